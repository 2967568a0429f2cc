"""`lidarops.retrieve.signal.counts_to_signal` in plain numpy: slow, and easy to read.

Sums over windows are differences of running sums, with the rounding errors of these.
"""

from __future__ import annotations

import numpy as np

from lidarops.constants import DEFAULT_DEAD_TIME, LICEL_RANGE_PER_MICROSECOND
from lidarops.flags import Quality
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.signal.counts_to_signal import Signal
from lidarops.retrieve.signal.thresholds import THRESHOLDS

EXTREMES = (-(2**31), 1 - 2**31, 2**31 - 1)
UNUSABLE = int(Quality.INPUT_MISSING | Quality.SATURATED)


def analog(
    counts,
    shots,
    range,  # noqa: A002
    *,
    adc_bits,
    input_range,
    dark=0.0,
    dark_variance=0.0,
    noise_variance=None,
    full_overlap_range=0.0,
):
    fired = shots.astype(np.float64)[..., np.newaxis]
    quality = raw_quality(counts, fired, range, full_overlap_range)
    quality[counts >= fired * (2.0**adc_bits - 1.0)] |= np.int32(Quality.SATURATED)
    whole = input_range[..., np.newaxis] * 1000.0 / 2.0**adc_bits
    with np.errstate(divide="ignore", invalid="ignore"):
        step = input_range[..., np.newaxis] * 1000.0 / (fired * 2.0**adc_bits)
        power = counts * step - dark
    power[(quality & UNUSABLE) != 0] = np.nan
    if noise_variance is None:
        variance = difference_variance(power, range)
    else:
        variance = np.full(power.shape, noise_variance) + dark_variance
    top = fired * (2.0**adc_bits - 1.0)
    with np.errstate(invalid="ignore"):
        clipped = (top - counts) * step < THRESHOLDS.clipping * np.sqrt(variance * fired)
        clipped &= fired > 0
        clipped &= counts > THRESHOLDS.near_full_scale * top
    power[clipped] = np.nan
    quality[clipped] |= np.int32(Quality.SATURATED)
    if noise_variance is None:
        with_clipping = clipped.any(axis=-1)
        variance[with_clipping] = difference_variance(power, range)[with_clipping]
        excess, length = correlated_noise(power, variance)
        error = np.sqrt(4.62 / range.size)
        raised = rounded(variance * excess[..., np.newaxis], whole, fired, error)
        return Signal(power, raised, quality, length)
    known = rounded(np.full(power.shape, noise_variance), whole, fired) + dark_variance
    return Signal(power, known, quality, correlated_noise(power, known)[1])


def correlated_noise(power, variance):
    """Return the excess of the variance in the far half, and the correlation length."""
    pairs = [
        _correlated(*rows)
        for rows in zip(
            power.reshape(-1, power.shape[-1]),
            variance.reshape(-1, power.shape[-1]),
            strict=True,
        )
    ]
    excess, length = np.array(pairs).T
    return excess.reshape(power.shape[:-1]), length.reshape(power.shape[:-1])


def _correlated(power, variance):
    size = power.size // 16
    if size < 32:
        return 1.0, 1.0
    place = np.arange(size)
    sections = []
    for start in range(power.size - 8 * size, power.size, size):
        x, v = power[start : start + size], variance[start : start + size]
        if np.isfinite(x).all() and 0 < v.sum() < np.inf:
            residual = x - np.polyval(np.polyfit(place - place.mean(), x, 2), place - place.mean())
            # Of a constant, rounding remains.
            sections.append((residual * (np.ptp(x) > 0), v.mean()))
    if len(sections) < 4:
        return 1.0, 1.0
    number = len(sections) * size
    r = []
    for k in range(1, 11):
        each = [e[k:] @ e[:-k] / (size - k) / (np.mean(e**2) or np.inf) for e, _ in sections]
        if np.median(each) < 3.0 / np.sqrt(number) - 3.0 / size:
            break
        r.append(np.median(each))
    taken = 3.0 / size * (1.0 + 2.0 * sum(r))
    chi_square = np.median([e @ e / (size - 3) / v for e, v in sections])
    chi_square *= 1.0 + taken - 3.0 / size
    kurtosis = [np.mean(e**4) / np.mean(e**2) ** 2 if e.any() else size for e, _ in sections]
    kurtosis = np.median(kurtosis)
    if chi_square < 1.0 + 3.0 * np.sqrt((kurtosis - 1.0) / number):
        chi_square = 1.0
    if not r:
        return chi_square, 1.0
    length = 1.0 + 2.0 * sum((value + taken) / (1.0 + taken) for value in r)
    return chi_square, length * (1.0 + np.sqrt(2.0 * (2.0 * len(r) + 1.0) / number))


