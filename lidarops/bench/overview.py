"""Error against run time of all retrievals in uniform rows, with tables and charts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from lidarops.bench.accuracy import elastic_cases
from lidarops.bench.accuracy.elastic import Elastic
from lidarops.bench.accuracy.elastic_costs import ALL_STEPS
from lidarops.bench.accuracy.homogeneous import Accuracy, outcomes_of
from lidarops.bench.accuracy.multiangle_scores import MultiAngle
from lidarops.bench.accuracy.network_scores import NetworkAccuracy
from lidarops.bench.accuracy.peers import iterative_peers
from lidarops.bench.harness.rows import (
    CPU_TIME,
    MonteCarloFigure,
    Quantity,
    Row,
    Unit,
    error_against_time,
    rows_of,
    table,
)
from lidarops.figures.charts import Chart
from lidarops.figures.wording import percent
from lidarops.reports.benchmark_page import Part, Table
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod

HOMOGENEOUS: Final = "homogeneous path"
ELASTIC: Final = "elastic inversion"
SCANS: Final = "scans over zenith angle"
NETWORKS: Final = "networks of lidars"

_LEVELS: Final = (1e2, 1e5)
"""Backgrounds of the elastic retrieval that are shown, counts per shot."""
_WITH_PRIOR_KNOWLEDGE: Final = frozenset(
    {
        HomogeneousMethod.LINEARIZED,
        HomogeneousMethod.KNOWN_BACKGROUND,
        HomogeneousMethod.KNOWN_EXTINCTION,
        elastic_cases.KNOWN_CLEAN_RANGE,
    }
)
"""Methods that know more than the profile."""
_SHOWN: Final = {
    ELASTIC: "background of 100000 counts",
    NETWORKS: "3 x 2 beams, plume, noise 5.0 %",
}
"""Setting shown for a retrieval, if not its first."""
_NETWORK_PEERS: Final = frozenset({"slope", "Klett, far end"})
_SCAN_PEERS: Final = frozenset({"numpy lstsq", "Tikhonov, L-curve", "scipy lsq_linear"})
_WHOLE: Final = "chosen, error carried"
"""Chain of all steps of the elastic retrieval."""
_EXTINCTION: Final = "extinction"
_INNER: Final = 1
"""Index of the 95 percent interval among the scored ones."""
_RMSE: Final = Quantity("RMSE", "error")
_OF_WORK: Final = (
    _RMSE,
    Quantity("95 %", "coverage", Unit.SHARE),
    Quantity(CPU_TIME, "nanoseconds", Unit.TIME),
)


@dataclass(frozen=True, slots=True)
class Baseline:
    """Time of a minimal operation on the same machine."""

    what: str
    nanoseconds: float
    """CPU time, minimum of the repeats."""


@dataclass(frozen=True, slots=True)
class WorkPrecision:
    """Error and run time of one method in one setting."""

    retrieval: str
    setting: str
    quantity: str
    """With its unit."""
    method: str
    ours: bool
    """Whether a method of lidarops; else a peer."""
    error: MonteCarloFigure
    """Root mean square."""
    coverage: MonteCarloFigure | None
    """Share of truths in the stated 95 percent interval; None if the method states none."""
    nanoseconds: float
    """CPU time per profile."""


def work_precision_rows(
    homogeneous: Accuracy, elastic: Elastic, scans: MultiAngle, networks: NetworkAccuracy
) -> tuple[WorkPrecision, ...]:
    """Return the rows of all retrievals."""
    return (
        *_path_rows(homogeneous),
        *_elastic_rows(elastic),
        *_scan_rows(scans),
        *_network_rows(networks),
    )


def _path_rows(accuracy: Accuracy) -> Iterator[WorkPrecision]:
    peers = iterative_peers()
    for method in dict.fromkeys(
        outcome.method for case in accuracy.cases for outcome in case.outcomes
    ):
        pairs = outcomes_of(accuracy, method)
        scores = [o.scores[_EXTINCTION] for _, o in pairs if _EXTINCTION in o.scores]
        if not scores:
            continue
        yield WorkPrecision(
            HOMOGENEOUS,
            f"median of {len(pairs)} paths",
            "extinction, RMSE over the Cramér-Rao bound",
            method,
            method not in peers and method != HomogeneousMethod.TAIL_MEAN,
            _median_figure([score.rmse for score in scores]),
            _median_figure([score.coverage for score in scores]),
            float(np.median([outcome.nanoseconds for _, outcome in pairs])),
        )


def _median_figure(figures: Sequence[MonteCarloFigure]) -> MonteCarloFigure:
    ranked = sorted(figures, key=lambda figure: figure.value)
    return ranked[len(ranked) // 2]


def _elastic_rows(accuracy: Elastic) -> Iterator[WorkPrecision]:
    times = {cost.step: cost.nanoseconds for cost in accuracy.costs}
    for level in accuracy.levels:
        if level.level not in _LEVELS:
            continue
        setting = f"background of {level.level:.0f} counts"
        for method, score in level.backgrounds.items():
            if method in times:
                yield WorkPrecision(
                    ELASTIC,
                    setting,
                    "background, counts",
                    method,
                    method != elastic_cases.TAIL_MEAN,
                    score.rmse,
                    score.coverage[_INNER],
                    times[method],
                )
        inverted = level.inversions.get(_WHOLE)
        if inverted is not None and ALL_STEPS in times:
            yield WorkPrecision(
                ELASTIC,
                setting,
                "backscatter 0.5 to 6 km, relative",
                ALL_STEPS,
                True,  # noqa: FBT003 - a row of a table
                inverted.rmse,
                inverted.coverage[_INNER],
                times[ALL_STEPS],
            )


def _scan_rows(accuracy: MultiAngle) -> Iterator[WorkPrecision]:
    for scene in accuracy.scenes:
        for score in scene.scores:
            yield WorkPrecision(
                SCANS,
                scene.label,
                "optical depth",
                score.method,
                score.method not in _SCAN_PEERS,
                score.rmse,
                None if score.coverage is None else score.coverage[_INNER],
                score.nanoseconds,
            )


def _network_rows(accuracy: NetworkAccuracy) -> Iterator[WorkPrecision]:
    for case in accuracy.cases:
        for method, score in case.scores.items():
            if score.rmse is not None:
                yield WorkPrecision(
                    NETWORKS,
                    f"{case.place}, {case.air}, noise {percent(case.noise)}",
                    "extinction, relative",
                    method,
                    method not in _NETWORK_PEERS,
                    score.rmse,
                    None if score.within is None else score.within[_INNER],
                    1e3 * score.microseconds,
                )


def overview(works: Sequence[WorkPrecision], baselines: Sequence[Baseline]) -> Part:
    """Return the chapter that compares all retrievals."""
    retrievals = list(dict.fromkeys(work.retrieval for work in works))
    floors = [row for floor in baselines for row in rows_of("", floor.what, floor, (_OF_WORK[-1],))]
    return Part(
        title="Error against run time, all retrievals",
        text="All methods of all retrievals, with common baselines and iterative peers, on "
        "simulated profiles with known truth. Root mean square error over the profiles that a "
        "method does not reject; CPU time per profile on one core. The chapters below describe "
        "the simulations and give bias, coverage and flags.",
        charts=tuple(_chart(works, retrieval) for retrieval in retrievals),
        tables=(
            best_methods(works),
            table("Minimal operations, measured in the same run", floors, method="operation"),
        ),
        details=tuple(
            table(
                f"{retrieval.capitalize()}: all methods",
                [
                    row
                    for work in works
                    if work.retrieval == retrieval
                    for row in _rows(work, f"{work.quantity}; {work.setting}")
                ],
                case="error of",
            )
            for retrieval in retrievals
        ),
    )


def _rows(work: WorkPrecision, case: str) -> list[Row]:
    method = work.method if work.ours else f"peer: {work.method}"
    return rows_of(case, method, work, _OF_WORK)


def best_methods(works: Sequence[WorkPrecision]) -> Table:
    """Return the best of our methods and of the peers for each retrieval and quantity.

    Of methods whose errors differ by less than 2 Monte Carlo errors, the best is the fastest.
    """
    rows: list[Row] = []
    for retrieval, quantity in dict.fromkeys((work.retrieval, work.quantity) for work in works):
        group = [
            work
            for work in works
            if (work.retrieval, work.quantity) == (retrieval, quantity)
            and work.method not in _WITH_PRIOR_KNOWLEDGE
        ]
        setting = _SHOWN.get(retrieval, group[0].setting)
        for ours in (True, False):
            candidates = [work for work in group if work.ours is ours and work.setting == setting]
            if candidates:
                rows += _rows(_best(candidates), f"{retrieval}, {setting}: {quantity}")
    return table(
        "The most accurate of our methods and of the peers",
        rows,
        "Of methods whose errors differ by less than 2 Monte Carlo errors, the fastest. One "
        "setting of each retrieval; the tables below list all. 95 %: share of truths in the "
        "stated interval. In brackets: Monte Carlo standard error.",
        case="error of",
    )


def _best(works: Sequence[WorkPrecision]) -> WorkPrecision:
    lowest_error = min((work.error for work in works), key=lambda error: error.value)
    equal = [
        work
        for work in works
        if work.error.value - lowest_error.value
        <= 2.0 * math.hypot(work.error.error, lowest_error.error)
    ]
    return min(equal, key=lambda work: work.nanoseconds)


def _chart(works: Sequence[WorkPrecision], retrieval: str) -> Chart:
    quantity = next(work.quantity for work in works if work.retrieval == retrieval)
    drawn = [work for work in works if (work.retrieval, work.quantity) == (retrieval, quantity)]
    settings = list(dict.fromkeys(work.setting for work in drawn))
    chosen = (settings[0], _SHOWN.get(retrieval, settings[-1]))
    chart = error_against_time(
        "all-" + retrieval.replace(" ", "-"),
        [
            row
            for work in drawn
            if work.setting in chosen
            for row in rows_of(work.setting, work.method, work, _OF_WORK)
        ],
        _RMSE.name,
        hollow={w.method for w in drawn if not w.ours or w.method in _WITH_PRIOR_KNOWLEDGE},
        gain=1.0,
    )
    return replace(chart, title=f"{retrieval.capitalize()}: RMSE of {quantity} against CPU time")
