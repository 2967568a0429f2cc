"""Errors of extinction that the profiles of a block show together.

In thin air a single profile shows little of its own error: amplified noise raises its logarithm of
extinction, and the error computed there is too small. A field that deviates from the prior shifts
all profiles alike, and no profile can separate it from attenuation. The curvature of a signal
within the bins of a fit is hidden by noise. The block shows all three: by the difference of
profiles and their mean and by the median error, by the mean without a prior, and by the median
curvature. Values do not change here, only their errors.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.network._condensed_signals import CondensedSignals
from lidarops.retrieve.network._empirical_prior import BlockSolution, median
from lidarops.retrieve.network.thresholds import THRESHOLDS

_MEDIAN_OVER_MEAN: Final = np.pi / 2.0
"""Variance of a median over the variance of a mean."""
_ROUNDING: Final = 1e-9
"""Relative size of a field below which it is rounding."""


def bent_fields(position: Array) -> Array:
    """Return (field, crossing) quadratic fields of ln extinction without level and gradient.

    They span curvature in any direction: the sum of their squares, averaged over the crossings,
    is `bend` squared. The fields of r_i r_j, i < j, count twice, as in the squares of r' H r with
    a random symmetric H. There is none where a gradient describes any field of so few crossings.

    Parameters
    ----------
    position : (crossing, 3) float64
        m.
    """
    centred = position - position.mean(axis=0)
    # A single crossing has no size.
    centred = centred / max(float(np.sqrt(np.mean(centred**2))), np.finfo(float).tiny)
    first, second = np.triu_indices(3)
    weight = np.where(first == second, 1.0, np.sqrt(2.0))
    fields = (weight * centred[:, first] * centred[:, second]).T
    axes, scale, _ = np.linalg.svd(np.insert(centred, 0, 1.0, axis=1), full_matrices=False)
    axes = axes[:, scale > _ROUNDING * scale[0]]
    fields = fields - (fields @ axes) @ axes.T
    fields[np.mean(fields**2, axis=1) <= _ROUNDING**2] = 0.0
    total = float(np.sqrt(np.sum(fields**2) / len(centred)))
    return np.asarray(fields * (THRESHOLDS.bend / total if total > 0.0 else 0.0))


def field_variance(block: BlockSolution, position: Array) -> Array:
    """Return (profile, crossing) variances by the field, which the prior does not describe.

    One field is no sample of many: errors are stated for one that deviates `doubt` times as much
    as the prior states, and where nothing can contradict a prior, as much as the weakest one; and
    that is curved by `bend`. All profiles share the field, so their median shift is at most what
    their solutions differ from the mean of the beams without a prior, and the error of that mean.
    A profile with fewer beams or more noise is shifted farther, as its prior has more weight.

    Parameters
    ----------
    block : BlockSolution
    position : (crossing, 3) float64
        m.
    """
    solution, free = block.profiles, block.free_mean
    weakest = max(THRESHOLDS.strengths[-1] / solution.prior.strength, THRESHOLDS.doubt)
    factor = np.where(np.isfinite(free.variance[0]), THRESHOLDS.doubt, weakest)
    bends = solution.prior_response @ bent_fields(position).T
    expected = factor**2 * solution.prior_share + (bends**2).sum(axis=2)
    gap = median(solution.logarithm) - free.logarithm[0]
    with np.errstate(invalid="ignore", divide="ignore"):
        allowed = (free.variance[0] + gap**2) / median(expected)
        return np.asarray(expected * np.fmin(allowed, 1.0))


def at_least_typical(extinction: Array, variance: Array, usable: Booleans) -> Array:
    """Return variances raised to at least the median of their block, in m-2.

    The error of an attenuation does not depend on the extinction that noise makes of it, so the
    error of a profile with a high value is too small. Each profile is compared with those that
    have at least its usable passages, because missing passages make errors larger. Small errors
    stay as they are.

    Parameters
    ----------
    extinction, variance : (profile, crossing) float64
        m-1 and m-2; NaN where there is none.
    usable : (profile, passage) bool
    """
    raised = variance.copy()
    for pattern in np.unique(usable, axis=0):
        alike, peers = (usable == pattern).all(axis=1), (usable >= pattern).all(axis=1)
        typical, level = median(variance[peers]), median(extinction[peers])
        large = typical > (THRESHOLDS.nonlinear_error * level) ** 2
        raised[alike] = np.maximum(variance[alike], np.where(large, typical, 0.0))
    return raised


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
