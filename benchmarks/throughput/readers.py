"""Speed of reading raw files into arrays, compared with minimal operations in the same run.

Times are CPU times of this process, the minimum of several repeats, with files in the page cache.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import dask
import numpy as np
from numpy.typing import NDArray

from benchmarks.harness.benchmark import Effort
from benchmarks.harness.rows import rows_of
from benchmarks.harness.study import Chapter, Results, Study
from benchmarks.harness.timing import least_times
from lidarops.errors import RawFormatError
from lidarops.raw.archive import open_archive
from lidarops.raw.licel import read_counts, read_header, select

_Paths = Sequence[str | os.PathLike[str]]
_REPEATS: Final = 7


def measure_readers(effort: Effort, paths: _Paths) -> Study:
    """Return the speed of the header scan, of raw files to float32 and of opening an archive.

    The floors come first: reading the bytes; reading them with ``np.frombuffer`` and one
    multiplication per channel at known offsets. The header scan is compared with the first,
    functions that return physical values with the second.

    Parameters
    ----------
    effort : Effort
    paths : sequence of path or str
        Files of one layout.

    Raises
    ------
    RawFormatError
        If there is no file, or one cannot be read.
    """
    if not paths:
        raise RawFormatError("at least one file is needed", field="paths")
    size = sum(read_header(path).size for path in paths)
    channels = [
        (dataset.offset or 0, dataset.bins, np.float32(dataset.scale))
        for dataset in select(read_header(paths[0]))
    ]
    floors: dict[str, Callable[[], object]] = {
        "read bytes (floor)": lambda: _read_bytes(paths),
        "numpy (floor)": lambda: _multiply(paths, channels),
    }
    read, multiply = floors
    compared = {"header scan": read, "raw to float32": multiply, "archive to float32": multiply}
    calls = floors | {
        "header scan": lambda: [read_header(path) for path in paths],
        "raw to float32": lambda: _scale(paths),
        "archive to float32": lambda: _archive(paths),
    }
    times = least_times(calls, effort.repeats or _REPEATS)
    rows = [
        row
        for name, seconds in times.items()
        for row in rows_of(
            "",
            name,
            {
                "files/s": len(paths) / seconds,
                "MB/s": size / seconds / 1e6,
                "times floor": seconds / times[compared.get(name, name)],
            },
        )
    ]
    text = "Raw files to arrays, from the page cache, against floors measured in the same run."
    results = Results("One core, CPU time", rows, method="what")
    return Study("Reader: files per second", effort.date, [Chapter("Throughput", text, [results])])


def _read_bytes(paths: _Paths) -> None:
    for path in paths:
        _read(path)


def _read(path: str | os.PathLike[str]) -> bytes:
    with Path(path).open("rb", buffering=0) as file:
        return file.read()


def _multiply(paths: _Paths, channels: list[tuple[int, int, np.float32]]) -> NDArray[Any]:
    values = np.empty((len(paths), sum(bins for _, bins, _ in channels)), np.float32)
    for row, path in zip(values, paths, strict=True):
        content = _read(path)
        start = 0
        for offset, bins, scale in channels:
            counts = np.frombuffer(content, "<i4", bins, offset)
            np.multiply(counts, scale, out=row[start : start + bins], casting="unsafe")
            start += bins
    return values


def _scale(paths: _Paths) -> list[NDArray[np.float32]]:
    values = []
    for path in paths:
        header, counts = read_counts(path)
        values += [
            (counts[dataset.name] * dataset.scale).astype(np.float32)
            for dataset in select(header, counts)
        ]
    return values


def _archive(paths: _Paths) -> None:
    with dask.config.set(scheduler="synchronous"):
        open_archive(paths).compute()
