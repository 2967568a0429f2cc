"""Header of a Licel raw file: bytes to records (standard library only).

Line 1 holds the file name; line 2 site, start, stop, altitude, longitude, latitude and zenith
angle, then azimuth and a quoted text (newer Licel) or a dummy, temperature and pressure
(Raymetrics); line 3 the lasers and the number of datasets; then one line per dataset and an
empty line (`licel2023`). Scanning lidars of Raymetrics write a line of seven decimals before the
lasers, the grid of the scan (`ScanGrid`). Instruments deviate in widths, padding, decimals and
site names, so line 2 is parsed relative to its dates, not by columns.

There is no checksum. The only guard against a wrong header is that the offsets must add up to
the size of the file: truncated files, and files with surplus bytes, are refused.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from enum import IntEnum
from functools import lru_cache
from itertools import product
from sys import intern
from typing import Any, Final, NamedTuple

from lidarops.constants import LICEL_RANGE_PER_MICROSECOND
from lidarops.errors import RawFormatError
from lidarops.raw.header import (
    LEFT_OUT,
    TIME_REMEDY,
    IncompleteHeaderError,
    RawChannel,
    RawHeader,
    holds_text,
)
from lidarops.records import DetectionMode

FORMAT: Final = "licel"
"""Name of the raw format."""
CONVENTION: Final = (
    "analog: mV = counts * input_range * 1000 / (shots * 2^adc_bits);"
    " photon counting: MHz = counts / shots * (150 m / bin_width)"
)
"""Conversion of counts to physical values. Later Licel readers divide by 2^adc_bits - 1."""

LF_ENDS: Final = "datasets end with LF instead of CRLF"
"""Note on a file."""
_LINE_LIMIT = 1024
_CACHED_BLOCK = 4 * 1024
_WITNESSES: Final = 2
"""Least number of channels that contradict the shots of another one."""
_MAX_DATASETS = 1000
_MAX_BINS = 1_000_000
_MAX_BIN_WIDTH = 1000.0
_MAX_BITS = 32
_MAX_INPUT_RANGE = 100.0
_SHORTEST, _LONGEST_WAVE = 1e-7, 2e-5
"""m."""
_YEARS = (1990, 2200)
"""Of the recorders; clocks without battery start in 1970 or 1980."""
_ICE_POINT = 273.15

_NUMBER = re.compile(r"[+-]?(?:\d{1,9}(?:[.,]\d{0,9})?|[.,]\d{1,9})", re.ASCII)
_INTEGER = re.compile(r"[+-]?\d{1,9}", re.ASCII)
_WAVELENGTH = re.compile(r"(\d{1,5})[.,]([A-Za-z0-9])", re.ASCII)
_DATE = r"(\d{1,2})/(\d{1,2})/(\d{4}) {1,8}(\d{1,2}):(\d{2}):(\d{2})"
_DATES = re.compile(rf"(?<!\S){_DATE} {{1,8}}{_DATE}(?!\S)", re.ASCII)
_NAMED = re.compile(r"[A-Za-z_]+(\d{2})([1-9A-C])(\d{2})(\d{2})\.(\d{2})(\d)(\d)?\d{0,3}", re.ASCII)
"""Name as Licel writes it: year, month in hexadecimal, day and hour, then minute and second,
or minute and tens of seconds (`licel2023`)."""
_EMPTY_LINES: Final = (b"\r\n", b"\n")
_BLOCK_LINE = re.compile(rb"[^\n]*\n")
_DECIMAL = r"[+-]?\d{1,4}[.,]\d{1,6}"
_SCAN = re.compile(rf" *{_DECIMAL}(?: +{_DECIMAL}){{6}} *", re.ASCII)

_CLOCK_STEP = timedelta(seconds=1)
"""Resolution of start and stop, by which the stop may lie before the start."""
_LONGEST = timedelta(days=1)
"""Interval of a file; a scene, of which it is one profile, is at most a day."""
_ANGLE_STEP = 0.1
"""degree; resolution of pointings and of the grid of a scan."""


class DatasetKind(IntEnum):
    """Type code of a dataset."""

    ANALOG = 0
    PHOTON = 1
    ANALOG_SQUARED = 2
    PHOTON_SQUARED = 3
    POWER_METER = 4
    OVERFLOW = 5
    OTHER = 6
    """Whatever else a file holds, such as a photodiode."""


_MODES = {
    DatasetKind.ANALOG: DetectionMode.ANALOG,
    DatasetKind.PHOTON: DetectionMode.PHOTON,
}
_SIGNAL_DEVICES = ("BT", "BC")
"""Begins of the device of analog and of photon datasets (`licel2023`)."""
_NEW_LETTERS: Final = frozenset("pr")
"""Older Licel software wrote l for parallel; in newer one that is p, and l is left circular, beside
r."""
_ANALOG = frozenset({DatasetKind.ANALOG, DatasetKind.ANALOG_SQUARED})
_PHOTON = frozenset({DatasetKind.PHOTON, DatasetKind.PHOTON_SQUARED})
_NO_SIGNAL = frozenset({DatasetKind.POWER_METER, DatasetKind.OTHER})


class ScanGrid(NamedTuple):
    """Pointings of a scan in the extra line of Raymetrics, degree as written."""

    azimuth_start: float
    azimuth_stop: float
    azimuth_step: float
    elevation_start: float
    """Elevations are negative upwards."""
    elevation_stop: float
    elevation_step: float
    azimuth_offset: float

    def holds(self, elevation: float, azimuth: float) -> bool:
        """Return whether a pointing as written is one of the grid."""
        elevations = self.elevation_start, self.elevation_stop, self.elevation_step
        azimuths = self.azimuth_start, self.azimuth_stop, self.azimuth_step
        return _is_on_grid(elevation, *elevations) and _is_on_grid(azimuth, *azimuths)


class Laser(NamedTuple):
    """One laser in line 3 of the header."""

    shots: int
    repetition_rate: float
    """Hz; 0 in many files, although the laser fires."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Dataset(RawChannel):
    """One dataset line of a header, from the parser or `licel.new_dataset`.

    Its name is unique in its header: ``analog_532o``, ``photon_355p``, ``analog_532o_2``. Its
    places are the bytes at which counts start.
    """

    # Both follow from other properties, and NaN equals nothing.
    wavelength: float = field(compare=False)
    scale: float = field(compare=False)
    kind: DatasetKind
    active: bool
    laser_polarisation: int
    comment: str
    line: bytes = field(compare=False, repr=False)
    """Header line as written, with its end."""

    __hash__ = RawChannel.__hash__

    @property
    def offset(self) -> int | None:
        """Byte at which the counts start; None if the file does not store them."""
        return self.places[0] if self.places else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Header(RawHeader):
    """Header of a Licel file, from the parser or `licel.new_header`.

    Times are by the clock of the instrument, taken as UTC; a stop that is not later than the start
    as written follows from shots and repetition rate.
    """

    name: str
    """File name in line 1."""
    zenith_as_written: float
    """degree; see `_pointing`."""
    azimuth_as_written: float | None
    """degree in [0, 360)."""
    temperature: float | None
    """K at the ground."""
    pressure: float | None
    """Pa at the ground."""
    custom: str | None
    """The quoted text of line 2."""
    scan: ScanGrid | None
    """None where no scan is stated."""
    lasers: tuple[Laser, ...]
    """Two or three."""
    timestamp: str | None
    """Timestamp of the controller, as written."""
    datasets: tuple[Dataset, ...]
    """In file order, with inactive datasets and those that are not signals."""
    data_start: int
    """Byte after the empty line."""
    source: bytes = field(compare=False, repr=False)
    """The header as written: `data_start` bytes."""


