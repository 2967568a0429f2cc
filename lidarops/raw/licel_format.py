"""The raw format ``licel``: Licel files as `lidarops.raw.formats` knows them."""

from __future__ import annotations

import hashlib
import re
from dataclasses import fields
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.raw import licel
from lidarops.raw.file import RawFile
from lidarops.raw.formats import RawFormat
from lidarops.raw.header import RawChannel, RawHeader, Stretches

_FIRST_LINES: Final = re.compile(rb"[^\r\n]{0,1022}\r\n[^\r\n]{0,1022}?\d/\d{4} +\d{1,2}:\d\d:\d\d")


_COMMON: Final = tuple(field.name for field in fields(RawChannel) if field.name != "place")
"""Properties of channels that datasets have under the same name."""


def _recognises(head: bytes) -> bool:
    return _FIRST_LINES.match(head) is not None


def _parse_header(head: bytes, file: str, size: int) -> RawHeader:
    return raw_header(licel.parse_header(head, file=file, size=size))


def raw_header(header: licel.Header) -> RawHeader:
    """Return the header of a Licel file in the general form."""
    return RawHeader(
        format=FORMAT.name,
        path=header.path or header.name,
        size=header.size,
        start=header.start,
        stop=header.stop,
        channels=_channels(header.datasets),
        digest=_digest(header.site, header.data_start, header.source.split(b"\r\n", 3)[3]),
        zenith_angle=header.zenith_angle,
        azimuth=header.azimuth,
        altitude=header.altitude,
        coordinates=(header.longitude, header.latitude),
        site=header.site,
        notes=header.notes,
        record=header,
    )


@lru_cache(maxsize=128)
def _channels(datasets: tuple[licel.Dataset, ...]) -> tuple[RawChannel, ...]:
    return tuple(
        RawChannel(place=dataset.offset, **{name: getattr(dataset, name) for name in _COMMON})
        for dataset in datasets
        if dataset.offset is not None and dataset.mode is not None
    )


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
