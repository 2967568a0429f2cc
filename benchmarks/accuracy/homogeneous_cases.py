"""Homogeneous paths with known truth: signals, bounds of accuracy, and solvers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from benchmarks.harness.figure import Array, Mask
from lidarops.flags import Quality, rejecting
from lidarops.retrieve.background import cubic_and_tail
from lidarops.retrieve.homogeneous import path_fit
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod, HomogeneousResult
from lidarops.simulate.signal import optical_depth

BINS: Final = 225
BACKGROUND: Final = 370.0
"""In standard deviations of the noise, like all powers here."""
QUANTITIES: Final = ("extinction", "background")
"""The compared unknowns; the third, the amplitude, is the signal extrapolated to range zero."""
TAIL_MEAN: Final = "tail_mean"
"""Solver: the mean of the last tenth of the bins as the background, as is usual."""
WRONG_PRIOR: Final = 0.8
"""Prior extinction, where one is needed, as a share of the truth."""

_STARTS: Final = (2500.0, 10500.0)
_LENGTHS: Final = (1700.0, 8000.0)
_EXTINCTIONS: Final = (1e-5, 1e-4, 1e-3, 5e-3)
_AMPLITUDES: Final = (15.0, 1e2, 1e3, 1e4, 1e5)
_SOLVABLE: Final = 0.1
_QUICK: Final = 8
_SEED: Final = 20240915


def relative_signal(distance: Array, extinction: Array, backscatter: Array) -> Array:
    r"""Return the signal of backscatter beyond full overlap, over that of the first bin, 1.

    Parameters
    ----------
    distance : ndarray, m, shape (bins,)
        Range of the bin centres, positive and ascending.
    extinction, backscatter : ndarray, shape (..., bins)
        m-1, and in any unit.

    Notes
    -----
    :math:`(\beta_i / \beta_0) (R_0 / R_i)^2 \exp(-2 (\tau_i - \tau_0))` is defined also where
    nothing of the signal itself is left in the first bin.
    """
    depth = optical_depth(distance, extinction)
    shape = backscatter / backscatter[..., :1] * (distance[0] / distance) ** 2
    signal: Array = shape * np.exp(-2.0 * (depth - depth[..., :1]))
    return signal


@dataclass(frozen=True, slots=True)
class Scenario:
    """One homogeneous path with white noise of unit variance."""

    start: float
    """m."""
    length: float
    """m."""
    extinction: float
    """m-1."""
    signal: float
    """Above the background, at the start."""
    background: float = BACKGROUND
    bins: int = BINS

    @property
    def range(self) -> Array:
        """Ranges in m, uniform from the start to the start plus the length."""
        return np.linspace(self.start, self.start + self.length, self.bins)

    @property
    def mean(self) -> Array:
        """Noise-free power."""
        air = np.ones(self.bins)
        signal = relative_signal(self.range, self.extinction * air, air)
        return np.asarray(self.background + self.signal * signal)

    @property
    def label(self) -> str:
        """Description, in km and km-1."""
        return (
            f"{self.start / 1e3:g} + {self.length / 1e3:g} km, "
            f"{1e3 * self.extinction:g} km-1, signal {self.signal:g}"
        )

    def powers(self, count: int, seed: int = 0, dtype: npt.DTypeLike = np.float64) -> Any:
        """Return `count` noisy profiles; the same seed gives the same noise."""
        noise = np.random.default_rng([_SEED, seed]).standard_normal((count, self.bins))
        return (self.mean + noise).astype(dtype)

    def least_errors(self) -> dict[str, float]:
        """Return the Cramér-Rao bound of the standard error of each of `QUANTITIES`."""
        bounds = least_errors(self.range, self.extinction, self.signal)
        return {name: float(bound[0]) for name, bound in bounds.items()}

    def difficulty(self) -> float:
        """Return the least standard error of extinction over extinction + 1 / mean range."""
        scale = self.extinction + 1.0 / float(self.range.mean())
        return self.least_errors()["extinction"] / scale


def least_errors(
    distance: Array, extinction: npt.ArrayLike, signal: npt.ArrayLike
) -> dict[str, Array]:
    r"""Return the Cramér-Rao bounds of the standard errors of paths, each (profile,).

    The inverse Fisher matrix of background, signal in the first bin and extinction with Gaussian
    noise of unit variance (kay1993),

    .. math:: F = J^T J, \quad J = [1, \; \phi, \; -2 (R - R_0) S \phi],
        \quad \phi = (R_0 / R)^2 e^{-2 \sigma (R - R_0)}

    The bound of an unknown is the reciprocal norm of what its column adds to the others: the last
    diagonal element of the triangular factor.

    Parameters
    ----------
    distance : (bin,) float
        m.
    extinction, signal : (profile, 1) float
        m-1, and the signal in the first bin over the noise.
    """
    depth = distance - distance[0]
    shape = (distance[0] / distance) ** 2 * np.exp(-2.0 * np.atleast_2d(extinction) * depth)
    slope = -2.0 * depth * signal * shape
    last = {"extinction": (np.ones_like(shape), shape, slope),
            "background": (shape, slope, np.ones_like(shape))}  # fmt: skip
    bounds = {}
    for name, columns in last.items():
        factor = np.asarray(np.linalg.qr(np.stack(columns, -1), mode="r"))
        bounds[name] = 1.0 / np.maximum(np.abs(factor[:, -1, -1]), np.finfo(float).tiny)
    return bounds


def scenarios(*, quick: bool = False) -> list[Scenario]:
    """Return the paths of the benchmark: those with a difficulty of at most 0.1, or 8 of them."""
    grid = product(_STARTS, _LENGTHS, _EXTINCTIONS, _AMPLITUDES)
    solvable = [s for values in grid if (s := Scenario(*values)).difficulty() <= _SOLVABLE]
    if not quick:
        return solvable
    selected = np.linspace(0, len(solvable) - 1, _QUICK).round().astype(int)
    return [solvable[k] for k in selected]


@dataclass(frozen=True, slots=True)
class Estimates:
    """Estimates of a solver, one value per profile, by `QUANTITIES`."""

    values: Mapping[str, Array]
    standard_errors: Mapping[str, Array]
    flagged: Mask
    """Any quality bit."""
    rejected: Mask
    """A rejecting quality bit."""


PathSolver = Callable[[Any, Scenario], Estimates]
"""Solver: returns estimates from powers (profile, range) and their scenario."""


def method_arguments(method: HomogeneousMethod, scenario: Scenario) -> dict[str, Any]:
    """Return the arguments that a method needs besides the power.

    Known values are exact; the prior of "linearized" is 20 percent low.
    """
    match method:
        case HomogeneousMethod.LINEARIZED:
            return {"extinction": WRONG_PRIOR * scenario.extinction}
        case HomogeneousMethod.KNOWN_EXTINCTION:
            return {"extinction": scenario.extinction}
        case HomogeneousMethod.KNOWN_BACKGROUND:
            return {"background": scenario.background}
        case _:
            return {}


def methods() -> dict[str, PathSolver]:
    """Return a solver for every method of `fit_homogeneous_path` and for `TAIL_MEAN`, by name."""
    solvers = {str(method): _solver(method) for method in HomogeneousMethod}
    return solvers | {TAIL_MEAN: _fit_above_tail}


def _fit_above_tail(power: Any, scenario: Scenario) -> Estimates:
    tail = cubic_and_tail.tail_mean(power, scenario.range, variance=1.0)
    fit = path_fit.fit_homogeneous_path(
        power, scenario.range, variance=1.0, method="known_background", background=tail.background,
        background_standard_error=tail.background_standard_error,
    )  # fmt: skip
    return _estimates(fit)


def _solver(method: HomogeneousMethod) -> PathSolver:
    def solve(power: Any, scenario: Scenario) -> Estimates:
        options = method_arguments(method, scenario)
        return _estimates(
            path_fit.fit_homogeneous_path(
                power, scenario.range, variance=1.0, method=method.value, **options
            )
        )

    return solve


def _estimates(fit: HomogeneousResult) -> Estimates:
    return Estimates(
        values={name: getattr(fit, name) for name in QUANTITIES},
        standard_errors={name: getattr(fit, f"{name}_standard_error") for name in QUANTITIES},
        flagged=fit.quality != 0,
        rejected=(fit.quality & rejecting((*Quality, *HomogeneousQuality))) != 0,
    )
