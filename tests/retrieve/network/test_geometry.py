"""Geodesy against pyproj and exact arithmetic, crossings of beams against trigonometry."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from support.oracles.network import fan, triangle

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.network import geometry
from lidarops.retrieve.network.geometry import Beam

# Geodesy ------------------------------------------------------------------------------------


def test_earth_centred_positions_agree_with_pyproj():
    pyproj = pytest.importorskip("pyproj")
    transform = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    rng = np.random.default_rng(0)
    latitude = np.concatenate([rng.uniform(-90, 90, 500), [-90.0, 90.0, 0.0]])
    longitude, altitude = rng.uniform(-180, 180, 503), rng.uniform(-400, 30_000, 503)
    expected = np.stack(transform.transform(longitude, latitude, altitude), axis=-1)
    measured = geometry.to_earth_centred(latitude, longitude, altitude)
    np.testing.assert_allclose(measured, expected, atol=1e-8)
    back = geometry.to_geodetic(expected)
    np.testing.assert_allclose(back[:, 0], latitude, atol=1e-12)
    np.testing.assert_allclose(back[:, 2], altitude, atol=1e-7)
    inner = np.abs(latitude) < 89.999
    np.testing.assert_allclose(back[inner, 1], longitude[inner], atol=1e-11)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (47.25, 11.3, 600.0), (-89.9, -170.0, 9e3)])
def test_earth_centred_positions_agree_with_exact_arithmetic(place):
    with mp.workdps(40):
        phi, lam = (mp.radians(mp.mpf(x)) for x in place[:2])
        f = 1 / mp.mpf("298.257223563")
        square = f * (2 - f)
        normal = 6378137 / mp.sqrt(1 - square * mp.sin(phi) ** 2)
        across = (normal + place[2]) * mp.cos(phi)
        along = (normal * (1 - square) + place[2]) * mp.sin(phi)
        exact = [float(v) for v in (across * mp.cos(lam), across * mp.sin(lam), along)]
    np.testing.assert_allclose(geometry.to_earth_centred(*place), exact, atol=2e-9)


def test_local_frame_is_east_north_up():
    here = Beam(47.0, 11.0, 500.0, 0.0, 0.0)
    step = 1e-4
    beams = [
        here,
        Beam(47.0, 11.0 + step, 500.0, 90.0, 0.0),
        Beam(47.0 + step, 11.0, 500.0, 0.0, 45.0),
        Beam(47.0, 11.0, 510.0, 180.0, 90.0),
    ]
    origin, direction = geometry.locate(beams)
    assert origin[1, 0] == pytest.approx(7.605, abs=0.002)
    assert origin[2, 1] == pytest.approx(11.117, abs=0.002)
    np.testing.assert_allclose(origin[3], [0, 0, 10], atol=1e-8)
    np.testing.assert_allclose(direction[1], [1, 0, 0], atol=3e-6)
    np.testing.assert_allclose(direction[2], [0, np.sqrt(0.5), np.sqrt(0.5)], atol=3e-6)
    np.testing.assert_allclose(direction[3], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, rtol=1e-14)


def test_verticals_of_distant_stations_differ_as_the_earth_curves():
    beams = [Beam(47.0, 11.0, 0.0, 0.0, 90.0), Beam(47.09, 11.0, 0.0, 0.0, 90.0)]
    _, direction = geometry.locate(beams)
    angle = np.degrees(np.arccos(direction[0] @ direction[1]))
    assert angle == pytest.approx(0.09, rel=1e-6)


def bearing(origin, target):
    """Return azimuth and elevation from a station to an earth-centred target."""
    latitude, longitude, altitude = origin
    axes = geometry.local_axes(latitude, longitude)
    east, north, up = axes @ (target - geometry.to_earth_centred(latitude, longitude, altitude))
    return np.degrees(np.arctan2(east, north)), np.degrees(np.arctan2(up, np.hypot(east, north)))


def test_beams_of_three_stations_meet_at_their_targets():
    stations = [(47.25, 11.30, 600.0), (47.25, 11.34, 620.0), (47.28, 11.32, 900.0)]
    targets = [(47.262, 11.315, 1500.0), (47.258, 11.325, 1900.0)]
    beams, expected = [], []
    for target in targets:
        point = geometry.to_earth_centred(*target)
        expected.append(point)
        beams += [Beam(*station, *bearing(station, point)) for station in stations]
    net = geometry.build_network(beams, tolerance=0.5)
    assert net.crossings == 2
    assert np.bincount(net.passages.crossing).tolist() == [3, 3]
    order = np.argsort(net.geodetic[:, 2])
    np.testing.assert_allclose(net.geodetic[order, :2], [t[:2] for t in targets], atol=1e-9)
    np.testing.assert_allclose(net.geodetic[order, 2], [1500.0, 1900.0], atol=1e-5)
    for beam in range(6):
        crossings, ranges = net.on_beam(beam)
        station = geometry.to_earth_centred(*stations[beam % 3])
        distance = np.linalg.norm(expected[beam // 3] - station)
        assert crossings.size == 1
        assert ranges[0] == pytest.approx(distance, abs=1e-6)


# Crossings -----------------------------------------------------------------------------------


def test_triangle_of_the_paper():
    net = triangle()
    assert net.crossings == 3
    np.testing.assert_allclose(
        net.crossing[:, [0, 2]],
        [[0.0, 300 * np.sqrt(3)], [-100.0, 400 * np.sqrt(3)], [0.0, 500 * np.sqrt(3)]],
        atol=1e-9,
    )
    # The third crossing is the last one on both of its beams.
    assert net.near_crossing.tolist() == [True, True, False]
    crossings, ranges = net.on_beam(0)
    assert crossings.tolist() == [0, 1]
    np.testing.assert_allclose(ranges, [600.0, 800.0], atol=1e-9)


def test_beams_that_pass_within_the_tolerance_meet_half_way():
    origin = [[-500.0, 0.0, 0.0], [0.0, -500.0, 8.0]]
    direction = [[2.0, 0.0, 0.0], [0.0, 0.5, 0.0]]
    assert geometry.network_of_lines(origin, direction, tolerance=7.9).crossings == 0
    net = geometry.network_of_lines(origin, direction, tolerance=8.1)
    np.testing.assert_allclose(net.crossing, [[0.0, 0.0, 4.0]], atol=1e-9)
    np.testing.assert_allclose(net.passages.range, [500.0, 500.0])


def test_passages_of_several_beams_in_one_place_are_one_crossing():
    net = fan([-500.0, 0.0, 500.0], [(45.0,), (90.0,), (135.0,)])
    assert net.crossings == 1
    assert net.passages.beam.tolist() == [0, 1, 2]
    # With distances of 10 m: one crossing at a tolerance of 15 m, three at 1 m.
    origin = [[-500.0, 0, 0], [10.0, 0, 0], [500.0, 0, 0]]
    direction = [[1.0, 0, 1.0], [0, 0, 1.0], [-1.0, 0, 1.0]]
    assert geometry.network_of_lines(origin, direction, tolerance=15.0).crossings == 1
    assert geometry.network_of_lines(origin, direction, tolerance=1.0).crossings == 3


def test_beams_of_one_station_and_parallel_beams_do_not_meet():
    assert fan([0.0], [(30.0, 60.0, 90.0)]).crossings == 0
    assert fan([0.0, 100.0], [(60.0,), (60.0,)]).crossings == 0
    assert fan([0.0, 10.0], [(89.5,), (90.5,)]).crossings == 0
    met = fan([0.0, 10.0], [(89.0,), (91.5,)], smallest_angle=1.0)
    assert met.crossings == 1


def test_crossings_lie_in_front_of_the_lidars_and_within_range():
    assert fan([-500.0, 500.0], [(135.0,), (45.0,)]).crossings == 0
    assert fan([-500.0, 500.0], [(45.0,), (135.0,)]).crossings == 1
    assert fan([-500.0, 500.0], [(45.0,), (135.0,)], nearest=720.0).crossings == 0
    assert fan([-500.0, 500.0], [(45.0,), (135.0,)], farthest=[800.0, 700.0]).crossings == 0
    assert fan([-500.0, 500.0], [(45.0,), (135.0,)], farthest=[800.0, 710.0]).crossings == 1


def test_network_is_cached_and_read_only():
    beams = [Beam(47.0, 11.0, 0.0, 45.0, 10.0), Beam(47.0, 11.01, 0.0, 315.0, 10.0)]
    net = geometry.build_network(beams)
    assert geometry.build_network(list(beams)) is net
    assert geometry.build_network(beams, tolerance=5.0) is not net
    with pytest.raises(ValueError, match="read-only"):
        net.crossing[0, 0] = 1.0


def test_network_does_not_depend_on_the_order_of_beams():
    rng = np.random.default_rng(4)
    angles = [(50, 68), (78, 103), (112, 130)]
    net = fan([-500.0, 0.0, 400.0], angles)
    shuffled = rng.permutation(6)
    other = geometry.network_of_lines(net.origin[shuffled], net.direction[shuffled], tolerance=1e-3)
    order = np.lexsort(net.crossing.T)
    np.testing.assert_allclose(
        other.crossing[np.lexsort(np.round(other.crossing, 6).T)],
        net.crossing[np.lexsort(np.round(net.crossing, 6).T)],
        atol=1e-8,
    )
    assert order.size == other.crossings


# Checks -------------------------------------------------------------------------------------

GOOD = {"latitude": 47.0, "longitude": 11.0, "altitude": 0.0, "azimuth": 0.0, "elevation": 45.0}


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("latitude", 91.0),
        ("longitude", np.nan),
        ("altitude", 1e6),
        ("azimuth", 361.0),
        ("elevation", -91.0),
        ("elevation", "up"),
    ],
)
def test_invalid_beams_raise_with_the_field_name(field, value):
    with pytest.raises(RetrievalInputError) as raised:
        geometry.build_network([Beam(**GOOD), Beam(**{**GOOD, field: value})])
    assert raised.value.field in {field, "beams"}


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"tolerance": 0.0}, "tolerance"),
        ({"tolerance": np.nan}, "tolerance"),
        ({"nearest": -1.0}, "nearest"),
        ({"nearest": [1.0, 2.0, 3.0]}, "nearest"),
        ({"farthest": np.nan}, "farthest"),
        ({"smallest_angle": 0.0}, "smallest_angle"),
    ],
)
def test_invalid_settings_raise_with_the_field_name(arguments, field):
    beams = [Beam(**GOOD), Beam(**{**GOOD, "latitude": 47.01, "azimuth": 180.0})]
    with pytest.raises(RetrievalInputError) as raised:
        geometry.build_network(beams, **arguments)
    assert raised.value.field == field


def test_no_beams_too_many_beams_and_invalid_lines_raise():
    with pytest.raises(RetrievalInputError, match="none"):
        geometry.build_network([])
    many = np.zeros((600, 3)), np.tile([1.0, 0, 0], (600, 1))
    with pytest.raises(RetrievalInputError, match="split"):
        geometry.network_of_lines(*many)
    for origin, direction in (
        (np.zeros((2, 2)), np.ones((2, 2))),
        (np.zeros((2, 3)), np.zeros((2, 3))),
        (np.full((2, 3), np.nan), np.ones((2, 3))),
    ):
        with pytest.raises(RetrievalInputError):
            geometry.network_of_lines(origin, direction)
