"""The index of products: queries and size."""

from __future__ import annotations

from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from uuid import UUID

import numpy as np
import pandas as pd
import pytest
from support.archives.aggregate_archive import add_day, facts_of

from lidarops.aggregate import index as indices
from lidarops.aggregate.facts import Facts, ProductSelection
from lidarops.aggregate.index import (
    INDEX,
    KnownFacts,
    find_in_index,
    find_products,
    write_index,
)
from lidarops.errors import ProductError, RetrievalInputError
from lidarops.records import Verdicts

pytest.importorskip("pyarrow")

VALUES = {
    "signal": 144 * 4096,
    "homogeneous": 144 * 3,
    "elastic": 48 * 2000,
    "multiangle": 24 * 100,
    "visibility": 144 * 3,
}


def fabricated(count: int) -> list[Facts]:
    """Return facts of products of ten years, with random digests and counts."""
    rng = np.random.default_rng(3)
    products = []
    for number in range(count):
        kind = list(VALUES)[number % len(VALUES)]
        channel = ("analog_532o", "photon_532o")[number // 4 % 2]
        start = datetime(2015, 1, 1, tzinfo=UTC) + timedelta(days=number // 8)
        values = VALUES[kind]
        usable = int(rng.integers(values // 3, values))
        cloudy = kind == "elastic" and rng.random() < 0.4
        products.append(
            Facts(
                path=f"products/odesa/lidar-1/{kind}/{start:%Y}/odesa_lidar-1_{kind}"
                f"_{channel}_{start:%Y%m%dT%H%M%S}.nc",
                id=str(UUID(bytes=rng.bytes(16))),
                kind=kind,
                campaign="demo",
                station="odesa",
                instrument="lidar-1",
                channel=channel,
                mode=channel.partition("_")[0],
                wavelength=532e-9,
                start=start,
                stop=start + timedelta(minutes=int(rng.integers(600, 1440))),
                latitude=46.44,
                longitude=30.76,
                altitude=53.5,
                sha256=rng.bytes(32).hex(),
                size=int(rng.normal(4e5, 5e3)),
                profiles=144,
                verdicts=Verdicts.of(
                    values, unflagged=int(usable * rng.uniform(0.5, 1.0)), usable=usable
                ),
                grid="0123456789abcdef",
                code_version="0123456789abcdef",
                flagged={
                    "INCOMPLETE_OVERLAP": values // 40,
                    "CLOUD": int(rng.integers(0, values // 3)) if cloudy else 0,
                },
            )
        )
    return products


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Facts]]:
    root = tmp_path_factory.mktemp("index")
    products = fabricated(20_000)
    return root / write_index(root, products), products


def test_twenty_thousand_products_take_less_than_a_megabyte(archive: tuple[Path, list[Facts]]):
    assert archive[0].stat().st_size <= 1_000_000


def test_a_query_returns_exactly_the_products_that_overlap(archive: tuple[Path, list[Facts]]):
    index, products = archive
    since, until = "2018-02-03T12:00", datetime(2018, 5, 1, tzinfo=UTC)
    table = find_products(index, kind="elastic", channel="photon_532o", since=since, until=until)
    selection = ProductSelection(
        "elastic",
        "photon_532o",
        since=datetime(2018, 2, 3, 12, tzinfo=UTC),
        until=datetime(2018, 5, 1, tzinfo=UTC),
    )
    expected = [
        facts for facts in products if selection.admits(asdict(facts), facts.start, facts.stop)
    ]
    assert 60 < len(expected) < 80
    assert table.path.tolist() == [facts.path for facts in expected]
    assert table.attrs["root"] == str(index.parents[1])


def test_the_index_keeps_every_fact(archive: tuple[Path, list[Facts]]):
    index, products = archive
    table = find_products(index)
    by_path = {facts.path: facts for facts in products}
    assert len(table) == len(products)
    for row in table.sample(50, random_state=1).itertuples():
        facts = by_path[row.path]
        assert UUID(row.id) == UUID(facts.id)
        assert row.sha256_prefix == facts.sha256[:32]
        assert (row.start, row.stop) == (facts.start, facts.stop)
        for name in ("kind", "mode", "size", "wavelength", "grid"):
            assert getattr(row, name) == getattr(facts, name)
        assert (row.good, row.care, row.reject) == facts.verdicts
        assert row.flag_cloud == facts.flagged.get("CLOUD", 0)
        assert row.flag_saturated == 0


def test_a_query_without_matches_is_empty(archive: tuple[Path, list[Facts]]):
    table = find_products(archive[0], station="nowhere")
    assert isinstance(table, pd.DataFrame)
    assert table.empty
    assert "path" in table


def test_wrong_arguments_list_the_choices(archive: tuple[Path, list[Facts]]):
    with pytest.raises(RetrievalInputError, match=r"kind: is 'nothing'.*homogeneous"):
        find_products(archive[0], kind="nothing")
    with pytest.raises(RetrievalInputError, match="since: is 'yesterday'"):
        find_products(archive[0], since="yesterday")


def test_equal_products_give_equal_bytes_in_any_order(tmp_path: Path):
    products = fabricated(50)
    first = (tmp_path / write_index(tmp_path, products)).read_bytes()
    assert (tmp_path / write_index(tmp_path, reversed(products))).read_bytes() == first


def test_the_index_of_real_files_can_be_queried(tmp_path: Path):
    for day in range(3):
        add_day(tmp_path, day)
    index = tmp_path / write_index(tmp_path, facts_of(tmp_path))
    assert index.name == INDEX
    selection = ProductSelection(since=datetime(2026, 3, 2, tzinfo=UTC))
    root, paths = find_in_index(index, selection)
    assert root == tmp_path.resolve()
    assert [path[-11:-3] for path in paths] == ["2T000000", "3T000000"]


def test_facts_of_products_that_have_not_changed_come_from_the_index(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for day in range(3):
        add_day(tmp_path, day)
    read = facts_of(tmp_path)
    first, *others = [facts.path for facts in read]
    write_index(tmp_path, read)
    assert [KnownFacts(tmp_path).of(facts.path) for facts in read] == read
    assert KnownFacts(tmp_path).of("products/other.nc") is None
    # Of another content of equal size.
    content = bytearray((tmp_path / first).read_bytes())
    content[-1] ^= 1
    (tmp_path / first).write_bytes(content)
    assert [KnownFacts(tmp_path).of(path) is None for path in (first, *others)] == [
        True,
        False,
        False,
    ]
    monkeypatch.setattr(indices, "module_version", lambda _: "of other code")
    assert all(KnownFacts(tmp_path).of(path) is None for path in others)


def test_an_unknown_wavelength_is_missing(tmp_path: Path):
    facts = replace(fabricated(1)[0], wavelength=float("nan"))
    table = find_products(tmp_path / write_index(tmp_path, [facts]))
    assert np.isnan(table.wavelength[0])


@pytest.mark.parametrize("content", [b"", b"PAR1 and something else PAR1"])
def test_other_files_are_refused(content: bytes, tmp_path: Path):
    (tmp_path / INDEX).write_bytes(content)
    with pytest.raises(ProductError, match="index"):
        find_products(tmp_path / INDEX)


def test_another_parquet_table_is_refused(tmp_path: Path):
    pd.DataFrame({"path": ["a"]}).to_parquet(tmp_path / INDEX)
    with pytest.raises(ProductError, match="is not an index of this version"):
        find_products(tmp_path / INDEX)


def test_an_index_with_the_columns_of_before_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its numbers of values were those of usable and unflagged ones."""
    with monkeypatch.context() as patch:
        patch.setattr(indices, "FORMAT", b"1")
        index = tmp_path / write_index(tmp_path, fabricated(8))
    with pytest.raises(ProductError, match="not an index of this version"):
        find_in_index(index, ProductSelection())
