"""Choice of the reference window: where a profile has the shape of particle-free air."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntFlag
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import HUGE, Array, Booleans, Flags, frozen
from lidarops.retrieve.common.compiled_code import compiled, inlined, summing
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON

_SHORTEST: Final = 1e-9
"""m; half length of a window of one bin, to divide by."""
_DEPENDENT: Final = 1e-12
"""Squared share of a polynomial outside the span of lower ones, below which it is rounding."""

# Values that `_compare_with_air` writes for each window.
SCALE, SCALE_ERROR, SLOPE, SLOPE_ERROR = 0, 1, 2, 3
CURVATURE, SCATTER, COUNT, EXCLUDED_BINS = 4, 5, 6, 7
RESPONSE: Final = 8
FIELDS: Final = 9

_PROBABLE: Final = 1.645
"""Standard errors that 95 % of normal errors do not exceed."""


class Thresholds(NamedTuple):
    """Limits of the window in which a profile has the shape of clean air."""

    steps_per_window: int = 4
    """Candidates that start within the width of one. Assumed."""
    undetected_particles: float = 0.5
    """Errors of the lowest ratio by which particles that the comparison cannot show may raise a
    window beside the measured excess. With a layer of scattering ratio 1.15 in all windows but the
    lowest, less than 0.1 % of backscatter is false for 0.5, 0.44 % for 0
    (`test_a_layer_in_most_windows_gives_few_false_values`). From 1 on, more than 98 % of
    backscatter at 355 nm is covered where there is none."""
    most_noise: float = 1.3
    """Error of a window over the least one of equally clean windows, up to which a higher one is
    preferred, because particles decrease with height. In the published Raman simulation,
    particles of the best determined windows make backscatter at 532 nm too small by a quarter
    (`tests/retrieve/raman/test_raman_published.py`)."""


THRESHOLDS: Final = Thresholds()


class Rejection(IntFlag):
    """Reason for which a candidate window is rejected."""

    TOO_FEW_BINS = 1 << 0
    """Fewer than 8 bins, or less than half of the window, hold data."""
    EXCLUDED = 1 << 1
    """A layer or another excluded bin lies in the window."""
    LOW_SIGNAL = 1 << 2
    """The mean of the window does not exceed zero by enough of its standard errors."""
    SLOPE = 1 << 3
    """The ratio to the air changes linearly along the window."""
    CURVATURE = 1 << 4
    """The ratio to the air is curved along the window."""
    SCATTER = 1 << 5
    """The ratio to the air scatters more than its noise explains."""
    MORE_PARTICLES = 1 << 6
    """Another window, which may be a noisy one, has a lower ratio to the air."""


@dataclass(frozen=True, slots=True)
class ReferenceWindow:
    """The chosen window of each profile, with the leading axes of the power.

    Where no candidate passes, floats are NaN.
    """

    chosen: Booleans
    bottom: Array
    """m."""
    top: Array
    """m."""
    scale: Array
    """Power over the molecular shape, averaged over the window with inverse variances."""
    scale_standard_error: Array
    comparison_standard_error: Array
    """Error by noise of the scale of the anchor, with which the window is compared; 0 where there
    is one candidate."""
    excess: Array
    """Scale above that of the anchor beyond noise and baseline: the root of the square of the
    difference less the variance of the difference; 0 where the anchor itself is chosen."""
    detection_limit: Array
    """Scattering ratio minus 1 of particles in the window that the comparison with other windows
    shows with a probability of 0.95. Infinite where no other window is comparable."""
    rejections: Flags
    """(..., candidate): bits of `Rejection`; 0 for the chosen one and those equally clean."""

    @property
    def undetected_particles(self) -> Array:
        """Relative standard error of the scattering ratio by particles that noise hides.

        `Thresholds.undetected_particles` errors of the comparison with the anchor, for those that
        it could not have shown, and the excess over the anchor. Noise, background and baseline of
        the window itself are errors of their own, and no part of it.
        """
        unseen = THRESHOLDS.undetected_particles * self.comparison_standard_error
        return np.asarray(np.nan_to_num(np.hypot(unseen, self.excess) / self.scale))

    def relative_error(self, stated: float) -> Array:
        """Return the relative error of the scattering ratio: stated, and by hidden particles."""
        return np.hypot(stated, self.undetected_particles)


def candidate_windows(lowest: float, highest: float, width: float, step: float) -> Array:
    """Return windows of equal width at regular steps.

    Parameters
    ----------
    lowest, highest : float
        m; all windows lie between them.
    width, step : float
        m.

    Returns
    -------
    (candidate, 2) float
        m, bottom and top.

    Raises
    ------
    RetrievalInputError
        Where no window fits.
    """
    if not (0.0 < width <= highest - lowest and step > 0.0):
        raise RetrievalInputError(
            f"no window of {width:g} m, moved by {step:g} m, fits between {lowest:g} and"
            f" {highest:g} m",
            field="candidates",
            remedy="give m, with the width and step positive",
        )
    count = math.floor((highest - lowest - width) / step + 1e-9) + 1
    bottom = lowest + step * np.arange(count)
    return np.stack([bottom, bottom + width], axis=-1)


def choose_reference(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    variance: npt.ArrayLike,
    *,
    molecular_attenuated: npt.ArrayLike,
    candidates: Array,
    background_standard_error: npt.ArrayLike = 0.0,
    baseline_standard_error: npt.ArrayLike = 0.0,
    exclude: Booleans | None = None,
) -> ReferenceWindow:
    r"""Return the cleanest window; of equally clean ones, the highest that is well determined.

    In each candidate the power is fitted with the molecular shape :math:`\phi` by weighted
    least squares: :math:`P = \phi (a_0 + a_1 p_1(R) + a_2 p_2(R))`, with polynomials that are
    orthogonal under the noise, so the three tests are independent. A candidate passes where

    - at least 8 bins and half of the window hold data, and none is excluded;
    - :math:`a_0` exceeds k = 3 of its standard errors;
    - :math:`a_1` and :math:`a_2` are below k of theirs;
    - chi-square of the power against :math:`\phi a_0` is less than k standard deviations above its
      mean (as Gaussian: :math:`\chi^2/\nu < 1 + k \sqrt{2/\nu}`).

    The anchor is the window with the lowest upper bound of :math:`a_0`, at k standard errors, of
    those that pass all tests but that of :math:`a_0`: a noisy window can show that a less noisy one
    holds particles. Windows whose :math:`a_0` exceeds that of the anchor by more than k standard
    errors of the difference are rejected. The rest counts as equally clean. Of these, the last
    passing candidate whose standard error of :math:`a_0` is below `Thresholds.most_noise` times the
    smallest one is chosen, because particles decrease with height. That
    error follows from the variances and not from the power, so the choice favours no
    fluctuation. The tests favour one slightly, because they keep windows whose noise looks flat.
    In differences and upper bounds, the error :math:`\sigma_b` of the background is common to all
    windows: it shifts :math:`a_0` by :math:`g \sigma_b`,
    :math:`g = \sum(\phi / v) / \sum(\phi^2 / v)`.
    No test of shape detects a thin layer that the noise hides: include it in the error of the
    reference (`ReferenceWindow.undetected_particles`).

    Parameters
    ----------
    power : (..., range) float
        Any unit, background subtracted; NaN where missing.
    range : (range,) float
        m.
    variance : (..., range) float
        Noise variance in the square of the power's unit, broadcast against `power`.
    molecular_attenuated : (..., range) float
        The shape :math:`\phi = \beta_m T_m^2 / R^2` times any constant, broadcast against
        `power`.
    candidates : (candidate, 2) float
        m, bottom and top of each window; see `candidate_windows`.
    background_standard_error : (...) float
        In the unit of the power.
    baseline_standard_error : (..., range) float
        In the unit of the power, of its baseline, whose shape is not known: a part of the errors of
        :math:`a_0` that no two windows have in common.
    exclude : (..., range) bool, optional
        Bins that no window may contain, such as the mask of `layers.find_layers`.

    Returns
    -------
    ReferenceWindow
        No window is chosen where no candidate passes; `rejections` gives the reasons.

    Raises
    ------
    RetrievalInputError
        For invalid arguments.
    """
    grid = inputs.range_grid(range)
    rows, leading, shape = inputs.profiles_and_air(power, molecular_attenuated, grid)
    first = np.searchsorted(grid, candidates[:, 0], side="left")
    stop = np.searchsorted(grid, candidates[:, 1], side="right")
    edges = np.stack([first, stop], axis=-1).astype(np.int64)
    mask = np.zeros(grid.size) if exclude is None else exclude.astype(np.float64)
    excluded = inputs.noise_rows(mask, "exclude", grid, leading)
    statistics = np.full((rows.shape[0], len(candidates), FIELDS), np.nan)
    _compare_with_air(
        frozen(rows),
        frozen(inputs.noise_rows(variance, "variance", grid, leading, negative=False)),
        frozen(shape),
        frozen(grid),
        frozen(excluded),
        edges,
        statistics,
    )
    rejections = _rejections(statistics, np.diff(edges)[:, 0])
    level_error = inputs.real_array(background_standard_error, "background_standard_error")
    level_error = np.broadcast_to(level_error.astype(np.float64), leading).reshape(-1, 1)
    baseline = inputs.noise_rows(baseline_standard_error, "baseline_standard_error", grid, leading)
    middle = np.minimum(edges.sum(axis=1) // 2, grid.size - 1)
    by_baseline = statistics[..., RESPONSE] * baseline[:, middle]
    noise = statistics[..., SCALE_ERROR].copy()
    statistics[..., SCALE_ERROR] = np.hypot(noise, by_baseline)
    index, comparison_error, excess = _pick(statistics, rejections, level_error, noise)
    chosen = index >= 0
    profile = np.arange(index.size)

    def of_chosen(values: Array) -> Array:
        return np.where(chosen, values, np.nan).reshape(leading)

    return ReferenceWindow(
        chosen=chosen.reshape(leading),
        bottom=of_chosen(candidates[index, 0]),
        top=of_chosen(candidates[index, 1]),
        scale=of_chosen(statistics[profile, index, SCALE]),
        scale_standard_error=of_chosen(statistics[profile, index, SCALE_ERROR]),
        comparison_standard_error=of_chosen(comparison_error),
        excess=of_chosen(excess),
        detection_limit=of_chosen(
            _detection_limit(statistics, rejections, level_error, candidates, index)
        ),
        rejections=rejections.reshape(*leading, len(candidates)),
    )


def _rejections(statistics: Array, lengths: npt.NDArray[np.int64]) -> Flags:
    """Return the bits of `Rejection` of each window; 0 for those that pass all tests."""
    f, most = np.moveaxis(statistics, -1, 0), COMMON.significant
    count = np.nan_to_num(f[COUNT])
    freedom = np.maximum(count - 1.0, 1.0)
    fewest = np.maximum(COMMON.fewest_bins, COMMON.least_share * lengths)
    passes = {
        Rejection.TOO_FEW_BINS: count >= fewest,
        Rejection.EXCLUDED: ~(f[EXCLUDED_BINS] > 0.0),
        Rejection.LOW_SIGNAL: f[SCALE] > most * f[SCALE_ERROR],
        Rejection.SLOPE: np.abs(f[SLOPE]) <= most * f[SLOPE_ERROR],
        Rejection.CURVATURE: np.abs(f[CURVATURE]) <= most,
        Rejection.SCATTER: f[SCATTER] <= 1.0 + most * np.sqrt(2.0 / freedom),
    }
    rejections = np.zeros(count.shape, dtype=np.int32)
    for reason, passed in passes.items():
        rejections[~passed] |= np.int32(reason)
    # Too few bins do not define a shape; the tests of the shape do not apply.
    has_few_bins = (rejections & np.int32(Rejection.TOO_FEW_BINS)) != 0
    rejections[has_few_bins] &= np.int32(Rejection.TOO_FEW_BINS | Rejection.EXCLUDED)
    return rejections


def _pick(
    statistics: Array, rejections: Flags, level_error: Array, noise: Array
) -> tuple[npt.NDArray[np.int64], Array, Array]:
    """Return the index of the chosen window or -1, its comparison with the anchor, and its excess.

    Both are those of `ReferenceWindow`. Windows with more particles than the anchor are marked as
    rejected.

    Parameters
    ----------
    statistics : (profile, window, `FIELDS`) float
    rejections : (profile, window) int
    level_error : (profile, 1) float
        Standard error of the background.
    noise : (profile, window) float
        Part of the errors of the scale.
    """
    scale, error = statistics[..., SCALE], statistics[..., SCALE_ERROR]
    by_level = level_error * statistics[..., RESPONSE]
    most = COMMON.significant
    comparable = (rejections & ~np.int32(Rejection.LOW_SIGNAL)) == 0
    upper = np.where(comparable, scale + most * np.hypot(error, by_level), np.inf)
    anchor = np.argmin(upper, axis=-1)[:, np.newaxis]
    lowest, lowest_error, lowest_noise, lowest_by_level = (
        np.take_along_axis(values, anchor, axis=-1) for values in (scale, error, noise, by_level)
    )
    above = scale - lowest
    variance = error**2 + lowest_error**2 + (by_level - lowest_by_level) ** 2
    has_more_particles = comparable & (above > most * np.sqrt(variance))
    rejections[has_more_particles] |= np.int32(Rejection.MORE_PARTICLES)
    passed = rejections == 0
    least = np.min(np.where(passed, error, np.inf), axis=-1, keepdims=True)
    certain = passed & (error <= THRESHOLDS.most_noise * least)
    highest = certain.shape[-1] - 1 - np.argmax(certain[:, ::-1], axis=-1)
    index = np.where(np.any(passed, axis=-1), highest, -1).astype(np.int64)
    chosen = np.arange(index.size), index
    excess = np.sqrt(np.maximum(np.maximum(above, 0.0)[chosen] ** 2 - variance[chosen], 0.0))
    compared = lowest_noise[:, 0] if scale.shape[-1] > 1 else np.zeros(index.size)
    return index, compared, excess


def _detection_limit(
    statistics: Array,
    rejections: Flags,
    level_error: Array,
    windows: Array,
    index: npt.NDArray[np.int64],
) -> Array:
    """Return the detection limit of the chosen windows, by the best window beside each."""
    bottom, top = windows[index, :1], windows[index, 1:]
    beside = (windows[:, 1] <= bottom) | (windows[:, 0] >= top)
    comparable = beside & ((rejections & ~np.int32(Rejection.LOW_SIGNAL)) == 0)
    scale, error = statistics[..., SCALE], statistics[..., SCALE_ERROR]
    by_level = level_error * statistics[..., RESPONSE]

    def of_chosen(values: Array) -> Array:
        return np.take_along_axis(values, index[:, np.newaxis], axis=-1)

    difference = np.hypot(error, by_level - of_chosen(by_level))
    difference = np.where(comparable, difference, np.inf).min(axis=-1)
    total = np.hypot(of_chosen(error)[:, 0], difference)
    # Without a window the index is -1, and the last one may have no signal.
    limit = np.full(index.size, np.nan)
    np.divide(total, of_chosen(scale)[:, 0], out=limit, where=index >= 0)
    return np.asarray((COMMON.significant + _PROBABLE) * limit)


@summing
def _weigh(power: Array, variance: Array, excluded: Array, inverse: Array, values: Array) -> None:
    """Fill inverse variances and powers, 0 in bins that are not usable."""
    for i in range(power.size):
        good = (abs(power[i]) < HUGE) & (variance[i] > 0.0) & (variance[i] < HUGE)
        inverse[i] = 1.0 / variance[i] if good & (excluded[i] == 0.0) else 0.0
        values[i] = power[i] if good else 0.0


@summing
def _moments(values: Array, inverse: Array, shape: Array, place: Array) -> tuple[float, ...]:
    """Return the number of bins, the sums of f / v, w t^0 to w t^4 and y t^0 to y t^2.

    With the shape f, w = f^2 / v and y = f P / v.
    """
    count = level = s0 = s1 = s2 = s3 = s4 = y0 = y1 = y2 = 0.0
    for i in range(place.size):
        scaled, t = shape[i] * inverse[i], place[i]
        w, y, square = scaled * shape[i], scaled * values[i], t * t
        count += 1.0 if inverse[i] > 0.0 else 0.0
        level += scaled
        s0 += w
        s1 += w * t
        s2 += w * square
        s3 += w * square * t
        s4 += w * square * square
        y0 += y
        y1 += y * t
        y2 += y * square
    return count, level, s0, s1, s2, s3, s4, y0, y1, y2


@summing
def _chi_square(values: Array, inverse: Array, shape: Array, scale: float) -> float:
    total = 0.0
    for i in range(values.size):
        residual = values[i] - scale * shape[i]
        total += residual * residual * inverse[i]
    return total


@inlined
def _fit(
    values: Array, inverse: Array, shape: Array, place: Array, half: float, out: Array
) -> None:
    """Fit the molecular shape times polynomials in range that are orthogonal under the noise."""
    count, level, s0, s1, s2, s3, s4, y0, y1, y2 = _moments(values, inverse, shape, place)
    out[COUNT] = count
    if not s0 > 0.0:
        return
    scale = y0 / s0
    residual = _chi_square(values, inverse, shape, scale)
    # 1, t - a and t^2 - b (t - a) - c are orthogonal.
    a, c = s1 / s0, s2 / s0
    norm1 = s2 - a * s1
    out[SCALE], out[SCALE_ERROR], out[RESPONSE] = scale, 1.0 / math.sqrt(s0), level / s0
    out[SCATTER] = residual / max(count - 1.0, 1.0)
    if count < 3.0 or not norm1 > _DEPENDENT * s0:
        return
    slope = (y1 - a * y0) / norm1
    out[SLOPE], out[SLOPE_ERROR] = slope / scale / half, 1.0 / math.sqrt(norm1) / abs(scale) / half
    b = (s3 - a * s2) / norm1
    norm2 = s4 - c * s2 - b * (s3 - a * s2)
    if norm2 > _DEPENDENT * s0:
        out[CURVATURE] = (y2 - c * y0 - b * (y1 - a * y0)) / math.sqrt(norm2)


@compiled
def _compare_with_air(
    power: Array,
    variance: Array,
    shape: Array,
    range_: Array,
    excluded: Array,
    edges: npt.NDArray[np.int64],
    out: Array,
) -> None:
    """Compare each profile with the molecular shape in each window.

    Parameters
    ----------
    power : (profile, bin) float64
    variance, shape : (profile or 1, bin) float64
    range_ : (bin,) float64
        m, ascending.
    excluded : (profile or 1, bin) float64
        1 in excluded bins, else 0.
    edges : (window, 2) int64
        First bin of the window, and first bin beyond it.
    out : (profile, window, `FIELDS`) float64
        Output, NaN before: scale of the shape with its error, slope of the logarithm of the
        ratio to the shape in m-1 with its error, curvature over its error, chi-square over the
        degrees of freedom, number of bins, number of excluded bins, change of the scale per change
        of the background.
    """
    place, values, inverse = (
        np.empty(range_.size), np.empty(range_.size), np.empty(range_.size),
    )  # fmt: skip
    for k in range(power.shape[0]):
        noise, air = variance[k % variance.shape[0]], shape[k % shape.shape[0]]
        masked = excluded[k % excluded.shape[0]]
        _weigh(power[k], noise, masked, inverse, values)
        for j in range(edges.shape[0]):
            first, stop = edges[j, 0], edges[j, 1]
            if stop <= first:
                continue
            middle = 0.5 * (range_[first] + range_[stop - 1])
            half = max(0.5 * (range_[stop - 1] - range_[first]), _SHORTEST)
            out[k, j, EXCLUDED_BINS] = 0.0
            for i in range(first, stop):
                place[i] = (range_[i] - middle) / half
                out[k, j, EXCLUDED_BINS] += masked[i]
            bins = slice(first, stop)
            _fit(values[bins], inverse[bins], air[bins], place[bins], half, out[k, j])
