"""The raw format ``licel``: Licel files as `lidarops.raw.formats` knows them.

After the header a file holds, for each stored dataset, its bins as little-endian 32-bit counts
followed by CRLF (`licel2023`). CRLF also occurs inside the data, so datasets are located by offset.
The CRLF, or LF, around a dataset is checked when the dataset is read.
"""

from __future__ import annotations

import re
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.errors import RawFormatError
from lidarops.raw import licel_header
from lidarops.raw.formats import RawFile, RawFormat
from lidarops.raw.header import RawChannel, RawHeader, Stretches

Counts = NDArray[np.int32]

COUNTS: Final = np.dtype("<i4")
_FIRST_LINES: Final = re.compile(
    rb"[^\0\r\n]{0,1022}\r?\n[^\r\n]{0,1022}?\d/\d{4} +\d{1,2}:\d\d:\d\d"
)

_WRONG_IN_THEMSELVES: Final = 1
"""Bins that may hold any counts: one of 272 measured files has one bin beyond full scale."""
_SCALED_TO: Final = np.iinfo(np.int32).max
"""Largest count of simulated signals that are scaled to 32 bits, as those of `boeckmann2004`: no
counts of a recorder."""
_SECTOR: Final = 128
"""Bins in 512 bytes, the smallest block that a disk loses."""


def _parse_header(head: bytes, file: str, size: int) -> RawHeader:
    header = licel_header.parse_header(head, file=file, size=size)
    if len(head) == size:
        for channel in header.channels:
            first, *further = (np.frombuffer(head, COUNTS, channel.bins, p) for p in channel.places)
            counts = sum(further, start=first)
            _check_full_scale(counts, channel, header.path)
            _check_blocks(counts, channel, header.path)
    return header


def _check_full_scale(counts: Counts, channel: RawChannel, path: str) -> None:
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


def _check_blocks(counts: Counts, channel: RawChannel, path: str) -> None:
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


def read_dataset(file: RawFile, place: int, stretches: Stretches | None, row: Counts) -> None:
    """Fill a row with the counts of the dataset from byte `place` on.

    Raises
    ------
    RawFormatError
        If counts are missing, or a dataset that is read as a whole is not between line ends.
    """
    start, size = 0, row.itemsize
    for first, past in ((0, row.size),) if stretches is None else stretches:
        offset, length = place + size * first, size * (past - first)
        # Only the last CRLF of a file may be missing.
        left = file.size - offset - length
        lead, end = (2, b"\r\n"[: max(left, 0)]) if stretches is None else (0, b"")
        content = file.read(offset - lead, lead + length + len(end))
        before, behind = content[:lead], content[lead + length :]
        # LF alone ends a dataset, but not the only one behind a header in CRLF. No count is so
        # large that its last byte is CR or LF: that is of a line end, and a byte before is lost.
        alone = behind[:1] == b"\n" and content[lead + length - 1] not in b"\r\n"
        alone = alone and (left > 2 or (left == 1 and before != b"\r\n"))
        ended = (behind == end or alone) and before[1:] in (b"", b"\n")
        if len(content) < lead + length or not ended:
            raise RawFormatError(
                f"no CRLF follows the counts from byte {place}, or those before: the data are not"
                " where the header says"
                if stretches is None
                else f"ends within the {past - first} counts at byte {offset}",
                file=file.path,
                field="data",
                remedy="copy the file again from the instrument, or leave it out",
            )
        row[start : start + past - first] = np.frombuffer(content, COUNTS, past - first, lead)
        start += past - first


FORMAT: Final = RawFormat(
    name=licel_header.FORMAT,
    title="Licel",
    conversion=licel_header.CONVENTION,
    recognises=lambda head: _FIRST_LINES.match(head) is not None,
    parse_header=_parse_header,
    read_counts=read_dataset,
    read_start=licel_header.stated_start,
    named_time=licel_header.named_time,
)
