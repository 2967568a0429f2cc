"""Stiff and extreme cases, and how often a wrong value comes without a flag."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final

from lidarops.bench.harness.terms import RESULT, Effort, Finding
from lidarops.bench.harness.timing import machine
from lidarops.bench.stability import (
    random_elastic,
    random_homogeneous,
    random_networks,
    random_scans,
    random_signals,
    stability_report,
    stiff_elastic,
    stiff_forward,
    stiff_homogeneous,
    stiff_layouts,
    stiff_networks,
    stiff_scans,
    stiff_signals,
)
from lidarops.bench.stability.random_scenes import Judged, Rate, collect
from lidarops.bench.stability.stability_report import Spent, Stability
from lidarops.bench.stability.stiff_cases import Case, Outcome, Retrieval, evaluate


@dataclass(frozen=True, slots=True)
class Draws:
    """Random scenes of one retrieval."""

    retrieval: Retrieval
    judged: Callable[[int, int], Iterator[tuple[Judged, int]]]
    profiles: int
    """Of a cluster and class, which share their geometry."""
    clusters: int
    quick: int
    """Clusters where little time is to be spent."""
    needless: float
    """Largest share of needless flags where the model holds."""


DRAWS: Final = (
    Draws(Retrieval.HOMOGENEOUS, random_homogeneous.judged, 1000, 400, 15, 1e-3),
    Draws(Retrieval.SIGNAL, random_signals.judged, 50, 1500, 60, 0.05),
    Draws(Retrieval.ELASTIC, random_elastic.judged, 20, 1500, 40, 0.05),
    Draws(Retrieval.MULTIANGLE, random_scans.judged, 8, 2000, 60, 0.13),
    Draws(Retrieval.MULTIPOSITION, random_networks.judged, 50, 800, 30, 0.05),
)
"""Chosen to take some 20 minutes on one core, and less than 2 where little is to be spent."""


def cases() -> tuple[Case, ...]:
    """Return all stiff and extreme cases."""
    return (
        *stiff_homogeneous.cases(),
        *stiff_signals.cases(),
        *stiff_elastic.cases(),
        *stiff_scans.cases(),
        *stiff_networks.cases(),
        *stiff_forward.cases(),
        *stiff_layouts.cases(),
    )


def measure(effort: Effort, draws: tuple[Draws, ...] = DRAWS) -> Stability:
    """Evaluate all cases and count the false values of random scenes.

    Parameters
    ----------
    effort : Effort
    draws : tuple of Draws
    """
    begin = time.process_time()
    outcomes = tuple(_evaluated(effort.progress))
    spent = [Spent("cases", time.process_time() - begin)]
    rates: list[Rate] = []
    for one in draws:
        begin = time.process_time()
        clusters = one.quick if effort.quick else one.clusters
        tally = collect(partial(_cluster, one), clusters, effort.progress)
        rates += tally.rates(one.retrieval.value, one.needless)
        spent.append(Spent(one.retrieval.value, time.process_time() - begin))
    return Stability(effort.date, machine(), outcomes, tuple(rates), tuple(spent))


def run(effort: Effort) -> Finding:
    """Run the benchmark.

    Parameters
    ----------
    effort : Effort

    Returns
    -------
    Finding
        A `Stability` and its page.
    """
    found = measure(effort)
    return Finding(found, stability_report.report(found, RESULT))


def _evaluated(progress: Callable[[int], object]) -> Iterator[Outcome]:
    for case in cases():
        yield evaluate(case)
        progress(1)


def _cluster(draws: Draws, cluster: int) -> Iterator[tuple[Judged, int]]:
    return draws.judged(cluster, draws.profiles)
