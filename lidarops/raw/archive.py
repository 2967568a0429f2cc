"""Many raw files of one format and layout as one dask-backed Dataset.

The data model is that of `lidarops.raw.model`. Headers are read when the archive is opened; of
files whose headers the catalog knows to be equal, one header is read. A task of the graph reads
the bytes of one channel in the files of one chunk.
"""

from __future__ import annotations

import glob
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import lru_cache
from operator import itemgetter
from pathlib import Path
from typing import Any

import dask.array as da
import numpy as np
import xarray as xr
from dask.base import tokenize
from numpy.typing import NDArray

from lidarops.errors import RawFormatError
from lidarops.raw.file import RawFile
from lidarops.raw.formats import raw_format, read_raw_header
from lidarops.raw.header import (
    Layout,
    RawChannel,
    RawHeader,
    Stretches,
    named_layout,
    recorder_names,
    to_physical,
)
from lidarops.raw.model import Position, RawFiles, StatedFile, build_raw_dataset
from lidarops.records import Granule

Source = str | os.PathLike[str] | Iterable[str | os.PathLike[str] | Granule]

_CHUNK_BYTES = 16_000_000


@dataclass(slots=True)
class ByteCount:
    """Number of signal bytes read."""

    bytes: int = 0


_COUNT: ContextVar[ByteCount | None] = ContextVar("byte_count", default=None)


@contextmanager
def count_bytes_read() -> Iterator[ByteCount]:
    """Count the signal bytes that this thread reads; headers do not count."""
    count = ByteCount()
    token = _COUNT.set(count)
    try:
        yield count
    finally:
        _COUNT.reset(token)


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
    """Open raw files of one format and layout as one Dataset.

    Parameters
    ----------
    source : str, path, or iterable of paths or Granule
        A folder (with its subfolders, without hidden files), a file, a glob pattern, or files.
        Profiles are sorted by start, then path. Where `header_position` is "ignore", granules
        supply start, stop, altitude and pointing in place of the header.
    channels : iterable of str, optional
        Channels to open, with equal range grids in all files; by default all signal channels,
        which must then be the same in all files. A name is one recorder, its ``device``.
    mask_and_scale : bool
        Whether to return physical values (float32, mV or MHz) or raw counts (int32).
    profiles_per_chunk : int, optional
        By default about 16 MB per chunk.
    header_position : {"longitude_first", "latitude_first", "ignore"}
        Which coordinate the instrument writes first.
    root : path or str, optional
        Base folder of relative paths; by default the working directory.
    stretches : mapping of str to tuple of (int, int), optional
        By channel, the stretches of bins to read: first bin and the one past the last, ascending.
        ``{"photon_532o": ((0, 500),)}`` reads the nearest 500 bins. Other channels are whole.

    Returns
    -------
    xarray.Dataset
        Channels are dask arrays (time, range), chunked along time. Computing one raises
        `RawFormatError` if a file has changed since.

    Raises
    ------
    RawFormatError
        If a file cannot be read or is of another format or layout; the error names the file.
    """
    stated = _read_headers(_files(source, root), header_position)
    files = RawFiles(stated, channels, header_position, stretches)
    chunks = _chunks(files, profiles_per_chunk)
    # Hashing one text is faster than dask's walk over a list of numbers.
    stamps = [(file.path, file.size, file.mtime_ns) for file in stated]
    token = tokenize(repr(stamps), files.kept)

    def signal(index: int, channel: RawChannel) -> da.Array:
        places = files.channel_places(index)
        scales = files.channel_values(index, "scale") if mask_and_scale else None
        lengths = tuple(len(chunk) for _, chunk in chunks)
        kept = files.kept.get(channel.name)
        name = f"{files.format}-{channel.name}-{tokenize(token, places, scales, lengths)}"
        graph = {}
        for number, (rows, chunk) in enumerate(chunks):
            scale = None if scales is None else scales[rows]
            task = _Chunk(files.format, chunk, places[rows], channel.bins, kept, scale)
            graph[name, number, 0] = (task,)
        shape = (lengths, (channel.bins,))
        dtype = np.int32 if scales is None else np.float32
        return da.Array(graph, name, chunks=shape, dtype=dtype)  # type: ignore[no-untyped-call]

    return build_raw_dataset(files, signal, scaled=mask_and_scale)


def _read_headers(
    files: Mapping[str, Granule | None], position_order: Position
) -> list[StatedFile]:
    """Return the files with their headers, in the same order.

    Of granules with equal header digests one header is read, unless the position of the header
    is requested: the catalog may hold another position.
    """
    read: list[StatedFile] = []
    alike: dict[tuple[object, ...], RawHeader] = {}
    for path, granule in files.items():
        known = granule if granule and position_order == "ignore" and granule.start else None
        key = (known.header_digest, known.size, known.layout) if known else ()
        if known and key in alike:
            read.append(StatedFile(path, known.size, known.mtime_ns, alike[key], known))
            continue
        file = _read_header(path, granule)
        read.append(replace(file, stated=known) if known else file)
        digest = file.header.header_digest
        if known and digest and key == (digest, file.size, known.layout):
            alike[key] = file.header
    unnamed = [file.header for file in read if files[file.path] is None]
    names = recorder_names((header.layout, 1, header.start) for header in unnamed)
    return [
        replace(file, header=_renamed(file.header, named_layout(file.header.layout, names)))
        if files[file.path] is None
        else file
        for file in read
    ]


