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
from lidarops.bench.stability.random_scenes import FalseValueRate, Judged, collect
from lidarops.bench.stability.stability_report import PartCost, Stability
from lidarops.bench.stability.stiff_cases import CaseOutcome, Retrieval, StiffCase, evaluate


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
    Draws(Retrieval.HOMOGENEOUS, random_homogeneous.judge_homogeneous, 1000, 400, 15, 1e-3),
    Draws(Retrieval.SIGNAL, random_signals.judge_signals, 50, 1500, 60, 0.05),
    Draws(Retrieval.ELASTIC, random_elastic.judge_elastic, 20, 1500, 40, 0.05),
    Draws(Retrieval.MULTIANGLE, random_scans.judge_scans, 8, 2000, 60, 0.13),
    Draws(Retrieval.MULTIPOSITION, random_networks.judge_networks, 50, 800, 30, 0.05),
)
"""Chosen to take some 20 minutes on one core, and less than 2 where little is to be spent."""


def all_cases() -> tuple[StiffCase, ...]:
    """Return all stiff and extreme cases."""
    return (
        *stiff_homogeneous.stiff_homogeneous_cases(),
        *stiff_signals.stiff_signal_cases(),
        *stiff_elastic.stiff_elastic_cases(),
        *stiff_scans.stiff_scan_cases(),
        *stiff_networks.stiff_network_cases(),
        *stiff_forward.stiff_forward_cases(),
        *stiff_layouts.memory_layout_cases(),
    )


def measure_stability(effort: Effort, draws: tuple[Draws, ...] = DRAWS) -> Stability:
    """Evaluate all cases and count the false values of random scenes.

    Parameters
    ----------
    effort : Effort
    draws : tuple of Draws
    """
    begin = time.process_time()
    outcomes = tuple(_evaluated(effort.progress))
    spent = [PartCost("cases", time.process_time() - begin)]
    rates: list[FalseValueRate] = []
    for one in draws:
        begin = time.process_time()
        clusters = one.quick if effort.quick else one.clusters
        tally = collect(partial(_cluster, one), clusters, effort.progress)
        rates += tally.rates(one.retrieval.value, one.needless)
        spent.append(PartCost(one.retrieval.value, time.process_time() - begin))
    return Stability(effort.date, machine(), outcomes, tuple(rates), tuple(spent))


def run_stability(effort: Effort) -> Finding:
    """Run the benchmark.

    Parameters
    ----------
    effort : Effort

    Returns
    -------
    Finding
        A `Stability` and its page.
    """
    found = measure_stability(effort)
    return Finding(found, stability_report.stability_report(found, RESULT))


def _evaluated(progress: Callable[[int], object]) -> Iterator[CaseOutcome]:
    for case in all_cases():
        yield evaluate(case)
        progress(1)


def _cluster(draws: Draws, cluster: int) -> Iterator[tuple[Judged, int]]:
    return draws.judged(cluster, draws.profiles)
