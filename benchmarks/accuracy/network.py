"""Accuracy of the retrieval of extinction where the beams of several lidars cross."""

from __future__ import annotations

import math
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np

from benchmarks.accuracy.comparison import comparison
from benchmarks.accuracy.network_peers import network_by_scipy, network_by_scipy_of_means
from benchmarks.harness.figure import (
    TWO_SIDED,
    Array,
    Figure,
    Mask,
    Score,
    Scores,
    cpu_time,
    root_by_block,
    share,
    share_by_block,
    timed,
)
from benchmarks.harness.results import Effort, Results, Study, Work
from benchmarks.scenes import lidar_networks as scenes
from benchmarks.scenes.lidar_networks import BLOCK, PEER_NOISE, Signals

PROFILES: Final = 3000
QUICK_PROFILES: Final = 500
"""Profiles of each case, and of a quick run."""
CLIPPED: Final = 3.0
"""Limit of relative errors: a quotient of noise has no variance."""
_PEER_PROFILES: Final = 1500
_QUICK_PEER_PROFILES: Final = 500
_CHUNK_BLOCKS: Final = 5
_SCIPY: Final = "scipy least_squares"
_SCIPY_MEAN: Final = f"{_SCIPY}, mean of {BLOCK} profiles"
PEERS: Final = {_SCIPY: network_by_scipy, _SCIPY_MEAN: network_by_scipy_of_means}
"""The second one is given what the network with its prior is: the profiles of a block."""
CASES: Final = tuple(enumerate(product(scenes.AIRS, scenes.NOISES)))
"""Air and noise, each with its number, which is part of the seed."""


def measure_network(
    effort: Effort, *, profiles: int | None = None, peer_profiles: int | None = None
) -> Study:
    """Retrieve extinction in every network and air that peers solve too.

    Parameters
    ----------
    effort : Effort
    profiles : int, optional
        Number of profiles of which the coverage is that, rounded up to whole blocks.
    peer_profiles : int, optional
        Number of profiles of each comparison with a plain fit.
    """
    profiles = profiles or (QUICK_PROFILES if effort.quick else PROFILES)
    fitted = peer_profiles or (_QUICK_PEER_PROFILES if effort.quick else _PEER_PROFILES)
    cases = [
        (number, air)
        for number, (air, noise) in CASES
        if noise == PEER_NOISE and air is not scenes.THIN
    ]
    comparisons: Scores = {}
    works: list[Work] = []
    for seed, (lidars, (number, air)) in enumerate(product(scenes.LIDAR_LINES, cases)):
        clean = scenes.signals(lidars.network(), air)
        score = comparisons[lidars.name, air.name] = compare_with_scipy(clean, fitted, seed)
        coverage = _coverage(clean, profiles, number)
        works += [
            Work(
                f"{lidars.name}, {air.name}, noise {100.0 * PEER_NOISE:g} %",
                "extinction, relative", method, Figure(error.value, error.error),
                coverage.get(method), score[f"{method}, CPU time"], ours=method not in PEERS,
            )
            for method in (*scenes.SOLVERS, *PEERS)
            for error in [score[f"{method}, RMSE"]]
        ]  # fmt: skip
        effort.progress(1)
    beside = Results(
        "Networks and scipy, the same profiles and crossings",
        comparisons,
        f"Noise {100.0 * PEER_NOISE:g} %: extinctions and beam constants by "
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
        f"Bins of {scenes.STEP:g} m, relative noise of each bin as given, plus 1 % of the power at "
        f"the first crossing of the beam; blocks of {BLOCK} profiles. Errors are relative and "
        "clipped at 300 %, because a quotient of noise has no variance. Coverage: of "
        f"{math.prod(_chunks(profiles)):,} other profiles."
    )
    return comparison("networks of lidars", works, note, [beside])


def _chunks(profiles: int) -> tuple[int, int]:
    """Return the number of chunks that are solved together, and their size, of whole blocks."""
    blocks = -(-profiles // BLOCK)
    return -(-blocks // _CHUNK_BLOCKS), min(blocks, _CHUNK_BLOCKS) * BLOCK


def solve_case(clean: Signals, noise: float, profiles: int, seed: int) -> dict[str, dict[str, Any]]:
    """Return the results of every solver by name: arrays by the names of their fields."""
    number, size = _chunks(profiles)
    beams = len(clean.network.origin)
    drawn = [clean.draw(noise, size, beams, seed, chunk) for chunk in range(number)]
    names = ("extinction", "extinction_standard_error", "flagged", "reduced_chi_square")
    results = {}
    for method, solve in scenes.SOLVERS.items():
        solved = [solve(power, variance, clean) for power, variance in drawn]
        results[method] = {
            name: np.concatenate([getattr(one, name) for one in solved]) for name in names
        }
    return results


def _coverage(clean: Signals, profiles: int, seed: int) -> dict[str, Figure | None]:
    """Return the share of unflagged values within 1.96 stated errors, by solver."""
    near, shares = clean.network.near_crossing, {}
    for method, result in solve_case(clean, PEER_NOISE, profiles, seed).items():
        values = result["extinction"][:, near]
        deviation = values - clean.truth(len(values))[:, near]
        deviation /= result["extinction_standard_error"][:, near]
        trusted = np.isfinite(deviation) & ~result["flagged"][:, near]
        shares[method] = share_by_block(np.abs(deviation) <= TWO_SIDED, trusted, BLOCK)
    return shares


def compare_with_scipy(clean: Signals, profiles: int, seed: int) -> Score:
    """Return errors and times of our methods and of a plain fit of a network.

    Of the same profiles, and of the near crossings that all of them solve.
    """
    power, variance = clean.draw(PEER_NOISE, profiles, 99, seed)
    near = clean.network.near_crossing
    truth = clean.truth(profiles)[:, near]
    ours = {
        name: timed(partial(solve, power, variance, clean))
        for name, solve in scenes.SOLVERS.items()
    }
    fitted = {name: timed(partial(peer, power, variance, clean)) for name, peer in PEERS.items()}
    values = {name: result.extinction[:, near] for name, (_, result) in ours.items()}
    values |= {name: extinction[:, near] for name, (_, extinction) in fitted.items()}
    seconds = {name: spent for name, (spent, _) in (*ours.items(), *fitted.items())}
    solved = np.all([np.isfinite(value) for value in values.values()], axis=0)
    errors = {
        name: np.clip(value / truth - 1.0, -CLIPPED, CLIPPED) for name, value in values.items()
    }
    plain, network = scenes.NO_PRIOR, scenes.NETWORK
    stated = ours[plain][1].extinction_standard_error[:, near]
    apart = ((values[_SCIPY] - values[plain]) / stated)[solved]
    return {
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
            f"{name}, CPU time": cpu_time(1e9 * spent / profiles) for name, spent in seconds.items()
        },
    }


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
