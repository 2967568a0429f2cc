"""Gluing of analog and photon-counting signals in the range where both are linear."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy import special

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Block, Booleans, Indices, Integers, frozen
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.signal.thresholds import THRESHOLDS

_HUGE: Final = 1e150
_PASSES: Final = 4
"""Iterations; each multiplies the error of the slope by about the share of noise in the spread of
x."""

_LINE: Final = ("slope", "intercept", "slope_variance", "centre_variance", "centre")
LINE: Final = np.dtype([(name, np.float64) for name in (*_LINE, "chi2", "points")])
"""Line of a profile: NaN where there are fewer than 3 points. Slope and value at the centre have
independent errors."""


@dataclass(frozen=True, slots=True)
class GluedSignal:
    """Glued signals, and the line that scales analog to photon counting, for each profile."""

    power: Array
    """(..., range), MHz: analog near, photon counting far; NaN where there is no line."""
    variance: Array
    """(..., range), MHz2, noise variance."""
    systematic_variance: Array
    """(..., range), MHz2, by the error of the line: common to all bins of a profile."""
    change: Array
    """(..., range), MHz: change of `power` with that of photon counting, and of the line by it."""
    slope: Array
    """(...), MHz mV-1."""
    slope_standard_error: Array
    start: Array
    """(...), m: first bin of the window; NaN where there is none."""
    stop: Array
    """(...), m: last bin of the window."""
    no_window: Booleans
    """(...): fewer than 8 consecutive bins are within the limits, or the count rate changes by
    less than a factor of 1.5 within them, which is too little to define a line."""
    poor_fit: Booleans
    """(...): the slope is less than 5 standard errors above 0, or chi-square exceeds 1.5 times the
    expected one. A channel is then not linear (dead time, saturation), or the channels receive
    different light (overlap, fields of view). A wrong lag may pass: it only scales a falling
    signal."""
    misfit: Booleans
    """(...): a poor fit by chi-square, and with `photon_change` too: one channel is wrong."""


def lit_bins(power: Array, variance: Array, highest: npt.ArrayLike = np.inf) -> Integers:
    """Return the number of bins, (...), whose smoothed signal is `Thresholds.least_snr` of noise.

    `power` and `variance` are (..., range); signals above `highest`, (...), do not count.
    """
    rows = frozen(power.reshape(-1, power.shape[-1]))
    noise = np.broadcast_to(variance, power.shape).reshape(rows.shape)
    with np.errstate(invalid="ignore"):
        lit = _is_lit(rows, noise) & (_smooth(rows) <= np.reshape(highest, (-1, 1)))
    return np.asarray((lit & np.isfinite(rows)).sum(axis=-1).reshape(power.shape[:-1]))


def glue(
    analog: npt.ArrayLike,
    photon_counting: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    *,
    analog_variance: npt.ArrayLike,
    photon_variance: npt.ArrayLike,
    photon_background: npt.ArrayLike = 0.0,
    photon_change: npt.ArrayLike = 0.0,
    analog_correlation_length: npt.ArrayLike = 1.0,
) -> GluedSignal:
    r"""Return analog signals scaled to photon counting by a line, joined with photon counting.

    The line :math:`y = s x + a` minimises

    .. math:: \chi^2 = \sum \frac{(y_i - s x_i - a)^2}{v_{y,i} + s^2 v_{x,i}}

    by 4 iterations of the equations of york2004, starting with the ratio of the spreads. A
    regression on noisy analog values would give too small a slope. The window is the longest run
    of bins in which the smoothed profile has a count rate within `Thresholds.count_rates` and an
    analog value of at least `Thresholds.least_snr` times the noise of a bin. Analog changes to
    photon counting abruptly in its middle: their noise is correlated, so that a blend would have
    more noise than its variance states.

    Parameters
    ----------
    analog : (..., range) float
        mV, dark signal and background subtracted, aligned with photon counting (`lag`).
    photon_counting : (..., range) float
        MHz, corrected for dead time, background subtracted.
    range : (range,) float
        m.
    analog_variance, photon_variance : (..., range) float
        mV2, MHz2, noise variances; broadcast. They must not follow the noise of the single bin.
    photon_background : (...) float
        MHz, the background that was subtracted from photon counting.
    photon_change : (..., range) float
        MHz, a change of photon counting by an error that all bins share, such as that of the dead
        time; broadcast.
    analog_correlation_length : (...) float
        Bins; the integral correlation length of analog noise
        (`lidarops.retrieve.signal.noise_correlation`), which raises the errors of the line.

    Raises
    ------
    RetrievalInputError
        For invalid arguments.

    References
    ----------
    york2004, licel2023
    """
    grid = inputs.range_grid(range)
    x, leading = _rows(analog, "analog", grid)
    y, photon_leading = _rows(photon_counting, "photon_counting", grid)
    if photon_leading != leading:
        raise RetrievalInputError(
            f"has the leading shape {photon_leading}, analog {leading}", field="photon_counting"
        )
    xv, yv = (
        frozen(np.broadcast_to(inputs.noise_rows(v, name, grid, leading, negative=False), x.shape))
        for v, name in ((analog_variance, "analog_variance"), (photon_variance, "photon_variance"))
    )
    sky = inputs.profile_values(photon_background, "photon_background", leading)
    highest = np.broadcast_to(THRESHOLDS.count_rates[1] - sky, len(x))
    first, past = _search(x, y, xv, highest)
    near = np.arange(grid.size) < ((first + past) // 2)[:, np.newaxis]
    line = fit_lines(x, y, xv, yv, first, past)
    length = inputs.profile_values(analog_correlation_length, "analog_correlation_length", leading)
    share = _correlated_share(xv, yv, line["slope"], first, past, length)
    line["slope_variance"] *= share
    line["centre_variance"] *= share
    power, variance, systematic = _joined(x, y, xv, yv, line, near)
    change, misfit = np.broadcast_to(0.0, y.shape), _misfits(line)
    common = misfit
    if np.any(photon_change):
        moved = frozen(y + inputs.noise_rows(photon_change, "photon_change", grid, leading))
        changed = fit_lines(x, moved, xv, yv, first, past)
        change = _joined(x, moved, xv, yv, changed, near)[0] - power
        common = misfit & _misfits(changed)
    empty, error = past == 0, np.sqrt(line["slope_variance"])
    with np.errstate(invalid="ignore"):
        poor_fit = misfit | ~(line["slope"] >= COMMON.first_order * error)
    result = GluedSignal(
        power=power,
        variance=variance,
        systematic_variance=systematic,
        change=change,
        slope=line["slope"],
        slope_standard_error=error,
        start=np.where(empty, np.nan, grid[first]),
        stop=np.where(empty, np.nan, grid[np.maximum(past - 1, 0)]),
        no_window=empty,
        poor_fit=poor_fit & ~empty,
        misfit=common,
    )
    return inputs.with_leading_axes(result, leading)


def _correlated_share(
    xv: Array, yv: Array, slope: Array, first: Indices, past: Indices, length: Array
) -> Array:
    """Return the noise of means of both channels over that of independent bins, (profile,)."""
    index = np.arange(xv.shape[1])
    inside = (index >= first[:, np.newaxis]) & (index < past[:, np.newaxis])
    analog = slope**2 * np.where(inside, xv, 0.0).sum(axis=-1)
    photons = np.where(inside, yv, 0.0).sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = (analog * length + photons) / (analog + photons)
    return np.where(np.isfinite(share), share, 1.0)


def _joined(
    x: Array, y: Array, xv: Array, yv: Array, line: Block, near: Booleans
) -> tuple[Array, Array, Array]:
    """Return signal, noise variance and variance by the line: scaled x where `near`, else y."""
    slope, intercept, by_slope, by_centre, centre = (line[name][:, np.newaxis] for name in _LINE)
    with np.errstate(invalid="ignore", over="ignore"):
        power = np.where(near, slope * x + intercept, y)
        valid = (np.abs(power) < _HUGE) & (slope > 0.0)
        lever = x - centre
        of_line = by_slope * lever * lever
        of_line = of_line + by_centre
        variance, systematic = np.where(near, slope * slope * xv, yv), np.where(near, of_line, 0.0)
    power[~valid] = variance[~valid] = systematic[~valid] = np.nan
    return power, variance, systematic


def _rows(values: npt.ArrayLike, name: str, grid: Array) -> tuple[Array, tuple[int, ...]]:
    rows, leading = inputs.profiles(values, grid, name)
    return frozen(rows.astype(np.float64, copy=False)), leading


def _search(x: Array, y: Array, xv: Array, highest: Array) -> tuple[Indices, Indices]:
    """Return first and past-the-last bin of the window of each profile, (0, 0) for none."""
    rate = _smooth(y)
    with np.errstate(invalid="ignore"):
        usable = (rate >= THRESHOLDS.count_rates[0]) & (rate <= highest[:, np.newaxis])
    usable &= _is_lit(x, xv)
    index = np.arange(rate.shape[1])
    # Number of usable bins up to each, whose largest is the longest run.
    run = index - np.maximum.accumulate(np.where(usable, -1, index), axis=1)
    past = run.argmax(axis=1) + 1
    first = past - run.max(axis=1)
    inside = (index >= first[:, np.newaxis]) & (index < past[:, np.newaxis])
    highest_rate = np.where(inside, rate, 0.0).max(axis=1, initial=0.0)
    lowest_rate = np.where(inside, rate, np.inf).min(axis=1, initial=np.inf)
    wide = past - first >= COMMON.fewest_bins
    wide &= highest_rate >= THRESHOLDS.least_fall * lowest_rate
    return np.where(wide, first, 0), np.where(wide, past, 0)


def _is_lit(x: Array, variance: Array) -> Booleans:
    """Return where smoothed signals exceed the noise of a bin by the least ratio."""
    with np.errstate(invalid="ignore"):
        noise = np.sqrt(_smooth(np.where(np.isfinite(x), variance, np.nan)))
        return np.asarray(_smooth(x) >= THRESHOLDS.least_snr * noise)


def _smooth(values: Array) -> Array:
    """Return averages over `Thresholds.smoothing` bins, fewer at the ends, skipping NaN."""
    smooth = np.empty(values.shape)
    running_means(frozen(values), THRESHOLDS.smoothing // 2, smooth)
    return smooth


def _misfits(line: Block) -> Booleans:
    """Return which lines have a chi-square that noise does not explain."""
    freedom = np.maximum(np.nan_to_num(line["points"]).astype(np.int64) - 2, 0)
    noise = special.chdtri(freedom, COMMON.misfit_false_alarm)
    with np.errstate(invalid="ignore"):
        return np.asarray(line["chi2"] > np.maximum(THRESHOLDS.largest_misfit * freedom, noise))


def fit_lines(
    x: Array, y: Array, x_variance: Array, y_variance: Array, first: Indices, past: Indices
) -> Block:
    """Return the line of each profile, within its window, (profile,) `LINE`.

    Parameters
    ----------
    x, y, x_variance, y_variance : (profile, bin) float64
        Points with a non-finite value or a variance that is not positive are skipped.
    first, past : (profile,) int
        Window of each profile.
    """
    out = np.full(len(x), np.nan, LINE)
    _fit_lines(x, y, x_variance, y_variance, first, past, out)
    return out


@compiled
def running_means(values: Array, half: int, out: Array) -> None:
    """Average over windows of 2 half + 1 bins, shorter at the ends, skipping non-finite values.

    Parameters
    ----------
    values, out : (row, bin) float64
    half : int
    """
    bins = values.shape[1]
    for k in range(values.shape[0]):
        total, count = 0.0, 0
        for i in range(-half, bins):
            new, old = i + half, i - half - 1
            if new < bins and abs(values[k, new]) < _HUGE:
                total += values[k, new]
                count += 1
            if old >= 0 and abs(values[k, old]) < _HUGE:
                total -= values[k, old]
                count -= 1
            if i >= 0:
                out[k, i] = total / count if count > 0 else math.nan


@compiled
def _usable(x: float, y: float, x_variance: float, y_variance: float) -> bool:
    finite = abs(x) < _HUGE and abs(y) < _HUGE
    return finite and 0.0 < x_variance < _HUGE and 0.0 < y_variance < _HUGE


@compiled
def _centroid(x: Array, y: Array, xv: Array, yv: Array, slope: float) -> Any:
    """Return the sum of the weights, the weighted means, and the number of points."""
    total = x_mean = y_mean = 0.0
    points = 0
    for i in range(x.size):
        if _usable(x[i], y[i], xv[i], yv[i]):
            weight = 1.0 / (yv[i] + slope * (slope * xv[i]))
            total += weight
            x_mean += weight * x[i]
            y_mean += weight * y[i]
            points += 1
    return total, x_mean / total, y_mean / total, points


@compiled
def _moments(
    x: Array, y: Array, xv: Array, yv: Array, slope: float, x_mean: float, y_mean: float
) -> Any:
    """Return the sums of York's equations: for y, x, the adjusted x, its square, and chi-square."""
    y_sum = x_sum = shift = square = chi2 = 0.0
    for i in range(x.size):
        if not _usable(x[i], y[i], xv[i], yv[i]):
            continue
        weight = 1.0 / (yv[i] + slope * (slope * xv[i]))
        u, v = x[i] - x_mean, y[i] - y_mean
        beta = weight * (u * yv[i] + slope * v * xv[i])
        y_sum += weight * beta * v
        x_sum += weight * beta * u
        shift += weight * beta
        square += weight * beta * beta
        chi2 += weight * (v - slope * u) ** 2
    return y_sum, x_sum, shift, square, chi2


