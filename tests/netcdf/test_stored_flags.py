"""Quality bits of files whose kind had them at other places, or that nobody knows."""

from __future__ import annotations

from pathlib import Path

import netCDF4
import numpy as np
import pytest
import xarray as xr
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, context

from lidarops.aggregate.facts import Facts, read_product_facts
from lidarops.aggregate.means import write_means
from lidarops.aggregate.means_variables import Period
from lidarops.errors import ProductError
from lidarops.flags import PLACES, Quality, Severity
from lidarops.kinds import flags_of
from lidarops.netcdf.read import open_product
from lidarops.netcdf.stored_flags import (
    FlagCounter,
    bits_of,
    recoding,
    rejecting_mask,
    stored_bits,
    with_current_flags,
)
from lidarops.netcdf.write import write_product
from lidarops.records import Verdicts
from lidarops.reports.inspection import describe
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality

FIRST_PLACES = {"poorly_determined": 7, "poor_fit": 10, "at_bound": 9, "not_level": 14}
"""Of homogeneous products before kinds had bits of their own."""


def product_of_now(path: Path, profiles: int) -> np.ndarray:
    """Write a homogeneous product with all bits of its kind; return them."""
    flags = flags_of("homogeneous")
    data = MAKERS["homogeneous"](profiles=profiles).fillna(1.0)
    shape = data["quality_flag"].shape
    now = np.resize(np.array([int(bit) for bit in flags], np.int32), shape)
    data["quality_flag"][:] = now
    write_product(build_product(data, context("homogeneous")), path)
    return now


def older(path: Path, *, profiles: int = 3, more: int = 0) -> np.ndarray:
    """Write a homogeneous product with bits at their first places; return its bits of now."""
    now, flags = product_of_now(path, profiles), flags_of("homogeneous")
    first = {bit.word: 1 << FIRST_PLACES.get(bit.word, int(bit).bit_length() - 1) for bit in flags}
    with netCDF4.Dataset(path, "a") as file:
        variable = file["quality_flag"]
        masks = {int(bit): first[bit.word] for bit in flags}
        variable[:] = np.vectorize(masks.get)(now).astype(np.int32) | np.int32(more)
        variable.flag_masks = np.array(list(first.values()), np.int32)
        variable.delncattr("lidarops_flag_layout")
    return now


@pytest.mark.parametrize("profiles", [3, 4000])
def test_reading_moves_bits_to_their_places_of_now(tmp_path: Path, profiles: int):
    now = older(tmp_path / "older.nc", profiles=profiles)
    with open_product(tmp_path / "older.nc", ["quality_flag"]) as product:
        np.testing.assert_array_equal(product["quality_flag"].isel(time=slice(1, 3)), now[1:3])
        np.testing.assert_array_equal(product["quality_flag"], now)
    with xr.open_dataset(tmp_path / "older.nc") as product:
        moved = with_current_flags(product)["quality_flag"]
        np.testing.assert_array_equal(moved, now)
        # Who reads the values goes by the places that are stated with them.
        stated = {bit.word: bit.mask for bit in stored_bits(moved.attrs, "homogeneous")}
        assert {bit.word: int(bit) for bit in flags_of("homogeneous")}.items() <= stated.items()


def facts_of(file: Path) -> Facts:
    (facts,) = read_product_facts(file.parent, [file.name])
    assert isinstance(facts, Facts)
    return facts


def test_facts_and_inspection_go_by_the_meanings_of_the_file(tmp_path: Path):
    now = older(tmp_path / "older.nc")
    facts = facts_of(tmp_path / "older.nc")
    flags = flags_of("homogeneous")
    assert facts.usable == np.count_nonzero((now & flags.rejecting) == 0)
    counts = {bit.word: int(np.count_nonzero(now & int(bit))) for bit in flags}
    assert facts.flagged == {word.upper(): count for word, count in counts.items() if count}
    rows = {row["name"]: row for row in describe(tmp_path / "older.nc")["quality"]}
    assert {word: rows[word]["values"] for word in counts if counts[word]} == {
        word: count for word, count in counts.items() if count
    }


def test_means_of_older_products_are_those_of_products_of_now(tmp_path: Path):
    product_of_now(tmp_path / "now.nc", 3)
    older(tmp_path / "older.nc")
    means = []
    for name in ("now", "older"):
        (written,) = write_means(tmp_path, [facts_of(tmp_path / f"{name}.nc")], Period.DAY).files
        means.append(xr.load_dataset(tmp_path / written.path))
    assert means[0].quality_flag.values.any()
    for name in ("quality_flag", "usable", "usable_share", "total_extinction"):
        xr.testing.assert_identical(means[0][name].variable, means[1][name].variable)
    groups = {facts_of(tmp_path / f"{name}.nc").group for name in ("now", "older")}
    assert len(groups) == 2, "views over both would mix bits"


def test_bits_without_a_name_are_reported_by_number(tmp_path: Path):
    older(tmp_path / "older.nc", more=1 << 25 | 1 << 27)
    rows = {row["name"]: row for row in describe(tmp_path / "older.nc")["quality"]}
    assert rows["bit_25"]["severity"] == rows["bit_27"]["severity"] == "unknown"
    refused = pytest.raises(ProductError, match="does not have: 25, 27")
    with refused, open_product(tmp_path / "older.nc", ["quality_flag"]):
        pass


def test_bits_that_a_kind_no_longer_has_are_refused_only_where_they_are_raised():
    attributes = {"flag_masks": np.array([1, 2]), "flag_meanings": "input_missing gone"}
    recode = recoding(attributes, "signal")
    assert recode is not None
    np.testing.assert_array_equal(recode(np.array([0, 1])), [0, 1])
    with pytest.raises(ProductError, match="kind signal does not have: 1"):
        recode(np.array([0, 3]))


def test_masks_and_meanings_must_agree():
    with pytest.raises(ProductError, match="flag_meanings"):
        stored_bits({"flag_masks": np.array([1, 2]), "flag_meanings": "saturated"}, "signal")


def test_a_usable_of_other_dimensions_says_nothing_of_bits():
    flags = xr.DataArray(np.full((4, 5), 1 << 20, np.int32), dims=("time", "range"))
    product = xr.Dataset({"quality_flag": flags, "usable": ("time", np.zeros(4, np.int8))})
    product.attrs["lidarops_kind"] = "of another package"
    assert rejecting_mask(bits_of(product)) & 1 << 20
    product["usable"] = flags.dims, np.zeros((4, 5), np.int8)
    assert not rejecting_mask(bits_of(product)) & 1 << 20


@pytest.mark.parametrize("kind", [None, "of another package"])
def test_shared_bits_are_known_without_the_kind(kind: str | None):
    bits = stored_bits({}, kind)
    assert sum(bit.mask for bit in bits) == (1 << PLACES) - 1
    by_word = {bit.word: bit for bit in bits}
    assert by_word["pile_up"].severity is Severity.CARE
    assert by_word["bit_17"].severity is None
    assert by_word["bit_17"].rejects
    values = np.array([0, int(Quality.PILE_UP), int(HomogeneousQuality.POOR_FIT)])
    counts = FlagCounter(rejecting_mask(bits))
    for part in (values[:2], values[2:]):
        counts.add(part)
    carried = {bit.word: counts.carried[bit.mask] for bit in bits if bit.mask in counts.carried}
    assert carried == {"pile_up": 1, "bit_18": 1}
    assert counts.verdicts == Verdicts(good=1, care=1, reject=1)
