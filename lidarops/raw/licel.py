"""Licel raw files: bytes to header and counts, and back (numpy and the standard library only).

Reading
    `read_header` (header only), `parse_header` (the same from bytes), `read_counts` (one file).
    Physical values of many files: `lidarops.open_archive`.
Writing
    `new_dataset` and `new_header` build a `Dataset` and a `Header` from numbers,
    ``encode(header, counts)`` returns the bytes of a file. As from Licel instruments, every header
    line starts with a blank, has its values separated by single blanks, is padded to 78 characters
    and ends in CRLF. A `Header` always agrees with its text: it is built or parsed, never edited.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarops.errors import RawFormatError
from lidarops.raw.formats import RawFile
from lidarops.raw.header import HeaderOrder, chosen
from lidarops.raw.licel_format import COUNTS, Counts, read_dataset
from lidarops.raw.licel_header import (
    CONVENTION,
    LF_ENDS,
    Dataset,
    DatasetKind,
    Header,
    Laser,
    ScanGrid,
    parse_dataset,
    parse_header,
)

__all__ = [
    "CONVENTION",
    "Dataset",
    "DatasetKind",
    "Header",
    "HeaderOrder",
    "Laser",
    "Place",
    "Recorder",
    "ScanGrid",
    "encode",
    "new_dataset",
    "new_header",
    "parse_header",
    "read_counts",
    "read_header",
]

PathLike = str | os.PathLike[str]
Dialect = Literal["classic", "extended", "raymetrics"]

_LINE: Final = 78
_INT32: Final = np.iinfo(np.int32)
_ICE_POINT: Final = 273.15
_PLACES: Final = {
    "classic": "{altitude:04.0f} {longitude:06.1f} {latitude:06.1f} {zenith_angle:02.0f}",
    "extended": "{altitude:04.0f} {longitude:011.6f} {latitude:011.6f} {zenith_angle:04.1f}"
    " {azimuth:04.1f}",
    # A number without meaning follows the zenith angle.
    "raymetrics": "{altitude:04.0f} {longitude:06.1f} {latitude:06.1f} {zenith_angle:02.0f} 00"
    " {temperature:.1f} {pressure:.1f}",
    "scan": "{altitude:04.0f} {longitude:.4f} {latitude:.4f} {zenith_angle:.1f} {azimuth:.1f}"
    " {temperature:.1f} {pressure:.1f}",
}
"""What line 2 holds after the dates, by dialect, and in scans of Raymetrics: degC and hPa."""


def _header(file: RawFile) -> Header:
    return file.read_header(lambda head: parse_header(head, file=file.path, size=file.size))


def read_header(path: PathLike) -> Header:
    """Read and check the header of a file, not its data.

    Raises
    ------
    RawFormatError
        As `parse_header`, or if the file cannot be opened.
    """
    with RawFile(path) as file:
        return _header(file)


def read_counts(
    path: PathLike, channels: Iterable[str] | None = None
) -> tuple[Header, dict[str, Counts]]:
    """Read the raw counts of one file.

    Parameters
    ----------
    path : path or str
    channels : str or iterable of str, optional
        By default the signal channels in file order. Datasets that are not signals can be named
        too.

    Returns
    -------
    Header
    dict of str to int32 array (bins,)

    Raises
    ------
    RawFormatError
        If the file cannot be read, or has no such channel; the error names the stored ones.
    """
    counts = {}
    with RawFile(path) as file:
        header = _header(file)
        stored = {d.name: d for d in header.datasets if d.places}
        if channels is None:
            channels = [d.name for d in stored.values() if d.mode is not None]
        for dataset in chosen(stored, channels, header.path):
            row = np.empty(dataset.bins, COUNTS)
            read_dataset(file, dataset.places[0], None, row)
            counts[dataset.name] = row.astype(np.int32, copy=False)
    return header, counts


class Recorder(NamedTuple):
    """How a channel is recorded."""

    kind: DatasetKind = DatasetKind.ANALOG
    """``DatasetKind.ANALOG`` or ``DatasetKind.PHOTON`` for a signal channel."""
    device: str | None = None
    """By default ``BT0`` (analog) or ``BC0`` (photon counting)."""
    high_voltage: float = 0.0
    """V; written in whole volts."""
    adc_bits: int = 12
    """Written as 0 for photon counting."""
    input_range: float = 0.5
    """V, analog; in whole millivolts."""
    discriminator: float = 3.1746e-3
    """V, photon counting; written in mV with four decimals."""
    bin_shift: float = 0.0
    """Bins; written with three decimals."""


class Place(NamedTuple):
    """Where a lidar stands and points, and the weather there: line 2 of a header."""

    site: str
    altitude: float
    """m; written in whole metres."""
    longitude: float
    """degree; one decimal, four in a scan of Raymetrics, or six in the extended dialect."""
    latitude: float
    """As the longitude."""
    zenith_angle: float = 0.0
    """degree; whole degrees except in the extended dialect. Raymetrics writes -90 for vertical, and
    in a scan the elevation, negative upwards, with one decimal."""
    azimuth: float | None = None
    """degree; makes the dialect extended, unless a scan is given; both need it."""
    temperature: float | None = None
    """K; makes the dialect raymetrics, which needs it, and the pressure."""
    pressure: float | None = None
    """Pa."""


def new_dataset(
    recorder: Recorder,
    *,
    wavelength: float,
    bins: int,
    bin_width: float,
    shots: int,
    polarisation: str = "o",
    laser: int = 1,
    laser_polarisation: int = 1,
    active: bool = True,
    comment: str = "",
) -> Dataset:
    """Build a dataset line from numbers.

    Parameters
    ----------
    recorder : Recorder
    wavelength : float
        m; written in whole nm (5.32e-5 gives the mistyped ``53200.o`` of some files).
    bins : int
    bin_width : float
        m; must fit into four characters, such as 7.5 or 15.
    shots : int
    polarisation : str
        o, p, s, r or l.
    laser, laser_polarisation : int
    active : bool
    comment : str

    Returns
    -------
    Dataset
        Without place; a header sets its offset and unique name.

    Raises
    ------
    RawFormatError
        If a number does not fit the format.
    """
    kind = recorder.kind
    analog = kind in {DatasetKind.ANALOG, DatasetKind.ANALOG_SQUARED}
    thousandths = round(recorder.bin_shift * 1000)
    tokens = [
        f"{active:d}",
        f"{kind:d}",
        f"{laser:d}",
        f"{bins:05d}",
        f"{laser_polarisation:d}",
        f"{recorder.high_voltage:04.0f}",
        _four_characters(bin_width),
        f"{round(wavelength * 1e9):05d}.{polarisation}",
        "0 0",
        f"{thousandths // 1000:02d}",
        f"{thousandths % 1000:03d}",
        f"{recorder.adc_bits if analog else 0:02d}",
        f"{shots:06d}",
        f"{recorder.input_range:.3f}" if analog else f"{recorder.discriminator * 1e3:.4f}",
        recorder.device or ("BT0" if analog else "BC0"),
        comment,
    ]
    dataset = parse_dataset(_line(*tokens))
    _compare("device", tokens[-2], dataset.device)
    if analog:
        _compare("input range", round(recorder.input_range, 9), dataset.input_range)
    return dataset


def new_header(
    *,
    name: str,
    place: Place,
    start: datetime,
    stop: datetime,
    datasets: Sequence[Dataset],
    lasers: Sequence[Laser],
    custom: str | None = None,
    timestamp: int | None = None,
    scan: ScanGrid | None = None,
    dialect: Dialect | None = None,
) -> Header:
    """Build a header from numbers.

    Parameters
    ----------
    name : str
        File name for line 1.
    place : Place
    start, stop : datetime
        Aware; written in UTC, in whole seconds.
    datasets : sequence of Dataset
        From `new_dataset` or a parsed header.
    lasers : sequence of Laser
        Two or three: shots and repetition rate in Hz.
    custom : str, optional
        Quoted text; makes the dialect extended.
    timestamp : int, optional
        Timestamp of the controller; needs three lasers.
    scan : ScanGrid, optional
        Grid of a scan of Raymetrics; needs temperature and pressure.
    dialect : {"classic", "extended", "raymetrics"}, optional
        By default the one that the given values need.

    Returns
    -------
    Header
        As parsed from its text: rounded as written, with offsets, names and promised size.

    Raises
    ------
    RawFormatError
        If a number does not fit the dialect.
    """
    if dialect is None:
        weather = place.temperature is not None or place.pressure is not None
        classic = place.azimuth is None and custom is None
        dialect = "raymetrics" if weather else "classic" if classic else "extended"
    if scan is not None and dialect != "raymetrics":
        raise RawFormatError("needs the raymetrics dialect", field="grid of the scan")
    text = b"".join(
        [
            _line(name),
            _line(
                place.site if dialect == "raymetrics" else f"{place.site:<8}",
                _utc(start, "start"),
                _utc(stop, "stop"),
                _place(dialect if scan is None else "scan", place),
                "" if custom is None else f'"{custom}"',
            ),
            *([] if scan is None else [_scan_line(scan)]),
            _line(*_laser_tokens(lasers, len(datasets), timestamp)),
            *(dataset.line for dataset in datasets),
            b"\r\n",
        ]
    )
    size = len(text) + sum(4 * dataset.bins + 2 for dataset in datasets if dataset.active)
    header = parse_header(text, file=name, size=size)
    _compare("site", place.site.strip(), header.site)
    _compare("custom text", custom, header.custom)
    _compare("grid of the scan", scan, header.scan)
    _compare("zenith angle", round(place.zenith_angle, 6), header.zenith_as_written)
    _compare("datasets", len(datasets), len(header.datasets))
    return header


def encode(header: Header, counts: Mapping[str, NDArray[Any]]) -> bytes:
    """Return the bytes of a file.

    Parameters
    ----------
    header : Header
    counts : mapping of str to integer array (bins,)
        By name, for every stored dataset of `header`.

    Raises
    ------
    RawFormatError
        If counts are missing, surplus, of a wrong shape or type, or exceed 32 bits, or if a field
        of the header was changed after it was made and contradicts its text.
    """
    if parse_header(header.source, file=header.path, size=header.size) != header:
        raise RawFormatError(
            "the fields contradict the text of the header",
            file=header.path,
            remedy="build a changed header with new_header",
        )
    stored = [dataset for dataset in header.datasets if dataset.places]
    surplus = set(counts) - {dataset.name for dataset in stored}
    if surplus:
        raise RawFormatError(f"not stored by the header: {', '.join(sorted(surplus))}")
    parts = [header.source]
    for dataset in stored:
        end = b"\n" if LF_ENDS in header.notes else b"\r\n"
        parts += [_counts(dataset, counts).tobytes(), end]
    # The size of a header read from a file without its last CRLF excludes the CRLF.
    return b"".join(parts)[: header.size]


def _counts(dataset: Dataset, counts: Mapping[str, NDArray[Any]]) -> NDArray[np.int32]:
    if dataset.name not in counts:
        raise RawFormatError("no counts are given", field=dataset.name)
    values = np.asarray(counts[dataset.name])
    if values.shape != (dataset.bins,) or values.dtype.kind not in "iu":
        raise RawFormatError(
            f"counts are {values.dtype} of shape {values.shape}, not integers of shape"
            f" ({dataset.bins},)",
            field=dataset.name,
        )
    if values.min() < _INT32.min or values.max() > _INT32.max:
        raise RawFormatError("counts exceed 32 bits", field=dataset.name)
    return values.astype("<i4")


def _line(*tokens: str) -> bytes:
    text = " " + " ".join(token for token in tokens if token)
    if not text.isprintable():
        raise RawFormatError(f"{text!r} holds a character that ends lines or does not print")
    try:
        return text.ljust(_LINE).encode("latin-1") + b"\r\n"
    except UnicodeEncodeError:
        raise RawFormatError(f"{text!r} is not Latin-1 text") from None


def _four_characters(width: float) -> str:
    text = f"{width:.2f}"[:4] if width < 100 else f"{width:04.0f}"
    if not math.isclose(float(text), width, rel_tol=1e-12):
        raise RawFormatError(f"{width:g} cannot be written in four characters", field="bin width")
    return text


def _place(form: str, place: Place) -> str:
    """Return what line 2 holds after the dates, with the values that the form has places for."""
    values = place._asdict()
    del values["site"]
    if place.temperature is not None:
        values["temperature"] = place.temperature - _ICE_POINT
    if place.pressure is not None:
        values["pressure"] = place.pressure / 100.0
    for name, value in values.items():
        if (value is not None) != (f"{{{name}:" in _PLACES[form]):
            has_none = f"a {form} header has no place for it"
            raise RawFormatError(
                f"is needed in a {form} header" if value is None else has_none,
                field=name,
                remedy="give what the dialect holds, or write another one",
            )
    return _PLACES[form].format_map(values)


def _scan_line(scan: ScanGrid) -> bytes:
    azimuth = f"{scan.azimuth_start:04.1f} {scan.azimuth_stop:05.1f} {scan.azimuth_step:04.1f}"
    first, last = f"{scan.elevation_start:04.1f}", f"{scan.elevation_stop:05.1f}"
    elevation = f"{first} {last} {scan.elevation_step:04.1f}"
    return _line(azimuth, f" {elevation}", f" {scan.azimuth_offset:04.1f}")


def _laser_tokens(lasers: Sequence[Laser], datasets: int, timestamp: int | None) -> list[str]:
    if len(lasers) not in {2, 3} or (timestamp is not None and len(lasers) == 2):
        raise RawFormatError("two or three are needed, three with a timestamp", field="lasers")
    pairs = [f"{laser.shots:07d} {laser.repetition_rate:04.0f}" for laser in lasers]
    reserved = ["0000000 0000"] if len(lasers) == 3 else []
    last = [] if timestamp is None else [f"{timestamp:d}"]
    return [*pairs[:2], f"{datasets:02d}", *pairs[2:], *reserved, *last]


def _utc(moment: datetime, name: str) -> str:
    if moment.tzinfo is None or moment.microsecond:
        raise RawFormatError("must be aware, in whole seconds", field=name)
    return f"{moment.astimezone(UTC):%d/%m/%Y %H:%M:%S}"


def _compare(name: str, requested: object, written: object) -> None:
    if requested != written:
        raise RawFormatError(
            f"{requested!r} cannot be written: it reads as {written!r}", field=name
        )
