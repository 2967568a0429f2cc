"""Combine optical depths of single altitudes into profiles with smooth extinction.

A scan gives the optical depth of each altitude independently. Altitudes are connected because
extinction changes gradually and the optical depth is zero at the lidar. The formulas are in
``docs/algorithms/vertical.md``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common.arrays import Array, Booleans, Integers
from lidarops.retrieve.multiangle import (
    _calibration,
    _smoothing,
    altitude_correlation,
    robust_weights,
)
from lidarops.retrieve.multiangle._smoothing import Smoothing
from lidarops.retrieve.multiangle.altitude_correlation import ResidualMoments
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_UNIFORM: Final = 1e-3
"""Largest relative deviation of a step from the mean step; allows for rounded altitudes."""


@dataclass(frozen=True, slots=True)
class _Block:
    """Estimates with the properties common to them."""

    altitude: Array
    """m above the lidar."""
    estimates: Array
    information: Array
    share: Array
    """Correlated share of the variance."""
    correlation: float
    stiffness: Array
    extent: float
    """m, from the lidar to the highest estimate."""
    gaps: Integers
    """Rows where neighbouring altitudes come from different beams."""


@dataclass(frozen=True, slots=True)
class _Fit:
    """Solution of a block."""

    information: Array
    """After the loss of weight of outlying estimates."""
    bands: Array
    smoothing: Smoothing
    depth: Array
    variance: Array
    extinction: Array
    """Optical depth of the layer from the altitude below."""
    extinction_variance: Array
    own: Array
    """Weight of each estimate in its own optical depth."""


@dataclass(frozen=True, slots=True)
class VerticalResult:
    """Smoothed profiles, (profile, altitude) unless stated; NaN beyond the reach."""

    optical_depth: Array
    """From the lidar to the altitude."""
    optical_depth_standard_error: Array
    """Random error and smoothing error."""
    extinction: Array
    """m-1, mean of the layer between the altitude and the next lower one (or the lidar)."""
    extinction_standard_error: Array
    """m-1."""
    data_share: Array
    """The solution smoothed once more, over the solution: 1 where smoothing changes nothing. NaN
    where the optical depth is not larger than its standard error."""
    effective_degrees_of_freedom: Array
    """(profile,): effective number of independent values in the profile."""
    correlation: float
    """Of the inhomogeneity at neighbouring altitudes."""
    interpolated: Booleans
    """No estimate there; interpolated from those around, or from the lidar."""
    downweighted: Booleans
    """The estimate is an outlier of its profile."""
    saturated: bool
    """The best fit of the block is little more than a straight line."""
    undersmoothed: Booleans
    """(profile,): more than 10 degrees of freedom and more than 0.4 per altitude, which the data
    prefer to a smoother profile."""
    high_correlation: bool
    """The correlation exceeds 0.85; standard errors may be too small."""
    block: _Block
    fit: _Fit
    factor: Callable[[Integers, Integers], Array]
    """Of the variances of differences of optical depths; see `_variance_factor`."""

    def respond(self, rows: Array) -> Array:
        """Return the solution for other estimates with the same weights, NaN beyond the reach.

        This is linear: the smoother of each profile is applied to its row.

        Parameters
        ----------
        rows : (profile, altitude) float
            Finite wherever there was an estimate.
        """
        rows = _respond(self.block, self.fit, rows)
        return np.where(np.isfinite(self.optical_depth), rows, np.nan)

    def layer(self, lower: int, upper: int) -> tuple[Array, Array]:
        """Return the optical depth between two altitudes, and its standard error, (profile,).

        The standard error is far smaller than that of a difference with independent errors.

        Parameters
        ----------
        lower, upper : int
            Indices of altitudes in ascending order, -1 for the lidar.
        """
        block, fit = self.block, self.fit
        right = np.zeros(block.estimates.shape)
        right[:, upper] = 1.0
        if lower >= 0:
            right[:, lower] = -1.0
        estimates = _smoothing.multiply_rows(fit.bands, block.estimates)
        inverse, solved = (
            fit.smoothing.solve(rows, fit.bands, block.stiffness)[0] for rows in (right, estimates)
        )
        posterior, value = (
            rows[:, [upper]] - (rows[:, [lower]] if lower >= 0 else 0.0)
            for rows in (inverse, solved)
        )
        depth, variance = fit.smoothing.mixed(value, posterior)
        variance *= self.factor(np.array([upper]), np.array([lower]))
        reached = np.isfinite(self.optical_depth[:, upper])
        return (
            np.where(reached, depth[:, 0], np.nan),
            np.where(reached, np.sqrt(variance[:, 0]), np.nan),
        )


def smooth_optical_depth(
    optical_depth: Array,
    information: Array,
    altitude: Array,
    *,
    residuals: ResidualMoments | None = None,
    robust: bool = True,
) -> VerticalResult:
    """Return profiles with smooth extinction from optical depths of single altitudes.

    The correlation, the weight of smoothness and the calibration of the standard errors are common
    to the profiles. With fewer than 8 profiles, solutions are averaged over the weight.

    Parameters
    ----------
    optical_depth : (profile, altitude) float
        Estimates of single altitudes; NaN where there is none. Each profile has one.
    information : (profile, altitude) float
        Reciprocal variances; NaN or 0 where there is no estimate.
    altitude : (altitude,) float
        m above the lidar, ascending and uniform.
    residuals : ResidualMoments, optional
        If not given, the estimates are taken as uncorrelated, with exactly known variance.
    robust : bool
        Whether to give outlying estimates less weight: first those more than 6 standard errors
        from the median of 15 altitudes; then, if any is more than 4.5 standard errors from the
        solution, all by Tukey's bisquare at 6 standard errors. Not done if `residuals` come from
        fewer than 4 beams, nor in a profile where more than half would lose weight.

    Raises
    ------
    RetrievalInputError
        For altitudes that are not uniform.

    References
    ----------
    patterson1971 (likelihood), mallows1973 (Cp), wahba1983 (intervals), takahashi1973
    (variances), beaton1974 (bisquare).
    """
    _require_uniform(altitude)
    used = np.isfinite(optical_depth) & (information > 0.0)
    block = _block(
        np.where(used, optical_depth, 0.0), np.where(used, information, 0.0), altitude, residuals
    )
    freedom = None if residuals is None else residuals.degrees_of_freedom
    few = freedom is not None and freedom.max() < THRESHOLDS.fewest_beams - 2.0
    fit = _solve_block(block, robust=robust and not few)
    within = np.cumsum(used[:, ::-1], axis=1)[:, ::-1] > 0
    calibrated = len(within) >= THRESHOLDS.fewest_to_choose
    factor = partial(
        _variance_factor,
        _calibrate(block, fit, within) if calibrated else None,
        _inflation(freedom, block.correlation, altitude.size),
    )
    return _result(block, fit, factor, within, np.diff(altitude, prepend=0.0))


def _require_uniform(altitude: Array) -> None:
    steps = np.diff(altitude)
    mean = (altitude[-1] - altitude[0]) / max(steps.size, 1)
    if np.any(np.abs(steps - mean) > _UNIFORM * mean):
        raise RetrievalInputError(
            "is not uniform", field="altitude", remedy="interpolate the signals to a uniform grid"
        )


def _block(
    depth: Array, information: Array, altitude: Array, moments: ResidualMoments | None
) -> _Block:
    highest = int(np.flatnonzero((information > 0.0).any(axis=0))[-1])
    correlation, share = 0.0, np.zeros_like(depth)
    gaps = np.zeros(0, dtype=np.int64)
    if moments is not None:
        correlation, amplitude = altitude_correlation.fit_correlation(
            moments.lag_products, moments.lag_norms
        )
        share = np.clip(moments.inhomogeneity_share * amplitude, 0.0, 1.0)
        gaps = np.flatnonzero(moments.gaps)
    stiffness = _smoothing.penalty(altitude)
    return _Block(
        altitude, depth, information, share, correlation, stiffness, float(altitude[highest]), gaps
    )


def _solve_block(block: _Block, *, robust: bool) -> _Fit:
    if not robust:
        return _fit(block, block.information)
    screened = robust_weights.screen_outliers(block.estimates, block.information)
    fit = _fit(block, robust_weights.reduce_information(block.information, screened))
    reduced = robust_weights.downweight_outliers(
        block.estimates, block.information, block.share, fit.depth, fit.variance
    )
    return fit if reduced is None else _fit(block, reduced)


def _fit(block: _Block, information: Array) -> _Fit:
    """Choose the smoothness of a block and solve."""
    bands = _precision(block, information)
    unit = float(information[information > 0.0].mean()) * block.extent**3
    scores = _smoothing.score_smoothing(bands, block.estimates, block.stiffness, unit)
    largest = _largest_smoothing(block, information) / unit
    smoothing = _smoothing.choose_smoothing(scores, largest).times(unit)
    right = _smoothing.multiply_rows(bands, block.estimates)
    solved, diagonal, beside, second = smoothing.solve(right, bands, block.stiffness)
    gained = np.diff(solved, axis=1, prepend=0.0)
    uncertain = diagonal.copy()
    uncertain[:, 1:] += diagonal[:, :-1] - 2.0 * beside[:, :-1]
    repeated = np.repeat(bands, smoothing.share.size, axis=1)
    own = _own_weights(repeated, np.array([diagonal, beside, second]))
    return _Fit(
        information,
        bands,
        smoothing,
        *smoothing.mixed(solved, diagonal),
        *smoothing.mixed(gained, uncertain),
        smoothing.mean(own),
    )


def _largest_smoothing(block: _Block, information: Array) -> float:
    """Return the weight with which extinction may change by its mean within a scale height."""
    known = float((information * block.altitude**2).sum())
    mean = float((information * block.estimates * block.altitude).sum()) / known
    return THRESHOLDS.scale_height / (mean**2 + 1.0 / known)


def _precision(block: _Block, information: Array) -> Array:
    share = _reduced_share(block, information)
    bands = altitude_correlation.correlated_precision(information, share, block.correlation)
    rows = block.gaps
    if rows.size and block.correlation > 0.0:
        bands[:, rows] = altitude_correlation.gap_precision(
            information[rows], share[rows], block.correlation
        )
    return bands


def _reduced_share(block: _Block, information: Array) -> Array:
    """Return the correlated share of the variance: an estimate with less weight has more own noise.

    The bisquare raises the information of good estimates slightly above the whole; a share above 1
    would leave a negative variance.
    """
    whole = block.information
    ratio = np.where(whole > 0.0, information / np.where(whole > 0.0, whole, 1.0), 1.0)
    return np.asarray(block.share * np.minimum(ratio, 1.0))


def _respond(block: _Block, fit: _Fit, rows: Array) -> Array:
    """Apply the smoother of each profile to its row."""
    right = _smoothing.multiply_rows(fit.bands, np.where(fit.information > 0.0, rows, 0.0))
    return fit.smoothing.mean(fit.smoothing.solve(right, fit.bands, block.stiffness)[0])


def _own_weights(bands: Array, inverse: Array) -> Array:
    """Return the diagonal of the smoother of each system."""
    own: Array = bands[0] * inverse[0]
    for step in (1, 2):
        both = (bands[step] * inverse[step])[:, :-step]
        own[:, :-step] += both
        own[:, step:] += both
    return own


def _calibrate(block: _Block, fit: _Fit, within: Booleans) -> _calibration.Calibration:
    information, share = _calibration.typical_profile(
        fit.information, _reduced_share(block, fit.information)
    )
    right = _smoothing.multiply_rows(fit.bands, block.estimates)
    pilot = fit.smoothing.times(THRESHOLDS.pilot)
    rough = pilot.solve(right, fit.bands, block.stiffness)[0]
    right = _smoothing.multiply_rows(fit.bands, rough)
    smooth = fit.smoothing.solve(right, fit.bands, block.stiffness)[0]
    bands = altitude_correlation.correlated_precision(
        information[np.newaxis], share[np.newaxis], block.correlation
    )
    return _calibration.Calibration(
        bands[:, 0],
        information,
        share,
        block.correlation,
        block.stiffness,
        float(fit.smoothing.weight[0]),
        np.where(within, rough - smooth, np.nan),
        _calibration.relative_squares(fit.depth, fit.variance, within),
    )


def _inflation(freedom: Array | None, correlation: float, altitudes: int) -> Array:
    """Return the factor on variances because noise is estimated from a window of residuals."""
    if freedom is None:
        return np.ones(altitudes)
    total = np.convolve(freedom.sum(axis=0), np.ones(THRESHOLDS.pooled), mode="full")
    start = THRESHOLDS.pooled // 2
    square = correlation * correlation
    known = total[start : start + altitudes] * (1.0 - square) / (1.0 + square)
    known = np.maximum(known, THRESHOLDS.fewest_freedom)
    factor: Array = known / (known - 2.0)
    return factor


def _variance_factor(
    calibration: _calibration.Calibration | None,
    inflation: Array,
    upper: Integers,
    lower: Integers,
) -> Array:
    """Return the factor on the posterior variance of differences of optical depths.

    The shape is (profile, difference), or (difference,) if common to all profiles: without a
    calibration, where the block is too small.
    """
    below = np.where(lower >= 0, inflation[np.maximum(lower, 0)], 1.0)
    few: Array = np.maximum(inflation[upper], below)
    if calibration is None:
        return few
    factor: Array = few * _calibration.variance_ratio(calibration, upper, lower)
    return factor


def _result(
    block: _Block,
    fit: _Fit,
    factor: Callable[[Integers, Integers], Array],
    within: Booleans,
    step: Array,
) -> VerticalResult:
    rows = np.arange(step.size)
    error = np.sqrt(fit.variance * factor(rows, np.full(step.size, -1)))
    extinction_error = np.sqrt(fit.extinction_variance * factor(rows, rows - 1)) / step
    certain = within & (np.abs(fit.depth) > error)
    response = _respond(block, fit, fit.depth)
    share = np.where(certain, response / np.where(certain, fit.depth, 1.0), np.nan)
    freedom = fit.own.sum(axis=1)
    used = fit.information > 0.0
    return VerticalResult(
        optical_depth=np.where(within, fit.depth, np.nan),
        optical_depth_standard_error=np.where(within, error, np.nan),
        extinction=np.where(within, fit.extinction / step, np.nan),
        extinction_standard_error=np.where(within, extinction_error, np.nan),
        data_share=share,
        effective_degrees_of_freedom=freedom,
        correlation=block.correlation,
        interpolated=within & ~used,
        downweighted=fit.information < THRESHOLDS.majority * block.information,
        saturated=fit.smoothing.saturated,
        # Where the data are smoother than allowed, their noise is not mistaken for structure.
        undersmoothed=(not fit.smoothing.limited)
        & (freedom > THRESHOLDS.most_freedom)
        & (freedom > THRESHOLDS.roughest * used.sum(axis=1)),
        high_correlation=block.correlation > THRESHOLDS.highest_correlation,
        block=block,
        fit=fit,
        factor=factor,
    )


def nearest_rising(profiles: Array) -> Array:
    """Return the nearest profiles that start at 0 or above and never decrease.

    Isotonic regression (`ayer1955`), of which negative values then become 0: the least-squares
    projection under both conditions. The result has no negative extinction, but means over many
    profiles are biased high where the signal is weak; those of the profiles themselves are not.

    Parameters
    ----------
    profiles : (profile, altitude) float64
        NaN is skipped and stays.

    Returns
    -------
    (profile, altitude) float64
    """
    from scipy.optimize import isotonic_regression  # noqa: PLC0415 - loads many other modules

    out = np.full(profiles.shape, np.nan)
    for row, rising in zip(profiles, out, strict=True):
        known = ~np.isnan(row)
        if known.any():
            rising[known] = np.maximum(isotonic_regression(row[known]).x, 0.0)
    return out
