"""Read soundings and profiles of models, each format by a small reader.

A reader yields `Record`: named columns with their units, time and place. `soundings` turns them
into SI, and into levels of rising altitude.
"""

from __future__ import annotations

import gzip
import io
import re
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path, PurePosixPath
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from lidarops.campaign.ancillary_files import (
    LARGEST,
    Table,
    netcdf_table,
    read_file,
    refuse_wide_levels,
)
from lidarops.campaign.atmosphere import AtmosphereReading
from lidarops.errors import AncillaryError, RetrievalInputError
from lidarops.retrieve.air.molecular import (
    MolecularProfile,
    altitude_of,
    thickness,
    vapour_share,
)

Array = npt.NDArray[np.float64]

_GRAVITY: Final = 9.80665
"""m s-2, by which geopotential height is defined."""
_MISSING: Final = -888.0
"""Values up to this are marks of what is missing: -999, -9999, -8888."""
_MISSING_OF_IGRA: Final = -8888.0
"""The same of IGRA, whose -888 is -88.8 degC."""
_LEAST_KELVIN: Final = 100.0
"""K; the largest dew point of a sounding is above, and below in degC."""
_PAUSE: Final = 1800.0
"""s between two rows of a table that are of two soundings: meanwhile a balloon rises by 9 km."""
_FEWEST: Final = 5
"""Levels of a sounding that is used."""
_LEAST_REACH: Final = 5000.0
"""m between its lowest and highest level: a balloon that bursts below tells little of the air where
signals are compared with it."""
_MOST_HECTOPASCAL: Final = 2000.0
"""Largest pressure of a column without unit that is in hPa."""
_SECONDS: Final[Mapping[str, float]] = {"second": 1.0, "minute": 60.0, "hour": 3600.0, "day": 86400}
_MONTHS: Final = "JanFebMarAprMayJunJulAugSepOctNovDec"


@dataclass(frozen=True, slots=True, eq=False)
class TimedProfile:
    """The air over one place at one time."""

    time: datetime
    latitude: float
    """degree north."""
    longitude: float
    """degree east."""
    origin: str
    """One of `ORIGINS`."""
    profile: MolecularProfile


class Record(NamedTuple):
    """One profile as its file states it."""

    columns: Table
    time: datetime | None = None
    place: tuple[float, float] = (np.nan, np.nan)
    """Latitude and longitude, degree."""
    origin: str = "radiosounding"


ORIGINS: Final = ("radiosounding", "ecmwf", "icon", "gdas")
"""What profiles come from."""


class _Quantity(NamedTuple):
    """A quantity of soundings."""

    names: tuple[str, ...]
    """In titles of columns, in lower case."""
    units: Mapping[str, tuple[float, float]]
    """Unit in lower case -> factor to SI and what is added; empty where none need be given."""