def parse_header(buffer: bytes, *, file: str = "", size: int | None = None) -> Header:
    """Parse the header at the start of `buffer`.

    Parameters
    ----------
    buffer : bytes
        A whole file or its beginning.
    file : str
        Name for messages.
    size : int, optional
        Bytes of the whole file; by default the length of `buffer`.

    Raises
    ------
    RawFormatError
        If the bytes are not a header, a value is impossible, or the header promises another
        size than the file has; the error names file, field and bytes. Only a missing last CRLF,
        or LF in place of each, is accepted, with a note.
    """
    try:
        return _parse(buffer, file, len(buffer) if size is None else size)
    except RawFormatError as error:
        error.file = file or None
        raise


def _parse(buffer: bytes, file: str, size: int) -> Header:
    first, second, third, scan, block_start = _first_lines(buffer)
    dates = _DATES.search(second)
    if dates is None:
        raise RawFormatError(
            "holds no start and stop date: this is not a Licel file", field="header line 2"
        )
    try:
        start, stop = _moments(dates)
    except RawFormatError as error:
        error.problem += _by_name(first.strip())
        error.remedy = error.remedy or TIME_REMEDY
        raise
    place, notes = _parse_place(second[dates.end() :].rstrip())
    lasers, number, timestamp, unknown = _parse_lasers(third)
    block_end = _dataset_lines_end(buffer, block_start, number)
    data_start = block_end + (1 if buffer.startswith(b"\n", block_end) else 2)
    block = buffer[block_start:block_end]
    parse = _parse_datasets if len(block) <= _CACHED_BLOCK else _parse_datasets.__wrapped__
    try:
        ends = (2, 1) if buffer[:data_start].endswith(b"\r\n") else (1, 2)
        datasets, dataset_notes = parse(block, data_start, size, ends)
    except RawFormatError:
        _refuse_export(buffer[data_start:])
        raise
    notes += unknown + _check_shots(datasets, lasers)
    if buffer[:data_start].count(b"\n") > buffer[:data_start].count(b"\r\n"):
        notes += ("lines of the header end with LF instead of CRLF",)
    if stop < start:
        notes += ("stop lies 1 s before start: the interval follows from the shots",)
    channels = _channels(datasets)
    if any(len(channel.places) > 1 for channel in channels):
        notes += ("channels have two memories: counts and shots of both are added",)
    site = second[: dates.start()].strip()
    zenith, azimuth, doubt = _pointing(
        place["zenith_as_written"], place["azimuth_as_written"], scan
    )
    return Header(
        **place,
        format=FORMAT,
        path=file or first.strip(),
        size=size,
        start=start,
        stop=_stop_by_shots(start, channels, lasers) if stop <= start else stop,
        zenith_angle=zenith,
        azimuth=azimuth,
        notes=notes + dataset_notes,
        header_digest=_digest(site, data_start, block + b"\r\n"),
        channels=channels,
        site=site,
        doubt=doubt,
        time_doubt=_time_doubt(first.strip(), start),
        written_angle=place["zenith_as_written"] if scan is None else None,
        name=first.strip(),
        scan=scan,
        lasers=lasers,
        timestamp=timestamp,
        datasets=datasets,
        data_start=data_start,
        source=buffer[:data_start],
    )


