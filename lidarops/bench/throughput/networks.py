"""Time the retrieval of extinction where the beams of several lidars cross; its report page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from lidarops.bench.accuracy import network_cases
from lidarops.bench.accuracy.network_cases import LidarLine
from lidarops.bench.accuracy.network_cycles import cycle_rates, thread_gain
from lidarops.bench.accuracy.network_report import cycles_part
from lidarops.bench.accuracy.network_scores import SolverRate
from lidarops.bench.harness.benchmark import facts
from lidarops.bench.harness.timing import READ, Machine, least_times, machine
from lidarops.reports.benchmark_page import BenchmarkReport, Part, Table

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


def measure_network_throughput(
    *,
    quick: bool = False,
    date: str = "",
    repeats: int | None = None,
    progress: Callable[[int], object] = lambda _: None,
) -> NetworkThroughput:
    """Time cycles, whole profiles of networks, and plain peers.

    Parameters
    ----------
    quick : bool
        Use fewer cycles and repeats.
    date : str
        Date of the run, for the report.
    repeats : int, optional
        Number of repeats; the shortest time counts.
    progress : callable
        Called with 1 after the cycles, and after each network.
    """
    repeat_count = repeats or (_QUICK_REPEATS if quick else _REPEATS)
    cycles = cycle_rates(quick=quick, repeats=repeat_count)
    progress(1)
    profiles: list[SolverRate] = []
    for lidars in network_cases.LIDAR_LINES:
        profiles += _profile_rates(lidars, repeat_count)
        progress(1)
    return NetworkThroughput(
        date,
        machine(),
        tuple(cycles),
        tuple(profiles),
        thread_gain(quick=quick, repeats=repeat_count),
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


def network_throughput_report(result: NetworkThroughput, data: str = "") -> BenchmarkReport:
    """Return the page of the throughput benchmark."""
    return BenchmarkReport(
        title="Networks of lidars: time per cycle and per profile",
        facts=facts(result.date, result.machine),
        parts=(cycles_part(result.cycles), _profiles(result)),
        data=data,
    )


def _profiles(result: NetworkThroughput) -> Part:
    return Part(
        title="Whole profiles",
        text="From signals to extinction with errors, visibility and flags: point values, "
        "integrals and their covariances, and the solution. One thread. Two threads with half of "
        f"the cycles of 3 beams each are {result.gain:.2f} times as fast in wall time, which is "
        "meaningful only on a machine with two idle cores.",
        tables=tuple(
            Table(
                title=f"Profiles of {beams} beams",
                columns=("method", "profiles", "µs each", "reads"),
                rows=tuple(
                    (
                        rate.method,
                        f"{rate.size:,}",
                        f"{rate.nanoseconds / 1e3:,.3g}",
                        f"{rate.reads:,.1f}",
                    )
                    for rate in result.profiles
                    if rate.beams == beams
                ),
                note=f"Reads: multiples of {READ} of the power.",
            )
            for beams in sorted({rate.beams for rate in result.profiles})
        ),
    )