_CELSIUS: Final = (1.0, 273.15)
_DEGREES: Final = {
    "": (1.0, 0.0), "k": (1.0, 0.0), "c": _CELSIUS, "degc": _CELSIUS, "oc": _CELSIUS,
}  # fmt: skip
_HECTO: Final = (100.0, 0.0)
_METRES: Final = {
    "": (1.0, 0.0),
    "m": (1.0, 0.0),
    "km": (1000.0, 0.0),
    "meters above mean sea level": (1.0, 0.0),
}
_SHARE: Final = {
    "1": (1.0, 0.0), "kg kg-1": (1.0, 0.0), "kg kg**-1": (1.0, 0.0), "kg/kg": (1.0, 0.0),
    "g/kg": (1e-3, 0.0), "g kg-1": (1e-3, 0.0),
}  # fmt: skip
_QUANTITIES: Final[Mapping[str, _Quantity]] = {
    "pressure": _Quantity(
        ("pressure", "pres", "level", "pressure_level"),
        {"pa": (1.0, 0.0), "hpa": _HECTO, "mbar": _HECTO, "mb": _HECTO,
         "millibars": _HECTO},
    ),
    "temperature": _Quantity(("temperature", "temp", "tdry", "t"), _DEGREES),
    "altitude": _Quantity(("altitude", "alt"), _METRES),
    "geopotential_height": _Quantity(
        ("geopotential_height", "geopotential height", "hght", "hgts"), _METRES
    ),
    "geopotential": _Quantity(
        ("geopotential", "z"),
        {"m2 s-2": (1.0 / _GRAVITY, 0.0), "m**2 s**-2": (1.0 / _GRAVITY, 0.0)},
    ),
    "dew_point": _Quantity(
        ("dew_point", "dew point", "dew point temperature", "dwpt", "dp"), _DEGREES
    ),
    "relative_humidity": _Quantity(
        ("relative_humidity", "relative humidity", "rh", "relh", "r"),
        {"1": (1.0, 0.0), "%": (0.01, 0.0)},
    ),
    "specific_humidity": _Quantity(("specific_humidity", "q"), _SHARE),
    "mixing_ratio": _Quantity(("mixing_ratio", "mixing ratio", "mixr"), _SHARE),
}  # fmt: skip
_HEIGHTS: Final = ("altitude", "geopotential_height", "geopotential")
_PLACE: Final = {"latitude": ("latitude", "lat"), "longitude": ("longitude", "lon")}


def soundings(
    folder: Path, name: str, reading: AtmosphereReading, place: tuple[float, float]
) -> tuple[tuple[TimedProfile, ...], str]:
    """Return the profiles of a file that can be used, in its order, and what of it is damaged.

    The damage is told in words. A sounding that is only too short is none: archives hold many.

    Parameters
    ----------
    folder : Path
        Folder of the campaign file.
    name : str
        Path of the file below `folder`.
    reading : AtmosphereReading
        What the file does not state.
    place : (float, float)
        Latitude and longitude, degree. Of a grid, the nearest point is read.

    Raises
    ------
    AncillaryError
        If the file holds no profile; the message names file, field and remedy.
    """
    found: list[TimedProfile] = []
    damaged: list[tuple[str, AncillaryError]] = []
    short: list[tuple[str, AncillaryError]] = []
    try:
        for record in _records(folder, name, reading, place):
            if isinstance(record, AncillaryError):
                damaged.append(("", record))
                continue
            try:
                found.append(_sounding(record, name, reading))
            except AncillaryError as error:
                time = f"sounding of {record.time:%Y-%m-%dT%H:%MZ}: " if record.time else ""
                (short if isinstance(error, _TooShortError) else damaged).append((time, error))
    except AncillaryError:
        raise
    except (ValueError, LookupError, OverflowError) as error:
        raise AncillaryError(
            "is damaged, or of another form", file=name, remedy="compare it with its origin"
        ) from error
    if not found:
        none = AncillaryError("holds no profile", file=name, remedy="remove the file")
        raise next((error for _, error in (*damaged, *short)), none)
    if not damaged:
        return tuple(found), ""
    time, first = damaged[0]
    more = f", and {len(damaged) - 1} more" if len(damaged) > 1 else ""
    words = f"{time}{str(first).removeprefix(f'{name}: ')}{more}; the rest of the file is used"
    return tuple(found), words


class _TooShortError(AncillaryError):
    """A sounding of too few levels."""


def _records(
    folder: Path, name: str, reading: AtmosphereReading, place: tuple[float, float]
) -> Iterator[Record | AncillaryError]:
    """Yield the profiles of a file, and an error for each part that is damaged."""
    stored = read_file(folder, name)
    content = _unpacked(stored, name)
    if content.startswith((b"CDF", b"\x89HDF")):
        table = _netcdf(folder / name, name, content if content is not stored else b"")
        for wanted, read in _NETCDF_FORMATS:
            if wanted <= table.keys():
                yield from read(table, name, place)
                return
    for mark in ("GRIB", "BUFR"):
        if mark.encode() in content[:100]:
            raise AncillaryError(
                f"is {mark}, which is not read", file=name, remedy="convert it to NetCDF or CSV"
            )
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise AncillaryError(
            "is neither text nor NetCDF", file=name, remedy="give a file of a known format"
        ) from error
    for mark, begin, read_text in _TEXT_FORMATS:
        if re.search(mark, text[:2000]) and not reading.columns:
            parts = re.split(begin, text, flags=re.MULTILINE)[1:]
            yield from _records_of_parts(read_text, parts, name)
            return
    yield from _csv_records(text, name, reading.columns)