def _first_lines(buffer: bytes) -> tuple[str, str, str, ScanGrid | None, int]:
    """Return lines 1, 2 and 3, the grid of a scan between the last two, and where line 4 starts."""
    ends = _line_ends(buffer, 0, 3)
    first, second, third = (
        _text(buffer[start:end]) for start, end in zip((0, *ends), ends, strict=False)
    )
    scan = None
    if _SCAN.fullmatch(third):
        scan = ScanGrid(*(_number(token, "grid of the scan") for token in third.split()))
        ends += _line_ends(buffer, ends[2], 1)
        third = _text(buffer[ends[2] : ends[3]])
    return first, second, third, scan, ends[-1]


def _text(line: bytes) -> str:
    """Return a line without its end, CRLF or LF."""
    return line.removesuffix(b"\n").removesuffix(b"\r").decode("latin-1")


def _dataset_lines_end(buffer: bytes, start: int, number: int) -> int:
    """Return the end of that many dataset lines, which an empty line must follow."""
    end = _line_ends(buffer, start, number)[-1]
    if buffer.startswith(_EMPTY_LINES, end):
        return end
    if len(buffer) < end + 2:
        raise IncompleteHeaderError("the file ends inside the header", field="empty line")
    _refuse_export(buffer[end:])
    raise RawFormatError(
        "no empty line follows the dataset lines: the number of datasets in line 3 is wrong",
        field="number of datasets",
    )


