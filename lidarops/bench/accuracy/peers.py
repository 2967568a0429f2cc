"""Iterative least-squares fits by common tools, for comparison.

All fit background, signal at the first range and extinction in km-1, which suits them best, with
exact derivatives. They start from the true background and signal and 0.8 of the true extinction,
which is better than any start from data.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from scipy.optimize import curve_fit

from lidarops.bench.accuracy import levenberg_marquardt, variable_projection
from lidarops.bench.accuracy.homogeneous_cases import (
    WRONG_PRIOR,
    Estimates,
    PathSolver,
    Scenario,
    estimated,
)
from lidarops.bench.harness.rows import Array

KILOMETRE: Final = 1e3
JIT: Final = "LM, numba"
PROJECTION: Final = "variable projection, numba"


def iterative_peers() -> dict[str, PathSolver]:
    """Return the iterative solvers by name."""
    return {
        JIT: compiled,
        PROJECTION: _by_projection,
        "scipy curve_fit": _by_scipy,
    }


def start(scenario: Scenario) -> Array:
    """Return the start values of the fits of a scenario."""
    extinction = WRONG_PRIOR * scenario.extinction * KILOMETRE
    return np.array([scenario.background, scenario.signal, extinction])


def compiled(power: Any, scenario: Scenario) -> Estimates:
    """Solve by the Levenberg-Marquardt fit of `lidarops.bench.accuracy.levenberg_marquardt`."""
    ratio, depth = _geometry(scenario)
    unknowns = np.empty((len(power), levenberg_marquardt.UNKNOWNS))
    covariance = np.empty((len(power), levenberg_marquardt.UNKNOWNS, levenberg_marquardt.UNKNOWNS))
    levenberg_marquardt.fit_levenberg_marquardt(
        power, ratio, depth, start(scenario), unknowns, covariance
    )
    return _estimates(unknowns, covariance, scenario)


def _by_projection(power: Any, scenario: Scenario) -> Estimates:
    """Solve by the fit of `lidarops.bench.accuracy.variable_projection`."""
    ratio, depth = _geometry(scenario)
    unknowns = np.empty((len(power), variable_projection.UNKNOWNS))
    covariance = np.empty((*unknowns.shape, variable_projection.UNKNOWNS))
    variable_projection.fit_variable_projection(
        power, ratio, depth, float(start(scenario)[2]), unknowns, covariance
    )
    return _estimates(unknowns, covariance, scenario)


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
    geometry, begin = _geometry(scenario), start(scenario)
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
    gradient = np.stack([1.0 / signal, np.full_like(signal, 2.0 * near / KILOMETRE)], axis=1)
    relative = np.einsum("ki,kij,kj->k", gradient, covariance[:, 1:, 1:], gradient)
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
