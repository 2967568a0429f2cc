"""A kind of product that another package adds is shown by reports, pages and means."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from support.archives import site_archive
from support.archives.aggregate_archive import facts_of
from support.products import fabricated as fab
from support.products.made_products import MAKERS

from lidarops import kinds
from lidarops.aggregate import means as means_of_products
from lidarops.aggregate.facts import Period, groups
from lidarops.aggregate.means import Means
from lidarops.netcdf.variables import layout_of
from lidarops.reports import run_page
from lidarops.reports.gallery import Gallery, fill
from lidarops.site.build import build_site

KIND = """
from lidarops.kinds import Kind
from lidarops.settings import ChannelProduct

KIND = Kind("smooth", "Smoothed extinction", __name__, ChannelProduct, rank=25)
"""
FLAGS = """
from lidarops.flags import FIRST_OWN, FlagBit, Flags, Quality, Severity
from lidarops.products.homogeneous.variables import FLAGS as OTHER


class SmoothQuality(FlagBit):
    RIPPLED = FIRST_OWN, Severity.CARE, "the smoothed profile has ripples"


FLAGS = Flags("smooth", 1, (*(bit for bit in OTHER if isinstance(bit, Quality)), *SmoothQuality))
"""
VARIABLES = """
from dataclasses import replace

from madeup_smooth.flags import FLAGS
from lidarops.netcdf.variables import ErrorBudget
from lidarops.products.homogeneous.variables import LAYOUT as OTHER

LAYOUT = replace(
    OTHER,
    data=tuple(
        replace(row, budget=ErrorBudget(comment="All is shared."))
        if row.name == "total_extinction"
        else replace(row, flags=row.flags and FLAGS)
        for row in OTHER.data
    ),
)
"""
FIGURES = """
import numpy as np

from lidarops.figures.kind_figures import KindFigures, View
from lidarops.figures.panels import Axis, Curve, Figure, Panel


def read(product, columns):
    return product.sizes["time"]


def draw(contents):
    axis, ends = Axis("smooth", 0.0, 1.0), np.array([0.0, 1.0])
    panel = Panel(axis, axis, (Curve(ends, ends),))
    yield Figure("A smooth figure", f"Of {sum(contents)} times", (panel,))


FIGURES = KindFigures((View("even", ("time",), read, draw),), preferred="amplitude")
"""
Register = Callable[..., None]


@pytest.fixture
def register(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Register]:
    """Return a function that adds the kind, with some of its modules."""

    def add(**modules: str) -> None:
        package = tmp_path / "code" / "madeup_smooth"
        package.mkdir(parents=True)
        for name, text in {
            "__init__": KIND,
            "flags": FLAGS,
            "variables": VARIABLES,
            **modules,
        }.items():
            (package / f"{name}.py").write_text(text)
        monkeypatch.syspath_prepend(package.parent)
        point = EntryPoint("smooth", "madeup_smooth:KIND", kinds.GROUP)

        def points(group: str) -> list[Any]:
            return [*entry_points(group=group), *([point] if group == kinds.GROUP else [])]

        monkeypatch.setattr(kinds, "entry_points", points)
        monkeypatch.setitem(MAKERS, "smooth", MAKERS["homogeneous"])
        forget()

    def forget() -> None:
        kinds.kinds.cache_clear()
        kinds.flags_of.cache_clear()
        layout_of.cache_clear()
        for name in [name for name in sys.modules if name.startswith("madeup_smooth")]:
            del sys.modules[name]

    yield add
    monkeypatch.undo()
    forget()


def _page(output: Path) -> str:
    site_archive.add(output, "smooth")
    site_archive.add(output, "elastic")
    made = build_site(output)
    assert (made.products, made.problems) == (2, ())
    (day,) = (output / "site").rglob("2026-03-01.html")
    text = day.read_text(encoding="utf-8")
    assert text.index("Smoothed extinction") < text.index("Backscatter of elastic profiles")
    (page,) = (page for page in (output / "site/product").rglob("*.html") if "smooth" in page.name)
    return page.read_text(encoding="utf-8")


def _report(folder: Path) -> Gallery:
    time = fab.times(fab.START, 40, 600.0)
    archive = fab.Archive(folder / "products")
    records = [
        archive.write(f"{kind}.nc", fab.homogeneous(time), kind)
        for kind in ("smooth", "homogeneous", "wind")
    ]
    run = fab.run_record(archive.root, [fab.outcome("a_1", fab.START, products=tuple(records))])
    assert run_page.build_report(run, folder / "report").page.is_file()
    gallery = fill(run)
    assert not gallery.problems
    return gallery


def test_without_figures_the_main_variable_is_shown(register: Register, tmp_path: Path) -> None:
    register()
    text = _page(tmp_path / "out")
    assert text.count('<div class="fig"') == 1
    assert "Extinction coefficient of molecules and particles against time" in text
    first, second, third = _report(tmp_path).pictures
    assert first.caption.startswith("Extinction and background of range sections")
    assert "against time" in second.caption
    # A kind that is not installed comes last.
    assert third.caption.startswith("Total_extinction against time")


def test_figures_are_those_of_the_kind(register: Register, tmp_path: Path) -> None:
    register(figures=FIGURES)
    text = _page(tmp_path / "out")
    assert text.count('<div class="fig"') == 2
    assert "A smooth figure" in text
    _, figure, _ = _report(tmp_path).pictures
    assert figure.caption.startswith("A smooth figure: ")
    assert figure.words.endswith("Of 40 times.")


def test_means_follow_its_budget(
    register: Register, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    register()
    # It has no source on disk whose digest could be taken.
    monkeypatch.setattr(means_of_products, "code_version", lambda *_: "0" * 16)
    path = site_archive.add(tmp_path, "smooth")
    (group,) = grouped = groups(facts_of(tmp_path))
    (file,) = Means(tmp_path, grouped, Period.DAY).of(group).files
    with xr.open_dataset(path) as data, xr.open_dataset(tmp_path / file.path) as means:
        error = data.total_extinction_standard_error.where(data.usable < 2).astype(float)
        np.testing.assert_allclose(
            means.total_extinction_standard_error[0], error.mean("time"), rtol=1e-5
        )
        assert means.total_extinction.attrs["comment"].endswith("All is shared.")
