"""The raw format ``csv``: counts as text, one row per range bin and one column per channel.

A file starts with lines ``# key: value``. Each channel has a line of its own, with further values
for analog channels::

    # start: 2026-03-01T10:00:00Z
    # stop: 2026-03-01T10:01:00Z
    # zenith_angle: 90
    # shots: 600
    # bins: 2
    # bin_width: 7.5
    # channel: analog_532o adc_bits=12 input_range=0.5
    # channel: photon_532o
    123456,77
    123450,76

Optional keys are altitude (m), azimuth, latitude and longitude (degree).
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.errors import RawFormatError
from lidarops.raw.formats import RawFile, RawFormat
from lidarops.raw.header import IncompleteHeaderError, RawChannel, RawHeader, Stretches
from lidarops.records import DetectionMode

_LINE: Final = re.compile(r"# (\w+): (.*)")
_NAME: Final = re.compile(r"(analog|photon)_(\d+)([a-z])")
_COUNT: Final = re.compile(r"0*\d{1,9}")
_AGAIN: Final = "copy the file again from the instrument, or leave it out"


def _recognises(head: bytes) -> bool:
    return head.startswith(b"# start: ")


def _parse_header(head: bytes, file: str, size: int) -> RawHeader:
    lines, rest = _split(head, file, whole=len(head) == size)
    channels = [value for key, value in lines if key == "channel"]
    values = dict(lines)
    bins = _whole(values, "bins", file)
    parsed = _channels(
        tuple(channels),
        _whole(values, "shots", file),
        bins,
        _number(values, "bin_width", file),
        file,
    )
    if len(head) == size:
        _parse_counts(rest, bins, [channel.name for channel in parsed], file)
    start, stop = _moment(values, "start", file), _moment(values, "stop", file)
    if stop < start:
        raise _refused("lies before the start", "stop", file)
    return RawHeader(
        format=FORMAT.name,
        path=file,
        size=size,
        start=start,
        stop=stop,
        channels=parsed,
        header_digest=hashlib.sha256(repr(parsed).encode()).hexdigest()[:16],
        zenith_angle=_number(values, "zenith_angle", file),
        azimuth=_number(values, "azimuth", file) if "azimuth" in values else None,
        altitude=_number(values, "altitude", file) if "altitude" in values else None,
        longitude=_number(values, "longitude", file) if "latitude" in values else None,
        latitude=_number(values, "latitude", file) if "latitude" in values else None,
    )


def _split(head: bytes, file: str, *, whole: bool) -> tuple[list[tuple[str, str]], list[str]]:
    """Return keys and values of the header, and the lines after it."""
    text = head.decode("latin-1").splitlines()
    number = next((i for i, line in enumerate(text) if not line.startswith("#")), None)
    if number is None:
        if not whole:
            raise IncompleteHeaderError("ends inside the header", file=file)
        raise _refused("holds no counts", "counts", file)
    lines = [_LINE.fullmatch(line) for line in text[:number]]
    return [(line[1], line[2].strip()) for line in lines if line], text[number:]


def _channels(
    lines: tuple[str, ...], shots: int, bins: int, bin_width: float, file: str
) -> tuple[RawChannel, ...]:
    if not lines:
        raise _refused("is missing", "channel", file)
    return tuple(
        _channel(line, column, shots, bins, bin_width, file) for column, line in enumerate(lines)
    )


def _channel(
    line: str, column: int, shots: int, bins: int, bin_width: float, file: str
) -> RawChannel:
    name, *settings = line.split()
    match = _NAME.fullmatch(name)
    if match is None:
        raise _refused(f"{name!r} is not of the form photon_532o", "channel", file)
    values = dict(setting.split("=", 1) for setting in settings if "=" in setting)
    bits, volts = 0, None
    scale = 150.0 / bin_width / shots
    if match[1] == "analog":
        bits, volts = _whole(values, "adc_bits", file), _number(values, "input_range", file)
        scale = volts * 1e3 / (shots << bits)
    return RawChannel(
        name=name,
        mode=DetectionMode(match[1]),
        wavelength=int(match[2]) * 1e-9,
        wavelength_label=match[2],
        bins=bins,
        bin_width=bin_width,
        shots=shots,
        scale=scale,
        places=(column,),
        adc_bits=bits,
        polarisation=match[3],
        input_range=volts,
    )


def _parse_counts(lines: list[str], bins: int, names: list[str], file: str) -> NDArray[np.int32]:
    """Return the counts, (bin, channel)."""
    if len(lines) != bins:
        problem = f"{len(lines)} rows of counts instead of {bins}: it is truncated or damaged"
        raise _refused(f"holds {problem}", "bins", file)
    rows = [line.split(",") for line in lines]
    for number, row in enumerate(rows, 1):
        if len(row) != len(names):
            problem = f"holds {len(row)} counts for {len(names)} channels"
            raise _refused(problem, f"row {number}", file)
        for name, count in zip(names, row, strict=True):
            if _COUNT.fullmatch(count) is None:
                problem = f"{count[:40]!r} is not a number of counts"
                raise _refused(problem, f"row {number}, {name}", file)
    return np.array(rows, dtype=np.int32)


def _read_counts(
    file: RawFile, place: int, stretches: Stretches | None, row: NDArray[np.int32]
) -> None:
    lines, rest = _split(file.read(0, file.size), file.path, whole=True)
    names = [value.split()[0] for key, value in lines if key == "channel"]
    bins = _whole(dict(lines), "bins", file.path)
    counts = _parse_counts(rest, bins, names, file.path)[:, place]
    kept = [counts[first:past] for first, past in stretches or ((0, len(counts)),)]
    row[:] = np.concatenate(kept)


def _number(values: Mapping[str, str], key: str, file: str) -> float:
    try:
        value = float(values[key])
    except KeyError:
        raise _refused("is missing", key, file) from None
    except ValueError:
        raise _refused(f"{values[key][:40]!r} is not a number", key, file) from None
    if not np.isfinite(value):
        raise _refused(f"{value} is not a finite number", key, file)
    return value


def _whole(values: Mapping[str, str], key: str, file: str) -> int:
    value = _number(values, key, file)
    if value < 1 or value != int(value):
        raise _refused(f"{values[key]} is not a whole number above 0", key, file)
    return int(value)


def _moment(values: Mapping[str, str], key: str, file: str) -> datetime:
    try:
        moment = datetime.fromisoformat(values[key])
    except KeyError:
        raise _refused("is missing", key, file) from None
    except ValueError:
        raise _refused(f"{values[key][:40]!r} is not an ISO 8601 time", key, file) from None
    if moment.tzinfo is None:
        raise _refused("has no time zone", key, file)
    return moment.astimezone(UTC)


def _refused(problem: str, field: str, file: str) -> RawFormatError:
    return RawFormatError(problem, file=file, field=field, remedy=_AGAIN)


FORMAT: Final = RawFormat(
    name="csv",
    title="CSV",
    conversion="analog: mV = counts * input_range * 1000 / (shots * 2^adc_bits);"
    " photon counting: MHz = counts / shots * (150 m / bin_width)",
    recognises=_recognises,
    parse_header=_parse_header,
    read_counts=_read_counts,
)