def _records_of_parts(
    read: Callable[[str], Record], parts: list[str], name: str
) -> Iterator[Record | AncillaryError]:
    for number, part in enumerate(parts, start=1):
        try:
            yield read(part)
        except (ValueError, LookupError, OverflowError) as error:
            problem = error.problem if isinstance(error, AncillaryError) else "is damaged"
            begin = part.strip().partition("\n")[0]
            yield AncillaryError(
                f"{problem}; it begins with {begin[:40]!r}",
                file=name,
                field=f"sounding {number}",
                remedy="compare it with its origin",
            )


def _unpacked(content: bytes, name: str) -> bytes:
    """Return the content of a file that is packed by gzip or zip, which holds one file."""
    try:
        if content.startswith(b"\x1f\x8b"):
            with gzip.GzipFile(fileobj=io.BytesIO(content)) as stream:
                content = stream.read(LARGEST + 1)
        elif content.startswith(b"PK\x03\x04"):
            with zipfile.ZipFile(io.BytesIO(content)) as packed:
                names = [each for each in packed.namelist() if not each.endswith("/")]
                if len(names) != 1:
                    raise AncillaryError(
                        f"holds {len(names)} files: {', '.join(names[:3])}",
                        file=name,
                        remedy="pack each file alone, or unpack them",
                    )
                with packed.open(names[0]) as member:
                    content = member.read(LARGEST + 1)
    # RuntimeError: it needs a password.
    except (OSError, EOFError, RuntimeError, zlib.error, zipfile.BadZipFile) as error:
        raise AncillaryError(f"cannot be unpacked: {error}", file=name) from error
    if len(content) > LARGEST:
        raise AncillaryError(
            "is larger than any profile", file=name, remedy="cut out the time of the campaign"
        )
    return content


# Text


