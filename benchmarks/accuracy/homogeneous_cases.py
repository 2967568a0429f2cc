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
QUANTITIES: Final = ("extinction", "background", "log_amplitude")
"""B is the signal extrapolated to range zero, by an optical depth of up to 100 here. Its logarithm
is nearly normally distributed, with the relative error of B."""
SOLVED: Final = ("extinction", "background", "amplitude")
"""The unknowns as the solvers return them."""
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
    def amplitude(self) -> float:
        """B of ``P = P* + B R^-2 exp(-2 extinction R)``, in m2."""
        return float(self.signal * self.start**2 * np.exp(2 * self.extinction * self.start))

    @property
    def truth(self) -> Mapping[str, float]:
        """Truth of the three unknowns, by name."""
        values = (self.extinction, self.background, float(np.log(self.amplitude)))
        return dict(zip(QUANTITIES, values, strict=True))

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


def least_errors(scenario: Scenario) -> dict[str, float]:
    r"""Return the Cramér-Rao bound of the standard error of each unknown.

    The inverse Fisher matrix of ``(P*, B, extinction)`` with Gaussian noise of unit variance,

    .. math:: F = J^T J, \quad J = [1, \; \phi, \; -2 R B \phi],
        \quad \phi = R^{-2} e^{-2 \sigma R}

    (kay1993). It is inverted in terms of ``b = B phi`` at the mean range, where it is well
    conditioned, and converted to log B by the exact derivatives.
    """
    height, covariance = _information(scenario)[1:]
    middle = float(scenario.range.mean())
    gradient = np.array([0.0, 1.0 / height, 2 * middle])
    return {
        "extinction": float(np.sqrt(covariance[2, 2])),
        "background": float(np.sqrt(covariance[0, 0])),
        "log_amplitude": float(np.sqrt(gradient @ covariance @ gradient)),
    }


def background_bias(scenario: Scenario) -> float:
    r"""Return the bias of the background common to all least-squares solutions.

    To second order, with the inverse Fisher matrix C and the second derivatives H of the model
    (box1971),

    .. math:: -\tfrac12 \, C \sum_i J_i \, \mathrm{tr}(C H_i)
    """
    slopes, height, covariance = _information(scenario)
    away = scenario.range - scenario.range.mean()
    shape = slopes[:, 1]
    curvature = (
        2 * covariance[1, 2] * (-2 * away * shape) + covariance[2, 2] * 4 * height * away**2 * shape
    )
    return float(-0.5 * (covariance @ (slopes.T @ curvature))[0])


def _information(scenario: Scenario) -> tuple[Array, float, Array]:
    """Return derivatives by (P*, b, extinction), b at the mean range, and their covariance."""
    distance = scenario.range
    middle = float(distance.mean())
    shape = (middle / distance) ** 2 * np.exp(-2 * scenario.extinction * (distance - middle))
    height = scenario.amplitude * middle**-2 * np.exp(-2 * scenario.extinction * middle)
    slopes = np.stack(
        [np.ones_like(distance), shape, -2 * height * (distance - middle) * shape], axis=1
    )
    scale = np.sqrt(np.sum(slopes**2, axis=0))
    covariance = np.linalg.inv((slopes / scale).T @ (slopes / scale)) / np.outer(scale, scale)
    return slopes, float(height), covariance


def difficulty(scenario: Scenario) -> float:
    """Return the least standard error of extinction over extinction + 1 / mean range."""
    scale = scenario.extinction + 1.0 / float(scenario.range.mean())
    return least_errors(scenario)["extinction"] / scale


def scenarios(*, quick: bool = False) -> list[Scenario]:
    """Return the paths of the benchmark: those with a `difficulty` of at most 0.1, or 8 of them."""
    grid = product(_STARTS, _LENGTHS, _EXTINCTIONS, _AMPLITUDES)
    solvable = [s for values in grid if difficulty(s := Scenario(*values)) <= _SOLVABLE]
    if not quick:
        return solvable
    selected = np.linspace(0, len(solvable) - 1, _QUICK).round().astype(int)
    return [solvable[k] for k in selected]


@dataclass(frozen=True, slots=True)
class Estimates:
    """Estimates of a solver, one value per profile."""

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
    return estimates(
        path_fit.fit_homogeneous_path(
            power,
            scenario.range,
            variance=1.0,
            method="known_background",
            background=tail.background,
            background_standard_error=tail.background_standard_error,
        )
    )


def _solver(method: HomogeneousMethod) -> PathSolver:
    def solve(power: Any, scenario: Scenario) -> Estimates:
        fit = path_fit.fit_homogeneous_path(
            power,
            scenario.range,
            variance=1.0,
            method=method.value,
            **method_arguments(method, scenario),
        )
        return estimates(fit)

    return solve


def estimates(fit: HomogeneousResult) -> Estimates:
    """Return the estimates of a fit."""
    return estimated(
        {name: getattr(fit, name) for name in SOLVED},
        {name: getattr(fit, f"{name}_standard_error") for name in SOLVED},
        flagged=fit.quality != 0,
        rejected=(fit.quality & rejecting((*Quality, *HomogeneousQuality))) != 0,
    )


def estimated(
    values: Mapping[str, Array],
    standard_errors: Mapping[str, Array],
    *,
    flagged: Any,
    rejected: Any,
) -> Estimates:
    """Return the estimates of `SOLVED`, with the logarithm of the amplitude or NaN."""
    amplitude = values["amplitude"]
    with np.errstate(invalid="ignore", divide="ignore"):
        logarithm = np.log(amplitude)
        relative = standard_errors["amplitude"] / amplitude
    linear = QUANTITIES[:2]
    return Estimates(
        values={name: values[name] for name in linear} | {"log_amplitude": logarithm},
        standard_errors={name: standard_errors[name] for name in linear}
        | {"log_amplitude": relative},
        flagged=flagged,
        rejected=rejected,
    )
