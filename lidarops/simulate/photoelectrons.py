"""Photoelectrons of a detector, and their bins in recorders with different trigger delays."""

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
"""MHz. Higher rates are cut, so counts of the range next to the telescope do not overflow."""

Counts = NDArray[np.int64]
Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Photoelectrons:
    """Photoelectrons that a detector released in one file."""

    rate: Array
    """Expected rate, MHz, shape (bins,)."""
    number: Counts
    """Number released in each bin, summed over shots."""
    shots: int
    bin_time: float
    """s for which a bin is open after one shot."""

    @property
    def exposure(self) -> float:
        """Time for which a bin was open over all shots, microseconds."""
        return self.shots * self.bin_time * 1e6


def limited_rate(rate: Array) -> Array:
    """Return a rate of photoelectrons, MHz, cut at `BRIGHTEST`.

    Raises
    ------
    SimulationInputError
        If a rate is negative or NaN.
    """
    rate = np.minimum(rate, BRIGHTEST)
    _checks.profile("rate", rate, rate.shape, "MHz")
    return rate


def release(
    rate: Array, *, shots: int, bin_width: float, random: np.random.Generator
) -> Photoelectrons:
    """Draw the photoelectrons of a file, Poisson-distributed in every bin.

    Parameters
    ----------
    rate : ndarray, MHz, shape (bins,)
        Expected rate: signal and sky together, cut at `BRIGHTEST`.
    shots : int
        Without shots nothing is released.
    bin_width : float, m
        Converted to time by the nominal 150 m per microsecond of the format (`licel2023`), as
        readers convert counts to MHz.
    random : numpy.random.Generator

    Raises
    ------
    SimulationInputError
        If a rate is negative or NaN, or the number of shots is negative.
    """
    _checks.not_negative("shots", shots)
    _checks.positive("bin_width", bin_width, "m")
    bin_time = bin_width / LICEL_RANGE_PER_MICROSECOND * 1e-6
    rate = limited_rate(rate)
    number = random.poisson(rate * (shots * bin_time * 1e6))
    return Photoelectrons(rate=rate, number=number, shots=shots, bin_time=bin_time)


def delay_recorder(
    released: Photoelectrons, first: float, bins: int, *, random: np.random.Generator
) -> Photoelectrons:
    """Return the same photoelectrons in the bins of a recorder that starts later.

    Two recorders of one detector with different trigger delays record the same photoelectrons
    in different bins. Release the photoelectrons once on an axis that covers both recorders, and
    call this function for each recorder.

    Parameters
    ----------
    released : Photoelectrons
        On the common axis.
    first : float
        Start of the recorder on the axis, bins, not necessarily whole. A recorder that starts
        `lag` bins later shows a cloud `lag` bins nearer.
    bins : int
        Bins of the recorder.
    random : numpy.random.Generator
        Used only if `first` is not a whole number. Recorders with the same start must share one
        result, because every call divides the photoelectrons of a cut bin anew.

    Raises
    ------
    SimulationInputError
        If the recorder is open outside of the axis.

    Notes
    -----
    A photoelectron of a cut bin lies in the later part with the probability that follows from a
    rate that is linear within the bin. Its slope is half the difference of the neighbours, cut
    where the rate would be negative.
    """
    whole = math.floor(first + 1e-9)
    fraction = max(first - whole, 0.0)
    fraction = 0.0 if fraction < 1e-9 else fraction
    last = whole + bins + (fraction > 0.0)
    if bins < 1 or whole < 0 or last > released.rate.size:
        raise SimulationInputError(
            f"bins {first:g} to {first + bins:g} are not on the axis of {released.rate.size} bins",
            field="first",
            remedy="release the photoelectrons on a longer axis",
        )
    rate, number = released.rate[whole:last], released.number[whole:last]
    if fraction > 0.0:
        late = _later_share(released.rate, fraction)[whole:last]
        later = random.binomial(number, late)
        rate = rate[:-1] * late[:-1] + (rate * (1.0 - late))[1:]
        number = later[:-1] + (number - later)[1:]
    return Photoelectrons(rate, number, released.shots, released.bin_time)


def _later_share(rate: Array, fraction: float) -> Array:
    """Return the share of each bin's light behind its first `fraction`."""
    if rate.size < 2:
        return np.full(rate.size, 1.0 - fraction)
    safe = np.where(rate > 0.0, rate, 1.0)
    slope = np.clip(np.gradient(rate) / safe, -2.0, 2.0)
    share: Array = np.clip((1.0 - fraction) * (1.0 + 0.5 * fraction * slope), 0.0, 1.0)
    return share
