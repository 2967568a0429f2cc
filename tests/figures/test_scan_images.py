"""Images of scans show the signal of each beam where it was measured."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from support.products.drawn import figures, images

from lidarops.figures.panels import BLANK, codes_of
from lidarops.products.multiangle.figures import read_scan

STATION = 180.0
ALTITUDE = STATION + 100.0 * np.arange(1, 31)
ELEVATIONS = np.array([10.0, 20.0, 30.0, 40.0])


def scan(azimuths, cycles=2, *, opposite=False):
    """Return a scan whose signal is that of its beam: 1, 2, 3 and so on."""
    zenith = np.tile(90.0 - ELEVATIONS, len(azimuths))
    azimuth = np.repeat(np.float64(azimuths), ELEVATIONS.size)
    if opposite:
        azimuth[::2] += 180.0
    shape = (cycles, zenith.size, ALTITUDE.size)
    signal = np.broadcast_to(1.0 + np.arange(zenith.size)[:, np.newaxis], shape).copy()
    dims = ("time", "beam", "altitude")
    start = np.datetime64("2026-03-01T00:00", "ns")
    return xr.Dataset(
        {"beam_signal": (dims, signal), "residual": (dims, np.zeros(shape))},
        coords={
            "time": start + np.arange(cycles) * np.timedelta64(10, "m"),
            "altitude": ALTITUDE,
            "station_altitude": STATION,
            "beam_zenith_angle": ("beam", zenith),
            "beam_azimuth": ("beam", azimuth % 360.0),
        },
    )


def drawn(product):
    (figure,) = figures("multiangle", "scan", [product])
    return figure


def level(panel, signal):
    """Return the code of a signal."""
    low, high = np.log([panel.bar.low, panel.bar.high])
    return int(codes_of(np.array([(np.log(signal) - low) / (high - low)]))[0])


def code(panel, x, y):
    """Return the code at a place, km."""
    (image,) = images(panel)
    column, row = (
        np.searchsorted(edges, at) - 1 for edges, at in ((image.left, x), (image.edges, y))
    )
    return int(image.codes[column, row])


@pytest.mark.parametrize("opposite", [False, True])
def test_a_range_height_image_has_each_signal_along_its_beam(opposite):
    figure = drawn(scan([62.0], opposite=opposite))
    (panel,) = figure.panels
    for number, elevation in enumerate(ELEVATIONS):
        # The lowest beam states the azimuth of the plane.
        side = -1.0 if opposite and number % 2 else 1.0
        for height in (0.55, 1.55, 2.55):
            place = side * height / np.tan(np.radians(elevation))
            assert code(panel, place, height) == level(panel, 1.0 + number)
    assert code(panel, 0.01, 1.5) == BLANK
    assert f"azimuth {242 if opposite else 62}°" in panel.x.label
    assert "4 beams of a vertical plane" in figure.words


def test_the_cycle_and_the_plane_with_most_signals_are_drawn():
    product = scan([20.0, 80.0])
    product["residual"][0, :4] = np.nan
    product["residual"][:, 4:, 20:] = np.nan
    figure = drawn(product)
    assert figure.caption == "Range-height scan (RHI) at 2026-03-01 00:10:00 UTC"
    (panel,) = figure.panels
    assert "azimuth 20°" in panel.x.label
    assert code(panel, 1.0 / np.tan(np.radians(20.0)), 1.0) == level(panel, 2)


def test_the_map_of_a_volume_has_each_signal_toward_its_azimuth():
    azimuths = [10.0, 55.0, 100.0, 145.0]
    figure = drawn(scan(azimuths))
    (panel,) = figure.panels
    assert "elevation of 10 degrees" in figure.words
    assert panel.to_scale
    for number, azimuth in enumerate(azimuths):
        east, north = 8.0 * np.sin(np.radians(azimuth)), 8.0 * np.cos(np.radians(azimuth))
        assert code(panel, east, north) == level(panel, 4 * number + 1)
    assert code(panel, 0.01, -8.0) == BLANK


def test_a_blocked_beam_is_marked_where_it_ends():
    product = scan([20.0])
    product["beam_obstruction"] = ("time", "beam"), np.full((2, 4), np.nan)
    product["beam_obstruction"][:, 1] = 2000.0
    product["residual"][:, 1, 7:] = np.nan
    figure = drawn(product)
    assert "1 beam blocked, from 2000 m" in figure.words
    (panel,) = figure.panels
    _, cross = panel.layers
    place = 2.0 * np.cos(np.radians(20.0)), 2.0 * np.sin(np.radians(20.0))
    np.testing.assert_allclose([cross.x[0], cross.y[0]], place)


def test_scans_without_azimuth_or_signal_have_no_image():
    product = scan([62.0])
    assert read_scan(product.drop_vars("beam_azimuth"), 240) is None
    product["residual"][:] = np.nan
    assert read_scan(product, 240) is None


def test_few_far_outliers_do_not_set_the_colours():
    product = scan([62.0])
    product["beam_signal"][:, 0, -1] = 1e9
    assert drawn(product).panels[0].bar.high < 10.0
