"""Combine optical depths of single altitudes into profiles with smooth extinction.

A scan gives the optical depth of each altitude independently. Altitudes are connected because
extinction changes gradually and the optical depth is zero at the lidar. The formulas are in
``docs/algorithms/vertical.md``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.multiangle import _smoothing
from lidarops.retrieve.multiangle._block import every_nth
from lidarops.retrieve.multiangle._calibration import (
    Calibration,
    Sandwich,
    inflation,
    relative_squares,
    typical_profile,
)
from lidarops.retrieve.multiangle._smoothing import Smoother
from lidarops.retrieve.multiangle.altitude_correlation import AltitudeNoise, correlated_precision
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_UNIFORM: Final = 1e-3
"""Largest relative deviation of a step from the mean step; allows for rounded altitudes."""


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
    weight: Array
    """(candidate,): of smoothness, those that are averaged over."""
    smoother: Smoother
    estimates: Array
    """(altitude, profile): 0 where there is none."""
    calibration: Calibration

    def respond(self, rows: Array) -> Array:
        """Return the solution for other estimates with the same weights, NaN beyond the reach.

        This is linear: the smoother of each profile is applied to its row.

        Parameters
        ----------
        rows : (profile, altitude) float
            Finite wherever there was an estimate.
        """
        known = np.where(self.smoother.bands[0] > 0.0, rows.T, 0.0)
        return np.where(np.isfinite(self.optical_depth), self.smoother.respond(known).T, np.nan)

    def layer(self, lower: int, upper: int) -> tuple[Array, Array]:
        """Return the optical depth between two altitudes, and its standard error, (profile,).

        The standard error is far smaller than that of a difference with independent errors.

        Parameters
        ----------
        lower, upper : int
            Indices of altitudes in ascending order, -1 for the lidar.
        """
        unit = np.zeros(self.estimates.shape)
        unit[upper] = 1.0
        if lower >= 0:
            unit[lower] = -1.0
        right = _smoothing.multiply(self.smoother.bands, self.estimates)
        posterior, value = (
            columns[[upper]] - (columns[[lower]] if lower >= 0 else 0.0)
            for columns in (self.smoother.solve(unit), self.smoother.solve(right))
        )
        (depth,), (variance,) = self.smoother.mixed(value, posterior)
        factors, _ = self.calibration.factors(np.array([upper]), np.array([lower]))
        reached = np.isfinite(self.optical_depth[:, upper])
        error = np.sqrt(variance * factors[:, 0])
        return np.where(reached, depth, np.nan), np.where(reached, error, np.nan)


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
    patterson1971 (likelihood), mallows1973 (Cp), wahba1983 (intervals), takahashi1973 (variances).
    """
    _require_uniform(altitude)
    used = (np.isfinite(optical_depth) & (information > 0.0)).T.copy()
    estimates, precise = (
        np.where(used, values.T, 0.0).copy() for values in (optical_depth, information)
    )
    widened = np.ones(altitude.size) if noise is None else inflation(noise)
    if noise is None:
        noise = AltitudeNoise(0.0, np.zeros((used.shape[1], altitude.size - 1)), np.zeros(0))
    shared, stiffness = noise.shared.T.copy(), _smoothing.penalty(altitude)
    bands = correlated_precision(precise, shared, noise.correlation)
    typical = typical_profile(precise, shared)
    of_typical = correlated_precision(*typical, noise.correlation)
    weight, share = _choose(bands, estimates, precise, altitude, stiffness, of_typical)
    smoother = Smoother.of(bands, stiffness, weight, share)
    middle = float(np.exp(share @ np.log(weight)))
    sandwich = Sandwich.of(typical, of_typical, noise.correlation, stiffness, middle)
    within = (np.cumsum(used[::-1], axis=0)[::-1] > 0).T
    change = None
    if len(within) >= THRESHOLDS.fewest_to_choose:
        rough = Smoother.of(bands, stiffness, THRESHOLDS.pilot * weight, share).respond(estimates)
        change = np.where(within, (rough - smoother.respond(rough)).T, np.nan)
    return _result(smoother, estimates, altitude, within, weight, (sandwich, widened, change))


