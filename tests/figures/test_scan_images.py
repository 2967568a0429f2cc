"""Images of scans show the signal of each beam where it was measured."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from support.products.drawn import figures, pixels

from lidarops.figures.kind_figures import ProductSource
from lidarops.figures.panels import BLANK, codes_of
from lidarops.products.multiangle.scan_images import read_scan_image

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
    return figures("multiangle", "scan-image", [product])


def level(panel, signal):
    """Return the pixel of a signal."""
    low, high = np.log([panel.bar.low, panel.bar.high])
    return int(codes_of(np.array([(np.log(signal) - low) / (high - low)]))[0])


def pixel(panel, x, y):
    """Return the pixel at a place, km."""
    shown = pixels(panel)
    rows, columns = shown.shape
    column = int((x - panel.x.low) / (panel.x.high - panel.x.low) * columns)
    row = int((panel.y.high - y) / (panel.y.high - panel.y.low) * rows)
    return int(shown[row, column])


@pytest.mark.parametrize("opposite", [False, True])
def test_a_range_height_image_has_each_signal_along_its_beam(opposite):
    (figure,) = drawn(scan([62.0], opposite=opposite))
    (panel,) = figure.panels
    for number, elevation in enumerate(ELEVATIONS):
        # The lowest beam states the azimuth of the plane.
        side = -1.0 if opposite and number % 2 else 1.0
        for height in (0.55, 1.55, 2.55):
            place = side * height / np.tan(np.radians(elevation))
            assert pixel(panel, place, height) == level(panel, 1.0 + number)
    assert pixel(panel, 0.0, 2.0) == BLANK
    assert f"azimuth {242 if opposite else 62}°" in panel.x.label


def test_each_plane_is_drawn_from_the_cycle_with_most_of_its_signals():
    product = scan([20.0, 80.0])
    product["residual"][0, :4] = np.nan
    product["residual"][1, 4:] = np.nan
    (figure,) = drawn(product)
    assert [panel.title for panel in figure.panels] == [
        "2026-03-01 00:10:00 UTC",
        "2026-03-01 00:00:00 UTC",
    ]
    for number, panel in enumerate(figure.panels):
        assert pixel(panel, 1.0 / np.tan(np.radians(20.0)), 1.0) == level(panel, 4 * number + 2)


def test_the_map_of_a_volume_has_each_signal_toward_its_azimuth():
    azimuths = [10.0, 55.0, 100.0, 145.0]
    _, figure = drawn(scan(azimuths))
    (panel,) = figure.panels
    assert "elevation of 10 degrees" in figure.words
    for number, azimuth in enumerate(azimuths):
        east, north = 8.0 * np.sin(np.radians(azimuth)), 8.0 * np.cos(np.radians(azimuth))
        assert pixel(panel, east, north) == level(panel, 4 * number + 1)
    assert pixel(panel, -2.0, 0.0) == BLANK


def test_the_map_holds_the_whole_sector_of_each_beam():
    """The first one is 25 degree wide, so that it goes on beyond the tip of its beam."""
    _, figure = drawn(scan([37.0, 62.0, 87.0, 112.0, 137.0, 162.0]))
    (panel,) = figure.panels
    far = 3.0 / np.tan(np.radians(10.0))
    assert panel.y.high == pytest.approx(far * np.cos(np.radians(37.0 - 12.5)), rel=0.02)


def test_a_blocked_beam_is_marked_where_it_ends():
    """One beam of a plane; another plane consists of a blocked beam only, and has no panel."""
    product = scan([20.0, 80.0])
    product["beam_obstruction"] = ("time", "beam"), np.full((2, 8), np.nan)
    product["beam_obstruction"][:, 1] = 2000.0
    product["residual"][:, 1, 7:] = np.nan
    product["beam_obstruction"][1, 4] = 60.0
    product["residual"][:, 4:] = np.nan
    (figure,) = drawn(product)
    assert "1 vertical plane of 1; " in figure.words
    assert "1 beam blocked, from 2000 m" in figure.words
    assert "1 more, blocked where the beams begin" in figure.words
    (panel,) = figure.panels
    distance, elevation = 2.0, np.radians(20.0)
    line, cross = panel.layers[1:]
    place = distance * np.cos(elevation), distance * np.sin(elevation)
    np.testing.assert_allclose([cross.x[0], cross.y[0]], place)
    np.testing.assert_allclose([line.x[0], line.y[0]], place)
    # Behind, the line goes on along the beam to the edge of the panel.
    assert line.y[1] / line.x[1] == pytest.approx(np.tan(elevation))
    assert np.isclose(line.x[1], panel.x.high) or np.isclose(line.y[1], panel.y.high)


def test_scans_without_azimuth_or_signal_have_no_image():
    product = scan([62.0])
    assert read_scan_image(product.drop_vars("beam_azimuth"), ProductSource()) is None
    product["residual"][:] = np.nan
    assert read_scan_image(product, ProductSource()) is None


def test_few_far_outliers_do_not_set_the_colours():
    product = scan([62.0])
    product["beam_signal"][:, 0, -1] = 1e9
    (figure,) = drawn(product)
    assert figure.panels[0].bar.high < 10.0
