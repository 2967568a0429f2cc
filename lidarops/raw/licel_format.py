"""The raw format ``licel``: Licel files as `lidarops.raw.formats` knows them."""

from __future__ import annotations

import hashlib
import re
from dataclasses import fields, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.errors import RawFormatError
from lidarops.raw import licel
from lidarops.raw.file import RawFile
from lidarops.raw.formats import RawFormat
from lidarops.raw.header import RawChannel, RawHeader, Stretches
from lidarops.raw.licel_header import memories, stated_start

_FIRST_LINES: Final = re.compile(rb"[^\r\n]{0,1022}\r\n[^\r\n]{0,1022}?\d/\d{4} +\d{1,2}:\d\d:\d\d")


_WRONG_IN_THEMSELVES: Final = 1
"""Bins that may hold any counts: one of 272 measured files has one bin beyond full scale."""
_SCALED_TO: Final = np.iinfo(np.int32).max
"""Largest count of simulated signals that are scaled to 32 bits, as those of `boeckmann2004`: no
counts of a recorder."""
_SECTOR: Final = 128
"""Bins in 512 bytes, the smallest block that a disk loses."""

_COMMON: Final = tuple(field.name for field in fields(RawChannel) if field.name != "places")
"""Properties of channels that datasets have under the same name."""


def _recognises(head: bytes) -> bool:
    return _FIRST_LINES.match(head) is not None


def _parse_header(head: bytes, file: str, size: int) -> RawHeader:
    header = raw_header(licel.parse_header(head, file=file, size=size))
    if len(head) == size:
        for channel in header.channels:
            first, *further = (np.frombuffer(head, "<i4", channel.bins, p) for p in channel.places)
            counts = sum(further, start=first)
            _check_full_scale(counts, channel, header.path)
            _check_blocks(counts, channel, header.path)
    return header


def raw_header(header: licel.Header) -> RawHeader:
    """Return the header of a Licel file in the general form."""
    return RawHeader(
        format=FORMAT.name,
        path=header.path or header.name,
        size=header.size,
        start=header.start,
        stop=header.stop,
        channels=_channels(header.datasets),
        digest=_digest(header.site, header.data_start, _after_lasers(header)),
        zenith_angle=header.zenith_angle,
        azimuth=header.azimuth,
        altitude=header.altitude,
        coordinates=(header.longitude, header.latitude),
        site=header.site,
        notes=header.notes,
        doubt=header.pointing_doubt,
        written_angle=header.zenith_as_written if header.scan is None else None,
        record=header,
    )


def _after_lasers(header: licel.Header) -> bytes:
    lines = 3 if header.scan is None else 4
    return header.source.split(b"\r\n", lines)[lines]


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


@lru_cache(maxsize=128)
def _channels(datasets: tuple[licel.Dataset, ...]) -> tuple[RawChannel, ...]:
    return tuple(
        RawChannel(
            places=tuple(memory.offset for memory in group if memory.offset is not None),
            **{name: getattr(_added(group), name) for name in _COMMON},
        )
        for group in memories(datasets)
    )


def _added(group: tuple[licel.Dataset, ...]) -> licel.Dataset:
    """Return the dataset of a channel with the shots of all its memories."""
    return replace(group[0], shots=sum(memory.shots for memory in group))


# All but name, times, place, lasers and weather; the same in many files.
@lru_cache(maxsize=128)
def _digest(site: str, data_start: int, datasets: bytes) -> str:
    prefix = f"{site}\n{data_start}\n".encode()
    return hashlib.sha256(prefix + datasets).hexdigest()[:16]


def _read_counts(
    file: RawFile, place: int, stretches: Stretches | None, row: NDArray[np.int32]
) -> None:
    if stretches is None:
        licel.read_datasets(file, place, [row])
        return
    start = 0
    for first, past in stretches:
        bins = past - first
        row[start : start + bins] = licel.read_part(file, place + row.itemsize * first, bins)
        start += bins


FORMAT: Final = RawFormat(
    name="licel",
    title="Licel",
    conversion=licel.CONVENTION,
    recognises=_recognises,
    parse_header=_parse_header,
    read_counts=_read_counts,
    read_start=stated_start,
)
