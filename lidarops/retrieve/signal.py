"""From raw counts to a clean signal with known noise: arrays in, arrays out.

The last axis is range, the one before it time. Signals are in mV (analog) and MHz (photon
counting), as the field has them; everything else is SI.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lidarops.constants import DEFAULT_DEAD_TIME, LICEL_RANGE_PER_MICROSECOND
from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.int32]

PILE_UP_CORRECTION = 0.1
"""Relative dead-time correction above which `Quality.PILE_UP` is raised."""
PARALYSIS = 0.5
"""Measured rate times dead time above which a rate cannot be corrected (`Quality.SATURATED`)."""
NOISE_WINDOW = 0.1
"""Half-width, relative to range, of the window in which noise is smoothed."""
WEIGHT_WINDOW = 0.3
"""The same for the weights of the noise model."""
MIN_NOISE_BINS = 16
"""Smallest half-width of such a window in bins."""
LEAK = 0.05
"""Largest share of the noise that the fall of the signal may fake in a third difference."""

_EXTREMES = (np.iinfo(np.int32).min, -np.iinfo(np.int32).max, np.iinfo(np.int32).max)
_UNUSABLE = int(Quality.INPUT_MISSING | Quality.SATURATED)


@dataclass(frozen=True, slots=True)
class Signal:
    """A signal with the variance of its noise and its quality, all of one shape."""

    power: Array
    """mV or MHz; NaN where `quality` holds INPUT_MISSING or SATURATED."""
    variance: Array
    """Of the noise, in the square of the signal's unit."""
    quality: Flags
    """Bits of `lidarops.flags.Quality`."""


def analog(
    counts: npt.NDArray[np.int32],
    shots: npt.NDArray[np.integer],
    range: Array,  # noqa: A002 - the field's word
    *,
    adc_bits: int,
    input_range: Array,
    dark: Array | None = None,
    dark_variance: Array | None = None,
    noise_variance: float | None = None,
    full_overlap_range: float = 0.0,
) -> Signal:
    r"""Turn summed ADC counts into voltage with known noise.

    .. math:: U = \frac{n \cdot 1000\, U_{max}}{N \, 2^{b}} - D

    with counts :math:`n`, shots :math:`N`, bits :math:`b`, input range :math:`U_{max}` in V and
    dark signal :math:`D` in mV. A bin at full scale, :math:`n \ge N (2^b - 1)`, is SATURATED; a
    bin at an extreme of the integer type, or of a profile without shots or of zeros alone, is
    INPUT_MISSING.

    Parameters
    ----------
    counts : (..., time, range) int32
        Sum over the shots.
    shots : (..., time) int
    range : (range,) float
        m.
    adc_bits : int
    input_range : (..., time) float
        V.
    dark, dark_variance : (range,) float, optional
        Mean of the dark files in mV, and the variance of that mean in mV^2.
    noise_variance : float, optional
        mV^2, of one profile; estimated from the profile (`difference_variance`) where absent.
    full_overlap_range : float
        m; nearer bins are INCOMPLETE_OVERLAP.

    Returns
    -------
    Signal
        In mV.

    References
    ----------
    licel2023
    """
    fired = np.asarray(shots, dtype=np.float64)[..., np.newaxis]
    quality = _raw_quality(counts, fired, range, full_overlap_range)
    quality[counts >= fired * (2.0**adc_bits - 1.0)] |= np.int32(Quality.SATURATED)
    with np.errstate(divide="ignore", invalid="ignore"):
        step = np.asarray(input_range)[..., np.newaxis] * 1000.0 / (fired * 2.0**adc_bits)
        power: Array = counts * step
    if dark is not None:
        power -= dark
    power[(quality & _UNUSABLE) != 0] = np.nan
    if noise_variance is None:
        variance = difference_variance(power, range)
    else:
        variance = np.full(power.shape, noise_variance)
        if dark_variance is not None:
            variance += dark_variance
    # Rounding to whole counts is noise too, and all there is where a signal stands still.
    variance = np.maximum(variance, step**2 / 12.0)
    return Signal(power, variance, quality)


