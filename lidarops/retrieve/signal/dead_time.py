"""Dead time of a photon counter, from the analog record of the same detector."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import Array, Integers
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.signal.thresholds import THRESHOLDS

_TAIL: Final = 10
"""Part of the bins, the last ones, that hold the background."""
_PASSES: Final = 12
"""Gauss-Newton steps of a solution."""
_ROUNDS: Final = 6
"""Solutions, each with the bins up to the load of the one before, and by its dead time."""
_ALIKE: Final = 1e10
"""Variance over that with a known slope, beyond which only rounding is left (clipped analog)."""
_LOADS: Final = (1e-3, 1.0)
"""Loads of the highest rate between which a solution is sought, from the lower one on."""
_HIGHEST: Final = 0.99
"""Load of a profile to which it is corrected."""


@dataclass(frozen=True, slots=True)
class DeadTimeEstimate:
    """Dead time of a non-paralysable counter."""

    dead_time: float
    """s."""
    standard_error: float
    """s: of noise, a nonlinear analog record, and half the change by low rates alone."""
    highest_load: float
    """Largest share of dead time among the bins."""


class ProfileGroup(NamedTuple):
    """Profiles of a photon counter, and their mean by the analog record of the detector."""

    counts: Integers | Array
    """(profile, range)."""
    exposure: Array
    """(profile,): microseconds for which a bin was open, above 0."""
    analog: Array
    """(range,): mV, mean of the profiles weighted by exposure; NaN where missing."""
    variance: Array
    """(range,): mV2, of this mean."""


def estimate_dead_time(groups: Sequence[ProfileGroup], lag: float) -> DeadTimeEstimate | None:
    r"""Return the dead time by which photon counting is proportional to analog, or None.

    With the analog signal :math:`a` without background, the measured rate :math:`m` of photon
    counting and the rate :math:`b` of its background,

    .. math:: m = \frac{r}{1 + \tau r}, \qquad r = s a + b,

    is solved for :math:`s` and :math:`\tau` by least squares, with the Poisson variance of the
    counts and the variance of :math:`s a`. Analog is the mean of a group, because its noise would
    make :math:`s` too small. The rate :math:`m` is that of the mean light of the group, by
    profiles: :math:`r` is the mean of :math:`m_j / (1 - \tau m_j)`, because the mean of measured
    rates is lower where laser or air vary. Poisson noise adds the factor :math:`1 + \tau / t` to
    that mean, with the time :math:`t` of a profile; :math:`s` takes it up. Bins up to a load
    :math:`\tau m` of 0.95 in all profiles of a group count: those of a high load depend least on a
    distorted analog record. The error contains half the change of the dead time if only those up
    to half of it count: a detector whose pulses differ in height is no non-paralysable counter. It
    also contains the change by an analog record whose largest signal is 1 percent too large, and
    smaller ones by less in proportion: the data cannot tell that from a dead time.

    Parameters
    ----------
    groups : sequence of ProfileGroup
        With equal numbers of bins.
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
    bins = min(groups[0].counts.shape[1], groups[0].analog.size)
    analog, variance = (
        np.stack([part[:bins] for part in parts])
        for parts in ([g.analog for g in groups], [g.variance for g in groups])
    )
    tail = _tail(bins)
    dark = np.isfinite(analog[:, tail])
    if not dark.any(axis=1).all():
        return None
    level = np.where(dark, analog[:, tail], 0.0).sum(axis=1) / dark.sum(axis=1)
    place = np.arange(bins) + lag
    signal, variance = (
        _blocks(np.stack([np.interp(place, np.arange(bins), r, np.nan, np.nan) for r in part]))
        for part in (analog - level[:, np.newaxis], variance)
    )
    counted = _Counted(groups, bins)
    variance /= THRESHOLDS.dead_time_block
    whole = _fit(counted, signal, variance, THRESHOLDS.highest_load)
    low = _fit(counted, signal, variance, 0.5 * THRESHOLDS.highest_load)
    if whole is None or low is None:
        return None
    dead_time, noise, load = whole
    if not dead_time > COMMON.first_order * noise or load < THRESHOLDS.least_load:
        return None
    # A quadratic analog record looks like a dead time: this changes the largest signal by a share.
    bent = THRESHOLDS.analog_nonlinearity * (1.0 - load) / load * dead_time
    error = math.hypot(noise, 0.5 * (dead_time - low[0]), bent)
    return DeadTimeEstimate(1e-6 * dead_time, 1e-6 * error, load)


class _Light(NamedTuple):
    """What the mean light of groups of profiles gives by a counter, (group, cell); MHz."""

    rate: Array
    """As measured."""
    change: Array
    """Derivative of `rate` to the dead time, MHz2: above 0 where the light varies."""
    background: Array
    """Without dead time, equal in all cells."""