def _stop_by_shots(
    start: datetime, channels: tuple[Dataset, ...], lasers: tuple[Laser, ...]
) -> datetime:
    """Return when the shots of the channels have been fired; the start where no rate is stated."""
    rate = max(laser.repetition_rate for laser in lasers)
    shots = max((channel.shots for channel in channels), default=0)
    return start + timedelta(seconds=shots / rate) if rate > 0.0 else start


# All but name, times, place, lasers and weather; the same in many files.
@lru_cache(maxsize=128)
def _digest(site: str, data_start: int, datasets: bytes) -> str:
    prefix = f"{site}\n{data_start}\n".encode()
    return hashlib.sha256(prefix + datasets).hexdigest()[:16]


@lru_cache(maxsize=128)
def _channels(datasets: tuple[Dataset, ...]) -> tuple[Dataset, ...]:
    """Return the signals, each with the shots and places of all its memories."""
    channels = []
    for first, *others in memories(datasets):
        channel = first
        if others:
            shots = sum((memory.shots for memory in others), first.shots)
            places = sum((memory.places for memory in others), first.places)
            channel = replace(first, shots=shots, scale=_scale(first, shots), places=places)
        channels.append(channel)
    return tuple(channels)


def _scale(dataset: Dataset, shots: int) -> float:
    """Return the physical value of one count, mV or MHz; NaN without shots or signal."""
    if shots == 0 or dataset.mode is None:
        return math.nan
    if dataset.input_range is not None:
        return dataset.input_range * 1e3 / (shots << dataset.adc_bits)
    return LICEL_RANGE_PER_MICROSECOND / dataset.bin_width / shots


def _pointing(
    written: float, azimuth: float | None, scan: ScanGrid | None
) -> tuple[float | None, float | None, str]:
    """Return zenith angle and azimuth in degree, and why they are unknown, in words.

    -90 as written means vertical. Scans state elevations, negative upwards (Raymetrics).
    """
    if scan is None:
        if written >= 0.0 or written == -90.0:
            return max(written, 0.0), azimuth, ""
        doubt = "may be an elevation or a zenith angle: the header holds no grid of a scan"
        return None, azimuth, f"the pointing {written:g} degree {doubt}"
    if azimuth is not None and scan.holds(written, azimuth):
        return 90.0 + written, (azimuth + scan.azimuth_offset) % 360.0, ""
    at = "unknown azimuth" if azimuth is None else f"azimuth {azimuth:g}"
    doubt = "is not on the grid of its scan: it is that of an earlier file"
    return None, None, f"the pointing {written:g} degree at {at} {doubt}"


def stated_start(buffer: bytes) -> datetime | None:
    """Return the start that the first lines of a file state; None where they state no sure one."""
    try:
        first, second = _line_ends(buffer, 0, 2)
        dates = _DATES.search(_text(buffer[first:second]))
        if dates is None:
            return None
        start = _moments(dates)[0]
    except RawFormatError:
        return None
    return None if _time_doubt(_text(buffer[:first]).strip(), start) else start


def named_time(name: str) -> datetime | None:
    """Return the time that the name of a file tells, UTC as its header; None where it tells none.

    It is the start or the stop, and in some archives a local time.
    """
    found = _NAMED.fullmatch(name)
    if found is None:
        return None
    year, month, *others, tens, ones = found.groups()
    day, hour, minute = map(int, others)
    seconds = int(tens + (ones or "0"))
    try:
        century = 1900 if int(year) >= _YEARS[0] % 100 else 2000
        return datetime(century + int(year), int(month, 16), day, hour, minute, seconds, tzinfo=UTC)
    except ValueError:
        return None


def _time_doubt(name: str, start: datetime) -> str:
    """Return that a start is more than a day away from the time in the name of the file."""
    named = named_time(name)
    if named is None or abs(start - named) <= _LONGEST:
        return ""
    return f"states {start:%Y-%m-%d %H:%M}{_by_name(name)}"


def _by_name(name: str) -> str:
    """Return what the name of a file tells of its time, in words; empty where it tells none."""
    named = named_time(name)
    if named is None:
        return ""
    return f", the name of the file in its first line ({name}) {named:%Y-%m-%d %H:%M}"


def _refuse_export(data: bytes) -> None:
    """Refuse a file with text in the place of counts."""
    if holds_text(data):
        raise RawFormatError(
            "holds numbers as text where a Licel file holds binary counts: it is an export",
            field="data",
            remedy="make the pattern of the instrument leave it out",
        ) from None


