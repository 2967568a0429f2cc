"""Gluing of analog and photon-counting signals in the range where both are linear."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt
from scipy import special

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.frozen_arrays import frozen
from lidarops.retrieve.signal import _line_fit, averaging

Array = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]
Indices = npt.NDArray[np.intp]
_Scalar = TypeVar("_Scalar", bound=np.generic)

COUNT_RATES: Final = (0.5, 20.0)
"""MHz; between them photon counting, corrected for dead time, is linear and above its noise."""
LEAST_SNR: Final = 10.0
"""Least signal-to-noise ratio of the analog signal in the window."""
FEWEST_BINS: Final = 8
"""Fewest bins of a window."""
LEAST_FALL: Final = 1.5
"""Factor by which the smoothed count rate must fall within a window."""
SMOOTHING: Final = 31
"""Bins over which signals are averaged before the window is chosen. Edges that follow the noise
of single bins would bias the slope."""
LEAST_SLOPE: Final = 5.0
"""Standard errors by which the slope must exceed 0."""
_LARGEST_MISFIT: Final = 1.5
"""Largest chi-square of the line over its degrees of freedom, for many bins."""
_FALSE_ALARM: Final = 1e-4
"""Probability with which noise exceeds the largest chi-square, for few bins."""


class _HandOver(StrEnum):
    """Transition of the glued signal from analog to photon counting."""

    BLEND = "blend"
    """Inverse-variance mean of both within the window."""
    SWITCH = "switch"
    """Abrupt, in the middle of the window."""


@dataclass(frozen=True, slots=True)
class GluedSignal:
    """Glued signals, and the line that scales analog to photon counting, for each profile."""

    power: Array
    """(..., range), MHz: analog near, photon counting far; NaN where there is no line."""
    variance: Array
    """(..., range), MHz2, noise variance."""
    systematic_variance: Array
    """(..., range), MHz2, by the error of the line: common to all bins and profiles of a block,
    so it does not average down."""
    slope: Array
    """(...), MHz mV-1."""
    slope_standard_error: Array
    intercept: Array
    """(...), MHz: 0 within its error if both backgrounds are right."""
    intercept_standard_error: Array
    chi2: Array
    """(...), of the line."""
    degrees_of_freedom: npt.NDArray[np.int64]
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


def glue(
    analog: npt.ArrayLike,
    photon_counting: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    *,
    analog_variance: npt.ArrayLike,
    photon_variance: npt.ArrayLike,
    count_rate_window: tuple[float, float] = COUNT_RATES,
    least_snr: float = LEAST_SNR,
    photon_background: npt.ArrayLike = 0.0,
    block: npt.ArrayLike | None = None,
    correlation: float = 0.0,
    hand_over: str = "blend",
) -> GluedSignal:
    r"""Return analog signals scaled to photon counting by a line, joined with photon counting.

    The line :math:`y = s x + a` minimises

    .. math:: \chi^2 = \sum \frac{(y_i - s x_i - a)^2}
                    {v_{y,i} + s^2 v_{x,i} - 2 s \rho \sqrt{v_{x,i} v_{y,i}}}

    by 4 iterations of the equations of york2004, starting with the ratio of the spreads. A
    regression on noisy analog values would give too small a slope. The window is the longest run
    of bins in which the smoothed mean of a block has a count rate within `count_rate_window`,
    and an analog value of at least `least_snr` times the noise of one bin of one profile.

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
    count_rate_window : (float, float)
        MHz; the upper limit applies to signal plus background.
    least_snr : float
        Least signal-to-noise ratio of the analog signal.
    photon_background : (...) float
        MHz, the background that was subtracted from photon counting.
    block : (...) int, optional
        Profiles with equal numbers share a window and a line. Where not given, each profile has
        its own.
    correlation : float
        Correlation of the noise of both in a bin, from -1 to 1, because shot noise is common. If
        noise is correlated, 0 makes the standard errors too large and the variance of a blend
        too small.
    hand_over : {"blend", "switch"}

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
    transition = inputs.choice(hand_over, _HandOver, "hand_over")
    _check_limits(count_rate_window, least_snr, correlation)
    x, leading = _rows(analog, "analog", grid)
    y, photon_leading = _rows(photon_counting, "photon_counting", grid)
    if photon_leading != leading:
        raise RetrievalInputError(
            f"has the leading shape {photon_leading}, analog {leading}", field="photon_counting"
        )
    xv = _variance(analog_variance, "analog_variance", grid, leading)
    yv = _variance(photon_variance, "photon_variance", grid, leading)
    sky = inputs.profile_values(photon_background, "photon_background", leading)
    block_index = _blocks(block, leading)
    blocks = int(block_index.max(initial=-1)) + 1
    top = np.full(len(x), count_rate_window[1]) - (0.0 if sky is None else sky)
    first, past = _search(x, y, xv, block_index, top, count_rate_window[0], least_snr)
    lines = np.full((blocks, _line_fit.COLUMNS), np.nan)
    order = np.argsort(block_index, kind="stable")
    starts = np.searchsorted(block_index[order], np.arange(blocks + 1))
    _line_fit.fit_lines(x, y, xv, yv, float(correlation), order, starts, first, past, lines)
    near, far = first, past
    if transition is _HandOver.SWITCH:
        near = far = (first + past) // 2
    glued = np.empty((3, *x.shape))
    _line_fit.combine(x, y, xv, yv, float(correlation), lines, block_index, near, far, glued)
    bounds = _bounds(grid.values, first, past)
    return _result(lines, block_index, bounds, glued, leading, grid)