class _Counted:
    """Profiles of groups, for means over cells of a few bins.

    Attributes
    ----------
    peak, exposure : ndarray, shape (group, cell)
        Largest rate of a profile, MHz, and microseconds for which the bins of a cell were open.
    """

    def __init__(self, groups: Sequence[ProfileGroup], bins: int) -> None:
        self._groups, self._bins = groups, bins
        self.peak = np.stack([_blocks(self._rates(group)).max(axis=0) for group in groups])
        open_for = THRESHOLDS.dead_time_block * np.array([g.exposure.sum() for g in groups])
        self.exposure = np.repeat(open_for[:, np.newaxis], self.peak.shape[1], axis=1)

    def _rates(self, group: ProfileGroup) -> Array:
        return group.counts[:, : self._bins] / group.exposure[:, np.newaxis]

    def light(self, dead_time: float) -> _Light:
        """Return the mean light of profiles that are corrected for a dead time, microseconds."""
        means, squares = [], []
        for group in self._groups:
            rates, weights = self._rates(group), group.exposure / group.exposure.sum()
            # A load of 1 has no light; such cells are not used.
            corrected = rates / (1.0 - np.minimum(dead_time * rates, _HIGHEST))
            means.append(weights @ corrected)
            squares.append(weights @ corrected**2)
        light = np.stack(means)
        sky = light[:, _tail(self._bins)].mean(axis=1, keepdims=True)
        cells = _blocks(light)
        share = 1.0 / (1.0 + dead_time * cells)
        change = (_blocks(np.stack(squares)) - cells**2) * share**2
        return _Light(cells * share, change, np.broadcast_to(sky, cells.shape))


def _tail(bins: int) -> slice:
    """Return the bins that hold the background."""
    return slice(bins - max(bins // _TAIL, 1), bins)


def _blocks(values: Array) -> Array:
    """Return means over `Thresholds.dead_time_block` bins."""
    whole = values.shape[1] // THRESHOLDS.dead_time_block * THRESHOLDS.dead_time_block
    return np.asarray(
        values[:, :whole].reshape(len(values), -1, THRESHOLDS.dead_time_block).mean(axis=2)
    )


def _fit(
    counted: _Counted, analog: Array, variance: Array, highest: float
) -> tuple[float, float, float] | None:
    """Return dead time and its error by noise, microseconds, and the load of cells below one.

    None where the cells do not determine them.

    Parameters
    ----------
    counted : _Counted
    analog, variance : (group, cell) float
        mV without background, mV2.
    highest : float
        Load up to which cells count.
    """
    known = np.isfinite(analog) & np.isfinite(variance)
    known &= analog > COMMON.significant * np.sqrt(np.where(known, variance, 1.0))
    known &= counted.light(0.0).rate > THRESHOLDS.least_rate
    fastest, dead_time = math.inf, 0.0
    solution: tuple[float, float, float] | None = None
    for number in range(_ROUNDS):
        used = known & (counted.peak < fastest)
        light = _Light(*(part[used] for part in counted.light(dead_time)))
        parts = (part[used] for part in (analog, variance, counted.exposure))
        solution = _solve(light, dead_time, *parts) if used.any() else None
        if solution is None:
            return None
        dead_time = solution[0]
        # Of varying light, the first rounds give too long ones. Only ever less, so that it ends.
        fastest = min(fastest, highest / dead_time) if number else fastest
    return solution


def _solve(
    light: _Light, of_light: float, analog: Array, variance: Array, exposure: Array
) -> tuple[float, float, float] | None:
    """Return dead time and its error by noise, microseconds, and the highest load; see `_fit`.

    `of_light` is the dead time of `light`, in microseconds.
    """
    least, most = np.array(_LOADS) / light.rate.max()
    dead_time = of_light or least
    slope = float((light.rate - light.background).sum() / analog.sum())
    error = math.inf
    rate = light.rate
    for _ in range(_PASSES):
        rate = light.rate + light.change * (dead_time - of_light)
        true = np.maximum(slope * analog + light.background, 1e-6)
        share = 1.0 / (1.0 + dead_time * true)
        model, of_true = true * share, share**2
        noise = model / exposure + (slope * of_true) ** 2 * variance
        jacobian = np.stack([-(true**2) * of_true - light.change, analog * of_true])
        weighted = jacobian / noise
        normal = weighted @ jacobian.T
        try:
            change = np.linalg.solve(normal, weighted @ (rate - model))
            square = float(np.linalg.inv(normal)[0, 0])
        except np.linalg.LinAlgError:
            return None
        # Else all cells are alike, but for rounding.
        if not 0.0 <= square * normal[0, 0] < _ALIKE:
            return None
        error = math.sqrt(square)
        dead_time = float(np.clip(dead_time + change[0], least, most))
        slope += float(change[1])
    return dead_time, error, float((rate * dead_time).max())
