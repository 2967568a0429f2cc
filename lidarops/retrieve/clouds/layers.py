"""Detection of clouds and other layers with a steep base."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.clouds.thresholds import THRESHOLDS
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import HUGE, Array, Booleans, Integers, frozen, usable
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.signal.averaging import skewness_margin
from lidarops.retrieve.signal.noise_correlation import estimate_noise_correlation
from lidarops.retrieve.signal.thresholds import THRESHOLDS as SIGNAL_THRESHOLDS

_ROUNDING: Final = 1e-9
"""Relative rise that the rounding of sums can cause."""

# Rows of the sums.
POWER, SHAPE, VARIANCE, COUNT = 0, 1, 2, 3


def find_layers(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    variance: npt.ArrayLike,
    *,
    molecular_attenuated: npt.ArrayLike,
    contrast: float = SIGNAL_THRESHOLDS.cloud_contrast,
    false_alarm: float = COMMON.false_alarm,
    quantum: npt.ArrayLike = 0.0,
) -> Booleans:
    r"""Return the bins in layers at whose base the scattering ratio rises by more than a factor.

    Layers are marked from base to apparent top, the last bin before the signal is back at its level
    below the base and falls no more: below the true top where a layer hides its upper part in
    noise.

    Let :math:`\rho = \sum P / \sum \phi` be the ratio of the power to the molecular shape in two
    adjoining windows, below and above a bin. The bin is a base where

    .. math:: \frac{\rho_+ - \rho_-}{\sqrt{\sigma_+^2 + \sigma_-^2}} > t, \qquad
       \frac{\rho_+ - c \rho_-}{\sqrt{\sigma_+^2 + c^2 \sigma_-^2}} > u

    for at least one length of the windows. Noise may rise in any bin: :math:`t` is the quantile of
    the normal distribution for the false-alarm rate over the number of bins and lengths
    (Bonferroni bound). An edge of aerosol is in one place, where noise may decide beside it as
    well: :math:`u` is the quantile for half the rate over the number of lengths. So a profile of
    air, and one with an edge of aerosol that rises by :math:`c`, are flagged with a probability
    of the false-alarm rate at most. Both are multiplied by the factor by which the noise of means
    over :math:`L` bins exceeds the stated one in the far half of the profile, with four standard
    errors (`lidarops.retrieve.signal.noise_correlation`).
    The layer begins where the statistic peaks, or below, from where the ratio no longer falls
    downwards: its lower part may be thin. The top is where the mean of the next window is again
    within 2 standard errors of the level below the steepest rise, and from where the ratio no
    longer falls: a layer that attenuates, or whose upper part is thin, is still brighter than the
    air above it where it is no brighter than that below it. The ratio falls where the mean of a
    window exceeds that of the next one, or of the next eight (four below the layer), by
    :math:`1 + (c - 1) / 10`, with :math:`u`. The window is the shortest in which noise does not
    hide a fall by :math:`(c - 1) / 4`.

    A layer that begins within one window of the first bin is not detected. With a `contrast` of
    1 all layers are detected that rise significantly.

    Parameters
    ----------
    power : (..., range) float
        Any unit, background subtracted, not range-corrected; NaN where missing or where the
        overlap is incomplete.
    range : (range,) float
        m, uniform or nearly so.
    variance : (..., range) float
        Noise variance in the square of the power's unit, broadcast against `power`.
    molecular_attenuated : (..., range) float
        The shape :math:`\phi = \beta_m T_m^2 / R^2` times any constant, broadcast against
        `power`.
    contrast : float
        The factor :math:`c`, at least 1.
    false_alarm : float
        Probability of a false layer in a profile.
    quantum : (...) float
        Power of a bin with a single count, broadcast to the profiles: the counts above a base must
        exceed the limit by a margin for their skewness (`skewness_margin`). 0 for many counts.

    Returns
    -------
    (..., range) bool

    Raises
    ------
    RetrievalInputError
        For invalid arguments.

    References
    ----------
    pal1992, wang2001.
    """
    tests = _tests(power, range, variance, molecular_attenuated, contrast, false_alarm, quantum)
    mask = np.zeros(tests.power.shape, dtype=np.bool_)
    _mark_layers(
        frozen(tests.power),
        frozen(tests.variance),
        frozen(tests.shape),
        tests.lengths,
        float(contrast),
        tests.certainty,
        frozen(tests.limits),
        frozen(tests.margins),
        mask,
    )
    return mask.reshape(*tests.leading, tests.power.shape[-1])


def find_visible_air(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    variance: npt.ArrayLike,
    *,
    cloudy: Booleans,
    molecular_attenuated: npt.ArrayLike,
    contrast: float = SIGNAL_THRESHOLDS.cloud_contrast,
    quantum: npt.ArrayLike = 0.0,
) -> Booleans:
    r"""Return the bins in which noise would not hide a layer, (..., range).

    The layer is 480 m deep, with twice the least excess over the air around it: a ratio of
    :math:`2 c - 1`. With the mean ratio :math:`\rho` of the bins outside of layers that lie within
    half that depth, and its variance :math:`\sigma^2`, it passes both tests of `find_layers` where

    .. math:: \frac{(2 c - 2) \rho}{\sqrt 2\,\sigma} \geq t, \qquad
       \frac{(c - 1) \rho}{\sigma \sqrt{1 + c^2}} \geq u .

    Noise that lowers its rise hides it in half of the cases at the limit.

    Parameters
    ----------
    power, range, variance, molecular_attenuated, contrast, quantum
        As for `find_layers`.
    cloudy : (..., range) bool
        Bins in layers.

    Raises
    ------
    RetrievalInputError
        For invalid arguments.
    """
    rate = COMMON.false_alarm
    tests = _tests(power, range, variance, molecular_attenuated, contrast, rate, quantum)
    bins = max(round(THRESHOLDS.visible_depth / tests.step), 2)
    of_depth = int(np.searchsorted(tests.lengths, bins))
    marked = np.reshape(cloudy, tests.power.shape)
    excess = THRESHOLDS.visible_excess * (contrast - 1.0)
    visible = np.zeros(tests.power.shape, dtype=np.bool_)
    _mark_visible(
        (
            frozen(np.where(marked, np.nan, tests.power)),
            frozen(tests.variance),
            frozen(tests.shape),
        ),
        bins,
        (frozen(tests.limits[:, of_depth]), frozen(tests.margins[:, of_depth])),
        (excess, math.sqrt(2.0)),
        (excess + 1.0 - contrast, tests.certainty * math.hypot(1.0, contrast)),
        visible,
    )
    return visible.reshape(*tests.leading, -1)


@dataclass(frozen=True, slots=True)
class _Tests:
    """Profiles, and what a rise is compared with."""

    leading: tuple[int, ...]
    step: float
    """m."""
    power: Array
    """(profile, bin)."""
    variance: Array
    """(profile or 1, bin)."""
    shape: Array
    """(profile or 1, bin)."""
    lengths: Integers
    """Bins of the windows, ascending."""
    certainty: float
    """Share of `limits` by which the rise exceeds the contrast."""
    limits: Array
    """Standard errors of the rise, (profile, length)."""
    margins: Array
    """Sums of power above a base that are subtracted there, (profile, length)."""


def _tests(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    variance: npt.ArrayLike,
    molecular_attenuated: npt.ArrayLike,
    contrast: float,
    false_alarm: float,
    quantum: npt.ArrayLike,
) -> _Tests:
    """Return the validated arguments of `find_layers` and the limits of its tests."""
    grid = inputs.range_grid(range)
    values, leading, shape = inputs.profiles_and_air(power, molecular_attenuated, grid)
    noise = inputs.noise_rows(variance, "variance", grid, leading, negative=False)
    if not 1.0 <= contrast < np.inf:
        raise RetrievalInputError(f"is {contrast}", field="contrast", remedy="give 1 or more")
    step = float(np.median(np.diff(grid))) if grid.size > 1 else 1.0
    # A window has at least two bins.
    lengths = np.unique(np.maximum(np.rint(np.array(THRESHOLDS.window_lengths) / step), 2.0))
    anywhere, at_an_edge = -ndtri(false_alarm / lengths.size / np.array([grid.size, 2.0]))
    limits = anywhere * _excess_noise(values, noise, lengths)
    margins = skewness_margin(limits) * np.reshape(quantum, (-1, 1))
    return _Tests(
        leading, step, values, noise, shape, lengths.astype(np.int64),
        float(at_an_edge / anywhere), limits, np.broadcast_to(margins, limits.shape),
    )  # fmt: skip


def _excess_noise(power: Array, variance: Array, lengths: Array) -> Array:
    """Return the noise of means over each length relative to the stated one, (profile, length)."""
    noise = estimate_noise_correlation(power, variance)
    of_means = noise.excess[:, np.newaxis] * noise.variance_of_means(lengths)
    # Three standard errors more: noise that is estimated too small by chance makes layers.
    return np.asarray(np.sqrt(of_means * (1.0 + 3.0 * noise.relative_error[:, np.newaxis])))


@compiled
def _accumulate(power: Array, variance: Array, shape: Array, sums: Array) -> None:
    """Sum from the far end, so that sums over far bins keep their digits."""
    signal = air = noise = count = 0.0
    sums[:, power.size] = 0.0
    for j in range(power.size):
        i = power.size - 1 - j
        if usable(power[i], variance[i]):
            signal += power[i]
            air += shape[i]
            noise += variance[i]
            count += 1.0
        sums[POWER, i], sums[SHAPE, i], sums[VARIANCE, i], sums[COUNT, i] = (
            signal,
            air,
            noise,
            count,
        )


@compiled
def _mark_visible(
    signals: tuple[Array, Array, Array],
    bins: int,
    tests: tuple[Array, Array],
    rise: tuple[float, float],
    excess: tuple[float, float],
    visible: Booleans,
) -> None:
    """Mark the bins around which a layer, of a number of bins, would pass both tests.

    `signals` are powers, variances and shapes of air, as for `_mark_layers`, `tests` the standard
    errors of the rise and the sums of power that are subtracted, (profile,), and `rise` and
    `excess` of both tests the excess over the ratio to air, and errors over those of the sum.
    """
    powers, variances, shapes = signals
    size = int(powers.shape[1])
    sums = np.empty((4, size + 1))
    for k in range(powers.shape[0]):
        variance, shape = variances[k % variances.shape[0]], shapes[k % shapes.shape[0]]
        _accumulate(powers[k], variance, shape, sums)
        limit, margin = tests[0][k], tests[1][k]
        for i in range(size):
            first = max(i - bins // 2, 0)
            past = min(i - bins // 2 + bins, size)
            signal = sums[POWER, first] - sums[POWER, past]
            error = limit * math.sqrt(sums[VARIANCE, first] - sums[VARIANCE, past])
            visible[k, i] = (
                signal > 0.0
                and sums[SHAPE, first] - sums[SHAPE, past] > 0.0
                and rise[0] * signal - margin >= rise[1] * error
                and excess[0] * signal - margin >= excess[1] * error
            )


@compiled
def _mean(sums: Array, first: int, stop: int) -> tuple[float, float]:
    """Return the mean ratio to air and its variance; NaN with data in less than half the bins."""
    if first < 0 or stop >= sums.shape[1]:
        return np.nan, np.nan
    count = sums[COUNT, first] - sums[COUNT, stop]
    shape = sums[SHAPE, first] - sums[SHAPE, stop]
    if 2.0 * count < stop - first or not shape > 0.0:
        return np.nan, np.nan
    ratio = (sums[POWER, first] - sums[POWER, stop]) / shape
    return ratio, (sums[VARIANCE, first] - sums[VARIANCE, stop]) / (shape * shape)


@compiled
def _rise(
    sums: Array, i: int, length: int, contrast: float, certainty: float, limit: float, margin: float
) -> float:
    """Return by how many standard errors the rise of the ratio to air exceeds `contrast`.

    0 where no layer begins: the rise is within `limit` standard errors, or exceeds `contrast` by
    less than the share `certainty` of them. The sum above is taken to be less by `margin`.
    """
    first, stop = i - length, i + length
    if first < 0 or stop >= sums.shape[1]:
        return 0.0
    # Most bins end here, without a division.
    below = (sums[POWER, first] - sums[POWER, i]) * (sums[SHAPE, i] - sums[SHAPE, stop])
    above = (sums[POWER, i] - sums[POWER, stop]) * (sums[SHAPE, first] - sums[SHAPE, i])
    if not above > contrast * below:
        return 0.0
    low, low_variance = _mean(sums, first, i)
    high, high_variance = _mean(sums, i, stop)
    high -= margin / (sums[SHAPE, i] - sums[SHAPE, stop])
    if not high - low >= limit * math.sqrt(high_variance + low_variance):
        return 0.0
    excess = high - contrast * low
    if not excess > _ROUNDING * high:
        return 0.0
    error = math.sqrt(high_variance + contrast * contrast * low_variance)
    if excess < certainty * limit * error:
        return 0.0
    return excess / error if error > 0.0 else HUGE


@compiled
def _steepest(
    sums: Array,
    start: int,
    reach: int,
    lengths: Integers,
    contrast: float,
    certainty: float,
    limits: Array,
    margins: Array,
) -> tuple[int, int]:
    """Return the bin of the steepest rise for the shortest window that shows it, and its length."""
    stop = min(start + reach + 1, int(sums.shape[1]) - 1)
    for k, length in enumerate(lengths):
        best, highest = start, 0.0
        for i in range(start, stop):
            rise = _rise(sums, i, length, contrast, certainty, limits[k], margins[k])
            if rise > highest:
                best, highest = i, rise
        if highest > 0.0:
            break
    return best, length


@compiled
def _next_base(
    sums: Array,
    start: int,
    lengths: Integers,
    contrast: float,
    certainty: float,
    limits: Array,
    margins: Array,
) -> tuple[int, int]:
    """Return the bin where the next layer begins and the window length that shows it; or -1."""
    for i in range(start, sums.shape[1] - 1):
        for k, length in enumerate(lengths):
            if _rise(sums, i, length, contrast, certainty, limits[k], margins[k]) > 0.0:
                return _steepest(sums, i, length, lengths, contrast, certainty, limits, margins)
    return -1, 0


@compiled
def _end(sums: Array, base: int, length: int) -> int:
    """Return the first bin from which the ratio to air is back at its level below the base.

    Bins without data, as saturated ones, do not end a layer; where none follows with data, it ends
    before them.
    """
    level, level_variance = _mean(sums, base - length, base)
    bins = int(sums.shape[1]) - 1
    end = base + 1
    for i in range(base + 1, bins):
        ratio, variance = _mean(sums, i, min(i + length, bins))
        if ratio > level + COMMON.by_noise * math.sqrt(variance + level_variance):
            end = i + 1
        elif not math.isnan(ratio):
            return i
    return end


@compiled
def _mean_towards(sums: Array, i: int, length: int, side: int) -> tuple[float, float]:
    """Return the mean ratio to air and its variance above (`side` 1) or below (-1) a bin's edge."""
    first = i if side > 0 else i - length
    return _mean(sums, first, first + length)


