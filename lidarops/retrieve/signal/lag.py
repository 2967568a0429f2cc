"""The lag between analog and photon counting of one detector: estimate and correction."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import special

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Booleans, Indices, Integers, frozen
from lidarops.retrieve.common.compiled_code import compiled, summing
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.signal.thresholds import THRESHOLDS

_PARTS: Final = 16
"""Parts of the range in the jackknife estimate of the standard error."""
_MARGIN: Final = 2
"""Additional lags on either side, for the neighbours of a peak."""
_REACH: Final = THRESHOLDS.largest_lag + _MARGIN
_LAGS: Final = np.arange(-_REACH, _REACH + 1)
PROFILES_AT_ONCE: Final = 32
"""Profiles of a group with a mean of its own, from which noise is taken. In a group of n, a
profile keeps 1 - 1/n of its noise."""


@dataclass(frozen=True, slots=True)
class ChannelLag:
    """Lag of the analog signal behind photon counting, known or estimated."""

    bins: float = 0.0
    """Positive where analog shows a cloud farther than photon counting. NaN without any
    correlation."""
    standard_error: float = math.nan
    """Bins: scatter of parts of the range, and the systematic error by the peak's width. NaN where
    the lag is not estimated."""
    confidence: float = math.nan
    """Probability that noise without a common cause has no peak as high as that of the estimate."""
    significant: bool = False
    """Whether it is estimated, with a confidence of at least 99.9 %, a standard error of less than
    2 bins, and a peak that is not at the largest lag."""


def profile_groups(profiles: int) -> list[slice]:
    """Return groups of about equal size, of at most 32 profiles, from which noise is taken."""
    groups = max(-(-profiles // PROFILES_AT_ONCE), 1)
    edges = np.linspace(0, profiles, groups + 1).astype(int)
    return [slice(int(first), int(last)) for first, last in itertools.pairwise(edges)]


def estimate_lag(groups: Iterable[tuple[Array, Array]]) -> ChannelLag:
    r"""Return the lag of analog behind photon counting from the correlation of their noise.

    Both record the same photoelectrons, so their shot noise is correlated at the lag and nowhere
    else. The noise of a profile is the profile minus the mean of up to 32 profiles, minus its
    running mean over 17 bins, divided by its standard deviation over 65 bins. A photoelectron at a
    lag between two bins contributes to both by its distance. With their correlations
    :math:`c_k, c_{k+1}`, corrected for the subtracted mean, the lag is

    .. math:: L = k + \frac{c_{k+1}}{c_k + c_{k+1}}

    for the highest correlation and the higher one of its neighbours.

    Parameters
    ----------
    groups : iterable of (analog, photon_counting)
        At least one, (time, range) each, of the profiles of one of `profile_groups`:
        simultaneous, on bins of the same width, in any unit, with or without background; NaN is
        skipped. One profile is enough if its noise is large enough.

    Returns
    -------
    ChannelLag
        The standard error includes the scatter and the distance to the centroid of 4 bins,
        because a recorder may ring or spread a photoelectron over more than two bins.

    Raises
    ------
    RetrievalInputError
        For fewer than 200 bins between the largest lags.
    """
    sums, energies = np.zeros((_PARTS, _LAGS.size)), np.zeros(2)
    for pair in groups:
        bins = pair[0].shape[-1]
        if not enough_bins(bins):
            raise RetrievalInputError(
                f"have {bins} bins for lags up to {THRESHOLDS.largest_lag}",
                field="analog",
                remedy="give all bins of the profiles",
            )
        first, second = (_noise(profiles) for profiles in pair)
        edges = np.linspace(_REACH, bins - _REACH, _PARTS + 1).astype(np.intp)
        of_group = np.zeros(sums.shape)
        _add_products(frozen(first), frozen(second), _REACH, edges, of_group)
        sums += of_group
        inner = (..., slice(_REACH, bins - _REACH))
        energies += [(noise[inner] ** 2).sum(axis=(-2, -1)) for noise in (first, second)]
    scale = np.sqrt(energies[0] * energies[1])
    by_part = sums / (scale if scale > 0 else np.inf)
    total = by_part.sum(axis=-2)
    lag, systematic, at_end = _peak(total)
    without = by_part.sum(axis=-2, keepdims=True) - by_part
    estimates = _peak(without)[0]
    # The jackknife over the parts of the range.
    deviation = estimates - estimates.mean()
    scatter = np.sqrt((deviation**2).sum(axis=-1) * (_PARTS - 1) / _PARTS)
    confidence, defined = _confidence(total, lag), bool(np.isfinite(lag))
    error = float(np.hypot(scatter, systematic)) if defined else math.nan
    significant = confidence >= 1.0 - COMMON.false_alarm and error < 0.5 * THRESHOLDS.peak_width
    return ChannelLag(float(lag), error, confidence, significant and not at_end)


def enough_bins(bins: int) -> bool:
    """Return whether profiles of as many bins allow an estimate of the lag."""
    return bins >= THRESHOLDS.fewest_lag_bins + 2 * _REACH


def _noise(profiles: Array) -> Array:
    """Return the noise of profiles over its standard deviation; 0 for gaps."""
    finite = np.isfinite(profiles)
    filled = np.where(finite, profiles, 0.0)
    if profiles.shape[-2] > 1:
        count = np.maximum(finite.sum(axis=-2, keepdims=True), 1)
        filled = np.where(finite, filled - filled.sum(axis=-2, keepdims=True) / count, 0.0)
        # With data of a single profile, a bin has no deviation from the mean.
        finite = finite & (count > 1)
    complete = bool(finite.all())
    present = np.ones((1, finite.shape[-1])) if complete else finite.astype(np.float64)
    bins = np.maximum(_box(present, THRESHOLDS.high_pass), 1.0)
    rough = np.where(finite, filled - _box(filled, THRESHOLDS.high_pass) / bins, 0.0)
    square = _box((rough**2).sum(axis=-2, keepdims=True), THRESHOLDS.variance_window)
    bins = _box(finite.sum(axis=-2, keepdims=True).astype(np.float64), THRESHOLDS.variance_window)
    deviation = np.sqrt(square / np.maximum(bins, 1.0))
    floor = 1e-12 * np.max(deviation, axis=-1, keepdims=True, initial=0.0)
    scaled = np.where(deviation > floor, rough / np.where(deviation > floor, deviation, 1.0), 0.0)
    return np.clip(scaled, -COMMON.single_bin, COMMON.single_bin)


def _box(values: Array, window: int) -> Array:
    """Return sums over that many bins, with 0 beyond the ends."""
    half = window // 2
    total = values.copy()
    for shift in np.arange(1, half + 1):
        total[..., shift:] += values[..., :-shift]
        total[..., :-shift] += values[..., shift:]
    return total


@summing
def _product(first: Any, second: Any) -> float:
    total = 0.0
    for i in range(second.size):
        total += first[i] * second[i]
    return total


@compiled
def _add_products(
    first: Array,
    second: Array,
    reach: int,
    edges: Indices,
    sums: Array,
) -> None:
    """Add the products of `second` and of `first` shifted by each lag, by parts of the range.

    Parameters
    ----------
    first, second : (time, bin) float64
    reach : int
        Largest lag to either side, in bins.
    edges : (part + 1,) int
        Bins of `second` where the parts begin and end, at least `reach` from both ends.
    sums : (part, lag) float64
        The sums to which the products are added.
    """
    for t in range(first.shape[0]):
        x, y = first[t], second[t]
        for p in range(edges.size - 1):
            segment = y[edges[p] : edges[p + 1]]
            for j in range(2 * reach + 1):
                start = edges[p] + j - reach
                sums[p, j] += _product(x[start : start + segment.size], segment)


def _peak(total: Array) -> tuple[Array, Array, Booleans]:
    """Return the lag, its distance to the centroid of four bins, and whether it is the largest."""
    index = np.argmax(total[..., _MARGIN:-_MARGIN], axis=-1) + _MARGIN

    def at(shift: int | Integers) -> Array:
        return np.take_along_axis(total, np.asarray(index + shift)[..., np.newaxis], -1)[..., 0]

    side = np.where(at(1) >= at(-1), 1, -1)
    peak, beside = _correct_for_high_pass(at(0), at(side))
    outside = at(-side), at(2 * side)
    sum_of_two = peak + beside
    base = sum_of_two / THRESHOLDS.high_pass
    sum_of_four = sum_of_two + outside[0] + outside[1] + 2.0 * base
    with np.errstate(invalid="ignore", divide="ignore"):
        fraction = np.clip(beside / sum_of_two, 0.0, 1.0)
        moment = beside - (outside[0] + base) + 2.0 * (outside[1] + base)
        systematic = np.minimum(np.abs(moment / sum_of_four - fraction), 1.0)
        lag = np.where(sum_of_two > 0, _LAGS[index] + side * fraction, np.nan)
    ends = (index == _MARGIN) | (index == _LAGS.size - 1 - _MARGIN)
    return lag, systematic, ends


def _correct_for_high_pass(peak: Array, beside: Array) -> tuple[Array, Array]:
    """Return two neighbouring correlations corrected for the subtracted running mean."""
    peak_response, side_response = (
        1.0 - 1.0 / THRESHOLDS.high_pass,
        -1.0 / THRESHOLDS.high_pass - 1.0 / THRESHOLDS.high_pass**2,
    )
    determinant = peak_response**2 - side_response**2
    return (
        (peak_response * peak - side_response * beside) / determinant,
        (peak_response * beside - side_response * peak) / determinant,
    )


def _confidence(total: Array, lag: Array) -> float:
    """Return the probability that the highest of as many random correlations is lower."""
    far = np.abs(_LAGS - lag) > THRESHOLDS.peak_width
    tried = _LAGS.size - 2 * _MARGIN
    # The spread of the others is smaller because the highest of all is not among them.
    count = np.maximum(far.sum() + 1.0 - special.ndtri(0.5 / tried) ** 2, 1.0)
    # The spread of the others includes noise correlated along range, and interference.
    noise = np.sqrt(np.where(far, total**2, 0.0).sum(axis=-1) / count)
    if not (np.isfinite(lag) and noise > 0):
        return 0.0
    height = total[_MARGIN:-_MARGIN].max() / noise
    return float(np.exp(tried * special.log_ndtr(height)))


def shift_signal(
    profile: npt.ArrayLike, lag: float, *, variance: npt.ArrayLike = np.nan
) -> tuple[Array, Array]:
    r"""Return a signal shifted by `lag` bins towards the lidar, and its variance.

    .. math:: P'_i = P(i + L) = \sum_j c_j P_{i + \lfloor L \rfloor + j}, \qquad
              v'_i = \sum_j c_j^2 v_{i + \lfloor L \rfloor + j}

    with the weights of linear interpolation between the 2 bins on either side.

    Parameters
    ----------
    profile : (..., range) float
    lag : float
        Bins.
    variance : (..., range) float, optional
        Variance of noise that is independent from bin to bin; broadcast. NaN where not given.

    Returns
    -------
    shifted : (..., range) float
        NaN where the source lies beyond the ends or in a gap.
    variance : (..., range) float
        A shift by a fraction of a bin correlates the noise of neighbouring bins and reduces that
        of a bin.

    Raises
    ------
    RetrievalInputError
        For a lag that is not finite, or shapes that do not match.
    """
    values = inputs.real_array(profile, "profile").astype(np.float64, copy=False)
    if values.ndim == 0:
        raise RetrievalInputError("is a single number", field="profile")
    if not math.isfinite(lag):
        raise RetrievalInputError("is not finite", field="lag")
    noise = inputs.real_array(variance, "variance").astype(np.float64, copy=False)
    noise = inputs.broadcast(noise, values.shape, "variance")
    shifted, variances = np.zeros((2, *values.shape))
    whole_bins = math.floor(lag)
    fraction = lag - whole_bins
    for offset, weight in enumerate((1.0 - fraction, fraction)):
        # NaN times a weight of 0 must not reach the sum.
        if weight != 0.0:
            _add_shifted(values, whole_bins + offset, weight, shifted)
            _add_shifted(noise, whole_bins + offset, weight**2, variances)
    missing = ~np.isfinite(shifted)
    shifted[missing] = np.nan
    variances[missing] = np.nan
    return shifted, variances


def _add_shifted(values: Array, whole_bins: int, weight: float, total: Array) -> None:
    bins = values.shape[-1]
    first, past = min(max(-whole_bins, 0), bins), max(min(bins - whole_bins, bins), 0)
    total[..., :first] = np.nan
    total[..., past:] = np.nan
    if first < past:
        total[..., first:past] += weight * values[..., first + whole_bins : past + whole_bins]
