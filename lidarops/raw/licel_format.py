"""The raw format ``licel``: Licel files as `lidarops.raw.formats` knows them.

After the header a file holds, for each stored dataset, its bins as little-endian 32-bit counts
followed by CRLF (`licel2023`). CRLF also occurs inside the data, so datasets are located by offset.
The CRLF after a dataset is checked when the dataset is read.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lidarops.errors import RawFormatError
from lidarops.raw import licel_header
from lidarops.raw.file import RawFile
from lidarops.raw.formats import RawFormat
from lidarops.raw.header import RawChannel, RawHeader, Stretches

Counts = NDArray[np.int32]

COUNTS: Final = np.dtype("<i4")
_FIRST_LINES: Final = re.compile(rb"[^\r\n]{0,1022}\r\n[^\r\n]{0,1022}?\d/\d{4} +\d{1,2}:\d\d:\d\d")


_WRONG_IN_THEMSELVES: Final = 1
"""Bins that may hold any counts: one of 272 measured files has one bin beyond full scale."""
_SCALED_TO: Final = np.iinfo(np.int32).max
"""Largest count of simulated signals that are scaled to 32 bits, as those of `boeckmann2004`: no
counts of a recorder."""
_SECTOR: Final = 128
"""Bins in 512 bytes, the smallest block that a disk loses."""


def _recognises(head: bytes) -> bool:
    return _FIRST_LINES.match(head) is not None


def _parse_header(head: bytes, file: str, size: int) -> RawHeader:
    header = licel_header.parse_header(head, file=file, size=size)
    if len(head) == size:
        for channel in header.channels:
            first, *further = (np.frombuffer(head, "<i4", channel.bins, p) for p in channel.places)
            counts = sum(further, start=first)
            _check_full_scale(counts, channel, header.path)
            _check_blocks(counts, channel, header.path)
    return header


def _check_full_scale(counts: NDArray[np.int32], channel: RawChannel, path: str) -> None:
    """Refuse counts beyond the full scale of the shots and bits that a file states."""
    if channel.full_scale is None or not channel.shots:
        return
    largest, full_scale = int(counts.max()), (1 << channel.adc_bits) - 1
    beyond = int(np.count_nonzero(counts > channel.full_scale))
    if beyond <= _WRONG_IN_THEMSELVES or largest == _SCALED_TO:
        return
    is_plateau = largest % full_scale == 0
    if is_plateau and np.count_nonzero(counts == largest) > _WRONG_IN_THEMSELVES:
        raise RawFormatError(
            f"states {channel.shots} shots, but saturates at full scale of"
            f" {largest // full_scale}: its values would be wrong by that ratio",
            file=path,
            field=f"shots of {channel.name}",
            remedy="leave the file out, or correct the shots in its header",
        )
    raise RawFormatError(
        f"{beyond} bins hold up to {largest} counts, but {channel.shots} shots of"
        f" {channel.adc_bits} bits give at most {channel.full_scale}",
        file=path,
        field=f"shots or ADC bits of {channel.name}",
        remedy="leave the file out, or correct its header",
    )


def _check_blocks(counts: NDArray[np.int32], channel: RawChannel, path: str) -> None:
    """Refuse a block of zeros between as many counts without a zero, as of a lost sector.

    A recorder that is off gives zeros only, one that stops early zeros at the end, and few
    photons zeros among other counts.
    """
    zero = counts == 0
    if np.count_nonzero(zero) < _SECTOR:
        return
    edges = np.flatnonzero(np.diff(zero, prepend=False, append=False))
    for first, stop in edges.reshape(-1, 2)[np.diff(edges)[::2] >= _SECTOR]:
        inside = first > 0 and stop < counts.size
        if inside and zero[max(first - _SECTOR, 0) : stop + _SECTOR].sum() == stop - first:
            raise RawFormatError(
                f"bins {first} to {stop - 1} hold zeros, and those beside them none: their counts"
                " are lost",
                file=path,
                field=f"counts of {channel.name}",
                remedy="copy the file again from the instrument, or leave it out",
            )


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
    return np.frombuffer(content, COUNTS)


def _read_counts(
    file: RawFile, place: int, stretches: Stretches | None, row: NDArray[np.int32]
) -> None:
    if stretches is None:
        read_datasets(file, place, [row])
        return
    start = 0
    for first, past in stretches:
        bins = past - first
        row[start : start + bins] = read_part(file, place + row.itemsize * first, bins)
        start += bins


FORMAT: Final = RawFormat(
    name=licel_header.FORMAT,
    title="Licel",
    conversion=licel_header.CONVENTION,
    recognises=_recognises,
    parse_header=_parse_header,
    read_counts=_read_counts,
    read_start=licel_header.stated_start,
)
