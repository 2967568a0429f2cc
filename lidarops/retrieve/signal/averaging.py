"""Weighted means over time that propagate variances and skip gaps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.frozen_arrays import frozen

Array = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]

_HUGE: Final = 1e300

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True, slots=True)
class Averages:
    """Means with their variances by independent noise and by shared errors."""

    values: Array
    """In the unit of the profiles; NaN where no value was finite."""
    variance: Array
    """Variance of the mean by noise that is independent from profile to profile."""
    shared_variance: Array
    """Variance of the mean by errors that all averaged profiles have in common."""
    count: Counts
    """Number of finite values in each mean."""
    weight: Array
    """Sum of the weights of these values."""

    @property
    def standard_error(self) -> Array:
        """Square root of the sum of both variances."""
        root: Array = np.sqrt(self.variance + self.shared_variance)
        return root


def time_mean(
    profiles: npt.ArrayLike,
    variance: npt.ArrayLike,
    *,
    groups: npt.ArrayLike | None = None,
    weights: npt.ArrayLike | None = None,
    shared_variance: npt.ArrayLike | None = None,
    axis: int = -2,
) -> Averages:
    r"""Return weighted means of profiles over time, bin by bin.

    .. math:: \bar P = \frac{\sum_t w_t P_t}{\sum_t w_t}, \qquad
              v = \frac{\sum_t w_t^2 v_t}{(\sum_t w_t)^2}, \qquad
              s = \left(\frac{\sum_t w_t \sqrt{s_t}}{\sum_t w_t}\right)^2

    over the finite :math:`P_t` of a bin, in the order of time. The weights must not depend on the
    noise: numbers of shots do not, inverse variances of the counts do.

    Parameters
    ----------
    profiles : (..., time, range) float
        NaN is a gap.
    variance : (..., time, range) float
        Noise variance, independent from profile to profile; broadcast against `profiles`. Where
        it is NaN, that of the mean is NaN.
    groups : (time,) int, optional
        Number of the mean to which each profile belongs, from 0; negative for none. Where not
        given, there is one mean of all profiles.
    weights : (..., time) float, optional
        Number of shots of each profile; broadcast. A profile of weight 0 is a gap.
    shared_variance : (..., time, range) float, optional
        Variance of errors that the profiles have in common, such as that of a subtracted dark
        profile; broadcast. It does not average down.
    axis : int
        The time axis.

    Returns
    -------
    Averages
        (..., group, range), with the groups on the time axis; one group for every number from 0
        to the largest one. Chunks along the other axes do not change a bit of the result.

    Raises
    ------
    RetrievalInputError
        For shapes that do not match, and negative weights or variances.
    """
    values = inputs.real_array(profiles, "profiles")
    if not -values.ndim <= axis < values.ndim:
        raise RetrievalInputError(
            f"is {axis}, but profiles have the shape {values.shape}", field="axis"
        )
    axis %= values.ndim
    group = _checked_groups(groups, values.shape[axis])
    before, after = values.shape[:axis], values.shape[axis + 1 :]
    number = int(group.max(initial=0)) + 1
    sums = np.zeros((4, math.prod(before), number, math.prod(after)))
    count = np.zeros(sums.shape[1:], dtype=np.int64)
    _add(sums, count, values, variance, shared_variance, weights, group, axis)
    return _averages(sums, count, (*before, number, *after))


def _add(
    sums: Array,
    count: Counts,
    values: inputs.Floats,
    variance: npt.ArrayLike,
    shared: npt.ArrayLike | None,
    weights: npt.ArrayLike | None,
    group: npt.NDArray[np.intp],
    axis: int = 0,
) -> None:
    """Add profiles to the sums of their groups, (4, before, group, after)."""
    whole = values.shape
    shape = (math.prod(whole[:axis]), whole[axis], math.prod(whole[axis + 1 :]))
    shared, weights = 0.0 if shared is None else shared, 1.0 if weights is None else weights
    _add_profiles(
        frozen(values.reshape(shape)),
        _flat_term(variance, "variance", whole, shape, axis),
        _flat_term(shared, "shared_variance", whole, shape, axis),
        _flat_term(weights, "weights", whole[: axis + 1], shape[:2], axis),
        frozen(group),
        sums,
        count,
    )


def _averages(sums: Array, count: Counts, shape: tuple[int, ...]) -> Averages:
    """Turn sums into means, in place."""
    total, value, noise, systematic = sums
    with np.errstate(invalid="ignore", divide="ignore"):
        value /= total
        noise /= total**2
        systematic /= total
        systematic **= 2
    for means in (value, noise, systematic):
        means[count == 0] = np.nan
    return Averages(
        value.reshape(shape),
        noise.reshape(shape),
        systematic.reshape(shape),
        count.reshape(shape),
        total.reshape(shape),
    )


class RunningMean:
    """Weighted means of groups of profiles that come one after another.

    Equal to the last bit to `time_mean` of all profiles together, because profiles are added one
    by one in both.

    Parameters
    ----------
    shape : (int, int)
        Number of groups, and of bins.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._sums = np.zeros((4, 1, *shape))
        self._count = np.zeros((1, *shape), dtype=np.int64)

    def add(
        self,
        profiles: Array,
        variance: Array,
        *,
        groups: npt.NDArray[np.intp],
        weights: Array,
        shared_variance: Array | None = None,
    ) -> None:
        """Add profiles, (time, range), to their groups.

        Parameters
        ----------
        profiles, variance, shared_variance : (time, range) float
            As for `time_mean`.
        groups : (time,) int
            Number of the mean to which each profile belongs.
        weights : (time,) float
            Number of shots of each profile.
        """
        group = np.ascontiguousarray(groups, dtype=np.intp)
        _add(self._sums, self._count, profiles, variance, shared_variance, weights, group)

    def averages(self) -> Averages:
        """Return the means of what was added; no more can be added."""
        return _averages(self._sums, self._count, self._count.shape[1:])


