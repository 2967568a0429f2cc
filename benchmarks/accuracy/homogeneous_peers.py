"""Iterative least-squares fits of a homogeneous path by common tools, for comparison.

All fit background, signal at the first range and extinction in km-1, which suits them best, with
exact derivatives. All fits of a call start from the values of the mean of its first profiles, which
suits profiles of the same air.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numba
import numpy as np
from scipy.optimize import curve_fit

from benchmarks.harness.figure import Array
from benchmarks.scenes.homogeneous_paths import Estimates, PathSolver, Scenario

KILOMETRE: Final = 1e3
_UNKNOWNS: Final = 3
PROJECTION: Final = "variable projection, numba"
CURVE_FIT: Final = "scipy curve_fit"
SLOW: Final = frozenset({CURVE_FIT})
"""Peers that loop over profiles in Python."""
_START_PROFILES: Final = 64
_START_EXTINCTIONS: Final = np.geomspace(3e-3, 10.0, 40)
"""km-1. Steps of 23 %: the nearest one is close enough for Gauss-Newton steps."""


def iterative_peers() -> dict[str, PathSolver]:
    """Return the iterative solvers by name."""
    return {PROJECTION: _by_projection, CURVE_FIT: _by_scipy}


def start(power: Any, scenario: Scenario) -> Array:
    """Return the start values of the fits: those of the mean of the first profiles."""
    ratio, depth = _geometry(scenario)
    first = np.asarray(power[:_START_PROFILES], np.float64)
    mean = first[np.isfinite(first).all(axis=1)].mean(axis=0)
    shapes = ratio * np.exp(-2.0 * _START_EXTINCTIONS[:, np.newaxis] * depth)
    shapes -= shapes.mean(axis=1, keepdims=True)
    explained = (shapes @ mean) ** 2 / np.sum(shapes**2, axis=1)
    extinction = float(_START_EXTINCTIONS[np.argmax(explained)])
    unknowns, _ = _project(mean[np.newaxis], (ratio, depth), extinction)
    return np.asarray(unknowns[0])


def _by_projection(power: Any, scenario: Scenario) -> Estimates:
    """Solve by `fit_variable_projection`."""
    extinction = float(start(power, scenario)[2])
    return _estimates(*_project(power, _geometry(scenario), extinction))


def _project(power: Any, geometry: tuple[Array, Array], extinction: float) -> tuple[Array, Array]:
    """Return unknowns and covariance of profiles."""
    unknowns = np.empty((len(power), _UNKNOWNS))
    covariance = np.empty((*unknowns.shape, _UNKNOWNS))
    fit_variable_projection(power, *geometry, extinction, unknowns, covariance)
    return unknowns, covariance


def _geometry(scenario: Scenario) -> tuple[Array, Array]:
    distance = scenario.range
    return (distance[0] / distance) ** 2, (distance - distance[0]) / KILOMETRE


def _model(geometry: tuple[Array, Array], background: float, signal: float, sigma: float) -> Array:
    ratio, depth = geometry
    return np.asarray(background + signal * ratio * np.exp(-2.0 * sigma * depth))


def _slopes(geometry: tuple[Array, Array], _: float, signal: float, sigma: float) -> Array:
    ratio, depth = geometry
    shape = ratio * np.exp(-2.0 * sigma * depth)
    return np.stack([np.ones_like(shape), shape, -2.0 * signal * depth * shape], axis=1)


def _by_scipy(power: Any, scenario: Scenario) -> Estimates:
    """Solve by `scipy.optimize.curve_fit`, profile by profile."""
    geometry, begin = _geometry(scenario), start(power, scenario)
    fit = partial(
        curve_fit, _model, geometry, p0=begin, sigma=np.ones(scenario.bins), absolute_sigma=True,
        jac=_slopes,
    )  # fmt: skip
    fits = [fit(ydata=np.asarray(row, np.float64)) for row in power]
    unknowns, covariance = zip(*fits, strict=True)
    return _estimates(np.stack(unknowns), np.stack(covariance))


def _estimates(unknowns: Array, covariance: Array) -> Estimates:
    """Return the estimates in SI units."""
    factors = {"extinction": (2, KILOMETRE), "background": (0, 1.0)}
    failed = np.asarray(~np.isfinite(unknowns).all(axis=1))
    return Estimates(
        {name: unknowns[:, k] / unit for name, (k, unit) in factors.items()},
        {name: np.sqrt(covariance[:, k, k]) / unit for name, (k, unit) in factors.items()},
        flagged=failed,
        rejected=failed,
    )


# Variable projection: the strongest simple peer ----------------------------------------------
#
# At one extinction the model is linear in background and signal, so that only the extinction is
# iterated, by Gauss-Newton steps (golub1973). All fits begin at one extinction, whose sums over the
# shape are formed once. Even spacing makes the exponential a recurrence.

_STEPS: Final = 30
"""Most steps of a fit."""
_CONVERGED: Final = 0.05
"""Last step in standard errors of the extinction: a further one would be a few hundredths of it."""
_LANES: Final = 8
"""Interleaved recurrences, which the compiler turns into vectors."""
_fast = numba.njit(
    cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp"}
)


@_fast
def _tables(ratio: Array, depth: Array, sigma: float, first: Array, second: Array) -> Any:
    """Fill the shape and its slope, and return their sums."""
    step = np.exp(-2.0 * sigma * _LANES * (depth[1] - depth[0]))
    for i in range(_LANES):
        first[i] = np.exp(-2.0 * sigma * depth[i])
    for i in range(_LANES, depth.size):
        first[i] = step * first[i - _LANES]
    f = d = ff = fd = dd = 0.0
    for i in range(depth.size):
        first[i] *= ratio[i]
        second[i] = depth[i] * first[i]
        f += first[i]
        d += second[i]
        ff += first[i] * first[i]
        fd += first[i] * second[i]
        dd += second[i] * second[i]
    return f, d, ff, fd, dd


@_fast
def _start_sums(power: Any, first: Array, second: Array) -> Any:
    """Return the sum of a profile, and those of its products with shape and slope."""
    total = yf = yd = 0.0
    for i in range(power.size):
        total += power[i]
        yf += power[i] * first[i]
        yd += power[i] * second[i]
    return total, yf, yd


@_fast
def _sums(power: Any, ratio: Array, depth: Array, sigma: float, shape: Array) -> Any:
    """Return the sums of the shape, of its slope and of their products with the profile."""
    step = np.exp(-2.0 * sigma * _LANES * (depth[1] - depth[0]))
    for i in range(_LANES):
        shape[i] = np.exp(-2.0 * sigma * depth[i])
    for i in range(_LANES, depth.size):
        shape[i] = step * shape[i - _LANES]
    f = d = ff = fd = dd = yf = yd = 0.0
    for i in range(depth.size):
        first = ratio[i] * shape[i]
        second = depth[i] * first
        f += first
        d += second
        ff += first * first
        fd += first * second
        dd += second * second
        yf += power[i] * first
        yd += power[i] * second
    return f, d, ff, fd, dd, yf, yd


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fit_variable_projection(
    power: Any, ratio: Array, depth: Array, start: float, unknowns: Array, covariance: Array
) -> None:
    """Fit background, signal at the start and extinction to profiles of unit variance.

    Parameters
    ----------
    power : (profile, bin) float
        At least 8 bins.
    ratio, depth : (bin,) float
        Square of first over range; evenly spaced distances from the first.
    start : float
        Extinction in the unit of 1 / `depth`, of all profiles.
    unknowns : (profile, 3) float
        Receives the solution; NaN where it does not converge.
    covariance : (profile, 3, 3) float
        Receives the covariance.
    """
    bins, shape, slope = depth.size, np.empty(depth.size), np.empty(depth.size)
    start_shape = np.empty(bins)
    f0, d0, ff0, fd0, dd0 = _tables(ratio, depth, start, start_shape, slope)
    for k in range(len(power)):
        total, yf, yd = _start_sums(power[k], start_shape, slope)
        f, d, ff, fd, dd = f0, d0, ff0, fd0, dd0
        sigma, step, error = start, np.inf, 0.0
        background = signal = of_signal = of_background = np.nan
        for iteration in range(_STEPS):
            if iteration:
                f, d, ff, fd, dd, yf, yd = _sums(power[k], ratio, depth, sigma, shape)
            # Without their means, and the slope without the shape.
            ff, fd, dd = ff - f * f / bins, fd - f * d / bins, dd - d * d / bins
            yf, yd = yf - f * total / bins, yd - d * total / bins
            signal = yf / ff
            background = (total - signal * f) / bins
            left = dd - fd * fd / ff
            error = 0.5 / (abs(signal) * np.sqrt(left))
            step = -0.5 * (yd - signal * fd) / (signal * left)
            sigma += step
            if not abs(step) > _CONVERGED * error:
                break
        # d signal / d extinction and d background / d extinction, at the minimum of the rest.
        of_signal = 2.0 * signal * fd / ff
        of_background = (2.0 * signal * d - of_signal * f) / bins
        unknowns[k, 0] = background + of_background * step
        unknowns[k, 1] = signal + of_signal * step
        unknowns[k, 2] = sigma
        if not abs(step) <= _CONVERGED * error:
            unknowns[k] = np.nan
        v = error * error
        covariance[k, 2, 2] = v
        covariance[k, 1, 1] = 1.0 / ff + of_signal**2 * v
        covariance[k, 0, 0] = 1.0 / bins + (f / bins) ** 2 / ff + of_background**2 * v
        covariance[k, 1, 2] = covariance[k, 2, 1] = of_signal * v
        covariance[k, 0, 2] = covariance[k, 2, 0] = of_background * v
        covariance[k, 0, 1] = covariance[k, 1, 0] = -f / bins / ff + of_signal * of_background * v