def photon(
    counts: npt.NDArray[np.int32],
    shots: npt.NDArray[np.integer],
    range: Array,  # noqa: A002 - the field's word
    *,
    bin_width: float,
    dead_time: float | None = None,
    full_overlap_range: float = 0.0,
) -> Signal:
    r"""Turn summed photon counts into a count rate with known noise.

    The measured rate is :math:`m = n / (N T)`, with the nominal bin time :math:`T` = bin width
    / 150 m per microsecond; a non-paralysable dead time :math:`\tau` is undone by

    .. math:: r = \frac{m}{1 - m \tau}, \qquad \mathrm{var}(r) = \frac{r}{N T (1 - m \tau)}

    (renewal statistics: :math:`\mathrm{var}(n) = n (1 - m\tau)^2`). The variance is evaluated on
    the rate smoothed over +- 10 % of range, so that the weights made of it do not follow the
    noise of the single bin. PILE_UP where the correction exceeds 10 %, SATURATED where
    :math:`m \tau > 0.5`; both are judged with 4 ns where no dead time is known, and then nothing
    is corrected.

    Parameters
    ----------
    counts : (..., time, range) int32
        Sum over the shots.
    shots : (..., time) int
    range : (range,) float
        m.
    bin_width : float
        m.
    dead_time : float, optional
        s.
    full_overlap_range : float
        m; nearer bins are INCOMPLETE_OVERLAP.

    Returns
    -------
    Signal
        In MHz.

    References
    ----------
    licel2023
    """
    fired = np.asarray(shots, dtype=np.float64)[..., np.newaxis]
    quality = _raw_quality(counts, fired, range, full_overlap_range)
    quality[counts < 0] |= np.int32(Quality.INPUT_MISSING)
    with np.errstate(divide="ignore", invalid="ignore"):
        exposure = fired * (bin_width / LICEL_RANGE_PER_MICROSECOND)
        rate: Array = counts / exposure
    load = rate * ((dead_time or DEFAULT_DEAD_TIME) * 1e6)
    with np.errstate(invalid="ignore"):
        quality[load > PARALYSIS] |= np.int32(Quality.SATURATED)
        quality[load / (1.0 - np.minimum(load, PARALYSIS)) > PILE_UP_CORRECTION] |= np.int32(
            Quality.PILE_UP
        )
    bad = (quality & _UNUSABLE) != 0
    rate[bad] = np.nan
    live = np.ones_like(rate) if dead_time is None else 1.0 - rate * (dead_time * 1e6)
    power = rate / live
    with np.errstate(divide="ignore", invalid="ignore"):
        # A window without a single count has a rate below one count, not a certain zero.
        floor = 1.0 / (exposure * _window_bins(power, range))
        expected = np.maximum(smooth(power, range), floor)
        variance = expected / (exposure * smooth(live, range))
    return Signal(power, variance, quality)


def _raw_quality(
    counts: npt.NDArray[np.int32],
    shots: Array,
    range: Array,  # noqa: A002 - the field's word
    full_overlap_range: float,
) -> Flags:
    if counts.shape[-1] != range.shape[-1] or counts.shape[:-1] != shots.shape[:-1]:
        raise RetrievalInputError(
            f"counts {counts.shape}, shots {shots.shape[:-1]} and range {range.shape} do not fit",
            field="counts",
            remedy="counts are (..., time, range), shots (..., time), range (range,)",
        )
    quality = np.zeros(counts.shape, dtype=np.int32)
    # A recorder that is off writes zeros; light and electronics never do over a whole profile.
    dead = ~counts.any(axis=-1, keepdims=True)
    missing = np.isin(counts, _EXTREMES) | (shots <= 0) | dead
    quality[missing] |= np.int32(Quality.INPUT_MISSING)
    quality[..., range < full_overlap_range] |= np.int32(Quality.INCOMPLETE_OVERLAP)
    return quality


