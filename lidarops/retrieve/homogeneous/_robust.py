"""Repeated fits without the bins that lie far off."""

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
from lidarops.retrieve.homogeneous._problem import Array, Flat, PathProblem

FARTHEST: Final = 4.0
"""Deviation, in standard deviations of the noise, beyond which a bin is left out."""
_MEDIAN: Final = 1.4826
"""Standard deviation over the median of absolute deviations."""
_HUGE: Final = 1e300

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True, slots=True)
class Robust:
    """A solver that leaves out outlying bins and fits again, a fixed number of times."""

    solver: Callable[[PathProblem], Flat]
    passes: int

    def __call__(self, problem: PathProblem) -> Flat:
        """Solve; each profile on its own."""
        found = self.solver(problem)
        if self.passes == 0:
            return found
        left_out = np.zeros(problem.power.shape, dtype=np.bool_)
        for _ in range(self.passes):
            changed = _find_far(problem, found, left_out)
            if changed.size == 0:
                break
            power = problem.power[changed]
            power[left_out[changed]] = np.nan
            again = self.solver(problem.select(changed, power))
            found = found.updated(changed, again)
        far = np.any(left_out, axis=-1)
        outlier = np.where(far, np.int32(Quality.OUTLIER), np.int32(0))
        return replace(found, quality=found.quality | outlier)


def _find_far(
    problem: PathProblem, found: Flat, left_out: npt.NDArray[np.bool_]
) -> npt.NDArray[np.intp]:
    """Update which bins are left out; return the profiles for which that changed."""
    changed = np.zeros(problem.power.shape[0], dtype=np.bool_)
    _mark(
        problem.power,
        problem.noise,
        problem.known_variance,
        problem.range,
        found.background,
        found.amplitude,
        found.extinction,
        left_out,
        changed,
    )
    return np.flatnonzero(changed)


@_compiled
def _deviations(
    power: Any, noise: Array, is_variance: bool, fit: Array, out: Array, rounding: float
) -> None:
    """Fill the absolute deviations in units of the noise, NaN where a bin is not used."""
    for i in range(out.size):
        value = np.float64(power[i])
        weight = 1.0 / noise[i] if is_variance else noise[i]
        usable = abs(value) < _HUGE and 0.0 < weight < _HUGE
        # What rounding explains is not far off, however exact the rest.
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
    left_out: npt.NDArray[np.bool_],
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
        # A bad fit must not shed most of its bins: no more than half lie beyond the median.
        limit = FARTHEST * (max(scale, 1.0) if is_variance else scale)
        for i in range(range_.size):
            far = deviation[i] > limit
            changed[k] = changed[k] or far != left_out[k, i]
            left_out[k, i] = far
