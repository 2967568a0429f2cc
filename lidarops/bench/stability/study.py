"""The stability benchmark: rates of false values without a flag."""

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
)
from lidarops.bench.stability.random_scenes import FalseValueRate, ScoredValues, collect
from lidarops.bench.stability.stability_report import PartCost, Stability


@dataclass(frozen=True, slots=True)
class Draws:
    """Random scenes of one retrieval."""

    retrieval: str
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
    Draws("homogeneous", random_homogeneous.score_homogeneous, 1000, 400, 15, 1e-3),
    Draws("signal chain", random_signals.score_signals, 50, 1500, 60, 0.05),
    Draws("elastic", random_elastic.score_elastic, 20, 1500, 40, 0.05),
    Draws("multi-angle", random_scans.score_scans, 8, 2000, 60, 0.13),
    Draws("network", random_networks.score_networks, 50, 800, 30, 0.05),
)
"""Sizes for about 20 minutes on one core, and less than 2 for a quick run."""


def measure_stability(effort: Effort, draws: tuple[Draws, ...] = DRAWS) -> Stability:
    """Return the rates of false values in random scenes.

    Parameters
    ----------
    effort : Effort
    draws : tuple of Draws
    """
    spent: list[PartCost] = []
    rates: list[FalseValueRate] = []
    for draw in draws:
        begin = time.process_time()
        clusters = draw.quick if effort.quick else draw.clusters
        tally = collect(partial(_score_cluster, draw), clusters, effort.progress)
        rates += tally.rates(draw.retrieval, draw.needless)
        spent.append(PartCost(draw.retrieval, time.process_time() - begin))
    return Stability(effort.date, machine(), tuple(rates), tuple(spent))


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


def _score_cluster(draws: Draws, cluster: int) -> Iterator[tuple[ScoredValues, int]]:
    return draws.score(cluster, draws.profiles)
