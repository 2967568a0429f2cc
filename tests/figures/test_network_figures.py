"""Figures of networks show the values of the product."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray as xr
from support.products.drawn import assert_same_series, figures, labelled, views
from support.products.made_network import product

from lidarops.errors import ProductError
from lidarops.figures.panels import Curve, Words
from lidarops.figures.series_data import join
from lidarops.flags import Quality
from lidarops.products.visibility.figures import instruments_of, read_crossings, read_map
from lidarops.products.visibility.retrieval import NetworkSettings
from lidarops.records import LeftOut, Plan, PlannedStep

NAMES = ("lidar-0", "lidar-1", "lidar-2")


@pytest.fixture(scope="module")
def made() -> xr.Dataset:
    return product(intervals=12)


def test_series_hold_values_and_errors(made):
    series = read_crossings(made)
    assert [crossing.label for crossing in series] == ["crossing 0", "crossing 1", "crossing 2"]
    for v, crossing in enumerate(series):
        np.testing.assert_array_equal(
            crossing.quantities["total_extinction"], made["total_extinction"].values[:, v]
        )
        whole = np.hypot(
            made["total_extinction_standard_error"], made["total_extinction_systematic_error"]
        ).values[:, v]
        np.testing.assert_allclose(crossing.quantities["total_extinction_standard_error"], whole)


def test_scenes_are_joined_in_time(made):
    halves = [made.isel(time=slice(6, 12)), made.isel(time=slice(6))]
    joined = join(crossing for half in halves for crossing in read_crossings(half))
    whole = read_crossings(made)
    assert [crossing.key for crossing in joined] == [(0,), (1,), (2,)]
    for crossing, expected in zip(joined, whole, strict=True):
        assert_same_series(crossing, expected)


def test_the_map_shows_each_crossing_to_scale(made):
    network = read_map(made)
    (figure,) = figures("visibility", "network", [made])
    (panel,) = figure.panels
    (words,) = (layer for layer in panel.layers if isinstance(layer, Words))
    medians = np.median(made["visibility_in_air"].values, axis=0) / 1e3
    assert words.texts == tuple(f"{v}: {value:.3g} km" for v, value in enumerate(medians))
    np.testing.assert_array_equal([words.x, words.y], network.crossings.T)
    stations = np.concatenate([[*m.x, *m.y] for m in labelled(panel, "beam")])
    np.testing.assert_array_equal(stations, network.stations.ravel())
    lines = [layer for layer in panel.layers if isinstance(layer, Curve) and layer.joined]
    for line, start, end in zip(lines, network.stations, network.ends, strict=True):
        np.testing.assert_array_equal([line.x[:2], line.y[:2]], np.transpose([start, end]))
    assert panel.to_scale
    assert f"0: {medians[0]:.3g} km" in figure.words
    # The first beam points to the north-east of its lidar.
    assert network.axes[0].startswith("east")
    np.testing.assert_allclose(
        np.hypot(*(network.crossings[2] - network.stations[0])), 1.588, atol=0.01
    )


def test_a_crossing_without_a_value_is_labelled(made):
    lost = made.copy(deep=True)
    lost["quality_flag"][:, 1] = int(Quality.LOW_SIGNAL)
    ((panel,),) = (figure.panels for figure in figures("visibility", "network", [lost]))
    (words,) = (layer for layer in panel.layers if isinstance(layer, Words))
    assert words.texts[1] == "1: no value"
    (hollow,) = labelled(panel, "crossing without a usable value")
    assert hollow.x.size == 1


def test_beams_in_a_vertical_plane_are_drawn_upright(made):
    plane = made.copy(deep=True)
    plane = plane.assign_coords(
        beam_latitude=("beam", np.full(3, 47.25)),
        beam_longitude=("beam", [11.3, 11.3265, 11.353]),
        beam_azimuth=("beam", np.full(3, 90.0)),
        beam_zenith_angle=("beam", [45.0, 30.0, 20.0]),
        latitude=("crossing", np.full(3, 47.25)),
        longitude=("crossing", [11.32, 11.33, 11.34]),
        altitude=("crossing", [1500.0, 2000.0, 2500.0]),
    )
    network = read_map(plane)
    assert network.axes == ("east of the first lidar (km)", "above the first lidar (km)")
    np.testing.assert_allclose(network.crossings[:, 1], [0.9, 1.4, 1.9], atol=0.01)


def test_series_are_drawn(made):
    series = read_crossings(made)
    view = views("visibility")["visibility"]
    (figure,) = view.draw([series])
    for panel, quantity, scale in zip(
        figure.panels, ("visibility", "total_extinction"), (1.0, 1e3), strict=True
    ):
        for line, crossing in zip(labelled(panel, "crossing"), series, strict=True):
            np.testing.assert_allclose(line.y, scale * crossing.quantities[quantity], rtol=1e-6)
        assert "km" in panel.y.label


def test_a_foreign_product_is_refused(made):
    with pytest.raises(ProductError, match="crossing_id"):
        read_crossings(made.drop_vars("crossing_id"))


def test_instruments_are_those_of_the_plan(made):
    beam = {"zenith_angle": 90, "azimuth": 0, "nearest": 100, "farthest": 5000, "exponent": 1}
    settings = NetworkSettings(
        beams=[{**beam, "instrument": name} for name in NAMES],
        wavelength=532e-9,
        block_seconds=3600,
        prior="block",
        tolerance=15,
        smallest_angle=2,
        exponent_relative_error=0.1,
        lidar_ratio_relative_error=0.02,
        overlap_relative_error=0.003,
        contrast=0.05,
        law="none",
        exponent_standard_error=0,
    ).model_dump(mode="json", exclude_none=True)
    step = PlannedStep("visibility", "photon_532o", settings, "why", product="visibility")
    assert instruments_of(planned(made, Plan("s", (step,), ()))) == NAMES
    none = Plan("s", (), (LeftOut("visibility", "photon_532o", "why"),))
    numbered = ("beam 0", "beam 1", "beam 2")
    assert instruments_of(planned(made, none)) == instruments_of(made) == numbered


def planned(made: xr.Dataset, plan: Plan) -> xr.Dataset:
    """Return a product with a plan in its provenance."""
    document = {"entity": {"lidarops:plan": {"lidarops:json": plan.text}}}
    return made.assign(provenance=((), json.dumps(document)))
