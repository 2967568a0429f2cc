"""Reference windows of Raman products: clean air is taken, and none by its noise."""

from __future__ import annotations

import numpy as np
import pytest
from support.raman_signals import make_sky

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.raman.retrieval import retrieve_raman

STEP = 30.0
R = STEP * (np.arange(450) + 0.5)
HAZE = np.where(R < 1500.0, 1.9e-4, 0.0) + 9e-5 * np.exp(-0.5 * ((R - 3200.0) / 300.0) ** 2)
ONE, SEVERAL = (6000.0, 8000.0, 2000.0), (6000.0, 12_000.0, 2000.0)
LEVELS = [(2000.0, 16.0), (20_000.0, 150.0)]
"""Raman counts of a bin at 1 km, and elastic counts over them: of an hour of the demo campaign (440
and 4,500 from 7 to 9 km), and of 10 times as much light and a filter of the Raman channel (4,400
and 440,000)."""


def retrieved(light, brightness, window, rows, seed, extinction=HAZE):
    sky = make_sky(extinction, STEP, light, lidar_ratio=60.0, window=window, brightness=brightness)
    rng = np.random.default_rng(seed)
    signals = (
        sky.signal(rng.poisson(mean, (rows, R.size)).astype(float))
        for mean in (sky.raman, sky.elastic)
    )
    quality = np.repeat(sky.quality, rows, axis=0)
    return sky, retrieve_raman(*signals, sky.air, sky.cells, sky.settings, quality=quality)


@pytest.mark.parametrize(("light", "brightness"), LEVELS)
def test_clean_air_is_as_rarely_rejected_as_the_tests_state(light, brightness):
    # Three tests at 3 standard errors, and that of chi-square: about 1 % of clean windows.
    _, found = retrieved(light, brightness, ONE, rows=100, seed=1)
    assert np.isnan(found.reference.bottom).sum() <= 5


@pytest.mark.slow
@pytest.mark.parametrize(("light", "brightness"), LEVELS)
def test_the_choice_among_windows_leaves_no_bias(light, brightness):
    sky, found = retrieved(light, brightness, SEVERAL, rows=120, seed=2)
    near = (sky.cells.range > 400.0) & (sky.cells.range < 1300.0)
    truth = sky.cells.mean(sky.backscatter)[near]
    away = (found.backscatter[:, near] - truth).mean(axis=1)
    z = away / found.backscatter_standard_error[:, near].mean(axis=1)
    # The error of the mean is 0.09.
    assert abs(np.nanmean(z)) < 0.2
    assert 0.8 < np.sqrt(np.nanmean(z**2)) < 1.15
    assert np.nanmean(found.lidar_ratio[:, near]) == pytest.approx(60.0, rel=0.03)
    # The highest of those that are nearly as certain as the nearest one.
    assert np.mean(np.abs(found.reference.bottom - 7000.0) <= 500.0) > 0.95


def test_windows_with_particles_are_rejected():
    # From 5.9 to 8.2 km half as much backscatter as of air.
    molecular = make_sky(HAZE, STEP, 1.0).air.backscatter
    layer = HAZE + np.where((R > 5900.0) & (R < 8200.0), 60.0 * 0.5 * molecular, 0.0)
    _, found = retrieved(20_000.0, 150.0, SEVERAL, rows=20, seed=3, extinction=layer)
    assert np.all(found.reference.bottom >= 8000.0)


def test_cells_below_the_window_are_refused_in_clear_words():
    with pytest.raises(RetrievalInputError, match=r"highest: the last cell at 13470 m") as caught:
        retrieved(1000.0, 16.0, (14_000.0, 15_000.0, 1000.0), rows=1, seed=1)
    assert caught.value.remedy
