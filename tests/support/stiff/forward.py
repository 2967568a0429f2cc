"""Stiff and extreme cases of the forward model: pulse, counter, digitiser, air."""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np
from scipy.special import expn

from lidarops.campaign.simulated_instrument import AnalogRecorder
from lidarops.constants import SPEED_OF_LIGHT
from lidarops.errors import LidarOpsError, RetrievalInputError
from lidarops.retrieve.air import molecular
from lidarops.simulate import analog, counting, pulse
from lidarops.simulate import signal as short
from lidarops.simulate.counting import release
from support.stiff.cases import (
    Answer,
    Array,
    Between,
    Near,
    Refused,
    Retrieval,
    StiffCase,
)

_case = partial(StiffCase, retrieval=Retrieval.FORWARD)
_BIN_TIME: Final = 50e-9
"""s."""
_DEAD_TIME: Final = 4e-9


# Pulses ---------------------------------------------------------------------------------------


def pulsed(distance: Array, extinction: float, duration: float, **options: Any) -> Answer:
    """Return the signal of a rectangular pulse in homogeneous air of unit backscatter."""
    path = np.array([1e-3, 1.1 * distance[-1]])
    arguments = {"full_overlap_range": 0.0} | options
    power = pulse.pulsed_signal(
        distance,
        extinction=np.full(2, extinction),
        backscatter=np.ones(2),
        system_constant=1.0,
        pulse=pulse.RectangularPulse(duration),
        path=path,
        **arguments,
    )
    return Answer({"signal": power})


def clear_rectangle(distance: Array, duration: float) -> Array:
    r"""Return the exact signal without extinction, :math:`1 / R (R - c \tau / 2)`."""
    return np.asarray(1.0 / (distance * (distance - 0.5 * SPEED_OF_LIGHT * duration)))


def hazy_rectangle(distance: Array, duration: float, extinction: float) -> Array:
    r"""Return the mean of :math:`e^{-2 \sigma R} / R^2` over the pulse by exponential integrals."""
    length = 0.5 * SPEED_OF_LIGHT * duration
    near = distance - length
    integral = expn(2, 2.0 * extinction * near) / near - expn(2, 2.0 * extinction * distance) / (
        distance
    )
    return np.asarray(integral / length)


def bin_mean(distance: Array, width: float, extinction: float) -> Array:
    r"""Return the mean of :math:`e^{-2 \sigma R} / R^2` over a bin."""
    duration = 2.0 * width / SPEED_OF_LIGHT
    return hazy_rectangle(distance + 0.5 * width, duration, extinction)


def _short(distance: Array, extinction: float) -> Answer:
    path = np.concatenate([np.linspace(1e-3, distance[0], 400, endpoint=False), distance])
    power = short.backscatter_signal(
        path, extinction=np.full(path.size, extinction), backscatter=np.ones(path.size),
        system_constant=1.0,
    )  # fmt: skip
    return Answer({"signal": power[-distance.size :]})


_NEAR_AND_FAR: Final = np.array([20.0, 50.0, 300.0, 1000.0, 5000.0, 15000.0])
_FROM_100: Final = np.linspace(100.5, 6000.0, 60)
_FROM_300: Final = np.linspace(300.0, 6000.0, 60)
_LONG_PULSE: Final = 7.5 * (np.arange(800, dtype=np.float64) + 0.5)


def _near_lidar(**arguments: Any) -> Answer:
    power = pulsed(_LONG_PULSE, 1e-4, 1e-6, **arguments).value("signal")
    return Answer({"signal": power, "finite": float(np.isfinite(power).all()),
                   "signal at 3.75 m": power[0]})  # fmt: skip


