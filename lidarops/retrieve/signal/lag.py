"""The lag between two recorders of one detector: its estimate from their noise, and its cure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import special

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.frozen_arrays import frozen
from lidarops.retrieve.signal import _cross_correlation

Array = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]

LARGEST_LAG: Final = 30
CONFIDENCE: Final = 0.999
"""Probability that a peak is none of chance from which on a lag counts as found."""
FEWEST_BINS: Final = 200
_HIGH_PASS: Final = 17
"""Bins over which the mean is subtracted: what is left is noise."""
_SCALE_WINDOW: Final = 65
"""Bins over which the size of the noise is taken."""
_CLIP: Final = 5.0
_PARTS: Final = 16
"""Parts of the range whose scatter tells the standard error."""
_AROUND: Final = 4
"""Bins about a peak that belong to it."""
_MARGIN: Final = 2


class LagInterpolation(StrEnum):
    """How a signal is read between its bins."""

    LINEAR = "linear"
    CUBIC = "cubic"


@dataclass(frozen=True, slots=True)
class LagEstimate:
    """How many bins the analog signal comes behind photon counting, one of each for a channel."""

    lag: Array
    """(...), bins; above 0 where analog shows a cloud farther than photon counting. NaN where
    nothing is correlated at all."""
    standard_error: Array
    """(...), bins: scatter of parts of the range, and what the width of the peak leaves open."""
    confidence: Array
    """(...): probability that noise without a common cause has no peak as high as this one."""
    found: Booleans
    """(...): the confidence is at least 99.9 % and the peak does not lie at the end of the lags
    tried."""
    correlation: Array
    """(..., lag): of the noise of both, at each of `lags`."""
    lags: npt.NDArray[np.int64]
    """(lag,), bins."""


def estimate_lag(
    analog: npt.ArrayLike,
    photon_counting: npt.ArrayLike,
    *,
    largest_lag: int = LARGEST_LAG,
    mask: npt.ArrayLike | None = None,
) -> LagEstimate:
    r"""Estimate the lag of analog behind photon counting by the correlation of their noise.

    Both record the same photoelectrons, so that their shot noise is correlated at the lag and
    nowhere else. Noise is what is left of each profile without the mean of all profiles and
    without its mean over 17 bins, over its own size in 65 bins. A photoelectron at a lag
    between two bins counts in both of them by its distance: with their correlations
    :math:`c_k, c_{k+1}`, freed from what the subtracted mean did to them, the lag is

    .. math:: L = k + \frac{c_{k+1}}{c_k + c_{k+1}}

    for the highest of all and the higher one of its neighbours.

    Parameters
    ----------
    analog, photon_counting : (..., time, range) float
        Simultaneous, on bins of the same width, in any unit, with their background or without;
        NaN is passed over. One profile will do where its noise is large enough.
    largest_lag : int
        Bins, to both sides.
    mask : (..., range) bool, optional
        True where a bin of photon counting may be used; broadcast against the profiles without
        time. Leave out the nearest bins where light is scattered in the system.

    Returns
    -------
    LagEstimate
        The standard error holds the scatter and, because a recorder may spread a photoelectron
        over more than two bins or swing through, the distance to the centroid of 4 bins.

    Raises
    ------
    RetrievalInputError
        For arguments that do not fit each other, or fewer than 200 bins between the largest
        lags.
    """
    first, second = _pair(analog, photon_counting)
    if largest_lag != int(largest_lag) or largest_lag < _AROUND:
        raise RetrievalInputError(
            f"is {largest_lag}", field="largest_lag", remedy=f"choose {_AROUND} bins or more"
        )
    bins = first.shape[-1]
    reach = int(largest_lag) + _MARGIN
    if bins < FEWEST_BINS + 2 * reach:
        raise RetrievalInputError(
            f"have {bins} bins for lags up to {largest_lag}",
            field="analog",
            remedy="give all bins of the profiles, or a smaller largest_lag",
        )
    allowed = _allowed(mask, first.shape)
    lags = np.arange(-reach, reach + 1)
    sums = _correlate(_noise(first), np.where(allowed, _noise(second), 0.0), reach)
    total = sums.sum(axis=-2)
    lag, systematic, at_end = _peak(total, lags)
    scatter = _jackknife(sums, lags)
    confidence = _confidence(total, lags, lag)
    lost = ~np.isfinite(lag)
    return LagEstimate(
        lag=lag,
        standard_error=np.where(lost, np.nan, np.hypot(scatter, systematic)),
        confidence=confidence,
        found=(confidence >= CONFIDENCE) & ~lost & ~at_end,
        correlation=total[..., _MARGIN:-_MARGIN],
        lags=lags[_MARGIN:-_MARGIN],
    )


def _pair(analog: npt.ArrayLike, photon_counting: npt.ArrayLike) -> tuple[Array, Array]:
    first = inputs.real_array(analog, "analog").astype(np.float64, copy=False)
    second = inputs.real_array(photon_counting, "photon_counting").astype(np.float64, copy=False)
    if first.ndim < 2:
        raise RetrievalInputError(
            f"has the shape {first.shape}", field="analog", remedy="give (..., time, range)"
        )
    if first.shape != second.shape:
        raise RetrievalInputError(
            f"has the shape {second.shape}, analog {first.shape}", field="photon_counting"
        )
    return first, second


def _allowed(mask: npt.ArrayLike | None, shape: tuple[int, ...]) -> Booleans:
    if mask is None:
        return np.ones((1, shape[-1]), dtype=bool)
    allowed = np.asarray(mask)
    if allowed.dtype != np.bool_:
        raise RetrievalInputError(
            f"holds {allowed.dtype}", field="mask", remedy="give True where a bin may be used"
        )
    try:
        return np.broadcast_to(allowed, (*shape[:-2], shape[-1]))[..., np.newaxis, :]
    except ValueError:
        raise RetrievalInputError(
            f"has the shape {allowed.shape}, which does not broadcast to"
            f" {(*shape[:-2], shape[-1])}",
            field="mask",
        ) from None


def _noise(profiles: Array) -> Array:
    """Return what varies from profile to profile and from bin to bin, over its size; 0 for gaps."""
    finite = np.isfinite(profiles)
    filled = np.where(finite, profiles, 0.0)
    if profiles.shape[-2] > 1:
        count = np.maximum(finite.sum(axis=-2, keepdims=True), 1)
        filled = np.where(finite, filled - filled.sum(axis=-2, keepdims=True) / count, 0.0)
        # A profile that is the only one to have a bin has no noise to show there.
        finite = finite & (count > 1)
    whole = bool(finite.all())
    seen = np.ones((1, finite.shape[-1])) if whole else finite.astype(np.float64)
    number = np.maximum(_box(seen, _HIGH_PASS), 1.0)
    rough = np.where(finite, filled - _box(filled, _HIGH_PASS) / number, 0.0)
    power = _box((rough**2).sum(axis=-2, keepdims=True), _SCALE_WINDOW)
    number = _box(finite.sum(axis=-2, keepdims=True).astype(np.float64), _SCALE_WINDOW)
    size = np.sqrt(power / np.maximum(number, 1.0))
    floor = 1e-12 * np.max(size, axis=-1, keepdims=True, initial=0.0)
    scaled = np.where(size > floor, rough / np.where(size > floor, size, 1.0), 0.0)
    return np.clip(scaled, -_CLIP, _CLIP)


def _box(values: Array, window: int) -> Array:
    """Sum over so many bins, those beyond the ends as 0."""
    half = window // 2
    total = values.copy()
    for shift in np.arange(1, half + 1):
        total[..., shift:] += values[..., :-shift]
        total[..., :-shift] += values[..., shift:]
    return total


def _correlate(first: Array, second: Array, reach: int) -> Array:
    """Return the correlation at each lag by parts of the range, (..., part, lag), that add up."""
    *leading, times, bins = first.shape
    flat = (math.prod(leading), times, bins)
    edges = np.linspace(reach, bins - reach, _PARTS + 1).astype(np.intp)
    sums = np.zeros((flat[0], _PARTS, 2 * reach + 1))
    _cross_correlation.add_products(
        frozen(first.reshape(flat)), frozen(second.reshape(flat)), reach, edges, sums
    )
    inner = (..., slice(reach, bins - reach))
    energy = (first[inner] ** 2).sum(axis=(-2, -1)) * (second[inner] ** 2).sum(axis=(-2, -1))
    scale = np.sqrt(energy)[..., np.newaxis, np.newaxis]
    by_part: Array = sums.reshape(*leading, *sums.shape[1:]) / np.where(scale > 0, scale, np.inf)
    return by_part


def _peak(total: Array, lags: npt.NDArray[np.int64]) -> tuple[Array, Array, Booleans]:
    """Return the lag, its distance to the centroid of four bins, and whether it lies at an end."""
    place = np.argmax(total[..., _MARGIN:-_MARGIN], axis=-1) + _MARGIN

    def at(shift: int | npt.NDArray[np.int64]) -> Array:
        return np.take_along_axis(total, np.asarray(place + shift)[..., np.newaxis], -1)[..., 0]

    side = np.where(at(1) >= at(-1), 1, -1)
    peak, beside = _undo(at(0), at(side))
    outside = at(-side), at(2 * side)
    both = peak + beside
    base = both / _HIGH_PASS
    four = both + outside[0] + outside[1] + 2.0 * base
    with np.errstate(invalid="ignore", divide="ignore"):
        part = np.clip(beside / both, 0.0, 1.0)
        moment = beside - (outside[0] + base) + 2.0 * (outside[1] + base)
        systematic = np.minimum(np.abs(moment / four - part), 1.0)
        lag = np.where(both > 0, lags[place] + side * part, np.nan)
    ends = (place == _MARGIN) | (place == lags.size - 1 - _MARGIN)
    return lag, systematic, ends


def _undo(peak: Array, beside: Array) -> tuple[Array, Array]:
    """Return two neighbouring correlations as they were before the mean was subtracted."""
    own, other = 1.0 - 1.0 / _HIGH_PASS, -1.0 / _HIGH_PASS - 1.0 / _HIGH_PASS**2
    determinant = own**2 - other**2
    return (
        (own * peak - other * beside) / determinant,
        (own * beside - other * peak) / determinant,
    )


def _jackknife(sums: Array, lags: npt.NDArray[np.int64]) -> Array:
    """Return the standard error of the lag from leaving out one part of the range at a time."""
    without = sums.sum(axis=-2, keepdims=True) - sums
    each = _peak(without, lags)[0]
    off = each - each.mean(axis=-1, keepdims=True)
    scatter: Array = np.sqrt((off**2).sum(axis=-1) * (_PARTS - 1) / _PARTS)
    return scatter


def _confidence(total: Array, lags: npt.NDArray[np.int64], lag: Array) -> Array:
    """Return the probability that the highest of so many correlations by chance is lower."""
    far = np.abs(lags - lag[..., np.newaxis]) > _AROUND
    tried = lags.size - 2 * _MARGIN
    # The highest of many is missing among the others, whose spread is smaller for that.
    count = np.maximum(far.sum(axis=-1) + 1.0 - special.ndtri(0.5 / tried) ** 2, 1.0)
    # The spread of the others knows of noise that is correlated along range, or of interference.
    noise = np.sqrt(np.where(far, total**2, 0.0).sum(axis=-1) / count)
    with np.errstate(invalid="ignore", divide="ignore"):
        height = total[..., _MARGIN:-_MARGIN].max(axis=-1) / noise
        sure = np.exp(tried * special.log_ndtr(height))
    return np.where(np.isfinite(lag) & (noise > 0), sure, 0.0)


def shift_signal(
    profile: npt.ArrayLike,
    lag: npt.ArrayLike,
    *,
    variance: npt.ArrayLike | None = None,
    interpolation: str = "linear",
) -> tuple[Array, Array]:
    r"""Move a signal that comes `lag` bins late to where it belongs.

    .. math:: P'_i = P(i + L) = \sum_j c_j P_{i + \lfloor L \rfloor + j}, \qquad
              v'_i = \sum_j c_j^2 v_{i + \lfloor L \rfloor + j}

    with the weights of the straight line through 2 bins, or of the cubic through 4.

    Parameters
    ----------
    profile : (..., range) float
    lag : (...) float
        Bins; broadcast.
    variance : (..., range) float, optional
        Of noise that is independent from bin to bin; broadcast.
    interpolation : {"linear", "cubic"}

    Returns
    -------
    shifted : (..., range) float
        NaN where it would come from beyond the ends or from a gap.
    variance : (..., range) float
        NaN where it is not given. After a shift by a part of a bin the noise of neighbours is
        correlated, and smaller in a bin than it was.

    Raises
    ------
    RetrievalInputError
        Where the lag is not finite, or the shapes do not fit.
    """
    way = inputs.choice(interpolation, LagInterpolation, "interpolation")
    values = inputs.real_array(profile, "profile").astype(np.float64, copy=False)
    if values.ndim == 0:
        raise RetrievalInputError("is a single number", field="profile")
    noise = np.asarray(np.nan) if variance is None else inputs.real_array(variance, "variance")
    try:
        noise = np.broadcast_to(noise.astype(np.float64, copy=False), values.shape)
    except ValueError:
        raise RetrievalInputError(
            f"has the shape {noise.shape}, which does not broadcast to {values.shape}",
            field="variance",
        ) from None
    bins = inputs.profile_values(lag, "lag", values.shape[:-1])
    rows, noises = values.reshape(-1, values.shape[-1]), noise.reshape(-1, values.shape[-1])
    amount = np.broadcast_to(np.zeros(1) if bins is None else bins, len(rows))
    moved, variances = _moved(rows, noises, amount, way)
    return moved.reshape(values.shape), variances.reshape(values.shape)


def _moved(rows: Array, noises: Array, amount: Array, way: LagInterpolation) -> tuple[Array, Array]:
    moved, variances = np.zeros(rows.shape), np.zeros(rows.shape)
    for value in np.unique(amount):
        same = slice(None) if np.all(amount == value) else np.flatnonzero(amount == value)
        one, other = rows[same], noises[same]
        total, spread = np.zeros(one.shape), np.zeros(one.shape)
        whole = math.floor(value)
        for offset, weight in _taps(float(value) - whole, way).items():
            # What counts nothing must not spoil a bin by being NaN.
            if weight != 0.0:
                _add_moved(one, whole + offset, weight, total)
                _add_moved(other, whole + offset, weight**2, spread)
        moved[same], variances[same] = total, spread
    lost = ~np.isfinite(moved)
    moved[lost] = np.nan
    variances[lost] = np.nan
    return moved, variances


def _add_moved(rows: Array, whole: int, weight: float, total: Array) -> None:
    bins = rows.shape[1]
    first, past = min(max(-whole, 0), bins), max(min(bins - whole, bins), 0)
    total[:, :first] = np.nan
    total[:, past:] = np.nan
    if first < past:
        total[:, first:past] += weight * rows[:, first + whole : past + whole]


def _taps(part: float, way: LagInterpolation) -> dict[int, float]:
    """Return the weights of the bins about a place a part of a bin behind bin 0."""
    if way is LagInterpolation.LINEAR:
        return {0: 1.0 - part, 1: part}
    return {
        -1: -part * (part - 1.0) * (part - 2.0) / 6.0,
        0: (part + 1.0) * (part - 1.0) * (part - 2.0) / 2.0,
        1: -(part + 1.0) * part * (part - 2.0) / 2.0,
        2: (part + 1.0) * part * (part - 1.0) / 6.0,
    }
