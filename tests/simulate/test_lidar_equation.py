"""The lidar equation forward, the sun and the sky against independent formulas."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarops.simulate.signal import backscatter_signal, bin_centres, optical_depth, overlap
from lidarops.simulate.sun import sky_brightness, solar_elevation


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
    values = overlap(distance, 500.0)
    assert np.all(np.diff(values) >= 0)
    assert values[1] == 0
    assert values[3] == pytest.approx(0.5)
    assert values[4] < 1
    assert np.all(values[5:] == 1.0)
    np.testing.assert_array_equal(overlap(distance, 0.0), [0, 0, 1, 1, 1, 1, 1])


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
    assert ours == pytest.approx(_almanac_elevation(moment, latitude, longitude), abs=5.0)


def test_the_sky_is_brightest_at_the_zenith_and_falls_through_twilight():
    assert sky_brightness(90) == pytest.approx(1)
    assert sky_brightness(-3) == pytest.approx(sky_brightness(0) / 10)
    elevations = np.linspace(-40, 90, 500)
    brightness = [sky_brightness(e) for e in elevations]
    assert np.all(np.diff(brightness) > 0)
    # No step at the horizon.
    assert sky_brightness(1e-9) == pytest.approx(sky_brightness(-1e-9), rel=1e-6)
