"""Fit the background of a profile whose far range is free of aerosol, by the molecular shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import special

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.background import _shape_fit
from lidarops.retrieve.background.thresholds import THRESHOLDS
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Booleans, Flags, Indices, Integers, frozen


@dataclass(frozen=True, slots=True)
class KnownShapeResult:
    """Background and amplitude of every profile, with their errors, tests and quality bits."""

    background: Array
    """In the unit of the power; NaN where there is none."""
    background_standard_error: Array
    """Of random noise, and of the choice of the window where there is more than one."""
    amplitude: Array
    """Power over shape."""
    amplitude_standard_error: Array
    """Of random noise."""
    chi2: Array
    """Sum of the squared residuals over their variances."""
    degrees_of_freedom: Integers
    """Bins less 2, at least 0."""
    condition: Array
    """Standard error of the background over that of the mean of the same bins: 1 where the shape
    dies away in the window, infinite where it cannot be distinguished from a constant."""
    curvature: Array
    """Slope along range of the residuals relative to the shape, in standard errors; positive
    where the signal falls less steeply than the shape."""
    waves: Array
    """Chi-square of the mean residuals of 16 equal parts of the window; the expectation is 14."""
    start: Array
    """m, range of the first bin of the window."""
    stop: Array
    """m, range of the last bin of the window."""
    poor_fit: Booleans
    """The residuals vary systematically along range: the window is not free of aerosol, the
    shape is not that of the air, or the noise is not white along range."""
    singular: Booleans
    """The window is too short for the shape to differ from a constant
    (`Thresholds.largest_condition`); use another method."""
    quality: Flags
    """INPUT_MISSING, TOO_FEW_BINS, NO_SIGNAL (all bins of a window equal, which noise never gives;
    not for counts), NEGATIVE_AMPLITUDE, NOT_HOMOGENEOUS (where `poor_fit`)."""


def molecular_shape(
    backscatter: npt.ArrayLike,
    extinction: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
) -> Array:
    r"""Return the signal of clear air up to a constant factor.

    .. math:: \varphi(R) = \frac{\beta(R)}{R^2} \exp\left(-2 \int_0^R \alpha \, dr\right)

    by trapezoids from the first bin on; nearer, the extinction is that of the first bin.

    Parameters
    ----------
    backscatter : (..., range) float
        m-1 sr-1.
    extinction : (..., range) float
        m-1.
    range : (range,) float
        m.

    Returns
    -------
    (..., range) float
        m-3 sr-1.

    References
    ----------
    vasylkivskyi2009
    """
    beta = inputs.real_array(backscatter, "backscatter").astype(np.float64)
    alpha = inputs.real_array(extinction, "extinction").astype(np.float64)
    grid = inputs.range_grid(range)
    depth = np.empty(alpha.shape)
    depth[..., :1] = alpha[..., :1] * grid[0]
    slices = 0.5 * (alpha[..., 1:] + alpha[..., :-1]) * np.diff(grid)
    depth[..., 1:] = depth[..., :1] + np.cumsum(slices, axis=-1)
    return np.asarray(beta * np.exp(-2.0 * depth) / grid**2)


def fit_known_shape(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    shape: npt.ArrayLike,
    *,
    variance: npt.ArrayLike | None = None,
    exposure: npt.ArrayLike | None = None,
    start: npt.ArrayLike | None = None,
    stop: npt.ArrayLike | None = None,
    mask: npt.ArrayLike | None = None,
) -> KnownShapeResult:
    r"""Fit background and amplitude of a signal whose shape is known, by weighted least squares.

    .. math:: P(R) = b + C \varphi(R), \qquad
              C = \frac{\sum w (\varphi - \bar\varphi)(P - \bar P)}
                       {\sum w (\varphi - \bar\varphi)^2}, \qquad
              b = \bar P - C \bar\varphi

    with weighted means and :math:`w = 1 / v`. This is equation (4) of potapova2021 with the
    molecular shape in place of that of a homogeneous path. There is no iteration.

    The variance of counts is that of the fitted model, :math:`v = (b + C \varphi) / E`, from two
    fixed passes after an unweighted one. Weights from the counts themselves would follow their
    noise and bias the background low.

    Parameters
    ----------
    power : (..., range) float
        Any unit; bins that are not finite are skipped.
    range : (range,) float
        m.
    shape : (..., range) float
        Any unit, broadcast against `power`; bins where it is not positive and finite are
        skipped. See `molecular_shape`.
    variance : (..., range) float, optional
        Noise variance in the square of the power's unit, broadcast against `power`. It must not
        follow the noise of the single bin. Either it or `exposure` is required.
    exposure : (...) float, optional
        For Poisson counts: counts per unit of power. That is the number of shots where power is
        a mean count per shot, and shots times bin time in microseconds where it is in MHz.
    start, stop : (...) float, optional
        m, ends of the window. Where `start` is not given, windows from each of
        `Thresholds.start_shares` of the farthest usable range are tried. The result is that of
        the longest window whose residuals show neither curvature nor waves and whose background
        agrees with those of all shorter windows (each at 1 % false alarms), else that of the
        shortest.
    mask : (..., range) bool, optional
        True where a bin may be used; broadcast against `power`.

    Returns
    -------
    KnownShapeResult
        With the leading axes of `power`. The standard errors cover random noise. Where windows
        are tried, that of the background also covers aerosol that the tests may miss: it is the
        root mean square about the chosen background over all windows that pass the tests, each
        weighted by the odds that the far range is clean from its start on
        (`Thresholds.aerosol_odds`). They do not cover an error of the shape, which `curvature`
        and `waves` show only where it exceeds the noise.

    Raises
    ------
    RetrievalInputError
        For invalid arguments.

    References
    ----------
    potapova2021, golub1973
    """
    grid = inputs.range_grid(range)
    rows, leading = inputs.profiles(power, grid)
    rows = frozen(rows.astype(np.float64, copy=False))
    shapes = frozen(inputs.noise_rows(shape, "shape", grid, leading))
    allowed = _mask_rows(mask, grid, leading)
    noise = _noise(variance, exposure, grid, leading)
    pasts = _pasts(rows, allowed, stop, grid, leading)
    firsts = _firsts(start, pasts, grid, leading)
    out = np.full((len(rows), _shape_fit.COLUMNS), np.nan)
    limits = _limits(THRESHOLDS.rejection)
    _shape_fit.fit_shape(rows, shapes, frozen(grid), allowed, noise, firsts, pasts, limits, out)
    window = np.nan_to_num(out[:, _shape_fit.WINDOW]).astype(np.intp)
    first = np.take_along_axis(
        np.broadcast_to(firsts, (len(rows), firsts.shape[1])), window[:, np.newaxis], axis=1
    )[:, 0]
    if exposure is not None:
        # In the dark, a whole window may be without a count.
        out[:, _shape_fit.CONSTANT] = 0.0
    return _result(out, grid, first, pasts, leading)


def _noise(
    variance: npt.ArrayLike | None,
    exposure: npt.ArrayLike | None,
    grid: Array,
    leading: tuple[int, ...],
) -> _shape_fit.ShapeNoise:
    if (variance is None) == (exposure is None):
        raise RetrievalInputError(
            "is given for counts" if exposure is not None else "is missing",
            field="variance",
            remedy="give the exposure of counts, else the variance",
        )
    counts = inputs.profile_values(exposure, "exposure", leading)
    if counts is not None and np.any(counts <= 0):
        raise RetrievalInputError(
            "is not positive", field="exposure", remedy="mask profiles without shots"
        )
    return _shape_fit.ShapeNoise(
        frozen(inputs.noise_rows(variance, "variance", grid, leading, negative=False)),
        frozen(np.full(1, np.nan) if counts is None else counts),
    )


def _mask_rows(mask: npt.ArrayLike | None, grid: Array, leading: tuple[int, ...]) -> Array:
    if mask is None:
        return frozen(np.ones((1, grid.size)))
    allowed = np.asarray(mask)
    if allowed.dtype != np.bool_:
        raise RetrievalInputError(
            f"holds {allowed.dtype}", field="mask", remedy="give True where a bin may be used"
        )
    return frozen(inputs.noise_rows(allowed.astype(np.float64), "mask", grid, leading))


def _pasts(
    rows: Array,
    allowed: Array,
    stop: npt.ArrayLike | None,
    range_: Array,
    leading: tuple[int, ...],
) -> Indices:
    """Return the bin past the window of each profile: past its last usable bin, or its stop."""
    pasts = np.full(len(rows), range_.size, dtype=np.intp)
    stops = inputs.profile_values(stop, "stop", leading)
    if stops is not None:
        pasts[:] = np.searchsorted(range_, stops, side="right")
    _shape_fit.fill_pasts(rows, allowed, pasts)
    return pasts


def _firsts(
    start: npt.ArrayLike | None,
    pasts: Indices,
    range_: Array,
    leading: tuple[int, ...],
) -> Indices:
    """Return the first bins of the windows, (profile or 1, window)."""
    starts = inputs.profile_values(start, "start", leading)
    if starts is not None:
        if np.any(starts > range_[-1]):
            raise RetrievalInputError(
                f"lies beyond the range, which ends at {range_[-1]:g} m", field="start"
            )
        return np.searchsorted(range_, starts, side="left").astype(np.intp)[:, np.newaxis]
    farthest = range_[np.maximum(pasts - 1, 0)]
    earliest: Array = farthest[:, np.newaxis] * np.array(THRESHOLDS.start_shares)
    return np.searchsorted(range_, earliest, side="left").astype(np.intp)


def _limits(false_alarm: float) -> _shape_fit.Limits:
    """Return the limits of waves and curvature for a joint rate of false alarms."""
    rate = 0.5 * false_alarm
    waves = special.chdtri(_shape_fit.GROUPS - 2.0, rate)
    deviation = -special.ndtri(0.5 * rate)
    return _shape_fit.Limits(float(waves), float(deviation), THRESHOLDS.aerosol_odds)


def _result(
    out: Array,
    range_: Array,
    first: Indices,
    pasts: Indices,
    leading: tuple[int, ...],
) -> KnownShapeResult:
    bins = out[:, _shape_fit.BINS].astype(np.int64)
    freedom = np.maximum(bins - 2, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        curvature, waves = out[:, _shape_fit.CURVATURE], out[:, _shape_fit.WAVES]
        amplitude_error = np.sqrt(out[:, _shape_fit.AMPLITUDE_VARIANCE])
        limits = _limits(THRESHOLDS.false_alarm)
        poor = (np.abs(curvature) > limits.deviation) | (waves > limits.waves)
        negative = out[:, _shape_fit.AMPLITUDE] < -THRESHOLDS.negative * amplitude_error
    condition = out[:, _shape_fit.CONDITION]
    unsolved = (bins > 0) & ~np.isfinite(out[:, _shape_fit.BACKGROUND])
    singular = (condition > THRESHOLDS.largest_condition) | unsolved
    quality = np.zeros(len(out), dtype=np.int32)
    quality[bins == 0] |= np.int32(Quality.INPUT_MISSING)
    quality[(bins > 0) & (bins < THRESHOLDS.fewest_bins)] |= np.int32(Quality.TOO_FEW_BINS)
    constant = (bins >= THRESHOLDS.fewest_bins) & (out[:, _shape_fit.CONSTANT] > 0)
    quality[constant] |= np.int32(Quality.NO_SIGNAL)
    quality[negative] |= np.int32(Quality.NEGATIVE_AMPLITUDE)
    quality[poor] |= np.int32(Quality.NOT_HOMOGENEOUS)
    empty = bins == 0
    start = np.where(empty, np.nan, range_[np.minimum(first, range_.size - 1)])
    stop = np.where(empty, np.nan, range_[np.maximum(pasts - 1, 0)])
    error = np.sqrt(out[:, _shape_fit.BACKGROUND_VARIANCE])
    return KnownShapeResult(
        background=out[:, _shape_fit.BACKGROUND].reshape(leading),
        background_standard_error=error.reshape(leading),
        amplitude=out[:, _shape_fit.AMPLITUDE].reshape(leading),
        amplitude_standard_error=amplitude_error.reshape(leading),
        chi2=out[:, _shape_fit.CHI2].reshape(leading),
        degrees_of_freedom=freedom.reshape(leading),
        condition=condition.reshape(leading),
        curvature=curvature.reshape(leading),
        waves=waves.reshape(leading),
        start=start.reshape(leading),
        stop=stop.reshape(leading),
        poor_fit=poor.reshape(leading),
        singular=singular.reshape(leading),
        quality=quality.reshape(leading),
    )
