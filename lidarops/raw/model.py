"""Data model of raw files of any format in xarray: names of variables, coordinates and attributes.

Every channel is a variable ``<channel>(time, range)`` in mV (analog) or MHz (photon counting), or
in raw counts, with ``<channel>_shots(time)`` and, for analog channels,
``<channel>_input_range(time)`` in V. ``time`` is the middle of the interval in
``time_bnds(time, nv)``; ``range`` is the centre of the bin. Channels on another range grid have
their own dimension, ``range_2`` and so on. ``zenith_angle(time)`` and, if known, ``azimuth(time)``
are coordinates, as are latitude, longitude and altitude. A property that is the same in all files
is an attribute of the channel; one that varies is a variable ``<channel>_<property>(time)``.

Nothing is masked: a value at or above the attribute ``full_scale`` (in the units of the variable,
present if it is the same in all files) is saturated or a glitch, and the processing flags it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from itertools import pairwise
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import RawFormatError
from lidarops.raw.formats import raw_format
from lidarops.raw.header import (
    POLARISATIONS,
    RawChannel,
    RawHeader,
    Stretches,
    channel_names,
    chosen,
)
from lidarops.records import Header

Position = Literal["longitude_first", "latitude_first", "ignore"]

_EPOCH = datetime.fromisoformat("1970-01-01T00:00:00+00:00")
_MICROSECOND = timedelta(microseconds=1)


class _Property(NamedTuple):
    description: str
    units: str
    """Empty for the units of the channel."""
    dtype: type
    may_be_attribute: bool
    """Whether it becomes an attribute if all files agree."""


_PROPERTIES: Mapping[str, _Property] = {
    "shots": _Property("laser shots", "1", np.int32, may_be_attribute=False),
    "input_range": _Property("digitiser input range", "V", np.float64, may_be_attribute=False),
    "scale": _Property("value of one count", "", np.float64, may_be_attribute=False),
    "laser": _Property("laser", "1", np.int32, may_be_attribute=True),
    "high_voltage": _Property("detector voltage", "V", np.float64, may_be_attribute=True),
    "discriminator": _Property("discriminator level", "V", np.float64, may_be_attribute=True),
    "bin_shift": _Property("bin shift", "1", np.float64, may_be_attribute=True),
}


@dataclass(frozen=True, slots=True)
class StatedFile:
    """A raw file, its header, and what is stated of it in place of the header."""

    path: str
    size: int
    mtime_ns: int
    header: RawHeader
    """Of this file, or of one with the same site and channels."""
    stated: Header
    """The header of this file, or a granule, which supplies times, altitude and pointing."""


class RawFiles:
    """Files of one format and layout, by start, then path, and the channels to open.

    Parameters
    ----------
    files : sequence of StatedFile
        The first one gives the layout.
    channels : iterable of str, optional
        Names to open; by default all signal channels.
    position_order : {"longitude_first", "latitude_first", "ignore"}
    stretches : mapping of str to tuple of (int, int), optional
        By channel, the stretches of bins to keep.

    Raises
    ------
    RawFormatError
        If a file is of another format than the first file, lacks a channel, has it on another range
        grid than the first file, or has an impossible position, or if stretches do not ascend.
    """

    def __init__(
        self,
        files: Sequence[StatedFile],
        channels: Iterable[str] | None,
        position_order: Position,
        stretches: Mapping[str, Stretches] | None = None,
    ) -> None:
        if position_order not in get_args(Position):
            raise RawFormatError(
                f"{position_order!r} is unknown",
                field="header_position",
                remedy=f"choose one of {', '.join(get_args(Position))}",
            )
        names = channel_names(channels)
        self.format = files[0].header.format
        """Name of the raw format."""
        self.position_order = position_order
        variants: dict[tuple[RawChannel, ...], int] = {}
        self._variants: list[tuple[RawChannel, ...]] = []
        """Selected channels of the files with the same ones; those of the first file first."""
        variant_of = {}
        for file in files:
            header = file.header
            if header.format != self.format:
                raise RawFormatError(
                    f"is of raw format {header.format}, the files before it of {self.format}",
                    file=header.path,
                    remedy="open files of one format",
                )
            variant = variants.setdefault(header.channels, len(variants))
            if variant == len(self._variants):
                self._variants.append(self._select(header, names))
            variant_of[file.path] = variant
        self.kept = _kept(stretches or {}, self._variants[0])
        """Stretches of the channels of which some bins are left out."""
        if self.kept:
            self._variants = [
                tuple(
                    replace(c, bins=sum(past - first for first, past in self.stretches(c)))
                    for c in selected
                )
                for selected in self._variants
            ]
        self.selected = self._variants[0]
        """Selected channels of the first file."""
        times = {file.path: _interval(file) for file in files}
        self.files = sorted(files, key=lambda file: (times[file.path][0], file.path))
        self.times = np.array([times[file.path] for file in self.files], dtype=np.int64)
        """Start and stop in ns since 1970, shape (files, 2)."""
        self._variant = [variant_of[file.path] for file in self.files]

    def _select(self, header: RawHeader, names: tuple[str, ...] | None) -> tuple[RawChannel, ...]:
        """Return the requested channels of a header, in the order of the first file."""
        stored = {channel.name: channel for channel in header.channels}
        found = chosen(stored, tuple(stored) if names is None else names, header.path)
        if not self._variants:
            return found
        first = self._variants[0]
        differing = {name for name, *_ in _grids_of(found) ^ _grids_of(first)}
        if differing:
            raise RawFormatError(
                "is of another layout (channels, bins, bin width or ADC bits) than the files"
                " before it",
                file=header.path,
                field=", ".join(sorted(differing)),
                remedy="open files of one layout, or choose channels that are equal in all files",
            )
        return tuple(stored[channel.name] for channel in first)

    def channel_values(self, channel: int, name: str) -> NDArray[Any]:
        """Return a property of selected channel number `channel`, one value per file."""
        return np.array([getattr(c[channel], name) for c in self._variants])[self._variant]

    def channel_places(self, channel: int) -> tuple[tuple[int, ...], ...]:
        """Return where each file holds the counts of selected channel number `channel`."""
        return tuple(self._variants[variant][channel].places for variant in self._variant)

    def stretches(self, channel: RawChannel) -> Stretches:
        """Return the kept stretches of bins of a selected channel."""
        return self.kept.get(channel.name, ((0, channel.bins),))


def _grids_of(channels: Iterable[RawChannel]) -> set[tuple[str, int, float, int]]:
    return {(c.name, c.bins, c.bin_width, c.adc_bits) for c in channels}


def _interval(file: StatedFile) -> tuple[int, int]:
    """Return start and stop in ns since 1970."""
    start, stop = file.stated.start, file.stated.stop
    if start is None or stop is None:
        raise RawFormatError("has no start or stop in the catalog", file=file.path, field="start")
    return (
        1000 * ((start - _EPOCH) // _MICROSECOND),
        1000 * ((stop - _EPOCH) // _MICROSECOND),
    )


def _kept(
    stretches: Mapping[str, Stretches], selected: Sequence[RawChannel]
) -> dict[str, Stretches]:
    """Return the stretches within the channels, without those of whole channels."""
    stored = {channel.name: channel.bins for channel in selected}
    kept = {}
    for name, requested in stretches.items():
        edges = [edge for stretch in requested for edge in stretch]
        ascending = all(low < high for low, high in pairwise(edges))
        if not (ascending and edges and 0 <= edges[0] < stored.get(name, 0)):
            raise RawFormatError(
                f"bins {list(requested)} of {name} cannot be kept",
                field="stretches",
                remedy=f"give ascending stretches of bins (first, past) of {', '.join(stored)}",
            )
        clipped = [(first, min(past, stored[name])) for first, past in requested]
        kept[name] = tuple(stretch for stretch in clipped if stretch[0] < stretch[1])
    return {name: held for name, held in kept.items() if held != ((0, stored[name]),)}


Signal = Callable[[int, RawChannel], Any]
"""Number of a channel, the channel in the first file -> array (time, range), lazy or not."""


def build_raw_dataset(files: RawFiles, signal: Signal, *, scaled: bool) -> xr.Dataset:
    """Return the Dataset of the files in `files`.

    Parameters
    ----------
    files : RawFiles
    signal : callable
        Returns the array of a channel.
    scaled : bool
        Whether `signal` returns physical values or counts.
    """
    grids = _grids(files)
    stated = [file.stated for file in files.files]
    notes = {note for header in stated for note in header.notes}
    notes |= {header.doubt for header in stated if isinstance(header, RawHeader)} - {""}
    variables: dict[str, xr.Variable] = {}
    for index, channel in enumerate(files.selected):
        dims = ("time", grids[files.stretches(channel), channel.bin_width])
        extra, attributes = _channel_properties(files, index, scaled=scaled)
        variables[channel.name] = xr.Variable(dims, signal(index, channel), attributes)
        variables.update(extra)
    return xr.Dataset(
        variables,
        {**_time(files), **_ranges(grids), **_place(files)},
        {
            "source_format": raw_format(files.format).title,
            "site": ", ".join(sorted({file.header.site for file in files.files})),
            **({"notes": "; ".join(sorted(notes))} if notes else {}),
        },
    )


def _grids(files: RawFiles) -> dict[tuple[Stretches, float], str]:
    # The most common grid is "range"; the others follow in file order.
    uses = Counter((files.stretches(c), c.bin_width) for c in files.selected)
    ordered = sorted(uses, key=lambda grid: grid != uses.most_common(1)[0][0])
    return {grid: "range" if i == 1 else f"range_{i}" for i, grid in enumerate(ordered, 1)}


def _channel_properties(
    files: RawFiles, index: int, *, scaled: bool
) -> tuple[dict[str, xr.Variable], dict[str, Any]]:
    channel = files.selected[index]
    attributes = {
        **_attributes(channel, scaled=scaled),
        "conversion": raw_format(files.format).conversion,
        "device": channel.device,
        **_full_scale(files, index, scaled=scaled),
    }
    variables = {}
    for name, prop in _PROPERTIES.items():
        values = files.channel_values(index, name)
        # Of type object where a file lacks the property.
        if values.dtype == object or (name == "scale" and scaled):
            continue
        if prop.may_be_attribute and _is_constant(values):
            attributes[name] = values[0].item()
            continue
        variables[f"{channel.name}_{name}"] = xr.Variable(
            ("time",),
            values.astype(prop.dtype),
            {
                "units": prop.units or channel.units,
                "long_name": f"{prop.description} of {channel.name}",
            },
        )
    return variables, attributes


def _full_scale(files: RawFiles, index: int, *, scaled: bool) -> dict[str, float]:
    channel = files.selected[index]
    if channel.input_range is None:
        return {}
    if scaled:
        # In the precision of the signal, so saturated values compare equal.
        nominal = files.channel_values(index, "input_range") * 1e3 * (1 - 0.5**channel.adc_bits)
        values = nominal.astype(np.float32)
    else:
        values = files.channel_values(index, "full_scale")
    return {"full_scale": values[0].item()} if _is_constant(values) else {}


def _is_constant(values: NDArray[Any]) -> bool:
    return bool((values == values[0]).all())


def _attributes(channel: RawChannel, *, scaled: bool) -> dict[str, Any]:
    polarisation = POLARISATIONS.get(channel.polarisation, channel.polarisation)
    mode = str(channel.mode)
    label = int(channel.wavelength_label.partition(".")[0])
    wavelength = {} if math.isnan(channel.wavelength) else {"wavelength": channel.wavelength}
    return {
        "units": channel.units if scaled else "count",
        "long_name": f"{mode} signal at {label} nm, {polarisation} polarisation",
        "detection_mode": mode,
        "wavelength_label": channel.wavelength_label,
        **wavelength,
        "polarisation": polarisation,
        "bin_width": channel.bin_width,
        "adc_bits": channel.adc_bits,
    }


def _time(files: RawFiles) -> dict[str, xr.Variable]:
    bounds = files.times
    middle = bounds[:, 0] + (bounds[:, 1] - bounds[:, 0]) // 2
    return {
        "time": xr.Variable(
            ("time",),
            middle.astype("datetime64[ns]"),
            {
                "standard_name": "time",
                "long_name": "middle of the measurement interval, UTC",
                "bounds": "time_bnds",
            },
        ),
        "time_bnds": xr.Variable(("time", "nv"), bounds.astype("datetime64[ns]")),
    }


def _ranges(grids: Mapping[tuple[Stretches, float], str]) -> dict[str, xr.Variable]:
    return {
        name: xr.Variable(
            (name,),
            (np.concatenate([np.arange(*stretch) for stretch in stretches]) + 0.5) * width,
            {"units": "m", "long_name": "distance of the bin centre from the lidar"},
        )
        for (stretches, width), name in grids.items()
    }


def _place(files: RawFiles) -> dict[str, xr.Variable]:
    stated = [file.stated for file in files.files]
    pointings = [(header.altitude, header.zenith_angle, header.azimuth) for header in stated]
    # None becomes NaN.
    altitude, zenith, azimuth = np.array(pointings, dtype=np.float64).T
    place = {
        "zenith_angle": xr.Variable(
            ("time",),
            zenith,
            {"units": "degree", "long_name": "zenith angle of the beam, 0 = up"},
        ),
        "altitude": _constant(
            altitude,
            {"units": "m", "standard_name": "altitude", "long_name": "altitude of the lidar"},
        ),
    }
    if np.isfinite(azimuth).any():
        place["azimuth"] = xr.Variable(
            ("time",),
            azimuth,
            {"units": "degree", "long_name": "azimuth of the beam, clockwise from north"},
        )
    if files.position_order != "ignore":
        order = files.position_order
        positions = [file.header.position(order) or (math.nan, math.nan) for file in files.files]
        latitude, longitude = np.array(positions).T
        place["latitude"] = _constant(
            latitude, {"units": "degrees_north", "standard_name": "latitude"}
        )
        place["longitude"] = _constant(
            longitude, {"units": "degrees_east", "standard_name": "longitude"}
        )
    return place


def _constant(values: NDArray[np.float64], attributes: dict[str, str]) -> xr.Variable:
    # A moving lidar has a position at every time.
    if _is_constant(values):
        return xr.Variable((), values[0], attributes)
    return xr.Variable(("time",), values, attributes)
