"""Figures do not depend on the number of processes, nor on the loss of one."""

from __future__ import annotations

import logging
import multiprocessing
import os
import subprocess
import sys
import time as clock
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
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
    truth_of,
)

from lidarops.errors import ProductError
from lidarops.figures.kind_figures import ProductSource
from lidarops.figures.raster import Raster, raster_variables, read_raster
from lidarops.records import InputRecord, Role, RunRecord
from lidarops.reports import gallery, reading, run_page
from lidarops.reports.reading import Readers, ReadFailure, ReadTask

SCENES = 6


@pytest.fixture
def many(archive: Archive, tmp_path: Path) -> RunRecord:
    """Return a simulated run of several scenes with unreadable products of two kinds."""
    scenes, all_times = [], []
    for number in range(SCENES):
        time = times(START + timedelta(hours=3 * number), 12, 900.0)
        all_times.append(time)
        products = (
            archive.write(f"e{number}.nc", homogeneous(time, seed=number), "homogeneous"),
            archive.write(f"s{number}.nc", signal(time, bins=80), "signal"),
        )
        inputs = tuple(
            InputRecord(f"raw/h{12 * number + i:05d}", Role.SIGNAL, "b" * 64) for i in range(12)
        )
        scenes.append(outcome(f"horizontal_{number}", products=products, inputs=inputs))
    (archive.root / "e2.nc").unlink()
    (archive.root / "s3.nc").write_bytes(b"nonsense")
    xr.open_dataset(archive.root / "s4.nc").load().drop_vars("signal_standard_error").to_netcdf(
        archive.root / "s4.nc"
    )
    truth = tmp_path / "truth.nc"
    truth_of(np.concatenate(all_times)).to_netcdf(truth)
    return run_record(archive.root, scenes, truth=str(truth))