@compiled
def _first_slope(x: Array, y: Array, xv: Array, yv: Array) -> float:
    """Return the ratio of the spreads of y and x, which depends little on noise in either."""
    points, x_mean, y_mean = 0, 0.0, 0.0
    for i in range(x.size):
        if _usable(x[i], y[i], xv[i], yv[i]):
            points += 1
            x_mean += (x[i] - x_mean) / points
            y_mean += (y[i] - y_mean) / points
    spread = rise = 0.0
    for i in range(x.size):
        if _usable(x[i], y[i], xv[i], yv[i]):
            spread += (x[i] - x_mean) ** 2
            rise += (y[i] - y_mean) ** 2
    return math.sqrt(rise / spread)


@compiled
def _fit_lines(
    x: Array, y: Array, xv: Array, yv: Array, first: Indices, past: Indices, out: Any
) -> None:
    for k in range(x.shape[0]):
        near, far, row = first[k], past[k], out[k]
        values = (x[k, near:far], y[k, near:far], xv[k, near:far], yv[k, near:far])
        slope = _first_slope(*values)
        total, x_mean, y_mean, points = _centroid(*values, slope)
        row.points = points
        if points < 3:
            continue
        for _ in range(_PASSES):
            y_sum, x_sum, _, _, _ = _moments(*values, slope, x_mean, y_mean)
            slope = y_sum / x_sum
            total, x_mean, y_mean, points = _centroid(*values, slope)
        _, _, shift, square, chi2 = _moments(*values, slope, x_mean, y_mean)
        row.slope, row.intercept = slope, y_mean - slope * x_mean
        row.slope_variance = 1.0 / (square - shift * shift / total)
        row.centre_variance = 1.0 / total
        row.centre = x_mean + shift / total
        row.chi2 = chi2