def _line_ends(buffer: bytes, start: int, number: int) -> list[int]:
    """Return where lines end, behind their CRLF, or LF alone; the size of the file proves both."""
    ends = []
    for _ in range(number):
        end = buffer.find(b"\n", start, start + _LINE_LIMIT) + 1
        if end == 0:
            if len(buffer) < start + _LINE_LIMIT:
                raise IncompleteHeaderError("the file ends inside the header", field="header")
            raise RawFormatError(
                f"no line end within {_LINE_LIMIT} bytes: this is not a Licel file",
                field="header",
            )
        ends.append(end)
        start = end
    return ends


# Headers of an archive repeat the same few numbers.
@lru_cache(maxsize=1024)
def _number(token: str, name: str, low: float = -math.inf, high: float = math.inf) -> float:
    if _NUMBER.fullmatch(token) is None:
        raise RawFormatError(f"{token[:40]!r} is not a number", field=name)
    value = float(token.replace(",", "."))
    if not low <= value <= high:
        raise RawFormatError(f"{value:g} is not within {low:g} to {high:g}", field=name)
    return value


@lru_cache(maxsize=1024)
def _integer(token: str, name: str, low: float = -math.inf, high: float = math.inf) -> int:
    if _INTEGER.fullmatch(token) is None:
        raise RawFormatError(f"{token[:40]!r} is not an integer", field=name)
    return int(_number(token, name, low, high))


def _moments(dates: re.Match[str]) -> tuple[datetime, datetime]:
    moments = []
    for name, numbers in (("start", dates.groups()[:6]), ("stop", dates.groups()[6:])):
        day, month, _, hour, minute, second = map(int, numbers)
        year = _integer(numbers[2], name, *_YEARS)
        try:
            moments.append(datetime(year, month, day, hour, minute, second, tzinfo=UTC))
        except ValueError as error:
            raise RawFormatError(f"is not a date and time: {error}", field=name) from None
    start, stop = moments
    if stop < start - _CLOCK_STEP:
        raise RawFormatError(f"{stop:%Y-%m-%d %H:%M:%S} lies before the start", field="stop")
    if stop - start > _LONGEST:
        raise RawFormatError(
            f"{stop:%Y-%m-%d %H:%M:%S} lies {(stop - start) / _LONGEST:.1f} days after the start"
            f" {start:%Y-%m-%d %H:%M:%S}",
            field="stop",
            remedy="leave the file out, or correct the damaged date in its header",
        )
    return start, stop


@lru_cache(maxsize=128)
def memories(datasets: tuple[Dataset, ...]) -> tuple[tuple[Dataset, ...], ...]:
    """Return the stored signal datasets in file order, those of one channel together.

    A recorder with two memories writes the same channel twice. In files of Raymetrics the first
    one holds the shots of both, and the second one zeros: only the sums of counts and of shots
    are those of one signal.
    """
    groups: dict[tuple[object, ...], list[Dataset]] = {}
    for one in datasets:
        if one.places and one.mode is not None:
            recorded = (
                one.active, one.kind, one.device, one.laser, one.wavelength_label, one.bins,
                one.bin_width, one.adc_bits, one.input_range, one.bin_shift,
            )  # fmt: skip
            groups.setdefault(recorded, []).append(one)
    return tuple(tuple(group) for group in groups.values())


