"""Errors of extinction where the signal is curved within the bins of a fit."""

from __future__ import annotations

from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.network.thresholds import THRESHOLDS

_MEDIAN_OVER_MEAN: Final = np.pi / 2.0
"""Variance of a median over the variance of a mean."""


def curvature_variance(curvature_error: Array, usable: Booleans, carried: Array) -> Array:
    r"""Return (profile, crossing) variances from curved signals within a fit.

    Where the logarithm f of the signal is curved along the beam, a line through equal weights of
    bins is too high by about f'' (bins^2 - 1) step^2 / 24. A polynomial of degree 4 through the
    same bins has almost none of this error, but twice the noise, so it is not a better value.
    Their difference, carried to the solution, shows the error. The result is the largest of
    three, each less the contribution of noise: the square of the shift by the median of the block,
    the mean square of the shifts of its profiles (a layer may rise or sink), and the square of the
    shift of the profile itself.

    Parameters
    ----------
    curvature_error : (profile, passage, 2) float64
        Difference of line and polynomial, and its variance by noise, in the profiles of a block.
    usable : (profile, passage) bool
    carried : (profile, crossing, passage) float64
        Derivatives of ln extinction by the log values.
    """
    error, noise = np.moveaxis(curvature_error, -1, 0)
    number = usable.sum(axis=0)
    shared, shared_noise = (np.nan_to_num(median(values, usable)) for values in (error, noise))
    # The median of one or two is their mean.
    shared_noise *= np.where(number > 2, _MEDIAN_OVER_MEAN, 1.0) / np.maximum(number, 1)
    with np.errstate(over="ignore", invalid="ignore"):
        squares = carried * carried
        own_shift, own_noise = (
            (values * of[:, np.newaxis]).sum(axis=2)
            for values, of in ((carried, error), (squares, noise))
        )
        shared_shift = (carried * shared).sum(axis=2)
        shared_excess = shared_shift**2 - THRESHOLDS.shared_noise * (squares * shared_noise).sum(2)
        # A noisy profile would hide the shift of the others, or imitate one.
        counted = own_noise > 0.0
        counted &= own_noise <= THRESHOLDS.noisy_profile * np.median(own_noise, axis=0)
        number = np.maximum(counted.sum(axis=0), 1)
        by_chance = (1.0 + THRESHOLDS.chance * np.sqrt(2.0 / number)) * own_noise
        excess = np.where(counted, own_shift**2 - by_chance, 0.0).sum(axis=0) / number
        largest = np.fmax(shared_excess, own_shift**2 - THRESHOLDS.profile_noise * own_noise)
        return np.asarray(np.fmax(np.fmax(largest, excess), 0.0))


def median(values: Array, known: Booleans) -> Array:
    """Return medians over profiles of the known values; NaN where there is none."""
    if not len(values):
        return np.full(values.shape[1], np.nan)
    number, columns = known.sum(axis=0), np.arange(values.shape[1])
    ordered = np.sort(np.where(known, values, np.inf), axis=0)
    low, high = (ordered[place, columns] for place in (np.maximum(number - 1, 0) // 2, number // 2))
    return np.where(number > 0, 0.5 * (low + high), np.nan)
