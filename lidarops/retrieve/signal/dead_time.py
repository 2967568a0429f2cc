"""Dead time of a photon counter, from the analog record of the same detector."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.signal.thresholds import THRESHOLDS

_TAIL: Final = 10
"""Part of the bins, the last ones, that hold the background."""
_PASSES: Final = 12
"""Gauss-Newton steps of a solution."""
_ROUNDS: Final = 6
"""Solutions, each with the bins up to the load of the one before."""


@dataclass(frozen=True, slots=True)
class DeadTimeEstimate:
    """Dead time of a non-paralysable counter."""

    dead_time: float
    """s."""
    standard_error: float
    """s: of noise, and half of how far the dead time of low rates differs from that of all."""
    highest_load: float
    """Largest share of dead time among the bins."""


def estimate_dead_time(
    counts: Array, exposure: Array, analog: Array, analog_variance: Array, lag: float
) -> DeadTimeEstimate | None:
    r"""Return the dead time by which photon counting is proportional to analog, or None.

    With the analog signal :math:`a` without background, the measured rate :math:`m` of photon
    counting and the rate :math:`b` of its background,

    .. math:: m = \frac{r}{1 + \tau r}, \qquad r = s a + b,

    is solved for :math:`s` and :math:`\tau` by least squares, with the Poisson variance of the
    counts and the variance of :math:`s a`. Profiles are summed before, because the noise of
    :math:`a` would make :math:`s` too small. Bins up to a load :math:`\tau m` of 0.95 count: those
    of a high load depend least on a distorted analog record. The error contains half the change of
    the dead time if only those up to half of it count: a detector whose pulses differ in height is
    no non-paralysable counter.

    Parameters
    ----------
    counts : (group, range) float
        Sums of the counts of several profiles.
    exposure : (group,) float
        Microseconds for which a bin of a group was open.
    analog, analog_variance : (group, range) float
        mV, mV2: means of the same profiles, weighted by shots; NaN where missing.
    lag : float
        Bins by which analog is late.

    Returns
    -------
    DeadTimeEstimate or None
        None where no bin has a load of 0.1, all bins have the same signal, or the dead time is less
        than 5 standard errors of noise.

    References
    ----------
    licel2023
    """
    bins = min(counts.shape[1], analog.shape[1])
    tail = slice(bins - max(bins // _TAIL, 1), bins)
    dark = np.isfinite(analog[:, tail])
    if not dark.any(axis=1).all():
        return None
    level = np.where(dark, analog[:, tail], 0.0).sum(axis=1) / dark.sum(axis=1)
    place = np.arange(bins) + lag
    signal, variance = (
        np.stack([np.interp(place, np.arange(bins), row, np.nan, np.nan) for row in part[:, :bins]])
        for part in (analog, analog_variance)
    )
    signal = signal - level[:, np.newaxis]
    rate = counts[:, :bins] / exposure[:, np.newaxis]
    sky = rate[:, tail].mean(axis=1, keepdims=True)
    skies = np.repeat(sky, bins, axis=1)
    open_for = np.repeat(THRESHOLDS.dead_time_block * exposure[:, np.newaxis], bins, axis=1)
    cells = _Cells(
        *map(_blocks, (rate, signal, variance / THRESHOLDS.dead_time_block, skies, open_for))
    )
    whole = _fit(cells, THRESHOLDS.highest_load)
    low = _fit(cells, 0.5 * THRESHOLDS.highest_load)
    if whole is None or low is None:
        return None
    dead_time, noise, load = whole
    if not dead_time > THRESHOLDS.least_dead_time * noise or load < THRESHOLDS.least_load:
        return None
    error = math.hypot(noise, 0.5 * (dead_time - low[0]))
    return DeadTimeEstimate(1e-6 * dead_time, 1e-6 * error, load)


class _Cells(NamedTuple):
    """Means over a few bins, (group, cell)."""

    rate: Array
    analog: Array
    variance: Array
    sky: Array
    exposure: Array


def _blocks(values: Array) -> Array:
    """Return means over `Thresholds.dead_time_block` bins."""
    whole = values.shape[1] // THRESHOLDS.dead_time_block * THRESHOLDS.dead_time_block
    return np.asarray(
        values[:, :whole].reshape(len(values), -1, THRESHOLDS.dead_time_block).mean(axis=2)
    )


def _fit(cells: _Cells, highest: float) -> tuple[float, float, float] | None:
    """Return dead time and its error by noise, microseconds, and the load of cells below one.

    None where the cells do not determine them.
    """
    known = np.isfinite(cells.analog) & np.isfinite(cells.variance)
    known &= cells.analog > THRESHOLDS.least_analog * np.sqrt(np.where(known, cells.variance, 1.0))
    known &= cells.rate > THRESHOLDS.least_rate
    fastest = math.inf
    solution: tuple[float, float, float] | None = None
    for _ in range(_ROUNDS):
        used = known & (cells.rate < fastest)
        solution = _solve(*(part[used] for part in cells)) if used.any() else None
        if solution is None:
            return None
        # Only ever less, so that the rounds converge.
        fastest = min(fastest, highest / solution[0])
    return solution


def _solve(
    rate: Array, analog: Array, variance: Array, sky: Array, exposure: Array
) -> tuple[float, float, float] | None:
    """Return dead time and its error by noise, microseconds, and the highest load; see `_fit`."""
    dead_time = THRESHOLDS.first_dead_time
    slope = float((rate - sky).sum() / analog.sum())
    error = math.inf
    for _ in range(_PASSES):
        true = np.maximum(slope * analog + sky, 1e-6)
        share = 1.0 / (1.0 + dead_time * true)
        model, of_true = true * share, share**2
        noise = model / exposure + (slope * of_true) ** 2 * variance
        jacobian = np.stack([-(true**2) * of_true, analog * of_true])
        weighted = jacobian / noise
        normal = weighted @ jacobian.T
        try:
            change = np.linalg.solve(normal, weighted @ (rate - model))
            square = float(np.linalg.inv(normal)[0, 0])
        except np.linalg.LinAlgError:
            return None
        if square < 0.0:  # By rounding: all cells are alike.
            return None
        error = math.sqrt(square)
        dead_time = float(np.clip(dead_time + change[0], *THRESHOLDS.dead_times))
        slope += float(change[1])
    return dead_time, error, float((rate * dead_time).max())
