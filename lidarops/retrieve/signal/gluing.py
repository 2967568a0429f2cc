"""Gluing of analog and photon-counting signals in the range where both are linear."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import special

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Booleans, Indices, Integers, frozen
from lidarops.retrieve.signal import _line_fit
from lidarops.retrieve.signal.thresholds import THRESHOLDS

_VARIANCES: Final = [_line_fit.SLOPE_VARIANCE, _line_fit.CENTRE_VARIANCE]


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
    intercept: Array
    """(...), MHz: 0 within its error if both backgrounds are right."""
    intercept_standard_error: Array
    chi2: Array
    """(...), of the line."""
    degrees_of_freedom: Integers
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

    Returns
    -------
    GluedSignal

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
    xv = _variance(analog_variance, "analog_variance", grid, leading)
    yv = _variance(photon_variance, "photon_variance", grid, leading)
    sky = inputs.profile_values(photon_background, "photon_background", leading)
    highest = THRESHOLDS.count_rates[1] - (np.zeros(1) if sky is None else sky)
    first, past = _search(x, y, xv, np.broadcast_to(highest, len(x)))
    near = np.arange(grid.size) < ((first + past) // 2)[:, np.newaxis]

    def fitted(photons: Array) -> Array:
        lines = np.full((len(x), _line_fit.COLUMNS), np.nan)
        _line_fit.fit_lines(x, photons, xv, yv, first, past, lines)
        return lines

    lines = fitted(y)
    length = inputs.profile_values(analog_correlation_length, "analog_correlation_length", leading)
    lines[:, _VARIANCES] *= _correlated_share(xv, yv, lines, first, past, length)
    joined = _joined(x, y, xv, yv, lines, near)
    change, changed = np.broadcast_to(0.0, y.shape), lines
    if np.any(photon_change):
        moved = frozen(y + inputs.noise_rows(photon_change, "photon_change", grid, leading))
        changed = fitted(moved)
        change = _joined(x, moved, xv, yv, changed, near)[0] - joined[0]
    return _result((lines, changed), (first, past), (*joined, change), leading, grid)


def _correlated_share(
    xv: Array, yv: Array, lines: Array, first: Indices, past: Indices, length: Array | None
) -> Array:
    """Return the noise of means of both channels over that of independent bins, (profile, 1)."""
    index = np.arange(xv.shape[1])
    inside = (index >= first[:, np.newaxis]) & (index < past[:, np.newaxis])
    analog = lines[:, _line_fit.SLOPE] ** 2 * np.where(inside, xv, 0.0).sum(axis=-1)
    photons = np.where(inside, yv, 0.0).sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = (analog * (1.0 if length is None else length) + photons) / (analog + photons)
    return np.where(np.isfinite(share), share, 1.0)[:, np.newaxis]


def _joined(
    x: Array, y: Array, xv: Array, yv: Array, lines: Array, near: Booleans
) -> tuple[Array, Array, Array]:
    """Return signal, noise variance and variance by the line: scaled x where `near`, else y."""
    column = np.where(lines[:, _line_fit.SLOPE, np.newaxis] > 0.0, lines, np.nan).T[..., np.newaxis]
    slope = column[_line_fit.SLOPE]
    with np.errstate(invalid="ignore", over="ignore"):
        power = np.where(near, slope * x + column[_line_fit.INTERCEPT], y)
        valid = (np.abs(power) < _line_fit.HUGE) & (slope > 0.0)
        lever = x - column[_line_fit.CENTRE]
        of_line = column[_line_fit.SLOPE_VARIANCE] * lever * lever
        of_line = of_line + column[_line_fit.CENTRE_VARIANCE]
        variance, systematic = np.where(near, slope * slope * xv, yv), np.where(near, of_line, 0.0)
    power[~valid] = variance[~valid] = systematic[~valid] = np.nan
    return power, variance, systematic


def _rows(
    values: npt.ArrayLike, name: str, grid: inputs.RangeGrid
) -> tuple[Array, tuple[int, ...]]:
    array = inputs.real_array(values, name)
    if array.ndim == 0 or array.shape[-1] != grid.size:
        raise RetrievalInputError(
            f"has the shape {array.shape}, but range has {grid.size} bins",
            field=name,
            remedy="the last axis is range",
        )
    rows = grid.turn(array).reshape(-1, grid.size).astype(np.float64, copy=False)
    return frozen(rows), array.shape[:-1]


def _variance(
    values: npt.ArrayLike, name: str, grid: inputs.RangeGrid, leading: tuple[int, ...]
) -> Array:
    rows = inputs.noise_rows(values, name, grid, leading)
    if np.any(rows < 0):
        raise RetrievalInputError("is negative", field=name)
    count = int(np.prod(leading, dtype=np.int64))
    return frozen(np.broadcast_to(rows, (count, grid.size)))


def _search(x: Array, y: Array, xv: Array, highest: Array) -> tuple[Indices, Indices]:
    """Return first and past-the-last bin of the window of each profile, (0, 0) for none."""
    rate = _smooth(y)
    with np.errstate(invalid="ignore"):
        usable = (rate >= THRESHOLDS.count_rates[0]) & (rate <= highest[:, np.newaxis])
    usable &= _is_lit(x, xv)
    first, past = np.zeros((2, len(x)), dtype=np.intp)
    _line_fit.longest_runs(usable, first, past)
    index = np.arange(rate.shape[1])
    inside = (index >= first[:, np.newaxis]) & (index < past[:, np.newaxis])
    highest_rate = np.where(inside, rate, 0.0).max(axis=1, initial=0.0)
    lowest_rate = np.where(inside, rate, np.inf).min(axis=1, initial=np.inf)
    wide = past - first >= THRESHOLDS.fewest_glued_bins
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
    _line_fit.running_means(frozen(values), THRESHOLDS.smoothing // 2, smooth)
    return smooth


def _misfits(lines: Array) -> Booleans:
    """Return which lines have a chi-square that noise does not explain."""
    freedom = _degrees_of_freedom(lines)
    noise = special.chdtri(freedom, THRESHOLDS.misfit_false_alarm)
    largest = np.maximum(THRESHOLDS.largest_misfit * freedom, noise)
    with np.errstate(invalid="ignore"):
        return np.asarray(lines[:, _line_fit.CHI2] > largest)


def _degrees_of_freedom(lines: Array) -> Integers:
    return np.maximum(np.nan_to_num(lines[:, _line_fit.POINTS]).astype(np.int64) - 2, 0)


def _result(
    fits: tuple[Array, Array],
    window: tuple[Indices, Indices],
    joined: tuple[Array, Array, Array, Array],
    leading: tuple[int, ...],
    grid: inputs.RangeGrid,
) -> GluedSignal:
    lines, misfit = fits[0], [_misfits(fit) for fit in fits]
    first, past = window
    empty = past == 0
    start = np.where(empty, np.nan, grid.values[first])
    stop = np.where(empty, np.nan, grid.values[np.maximum(past - 1, 0)])
    slope = lines[:, _line_fit.SLOPE]
    slope_error = np.sqrt(lines[:, _line_fit.SLOPE_VARIANCE])
    intercept_error = np.sqrt(
        lines[:, _line_fit.CENTRE_VARIANCE] + (lines[:, _line_fit.CENTRE] * slope_error) ** 2
    )
    with np.errstate(invalid="ignore"):
        poor_fit = misfit[0] | ~(slope >= THRESHOLDS.least_slope * slope_error)
    power, variance, systematic, change = (
        grid.turn(values.reshape(*leading, grid.size)) for values in joined
    )
    return GluedSignal(
        power=power,
        variance=variance,
        systematic_variance=systematic,
        change=change,
        slope=slope.reshape(leading),
        slope_standard_error=slope_error.reshape(leading),
        intercept=lines[:, _line_fit.INTERCEPT].reshape(leading),
        intercept_standard_error=intercept_error.reshape(leading),
        chi2=lines[:, _line_fit.CHI2].reshape(leading),
        degrees_of_freedom=_degrees_of_freedom(lines).reshape(leading),
        start=start.reshape(leading),
        stop=stop.reshape(leading),
        no_window=empty.reshape(leading),
        poor_fit=(poor_fit & ~empty).reshape(leading),
        misfit=(misfit[0] & misfit[1]).reshape(leading),
    )
