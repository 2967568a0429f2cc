"""Figures do not depend on the number of processes, nor on the loss of one."""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest
import xarray as xr
from support.products.fabricated import (
    START,
    Archive,
    homogeneous,
    outcome,
    run_record,
    signal,
    times,
)

from lidarops.records import RunRecord
from lidarops.reports import gallery, run_page

SCENES = 6


@pytest.fixture
def many(archive: Archive) -> RunRecord:
    """Return a run of several scenes with unreadable products of two kinds."""
    scenes = []
    for number in range(SCENES):
        time = times(START + timedelta(hours=3 * number), 12, 900.0)
        products = (
            archive.write(f"e{number}.nc", homogeneous(time, seed=number), "homogeneous"),
            archive.write(f"s{number}.nc", signal(time, bins=80), "signal"),
        )
        scenes.append(outcome(f"horizontal_{number}", products=products))
    (archive.root / "e2.nc").unlink()
    (archive.root / "s3.nc").write_bytes(b"nonsense")
    xr.open_dataset(archive.root / "s4.nc").load().drop_vars("signal_standard_error").to_netcdf(
        archive.root / "s4.nc"
    )
    return run_record(archive.root, scenes)


def files(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.mark.usefixtures("server")
class TestFigures:
    def test_do_not_depend_on_the_number_of_processes(self, many, tmp_path, monkeypatch):
        filled = []
        fill = gallery.fill

        def noted(*arguments, **options):
            filled.append(fill(*arguments, **options))
            return filled[-1]

        monkeypatch.setattr(gallery, "fill", noted)
        run_page.build_report(many, tmp_path / "one")
        monkeypatch.setattr(gallery, "FEWEST", 1)
        monkeypatch.setattr(gallery, "_AT_A_TIME", 2)
        run_page.build_report(many, tmp_path / "two", workers=2)
        alone, together = filled
        assert files(tmp_path / "one") == files(tmp_path / "two")
        # Pages hold the figures, of which arrays have no single truth.
        assert replace(together, pictures=[]) == replace(alone, pictures=[])
        assert list(alone.problems) == ["s3.nc", "s4.nc", "e2.nc"]
        assert alone.problems["e2.nc"] == "the file is missing"
        assert alone.problems["s4.nc"] == "signal_standard_error: is missing from the product"

    def test_no_product_is_read_twice(self, many, tmp_path, monkeypatch):
        read = []
        before = gallery.open_product

        def noted(path: Path, names: tuple[str, ...]) -> xr.Dataset:
            # The light of a group is that of its first product.
            read.extend([path.name] if "time" in names else [])
            return before(path, names)

        monkeypatch.setattr(gallery, "open_product", noted)
        gallery.fill(many)
        assert sorted(read) == sorted({*read})
        assert len(read) == 2 * SCENES

    def test_name_a_product_that_crashes_its_process(self, many, monkeypatch, caplog):
        alone = gallery.fill(many)
        monkeypatch.setattr(gallery, "FEWEST", 1)
        monkeypatch.setattr(gallery, "_content", deadly)
        with caplog.at_level(logging.WARNING):
            together = gallery.fill(many, workers=2)
        crashed = {"e1.nc": "reading it crashed the process"}
        assert together.problems == alone.problems | crashed
        assert len(together.pictures) == len(alone.pictures)
        assert caplog.text.count("a process was lost") == 1

    def test_errors_of_the_program_are_not_hidden_as_file_errors(self, many, monkeypatch):
        monkeypatch.setattr(gallery, "_content", lambda *_: len(3))
        with pytest.raises(TypeError):
            gallery.fill(many)


CONTENT = gallery._content


def deadly(names, read, columns, file):
    """End the process at a product."""
    if file.name == "e1.nc":
        os._exit(9)
    return CONTENT(names, read, columns, file)
