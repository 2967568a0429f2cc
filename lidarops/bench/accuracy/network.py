"""How right and how fast extinction is found where the beams of several lidars meet."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt

from lidarops.bench.accuracy import network_cases as known
from lidarops.bench.accuracy.network_cases import Air, Array, FigurePoint, Place, Signals
from lidarops.bench.accuracy.network_report import (
    network_accuracy_report,
    network_throughput_report,
)
from lidarops.bench.accuracy.network_scores import (
    CLIPPED,
    READ,
    Comparison,
    Errors,
    MultiPosition,
    MultiPositionThroughput,
    NetworkScenario,
    Sight,
    SolverRate,
    errors_of,
    joined,
    mean_by_block,
    root_by_block,
    score,
    share_by_block,
)
from lidarops.bench.harness.terms import RESULT, Effort, Finding, Kind
from lidarops.bench.harness.timing import in_threads, least_times, machine
from lidarops.retrieve.air import visibility as sight
from lidarops.retrieve.network.cycles import solve_cycle, values_and_variances
from lidarops.retrieve.network.extinction_field import MultiPositionResult

Booleans = npt.NDArray[np.bool_]

PROFILES: Final = 3000
QUICK_PROFILES: Final = 500
CONTRASTS: Final = (sight.MOR_CONTRAST, sight.KOSCHMIEDER_CONTRAST, sight.PAPER_CONTRAST)

_PEER_PROFILES: Final = 150
_QUICK_PEER_PROFILES: Final = 30
_CHUNK_BLOCKS: Final = 5
_TIMED_PROFILES: Final = 250
_CYCLES: Final = {3: 500_000, 12: 100_000}
_QUICK_CYCLES: Final = {3: 100_000, 12: 20_000}
"""Cycles of a call by the beams of each."""
_REPEATS: Final = 7
_QUICK_REPEATS: Final = 3
_SHORTEST: Final = 1e-9
"""The clock of a fast machine with little work may not have moved."""

_Found = TypeVar("_Found")


# Accuracy -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Chunks:
    """Profiles are drawn and solved chunk by chunk, whole blocks each."""

    number: int
    size: int


def measure_network(
    *,
    quick: bool = False,
    date: str = "",
    profiles: int | None = None,
    repeats: int | None = None,
    peer_profiles: int | None = None,
    progress: Callable[[int], object] = lambda _: None,
) -> MultiPosition:
    """Find extinction in every network, air and noise, in every way.

    Parameters
    ----------
    quick : bool
        Fewer profiles.
    date : str
        When it is run, as it is to be stated.
    profiles : int, optional
        Of each case; whole blocks are drawn.
    repeats : int, optional
        Counted rounds of the timing of cycles.
    peer_profiles : int, optional
        Of each comparison with a plain fit.
    progress : callable
        Is given 1 after each case.
    """
    count = profiles or (QUICK_PROFILES if quick else PROFILES)
    blocks = -(-count // known.BLOCK)
    chunks = Chunks(-(-blocks // _CHUNK_BLOCKS), min(blocks, _CHUNK_BLOCKS) * known.BLOCK)
    peer_profiles = peer_profiles or (_QUICK_PEER_PROFILES if quick else _PEER_PROFILES)
    cases, sights = [], []
    for place in known.PLACES:
        net = place.network()
        seen = {air.name: known.signals(net, air) for air in known.AIRS}
        for number, (air, noise) in enumerate(product(known.AIRS, known.NOISES)):
            case, network = _case(place, air, noise, seen[air.name], chunks, number)
            cases.append(case)
            if place is known.THREE_BY_TWO and air is known.SIGHTS_AIR:
                sights += _sights(network, seen[air.name], noise)
            progress(1)
    return MultiPosition(
        date=date,
        machine=machine(),
        cases=tuple(cases),
        figure=figure(),
        sights=tuple(sights),
        comparisons=tuple(_comparisons(peer_profiles)),
        cycles=tuple(cycle_rates(quick=True, repeats=repeats or _QUICK_REPEATS)),
    )


def figure() -> tuple[FigurePoint, ...]:
    """Return the points of figure 2 of drabenko2021."""
    return tuple(
        known.figure_point(first, elevation)
        for first, elevation in product(known.FIGURE_FIRST_LIDARS, known.FIGURE_ELEVATIONS)
    )


def _case(
    place: Place, air: Air, noise: float, seen: Signals, chunks: Chunks, seed: int
) -> tuple[NetworkScenario, list[MultiPositionResult]]:
    """Return the scores of every way, and what the network found."""
    truth, near = seen.truth(chunks.size), seen.network.near_crossing
    errors: dict[str, list[Errors]] = {way.name: [] for way in known.network_solvers(place)}
    least = dict.fromkeys((READ, *errors), math.inf)
    network = []
    for chunk in range(chunks.number):
        power, variance = seen.draw(noise, chunks.size, len(seen.network.origin), seed, chunk)
        least[READ] = min(least[READ], _timed(partial(np.max, power))[0])
        for way in known.network_solvers(place):
            solve = partial(way, power, variance, seen)
            if chunk == 0:
                # The first call compiles and fills caches.
                way(power[: known.BLOCK], variance[: known.BLOCK], seen)
            seconds, found = _timed(solve)
            least[way.name] = min(least[way.name], seconds)
            errors[way.name].append(errors_of(found, truth, near))
            network += [found] * (way is known.NETWORK)
    scores = {
        name: score(joined(parts), 1e6 * least[name] / chunks.size, least[name] / least[READ])
        for name, parts in errors.items()
    }
    return NetworkScenario(
        place.name, air.name, noise, chunks.number * chunks.size, scores
    ), network


def _timed(call: Callable[[], _Found]) -> tuple[float, _Found]:
    """Return the CPU time of a call in seconds, and what it returns."""
    begin = time.process_time()
    found = call()
    return max(time.process_time() - begin, _SHORTEST), found


def _sights(found: Sequence[MultiPositionResult], seen: Signals, noise: float) -> list[Sight]:
    near = seen.network.near_crossing
    truth = np.concatenate([seen.truth(len(one.extinction))[:, near] for one in found])
    extinction = np.concatenate([one.extinction[:, near] for one in found])
    stated = np.concatenate([one.extinction_standard_error[:, near] for one in found])
    flagged = np.concatenate([one.flags.flagged[:, near] for one in found])
    kept = ~flagged & np.isfinite(extinction) & np.isfinite(stated)
    rows = [_sight(extinction, stated, truth, kept, c, noise) for c in CONTRASTS]
    return [row for row in rows if row is not None]


def _sight(
    extinction: Array, stated: Array, truth: Array, kept: Booleans, contrast: float, noise: float
) -> Sight | None:
    constant = sight.koschmieder_constant(contrast)
    found = sight.visibility_from_extinction(extinction, stated, contrast=contrast)
    true = constant / truth
    error = found.visibility - true
    bias, rmse = mean_by_block(error, kept), root_by_block(error, kept)
    linear = share_by_block(np.abs(error) <= found.visibility_standard_error, kept)
    between = (found.visibility_lower <= true) & (true <= found.visibility_upper)
    interval = share_by_block(between, kept)
    if bias is None or rmse is None or linear is None or interval is None:
        return None
    return Sight(
        noise=noise,
        contrast=contrast,
        constant=constant,
        visibility=float(true[kept].mean()),
        bias=bias,
        rmse=rmse,
        within_error=linear,
        within_interval=interval,
    )


def _comparisons(profiles: int) -> Iterator[Comparison]:
    """Compare with a plain fit of each profile."""
    airs = [air for air in known.AIRS if air.name != known.THIN]
    for number, (place, air) in enumerate(product(known.PLACES, airs)):
        seen = known.signals(place.network(), air)
        power, variance = seen.draw(known.PEER_NOISE, profiles, 99, number)
        truth, near = (
            seen.truth(profiles)[:, seen.network.near_crossing],
            seen.network.near_crossing,
        )
        ours_seconds, ours = _timed(partial(known.FREE, power, variance, seen))
        seconds, fitted = _timed(partial(known.network_by_scipy, power, variance, seen))
        found, stated = ours.extinction[:, near], ours.extinction_standard_error[:, near]
        solved = np.isfinite(found) & np.isfinite(stated)
        yield Comparison(
            place=place.name,
            air=air.name,
            profiles=profiles,
            ours=_clipped_rms(found / truth - 1.0, solved),
            peer=_clipped_rms(fitted[:, near] / truth - 1.0, solved),
            apart=float(np.sqrt(np.mean((((fitted[:, near] - found) / stated)[solved]) ** 2))),
            ours_microseconds=1e6 * ours_seconds / profiles,
            peer_microseconds=1e6 * seconds / profiles,
        )


def _clipped_rms(errors: Array, kept: Booleans) -> float:
    return float(np.sqrt(np.mean(np.clip(errors[kept], -CLIPPED, CLIPPED) ** 2)))


# Throughput -----------------------------------------------------------------------------------


def measure_network_throughput(
    *,
    quick: bool = False,
    date: str = "",
    repeats: int | None = None,
    progress: Callable[[int], object] = lambda _: None,
) -> MultiPositionThroughput:
    """Time cycles, whole profiles of networks, and plain peers.

    Parameters
    ----------
    quick : bool
        Fewer cycles and repeats.
    date : str
        When it is run, as it is to be stated.
    repeats : int, optional
        Counted rounds, of which the least time counts.
    progress : callable
        Is given 1 after cycles, and after each network.
    """
    rounds = repeats or (_QUICK_REPEATS if quick else _REPEATS)
    cycles = cycle_rates(quick=quick, repeats=rounds)
    progress(1)
    profiles: list[SolverRate] = []
    for place in known.PLACES:
        profiles += _profile_rates(place, rounds)
        progress(1)
    return MultiPositionThroughput(
        date, machine(), tuple(cycles), tuple(profiles), _gain(quick=quick, repeats=rounds)
    )


def cycle_rates(*, quick: bool, repeats: int) -> list[SolverRate]:
    """Return the CPU time of cycles of 3 and of 12 beams in every way, the read first."""
    rates = []
    for beams, cycles in (_QUICK_CYCLES if quick else _CYCLES).items():
        rows = known.random_rows(cycles, beams)
        sizes = {name: min(cycles, most) for name, (_, most) in _CYCLE_WAYS.items()}
        calls = {
            name: partial(way, rows.first(sizes[name])) for name, (way, _) in _CYCLE_WAYS.items()
        }
        times = least_times(calls, repeats)
        each = {name: 1e9 * seconds / sizes[name] for name, seconds in times.items()}
        rates += [
            SolverRate(name, beams, sizes[name], each[name], each[name] / each[READ], name in OURS)
            for name in calls
        ]
    return rates


def _read(rows: known.Rows) -> object:
    return [np.max(array) for array in rows.arrays]


def _with_variance(rows: known.Rows) -> object:
    return values_and_variances(*rows.arrays)


def _with_one_variance(rows: known.Rows) -> object:
    return values_and_variances(rows.start, rows.end, rows.integral, rows.variance[0])


def _with_flags(rows: known.Rows) -> object:
    return solve_cycle(rows.start, rows.end, rows.integral, relative_variance=rows.variance)


VALUES: Final = "closed form with variance"
SHARED: Final = "closed form, one variance for all"
FLAGS: Final = "closed form with sensitivities and flags"
LU: Final = "numpy.linalg.solve at once"
ONE_BY_ONE: Final = "numpy.linalg.solve, one by one"
OURS: Final = frozenset({VALUES, SHARED, FLAGS})

_ALL: Final = 10**9
_CYCLE_WAYS: Final[Mapping[str, tuple[Callable[[known.Rows], object], int]]] = {
    READ: (_read, _ALL),
    VALUES: (_with_variance, _ALL),
    SHARED: (_with_one_variance, _ALL),
    FLAGS: (_with_flags, 100_000),
    LU: (known.solve_by_lu, 50_000),
    ONE_BY_ONE: (known.solve_by_lu_one_by_one, 5_000),
}
"""Each way with the most cycles that it gets."""


def _profile_rates(place: Place, repeats: int) -> list[SolverRate]:
    """Return the CPU time of profiles of a network in every way, the read first."""
    net, size = place.network(), _TIMED_PROFILES
    seen = known.signals(net, known.AIRS[0])
    power, variance = seen.draw(known.PEER_NOISE, size, 7)
    calls: dict[str, Callable[[], object]] = {READ: partial(np.max, power)}
    for way in known.network_solvers(place):
        calls[way.name] = partial(way, power, variance, seen)
    times = least_times(calls, repeats)
    return [
        SolverRate(name, net.beams, size, 1e9 * s / size, s / times[READ], name != READ)
        for name, s in times.items()
    ]


def _gain(*, quick: bool, repeats: int) -> float:
    cycles = (_QUICK_CYCLES if quick else _CYCLES)[3]
    rows = known.random_rows(cycles, 3)
    halves = rows.first(cycles // 2), rows.last(cycles // 2)
    times = least_times(
        {
            "one": lambda: _with_variance(rows),
            "two": lambda: in_threads(lambda part: _with_variance(halves[part]), 2),
        },
        repeats,
        clock="perf_counter",
    )
    return times["one"] / times["two"]


# The command ----------------------------------------------------------------------------------


def run_network(kind: Kind, *, effort: Effort) -> Finding:
    """Run a benchmark of networks of lidars.

    Parameters
    ----------
    kind : Kind
    effort : Effort
    """
    if kind is Kind.ACCURACY:
        found = measure_network(
            quick=effort.quick, date=effort.date, repeats=effort.repeats, progress=effort.progress
        )
        return Finding(found, network_accuracy_report(found, RESULT))
    timed = measure_network_throughput(
        quick=effort.quick, date=effort.date, repeats=effort.repeats, progress=effort.progress
    )
    return Finding(timed, network_throughput_report(timed, RESULT))
