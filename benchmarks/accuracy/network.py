"""Accuracy of the retrieval of extinction where the beams of several lidars cross."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Final, TypeVar

import numpy as np

from benchmarks.accuracy import network_cases
from benchmarks.accuracy.network_cases import BLOCK, Air, LidarLine, Signals
from benchmarks.harness.benchmark import Effort
from benchmarks.harness.charts import chart, panel
from benchmarks.harness.costs import READS
from benchmarks.harness.drawing import Chart
from benchmarks.harness.figure import Array, Figure, Mask, cpu_time, share
from benchmarks.harness.rows import CPU_TIME, Row, Score, Scores, by_method, rows_of_scores
from benchmarks.harness.statistics import (
    SIGMAS,
    mean_by_block,
    root_by_block,
    share_by_block,
)
from benchmarks.harness.study import Chapter, Results, Study, Work
from benchmarks.harness.timing import READ
from lidarops.retrieve.air import visibility as sight
from lidarops.retrieve.network.extinction_field import NetworkResult

PROFILES: Final = 3000
QUICK_PROFILES: Final = 500
"""Profiles of each case, and of a quick run."""
CONTRASTS: Final = (sight.MOR_CONTRAST, sight.KOSCHMIEDER_CONTRAST, sight.PAPER_CONTRAST)
CLIPPED: Final = 3.0
"""Limit of relative errors: a quotient of noise has no variance."""
_WITHIN: Final = {"within 1": SIGMAS[0], "within 1.96": SIGMAS[1], "within 3": 3.0}
"""Numbers of standard errors."""
_PEER_PROFILES: Final = 1500
_QUICK_PEER_PROFILES: Final = 500
_CHUNK_BLOCKS: Final = 5
_SHORTEST: Final = 1e-9
"""s. A short call may take less than one tick of the clock."""
_SCIPY: Final = "scipy least_squares"
_SCIPY_MEAN: Final = f"{_SCIPY}, mean of {BLOCK} profiles"
_PEERS: Final = {
    _SCIPY: network_cases.network_by_scipy,
    _SCIPY_MEAN: network_cases.network_by_scipy_of_means,
}
"""The second one is given what the network with its prior is: the profiles of a block."""
_HIGHEST: Final = 2.0
"""Largest systematic error in figure 2."""
_RMSE: Final = "RMSE of extinction"
_RATIO: Final = "network / scipy"
_RATIO_MEAN: Final = f"network / scipy of means of {BLOCK}"
_FIRST: Final = ("mean error at the first crossing", "RMSE at the first crossing")

_Result = TypeVar("_Result")


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
    blocks = -(-(profiles or (QUICK_PROFILES if effort.quick else PROFILES)) // BLOCK)
    chunks = (-(-blocks // _CHUNK_BLOCKS), min(blocks, _CHUNK_BLOCKS) * BLOCK)
    fitted = peer_profiles or (_QUICK_PEER_PROFILES if effort.quick else _PEER_PROFILES)
    comparisons = compare_with_scipy(fitted)
    chapters: list[Chapter] = []
    visibilities: Scores = {}
    works: list[Work] = []
    for lidars in network_cases.LIDAR_LINES:
        scores: Scores = {}
        signals = {a.name: network_cases.signals(lidars.network(), a) for a in network_cases.AIRS}
        for index, (air, noise) in enumerate(product(network_cases.AIRS, network_cases.NOISES)):
            case = f"{air.name}, noise {_percent(noise)}"
            scored, results = _measure_case(noise, signals[air.name], chunks, index)
            scores |= {(case, method): score for method, score in scored.items()}
            if lidars is network_cases.THREE_BY_TWO and air is network_cases.VISIBILITY_AIR:
                visibilities |= _visibilities(results, signals[air.name], noise)
            effort.progress(1)
        chapters.append(_errors_chapter(lidars, scores, comparisons, math.prod(chunks)))
        works += _works(lidars, scores, comparisons)
    return Study(
        "Networks of lidars: error of extinction and visibility against run time",
        effort.date,
        [
            *chapters,
            _figure_chapter(),
            _visibility_chapter(visibilities),
            _peers_chapter(comparisons),
        ],
        works,
    )


def _percent(part: float) -> str:
    return f"{100.0 * part:g} %"


def _measure_case(
    noise: float, signals: Signals, chunks: tuple[int, int], seed: int
) -> tuple[dict[str, Score], list[NetworkResult]]:
    """Return the scores of every solver, and the results of the network method."""
    number, size = chunks
    truth, near = signals.truth(size), signals.network.near_crossing
    solvers = network_cases.NETWORK_SOLVERS
    errors: dict[str, list[CrossingErrors]] = {solver.name: [] for solver in solvers}
    least_seconds = dict.fromkeys((READ, *errors), math.inf)
    network_results = []
    for chunk in range(number):
        power, variance = signals.draw(noise, size, len(signals.network.origin), seed, chunk)
        least_seconds[READ] = min(least_seconds[READ], _timed(partial(np.max, power))[0])
        for solver in solvers:
            if chunk == 0:
                # The first call compiles and fills caches.
                solver(power[:BLOCK], variance[:BLOCK], signals)
            seconds, result = _timed(partial(solver, power, variance, signals))
            least_seconds[solver.name] = min(least_seconds[solver.name], seconds)
            errors[solver.name].append(crossing_errors(result, truth, near))
            network_results += [result] * (solver is network_cases.NETWORK)
    return {
        name: score_crossings(join_errors(parts))
        | {
            CPU_TIME: cpu_time(1e9 * least_seconds[name] / size),
            READS: least_seconds[name] / least_seconds[READ],
        }
        for name, parts in errors.items()
    }, network_results


def _timed(call: Callable[[], _Result]) -> tuple[float, _Result]:
    """Return the CPU time of a call in seconds, and its result."""
    start = time.process_time()
    result = call()
    return max(time.process_time() - start, _SHORTEST), result


# Scores ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class CrossingErrors:
    """(profile, near crossing) errors of one solver; NaN where values are withheld."""

    extinction: Array
    """Relative, clipped."""
    visibility: Array
    """Relative, clipped."""
    deviation: Array
    """Error of extinction over the stated standard error."""
    flagged: Mask
    chi_square: Array
    """(profile,)."""


def crossing_errors(result: NetworkResult, truth: Array, near: Mask) -> CrossingErrors:
    """Return the errors of a result.

    Parameters
    ----------
    result : NetworkResult
    truth : (profile, crossing) float
        Extinction, m-1.
    near : (crossing,) bool
    """
    extinction, truth = result.extinction[:, near], truth[:, near]
    stated = result.extinction_standard_error[:, near]
    return CrossingErrors(
        np.clip(extinction / truth - 1.0, -CLIPPED, CLIPPED),
        np.clip(truth / extinction - 1.0, -CLIPPED, CLIPPED),
        (extinction - truth) / stated,
        result.flagged[:, near],
        result.reduced_chi_square,
    )


def join_errors(chunks: Sequence[CrossingErrors]) -> CrossingErrors:
    """Return the errors of all profiles."""
    return CrossingErrors(
        *(
            np.concatenate([getattr(chunk, name) for chunk in chunks])
            for name in CrossingErrors.__slots__
        )
    )


def score_crossings(errors: CrossingErrors) -> Score:
    """Return the score of one solver in one case, relative to the truth; None without values.

    Monte Carlo errors come from the scatter between blocks, whose profiles share a field.
    """
    solved = np.isfinite(errors.extinction) & np.isfinite(errors.deviation)
    trusted = solved & ~errors.flagged
    columns = list(zip(errors.visibility.T, solved.T, strict=True))
    fitted = errors.chi_square[np.isfinite(errors.chi_square)]
    crossings = [rmse.value for v, k in columns if (rmse := root_by_block(v, k, BLOCK))]
    return {
        _FIRST[0]: _share(mean_by_block(*columns[0], BLOCK)),
        _FIRST[1]: _share(root_by_block(*columns[0], BLOCK)),
        "solved": share(float(solved.mean())),
        "flagged": share_by_block(errors.flagged, np.ones_like(solved), BLOCK),
        "mean error": _share(mean_by_block(errors.extinction, solved, BLOCK)),
        _RMSE: _share(root_by_block(errors.extinction, solved, BLOCK)),
        "RMSE unflagged": _share(root_by_block(errors.extinction, trusted, BLOCK)),
        **{
            name: share_by_block(np.abs(errors.deviation) <= sigmas, trusted, BLOCK)
            for name, sigmas in _WITHIN.items()
        },
        "χ²/dof": float(fitted.mean()) if fitted.size else None,
        "median crossing": share(float(np.median(crossings))) if crossings else None,
    }


def _share(figure: Figure | None) -> Figure | None:
    return None if figure is None else share(figure)


def _works(lidars: LidarLine, scores: Scores, comparisons: Scores) -> Iterator[Work]:
    # On the same profiles and crossings as the peer, where there is one.
    common = {
        (f"{air}, noise {_percent(network_cases.PEER_NOISE)}", method): {
            **scores.get((f"{air}, noise {_percent(network_cases.PEER_NOISE)}", method), {}),
            _RMSE: score[f"{method}, RMSE"],
            CPU_TIME: score[f"{method}, CPU time"],
        }
        for (place, air), score in comparisons.items()
        if place == lidars.name
        for method in (*(solver.name for solver in network_cases.NETWORK_SOLVERS), *_PEERS)
    }
    for (case, method), score in (scores | common).items():
        error, coverage, spent = score[_RMSE], score.get("within 1.96"), score[CPU_TIME]
        if isinstance(error, Figure) and isinstance(spent, Figure):
            yield Work(
                f"{lidars.name}, {case}",
                "extinction, relative",
                method,
                Figure(error.value, error.error),
                coverage if isinstance(coverage, Figure) else None,
                spent,
                ours=method not in _PEERS,
            )


_NOTE: Final = (
    "Solved: share of values that are not withheld. Within: share of unflagged values within this "
    "number of stated standard errors; 68.3, 95 and 99.7 % for correct errors. Median crossing: "
    "median over the crossings of the RMS error of visibility. CPU time per profile, and in "
    f"multiples of {READ}. In brackets: Monte Carlo standard error of the last digit, from block "
    "to block."
)


def _errors_chapter(
    lidars: LidarLine, scores: Scores, comparisons: Scores, profiles: int
) -> Chapter:
    network, name = lidars.network(), lidars.name.capitalize()
    rows = rows_of_scores(scores)
    solvers = [row for row in rows if row.quantity not in _FIRST]
    return Chapter(
        f"{name}: error against run time",
        f"{network.beams} beams, {network.crossings} crossings, of which "
        f"{int(network.near_crossing.sum())} near ones; {profiles:,} profiles of each "
        f"case, bins of {network_cases.STEP:g} m, "
        "relative noise of each bin as given, plus 1 % of the power at the first crossing of the "
        f"beam; blocks of {BLOCK} profiles. Extinction is 2 per km at 600 m with a "
        "scale height of 1 km (gradient), or 1.5 per km with a plume of 3.5 per km that is fixed "
        "or drifts by 300 m in a block. "
        "Errors are relative and clipped at 300 %, because a quotient of noise has no variance. "
        "Where noise hides the attenuation (0.2 per km), most values are flagged. The few "
        "unflagged ones are those that noise has made large, and their errors exceed the stated "
        "ones.",
        [
            *(
                Results(
                    f"{name}: visibility, {quantity}",
                    by_method(rows, quantity),
                    "All values that are not withheld, with and without flags.",
                    method="case",
                )
                for quantity in _FIRST
            ),
            Results(
                f"{name}: extinction by the network, all near crossings",
                [row for row in solvers if row.method == network_cases.NETWORK.name],
                _NOTE,
            ),
            Results(f"{name}: all methods", solvers, _NOTE, folded=True),
        ],
        [_chart(lidars, solvers, comparisons)],
    )


def _chart(lidars: LidarLine, rows: Sequence[Row], comparisons: Scores) -> Chart:
    airs = [air.name for air in network_cases.AIRS if air is not network_cases.THIN]
    peers = rows_of_scores(
        {
            (air, peer): {
                _RMSE: score[f"{peer}, RMSE"],
                CPU_TIME: score[f"{peer}, CPU time"],
            }
            for (place, air), score in comparisons.items()
            for peer in _PEERS
            if place == lidars.name
        }
    )
    drawn = [*rows, *peers]
    return chart(
        f"work-precision-{lidars.name.replace(' ', '')}",
        f"Error of extinction against run time, {lidars.name}",
        "Root mean square error at the near crossings, of values with and without flags, with bars "
        "of 2 Monte Carlo standard errors. The joined marks of a method are for noise of "
        f"{', '.join(_percent(noise) for noise in network_cases.NOISES)} of each bin; scipy has "
        f"{_percent(network_cases.PEER_NOISE)} only.",
        [
            panel(
                air,
                [row for row in drawn if row.case.split(", noise ")[0] == air],
                _RMSE,
                joined=True,
                hollow=_PEERS,
            )
            for air in airs
        ],
    )


# Figure 2 of the paper ------------------------------------------------------------------------


def _figure_chapter() -> Chapter:
    points = [
        network_cases.figure_point(first_lidar, elevation)
        for first_lidar, elevation in product(
            network_cases.FIGURE_FIRST_LIDARS, network_cases.FIGURE_ELEVATIONS
        )
    ]
    scores: Scores = {
        (f"{point.elevation:g}", f"{point.first_lidar:g} m"): {
            "paper, without signs": point.printed,
            "crossing 1, with signs": point.signed,
            "near crossing": point.near,
        }
        for point in points
    }
    rows = rows_of_scores(scores)
    drawn = [row for row in rows if not isinstance(row.value, float) or row.value <= _HIGHEST]
    return Chapter(
        "Figure 2 of the paper, and the correct signs",
        "Systematic error of visibility with a multiplier of 0.8 in homogeneous air of 2 per "
        "km, lidars 2 and 3 apart by 500 m, beams 1 and 3 at 120 and 90 degrees (drabenko2021). "
        "Without signs: the formula with unsigned lengths of the sides of the triangle, the only "
        "reading whose values fit the axis of the figure; the drawn curves were not compared. "
        "Below the crossing of beams 1 and 3, crossing 1 is the far one on both of its beams, and "
        "all signs change: the error at crossing 1 is above 1 and grows without limit up to a "
        "pole, below which there is no estimate. A cycle that starts at a near crossing and leads "
        "away from the lidars keeps the error below 1. At the crossing, it is 1 for every "
        "multiplier.",
        [
            Results(
                "Figure 2 by the distance of lidars 1 and 3",
                sorted(rows, key=lambda row: row.method),
                "(true - estimate) / true; none beyond the pole. Solved: from signals without "
                "noise, at the near crossing.",
                case="elevation",
                method="lidars apart",
            ),
        ],
        [
            chart(
                "paper-figure-2",
                "Systematic error of visibility, with a multiplier of 0.8",
                "(true - estimate) / true, by the distance of lidars 1 and 3. Solved: from signals "
                f"without noise, at the near crossing. Errors above {_HIGHEST:g}: table only.",
                [
                    panel(
                        quantity,
                        drawn,
                        quantity,
                        x="elevation of beam 2 (degree)",
                        joined=True,
                        logarithmic=(False, False),
                        level=1.0,
                    )
                    for quantity in dict.fromkeys(row.quantity for row in rows)
                ],
            ),
        ],
    )


# Visibility -----------------------------------------------------------------------------------


def _visibilities(results: Sequence[NetworkResult], signals: Signals, noise: float) -> Scores:
    near = signals.network.near_crossing
    truth = np.concatenate([signals.truth(len(result.extinction))[:, near] for result in results])
    extinction = np.concatenate([result.extinction[:, near] for result in results])
    stated = np.concatenate([result.extinction_standard_error[:, near] for result in results])
    flagged = np.concatenate([result.flagged[:, near] for result in results])
    kept = ~flagged & np.isfinite(extinction) & np.isfinite(stated)
    return {
        (_percent(noise), f"{contrast:.4g}"): _visibility_score(
            extinction, stated, truth, kept, contrast
        )
        for contrast in CONTRASTS
        if kept.any()
    }


def _visibility_score(
    extinction: Array, stated: Array, truth: Array, kept: Mask, contrast: float
) -> Score:
    constant = sight.koschmieder_constant(contrast)
    visibility = sight.visibility_from_extinction(extinction, stated, contrast=contrast)
    true = constant / truth
    error = visibility.visibility - true
    within = np.abs(error) <= visibility.visibility_standard_error
    inside = (visibility.visibility_lower <= true) & (true <= visibility.visibility_upper)
    return {
        "-ln(contrast)": constant,
        "mean truth (m)": float(true[kept].mean()),
        "mean error (m)": mean_by_block(error, kept, BLOCK),
        "RMSE (m)": root_by_block(error, kept, BLOCK),
        "within 1": share_by_block(within, kept, BLOCK),
        "in interval": share_by_block(inside, kept, BLOCK),
    }


def _visibility_chapter(scores: Scores) -> Chapter:
    return Chapter(
        "Visibility by three contrasts",
        f"Of unflagged extinction by the network of {network_cases.THREE_BY_TWO.name} in a "
        f"{network_cases.VISIBILITY_AIR.name}, all near crossings. A contrast multiplies values "
        "and errors alike. A wrong contrast is an error itself: visibility for 0.02 is 31 % larger "
        "than for 0.05, and 0.14 % larger for exp(-3).",
        [
            Results(
                "Errors of visibility",
                rows_of_scores(scores),
                "Within 1: within the linear standard error. Interval: from the lower to the "
                "upper visibility, converted from extinction. 68.3 % for correct errors.",
                case="noise",
                method="contrast",
            ),
        ],
    )


# Comparison with a plain fit ------------------------------------------------------------------


def compare_with_scipy(profiles: int) -> Scores:
    """Return errors and times of our methods and of a plain fit, by network and air.

    Of the same profiles, and of the near crossings that all of them solve.
    """
    airs: list[Air] = [air for air in network_cases.AIRS if air is not network_cases.THIN]
    scores: Scores = {}
    for seed, (lidars, air) in enumerate(product(network_cases.LIDAR_LINES, airs)):
        signals = network_cases.signals(lidars.network(), air)
        power, variance = signals.draw(network_cases.PEER_NOISE, profiles, 99, seed)
        near = signals.network.near_crossing
        truth = signals.truth(profiles)[:, near]
        ours = {
            solver.name: _timed(partial(solver, power, variance, signals))
            for solver in network_cases.NETWORK_SOLVERS
        }
        fitted = {
            name: _timed(partial(peer, power, variance, signals)) for name, peer in _PEERS.items()
        }
        extinctions = {name: result.extinction[:, near] for name, (_, result) in ours.items()}
        extinctions |= {name: values[:, near] for name, (_, values) in fitted.items()}
        seconds = {name: spent for name, (spent, _) in (*ours.items(), *fitted.items())}
        solved = np.all([np.isfinite(value) for value in extinctions.values()], axis=0)
        errors = {
            name: np.clip(value / truth - 1.0, -CLIPPED, CLIPPED)
            for name, value in extinctions.items()
        }
        plain, network = network_cases.NETWORK_WITHOUT_PRIOR.name, network_cases.NETWORK.name
        stated = ours[plain][1].extinction_standard_error[:, near]
        apart = ((extinctions[_SCIPY] - extinctions[plain]) / stated)[solved]
        scores[lidars.name, air.name] = {
            "profiles": profiles,
            "compared": share(float(solved.mean())),
            **{f"{name}, RMSE": _clipped_rms(error, solved) for name, error in errors.items()},
            _RATIO: _ratio(errors[network], errors[_SCIPY], solved),
            _RATIO_MEAN: _ratio(errors[network], errors[_SCIPY_MEAN], solved),
            "difference / stated": float(np.sqrt(np.mean(apart**2))),
            **{
                f"{name}, CPU time": cpu_time(1e9 * spent / profiles)
                for name, spent in seconds.items()
            },
        }
    return scores


def _clipped_rms(errors: Array, kept: Mask) -> Figure:
    """Return the root mean square of kept errors, from block to block."""
    rmse = root_by_block(errors, kept, BLOCK)
    return share(math.nan) if rmse is None else share(rmse)


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


def _peers_chapter(comparisons: Scores) -> Chapter:
    return Chapter(
        "Comparison with a plain fit",
        f"Noise {_percent(network_cases.PEER_NOISE)}: extinctions and "
        "beam constants by scipy.optimize.least_squares, weighted as if point values "
        "were independent, without errors or flags, and with all points; lidarops leaves out those "
        "that are too noisy. Of single profiles, and of the mean of a block, whose extinction is "
        "taken for all of its profiles: the network with its prior has the block, too. In air that "
        "stays as it is, a mean is hard to surpass; in air that moves, it is wrong.",
        [
            Results(
                "Networks and scipy, the same profiles and crossings",
                rows_of_scores(comparisons),
                "Of extinction at the near crossings that all solve, clipped at 300 %. Network / "
                "scipy: ratio of the RMSE, below 1 where ours is more accurate. Difference: root "
                "mean square of scipy and the network without prior, over its stated standard "
                "errors.",
                case="network",
                method="air",
            ),
        ],
    )
