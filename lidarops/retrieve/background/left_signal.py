"""Judge how much signal is left in the tail: the far range whose mean is the background.

In front of the tail, the signal without background is S - L, where L is the mean signal in the
tail, which was subtracted with the background. Unless the air becomes more turbid, S falls at
least with the square of range; this bounds L.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarops.retrieve.background.thresholds import THRESHOLDS
from lidarops.retrieve.common.arrays import Array, Booleans


@dataclass(frozen=True, slots=True)
class LeftSignal:
    """Signal that may have been subtracted with the background, one value a profile."""

    most: Array
    """In the unit of the power; NaN where no bin before the tail is known."""
    standard_error: Array

    @property
    def detected(self) -> Array:
        """`most` where the signal before the tail exceeds its noise, else 0."""
        with np.errstate(invalid="ignore"):
            beyond_noise = self.most > THRESHOLDS.detected * self.standard_error
        return np.where(beyond_noise, self.most, 0.0)


def window_before(start: float) -> tuple[float, float]:
    """Return the ranges, near and far, of the window that is compared with a tail.

    Parameters
    ----------
    start : float
        m, start of the tail.
    """
    return THRESHOLDS.nearest * start, THRESHOLDS.farthest * start


def shifts(shift: Array, standard_error: Array) -> Booleans:
    """Return where a shift of a value by signal left in the tail is too large for no flag.

    Parameters
    ----------
    shift, standard_error : (...) float
        Of the value, in one unit; NaN raises no flag.
    """
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(shift) > THRESHOLDS.share_of_error * standard_error)


def left_in_tail(
    power: Array,
    range: Array,  # noqa: A002 - the field's word
    variance: Array,
    tail: slice,
    background: Array,
    background_standard_error: Array,
    shape: Array | None = None,
) -> LeftSignal:
    """Return the most signal that the mean of a tail may contain.

    Parameters
    ----------
    power, variance : (..., range) float
        Bins are skipped where either is not finite.
    range : (range,) float
        m, ascending.
    tail : slice
        Bins whose mean is the background.
    background, background_standard_error : (...) float
        From these bins.
    shape : (..., range) float, optional
        Signal that falls no faster than the actual one from the window before to the tail. By
        default that of air of constant scattering, without attenuation.

    Returns
    -------
    LeftSignal
        With the leading axes of `power`.
    """
    before = slice(*np.searchsorted(range, window_before(float(range[tail][0]))))
    if before.start == before.stop:
        unknown = np.full(power.shape[:-1], np.nan)
        return LeftSignal(unknown, unknown)
    slowest = range**-2.0 if shape is None else shape
    fall = slowest[..., tail].mean(axis=-1) / slowest[..., before].mean(axis=-1)
    net, noise = power[..., before] - background[..., np.newaxis], variance[..., before]
    known = np.isfinite(net) & np.isfinite(noise)
    count = known.sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(known, net, 0.0).sum(axis=-1) / count
        error = np.sqrt(np.where(known, noise, 0.0).sum(axis=-1)) / count
        spread = np.hypot(error, background_standard_error)
    return LeftSignal(mean * fall / (1.0 - fall), spread * fall / (1.0 - fall))
