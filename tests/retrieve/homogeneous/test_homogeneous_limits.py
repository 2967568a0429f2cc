"""Paths at the limit of what a signal determines: no value there is false."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy import stats
from support.cases import each

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality, rejecting
from lidarops.retrieve.homogeneous import labeled
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.homogeneous.path_fit import Noise, fit_homogeneous_path
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS


@pytest.mark.parametrize(
    ("variance", "share"), [(1.0, 0.19), (None, 0.18)], ids=["known noise", "estimated noise"]
)
def test_a_signal_that_dies_within_a_bin_determines_no_extinction(variance, share):
    """The second bin then holds noise, which looks like the transmission of the first."""
    rng = np.random.default_rng(31)
    r = 500.0 + 15.0 * np.arange(16)
    fall = rng.uniform(6.0, 14.0, (20_000, 1))
    extinction = fall[:, 0] / 30.0
    height = np.exp(rng.uniform(np.log(10.0), np.log(1e6), fall.shape))
    signal = height * (r[0] / r) ** 2 * np.exp(-fall * (r - r[0]) / 15.0)
    fit = fit_homogeneous_path(100.0 + signal + rng.normal(size=signal.shape), r, variance=variance)
    bits = fit.quality & rejecting((*Quality, *HomogeneousQuality))
    kept = bits == 0
    false = np.abs(fit.extinction - extinction) > 4.0 * fit.extinction_standard_error
    assert kept.sum() > 300
    # Noise that is estimated from 16 bins puts some values beyond 4 errors, which are marked.
    assert np.sum(false & kept & (fit.quality & int(HomogeneousQuality.NOISE_UNCERTAIN) == 0)) <= 1
    assert np.mean(false[kept]) < 8e-3
    # The limit of the slope alone would keep these.
    others = bits & ~int(HomogeneousQuality.POORLY_DETERMINED) == 0
    others &= fit.extinction_standard_error < 0.15 * fit.extinction
    assert np.mean(false[others]) == pytest.approx(share, abs=0.01)


@each(
    ("bins", "factor", "far"),
    [(225, 1.01, 1e-4), (50, 1.05, 3e-4), (32, 1.08, 5.5e-4), (31, 1.09, 5.8e-4),
     (20, 1.15, 1.2e-3), (8, 1.60, 7.1e-3)],
)  # fmt: skip
def test_errors_from_estimated_noise_are_widened_as_the_page_tells(bins, factor, far):
    r = np.linspace(1000.0, 4000.0, bins)
    noise = np.random.default_rng(34).normal(size=bins)
    power = 100.0 + 1e5 * (r[0] / r) ** 2 * np.exp(-4e-4 * (r - r[0])) + noise
    known, estimated = (
        fit_homogeneous_path(power, r, variance=variance) for variance in (1.0, None)
    )
    level = np.sqrt(known.reduced_chi2 / estimated.reduced_chi2)
    widening = estimated.extinction_standard_error / (level * known.extinction_standard_error)
    assert widening == pytest.approx(factor, abs=0.006)
    freedom = 18.0 / 35.0 * (bins - 2)
    assert 1.0 - 2.0 * stats.t.sf(1.96 * widening, freedom) == pytest.approx(0.95, abs=1e-4)
    assert 2.0 * stats.t.sf(4.0 * widening, freedom) == pytest.approx(far, rel=0.05)
    assert bool(estimated.quality & int(HomogeneousQuality.NOISE_UNCERTAIN)) == (bins < 32)
    assert known.quality & int(HomogeneousQuality.NOISE_UNCERTAIN) == 0


def of_estimated_noise(bins, seed):
    """Return |error| over stated error of extinction and background, of values that are kept."""
    rng = np.random.default_rng((36, bins, seed))
    r = np.exp(rng.uniform(np.log(250.0), np.log(6000.0))) + rng.choice([15.0, 60.0]) * np.arange(
        bins
    )
    extinction, height = (
        np.exp(rng.uniform(np.log(low), np.log(high), (1000, 1)))
        for low, high in ((1e-6, 3e-2), (10.0, 3e6))
    )
    power = height * (r[0] / r) ** 2 * np.exp(-2.0 * extinction * (r - r[0]))
    fit = fit_homogeneous_path(100.0 + power + rng.normal(size=power.shape), r)
    kept = fit.quality & rejecting((*Quality, *HomogeneousQuality)) == 0
    marked = fit.quality & int(HomogeneousQuality.NOISE_UNCERTAIN) != 0
    assert np.all(marked == (bins < 32))
    return np.stack(
        [
            np.abs(fit.extinction - extinction[:, 0])[kept] / fit.extinction_standard_error[kept],
            np.abs(fit.background - 100.0)[kept] / fit.background_standard_error[kept],
        ]
    )


@each("bins", [8, 12, 16, 24, 32])
def test_intervals_of_short_sections_with_estimated_noise_hold_what_they_state(bins):
    """Those of 8 bins held 99.8 percent while their errors were widened for the far tail."""
    errors = np.concatenate([of_estimated_noise(bins, seed) for seed in range(24)], axis=1)
    assert errors.shape[1] > 12_000
    held = np.mean(errors < 1.96, axis=1)
    assert np.all((held > 0.94) & (held < 0.965))
    far = np.mean(errors > 4.0, axis=1)
    # The page states these limits: of values that the flag marks, and of others.
    assert np.all(far < (5e-3 if bins < 32 else 1e-3))


def test_missing_bins_do_not_change_the_limit_of_steep_signals():
    """The limit is that of the transmission of one bin, however many bins have data."""
    r = 500.0 + 15.0 * np.arange(80)
    power = 100.0 + 1e4 * (r[0] / r) ** 2 * np.exp(-2.0 * 0.04 * (r - r[0]))
    power[40:] = np.nan
    # With this noise the error is 0.9 of the limit, 0.15 / (2 * 15 m).
    error = fit_homogeneous_path(power, r, variance=1.0).extinction_standard_error
    noise = 0.9 * 0.15 / 30.0 / error
    fit = fit_homogeneous_path(power, r, variance=noise**2)
    assert fit.extinction == pytest.approx(0.04, rel=1e-3)
    assert fit.quality & int(HomogeneousQuality.POORLY_DETERMINED) == 0
    fit = fit_homogeneous_path(power, r, variance=1.3 * noise**2)
    assert fit.quality & int(HomogeneousQuality.POORLY_DETERMINED)


@pytest.mark.parametrize("counts", [1.0, 0.1, 0.02])
def test_few_counts_are_neither_outlying_nor_a_poor_fit(counts):
    """One count in a bin that expects 0.02 is 7 standard deviations."""
    rng = np.random.default_rng(33)
    exposure, profiles = 0.2, 4_000
    r = np.linspace(500.0, 3500.0, 200)
    near = 400.0 * (r[0] / r) ** 2 * np.exp(-2.0 * 2e-3 * (r - r[0]))
    mean = (counts + near) / exposure
    power = rng.poisson(mean * exposure, (profiles, r.size)) / exposure
    tests = int(Quality.OUTLIER | HomogeneousQuality.POOR_FIT)
    flagged = {
        name: np.mean(fit_homogeneous_path(power, r, variance=mean / exposure, **given).quality
                      & tests != 0)
        for name, given in (("normal", {}), ("counts", {"noise": Noise(exposure=exposure)}))
    }  # fmt: skip
    assert flagged["normal"] > 0.02
    assert flagged["counts"] < 2e-3
    # An outlier is still found.
    power[:, 150] += 30.0 / exposure
    fit = fit_homogeneous_path(power, r, variance=mean / exposure, noise=Noise(exposure=exposure))
    assert np.all(fit.quality & int(Quality.OUTLIER))


def test_many_counts_have_the_limits_of_normal_noise():
    rng = np.random.default_rng(34)
    r = np.linspace(500.0, 3500.0, 200)
    mean = 1e5 + 1e6 * (r[0] / r) ** 2
    power = rng.poisson(mean, (200, r.size)).astype(float)
    fits = [
        fit_homogeneous_path(power, r, variance=mean, **g)
        for g in ({}, {"noise": Noise(exposure=1.0)})
    ]
    assert np.array_equal(fits[0].extinction, fits[1].extinction)
    assert np.array_equal(fits[0].quality, fits[1].quality)
    with pytest.raises(RetrievalInputError, match="exposure"):
        fit_homogeneous_path(power, r, noise=Noise(exposure=1.0))


def test_labeled_profiles_take_their_exposures():
    rng = np.random.default_rng(35)
    r = np.linspace(500.0, 3500.0, 200)
    exposure = np.array([0.5, 2.0, 8.0])
    mean = 0.2 + 40.0 * (r[0] / r) ** 2
    power = rng.poisson(mean * exposure[:, np.newaxis]) / exposure[:, np.newaxis]
    variance = mean / exposure[:, np.newaxis]
    fit = fit_homogeneous_path(power, r, variance=variance, noise=Noise(exposure=exposure))
    result = labeled.fit_homogeneous_path(
        xr.DataArray(
            power,
            dims=("time", "range"),
            coords={"range": ("range", r, {"units": "m"})},
            attrs={"units": "MHz"},
        ),
        sections=[(0.0, 4000.0)],
        variance=xr.DataArray(variance, dims=("time", "range")),
        noise=Noise(exposure=xr.DataArray(exposure, dims="time")),
    )
    assert np.array_equal(result["quality_flag"][:, 0], fit.quality)
    assert np.array_equal(result["total_extinction"][:, 0], fit.extinction, equal_nan=True)


def test_the_page_tells_where_errors_of_backgrounds_are_widened():
    quantile = stats.norm.isf(THRESHOLDS.false_curved)
    assert quantile == pytest.approx(3.19, abs=6e-3)
    assert 1.0 / quantile - 0.25 == pytest.approx(0.063, abs=6e-4)
    at_limit = quantile / (4.0 * (1.0 - quantile * THRESHOLDS.largest_relative_error))
    assert at_limit == pytest.approx(1.53, abs=6e-3)


@pytest.mark.parametrize("known", [True, False])
def test_backgrounds_near_the_limit_of_determination_are_not_selected_by_their_noise(known):
    """Noise that bends a signal makes background and error too small: 1 % were false."""
    r, count = 2500.0 + 37.5 * np.arange(80), 16_000
    rng = np.random.default_rng(11)
    shape = r[0] ** 2 / r**2 * np.exp(-2e-5 * (r - r[0]))
    signal = np.exp(rng.uniform(np.log(3.0), np.log(100.0), (count, 1)))
    power = 100.0 + signal * shape + rng.standard_normal((count, r.size))
    fit = fit_homogeneous_path(power, r, variance=1.0 if known else None)
    scale = fit.extinction + 1.0 / r.mean()
    near = (fit.quality == 0) & (fit.extinction_standard_error > 0.1 * scale)
    errors = np.abs(fit.background - 100.0)[near] / fit.background_standard_error[near]
    assert errors.size > 1000
    assert 2e-3 < np.mean(errors > 4.0) < 4.5e-3
    assert 0.93 < np.mean(errors < 1.96) < 0.97
