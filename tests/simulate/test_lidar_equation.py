"""The lidar equation, overlap and the sun against independent formulas."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarops.simulate._checks import SimulationInputError
from lidarops.simulate.lidar import Lidar
from lidarops.simulate.overlap import GeometricalOverlap, SineOverlap, finite_at_lidar
from lidarops.simulate.pulse import GaussianPulse, RectangularPulse
from lidarops.simulate.signal import (
    backscatter_signal,
    bin_centres,
    isotropic_backscatter,
    optical_depth,
    transmission,
)
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
        1e12 * SineOverlap(200.0)(distance) / distance**2 * transmission(distance, out) ** 2,
        rtol=1e-12,
    )


def test_isotropic_scatterers_of_one_kind():
    # 1e12 m-3 of 1e-16 m2: an extinction of 0.1 /km with a lidar ratio of 4 pi.
    assert isotropic_backscatter(1e12, 1e-16) * 4 * math.pi == pytest.approx(1e-4)
    with pytest.raises(SimulationInputError, match="cross_section"):
        isotropic_backscatter(1e12, -1e-16)
    with pytest.raises(SimulationInputError, match="number_density"):
        isotropic_backscatter(np.array([1.0, -1.0]), 1e-16)


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
    values = SineOverlap(500.0)(distance)
    assert np.all(np.diff(values) >= 0)
    assert values[1] == 0
    assert values[3] == pytest.approx(0.5)
    assert values[4] < 1
    assert np.all(values[5:] == 1.0)
    np.testing.assert_array_equal(SineOverlap(0.0)(distance), [0, 0, 1, 1, 1, 1, 1])


TELESCOPES = {
    "coaxial": {"separation": 0.0, "obstruction_radius": 0.03},
    "biaxial": {"separation": 0.25},
    "tilted": {"separation": 0.25, "tilt": 2e-4},
}


@pytest.mark.parametrize("telescope", TELESCOPES)
def test_the_geometrical_overlap_is_that_of_single_beams(telescope):
    geometry = {
        "aperture_radius": 0.1, "field_of_view": 1e-3, "beam_radius": 0.01, "divergence": 2e-4,
        "separation": 0.0, "tilt": 0.0, "obstruction_radius": 0.0,
    } | TELESCOPES[telescope]  # fmt: skip
    shape = GeometricalOverlap(**geometry)
    random = np.random.default_rng(1)
    beams = 400_000
    inner, outer = geometry["obstruction_radius"] ** 2, geometry["aperture_radius"] ** 2
    radius = np.sqrt(inner + (outer - inner) * random.random(beams))
    angle = 2 * np.pi * random.random(beams)
    aperture = radius * np.exp(1j * angle)
    for distance in (30.0, 150.0, 300.0, 600.0, 1500.0, 8000.0):
        width = math.hypot(0.01, 2e-4 * distance) / 2
        beam = geometry["separation"] - geometry["tilt"] * distance
        beam = beam + width * (random.standard_normal(beams) + 1j * random.standard_normal(beams))
        passed = (np.abs(beam - aperture) < 5e-4 * distance).mean()
        error = math.sqrt(max(passed * (1 - passed), 1e-6) / beams)
        assert shape(np.array([distance]))[0] == pytest.approx(passed, abs=4.5 * error + 2e-3)


@pytest.mark.parametrize(
    "shape",
    [
        SineOverlap(300.0),
        *(
            GeometricalOverlap(0.1, 1e-3, 0.01, 2e-4, **{"separation": 0.0} | TELESCOPES[name])
            for name in TELESCOPES
        ),
    ],
)
def test_every_overlap_vanishes_with_the_square_of_the_range(shape):
    near = np.array([-5.0, 0.0, 1e-3, 1e-2, 1e-1])
    values = shape(near)
    assert np.all(values[:2] == 0)
    assert finite_at_lidar(shape)
    far = shape(np.geomspace(1e-3, 2e4, 4000))
    assert np.all((far >= 0) & (far <= 1))
    assert far.max() > 0.5
    if values[2] > 0:
        assert values[3] / values[2] == pytest.approx(100, rel=1e-3)
    assert not finite_at_lidar(SineOverlap(0.0))


def _lidar(**changes):
    return Lidar(
        **{
            "energy": 0.1,
            "aperture_diameter": 0.3,
            "wavelength": 532e-9,
            "optical_efficiency": 0.3,
            "quantum_efficiency": 0.2,
            "bin_width": 7.5,
            "full_overlap_range": 400.0,
        }
        | changes
    )


def test_photons_add_up_from_laser_to_detector():
    lidar = _lidar()
    # 100 mJ at 532 nm are 2.678e17 photons; from 1 km, 1e-6 m-1 sr-1 sends 7.5e-12 of them per
    # metre of telescope squared and bin: counted by hand, photon by photon.
    photons = 0.1 / 3.7339e-19
    area = math.pi * 0.15**2
    per_shot = photons * 1e-6 * 7.5 * area / 1000.0**2 * 0.3 * 0.2
    rate = lidar.rate(
        np.array([1000.0, 1007.5]), extinction=np.zeros(2), backscatter=np.full(2, 1e-6)
    )
    # 7.5 m are 50 ns by the nominal 150 m per microsecond, 7e-4 more by the speed of light.
    assert rate[0] == pytest.approx(per_shot / 0.05, rel=1e-3)
    power = lidar.power(
        np.array([1000.0, 1007.5]), extinction=np.zeros(2), backscatter=np.full(2, 1e-6)
    )
    assert power[0] == pytest.approx(rate[0] * 1e6 / 0.2 * 3.7339e-19, rel=1e-4)
    # Equation 23 for a rectangular pulse: power times duration times c / 2.
    pulse = RectangularPulse(20e-9)
    peak = 0.1 / pulse.duration * area * 0.3 * 299_792_458.0 * pulse.duration / 2
    assert lidar.power_constant == pytest.approx(peak)


def test_the_system_constant_scales_with_the_lidar():
    base = _lidar().system_constant
    assert _lidar(energy=0.2).system_constant == pytest.approx(2 * base)
    assert _lidar(aperture_diameter=0.6).system_constant == pytest.approx(4 * base)
    assert _lidar(obstruction_diameter=0.15).system_constant == pytest.approx(0.75 * base)
    assert _lidar(quantum_efficiency=0.1).system_constant == pytest.approx(base / 2)
    # More photons of less energy come back.
    raman = _lidar(detected_wavelength=607e-9)
    assert raman.system_constant == pytest.approx(base * 607 / 532)


def test_a_pulse_of_a_lidar_smears_a_cloud():
    path = np.arange(0.5, 3000.0, 0.5)
    cloud = np.where(path > 1500, 1e-4, 1e-9)
    distance = bin_centres(350, 7.5)
    air = {"extinction": np.zeros(path.size), "backscatter": cloud, "path": path}
    short = _lidar().rate(distance, **air)
    smeared = _lidar(pulse=GaussianPulse(200e-9)).rate(distance, **air)
    rise = [np.flatnonzero(s > 0.9 * s[distance > 1500].max())[0] for s in (short, smeared)]
    assert rise[1] >= rise[0] + 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"aperture_diameter": 0.0}, "aperture_diameter"),
        ({"energy": -1.0}, "energy"),
        ({"energy": 100e3}, "energy"),
        ({"wavelength": 532.0}, r"wavelength.*5\.32e-07 m"),
        ({"detected_wavelength": 607.0}, r"detected_wavelength"),
        ({"quantum_efficiency": 20.0}, "quantum_efficiency"),
        ({"optical_efficiency": 0.0}, "optical_efficiency"),
        ({"bin_width": 0.0}, "bin_width"),
        ({"full_overlap_range": -1.0}, "full_overlap_range"),
        ({"obstruction_diameter": 0.3}, "obstruction_diameter"),
        ({"energy": math.nan}, "energy"),
    ],
)
def test_impossible_lidars_are_refused(change, message):
    with pytest.raises(SimulationInputError, match=message):
        _lidar(**change)


def test_a_pulse_longer_than_the_range_is_refused():
    lidar = _lidar(pulse=RectangularPulse(10e-6))
    with pytest.raises(SimulationInputError, match="pulse"):
        lidar.rate(bin_centres(100, 7.5), extinction=np.zeros(100), backscatter=np.ones(100))


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
