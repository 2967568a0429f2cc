"""The stability benchmark: stiff cases, and rates of false values without a flag."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final

from lidarops.bench.harness.benchmark import BenchmarkOutput, Effort
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
from lidarops.bench.stability.random_scenes import FalseValueRate, ScoredValues, collect
from lidarops.bench.stability.stability_report import PartCost, Stability
from lidarops.bench.stability.stiff_cases import CaseOutcome, Retrieval, StiffCase, evaluate


@dataclass(frozen=True, slots=True)
class Draws:
    """Random scenes of one retrieval."""

    retrieval: Retrieval
    score: Callable[[int, int], Iterator[tuple[ScoredValues, int]]]
    """Returns the values of a cluster, given its number and the number of profiles."""
    profiles: int
    """Number per cluster and class; they share their geometry."""
    clusters: int
    quick: int
    """Number of clusters of a quick run."""
    needless: float
    """Largest share of needless flags where the model holds."""


DRAWS: Final = (
    Draws(Retrieval.HOMOGENEOUS, random_homogeneous.score_homogeneous, 1000, 400, 15, 1e-3),
    Draws(Retrieval.SIGNAL, random_signals.score_signals, 50, 1500, 60, 0.05),
    Draws(Retrieval.ELASTIC, random_elastic.score_elastic, 20, 1500, 40, 0.05),
    Draws(Retrieval.MULTIANGLE, random_scans.score_scans, 8, 2000, 60, 0.13),
    Draws(Retrieval.NETWORK, random_networks.score_networks, 50, 800, 30, 0.05),
)
"""Sizes for about 20 minutes on one core, and less than 2 for a quick run."""


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
    """Return the outcomes of all cases and the rates of false values in random scenes.

    Parameters
    ----------
    effort : Effort
    draws : tuple of Draws
    """
    begin = time.process_time()
    outcomes = tuple(_outcomes(effort.progress))
    spent = [PartCost("cases", time.process_time() - begin)]
    rates: list[FalseValueRate] = []
    for draw in draws:
        begin = time.process_time()
        clusters = draw.quick if effort.quick else draw.clusters
        tally = collect(partial(_score_cluster, draw), clusters, effort.progress)
        rates += tally.rates(draw.retrieval.value, draw.needless)
        spent.append(PartCost(draw.retrieval.value, time.process_time() - begin))
    return Stability(effort.date, machine(), outcomes, tuple(rates), tuple(spent))


def run_stability(effort: Effort) -> BenchmarkOutput:
    """Run the stability benchmark.

    Parameters
    ----------
    effort : Effort

    Returns
    -------
    BenchmarkOutput
        A `Stability` and its page.
    """
    stability = measure_stability(effort)
    return BenchmarkOutput(stability, stability_report.stability_report(stability))


def _outcomes(progress: Callable[[int], object]) -> Iterator[CaseOutcome]:
    for case in all_cases():
        yield evaluate(case)
        progress(1)


def _score_cluster(draws: Draws, cluster: int) -> Iterator[tuple[ScoredValues, int]]:
    return draws.score(cluster, draws.profiles)
