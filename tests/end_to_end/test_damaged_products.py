"""A damaged product costs one line: a command on it states it, any other goes on without it."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from support.archives.small_archive import Archive, made
from support.damage import OF_ANY_FILE
from typer.testing import CliRunner

from lidarops.campaign.model import Campaign
from lidarops.catalog.product_files import verify_archive
from lidarops.catalog.store import Store
from lidarops.cli import app
from lidarops.netcdf import stored
from lidarops.netcdf.comparison import compare_products
from lidarops.records import Grade
from lidarops.run.archive import reprocess

pytest.importorskip("pyarrow")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an archive with products of every kind of one channel, on three days."""
    folder = tmp_path_factory.mktemp("finished")
    assert reprocess(Archive(folder, days=3).write()) is not None
    return folder


def _run(*arguments: object) -> tuple[int, str]:
    """Run a command; return its exit code and all that it shows."""
    result = CliRunner().invoke(app, [str(word) for word in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), arguments
    return result.exit_code, result.output


def _products(folder: Path) -> list[Path]:
    return sorted((folder / "out/products").rglob("*.nc"))


def _draw(products: Sequence[Path], rng: random.Random, number: int) -> dict[Path, bytes]:
    """Return products with what damage leaves of them."""
    drawn = {}
    for at, product in enumerate(rng.sample(list(products), number)):
        damaged = product.read_bytes()
        # Few single bits of a product matter.
        for _ in range(5):
            damaged = OF_ANY_FILE[at % len(OF_ANY_FILE)](damaged, rng)
        drawn[product] = damaged
    return drawn


@pytest.mark.parametrize("rounds", [1, pytest.param(17, marks=pytest.mark.slow)])
def test_commands_state_a_damaged_product_in_one_line(
    finished: Path, tmp_path: Path, rounds: int
) -> None:
    rng = random.Random(rounds)
    stated = 0
    for _ in range(rounds):
        for product, damaged in _draw(_products(finished), rng, 12).items():
            file = tmp_path / "damaged.nc"
            file.write_bytes(damaged)
            for command in (
                ("inspect", file),
                ("plot", file, "--out", tmp_path / "figure.png"),
                ("compare", product, file),
                ("compare", file, product),
            ):
                code, output = _run(*command)
                assert code in (0, 1, 2)
                if output.startswith("error: "):
                    assert code
                    stated += 1
                    assert output.count("\n") == 1
                    assert file.name in output
    assert stated > 20 * rounds


@pytest.mark.parametrize("rounds", [1, pytest.param(17, marks=pytest.mark.slow)])
def test_site_and_aggregates_go_on_without_damaged_products(
    finished: Path, tmp_path: Path, rounds: int
) -> None:
    rng = random.Random(rounds)
    whole = len(_products(finished))
    for number in range(rounds):
        folder = tmp_path / str(number)
        shutil.copytree(finished / "out/products", folder / "products")
        drawn = _draw(sorted((folder / "products").rglob("*.nc")), rng, 12)
        for product, damaged in drawn.items():
            product.write_bytes(damaged)
        code, output = _run("site", folder, "--json")
        built = json.loads(output)
        listed = {problem["path"] for problem in built["problems"]}
        assert code == 1
        assert built["products"] + len(listed) >= whole
        assert {folder / "products" / path for path in listed} <= drawn.keys()
        options = ("--means", "month", "--stac", "--store", "--json")
        code, output = _run("aggregate", folder, *options)
        joined = json.loads(output)
        refused = {product["path"] for product in joined["refused"]}
        assert code == 1
        assert {folder / path for path in refused} <= drawn.keys()
        assert whole - len(drawn) <= joined["products"] < whole


def _foreign(error: Exception) -> Callable[..., Any]:
    def failing(*_: Any, **__: Any) -> Any:
        raise error

    return failing


@pytest.mark.parametrize(
    "error",
    [
        AttributeError("NetCDF: HDF error"),
        MemoryError(),
        OverflowError("Python integer 70000 out of bounds"),
        UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_whatever_the_library_raises_is_stated(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    product = _products(finished)[0]
    monkeypatch.setattr(stored, "StoredProduct", _foreign(error))
    for command in (
        ("inspect", product),
        ("plot", product, "--out", tmp_path / "figure.png"),
        ("compare", product, product),
        ("reproduce", product),
    ):
        code, output = _run(*command)
        assert code == 1
        assert output.startswith(f"error: {product}: cannot be read: ")
        assert output.count("\n") == 1
    code, output = _run("aggregate", finished / "out")
    assert code == 1
    assert "no product found" in output


def test_a_damaged_product_is_found_and_made_again(tmp_path: Path) -> None:
    campaign: Campaign = Archive(tmp_path, days=1).write()
    assert reprocess(campaign) is not None
    held = {product: product.read_bytes() for product in _products(tmp_path)}
    drawn = _draw(list(held), random.Random(3), 4)
    for product, damaged in drawn.items():
        product.write_bytes(damaged)
    with Store(campaign.catalog_url, campaign.name) as store:
        found = {checked.path for checked in verify_archive(campaign, store) if checked.problem}
    assert {campaign.products_root / path for path in found} == drawn.keys()
    assert len(made(reprocess(campaign))) == len(drawn)
    copy = tmp_path / "held.nc"
    for product, content in held.items():
        copy.write_bytes(content)
        assert compare_products(copy, product).grade is Grade.NONE
    assert reprocess(campaign) is None
