"""Estimate the background of profiles by one of several methods, and judge the signal left in it.

`from_tail` averages the far bins, `from_bounded_tail` subtracts half of the signal that they may
hold, `from_known_shape` fits background and amplitude of clear air, `from_far_range` takes the
better known of these two, and `from_cubic` solves the cubic of a homogeneous section, which
`fit_section` judges. All return a `Background`: value, standard error, the most signal that may
have been subtracted with it, and quality bits. The result of a profile does not
depend on the other profiles, to the last bit.

In front of the tail, the far range whose mean is the background, the signal without background is
S - L, where L is the mean signal in the tail, which was subtracted with the background. Unless the
air becomes more turbid, S falls at least with the square of range; this bounds L (`left_in_tail`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy import special

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.background import cubic_and_tail, known_shape
from lidarops.retrieve.background.thresholds import THRESHOLDS
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Booleans, Flags, Indices
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON


@dataclass(frozen=True, slots=True)
class Background:
    """Background of every profile, with the leading axes of the power."""

    background: Array
    """In the unit of the power; NaN where there is none."""
    standard_error: Array
    left: Array
    """The most signal that may have been subtracted with the background; of `from_bounded_tail`
    the standard deviation of what it holds too much or too little. NaN where it is not known."""
    left_standard_error: Array
    unjudged: Booleans
    """The far range does not fit the method, or `left` cannot be estimated."""
    uncertain: Booleans
    """`unjudged`, or `left` is detected and matters beside the standard error."""
    absent: Flags
    """INPUT_MISSING, or for the cubic NO_REAL_SOLUTION, where there is no background."""

    @property
    def quality(self) -> Flags:
        """`absent`, and BACKGROUND_UNCERTAIN where `uncertain`."""
        return self.absent | self.uncertain * np.int32(Quality.BACKGROUND_UNCERTAIN)

    def where(self, chosen: Booleans, other: Background) -> Background:
        """Return this background for the profiles that are chosen, else the other one."""
        names = self.__slots__
        return Background(
            *(np.where(chosen, getattr(self, name), getattr(other, name)) for name in names)
        )


def from_tail(
    power: Array,
    range: Array,  # noqa: A002 - the field's word
    variance: Array,
    span: tuple[float, float] | None = None,
    *,
    shape: Array | None = None,
) -> Background:
    """Return the mean of far bins, and the most signal that it may contain.

    There is no background where fewer than half of the bins are known. Where some are not, they
    may have been left out because of their value, as saturated ones are: BACKGROUND_UNCERTAIN is
    raised where this may shift the mean (`selection_bias`) by more than half its standard error.

    Parameters
    ----------
    power, variance : (..., range) float
        In one unit and its square; bins are skipped where either is not finite.
    range : (range,) float
        m, ascending.
    span : (float, float), optional
        m; ranges of the bins that are averaged, both ends included. The last tenth of the bins
        where not given.
    shape : (..., range) float, optional
        Signal that falls no faster than the actual one; by default :math:`R^{-2}`.

    Raises
    ------
    RetrievalInputError
        If no bin lies there.
    """
    tail = _bins(range, span)
    mean = cubic_and_tail.tail_mean(
        power[..., tail], range[tail], start=float(range[tail][0]), variance=variance[..., tail]
    )
    value, error = mean.background, mean.background_standard_error
    left = left_in_tail(power, range, variance, tail, value, error, shape)
    missing = np.where(np.isnan(value), np.int32(Quality.INPUT_MISSING), np.int32(0))
    known = np.isfinite(power[..., tail]) & np.isfinite(variance[..., tail])
    selected = _selected(known.sum(axis=-1), np.asarray(known.shape[-1]))
    return _judged(value, error, left, np.isnan(left[0]) | selected, missing)


def _selected(known: Indices, bins: Indices) -> Booleans:
    """Return where the choice of the known bins may shift their mean beyond its error."""
    with np.errstate(invalid="ignore"):
        bias = cubic_and_tail.selection_bias(known / bins)
    return shifts(bias * np.sqrt(known), np.ones(known.shape))


def from_known_shape(
    power: Array,
    range: Array,  # noqa: A002 - the field's word
    variance: Array,
    shape: Array,
    span: tuple[float, float] | None = None,
    *,
    mask: Booleans | None = None,
    exposure: Array | None = None,
) -> Background:
    """Return the background fitted with the shape of clean air; `from_tail` where that fails.

    The fit fails also where fewer than half of the bins that may be fitted, from the start of its
    window on, are known; BACKGROUND_UNCERTAIN as for `from_tail`.

    Parameters
    ----------
    power, range, variance, span
        As for `from_tail`; ranges must be positive.
    shape : (..., range) float
        From `lidarops.retrieve.background.molecular_shape`.
    mask : (..., range) bool, optional
        True where a bin may be fitted.
    exposure : (...) float, optional
        Indices per unit of power, for photon counting. The fit then takes its variances from the
        fitted counts: those of few counts follow their noise, which makes the background too low.

    Raises
    ------
    RetrievalInputError
        If no bin lies in `span`.
    """
    tail = from_tail(power, range, variance, span)
    noise = {"variance": variance} if exposure is None else {"exposure": exposure}
    fit = known_shape.fit_known_shape(power, range, shape, mask=mask, **noise)
    usable = ~fit.singular & np.isfinite(fit.background)
    known, bins = np.minimum(fit.degrees_of_freedom + 2, fit.allowed), fit.allowed
    usable &= known >= COMMON.least_share * bins
    doubtful = fit.poor_fit | _selected(known, bins)
    fitted_sky = Background(
        background=fit.background,
        standard_error=fit.background_standard_error,
        left=THRESHOLDS.shape_error * np.abs(tail.background - fit.background),
        left_standard_error=THRESHOLDS.shape_error
        * np.hypot(tail.standard_error, fit.background_standard_error),
        unjudged=doubtful,
        uncertain=doubtful,
        absent=np.zeros(doubtful.shape, np.int32),
    )
    return fitted_sky.where(usable, tail)


def from_bounded_tail(
    power: Array,
    range: Array,  # noqa: A002 - the field's word
    variance: Array,
    shape: Array | None = None,
    span: tuple[float, float] | None = None,
) -> Background:
    r"""Return the middle of the backgrounds that the tail permits.

    The mean of the tail :math:`P_t` holds between no signal and the largest one :math:`L` that may
    be left in it: the signal before the tail, falling as that of clean air, or as :math:`R^{-2}`
    where no `shape` is given. The background is
    :math:`P_t - L / 2`, and `left` the standard deviation :math:`L / \sqrt{12}` of an even
    distribution, with one standard error of :math:`L`. BACKGROUND_UNCERTAIN is raised where `left`
    cannot be estimated, or bins that are left out may shift the mean.

    Parameters and errors are those of `from_known_shape`.
    """
    tail = from_tail(power, range, variance, span, shape=shape)
    most, spread = np.maximum(np.nan_to_num(tail.left), 0.0), tail.left_standard_error
    return Background(
        background=tail.background - 0.5 * most,
        standard_error=np.hypot(tail.standard_error, 0.5 * np.nan_to_num(spread)),
        left=(most + spread) / np.sqrt(12.0),
        left_standard_error=np.zeros_like(most),
        unjudged=tail.unjudged,
        uncertain=tail.unjudged,
        absent=tail.absent,
    )


def from_far_range(
    power: Array,
    range: Array,  # noqa: A002 - the field's word
    variance: Array,
    shape: Array,
    span: tuple[float, float] | None = None,
    *,
    mask: Booleans,
) -> Background:
    """Return the better known one of `from_known_shape` and `from_bounded_tail` for each profile.

    The fit counts where it passes its tests, and its standard error with `left` is smaller.
    Parameters and errors are those of `from_known_shape`.
    """
    tail = from_bounded_tail(power, range, variance, shape, span)
    fit = from_known_shape(power, range, variance, shape, span, mask=mask)
    of_tail, of_fit = (np.hypot(sky.standard_error, sky.left) for sky in (tail, fit))
    fitted = np.isfinite(fit.background) & ~fit.unjudged & ~(of_tail <= of_fit)
    return fit.where(fitted, tail)


def from_cubic(
    power: Array,
    range: Array,  # noqa: A002 - the field's word
    variance: Array,
    span: tuple[float, float] | None = None,
) -> Background:
    """Return the background of a homogeneous section that holds signal, by the cubic.

    The result is judged by least squares of the same bins: the difference of the two backgrounds
    is the most signal that may have been subtracted, and its variance is the difference of their
    variances (hausman1978). Backscatter that bends along the section passes for a background.

    Parameters
    ----------
    power, range, variance
        As for `from_tail`; all bins of the section must be finite, and their range uniform.
    span : (float, float), optional
        m; ranges of the section, both ends included. The last tenth of the bins where not given.

    Returns
    -------
    Background
        NO_REAL_SOLUTION where the cubic has no admissible root, or the section is constant.
        BACKGROUND_UNCERTAIN also where the residuals of the least squares vary systematically
        along range (1e-4 false alarms), where noise may have led to another root, and below 8
        bins.

    Raises
    ------
    RetrievalInputError
        If no bin lies in the section, or its ranges are not uniform.
    """
    section = _bins(range, span)
    grid = inputs.range_grid(range[section])
    rows, leading = inputs.profiles(power[..., section], grid)
    noise = inputs.noise_rows(variance[..., section], "variance", grid, leading, negative=False)
    root, _ = cubic_and_tail.solve_cubic(rows, grid, None, noise, known_variance=True)
    error = root.background_standard_error
    usable = np.isfinite(error)
    value = np.where(usable, root.background, np.nan)
    fit = fit_section(rows.astype(np.float64, copy=False), grid, noise, value)
    with np.errstate(invalid="ignore"):
        spread = np.sqrt(np.maximum(error**2 - fit.variance, 0.0))
    left = np.abs(value - fit.background)
    doubts = np.int32(Quality.LOW_SIGNAL | Quality.TOO_FEW_BINS)
    absent = np.where(
        (root.quality & np.int32(Quality.INPUT_MISSING)) != 0,
        np.int32(Quality.INPUT_MISSING),
        np.int32(Quality.NO_REAL_SOLUTION),
    )
    calm = fit.waves <= special.chdtri(groups(grid.size) - 3.0, COMMON.misfit_false_alarm)
    unjudged = np.isnan(left) | ~calm | ((root.quality & doubts) != 0)
    absent = np.where(usable, np.int32(0), absent)
    sky = _judged(value, error, (left, spread), unjudged, absent)
    return inputs.with_leading_axes(sky, leading)


def _judged(
    value: Array, error: Array, left: tuple[Array, Array], unjudged: Booleans, absent: Flags
) -> Background:
    unjudged = unjudged & np.isfinite(value)
    uncertain = unjudged | shifts(detected(*left), error)
    return Background(value, error, *left, unjudged, uncertain, absent)


def _bins(range_: Array, span: tuple[float, float] | None) -> slice:
    if span is None:
        return slice(cubic_and_tail.first_of_tail(range_), range_.size)
    start, stop = span
    first, past = np.searchsorted(range_, (start, np.nextafter(stop, np.inf)))
    if first == past:
        raise RetrievalInputError(
            f"has no bin from {start:g} to {stop:g} m",
            field="background",
            remedy=f"ranges end at {range_[-1]:g} m",
        )
    return slice(int(first), int(past))


_STEPS: Final = 4
_STEEPEST: Final = 100.0
"""Largest optical depth, there and back, of a section; the signal vanishes within a few bins."""
_LARGEST_STEP: Final = 3.0
"""Largest change of that optical depth in one step."""


class SectionFit(NamedTuple):
    """Result of each profile, (profile,)."""

    background: Array
    variance: Array
    """Of the background."""
    waves: Array
    """Chi-square of the mean residuals of `groups` of bins; the fit uses 3 degrees of freedom."""


def groups(bins: int) -> int:
    """Return the number of groups of neighbouring bins whose mean residuals are tested."""
    return min(bins, 16)


def fit_section(power: Array, range_: Array, variance: Array, background: Array) -> SectionFit:
    """Fit background, amplitude and extinction.

    Parameters
    ----------
    power, variance : (profile, bin) float
    range_ : (bin,) float
        m, ascending and uniform.
    background : (profile,) float
        From which the steps begin.
    """
    if range_.size < 3:
        return SectionFit(*np.full((3, len(power)), np.nan))
    fall = (range_[0] / range_) ** 2
    with np.errstate(all="ignore"):
        along = (range_ - range_[0]) / (range_[-1] - range_[0])
        depth = _first_depth(power - background[:, np.newaxis], fall)
        root = 1.0 / np.sqrt(variance)
        for step in range(_STEPS):
            shape = fall * np.exp(-depth[:, np.newaxis] * along)
            solved = _least_squares(root * power, (root * shape, root * shape * along, root))
            change = np.clip(-solved.tilt / solved.amplitude, -_LARGEST_STEP, _LARGEST_STEP)
            usable = (solved.amplitude > 0.0) & np.isfinite(change) & (step < _STEPS - 1)
            depth = np.clip(depth + np.where(usable, change, 0.0), -_STEEPEST, _STEEPEST)
        count = groups(range_.size)
        edges = np.arange(count) * range_.size // count
        total = np.add.reduceat(solved.residuals * root, edges, axis=-1)
        weight = np.add.reduceat(root**2, edges, axis=-1)
        waves = (total**2 / weight).sum(axis=-1)
    return SectionFit(solved.background, solved.variance, waves)


def _first_depth(net: Array, fall: Array) -> Array:
    """Return the optical depth there and back from the signals of the first two quarters."""
    quarter = max(fall.size // 4, 1)
    level = net / fall
    near, next_ = level[:, :quarter].sum(axis=-1), level[:, quarter : 2 * quarter].sum(axis=-1)
    depth = np.log(near / next_) * (fall.size - 1) / quarter
    return np.where(np.isfinite(depth), np.clip(depth, -_STEEPEST, _STEEPEST), 0.0)


class _Solution(NamedTuple):
    background: Array
    variance: Array
    amplitude: Array
    tilt: Array
    residuals: Array


def _least_squares(values: Array, columns: tuple[Array, Array, Array]) -> _Solution:
    """Solve for the coefficients of shape, tilted shape and constant, by orthogonalization."""
    q, r = np.linalg.qr(np.stack(np.broadcast_arrays(*columns), axis=-1))
    products = (q * values[..., np.newaxis]).sum(axis=-2)
    residuals = values - (q * products[:, np.newaxis]).sum(axis=-1)
    background = products[:, 2] / r[:, 2, 2]
    tilt = (products[:, 1] - r[:, 1, 2] * background) / r[:, 1, 1]
    amplitude = (products[:, 0] - r[:, 0, 1] * tilt - r[:, 0, 2] * background) / r[:, 0, 0]
    return _Solution(background, r[:, 2, 2] ** -2.0, amplitude, tilt, residuals)


def detected(left: Array, standard_error: Array) -> Array:
    """Return the signal left in a tail where that before it exceeds its noise, else 0."""
    with np.errstate(invalid="ignore"):
        return np.where(left > COMMON.significant * standard_error, left, 0.0)


def window_before(start: float) -> tuple[float, float]:
    """Return the ranges, near and far, of the window that is compared with a tail.

    Parameters
    ----------
    start : float
        m, start of the tail.
    """
    return THRESHOLDS.nearest * start, THRESHOLDS.farthest * start


def shifts(shift: Array, standard_error: Array) -> Booleans:
    """Return where a shift of a value by signal left in the tail is too large for no flag.

    Parameters
    ----------
    shift, standard_error : (...) float
        Of the value, in one unit; NaN raises no flag.
    """
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(shift) > THRESHOLDS.share_of_error * standard_error)


def left_in_tail(
    power: Array,
    range: Array,  # noqa: A002 - the field's word
    variance: Array,
    tail: slice,
    background: Array,
    background_standard_error: Array,
    shape: Array | None = None,
) -> tuple[Array, Array]:
    """Return the most signal that the mean of a tail may contain, and its standard error.

    Parameters
    ----------
    power, variance : (..., range) float
        Bins are skipped where either is not finite.
    range : (range,) float
        m, ascending.
    tail : slice
        Bins whose mean is the background.
    background, background_standard_error : (...) float
        From these bins.
    shape : (..., range) float, optional
        Signal that falls no faster than the actual one from the window before to the tail. By
        default that of air of constant scattering, without attenuation.

    Returns
    -------
    (...) float, (...) float
        In the unit of the power; NaN where no bin before the tail is known.
    """
    before = slice(*np.searchsorted(range, window_before(float(range[tail][0]))))
    if before.start == before.stop:
        unknown = np.full(power.shape[:-1], np.nan)
        return unknown, unknown
    slowest = range**-2.0 if shape is None else shape
    fall = slowest[..., tail].mean(axis=-1) / slowest[..., before].mean(axis=-1)
    net, noise = power[..., before] - background[..., np.newaxis], variance[..., before]
    known = np.isfinite(net) & np.isfinite(noise)
    count = known.sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(known, net, 0.0).sum(axis=-1) / count
        error = np.sqrt(np.where(known, noise, 0.0).sum(axis=-1)) / count
        spread = np.hypot(error, background_standard_error)
    return mean * fall / (1.0 - fall), spread * fall / (1.0 - fall)
