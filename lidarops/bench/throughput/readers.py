"""Speed of reading raw files into arrays, compared with minimal operations in the same run.

Times are CPU times of this process, the minimum of several repeats, with files in the page cache.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dask
import numpy as np
from numpy.typing import NDArray

from lidarops.errors import RawFormatError
from lidarops.raw.archive import open_archive
from lidarops.raw.licel import read_header, read_physical, select


@dataclass(frozen=True, slots=True)
class ReaderThroughput:
    """Speed of one reading function."""

    name: str
    files_per_second: float
    """Files per second of CPU time."""
    megabytes_per_second: float
    """10^6 bytes of raw file per second of CPU time."""
    times_floor: float
    """CPU time over that of the minimal operation (floor); 1 for the floor itself."""


def measure_readers(
    paths: Sequence[str | os.PathLike[str]], repeats: int = 7
) -> list[ReaderThroughput]:
    """Return the speed of the header scan, of raw files to float32 and of opening an archive.

    Parameters
    ----------
    paths : sequence of path or str
        Files of one layout.
    repeats : int
        The least time of these counts.

    Returns
    -------
    list of ReaderThroughput
        The floors first: reading the bytes; reading them with ``np.frombuffer`` and one
        multiplication per channel at known offsets. The header scan is compared with the first,
        functions that return physical values with the second.

    Raises
    ------
    RawFormatError
        If there is no file, or one cannot be read.
    """
    if not paths or repeats < 1:
        raise RawFormatError("at least one file and one repeat are needed", field="paths")
    size = sum(read_header(path).size for path in paths)
    channels = [
        (dataset.offset or 0, dataset.bins, np.float32(dataset.scale))
        for dataset in select(read_header(paths[0]))
    ]
    read = _least(lambda: _read_bytes(paths), repeats)
    multiply = _least(lambda: _multiply(paths, channels), repeats)
    functions: list[tuple[str, Callable[[], object], float]] = [
        ("header scan", lambda: [read_header(path) for path in paths], read),
        ("raw to float32", lambda: read_physical(paths), multiply),
        ("archive to float32", lambda: _archive(paths), multiply),
    ]
    timed = [("read bytes (floor)", read, read), ("numpy (floor)", multiply, multiply)]
    timed += [(name, _least(function, repeats), floor) for name, function, floor in functions]
    return [
        ReaderThroughput(name, len(paths) / seconds, size / seconds / 1e6, seconds / floor)
        for name, seconds, floor in timed
    ]


def _least(function: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        function()
        times.append(time.process_time() - begin)
    # A coarse clock may not advance during a fast call.
    return max(min(times), 1e-9)


def _read_bytes(paths: Sequence[str | os.PathLike[str]]) -> None:
    for path in paths:
        _read(path)


def _read(path: str | os.PathLike[str]) -> bytes:
    with Path(path).open("rb", buffering=0) as file:
        return file.read()


def _multiply(
    paths: Sequence[str | os.PathLike[str]], channels: list[tuple[int, int, np.float32]]
) -> NDArray[Any]:
    values = np.empty((len(paths), sum(bins for _, bins, _ in channels)), np.float32)
    for row, path in zip(values, paths, strict=True):
        content = _read(path)
        start = 0
        for offset, bins, scale in channels:
            counts = np.frombuffer(content, "<i4", bins, offset)
            np.multiply(counts, scale, out=row[start : start + bins], casting="unsafe")
            start += bins
    return values


def _archive(paths: Sequence[str | os.PathLike[str]]) -> None:
    with dask.config.set(scheduler="synchronous"):
        open_archive(paths).compute()
