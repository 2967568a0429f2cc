"""Rasters of products: block means, flags, edges and reach."""

from __future__ import annotations

from datetime import timedelta
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.products.fabricated import START, signal, times

from lidarops.errors import ProductError
from lidarops.figures import raster
from lidarops.figures.raster import read_raster
from lidarops.flags import Quality
from lidarops.kinds import flags_of

read = partial(read_raster, quantity="signal", profiles=1)
BITS = list(flags_of("signal"))
BAD = flags_of("signal").rejecting


def oracle(product, columns, rows):
    """Return the mean over usable bins, by plain loops."""
    flag, value = product["quality_flag"].values, product["signal"].values.astype(float)
    good = ((flag & BAD) == 0) & np.isfinite(value)
    out = np.full((len(columns), len(rows)), np.nan)
    for i, column in enumerate(columns):
        for j, row in enumerate(rows):
            block = value[column, row][good[column, row]]
            out[i, j] = block.mean() if block.size else np.nan
    return out


@settings(max_examples=25, deadline=None)
@given(
    count=st.integers(1, 40),
    bins=st.integers(2, 50),
    profiles=st.integers(1, 9),
    seed=st.integers(0, 9),
)
def test_blocks_are_means_of_usable_bins(count, bins, profiles, seed):
    random = np.random.default_rng(seed)
    product = signal(times(START, count, 60.0), bins=bins, seed=seed)
    flag = random.choice([0, 0, 0, *map(int, BITS)], size=(count, bins))
    product["quality_flag"][:] = flag.astype(np.int32)
    product["signal"].values[random.random((count, bins)) < 0.1] = np.nan
    image = read(product, profiles=profiles)
    columns = [slice(i, min(i + profiles, count)) for i in range(0, count, profiles)]
    rows = [slice(j, j + 1) for j in range(bins)]
    np.testing.assert_allclose(image.mean, oracle(product, columns, rows), rtol=1e-5, atol=1e-3)
    visible = BAD & ~int(Quality.INPUT_MISSING)
    rejected = [(flag[c] & visible != 0).mean(axis=0) for c in columns]
    np.testing.assert_array_equal(image.flagged, np.array(rejected) >= 0.5)


@given(bins=st.integers(2, 3000), share=st.floats(0.01, 1.0))
@settings(max_examples=20, deadline=None)
def test_rows_merge_without_loss(bins, share):
    product = signal(times(START, 3, 60.0), bins=bins, bin_width=5.0)
    image = read(product)
    cut = image.shown_to(share * bins * 5.0)
    assert cut.edges.size - 1 <= raster.ROWS
    assert cut.edges[-1] >= share * bins * 5.0 - 1e-6 or cut.edges[-1] == image.edges[-1]
    rows = int(np.searchsorted(image.edges, cut.edges[-1]))
    np.testing.assert_allclose(cut.sums[0].sum(), image.sums[0, :, :rows].sum(), rtol=1e-4)
    assert cut.sums[2].sum() == image.sums[2, :, :rows].sum()
    assert cut.bins.sum() == image.bins[:rows].sum()


def test_many_bins_are_read_in_blocks(monkeypatch):
    product = signal(times(START, 30, 60.0), bins=9000, bin_width=3.0)
    whole = read(product, profiles=4)
    assert whole.mean.shape == (8, 3000)
    monkeypatch.setattr(raster, "_READ_BYTES", 1)
    in_blocks = read(product, profiles=4)
    np.testing.assert_array_equal(whole.sums, in_blocks.sums)
    rows = [slice(j, j + 3) for j in range(0, 9000, 3)]
    columns = [slice(i, min(i + 4, 30)) for i in range(0, 30, 4)]
    np.testing.assert_allclose(whole.mean, oracle(product, columns, rows), rtol=1e-4, atol=0.1)


