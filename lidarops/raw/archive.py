"""Many raw files of one layout as one dask-backed Dataset.

The data model is that of `lidarops.raw.model`. Headers are read once, when the archive is opened,
and of files that the catalog knows to be alike one is;
a task of the graph reads the bytes of one channel in the files of one chunk.
"""

from __future__ import annotations

import glob
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import dask.array as da
import numpy as np
import xarray as xr
from dask.base import tokenize
from numpy.typing import NDArray

from lidarops.errors import RawFormatError
from lidarops.raw.licel import Dataset, RawFile, channel_names, header_digest, to_physical
from lidarops.raw.model import Columns, Position, Stretches, build_raw_dataset
from lidarops.records import Granule

Source = str | os.PathLike[str] | Iterable[str | os.PathLike[str] | Granule]

_CHUNK_BYTES = 16_000_000


@dataclass(slots=True)
class Tally:
    """Bytes of signals that were read."""

    bytes: int = 0


_TALLY: ContextVar[Tally | None] = ContextVar("tally", default=None)


@contextmanager
def counting() -> Iterator[Tally]:
    """Count the bytes of signals that are read in this thread; headers do not count."""
    tally = Tally()
    token = _TALLY.set(tally)
    try:
        yield tally
    finally:
        _TALLY.reset(token)


def open_archive(
    source: Source,
    *,
    channels: Iterable[str] | None = None,
    mask_and_scale: bool = True,
    profiles_per_chunk: int | None = None,
    header_position: Position = "longitude_first",
    root: str | os.PathLike[str] | None = None,
    stretches: Mapping[str, Stretches] | None = None,
) -> xr.Dataset:
    """Open raw files of one layout as one Dataset.

    Parameters
    ----------
    source : str, path, or iterable of paths or Granule
        A folder (with its subfolders, hidden files left out), a file, a glob pattern, or files.
        The order does not matter: profiles are sorted by start, then path. Of granules with a
        `header_digest`, start, stop, altitude and pointing are taken instead of the header's
        where `header_position` is "ignore".
    channels : iterable of str, optional
        Channels to open, which all files must have alike; all signal channels, which must be
        the same in all files, where not given.
    mask_and_scale : bool
        Whether to give physical values (float32, mV or MHz) or raw counts (int32).
    profiles_per_chunk : int, optional
        About 16 MB a chunk where not given.
    header_position : {"longitude_first", "latitude_first", "ignore"}
        Which coordinate the instrument writes first.
    root : path or str, optional
        Folder that relative paths start from; the working directory where not given.
    stretches : mapping of str to tuple of (int, int), optional
        Of these channels only some bins, the others stay on disk: the first bin of each stretch
        and the one past its last, ascending. ``{"photon_532o": ((0, 500),)}`` are the nearest 500.

    Returns
    -------
    xarray.Dataset
        Channels are dask arrays (time, range), chunked along time. Computing one raises
        `RawFormatError` where a file has changed since.

    Raises
    ------
    RawFormatError
        Naming the file where one cannot be read or is of another layout.
    """
    columns = Columns(channel_names(channels), header_position)
    stamps = _read_headers(columns, _files(source, root))
    columns.sort()
    columns.keep(stretches or {})
    chunks = _chunks(columns, profiles_per_chunk)
    # dask itself would look at each number of a list.
    token = tokenize(repr(stamps), columns.kept)

    def signal(channel: int, dataset: Dataset) -> da.Array:
        offsets = columns.fact(channel, "offset").astype(np.int64)
        scales = columns.fact(channel, "scale") if mask_and_scale else None
        lengths = tuple(len(files.paths) for _, files in chunks)
        kept = columns.kept.get(dataset.name)
        name = f"licel-{dataset.name}-{tokenize(token, offsets, scales, lengths)}"
        graph = {}
        for index, (part, files) in enumerate(chunks):
            scale = None if scales is None else scales[part]
            graph[name, index, 0] = (_Chunk(files, offsets[part], dataset.bins, kept, scale),)
        shape = (lengths, (dataset.bins,))
        dtype = np.int32 if scales is None else np.float32
        return da.Array(graph, name, chunks=shape, dtype=dtype)  # type: ignore[no-untyped-call]

    return build_raw_dataset(columns, signal, scaled=mask_and_scale)


