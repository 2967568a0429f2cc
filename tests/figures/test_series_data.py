"""Sections of homogeneous products: reading, matching with the truth, thinning, comparison."""

from __future__ import annotations

from datetime import timedelta

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from support.products import fabricated as fab
from support.products.fabricated import CHANNEL, START, homogeneous, times, truth_of

from lidarops.errors import ProductError
from lidarops.figures.series_data import (
    Verdict,
    compare,
    join,
    normalised_error,
    thin,
)
from lidarops.flags import Quality
from lidarops.products.homogeneous.figures import read_sections


def sections_of(product, truth=None, **options):
    options = {"instrument": "horizontal", "channel": CHANNEL} | options
    return read_sections(product, truth, **options)


def test_values_are_those_of_the_product():
    product = homogeneous(times(START, 40, 60.0))
    near, far = sections_of(product)
    assert (near.key, near.label) == ((2500.0, 5000.0), "2.5\N{EN DASH}5 km")
    for k, section in enumerate((near, far)):
        np.testing.assert_array_equal(section.time, product["time"].values)
        np.testing.assert_array_equal(section.flag, product["quality_flag"].values[:, k])
        for name, estimate in section.estimates.items():
            np.testing.assert_array_equal(estimate.value, product[name].values[:, k])
            error = product[f"{name}_standard_error"].values[:, k]
            np.testing.assert_array_equal(estimate.standard_error, error)
            assert np.isnan(estimate.truth).all()


def test_sections_and_times_are_sorted_together():
    product = homogeneous(times(START, 40, 60.0))
    shuffled = product.isel(time=np.random.default_rng(1).permutation(40), section=[1, 0])
    for straight, sorted_ in zip(sections_of(product), sections_of(shuffled), strict=True):
        np.testing.assert_array_equal(straight.time, sorted_.time)
        np.testing.assert_array_equal(straight.flag, sorted_.flag)
        for name in straight.estimates:
            np.testing.assert_array_equal(
                straight.estimates[name].value, sorted_.estimates[name].value
            )


@pytest.mark.parametrize("name", ["total_extinction", "background_standard_error", "quality_flag"])
def test_missing_variable_is_named(name):
    product = homogeneous(times(START, 4, 60.0)).drop_vars(name)
    with pytest.raises(ProductError, match=f"{name}: is missing"):
        sections_of(product)


def test_foreign_products_are_refused():
    product = homogeneous(times(START, 4, 60.0))
    with pytest.raises(ProductError, match="extinction: has the units 'km-1'"):
        sections_of(
            product.assign(total_extinction=product["total_extinction"].assign_attrs(units="km-1"))
        )
    with pytest.raises(ProductError, match="dims"):
        sections_of(product.transpose("section", "time", "nv"))
    with pytest.raises(ProductError, match="section_bounds"):
        sections_of(product.drop_vars("section_bounds"))
    with pytest.raises(ProductError, match="CF times"):
        sections_of(product.assign_coords(time=np.arange(4)))


def test_fill_values_in_flags_reject():
    product = homogeneous(times(START, 4, 60.0), flagged=0.0)
    flag = product["quality_flag"].astype(float)
    flag[1, :] = np.nan
    product["quality_flag"] = flag
    assert [section.rejected.tolist() for section in sections_of(product)] == 2 * [
        [False, True, False, False]
    ]


