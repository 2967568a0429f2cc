"""Accuracy of the retrieval of extinction where the beams of several lidars cross."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np

from benchmarks.accuracy.comparison import comparison
from benchmarks.accuracy.network_peers import network_by_scipy, network_by_scipy_of_means
from benchmarks.harness.figure import (
    CPU_TIME,
    TWO_SIDED,
    Array,
    Figure,
    Mask,
    Score,
    Scores,
    Unit,
    cpu_time,
    root_by_block,
    share,
    share_by_block,
    timed,
)
from benchmarks.harness.results import Effort, Results, Study, Work
from benchmarks.scenes import lidar_networks as cases
from benchmarks.scenes.lidar_networks import BLOCK, LidarLine, Signals

PROFILES: Final = 3000
QUICK_PROFILES: Final = 500
"""Profiles of each case, and of a quick run."""
CLIPPED: Final = 3.0
"""Limit of relative errors: a quotient of noise has no variance."""
_WITHIN: Final = {"within 1.96": TWO_SIDED, "within 3": 3.0}
"""Numbers of standard errors."""
_PEER_PROFILES: Final = 1500
_QUICK_PEER_PROFILES: Final = 500
_CHUNK_BLOCKS: Final = 5
_SCIPY: Final = "scipy least_squares"
_SCIPY_MEAN: Final = f"{_SCIPY}, mean of {BLOCK} profiles"
PEERS: Final = {_SCIPY: network_by_scipy, _SCIPY_MEAN: network_by_scipy_of_means}
"""The second one is given what the network with its prior is: the profiles of a block."""
_RMSE: Final = "RMSE of extinction"


def measure_network(
    effort: Effort, *, profiles: int | None = None, peer_profiles: int | None = None
) -> Study:
    """Retrieve extinction in every network, air and noise, with every solver.

    Parameters
    ----------
    effort : Effort
    profiles : int, optional
        Number of profiles of each case, rounded up to whole blocks.
    peer_profiles : int, optional
        Number of profiles of each comparison with a plain fit.
    """
    chunks = _chunks(profiles or (QUICK_PROFILES if effort.quick else PROFILES))
    fitted = peer_profiles or (_QUICK_PEER_PROFILES if effort.quick else _PEER_PROFILES)
    comparisons = compare_with_scipy(fitted)
    works: list[Work] = []
    for lidars in cases.LIDAR_LINES:
        scores: Scores = {}
        for index, (air, noise) in enumerate(product(cases.AIRS, cases.NOISES)):
            clean = cases.signals(lidars.network(), air)
            for method, score in measure_case(clean, noise, math.prod(chunks), index).items():
                scores[_case(air.name, noise), method] = score
            effort.progress(1)
        works += _works(lidars, scores, comparisons)
    beside = Results(
        "Networks and scipy, the same profiles and crossings",
        comparisons,
        f"Noise {_percent(cases.PEER_NOISE)}: extinctions and beam constants by "
        "scipy.optimize.least_squares, weighted as if point values were independent, without "
        "errors or flags, and with all points; lidarops leaves out those that are too noisy. Of "
        "single profiles, and of the mean of a block, whose extinction is taken for all of its "
        "profiles: the network with its prior has the block, too. In air that stays as it is, a "
        "mean is hard to surpass; in air that moves, it is wrong. Of extinction at the near "
        "crossings that all solve, clipped at 300 %. Network / scipy: ratio of the RMSE, below 1 "
        "where ours is more accurate. Difference: root mean square of scipy and the network "
        "without prior, over its stated standard errors.",
        case="network",
        method="air",
    )
    note = (
        f"{math.prod(chunks):,} profiles of each case, bins of {cases.STEP:g} m, relative noise of "
        "each bin as given, plus 1 % of the power at the first crossing of the beam; blocks of "
        f"{BLOCK} profiles. Errors are relative and clipped at 300 %, because a quotient of noise "
        "has no variance."
    )
    return comparison("networks of lidars", effort, works, note, [beside])


def _percent(part: float) -> str:
    return f"{100.0 * part:g} %"


def _case(air: str, noise: float) -> str:
    return f"{air}, noise {_percent(noise)}"


def _chunks(profiles: int) -> tuple[int, int]:
    """Return the number of chunks that are solved together, and their size, of whole blocks."""
    blocks = -(-profiles // BLOCK)
    return -(-blocks // _CHUNK_BLOCKS), min(blocks, _CHUNK_BLOCKS) * BLOCK


def measure_case(clean: Signals, noise: float, profiles: int, seed: int) -> dict[str, Score]:
    """Return the scores of every solver."""
    number, size = _chunks(profiles)
    beams = len(clean.network.origin)
    drawn = [clean.draw(noise, size, beams, seed, chunk) for chunk in range(number)]
    truth = np.concatenate([clean.truth(size)] * number)
    scores = {}
    for name, solve in cases.SOLVERS.items():
        # The first call compiles and fills caches.
        solve(*(each[:BLOCK] for each in drawn[0]), clean)
        solved = [timed(partial(solve, *each, clean)) for each in drawn]
        names = ("extinction", "extinction_standard_error", "flagged", "reduced_chi_square")
        whole = {key: np.concatenate([getattr(one, key) for _, one in solved]) for key in names}
        spent = min(seconds for seconds, _ in solved)
        scores[name] = score_crossings(whole, truth, clean.network.near_crossing)
        scores[name][CPU_TIME] = cpu_time(1e9 * spent / size)
    return scores


def score_crossings(result: dict[str, Any], truth: Array, near: Mask) -> Score:
    """Return the score of one solver in one case, relative to the truth; None without values.

    Monte Carlo errors come from the scatter between blocks, whose profiles share a field.

    Parameters
    ----------
    result : mapping of str to array
        ``extinction``, its ``extinction_standard_error`` and ``flagged``, (profile, crossing), and
        ``reduced_chi_square``, (profile,).
    truth : (profile, crossing) float
        Extinction, m-1.
    near : (crossing,) bool
    """
    extinction, truth, flagged = result["extinction"][:, near], truth[:, near], result["flagged"]
    deviation = (extinction - truth) / result["extinction_standard_error"][:, near]
    relative = np.clip(extinction / truth - 1.0, -CLIPPED, CLIPPED)
    visibility = np.clip(truth / extinction - 1.0, -CLIPPED, CLIPPED)
    solved = np.isfinite(extinction) & np.isfinite(deviation)
    trusted = solved & ~flagged[:, near]
    chi = result["reduced_chi_square"]
    of_visibility = [
        root_by_block(values, kept, BLOCK)
        for values, kept in zip(visibility.T, solved.T, strict=True)
    ]
    crossings = [rmse.value for rmse in of_visibility if rmse]
    return {
        "RMSE at the first crossing": of_visibility[0],
        "solved": share(float(solved.mean())),
        "flagged": share_by_block(flagged[:, near], np.ones_like(solved), BLOCK),
        _RMSE: root_by_block(relative, solved, BLOCK),
        **{
            name: share_by_block(np.abs(deviation) <= sigmas, trusted, BLOCK)
            for name, sigmas in _WITHIN.items()
        },
        "χ²/dof": float(np.nanmean(chi)) if np.isfinite(chi).any() else None,
        "median crossing": share(float(np.median(crossings))) if crossings else None,
    }


def _works(lidars: LidarLine, scores: Scores, comparisons: Scores) -> Iterator[Work]:
    # On the same profiles and crossings as the peer, where there is one.
    common: Scores = {}
    for (place, air), score in comparisons.items():
        for method in (*cases.SOLVERS, *PEERS) if place == lidars.name else ():
            key = (_case(air, cases.PEER_NOISE), method)
            own = {_RMSE: score[f"{method}, RMSE"], CPU_TIME: score[f"{method}, CPU time"]}
            common[key] = scores.get(key, {}) | own
    for (case, method), score in (scores | common).items():
        if score[_RMSE] is not None:
            yield Work(
                f"{lidars.name}, {case}", "extinction, relative", method,
                replace(score[_RMSE], unit=Unit.NUMBER), score.get("within 1.96"), score[CPU_TIME],
                ours=method not in PEERS,
            )  # fmt: skip


def compare_with_scipy(profiles: int) -> Scores:
    """Return errors and times of our methods and of a plain fit, by network and air.

    Of the same profiles, and of the near crossings that all of them solve.
    """
    airs = [air for air in cases.AIRS if air is not cases.THIN]
    scores: Scores = {}
    for seed, (lidars, air) in enumerate(product(cases.LIDAR_LINES, airs)):
        clean = cases.signals(lidars.network(), air)
        power, variance = clean.draw(cases.PEER_NOISE, profiles, 99, seed)
        near = clean.network.near_crossing
        truth = clean.truth(profiles)[:, near]
        ours = {
            name: timed(partial(solve, power, variance, clean))
            for name, solve in cases.SOLVERS.items()
        }
        fitted = {
            name: timed(partial(peer, power, variance, clean)) for name, peer in PEERS.items()
        }
        values = {name: result.extinction[:, near] for name, (_, result) in ours.items()}
        values |= {name: extinction[:, near] for name, (_, extinction) in fitted.items()}
        seconds = {name: spent for name, (spent, _) in (*ours.items(), *fitted.items())}
        solved = np.all([np.isfinite(value) for value in values.values()], axis=0)
        errors = {
            name: np.clip(value / truth - 1.0, -CLIPPED, CLIPPED) for name, value in values.items()
        }
        plain, network = cases.NO_PRIOR, cases.NETWORK
        stated = ours[plain][1].extinction_standard_error[:, near]
        apart = ((values[_SCIPY] - values[plain]) / stated)[solved]
        scores[lidars.name, air.name] = {
            "profiles": profiles,
            "compared": share(float(solved.mean())),
            **{
                f"{name}, RMSE": share(root_by_block(error, solved, BLOCK) or math.nan)
                for name, error in errors.items()
            },
            "network / scipy": _ratio(errors[network], errors[_SCIPY], solved),
            f"network / scipy of means of {BLOCK}": _ratio(
                errors[network], errors[_SCIPY_MEAN], solved
            ),
            "difference / stated": float(np.sqrt(np.mean(apart**2))),
            **{
                f"{name}, CPU time": cpu_time(1e9 * spent / profiles)
                for name, spent in seconds.items()
            },
        }
    return scores


def _ratio(ours: Array, peers: Array, kept: Mask) -> Figure:
    """Return the ratio of two RMS errors of the same values, with its error from the blocks.

    The errors of both follow the same noise, so that their ratio scatters less than either.
    """
    first = np.arange(0, len(kept), BLOCK)
    squares = [
        np.add.reduceat(np.where(kept, error**2, 0.0).sum(axis=1), first) for error in (ours, peers)
    ]
    totals = [square.sum() for square in squares]
    parts = squares[0] / totals[0] - squares[1] / totals[1]
    scatter = np.sum(parts**2) * first.size / max(first.size - 1, 1)
    ratio = math.sqrt(totals[0] / totals[1])
    return Figure(ratio, 0.5 * ratio * math.sqrt(scatter))
