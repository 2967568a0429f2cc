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
from lidarops.retrieve.multiangle import _calibration, _smoothing
from lidarops.retrieve.multiangle._smoothing import Smoothing
from lidarops.retrieve.multiangle.altitude_correlation import AltitudeNoise, correlated_precision
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_UNIFORM: Final = 1e-3
"""Largest relative deviation of a step from the mean step; allows for rounded altitudes."""


@dataclass(frozen=True, slots=True)
class _Block:
    """Estimates with the properties common to them."""

    altitude: Array
    """m above the lidar."""
    estimates: Array
    """0 where there is none."""
    information: Array
    noise: AltitudeNoise
    bands: Array
    """Precision of the estimates."""
    stiffness: Array


@dataclass(frozen=True, slots=True)
class _Fit:
    """Solution of a block."""

    smoothing: Smoothing
    depth: Array
    variance: Array
    extinction: Array
    """Optical depth of the layer from the altitude below."""
    extinction_variance: Array
    freedom: Array
    """(profile,): effective degrees of freedom."""


@dataclass(frozen=True, slots=True)
class VerticalResult:
    """Smoothed profiles, (profile, altitude) unless stated; NaN beyond the reach."""

    optical_depth: Array
    """From the lidar to the altitude."""
    optical_depth_standard_error: Array
    """Random error and smoothing error."""
    optical_depth_error_air: Array
    """Part of the standard error that the air makes."""
    extinction: Array
    """m-1, mean of the layer between the altitude and the next lower one (or the lidar)."""
    extinction_standard_error: Array
    """m-1."""
    data_share: Array
    """The solution smoothed once more, over the solution: 1 where smoothing changes nothing. NaN
    where the optical depth is not larger than its standard error."""
    effective_degrees_of_freedom: Array
    """(profile,): effective number of independent values in the profile."""
    interpolated: Booleans
    """No estimate there; interpolated from those around, or from the lidar."""
    block: _Block
    fit: _Fit
    factor: Callable[[Integers, Integers], tuple[Array, Array]]
    """Of the variances of differences of optical depths; see `_variance_factors`."""

    def respond(self, rows: Array) -> Array:
        """Return the solution for other estimates with the same weights, NaN beyond the reach.

        This is linear: the smoother of each profile is applied to its row.

        Parameters
        ----------
        rows : (profile, altitude) float
            Finite wherever there was an estimate.
        """
        known = np.where(self.block.information > 0.0, rows, 0.0)
        smooth = _respond(self.block, self.fit.smoothing, known)
        return np.where(np.isfinite(self.optical_depth), smooth, np.nan)

    def layer(self, lower: int, upper: int) -> tuple[Array, Array]:
        """Return the optical depth between two altitudes, and its standard error, (profile,).

        The standard error is far smaller than that of a difference with independent errors.

        Parameters
        ----------
        lower, upper : int
            Indices of altitudes in ascending order, -1 for the lidar.
        """
        block, smoothing = self.block, self.fit.smoothing
        right = np.zeros(block.estimates.shape)
        right[:, upper] = 1.0
        if lower >= 0:
            right[:, lower] = -1.0
        estimates = _smoothing.multiply_rows(block.bands, block.estimates)
        inverse, solved = (
            smoothing.solve(rows, block.bands, block.stiffness)[0] for rows in (right, estimates)
        )
        posterior, value = (
            rows[:, [upper]] - (rows[:, [lower]] if lower >= 0 else 0.0)
            for rows in (inverse, solved)
        )
        depth, variance = smoothing.mixed(value, posterior)
        variance *= self.factor(np.array([upper]), np.array([lower]))[0]
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
    noise: AltitudeNoise | None = None,
) -> VerticalResult:
    """Return profiles with smooth extinction from optical depths of single altitudes.

    The weight of smoothness and the calibration of the standard errors are common to the profiles.
    With fewer than 8 profiles, solutions are averaged over the weight.

    Parameters
    ----------
    optical_depth : (profile, altitude) float
        Estimates of single altitudes; NaN where there is none. Each profile has one.
    information : (profile, altitude) float
        Reciprocal variances; NaN or 0 where there is no estimate.
    altitude : (altitude,) float
        m above the lidar, ascending and uniform.
    noise : AltitudeNoise, optional
        If not given, the estimates are taken as uncorrelated, with exactly known variance.

    Raises
    ------
    RetrievalInputError
        For altitudes that are not uniform.

    References
    ----------
    patterson1971 (likelihood), mallows1973 (Cp), wahba1983 (intervals), takahashi1973
    (variances).
    """
    _require_uniform(altitude)
    used = np.isfinite(optical_depth) & (information > 0.0)
    block = _block(
        np.where(used, optical_depth, 0.0), np.where(used, information, 0.0), altitude, noise
    )
    fit = _fit(block)
    within = np.cumsum(used[:, ::-1], axis=1)[:, ::-1] > 0
    calibration = None
    if len(within) >= THRESHOLDS.fewest_to_choose:
        scale = _calibration.relative_squares(fit.depth, fit.variance, within)
        calibration = _pilot_change(block, fit, within), scale
    inflation = np.ones(altitude.size) if noise is None else _inflation(noise)
    factor = partial(_variance_factors, _typical(block, fit.smoothing), inflation, calibration)
    return _result(block, fit, factor, within)


def _require_uniform(altitude: Array) -> None:
    steps = np.diff(altitude)
    mean = (altitude[-1] - altitude[0]) / max(steps.size, 1)
    if np.any(np.abs(steps - mean) > _UNIFORM * mean):
        raise RetrievalInputError(
            "is not uniform", field="altitude", remedy="interpolate the signals to a uniform grid"
        )