def _wyoming(text: str) -> Record:
    """Return a sounding of the University of Wyoming, of text or a page, from its title on."""
    body = re.sub("<[^>]*>", "\n", text)
    title = re.match(r"Observations at (\d\d)Z (\d\d) (\w{3}) (\d{4})", body)
    if title is None:
        raise AncillaryError("states no time")
    hour, day, month, year = title.groups()
    time = datetime(int(year), _MONTHS.index(month) // 3 + 1, int(day), int(hour), tzinfo=UTC)
    latitude, longitude = (
        float(found[1]) if (found := re.search(rf"Station {name}: *(\S+)", body)) else np.nan
        for name in _PLACE
    )
    lines = body.partition("Station information")[0].splitlines()
    top = next((n for n, line in enumerate(lines) if "PRES" in line), len(lines))
    names, units = lines[top].split(), lines[top + 1].split()
    rows = [line for line in lines[top + 3 :] if re.match(r"[ \d.-]{7}", line)]
    cells = [[row[7 * k : 7 * k + 7] for row in rows] for k in range(len(names))]
    columns = {
        title.lower(): (unit, _numbers(column))
        for title, unit, column in zip(names, units, cells, strict=True)
    }
    return Record(columns, time, (latitude, longitude))


def _spc(text: str) -> Record:
    """Return the sounding of a file of the Storm Prediction Center, which states no place."""
    title = re.search(r"%TITLE%\s+\S+\s+(\d{6}/\d{4})", text)
    body = text.partition("%RAW%")[2].partition("%END%")[0]
    rows = [line.split(",") for line in body.splitlines() if line.strip()]
    names, units = ("pres", "hght", "temp", "dwpt"), ("hpa", "m", "c", "c")
    return Record(
        {
            name: (unit, _numbers([row[k] for row in rows if len(row) > k]))
            for k, (name, unit) in enumerate(zip(names, units, strict=True))
        },
        None if title is None else datetime.strptime(f"{title[1]}Z", "%y%m%d/%H%M%z"),
    )


def _igra(text: str) -> Record:
    """Return a sounding of IGRA 2 (`igra2-data-format.txt` of NOAA), from after its ``#`` on."""
    head, *rows = text.splitlines()
    if len(rows) > int(head[31:36]):
        # The header of the next sounding is damaged.
        raise AncillaryError(f"has {len(rows)} levels, but states {int(head[31:36])}")
    year, month, day, hour = (int(word) for word in head[12:25].split())
    time = datetime(year, month, day, hour % 99, tzinfo=UTC)
    hours, minutes = divmod(int(head[25:30]), 100)
    if hours < 24 and minutes < 60:
        begin = time.replace(hour=hours, minute=minutes)
        # The date is that of the hour: a sounding of 00 UTC is released on the day before. Without
        # the hour it is that of the release.
        days = 0 if hour == 99 else round((begin - time) / timedelta(days=1))
        time = begin - timedelta(days=days)
    elif hour == 99:
        raise AncillaryError("states no hour")
    fields = {"pres": (9, 15), "hght": (16, 21), "temp": (22, 27), "dpdp": (34, 39)}
    columns = {
        name: _numbers([row[first:last] for row in rows], _MISSING_OF_IGRA)
        for name, (first, last) in fields.items()
    }
    temperature = 0.1 * columns["temp"]
    return Record(
        {
            "pres": ("pa", columns["pres"]),
            "hght": ("m", columns["hght"]),
            "temp": ("c", temperature),
            "dwpt": ("c", temperature - 0.1 * columns["dpdp"]),
        },
        time,
        (1e-4 * int(head[54:62]), 1e-4 * int(head[62:72])),
    )


def _gdas(text: str) -> Record:
    """Return the profile of a file ``.gdas1``: text of the program ``profile`` of HYSPLIT."""
    time = re.search(r"Profile Time: *(\d+) +(\d+) +(\d+) +(\d+) +(\d+)", text)
    point = re.search(r"Grid Point \( *(\d+), *(\d+)\)", text)
    body = text.partition("3D Fields")[2].splitlines()[1:]
    if time is None or point is None or len(body) < 2:
        raise AncillaryError("states no time, no grid point, or no level")
    year, month, day, hour, minute = map(int, time.groups())
    ends = {name: body[0].index(name) + 4 for name in ("HGTS", "TEMP", "RELH") if name in body[0]}
    rows = [line for line in body[2:] if line.strip()]
    columns = {
        name.lower(): (
            body[1][end - 6 : end].strip(),
            _numbers([row[end - 6 : end] for row in rows]),
        )
        for name, end in ends.items()
    }
    column, row = (int(number) for number in point.groups())
    return Record(
        {"pres": ("hpa", _numbers([line[:6] for line in rows])), **columns},
        datetime(year + (1900 if year > 50 else 2000), month, day, hour, minute, tzinfo=UTC),
        # The grid has 1 degree, from the south pole and Greenwich on. The place that the file names
        # is the one requested of the program, up to half a step away.
        (row - 91.0, (column + 179.0) % 360.0 - 180.0),
        "gdas",
    )


def _csv_records(text: str, name: str, titles: list[str]) -> Iterator[Record | AncillaryError]:
    """Yield the profiles of a table with titles, such as ``pressure [hPa]`` or ``pressure_hPa``.

    Rows of other times are of another profile.
    """
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    separator = max(",;\t", key=(lines or [""])[0].count)
    rows = [[cell.strip() for cell in line.split(separator)] for line in lines]
    heads = titles or (rows.pop(0) if rows else [])
    wrong = [
        AncillaryError(
            f"has {len(row)} values for {len(heads)} columns",
            file=name,
            field=f"row {number}",
            remedy="give one value for each column, with a decimal point",
        )
        for number, row in enumerate(rows, start=1 if titles else 2)
        if len(row) != len(heads)
    ]
    rows = [row for row in rows if len(row) == len(heads)]
    if wrong and not rows:
        raise wrong[0]
    columns: dict[str, tuple[str, list[str]]] = {}
    for place, head in enumerate(heads):
        # The last part of a title is a unit where the rest is a known name.
        title = re.fullmatch(r"(.*?) *(?:[\[(](.*)[\])]|_([^_\[(]+))? *", head.lower())
        known = {one for each in _QUANTITIES.values() for one in each.names}
        parts = (title[1], title[2] or title[3] or "") if title else (head, "")
        label, unit = parts if parts[0] in known else (head.lower().strip(), "")
        columns[label] = unit, [row[place] for row in rows]
    _, cells_of_time = columns.pop("time", ("", []))
    for label, (_, cells) in columns.items():
        if comma := next((cell for cell in cells if re.fullmatch(r"-?\d+,\d+", cell)), ""):
            raise AncillaryError(
                f"has a decimal comma: {comma}",
                file=name,
                field=label,
                remedy=f"write {comma.replace(',', '.')}",
            )
    found = {label: (unit, _numbers(cells)) for label, (unit, cells) in columns.items()}
    times = [_moment(cell, name) for cell in cells_of_time]
    seconds = np.array([time.timestamp() for time in times]) if times else np.zeros(len(rows))
    order = np.argsort(seconds, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(seconds[order]) >= _PAUSE) + 1):
        table = {label: (unit, values[np.sort(part)]) for label, (unit, values) in found.items()}
        yield Record(table, times[part[0]] if times else None, _place(table))
    yield from wrong


