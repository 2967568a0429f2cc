r"""Analog recorders: from photoelectrons to digitiser steps.

One sample of one shot is the charge of its photoelectrons, an offset and electronic noise,
rounded to a step. For a voltage v (in steps) with the characteristic function
:math:`\phi(\omega) = E[e^{i \omega v}]` the rounding error e = round(v) - v has the moments

.. math:: E[e] = \sum_k \frac{(-1)^k}{\pi k} \Im\phi(2 \pi k), \quad
          E[e^2] = \frac{1}{12} + \sum_k \frac{(-1)^k}{\pi^2 k^2} \Re\phi(2 \pi k), \quad
          E[v e] = \sum_k \frac{(-1)^k}{\pi k} \Im(-i \phi'(2 \pi k))

(`widrow2008`). Here phi is that of a compound Poisson distribution of gamma-distributed charges
plus Gaussian noise. The moments therefore hold for few photoelectrons and for noise far below a
step, where rounding errors do not average out over shots.
"""

from __future__ import annotations

from math import cos, erfc, exp, pi, sin, sqrt
from typing import Any, Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from lidarops.campaign.simulated_instrument import AnalogRecorder
from lidarops.simulate.counting import Array, Counts, Photoelectrons, limited_rate
from lidarops.simulate.signal import SimulationInputError, check_positive

_NEGLIGIBLE: Final = 20.0
"""Harmonics of less than exp(-20) = 2e-9 steps are left out."""
_NEGLIGIBLE_FAST: Final = 9.2
"""The same where no photoelectrons were drawn: 1e-4 steps."""
_LARGEST: Final = 2**31 - 1
"""Largest signed integer of 32 bits."""
_FAR: Final = 8.0
"""Standard deviations from the ends of the scale beyond which no sample is clipped."""
_MANY: Final = 50.0
"""Photoelectrons in a sample above which the sum of their charges is normal."""


def digitise(
    released: Photoelectrons,
    recorder: AnalogRecorder,
    *,
    random: np.random.Generator,
) -> Counts:
    r"""Draw the samples of a digitiser, summed over shots.

    Parameters
    ----------
    released : Photoelectrons
    recorder : AnalogRecorder
    random : numpy.random.Generator

    Returns
    -------
    ndarray of int, shape (bins,)
        Digitiser steps summed over shots, 0 to shots times full scale; 0 without shots.

    Raises
    ------
    SimulationInputError
        If fast sums do not fit into 32 bits.

    Notes
    -----
    Where no photoelectrons were drawn, sums have the same mean and variance by one Gaussian draw
    per bin, and the bias of the rounding is accurate to 1e-4 steps.

    The mean of one sample of one shot is gain times rate, plus the dark offset, plus the bias of
    the rounding. Its noise is the shot noise of the photoelectrons (the same as in the photon
    counter), the spread of their charge (`excess_noise`), electronic noise and rounding noise;
    the sum is regressed on the photoelectrons. Every sample is clipped at both ends of the scale.
    Near the ends, mean and variance are those of a censored normal distribution, or of a mixture
    of such distributions over the numbers of photoelectrons where these are few,

    .. math:: \mathrm{E}[\min(v, F)] = \mu \Phi(z) + F (1 - \Phi(z)) - s \phi(z),
              \quad z = (F - \mu) / s

    Where only some shots are clipped, the sum is too low although it is below full scale, as in
    a real instrument.
    """
    shots, rate, number = released.shots, released.rate, released.number
    if shots == 0:
        return np.zeros(rate.shape, dtype=np.int64)
    sample = _sample(
        recorder, released.bin_time, _NEGLIGIBLE_FAST if number is None else _NEGLIGIBLE
    )
    if number is None and shots * sample.top > _LARGEST:
        raise SimulationInputError(
            f"of {shots} with {recorder.adc_bits} bits do not fit into 32 bits",
            field="shots",
            remedy="take fewer shots, or draw photoelectrons",
        )
    _, rounded, covariance, centre, kept = _moments_of(rate, sample)
    if number is None:
        deviation = np.sqrt(rounded * shots) * random.standard_normal(rate.size, dtype=np.float32)
    else:
        events, unit, electronic = rate * sample.window, sample.unit, sample.noise
        slope = covariance / ((1.0 + sample.spread) * unit**2 * events + electronic**2)
        own = np.maximum(rounded - slope * covariance, 0.0) + (slope * electronic) ** 2
        charge = slope**2 * unit**2 * sample.spread * number
        deviation = slope * unit * (number - events * shots)
        deviation += np.sqrt(charge + shots * own) * random.standard_normal(rate.size)
    total = np.clip(shots * centre + kept * deviation, 0.0, shots * sample.top)
    summed: Counts = (total + 0.5).astype(np.int32 if number is None else np.int64)
    return summed


def sample_moments(
    rate: Array, recorder: AnalogRecorder, *, bin_time: float
) -> tuple[Array, Array]:
    """Return mean and variance of one sample of one shot before clipping, steps.

    Parameters
    ----------
    rate : ndarray, MHz, shape (bins,)
    recorder : AnalogRecorder
    bin_time : float, s
    """
    check_positive("bin_time", bin_time, "s")
    mean, variance, *_ = _moments_of(limited_rate(rate), _sample(recorder, bin_time))
    return mean, variance


class _Sample(NamedTuple):
    """One sample of one shot, in digitiser steps."""

    window: float
    """Microseconds for which a bin is open."""
    dark: float
    """Voltage without light."""
    unit: float
    """Mean charge of a photoelectron."""
    spread: float
    """Variance of the charge over the square of its mean."""
    noise: float
    """Standard deviation of the electronic noise."""
    gauss: NDArray[np.float64]
    """Harmonics of the noise."""
    harmonics: NDArray[np.complex128]
    """Those of the charge, and their slopes."""
    top: float
    """Full scale."""