class TestTruth:
    def test_is_matched_by_path_whatever_the_times(self):
        time = times(START, 30, 60.0)
        truth = truth_of(time)
        truth["time"] = truth["time"] + np.timedelta64(7, "D")
        paths = [f"raw/h{i:05d}" for i in (3, 1, 29)]
        (section, _) = sections_of(homogeneous(time[[3, 1, 29]]), truth, paths=paths)
        np.testing.assert_allclose(
            section.estimates["total_extinction"].truth, fab.true_extinction(time[[1, 3, 29]])
        )

    @pytest.mark.parametrize("offset", [0.0, -29.0, 6.0])
    def test_is_matched_by_the_nearest_time(self, offset):
        time = times(START, 30, 60.0)
        truth = truth_of(time)
        truth["time"] = truth["time"] + np.timedelta64(int(offset * 1e9), "ns")
        (section, _) = sections_of(homogeneous(time[5:9]), truth)
        np.testing.assert_allclose(
            section.estimates["total_extinction"].truth, fab.true_extinction(time[5:9])
        )

    def test_is_absent_where_no_granule_is_near(self):
        time = times(START, 30, 60.0)
        far = times(START + timedelta(hours=3), 5, 60.0)
        (section, _) = sections_of(homogeneous(far), truth_of(time))
        assert np.isnan(section.estimates["total_extinction"].truth).all()
        assert compare(section, "total_extinction") is None

    def test_is_of_the_right_instrument(self):
        time = times(START, 30, 60.0)
        truth = truth_of(time, other=30)
        (section, _) = sections_of(homogeneous(time), truth, instrument="vertical")
        assert np.isnan(section.estimates["total_extinction"].truth).all()
        # Its background is 9 MHz at the first profile and unknown at the others.
        background = section.estimates["background"].truth
        assert background[0] == 9.0
        assert np.isnan(background[1:]).all()

    def test_holds_the_dark_offset_where_it_was_not_subtracted(self):
        time = times(START, 30, 60.0)
        truth = truth_of(time)
        offset = xr.full_like(truth[f"background_{CHANNEL}"], 2.5)
        truth = truth.assign({f"dark_offset_{CHANNEL}": offset})
        (with_dark, _) = sections_of(homogeneous(time), truth, dark_subtracted=False)
        (without, _) = sections_of(homogeneous(time), truth, dark_subtracted=True)
        difference = with_dark.estimates["background"].truth - without.estimates["background"].truth
        np.testing.assert_allclose(difference, 2.5)

    def test_is_the_same_when_read_from_a_file(self, tmp_path):
        time = times(START, 30, 60.0)
        truth_of(time).to_netcdf(tmp_path / "truth.nc")
        with xr.open_dataset(tmp_path / "truth.nc") as opened:
            (section, _) = sections_of(homogeneous(time), opened)
        np.testing.assert_allclose(
            section.estimates["total_extinction"].truth, fab.true_extinction(time)
        )
        assert np.isfinite(section.estimates["amplitude"].truth).all()

    def test_bytes_are_text_too(self):
        time = times(START, 30, 60.0)
        truth = truth_of(time)
        truth["instrument"] = truth["instrument"].astype("S20")
        (section, _) = sections_of(homogeneous(time), truth)
        assert np.isfinite(section.estimates["total_extinction"].truth).all()

    def test_without_granules_is_no_truth(self):
        time = times(START, 3, 60.0)
        (section, _) = sections_of(homogeneous(time), truth_of(time).isel(granule=slice(0)))
        assert np.isnan(section.estimates["total_extinction"].truth).all()


class TestCompare:
    def test_counts_unflagged_values_only(self):
        time = times(START, 2000, 30.0)
        for section in sections_of(homogeneous(time, flagged=0.2), truth_of(time)):
            comparison = compare(section, "total_extinction")
            assert comparison.count == int((section.flag == 0).sum())
            estimate = section.estimates["total_extinction"]
            score = (estimate.value - estimate.truth) / estimate.standard_error
            score = score[section.flag == 0]
            assert comparison.within_1 == np.mean(np.abs(score) <= 1)
            assert comparison.within_3 == np.mean(np.abs(score) <= 3)
            # Normal errors: 0.6827 +- 4 binomial standard deviations.
            assert abs(comparison.within_1 - 0.6827) < 4 * np.sqrt(0.2166 / comparison.count)
            assert comparison.bias == pytest.approx(score.mean())
            assert comparison.spread == pytest.approx(1.0, abs=4 / np.sqrt(2 * comparison.count))
            assert comparison.verdict is Verdict.AS_STATED

    @pytest.mark.parametrize(
        ("scale", "shift", "verdict"),
        [
            (1.0, 0.0, Verdict.AS_STATED),
            (1.6, 0.0, Verdict.BEYOND),
            (0.5, 0.0, Verdict.OVERSTATED),
            (0.7, 0.6, Verdict.SHARED),
            (0.0, 1.3, Verdict.UNDERSTATED),
        ],
    )
    def test_verdict_on_the_standard_errors(self, scale, shift, verdict):
        time = times(START, 500, 30.0)
        product = homogeneous(time, flagged=0.0, scale=scale)
        product["total_extinction"] = (
            product["total_extinction"] + shift * product["total_extinction_standard_error"]
        ).assign_attrs(units="m-1")
        (section, _) = sections_of(product, truth_of(time))
        comparison = compare(section, "total_extinction")
        assert comparison.verdict is verdict
        assert verdict.unsafe == (verdict in (Verdict.BEYOND, Verdict.UNDERSTATED))

    @pytest.mark.parametrize("error", [0.0, -1.0, np.nan, np.inf])
    def test_values_without_a_standard_error_are_counted(self, error):
        time = times(START, 10, 30.0)
        product = homogeneous(time, flagged=0.0)
        product["total_extinction_standard_error"][4, :] = error
        (section, _) = sections_of(product, truth_of(time))
        comparison = compare(section, "total_extinction")
        assert (comparison.count, comparison.without_error) == (9, 1)
        assert comparison.verdict is Verdict.NO_ERROR
        assert comparison.verdict.unsafe
        assert np.isnan(normalised_error(section, "total_extinction")[4])

    def test_only_values_without_standard_error(self):
        time = times(START, 10, 30.0)
        product = homogeneous(time, flagged=0.0)
        product["total_extinction_standard_error"][:] = np.nan
        (section, _) = sections_of(product, truth_of(time))
        comparison = compare(section, "total_extinction")
        assert (comparison.count, comparison.without_error) == (0, 10)
        assert comparison.verdict is Verdict.NO_ERROR
        assert comparison.verdict.unsafe
        assert np.isnan(comparison.within_3)


