"""Many raw files of one format and layout as one lazy Dataset.

Every channel is a variable ``<channel>(time, range)`` in mV (analog) or MHz (photon counting), or
in raw counts, with ``<channel>_shots(time)`` and, for analog channels,
``<channel>_input_range(time)`` in V. ``time`` is the middle of the interval in
``time_bnds(time, nv)``; ``range`` is the centre of the bin. Channels on another range grid have
their own dimension, ``range_2`` and so on. ``zenith_angle(time)`` and, if known, ``azimuth(time)``
are coordinates, as are latitude, longitude and altitude. A property that is the same in all files
is an attribute of the channel; one that varies is a variable ``<channel>_<property>(time)``.

Nothing is masked: a value at or above the attribute ``full_scale`` (in the units of the variable,
present if it is the same in all files) is saturated or a glitch, and the processing flags it.

Headers are read when the archive is opened; of files whose headers the catalog knows to be equal,
one header is read. Counts are read as a channel is indexed: those of one channel in the files of
the selected profiles. `open_archive` gives dask arrays of them, and processing takes them as they
are.
"""

from __future__ import annotations

import glob
import math
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import lru_cache
from itertools import pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from lidarops.errors import RawFormatError
from lidarops.raw.formats import RawFile, raw_formats, read_raw_header
from lidarops.raw.header import (
    POLARISATIONS,
    Layout,
    RawChannel,
    RawHeader,
    Stretches,
    chosen,
    named_layout,
    recorder_names,
)
from lidarops.records import SIGNAL_UNITS, Granule, Header

Source = str | os.PathLike[str] | Iterable[str | os.PathLike[str] | Granule]
Position = Literal["longitude_first", "latitude_first", "ignore"]
Grid = tuple[Stretches, float]
"""Stretches of bins, and their width in m."""
_Variable = tuple[str | tuple[str, ...], Any, Mapping[str, Any]]
"""Dimensions, values and attributes."""

_CHUNK_BYTES = 16_000_000
_EPOCH = datetime.fromisoformat("1970-01-01T00:00:00+00:00")
_MICROSECOND = timedelta(microseconds=1)


class _Property(NamedTuple):
    description: str
    units: str
    """Empty for the units of the channel."""
    dtype: type
    may_be_attribute: bool = True
    """Whether it becomes an attribute if all files agree."""


_PROPERTIES: Mapping[str, _Property] = {
    "shots": _Property("laser shots", "1", np.int32, may_be_attribute=False),
    "input_range": _Property("digitiser input range", "V", np.float64, may_be_attribute=False),
    "scale": _Property("value of one count", "", np.float64, may_be_attribute=False),
    "laser": _Property("laser", "1", np.int32),
    "high_voltage": _Property("detector voltage", "V", np.float64),
    "discriminator": _Property("discriminator level", "V", np.float64),
    "bin_shift": _Property("bin shift", "1", np.float64),
}


