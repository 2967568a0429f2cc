"""Calibration of the standard errors of a block, by the spread of a rougher solution.

Formula numbers are those of ``docs/algorithms/vertical.md``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Integers
from lidarops.retrieve.multiangle import _smoothing
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_COMPUTED: Final = 48
"""Most differences that are computed, not interpolated: factors on errors become up to 2 percent
smaller, beside a gap up to 14."""


@dataclass(frozen=True, slots=True)
class Typical:
    """A profile that represents all of a block in quantities that depend on weights only."""

    bands: Array
    """(2, altitude): its precision."""
    information: Array
    """(altitude,): 0 where there is no estimate."""
    shared: Array
    """(altitude - 1,): correlation of its noise at neighbouring altitudes in equal air."""
    correlation: float
    """Correlation of the correlated noise at neighbouring altitudes."""
    stiffness: Array
    """(3, altitude): bands of the penalty on roughness."""
    smoothing: float
    """Weight of the penalty, in the unit of the system."""


def sandwich(typical: Typical, upper: Integers, lower: Integers) -> Array:
    """Return posterior variances of differences of optical depths, and their components.

    Formula 3 of ``docs/algorithms/vertical.md``. Of many differences, some are computed, more at
    low altitudes, and those between them interpolated.

    Parameters
    ----------
    typical : Typical
    upper, lower : (difference,) int64
        Altitudes in ascending order; -1 for the lidar.

    Returns
    -------
    (5, difference) float64
        Posterior variance, variance from noise and air, expected square of the smoothing error,
        variance of the smoothing error estimated from the pilot, and variance from air alone.
    """
    every = np.arange(upper.size)
    some = every
    if every.size > _COMPUTED:
        places = every[-1] * np.linspace(0.0, 1.0, _COMPUTED) ** 2
        some = np.unique(np.rint(places).astype(np.int64))
    bands, each = typical.bands[:, np.newaxis], np.arange(some.size)
    a = np.zeros((some.size, bands.shape[2]))
    a[each, upper[some]] = 1.0
    below = lower[some]
    a[each[below >= 0], below[below >= 0]] = -1.0
    solved = _inverse(typical, 1.0, a)
    x = _smoothing.multiply_rows(bands, solved)
    y = _smoothing.multiply_rows(bands, _inverse(typical, THRESHOLDS.pilot, a - x))
    posterior = (a * solved).sum(axis=1)
    model = np.maximum(posterior - (solved * x).sum(axis=1), 0.0)
    (noise, air), of_pilot = _noise_and_air(typical, x), _noise_and_air(typical, y)
    parts = posterior, noise + air, model, sum(of_pilot), air
    return np.stack([np.interp(every, some, part) for part in parts])


def _inverse(typical: Typical, factor: float, rows: Array) -> Array:
    """Return rows times the inverse of the system, with a multiple of its smoothing."""
    count = len(rows)
    out = np.empty((1, *rows.shape))
    _smoothing.solve_banded(
        np.broadcast_to(typical.bands[:, np.newaxis], (2, *rows.shape)).copy(),
        rows, typical.stiffness, np.arange(count),
        np.full(count, factor * typical.smoothing), out,
    )  # fmt: skip
    return np.asarray(out[0])


def _noise_and_air(typical: Typical, y: Array) -> tuple[Array, Array]:
    """Return the parts of y'Vy of each row: the share of the air decays with the distance."""
    known = typical.information > 0.0
    error = np.where(known, 1.0 / np.sqrt(np.where(known, typical.information, 1.0)), 0.0)
    from scipy.signal import lfilter  # noqa: PLC0415 - loads a third of a second of other modules

    # Neighbours of the ends are as those of the altitudes beside them.
    shared = typical.shared if typical.shared.size else np.zeros(1)
    share = np.convolve(np.pad(shared, 1, mode="edge"), [0.5, 0.5], mode="valid")[: y.shape[1]]
    own, common = (y * error) ** 2 * (1.0 - share), y * error * np.sqrt(share)
    decay = typical.correlation
    tail = lfilter([0.0, decay], [1.0, -decay], common, axis=1)
    return own.sum(axis=1), (common * (common + 2.0 * tail)).sum(axis=1)


def typical_profile(information: Array, shared: Array) -> tuple[Array, Array]:
    """Return means over the profiles of a block, of information and of what neighbours share."""
    used = information > 0.0
    linked = used[:, 1:] & used[:, :-1]
    mean = np.where(linked, shared, 0.0).sum(axis=0) / np.maximum(linked.sum(axis=0), 1)
    return information.sum(axis=0) / np.maximum(used.sum(axis=0), 1), np.maximum(mean, 0.0)


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
    usual = np.maximum(np.nanmedian(square, axis=0), np.finfo(np.float64).tiny)
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


def variance_ratio(known: Array, bias: Array, scale: Array) -> Array:
    """Return calibrated over posterior variance of differences of optical depths.

    Parameters
    ----------
    known : (5, difference) float64
        From `sandwich`.
    bias : (profile, difference) float64
        Pilot solution minus its smoothed form; NaN beyond the reach.
    scale : (profile,) float64
        From `relative_squares`.

    Returns
    -------
    (profile, difference) float64
    """
    square = scale[:, np.newaxis] * _smoothing_square(bias, known)
    return np.asarray((known[1] + square) / known[0])
