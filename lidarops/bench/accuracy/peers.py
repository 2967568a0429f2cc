"""Iterative least-squares fits by common tools, for comparison.

All fit background, signal at the first range and extinction in km-1, which suits them best, with
exact derivatives. They start from the true background and signal and 0.8 of the true extinction,
which is better than any start from data.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

import numpy as np
from scipy.optimize import curve_fit, least_squares

from lidarops.bench.accuracy import levenberg_marquardt
from lidarops.bench.accuracy.homogeneous_cases import (
    WRONG_PRIOR,
    Array,
    Estimates,
    PathSolver,
    Scenario,
    estimated,
)

KILOMETRE: Final = 1e3
JIT: Final = "LM, numba"
JAX: Final = "LM, JAX vmap"
_JAX_ITERATIONS: Final = 8
_JAX_DAMPING: Final = 1e-6


def iterative_peers() -> dict[str, PathSolver]:
    """Return the iterative solvers by name; the JAX solver only if JAX is installed."""
    peers: dict[str, PathSolver] = {
        JIT: compiled,
        "scipy curve_fit": _one_by_one(_curve_fit),
        "scipy least_squares": _one_by_one(_least_squares),
    }
    if find_spec("jax") is not None:
        peers[JAX] = vectorised
    return peers


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


def vectorised(power: Any, scenario: Scenario) -> Estimates:
    """Solve by a fixed number of damped Gauss-Newton steps of all profiles at once, in JAX."""
    ratio, depth = _geometry(scenario)
    unknowns, covariance = _jax_solver()(
        np.asarray(power, np.float64), ratio, depth, start(scenario)
    )
    return _estimates(np.asarray(unknowns), np.asarray(covariance), scenario)


@cache
def _jax_solver() -> Callable[..., Any]:
    jax: Any = import_module("jax")
    # Single precision, the default, does not reach the least scatter with a large background.
    jax.config.update("jax_enable_x64", True)  # noqa: FBT003 - the signature of JAX
    numpy = jax.numpy

    def normal(power: Any, unknowns: Any, ratio: Any, depth: Any) -> tuple[Any, Any]:
        shape = ratio * numpy.exp(-2.0 * unknowns[2] * depth)
        slopes = numpy.stack([numpy.ones_like(shape), shape, -2.0 * unknowns[1] * depth * shape])
        return slopes @ slopes.T, slopes @ (power - unknowns[0] - unknowns[1] * shape)

    def solve(power: Any, ratio: Any, depth: Any, begin: Any) -> tuple[Any, Any]:
        def step(_: Any, unknowns: Any) -> Any:
            matrix, side = normal(power, unknowns, ratio, depth)
            damped = matrix + _JAX_DAMPING * numpy.diag(numpy.diag(matrix))
            return unknowns + numpy.linalg.solve(damped, side)

        unknowns = jax.lax.fori_loop(0, _JAX_ITERATIONS, step, begin)
        return unknowns, numpy.linalg.inv(normal(power, unknowns, ratio, depth)[0])

    compiled_solver: Callable[..., Any] = jax.jit(jax.vmap(solve, in_axes=(0, None, None, None)))
    return compiled_solver


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


_Single = Callable[[Array, tuple[Array, Array], Array], tuple[Array, Array]]


def _curve_fit(power: Array, geometry: tuple[Array, Array], begin: Array) -> tuple[Array, Array]:
    unknowns, covariance = curve_fit(
        _model,
        geometry,
        power,
        p0=begin,
        sigma=np.ones_like(power),
        absolute_sigma=True,
        jac=_slopes,
    )
    return unknowns, covariance


def _least_squares(
    power: Array, geometry: tuple[Array, Array], begin: Array
) -> tuple[Array, Array]:
    solution = least_squares(
        lambda unknowns: _model(geometry, *unknowns) - power,
        begin,
        jac=lambda unknowns: _slopes(geometry, *unknowns),
        method="lm",
        x_scale="jac",
    )
    return solution.x, np.linalg.inv(solution.jac.T @ solution.jac)


def _one_by_one(single: _Single) -> PathSolver:
    def solve(power: Any, scenario: Scenario) -> Estimates:
        geometry, begin = _geometry(scenario), start(scenario)
        fits = [single(np.asarray(row, np.float64), geometry, begin) for row in power]
        unknowns, covariance = zip(*fits, strict=True)
        return _estimates(np.stack(unknowns), np.stack(covariance), scenario)

    return solve


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