@lru_cache(maxsize=128)
def _check_shots(datasets: tuple[Dataset, ...], lasers: tuple[Laser, ...]) -> tuple[str, ...]:
    """Return a note if line 3 contradicts the only channel: either may be damaged.

    A file is refused if two or more witnesses contradict the shots of a single channel. Witnesses
    are other channels; of a channel with one other of the same recorder, also line 3. A recorder
    that misses triggers misses them for all its datasets; a damaged digit is one. All channels of
    each of 272 measured files state the same shots, those of recorders with two memories as the
    sum over both, and in 180 files they are those of line 3. A dataset without shots gives no
    values.
    """
    groups = memories(datasets)
    fired = {laser.shots for laser in lasers}
    if len(groups) < _WITNESSES:
        only, stated = [one for group in groups for one in group], fired - {0}
        if len(only) != 1 or not stated or only[0].shots in fired | {0}:
            return ()
        words = ", ".join(map(str, sorted(stated)))
        return (f"{only[0].name} states {only[0].shots} shots, line 3 {words}",)
    # A channel that alone is recorded twice cannot be compared with the others.
    usual = Counter(len(group) for group in groups).most_common(1)[0][0]
    shots = {g[0].name: sum(d.shots for d in g) for g in groups if len(g) == usual}
    counted = {name: number for name, number in shots.items() if number}
    # The analog and photon ones of a recorder are named alike, as BT0 and BC0.
    one_recorder = len({group[0].device[2:] for group in groups}) == 1
    if len(counted) > _WITNESSES:
        alike, channels = Counter(counted.values()).most_common(1)[0]
        # A recorder of two memories states line 3 for each of them, or less.
        others = {alike} if channels == len(counted) - 1 else fired
    elif len(counted) == len(groups) and one_recorder:
        others = fired & set(counted.values())
    else:
        return ()
    outlying = {name: n for name, n in counted.items() if n not in others | fired}
    if len(outlying) == 1:
        ((name, number),) = outlying.items()
        raise RawFormatError(
            f"states {number} shots, all other channels {', '.join(map(str, sorted(others)))}: its"
            " values would be wrong by that ratio",
            field=f"shots of {name}",
            remedy="leave the file out, or correct the shots in its header",
        )
    return ()


def _is_on_grid(value: float, start: float, stop: float, step: float) -> bool:
    low, high = min(start, stop) - _ANGLE_STEP, max(start, stop) + _ANGLE_STEP
    if not low <= value <= high:
        return False
    from_node = 0.0 if step == 0.0 else abs(math.remainder(value - start, step))
    # The last pointing need not be a whole number of steps from the first one.
    return min(from_node, abs(value - stop)) <= _ANGLE_STEP


# Position, pointing and lasers are the same in many files.
@lru_cache(maxsize=1024)
def _parse_place(text: str) -> tuple[Mapping[str, Any], tuple[str, ...]]:
    """Return what follows the dates in line 2, by fields of `Header`, and notes."""
    before, quote, after = text.partition('"')
    custom, end, _ = after.rpartition('"')
    if quote and not end:
        raise RawFormatError("the quoted text does not end", field="header line 2")
    tokens = before.split()
    if len(tokens) < 4:
        raise RawFormatError(
            "altitude, longitude, latitude and zenith angle do not follow the dates",
            field="header line 2",
        )
    altitude, longitude, latitude = map(_number, tokens, ("altitude", "longitude", "latitude"))
    zenith = _number(tokens[3], "zenith angle", -180, 180)
    notes: tuple[str, ...] = ("zenith angle -90 taken as vertical",) if zenith == -90.0 else ()
    azimuth = temperature = pressure = None
    # Raymetrics: zenith, a dummy integer, temperature, pressure. Licel: zenith, azimuth.
    if len(tokens) == 5 or (len(tokens) == 7 and set(".,") & set(tokens[4])):
        azimuth = _number(tokens[4], "azimuth", -360, 360) % 360.0
    if len(tokens) == 7:
        temperature = _number(tokens[5], "temperature") + _ICE_POINT
        pressure = _number(tokens[6], "pressure") * 1e2
        if not (150 < temperature < 350 and 1e4 < pressure < 1.2e5):
            temperature = pressure = None
            notes += (f"{tokens[5]} degC, {tokens[6]} hPa are impossible and ignored",)
    elif len(tokens) not in {4, 5}:
        notes += (f"{len(tokens) - 4} values after the zenith angle are not interpreted",)
    place = {
        "altitude": altitude,
        "longitude": longitude,
        "latitude": latitude,
        "zenith_as_written": zenith,
        "azimuth_as_written": azimuth,
        "temperature": temperature,
        "pressure": pressure,
        "custom": custom if quote else None,
    }
    return place, notes


