"""Slant paths against exact geometry, and the selection of usable beams."""

from __future__ import annotations

import math

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from support.cases import each

from lidarops.constants import EARTH_RADIUS
from lidarops.errors import RetrievalInputError
from lidarops.retrieve.multiangle import slant_paths

HEIGHT = np.array([100.0, 1000.0, 5000.0])


def exact(angle, height):
    """Return the slant over the vertical path from the triangle to the Earth's centre."""
    with mp.workdps(50):
        earth, z = mp.mpf(slant_paths.EFFECTIVE_RADIUS), mp.mpf(height)
        cosine = mp.cos(mp.mpf(float(angle)) * mp.pi / 180)
        return (mp.sqrt((earth * cosine) ** 2 + 2 * earth * z + z**2) - earth * cosine) / z


@pytest.mark.parametrize("angle", [75.001, 80.0, 83.0, 88.0])
def test_spherical_path_keeps_its_digits(angle):
    path = slant_paths.slant_path(np.array([angle]), HEIGHT)[0]
    for x, z in zip(path, HEIGHT, strict=True):
        assert abs(x / exact(angle, z) - 1) < 1e-14


def refractive_index(height):
    """Return the refractive index of air at 532 nm in the standard atmosphere."""
    warmth = 1.0 - 0.0065 * height / 288.15
    return 1.0 + 2.78e-4 * warmth ** (0.034163 / 0.0065 - 1.0)


@pytest.mark.parametrize("elevation", [3.0, 5.0, 10.0])
def test_path_follows_the_refracted_beam(elevation):
    """By Snell's law in spherical layers: 0.2 percent at 5 km, 0.01 at 1 km."""
    constant = refractive_index(0.0) * EARTH_RADIUS * math.cos(math.radians(elevation))
    path = slant_paths.slant_path(np.array([90.0 - elevation]), HEIGHT)[0]
    for x, height, tolerance in zip(path, HEIGHT, (2e-6, 1.1e-4, 2e-3), strict=True):
        length, _ = quad(
            lambda root: (
                2.0
                * root
                / math.sqrt(
                    1.0 - (constant / (refractive_index(root**2) * (EARTH_RADIUS + root**2))) ** 2
                )
            ),
            0.0,
            math.sqrt(height),
            epsrel=1e-10,
        )
        assert x == pytest.approx(length / height, rel=tolerance)


@pytest.mark.parametrize("angle", [0.0, 30.0, 60.0, 75.0])
def test_secant_equals_the_spherical_path_up_to_75_degrees(angle):
    path = slant_paths.slant_path(np.array([angle]), HEIGHT)[0]
    assert path == pytest.approx(1 / np.cos(np.radians(angle)), rel=1e-15)
    # The curvature that the secant neglects changes an optical depth by at most 0.6 percent.
    assert abs(path[-1] / float(exact(angle, 5000.0)) - 1) < 0.006


@pytest.mark.parametrize(("angle", "deviation"), [(84.3, 0.030), (88.0, 0.175)])
def test_secant_is_wrong_near_the_horizon(angle, deviation):
    path = slant_paths.slant_path(np.array([angle]), np.array([5000.0]))[0, 0]
    assert 1 - path * np.cos(np.radians(angle)) == pytest.approx(deviation, abs=0.006)


def test_long_paths_are_not_used():
    scan = slant_paths.make_scan([0.0, 60.0, -75.0, 87.0, 87.5, 89.99, 90.0, np.nan], HEIGHT)
    assert scan.usable.tolist() == [True, True, True, True, False, False, False, False]
    assert np.all(np.isfinite(scan.path[scan.usable]))
    assert np.all(np.isnan(scan.path[~scan.usable]))
    assert np.nanmax(scan.path) <= 19.2


def test_a_negative_angle_points_opposite_to_its_azimuth():
    scan = slant_paths.make_scan([-40.0, 40.0], HEIGHT, [10.0, 190.0])
    assert scan.path[0] == pytest.approx(scan.path[1])
    assert scan.east[0] == pytest.approx(scan.east[1])
    assert scan.north[0] == pytest.approx(scan.north[1])
    assert np.hypot(scan.east, scan.north) == pytest.approx(np.tan(np.radians(40.0)))


@given(
    st.lists(st.floats(0.0, 2 * np.pi), min_size=1, max_size=8),
    st.floats(0.0, 2 * np.pi),
)
@settings(max_examples=200, deadline=None)
def test_beams_surround_the_zenith_if_no_half_plane_contains_them(azimuth, turn):
    directions = np.array(azimuth)
    normals = np.linspace(0, 2 * np.pi, 3601)
    # The zero vector is outside the convex hull if a half plane strictly contains all directions.
    closest = np.min(np.cos(directions[:, np.newaxis] - normals), axis=0).max()
    if abs(closest) > 2e-3:
        assert slant_paths.surrounds_zenith(directions + turn) == (closest < 0)


@pytest.mark.parametrize(
    ("azimuth", "around"),
    [([0.0, 180.0], True), ([0.0, 120.0, 240.0], True), ([0.0, 150.0], False), ([7.0, 7.0], False)],
)
def test_opposite_beams_surround_the_zenith(azimuth, around):
    assert slant_paths.surrounds_zenith(np.radians(azimuth)) == around


@each(
    ("angles", "altitude", "azimuth", "field"),
    [
        ([0.0, 91.0], HEIGHT, None, "zenith_angle"),
        ([[0.0]], HEIGHT, None, "zenith_angle"),
        ([], HEIGHT, None, "zenith_angle"),
        ([0.0, 10.0], HEIGHT, [0.0], "azimuth"),
        ([0.0, 10.0], [0.0, 100.0], None, "altitude"),
        ([0.0, 10.0], [200.0, 100.0], None, "altitude"),
        ([0.0, 10.0], [100.0, np.inf], None, "altitude"),
        ([0.0, 10.0], [], None, "altitude"),
        (["a"], HEIGHT, None, "zenith_angle"),
    ],
)
def test_invalid_geometry_is_refused(angles, altitude, azimuth, field):
    with pytest.raises(RetrievalInputError, match=field):
        slant_paths.make_scan(angles, altitude, azimuth)
