"""Raw counts of whole archives at the speed of a disk: Gaussian noise, one draw a bin.

What is left out against `lidarops.simulate.instrument`: that both outputs of a detector see the
same photoelectrons, the skewness of few counts, and clipping shot by shot.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from lidarops.simulate.settings import AnalogRecorder

Array = NDArray[np.float64]
Counts = NDArray[np.int32]


def count(rate: Array, *, exposure: float, dead_time: float, random: np.random.Generator) -> Counts:
    r"""Return counts of a photon counter with non-paralyzable dead time.

    Parameters
    ----------
    rate : ndarray, MHz, shape (bins,)
    exposure : float, microseconds
        Time for which a bin was open in all shots together.
    dead_time : float, s
    random : numpy.random.Generator

    Notes
    -----
    Mean :math:`n T / (1 + n \tau)` and variance :math:`n T / (1 + n \tau)^3`.
    """
    noise = random.standard_normal(rate.size, dtype=np.float32)
    counts: Counts = _counted(rate, noise, exposure, dead_time * 1e6)
    return counts


def record(
    rate: Array,
    recorder: AnalogRecorder,
    *,
    dark_offset: float,
    exposure: float,
    shots: int,
    random: np.random.Generator,
) -> Counts:
    """Return the sum over shots of what a digitiser makes of photoelectrons, clipped as a whole.

    Parameters
    ----------
    rate : ndarray, MHz, shape (bins,)
    recorder : AnalogRecorder
    dark_offset : float, mV
    exposure : float, microseconds
    shots : int
    random : numpy.random.Generator
    """
    noise = random.standard_normal(rate.size, dtype=np.float32)
    unit = recorder.gain / recorder.step
    still = shots * ((recorder.noise / recorder.step) ** 2 + 1.0 / 12.0)
    per_count = unit * shots / exposure
    counts: Counts = _recorded(
        rate,
        noise,
        unit * shots,
        dark_offset / recorder.step * shots,
        recorder.excess_noise * per_count**2 * exposure,
        still,
        shots * (2.0**recorder.adc_bits - 1.0),
    )
    return counts


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _counted(rate: Any, noise: Any, exposure: float, dead_time: float) -> Any:
    counts = np.empty(rate.size, np.int32)
    for i in range(rate.size):
        live = 1.0 / (1.0 + rate[i] * dead_time)
        mean = rate[i] * exposure * live
        value = mean + sqrt(mean) * live * noise[i]
        counts[i] = int(value + 0.5) if value > 0.0 else 0
    return counts


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _recorded(
    rate: Any, noise: Any, unit: float, offset: float, shot: float, still: float, top: float
) -> Any:
    counts = np.empty(rate.size, np.int32)
    for i in range(rate.size):
        value = unit * rate[i] + offset + sqrt(shot * rate[i] + still) * noise[i]
        counts[i] = int(min(max(value, 0.0), top) + 0.5)
    return counts