def _require_uniform(altitude: Array) -> None:
    steps = np.diff(altitude)
    mean = (altitude[-1] - altitude[0]) / max(steps.size, 1)
    if np.any(np.abs(steps - mean) > _UNIFORM * mean):
        raise RetrievalInputError(
            "is not uniform", field="altitude", remedy="interpolate the signals to a uniform grid"
        )


def _choose(
    bands: Array,
    estimates: Array,
    information: Array,
    altitude: Array,
    stiffness: Array,
    of_typical: Array,
) -> tuple[Array, Array]:
    """Return the weights of smoothness of a block, and their shares."""
    highest = int(np.flatnonzero((information > 0.0).any(axis=1))[-1])
    unit = float(information[information > 0.0].mean()) * altitude[highest] ** 3
    profiles = estimates.shape[1]
    one = profiles >= THRESHOLDS.fewest_to_choose
    largest = _largest_smoothing(estimates, information, altitude[:, np.newaxis])
    weight = _smoothing.weights_up_to(largest, unit)
    every = every_nth(profiles)
    scores = _smoothing.score_smoothing(
        bands[..., every].copy(), estimates[:, every], of_typical, stiffness, weight
    )
    return _smoothing.choose_smoothing(scores, one=one)


def _largest_smoothing(estimates: Array, information: Array, altitude: Array) -> float:
    """Return the weight with which extinction may change by its mean within a scale height."""
    known = float((information * altitude**2).sum())
    mean = float((information * estimates * altitude).sum()) / known
    return THRESHOLDS.scale_height / (mean**2 + 1.0 / known)


def _result(
    smoother: Smoother,
    estimates: Array,
    altitude: Array,
    within: Booleans,
    weight: Array,
    known: tuple[Sandwich, Array, Array | None],
) -> VerticalResult:
    """Return the solution with calibrated errors."""
    bands, step = smoother.bands, np.diff(altitude, prepend=0.0)
    solved = smoother.solve(_smoothing.multiply(bands, estimates))
    diagonal, beside = _smoothing.invert_bands(smoother.factors)
    gained = np.diff(solved, axis=0, prepend=0.0)
    uncertain = diagonal.copy()
    uncertain[1:] += diagonal[:-1] - 2.0 * beside[:-1]
    (depth, variance), (rise, of_rise) = (
        [part.T for part in smoother.mixed(*both)]
        for both in ((solved, diagonal), (gained, uncertain))
    )
    own = bands[0] * smoother.mean(diagonal) + 2.0 * bands[1] * smoother.mean(beside)
    scale = np.ones(1)
    if known[2] is not None:
        scale = relative_squares(depth, variance, within)
    calibration = Calibration(*known, scale)
    rows = np.arange(step.size)
    error, air = (
        np.sqrt(variance * of) for of in calibration.factors(rows, np.full_like(rows, -1))
    )
    extinction_error = np.sqrt(of_rise * calibration.factors(rows, rows - 1)[0]) / step
    certain = within & (np.abs(depth) > error)
    response = smoother.respond(np.where(bands[0] > 0.0, depth.T, 0.0)).T
    return VerticalResult(
        optical_depth=np.where(within, depth, np.nan),
        optical_depth_standard_error=np.where(within, error, np.nan),
        optical_depth_error_air=np.where(within, air, np.nan),
        extinction=np.where(within, rise / step, np.nan),
        extinction_standard_error=np.where(within, extinction_error, np.nan),
        data_share=np.where(certain, response / np.where(certain, depth, 1.0), np.nan),
        effective_degrees_of_freedom=own.sum(axis=0),
        interpolated=within & ~(bands[0] > 0.0).T,
        weight=weight,
        smoother=smoother,
        estimates=estimates,
        calibration=calibration,
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