def test_join_sorts_in_time_and_separates_other_bounds():
    late = homogeneous(times(START + timedelta(days=1), 10, 60.0), seed=1)
    early = homogeneous(times(START, 10, 60.0), seed=2, sections=((2500.0, 5000.0), (1.0, 2.0)))
    joined = join([*sections_of(late), *sections_of(early)])
    assert [(s.key[0], s.time.size) for s in joined] == [(1.0, 10), (2500.0, 20), (5000.0, 10)]
    middle = joined[1]
    assert (np.diff(middle.time) > np.timedelta64(0)).all()
    np.testing.assert_array_equal(
        middle.estimates["total_extinction"].value,
        np.concatenate(
            [early["total_extinction"].values[:, 0], late["total_extinction"].values[:, 0]]
        ),
    )


@settings(max_examples=30, deadline=None)
@given(count=st.integers(1, 400), points=st.integers(1, 60), seed=st.integers(0, 99))
def test_thin_is_the_block_mean_of_unflagged_values(count, points, seed):
    time = times(START, count, 60.0)
    (section, _) = sections_of(homogeneous(time, flagged=0.3, seed=seed), truth_of(time))
    thinned = thin(section, points)
    good = section.flag == 0
    assert (thinned.flag == 0).all()
    if good.sum() <= points:
        np.testing.assert_array_equal(thinned.time, section.time[good])
        return
    size = -(-int(good.sum()) // points)
    # Oracle: blocks of `size` profiles, without those that have no unflagged profile.
    blocks = [np.arange(i, min(i + size, count)) for i in range(0, count, size)]
    blocks = [block[good[block]] for block in blocks if good[block].any()]
    assert thinned.time.size == len(blocks)
    for name in ("total_extinction", "background"):
        estimate, mean = section.estimates[name], thinned.estimates[name]
        error = [np.sqrt((estimate.standard_error[b] ** 2).sum()) / b.size for b in blocks]
        np.testing.assert_allclose(mean.value, [estimate.value[b].mean() for b in blocks])
        np.testing.assert_allclose(mean.standard_error, error, rtol=1e-6)
        np.testing.assert_allclose(mean.truth, [estimate.truth[b].mean() for b in blocks])


def test_thin_does_not_average_across_a_gap():
    time = np.concatenate([times(START, 7, 60.0), times(START + timedelta(hours=9), 7, 60.0)])
    (section, _) = sections_of(homogeneous(time, flagged=0.0))
    thinned = thin(section, 3)
    hours = (thinned.time - time[0]) / np.timedelta64(1, "h")
    assert not ((hours > 0.2) & (hours < 8.9)).any()


def test_all_flagged_thins_to_nothing():
    product = homogeneous(times(START, 10, 60.0))
    product["quality_flag"][:] = int(Quality.NO_SIGNAL)
    assert thin(sections_of(product)[0], 5).time.size == 0
