"""Test on a few profiles of a scene whether a stretch of range holds any backscatter.

Raman products retrieve nothing where this test finds none. It never yields a result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.background.thresholds import THRESHOLDS
from lidarops.retrieve.common.arrays import Array, Booleans, Integers


@dataclass(frozen=True, slots=True)
class LightDetection:
    """Backscatter that some profiles show in a stretch of range."""

    profiles: int
    """Profiles tested that have values there, saturated ones included."""
    significance: float
    """Largest backscatter of a profile over its standard error; 0 where there is none."""


def spaced_indices(count: int, most: int) -> Integers:
    """Return the indices of at most `most` of `count` profiles, evenly spaced, ends included.

    Parameters
    ----------
    count : int
        At least 1.
    most : int
        At least 1.
    """
    if count < 1 or most < 1:
        raise RetrievalInputError(f"{most} of {count} profiles cannot be chosen", field="most")
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def detect_light(
    power: npt.ArrayLike,
    variance: npt.ArrayLike,
    quality: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the term of the field
    near: float,
    far: float,
) -> LightDetection:
    """Return the significance of backscatter between two ranges.

    By the weighted least-squares fit of ``P = b + A r**-2`` to the bins of the stretch and to the
    last tenth of the bins; the significance of a profile is `A` over its standard error, which
    has unit variance for pure noise.

    Parameters
    ----------
    power, variance : (profile, range) array_like
        mV or MHz, and its square; NaN = missing.
    quality : (profile, range) array_like of int
        `Quality` bits.
    range : (range,) array_like
        m, increasing.
    near, far : float
        m.

    Returns
    -------
    LightDetection

    Raises
    ------
    RetrievalInputError
        Where the shapes do not fit.
    """
    power, variance = (np.asarray(values, dtype=np.float64) for values in (power, variance))
    flags, r = np.asarray(quality), np.asarray(range, dtype=np.float64)
    if power.ndim != 2 or not power.shape == variance.shape == flags.shape == (len(power), r.size):
        raise RetrievalInputError(
            f"shapes {power.shape}, {variance.shape}, {flags.shape} and {r.shape} do not fit",
            field="power",
            remedy="give profiles over range, and one range per bin",
        )
    tail = (np.arange(r.size) >= (1.0 - THRESHOLDS.tail_share) * r.size) & (r > 0.0)
    used = np.flatnonzero(tail | ((r >= near) & (r <= far) & (r > 0.0)))
    power, variance, flags, r = power[:, used], variance[:, used], flags[:, used], r[used]
    inside, tail = (r >= near) & (r <= far), tail[used]
    measured = np.isfinite(power) & np.isfinite(variance) & (variance > 0.0)
    measured &= (flags & int(Quality.INPUT_MISSING)) == 0
    saturated = (flags & int(Quality.SATURATED)) != 0
    seen = ((measured | saturated) & inside).sum(axis=1) >= THRESHOLDS.fewest_bins
    fitted = measured & (inside | tail)
    significance = _significance(power, variance, fitted, r)
    testable = (measured & inside).sum(axis=1) >= THRESHOLDS.fewest_bins
    significances = significance[testable & np.isfinite(significance)]
    return LightDetection(
        profiles=int(seen.sum()),
        significance=max(float(significances.max()), 0.0) if significances.size else 0.0,
    )


def _significance(
    power: Array,
    variance: Array,
    fitted: Booleans,
    r: Array,
) -> Array:
    with np.errstate(invalid="ignore", divide="ignore"):
        weight = np.where(fitted, 1.0 / variance, 0.0)
        shape = r**-2.0
        total = weight.sum(axis=1)
        centred = shape - ((weight * shape).sum(axis=1) / total)[:, np.newaxis]
        projection = (weight * centred * np.where(fitted, power, 0.0)).sum(axis=1)
        return np.asarray(projection / np.sqrt((weight * centred**2).sum(axis=1)))
