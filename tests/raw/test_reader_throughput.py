"""The reader benchmark returns consistent rates; speed is not asserted."""

from __future__ import annotations

import pytest
from support.licel_strategies import raw_file

from lidarops.bench.throughput import readers
from lidarops.errors import RawFormatError


def test_ways_and_rates(tmp_path):
    paths = [tmp_path / f"file{number}" for number in range(3)]
    for path in paths:
        path.write_bytes(raw_file())
    results = readers.measure_readers(paths, repeats=2)
    assert [result.name for result in results] == [
        "read bytes (floor)",
        "numpy (floor)",
        "header scan",
        "raw to float32",
        "archive to float32",
    ]
    size = len(raw_file()) / 1e6
    for result in results:
        assert result.files_per_second > 0
        assert result.megabytes_per_second == pytest.approx(result.files_per_second * size)
    read, multiply, scan, physical, archive = results
    assert (read.times_floor, multiply.times_floor) == (1.0, 1.0)
    for result, floor in ((scan, read), (physical, multiply), (archive, multiply)):
        ratio = floor.files_per_second / result.files_per_second
        assert result.times_floor == pytest.approx(ratio)


def test_needs_files(tmp_path):
    with pytest.raises(RawFormatError, match="at least one file"):
        readers.measure_readers([])
    with pytest.raises(RawFormatError, match="cannot be opened"):
        readers.measure_readers([tmp_path / "absent"])