def _moment(text: str, name: str) -> datetime:
    try:
        time = datetime.fromisoformat(text)
    except ValueError as error:
        raise AncillaryError(
            f"is {text!r}", file=name, field="time", remedy="write 2024-09-21T12:00:00, in UTC"
        ) from error
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)


def _numbers(cells: list[str], missing: float = _MISSING) -> Array:
    """Return numbers, NaN for cells without one and for marks of missing values."""
    values = np.full(len(cells), np.nan)
    for place, cell in enumerate(cells):
        try:
            values[place] = float(cell)
        except ValueError:
            continue
    return np.where(values <= missing, np.nan, values)


_TEXT_FORMATS: Final[tuple[tuple[str, str, Callable[[str], Record]], ...]] = (
    ("Observations at ", "(?=Observations at )", _wyoming),
    ("%TITLE%", r"\A", _spc),
    (r"\A#[A-Z]{3}\w{8} .*\n\d\d ", "^#", _igra),
    (r"\A\s*Profile Time:", r"\A", _gdas),
)
"""What the first lines of a format hold, where its soundings begin, and the reader of one; other
text is a table."""


# NetCDF


def _cloudnet(table: Table, name: str, place: tuple[float, float]) -> Iterator[Record]:  # noqa: ARG001
    """Yield the profiles of a model over a site of Cloudnet; heights are above its ground."""
    if "sfc_geopotential" in table:
        ground = np.atleast_1d(table["sfc_geopotential"][1]) / _GRAVITY
    elif "sfc_height_amsl" in table:
        ground = np.atleast_1d(table["sfc_height_amsl"][1])
    else:
        raise AncillaryError(
            "is missing, so that the ground from which height counts is unknown",
            file=name,
            field="sfc_geopotential",
            remedy="give the file with sfc_geopotential or sfc_height_amsl",
        )
    origins = [origin for origin in ORIGINS if origin in PurePosixPath(name).name.lower()]
    held = [key for key in ("pressure", "temperature", "q", "rh") if key in table]
    for row, time in enumerate(_times(table, name, "time")):
        heights = table["height"][1][row] + ground[row % ground.size]
        columns = {key: (table[key][0], table[key][1][row]) for key in held}
        latitude, longitude = (
            float(np.atleast_1d(table[key][1])[row % table[key][1].size]) for key in _PLACE
        )
        yield Record(
            {**columns, "geopotential_height": ("m", heights)},
            time,
            (latitude, longitude),
            origins[0] if origins else "ecmwf",
        )


