"""Range cells of the truth of a simulation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarops.simulate.truth import cell_stops


@given(
    bins=st.integers(1, 20_000),
    bin_width=st.sampled_from([0.75, 3.75, 7.5, 15.0, 29.0, 37.5, 60.0]),
    cells=st.none() | st.integers(1, 2048),
)
def test_cells_fill_the_range_and_none_is_empty(bins, bin_width, cells):
    stops = cell_stops(bins, bin_width, cells)
    assert stops[0] == 0
    assert stops[-1] == bins
    assert np.all(np.diff(stops) > 0)
    if cells is not None:
        assert stops.size - 1 == min(cells, bins)


@pytest.mark.parametrize("bins", [399, 1600, 2400, 8000, 16380])
@pytest.mark.parametrize("bin_width", [3.75, 7.5, 15.0])
def test_steps_near_the_lidar_do_not_grow_with_the_number_of_bins(bins, bin_width):
    stops = cell_stops(bins, bin_width, None)
    width = np.diff(stops) * bin_width
    near = stops[1:] * bin_width <= 12_000.0
    # Only the last cell of a short range may be cut.
    assert np.all(width[near][:-1] == 30.0)
    assert stops.size - 1 <= 400 + 64


def test_an_optical_depth_between_cells_is_right_below_800_m():
    """Haze with a scale height of 150 m: linear interpolation of the depth within cells."""
    edges = cell_stops(8000, 7.5, None) * 7.5
    depth = 0.05 * -np.expm1(-edges / 150.0)
    height = np.linspace(0.0, 800.0, 1601)
    error = np.interp(height, edges, depth) - 0.05 * -np.expm1(-height / 150.0)
    assert np.abs(error).max() < 3e-4


def test_no_cells_on_request():
    assert cell_stops(2400, 7.5, 0).size == 1
