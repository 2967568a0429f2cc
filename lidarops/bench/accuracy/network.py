"""Measure the accuracy of the retrieval of extinction where the beams of several lidars cross."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt

from lidarops.bench.accuracy import network_cases
from lidarops.bench.accuracy.network_cases import (
    Air,
    Array,
    FigurePoint,
    LidarLine,
    Signals,
)
from lidarops.bench.accuracy.network_cycles import cycle_rates
from lidarops.bench.accuracy.network_scores import (
    CLIPPED,
    Comparison,
    CrossingErrors,
    NetworkAccuracy,
    NetworkScenario,
    VisibilityScore,
    crossing_errors,
    join_errors,
    mean_by_block,
    root_by_block,
    score,
    share_by_block,
)
from lidarops.bench.harness.benchmark import Effort
from lidarops.bench.harness.timing import READ, machine
from lidarops.retrieve.air import visibility as sight
from lidarops.retrieve.network.extinction_field import NetworkResult

Booleans = npt.NDArray[np.bool_]

PROFILES: Final = 3000
QUICK_PROFILES: Final = 500
"""Profiles of each case, and of a quick run."""
CONTRASTS: Final = (sight.MOR_CONTRAST, sight.KOSCHMIEDER_CONTRAST, sight.PAPER_CONTRAST)

_PEER_PROFILES: Final = 150
_QUICK_PEER_PROFILES: Final = 30
_CHUNK_BLOCKS: Final = 5
_QUICK_REPEATS: Final = 3
_SHORTEST: Final = 1e-9
"""s. A short call may take less than one tick of the clock."""

_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True)
class _Chunks:
    """Number and size of the chunks of profiles that are solved together: whole blocks."""

    number: int
    size: int


def measure_network(
    effort: Effort, *, profiles: int | None = None, peer_profiles: int | None = None
) -> NetworkAccuracy:
    """Retrieve extinction in every network, air and noise, with every solver.

    Parameters
    ----------
    effort : Effort
    profiles : int, optional
        Number of profiles of each case, rounded up to whole blocks.
    peer_profiles : int, optional
        Number of profiles of each comparison with a plain fit.
    """
    profile_count = profiles or (QUICK_PROFILES if effort.quick else PROFILES)
    blocks = -(-profile_count // network_cases.BLOCK)
    chunks = _Chunks(-(-blocks // _CHUNK_BLOCKS), min(blocks, _CHUNK_BLOCKS) * network_cases.BLOCK)
    peer_profiles = peer_profiles or (_QUICK_PEER_PROFILES if effort.quick else _PEER_PROFILES)
    cases, visibility_scores = [], []
    for lidars in network_cases.LIDAR_LINES:
        net = lidars.network()
        signals = {air.name: network_cases.signals(net, air) for air in network_cases.AIRS}
        for index, (air, noise) in enumerate(product(network_cases.AIRS, network_cases.NOISES)):
            scenario, results = _measure_case(lidars, air, noise, signals[air.name], chunks, index)
            cases.append(scenario)
            if lidars is network_cases.THREE_BY_TWO and air is network_cases.VISIBILITY_AIR:
                visibility_scores += _visibility_scores(results, signals[air.name], noise)
            effort.progress(1)
    return NetworkAccuracy(
        date=effort.date,
        machine=machine(),
        cases=tuple(cases),
        figure=figure_points(),
        sights=tuple(visibility_scores),
        comparisons=tuple(_comparisons(peer_profiles)),
        cycles=tuple(cycle_rates(quick=True, repeats=effort.repeats or _QUICK_REPEATS)),
    )


def figure_points() -> tuple[FigurePoint, ...]:
    """Return the points of figure 2 of drabenko2021."""
    return tuple(
        network_cases.figure_point(first_lidar, elevation)
        for first_lidar, elevation in product(
            network_cases.FIGURE_FIRST_LIDARS, network_cases.FIGURE_ELEVATIONS
        )
    )


def _measure_case(
    lidars: LidarLine, air: Air, noise: float, signals: Signals, chunks: _Chunks, seed: int
) -> tuple[NetworkScenario, list[NetworkResult]]:
    """Return the scores of every solver, and the results of the network method."""
    truth, near = signals.truth(chunks.size), signals.network.near_crossing
    errors: dict[str, list[CrossingErrors]] = {
        solver.name: [] for solver in network_cases.network_solvers(lidars)
    }
    least_seconds = dict.fromkeys((READ, *errors), math.inf)
    network_results = []
    for chunk in range(chunks.number):
        power, variance = signals.draw(noise, chunks.size, len(signals.network.origin), seed, chunk)
        least_seconds[READ] = min(least_seconds[READ], _timed(partial(np.max, power))[0])
        for solver in network_cases.network_solvers(lidars):
            call_solver = partial(solver, power, variance, signals)
            if chunk == 0:
                # The first call compiles and fills caches.
                solver(power[: network_cases.BLOCK], variance[: network_cases.BLOCK], signals)
            seconds, result = _timed(call_solver)
            least_seconds[solver.name] = min(least_seconds[solver.name], seconds)
            errors[solver.name].append(crossing_errors(result, truth, near))
            network_results += [result] * (solver is network_cases.NETWORK)
    scores = {
        name: score(
            join_errors(chunk_errors),
            1e6 * least_seconds[name] / chunks.size,
            least_seconds[name] / least_seconds[READ],
        )
        for name, chunk_errors in errors.items()
    }
    return NetworkScenario(
        lidars.name, air.name, noise, chunks.number * chunks.size, scores
    ), network_results


def _timed(call: Callable[[], _Result]) -> tuple[float, _Result]:
    """Return the CPU time of a call in seconds, and its result."""
    start = time.process_time()
    result = call()
    return max(time.process_time() - start, _SHORTEST), result


def _visibility_scores(
    results: Sequence[NetworkResult], signals: Signals, noise: float
) -> list[VisibilityScore]:
    near = signals.network.near_crossing
    truth = np.concatenate([signals.truth(len(result.extinction))[:, near] for result in results])
    extinction = np.concatenate([result.extinction[:, near] for result in results])
    stated = np.concatenate([result.extinction_standard_error[:, near] for result in results])
    flagged = np.concatenate([result.flags.flagged[:, near] for result in results])
    kept = ~flagged & np.isfinite(extinction) & np.isfinite(stated)
    rows = [
        _visibility_score(extinction, stated, truth, kept, contrast, noise)
        for contrast in CONTRASTS
    ]
    return [row for row in rows if row is not None]


def _visibility_score(
    extinction: Array, stated: Array, truth: Array, kept: Booleans, contrast: float, noise: float
) -> VisibilityScore | None:
    constant = sight.koschmieder_constant(contrast)
    visibility = sight.visibility_from_extinction(extinction, stated, contrast=contrast)
    true = constant / truth
    error = visibility.visibility - true
    bias, rmse = mean_by_block(error, kept), root_by_block(error, kept)
    within_error = share_by_block(np.abs(error) <= visibility.visibility_standard_error, kept)
    inside = (visibility.visibility_lower <= true) & (true <= visibility.visibility_upper)
    within_interval = share_by_block(inside, kept)
    if bias is None or rmse is None or within_error is None or within_interval is None:
        return None
    return VisibilityScore(
        noise=noise,
        contrast=contrast,
        constant=constant,
        visibility=float(true[kept].mean()),
        bias=bias,
        rmse=rmse,
        within_error=within_error,
        within_interval=within_interval,
    )


def _comparisons(profiles: int) -> Iterator[Comparison]:
    """Yield comparisons with a plain fit of each profile."""
    airs = [air for air in network_cases.AIRS if air.name != network_cases.THIN]
    for seed, (lidars, air) in enumerate(product(network_cases.LIDAR_LINES, airs)):
        signals = network_cases.signals(lidars.network(), air)
        power, variance = signals.draw(network_cases.PEER_NOISE, profiles, 99, seed)
        truth, near = (
            signals.truth(profiles)[:, signals.network.near_crossing],
            signals.network.near_crossing,
        )
        ours_seconds, ours = _timed(
            partial(network_cases.NETWORK_WITHOUT_PRIOR, power, variance, signals)
        )
        seconds, fitted = _timed(partial(network_cases.network_by_scipy, power, variance, signals))
        extinction, stated = ours.extinction[:, near], ours.extinction_standard_error[:, near]
        solved = np.isfinite(extinction) & np.isfinite(stated)
        yield Comparison(
            place=lidars.name,
            air=air.name,
            profiles=profiles,
            ours=_clipped_rms(extinction / truth - 1.0, solved),
            peer=_clipped_rms(fitted[:, near] / truth - 1.0, solved),
            apart=float(np.sqrt(np.mean((((fitted[:, near] - extinction) / stated)[solved]) ** 2))),
            ours_microseconds=1e6 * ours_seconds / profiles,
            peer_microseconds=1e6 * seconds / profiles,
        )


def _clipped_rms(errors: Array, kept: Booleans) -> float:
    return float(np.sqrt(np.mean(np.clip(errors[kept], -CLIPPED, CLIPPED) ** 2)))
