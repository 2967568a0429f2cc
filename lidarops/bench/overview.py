"""Error against run time of all retrievals, in rows of one shape."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from lidarops.bench.accuracy import elastic_cases
from lidarops.bench.accuracy.elastic import Elastic
from lidarops.bench.accuracy.homogeneous import Accuracy, MonteCarloFigure, outcomes_of
from lidarops.bench.accuracy.multiangle_scores import MultiAngle
from lidarops.bench.accuracy.network_scores import MultiPosition
from lidarops.bench.accuracy.peers import iterative_peers
from lidarops.bench.throughput.retrievals import ALL_STEPS
from lidarops.figures.charts import Chart, Panel, Series, pareto
from lidarops.figures.wording import percent
from lidarops.reports.benchmark_page import Part, Table
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod

HOMOGENEOUS: Final = "homogeneous path"
ELASTIC: Final = "elastic inversion"
SCANS: Final = "scans over zenith angle"
NETWORKS: Final = "networks of lidars"

_LEVELS: Final = (1e2, 1e5)
"""Backgrounds of the elastic retrieval that stand for all, counts a shot."""
_HELPED: Final = frozenset(
    {
        HomogeneousMethod.LINEARIZED,
        HomogeneousMethod.KNOWN_BACKGROUND,
        HomogeneousMethod.KNOWN_EXTINCTION,
        elastic_cases.TOLD,
    }
)
"""Methods that are told more than the profile."""
_SHOWN: Final = {
    ELASTIC: "background of 100000 counts",
    NETWORKS: "3 x 2 beams, plume, noise 5.0 %",
}
"""Settings that stand for all of a retrieval; else its first."""
_PLAIN_WAYS: Final = frozenset({"slope", "Klett, far end"})
_SCAN_PEERS: Final = frozenset({"numpy lstsq", "Tikhonov, L-curve", "scipy lsq_linear"})
_WHOLE: Final = "chosen, error carried"
"""The chain of all steps."""
_EXTINCTION: Final = "extinction"
_NONE: Final = "-"
_INNER: Final = 1
"""Place of the 95 percent interval among those that are scored."""


@dataclass(frozen=True, slots=True)
class Baseline:
    """What the machine can do at best."""

    what: str
    nanoseconds: float
    """CPU time, least of the repeats."""


@dataclass(frozen=True, slots=True)
class Work:
    """Error and run time of one way in one setting."""

    retrieval: str
    setting: str
    quantity: str
    """With its unit."""
    way: str
    ours: bool
    """Whether a method of lidarops; else a peer."""
    error: MonteCarloFigure
    """Root mean square."""
    coverage: MonteCarloFigure | None
    """Share of truths in the stated 95 percent interval; None where the way states none."""
    nanoseconds: float
    """CPU time of a profile."""


def works(
    homogeneous: Accuracy, elastic: Elastic, scans: MultiAngle, networks: MultiPosition
) -> tuple[Work, ...]:
    """Return the rows of all retrievals."""
    return (
        *_of_paths(homogeneous),
        *_of_elastic(elastic),
        *_of_scans(scans),
        *_of_networks(networks),
    )


def _of_paths(found: Accuracy) -> Iterator[Work]:
    others = iterative_peers()
    for way in dict.fromkeys(outcome.way for case in found.cases for outcome in case.outcomes):
        pairs = outcomes_of(found, way)
        scores = [o.scores[_EXTINCTION] for _, o in pairs if _EXTINCTION in o.scores]
        if not scores:
            continue
        yield Work(
            HOMOGENEOUS,
            f"median of {len(pairs)} paths",
            "extinction, RMSE over the Cramér-Rao bound",
            way,
            way not in others and way != HomogeneousMethod.TAIL_MEAN,
            _middle([score.rmse for score in scores]),
            _middle([score.coverage for score in scores]),
            float(np.median([outcome.nanoseconds for _, outcome in pairs])),
        )


def _middle(figures: Sequence[MonteCarloFigure]) -> MonteCarloFigure:
    ranked = sorted(figures, key=lambda figure: figure.value)
    return ranked[len(ranked) // 2]


def _of_elastic(found: Elastic) -> Iterator[Work]:
    times = {cost.step: cost.nanoseconds for cost in found.costs}
    for level in found.levels:
        if level.level not in _LEVELS:
            continue
        setting = f"background of {level.level:.0f} counts"
        for way, score in level.backgrounds.items():
            if way in times:
                yield Work(
                    ELASTIC,
                    setting,
                    "background, counts",
                    way,
                    way != elastic_cases.TAIL_MEAN,
                    score.rmse,
                    score.coverage[_INNER],
                    times[way],
                )
        inverted = level.inversions.get(_WHOLE)
        if inverted is not None and ALL_STEPS in times:
            yield Work(
                ELASTIC,
                setting,
                "backscatter 0.5 to 6 km, relative",
                ALL_STEPS,
                True,  # noqa: FBT003 - a row of a table
                inverted.rmse,
                inverted.coverage[_INNER],
                times[ALL_STEPS],
            )


def _of_scans(found: MultiAngle) -> Iterator[Work]:
    for scene in found.scenes:
        for score in scene.scores:
            yield Work(
                SCANS,
                scene.label,
                "optical depth",
                score.way,
                score.way not in _SCAN_PEERS,
                score.rmse,
                None if score.coverage is None else score.coverage[_INNER],
                score.nanoseconds,
            )


def _of_networks(found: MultiPosition) -> Iterator[Work]:
    for case in found.cases:
        for way, score in case.scores.items():
            if score.rmse is not None:
                yield Work(
                    NETWORKS,
                    f"{case.place}, {case.air}, noise {percent(case.noise)}",
                    "extinction, relative",
                    way,
                    way not in _PLAIN_WAYS,
                    score.rmse,
                    None if score.within is None else score.within[_INNER],
                    1e3 * score.microseconds,
                )


def overview(found: Sequence[Work], baselines: Sequence[Baseline]) -> Part:
    """Return the chapter that sets all retrievals side by side."""
    retrievals = list(dict.fromkeys(work.retrieval for work in found))
    floors = Table(
        title="Floors, measured in the same run",
        columns=("what", "CPU time"),
        rows=tuple((floor.what, spelled_time(floor.nanoseconds)) for floor in baselines),
    )
    return Part(
        title="Error against run time, all retrievals",
        text="Every method of every retrieval, with the baselines of the field and iterative "
        "peers, on simulated profiles whose truth is known. Root mean square error over the "
        "profiles that a method does not reject, CPU time of a profile on one core. The chapters "
        "below tell what was simulated, and give bias, coverage and flags.",
        charts=tuple(_chart(found, retrieval) for retrieval in retrievals),
        tables=(short(found), floors),
        details=tuple(_table(found, retrieval) for retrieval in retrievals),
    )


def short(found: Sequence[Work]) -> Table:
    """Return for each retrieval and quantity the best of ours and of the peers.

    Of ways whose errors differ by less than 2 Monte Carlo errors, the best is the fastest.
    """
    rows = []
    for retrieval, quantity in dict.fromkeys((work.retrieval, work.quantity) for work in found):
        group = [
            work
            for work in found
            if (work.retrieval, work.quantity) == (retrieval, quantity) and work.way not in _HELPED
        ]
        setting = _SHOWN.get(retrieval, group[0].setting)
        for whose in (True, False):
            chosen = [work for work in group if work.ours is whose and work.setting == setting]
            if chosen:
                rows.append((f"{retrieval}, {setting}: {quantity}", *_cells(_best(chosen))))
    return Table(
        title="The most accurate of ours and of the peers",
        columns=("error of", "way", "RMSE", "95 %", "a profile"),
        rows=tuple(rows),
        note="Of ways whose errors differ by less than 2 Monte Carlo errors, the fastest. One "
        "setting of each retrieval; all are in the tables of this page. 95 %: share of truths "
        "in the stated interval. In brackets the Monte Carlo standard error.",
    )


def _best(found: Sequence[Work]) -> Work:
    least = min((work.error for work in found), key=lambda error: error.value)
    as_good = [
        work
        for work in found
        if work.error.value - least.value <= 2.0 * math.hypot(work.error.error, least.error)
    ]
    return min(as_good, key=lambda work: work.nanoseconds)


def _cells(work: Work) -> tuple[str, ...]:
    return (
        work.way if work.ours else f"peer: {work.way}",
        f"{work.error.value:.3g} ({work.error.error:.1g})",
        _NONE if work.coverage is None else percent(work.coverage.value),
        spelled_time(work.nanoseconds),
    )


def spelled_time(nanoseconds: float) -> str:
    """Return a time with a unit that fits it."""
    for unit, size in (("s", 1e9), ("ms", 1e6), ("µs", 1e3)):
        if nanoseconds >= size:
            return f"{nanoseconds / size:.3g} {unit}"
    return f"{nanoseconds:.3g} ns"


def _table(found: Sequence[Work], retrieval: str) -> Table:
    rows = [(w.setting, w.quantity, *_cells(w)) for w in found if w.retrieval == retrieval]
    return Table(
        title=f"{retrieval.capitalize()}: every way",
        columns=("setting", "error of", "way", "RMSE", "95 %", "a profile"),
        rows=tuple(rows),
    )


def _chart(found: Sequence[Work], retrieval: str) -> Chart:
    of = [work for work in found if work.retrieval == retrieval]
    quantity = of[0].quantity
    shown = [work for work in of if work.quantity == quantity]
    settings = list(dict.fromkeys(work.setting for work in shown))
    chosen = dict.fromkeys((settings[0], _SHOWN.get(retrieval, settings[-1])))
    ways = list(dict.fromkeys(work.way for work in shown))
    return Chart(
        name="all-" + retrieval.replace(" ", "-"),
        title=f"{retrieval.capitalize()}: error against CPU time",
        caption=f"RMSE of {quantity}, with bars of 2 Monte Carlo standard errors. Hollow: peers, "
        "and methods that are told more than the profile. The steps join the ways that no other "
        "beats in both.",
        panels=tuple(
            _panel([work for work in shown if work.setting == setting], setting, ways)
            for setting in chosen
        ),
    )


def _panel(found: Sequence[Work], setting: str, ways: Sequence[str]) -> Panel:
    by_way = {work.way: work for work in found}
    return Panel(
        title=setting,
        x_label="CPU time per profile (µs)",
        y_label="RMSE",
        # A way without value keeps its place, so that a mark means the same in all panels.
        series=tuple(_point(by_way[way]) if way in by_way else Series(way, (), ()) for way in ways),
        front=pareto(
            [(_micro(work), work.error.value) for work in found if work.way not in _HELPED]
        ),
    )


def _point(work: Work) -> Series:
    error = work.error
    return Series(
        work.way,
        (_micro(work),),
        (error.value,),
        (max(error.value - 2 * error.error, 0.5 * error.value),),
        (error.value + 2 * error.error,),
        hollow=not work.ours or work.way in _HELPED,
    )


def _micro(work: Work) -> float:
    return work.nanoseconds / 1e3
