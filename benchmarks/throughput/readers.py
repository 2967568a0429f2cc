"""Speed of reading raw files into arrays, compared with minimal operations in the same run.

Times are CPU times of this process, the minimum of several repeats, with files in the page cache.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import dask
import numpy as np
from numpy.typing import NDArray

from benchmarks.harness.results import Effort, Results, Study
from benchmarks.harness.timing import least_times
from benchmarks.harness.verdicts import Scores
from lidarops.errors import RawFormatError
from lidarops.raw.archive import open_archive
from lidarops.raw.licel import read_counts, read_header, select


def measure_readers(effort: Effort) -> Study:
    """Return the speed of the header scan, of raw files to float32 and of opening an archive.

    The floors come first: reading the bytes; reading them with ``np.frombuffer`` and one
    multiplication per channel at known offsets. The header scan is compared with the first,
    functions that return physical values with the second.

    Parameters
    ----------
    effort : Effort
        With files of one layout.

    Raises
    ------
    RawFormatError
        If there is no file, or one cannot be read.
    """
    paths = effort.files
    if not paths:
        raise RawFormatError("at least one file is needed", field="paths")
    size = sum(read_header(path).size for path in paths)
    channels = [
        (dataset.offset or 0, dataset.bins, np.float32(dataset.scale))
        for dataset in select(read_header(paths[0]))
    ]
    calls: dict[str, Callable[[], object]] = {
        "read bytes (floor)": lambda: [path.read_bytes() for path in paths],
        "numpy (floor)": lambda: _multiply(paths, channels),
        "header scan": lambda: [read_header(path) for path in paths],
        "raw to float32": lambda: _scale(paths),
        "archive to float32": lambda: _archive(paths),
    }
    read, multiply, scan, *_ = calls
    times = least_times(calls, effort.repeats or 7)
    scores: Scores = {
        ("", name): {
            "files/s": len(paths) / seconds,
            "MB/s": size / seconds / 1e6,
            "times floor": seconds / times[read if name in {read, scan} else multiply],
        }
        for name, seconds in times.items()
    }
    note = "Raw files to arrays, from the page cache, against floors measured in the same run."
    results = Results("One core, CPU time", scores, note, method="what")
    return Study("Reader: files per second", effort.date, [results])


def _multiply(
    paths: Sequence[Path], channels: Sequence[tuple[int, int, np.float32]]
) -> NDArray[Any]:
    values = np.empty((len(paths), sum(bins for _, bins, _ in channels)), np.float32)
    for row, path in zip(values, paths, strict=True):
        content = path.read_bytes()
        start = 0
        for offset, bins, scale in channels:
            counts = np.frombuffer(content, "<i4", bins, offset)
            np.multiply(counts, scale, out=row[start : start + bins], casting="unsafe")
            start += bins
    return values


def _scale(paths: Sequence[Path]) -> list[NDArray[np.float32]]:
    values = []
    for path in paths:
        header, counts = read_counts(path)
        values += [
            (counts[dataset.name] * dataset.scale).astype(np.float32)
            for dataset in select(header, counts)
        ]
    return values


def _archive(paths: Sequence[Path]) -> None:
    with dask.config.set(scheduler="synchronous"):
        open_archive(paths).compute()
