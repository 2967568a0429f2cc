"""Licel raw files: bytes to header and arrays (numpy and the standard library only).

After the header (`lidarops.raw.licel_header`) a file holds, for each stored dataset, its bins as
little-endian 32-bit counts followed by CRLF (`licel2023`). CRLF also occurs inside the data, so
datasets are located by offset. The CRLF after a dataset is checked when the dataset is read.

Reading
    `read_header` (header only), `parse_header` (the same from bytes), `read_counts` (one file),
    `read_physical` (many files of one layout, in mV and MHz).
Writing
    `new_dataset` and `new_header` build a `Dataset` and a `Header` from numbers,
    ``encode(header, counts)`` returns the bytes of a file, ``write(path, header, counts)`` writes
    it (`lidarops.raw.licel_write`). A `Header` always agrees with its text: it is built or
    parsed, never edited.
"""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import lru_cache
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray

from lidarops.errors import RawFormatError
from lidarops.raw.licel_header import (
    CONVENTION,
    Dataset,
    DatasetKind,
    Header,
    HeaderOrder,
    IncompleteHeaderError,
    Laser,
    parse_header,
)
from lidarops.raw.licel_write import (
    encode,
    format_header,
    new_dataset,
    new_header,
    write,
)
from lidarops.records import ChannelLayout

__all__ = [
    "CONVENTION",
    "Dataset",
    "DatasetKind",
    "Header",
    "HeaderOrder",
    "Laser",
    "RawFile",
    "channel_names",
    "check_layout",
    "encode",
    "format_header",
    "header_digest",
    "layout",
    "new_dataset",
    "new_header",
    "parse_header",
    "read_counts",
    "read_header",
    "read_physical",
    "select",
    "select_signals",
    "to_physical",
    "write",
]

Counts = NDArray[np.int32]
PathLike = str | os.PathLike[str]

_PREFIX = 8 * 1024
_HEADER_LIMIT = 512 * 1024
_COUNTS = np.dtype("<i4")
_MOST_ROWS = 256  # of one vectored read; systems allow 1024 buffers, two per row


