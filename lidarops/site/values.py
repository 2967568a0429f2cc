"""Values of a product as tables to read, and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.any_kind import main_name
from lidarops.figures.kind_figures import figures_of
from lidarops.figures.panels import number, units
from lidarops.figures.raster import BEYOND, profile_bounds, signal_reach
from lidarops.figures.series_data import quality_bits
from lidarops.figures.series_panels import Quantity
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
"""Most times of a table of few columns."""
_CELLS: Final = 320
"""Most values of a table; beyond, times and columns are chosen."""
_COLUMNS: Final = 12
"""Most columns of a table."""
_STEPS: Final = (1, 2, 5, 10, 15, 20, 30, 60, 120, 180, 360, 720, 1440)
"""Minutes between the times of a table."""
_ROUND: Final = (1.0, 2.0, 5.0, 10.0)
_ACROSS: Final = 2
"""Dimensions of a variable over time and another dimension."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One value in words."""

    text: str
    css: str
    """``good``, ``care`` or ``reject``."""


@dataclass(frozen=True, slots=True)
class ValueTable:
    """Values of one quantity by time, and by range, altitude or section."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[Cell, ...]], ...]
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


@dataclass(frozen=True, slots=True)
class _Grid:
    """Times, and places along the other dimension."""

    start: NDArray[np.datetime64]
    stop: NDArray[np.datetime64]
    place: Floats
    """km where `name` has a unit, else the number of the place."""
    name: str
    labels: tuple[str, ...]
    """Of the places; empty where they are numbers along a line."""


def read_values(product: xr.Dataset, kind: str) -> Values:
    """Return the values of the main quantities of a product.

    Parameters
    ----------
    product : Dataset
        Of any kind.
    kind : str
        Kind of the product, which states its main quantities; may be unknown.
    """
    quantities = _quantities(product, kind)
    if not quantities:
        return Values((), b"", "")
    product = product.isel(time=np.argsort(product["time"].values, kind="stable"))
    grid = _grid(product, quantities[0].name)
    shape = (grid.start.size, grid.place.size)
    bits = _stored(product, kind)
    flags = _flags(product, quantities[0].name).reshape(shape)
    rejected = (flags & rejecting_mask(bits)) != 0
    arrays = {q.name: _array(product, q.name).reshape(shape) for q in quantities}
    errors = {
        q.name: _array(product, f"{q.name}_standard_error", q.name).reshape(shape)
        for q in quantities
    }
    main = quantities[0].name
    reach = _reach(np.where(rejected, np.nan, arrays[main]) / errors[main], grid)
    tables = tuple(
        _table(q, grid, arrays[q.name], errors[q.name], (flags, rejected), reach)
        for q in quantities
    )
    most = ROWS if is_retrieved(kind) else _SIGNAL_ROWS
    rows = _near_round_times(grid, max(1, most // reach))
    text = _csv(grid, quantities, arrays, errors, (flags, rejected), bits, (rows, reach))
    return Values(tables, text, _csv_note(grid, rows, reach))


def _quantities(product: xr.Dataset, kind: str) -> tuple[Quantity, ...]:
    """Return the quantities that the kind states, else its main variable, of equal dimensions."""
    figures = figures_of(kind)
    stated = figures.values if figures is not None else ()
    known = tuple(q for q in stated if q.name in product.data_vars)
    if not known:
        name = main_name(product)
        if name is None:
            return ()
        known = (Quantity(name, 1.0, str(product[name].attrs.get("units", ""))),)
    if product["time"].dtype.kind != "M" or product.sizes["time"] == 0:
        return ()
    dims = product[known[0].name].dims
    if dims[:1] != ("time",) or len(dims) > _ACROSS:
        return ()
    return tuple(q for q in known if product[q.name].dims == dims)


def _grid(product: xr.Dataset, name: str) -> _Grid:
    start, stop = profile_bounds(product)
    dims = product[name].dims
    if len(dims) < _ACROSS:
        return _Grid(start, stop, np.zeros(1), "", ("value",))
    along = str(dims[1])
    count = product.sizes[along]
    bounds = f"{along}_bounds"
    if bounds in product.variables and product[bounds].dims[:1] == (along,):
        edges = product[bounds].values.astype(np.float64) / 1e3
        labels = tuple(f"{low:g}\N{EN DASH}{high:g} km" for low, high in edges)
        return _Grid(start, stop, np.arange(count, dtype=np.float64), along, labels)
    if along in product.variables and product[along].attrs.get("units") == "m":
        return _Grid(start, stop, product[along].values.astype(np.float64) / 1e3, along, ())
    numbers = tuple(f"{along} {place}" for place in range(count))
    return _Grid(start, stop, np.arange(count, dtype=np.float64), along, numbers)


def _stored(product: xr.Dataset, kind: str) -> tuple[StoredBit, ...]:
    return stored_bits(product[QUALITY_FLAG].attrs, kind) if QUALITY_FLAG in product else ()


def _flags(product: xr.Dataset, name: str) -> NDArray[np.int64]:
    if QUALITY_FLAG in product and product[QUALITY_FLAG].dims == product[name].dims:
        return quality_bits(product[QUALITY_FLAG])
    return np.zeros(product[name].shape, dtype=np.int64)


def _array(product: xr.Dataset, name: str, like: str = "") -> Floats:
    if name not in product:
        return np.full(product[like].shape, np.nan)
    return product[name].values.astype(np.float64)


def _table(
    quantity: Quantity,
    grid: _Grid,
    values: Floats,
    errors: Floats,
    quality: tuple[NDArray[np.int64], NDArray[np.bool_]],
    reach: int,
) -> ValueTable:
    columns = _chosen_places(grid, reach)
    few = columns.size * grid.start.size <= _CELLS or grid.place.size <= _ACROSS
    most = _TIMES if few else max(1, _CELLS // columns.size)
    rows = _near_round_times(grid, most)
    flags, rejected = quality
    cells = tuple(
        (
            _clock(grid, int(row)),
            tuple(
                _cell(
                    quantity.factor * float(values[row, column]),
                    quantity.factor * float(errors[row, column]),
                    bool(rejected[row, column]),
                    bool(flags[row, column]),
                )
                for column in columns
            ),
        )
        for row in rows
    )
    heads = grid.labels or tuple(f"{grid.place[k]:.3g} km" for k in columns)
    shown = [heads[k] for k in columns] if grid.labels else heads
    some = []
    if rows.size < grid.start.size:
        some.append(f"{rows.size} of {counted(grid.start.size, 'time')}, nearest to round times")
    if columns.size < grid.place.size:
        some.append(f"single values at {columns.size} of {grid.place.size:,} {grid.name} bins")
    unit = units(quantity.units)
    title = quantity.name.replace("_", " ") + (f" ({unit})" if unit not in ("", "1") else "")
    return ValueTable(f"{title[:1].upper()}{title[1:]}", tuple(shown), cells, "; ".join(some))


def _cell(value: float, error: float, rejected: bool, flagged: bool) -> Cell:  # noqa: FBT001
    if rejected or not np.isfinite(value):
        return Cell("\N{EN DASH}", "reject")
    words = number(float(f"{value:.3g}"))
    if np.isfinite(error):
        words += f" \N{PLUS-MINUS SIGN} {number(float(f'{error:.2g}'))}"
    return Cell(f"{words}{' *' if flagged else ''}", "care" if flagged else "good")


def _clock(grid: _Grid, row: int) -> str:
    """Return the interval of a profile: date and time of its start, time of its end."""
    start, stop = (str(edge[row].astype("datetime64[s]")) for edge in (grid.start, grid.stop))
    if start[17:] == stop[17:] == "00":
        start, stop = start[:16], stop[:16]
    same = start[:10] == stop[:10]
    end = stop[11:] if same else stop.replace("T", " ")
    return f"{start.replace('T', ' ')}\N{EN DASH}{end}"


def _reach(ratio: Floats, grid: _Grid) -> int:
    """Return the number of places to show: up to somewhat beyond where noise dominates."""
    count = grid.place.size
    if grid.labels or count <= _COLUMNS:
        return count
    far = BEYOND * signal_reach(ratio, grid.place)
    return min(count, int(np.searchsorted(grid.place, far)) + 1) if far > 0.0 else count


def _chosen_places(grid: _Grid, reach: int) -> Indices:
    """Return places at round steps up to the reach; all if they are few or have no order."""
    if reach <= _COLUMNS or grid.labels:
        return np.arange(min(reach, _COLUMNS), dtype=np.intp)
    place = grid.place[:reach]
    rough = (place[-1] - place[0]) / _COLUMNS
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(power * s for s in _ROUND if power * s >= rough)
    wanted = np.arange(np.ceil(place[0] / step), np.floor(place[-1] / step) + 1) * step
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


def _csv(
    grid: _Grid,
    quantities: Sequence[Quantity],
    values: dict[str, Floats],
    errors: dict[str, Floats],
    quality: tuple[NDArray[np.int64], NDArray[np.bool_]],
    bits: Sequence[StoredBit],
    chosen: tuple[Indices, int],
) -> bytes:
    """Return values with errors and quality, one row for each time and place."""
    flags, rejected = quality
    rows, reach = chosen
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    head = ["time_start", "time_end"]
    if grid.name:
        head.append(grid.name if grid.labels else f"{grid.name} (km)")
    for q in quantities:
        unit = f" ({q.units})" if q.units else ""
        head += [f"{q.name}{unit}", f"{q.name}_standard_error{unit}"]
    writer.writerow([*head, "quality", "flags"])
    words: dict[int, str] = {}
    for row in rows.tolist():
        interval = [str(e[row].astype("datetime64[s]")) + "Z" for e in (grid.start, grid.stop)]
        for k in range(reach):
            flag = int(flags[row, k])
            if flag not in words:
                words[flag] = " ".join(bit.word for bit in bits if flag & bit.mask)
            label = grid.labels[k] if grid.labels else f"{grid.place[k]:.7g}"
            numbers = [
                f"{q.factor * array[q.name][row, k]:.6g}"
                for q in quantities
                for array in (values, errors)
            ]
            grade = "reject" if rejected[row, k] else "care" if flag else "good"
            place = [label] if grid.name else []
            writer.writerow([*interval, *place, *numbers, grade, words[flag]])
    return out.getvalue().encode()


def _csv_note(grid: _Grid, rows: Indices, reach: int) -> str:
    every = rows.size == grid.start.size
    profiles = (
        f"all {counted(grid.start.size, 'time')}"
        if every
        else f"{rows.size} of {counted(grid.start.size, 'time')}, nearest to round times"
    )
    beyond = "" if reach == grid.place.size else f", up to {grid.place[reach - 1]:.3g} km"
    return f"{profiles}{beyond}"
