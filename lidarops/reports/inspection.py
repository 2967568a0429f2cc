"""The content of a raw file or a product, as plain data and as tables for the terminal.

This is what `lidarops inspect` shows.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr

from lidarops.catalog.folder import FileGroup, read_folder
from lidarops.errors import LidarOpsError, RawFormatError
from lidarops.netcdf.read import decoded, is_netcdf, read_provenance
from lidarops.netcdf.stored import open_stored, reading
from lidarops.netcdf.stored_flags import (
    FlagCounter,
    bits_of,
    blocks,
    flags_names,
    quality_bits,
    rejecting_mask,
)
from lidarops.netcdf.variables import TIME_UNITS
from lidarops.raw.formats import RawFile, raw_formats, read_raw_header
from lidarops.records import UNKNOWN_FORMAT, Role
from lidarops.reports import product_contents

Table = tuple[str, Sequence[str], Sequence[Sequence[Any]]]
"""Title, names of columns, and rows."""
_LONG: Final = {"comment", "history", "references"}
"""Attributes too long for a table; the JSON output has them."""
_CHANNEL: Final = ("name", "wavelength", "bins", "bin_width", "shots", "adc_bits", "device")
"""Channel properties in the table; the JSON output has all."""
_GROUP: Final = ("files", "count", "role", "start", "stop", "site", "zenith_angle", "channels")
"""Properties of a group of raw files in the table."""
_VARIABLE: Final = ("name", "dimensions", "units", "minimum", "maximum", "missing", "long_name")
_STEP: Final = ("step", "channel", "settings", "reason")
_FLAG: Final = ("flags", "name", "severity", "values", "share", "description")
_UNITS: Final = {
    **dict.fromkeys(("altitude", "bin_width", "wavelength"), "m"),
    **dict.fromkeys(("zenith_as_written", "zenith_angle", "azimuth"), "degree"),
    **dict.fromkeys(("latitude", "longitude"), "degree"),
    **dict.fromkeys(("size", "data_start"), "bytes"),
    "temperature": "K",
    "pressure": "Pa",
}
"""Units of what raw headers hold."""
_HEADER: Final = "source"
"""Key of the header as written."""
_READ_VALUES: Final = 4_000_000
"""Values in memory at a time."""
_OTHERS: Final = 20
"""Most files of no raw format in the table; the JSON output has all."""
_VERDICTS: Final = ("good", "use_with_care", "do_not_use")


def describe(file: Path, time: str = "") -> dict[str, Any]:
    """Describe a raw file or a NetCDF product, or the raw files of a folder, grouped.

    Parameters
    ----------
    file : Path
    time : str, optional
        UTC, such as ``2024-09-21T15:00``: only the profile of a product that holds this time.

    Returns
    -------
    dict
        Plain JSON types. Key ``type`` is ``raw``, ``netcdf`` or ``folder``; unknown values are
        None.

    Raises
    ------
    LidarOpsError
        If the file cannot be read, or is neither, or is no product that holds the time.
    """
    if not file.is_dir() and is_netcdf(file):
        return _product(file, time)
    if time:
        raise LidarOpsError("is of products alone", field="time", file=file, wrong_use=True)
    return _folder(file) if file.is_dir() else _raw(file)


def tables(file: Path, time: str = "") -> Iterator[Table]:
    """Yield the description of a file as tables: title, names of columns, rows; see `describe`.

    Of a product, quality and values come first.
    """
    description = describe(file, time)
    about = [
        (key.replace("_", " "), _with_unit(key, value))
        for key, value in description.items()
        if key != _HEADER and (isinstance(value, str | int | float) or value is None)
    ]
    if description["type"] == "raw":
        about += [("notes", note) for note in description["notes"] or ["none"]]
    elif description["type"] == "netcdf":
        about += [item for item in description["attributes"].items() if item[0] not in _LONG]
        yield _table("Quality", description["quality"], _FLAG)
        yield _table("Variables", description["variables"], _VARIABLE)
        yield _table("Steps", description["steps"], _STEP)
    yield file.name, ("field", "value"), about
    if description["type"] == "folder":
        others = [{"file": path} for path in description["other"][:_OTHERS]]
        yield _table("Groups of like files", description["groups"], _GROUP)
        yield _table("Damaged files", description["refused"], ("file", "reason"))
        yield _table("Files of unknown format", others, ("file",))
    elif description["type"] == "raw":
        yield _table("Channels", description["channels"], _CHANNEL)
        lines = description.get(_HEADER, "").splitlines()
        yield "Header as written", ("line",), [(line,) for line in lines]


def _with_unit(key: str, value: object) -> str:
    if value is None:
        return "not known"
    if value == "":
        return "none"
    return f"{value} {_UNITS[key]}" if key in _UNITS else str(value)


def provenance(file: Path) -> str:
    """Return the provenance of a product as PROV-JSON text.

    Raises
    ------
    ProductError
        If the file is not a product of lidarops.
    """
    return json.dumps(read_provenance(file), indent=2)


def _raw(file: Path) -> dict[str, Any]:
    try:
        with RawFile(file) as opened:
            header = read_raw_header(opened)
    except RawFormatError as error:
        if UNKNOWN_FORMAT in error.problem:
            # That of an archive speaks of the patterns of a campaign.
            formats = ", ".join(raw_formats())
            error.remedy = f"lidarops inspect reads NetCDF products and raw files of {formats}"
        raise
    return {"type": "raw", "file": str(file), **_plain(header)}


def _folder(folder: Path) -> dict[str, Any]:
    contents = read_folder(str(folder))
    return {
        "type": "folder",
        "file": str(folder),
        "raw_files": sum(len(group.files) for group in contents.groups),
        "damaged_files": len(contents.refused),
        "other_files": len(contents.other),
        "groups": [_grouped(group) for group in contents.groups],
        "refused": [{"file": path, "reason": reason} for path, reason in contents.refused],
        "other": list(contents.other),
    }


def _grouped(group: FileGroup) -> dict[str, Any]:
    angles = group.zenith_angles
    return {
        "files": group.pattern,
        "count": len(group.files),
        "role": (Role.DARK if group.dark else Role.SIGNAL).value,
        "start": f"{group.start:%Y-%m-%d %H:%M:%S}",
        "stop": f"{group.stop:%Y-%m-%d %H:%M:%S}",
        "site": group.site,
        "zenith_angle": " to ".join(
            f"{end:g}" for end in dict.fromkeys((*angles[:1], *angles[-1:]))
        )
        or None,
        "files_without_zenith_angle": group.without_zenith,
        "channels": ", ".join(channel.name for channel in group.layout),
    }


def _product(file: Path, time: str) -> dict[str, Any]:
    with reading(file), open_stored(file) as stored:
        for one in stored.variables.values():
            one.dims = one.written
        opened = decoded(stored, stored.variables, decode_times=False)
        dataset = _profile(opened, time, file) if time else opened
        errors = [str(name) for name in opened.variables if str(name).endswith("_error")]
        main = {end for name in errors for end in (name, name.removesuffix("_standard_error"))}
        names = sorted(map(str, opened.variables), key=lambda name: name not in main)
        steps = product_contents.origin(dataset).get("steps", [])
        return {
            "type": "netcdf",
            "file": str(file),
            "size": file.stat().st_size,
            "citation": product_contents.citation(dataset),
            "dimensions": {str(name): size for name, size in dataset.sizes.items()},
            "attributes": _plain(dict(dataset.attrs)),
            "variables": [_variable(name, dataset[name]) for name in names],
            "quality": _quality(dataset),
            "steps": [dict(zip(_STEP, step, strict=True)) for step in steps],
        }


def _profile(dataset: xr.Dataset, time: str, file: Path) -> xr.Dataset:
    """Return the profile of a product that holds a time."""
    try:
        moment = product_contents.utc_moment(time).astype("datetime64[s]").astype(np.float64)
    except ValueError:
        form = "give a UTC time such as 2024-09-21T15:00"
        error = LidarOpsError(f"is no time: {time!r}", field="time", remedy=form, wrong_use=True)
        raise error from None
    bounds = dataset.get("time_bnds")
    begun = np.zeros(0) if bounds is None else (bounds <= moment).sum("nv").to_numpy()
    inside = np.flatnonzero(begun == 1)
    if not inside.size:
        raise LidarOpsError(f"has no profile at {time}", field="time", file=file, wrong_use=True)
    return dataset.isel(time=inside[:1])


def _variable(name: str, variable: xr.DataArray) -> dict[str, Any]:
    properties = {
        "name": name,
        "dimensions": ", ".join(f"{dim} {size}" for dim, size in variable.sizes.items()),
        **{key: variable.attrs.get(key) for key in ("units", "standard_name", "long_name")},
        "type": str(variable.dtype),
        **dict.fromkeys(("minimum", "maximum", "missing")),
    }
    if variable.dtype.kind not in "fiu" or variable.size == 0:
        return properties
    missing, ends = 0, []
    for values in (block.to_numpy() for block in blocks(variable, _READ_VALUES)):
        finite = values[np.isfinite(values)]
        missing += values.size - finite.size
        ends += [float(finite.min()), float(finite.max())] if finite.size else []
    properties["missing"] = missing
    if ends:
        least: float | str = min(ends)
        most: float | str = max(ends)
        if properties["units"] == TIME_UNITS:
            least, most = (str(np.datetime64(round(end(ends)), "s")) for end in (min, max))
        properties |= {"minimum": least, "maximum": most}
    return properties


def _quality(dataset: xr.Dataset) -> list[dict[str, Any]]:
    """Count values by verdict and by quality bit; empty for files without quality flags."""
    return [row for name in flags_names(dataset) for row in _counted_flags(dataset, name)]


def _counted_flags(dataset: xr.Dataset, name: str) -> list[dict[str, Any]]:
    flags, bits = dataset[name], bits_of(dataset, name)
    if not flags.size:
        return []
    counts = FlagCounter(rejecting_mask(bits))
    for block in blocks(flags, _READ_VALUES):
        counts.add(quality_bits(block))
    rows = [(word, "verdict", n, "") for word, n in zip(_VERDICTS, counts.verdicts, strict=True)]
    for bit in (bit for bit in bits if bit.mask in counts.carried):
        severity = "unknown" if bit.severity is None else bit.severity.name.lower()
        rows.append((bit.word, severity, counts.carried[bit.mask], bit.description))
    return [
        {
            "flags": name,
            "name": word,
            "severity": severity,
            "values": count,
            "share": round(count / flags.size, 4),
            "description": description,
        }
        for word, severity, count, description in rows
    ]


def _plain(value: Any) -> Any:
    """Convert to plain JSON types; numbers that are not finite become None."""
    if is_dataclass(value):
        return {item.name: _plain(getattr(value, item.name)) for item in fields(value)}
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    return _plain_scalar(value)


def _plain_scalar(value: Any) -> Any:
    if isinstance(value, Enum):
        return value.name.lower()
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, bytes):
        return value.decode("latin-1")
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return str(value)


def _table(title: str, items: list[dict[str, Any]], columns: tuple[str, ...]) -> Table:
    rows = [[_cell(item.get(column)) for column in columns] for item in items]
    return title, [_title(column) for column in columns], rows


def _title(column: str) -> str:
    unit = f" ({_UNITS[column]})" if column in _UNITS else ""
    return f"{column.replace('_', ' ')}{unit}"


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)