class RawFile:
    """An open local raw file; all raw files are opened here.

    Parameters
    ----------
    path : path or str

    Raises
    ------
    RawFormatError
        If the file cannot be opened, or is not a regular file.
    """

    __slots__ = ("_descriptor", "mtime_ns", "path", "size")

    def __init__(self, path: PathLike) -> None:
        self.path = os.fspath(path)
        try:
            # Without O_NONBLOCK, opening a pipe would wait for a writer.
            self._descriptor = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK)
        except (OSError, ValueError) as error:
            raise RawFormatError(f"cannot be opened: {error}", file=self.path) from None
        try:
            status = os.fstat(self._descriptor)
        except OSError as error:
            os.close(self._descriptor)
            raise self._unreadable(error) from None
        self.size = status.st_size
        self.mtime_ns = status.st_mtime_ns
        if not stat.S_ISREG(status.st_mode):
            os.close(self._descriptor)
            raise RawFormatError("is not a regular file", file=self.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # What was read is right, whether the file can be closed or not.
        with suppress(OSError):
            os.close(self._descriptor)

    def read_header(self) -> Header:
        """Read and check the header.

        Raises
        ------
        RawFormatError
            As `parse_header`.
        """
        prefix = self.read(0, _PREFIX)
        try:
            return parse_header(prefix, file=self.path, size=self.size)
        except IncompleteHeaderError:
            if len(prefix) < _PREFIX:
                raise
        return parse_header(self.read(0, _HEADER_LIMIT), file=self.path, size=self.size)

    def read(self, offset: int, length: int) -> bytes:
        """Return at most `length` bytes from `offset` on."""
        try:
            return os.pread(self._descriptor, length, offset)
        except OSError as error:
            raise self._unreadable(error) from None

    def read_counts(self, offset: int, rows: Sequence[Counts]) -> None:
        """Fill `rows` with the counts of consecutive datasets from byte `offset` on.

        Raises
        ------
        RawFormatError
            If counts are missing, or a dataset is not followed by CRLF.
        """
        tails = [bytearray(2) for _ in rows]
        buffers: list[Any] = [buffer for pair in zip(rows, tails, strict=True) for buffer in pair]
        try:
            length = os.preadv(self._descriptor, buffers, offset)
        except OSError as error:
            raise self._unreadable(error) from None
        expected = sum([row.nbytes for row in rows]) + 2 * len(rows)
        if length == self.size - offset and expected - 2 <= length < expected:
            # Only the last CRLF of the file is missing.
            tails[-1][length - expected :] = b"\r\n"[length - expected :]
            length = expected
        if length != expected or b"".join(tails) != b"\r\n" * len(rows):
            raise RawFormatError(
                f"no CRLF follows the counts from byte {offset}: the data are not where the"
                " header says",
                file=self.path,
                field="data",
                remedy="copy the file again from the instrument, or leave it out",
            )

    def read_part(self, offset: int, number: int) -> Counts:
        """Return `number` counts from byte `offset` on.

        Raises
        ------
        RawFormatError
            If the file ends before.
        """
        content = self.read(offset, 4 * number)
        if len(content) < 4 * number:
            raise RawFormatError(
                f"ends within the {number} counts at byte {offset}", file=self.path, field="data"
            )
        return np.frombuffer(content, _COUNTS)

    def expect(self, size: int) -> None:
        """Raise if the size of the file has changed since its header was read."""
        if self.size != size:
            raise RawFormatError(
                f"had {size} bytes when its header was read, has {self.size} now",
                file=self.path,
                field="size",
                remedy="open the archive again when no process writes to it",
            )

    def _unreadable(self, error: OSError) -> RawFormatError:
        return RawFormatError(f"cannot be read: {error.strerror}", file=self.path)


def read_header(path: PathLike) -> Header:
    """Read and check the header of a file, not its data.

    Raises
    ------
    RawFormatError
        As `parse_header`, or if the file cannot be opened.
    """
    with RawFile(path) as file:
        return file.read_header()


def layout(header: Header) -> tuple[ChannelLayout, ...]:
    """Return the channels of `header` and their range grids, in file order."""
    return _layout(header.datasets)


@lru_cache(maxsize=128)
def _layout(datasets: tuple[Dataset, ...]) -> tuple[ChannelLayout, ...]:
    return tuple(
        ChannelLayout(
            name=dataset.name,
            mode=dataset.mode,
            wavelength=dataset.wavelength,
            bins=dataset.bins,
            bin_width=dataset.bin_width,
            adc_bits=dataset.adc_bits,
        )
        for dataset in datasets
        if dataset.offset is not None and dataset.mode is not None
    )


def header_digest(header: Header) -> str:
    """Return a digest that is equal for headers with equal site and datasets.

    Returns
    -------
    str
        16 hexadecimal digits of site, dataset lines and start of the data. Headers with equal
        digests differ at most in file name, times, position, pointing, lasers and weather.
    """
    datasets = header.source.split(b"\r\n", 3)[3]
    prefix = f"{header.site}\n{header.data_start}\n".encode()
    return hashlib.sha256(prefix + datasets).hexdigest()[:16]


def channel_names(channels: Iterable[str] | None) -> tuple[str, ...] | None:
    """Return channel names without duplicates, also of a single name; None stands for all."""
    if channels is None:
        return None
    return tuple(dict.fromkeys([channels] if isinstance(channels, str) else channels))


def select(header: Header, channels: Iterable[str] | None = None) -> tuple[Dataset, ...]:
    """Return the stored datasets of these names, in the order of `channels`.

    Parameters
    ----------
    header : Header
    channels : str or iterable of str, optional
        By default the signal channels in file order. Datasets that are not signals can be named
        too.

    Raises
    ------
    RawFormatError
        If a channel is not stored, or there is no channel; the error names the stored ones.
    """
    stored = {d.name: d for d in header.datasets if d.offset is not None}
    names = channel_names(channels)
    if names is None:
        names = tuple(d.name for d in header.channels)
    missing = [name for name in names if name not in stored]
    if missing or not names:
        raise RawFormatError(
            f"has no channel {', '.join(missing)}" if missing else "has no channels",
            file=header.path or header.name,
            field="channels",
            remedy=f"stored: {', '.join(stored) or 'none'}",
        )
    return tuple(stored[name] for name in names)


def select_signals(header: Header, channels: Iterable[str] | None = None) -> tuple[Dataset, ...]:
    """Return the signal channels of these names, as `select`.

    Raises
    ------
    RawFormatError
        As `select`, and if a dataset is not a signal.
    """
    datasets = select(header, channels)
    for dataset in datasets:
        if dataset.mode is None:
            raise RawFormatError(
                f"{dataset.name} is not a signal: it has no physical values",
                file=header.path or header.name,
                field="channels",
                remedy="read it with licel.read_counts",
            )
    return datasets


def read_counts(
    path: PathLike, channels: Iterable[str] | None = None, *, bins: int | None = None
) -> tuple[Header, dict[str, Counts]]:
    """Read the raw counts of one file.

    Parameters
    ----------
    path : path or str
    channels : iterable of str, optional
        As in `select`.
    bins : int, optional
        Return only this many of the nearest bins; by default all.

    Returns
    -------
    Header
    dict of str to int32 array (bins,)

    Raises
    ------
    RawFormatError
        If the file cannot be read, or has no such channel.
    """
    with RawFile(path) as file:
        header = file.read_header()
        datasets = select(header, channels)
        if bins is not None and bins < 1:
            raise RawFormatError(f"{bins} bins cannot be read", file=file.path, field="bins")
        rows = [np.empty(dataset.bins, _COUNTS) for dataset in datasets]
        _read_rows(file, datasets, rows)
    return header, {
        dataset.name: row[:bins].astype(np.int32, copy=False)
        for dataset, row in zip(datasets, rows, strict=True)
    }


def _read_rows(file: RawFile, datasets: Sequence[Dataset], rows: Sequence[Counts]) -> None:
    start, position = 0, None
    for index, dataset in enumerate(datasets):
        if index > start and (dataset.offset != position or index - start == _MOST_ROWS):
            file.read_counts(_offset(datasets[start]), rows[start:index])
            start = index
        position = _offset(dataset) + 4 * dataset.bins + 2
    file.read_counts(_offset(datasets[start]), rows[start:])


def read_physical(
    paths: Sequence[PathLike],
    channels: Iterable[str] | None = None,
    *,
    dtype: DTypeLike = np.float32,
) -> tuple[tuple[Header, ...], dict[str, NDArray[Any]]]:
    """Read many files of one layout, and return physical values.

    Parameters
    ----------
    paths : sequence of path or str
    channels : iterable of str, optional
        As in `select`.
    dtype : dtype
        Of the values; scaling is done in double precision.

    Returns
    -------
    tuple of Header
        In the order of `paths`.
    dict of str to array (file, bin)
        mV for analog channels, MHz for photon counting (`CONVENTION`). NaN without shots.

    Raises
    ------
    RawFormatError
        If a file cannot be read, or has another layout than the first; the error names it.
    """
    names = channel_names(channels)
    headers: list[Header] = []
    first: tuple[Dataset, ...] = ()
    datasets: tuple[Dataset, ...] = ()
    values: list[NDArray[Any]] = []
    for index, path in enumerate(paths):
        with RawFile(path) as file:
            header = file.read_header()
            # Files with equal dataset lines share the parsed datasets, so the selection holds.
            if not headers or header.datasets is not headers[-1].datasets:
                datasets = select_signals(header, names)
                scales = [dataset.scale for dataset in datasets]
            if not headers:
                first = datasets
                values, rows = _allocate(first, len(paths), dtype)
            check_layout(header, datasets, first)
            _read_rows(file, datasets, rows)
        for row, scale, block in zip(rows, scales, values, strict=True):
            to_physical(row, scale, block[index])
        headers.append(header)
    return tuple(headers), {d.name: block for d, block in zip(first, values, strict=True)}


def _allocate(
    datasets: tuple[Dataset, ...], files: int, dtype: DTypeLike
) -> tuple[list[NDArray[Any]], list[Counts]]:
    # One large block: the system maps it in huge pages, at a tenth of the cost.
    total = np.empty(files * sum(dataset.bins for dataset in datasets), dtype)
    values, start = [], 0
    for dataset in datasets:
        stop = start + files * dataset.bins
        values.append(total[start:stop].reshape(files, dataset.bins))
        start = stop
    return values, [np.empty(dataset.bins, _COUNTS) for dataset in datasets]


def check_layout(
    header: Header, datasets: tuple[Dataset, ...], expected: tuple[Dataset, ...]
) -> None:
    """Raise if channels differ from the `expected` ones in range grid or ADC bits.

    Raises
    ------
    RawFormatError
        Naming file and channels.
    """
    if datasets is expected:
        return
    grid, expected_grid = _grid(datasets), _grid(expected)
    if grid == expected_grid:
        return
    differing = sorted({name for name, *_ in grid ^ expected_grid})
    raise RawFormatError(
        "is of another layout (channels, bins, bin width or ADC bits) than the files before it",
        file=header.path,
        field=", ".join(differing),
        remedy="open files of one layout, or choose channels that are equal in all files",
    )


def _grid(datasets: tuple[Dataset, ...]) -> set[tuple[str, int, float, int]]:
    return {(d.name, d.bins, d.bin_width, d.adc_bits) for d in datasets}


def to_physical(counts: Counts, scale: float, out: NDArray[Any]) -> None:
    """Fill `out` with ``counts * scale``, computed in double precision."""
    np.multiply(counts, scale, out=out, casting="same_kind")


def _offset(dataset: Dataset) -> int:
    if dataset.offset is None:
        raise RawFormatError("is not stored", field=dataset.name)
    return dataset.offset