def _arm(table: Table, name: str, place: tuple[float, float]) -> Iterator[Record]:  # noqa: ARG001
    """Yield the sounding of a file of ARM (``sondewnpn``)."""
    keys = [key for key in ("pres", "tdry", "dp", "alt") if key in table]
    columns = {key: (table[key][0], np.where(table[key][1] <= _MISSING, np.nan, table[key][1]))
               for key in keys}  # fmt: skip
    yield Record(columns, next(_times(table, name, "time"), None), _place(table))


def _pressure_levels(table: Table, name: str, place: tuple[float, float]) -> Iterator[Record]:
    """Yield the profiles of ERA5 at the point of the grid that is nearest to a place."""
    latitude, longitude = (np.atleast_1d(table[key][1]) for key in _PLACE)
    levels = "level" if "level" in table else "pressure_level"
    row = int(np.argmin(np.abs(latitude - place[0])))
    column = int(np.argmin(np.abs((longitude - place[1] + 180.0) % 360.0 - 180.0)))
    times = list(_times(table, name, "time" if "time" in table else "valid_time"))
    shape = len(times), table[levels][1].size, latitude.size, longitude.size
    for number, time in enumerate(times):
        columns = {levels: table[levels]}
        for key in ("t", "z", "q", "r"):
            if key in table:
                unit, values = table[key]
                if values.shape != shape:
                    raise AncillaryError(
                        f"has the shape {values.shape}, not time, level, latitude, longitude:"
                        f" {shape}",
                        file=name,
                        field=key,
                        remedy="give the pressure levels of one product type",
                    )
                columns[key] = unit, values[number, :, row, column]
        east = (longitude[column] + 180.0) % 360.0 - 180.0
        yield Record(columns, time, (float(latitude[row]), float(east)), "ecmwf")


def _columns_of_netcdf(table: Table, name: str, place: tuple[float, float]) -> Iterator[Record]:  # noqa: ARG001
    """Yield the profile of any other file, of columns with names of quantities."""
    columns = {key: column for key, column in table.items() if column[1].ndim == 1}
    time = next(_times(table, name, "time"), None) if "time" in table else None
    yield Record(columns, time, _place(table))


_NETCDF_FORMATS: Final[
    tuple[tuple[set[str], Callable[[Table, str, tuple[float, float]], Iterator[Record]]], ...]
] = (
    ({"height", "pressure", "temperature", "time", *_PLACE}, _cloudnet),
    ({"pres", "tdry", "alt", "time", "lat", "lon"}, _arm),
    ({"t", "z", *_PLACE}, _pressure_levels),
    (set(), _columns_of_netcdf),
)
"""Variables of a format, and its reader."""


def _times(table: Table, name: str, key: str) -> Iterator[datetime]:
    """Yield the times of a variable of seconds, minutes, hours or days since a time."""
    unit, values = table[key]
    words = re.fullmatch(
        r"(second|minute|hour|day)s? since (\d+)-(\d+)-(\d+)(?:[ T]([\d:]+)(?:\.\d*)?)?"
        r" *(?:Z|UTC|([+-]?)(\d\d?)(?::?(\d\d))?)?",
        unit.strip(),
    )
    if words is None:
        raise AncillaryError(
            f"has the unit {unit!r}", file=name, field=key, remedy="give hours since a time in UTC"
        )
    clock = [int(part) for part in (words[5] or "0").split(":")]
    zone = timedelta(hours=int(words[7] or 0), minutes=int(words[8] or 0))
    since = datetime(int(words[2]), int(words[3]), int(words[4]), tzinfo=UTC)
    units = ("hours", "minutes", "seconds")
    begin = since + timedelta(**dict(zip(units, clock, strict=False)))
    begin += zone if words[6] == "-" else -zone
    for value in np.atleast_1d(values):
        yield begin + timedelta(seconds=round(float(value) * _SECONDS[words[1]]))


