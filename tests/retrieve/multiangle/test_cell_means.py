"""Means over altitude cells: against quadrature of a known atmosphere, and their noise."""

from __future__ import annotations

import numpy as np
import pytest
from support.cases import each

from lidarops.flags import Quality
from lidarops.retrieve.multiangle import slant_paths
from lidarops.retrieve.multiangle._cell_means import at_centres, average_over_cells
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

BIN = 7.5
RANGE = BIN * (np.arange(1600) + 0.5)
EDGES = 310.0 + 60.0 * np.arange(36)
ANGLES = (0.0, 20.0, 50.0, 75.0, 80.0)


def height_of(range_, angle):
    """Return the height at a range, from the triangle with the centre of the Earth."""
    slanted = range_ * np.cos(np.radians(angle))
    earth = slant_paths.EFFECTIVE_RADIUS
    sphere = np.sqrt(earth**2 + range_**2 + 2 * earth * slanted) - earth
    return slanted if angle <= THRESHOLDS.spherical_beyond else sphere


def edges_of(angle):
    return slant_paths.slant_path(np.array([angle]), EDGES)[0] * EDGES


def scattering(height):
    return np.exp(-height / 1500.0) * (1.0 + 0.5 * np.exp(-0.5 * ((height - 1500.0) / 80.0) ** 2))


def of_bins(angle, function):
    """Return means over bins, by quadrature."""
    fine = RANGE[:, np.newaxis] + BIN * ((np.arange(20) + 0.5) / 20.0 - 0.5)
    return function(height_of(fine, angle)).mean(axis=1)


def cells(signal, angle, *, variance=None, quality=None):
    rows = np.atleast_2d(signal)
    noise = np.zeros_like(rows) if variance is None else np.broadcast_to(variance, rows.shape)
    bits = np.zeros(rows.shape, np.int32) if quality is None else np.atleast_2d(quality)
    return average_over_cells(rows, noise, bits, np.ones(RANGE.size), RANGE, edges_of(angle))


@each("angle", ANGLES)
def test_all_beams_average_the_same_air(angle):
    means = cells(of_bins(angle, scattering), angle).signal[0]
    fine = EDGES[:-1, np.newaxis] + 60.0 * (np.arange(200) + 0.5) / 200.0
    reached = edges_of(angle)[1:] <= RANGE[-1] + 0.5 * BIN
    assert reached.sum() >= 25
    np.testing.assert_array_equal(np.isfinite(means), reached)
    np.testing.assert_allclose(
        means[reached], scattering(fine).mean(axis=1)[reached], rtol=1e-3 if angle else 3e-4
    )


def test_cells_of_whole_bins_are_plain_means():
    signal = np.random.default_rng(1).normal(1.0, 0.3, (3, RANGE.size))
    edges = BIN * np.array([40.0, 48.0, 50.0, 51.0, 90.0])
    nothing = np.zeros_like(signal)
    bits = np.zeros(signal.shape, np.int32)
    means = average_over_cells(signal, nothing, bits, np.ones(RANGE.size), RANGE, edges)
    expected = [
        signal[:, low:high].mean(axis=1) for low, high in ((40, 48), (48, 50), (50, 51), (51, 90))
    ]
    np.testing.assert_allclose(means.signal, np.stack(expected, axis=1), rtol=1e-12)


@pytest.mark.parametrize("width", [5.0, 15.0, 60.0])
def test_signals_that_are_linear_in_range_are_exact(width):
    """Also in cells narrower than a bin, at any place of their edges."""
    edges = 400.0 + 1.7 + width * np.arange(20)
    signal = (5.0 - RANGE / 4000.0)[np.newaxis]
    means = average_over_cells(
        signal,
        np.zeros_like(signal),
        np.zeros(signal.shape, np.int32),
        np.ones(RANGE.size),
        RANGE,
        edges,
    )
    middles = 0.5 * (edges[:-1] + edges[1:])
    np.testing.assert_allclose(means.signal[0], 5.0 - middles / 4000.0, rtol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 75.0])
