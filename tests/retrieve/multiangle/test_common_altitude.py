"""Interpolation to common altitudes: against a known atmosphere, and its noise in simulations."""

from __future__ import annotations

import numpy as np
import pytest

from lidarops.retrieve.multiangle import slant_paths
from lidarops.retrieve.multiangle._common_altitude import along_beam
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

RANGE = 7.5 * np.arange(1, 1500)
ALTITUDE = np.arange(310.0, 2500.0, 30.0)
ANGLES = (0.0, 20.0, 50.0, 75.0, 80.0)


def layer(height):
    return 0.08 * np.exp(-0.5 * ((height - 1500.0) / 50.0) ** 2) - height / 2000.0


def height_of(range_, angle):
    """Return the height at a range, from the triangle with the centre of the Earth."""
    slanted = range_ * np.cos(np.radians(angle))
    earth = slant_paths.EARTH_RADIUS
    sphere = np.sqrt(earth**2 + range_**2 + 2 * earth * slanted) - earth
    return slanted if angle <= THRESHOLDS.spherical_beyond else sphere


@pytest.mark.parametrize("angle", ANGLES)
def test_layer_is_reproduced(angle):
    signal = np.exp(layer(height_of(RANGE, angle)))
    target = slant_paths.slant_path(np.array([angle]), ALTITUDE)[0] * ALTITUDE
    values, _ = along_beam(signal, 1e-8 * signal**2, RANGE, target)
    error = np.abs(np.log(values) - layer(ALTITUDE))
    assert np.nanmax(error) < 3e-6
    np.testing.assert_array_equal(np.isfinite(values), RANGE[-1] >= target)


@pytest.mark.parametrize("ratio", [3.0, 200.0])
def test_noise_is_propagated_without_bias(ratio):
    rng = np.random.default_rng(11)
    mean = np.exp(-RANGE[:300] / 3000.0)
    signal = mean + mean / ratio * rng.normal(size=(8000, 300))
    target = np.array([1001.0, 1003.75, 1499.0])
    noise = np.broadcast_to((mean / ratio) ** 2, signal.shape)
    values, variance = along_beam(signal, noise, RANGE[:300], target)
    scatter = values.std(axis=0)
    assert np.sqrt(variance.mean(axis=0)) == pytest.approx(scatter, rel=0.04)
    bias = (values.mean(axis=0) - np.exp(-target / 3000.0)) / scatter
    assert np.all(np.abs(bias) < 4.5 / np.sqrt(8000))


def test_missing_bins_affect_their_neighbours_only():
    signal = np.exp(layer(RANGE))
    signal[100] = np.nan
    noise = np.full(signal.shape, 1e-8)
    values, _ = along_beam(signal, noise, RANGE, RANGE[95:107] + 2.5)
    assert (np.flatnonzero(np.isnan(values)) + 95).tolist() == [99, 100]
    on_the_bins, _ = along_beam(signal, noise, RANGE, RANGE[95:107])
    assert (np.flatnonzero(np.isnan(on_the_bins)) + 95).tolist() == [100]
    assert on_the_bins[0] == pytest.approx(signal[95], rel=1e-14)
    assert np.isnan(along_beam(np.full_like(signal, np.nan), noise, RANGE, RANGE)[0]).all()


def test_noise_around_zero_is_kept():
    """Between two bins, because the farther ones are missing."""
    signal = np.full(RANGE.size, np.nan)
    signal[[132, 133]] = 3.0, -1.0
    values, variance = along_beam(signal, np.full(signal.shape, 100.0), RANGE, np.array([1001.25]))
    assert values[0] == pytest.approx(1.0, rel=1e-9)
    assert variance[0] == pytest.approx(50.0, rel=1e-9)
