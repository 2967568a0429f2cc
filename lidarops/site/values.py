"""Values of a product as tables to read, and as CSV."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.any_kind import main_name
from lidarops.figures.kind_figures import figures_of
from lidarops.figures.panels import number, units
from lidarops.figures.raster import BEYOND, profile_bounds, signal_reach
from lidarops.figures.series_data import as_bits, section_label
from lidarops.figures.series_panels import Quantity
from lidarops.figures.svg import round_steps
from lidarops.figures.wording import counted
from lidarops.netcdf.stored_flags import StoredBit, rejecting_mask, stored_bits
from lidarops.netcdf.variables import QUALITY_FLAG, is_retrieved

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

ROWS: Final = 20_000
"""Most rows of a CSV file of retrieved quantities, about 1.5 MB."""
_SIGNAL_ROWS: Final = 4_000
"""Most rows of a CSV file of signals, which few read as text."""
_TIMES: Final = 300
"""Most times of a table of few columns, or of few values."""
_CELLS: Final = 320
"""Most values of a table; beyond, times and columns are chosen."""
_COLUMNS: Final = 12
"""Most columns of a table."""
_STEPS: Final = (1, 2, 5, 10, 15, 20, 30, 60, 120, 180, 360, 720, 1440)
"""Minutes between the times of a table."""
_READ_BYTES: Final = 16_000_000
"""Most bytes of a variable that are read for the choice of places. A variable of fewer is read as
a whole, which is faster than single rows."""
_FEW_COLUMNS: Final = 2
"""Columns of a table that may have `_TIMES` times, because it is narrow."""
_ACROSS: Final = 2
"""Dimensions of a variable over time and another dimension."""


@dataclass(frozen=True, slots=True)
class ValueTable:
    """Values of one quantity by time, and by range, altitude or section."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[str, ...]], ...]
    """Interval, and values in words."""
    note: str
    """Which values are shown; empty if all are."""


@dataclass(frozen=True, slots=True)
class Values:
    """Readable values of a product."""

    tables: tuple[ValueTable, ...]
    csv: bytes
    """Empty without values over time."""
    note: str
    """What the CSV file holds."""


_DECIMALS: Final = 6
"""Most decimals, or zeros, of a value without a power of ten."""
NO_VALUES: Final = Values((), b"", "")


@dataclass(frozen=True, slots=True)
class _Grid:
    """Times, and places along the other dimension, both rising."""

    dims: tuple[str, ...]
    start: NDArray[np.datetime64]
    stop: NDArray[np.datetime64]
    place: Floats
    """km where `labels` are empty, else the number of the place."""
    labels: tuple[str, ...]
    """Of the places; empty where they are numbers along a line."""
    order: tuple[Indices, Indices]
    """Of times and places in the file."""

    @property
    def name(self) -> str:
        """Dimension of the places; empty without any."""
        return self.dims[1] if len(self.dims) == _ACROSS else ""


@dataclass(frozen=True, slots=True)
class _Column:
    """A quantity at some times and places, in the displayed unit."""

    quantity: Quantity
    values: Floats
    errors: Floats


@dataclass(frozen=True, slots=True)
class _Quality:
    """Quality bits at some times and places."""

    bits: tuple[StoredBit, ...]
    flags: NDArray[np.int64]

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """Whether a value must not be used."""
        return np.asarray((self.flags & rejecting_mask(self.bits)) != 0)

    def words(self, row: int, place: int) -> tuple[str, str]:
        """Return the grade of a value, and its bits."""
        carried = [bit for bit in self.bits if self.flags[row, place] & bit.mask]
        grade = "reject" if any(bit.rejects for bit in carried) else "care" if carried else "good"
        return grade, " ".join(bit.word for bit in carried)


@dataclass(frozen=True, slots=True)
class _Part:
    """Some times and places of a product."""

    rows: Indices
    places: Indices
    columns: tuple[_Column, ...]
    quality: _Quality | None
    """None without flags of these values."""


@dataclass(frozen=True, slots=True)
class _Source:
    """A product with the quantities that are shown."""

    product: xr.Dataset
    kind: str
    quantities: tuple[Quantity, ...]
    grid: _Grid

    def part(self, rows: Indices, places: Indices) -> _Part:
        """Read some times and places."""

        def read(name: str) -> NDArray[Any] | None:
            if name not in self.product or self.product[name].dims != self.grid.dims:
                return None
            time, along = self.grid.order
            return _at(self.product[name], time[rows], along[places])

        def floats(name: str, factor: float) -> Floats:
            values = read(name)
            missing = np.full((rows.size, places.size), np.nan)
            return missing if values is None else factor * values.astype(np.float64)

        columns = tuple(
            _Column(q, floats(q.name, q.factor), floats(f"{q.name}_standard_error", q.factor))
            for q in self.quantities
        )
        flags = read(QUALITY_FLAG)
        if flags is None:
            return _Part(rows, places, columns, None)
        bits = stored_bits(self.product[QUALITY_FLAG].attrs, self.kind)
        return _Part(rows, places, columns, _Quality(bits, as_bits(flags)))


