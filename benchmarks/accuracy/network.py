"""Accuracy of the retrieval of extinction where the beams of several lidars cross."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np
from scipy.optimize import least_squares

from benchmarks.accuracy import comparison
from benchmarks.harness.figure import TWO_SIDED, Array, Figure, Work, root_by_block, share_by_block
from benchmarks.harness.results import Effort, Study
from benchmarks.scenes import lidar_networks as scenes
from benchmarks.scenes.lidar_networks import BLOCK, PEER_NOISE, Signals
from lidarops.retrieve.network.extinction_field import NetworkResult
from lidarops.retrieve.network.thresholds import THRESHOLDS

PROFILES: Final = 3000
QUICK_PROFILES: Final = 500
"""Profiles of each case, and of a quick run."""
CLIPPED: Final = 3.0
"""Limit of relative errors: a quotient of noise has no variance."""
_PEER_PROFILES: Final = 1500
CASES: Final = tuple(enumerate(product(scenes.AIRS, scenes.NOISES)))
"""Air and noise, each with its number, which is part of the seed."""


def measure_network(
    effort: Effort, *, profiles: int | None = None, peer_profiles: int | None = None
) -> Study:
    """Retrieve extinction in every network and air that peers solve too.

    Parameters
    ----------
    effort : Effort
    profiles : int, optional
        Number of profiles of which the coverage is that.
    peer_profiles : int, optional
        Number of profiles of each comparison with the peers.
    """
    profiles = profiles or (QUICK_PROFILES if effort.quick else PROFILES)
    compared = peer_profiles or (QUICK_PROFILES if effort.quick else _PEER_PROFILES)
    cases = [
        (number, air)
        for number, (air, noise) in CASES
        if noise == PEER_NOISE and air is not scenes.THIN
    ]
    works: list[Work] = []
    for seed, (lidars, (number, air)) in enumerate(product(scenes.LIDAR_LINES, cases)):
        clean = scenes.signals(lidars.network(), air)
        coverage = _coverage(clean, profiles, number)
        setting = f"{lidars.name}, {air.name}, noise {100.0 * PEER_NOISE:g} %"
        works += [
            Work(setting, "extinction, relative", method, error, coverage.get(method), spent,
                 ours=method not in PEERS)
            for method, (error, spent) in compare(clean, compared, seed).items()
        ]  # fmt: skip
        effort.progress(1)
    note = (
        f"Bins of {scenes.STEP:g} m, relative noise of each bin as given, plus 1 % of the power at "
        f"the first crossing of the beam; blocks of {BLOCK} profiles. Of extinction at the near "
        "crossings that all methods solve; relative, and clipped at 300 %, because a quotient of "
        f"noise has no variance. Coverage: of {profiles:,} other profiles. The "
        "peers fit extinctions and beam constants by scipy.optimize.least_squares, weighted as if "
        "point values were independent, without errors or flags, and with all points; lidarops "
        "leaves out those that are too noisy. They fit single profiles, or the mean of a block, "
        "whose extinction is taken for all of its profiles: the network with its prior has the "
        "block, too. In air that stays as it is, a mean is hard to surpass; in air that moves, it "
        "is wrong."
    )
    return comparison.study("networks of lidars", works, note)


def solve_case(clean: Signals, noise: float, profiles: int, seed: int) -> dict[str, NetworkResult]:
    """Return the results of every solver by name."""
    power, variance = clean.draw(noise, profiles, len(clean.network.origin), seed)
    return {method: solve(power, variance, clean) for method, solve in scenes.SOLVERS.items()}


def _coverage(clean: Signals, profiles: int, seed: int) -> dict[str, Figure | None]:
    """Return the share of unflagged values within 1.96 stated errors, by solver."""
    near, shares = clean.network.near_crossing, {}
    for method, result in solve_case(clean, PEER_NOISE, profiles, seed).items():
        deviation = result.extinction[:, near] - clean.truth(len(result.extinction))[:, near]
        deviation /= result.extinction_standard_error[:, near]
        trusted = np.isfinite(deviation) & ~result.flagged[:, near]
        shares[method] = share_by_block(np.abs(deviation) <= TWO_SIDED, trusted, BLOCK)
    return shares


def compare(clean: Signals, profiles: int, seed: int) -> dict[str, tuple[Figure, Figure]]:
    """Return the RMS relative error of all methods, and their CPU time of a profile.

    Of the same profiles, and of the near crossings that all of them solve.
    """
    power, variance = clean.draw(PEER_NOISE, profiles, 99, seed)
    near = clean.network.near_crossing
    truth = clean.truth(profiles)[:, near]
    times, errors = {}, {}
    methods: dict[str, Callable[[Array, Array, Signals], Any]] = {**scenes.SOLVERS, **PEERS}
    for name, solve in methods.items():
        times[name], solved = comparison.time_profiles(
            partial(solve, power, variance, clean), profiles
        )
        errors[name] = getattr(solved, "extinction", solved)[:, near] / truth - 1.0
    common = np.all([np.isfinite(error) for error in errors.values()], axis=0)
    return {
        name: (
            root_by_block(np.clip(error, -CLIPPED, CLIPPED), common, BLOCK) or Figure(math.nan),
            times[name],
        )
        for name, error in errors.items()
    }


# Peers: networks by `scipy.optimize.least_squares` ------------------------------------------------

_LEAST_SLOPE: Final = 1e-6
"""m-1, smallest extinction at the start of a fit."""


def network_by_scipy(power: Array, variance: Array, signals: Signals) -> Array:
    """Return (profile, crossing) extinction by `scipy.optimize.least_squares`, without errors.

    For each profile, the logarithms of extinction at the crossings and of one constant per beam
    are fitted to point values, weighted as if these were independent.
    """
    return np.stack(
        [
            _fit_network(*_point_values(profile, noise, signals), signals)
            for profile, noise in zip(power, variance, strict=True)
        ]
    )


def network_by_scipy_of_means(power: Array, variance: Array, signals: Signals) -> Array:
    """Return (profile, crossing) extinction of the mean of each block, for all its profiles."""
    first = np.arange(0, len(power), BLOCK)
    counts = np.diff(first, append=len(power))
    number = counts[:, np.newaxis, np.newaxis]
    mean = np.add.reduceat(power, first) / number
    variance_of_mean = np.add.reduceat(variance, first) / number**2
    return np.repeat(network_by_scipy(mean, variance_of_mean, signals), counts, axis=0)


def _point_values(power: Array, variance: Array, signals: Signals) -> tuple[Array, Array, Array]:
    """Return values, their relative errors, and integrals from the first crossing of each beam."""
    values, errors, integrals = [], [], []
    # A bin that is not positive has no logarithm and is replaced by half its noise.
    power = np.maximum(power, 0.5 * np.sqrt(variance))
    for beam in range(signals.network.beams):
        logarithm = np.log(power[beam] * signals.range**2)
        crossing_ranges, points = signals.network.on_beam(beam)[1], []
        for distance in crossing_ranges:
            middle = int(np.argmin(np.abs(signals.range - distance)))
            bins = slice(middle - THRESHOLDS.fit_bins // 2, middle + THRESHOLDS.fit_bins // 2 + 1)
            fit = np.polynomial.Polynomial.fit(signals.range[bins] - distance, logarithm[bins], 1)
            points.append(float(fit(0.0)))
            noise = np.sqrt(variance[beam, bins]) / power[beam, bins]
            errors.append(float(noise.mean() / np.sqrt(THRESHOLDS.fit_bins)))
        values += points
        total = 0.0
        for k, distance in enumerate(crossing_ranges):
            if k:
                inside = (signals.range > crossing_ranges[k - 1]) & (signals.range < distance)
                x = np.concatenate([[crossing_ranges[k - 1]], signals.range[inside], [distance]])
                y = np.concatenate([[points[k - 1]], logarithm[inside], [points[k]]])
                total += _log_trapezoid(x, y)
            integrals.append(total)
    return np.array(values), np.array(errors), np.array(integrals)


def _log_trapezoid(x: Array, logarithm: Array) -> float:
    """Return the integral of a function that is exponential between points."""
    rise = np.diff(logarithm)
    constant = np.abs(rise) < 1e-6
    mean = np.where(constant, 1.0, np.expm1(rise) / np.where(constant, 1.0, rise))
    return float(np.sum(np.diff(x) * np.exp(logarithm[:-1]) * mean))


def _fit_network(values: Array, errors: Array, integrals: Array, signals: Signals) -> Array:
    net = signals.network
    beam, crossing = net.passages.beam, net.passages.crossing
    first = np.searchsorted(beam, np.arange(net.beams))
    last = np.searchsorted(beam, np.arange(net.beams), side="right") - 1
    drop = np.exp(values[first]) - np.exp(values[last])
    slope = max(float(np.median(drop / (2.0 * integrals[last]))), _LEAST_SLOPE)
    start = np.concatenate([np.full(net.crossings, np.log(slope)), values[first] - np.log(slope)])

    def residuals(unknown: Array) -> Array:
        extinction, constant = unknown[crossing], np.exp(unknown[net.crossings + beam])
        remaining = np.maximum(constant - 2.0 * integrals, 1e-9 * constant)
        return np.asarray((np.log(remaining) + extinction - values) / errors)

    return np.asarray(np.exp(least_squares(residuals, start, x_scale="jac").x[: net.crossings]))


_SCIPY: Final = "scipy least_squares"
_SCIPY_MEAN: Final = f"{_SCIPY}, mean of {BLOCK} profiles"
PEERS: Final = {_SCIPY: network_by_scipy, _SCIPY_MEAN: network_by_scipy_of_means}
"""The second one is given what the network with its prior is: the profiles of a block."""