@lru_cache(maxsize=1024)
def _parse_lasers(text: str) -> tuple[tuple[Laser, ...], int, str | None, tuple[str, ...]]:
    tokens = text.split()
    if len(tokens) < 5:
        raise RawFormatError("holds fewer than 5 values", field="header line 3")
    number = _integer(tokens[4], "number of datasets", 1, _MAX_DATASETS)
    pairs = [tokens[0:2], tokens[2:4]] + ([tokens[5:7]] if len(tokens) >= 7 else [])
    lasers = tuple(
        Laser(_integer(shots, "laser shots"), _number(rate, "repetition rate"))
        for shots, rate in pairs
    )
    timestamp = tokens[9] if len(tokens) == 10 else None
    unknown = len(tokens) not in {5, 7, 9, 10}
    notes = (f"{len(tokens)} values in line 3 are not all interpreted",) if unknown else ()
    return lasers, number, timestamp, notes


# Dataset lines repeat from file to file: parsing them once makes a header scan fast.
@lru_cache(maxsize=128)
def _parse_datasets(
    block: bytes, data_start: int, size: int, ends: tuple[int, int]
) -> tuple[tuple[Dataset, ...], tuple[str, ...]]:
    """Return the datasets that fit the size of the file, and notes on them.

    The lengths of line ends are tried in turn, first that of the line before the counts.
    """
    datasets = _parse_lines(block)
    notes = [
        f"{d.name} has no shots: its values are undefined"
        for d in datasets
        if d.active and d.shots == 0 and d.kind not in _NO_SIGNAL
    ]
    notes += [
        f"{d.name} is no signal by its type, and one by its device {d.device}"
        for d in datasets
        if d.active and d.mode is None and d.device.startswith(_SIGNAL_DEVICES)
        if not _lacks_bits(d)
    ]
    notes += [
        f"{d.name} ({d.device}) states 0 bits and {LEFT_OUT}"
        for d in datasets
        if d.active and _lacks_bits(d)
    ]
    notes += [
        f"dataset {d.device} cannot be a signal and {LEFT_OUT}"
        for d in datasets
        if d.active and d.kind in _NO_SIGNAL and not d.device.startswith(_SIGNAL_DEVICES)
    ]
    notes += [
        f"polarisation l of {d.name} means parallel, as in older files"
        for d in datasets
        if d.active and d.polarisation == "p" and d.wavelength_label.endswith("l")
    ]
    # By the specification, inactive datasets are not stored; some software stores them. Some ends
    # datasets with LF: one or two are then as long as with CRLF of which the last is missing, so
    # the last line of the header decides; bytes around datasets are checked when they are read.
    expected: list[int] = []
    for all_stored, end in product((False, True), ends):
        lengths = [4 * d.bins + end for d in datasets if d.active or all_stored]
        expected.append(data_start + sum(lengths))
        promised = expected[-1]
        if size != promised and not (lengths and end == 2 and promised - 2 <= size < promised):
            continue
        notes += ["inactive datasets are stored"] * all_stored
        notes += ["the last CRLF is missing"] * (size < promised)
        notes += [LF_ENDS] * (end == 1 and bool(lengths))
        place = data_start
        for index, dataset in enumerate(datasets):
            if dataset.active or all_stored:
                datasets[index] = replace(dataset, places=(place,))
                place += 4 * dataset.bins + end
        return tuple(datasets), tuple(notes)
    raise RawFormatError(
        f"the header promises {expected[0]} bytes, the file has {size}:"
        f" it {'is truncated' if size < expected[0] else 'has surplus bytes'}",
        field="size",
        remedy="copy the file again from the instrument, or leave it out",
    )


def _lacks_bits(dataset: Dataset) -> bool:
    return dataset.kind in _ANALOG and dataset.adc_bits == 0


def _parse_lines(block: bytes) -> list[Dataset]:
    datasets: list[Dataset] = []
    for line in _BLOCK_LINE.finditer(block):
        try:
            datasets.append(parse_dataset(line[0]))
        except RawFormatError as error:
            error.field = f"dataset {len(datasets) + 1}, {error.field}"
            raise
    letters: dict[str, set[str]] = defaultdict(set)
    for dataset in datasets:
        letters[dataset.wavelength_label[:-1]].add(dataset.polarisation)
    for place, dataset in enumerate(datasets):
        beside = letters[dataset.wavelength_label[:-1]]
        if dataset.polarisation == "l" and not beside & _NEW_LETTERS:
            name = f"{dataset.name[:-1]}p"
            datasets[place] = replace(dataset, polarisation="p", name=name)
    uses: Counter[str] = Counter()
    # Active datasets get their names first: an inactive one must not take the plain name.
    for index in sorted(range(len(datasets)), key=lambda index: not datasets[index].active):
        name = datasets[index].name
        uses[name] += 1
        if uses[name] > 1:
            datasets[index] = replace(datasets[index], name=f"{name}_{uses[name]}")
    return datasets


