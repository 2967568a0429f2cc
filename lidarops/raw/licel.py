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

import os
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from lidarops.errors import RawFormatError
from lidarops.raw.file import RawFile
from lidarops.raw.header import (
    HeaderOrder,
    channel_names,
    check_layout,
    chosen,
    to_physical,
)
from lidarops.raw.licel_header import (
    CONVENTION,
    Dataset,
    DatasetKind,
    Header,
    Laser,
    ScanGrid,
    parse_header,
)
from lidarops.raw.licel_write import (
    encode,
    format_header,
    new_dataset,
    new_header,
    write,
)

__all__ = [
    "CONVENTION",
    "Dataset",
    "DatasetKind",
    "Header",
    "HeaderOrder",
    "Laser",
    "ScanGrid",
    "encode",
    "format_header",
    "new_dataset",
    "new_header",
    "parse_header",
    "read_counts",
    "read_header",
    "read_physical",
    "select",
    "select_signals",
    "write",
]

Counts = NDArray[np.int32]
PathLike = str | os.PathLike[str]

_COUNTS = np.dtype("<i4")
_MOST_ROWS = 256  # of one vectored read; systems allow 1024 buffers, two per row


def _header(file: RawFile) -> Header:
    return file.read_header(lambda head: parse_header(head, file=file.path, size=file.size))


def read_datasets(file: RawFile, offset: int, rows: Sequence[Counts]) -> None:
    """Fill `rows` with the counts of consecutive datasets from byte `offset` on.

    Raises
    ------
    RawFormatError
        If counts are missing, or a dataset is not followed by CRLF.
    """
    tails = [bytearray(2) for _ in rows]
    buffers: list[Any] = [buffer for pair in zip(rows, tails, strict=True) for buffer in pair]
    length = file.read_into(offset, buffers)
    expected = sum([row.nbytes for row in rows]) + 2 * len(rows)
    if length == file.size - offset and expected - 2 <= length < expected:
        # Only the last CRLF of the file is missing.
        tails[-1][length - expected :] = b"\r\n"[length - expected :]
        length = expected
    if length != expected or b"".join(tails) != b"\r\n" * len(rows):
        raise RawFormatError(
            f"no CRLF follows the counts from byte {offset}: the data are not where the"
            " header says",
            file=file.path,
            field="data",
            remedy="copy the file again from the instrument, or leave it out",
        )


def read_part(file: RawFile, offset: int, number: int) -> Counts:
    """Return `number` counts from byte `offset` on.

    Raises
    ------
    RawFormatError
        If the file ends before.
    """
    content = file.read(offset, 4 * number)
    if len(content) < 4 * number:
        raise RawFormatError(
            f"ends within the {number} counts at byte {offset}", file=file.path, field="data"
        )
    return np.frombuffer(content, _COUNTS)


def read_header(path: PathLike) -> Header:
    """Read and check the header of a file, not its data.

    Raises
    ------
    RawFormatError
        As `parse_header`, or if the file cannot be opened.
    """
    with RawFile(path) as file:
        return _header(file)


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
    stored = {d.name: d for d in header.datasets if d.places}
    names = channel_names(channels)
    signals = [d.name for d in stored.values() if d.is_signal]
    return chosen(stored, signals if names is None else names, header.path)


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
                file=header.path,
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
        header = _header(file)
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
            read_datasets(file, _offset(datasets[start]), rows[start:index])
            start = index
        position = _offset(dataset) + 4 * dataset.bins + 2
    read_datasets(file, _offset(datasets[start]), rows[start:])


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
            header = _header(file)
            # Files with equal dataset lines share the parsed datasets, so the selection holds.
            if not headers or header.datasets is not headers[-1].datasets:
                datasets = select_signals(header, names)
                scales = [dataset.scale for dataset in datasets]
            if not headers:
                first = datasets
                values, rows = _allocate(first, len(paths), dtype)
            check_layout(header.path, datasets, first)
            _read_rows(file, datasets, rows)
        for row, scale, block in zip(rows, scales, values, strict=True):
            to_physical(row, scale, block[index])
        headers.append(header)
    return tuple(headers), {d.name: block for d, block in zip(first, values, strict=True)}


def _allocate(
    datasets: tuple[Dataset, ...], files: int, dtype: DTypeLike
) -> tuple[list[NDArray[Any]], list[Counts]]:
    # One large block, because the system maps it in huge pages.
    total = np.empty(files * sum(dataset.bins for dataset in datasets), dtype)
    values, start = [], 0
    for dataset in datasets:
        stop = start + files * dataset.bins
        values.append(total[start:stop].reshape(files, dataset.bins))
        start = stop
    return values, [np.empty(dataset.bins, _COUNTS) for dataset in datasets]


def _offset(dataset: Dataset) -> int:
    if dataset.offset is None:
        raise RawFormatError("is not stored", field=dataset.name)
    return dataset.offset
