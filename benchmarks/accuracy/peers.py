"""Iterative least-squares fits by common tools, for comparison.

All fit background, signal at the first range and extinction in km-1, which suits them best, with
exact derivatives. All fits of a call start from the values of the mean of its first profiles, which
suits profiles of the same air.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from scipy.optimize import curve_fit

from benchmarks.accuracy import levenberg_marquardt, variable_projection
from benchmarks.accuracy.homogeneous_cases import (
    Estimates,
    PathSolver,
    Scenario,
    estimated,
)
from benchmarks.harness.figure import Array

KILOMETRE: Final = 1e3
JIT: Final = "LM, numba"
PROJECTION: Final = "variable projection, numba"
CURVE_FIT: Final = "scipy curve_fit"
SLOW: Final = frozenset({CURVE_FIT})
"""Peers that loop over profiles in Python."""
_START_PROFILES: Final = 64
_START_EXTINCTIONS: Final = np.geomspace(3e-3, 10.0, 40)
"""km-1. Steps of 23 %: the nearest one is close enough for Gauss-Newton steps."""


def iterative_peers() -> dict[str, PathSolver]:
    """Return the iterative solvers by name."""
    return {
        JIT: compiled,
        PROJECTION: _by_projection,
        CURVE_FIT: _by_scipy,
    }


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


def compiled(power: Any, scenario: Scenario) -> Estimates:
    """Solve by the Levenberg-Marquardt fit of `benchmarks.accuracy.levenberg_marquardt`."""
    ratio, depth = _geometry(scenario)
    unknowns = np.empty((len(power), levenberg_marquardt.UNKNOWNS))
    covariance = np.empty((len(power), levenberg_marquardt.UNKNOWNS, levenberg_marquardt.UNKNOWNS))
    levenberg_marquardt.fit_levenberg_marquardt(
        power, ratio, depth, start(power, scenario), unknowns, covariance
    )
    return _estimates(unknowns, covariance, scenario)


def _by_projection(power: Any, scenario: Scenario) -> Estimates:
    """Solve by the fit of `benchmarks.accuracy.variable_projection`."""
    extinction = float(start(power, scenario)[2])
    return _estimates(*_project(power, _geometry(scenario), extinction), scenario)


def _project(power: Any, geometry: tuple[Array, Array], extinction: float) -> tuple[Array, Array]:
    """Return unknowns and covariance of profiles."""
    unknowns = np.empty((len(power), variable_projection.UNKNOWNS))
    covariance = np.empty((*unknowns.shape, variable_projection.UNKNOWNS))
    variable_projection.fit_variable_projection(power, *geometry, extinction, unknowns, covariance)
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
    noise = np.ones(scenario.bins)
    fits = [
        curve_fit(
            _model,
            geometry,
            np.asarray(row, np.float64),
            p0=begin,
            sigma=noise,
            absolute_sigma=True,
            jac=_slopes,
        )
        for row in power
    ]
    unknowns, covariance = zip(*fits, strict=True)
    return _estimates(np.stack(unknowns), np.stack(covariance), scenario)


def _estimates(unknowns: Array, covariance: Array, scenario: Scenario) -> Estimates:
    """Convert the signal at the first range to the amplitude, with its standard error."""
    background, signal, sigma = unknowns.T
    near = scenario.start
    amplitude = signal * near**2 * np.exp(2.0 * sigma / KILOMETRE * near)
    of_signal, of_extinction = 1.0 / signal, 2.0 * near / KILOMETRE
    relative = (
        of_signal**2 * covariance[:, 1, 1]
        + 2.0 * of_signal * of_extinction * covariance[:, 1, 2]
        + of_extinction**2 * covariance[:, 2, 2]
    )
    failed = np.asarray(~np.isfinite(unknowns).all(axis=1))
    return estimated(
        {
            "extinction": sigma / KILOMETRE,
            "background": background,
            "amplitude": amplitude,
        },
        {
            "extinction": np.sqrt(covariance[:, 2, 2]) / KILOMETRE,
            "background": np.sqrt(covariance[:, 0, 0]),
            "amplitude": np.abs(amplitude) * np.sqrt(relative),
        },
        flagged=failed,
        rejected=failed,
    )