def _block(
    depth: Array, information: Array, altitude: Array, noise: AltitudeNoise | None
) -> _Block:
    if noise is None:
        noise = AltitudeNoise(0.0, np.zeros((len(depth), altitude.size - 1)), np.zeros(0))
    bands = correlated_precision(information, noise.shared, noise.correlation)
    stiffness = _smoothing.penalty(altitude)
    return _Block(altitude, depth, information, noise, bands, stiffness)


def _fit(block: _Block) -> _Fit:
    """Choose the smoothness of a block and solve."""
    information, bands = block.information, block.bands
    highest = int(np.flatnonzero((information > 0.0).any(axis=0))[-1])
    unit = float(information[information > 0.0].mean()) * block.altitude[highest] ** 3
    one = len(information) >= THRESHOLDS.fewest_to_choose
    weights = _smoothing.weights_up_to(_largest_smoothing(block, information), unit, one=one)
    scores = _smoothing.score_smoothing(bands, block.estimates, block.stiffness, weights)
    smoothing = _smoothing.choose_smoothing(scores, one=one)
    right = _smoothing.multiply_rows(bands, block.estimates)
    solved, diagonal, beside = smoothing.solve(right, bands, block.stiffness, inverse=True)
    gained = np.diff(solved, axis=1, prepend=0.0)
    uncertain = diagonal.copy()
    uncertain[:, 1:] += diagonal[:, :-1] - 2.0 * beside[:, :-1]
    repeated = np.repeat(bands, smoothing.share.size, axis=1)
    own = repeated[0] * diagonal + 2.0 * repeated[1] * beside
    return _Fit(
        smoothing,
        *smoothing.mixed(solved, diagonal),
        *smoothing.mixed(gained, uncertain),
        smoothing.mean(own).sum(axis=1),
    )


def _largest_smoothing(block: _Block, information: Array) -> float:
    """Return the weight with which extinction may change by its mean within a scale height."""
    known = float((information * block.altitude**2).sum())
    mean = float((information * block.estimates * block.altitude).sum()) / known
    return THRESHOLDS.scale_height / (mean**2 + 1.0 / known)


def _respond(block: _Block, smoothing: Smoothing, rows: Array) -> Array:
    """Apply the smoother of each profile to its row."""
    right = _smoothing.multiply_rows(block.bands, rows)
    return smoothing.mean(smoothing.solve(right, block.bands, block.stiffness)[0])


def _typical(block: _Block, smoothing: Smoothing) -> _calibration.Typical:
    information, shared = _calibration.typical_profile(block.information, block.noise.shared)
    bands = correlated_precision(
        information[np.newaxis], shared[np.newaxis], block.noise.correlation
    )
    return _calibration.Typical(
        bands[:, 0],
        information,
        shared,
        block.noise.correlation,
        block.stiffness,
        float(smoothing.weight[smoothing.share.argmax()]),
    )


def _pilot_change(block: _Block, fit: _Fit, within: Booleans) -> Array:
    """Return the pilot solution minus its smoothed form, (profile, altitude)."""
    rough = _respond(block, fit.smoothing.times(THRESHOLDS.pilot), block.estimates)
    smooth = _respond(block, fit.smoothing, rough)
    return np.where(within, rough - smooth, np.nan)


def _inflation(noise: AltitudeNoise) -> Array:
    """Return the factor on variances because noise is estimated from a window of residuals."""
    square = noise.correlation**2
    known = noise.freedom * (1.0 - square) / (1.0 + square)
    known = np.maximum(known, THRESHOLDS.fewest_freedom)
    factor: Array = known / (known - 2.0)
    return factor


def _variance_factors(
    typical: _calibration.Typical,
    inflation: Array,
    calibration: tuple[Array, Array] | None,
    upper: Integers,
    lower: Integers,
) -> tuple[Array, Array]:
    """Return variances of differences of optical depths over posterior ones: of all, of the air.

    The shape is (profile, difference), or (difference,) if common to all profiles, as all are
    without a calibration, where the block is too small. A calibration is the change of the pilot
    solution, (profile, altitude), and the scale of its square, (profile,).
    """
    known = _calibration.sandwich(typical, upper, lower)
    below = lower >= 0
    few = np.maximum(inflation[upper], np.where(below, inflation[np.maximum(lower, 0)], 1.0))
    air = few * known[-1] / known[0]
    if calibration is None:
        return few * (known[1] + known[2]) / known[0], air
    change, scale = calibration
    bias = change[:, upper] - np.where(below, change[:, np.maximum(lower, 0)], 0.0)
    return few * _calibration.variance_ratio(known, bias, scale), air


def _result(
    block: _Block,
    fit: _Fit,
    factor: Callable[[Integers, Integers], tuple[Array, Array]],
    within: Booleans,
) -> VerticalResult:
    step = np.diff(block.altitude, prepend=0.0)
    rows = np.arange(step.size)
    error, air = (np.sqrt(fit.variance * of) for of in factor(rows, np.full(step.size, -1)))
    extinction_error = np.sqrt(fit.extinction_variance * factor(rows, rows - 1)[0]) / step
    certain = within & (np.abs(fit.depth) > error)
    known = np.where(block.information > 0.0, fit.depth, 0.0)
    response = _respond(block, fit.smoothing, known)
    return VerticalResult(
        optical_depth=np.where(within, fit.depth, np.nan),
        optical_depth_standard_error=np.where(within, error, np.nan),
        optical_depth_error_air=np.where(within, air, np.nan),
        extinction=np.where(within, fit.extinction / step, np.nan),
        extinction_standard_error=np.where(within, extinction_error, np.nan),
        data_share=np.where(certain, response / np.where(certain, fit.depth, 1.0), np.nan),
        effective_degrees_of_freedom=fit.freedom,
        interpolated=within & ~(block.information > 0.0),
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
