"""Fixtures for tests of reports and figures."""

from __future__ import annotations

from pathlib import Path

import pytest

from lidarops.records import InputRecord, Role, RunRecord
from support.products.fabricated import (
    START,
    Archive,
    homogeneous,
    outcome,
    run_record,
    signal,
    times,
)


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    """Return an empty product folder."""
    return Archive(tmp_path / "products")


@pytest.fixture
def simulated(archive: Archive) -> RunRecord:
    """Return the record of a run over one day."""
    time = times(START, 96, 900.0)
    products = (
        archive.write("h/extinction.nc", homogeneous(time), "homogeneous"),
        archive.write("h/signal.nc", signal(time, bins=200), "signal"),
    )
    inputs = tuple(InputRecord(f"raw/h{i:05d}", Role.SIGNAL, "b" * 64) for i in range(96))
    scene = outcome("horizontal_20240301T000000", granules=96, products=products, inputs=inputs)
    return run_record(archive.root, [scene])
