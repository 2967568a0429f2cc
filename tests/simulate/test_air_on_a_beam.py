"""Air along beams: every part of the atmosphere against its formula."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from lidarops.campaign.simulated_air import AtmosphereSettings
from lidarops.simulate.atmosphere import Air, Beam

START = datetime(2025, 6, 1, tzinfo=UTC)
DISTANCE = (np.arange(1000) + 0.5) * 7.5
LEVEL = Beam(0.0, 0.0, 0.0, 90.0, 90.0)
UP = Beam(0.0, 0.0, 0.0, 0.0, 0.0)
GREEN = 532e-9


def _air(altitude=0.0, seed=1, **parts):
    settings = AtmosphereSettings.model_validate(parts)
    return Air(settings, altitude=altitude, start=START, seed=seed)


def _particles(beam=LEVEL, hours=0.0, wavelength=GREEN, distance=DISTANCE, seed=1, **parts):
    """Return extinction and backscatter of particles alone."""
    moment = START + timedelta(hours=hours)
    full = _air(seed=seed, **parts).along(beam, distance, moment, wavelength)
    clear = _air().along(beam, distance, moment, wavelength)
    return full.extinction - clear.extinction, full.backscatter - clear.backscatter


def test_only_a_level_beam_in_layered_air_is_homogeneous():
    air = _air(altitude=300, boundary_layer={}, clouds=[])
    for azimuth in (0, 37, 270):
        assert air.along(LEVEL._replace(azimuth=azimuth), DISTANCE, START, GREEN).homogeneous
    for zenith in (0.0, 60.0, 89.9):
        tilted = LEVEL._replace(zenith_angle=zenith)
        assert not air.along(tilted, DISTANCE, START, GREEN).homogeneous


def test_molecules_may_be_kept_constant():
    course = {"minimum": 1e-4, "maximum": 1e-4}
    kept = _air(homogeneous={"extinction": course, "molecules_constant": True})
    assert kept.along(UP, DISTANCE, START, GREEN).homogeneous
    real = _air(homogeneous={"extinction": course})
    assert not real.along(UP, DISTANCE, START, GREEN).homogeneous


def test_nothing_scatters_above_the_standard_atmosphere():
    air = _air()
    path = air.along(UP, np.array([1e3, 83e3, 85e3, 2e6]), START, GREEN)
    assert path.extinction[1] > 0
    assert not path.extinction[2:].any()


def test_clouds_have_edges_and_hours():
    cloud = {
        "extinction": 0.01, "base": 1000, "top": 1500, "lidar_ratio": 20,
        "start": START.isoformat(), "stop": (START + timedelta(hours=1)).isoformat(),
    }  # fmt: skip
    extinction, backscatter = _particles(UP, clouds=[cloud])
    inside = (DISTANCE >= 1000) & (DISTANCE < 1500)
    np.testing.assert_allclose(extinction, 0.01 * inside, atol=1e-15)
    np.testing.assert_allclose(backscatter, 0.01 / 20 * inside, atol=1e-15)
    assert not _particles(UP, hours=1.5, clouds=[cloud])[0].any()
    # On a slant beam the cloud is farther away.
    slant, _ = _particles(UP._replace(zenith_angle=60.0), clouds=[cloud])
    np.testing.assert_allclose(DISTANCE[slant > 1e-3].min(), 2000, atol=7.5)


def test_a_gradient_grows_towards_its_azimuth():
    gradient = {"extinction": 1e-4, "azimuth": 90, "scale": 5000, "top": 1000}
    extinction, _ = _particles(gradients=[gradient])
    np.testing.assert_allclose(extinction, 1e-4 * np.exp(DISTANCE / 5000), rtol=1e-9)
    opposite, _ = _particles(LEVEL._replace(azimuth=270.0), gradients=[gradient])
    np.testing.assert_allclose(opposite, 1e-4 * np.exp(-DISTANCE / 5000), rtol=1e-9)
    across, _ = _particles(LEVEL._replace(azimuth=0.0), gradients=[gradient])
    np.testing.assert_allclose(across, 1e-4, rtol=1e-9)
    above, _ = _particles(UP, gradients=[gradient])
    np.testing.assert_allclose(above, 1e-4 * (DISTANCE <= 1000), atol=1e-15)


def test_a_plume_drifts_with_the_wind():
    plume = {
        "extinction": 1e-3, "east": -3000, "north": 500, "height": 0,
        "horizontal_depth": 400, "vertical_depth": 100, "wind_east": 5,
    }  # fmt: skip
    beam = Beam(0.0, 500.0, 0.0, 90.0, 90.0)
    for minutes in (10, 15, 20):
        extinction, _ = _particles(beam, hours=minutes / 60, plumes=[plume])
        centre = -3000 + 5 * 60 * minutes
        expected = 1e-3 * np.exp(-0.5 * ((DISTANCE - centre) / 400) ** 2)
        np.testing.assert_allclose(extinction, expected, atol=1e-14)
    # Off its axis the plume is thinner.
    aside, _ = _particles(beam._replace(north=1300.0), hours=0.25, plumes=[plume])
    centred, _ = _particles(beam, hours=0.25, plumes=[plume])
    np.testing.assert_allclose(aside, centred * math.exp(-0.5 * 4), atol=1e-14)


def test_profiles_and_soundings_are_interpolated_as_given():
    profile = {
        "height": [0, 1000, 2000], "extinction": [1e-4, 2e-4, 0],
        "aerosol": {"lidar_ratio": 40, "angstrom_exponent": 2},
    }  # fmt: skip
    extinction, backscatter = _particles(UP, wavelength=1064e-9, profiles=[profile])
    expected = np.interp(DISTANCE, [0, 1000, 2000], [1e-4, 2e-4, 0], right=0) / 4
    np.testing.assert_allclose(extinction, expected, atol=1e-15)
    np.testing.assert_allclose(backscatter, expected / 40, atol=1e-16)
    # A sounding of the standard atmosphere is the standard atmosphere.
    levels = {
        "altitude": [0.0, 11_000.0],
        "pressure": [101_325.0, 22_699.96],
        "temperature": [288.15, 216.774],
    }
    ends = np.array([0.0, 11_000.0])
    sounded = _air(sounding=levels).along(UP, ends, START, GREEN).extinction
    np.testing.assert_allclose(sounded, _air().along(UP, ends, START, GREEN).extinction, rtol=1e-5)


def test_turbulence_is_log_normal_with_its_correlation():
    course = {"minimum": 1e-4, "maximum": 1e-4}
    wide = {"deviation": 0.4, "horizontal_length": 200, "vertical_length": 50}
    distance = np.linspace(0, 400_000, 8001)  # 2000 correlation lengths, steps of 50 m
    extinction, _ = _particles(
        distance=distance, homogeneous={"extinction": course}, turbulence=wide
    )
    factor = extinction / 1e-4
    # 256 waves are normal to 1 / 256, and 400 km hold some 800 independent values.
    assert factor.mean() == pytest.approx(1, abs=0.06)
    logarithm = np.log(factor)
    assert logarithm.std() == pytest.approx(0.4, rel=0.1)
    assert logarithm.mean() == pytest.approx(-0.08, abs=0.04)
    for step in (2, 4, 8):
        correlation = np.corrcoef(logarithm[:-step], logarithm[step:])[0, 1]
        expected = math.exp(-0.5 * (50 * step / 200) ** 2)
        assert correlation == pytest.approx(expected, abs=0.1)


def test_turbulence_is_the_same_for_all_beams_and_drifts_with_the_wind():
    parts = {
        "homogeneous": {"extinction": {"minimum": 1e-4, "maximum": 1e-4}},
        "turbulence": {
            "deviation": 0.3, "horizontal_length": 300, "vertical_length": 100, "wind_east": 10,
        },
    }  # fmt: skip
    from_west, _ = _particles(LEVEL, **parts)
    # The same points, from the other end of the line.
    east = Beam(7500.0, 0.0, 0.0, 90.0, 270.0)
    from_east, _ = _particles(east, **parts)
    np.testing.assert_allclose(from_west, from_east[::-1], rtol=1e-6)
    # 75 s later the air has moved by 100 bins.
    later, _ = _particles(LEVEL, hours=75 / 3600, **parts)
    np.testing.assert_allclose(later[100:], from_west[:-100], rtol=1e-6)
    other_seed, _ = _particles(LEVEL, seed=2, **parts)
    assert np.abs(np.log(other_seed / from_west)).mean() > 0.1


def test_equal_states_mean_the_same_air():
    cloud = {
        "extinction": 0.01, "base": 1000, "top": 1500,
        "start": START.isoformat(), "stop": (START + timedelta(hours=1)).isoformat(),
    }  # fmt: skip
    still = _air(clouds=[cloud])
    half, later = START + timedelta(minutes=30), START + timedelta(hours=2)
    assert still.state(START) == still.state(half) != still.state(later)
    moving = _air(boundary_layer={})
    assert moving.state(START) != moving.state(half)
