"""From photoelectrons to raw counts: photon counters with dead time, digitisers with steps.

Both outputs of a detector are driven by the same photoelectrons, bin by bin, so that their
noise is correlated as in a real instrument.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from lidarops.constants import LICEL_RANGE_PER_MICROSECOND
from lidarops.simulate.settings import AnalogRecorder

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


def release(
    rate: Array, *, shots: int, bin_width: float, random: np.random.Generator
) -> Photoelectrons:
    """Draw the photoelectrons of a file: Poisson in every bin.

    Parameters
    ----------
    rate : ndarray, MHz, shape (bins,)
        Expected rate: signal and sky together, cut at `BRIGHTEST`.
    shots : int
    bin_width : float, m
        Converted to time by the nominal 150 m per microsecond of the format (`licel2023`), by
        which readers convert counts to MHz.
    random : numpy.random.Generator
    """
    bin_time = bin_width / LICEL_RANGE_PER_MICROSECOND * 1e-6
    rate = np.minimum(rate, BRIGHTEST)
    number = random.poisson(rate * (shots * bin_time * 1e6))
    return Photoelectrons(rate=rate, number=number, shots=shots, bin_time=bin_time)


def count_photons(
    released: Photoelectrons, *, dead_time: float, random: np.random.Generator
) -> Counts:
    r"""Return what a counter with non-paralyzable dead time counts of the photoelectrons.

    Parameters
    ----------
    released : Photoelectrons
    dead_time : float, s
    random : numpy.random.Generator

    Returns
    -------
    ndarray of int, shape (bins,)
        Counts summed over shots.

    Notes
    -----
    Of N events in the exposure T each finds on average x = (N - 1) tau / T others in the dead
    time before it. The number of lost events is drawn as

    .. math:: L \sim \mathrm{Binomial}\left(N \frac{(1 + x)^2}{3 + 3 x + x^2},
              1 - (1 + x)^{-3}\right)

    the first argument rounded up or down at random so that its mean is right. At a rate n and
    x = n tau this makes N - L a count of mean :math:`n T / (1 + x)`, variance
    :math:`n T / (1 + x)^3` and covariance with N of :math:`n T / (1 + x)^2`, as the theory of
    renewal processes has them for T much longer than tau; for N = 2 it is the exact
    probability of a coincidence. Counts are integers from 0 to N at any rate, where a rounded
    Gaussian would lose the dead time of weak signals in the rounding. Left out: that a dead
    time reaches into the next bin, which correlates the counts of neighbouring bins by about
    -(n tau)^2 / 2 (-0.003 at 20 MHz and 4 ns).

    References
    ----------
    `cox1962`.
    """
    number = released.number
    exposure = released.exposure * 1e-6
    x = np.maximum(number - 1, 0) * (dead_time / exposure)
    trials = number * (1.0 + x) ** 2 / (3.0 + 3.0 * x + x**2)
    whole = np.floor(trials + random.random(number.shape)).astype(np.int64)
    counted: Counts = number - random.binomial(whole, -np.expm1(-3.0 * np.log1p(x)))
    return counted


def digitise(
    released: Photoelectrons, recorder: AnalogRecorder, *, random: np.random.Generator
) -> Counts:
    r"""Return the sum over shots of what a digitiser makes of the photoelectrons.

    Parameters
    ----------
    released : Photoelectrons
    recorder : AnalogRecorder
    random : numpy.random.Generator

    Returns
    -------
    ndarray of int, shape (bins,)
        Digitiser steps summed over shots, 0 to shots times full scale.

    Notes
    -----
    One sample of one shot has the mean "gain times rate plus dark offset". Its noise is the
    shot noise of the photoelectrons (the same that the counter sees), the spread of their
    charge (`AnalogRecorder.excess_noise`), electronic noise and the rounding to a step, of
    variance 1/12. Samples are clipped at full scale one by one: near it the mean and the
    variance are those of a censored normal distribution,

    .. math:: \mathrm{E}[\min(v, F)] = \mu \Phi(z) + F (1 - \Phi(z)) - s \phi(z),
              \quad z = (F - \mu) / s

    so that a bin of which only some shots are clipped is too low, as in a real instrument,
    though its sum is below full scale.
    """
    shots = released.shots
    unit = recorder.gain / recorder.step  # steps per MHz
    mean = unit * released.rate + recorder.dark_offset / recorder.step
    per_count = unit / released.exposure  # steps, mean over shots, per photoelectron
    expected = released.rate * released.exposure

    charge = np.sqrt((recorder.excess_noise - 1.0) * released.number)
    light = released.number - expected + charge * random.standard_normal(mean.shape)
    still = (recorder.noise / recorder.step) ** 2 + 1.0 / 12.0
    electronic = np.sqrt(still / shots) * random.standard_normal(mean.shape)
    variance = recorder.excess_noise * expected * (per_count**2 * shots) + still

    top = 2**recorder.adc_bits - 1
    clipped, kept = _censored(mean, variance, float(top))
    steps = clipped + kept * (per_count * light + electronic)
    total: Counts = np.clip(np.rint(shots * steps), 0, shots * top).astype(np.int64)
    return total


def _censored(mean: Array, variance: Array, top: float) -> tuple[Array, Array]:
    """Return the mean of min(v, top) for normal v, and the part of its deviation that stays."""
    deviation = np.sqrt(variance)
    z = np.clip((top - mean) / deviation, -30.0, 30.0)
    below = ndtr(z)
    density = np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    # Deficit d = (top - v)+ in units of the deviation: its mean and its second moment.
    deficit = z * below + density
    second = (z**2 + 1.0) * below + z * density
    clipped = np.where(z >= 30.0, mean, top - deviation * deficit)
    return clipped, np.sqrt(np.maximum(second - deficit**2, 0.0))