def _pulses() -> tuple[StiffCase, ...]:
    rectangle = partial(hazy_rectangle, _FROM_100, 100e-9)
    return (
        _case("rectangular pulse of 100 ns without extinction",
              build=lambda: {"distance": _NEAR_AND_FAR, "extinction": 0.0, "duration": 100e-9},
              solve=pulsed,
              expected=(Near("signal", partial(clear_rectangle, _NEAR_AND_FAR, 100e-9), 1e-12),)),
        *(
            _case(f"rectangular pulse, extinction {1e3 * haze:g} per km, cells of 0.3 m",
                  build=partial(dict, distance=_FROM_100, extinction=haze, duration=100e-9,
                                resolution=0.3),
                  solve=pulsed, expected=(Near("signal", partial(rectangle, haze), tolerance),))
            for haze, tolerance in ((1e-4, 1e-6), (1e-3, 1e-6), (5e-3, 1e-5))
        ),
        _case("short pulse at bin centres against the mean over bins of 7.5 m",
              build=lambda: {"distance": _FROM_300, "extinction": 2e-3}, solve=_short,
              expected=(Near("signal", partial(bin_mean, _FROM_300, 7.5, 2e-3), 4e-4),)),
        _case("B a pulse of 1 us, overlap that vanishes at the lidar",
              build=lambda: {"full_overlap_range": 300.0}, solve=_near_lidar,
              expected=(Near("finite", 1.0, 0.0), Between("signal", 0.0, 1.0))),
        _case("B a pulse of 1 us without overlap: infinite at the lidar", build=dict,
              solve=_near_lidar, expected=(Refused(LidarOpsError),)),
        _case("pulse as long as the range", solve=pulsed,
              build=lambda: {"distance": _NEAR_AND_FAR, "extinction": 0.0, "duration": 2e-4,
                             "full_overlap_range": 100.0},
              expected=(Refused(LidarOpsError),)),
        _case("extinction of 10 per m", solve=pulsed,
              build=lambda: {"distance": _FROM_100, "extinction": 10.0, "duration": 1e-7},
              expected=(Between("signal", 0.0, 1e-300),)),
        _case("negative extinction", solve=pulsed,
              build=lambda: {"distance": _FROM_100, "extinction": -1e-3, "duration": 1e-7},
              expected=(Refused(LidarOpsError),)),
        _case("extinction NaN", solve=pulsed,
              build=lambda: {"distance": _FROM_100, "extinction": np.nan, "duration": 1e-7},
              expected=(Refused(LidarOpsError),)),
        _case("descending ranges", solve=pulsed,
              build=lambda: {"distance": _FROM_100[::-1], "extinction": 1e-3, "duration": 1e-7},
              expected=(Refused(LidarOpsError),)),
    )  # fmt: skip


# Recorders ------------------------------------------------------------------------------------


def _counted(rate: float, *, paralyzable: bool = False) -> Answer:
    """Return mean and variance of simulated counts over those of renewal theory."""
    rng = np.random.default_rng(21)
    shots, bins = 500, 20_000
    released = release(np.full(bins, rate), shots=shots, bin_width=7.5, random=rng)
    counts = counting.count_photons(
        released, dead_time=_DEAD_TIME, random=rng, paralyzable=paralyzable
    )[5:]
    x, exposed = rate * _DEAD_TIME * 1e6, rate * _BIN_TIME * 1e6 * shots
    if paralyzable:
        mean = exposed * np.exp(-x)
        factor = 1.0 - 2.0 * x * np.exp(-x) * (1.0 - 0.5 * _DEAD_TIME / _BIN_TIME)
        variance = mean * factor
    else:
        mean, variance = exposed / (1.0 + x), exposed / (1.0 + x) ** 3
    return Answer({"mean over theory": counts.mean() / mean,
                   "variance over theory": counts.var() / variance})  # fmt: skip


def _digitised(rate: float, noise: float, offset: float = 100.3) -> Answer:
    recorder = AnalogRecorder(
        gain=1.0, noise=noise * 500.0 / 4096.0, dark_offset=offset * 500.0 / 4096.0
    )
    rng = np.random.default_rng(22)
    released = release(np.full(20_000, rate), shots=100, bin_width=7.5, random=rng)
    total = analog.digitise(released, recorder, random=rng)
    return Answer({"steps": total.mean() / 100.0, "spread": total.std() / 10.0})


def _recorders() -> tuple[StiffCase, ...]:
    counters = (
        (1.0, False, 0.005, 0.03),
        (100.0, False, 0.005, 0.04),
        (600.0, False, 0.005, 0.22),
        (100.0, True, 0.005, 0.05),
        (600.0, True, 0.005, 0.05),
    )
    return (
        *(
            _case(f"counter at {rate:g} MHz, {'' if paralyzable else 'non-'}paralyzable",
                  build=partial(dict, rate=rate, paralyzable=paralyzable), solve=_counted,
                  expected=(Near("mean over theory", 1.0, mean),
                            Near("variance over theory", 1.0, variance)))
            for rate, paralyzable, mean, variance in counters
        ),
        _case("B c 600 MHz is counted as a lower rate, paralyzable", solve=_counted,
              build=lambda: {"rate": 600.0, "paralyzable": True},
              expected=(Between("mean over theory", 0.99, 1.01),)),
        _case("no light at all", build=lambda: {"rate": 0.0, "noise": 0.5}, solve=_digitised,
              expected=(Near("steps", 100.3, 0.005, relative=False),)),
        _case("B d noise of 0.05 steps: the mean is a whole step",
              build=lambda: {"rate": 0.0, "noise": 0.05}, solve=_digitised,
              expected=(Near("steps", 100.0, 1e-3, relative=False),)),
        _case("far beyond full scale", build=lambda: {"rate": 1e6, "noise": 1.0},
              solve=_digitised, expected=(Near("steps", 4095.0, 0.0),)),
        _case("rate of 1e300 MHz", build=lambda: {"rate": 1e300, "noise": 1.0}, solve=_digitised,
              expected=(Near("steps", 4095.0, 0.0),)),
        _case("rate NaN", build=lambda: {"rate": np.nan, "noise": 1.0}, solve=_digitised,
              expected=(Refused(LidarOpsError),)),
        _case("negative rate", build=lambda: {"rate": -1.0, "noise": 1.0}, solve=_digitised,
              expected=(Refused(LidarOpsError),)),
    )  # fmt: skip


