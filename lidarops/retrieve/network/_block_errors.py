"""What the profiles of a block tell about the errors of each of them in a network.

In thin air a profile alone says little of its own error. Its logarithm of extinction lies high
where noise is amplified, and the error taken there is small; and a field that the prior rules out
moves all profiles alike, which no profile can tell from attenuation. Of both the block knows more:
how far single profiles lie off the solution of their mean, how large an error typically is, and
what the mean of the beams leaves open without any prior. Nothing here changes a value.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Booleans = npt.NDArray[np.bool_]

BEND: Final = 0.15
"""Standard deviation of ln extinction over the crossings by which a field may bend beyond any
gradient: as much as it may tilt (`lidarops.retrieve.network._empirical_prior.GRADIENT`)."""
_HARMLESS: Final = 0.5
"""Of the standard error that is reported."""
_NOT_LINEAR: Final = 0.1
"""Relative standard error, typical of a block, from which on that of a profile depends on where
noise has put the value."""
_FARTHEST: Final = 8.0
"""Median standard errors from the median, beyond which a profile is taken for no further off, and
that it states at most."""
_FLAT: Final = 1e-9
"""Of a field's size: less is rounding."""


def bends(position: Array) -> Array:
    """Return quadratic fields, free of level and gradient, that make up one of any direction.

    The sum of their squares, averaged over the crossings, is `BEND` squared; the fields of
    r_i r_j, i < j, count twice, as the squares of r' H r with a random symmetric H do.

    Parameters
    ----------
    position : (crossing, 3) float64
        m.

    Returns
    -------
    (field, crossing) float64
        Of ln extinction; no field where crossings are so few that a gradient describes any.
    """
    return _bends(np.ascontiguousarray(position, dtype=np.float64).tobytes())


@lru_cache(maxsize=32)
def _bends(position: bytes) -> Array:
    # Blocks of profiles share a network, and a decomposition costs more than a profile.
    where = np.frombuffer(position, dtype=np.float64).reshape(-1, 3)
    if where.shape[0] == 0:
        return np.zeros((0, 0))
    centred = where - where.mean(axis=0)
    size = float(np.sqrt(np.mean(np.sum(centred * centred, axis=1))))
    if size == 0.0:
        return np.zeros((0, where.shape[0]))
    centred /= size
    first, second = np.triu_indices(3)
    weight = np.where(first == second, 1.0, np.sqrt(2.0))
    fields = (weight * centred[:, first] * centred[:, second]).T
    plain = np.column_stack([np.ones(len(centred)), centred])
    axes, scale, _ = np.linalg.svd(plain, full_matrices=False)
    known = axes[:, scale > _FLAT * scale[0]]
    fields = fields - (fields @ known) @ known.T
    fields = fields[np.mean(fields * fields, axis=1) > _FLAT**2]
    whole = float(np.sqrt(np.sum(fields * fields) / len(centred)))
    return np.ascontiguousarray(fields * (BEND / whole if whole > 0.0 else 0.0))


def of_noise(logarithm: Array, variance: Array, mean: Array) -> Array:
    """Return the squares of what noise moves single profiles by, all in one direction.

    Profiles and their mean see the same field through the same prior. Where they differ on
    average, the logarithm of extinction is not linear in the noise of a profile; in their mean,
    noise is less. A field that changes within the block makes them differ by less than errors are.

    Parameters
    ----------
    logarithm, variance : (profile, crossing) float64
        Of ln extinction; NaN where there is none.
    mean : (crossing,) float64
        ln extinction by the mean of the beams.

    Returns
    -------
    (crossing,) float64
        0 where the difference is less than half of the typical standard error.
    """
    known = np.isfinite(logarithm) & np.isfinite(variance)
    number = np.maximum(known.sum(axis=0), 1)
    middle = _median(np.where(known, logarithm, np.nan))
    farthest = _FARTHEST**2 * _median(np.where(known, variance, np.nan))
    # Of a profile whose beams contradict each other, all others would state the error.
    with np.errstate(invalid="ignore"):
        typical = np.where(known, np.minimum(variance, farthest), 0.0).sum(axis=0) / number
        apart = np.clip(logarithm - middle, -np.sqrt(farthest), np.sqrt(farthest))
        gap = np.where(known, apart, 0.0).sum(axis=0) / number + middle - mean
    counts = known.any(axis=0) & (gap * gap > _HARMLESS**2 * typical)
    return np.asarray(np.where(counts, gap * gap, 0.0))


def of_field(missed: Array, told: Array, free: Array, variance: Array) -> Array:
    """Return variances by fields that the prior rules out and the beams do not.

    All profiles share such an error, so that it is no larger than what the mean of the beams leaves
    open when nothing is told beforehand.

    Parameters
    ----------
    missed : (profile, crossing) float64
        Variance by such fields, if nothing but the prior spoke of them.
    told, free : (crossing,) float64
        ln extinction by the mean of the beams, with the prior and without.
    variance : (crossing,) float64
        Of `free`; NaN where the beams leave anything open.

    Returns
    -------
    (profile, crossing) float64
    """
    gap = free - told
    allowed = variance + gap * gap
    return np.asarray(np.minimum(missed, np.where(np.isfinite(allowed), allowed, np.inf)))


def at_least_typical(extinction: Array, variance: Array, block: Indices, seen: Booleans) -> Array:
    """Return variances that are no less than the median of their block, in m-2.

    The error of an attenuation does not depend on the extinction that noise makes of it; what a
    profile that came out high states is too little. It is compared with those that see all that
    it sees: what others lack makes their errors larger. Where errors are small, they are left
    alone.

    Parameters
    ----------
    extinction, variance : (profile, crossing) float64
        m-1 and m-2; NaN where there is none.
    block : (profile,) intp
    seen : (profile, passage) bool
    """
    out = variance.copy()
    for number in np.unique(block):
        mine = np.flatnonzero(block == number)
        patterns, kind = np.unique(seen[mine], axis=0, return_inverse=True)
        for k, pattern in enumerate(patterns):
            alike = mine[kind.reshape(-1) == k]
            peers = mine[(seen[mine] >= pattern).all(axis=1)]
            out[alike] = _lifted(extinction, variance, alike, peers)
    return out


def _lifted(extinction: Array, variance: Array, rows: Indices, peers: Indices) -> Array:
    """Return variances of rows, no less than the medians of their peers where these are large."""
    usual, middle = _median(variance[peers]), _median(extinction[peers])
    own = variance[rows]
    with np.errstate(invalid="ignore"):
        large = usual > (_NOT_LINEAR * middle) ** 2
    return np.asarray(np.where(large & np.isfinite(own), np.fmax(own, usual), own))


def _median(values: Array) -> Array:
    """Return (crossing,) medians of what is finite; NaN where nothing is."""
    known = np.isfinite(values)
    if known.all():
        return np.asarray(np.median(values, axis=0))
    out = np.full(values.shape[1], np.nan)
    for column in np.flatnonzero(known.any(axis=0)):
        out[column] = np.median(values[known[:, column], column])
    return out