def test_columns_touch_except_at_gaps():
    time = np.concatenate([times(START, 10, 60.0), times(START + timedelta(hours=2), 4, 60.0)])
    image = read(signal(time), profiles=3)
    gaps = (image.start[1:] - image.stop[:-1]) / np.timedelta64(1, "m")
    # 10 profiles in 4 columns, then 4 in 2: one gap, from 10 min to 2 h.
    np.testing.assert_allclose(gaps, [0, 0, 0, 110, 0], atol=1e-9)
    assert image.profiles.tolist() == [3, 3, 3, 1, 3, 1]
    assert image.start[0] == np.datetime64("2024-03-01T00:00:00")


@pytest.mark.parametrize(
    ("missing", "gap"),
    [(1, 0.0), (9, 9.0)],
    ids=["one profile is no gap", "an outage"],
)
def test_columns_do_not_touch_across_an_outage(missing, gap):
    time = np.concatenate(
        [times(START, 10, 60.0), times(START + timedelta(minutes=10 + missing), 10, 60.0)]
    )
    image = read(signal(time), profiles=1)
    gaps = (image.start[1:] - image.stop[:-1]) / np.timedelta64(1, "m")
    np.testing.assert_allclose(gaps, [*[0.0] * 9, gap, *[0.0] * 9], atol=1e-9)


def test_columns_touch_where_one_minute_in_ten_is_measured():
    product = signal(times(START, 12, 600.0))
    middle = product["time"].values
    half = np.timedelta64(30, "s")
    product["time_bnds"] = ("time", "bound"), np.stack([middle - half, middle + half], axis=-1)
    image = read(product, profiles=1)
    np.testing.assert_array_equal(image.start[1:], image.stop[:-1])


def test_reach_ends_where_noise_dominates():
    product = signal(times(START, 60, 60.0), bins=2000, bin_width=15.0)
    product["signal"].values[:, 400:] = (
        product["signal_standard_error"].values[:, 400:]
        * np.random.default_rng(0).standard_normal((60, 1600))
    )  # fmt: skip
    product["signal"].values[:, :400] = 5 * product["signal_standard_error"].values[:, :400]
    assert read(product).reach == pytest.approx(6000.0, abs=15.0 * 25)
    product["signal"].values[:] = 0.0
    assert read(product).reach == 0.0


def test_rejected_profiles_do_not_shorten_the_reach():
    """As of four lone beams beside two scans."""
    product = signal(times(START, 6, 60.0), bins=400)
    product["signal"].values[:] = 2.0 * product["signal_standard_error"].values
    product["quality_flag"].values[:4] = BAD
    assert read(product).reach == pytest.approx(product["range"].values[-1], rel=0.05)


def test_altitude_is_a_line_in_range():
    image = read(signal(times(START, 3, 60.0)))
    np.testing.assert_allclose(image.altitude, (120.0, 0.94))
    assert read(signal(times(START, 3, 60.0)).drop_vars("altitude")).altitude is None


def test_unsorted_times_are_sorted():
    product = signal(times(START, 12, 60.0))
    backwards = product.isel(time=slice(None, None, -1))
    np.testing.assert_array_equal(read(product).sums, read(backwards).sums)


@pytest.mark.parametrize("name", ["signal", "quality_flag", "range"])
def test_missing_variable_is_named(name):
    with pytest.raises(ProductError, match=f"{name}: is missing"):
        read(signal(times(START, 3, 60.0)).drop_vars(name))


def test_of_an_unknown_kind_the_file_tells_which_bits_reject():
    product = signal(times(START, 4, 60.0), bins=10).assign_attrs(lidarops_kind="wind")
    flags = product["quality_flag"]
    flags.values[:] = 0
    flags.attrs |= {"flag_masks": [1, 2], "flag_meanings": "calm stormy"}
    flags.attrs.pop("flag_assessments", None)
    flags.values[0], flags.values[1] = 1, 3
    assert read(product).flagged.any(axis=1).tolist() == [True, True, False, False]
    flags.attrs["flag_assessments"] = "Indeterminate Bad"
    assert read(product).flagged.any(axis=1).tolist() == [False, True, False, False]


def test_empty_product_is_refused():
    with pytest.raises(ProductError, match="no profile"):
        read(signal(times(START, 3, 60.0)).isel(time=slice(0)))