# Air ------------------------------------------------------------------------------------------


def _standard(altitude: Any) -> Answer:
    pressure, temperature = molecular.us_standard(altitude)
    return Answer({"pressure": pressure, "temperature": temperature})


def _scattering(wavelength: float) -> Answer:
    air, height = molecular.MolecularProfile.us_standard(), np.linspace(0.0, 80e3, 8001)
    return Answer({"cross section": molecular.rayleigh_cross_section(wavelength),
                   "optical depth": np.trapezoid(air.extinction(height, wavelength), height),
                   "lidar ratio": molecular.molecular_lidar_ratio(wavelength)})  # fmt: skip


def _profile(**arguments: Any) -> Answer:
    profile = molecular.MolecularProfile.from_profile(**arguments)
    return Answer({"pressure": profile.pressure})


def _air() -> tuple[StiffCase, ...]:
    levels = np.array([0.0, 5000.0, 11000.0])
    warm = np.array([288.15, 255.7, 216.8])
    columns = (
        (355e-9, 2.759e-30, 0.5940),
        (532e-9, 5.167e-31, 0.1113),
        (1064e-9, 3.130e-32, 0.00674),
    )
    return (
        *(
            _case(f"standard atmosphere, {altitude / 1e3:g} km",
                  build=partial(dict, altitude=altitude), solve=_standard,
                  expected=(Near("pressure", pressure, 2e-4),))
            for altitude, pressure in ((11e3, 22699.96), (20e3, 5529.31), (50e3, 79.78))
        ),
        *(
            _case(f"molecules at {1e9 * length:g} nm", build=partial(dict, wavelength=length),
                  solve=_scattering, expected=(Near("cross section", section, 1e-3),
                                               Near("optical depth", depth, 2e-3)))
            for length, section, depth in columns
        ),
        _case("lidar ratio of molecules", build=lambda: {"wavelength": 532e-9},
              solve=_scattering, expected=(Near("lidar ratio", 8.497, 0.02),)),
        _case("altitude of 1000 km", build=lambda: {"altitude": 1e6}, solve=_standard,
              expected=(Refused(RetrievalInputError, "altitude"),)),
        _case("altitude NaN", build=lambda: {"altitude": np.nan}, solve=_standard,
              expected=(Refused(RetrievalInputError, "altitude"),)),
        _case("wavelength in nm", build=lambda: {"wavelength": 532.0}, solve=_scattering,
              expected=(Refused(RetrievalInputError, "wavelength"),)),
        _case("sounding in hPa", solve=_profile,
              build=lambda: {"altitude": levels, "pressure": [1013.25, 540.2, 226.3],
                             "temperature": warm},
              expected=(Near("pressure", np.array([101325.0, 54020.0, 22630.0]), 1e-12),)),
        _case("sounding in Pa", solve=_profile,
              build=lambda: {"altitude": levels, "pressure": [101325.0, 54020.0, 22630.0],
                             "temperature": warm},
              expected=(Near("pressure", np.array([101325.0, 54020.0, 22630.0]), 1e-12),)),
        _case("sounding in mbar times ten", solve=_profile,
              build=lambda: {"altitude": levels, "pressure": [10132.5, 5402.0, 2263.0],
                             "temperature": warm},
              expected=(Refused(RetrievalInputError),)),
        _case("sounding in Celsius", solve=_profile,
              build=lambda: {"altitude": levels, "pressure": [1013.25, 540.2, 226.3],
                             "temperature": warm - 273.15},
              expected=(Refused(RetrievalInputError, "temperature"),)),
    )  # fmt: skip


def stiff_forward_cases() -> tuple[StiffCase, ...]:
    """Return all stiff cases of the forward model."""
    return (*_pulses(), *_recorders(), *_air())