@compiled
def _falls(
    sums: Array,
    i: int,
    length: int,
    beyond: int,
    side: int,
    contrast: float,
    least: float,
    margin: float,
) -> bool:
    """Return whether the ratio to air exceeds that of the window beyond by more than `contrast`.

    By more than `least` standard errors, and it does not rise within the window.
    """
    stop = i + side * length
    high, high_variance = _mean_towards(sums, i, length, side)
    low, low_variance = _mean_towards(sums, stop, beyond, side)
    # With too high a background the ratio falls for ever, below zero.
    excess = high - contrast * max(low, 0.0) - margin / abs(sums[SHAPE, i] - sums[SHAPE, stop])
    error = math.sqrt(high_variance + contrast * contrast * low_variance)
    if not excess > max(least * error, _ROUNDING * high):
        return False
    # Within a window that begins in the gap before another layer it rises.
    half = length // 2
    near, near_variance = _mean_towards(sums, i, half, side)
    far, far_variance = _mean_towards(sums, i + side * half, length - half, side)
    return not far - near > COMMON.by_noise * math.sqrt(near_variance + far_variance)


@compiled
def _edge(
    sums: Array,
    start: int,
    last: int,
    beyond: int,
    lengths: Integers,
    contrast: float,
    certainty: float,
    limits: Array,
    margins: Array,
) -> int:
    """Return the edge of a bin, from `start` to `last`, from which the ratio no longer falls.

    The window is the shortest in which noise does not hide such a fall: a longer one would reach
    the edge of aerosol beyond the layer.
    """
    slight = 1.0 + THRESHOLDS.least_fall * (contrast - 1.0)
    side = 1 if last >= start else -1
    for i in range(start, last, side):
        falls = False
        for k, length in enumerate(lengths):
            least = certainty * limits[k]
            for windows in (1, beyond):
                falls = falls or _falls(
                    sums, i, length, windows * length, side, slight, least, margins[k]
                )
            level, variance = _mean_towards(sums, i + side * length, length, side)
            if falls or THRESHOLDS.visible_fall * (contrast - 1.0) * level > least * math.sqrt(
                2.0 * variance
            ):
                break
        if not falls:
            return i
    return last