def _windows(
    range: Array,  # noqa: A002 - the field's word
    window: float,
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return first and past-the-last bin of the smoothing window of each bin."""
    index = np.arange(range.size)
    spacing = float(np.min(np.abs(np.diff(range)))) if range.size > 1 else 1.0
    half = np.maximum(np.abs(range) * (window / spacing), MIN_NOISE_BINS).astype(np.intp)
    # Symmetric up to the ends, so that a steep signal is not smoothed to one side.
    half = np.minimum(half, np.maximum(np.minimum(index, range.size - 1 - index), MIN_NOISE_BINS))
    return np.maximum(index - half, 0), np.minimum(index + half + 1, range.size)


def _window_sums(
    values: Array,
    range: Array,  # noqa: A002 - the field's word
    window: float = NOISE_WINDOW,
) -> Array:
    first, past = _windows(range, window)
    sums = np.concatenate([np.zeros((*values.shape[:-1], 1)), np.cumsum(values, axis=-1)], axis=-1)
    total: Array = sums[..., past] - sums[..., first]
    return total


def _window_bins(
    values: Array,
    range: Array,  # noqa: A002 - the field's word
    window: float = NOISE_WINDOW,
) -> Array:
    return _window_sums(np.isfinite(values).astype(np.float64), range, window)


def smooth(
    values: Array,
    range: Array,  # noqa: A002 - the field's word
    *,
    window: float = NOISE_WINDOW,
) -> Array:
    """Average over a window that grows with range, at least 33 bins, passing over NaN.

    Parameters
    ----------
    values : (..., range) float
    range : (range,) float
        m.
    window : float
        Half-width of the window, relative to range.

    Returns
    -------
    (..., range) float
        NaN where the window holds no finite value.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        sums = _window_sums(np.nan_to_num(values), range, window)
        averages: Array = sums / _window_bins(values, range, window)
    return averages


def difference_variance(power: Array, range: Array) -> Array:  # noqa: A002 - the field's word
    r"""Estimate the noise variance of an analog signal from third differences along range.

    Electronic noise is constant and shot noise follows the light, so that

    .. math:: v(R) = a + b \, \overline{P}(R), \qquad
              \left\langle \frac{(P_{i-1} - 3 P_i + 3 P_{i+1} - P_{i+2})^2}{20} \right\rangle
              = a + b \, \overline{P}_i

    is fitted by weighted least squares with :math:`a, b \ge 0`, one pair a profile: weights made
    of two well-determined numbers do not follow the noise of the single bin. Exact for noise
    that is white along range; noise that is correlated from bin to bin is underestimated. Bins
    so near that the fall of the signal itself would be taken for noise are left out of the fit.

    Parameters
    ----------
    power : (..., range) float
        NaN where unusable; differences that touch NaN are passed over.
    range : (range,) float
        m.

    Returns
    -------
    (..., range) float
        In the square of the unit of `power`; NaN where no difference is finite.
    """
    third = power[..., 3:] - 3.0 * power[..., 2:-1] + 3.0 * power[..., 1:-2] - power[..., :-3]
    squares = np.full(power.shape, np.nan)
    squares[..., 1:-2] = third**2 / 20.0
    local = smooth(squares, range, window=WEIGHT_WINDOW)
    mean = smooth(power, range)
    spacing = np.abs(np.gradient(range)) if range.size > 1 else np.ones(1)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        # The third difference of R^-2 is 24 (h / R)^3 of the signal.
        leak = (24.0 * (spacing / range) ** 3 * mean) ** 2 / 20.0
        usable = np.isfinite(squares) & np.isfinite(mean) & (local > 0) & (leak < LEAK * local)
        weight = np.where(usable, 1.0 / local**2, 0.0)
        weight /= np.max(weight, axis=-1, keepdims=True)
        a, b = _line(np.where(usable, mean, 0.0), np.where(usable, squares, 0.0), weight)
        variance = a + b * np.maximum(mean, 0.0)
    # Too few differences for a line, or a signal without noise: what there is, locally.
    return np.where(np.isfinite(variance) & (variance > 0), variance, local)


def _line(x: Array, y: Array, weight: Array) -> tuple[Array, Array]:
    """Return intercept and slope of y over x, neither below zero; one pair a row."""
    total = weight.sum(axis=-1, keepdims=True)
    x_mean = (weight * x).sum(axis=-1, keepdims=True) / total
    y_mean = (weight * y).sum(axis=-1, keepdims=True) / total
    from_mean = x - x_mean
    square = (weight * from_mean**2).sum(axis=-1, keepdims=True)
    slope = (weight * from_mean * (y - y_mean)).sum(axis=-1, keepdims=True) / square
    slope = np.where(slope > 0, slope, 0.0)
    intercept = y_mean - slope * x_mean
    # Through the origin, where the fit would have the noise vanish above zero light.
    x_square = (weight * x**2).sum(axis=-1, keepdims=True)
    through = (weight * x * y).sum(axis=-1, keepdims=True) / x_square
    negative = intercept < 0
    return np.where(negative, 0.0, intercept), np.where(negative, through, slope)


def dark_mean(signals: Array) -> tuple[Array, Array]:
    """Average dark profiles.

    Parameters
    ----------
    signals : (time, range) float
        mV; NaN is passed over.

    Returns
    -------
    mean : (range,) float
        mV, NaN where no profile is finite.
    variance : (range,) float
        Of that mean, from the scatter of the profiles; pooled over the bins where a bin has
        fewer than two finite values.
    """
    finite = np.isfinite(signals)
    count = finite.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(finite, signals, 0.0).sum(axis=0) / count
        residual = np.where(finite, signals - mean, 0.0)
        scatter = (residual**2).sum(axis=0) / (count - 1)
    known = count > 1
    pooled = float(scatter[known].mean()) if known.any() else 0.0
    scatter = np.where(known, scatter, pooled)
    return np.where(count > 0, mean, np.nan), scatter / np.maximum(count, 1)


def range_corrected(
    signal: Signal,
    range: Array,  # noqa: A002 - the field's word
    *,
    background: Array,
    background_variance: Array,
) -> Signal:
    r"""Subtract the background and multiply with the square of range.

    .. math:: X = (P - P^*) R^2, \qquad \mathrm{var}(X) = (v_P + v_{P^*}) R^4

    Parameters
    ----------
    signal : Signal
        (..., range).
    range : (range,) float
        m.
    background, background_variance : (...) float
        In the unit of the signal and its square.

    Returns
    -------
    Signal
        In mV m2 or MHz m2. Negative values stay: clipping would bias every mean.
    """
    square = range**2
    power = (signal.power - background[..., np.newaxis]) * square
    variance = (signal.variance + background_variance[..., np.newaxis]) * square**2
    return Signal(power, variance, signal.quality)