def rounded(variance, step, shots, error=0.0):
    """Return the variance of a mean of shots, each rounded by the digitiser to whole steps."""
    result = variance.copy()
    for row, size, fired in zip(result, step[:, 0], shots[:, 0], strict=True):
        if fired == 0:
            row[:] = row + np.inf
            continue
        shot = row * fired / size**2
        middle = np.sort(shot)[(shot.size - 1) // 2]
        least = shot if np.isnan(middle) else np.where(shot < middle, shot, middle)
        least = least / (1.0 + error)
        few = np.where(least < 1 / 12, 1.0, np.exp(-4 * np.pi**2 * (least - 1 / 12)))
        bias = np.maximum((1 / 4 - least) / 3, few / (2 * np.pi**2))
        coarse = (np.maximum(shot, 1 / 12) / fired + bias) * size**2
        row[shot < 0.5] = coarse[shot < 0.5]
    return result


def photon(
    counts,
    shots,
    range,  # noqa: A002
    *,
    bin_width,
    dead_time=None,
    dead_time_uncertainty=0.2,
    full_overlap_range=0.0,
):
    fired = shots.astype(np.float64)[..., np.newaxis]
    quality = raw_quality(counts, fired, range, full_overlap_range)
    quality[counts < 0] |= np.int32(Quality.INPUT_MISSING)
    with np.errstate(divide="ignore", invalid="ignore"):
        exposure = fired * (bin_width / LICEL_RANGE_PER_MICROSECOND)
        rate = counts / exposure
        assumed = (DEFAULT_DEAD_TIME if dead_time is None else dead_time) * 1e6
        load = rate * assumed
        correction = load / (1.0 - np.minimum(load, THRESHOLDS.paralysis))
        quality[load > THRESHOLDS.paralysis] |= np.int32(Quality.SATURATED)
        limit = THRESHOLDS.uncorrected_pile_up if dead_time is None else THRESHOLDS.pile_up
        quality[correction > limit] |= np.int32(Quality.PILE_UP)
        rate[(quality & UNUSABLE) != 0] = np.nan
        power = rate / (1.0 - rate * ((dead_time or 0.0) * 1e6))
        floor = 1.0 / (exposure * window_sums(np.isfinite(power).astype(float), range, 0.1))
        expected = np.maximum(smooth(power, range), floor)
        live = smooth(1.0 - rate * assumed, range)
        variance = expected / exposure * (live**2 if dead_time is None else 1.0 / live)
        error = dead_time_uncertainty if dead_time is not None else 1.0
        largest = THRESHOLDS.largest_dead_time_error
        largest = largest / (largest + error)
        margin = COMMON.single_bin * np.sqrt(load * assumed / exposure) * (1.0 - load)
        over = np.where(np.abs(load - largest) < margin, 1.0 - live, load) > largest
        over &= (quality & np.int32(Quality.INPUT_MISSING)) == 0
        power[over] = np.nan
        quality[over] |= np.int32(Quality.SATURATED)
    return Signal(power, variance, quality, np.ones(shots.shape))


def raw_quality(counts, shots, range, full_overlap_range):  # noqa: A002
    quality = np.zeros(counts.shape, dtype=np.int32)
    dead = ~counts.any(axis=-1, keepdims=True)
    missing = np.isin(counts, EXTREMES) | (shots <= 0) | dead
    quality[missing] |= np.int32(Quality.INPUT_MISSING)
    quality[..., range < full_overlap_range] |= np.int32(Quality.INCOMPLETE_OVERLAP)
    return quality


def windows(range, window):  # noqa: A002
    """Return first and past-the-last bin of the smoothing window of each bin."""
    index = np.arange(range.size)
    spacing = float(np.min(np.abs(np.diff(range)))) if range.size > 1 else 1.0
    half = np.maximum(np.abs(range) * (window / spacing), 16).astype(np.intp)
    half = np.minimum(half, np.maximum(np.minimum(index, range.size - 1 - index), 16))
    return np.maximum(index - half, 0), np.minimum(index + half + 1, range.size)


def window_sums(values, range, window):  # noqa: A002
    first, past = windows(range, window)
    sums = np.concatenate([np.zeros((*values.shape[:-1], 1)), np.cumsum(values, axis=-1)], axis=-1)
    return sums[..., past] - sums[..., first]


def smooth(values, range, *, window=0.1):  # noqa: A002
    finite = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        sums = window_sums(np.where(finite, values, 0.0), range, window)
        return sums / window_sums(finite.astype(float), range, window)


def difference_variance(power, range):  # noqa: A002
    rows = [_difference_variance(row, range) for row in power.reshape(-1, power.shape[-1])]
    return np.array(rows).reshape(power.shape)


def _difference_variance(power, range):  # noqa: A002
    """Return the line through the far half and the bright blocks, corrected by bands."""
    size = power.size
    count = max(size - 12, 0) // 16
    light, drift = _light(smooth(power, range), size // 2)
    index = np.arange(max(size - 12, 0))
    third = power[index + 12] - 3.0 * power[index + 8] + 3.0 * power[index + 4] - power[index]
    squares = (third[: 16 * count] ** 2 / 20.0).reshape(count, 16).mean(axis=1)
    far = squares[(size // 2) // 16 :]
    far = far[np.isfinite(far)]
    dark = _clipped_mean(far)
    if not dark > 0.0:
        neighbours = np.diff(power, 3) ** 2 / 20.0
        neighbours = neighbours[np.isfinite(neighbours)]
        return np.full(size, neighbours.mean() if neighbours.size else np.nan)
    first = 16 * np.arange(count)
    spread = light[first + 13]
    fall = 24.0 * (4 * np.abs(np.diff(range))[first] / range[first]) ** 3 * spread
    usable = np.isfinite(squares) & (fall**2 / 20.0 <= THRESHOLDS.leak * dark)
    clear = 5.0 * max(drift, np.sqrt(dark / 16))
    bright = np.isfinite(squares) & (spread > clear)
    if (bright & usable).sum() < 4 <= bright.sum():
        slope, least = _slope(squares[bright], spread[bright], dark), clear
    else:
        bright &= usable
        slope, least = _slope(squares[bright], spread[bright], dark), -np.inf
        lines = np.maximum(dark + slope * spread, 0.5 * dark)
        kept = usable & (squares <= 8.0 * lines)
        improved = np.average(dark + (squares - lines)[kept], weights=lines[kept] ** -2.0)
        dark = improved if improved > 0.0 else dark
    line = np.maximum(dark + slope * np.nan_to_num(light), 0.5 * dark)
    line[light < least] = dark
    return line * _band_ratio(squares / line[first + 13], usable, size)


def _light(mean, far):
    levels = mean[far::16]
    levels = levels[np.isfinite(levels)]
    if levels.size < 4:
        return np.full(mean.size, np.nan), np.nan
    departures = np.sort(np.abs(levels - np.median(levels)))
    return mean - np.median(levels), departures[int(0.9 * departures.size)]


def _clipped_mean(values):
    if values.size < 4:
        return np.nan
    median = np.median(values)
    return values[values <= 8.0 * median].mean() if median > 0.0 else values.mean()


def _slope(squares, light, dark):
    if light.size < 4:
        return 0.0
    line = dark + max(np.median((squares - dark) / light), 0.0) * light
    weights = light / line**2 * (squares <= 8.0 * line)
    slope = np.sum(weights * (squares - dark)) / np.sum(weights * light)
    return slope if slope > 0.49 / np.sqrt(np.sum(weights * light)) else 0.0


def _band_ratio(ratio, usable, size):
    centres, logarithms, significant, start = [], [], False, 0
    while start < ratio.size:
        end = start + max(32, int(0.25 * start))
        end = ratio.size if ratio.size - end < 32 else end
        places = start + np.flatnonzero(usable[start:end])
        excess = _clipped_mean(ratio[places])
        if excess > 0.0:
            centres.append(16 * places.mean() + 13)
            logarithms.append(np.log(excess))
            error = 0.49 * np.sqrt(1.0 / places.size + 2.0 / ratio.size)
            significant |= abs(logarithms[-1]) > 3.5 * error
        start = end
    if not significant:
        return np.ones(size)
    return np.exp(np.interp(np.arange(size), centres, logarithms))
