"""The lidar equation, overlap and the sun against independent formulas."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarops.campaign.simulated_air import AtmosphereSettings
from lidarops.campaign.simulated_instrument import Optics
from lidarops.simulate.atmosphere import Air, Beam, sky_brightness, solar_elevation
from lidarops.simulate.signal import (
    SimulationInputError,
    backscatter_signal,
    bin_centres,
    optical_depth,
    sine_overlap,
)


@pytest.mark.parametrize("extinction", [1e-5, 2e-4, 2e-3])
def test_a_homogeneous_path_is_the_integral_over_each_bin(extinction):
    width, constant, beta = 7.5, 3.0e12, 4.0e-6
    distance = bin_centres(400, width)
    signal = backscatter_signal(
        distance,
        extinction=np.full(400, extinction),
        backscatter=np.full(400, beta),
        system_constant=constant,
        full_overlap_range=250.0,
    )
    for index in (40, 100, 399):
        edge = [mpmath.mpf(index) * width, mpmath.mpf(index + 1) * width]
        mean = mpmath.quad(lambda r: mpmath.exp(-2 * extinction * r) / r**2, edge) / width
        exact = float(constant * beta * mean)
        # The bin centre is off by the second derivative only; a bin edge by width / R.
        near = 1 / distance[index]
        second = ((near + extinction) ** 2 + near**2 / 2) * width**2 / 6
        assert signal[index] == pytest.approx(exact * (1 - second), rel=0.01 * second + 1e-12)
        assert second < 0.06 * width * near
        # Equation 15 at the bin centre, from 300 m on.
        assert abs(signal[index] / exact - 1) <= 4e-4


def test_raman_light_is_attenuated_at_both_wavelengths():
    distance = bin_centres(500, 7.5)
    out, back = np.full(500, 3e-4), np.full(500, 2e-4)
    both = {"system_constant": 1e12, "full_overlap_range": 200.0, "backscatter": np.ones(500)}
    raman = backscatter_signal(distance, extinction=out, returning_extinction=back, **both)
    elastic = backscatter_signal(distance, extinction=out, **both)
    np.testing.assert_allclose(raman / elastic, np.exp(1e-4 * distance), rtol=1e-12)
    np.testing.assert_allclose(
        elastic,
        1e12
        * sine_overlap(distance, 200.0)
        / distance**2
        * np.exp(-2 * optical_depth(distance, out)),
        rtol=1e-12,
    )


def test_isotropic_scatterers_of_one_kind():
    # 1e12 m-3 of 1e-16 m2: an extinction of 0.1 /km with a lidar ratio of 4 pi.
    number, cross_section = 1e12, 1e-16
    isotropic = {"extinction": [number * cross_section] * 2, "height": [0.0, 1e5]}
    profile = isotropic | {"aerosol": {"lidar_ratio": 4 * math.pi}}
    start = datetime(2024, 6, 21, tzinfo=UTC)
    with_aerosol, clear = (
        Air(AtmosphereSettings(profiles=profiles), altitude=0.0, start=start, seed=1).along(
            Beam(0.0, 0.0, 0.0, 0.0, 0.0), np.array([1000.0]), start, 532e-9
        )
        for profiles in ([profile], [])
    )
    backscatter = with_aerosol.backscatter - clear.backscatter
    assert backscatter[0] == pytest.approx(number * cross_section / (4 * math.pi))


@pytest.mark.parametrize(
    "change",
    [{"extinction": -1e-4}, {"backscatter": -1e-6}, {"returning_extinction": np.inf}],
)
def test_impossible_air_is_refused(change):
    air = {"extinction": 1e-4, "backscatter": 1e-6, "returning_extinction": 1e-4} | change
    with pytest.raises(SimulationInputError, match=next(iter(change))):
        backscatter_signal(
            bin_centres(9, 7.5),
            system_constant=1e12,
            full_overlap_range=9.0,
            **{name: np.full(9, value) for name, value in air.items()},
        )


def test_optical_depth_of_a_layered_path():
    distance = bin_centres(2000, 7.5)
    scale = 1500.0
    depth = optical_depth(distance, 3e-4 * np.exp(-distance / scale))
    exact = 3e-4 * scale * (1 - np.exp(-distance / scale))
    np.testing.assert_allclose(depth, exact, rtol=1e-5, atol=4e-6)


@given(st.floats(-300, 300), st.floats(1e-6, 1e-2))
def test_a_trigger_delay_moves_the_signal_but_not_the_path(offset, extinction):
    distance = bin_centres(500, 7.5, offset)
    depth = optical_depth(distance, np.full(500, extinction))
    np.testing.assert_allclose(
        depth, extinction * np.clip(distance, 0, None), rtol=1e-9, atol=1e-12
    )
    signal = backscatter_signal(
        distance,
        extinction=np.full(500, extinction),
        backscatter=np.full(500, 1e-6),
        system_constant=1e12,
        full_overlap_range=200.0,
    )
    assert np.all(np.isfinite(signal))
    assert np.all(signal[distance <= 0] == 0)
    assert np.all(signal[distance > 0] > 0)


def test_overlap_is_complete_at_the_stated_range_and_not_before():
    distance = np.array([-10.0, 0.0, 1.0, 250.0, 499.9, 500.0, 900.0])
    values = sine_overlap(distance, 500.0)
    assert np.all(np.diff(values) >= 0)
    assert values[1] == 0
    assert values[3] == pytest.approx(0.5)
    assert values[4] < 1
    assert np.all(values[5:] == 1.0)
    np.testing.assert_array_equal(sine_overlap(distance, 0.0), [0, 0, 1, 1, 1, 1, 1])


def test_the_overlap_vanishes_with_the_square_of_the_range():
    values = sine_overlap(np.array([-5.0, 0.0, 1e-3, 1e-2]), 300.0)
    assert np.all(values[:2] == 0)
    assert values[3] / values[2] == pytest.approx(100, rel=1e-3)
    with pytest.raises(SimulationInputError, match="full_overlap_range"):
        sine_overlap(values, -1.0)


def test_photons_add_up_from_laser_to_detector():
    area = math.pi * 0.15**2
    optics = Optics(energy=0.1, area=area, efficiency=0.3 * 0.2)
    # 100 mJ at 532 nm are 2.678e17 photons; from 1 km, 1e-6 m-1 sr-1 sends 7.5e-12 of them per
    # metre of telescope squared and bin: counted by hand, photon by photon.
    photons = 0.1 / 3.7339e-19
    per_shot = photons * 1e-6 * 7.5 * area / 1000.0**2 * 0.3 * 0.2
    # 7.5 m are 50 ns by the nominal 150 m per microsecond, 7e-4 more by the speed of light.
    assert optics.signal_rate(532) == pytest.approx(per_shot / 0.05, rel=1e-3)
    # Photons of a longer wavelength have less energy, so there are more.
    assert optics.signal_rate(607) == pytest.approx(optics.signal_rate(532) * 607 / 532)
    for part in ("energy", "area"):
        twice = optics.model_copy(update={part: 2 * getattr(optics, part)})
        assert twice.signal_rate(532) == pytest.approx(2 * optics.signal_rate(532))


def _almanac_elevation(moment: datetime, latitude: float, longitude: float) -> float:
    """Low-precision formulas of the Astronomical Almanac: right to 0.01 degree."""
    days = (moment - datetime(2000, 1, 1, 12, tzinfo=UTC)) / timedelta(days=1)
    anomaly = math.radians(357.528 + 0.9856003 * days)
    mean = 280.460 + 0.9856474 * days
    ecliptic = math.radians(mean + 1.915 * math.sin(anomaly) + 0.020 * math.sin(2 * anomaly))
    tilt = math.radians(23.439 - 4e-7 * days)
    ascension = math.atan2(math.cos(tilt) * math.sin(ecliptic), math.cos(ecliptic))
    declination = math.asin(math.sin(tilt) * math.sin(ecliptic))
    sidereal = math.radians(15 * (18.697374558 + 24.06570982441908 * days) + longitude)
    phi = math.radians(latitude)
    return math.degrees(
        math.asin(
            math.sin(phi) * math.sin(declination)
            + math.cos(phi) * math.cos(declination) * math.cos(sidereal - ascension)
        )
    )


@given(
    st.integers(0, 365 * 24 * 4),
    st.floats(-80, 80),
    st.floats(-180, 180),
)
def test_the_sun_stands_where_the_almanac_says(quarter, latitude, longitude):
    moment = datetime(2024, 1, 1, tzinfo=UTC) + timedelta(minutes=15 * quarter)
    ours = solar_elevation(moment, latitude, longitude)
    assert ours == pytest.approx(_almanac_elevation(moment, latitude, longitude), abs=0.5)


def test_the_sky_is_brightest_at_the_zenith_and_falls_through_twilight():
    assert sky_brightness(90) == pytest.approx(1)
    assert sky_brightness(-3) == pytest.approx(sky_brightness(0) / 10)
    elevations = np.linspace(-40, 90, 500)
    brightness = [sky_brightness(e) for e in elevations]
    assert np.all(np.diff(brightness) > 0)
    # No step at the horizon.
    assert sky_brightness(1e-9) == pytest.approx(sky_brightness(-1e-9), rel=1e-6)