def files(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


class TestFigures:
    def test_do_not_depend_on_the_number_of_processes(self, many, tmp_path, monkeypatch):
        filled = []
        fill = gallery.fill

        def noted(*arguments, **options):
            filled.append(fill(*arguments, **options))
            return filled[-1]

        monkeypatch.setattr(gallery, "fill", noted)
        run_page.build_report(many, tmp_path / "one")
        monkeypatch.setattr(reading, "FEWEST", 1)
        monkeypatch.setattr(reading, "_AT_A_TIME", 2)
        run_page.build_report(many, tmp_path / "two", workers=2)
        alone, together = filled
        assert files(tmp_path / "one") == files(tmp_path / "two")
        # Pages hold the figures, of which arrays have no single truth.
        assert replace(together, pictures=[]) == replace(alone, pictures=[])
        assert [problem.path for problem in alone.problems] == ["s3.nc", "s4.nc", "e2.nc"]
        assert alone.problems[2].reason == "the file is missing"
        assert alone.problems[1].reason == "signal_standard_error: is missing from the product"
        assert alone.compared

    def test_no_product_is_read_twice(self, many, tmp_path, monkeypatch):
        read = []
        before = reading.open_product

        def noted(path: Path, names: tuple[str, ...]) -> xr.Dataset:
            read.append(path.name)
            return before(path, names)

        monkeypatch.setattr(reading, "open_product", noted)
        gallery.fill(many)
        assert sorted(read) == sorted({*read})
        assert len(read) == 2 * SCENES - 1


def shape(product: xr.Dataset, _: ProductSource) -> tuple[int, ...]:
    return product["signal"].shape


def of_truth(product: xr.Dataset, source: ProductSource) -> float:
    assert source.truth is not None
    return float(source.truth["level"]) + product.sizes["time"]


def refusing(product: xr.Dataset, _: ProductSource) -> None:
    raise ProductError("is of no use", file=product["signal"].attrs.get("none"), field="signal")


def process(product: xr.Dataset, _: ProductSource) -> int:
    return os.getpid()


def deadly(product: xr.Dataset, _: ProductSource) -> int:
    """End any process but the main one."""
    if multiprocessing.parent_process() is not None and product.sizes["time"] == 5:
        os._exit(9)
    return product.sizes["time"]


@pytest.fixture
def paths(archive: Archive) -> list[Path]:
    for count in range(2, 10):
        archive.write(f"{count}.nc", signal(times(START, count, 60.0), bins=4), "signal")
    return [archive.root / f"{count}.nc" for count in range(2, 10)]


def raster_of(product: xr.Dataset, _: ProductSource) -> Raster:
    return read_raster(product, quantity="signal")


def readings(paths: list[Path], read) -> list[ReadTask]:
    return [ReadTask(path, raster_variables("signal"), read, ProductSource()) for path in paths]


@pytest.fixture(scope="module", params=[1, 2])
def readers(request: pytest.FixtureRequest) -> Iterator[Readers]:
    """Readers in this process, and in two others."""
    with Readers(request.param, 1000, xr.Dataset({"level": 100.0})) as opened:
        yield opened


class TestReaders:
    def test_keep_the_order(self, paths, readers, monkeypatch):
        monkeypatch.setattr(reading, "_AT_A_TIME", 1)
        shapes = list(readers.read_all(readings(paths, shape)))
        known = list(readers.read_all(readings(paths, of_truth)))
        refused = list(readers.read_all(readings([*paths, Path("no.nc")], refusing)))
        assert shapes == [(count, 4) for count in range(2, 10)]
        assert known == [100.0 + count for count in range(2, 10)]
        failures = [ReadFailure("signal: is of no use")] * len(paths)
        assert refused == [*failures, ReadFailure("the file is missing")]

    def test_reduce_to_the_same_rasters(self, paths, readers):
        rasters = list(readers.read_all(readings(paths, raster_of)))
        serial = [Readers().read(task) for task in readings(paths, raster_of)]
        for expected, other in zip(serial, rasters, strict=True):
            np.testing.assert_array_equal(expected.sums, other.sums)
            for name in ("bits", "units", "altitude"):
                assert getattr(expected, name) == getattr(other, name)

    def test_no_process_is_started_for_few_products(self, paths):
        for workers, products in ((2, 99), (1, 1000)):
            with Readers(workers, products) as readers:
                assert set(readers.read_all(readings(paths, process))) == {os.getpid()}

    def test_death_of_a_process_stops_nothing(self, paths, monkeypatch, caplog):
        monkeypatch.setattr(reading, "_AT_A_TIME", 1)
        with caplog.at_level(logging.WARNING), Readers(2, 100) as readers:
            assert os.getpid() not in readers.read_all(readings(paths, process))
            assert list(readers.read_all(readings(paths, deadly))) == list(range(2, 10))
            assert list(readers.read_all(readings(paths, shape)))[-1] == (9, 4)
            assert set(readers.read_all(readings(paths, process))) == {os.getpid()}
        assert caplog.text.count("a process was lost") == 1

    def test_a_daemon_process_reads_by_itself(self, paths, monkeypatch):
        monkeypatch.setitem(multiprocessing.current_process()._config, "daemon", True)
        with Readers(2, 1000) as readers:
            assert set(readers.read_all(readings(paths, process))) == {os.getpid()}

    def test_nothing_to_read(self):
        with Readers(2, 1000) as readers:
            assert list(readers.read_all([])) == []

    def test_errors_of_the_program_are_not_hidden_as_file_errors(self, paths):
        with Readers() as readers, pytest.raises(TypeError):
            list(readers.read_all(readings(paths, len)))


_READER = """
import os, sys, time
from pathlib import Path
from lidarops.figures.kind_figures import ProductSource
from lidarops.reports import reading

def wait(product, source):
    Path(sys.argv[1], str(os.getpid())).touch()
    time.sleep(600)

if __name__ == "__main__":
    path = Path(sys.argv[2])
    with reading.Readers(2, 1000) as readers:
        list(readers.read_all([reading.ReadTask(path, (), wait, ProductSource())] * 2))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="uses POSIX processes")
def test_processes_do_not_outlive_the_one_that_started_them(paths, tmp_path):
    script, seen = tmp_path / "reader.py", tmp_path / "seen"
    script.write_text(_READER)
    seen.mkdir()
    with subprocess.Popen([sys.executable, str(script), str(seen), str(paths[0])]) as started:
        deadline = clock.monotonic() + 60
        while not list(seen.iterdir()) and clock.monotonic() < deadline:
            clock.sleep(0.1)
        started.kill()
    (number,) = (int(path.name) for path in list(seen.iterdir())[:1])
    while alive(number) and clock.monotonic() < deadline:
        clock.sleep(0.1)
    assert not alive(number)


def alive(number: int) -> bool:
    try:
        state = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    # A zombie has ended, but has no parent that asks for its exit status.
    return state != "Z"