def _read_headers(
    columns: Columns, files: Mapping[str, Granule | None]
) -> list[tuple[str, int, int]]:
    """Fill `columns`; return path, size and time of change of each file.

    Of granules that say which headers are alike one is read, as far as the place that a header
    tells is not asked for: the catalog may have another for it.
    """
    stamps = []
    variants: dict[tuple[str, int], int] = {}
    for path, granule in files.items():
        alike = None
        if granule is not None and granule.header_digest and columns.order == "ignore":
            alike = granule.header_digest, granule.size
            if alike in variants:
                columns.append_alike(granule, path, variants[alike])
                stamps.append((path, granule.size, granule.mtime_ns))
                continue
        with RawFile(path) as file:
            header = file.read_header()
            columns.append(header)
            stamps.append((path, file.size, file.mtime_ns))
        if alike == (header_digest(header), header.size):
            variants[alike] = columns.variant[-1]
    return stamps


@dataclass(frozen=True, slots=True)
class _Files:
    """The files of one chunk, shared by the tasks of all channels."""

    paths: tuple[str, ...]
    sizes: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class _Chunk:
    """One task: reads one channel of the files of one chunk. Small, and can be pickled."""

    files: _Files
    offsets: NDArray[np.int64]
    bins: int
    kept: Stretches | None
    """Which bins of the channel these are; None for all."""
    scales: NDArray[np.float64] | None
    """None for counts."""

    def __call__(self) -> NDArray[Any]:
        values = np.empty(
            (len(self.offsets), self.bins), np.int32 if self.scales is None else np.float32
        )
        row = np.empty(self.bins, np.dtype("<i4"))
        for index, (path, size) in enumerate(zip(self.files.paths, self.files.sizes, strict=True)):
            with RawFile(path) as file:
                file.expect(size)
                offset = int(self.offsets[index])
                if self.kept is None:
                    file.read_counts(offset, [row])
                else:
                    _read_stretches(file, offset, self.kept, row)
            if self.scales is None:
                values[index] = row
            else:
                to_physical(row, self.scales[index], values[index])
        tally = _TALLY.get()
        if tally is not None:
            tally.bytes += len(self.offsets) * self.bins * row.itemsize
        return values


def _read_stretches(
    file: RawFile, offset: int, stretches: Stretches, row: NDArray[np.int32]
) -> None:
    place = 0
    for first, past in stretches:
        bins = past - first
        row[place : place + bins] = file.read_part(offset + row.itemsize * first, bins)
        place += bins


def _chunks(columns: Columns, profiles: int | None) -> list[tuple[slice, _Files]]:
    if profiles is None:
        largest = max(dataset.bins for dataset in columns.datasets)
        profiles = max(1, _CHUNK_BYTES // (4 * largest))
    if profiles < 1:
        raise RawFormatError(
            f"{profiles} is not a number of profiles",
            field="profiles_per_chunk",
            remedy="give at least 1",
        )
    parts = [slice(i, i + profiles) for i in range(0, len(columns.paths), profiles)]
    return [
        (part, _Files(tuple(columns.paths[part]), tuple(columns.sizes[part]))) for part in parts
    ]


def _files(source: Source, root: str | os.PathLike[str] | None) -> dict[str, Granule | None]:
    base = Path(root) if root is not None else Path()
    files: list[tuple[str, Granule | None]]
    if isinstance(source, str | os.PathLike):
        files = [(path, None) for path in _expand(base, Path(source))]
    else:
        # What Path would make of it, at a tenth of the cost: a granule's path is in order.
        folder = "" if base == Path() else os.path.join(base, "")  # noqa: PTH118
        files = [
            (folder + item.path, item) if isinstance(item, Granule) else (str(base / item), None)
            for item in source
        ]
    if not files:
        raise RawFormatError(
            "no files are found",
            file=base / source if isinstance(source, str | os.PathLike) else None,
            remedy="give a folder, a glob pattern or paths that exist",
        )
    path, times = Counter(path for path, _ in files).most_common(1)[0]
    if times > 1:
        raise RawFormatError(f"is given {times} times", file=path)
    # The first file, with which the layout of the others is compared, is always the same.
    return dict(sorted(files, key=itemgetter(0)))


def _expand(base: Path, source: Path) -> list[str]:
    place = base / source
    if place.is_dir():
        return list(_walk(place))
    if place.exists():
        return [str(place)]
    # Unlike Path.glob this leaves hidden files out, such as those that are being written.
    found = glob.glob(str(source), root_dir=base, recursive=True)  # noqa: PTH207
    return [str(base / path) for path in found if (base / path).is_file()]


def _walk(folder: Path) -> Iterator[str]:
    def fail(error: OSError) -> None:
        raise RawFormatError(f"cannot be listed: {error.strerror}", file=error.filename) from None

    for place, folders, names in os.walk(folder, onerror=fail):
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from (str(Path(place, name)) for name in names if not name.startswith("."))
