"""Error against run time of all retrievals in uniform rows, with tables and charts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from lidarops.bench.accuracy import elastic_cases
from lidarops.bench.accuracy.elastic import Elastic
from lidarops.bench.accuracy.elastic_costs import ALL_STEPS
from lidarops.bench.accuracy.homogeneous import Accuracy, MonteCarloFigure, outcomes_of
from lidarops.bench.accuracy.multiangle_scores import MultiAngle
from lidarops.bench.accuracy.network_scores import NetworkAccuracy
from lidarops.bench.accuracy.peers import iterative_peers
from lidarops.figures.charts import Chart, Panel, Series, pareto
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
_NONE: Final = "-"
_INNER: Final = 1
"""Index of the 95 percent interval among the scored ones."""


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


def overview(rows: Sequence[WorkPrecision], baselines: Sequence[Baseline]) -> Part:
    """Return the chapter that compares all retrievals."""
    retrievals = list(dict.fromkeys(work.retrieval for work in rows))
    floors = Table(
        title="Minimal operations, measured in the same run",
        columns=("operation", "CPU time"),
        rows=tuple((floor.what, format_time(floor.nanoseconds)) for floor in baselines),
    )
    return Part(
        title="Error against run time, all retrievals",
        text="All methods of all retrievals, with common baselines and iterative peers, on "
        "simulated profiles with known truth. Root mean square error over the profiles that a "
        "method does not reject; CPU time per profile on one core. The chapters below describe "
        "the simulations and give bias, coverage and flags.",
        charts=tuple(_chart(rows, retrieval) for retrieval in retrievals),
        tables=(best_methods(rows), floors),
        details=tuple(_table(rows, retrieval) for retrieval in retrievals),
    )


def best_methods(works: Sequence[WorkPrecision]) -> Table:
    """Return the best of our methods and of the peers for each retrieval and quantity.

    Of methods whose errors differ by less than 2 Monte Carlo errors, the best is the fastest.
    """
    rows = []
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
                rows.append((f"{retrieval}, {setting}: {quantity}", *_cells(_best(candidates))))
    return Table(
        title="The most accurate of our methods and of the peers",
        columns=("error of", "method", "RMSE", "95 %", "per profile"),
        rows=tuple(rows),
        note="Of methods whose errors differ by less than 2 Monte Carlo errors, the fastest. One "
        "setting of each retrieval; the tables below list all. 95 %: share of truths in the "
        "stated interval. In brackets: Monte Carlo standard error.",
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


def _cells(work: WorkPrecision) -> tuple[str, ...]:
    return (
        work.method if work.ours else f"peer: {work.method}",
        f"{work.error.value:.3g} ({work.error.error:.1g})",
        _NONE if work.coverage is None else percent(work.coverage.value),
        format_time(work.nanoseconds),
    )


def format_time(nanoseconds: float) -> str:
    """Return a time in s, ms, µs or ns."""
    for unit, size in (("s", 1e9), ("ms", 1e6), ("µs", 1e3)):
        if nanoseconds >= size:
            return f"{nanoseconds / size:.3g} {unit}"
    return f"{nanoseconds:.3g} ns"


def _table(works: Sequence[WorkPrecision], retrieval: str) -> Table:
    rows = [(w.setting, w.quantity, *_cells(w)) for w in works if w.retrieval == retrieval]
    return Table(
        title=f"{retrieval.capitalize()}: all methods",
        columns=("setting", "error of", "method", "RMSE", "95 %", "per profile"),
        rows=tuple(rows),
    )


def _chart(works: Sequence[WorkPrecision], retrieval: str) -> Chart:
    of_retrieval = [work for work in works if work.retrieval == retrieval]
    quantity = of_retrieval[0].quantity
    shown = [work for work in of_retrieval if work.quantity == quantity]
    settings = list(dict.fromkeys(work.setting for work in shown))
    chosen = dict.fromkeys((settings[0], _SHOWN.get(retrieval, settings[-1])))
    methods = list(dict.fromkeys(work.method for work in shown))
    return Chart(
        name="all-" + retrieval.replace(" ", "-"),
        title=f"{retrieval.capitalize()}: error against CPU time",
        caption=f"RMSE of {quantity}, with bars of 2 Monte Carlo standard errors. Hollow: peers, "
        "and methods that know more than the profile. The steps join the methods that no other "
        "beats in both error and time.",
        panels=tuple(
            _panel([work for work in shown if work.setting == setting], setting, methods)
            for setting in chosen
        ),
    )


def _panel(works: Sequence[WorkPrecision], setting: str, methods: Sequence[str]) -> Panel:
    by_method = {work.method: work for work in works}
    return Panel(
        title=setting,
        x_label="CPU time per profile (µs)",
        y_label="RMSE",
        # A method without value keeps its place, so that a mark means the same in all panels.
        series=tuple(
            _point(by_method[method]) if method in by_method else Series(method, (), ())
            for method in methods
        ),
        front=pareto(
            [
                (_micro(work), work.error.value)
                for work in works
                if work.method not in _WITH_PRIOR_KNOWLEDGE
            ]
        ),
    )


def _point(work: WorkPrecision) -> Series:
    error = work.error
    return Series(
        work.method,
        (_micro(work),),
        (error.value,),
        (max(error.value - 2 * error.error, 0.5 * error.value),),
        (error.value + 2 * error.error,),
        hollow=not work.ours or work.method in _WITH_PRIOR_KNOWLEDGE,
    )


def _micro(work: WorkPrecision) -> float:
    return work.nanoseconds / 1e3
