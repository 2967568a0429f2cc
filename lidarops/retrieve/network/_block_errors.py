"""Errors of ln extinction that the profiles of a block show together.

In thin air a single profile shows little of its own error: amplified noise raises its logarithm of
extinction, and the error computed there is too small. A field that the prior excludes shifts all
profiles alike, and no profile can separate it from attenuation. The curvature of a signal within
the bins of a fit is hidden by noise. The block shows all three. Values do not change here, only
their errors.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.network._condensed_signals import CondensedSignals
from lidarops.retrieve.network._empirical_prior import BlockSolution, median
from lidarops.retrieve.network.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]

_MEDIAN_OVER_MEAN: Final = np.pi / 2.0
"""Variance of a median over the variance of a mean."""
_ROUNDING: Final = 1e-9
"""Relative size of a field below which it is rounding."""


def prior_variance(block: BlockSolution) -> Array:
    """Return (profile, crossing) variances by fields that deviate from the prior.

    One field is no sample of many: errors are stated for one that deviates `doubt` times as much
    as the prior states, and where nothing can contradict a prior, as much as the weakest one.
    """
    solution, free = block.profiles, block.free_mean
    weakest = max(THRESHOLDS.strengths[-1] / solution.prior.strength, THRESHOLDS.doubt)
    factor = np.where(np.isfinite(free.variance[0]), THRESHOLDS.doubt, weakest)
    return np.asarray((factor**2 - 1.0) * solution.prior_share)


def noise_bias_variance(block: BlockSolution) -> Array:
    """Return (crossing,) squares of the bias of single profiles by noise.

    Profiles and their mean share the field and the prior. Where they differ on average, the
    logarithm of extinction is not linear in the noise of a profile; their mean has less noise.
    Differences below half the typical standard error are harmless.
    """
    logarithm, variance = block.profiles.logarithm, block.profiles.variance
    middle = median(logarithm)
    largest = THRESHOLDS.largest_deviation * np.sqrt(median(variance))
    # A profile with contradictory beams must not raise the errors of all others.
    deviation = np.clip(logarithm - middle, -largest, largest)
    gap = _mean(deviation) + middle - block.mean.logarithm[0]
    typical = _mean(np.minimum(variance, largest**2))
    return np.where(gap * gap > THRESHOLDS.harmless**2 * typical, gap * gap, 0.0)


def curvature_variance(data: CondensedSignals, carried: Array) -> Array:
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
    data : CondensedSignals
        Of the profiles of one block.
    carried : (profile, crossing, passage) float64
        Derivatives of ln extinction by the log values.
    """
    error, noise = np.moveaxis(data.curvature_error, -1, 0)
    number = data.usable.sum(axis=0)
    known = np.where(data.usable, 1.0, np.nan)
    shared, shared_noise = np.nan_to_num(median(error * known)), median(noise * known)
    # The median of one or two is their mean.
    shared_noise *= np.where(number > 2, _MEDIAN_OVER_MEAN, 1.0) / np.maximum(number, 1)
    shared_noise = np.nan_to_num(shared_noise)
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


def _mean(values: Array) -> Array:
    """Return means over profiles of the finite values; NaN where there is none."""
    known = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(known, values, 0.0).sum(axis=0) / known.sum(axis=0))
