"""`lidarops aggregate`, and missing optional packages."""

from __future__ import annotations

import json
import shutil
import sys
from collections import Counter
from pathlib import Path

import h5py
import pytest
from support.archives.aggregate_archive import add_day
from typer.testing import CliRunner

from lidarops.aggregate import need
from lidarops.cli import app
from lidarops.errors import LidarOpsError

pytest.importorskip("pyarrow")


def run(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["aggregate", *map(str, arguments)])
    assert result.exception is None or isinstance(result.exception, SystemExit)
    return result.exit_code, result.output


def test_everything_is_made(tmp_path: Path):
    for day in range(2):
        add_day(tmp_path, day)
        add_day(tmp_path, day, "elastic")
    code, output = run(tmp_path, "--means", "month", "--stac", "--json")
    made = json.loads(output)
    assert code == 0
    assert made["products"] == 4
    assert len(made["means"]) == 2
    files = [made["index"], made["stac"], *(means["path"] for means in made["means"])]
    assert all((tmp_path / file).is_file() for file in files)


def test_a_damaged_product_is_listed_with_exit_code_1(tmp_path: Path):
    add_day(tmp_path, 0)
    damaged = add_day(tmp_path, 1)
    (tmp_path / damaged).write_bytes(b"nothing")
    code, output = run(tmp_path, "--json")
    made = json.loads(output)
    assert code == 1
    assert [product["path"] for product in made["refused"]] == [damaged]
    assert made["products"] == 1


def test_a_selection_leaves_the_index_alone(tmp_path: Path):
    add_day(tmp_path, 0)
    add_day(tmp_path, 0, "signal")
    code, output = run(
        tmp_path, "--kind", "signal", "--since", "2026-01-01", "--means", "day", "--json"
    )
    made = json.loads(output)
    assert code == 0
    assert made["index"] is None
    assert len(made["means"]) == 1
    assert "signal" in made["means"][0]["path"]
    code, output = run(tmp_path, "--kind", "signal", "--stac")
    assert code == 1
    assert "lists all products" in output


def test_stores_are_made_and_their_snapshots_shown(tmp_path: Path):
    pytest.importorskip("icechunk")
    add_day(tmp_path, 0)
    add_day(tmp_path, 0, "signal")
    stores = json.loads(run(tmp_path, "--store", "--json")[1])["stores"]
    assert [store["path"] for store in stores] == ["stores/homogeneous", "stores/signal"]
    assert [store["added"] for store in stores] == [1, 1]
    code, output = run(tmp_path, "--store", "--kind", "signal")
    assert code == 0
    assert stores[1]["snapshot"] in output
    assert stores[0]["snapshot"] not in output
    # What the archive no longer holds leaves its store, even if it was the last of its kind.
    shutil.rmtree(next(tmp_path.glob("products/*/*/signal")))
    _, signals = json.loads(run(tmp_path, "--store", "--json")[1])["stores"]
    assert (signals["path"], signals["groups"], signals["dropped"]) == ("stores/signal", 0, 1)
    code, output = run(tmp_path, "--store", "--since", "2026-01-01")
    assert code == 1
    assert output.count("a store holds all times") == 1


def test_means_and_a_new_store_read_a_product_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    pytest.importorskip("icechunk")
    products = [add_day(tmp_path, day) for day in range(3)]
    opened = []
    file_of = h5py.File
    monkeypatch.setattr(
        h5py, "File", lambda path, *rest, **how: opened.append(path) or file_of(path, *rest, **how)
    )
    means = json.loads(run(tmp_path, "--means", "day", "--store", "--json")[1])["means"]
    # For its facts, and for both.
    counts = Counter(opened)
    assert [counts[tmp_path / path] for path in products] == [2, 2, 2]
    (file,) = (tmp_path / mean["path"] for mean in means)
    together = file.read_bytes()
    assert json.loads(run(tmp_path, "--means", "day", "--json")[1])["means"] == means
    assert file.read_bytes() == together


def test_signals_of_a_scan_have_no_mean_and_the_others_are_made(tmp_path: Path):
    add_day(tmp_path, 0, zenith=[0.0, 10.0, 20.0, 30.0, 40.0])
    add_day(tmp_path, 1, "signal")
    code, output = run(tmp_path, "--means", "day", "--json")
    made = json.loads(output)
    assert code == 0
    assert made["products"] == 2
    assert len(made["means"]) == 1
    assert not made["failed"]
    assert "profiles of several directions" in made["notes"][0]


def test_several_grids_give_a_note(tmp_path: Path):
    add_day(tmp_path, 0)
    add_day(tmp_path, 1, sections=3)
    code, output = run(tmp_path)
    assert code == 0
    assert "products of 2 grids, which are not joined" in " ".join(output.split())
    assert "products.parquet" in output


@pytest.mark.parametrize(
    "wrong",
    [
        ["--kind", "x"], ["--means", "week"], ["--weights", "x"], ["--since", "x"],
        ["--channel", "x"], ["--station", "x"], ["--instrument", "x"],
    ],
)  # fmt: skip
def test_wrong_use_exits_with_2(wrong: list[str], tmp_path: Path):
    add_day(tmp_path, 0)
    assert run(tmp_path, *wrong)[0] == 2


def test_a_folder_without_products_is_refused(tmp_path: Path):
    assert run(tmp_path)[0] == 2
    assert run(tmp_path / "nothing")[0] == 2


def test_a_selection_without_products_lists_known_names(tmp_path: Path):
    add_day(tmp_path, 0)
    code, output = run(tmp_path, "--station", "nope")
    assert (code, "known: " in output) == (2, True)
    # The kind exists, but this archive has no product of it yet.
    assert run(tmp_path, "--kind", "multiangle")[0] == 1
    assert run(tmp_path, "--since", "2030-01-01")[0] == 1


def test_a_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(LidarOpsError, match=r"pip install 'lidarops\[aggregate\]'"):
        need("pyarrow")
