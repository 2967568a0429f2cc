"""Quality bits of files whose kind had them at other places, or that nobody knows."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import netCDF4
import numpy as np
import pytest
import xarray as xr
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, context

from lidarops.aggregate.facts import Facts, Period, read_product_facts
from lidarops.aggregate.means import Means
from lidarops.errors import ProductError
from lidarops.flags import PLACES, Quality, Severity
from lidarops.kinds import flags_of
from lidarops.netcdf.read import open_product
from lidarops.netcdf.stored_flags import (
    FlagCounter,
    refuse_moved_flags,
    rejecting_mask,
    stored_bits,
)
from lidarops.netcdf.write import write_product
from lidarops.records import Verdicts
from lidarops.reports.inspection import describe
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality

FIRST_PLACES = {"poorly_determined": 7, "poor_fit": 10, "at_bound": 9, "not_level": 14}
"""Of homogeneous products before kinds had bits of their own."""


def older(path: Path, *, more: int = 0) -> np.ndarray:
    """Write a homogeneous product with bits at their first places; return its bits of now."""
    flags = flags_of("homogeneous")
    data = MAKERS["homogeneous"](profiles=3).fillna(1.0)
    bits = np.array([int(bit) for bit in flags], np.int32)
    now = np.resize(bits, data["quality_flag"].shape)
    data["quality_flag"][:] = now
    write_product(build_product(data, context("homogeneous")), path)
    first = {bit.word: 1 << FIRST_PLACES.get(bit.word, int(bit).bit_length() - 1) for bit in flags}
    with netCDF4.Dataset(path, "a") as file:
        variable = file["quality_flag"]
        masks = {int(bit): first[bit.word] for bit in flags}
        variable[:] = np.vectorize(masks.get)(now).astype(np.int32) | np.int32(more)
        variable.flag_masks = np.array(list(first.values()), np.int32)
        variable.delncattr("lidarops_flag_layout")
    return now


def test_who_goes_by_the_places_of_now_refuses_others(tmp_path: Path):
    older(tmp_path / "older.nc")
    words = "not_level, poor_fit, poorly_determined"
    refused = pytest.raises(ProductError, match=words)
    with refused, open_product(tmp_path / "older.nc", ["quality_flag"]):
        pass
    with xr.open_dataset(tmp_path / "older.nc") as product, pytest.raises(ProductError):
        refuse_moved_flags(product)
    facts = facts_of(tmp_path / "older.nc")
    result = Means(tmp_path, {facts.group: [facts]}, Period.DAY).of(facts.group)
    assert not result.files
    assert [words in refused.reason for refused in result.refused] == [True]


def facts_of(file: Path) -> Facts:
    facts = read_product_facts(file.parent, file.name)
    assert isinstance(facts, Facts)
    return facts


def test_facts_and_inspection_go_by_the_meanings_of_the_file(tmp_path: Path):
    now = older(tmp_path / "older.nc")
    facts = facts_of(tmp_path / "older.nc")
    flags = flags_of("homogeneous")
    assert facts.verdicts.usable == np.count_nonzero((now & flags.rejecting) == 0)
    counts = {bit.word: int(np.count_nonzero(now & int(bit))) for bit in flags}
    assert facts.flagged == {word.upper(): count for word, count in counts.items() if count}
    rows = {row["name"]: row for row in describe(tmp_path / "older.nc")["quality"]}
    assert {word: rows[word]["values"] for word in counts if counts[word]} == {
        word: count for word, count in counts.items() if count
    }


def test_bits_without_a_name_are_reported_by_number(tmp_path: Path):
    older(tmp_path / "older.nc", more=1 << 25 | 1 << 27)
    rows = {row["name"]: row for row in describe(tmp_path / "older.nc")["quality"]}
    assert rows["bit_25"]["severity"] == rows["bit_27"]["severity"] == "unknown"


@pytest.mark.parametrize(
    ("words", "masks", "fits"),
    [("input_missing", 1, True), ("input_missing", 2, False), ("gone", 1, False)],
)
def test_a_file_may_name_fewer_bits_but_no_others(words: str, masks: int, fits: bool):
    flags = xr.DataArray(np.zeros(4, np.int32), dims="time")
    flags.attrs = {"flag_masks": np.int32([masks]), "flag_meanings": words}
    product = xr.Dataset({"quality_flag": flags}, attrs={"lidarops_kind": "signal"})
    with nullcontext() if fits else pytest.raises(ProductError, match=words):
        refuse_moved_flags(product)
    refuse_moved_flags(product.assign_attrs(lidarops_kind="of another package"))


def test_masks_and_meanings_must_agree():
    with pytest.raises(ProductError, match="flag_meanings"):
        stored_bits({"flag_masks": np.array([1, 2]), "flag_meanings": "saturated"}, "signal")


@pytest.mark.parametrize("kind", ["signal", "of another package"])
def test_the_file_tells_what_its_bits_mean_for_values(kind: str):
    stated = {"flag_masks": np.int32([1, 1 << 20]), "flag_meanings": "input_missing breezy"}
    for words, rejecting in (("Bad Indeterminate", 1), ("Indeterminate Bad", 1 << 20)):
        bits = stored_bits({**stated, "flag_assessments": words}, kind)
        assert rejecting_mask(bits[:2]) == rejecting
    with pytest.raises(ProductError, match="flag_assessments"):
        stored_bits({**stated, "flag_assessments": "Bad"}, kind)


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
