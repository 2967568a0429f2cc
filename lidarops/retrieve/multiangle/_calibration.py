"""Calibration of the standard errors of a block, by the spread of a rougher solution.

Formula numbers are those of ``docs/algorithms/vertical.md``.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Integers, median
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.multiangle import _smoothing
from lidarops.retrieve.multiangle.altitude_correlation import AltitudeNoise
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS


class Sandwich(NamedTuple):
    """A profile that represents all of a block in quantities that depend on weights only.

    Matrices over altitudes, of which a row is that of one optical depth.
    """

    inverse: Array
    """Posterior covariance."""
    data: Array
    """Response of the optical depths to the estimates."""
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
        """Return the matrices of the results of `typical_profile` and of their precision.

        `correlation` is that of the air at neighbouring altitudes, `weight` that of the penalty.
        """
        information, shared = typical
        every = np.eye(len(information))
        factors, rough = (
            np.repeat(_smoothing.factor_bands(bands, stiffness, own), len(every), axis=2)
            for own in np.array([[weight], [THRESHOLDS.pilot * weight]])
        )
        inverse = _smoothing.solve_bands(factors, every)
        repeated = np.repeat(bands, len(every), axis=2)
        data = _smoothing.multiply(repeated, inverse)
        pilot = _smoothing.multiply(repeated, _smoothing.solve_bands(rough, every - data))
        known = information[:, 0] > 0.0
        variance = np.where(known, 1.0 / np.where(known, information[:, 0], 1.0), 0.0)
        # Neighbours of the ends are as those of the altitudes beside them.
        beside = shared[:, 0] if len(shared) else np.zeros(1)
        share = 0.5 * (np.append(beside, beside[-1]) + np.append(beside[0], beside))
        share = share[: variance.size]
        noise = np.stack(
            [variance * (1.0 - share), np.sqrt(variance * share), np.full(share.size, correlation)]
        )
        return cls(inverse, data.T.copy(), pilot.T.copy(), noise)

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
        return np.asarray(_parts(*self, upper, lower))


@compiled
def _parts(
    inverse: Array, data: Array, pilot: Array, noise: Array, upper: Integers, lower: Integers
) -> Array:
    """Return what `Sandwich.parts` returns."""
    out = np.empty((5, upper.size))
    for d in range(upper.size):
        u, below = upper[d], lower[d]
        posterior, explained = inverse[u, u], 0.0
        if below >= 0:
            posterior += inverse[below, below] - inverse[u, below] - inverse[below, u]
        # The share of the air decays with distance.
        own, decayed, of_own, of_air = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros(2)
        for k in range(len(inverse)):
            solved, x, y = inverse[u, k], data[u, k], pilot[u, k]
            if below >= 0:
                solved -= inverse[below, k]
                x -= data[below, k]
                y -= pilot[below, k]
            explained += solved * x
            for i, value in enumerate((x, y)):
                decayed[i] = noise[2, k] * (decayed[i] + own[i])
                own[i] = noise[1, k] * value
                of_own[i] += noise[0, k] * value * value
                of_air[i] += own[i] * (own[i] + 2.0 * decayed[i])
        out[0, d], out[2, d] = posterior, max(posterior - explained, 0.0)
        out[1, d], out[4, d] = of_own[0] + of_air[0], of_air[0]
        out[3, d] = of_own[1] + of_air[1]
    return out


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
    the highest altitude within the reach of each, one at least. Arguments are (profile, altitude);
    results (profile,), 1 where noise exceeds the optical depth by far.
    """
    tops, own = np.unique(within.sum(axis=1) - 1, return_inverse=True)
    reached = within[:, tops]
    square = np.where(reached, depth[:, tops] ** 2, np.nan)
    noise = np.where(reached, variance[:, tops], np.nan)
    # The median, because the square of a single noisy profile may exceed all others.
    usual = np.maximum(median(square, reached), np.finfo(np.float64).tiny)
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


def _smoothing_square(bias: Array, known: Array) -> Array:
    """Return the square of the smoothing error, formula 4 of the page, (difference,).

    `bias` is (profile, difference), NaN beyond the reach; `known` is from `Sandwich.parts`.
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

        Of differences between altitudes as in `Sandwich.parts`.
        """
        known = self.sandwich.parts(upper, lower)
        below = lower >= 0
        few = np.maximum(
            self.inflation[upper], np.where(below, self.inflation[np.maximum(lower, 0)], 1.0)
        )
        square = known[2]
        if self.change is not None:
            beside = self.change[:, np.maximum(lower, 0)] if below.any() else 0.0
            bias = self.change[:, upper] - np.where(below, beside, 0.0)
            square = self.scale[:, np.newaxis] * _smoothing_square(bias, known)
        few = few / known[0]
        return few * (known[1] + np.atleast_2d(square)), few * known[4]


def inflation(noise: AltitudeNoise) -> Array:
    """Return the factor on variances because noise is estimated from a window of residuals."""
    square = noise.correlation**2
    known = noise.freedom * (1.0 - square) / (1.0 + square)
    known = np.maximum(known, THRESHOLDS.fewest_freedom)
    return np.asarray(known / (known - 2.0))
