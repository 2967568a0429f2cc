"""Weighted means over time that propagate variances and skip gaps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import HUGE, Array, Booleans, Indices, Integers, frozen
from lidarops.retrieve.common.compiled_code import compiled


@dataclass(frozen=True, slots=True)
class Averages:
    """Means with their variances by independent noise and by shared errors, (group, range)."""

    values: Array
    """In the unit of the profiles; NaN where no value was finite."""
    variance: Array
    """Variance of the mean by noise that is independent from profile to profile."""
    shared_variance: Array
    """Variance of the mean by errors that all averaged profiles have in common."""
    count: Integers
    """Number of finite values in each mean."""


class RunningMean:
    r"""Weighted means over time of groups of profiles, bin by bin.

    .. math:: \bar P = \frac{\sum_t w_t P_t}{\sum_t w_t}, \qquad
              v = \frac{\sum_t w_t^2 v_t}{(\sum_t w_t)^2}, \qquad
              s = \left(\frac{\sum_t w_t \sqrt{s_t}}{\sum_t w_t}\right)^2

    over the finite :math:`P_t` of a bin, in the order of time. The weights must not depend on the
    noise: numbers of shots do not, inverse variances of the counts do. Profiles are added one by
    one, so that chunks of them do not change a bit of the result.

    Parameters
    ----------
    shape : (int, int)
        Number of groups, and of bins.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._sums = np.zeros((4, *shape))
        self._count = np.zeros(shape, dtype=np.int64)

    def add(
        self,
        profiles: npt.ArrayLike,
        variance: npt.ArrayLike,
        *,
        groups: npt.ArrayLike,
        weights: npt.ArrayLike = 1.0,
        shared_variance: npt.ArrayLike = 0.0,
    ) -> None:
        """Add profiles to their groups.

        Parameters
        ----------
        profiles : (time, range) float
            NaN is a gap.
        variance : (time, range) float
            Noise variance, independent from profile to profile; broadcast against `profiles`.
            Where it is NaN, that of the mean is NaN.
        groups : (time,) int
            Number of the mean to which each profile belongs, from 0; negative for none.
        weights : (time,) float
            Number of shots of each profile; broadcast. A profile of weight 0 is a gap.
        shared_variance : (time, range) float
            Variance of errors that the profiles have in common, such as that of a subtracted dark
            profile; broadcast. It does not average down.

        Raises
        ------
        RetrievalInputError
            For shapes that do not match, and negative weights or variances.
        """
        values = _term(profiles, "profiles", (np.shape(groups)[0], self._count.shape[1]))
        _add_profiles(
            values,
            _positive(variance, "variance", values.shape),
            _positive(shared_variance, "shared_variance", values.shape),
            _positive(weights, "weights", values.shape[:1]),
            frozen(np.asarray(groups, dtype=np.intp)),
            self._sums,
            self._count,
        )

    def averages(self) -> Averages:
        """Return the means of what was added; once, because the sums become the means."""
        sums = self._sums
        del self._sums
        return _averages(sums, self._count)

    def joined(self, groups: Booleans) -> Averages:
        """Return the means of all values of some groups, (1, range), from their sums."""
        sums, count = self._sums, self._count
        if not groups.all():
            sums, count = sums[:, groups], count[groups]
        return _averages(sums.sum(axis=1, keepdims=True), count.sum(axis=0, keepdims=True))

    @property
    def sums(self) -> Array:
        """(4, group, range), in the order of the fractions above: denominator, numerators."""
        return self._sums


def _averages(sums: Array, count: Integers) -> Averages:
    """Return the means that follow from sums, in whose memory they come to lie."""
    total, value, noise, systematic = sums
    with np.errstate(invalid="ignore", divide="ignore"):
        value /= total
        noise /= total**2
        systematic /= total
        systematic **= 2
    for means in (value, noise, systematic):
        means[count == 0] = np.nan
    return Averages(value, noise, systematic, count)


def _term(values: npt.ArrayLike, name: str, shape: tuple[int, ...]) -> Array:
    """Return values that broadcast to a shape, in that shape."""
    array = inputs.real_array(values, name).astype(np.float64, copy=False)
    return frozen(inputs.broadcast(array, shape, name))


def _positive(values: npt.ArrayLike, name: str, shape: tuple[int, ...]) -> Array:
    """Return `_term`, of values that are not negative."""
    array = _term(values, name, shape)
    if np.any(array < 0):
        raise RetrievalInputError("is negative", field=name)
    return array


@compiled
def _add_profiles(
    values: Array,
    variance: Array,
    shared: Array,
    weights: Array,
    groups: Indices,
    sums: Array,
    count: Integers,
) -> None:
    """Add each profile to the sums of its group.

    Parameters
    ----------
    values, variance, shared : (time, bin) float64
        Values that are not finite are skipped.
    weights : (time,) float64
        A profile is skipped where it is not positive.
    groups : (time,) int
        A profile is skipped where it is negative.
    sums : (4, group, bin) float64
        Input and output: sums of weights, of weighted values, of squared weights times variance,
        and of weighted roots of the shared variance.
    count : (group, bin) int64
        Input and output: number of finite values.
    """
    for t in range(values.shape[0]):
        weight, group = weights[t], groups[t]
        if group < 0 or not 0.0 < weight < HUGE:
            continue
        total, value = sums[0, group], sums[1, group]
        noise, systematic, number = sums[2, group], sums[3, group], count[group]
        row, row_variance, row_shared = values[t], variance[t], shared[t]
        for i in range(row.size):
            x = row[i]
            valid = abs(x) < HUGE
            total[i] += weight if valid else 0.0
            value[i] += weight * x if valid else 0.0
            noise[i] += weight * weight * row_variance[i] if valid else 0.0
            systematic[i] += weight * math.sqrt(row_shared[i]) if valid else 0.0
            number[i] += 1 if valid else 0


@compiled
def join_bits(
    quality: npt.NDArray[np.int32],
    groups: Indices,
    passed: int,
    bits: npt.NDArray[np.int32],
) -> None:
    """Add the bits of profiles, (time, range), that are `passed`, to those of their groups."""
    for t in range(quality.shape[0]):
        row, of_group = quality[t], bits[groups[t]]
        for i in range(row.size):
            of_group[i] |= row[i] & passed