def read_values(product: xr.Dataset, kind: str) -> Values:
    """Return the values of the main quantities of a product.

    Parameters
    ----------
    product : Dataset
        Of any kind; may be lazy, because only the times and places that are shown are read.
    kind : str
        Kind of the product, which states its main quantities; may be unknown.
    """
    quantities = _quantities(product, kind)
    if not quantities:
        return NO_VALUES
    grid = _grid(product, quantities[0].name)
    source = _Source(product, kind, quantities, grid)
    reach = _reach(source)
    places = _chosen_places(grid, reach)
    few = places.size * grid.start.size <= _CELLS or grid.place.size <= _FEW_COLUMNS
    rows = _near_round_times(grid, _TIMES if few else max(1, _CELLS // places.size))
    shown = source.part(rows, places)
    most = ROWS if is_retrieved(kind) else _SIGNAL_ROWS
    rows = _near_round_times(grid, max(1, most // reach))
    listed = source.part(rows, np.arange(reach, dtype=np.intp))
    tables = tuple(_table(grid, shown, column) for column in shown.columns)
    return Values(tables, _csv(grid, listed), _csv_note(grid, listed))


def _quantities(product: xr.Dataset, kind: str) -> tuple[Quantity, ...]:
    """Return the quantities that the kind states, else its main variable, of equal dimensions."""
    figures = figures_of(kind)
    stated = figures.values if figures is not None else ()
    known = tuple(q for q in stated if q.name in product.data_vars)
    if not known:
        name = main_name(product)
        if name is None:
            return ()
        known = (Quantity(name, 1.0, units(str(product[name].attrs.get("units", "")))),)
    if product["time"].dtype.kind != "M" or product[known[0].name].size == 0:
        return ()
    dims = product[known[0].name].dims
    if dims[:1] != ("time",) or len(dims) > _ACROSS:
        return ()
    return tuple(q for q in known if product[q.name].dims == dims)


def _grid(product: xr.Dataset, name: str) -> _Grid:
    order = np.argsort(product["time"].values, kind="stable")
    start, stop = (edge[order] for edge in profile_bounds(product))
    dims = tuple(map(str, product[name].dims))
    place, labels = _places(product, dims[1]) if len(dims) == _ACROSS else (np.zeros(1), ("value",))
    along = np.arange(place.size) if labels else np.argsort(place, kind="stable")
    return _Grid(dims, start, stop, place[along], labels, (order, along))


def _places(product: xr.Dataset, along: str) -> tuple[Floats, tuple[str, ...]]:
    """Return km along a dimension, or numbers with labels where it has sections or no length."""
    numbers = np.arange(product.sizes[along], dtype=np.float64)
    bounds = f"{along}_bounds"
    if bounds in product.variables and product[bounds].dims[:1] == (along,):
        edges = product[bounds].values.astype(np.float64)
        return numbers, tuple(section_label(near, far) for near, far in edges)
    if along in product.variables and product[along].attrs.get("units") == "m":
        place = product[along].values.astype(np.float64) / 1e3
        if np.isfinite(place).all() and np.unique(place).size == place.size:
            return place, ()
    return numbers, tuple(f"{along} {number:.0f}" for number in numbers)


def _at(variable: xr.DataArray, rows: Indices, places: Indices) -> NDArray[Any]:
    """Return a variable as a table of some times and places."""
    if variable.nbytes <= _READ_BYTES:
        table = variable.values.reshape(variable.shape[0], -1)
        return np.asarray(table[np.ix_(rows, places)])
    part = dict(zip(variable.dims, (rows, places), strict=False))
    return variable.isel(part).values.reshape(rows.size, -1)


def _table(grid: _Grid, part: _Part, column: _Column) -> ValueTable:
    flags = None if part.quality is None else part.quality.flags
    rejected = False if part.quality is None else part.quality.rejected
    shown = np.isfinite(column.values) & ~np.asarray(rejected)
    rows = tuple(
        (
            _clock(grid, int(row)),
            tuple(
                _words(column.values[i, k], column.errors[i, k], flags is not None and flags[i, k])
                if shown[i, k]
                else "\N{EN DASH}"
                for k in range(part.places.size)
            ),
        )
        for i, row in enumerate(part.rows)
    )
    heads = [
        grid.labels[k] if grid.labels else f"{grid.place[k]:.3g} km" for k in part.places.tolist()
    ]
    some = []
    if part.rows.size < grid.start.size:
        some.append(
            f"{part.rows.size} of {counted(grid.start.size, 'time')}, nearest to round times"
        )
    if part.places.size < grid.place.size:
        some.append(f"single values at {part.places.size} of {grid.place.size:,} {grid.name} bins")
    title = column.quantity.label
    return ValueTable(f"{title[:1].upper()}{title[1:]}", tuple(heads), rows, "; ".join(some))


def _words(value: float, error: float, flagged: object) -> str:
    words = " \N{PLUS-MINUS SIGN} ".join(_rounded(value, error))
    return f"{words} *" if flagged else words


def _rounded(value: float, error: float) -> tuple[str, ...]:
    """Return a value and its error of two digits, to the same place; three digits without one."""
    if not np.isfinite(error):
        return (number(float(f"{value:.3g}")),)
    if not error > 0.0:
        return number(value), "0"
    error = float(f"{error:.2g}")
    decimals = 1 - math.floor(math.log10(error))
    pair = [round(size, decimals) + 0.0 for size in (value, error)]
    if abs(decimals) > _DECIMALS:
        return tuple(number(size) for size in pair)
    texts = (f"{size:.{max(decimals, 0)}f}" for size in pair)
    return tuple(text.replace("-", "\N{MINUS SIGN}") for text in texts)


def _clock(grid: _Grid, row: int) -> str:
    """Return the interval of a profile: date and time of its start, time of its end."""
    start, stop = (str(edge[row].astype("datetime64[s]")) for edge in (grid.start, grid.stop))
    if start[17:] == stop[17:] == "00":
        start, stop = start[:16], stop[:16]
    same = start[:10] == stop[:10]
    end = stop[11:] if same else stop.replace("T", " ")
    return f"{start.replace('T', ' ')}\N{EN DASH}{end}"


def _reach(source: _Source) -> int:
    """Return the number of places to show: up to somewhat beyond where noise dominates."""
    grid, count = source.grid, source.grid.place.size
    if grid.labels or count <= _COLUMNS:
        return count
    every = -(-8 * count * grid.start.size // _READ_BYTES)
    only = replace(source, quantities=source.quantities[:1])
    part = only.part(np.arange(0, grid.start.size, every), np.arange(count))
    (main,) = part.columns
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = main.values / main.errors
    if part.quality is not None:
        ratio[part.quality.rejected] = np.nan
    far = BEYOND * signal_reach(ratio, grid.place)
    return min(count, int(np.searchsorted(grid.place, far)) + 1) if far > 0.0 else count


def _chosen_places(grid: _Grid, reach: int) -> Indices:
    """Return places at round steps up to the reach; all if they are few or have no order."""
    if reach <= _COLUMNS or grid.labels:
        return np.arange(min(reach, _COLUMNS), dtype=np.intp)
    place = grid.place[:reach]
    wanted = np.array(round_steps(float(place[0]), float(place[-1]), _COLUMNS - 1))
    return np.unique(np.abs(place[None, :] - wanted[:, None]).argmin(axis=1))


def _near_round_times(grid: _Grid, at_most: int) -> Indices:
    """Return all profiles, or those nearest to round times if they are too many."""
    if grid.start.size <= at_most:
        return np.arange(grid.start.size, dtype=np.intp)
    middle = grid.start + (grid.stop - grid.start) / 2
    minute = middle.astype("datetime64[s]").astype(np.int64) / 60.0
    for step in _STEPS:
        slot = np.rint(minute / step)
        if np.unique(slot).size <= at_most:
            order = np.lexsort((np.abs(minute - slot * step), slot))
            return np.sort(order[np.unique(slot[order], return_index=True)[1]])
    return np.unique(np.linspace(0, grid.start.size - 1, at_most).astype(np.intp))


def _csv(grid: _Grid, part: _Part) -> bytes:
    """Return values with errors and quality, one row for each time and place."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    head = ["time_start", "time_end"]
    if grid.name:
        head.append(grid.name if grid.labels else f"{grid.name} (km)")
    for column in part.columns:
        unit = f" ({column.quantity.units})" if column.quantity.units else ""
        head += [f"{column.quantity.name}{unit}", f"{column.quantity.name}_standard_error{unit}"]
    writer.writerow([*head, "quality", "flags"])
    for i, row in enumerate(part.rows.tolist()):
        interval = [str(e[row].astype("datetime64[s]")) + "Z" for e in (grid.start, grid.stop)]
        for k in part.places.tolist():
            label = grid.labels[k] if grid.labels else f"{grid.place[k]:.7g}"
            numbers = [
                # The shortest text that is the same number in the precision of the file.
                str(np.float32(values[i, k]))
                for column in part.columns
                for values in (column.values, column.errors)
            ]
            place = [label] if grid.name else []
            quality = part.quality.words(i, k) if part.quality else ("", "")
            writer.writerow([*interval, *place, *numbers, *quality])
    return out.getvalue().encode()


def _csv_note(grid: _Grid, part: _Part) -> str:
    count, reach = counted(grid.start.size, "time"), part.places.size
    every = part.rows.size == grid.start.size
    profiles = f"all {count}" if every else f"{part.rows.size} of {count}, nearest to round times"
    beyond = "" if reach == grid.place.size else f", up to {grid.place[reach - 1]:.3g} km"
    without = "" if part.quality else "; these values have no quality flags"
    return f"{profiles}{beyond}{without}"