def _check_limits(rates: tuple[float, float], least_snr: float, correlation: float) -> None:
    if not 0 < rates[0] < rates[1]:
        raise RetrievalInputError(
            f"is {rates}", field="count_rate_window", remedy="give two rates in MHz, rising"
        )
    if not least_snr >= 0:
        raise RetrievalInputError(f"is {least_snr}", field="least_snr", remedy="give 0 or more")
    if not -1 < correlation < 1:
        raise RetrievalInputError(
            f"is {correlation}", field="correlation", remedy="choose between -1 and 1"
        )


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


def _blocks(block: npt.ArrayLike | None, leading: tuple[int, ...]) -> Indices:
    """Return the index of the block of each profile."""
    count = int(np.prod(leading, dtype=np.int64))
    if block is None:
        return np.arange(count)
    labels = np.asarray(block)
    if labels.dtype.kind not in "iu":
        raise RetrievalInputError(f"holds {labels.dtype}", field="block", remedy="give integers")
    try:
        labels = np.broadcast_to(labels, leading).reshape(count)
    except ValueError:
        raise RetrievalInputError(
            f"has the shape {labels.shape}, which does not broadcast to the shape {leading} of"
            " the profiles",
            field="block",
        ) from None
    return np.unique(labels, return_inverse=True)[1].reshape(count).astype(np.intp)


def _search(
    x: Array,
    y: Array,
    xv: Array,
    block_index: Indices,
    top: Array,
    bottom: float,
    least_snr: float,
) -> tuple[Indices, Indices]:
    """Return first and past-the-last bin of the window of each block, (0, 0) for none."""
    analog = averaging.time_mean(x, xv, groups=block_index)
    rate = _smooth(averaging.time_mean(y, 0.0, groups=block_index).values)
    rate_limit = np.full(len(rate), np.inf)
    np.minimum.at(rate_limit, block_index, top)
    with np.errstate(invalid="ignore"):
        noise = np.sqrt(_smooth(analog.variance * analog.count))
        above_noise = _smooth(analog.values) >= least_snr * noise
        usable_bins = (rate >= bottom) & (rate <= rate_limit[:, np.newaxis]) & above_noise
    first, past = (np.zeros(len(usable_bins), dtype=np.intp) for _ in (0, 1))
    _line_fit.longest_runs(usable_bins, first, past)
    index = np.arange(rate.shape[1])
    inside = (index >= first[:, np.newaxis]) & (index < past[:, np.newaxis])
    highest_rate = np.where(inside, rate, 0.0).max(axis=1, initial=0.0)
    lowest_rate = np.where(inside, rate, np.inf).min(axis=1, initial=np.inf)
    usable = (past - first >= FEWEST_BINS) & (highest_rate >= LEAST_FALL * lowest_rate)
    return np.where(usable, first, 0), np.where(usable, past, 0)


def _smooth(values: Array) -> Array:
    """Return averages over `SMOOTHING` bins, fewer at the ends, skipping NaN."""
    smooth = np.empty(values.shape)
    _line_fit.running_means(frozen(values), SMOOTHING // 2, smooth)
    return smooth


def _bounds(range_: Array, first: Indices, past: Indices) -> tuple[Array, Array]:
    empty = past == 0
    return (
        np.where(empty, np.nan, range_[first]),
        np.where(empty, np.nan, range_[np.maximum(past - 1, 0)]),
    )


def _result(
    lines: Array,
    block_index: Indices,
    bounds: tuple[Array, Array],
    glued: Array,
    leading: tuple[int, ...],
    grid: inputs.RangeGrid,
) -> GluedSignal:
    freedom = np.maximum(np.nan_to_num(lines[:, _line_fit.POINTS]).astype(np.int64) - 2, 0)
    slope, chi2 = lines[:, _line_fit.SLOPE], lines[:, _line_fit.CHI2]
    slope_error = np.sqrt(lines[:, _line_fit.SLOPE_VARIANCE])
    intercept_error = np.sqrt(
        lines[:, _line_fit.CENTRE_VARIANCE] + (lines[:, _line_fit.CENTRE] * slope_error) ** 2
    )
    largest = np.maximum(_LARGEST_MISFIT * freedom, special.chdtri(freedom, _FALSE_ALARM))
    with np.errstate(invalid="ignore"):
        poor_fit = (chi2 > largest) | ~(slope >= LEAST_SLOPE * slope_error)
    empty = np.isnan(bounds[0])
    shape = (*leading, grid.size)

    def per_profile(values: npt.NDArray[_Scalar]) -> npt.NDArray[_Scalar]:
        return values[block_index].reshape(leading)

    power, variance, systematic = (grid.turn(values.reshape(shape)) for values in glued)
    return GluedSignal(
        power=power,
        variance=variance,
        systematic_variance=systematic,
        slope=per_profile(slope),
        slope_standard_error=per_profile(slope_error),
        intercept=per_profile(lines[:, _line_fit.INTERCEPT]),
        intercept_standard_error=per_profile(intercept_error),
        chi2=per_profile(chi2),
        degrees_of_freedom=per_profile(freedom),
        start=per_profile(bounds[0]),
        stop=per_profile(bounds[1]),
        no_window=per_profile(empty),
        poor_fit=per_profile(poor_fit & ~empty),
    )
