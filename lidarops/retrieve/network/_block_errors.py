"""Errors of a profile that only the other profiles of its block show.

In thin air a single profile shows little of its own error. Amplified noise raises its logarithm
of extinction, and the error computed there is then too small. A field that the prior excludes
shifts all profiles alike, and no profile can separate it from attenuation. The block shows both:
how far single profiles are from the solution of their mean, how large an error typically is, and
what the mean of the beams leaves undetermined without a prior. Values do not change here, only
their errors.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.network.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Booleans = npt.NDArray[np.bool_]

_ROUNDING: Final = 1e-9
"""Relative size of a field below which it is rounding."""


def bent_fields(position: Array) -> Array:
    """Return quadratic fields without level and gradient that span curvature in any direction.

    The sum of their squares, averaged over the crossings, is `bend` squared. The fields of
    r_i r_j, i < j, count twice, as in the squares of r' H r with a random symmetric H.

    Parameters
    ----------
    position : (crossing, 3) float64
        m.

    Returns
    -------
    (field, crossing) float64
        Fields of ln extinction; none where a gradient describes any field of so few crossings.
    """
    return _cached_bent_fields(np.ascontiguousarray(position, dtype=np.float64).tobytes())


@lru_cache(maxsize=32)
def _cached_bent_fields(position: bytes) -> Array:
    # All blocks share a network, and a decomposition costs more than a profile.
    positions = np.frombuffer(position, dtype=np.float64).reshape(-1, 3)
    if positions.shape[0] == 0:
        return np.zeros((0, 0))
    centred = positions - positions.mean(axis=0)
    radius = float(np.sqrt(np.mean(np.sum(centred * centred, axis=1))))
    if radius == 0.0:
        return np.zeros((0, positions.shape[0]))
    centred /= radius
    first, second = np.triu_indices(3)
    weight = np.where(first == second, 1.0, np.sqrt(2.0))
    fields = (weight * centred[:, first] * centred[:, second]).T
    linear = np.column_stack([np.ones(len(centred)), centred])
    axes, scale, _ = np.linalg.svd(linear, full_matrices=False)
    linear_axes = axes[:, scale > _ROUNDING * scale[0]]
    fields = fields - (fields @ linear_axes) @ linear_axes.T
    fields = fields[np.mean(fields * fields, axis=1) > _ROUNDING**2]
    total = float(np.sqrt(np.sum(fields * fields) / len(centred)))
    return np.ascontiguousarray(fields * (THRESHOLDS.bend / total if total > 0.0 else 0.0))


def noise_bias_variance(logarithm: Array, variance: Array, mean: Array) -> Array:
    """Return the squares of the bias of single profiles by noise.

    Profiles and their mean share the field and the prior. Where they differ on average, the
    logarithm of extinction is not linear in the noise of a profile; their mean has less noise.
    A field that changes within the block makes a difference smaller than the errors.

    Parameters
    ----------
    logarithm, variance : (profile, crossing) float64
        ln extinction and its variance; NaN where there is none.
    mean : (crossing,) float64
        ln extinction from the mean of the beams.

    Returns
    -------
    (crossing,) float64
        0 where the difference is less than half the typical standard error.
    """
    known = np.isfinite(logarithm) & np.isfinite(variance)
    number = np.maximum(known.sum(axis=0), 1)
    median = _median(np.where(known, logarithm, np.nan))
    largest = THRESHOLDS.largest_deviation**2 * _median(np.where(known, variance, np.nan))
    # A profile with contradictory beams must not raise the errors of all others.
    with np.errstate(invalid="ignore"):
        typical = np.where(known, np.minimum(variance, largest), 0.0).sum(axis=0) / number
        deviation = np.clip(logarithm - median, -np.sqrt(largest), np.sqrt(largest))
        gap = np.where(known, deviation, 0.0).sum(axis=0) / number + median - mean
    significant = known.any(axis=0) & (gap * gap > THRESHOLDS.harmless**2 * typical)
    return np.asarray(np.where(significant, gap * gap, 0.0))


def excluded_field_variance(
    excluded_variance: Array, with_prior: Array, without_prior: Array, variance: Array
) -> Array:
    """Return variances from fields that the prior excludes and the beams do not.

    All profiles share such an error, so it is at most what the mean of the beams leaves
    undetermined without a prior.

    Parameters
    ----------
    excluded_variance : (profile, crossing) float64
        Variance from such fields where only the prior limits them.
    with_prior, without_prior : (crossing,) float64
        ln extinction from the mean of the beams, with and without the prior.
    variance : (crossing,) float64
        Variance of `without_prior`; NaN where the beams leave a crossing undetermined.

    Returns
    -------
    (profile, crossing) float64
    """
    gap = without_prior - with_prior
    allowed = variance + gap * gap
    return np.asarray(
        np.minimum(excluded_variance, np.where(np.isfinite(allowed), allowed, np.inf))
    )


def at_least_typical(extinction: Array, variance: Array, block: Indices, seen: Booleans) -> Array:
    """Return variances raised to at least the median of their block, in m-2.

    The error of an attenuation does not depend on the extinction that noise makes of it, so the
    error of a profile with a high value is too small. Each profile is compared with those that
    have at least its usable passages, because missing passages make errors larger. Small errors
    stay as they are.

    Parameters
    ----------
    extinction, variance : (profile, crossing) float64
        m-1 and m-2; NaN where there is none.
    block : (profile,) intp
    seen : (profile, passage) bool
        True where a passage is usable.
    """
    raised = variance.copy()
    for number in np.unique(block):
        profiles = np.flatnonzero(block == number)
        patterns, kind = np.unique(seen[profiles], axis=0, return_inverse=True)
        for k, pattern in enumerate(patterns):
            alike = profiles[kind.reshape(-1) == k]
            peers = profiles[(seen[profiles] >= pattern).all(axis=1)]
            raised[alike] = _at_least_median(extinction, variance, alike, peers)
    return raised


def _at_least_median(extinction: Array, variance: Array, rows: Indices, peers: Indices) -> Array:
    """Return variances of rows, at least the medians of their peers where these are large."""
    typical, median = _median(variance[peers]), _median(extinction[peers])
    own = variance[rows]
    with np.errstate(invalid="ignore"):
        large = typical > (THRESHOLDS.nonlinear_error * median) ** 2
    return np.asarray(np.where(large & np.isfinite(own), np.fmax(own, typical), own))


def _median(values: Array) -> Array:
    """Return (crossing,) medians of the finite values; NaN where there is none."""
    known = np.isfinite(values)
    if known.all():
        return np.asarray(np.median(values, axis=0))
    out = np.full(values.shape[1], np.nan)
    for column in np.flatnonzero(known.any(axis=0)):
        out[column] = np.median(values[known[:, column], column])
    return out