def test_noise_of_means_is_as_stated_and_without_bias(angle):
    rng = np.random.default_rng(11)
    level = np.exp(-RANGE / 3000.0)
    signal = level + level * rng.normal(size=(4000, RANGE.size))
    means = cells(signal, angle, variance=level**2)
    exact = cells(level, angle).signal[0]
    known = np.isfinite(exact)
    scatter = means.signal[:, known].std(axis=0)
    np.testing.assert_allclose(np.sqrt(means.variance[0, known]), scatter, rtol=0.05)
    bias = (means.signal[:, known].mean(axis=0) - exact[known]) / scatter
    assert np.all(np.abs(bias) < 4.5 / np.sqrt(4000))
    bins = np.diff(edges_of(angle))[known] / BIN
    np.testing.assert_allclose(means.variance[0, known] * bins, level_in(angle)[known], rtol=0.15)


def level_in(angle):
    middles = 0.5 * (edges_of(angle)[:-1] + edges_of(angle)[1:])
    return np.exp(-2.0 * middles / 3000.0)


def test_the_response_to_the_background_is_the_mean_gain():
    gain = RANGE**2 / np.clip(RANGE / 800.0, 0.0, 1.0)
    rows = np.stack([np.zeros(RANGE.size), np.ones(RANGE.size)])
    nothing, bits = np.zeros_like(rows), np.zeros(rows.shape, np.int32)
    means = average_over_cells(rows, nothing, bits, gain, RANGE, EDGES)
    np.testing.assert_allclose(means.signal[1] - means.signal[0], means.response, rtol=1e-12)
    middles = 0.5 * (EDGES[:-1] + EDGES[1:])
    far = middles > 900.0
    # The mean of the square of range over a cell.
    np.testing.assert_allclose(means.response[far], (middles**2 + 300.0)[far], rtol=1e-5)


def test_missing_bins_and_flags_affect_their_cells_only():
    signal, bits = np.ones(RANGE.size), np.zeros(RANGE.size, np.int32)
    signal[100], bits[100], bits[200] = np.nan, Quality.SATURATED, Quality.PILE_UP
    means = cells(signal, 0.0, quality=bits)
    (lost,) = np.flatnonzero(np.isnan(means.signal[0]))
    assert EDGES[lost] <= RANGE[100] < EDGES[lost + 1]
    assert means.quality[0, lost] == Quality.SATURATED
    raised = np.flatnonzero(means.quality[0] == Quality.PILE_UP)
    assert any(EDGES[k] <= RANGE[200] < EDGES[k + 1] for k in raised)
    # The slope within a bin is that of its neighbours.
    assert all(EDGES[k] - BIN <= RANGE[200] < EDGES[k + 1] + BIN for k in raised)


def test_cells_beyond_the_bins_are_missing_input():
    means = cells(np.ones(RANGE.size), 80.0)
    beyond = edges_of(80.0)[1:] > RANGE[-1] + 0.5 * BIN
    assert beyond.any()
    np.testing.assert_array_equal(np.isnan(means.signal[0]), beyond)
    np.testing.assert_array_equal(means.quality[0] == Quality.INPUT_MISSING, beyond)


@pytest.mark.parametrize("rise", [-0.03, -1e-3, 0.0, 0.02])
def test_exponentials_are_exact_at_the_centres(rise):
    """Means over 60 m of signals that fall or rise by up to a factor of 6 in a cell."""
    lower = EDGES[:-1]
    mean = (
        (np.exp(rise * (lower + 60.0)) - np.exp(rise * lower)) / (60.0 * rise)
        if rise
        else np.ones(35)
    )
    values, variance = at_centres(mean, mean**2)
    np.testing.assert_allclose(values, np.exp(rise * (lower + 30.0)), rtol=1e-9)
    np.testing.assert_allclose(variance, values**2, rtol=1e-9)


def test_centres_beside_missing_or_negative_cells_keep_their_means():
    signal = np.array([1.0, np.nan, 2.0, -1.0, 3.0])
    values, _ = at_centres(signal, np.ones(5))
    np.testing.assert_array_equal(values, signal)