def parse_dataset(line: bytes) -> Dataset:
    """Parse one dataset line outside of a header: it has no place, and its name is not yet unique.

    Raises
    ------
    RawFormatError
        If a value is missing or impossible, of a device that may be a signal.
    """
    tokens = line.decode("latin-1").split()
    if len(tokens) < 16:
        raise RawFormatError(f"holds {len(tokens)} values instead of 16", field="line")
    if tokens[0] not in {"0", "1"}:
        raise RawFormatError(f"{tokens[0][:40]!r} is neither 0 nor 1", field="active")
    try:
        return _parse_signal(tokens, line)
    except RawFormatError:
        if tokens[15].startswith(_SIGNAL_DEVICES):
            raise
    # Only its length matters: what follows it has its place behind it.
    return Dataset(
        name=f"other_{tokens[15]}",
        mode=None,
        wavelength=math.nan,
        wavelength_label=intern(tokens[7]),
        bins=_integer(tokens[3], "bins", 1, _MAX_BINS),
        bin_width=math.nan,
        shots=0,
        scale=math.nan,
        places=(),
        device=intern(tokens[15]),
        kind=DatasetKind.OTHER,
        active=tokens[0] == "1",
        laser_polarisation=0,
        comment=" ".join(tokens[16:]),
        line=line,
    )


def _parse_signal(tokens: list[str], line: bytes) -> Dataset:
    """Return a dataset all of whose values are possible."""
    kind = DatasetKind(_integer(tokens[1], "type", DatasetKind.ANALOG, DatasetKind.OVERFLOW))
    label = _WAVELENGTH.fullmatch(tokens[7])
    if label is None:
        raise RawFormatError(f"{tokens[7][:40]!r} is not of the form 00532.o", field="wavelength")
    polarisation = label[2].lower().replace("0", "o")
    wavelength = int(label[1]) * 1e-9
    adc_bits = _integer(tokens[12], "ADC bits", 0, _MAX_BITS)
    # A recorder without bits has no counts.
    analog, photon = kind in _ANALOG and adc_bits > 0, kind in _PHOTON
    least = 1e-6 if analog else -math.inf
    level = _number(tokens[14], "input range", least, _MAX_INPUT_RANGE if analog else math.inf)
    fraction = abs(_integer(tokens[11], "bin shift"))
    dataset = Dataset(
        name=f"{kind.name.lower()}_{int(label[1])}{polarisation}",
        mode=_MODES.get(kind) if analog or photon else None,
        wavelength=wavelength if _SHORTEST < wavelength < _LONGEST_WAVE else math.nan,
        scale=math.nan,
        places=(),
        kind=kind,
        active=tokens[0] == "1",
        laser=_integer(tokens[2], "laser"),
        bins=_integer(tokens[3], "bins", 1, _MAX_BINS),
        laser_polarisation=_integer(tokens[4], "laser polarisation"),
        high_voltage=_number(tokens[5], "high voltage"),
        bin_width=_number(tokens[6], "bin width", 1e-3 if analog or photon else 0, _MAX_BIN_WIDTH),
        wavelength_label=intern(f"{label[1]}.{label[2]}"),
        polarisation=polarisation,
        bin_shift=_integer(tokens[10], "bin shift") + float(f"0.{fraction:0{len(tokens[11])}d}"),
        adc_bits=adc_bits,
        shots=_integer(tokens[13], "shots", 0, 10**9),
        input_range=level if analog else None,
        discriminator=level * 1e-3 if photon else None,
        device=intern(tokens[15]),
        comment=" ".join(tokens[16:]),
        line=line,
    )
    return replace(dataset, scale=_scale(dataset, dataset.shots))
