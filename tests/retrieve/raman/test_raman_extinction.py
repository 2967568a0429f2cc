"""Extinction from the slope of a Raman signal: exactness, resolution, comparison with lines."""

from __future__ import annotations

import numpy as np
import pytest
from support.raman_signals import make_sky, mean_over, sliding_line

from lidarops.retrieve.raman.depth_fit import SignalNoise, extinction_of, fit_depth, mean_weights
from lidarops.retrieve.raman.signals import cell_signals

STEP = 30.0
R = STEP * (np.arange(400) + 0.5)
HAZE = 1.5e-4 * np.exp(-R / 1500.0) + 8e-5 * np.exp(-0.5 * ((R - 2500.0) / 300.0) ** 2)


def solved(extinction, light, counts=None, **of_sky):
    """Return the extinction of one profile of cells of one bin, and the bins of full overlap."""
    sky = make_sky(extinction, STEP, light, cell=STEP, **of_sky)
    signal = sky.signal((sky.raman if counts is None else counts)[np.newaxis])
    (cells,) = cell_signals(signal, sky.air.raman_shape, sky.cells)
    full = sky.quality[0] == 0
    noise = SignalNoise(cells.noise.per_signal, np.where(full, cells.noise.fixed, np.inf))
    fit = fit_depth(cells.value, noise)
    return extinction_of(fit, STEP, sky.ratio), full, sky


@pytest.mark.parametrize("light", [1e4, 1e10])
def test_constant_extinction_without_noise_is_exact(light):
    found, full, _ = solved(np.full(R.size, 1e-4), light)
    np.testing.assert_allclose(found.value[full], 1e-4, rtol=1e-6)


def test_extinction_without_noise_is_the_true_one_at_the_stated_resolution():
    found, full, _ = solved(HAZE, 1e7)
    np.testing.assert_allclose(found.value[full], (found.kernel @ HAZE)[full], rtol=1e-6)
    np.testing.assert_allclose(found.kernel.sum(axis=1), 1.0, atol=1e-9)


def test_resolution_follows_the_signal():
    coarse, _, _ = solved(HAZE, 1e3)
    fine, _, _ = solved(HAZE, 1e7)
    near, far = np.searchsorted(R, [1000.0, 6000.0])
    assert fine.vertical_resolution[near] < 0.5 * coarse.vertical_resolution[near]
    assert fine.vertical_resolution[near] < 0.5 * fine.vertical_resolution[far]
    # Lines of that length through the logarithm have about the noise of the value.
    length = 2 * round(fine.vertical_resolution[near] / STEP) + 1
    counts = make_sky(HAZE, STEP, 1e7, cell=STEP).raman[near]
    line = np.sqrt(12.0 / (counts * length**3)) / STEP / 1.9
    assert 0.3 < fine.noise_error[near] / line < 3.0


def test_noise_error_is_the_scatter_of_profiles():
    rng = np.random.default_rng(3)
    sky = make_sky(HAZE, STEP, 3e3, cell=STEP)
    found = [solved(HAZE, 3e3, rng.poisson(sky.raman).astype(float)) for _ in range(40)]
    away = [(one.value - one.kernel @ HAZE) / one.noise_error for one, _, _ in found]
    scatter = np.sqrt(np.mean(np.square(away)[:, 12:250]))
    assert 0.9 < scatter < 1.1


def test_lines_agree_with_the_smooth_solution_where_there_is_much_light():
    sky = make_sky(HAZE, STEP, 1e8, cell=STEP)
    (cells,) = cell_signals(sky.signal(sky.raman[np.newaxis]), sky.air.raman_shape, sky.cells)
    value, error = sliding_line(cells.value, cells.variance, STEP, sky.ratio, 5)
    inside = slice(12, 250)
    np.testing.assert_allclose(value[inside], HAZE[inside], rtol=0.02)
    assert np.all(error[inside] > 0.0)
    assert np.isnan(value[:2]).all()


def test_weights_of_means_are_those_of_the_cells_that_overlap():
    weights = mean_weights(np.array([10.0, 20.0, 30.0, 10.0]), 10.0)
    np.testing.assert_allclose(weights[0], [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(weights[1], [0.25, 0.5, 0.25, 0.0])
    np.testing.assert_allclose(weights[2], [0.0, 1 / 3, 1 / 3, 1 / 3])
    # Where the signal shows no extinction before the second cell.
    weights = mean_weights(np.full(4, 20.0), 10.0, 1)
    np.testing.assert_allclose(weights[1], [0.0, 0.5, 0.5, 0.0])
    np.testing.assert_allclose(weights[2], [0.0, 0.25, 0.5, 0.25])


def test_extinction_next_to_partial_overlap_is_that_of_the_air_beyond():
    """Of random walks, values differ from means that begin there by the stated error."""
    rng = np.random.default_rng(6)
    found, full, _ = solved(HAZE, 300.0, full_overlap=2000.0)
    first = int(np.argmax(full))
    assert found.vertical_resolution[first] > 500.0
    walks = np.cumsum(rng.normal(size=(1000, R.size)), axis=1)
    there = slice(first, first + 10)
    mean = [
        mean_over(walk, STEP, R[there], found.vertical_resolution[there], STEP * first)
        for walk in walks
    ]
    scatter = np.std(walks @ found.kernel[there].T - mean, axis=0)
    stated = found.resolution_error[there]
    np.testing.assert_allclose(scatter / scatter[-1], stated / stated[-1], rtol=0.1)


@pytest.mark.parametrize("light", [3.0, 300.0])
def test_errors_do_not_depend_on_the_number_of_cells(light):
    bins = 7.5 * (np.arange(2000) + 0.5)
    layer = np.where(bins < 3500.0, 1e-4, 1e-6)
    counts = np.random.default_rng(1).poisson(make_sky(layer, 7.5, light).raman).astype(float)
    at = np.arange(600.0, 5000.0, 60.0)
    errors, depths = [], []
    for length in (60.0, 7.5):
        sky = make_sky(layer, 7.5, light, cell=length)
        (cells,) = cell_signals(sky.signal(counts[np.newaxis]), sky.air.raman_shape, sky.cells)
        fixed = np.where(sky.quality[0] == 0, cells.noise.fixed, np.inf)
        fit = fit_depth(cells.value, SignalNoise(cells.noise.per_signal, fixed))
        depths.append(np.interp(at, sky.cells.range, fit.depth))
        errors.append(np.interp(at, sky.cells.range, fit.standard_error))
    np.testing.assert_allclose(errors[1], errors[0], rtol=0.15)
    np.testing.assert_allclose(depths[1], depths[0], atol=errors[0].max())


def test_no_signal_gives_no_fit():
    fixed = np.ones(50)
    assert fit_depth(np.full(50, -1.0), SignalNoise(np.zeros(50), fixed)) is None
    few = np.where(np.arange(50) < 5, 1.0, np.inf)
    assert fit_depth(np.ones(50), SignalNoise(np.zeros(50), few)) is None