@compiled
def _mark_layers(
    power: Array,
    variance: Array,
    shape: Array,
    lengths: Integers,
    contrast: float,
    certainty: float,
    limits: Array,
    margins: Array,
    layers: Booleans,
) -> None:
    """Mark the bins between base and top of all layers of each profile.

    Parameters
    ----------
    power : (profile, bin) float64
    variance, shape : (profile or 1, bin) float64
    lengths : (scale,) int64
        Bins that are averaged below and above a base, ascending.
    contrast : float
        Least factor by which the ratio to air rises.
    certainty : float
        Share of `limits` by which the rise exceeds that factor.
    limits : (profile, scale) float64
        Standard errors of the rise.
    margins : (profile, scale) float64
        Sums of power above a base that are subtracted there.
    layers : (profile, bin) bool
        Output, False before.
    """
    bins = int(power.shape[1])
    sums = np.empty((4, bins + 1))
    below, beyond = THRESHOLDS.windows_below, THRESHOLDS.windows_beyond
    for k in range(power.shape[0]):
        noise, air = variance[k % variance.shape[0]], shape[k % shape.shape[0]]
        _accumulate(power[k], noise, air, sums)
        end = 0
        while True:
            base, length = _next_base(
                sums, end, lengths, contrast, certainty, limits[k], margins[k]
            )
            if base < 0:
                break
            first = _edge(
                sums, base, end, below, lengths, contrast, certainty, limits[k], margins[k]
            )
            end = _end(sums, base, length)
            end = _edge(
                sums, end, bins, beyond, lengths, contrast, certainty, limits[k], margins[k]
            )
            layers[k, first:end] = True
