"""Errors of Raman products in simulated profiles, and the bias of ratios of few counts."""

from __future__ import annotations

import numpy as np
import pytest
from support.raman_signals import make_sky, mean_over

from lidarops.flags import Quality, rejecting
from lidarops.retrieve.raman.backscatter import (
    Backscatter,
    Ratio,
    calibrated_backscatter,
    inverse_mean,
    inverse_of_weak,
)
from lidarops.retrieve.raman.depth_fit import Extinction, SignalNoise
from lidarops.retrieve.raman.flags import RamanQuality
from lidarops.retrieve.raman.retrieval import lidar_ratio_of, retrieve_raman

STEP = 30.0
R = STEP * (np.arange(400) + 0.5)
HAZE = 1.5e-4 * np.exp(-R / 1500.0) / (1.0 + np.exp((R - 4500.0) / 400.0))
LEVELS = (30.0, 300.0, 5000.0)
"""Counts of a Raman bin at 1 km."""


def retrieved(light, profiles, seed, lidar_ratio=50.0):
    """Return a sky of haze, and the result of noisy profiles of it."""
    sky = make_sky(HAZE, STEP, light, lidar_ratio=lidar_ratio)
    rng = np.random.default_rng(seed)
    signals, quality = sky.drawn(rng, profiles), np.repeat(sky.quality, profiles, axis=0)
    return sky, retrieve_raman(*signals, sky.air, sky.cells, sky.settings, quality=quality)


def deviations(sky, found):
    """Return deviations over stated errors of extinction and backscatter that are not rejected."""
    usable = (found.quality & rejecting((*RamanQuality, *Quality))) == 0
    inside = usable & (sky.cells.range < 6000.0)
    length = np.where(np.isnan(found.vertical_resolution), 60.0, found.vertical_resolution)
    true = mean_over(HAZE, STEP, sky.cells.range, length, 300.0)
    of_extinction = (found.extinction - true) / found.extinction_standard_error
    of_backscatter = found.backscatter - sky.cells.mean(sky.backscatter)
    of_backscatter /= found.backscatter_standard_error
    return [z[inside & np.isfinite(z)] for z in (of_extinction, of_backscatter)]


def covered(z):
    return np.mean(np.abs(z) < 1.96)


def test_intervals_cover_the_truth():
    for z in deviations(*retrieved(300.0, 25, seed=1)):
        assert 0.92 < covered(z) < 0.98
        assert np.mean(np.abs(z) > 4.0) <= 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("light", LEVELS)
def test_intervals_of_1000_profiles_cover_the_truth(light):
    sky, found = retrieved(light, 1000, seed=1)
    # Falsely negative: 1 of 3,000 profiles.
    negative = (found.quality & RamanQuality.NEGATIVE_EXTINCTION) != 0
    assert negative.any(axis=1).sum() == {30.0: 0, 300.0: 1, 5000.0: 0}[light]
    # Values of a profile share an error: those of backscatter of 2 profiles cover nothing.
    both = deviations(sky, found)[: 1 if light == 30.0 else 2]
    # As the page tells.
    shares = {30.0: (0.955,), 300.0: (0.957, 0.951), 5000.0: (0.959, 0.945)}[light]
    assert [covered(z) for z in both] == pytest.approx(shares, abs=6e-4)
    far = max(np.mean(np.abs(z) > 4.0) for z in both)
    assert far == pytest.approx({30.0: 1e-5, 300.0: 6e-4, 5000.0: 1e-4}[light], abs=6e-5)


@pytest.mark.parametrize("mean", [0.3, 1.0, 3.0, 10.0, 30.0])
def test_ratio_to_a_smooth_signal_has_no_bias(mean):
    # The denominator is known from 20 bins, as the smooth Raman signal is.
    rng = np.random.default_rng(7)
    counts, smooth = rng.poisson(mean, 400_000), rng.poisson(20.0 * mean, 400_000)
    seen = smooth > 0
    inverse = np.zeros(counts.size)
    inverse[seen] = inverse_mean(smooth[seen] / 20.0, 1.0 / smooth[seen])
    ratio = counts * inverse
    assert abs(ratio.mean() - 1.0) < 0.05 * ratio.std()


def test_backscatter_of_few_counts_has_no_bias():
    # Quotients of cells would be too large by a third at 3 counts a cell.
    sky = make_sky(HAZE, STEP, 60.0, cell=STEP, window=(7000.0, 12_000.0, 4000.0))
    rng = np.random.default_rng(5)
    rows = 40
    raman = sky.signal(rng.poisson(sky.raman, (rows, R.size)).astype(float))
    elastic = sky.signal(np.repeat(sky.elastic[np.newaxis], rows, axis=0))
    quality = np.repeat(sky.quality, rows, axis=0)
    found = retrieve_raman(raman, elastic, sky.air, sky.cells, sky.settings, quality=quality)
    inside = (sky.cells.range > 1000.0) & (sky.cells.range < 4000.0)
    away = (found.backscatter - sky.cells.mean(sky.backscatter))[:, inside]
    spread = np.nanstd(away, axis=0)
    assert np.all(np.abs(np.nanmean(away, axis=0)) < 4.0 * spread / np.sqrt(rows))


