"""Sections of homogeneous products: reading and thinning."""

from __future__ import annotations

from datetime import timedelta

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.products.drawn import assert_same_series
from support.products.fabricated import START, homogeneous, times

from lidarops.errors import ProductError
from lidarops.figures.series_data import join, thin
from lidarops.flags import Quality
from lidarops.products.homogeneous.figures import read_sections


def test_values_are_those_of_the_product():
    product = homogeneous(times(START, 40, 60.0))
    near, far = read_sections(product)
    assert (near.key, near.label) == ((2500.0, 5000.0), "2.5\N{EN DASH}5 km")
    for k, section in enumerate((near, far)):
        np.testing.assert_array_equal(section.time, product["time"].values)
        np.testing.assert_array_equal(section.flag, product["quality_flag"].values[:, k])
        for name, values in section.quantities.items():
            np.testing.assert_array_equal(values, product[name].values[:, k])


def test_sections_and_times_are_sorted_together():
    product = homogeneous(times(START, 40, 60.0))
    shuffled = product.isel(time=np.random.default_rng(1).permutation(40), section=[1, 0])
    for straight, sorted_ in zip(read_sections(product), read_sections(shuffled), strict=True):
        assert_same_series(straight, sorted_)


@pytest.mark.parametrize("name", ["total_extinction", "background_standard_error", "quality_flag"])
def test_missing_variable_is_named(name):
    product = homogeneous(times(START, 4, 60.0)).drop_vars(name)
    with pytest.raises(ProductError, match=f"{name}: is missing"):
        read_sections(product)


def test_foreign_products_are_refused():
    product = homogeneous(times(START, 4, 60.0))
    with pytest.raises(ProductError, match="extinction: has the units 'km-1'"):
        read_sections(
            product.assign(total_extinction=product["total_extinction"].assign_attrs(units="km-1"))
        )
    with pytest.raises(ProductError, match="dims"):
        read_sections(product.transpose("section", "time", "nv"))
    with pytest.raises(ProductError, match="section_bounds"):
        read_sections(product.drop_vars("section_bounds"))
    with pytest.raises(ProductError, match="CF times"):
        read_sections(product.assign_coords(time=np.arange(4)))


def test_fill_values_in_flags_reject():
    product = homogeneous(times(START, 4, 60.0), flagged=0.0)
    flag = product["quality_flag"].astype(float)
    flag[1, :] = np.nan
    product["quality_flag"] = flag
    assert [section.rejected.tolist() for section in read_sections(product)] == 2 * [
        [False, True, False, False]
    ]


def test_join_sorts_in_time_and_separates_other_bounds():
    late = homogeneous(times(START + timedelta(days=1), 10, 60.0), seed=1)
    early = homogeneous(times(START, 10, 60.0), seed=2, sections=((2500.0, 5000.0), (1.0, 2.0)))
    joined = join([*read_sections(late), *read_sections(early)])
    assert [(s.key[0], s.time.size) for s in joined] == [(1.0, 10), (2500.0, 20), (5000.0, 10)]
    middle = joined[1]
    assert (np.diff(middle.time) > np.timedelta64(0)).all()
    np.testing.assert_array_equal(
        middle.quantities["total_extinction"],
        np.concatenate(
            [early["total_extinction"].values[:, 0], late["total_extinction"].values[:, 0]]
        ),
    )


@settings(max_examples=30, deadline=None)
@given(count=st.integers(1, 400), points=st.integers(1, 60), seed=st.integers(0, 99))
def test_thin_is_the_block_mean_of_unflagged_values(count, points, seed):
    time = times(START, count, 60.0)
    (section, _) = read_sections(homogeneous(time, flagged=0.3, seed=seed))
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
        value, error = (section.quantities[column] for column in (name, f"{name}_standard_error"))
        of_mean = [np.sqrt((error[b] ** 2).sum()) / b.size for b in blocks]
        np.testing.assert_allclose(thinned.quantities[name], [value[b].mean() for b in blocks])
        np.testing.assert_allclose(thinned.quantities[f"{name}_standard_error"], of_mean, rtol=1e-6)


def test_thin_does_not_average_across_a_gap():
    time = np.concatenate([times(START, 7, 60.0), times(START + timedelta(hours=9), 7, 60.0)])
    (section, _) = read_sections(homogeneous(time, flagged=0.0))
    thinned = thin(section, 3)
    hours = (thinned.time - time[0]) / np.timedelta64(1, "h")
    assert not ((hours > 0.2) & (hours < 8.9)).any()


def test_all_flagged_thins_to_nothing():
    product = homogeneous(times(START, 10, 60.0))
    product["quality_flag"][:] = int(Quality.NO_SIGNAL)
    assert thin(read_sections(product)[0], 5).time.size == 0
