"""Weighted means over time, and parts of a mean that hold what the rest of it does not.

The means propagate variances and skip gaps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import HUGE, Array, Booleans, Indices, Integers, frozen
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.signal.noise_correlation import estimate_noise_correlation
from lidarops.retrieve.signal.thresholds import THRESHOLDS


@dataclass(frozen=True, slots=True)
class Averages:
    """Means with their variances by independent noise and by shared errors, (group, range)."""

    values: Array
    """In the unit of the profiles; NaN where no value was finite."""
    variance: Array
    """Variance of the mean by noise that is independent from profile to profile."""
    shared_variance: Array
    """Variance of the mean by errors that all averaged profiles have in common."""


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
        shape = np.shape(groups)[0], self._count.shape[1]
        values = _term(profiles, "profiles", shape, negative=True)
        _add_profiles(
            values,
            _term(variance, "variance", values.shape),
            _term(shared_variance, "shared_variance", values.shape),
            _term(weights, "weights", values.shape[:1]),
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
    return Averages(value, noise, systematic)


def _term(
    values: npt.ArrayLike, name: str, shape: tuple[int, ...], *, negative: bool = False
) -> Array:
    """Return values that broadcast to a shape, in that shape."""
    array = inputs.real_array(values, name).astype(np.float64, copy=False)
    if not negative and np.any(array < 0):
        raise RetrievalInputError("is negative", field=name)
    return frozen(inputs.broadcast(array, shape, name))


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


_SIGNS: Final = (1.0, -1.0)

_CONTRAST_WAVELENGTH: Final = 532e-9
"""m; wavelength of `Thresholds.cloud_contrast`."""


@dataclass(frozen=True, slots=True)
class PartCells:
    """Means of consecutive bins, (..., cell)."""

    power: Array
    """NaN where less than half of the bins have data."""
    variance: Array
    quantum: Array
    """(...): the power of a cell with a single count; 0 where nothing is counted."""


def cloud_contrast(wavelength: float) -> float:
    """Return the least contrast of a cloud, that of the same aerosol at each wavelength.

    Over air, aerosol of an Angstrom exponent of 1 scales with lambda^3.

    Parameters
    ----------
    wavelength : float
        m.
    """
    scaled = (wavelength / _CONTRAST_WAVELENGTH) ** 3
    return 1.0 + (THRESHOLDS.cloud_contrast - 1.0) * scaled


def skewness_margin(quantile: Array | float) -> Array:
    r"""Return the counts by which those of few counts exceed a quantile of the normal distribution.

    The Cornish-Fisher expansion of a Poisson distribution, of skewness :math:`N^{-1/2}`, gives
    :math:`(t^2 - 1) / 6` counts more than :math:`t \sqrt N`.
    """
    return np.asarray((np.square(quantile) - 1.0) / 6.0)


def cells_of_parts(
    sums: Array, usable: Booleans, first: int, past: int, bins: int
) -> tuple[Array, Array]:
    """Return power and variance of means over cells of a number of bins, (part, cell).

    The power is NaN where less than half of the bins have data.

    Parameters
    ----------
    sums : (4, part, range) float
        Of `lidarops.retrieve.signal.averaging.RunningMean`.
    usable : (part, range) bool
    first, past : int
        Bins from and before which cells lie; bins that are left over at the end are left out.
    bins : int
    """
    shape = sums.shape[1], (past - first) // bins
    power, variance = np.empty(shape), np.empty(shape)
    _fill_cells(frozen(sums), frozen(usable), first, bins, power, variance)
    return power, variance


def tail_of_cells(power: Array, variance: Array) -> tuple[Array, Array]:
    """Return the mean of the last tenth of the cells and its error, (part, 1): the background."""
    tail = slice(-max(power.shape[1] // 10, 1), None)
    known = np.isfinite(power[:, tail])
    count = np.maximum(known.sum(axis=1, keepdims=True), 1)
    mean = np.where(known, power[:, tail], 0.0).sum(axis=1, keepdims=True) / count
    noise = np.where(known, variance[:, tail], 0.0).sum(axis=1, keepdims=True)
    return mean, np.sqrt(noise) / count


@compiled
def _fill_cells(
    sums: Array, usable: Booleans, first: int, bins: int, power: Array, variance: Array
) -> None:
    for part in range(power.shape[0]):
        for cell in range(power.shape[1]):
            signal = noise = 0.0
            count = 0
            begin = first + cell * bins
            for i in range(max(begin, 0), min(begin + bins, sums.shape[2])):
                total = sums[0, part, i]
                if total > 0.0 and usable[part, i]:
                    share = 1.0 / total
                    shared = sums[3, part, i] * share
                    signal += sums[1, part, i] * share
                    noise += sums[2, part, i] * share * share + shared * shared
                    count += 1
            known = 2 * count >= bins and count > 0
            power[part, cell] = signal / count if known else np.nan
            variance[part, cell] = noise / (count * count) if known else np.nan


def outlying_parts(cells: PartCells, compared: slice, *, contrast: float) -> Booleans:
    r"""Return the parts in which a cell exceeds that cell in all other parts by more than a factor.

    Let :math:`x_1 \ge x_2 \ge \dots` be the signals of one cell in the :math:`n` parts. The first
    :math:`k \le n / 5` are outlying where

    .. math:: \frac{x_k - c \max(x_{k+1}, 0)}{\sqrt{\sigma_k^2 + c^2 \sigma_{k+1}^2}} > t.

    This tests the hypothesis that the light of the cell differs by no more than the factor
    :math:`c` from part to part, whatever the aerosol and its drift. If that holds everywhere, a
    part is outlying with a probability below `Thresholds.false_alarm` for each mean:
    :math:`t` is the quantile of the normal distribution for that rate over the number of cells and
    parts (Bonferroni bound), with a margin for few counts (`skewness_margin`). The same test of
    :math:`-x` finds signals below zero. Noise that exceeds the stated one in the far half of a
    part raises its :math:`\sigma` (`lidarops.retrieve.signal.noise_correlation`).

    Where more than a fifth of the parts are outlying in one cell or another, or there are fewer
    than 5, none is: what is rare is then not told from what is common.

    Parameters
    ----------
    cells : PartCells
        (part, cell), background subtracted.
    compared : slice
        The cells that are compared; the noise is that of the far half of all.
    contrast : float
        The factor :math:`c`, at least 1.

    Returns
    -------
    (part,) bool
    """
    count, size = cells.power[:, compared].shape
    outlying = np.zeros(count, dtype=np.bool_)
    most = count // COMMON.fewest_profiles
    if not most:
        return outlying
    excess = estimate_noise_correlation(cells.power, cells.variance).excess
    least = -float(ndtri(COMMON.false_alarm / (len(_SIGNS) * count * size)))
    margin = float(skewness_margin(least)) * cells.quantum
    power, variance = cells.power[:, compared], cells.variance[:, compared]
    whole = np.isfinite(power + variance).all(axis=0)
    for sign in _SIGNS:
        signal, noise = sign * power[:, whole], variance[:, whole]
        largest = np.argsort(-signal, axis=0, kind="stable")
        for k in range(1, most + 1):
            high, low = largest[k - 1 : k], largest[k : k + 1]
            above = np.take_along_axis(signal, high, 0) - margin[high]
            above -= contrast * np.maximum(np.take_along_axis(signal, low, 0), 0.0)
            square = excess[high] * np.take_along_axis(noise, high, 0)
            square += contrast * contrast * excess[low] * np.take_along_axis(noise, low, 0)
            outlying[largest[:k, (above > least * np.sqrt(square))[0]]] = True
    return outlying if outlying.sum() <= most else np.zeros_like(outlying)
