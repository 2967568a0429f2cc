"""Photoelectrons of a detector, and what two recorders with a lag see of the same ones."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.constants import LICEL_RANGE_PER_MICROSECOND
from lidarops.simulate import _checks
from lidarops.simulate._checks import SimulationInputError

BRIGHTEST: Final = 1.0e6
"""MHz: no detector releases more, so that nothing overflows a metre before the telescope."""

Counts = NDArray[np.int64]
Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Photoelectrons:
    """What a detector released in one file."""

    rate: Array
    """Expected rate, MHz, shape (bins,)."""
    number: Counts
    """Released in each bin, summed over shots."""
    shots: int
    bin_time: float
    """s for which a bin is open after one shot."""

    @property
    def exposure(self) -> float:
        """Time for which a bin was open in all shots together, microseconds."""
        return self.shots * self.bin_time * 1e6


def possible_rate(rate: Array) -> Array:
    """Return a rate of photoelectrons (MHz) cut at `BRIGHTEST`.

    Raises
    ------
    SimulationInputError
        Where it is negative or NaN.
    """
    rate = np.minimum(rate, BRIGHTEST)
    _checks.profile("rate", rate, rate.shape, "MHz")
    return rate


def release(
    rate: Array, *, shots: int, bin_width: float, random: np.random.Generator
) -> Photoelectrons:
    """Draw the photoelectrons of a file: Poisson in every bin.

    Parameters
    ----------
    rate : ndarray, MHz, shape (bins,)
        Expected rate: signal and sky together, cut at `BRIGHTEST`.
    shots : int
        Without shots nothing is released; see `count_rate` for what is then measured.
    bin_width : float, m
        Converted to time by the nominal 150 m per microsecond of the format (`licel2023`), by
        which readers convert counts to MHz.
    random : numpy.random.Generator

    Raises
    ------
    SimulationInputError
        Where a rate is negative or NaN, or the number of shots is negative.
    """
    _checks.not_negative("shots", shots)
    _checks.positive("bin_width", bin_width, "m")
    bin_time = bin_width / LICEL_RANGE_PER_MICROSECOND * 1e-6
    rate = possible_rate(rate)
    number = random.poisson(rate * (shots * bin_time * 1e6))
    return Photoelectrons(rate=rate, number=number, shots=shots, bin_time=bin_time)


def seen_from(
    released: Photoelectrons, first: float, bins: int, *, random: np.random.Generator
) -> Photoelectrons:
    """Return the same photoelectrons in the bins of a recorder that starts later.

    Two recorders of one detector that differ in their trigger delay see the same
    photoelectrons in other bins: release them once on an axis that covers both, and look at
    them from the first bin of each.

    Parameters
    ----------
    released : Photoelectrons
        On the common axis.
    first : float
        Bins, also parts of one, from the start of the axis to the start of the recorder. A
        recorder that starts `lag` bins later shows a cloud `lag` bins nearer.
    bins : int
        Of the recorder.
    random : numpy.random.Generator
        Drawn from only where `first` is no whole number. Recorders with the same start must
        share one result, as the photoelectrons of a cut bin are dealt out anew by every call.

    Raises
    ------
    SimulationInputError
        Where the recorder is open outside of the axis.

    Notes
    -----
    A photoelectron of a bin lies in its later part with the probability of that part, by a rate
    that is straight within the bin: its slope is half the difference of the neighbours, cut
    where the rate would be negative.
    """
    whole = math.floor(first + 1e-9)
    part = max(first - whole, 0.0)
    part = 0.0 if part < 1e-9 else part
    last = whole + bins + (part > 0.0)
    if bins < 1 or whole < 0 or last > released.rate.size:
        raise SimulationInputError(
            f"bins {first:g} to {first + bins:g} are not on the axis of {released.rate.size} bins",
            field="first",
            remedy="release the photoelectrons on a longer axis",
        )
    rate, number = released.rate[whole:last], released.number[whole:last]
    if part > 0.0:
        late = _later_share(released.rate, part)[whole:last]
        later = random.binomial(number, late)
        rate = rate[:-1] * late[:-1] + (rate * (1.0 - late))[1:]
        number = later[:-1] + (number - later)[1:]
    return Photoelectrons(rate, number, released.shots, released.bin_time)


def _later_share(rate: Array, part: float) -> Array:
    """Return the share of each bin's light behind its first `part`."""
    if rate.size < 2:
        return np.full(rate.size, 1.0 - part)
    safe = np.where(rate > 0.0, rate, 1.0)
    slope = np.clip(np.gradient(rate) / safe, -2.0, 2.0)
    share: Array = np.clip((1.0 - part) * (1.0 + 0.5 * part * slope), 0.0, 1.0)
    return share
