"""Positions along slant beams, compared with an inverse computation in Cartesian coordinates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, STATION, context

from lidarops.campaign.model import Station
from lidarops.netcdf.coordinates import beam_positions

SEMI_MAJOR, INVERSE_FLATTENING = 6378137.0, 298.257223563


def cartesian(latitude: float, longitude: float, altitude: float) -> np.ndarray:
    lat, lon = np.deg2rad(latitude), np.deg2rad(longitude)
    squared = (2 - 1 / INVERSE_FLATTENING) / INVERSE_FLATTENING
    normal = SEMI_MAJOR / np.sqrt(1 - squared * np.sin(lat) ** 2)
    return np.array(
        [
            (normal + altitude) * np.cos(lat) * np.cos(lon),
            (normal + altitude) * np.cos(lat) * np.sin(lon),
            (normal * (1 - squared) + altitude) * np.sin(lat),
        ]
    )


@given(
    latitude=st.floats(-90, 90),
    longitude=st.floats(-180, 180),
    altitude=st.floats(-400, 9000),
    ahead=st.floats(0, 60e3),
    azimuth=st.floats(0, 360),
    up=st.floats(-1e3, 60e3),
)
def test_positions_lie_on_the_straight_beam(latitude, longitude, altitude, ahead, azimuth, up):
    found = beam_positions(latitude, longitude, altitude, *map(np.float64, (ahead, azimuth, up)))
    lat, lon, direction = np.deg2rad([latitude, longitude, azimuth])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    upward = np.cross(east, north)
    there = (
        cartesian(latitude, longitude, altitude)
        + ahead * (np.sin(direction) * east + np.cos(direction) * north)
        + up * upward
    )
    # At the place that is found, some height above the ellipsoid must be the point itself.
    ground = cartesian(float(found[0]), float(found[1]), 0.0)
    above = cartesian(float(found[0]), float(found[1]), 1.0) - ground
    height = (there - ground) @ above
    assert np.linalg.norm(ground + height * above - there) < 0.01
    assert -180 <= found[1] <= 180


def test_north_and_east_have_the_right_sign():
    east = np.array([0.0, 90.0])
    latitude, longitude = beam_positions(0.0, 179.99, 0.0, np.float64(10e3), east, np.float64(0))
    assert latitude[0] > 0.09
    assert longitude[0] == pytest.approx(179.99)
    assert longitude[1] == pytest.approx(-179.92, abs=0.001)


@pytest.mark.parametrize("kind", ["signal", "homogeneous"])
def test_bins_of_slant_beams_have_their_own_position(kind: str):
    product = build_product(MAKERS[kind](zenith=80.0, azimuth=90.0), context(kind))
    bins = product["bin_longitude"]
    along = product["range" if kind == "signal" else "section_range"]
    assert bins.dims == along.dims
    metres = (bins - STATION.longitude) * 111_320 * np.cos(np.deg2rad(STATION.latitude))
    np.testing.assert_allclose(metres, along * np.sin(np.deg2rad(80)), rtol=0.005, atol=1.0)
    assert product["latitude"].attrs["standard_name"] == "deployment_latitude"
    assert product["bin_latitude"].attrs["standard_name"] == "latitude"
    assert product.attrs["geospatial_lon_max"] == float(bins.max())
    assert product.attrs["geospatial_bounds"].startswith("POLYGON ((")
    main = "signal" if kind == "signal" else "total_extinction"
    # CDO 2.1 would skip the variable, or read garbage where the beam moves.
    assert "bin_latitude" not in product[main].attrs["coordinates"].split()


def test_a_moving_beam_has_the_position_of_the_station_only():
    # No tool reads places that change over time and along the beam.
    angles = [0.0, 90.0, 180.0, 270.0, 0.0]
    product = build_product(MAKERS["signal"](zenith=45.0, azimuth=angles), context("signal"))
    assert "bin_latitude" not in product
    assert product["latitude"].attrs["standard_name"] == "latitude"


def test_vertical_beams_and_unknown_azimuths_have_no_bin_positions():
    for beam in ({"zenith": 90.0}, {"zenith": 3.0, "azimuth": 10.0}):
        product = build_product(MAKERS["signal"](**beam), context("signal"))
        assert "bin_latitude" not in product
        assert product["latitude"].attrs["standard_name"] == "latitude"


def test_stations_at_a_pole_have_bins_too():
    pole = Station(name="Pole", latitude=90.0, longitude=0.0)
    data = MAKERS["signal"](zenith=90.0, azimuth=90.0)
    product = build_product(data, context("signal", station=pole))
    assert np.isfinite(product["bin_longitude"]).all()
    np.testing.assert_allclose(product["bin_longitude"], 90.0)
