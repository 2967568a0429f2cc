"""Extinction, backscatter and lidar ratio together: exactness, causes of error, flags."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.raman_signals import make_sky

from lidarops.flags import Quality
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.raman.flags import RamanQuality
from lidarops.retrieve.raman.retrieval import retrieve_raman
from lidarops.retrieve.raman.scattering import (
    NITROGEN_SHIFT,
    nitrogen_line_share,
    raman_wavelength,
)
from lidarops.retrieve.raman.thresholds import THRESHOLDS

STEP = 30.0
R = STEP * (np.arange(400) + 0.5)
HAZE = np.where(R < 6500.0, 1.5e-4 * np.exp(-R / 2000.0) * (1.0 - (R / 6500.0) ** 2), 0.0)
WINDOW = (7000.0, 12_000.0, 4000.0)


@pytest.fixture(scope="module")
def sky():
    return make_sky(HAZE, STEP, 1e7, cell=STEP, window=WINDOW)


def retrieved(sky, **settings):
    quality = settings.pop("quality", sky.quality)
    raman, elastic = (sky.signal(mean[np.newaxis]) for mean in (sky.raman, sky.elastic))
    raman = replace(raman, **settings.pop("raman", {}))
    elastic = replace(elastic, **settings.pop("elastic", {}))
    limits = sky.settings.reference.model_copy(update=settings.pop("reference", {}))
    air = replace(sky.air, **settings.pop("air", {}))
    changed = replace(sky.settings, reference=limits, **settings)
    return retrieve_raman(raman, elastic, air, sky.cells, changed, quality=quality)


def test_values_without_noise_are_exact():
    # By so many counts, the mean of the posterior of a reciprocal is the reciprocal.
    sky = make_sky(HAZE, STEP, 1e10, cell=STEP, window=WINDOW)
    found = retrieved(sky)
    near = (R > 600.0) & (R < 5000.0)
    np.testing.assert_allclose(found.backscatter[0, near], HAZE[near] / 50.0, rtol=1e-6)
    np.testing.assert_allclose(found.lidar_ratio[0, near], 50.0, rtol=2e-5)
    assert np.all(found.quality[0, near] == 0)


def test_lidar_ratios_are_less_by_the_relative_variance_of_backscatter(sky):
    found = retrieved(sky)
    near = (R > 600.0) & (R < 5000.0)
    np.testing.assert_allclose(found.backscatter[0, near], HAZE[near] / 50.0, rtol=1e-3)
    less = 1.0 - found.lidar_ratio[0, near] / 50.0
    # Of the cell; that of the smoothed one is 1.6 times to 0.3 times as much. At most 0.3 %.
    variance = (found.backscatter_budget["noise"] / found.backscatter)[0, near] ** 2
    assert np.all((0.25 * variance < less) & (less < 1.6 * variance) & (less < 3e-3))
    assert np.all(found.quality[0, near] == 0)


def test_particles_everywhere_leave_no_reference():
    sky = make_sky(np.full(R.size, 1e-4), STEP, 1e7, cell=STEP, window=WINDOW)
    assumed = 1.0 + 1e-4 / 50.0 / sky.air.backscatter
    middle = (R > 9000.0) & (R < 11_000.0)
    found = retrieved(sky, reference={"scattering_ratio": float(assumed[middle].mean())})
    assert np.isnan(found.reference.bottom).all()  # no shape of air anywhere
    assert np.all(found.quality & RamanQuality.NO_REFERENCE)
    np.testing.assert_allclose(found.extinction[0, 20:300], 1e-4, rtol=1e-6)


def test_partial_overlap_cancels_in_backscatter(sky):
    found = retrieved(sky)
    near = R < 300.0
    assert np.isnan(found.extinction[0, near]).all()
    # Extinction is continued with its slope, which attenuates by 0.1 % too little.
    np.testing.assert_allclose(found.backscatter[0, near], HAZE[near] / 50.0, rtol=2e-3)


def test_extinction_begins_with_the_data(sky):
    """What smoothness says of the air before them is no value, even where its error is small."""
    power, near = sky.raman[np.newaxis].copy(), R < 1000.0
    power[:, R < 600.0] = np.nan
    found = retrieved(sky, raman={"power": power})
    for name in ("extinction", "vertical_resolution", "lidar_ratio"):
        known = np.isfinite(getattr(found, name)[0])
        np.testing.assert_array_equal(known[near], R[near] > 600.0)
    between = (R > 300.0) & (R < 600.0)
    assert np.all(found.raman_depth_error[0, between] < 1.0 / COMMON.first_order)


@pytest.mark.parametrize(
    ("cause", "settings", "changed"),
    [
        (
            "reference",
            {"reference": {"relative_error": 1e-3}},
            {"reference": {"scattering_ratio": 1.001}},
        ),
        ("angstrom", {"angstrom_standard_error": 0.01}, {"angstrom_exponent": 1.21}),
    ],
)
def test_errors_are_the_change_by_their_cause(sky, cause, settings, changed):
    near = (R > 600.0) & (R < 5000.0)
    before = retrieved(sky, **settings)
    after = retrieved(sky, **changed)
    for name in ("extinction", "backscatter"):
        budget = getattr(before, f"{name}_budget")
        if cause in budget:
            change = np.abs(getattr(after, name) - getattr(before, name))[0, near]
            stated = budget[cause][0, near]
            np.testing.assert_allclose(change, stated, rtol=0.03, atol=1e-3 * stated.max())
    change = np.abs(after.lidar_ratio - before.lidar_ratio)[0, near]
    np.testing.assert_allclose(change, before.lidar_ratio_systematic[0, near], rtol=0.05, atol=2e-3)


def test_errors_of_the_overlap_are_the_change_by_it(sky):
    overlap = np.where(R >= 300.0, 1.0 - (1.0 - np.minimum(R / 2000.0, 1.0)) ** 2, np.nan)
    seen = np.nan_to_num(overlap, nan=1.0)
    sky = replace(sky, raman=sky.raman * seen, elastic=sky.elastic * seen)
    # One minus the overlap is 1e-3 of itself larger.
    of_overlap = (overlap, 1.0 - 1.001 * (1.0 - overlap))
    before, after = (
        retrieved(replace(sky, air=replace(sky.air, overlap=o)), overlap_relative_error=1e-3)
        for o in of_overlap
    )
    near = (R > 450.0) & (R < 5000.0)
    assert overlap[near].min() < 0.45
    for name in ("extinction", "backscatter"):
        change = np.abs(getattr(after, name) - getattr(before, name))[0, near]
        stated = getattr(before, f"{name}_budget")["overlap"][0, near]
        np.testing.assert_allclose(change, stated, rtol=0.03, atol=0.02 * stated.max())


@pytest.mark.parametrize("scale", [60.0, 150.0, 300.0])
def test_errors_cover_what_an_overlap_lacks_where_it_is_stated_to_be_full(sky, scale):
    """Of 5 percent, which is 2.5 of its standard errors."""
    seen = 1.0 - 0.05 * np.exp(-np.maximum(R - 300.0, 0.0) / scale)
    before = retrieved(sky, full_overlap_error=0.02)
    after = retrieved(replace(sky, raman=sky.raman * seen, elastic=sky.elastic * seen))
    near = (R > 300.0) & (R < 5000.0)
    change = np.abs(after.extinction - before.extinction)[0, near]
    assert change.max() > 4.0 * retrieved(sky).extinction_standard_error[0, near].max()
    assert np.all(change < 4.0 * before.extinction_standard_error[0, near])


def test_errors_of_the_slope_of_air_are_the_change_by_it(sky):
    before = retrieved(sky, air={"slope_error": 1e-6})
    steeper, molecular = np.exp(1e-6 * R), sky.air.backscatter
    window = (before.reference.bottom < R) & (before.reference.top > R)
    # The density in the reference window stays.
    steeper *= molecular[window].sum() / (steeper * molecular)[window].sum()
    air = replace(sky.air, density=sky.air.density * steeper, backscatter=molecular * steeper)
    after = retrieved(replace(sky, air=air))
    near = (R > 600.0) & (R < 5000.0)
    np.testing.assert_allclose(before.extinction_budget["molecular"][0, near], 5.3e-7, rtol=0.02)
    for name in ("extinction", "backscatter"):
        change = np.abs(getattr(after, name) - getattr(before, name))[0, near]
        stated = getattr(before, f"{name}_budget")["molecular"][0, near]
        np.testing.assert_allclose(change, stated, rtol=0.03, atol=0.02 * stated.max())


def test_errors_cover_the_standard_atmosphere_in_the_tropics(sky):
    # 300 K at the ground, 6.5 K less each km: 12 K warmer than the standard, below 11 km.
    height = np.arange(0.0, 14_000.0, 100.0)
    temperature = 300.0 - 6.5e-3 * height
    pressure = 101_325.0 * (temperature / 300.0) ** (9.80665 * 0.0289644 / 8.31432 / 6.5e-3)
    tropical = MolecularProfile.from_profile(height, pressure, temperature)
    density = sky.air.density * tropical.number_density(R)
    density /= MolecularProfile.us_standard().number_density(R)
    shape = density / sky.air.density
    # The signal is that of tropical air, and the retrieval takes the standard.
    truth = replace(sky, raman=sky.raman * shape)
    found = retrieved(truth, air={"slope_error": THRESHOLDS.standard_slope_error})
    away = found.extinction - retrieved(sky).extinction
    for low, high in ((600.0, 5000.0), (5000.0, 11_000.0)):
        heights = (low < R) & (high > R)
        scatter = np.sqrt(np.mean((away / found.extinction_standard_error)[0, heights] ** 2))
        assert 0.1 < scatter < 1.0


def test_errors_of_the_background_are_the_change_by_it(sky):
    near = (R > 600.0) & (R < 5000.0)
    error = np.array([1e-4 * sky.raman[160]])
    before = retrieved(sky, raman={"background_standard_error": error})
    after = retrieved(sky, raman={"power": (sky.raman - error)[np.newaxis]})
    for name in ("extinction", "backscatter"):
        change = np.abs(getattr(after, name) - getattr(before, name))[0, near]
        stated = getattr(before, f"{name}_budget")["background"][0, near]
        np.testing.assert_allclose(change, stated, rtol=0.05, atol=0.02 * stated.max())


def test_profiles_without_raman_signal_have_no_values(sky):
    none = {"power": np.full((1, R.size), -1.0)}
    found = retrieved(sky, raman=none)
    assert np.isnan(found.extinction).all()
    assert np.isnan(found.backscatter).all()
    assert np.all(found.quality & RamanQuality.WEAK_SIGNAL)
    assert np.all(found.quality & RamanQuality.NO_LIDAR_RATIO)


def test_missing_bins_are_interpolated_by_the_smooth_solution(sky):
    power = sky.raman[np.newaxis].copy()
    power[0, 100:103] = np.nan
    found = retrieved(sky, raman={"power": power})
    assert found.extinction[0, 101] == pytest.approx(HAZE[101], rel=0.05)
    assert np.all(found.quality[0, 100:103] & Quality.OUTLIER == 0)


def test_profiles_do_not_depend_on_each_other():
    sky = make_sky(HAZE, STEP, 300.0)
    rng = np.random.default_rng(2)
    raman, elastic = (rng.poisson(m, (3, R.size)).astype(float) for m in (sky.raman, sky.elastic))
    signals = [sky.signal(raman), sky.signal(elastic)]
    alone = [
        replace(one, power=one.power[1:2], variance=one.variance[1:2],
                background=one.background[1:2],
                background_standard_error=one.background_standard_error[1:2],
                counts_per_power=one.counts_per_power[1:2])
        for one in signals
    ]  # fmt: skip
    quality = np.repeat(sky.quality, 3, axis=0)
    three = retrieve_raman(*signals, sky.air, sky.cells, sky.settings, quality=quality)
    one = retrieve_raman(*alone, sky.air, sky.cells, sky.settings, quality=sky.quality)
    for name in ("extinction", "backscatter", "lidar_ratio", "vertical_resolution"):
        np.testing.assert_array_equal(getattr(three, name)[1], getattr(one, name)[0])


def test_an_overlap_that_is_not_full_where_stated_is_found():
    rng = np.random.default_rng(4)
    for true, to in ((300.0, 0.0), (2500.0, 2200.0)):
        sky = make_sky(HAZE, STEP, 5000.0, full_overlap=true, window=WINDOW)
        r = sky.cells.range
        partial = np.where(r < 1000.0, np.int32(Quality.INCOMPLETE_OVERLAP), np.int32(0))
        quality = np.tile(partial, (5, 1))
        signals = sky.drawn(rng, 5)
        found = retrieve_raman(*signals, sky.air, sky.cells, sky.settings, quality=quality)
        negative = (found.quality & RamanQuality.NEGATIVE_EXTINCTION) != 0
        assert negative[:, (r > 1000.0) & (r < to)].all()
        assert to > 0.0 or not negative.any()


def test_lines_in_a_narrow_filter_change_with_temperature():
    centre = raman_wavelength(354.7e-9, NITROGEN_SHIFT)
    assert centre == pytest.approx(386.7e-9, abs=0.1e-9)
    warm, cold = (
        nitrogen_line_share(np.array([300.0, 220.0]), 354.7e-9, centre, width)
        for width in (0.3e-9, 20e-9)
    )
    # Cold nitrogen has more of its lines near the centre of the branch.
    assert 0.001 < warm[1] / warm[0] - 1.0 < 0.05
    assert abs(cold[1] / cold[0] - 1.0) < 1e-3
