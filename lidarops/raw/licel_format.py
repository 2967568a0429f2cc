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
from lidarops.raw.licel_header import memories

_FIRST_LINES: Final = re.compile(rb"[^\r\n]{0,1022}\r\n[^\r\n]{0,1022}?\d/\d{4} +\d{1,2}:\d\d:\d\d")


_COMMON: Final = tuple(field.name for field in fields(RawChannel) if field.name != "places")
"""Properties of channels that datasets have under the same name."""


def _recognises(head: bytes) -> bool:
    return _FIRST_LINES.match(head) is not None


def _parse_header(head: bytes, file: str, size: int) -> RawHeader:
    header = raw_header(licel.parse_header(head, file=file, size=size))
    if len(head) == size:
        _check_shots(head, header)
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
        record=header,
    )


def _after_lasers(header: licel.Header) -> bytes:
    lines = 3 if header.scan is None else 4
    return header.source.split(b"\r\n", lines)[lines]


def _check_shots(content: bytes, header: RawHeader) -> None:
    """Refuse a file whose largest counts are full scale of more shots than it states."""
    for channel in header.channels:
        if channel.full_scale is None:
            continue
        first, *further = (np.frombuffer(content, "<i4", channel.bins, p) for p in channel.places)
        counts = sum(further, start=first)
        largest, full_scale = int(counts.max()), (1 << channel.adc_bits) - 1
        # A single bin may be wrong in itself.
        is_plateau = largest % full_scale == 0 and np.count_nonzero(counts == largest) > 1
        if largest > channel.full_scale and is_plateau:
            raise RawFormatError(
                f"states {channel.shots} shots, but saturates at full scale of"
                f" {largest // full_scale}: its values would be wrong by that ratio",
                file=header.path,
                field=f"shots of {channel.name}",
                remedy="leave the file out, or correct the shots in its header",
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
)
