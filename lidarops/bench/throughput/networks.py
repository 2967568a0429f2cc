"""Time the retrieval of extinction where the beams of several lidars cross."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from lidarops.bench.accuracy import network_cases
from lidarops.bench.accuracy.network_cases import LidarLine
from lidarops.bench.accuracy.network_cycles import cycle_rates, thread_gain
from lidarops.bench.accuracy.network_scores import SolverRate
from lidarops.bench.harness.benchmark import Effort
from lidarops.bench.harness.timing import READ, Machine, least_times, machine

_TIMED_PROFILES: Final = 250
_REPEATS: Final = 7
_QUICK_REPEATS: Final = 3


@dataclass(frozen=True, slots=True)
class NetworkThroughput:
    """Result of the throughput benchmark of networks of lidars."""

    date: str
    machine: Machine
    cycles: tuple[SolverRate, ...]
    profiles: tuple[SolverRate, ...]
    gain: float
    """Wall time of one thread over that of two threads with half of the cycles each."""


def measure_network_throughput(effort: Effort) -> NetworkThroughput:
    """Time cycles, whole profiles of networks, and plain peers.

    Parameters
    ----------
    effort : Effort
    """
    repeat_count = effort.repeats or (_QUICK_REPEATS if effort.quick else _REPEATS)
    cycles = cycle_rates(quick=effort.quick, repeats=repeat_count)
    effort.progress(1)
    profiles: list[SolverRate] = []
    for lidars in network_cases.LIDAR_LINES:
        profiles += _profile_rates(lidars, repeat_count)
        effort.progress(1)
    return NetworkThroughput(
        effort.date,
        machine(),
        tuple(cycles),
        tuple(profiles),
        thread_gain(quick=effort.quick, repeats=repeat_count),
    )


def _profile_rates(lidars: LidarLine, repeats: int) -> list[SolverRate]:
    """Return CPU times of profiles of a network with every solver, the read first."""
    network, size = lidars.network(), _TIMED_PROFILES
    signals = network_cases.signals(network, network_cases.AIRS[0])
    power, variance = signals.draw(network_cases.PEER_NOISE, size, 7)
    calls: dict[str, Callable[[], object]] = {READ: partial(np.max, power)}
    for solver in network_cases.network_solvers(lidars):
        calls[solver.name] = partial(solver, power, variance, signals)
    times = least_times(calls, repeats)
    return [
        SolverRate(
            name, network.beams, size, 1e9 * seconds / size, seconds / times[READ], name != READ
        )
        for name, seconds in times.items()
    ]
