"""Calibration of the standard errors of a block, by the spread of a rougher solution.

Formula numbers are those of ``docs/algorithms/vertical.md``.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Integers
from lidarops.retrieve.multiangle import _smoothing
from lidarops.retrieve.multiangle.altitude_correlation import AltitudeNoise, decayed_sums
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS


class Sandwich(NamedTuple):
    """A profile that represents all of a block in quantities that depend on weights only.

    Matrices over altitudes, of which a column is that of one optical depth.
    """

    inverse: Array
    """Posterior covariance."""
    data: Array
    """Response of the optical depths to the estimates, transposed."""
    pilot: Array
    """The same of the change of the pilot solution by smoothing."""
    noise: Array
    """(3, altitude): variance of the errors of estimates that is their own, root of that which
    they share with others, and its correlation at neighbouring altitudes."""

    @classmethod
    def of(
        cls,
        typical: tuple[Array, Array],
        bands: Array,
        correlation: float,
        stiffness: Array,
        weight: float,
    ) -> Self:
        """Return the matrices.

        Parameters
        ----------
        typical : (altitude, 1) float, (altitude - 1, 1) float
            Information, and correlation of errors at neighbouring altitudes in equal air.
        bands : (2, altitude, 1) float
            Precision of the same.
        correlation : float
            Of the air at neighbouring altitudes.
        stiffness : (3, altitude) float
        weight : float
            Of the penalty.
        """
        information, shared = typical
        every = np.eye(len(information))
        repeated = np.repeat(bands, len(every), axis=2)
        factors, rough = (
            _smoothing.factor_bands(repeated, stiffness, np.full(len(every), times * weight))
            for times in (1.0, THRESHOLDS.pilot)
        )
        inverse = _smoothing.solve_bands(factors, every)
        data = _smoothing.multiply(bands, inverse)
        pilot = _smoothing.multiply(bands, _smoothing.solve_bands(rough, every - data))
        known = information[:, 0] > 0.0
        variance = np.where(known, 1.0 / np.where(known, information[:, 0], 1.0), 0.0)
        # Neighbours of the ends are as those of the altitudes beside them.
        beside = shared[:, 0] if len(shared) else np.zeros(1)
        share = np.convolve(np.pad(beside, 1, mode="edge"), [0.5, 0.5], mode="valid")
        share = share[: variance.size]
        noise = np.stack(
            [variance * (1.0 - share), np.sqrt(variance * share), np.full(share.size, correlation)]
        )
        return cls(inverse, data, pilot, noise)

    def parts(self, upper: Integers, lower: Integers) -> Array:
        """Return posterior variances of differences of optical depths, and their components.

        Formula 3 of ``docs/algorithms/vertical.md``.

        Parameters
        ----------
        upper, lower : (difference,) int64
            Altitudes in ascending order; -1 for the lidar.

        Returns
        -------
        (5, difference) float64
            Posterior variance, variance from noise and air, expected square of the smoothing error,
            variance of the smoothing error estimated from the pilot, and variance from air alone.
        """
        each = np.arange(upper.size)

        def between(matrix: Array) -> Array:
            return matrix[:, upper] - np.where(lower >= 0, matrix[:, np.maximum(lower, 0)], 0.0)

        solved, x, y = (between(matrix) for matrix in (self.inverse, self.data, self.pilot))
        posterior = solved[upper, each] - np.where(lower >= 0, solved[lower, each], 0.0)
        model = np.maximum(posterior - (solved * x).sum(axis=0), 0.0)
        (noise, air), of_pilot = self._noise_and_air(x), self._noise_and_air(y)
        return np.stack([posterior, noise + air, model, sum(of_pilot), air])

    def _noise_and_air(self, y: Array) -> tuple[Array, Array]:
        """Return the parts of y'Vy of each column: the share of the air decays with distance."""
        own, root, decay = self.noise[:, :, np.newaxis]
        common = root * y
        linked = np.ones((len(y) - 1, y.shape[1]), dtype=np.bool_)
        tail = decayed_sums(common, linked, float(decay[0, 0]))
        return (own * y**2).sum(axis=0), (common * (common + 2.0 * tail)).sum(axis=0)


def typical_profile(information: Array, shared: Array) -> tuple[Array, Array]:
    """Return means over the profiles of a block, of information and of what neighbours share.

    Parameters and results are (altitude, profile).
    """
    used = information > 0.0
    linked = used[1:] & used[:-1]
    count = np.maximum(linked.sum(axis=1, keepdims=True), 1)
    mean = np.where(linked, shared, 0.0).sum(axis=1, keepdims=True) / count
    whole = information.sum(axis=1, keepdims=True)
    return whole / np.maximum(used.sum(axis=1, keepdims=True), 1), np.maximum(mean, 0.0)


