"""Repeated fits without outlying bins."""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt

from lidarops.flags import Quality
from lidarops.retrieve.homogeneous._problem import Array, PathProblem, PathSolution

FARTHEST: Final = 4.0
"""Deviation, in standard deviations of the noise, beyond which a bin is excluded."""
_MEDIAN: Final = 1.4826
"""Standard deviation over the median of absolute deviations."""
_HUGE: Final = 1e300

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True, slots=True)
class RobustSolver:
    """A solver that excludes outlying bins and fits again, a fixed number of times."""

    solver: Callable[[PathProblem], PathSolution]
    passes: int

    def __call__(self, problem: PathProblem) -> PathSolution:
        """Return the solution; every profile is solved on its own."""
        solution = self.solver(problem)
        if self.passes == 0:
            return solution
        excluded = np.zeros(problem.power.shape, dtype=np.bool_)
        for _ in range(self.passes):
            changed = _mark_outliers(problem, solution, excluded)
            if changed.size == 0:
                break
            power = problem.power[changed]
            power[excluded[changed]] = np.nan
            again = self.solver(problem.select(changed, power))
            solution = solution.updated(changed, again)
        far = np.any(excluded, axis=-1)
        outlier = np.where(far, np.int32(Quality.OUTLIER), np.int32(0))
        return replace(solution, quality=solution.quality | outlier)


def _mark_outliers(
    problem: PathProblem, solution: PathSolution, excluded: npt.NDArray[np.bool_]
) -> npt.NDArray[np.intp]:
    """Update the excluded bins; return the profiles for which they changed."""
    changed = np.zeros(problem.power.shape[0], dtype=np.bool_)
    _mark(
        problem.power,
        problem.noise,
        problem.known_variance,
        problem.range,
        solution.background,
        solution.amplitude,
        solution.extinction,
        excluded,
        changed,
    )
    return np.flatnonzero(changed)


@_compiled
def _deviations(
    power: Any, noise: Array, is_variance: bool, fit: Array, out: Array, rounding: float
) -> None:
    """Fill the absolute deviations in units of the noise, NaN for unused bins."""
    for i in range(out.size):
        value = np.float64(power[i])
        weight = 1.0 / noise[i] if is_variance else noise[i]
        usable = abs(value) < _HUGE and 0.0 < weight < _HUGE
        # A deviation within rounding is no outlier, however small the noise.
        excess = max(abs(value - fit[i]) - rounding * abs(value), 0.0)
        out[i] = excess * math.sqrt(weight) if usable else np.nan


@_compiled
def _mark(
    power: Any,
    noise: Array,
    is_variance: bool,
    range_: Array,
    background: Array,
    amplitude: Array,
    extinction: Array,
    excluded: npt.NDArray[np.bool_],
    changed: npt.NDArray[np.bool_],
) -> None:
    fit, deviation = np.empty(range_.size), np.empty(range_.size)
    rounding = 4.0 * np.finfo(power.dtype).eps
    for k in range(power.shape[0]):
        if not math.isfinite(extinction[k] * background[k] * amplitude[k]):
            continue
        sign = math.copysign(1.0, amplitude[k])
        logarithm = math.log(abs(amplitude[k]))
        for i in range(range_.size):
            falling = logarithm - 2.0 * (math.log(range_[i]) + extinction[k] * range_[i])
            fit[i] = background[k] + sign * math.exp(falling)
        _deviations(power[k], noise[k % noise.shape[0]], is_variance, fit, deviation, rounding)
        scale = _MEDIAN * np.nanmedian(deviation)
        # The median keeps a bad fit from excluding most of its bins: at most half exceed it.
        limit = FARTHEST * (max(scale, 1.0) if is_variance else scale)
        for i in range(range_.size):
            far = deviation[i] > limit
            changed[k] = changed[k] or far != excluded[k, i]
            excluded[k, i] = far
