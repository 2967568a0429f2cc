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
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from itertools import pairwise
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import RawFormatError
from lidarops.raw.formats import raw_format
from lidarops.raw.header import RawChannel, RawHeader, Stretches, check_layout, select_channels
from lidarops.raw.recorders import POLARISATIONS
from lidarops.records import Granule, Header

Position = Literal["longitude_first", "latitude_first", "ignore"]

POSITIONS: Final = ("longitude_first", "latitude_first", "ignore")

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


@dataclass(slots=True)
class Columns:
    """Header values of many files of one format and layout, one column per property."""

    channels: tuple[str, ...] | None
    """Names to open; None for all."""
    position_order: Position
    format: str = ""
    """Name of the raw format; empty without files."""
    paths: list[str] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    times: list[tuple[int, int]] = field(default_factory=list)
    """Start and stop in ns since 1970."""
    places: list[tuple[float, ...]] = field(default_factory=list)
    """Latitude, longitude, altitude, zenith angle, azimuth; NaN if unknown."""
    sites: set[str] = field(default_factory=set)
    notes: set[str] = field(default_factory=set)
    variants: dict[tuple[RawChannel, ...], tuple[int, tuple[RawChannel, ...]]] = field(
        default_factory=dict
    )
    """All channels of a header -> number of the variant, selected channels."""
    variant: list[int] = field(default_factory=list)
    kept: dict[str, Stretches] = field(default_factory=dict)
    """Stretches of the channels of which some bins are left out."""

    def __post_init__(self) -> None:
        if self.position_order not in POSITIONS:
            raise RawFormatError(
                f"{self.position_order!r} is unknown",
                field="header_position",
                remedy=f"choose one of {', '.join(POSITIONS)}",
            )

    def append(self, header: RawHeader, granule: Granule | None = None) -> None:
        """Add a file.

        Parameters
        ----------
        header : RawHeader
        granule : Granule, optional
            Supplies times, altitude and pointing in place of the header.

        Raises
        ------
        RawFormatError
            If the file is of another format than the first file, lacks a channel, has it on
            another range grid than the first file, or has an impossible position.
        """
        if header.format != self.format:
            self._start_format(header)
        if header.channels not in self.variants:
            selected = select_channels(header, self.channels)
            check_layout(header.path, selected, self.selected if self.variants else selected)
            ordered = sorted(selected, key=lambda channel: self._rank(channel.name))
            self.variants[header.channels] = (len(self.variants), tuple(ordered))
        variant = self.variants[header.channels][0]
        position = None
        if self.position_order != "ignore":
            position = header.position(self.position_order)
        self.sites.add(header.site)
        if granule is not None:
            self.append_alike(granule, header.path, variant)
            return
        self.notes.update((header.doubt,) if header.doubt else ())
        self._add(header, header.path, header.size, variant, position)

    def _start_format(self, header: RawHeader) -> None:
        if self.format:
            raise RawFormatError(
                f"is of raw format {header.format}, the files before it of {self.format}",
                file=header.path,
                remedy="open files of one format",
            )
        self.format = header.format

    def append_alike(self, granule: Granule, path: str, variant: int) -> None:
        """Add a file whose header has the site and channels of another file.

        Parameters
        ----------
        granule : Granule
            The other values of the header; its position is ignored.
        path : str
            Path of the file.
        variant : int
            Number of the variant of the other file.
        """
        self._add(granule, path, granule.size, variant)

    def _add(
        self,
        header: Header,
        path: str,
        size: int,
        variant: int,
        position: tuple[float, float] | None = None,
    ) -> None:
        if header.start is None or header.stop is None:
            raise RawFormatError("has no start or stop in the catalog", file=path, field="start")
        self.paths.append(path)
        self.sizes.append(size)
        start, stop = (
            1000 * ((moment - _EPOCH) // _MICROSECOND) for moment in (header.start, header.stop)
        )
        self.times.append((start, stop))
        stated = (header.altitude, header.zenith_angle, header.azimuth)
        self.places.append(
            (
                *(position or (math.nan, math.nan)),
                *(math.nan if value is None else value for value in stated),
            )
        )
        self.notes.update(header.notes)
        self.variant.append(variant)

    @property
    def selected(self) -> tuple[RawChannel, ...]:
        """Selected channels of the first file."""
        return next(iter(self.variants.values()))[1]

    def channel_values(self, channel: int, name: str) -> NDArray[Any]:
        """Return a property of selected channel number `channel`, one value per file."""
        by_variant = [getattr(selected[channel], name) for _, selected in self.variants.values()]
        return np.array(by_variant)[self.variant]

    def channel_places(self, channel: int) -> tuple[tuple[int, ...], ...]:
        """Return where each file holds the counts of selected channel number `channel`."""
        by_variant = [selected[channel].places for _, selected in self.variants.values()]
        return tuple(by_variant[variant] for variant in self.variant)

    def sort(self) -> None:
        """Order the files by start, then path."""
        order = sorted(range(len(self.paths)), key=lambda i: (self.times[i][0], self.paths[i]))
        for name in ("paths", "sizes", "times", "places", "variant"):
            values = getattr(self, name)
            setattr(self, name, [values[index] for index in order])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the selected channels."""
        return tuple(channel.name for channel in self.selected)

    def keep(self, stretches: Mapping[str, Stretches]) -> None:
        """Keep only some bins of these channels.

        Raises
        ------
        RawFormatError
            If a channel is not opened, or its stretches do not ascend.
        """
        stored = {channel.name: channel.bins for channel in self.selected}
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
            self.kept[name] = tuple(stretch for stretch in clipped if stretch[0] < stretch[1])
            if self.kept[name] == ((0, stored[name]),):
                del self.kept[name]
        self.variants = {
            channels: (
                number,
                tuple(replace(c, bins=count_bins(self.stretches(c))) for c in selected),
            )
            for channels, (number, selected) in self.variants.items()
        }

    def stretches(self, channel: RawChannel) -> Stretches:
        """Return the kept stretches of bins of a selected channel."""
        return self.kept.get(channel.name, ((0, channel.bins),))

    def _rank(self, name: str) -> int:
        if not self.variants:
            return 0
        return next(i for i, channel in enumerate(self.selected) if channel.name == name)


def count_bins(stretches: Stretches) -> int:
    """Return the number of bins in stretches."""
    return sum(past - first for first, past in stretches)


Signal = Callable[[int, RawChannel], Any]
"""Number of a channel, the channel in the first file -> array (time, range), lazy or not."""


def build_raw_dataset(columns: Columns, signal: Signal, *, scaled: bool) -> xr.Dataset:
    """Return the Dataset of the files in `columns`.

    Parameters
    ----------
    columns : Columns
    signal : callable
        Returns the array of a channel.
    scaled : bool
        Whether `signal` returns physical values or counts.
    """
    grids = _grids(columns)
    variables: dict[str, xr.Variable] = {}
    for index, channel in enumerate(columns.selected):
        dims = ("time", grids[columns.stretches(channel), channel.bin_width])
        extra, attributes = _channel_properties(columns, index, scaled=scaled)
        variables[channel.name] = xr.Variable(dims, signal(index, channel), attributes)
        variables.update(extra)
    return xr.Dataset(
        variables,
        {**_time(columns), **_ranges(grids), **_place(columns)},
        {
            "source_format": raw_format(columns.format).title,
            "site": ", ".join(sorted(columns.sites)),
            **({"notes": "; ".join(sorted(columns.notes))} if columns.notes else {}),
        },
    )


def _grids(columns: Columns) -> dict[tuple[Stretches, float], str]:
    # The most common grid is "range"; the others follow in file order.
    uses = Counter((columns.stretches(c), c.bin_width) for c in columns.selected)
    ordered = sorted(uses, key=lambda grid: grid != uses.most_common(1)[0][0])
    return {grid: "range" if i == 1 else f"range_{i}" for i, grid in enumerate(ordered, 1)}


def _channel_properties(
    columns: Columns, index: int, *, scaled: bool
) -> tuple[dict[str, xr.Variable], dict[str, Any]]:
    channel = columns.selected[index]
    attributes = {
        **_attributes(channel, scaled=scaled),
        "conversion": raw_format(columns.format).conversion,
        "device": channel.device,
        **_full_scale(columns, index, scaled=scaled),
    }
    variables = {}
    for name, prop in _PROPERTIES.items():
        values = columns.channel_values(index, name)
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


def _full_scale(columns: Columns, index: int, *, scaled: bool) -> dict[str, float]:
    channel = columns.selected[index]
    if channel.input_range is None:
        return {}
    if scaled:
        # In the precision of the signal, so saturated values compare equal.
        nominal = columns.channel_values(index, "input_range") * 1e3 * (1 - 0.5**channel.adc_bits)
        values = nominal.astype(np.float32)
    else:
        values = columns.channel_values(index, "full_scale")
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


def _time(columns: Columns) -> dict[str, xr.Variable]:
    bounds = np.array(columns.times, dtype=np.int64)
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


def _place(columns: Columns) -> dict[str, xr.Variable]:
    latitude, longitude, altitude, zenith, azimuth = np.array(columns.places).T
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
    if columns.position_order != "ignore":
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
