"""Files are written and copied as a whole or not at all."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest

from lidarops.system.files import copy_atomically

SIZE = 20_000_000


def test_a_copy_is_equal_and_not_held_in_memory(tmp_path: Path) -> None:
    source, target = tmp_path / "source", tmp_path / "target"
    source.write_bytes(bytes(range(250)) * (SIZE // 250))
    target.write_bytes(b"old")
    tracemalloc.start()
    copy_atomically(source, target)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < SIZE / 10
    assert target.read_bytes() == source.read_bytes()
    assert target.stat().st_mode & 0o777 == 0o644


def test_a_source_that_is_missing_leaves_the_target(tmp_path: Path) -> None:
    target = tmp_path / "target"
    target.write_bytes(b"old")
    with pytest.raises(FileNotFoundError):
        copy_atomically(tmp_path / "missing", target)
    assert target.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["target"]