def test_backscatter_from_a_reference_of_few_counts_has_no_bias():
    # 30 counts of the window, and a Raman level there of 60 counts. The quotient of means is too
    # large by the variance of the level, 5 %.
    rng = np.random.default_rng(11)
    truth = np.where(np.arange(30) < 10, 2.0, 1.0)
    window = truth == 1.0
    light = np.where(window, 1.5, 100.0)
    noise = SignalNoise(1.0 / light, np.zeros(30))
    levels = rng.poisson(60.0, 4000) / 60.0
    response = np.where(window, -1.0 / np.sqrt(60.0), 0.0)[:, np.newaxis]
    total = []
    for level, counts in zip(levels, rng.poisson(truth * light, (4000, 30)), strict=True):
        factor = np.where(window, inverse_mean(level, 1.0 / 60.0), 1.0)
        signal = counts / light
        ratio = Ratio(signal * factor, factor**2 * truth / light, np.ones(30), factor)
        total.append(
            calibrated_backscatter(ratio, noise, response, truth, window).total[:10].mean()
        )
    assert abs(np.mean(total) / 2.0 - 1.0) < 3.0 * np.std(total) / 2.0 / np.sqrt(len(total))


@pytest.mark.parametrize("errors", [1.5, 2.0, 3.0, 10.0])
def test_reciprocals_of_weak_values_have_no_bias(errors):
    # The mean over normal noise to 9 errors, by quadrature.
    error = 0.3
    values = errors * error + error * np.linspace(-9.0, 9.0, 20_001)
    density = np.exp(-0.5 * (values / error - errors) ** 2)
    inverse = inverse_of_weak(values, np.full(values.size, error))
    mean = (density * inverse).sum() / density.sum()
    assert mean == pytest.approx(1.0 / (errors * error), rel=1e-5)
    # As the page tells of another reciprocal.
    shrunk = (density * values / (values**2 + error**2)).sum() / density.sum() * errors * error
    known = {2.0: 0.73, 3.0: 0.93}
    assert shrunk == pytest.approx(known.get(errors, shrunk), abs=6e-3)


def test_errors_of_lidar_ratios_do_not_follow_their_noise():
    # Errors of the first order are too small where the value is: 0.18 % of it are beyond 4.
    rng = np.random.default_rng(12)
    cells, extinction, error = 1000, 1e-4, 1e-5
    none, unit = np.zeros(cells), np.ones(cells)
    z = []
    for _ in range(20):
        true = rng.uniform(25.0, 90.0, cells)
        scatter = extinction / true / np.exp(rng.uniform(np.log(3.0), np.log(20.0), cells))
        noisy = extinction / true + scatter * rng.normal(size=cells)
        alpha = extinction + error * rng.normal(size=cells)
        response = np.full((cells, 1), error)
        of_extinction = Extinction(alpha, np.eye(cells), unit, response, none, none)
        total = Backscatter(noisy + 5e-6, scatter, 0.0, none, none)
        found = lidar_ratio_of(of_extinction, total, noisy, 0.0 * response, [], unit > 0.0)
        z.append(((found.value - true) / found.random)[np.isfinite(found.value)])
    z = np.concatenate(z)
    assert z.size > 18_000
    assert np.mean(np.abs(z) > 4.0) < 1e-3
    assert 0.94 < covered(z) < 0.96
    assert 0.67 < np.mean(np.abs(z) < 1.0) < 0.72


def of_lidar_ratio(light, lidar_ratio, rows, seed):
    """Return the mean relative deviation of lidar ratios, and the share that 95 % intervals hold.

    Also the number of values.
    """
    _, found = retrieved(light, rows, seed, lidar_ratio)
    known = np.isfinite(found.lidar_ratio)
    away = (found.lidar_ratio - lidar_ratio)[known]
    held = np.mean(np.abs(away / found.lidar_ratio_standard_error[known]) < 1.96)
    return away.mean() / lidar_ratio, held, known.sum()


@pytest.mark.parametrize("lidar_ratio", [25.0, 50.0, 90.0])
def test_lidar_ratios_of_few_counts_have_little_bias(lidar_ratio):
    away, held, values = of_lidar_ratio(1000.0, lidar_ratio, rows=50, seed=3)
    assert values > 250
    # One error of the mean is 4 %.
    assert abs(away) < 0.1
    # Errors expect fewer lidar ratios of 90 sr.
    assert held > (0.8 if lidar_ratio > 80.0 else 0.9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("light", "lidar_ratio", "away", "held"),
    [
        (1000.0, 25.0, -0.017, 0.999), (1000.0, 50.0, -0.017, 0.991), (1000.0, 90.0, -0.081, 0.850),
        (5000.0, 25.0, 0.009, 0.991), (5000.0, 50.0, 0.006, 0.968), (5000.0, 90.0, 0.014, 0.903),
    ],
)  # fmt: skip
def test_high_lidar_ratios_of_few_counts_are_too_small_as_the_page_tells(
    light, lidar_ratio, away, held
):
    figures = of_lidar_ratio(light, lidar_ratio, rows=300, seed=4)[:2]
    assert figures == pytest.approx((away, held), abs=6e-3)