def relative_squares(depth: Array, variance: Array, within: Booleans) -> Array:
    """Return the squared optical depth of each profile over the usual one, formula 5 of the page.

    The smoothing error of a profile is proportional to its extinction. Profiles are compared at
    the highest altitude within the reach of each.

    Parameters
    ----------
    depth, variance : (profile, altitude) float64
    within : (profile, altitude) bool
        Altitudes within the reach, at least one of every profile.

    Returns
    -------
    (profile,) float64
        1 where noise exceeds the optical depth by far.
    """
    tops, own = np.unique(within.sum(axis=1) - 1, return_inverse=True)
    reached = within[:, tops]
    square = np.where(reached, depth[:, tops] ** 2, np.nan)
    noise = np.where(reached, variance[:, tops], np.nan)
    # The median, because the square of a single noisy profile may exceed all others.
    usual = np.maximum(_median(square, reached.sum(axis=0)), np.finfo(np.float64).tiny)
    weight = (usual / (usual + noise)) ** 2
    total = np.nansum(weight, axis=0)
    # Zero if no profile is known, or most have no optical depth at all.
    mean = np.nansum(weight * square, axis=0) / np.where(total > 0.0, total, 1.0)
    at_top = np.arange(len(own)), own
    own_square = (square + noise)[at_top]
    usual_square = (np.where(total > 0.0, mean, square) + noise)[at_top]
    known = np.isfinite(own_square) & np.isfinite(usual_square) & (usual_square > 0.0)
    relative = np.where(known, own_square, 1.0) / np.where(known, usual_square, 1.0)
    return np.asarray(np.maximum(relative, THRESHOLDS.least_scale))


def _median(values: Array, count: Integers) -> Array:
    """Return the median of the first axis, of which `count` values are no NaN."""
    ordered, each = np.sort(values, axis=0), np.arange(count.size)
    return np.asarray(0.5 * (ordered[(count - 1) // 2, each] + ordered[count // 2, each]))


def _smoothing_square(bias: Array, known: Array) -> Array:
    """Return the square of the smoothing error, formula 4 of the page, (difference,).

    Parameters
    ----------
    bias : (profile, difference) float64
        NaN beyond the reach.
    known : (5, difference) float64
        From `sandwich`.
    """
    _, _, model, noise, _ = known
    present = np.isfinite(bias)
    count = np.maximum(present.sum(axis=0), 1)
    mean = np.where(present, bias, 0.0).sum(axis=0) / count
    square = np.where(present, bias**2, 0.0).sum(axis=0) / count
    of_mean = noise / count
    common = mean**2 - of_mean
    certain = _trust(model, 4.0 * model * of_mean + 2.0 * of_mean**2)
    shared = np.maximum(np.maximum(common, 0.0), certain * common + (1.0 - certain) * model)
    own = square - mean**2 - (noise - of_mean)
    certain = _trust(model, 2.0 * (noise + model) ** 2 / count)
    rest = (1.0 - certain) * np.maximum(model - shared, 0.0) + certain * own
    result: Array = shared + np.maximum(rest, 0.0)
    return result


def _trust(signal: Array, variance: Array) -> Array:
    return np.asarray(signal**2 / np.maximum(signal**2 + variance, np.finfo(np.float64).tiny))


class Calibration(NamedTuple):
    """Variances of differences of optical depths over posterior ones."""

    sandwich: Sandwich
    inflation: Array
    """(altitude,): factor because noise is estimated from a window of residuals."""
    change: Array | None
    """(profile, altitude): pilot solution minus its smoothed form; NaN beyond the reach. None if
    the block is too small for a calibration."""
    scale: Array
    """(profile,): from `relative_squares`."""

    def factors(self, upper: Integers, lower: Integers) -> tuple[Array, Array]:
        """Return the factors on variances, (profile or 1, difference), and those of the air alone.

        Parameters
        ----------
        upper, lower : (difference,) int64
            Altitudes in ascending order; -1 for the lidar.
        """
        known = self.sandwich.parts(upper, lower)
        below = lower >= 0
        few = np.maximum(
            self.inflation[upper], np.where(below, self.inflation[np.maximum(lower, 0)], 1.0)
        )
        square = known[2]
        if self.change is not None:
            beside = np.where(below, self.change[:, np.maximum(lower, 0)], 0.0)
            bias = self.change[:, upper] - beside
            square = self.scale[:, np.newaxis] * _smoothing_square(bias, known)
        return few * (known[1] + np.atleast_2d(square)) / known[0], few * known[4] / known[0]


def inflation(noise: AltitudeNoise) -> Array:
    """Return the factor on variances because noise is estimated from a window of residuals."""
    square = noise.correlation**2
    known = noise.freedom * (1.0 - square) / (1.0 + square)
    known = np.maximum(known, THRESHOLDS.fewest_freedom)
    return np.asarray(known / (known - 2.0))