def _netcdf(path: Path, name: str, unpacked: bytes) -> Table:
    """Return the variables of a file, or of its content where it was packed."""
    if not unpacked:
        return netcdf_table(path, name)
    with tempfile.NamedTemporaryFile(suffix=".nc") as stream:
        stream.write(unpacked)
        stream.flush()
        return netcdf_table(Path(stream.name), name)


# What all formats share


def _place(table: Table) -> tuple[float, float]:
    """Return the first latitude and longitude of a table; NaN where it has none."""
    first = [
        next((float(x) for key in keys if key in table for x in table[key][1].flat), np.nan)
        for keys in _PLACE.values()
    ]
    return first[0], first[1]


def _time_and_place(
    record: Record, name: str, reading: AtmosphereReading
) -> tuple[datetime, tuple[float, float]]:
    """Return time and place of a profile, which the campaign gives where the file does not."""
    time, place = record.time, record.place
    if time is None and reading.name_time:
        try:
            stated = datetime.strptime(PurePosixPath(name).name, reading.name_time)  # noqa: DTZ007
        except ValueError as error:
            raise AncillaryError(
                f"does not stand in the name as {reading.name_time}",
                file=name,
                field="time",
                remedy="correct name_time of its source",
            ) from error
        time = stated.replace(tzinfo=UTC)
    if time is None:
        raise AncillaryError(
            "is not stated",
            file=name,
            field="time",
            remedy="give name_time of its source, such as sonde_%Y%m%d%H.csv",
        )
    # Some archives write -99.99 for what they do not know.
    if not (abs(place[0]) <= 90.0 and abs(place[1]) <= 360.0):
        if reading.latitude is None or reading.longitude is None:
            raise AncillaryError(
                "is not stated",
                file=name,
                field="place",
                remedy="give latitude and longitude of its source",
            )
        place = reading.latitude, reading.longitude
    return time, place


def _sounding(record: Record, name: str, reading: AtmosphereReading) -> TimedProfile:
    """Return a profile in SI, of the levels that are complete, by rising altitude."""
    found = {
        quantity: values
        for quantity in _QUANTITIES
        if (values := _in_si(record.columns, quantity, name)) is not None
    }
    heights = [found.pop(key) for key in _HEIGHTS if key in found]
    held = found.keys() | ({"altitude"} if heights else set())
    for key in ("pressure", "temperature", "altitude"):
        if key not in held:
            raise AncillaryError(
                f"is missing; columns are {', '.join(record.columns) or 'none'}",
                file=name,
                field=key,
                remedy="give pressure, temperature and altitude or geopotential height",
            )
    if _begins_again(found["pressure"]):
        raise AncillaryError(
            "begins again: these are several soundings",
            file=name,
            field="pressure",
            remedy="give each its time in a column time, or its own file",
        )
    time, place = _time_and_place(record, name, reading)
    # A humidity without any value hides no other one.
    needed = ("pressure", "temperature")
    share = vapour_share(
        **{key: one for key, one in found.items() if key in needed or np.isfinite(one).any()}
    )
    levels = _levels(heights[0], found["pressure"], found["temperature"], share)
    reach = float(np.ptp(levels[0])) if levels.size else 0.0
    if levels.shape[1] < _FEWEST or reach < _LEAST_REACH:
        raise _TooShortError(
            f"has {levels.shape[1]} complete levels over {reach:.0f} m",
            file=name,
            field="altitude",
            remedy=f"give at least {_FEWEST} levels over {_LEAST_REACH:g} m",
        )
    altitude, pressure, temperature, vapour = levels
    if not record.columns.keys() & {*_QUANTITIES["altitude"].names}:
        altitude = altitude_of(altitude, place[0])
    try:
        profile = MolecularProfile.from_profile(
            altitude,
            pressure,
            temperature,
            pressure_unit="Pa",
            water_vapour=None if np.isnan(share).all() else vapour,
        )
    except RetrievalInputError as error:
        problem, field, remedy = error.problem, error.field, error.remedy
        raise AncillaryError(problem, file=name, field=field, remedy=remedy) from error
    refuse_wide_levels(profile, name)
    dew_point = found.get("dew_point", np.zeros(0))
    most = dew_point[np.isfinite(dew_point)].max(initial=-np.inf)
    if abs(most) < _LEAST_KELVIN:
        raise AncillaryError(
            f"is {most:g} K at most",
            file=name,
            field="dew_point",
            remedy="this looks like Celsius: name the unit, such as dew_point [degC]",
        )
    return TimedProfile(time, *place, record.origin, profile)


