"""The reader benchmark returns consistent rates; speed is not asserted."""

from __future__ import annotations

import pytest
from support.licel_strategies import raw_file

from benchmarks.harness.results import Effort
from benchmarks.throughput import readers
from lidarops.errors import RawFormatError


def test_ways_and_rates(tmp_path):
    paths = [tmp_path / f"file{number}" for number in range(3)]
    for path in paths:
        path.write_bytes(raw_file())
    rows = readers.measure_readers(Effort(repeats=2, files=paths)).figures("One core, CPU time")
    names = list(dict.fromkeys(name for _, name, _ in rows))
    assert names == [
        "read bytes (floor)",
        "numpy (floor)",
        "header scan",
        "raw to float32",
        "archive to float32",
    ]
    rate = {name: rows["", name, "files/s"].value for name in names}
    for name in names:
        megabytes = rate[name] * len(raw_file()) / 1e6
        assert rate[name] > 0
        assert rows["", name, "MB/s"].value == pytest.approx(megabytes)
    read, multiply, scan, physical, archive = names
    for name, floor in ((read, read), (scan, read), (physical, multiply), (archive, multiply)):
        assert rows["", name, "times floor"].value == pytest.approx(rate[floor] / rate[name])


def test_needs_files(tmp_path):
    with pytest.raises(RawFormatError, match="at least one file"):
        readers.measure_readers(Effort())
    with pytest.raises(RawFormatError, match="cannot be opened"):
        readers.measure_readers(Effort(files=[tmp_path / "absent"]))