def _sample(recorder: AnalogRecorder, bin_time: float, negligible: float = _NEGLIGIBLE) -> _Sample:
    unit = recorder.gain / recorder.step / (bin_time * 1e6)
    spread, dark_noise = recorder.excess_noise - 1.0, recorder.noise / recorder.step
    most = int(sqrt(negligible / (2.0 * pi**2)) / dark_noise)
    omega = 2.0 * pi * np.arange(1, most + 1)
    gauss = np.exp(-0.5 * (omega * dark_noise) ** 2)
    inner = 1.0 - 1j * omega * unit * spread
    power = -np.log(inner) / spread if spread > 0.0 else 1j * omega * unit
    charge = np.exp(power)
    slope = 1j * unit * charge / inner
    harmonics = np.stack([charge, slope])
    dark, top = recorder.dark_offset / recorder.step, float(2**recorder.adc_bits - 1)
    return _Sample(1e6 * bin_time, dark, unit, spread, dark_noise, gauss, harmonics, top)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _rounded(events: float, sample: Any) -> tuple[float, float, float]:
    """Return mean and variance of a rounded sample, and its covariance with the voltage."""
    _, dark, unit, spread, dark_noise, gauss, harmonics, _ = sample
    mean = unit * events + dark
    variance = (1.0 + spread) * unit * unit * events + dark_noise * dark_noise
    bias, square, product = 0.0, 1.0 / 12.0, 0.0
    sign = 1.0
    for k in range(gauss.size):
        sign = -sign
        order = pi * (k + 1)
        charge = harmonics[0, k]
        size = gauss[k] * exp(events * (charge.real - 1.0))
        if size < 1e-9:
            continue
        angle = events * charge.imag + 2.0 * order * dark
        real, imag = size * cos(angle), size * sin(angle)
        # d ln phi / d omega; times -i phi it is E[v exp(i omega v)].
        along = events * harmonics[1, k].real - 2.0 * order * dark_noise * dark_noise
        across = events * harmonics[1, k].imag + dark
        bias += sign / order * imag
        square += sign / order**2 * real
        product += sign / order * (across * imag - along * real)
    covariance = product - mean * bias
    rounded = variance + 2.0 * covariance + square - bias * bias
    return mean + bias, max(rounded, 0.0), variance + covariance


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _beyond(z: float) -> tuple[float, float]:
    """Return the mean of (y - z)+ of a standard normal y, and the chance that y is beyond z."""
    tail = 0.5 * erfc(z / sqrt(2.0))
    return exp(-0.5 * z * z) / sqrt(2.0 * pi) - z * tail, tail


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _censored(mean: float, deviation: float, top: float) -> tuple[float, float]:
    """Return mean and variance of a normal voltage clipped to 0..top."""
    if deviation <= 0.0:
        return min(max(mean, 0.0), top), 0.0
    high, low = (top - mean) / deviation, mean / deviation
    if min(high, low) > _FAR:
        return mean, deviation * deviation
    if high < -_FAR or low < -_FAR:
        return (top if high < low else 0.0), 0.0
    above, over = _beyond(high)
    below, under = _beyond(low)
    shift = below - above
    second = 1.0 - over - under + high * high * over + low * low * under
    second -= (high * exp(-0.5 * high * high) + low * exp(-0.5 * low * low)) / sqrt(2.0 * pi)
    return mean + deviation * shift, max(second - shift * shift, 0.0) * deviation * deviation


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mixture(
    events: float, dark: float, unit: float, spread: float, dark_noise: float, top: float
) -> tuple[float, float]:
    """Return mean and variance of a clipped voltage, summed over numbers of photoelectrons."""
    mean, square = 0.0, 0.0
    chance = exp(-events)
    for number in range(int(events + 10.0 * sqrt(events)) + 12):
        deviation = sqrt(dark_noise * dark_noise + spread * unit * unit * number)
        centre, variance = _censored(dark + unit * number, deviation, top)
        mean += chance * centre
        square += chance * (variance + centre * centre)
        chance *= events / (number + 1.0)
    return mean, max(square - mean * mean, 0.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _clipped(mean: float, rounded: float, events: float, sample: Any) -> tuple[float, float]:
    """Return the mean of a sample clipped to 0..top, and the remaining share of its deviation."""
    _, dark, unit, spread, dark_noise, _, _, top = sample
    reach = _FAR * sqrt(rounded)
    # Photoelectrons only add to the dark voltage.
    above, below = mean + reach > top, dark < _FAR * dark_noise + 0.5 and mean < reach + 0.5
    if not (above or below):
        return mean, 1.0
    if rounded <= 0.0:
        return min(max(mean, 0.0), top), 1.0
    if events > _MANY:
        centre, variance = _censored(mean, sqrt(rounded), top)
        return centre, sqrt(variance / rounded)
    whole = (1.0 + spread) * unit * unit * events + dark_noise * dark_noise
    centre, variance = _mixture(events, dark, unit, spread, dark_noise, top)
    return centre + mean - unit * events - dark, sqrt(variance / whole)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _moments_of(rate: Any, sample: Any) -> Any:
    """Return the results of `_rounded` and `_clipped` for each bin, shape (5, bins)."""
    moments = np.empty((5, rate.size))
    for i in range(rate.size):
        events = rate[i] * sample.window
        mean, rounded, covariance = _rounded(events, sample)
        centre, kept = _clipped(mean, rounded, events, sample)
        moments[:, i] = mean, rounded, covariance, centre, kept
    return moments