def _flat_term(
    values: npt.ArrayLike, name: str, shape: tuple[int, ...], flat: tuple[int, ...], axis: int
) -> Array:
    """Return a term that broadcasts to `shape` as `flat`, with length 1 along constant axes."""
    array = inputs.real_array(values, name).astype(np.float64, copy=False)
    if np.any(array < 0):
        raise RetrievalInputError("is negative", field=name)
    padded = (1,) * (len(shape) - array.ndim) + array.shape
    outer = 1 if math.prod(padded[:axis]) == 1 else flat[0]
    length = 1 if padded[axis] == 1 else flat[1]
    varying = (
        *((1,) * axis if outer == 1 else shape[:axis]),
        1 if length == 1 else shape[axis],
        *shape[axis + 1 :],
    )
    try:
        full = np.broadcast_to(array, varying)
    except ValueError:
        raise RetrievalInputError(
            f"has the shape {array.shape}, which does not broadcast to {shape}", field=name
        ) from None
    return frozen(full.reshape(outer, length, *flat[2:]))


def _checked_groups(groups: npt.ArrayLike | None, length: int) -> npt.NDArray[np.intp]:
    if groups is None:
        return np.zeros(length, dtype=np.intp)
    group = np.asarray(groups)
    if group.dtype.kind not in "iu" or group.shape != (length,):
        raise RetrievalInputError(
            f"hold {group.dtype} of the shape {group.shape}",
            field="groups",
            remedy=f"give one whole number for each of the {length} profiles",
        )
    return np.ascontiguousarray(group, dtype=np.intp)


@_compiled
def _add_profile(
    values: Any,
    variance: Array,
    shared: Array,
    weight: float,
    sums: tuple[Array, Array, Array, Array],
    count: npt.NDArray[np.int64],
) -> None:
    total, value, noise, systematic = sums
    for i in range(values.size):
        x = np.float64(values[i])
        valid = abs(x) < _HUGE
        total[i] += weight if valid else 0.0
        value[i] += weight * x if valid else 0.0
        noise[i] += weight * weight * variance[i] if valid else 0.0
        systematic[i] += weight * math.sqrt(shared[i]) if valid else 0.0
        count[i] += 1 if valid else 0


@_compiled
def _add_profiles(
    values: Any,
    variance: Array,
    shared: Array,
    weights: Array,
    group: npt.NDArray[np.intp],
    sums: Array,
    count: npt.NDArray[np.int64],
) -> None:
    """Add each profile to the sums of its group.

    Parameters
    ----------
    values : (outer, time, inner) float32 or float64
        Values that are not finite are skipped.
    variance, shared : (outer or 1, time or 1, inner) float64
    weights : (outer or 1, time or 1) float64
        A profile is skipped where it is not positive.
    group : (time,) int
        A profile is skipped where it is negative.
    sums : (4, outer, group, inner) float64
        Input and output: sums of weights, of weighted values, of squared weights times variance,
        and of weighted roots of the shared variance.
    count : (outer, group, inner) int64
        Input and output: number of finite values.
    """
    for k in range(values.shape[0]):
        for t in range(values.shape[1]):
            weight, g = weights[k % weights.shape[0], t % weights.shape[1]], group[t]
            if g < 0 or not 0.0 < weight < _HUGE:
                continue
            group_sums = (sums[0, k, g], sums[1, k, g], sums[2, k, g], sums[3, k, g])
            profile_variance = variance[k % variance.shape[0], t % variance.shape[1]]
            profile_shared = shared[k % shared.shape[0], t % shared.shape[1]]
            _add_profile(
                values[k, t], profile_variance, profile_shared, weight, group_sums, count[k, g]
            )