def _read_header(path: str, granule: Granule | None) -> StatedFile:
    with RawFile(path) as file:
        header = read_raw_header(file, "" if granule is None else granule.format)
        stamp = file.size, file.mtime_ns
    if granule is not None:
        header = _renamed(header, granule.layout or header.layout)
    return StatedFile(path, *stamp, header, header)


def _renamed(header: RawHeader, layout: Layout) -> RawHeader:
    """Return a header whose channels have the names of a layout of the same recorders."""
    if [channel.device for channel in header.channels] != [own.recorder for own in layout]:
        raise RawFormatError(
            "holds other channels than the catalog states",
            file=header.path,
            remedy="run lidarops catalog again",
        )
    return replace(header, channels=_with_names(header.channels, layout))


# Files with equal channels share one tuple.
@lru_cache(maxsize=128)
def _with_names(channels: tuple[RawChannel, ...], layout: Layout) -> tuple[RawChannel, ...]:
    return tuple(replace(c, name=own.name) for c, own in zip(channels, layout, strict=True))


@dataclass(frozen=True, slots=True)
class _Chunk:
    """Task that reads one channel of the files of one chunk; small, and can be pickled."""

    format: str
    """Name of their raw format."""
    files: tuple[tuple[str, int], ...]
    """Path and size of each, shared by the tasks of all channels."""
    places: tuple[tuple[int, ...], ...]
    """Of the channel, for each file."""
    bins: int
    kept: Stretches | None
    """Stretches of bins to read; None for all bins."""
    scales: NDArray[np.float64] | None
    """None for counts."""

    def __call__(self) -> NDArray[Any]:
        shape = len(self.places), self.bins
        counts = np.empty(shape if self.scales is None else shape[1:], np.dtype("<i4"))
        values = counts if self.scales is None else np.empty(shape, np.float32)
        read_channel = raw_format(self.format).read_channel
        for index, ((path, size), places) in enumerate(zip(self.files, self.places, strict=True)):
            row = counts if self.scales is not None else counts[index]
            with RawFile(path) as file:
                file.expect(size)
                read_channel(file, places, self.kept, row)
            if self.scales is not None:
                to_physical(row, self.scales[index], values[index])
        count = _COUNT.get()
        if count is not None:
            count.bytes += sum(map(len, self.places)) * self.bins * counts.itemsize
        return values.astype(np.int32 if self.scales is None else np.float32, copy=False)


def _chunks(
    files: RawFiles, profiles: int | None
) -> list[tuple[slice, tuple[tuple[str, int], ...]]]:
    """Return the rows of each chunk, with path and size of its files."""
    if profiles is None:
        largest = max(channel.bins for channel in files.selected)
        profiles = max(1, _CHUNK_BYTES // (4 * largest))
    if profiles < 1:
        raise RawFormatError(
            f"{profiles} is not a possible number of profiles",
            field="profiles_per_chunk",
            remedy="give at least 1",
        )
    stamps = tuple((file.path, file.size) for file in files.files)
    slices = [slice(i, i + profiles) for i in range(0, len(stamps), profiles)]
    return [(rows, stamps[rows]) for rows in slices]


def _files(source: Source, root: str | os.PathLike[str] | None) -> dict[str, Granule | None]:
    base = Path(root) if root is not None else Path()
    files: list[tuple[str, Granule | None]]
    if isinstance(source, str | os.PathLike):
        files = [(path, None) for path in _expand(base, Path(source))]
    else:
        # As Path would join them, but faster: the path of a granule is normalised.
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
    path, uses = Counter(path for path, _ in files).most_common(1)[0]
    if uses > 1:
        raise RawFormatError(f"is given {uses} times", file=path)
    # Sorted, so the file that sets the expected layout does not depend on the order of input.
    return dict(sorted(files, key=itemgetter(0)))


def _expand(base: Path, source: Path) -> list[str]:
    path = base / source
    if path.is_dir():
        return list(_walk(path))
    if path.exists():
        return [str(path)]
    # Unlike Path.glob, this skips hidden files, such as files that are being written.
    matches = glob.glob(str(source), root_dir=base, recursive=True)  # noqa: PTH207
    return [str(base / match) for match in matches if (base / match).is_file()]


def _walk(folder: Path) -> Iterator[str]:
    def fail(error: OSError) -> None:
        raise RawFormatError(f"cannot be listed: {error.strerror}", file=error.filename) from None

    for parent, folders, names in os.walk(folder, onerror=fail):
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from (str(Path(parent, name)) for name in names if not name.startswith("."))