def open_archive(
    source: Source,
    *,
    channels: Iterable[str] | None = None,
    mask_and_scale: bool = True,
    profiles_per_chunk: int | None = None,
    header_position: Position = "longitude_first",
    root: str | os.PathLike[str] | None = None,
    stretches: Mapping[str, Stretches] | None = None,
) -> xr.Dataset:
    """Open raw files of one format and layout as one Dataset.

    Parameters
    ----------
    source : str, path, or iterable of paths or Granule
        A folder (with its subfolders, without hidden files), a file, a glob pattern, or files.
        Profiles are sorted by start, then path. Where `header_position` is "ignore", granules
        supply start, stop, altitude and pointing in place of the header.
    channels : iterable of str, optional
        Channels to open, with equal range grids in all files; by default all signal channels,
        which must then be the same in all files. A name is one recorder, its ``device``.
    mask_and_scale : bool
        Whether to return physical values (float32, mV or MHz) or raw counts (int32).
    profiles_per_chunk : int, optional
        By default about 16 MB per chunk.
    header_position : {"longitude_first", "latitude_first", "ignore"}
        Which coordinate the instrument writes first.
    root : path or str, optional
        Base folder of relative paths; by default the working directory.
    stretches : mapping of str to tuple of (int, int), optional
        By channel, the stretches of bins to read: first bin and the one past the last, ascending.
        ``{"photon_532o": ((0, 500),)}`` reads the nearest 500 bins. Other channels are whole.

    Returns
    -------
    xarray.Dataset
        Channels are dask arrays (time, range), chunked along time. Computing one raises
        `RawFormatError` if a file has changed since.

    Raises
    ------
    RawFormatError
        If a file cannot be read or is of another format or layout; the error names the file.
    """
    stated = _read_headers(_files(source, root), header_position)
    files = RawFiles(stated, channels, header_position, stretches)
    profiles = profiles_per_chunk
    if profiles is None:
        largest = max(channel.bins for channel in files.selected)
        profiles = max(1, _CHUNK_BYTES // (4 * largest))
    if profiles < 1:
        raise RawFormatError(
            f"{profiles} is not a possible number of profiles",
            field="profiles_per_chunk",
            remedy="give at least 1",
        )
    # The processing needs no dask.
    from dask.base import tokenize  # noqa: PLC0415

    archive = build_raw_dataset(files, scaled=mask_and_scale)
    # Hashing one text is faster than dask's walk over a list of numbers.
    token = repr([(file.path, file.size, file.mtime_ns) for file in files.files])
    for index, channel in enumerate(files.selected):
        scales = files.values(index, "scale") if mask_and_scale else None
        about = tokenize(token, files.kept, files.places(index), scales, profiles)
        name = f"{files.format}-{channel.name}-{about}"
        chunked = archive[channel.name].variable.chunk({"time": profiles}, name=name)
        archive[channel.name] = chunked
    return archive


def open_counts(
    granules: Iterable[Granule],
    *,
    root: Path,
    channels: Iterable[str],
    stretches: Mapping[str, Stretches] | None = None,
) -> xr.Dataset:
    """Return the raw counts of some channels of granules as one Dataset.

    As `open_archive`, but lazy without dask, with what the granules state in place of headers.
    """
    stated = _read_headers(_files(granules, root), "ignore")
    return build_raw_dataset(RawFiles(stated, channels, "ignore", stretches), scaled=False)


def _files(source: Source, root: str | os.PathLike[str] | None) -> dict[str, Granule | None]:
    base = Path(root) if root is not None else Path()
    files: list[tuple[str, Granule | None]]
    if isinstance(source, str | os.PathLike):
        files = [(path, None) for path in _expand(base, Path(source))]
    else:
        # As Path would join them, but faster: the path of a granule is normalised.
        folder = "" if base == Path() else os.path.join(base, "")  # noqa: PTH118
        files = [
            (folder + item.path, item) if isinstance(item, Granule) else (str(base / item), None)
            for item in source
        ]
    if not files:
        raise RawFormatError(
            "no files are found",
            file=base / source if isinstance(source, str | os.PathLike) else None,
            remedy="give a folder, a glob pattern or paths that exist",
        )
    path, uses = Counter(path for path, _ in files).most_common(1)[0]
    if uses > 1:
        raise RawFormatError(f"is given {uses} times", file=path)
    # Sorted, so the file that sets the expected layout does not depend on the order of input.
    return dict(sorted(files, key=itemgetter(0)))


def _expand(base: Path, source: Path) -> list[str]:
    path = base / source
    if path.is_dir():
        return list(_walk(path))
    if path.exists():
        return [str(path)]
    # Unlike Path.glob, this skips hidden files, such as files that are being written.
    matches = glob.glob(str(source), root_dir=base, recursive=True)  # noqa: PTH207
    return [str(base / match) for match in matches if (base / match).is_file()]


def _walk(folder: Path) -> Iterator[str]:
    def fail(error: OSError) -> None:
        raise RawFormatError(f"cannot be listed: {error.strerror}", file=error.filename) from None

    for parent, folders, names in os.walk(folder, onerror=fail):
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from (str(Path(parent, name)) for name in names if not name.startswith("."))


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

    @property
    def interval(self) -> tuple[int, int]:
        """Start and stop in ns since 1970."""
        start, stop = self.stated.start, self.stated.stop
        if start is None or stop is None:
            raise RawFormatError(
                "has no start or stop in the catalog", file=self.path, field="start"
            )
        return (
            1000 * ((start - _EPOCH) // _MICROSECOND),
            1000 * ((stop - _EPOCH) // _MICROSECOND),
        )


def _read_headers(
    files: Mapping[str, Granule | None], position_order: Position
) -> list[StatedFile]:
    """Return the files with their headers, in the same order.

    Of granules with equal header digests one header is read, unless the position of the header
    is requested: the catalog may hold another position.
    """
    read: list[StatedFile] = []
    alike: dict[tuple[object, ...], RawHeader] = {}
    for path, granule in files.items():
        known = granule if granule and position_order == "ignore" and granule.start else None
        key = (known.header_digest, known.size, known.layout) if known else ()
        if known and key in alike:
            read.append(StatedFile(path, known.size, known.mtime_ns, alike[key], known))
            continue
        with RawFile(path) as file:
            header = read_raw_header(file, granule.format if granule else "")
        if granule:
            header = _renamed(header, granule.layout or header.layout)
        read.append(StatedFile(path, file.size, file.mtime_ns, header, known or header))
        if known and header.header_digest and key[:2] == (header.header_digest, file.size):
            alike[key] = header
    unnamed = [file.header for file in read if files[file.path] is None]
    names = recorder_names((header.layout, 1, header.start) for header in unnamed)
    return [
        replace(file, header=_renamed(file.header, named_layout(file.header.layout, names)))
        if files[file.path] is None
        else file
        for file in read
    ]


def _renamed(header: RawHeader, layout: Layout) -> RawHeader:
    """Return a header whose channels have the names of a layout of the same recorders."""
    if [channel.device for channel in header.channels] != [own.recorder for own in layout]:
        raise RawFormatError(
            "holds other channels than the catalog states",
            file=header.path,
            remedy="run lidarops catalog again",
        )
    return replace(header, channels=_with_names(header.channels, layout))


# Files with equal channels share one tuple.
@lru_cache(maxsize=128)
def _with_names(channels: tuple[RawChannel, ...], layout: Layout) -> tuple[RawChannel, ...]:
    return tuple(
        replace(c, name=own.name, bins=own.bins, first=None if own.bins == c.bins else own.before)
        for c, own in zip(channels, layout, strict=True)
    )


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
        first = files[0].header
        found = chosen({channel.name: channel for channel in first.channels}, channels, first.path)
        of_layout: dict[tuple[RawChannel, ...], tuple[RawChannel, ...]] = {}
        for header in (file.header for file in files):
            if header.format != first.format:
                raise RawFormatError(
                    f"is of raw format {header.format}, the files before it of {first.format}",
                    file=header.path,
                    remedy="open files of one format",
                )
            if header.channels not in of_layout:
                of_layout[header.channels] = _alike(header, found, whole=channels is None)
        self.format = first.format
        """Name of the raw format."""
        self.position_order = position_order
        self.kept = _kept(stretches or {}, found)
        """Stretches of the channels of which some bins are left out."""
        self.grids: list[Grid] = [
            (self.kept.get(c.name, ((0, c.bins),)), c.bin_width) for c in found
        ]
        """Range grid of each selected channel."""
        self.selected = tuple(
            replace(c, bins=sum(past - first for first, past in stretches))
            for c, (stretches, _) in zip(found, self.grids, strict=True)
        )
        """Selected channels of the first file, with the bins to keep."""
        self.files = sorted(files, key=lambda file: (file.interval[0], file.path))
        self.times = np.array([file.interval for file in self.files], dtype=np.int64)
        """Start and stop in ns since 1970, shape (files, 2)."""
        self.channels = [of_layout[file.header.channels] for file in self.files]
        """Selected channels of each file."""
        self.stamps = tuple((file.path, file.size) for file in self.files)
        """Path and size of each file, shared by all channels."""

    def places(self, channel: int) -> tuple[tuple[int, ...], ...]:
        """Return where each file holds the counts of selected channel number `channel`."""
        return tuple(selected[channel].places for selected in self.channels)

    def values(self, channel: int, name: str) -> NDArray[Any]:
        """Return a property of selected channel number `channel`, one value per file."""
        return np.array([getattr(selected[channel], name) for selected in self.channels])


def _alike(
    header: RawHeader, first: tuple[RawChannel, ...], *, whole: bool
) -> tuple[RawChannel, ...]:
    """Return the channels of a header that the first file has on the same grids, in its order."""
    stored = {channel.name: channel for channel in header.channels}
    names = None if whole else [channel.name for channel in first]
    grids, expected = (
        {(c.name, c.bins, c.bin_width, c.adc_bits) for c in channels}
        for channels in (chosen(stored, names, header.path), first)
    )
    differing = {name for name, *_ in grids ^ expected}
    if differing:
        raise RawFormatError(
            "is of another layout (channels, bins, bin width or ADC bits) than the files before it",
            file=header.path,
            field=", ".join(sorted(differing)),
            remedy="open files of one layout, or choose channels that are equal in all files",
        )
    return tuple(stored[channel.name] for channel in first)


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


class LazyChannel(BackendArray):
    """One channel of some files as an array (files, bins), which reads what is indexed.

    It can be pickled, because it holds paths and no open file. Of a channel without stretches, only
    the bins from the lowest to the highest one are read.
    """

    def __init__(self, files: RawFiles, index: int, *, scaled: bool) -> None:
        channel = files.selected[index]
        self._format = files.format
        self._files = files.stamps
        self._places = files.places(index)
        self._kept, self._first = files.kept.get(channel.name), channel.first
        self._scales = files.values(index, "scale") if scaled else None
        self.shape = (len(self._files), channel.bins)
        self.dtype = np.dtype(np.float32 if scaled else np.int32)

    def __getitem__(self, key: indexing.ExplicitIndexer) -> NDArray[Any]:
        support = indexing.IndexingSupport.OUTER
        values = indexing.explicit_indexing_adapter(key, self.shape, support, self._read)
        return np.asarray(values)

    def _read(self, key: tuple[Any, ...]) -> NDArray[Any]:
        files, bins = (np.arange(size)[part] for size, part in zip(self.shape, key, strict=True))
        if not (files.size and bins.size):
            return np.empty(files.shape + bins.shape, self.dtype)
        low, past, kept = 0, self.shape[1], self._kept
        whole = self._first is None and bins.min() == 0 and bins.max() + 1 == past
        if kept is None and not whole:
            low, past = int(bins.min()), int(bins.max()) + 1
            kept = ((low, past),)
        if kept is not None and self._first:
            kept = tuple((first + self._first, end + self._first) for first, end in kept)
        values = np.empty((files.size, past - low), self.dtype)
        row = np.empty(past - low, np.dtype("<i4"))
        read_channel = raw_formats()[self._format].read_channel
        for index, place in enumerate(np.atleast_1d(files)):
            path, size = self._files[place]
            with RawFile(path) as file:
                file.expect(size)
                read_channel(file, self._places[place], kept, row)
            scale = 1 if self._scales is None else self._scales[place]
            # In double precision.
            np.multiply(row, scale, out=values[index], casting="same_kind")
        if not np.array_equal(bins, np.arange(low, past)):
            values = values[:, bins - low]
        return values if files.ndim else np.asarray(values[0])


def build_raw_dataset(files: RawFiles, *, scaled: bool) -> xr.Dataset:
    """Return the lazy Dataset of some files, of physical values if `scaled`, else of counts."""
    # The most common grid is "range"; the others follow in file order.
    uses = Counter(files.grids)
    ordered = sorted(uses, key=lambda grid: grid != uses.most_common(1)[0][0])
    grids = {grid: "range" if i == 1 else f"range_{i}" for i, grid in enumerate(ordered, 1)}
    stated = [file.stated for file in files.files]
    notes = {note for header in stated for note in header.notes}
    read = [header for header in stated if isinstance(header, RawHeader)]
    notes |= {doubt for header in read for doubt in (header.doubt, header.time_doubt)} - {""}
    variables: dict[str, _Variable] = {}
    for index, channel in enumerate(files.selected):
        dims = ("time", grids[files.grids[index]])
        attributes, varying = _properties(files, index, scaled=scaled)
        lazy = indexing.LazilyIndexedArray(LazyChannel(files, index, scaled=scaled))
        variables[channel.name] = dims, lazy, attributes
        variables |= varying
    return xr.Dataset(
        variables,
        {**_axes(files, grids), **_place(files)},
        {
            "source_format": raw_formats()[files.format].title,
            "site": ", ".join(sorted({file.header.site for file in files.files})),
            **({"notes": "; ".join(sorted(notes))} if notes else {}),
        },
    )


def _properties(
    files: RawFiles, index: int, *, scaled: bool
) -> tuple[dict[str, Any], dict[str, _Variable]]:
    """Return the attributes of a channel, and the variables of what differs between files."""
    channel = files.selected[index]
    polarisation = POLARISATIONS.get(channel.polarisation, channel.polarisation)
    mode = str(channel.mode)
    units = SIGNAL_UNITS[mode]
    label = int(channel.wavelength_label.partition(".")[0])
    attributes: dict[str, Any] = {
        "units": units if scaled else "count",
        "long_name": f"{mode} signal at {label} nm, {polarisation} polarisation",
        "detection_mode": mode,
        "wavelength_label": channel.wavelength_label,
        **({} if math.isnan(channel.wavelength) else {"wavelength": channel.wavelength}),
        "polarisation": polarisation,
        "bin_width": channel.bin_width,
        "adc_bits": channel.adc_bits,
        "conversion": raw_formats()[files.format].conversion,
        "device": channel.device,
        **_full_scale(files, index, scaled=scaled),
    }
    varying: dict[str, _Variable] = {}
    for name, prop in _PROPERTIES.items():
        values = files.values(index, name)
        # Of type object where a file lacks the property.
        if values.dtype == object or (name == "scale" and scaled):
            continue
        if prop.may_be_attribute and _is_constant(values):
            attributes[name] = values[0].item()
            continue
        about = {
            "units": prop.units or units,
            "long_name": f"{prop.description} of {channel.name}",
        }
        varying[f"{channel.name}_{name}"] = "time", values.astype(prop.dtype), about
    return attributes, varying


def _full_scale(files: RawFiles, index: int, *, scaled: bool) -> dict[str, float]:
    channel = files.selected[index]
    if channel.input_range is None:
        return {}
    values = files.values(index, "full_scale")
    if scaled:
        # In the precision of the signal, so saturated values compare equal.
        nominal = files.values(index, "input_range") * 1e3 * (1 - 0.5**channel.adc_bits)
        values = nominal.astype(np.float32)
    return {"full_scale": values[0].item()} if _is_constant(values) else {}


def _is_constant(values: NDArray[Any]) -> bool:
    return bool((values == values[0]).all())


def _axes(files: RawFiles, grids: Mapping[Grid, str]) -> dict[str, _Variable]:
    bounds = files.times
    middle = bounds[:, 0] + (bounds[:, 1] - bounds[:, 0]) // 2
    about = {
        "standard_name": "time",
        "long_name": "middle of the measurement interval, UTC",
        "bounds": "time_bnds",
    }
    away = {"units": "m", "long_name": "distance of the bin centre from the lidar"}
    axes: dict[str, _Variable] = {
        "time": ("time", middle.astype("datetime64[ns]"), about),
        "time_bnds": (("time", "nv"), bounds.astype("datetime64[ns]"), {}),
    }
    for (stretches, width), name in grids.items():
        bins = np.concatenate([np.arange(*stretch) for stretch in stretches])
        axes[name] = name, (bins + 0.5) * width, away
    return axes


def _place(files: RawFiles) -> dict[str, _Variable]:
    stated = [file.stated for file in files.files]
    pointings = [(header.altitude, header.zenith_angle, header.azimuth) for header in stated]
    # None becomes NaN.
    altitude, zenith, azimuth = np.array(pointings, dtype=np.float64).T
    up = {"units": "degree", "long_name": "zenith angle of the beam, 0 = up"}
    height = {"units": "m", "standard_name": "altitude", "long_name": "altitude of the lidar"}
    place: dict[str, _Variable] = {
        "zenith_angle": ("time", zenith, up),
        "altitude": _constant(altitude, height),
    }
    if np.isfinite(azimuth).any():
        north = {"units": "degree", "long_name": "azimuth of the beam, clockwise from north"}
        place["azimuth"] = "time", azimuth, north
    order = files.position_order
    if order != "ignore":
        pairs = [file.header.position(order) or (math.nan, math.nan) for file in files.files]
        for name, way, degrees in zip(
            ("latitude", "longitude"), ("north", "east"), np.array(pairs).T, strict=True
        ):
            about = {"units": f"degrees_{way}", "standard_name": name}
            place[name] = _constant(degrees, about)
    return place


def _constant(values: NDArray[np.float64], attributes: dict[str, str]) -> _Variable:
    # A moving lidar has a position at every time.
    return ((), values[0], attributes) if _is_constant(values) else ("time", values, attributes)