def _begins_again(pressure: Array) -> bool:
    """Return whether rows, in their order, go through the air several times the same way.

    A single wrong pressure goes as far back as forth.
    """
    logarithm = np.log(pressure[pressure > 0.0])
    if logarithm.size < _FEWEST:
        return False
    steps = np.diff(logarithm)
    onward = steps * np.sign(np.median(steps))
    half = 0.5 * np.ptp(logarithm)
    return bool(np.sum(onward < -half) > np.sum(onward > half))


def _in_si(columns: Table, quantity: str, name: str) -> Array | None:
    """Return a quantity in SI; None where a file does not hold it."""
    known = _QUANTITIES[quantity]
    for title in known.names:
        if title in columns:
            unit, values = columns[title]
            if quantity == "pressure" and not unit:
                unit = "pa" if np.nanmax(values, initial=0.0) > _MOST_HECTOPASCAL else "hpa"
            if unit.lower() not in known.units:
                raise AncillaryError(
                    f"has the unknown unit {unit!r}",
                    file=name,
                    field=title,
                    remedy=f"use {', '.join(filter(None, known.units))}",
                )
            scale, zero = known.units[unit.lower()]
            return np.asarray(values * scale + zero)
    return None


def _levels(height: Array, pressure: Array, temperature: Array, share: Array) -> Array:
    """Return height, pressure, temperature and humidity of levels that rise, (4, level).

    Levels without height lie where the hydrostatic equation puts them between their neighbours.
    Humidity is 0 above the last level that states it.
    """
    known = (pressure > 0.0) & np.isfinite(pressure) & np.isfinite(temperature)
    # Rounded pressures hold for the mean height of their levels.
    fallen, level = np.unique(-pressure[known], return_inverse=True)
    p = -fallen
    z, t, x = (_means(values[known], level) for values in (height, temperature, share))
    stated = np.isfinite(z)
    if stated.any():
        own = thickness(p, t)
        # The surface states no height; above the last one that is stated there is none.
        offset = np.interp(own, own[stated], (z - own)[stated], right=np.nan)
        z = np.where(stated, z, own + offset)
    rising = np.isfinite(z)
    z, p, t, x = z[rising], p[rising], t[rising], x[rising]
    above = np.maximum.accumulate(np.concatenate([[-np.inf], z]))[:-1] < z
    z, p, t, x = z[above], p[above], t[above], x[above]
    humid = np.isfinite(x)
    if humid.any():
        x = np.interp(z, z[humid], x[humid], right=0.0)
    return np.array([z, p, t, x])


def _means(values: Array, level: npt.NDArray[np.intp]) -> Array:
    """Return the mean over the finite values of each level, NaN where it has none."""
    finite = np.isfinite(values)
    sums = np.bincount(level, np.where(finite, values, 0.0))
    counts = np.bincount(level, finite)
    return np.asarray(np.where(counts > 0, sums, np.nan) / np.maximum(counts, 1))
