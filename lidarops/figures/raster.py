"""Images of signals, backscatter and extinction: block means over time and range.

Products are read in blocks of bounded memory.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from tempfile import SpooledTemporaryFile
from typing import Any, Final, TypeVar

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import ProductError
from lidarops.figures.series_data import require
from lidarops.figures.time_axis import (
    TIME_BOUNDS,
    Indices,
    Times,
    column_edges,
    column_starts,
    profile_bounds,
)
from lidarops.flags import Quality
from lidarops.netcdf.stored_flags import bits_of, flags_names, quality_bits, rejecting_mask
from lidarops.netcdf.variables import judging, possible_judges

_Item = TypeVar("_Item")
Floats = NDArray[np.float64]
Sums = NDArray[np.float32]
"""Computed in double and kept in single precision, enough for an image."""

Names = tuple[str, str, str]
"""Variables of a quantity, of its standard error and of its flags."""

COLUMNS: Final = 240
"""About the largest number of columns of an image."""
ROWS: Final = 180
"""Most rows of an image."""
_READ_ROWS: Final = 4096
"""Most rows while reading, because the range to show is known only afterwards."""
_READ_BYTES: Final = 48_000_000
"""Most bytes of one variable in memory."""
_IN_MEMORY: Final = 4_000_000
"""Most bytes of `Kept` in memory."""
_VISIBLE: Final = 1.0
"""The reach of a signal ends where its median falls below this many standard errors."""
_SOMETIMES: Final = 90.0, 3.0
"""It also goes on where this percentile over time exceeds this many, as in a cloud that passes; of
noise alone it is 1.3."""
_SMOOTH: Final = 25
"""Places of the running mean along range, so that a single noisy one does not count as signal."""


class Kept(Sequence[_Item]):
    """Items that are kept as bytes, in a temporary file where they are many, and read one by one.

    Raises
    ------
    OSError
        If the folder of temporary files cannot hold them.
    """

    def __init__(self, items: Iterable[_Item]) -> None:
        self._file = SpooledTemporaryFile(_IN_MEMORY)  # noqa: SIM115 - open as long as this lives
        self._places: list[int] = []
        for item in items:
            self._places.append(self._file.tell())
            pickle.dump(item, self._file, pickle.HIGHEST_PROTOCOL)

    def __len__(self) -> int:
        """Return the number of items."""
        return len(self._places)

    def __getitem__(self, at: Any) -> Any:
        """Return an item."""
        self._file.seek(self._places[at])
        return pickle.load(self._file)  # noqa: S301 - written above


@dataclass(frozen=True, slots=True)
class Raster:
    """A quantity of a product reduced to blocks over time and range.

    It keeps sums instead of means, so that rows can be merged without loss.
    """

    start: Times
    """(column,) Start of each column, UTC."""
    stop: Times
    """(column,) End of each column."""
    edges: Floats
    """(row + 1,) Edges of the rows along range, m."""
    sums: Sums
    """(4, column, row) Sums of the usable bins, of their variances, of their number, and of the
    number of bins that a quality bit rejects, without missing data."""
    bins: Floats
    """(row,) Number of bins along range in a row."""
    profiles: NDArray[np.int64]
    """(column,) Number of profiles in a column."""
    length: np.timedelta64
    """Usual length of a profile."""
    clouds: Floats
    """(column,) Range of the lowest cloud base, m; NaN without a cloud."""
    units: str
    altitude: tuple[float, float] | None
    """Altitude at range 0 in m, and its change per m of range; None if unknown."""

    @property
    def mean(self) -> Floats:
        """(column, row) Mean over usable bins; NaN without any."""
        total, _, used, *_ = self.sums
        return np.where(used > 0, total / np.maximum(used, 1), np.nan)

    @property
    def flagged(self) -> NDArray[np.bool_]:
        """(column, row) Whether at least half of the bins of a block are rejected."""
        rejected = self.sums[3]
        blocks = self.profiles[:, None] * self.bins[None, :]
        return np.asarray((rejected > 0) & (2 * rejected >= blocks))

    @property
    def reach(self) -> float:
        """Range up to which the signal exceeds its noise, m; 0 if it never does.

        Columns without any usable bin do not count.
        """
        total, variance, used, *_ = self.sums
        measured = used.any(axis=1)
        if not measured.any():
            return 0.0
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.nan_to_num(total / np.sqrt(variance), posinf=0.0, neginf=0.0)[measured]
        width = min(_SMOOTH, ratio.shape[1])
        often, many = _SOMETIMES
        usual, best = (
            np.convolve(level, np.full(width, 1.0 / width), mode="same")
            for level in np.percentile(ratio, [50.0, often], axis=0)
        )
        visible = np.flatnonzero((usual > _VISIBLE) | (best > many))
        return float(self.edges[visible[-1] + 1]) if visible.size else 0.0

    @property
    def usable_to(self) -> float:
        """Range of the last usable bin, m; 0 without any."""
        usable = np.flatnonzero(self.sums[2].any(axis=0))
        return float(self.edges[usable[-1] + 1]) if usable.size else 0.0

    def shown_to(self, far: float) -> Raster:
        """Return the rows up to `far` (m), merged to at most `ROWS` rows."""
        rows = int(np.clip(np.searchsorted(self.edges, far), 1, self.edges.size - 1))
        starts = np.arange(0, rows, -(-rows // ROWS))
        return replace(
            self,
            edges=np.append(self.edges[starts], self.edges[rows]),
            sums=np.add.reduceat(self.sums[..., :rows], starts, axis=-1),
            bins=np.add.reduceat(self.bins[:rows], starts),
        )


def raster_variables(quantity: str, along: str = "range") -> tuple[str, ...]:
    """Return the variables that `read_raster` reads, including optional ones."""
    flags, where = possible_judges(quantity), ("cloud_base_range", "altitude")
    return "time", along, *_along_both(quantity), *flags, TIME_BOUNDS, *where


def _along_both(quantity: str) -> tuple[str, ...]:
    return quantity, f"{quantity}_standard_error"


def read_raster(
    product: xr.Dataset, *, quantity: str, profiles: int, along: str = "range"
) -> Raster:
    """Reduce one quantity of a product to blocks.

    Parameters
    ----------
    product : Dataset
        Of any kind; may be lazy, because it is read in blocks.
    quantity : str
        A variable of the product, dims (time, `along`), with a standard error.
    profiles : int
        Profiles per column. Columns neither extend across gaps in time nor touch there.
    along : str, optional
        Dimension across time, with its coordinate: ``range``, or ``altitude``.

    Returns
    -------
    Raster
        With at most 4096 rows.

    Raises
    ------
    ProductError
        If a variable is missing or has other dimensions, or the product is empty.
    """
    dims: dict[str, tuple[str, ...]] = {"time": ("time",), along: (along,)}
    judge = judging(quantity, flags_names(product))
    require(product, dims | dict.fromkeys((*_along_both(quantity), judge), ("time", along)))
    if product.sizes["time"] < 1 or product.sizes[along] < 2:
        raise ProductError("holds no profile of at least 2 bins", field=quantity)
    time = product.variables["time"].values
    if np.any(time[1:] < time[:-1]):
        product = product.isel(time=np.argsort(time, kind="stable"))
    ranges = product.variables[along].values.astype(np.float64)
    starts, stops = profile_bounds(product)
    columns = column_starts(starts, stops, profiles)
    rows = np.arange(0, ranges.size, -(-ranges.size // _READ_ROWS))
    known = bits_of(product, judge)
    missing = sum(bit.mask for bit in known if bit.word == Quality.INPUT_MISSING.word)
    masks = rejecting_mask(known), missing
    names = quantity, f"{quantity}_standard_error", judge
    sums = [*_reduced(product[[*names]], names, masks, columns, rows)]
    start, stop = column_edges(starts, stops, columns)
    return Raster(
        start=start,
        stop=stop,
        edges=bin_edges(ranges)[[*rows, ranges.size]],
        sums=np.concatenate(sums, axis=1),
        bins=np.diff([*rows, ranges.size]).astype(np.float64),
        profiles=np.diff([*columns, starts.size]),
        length=np.median(stops - starts),
        clouds=_clouds(product, columns),
        units=str(product.variables[quantity].attrs.get("units", "")),
        altitude=_altitude(product, ranges),
    )


def _reduced(
    product: xr.Dataset, names: Names, masks: tuple[int, int], columns: Indices, rows: Indices
) -> Iterator[Sums]:
    """Yield sums over blocks of columns."""
    edges = [*columns, product.sizes["time"]]
    longest = int(np.diff(edges).max())
    step = max(1, _READ_BYTES // (8 * product.variables[names[0]].shape[1] * longest))
    for first in range(0, columns.size, step):
        last = min(first + step, columns.size)
        block = product.isel(time=slice(int(edges[first]), int(edges[last])))
        yield _sums(block, names, masks, columns[first:last] - edges[first], rows)


def _sums(
    product: xr.Dataset, names: Names, masks: tuple[int, int], columns: Indices, rows: Indices
) -> Sums:
    signal, error = (product.variables[name].values.astype(np.float64) for name in names[:2])
    flag = quality_bits(product.variables[names[2]])
    rejected, missing = ((flag & mask) != 0 for mask in masks)
    good = np.isfinite(signal) & ~rejected & ~missing
    known = np.where(good, signal, 0.0), np.where(good, error, 0.0) ** 2
    parts = *known, good, rejected & ~missing
    sums = np.zeros((len(parts), columns.size, rows.size), dtype=np.float32)
    for total, part in zip(sums, parts, strict=True):
        by_row = part.astype(np.float64, copy=False)
        # With one bin per row there is nothing to add.
        if rows.size < part.shape[1]:
            by_row = np.add.reduceat(by_row, rows, axis=1)
        total[:] = np.add.reduceat(by_row, columns, axis=0)
    return sums


def _clouds(product: xr.Dataset, columns: Indices) -> Floats:
    base = product.variables.get("cloud_base_range")
    if base is None:
        return np.full(columns.size, np.nan)
    return np.fmin.reduceat(base.values.astype(np.float64), columns)


def bin_edges(middles: Floats) -> Floats:
    """Return the edges of bins, half way between the given middles; at least two bins."""
    between = 0.5 * (middles[1:] + middles[:-1])
    ends = [1.5 * middles[0] - 0.5 * middles[1], 1.5 * middles[-1] - 0.5 * middles[-2]]
    return np.concatenate([ends[:1], between, ends[1:]])


def _altitude(product: xr.Dataset, ranges: Floats) -> tuple[float, float] | None:
    altitude = product.variables.get("altitude")
    if altitude is None or altitude.dims != ("range",):
        return None
    values = altitude.values.astype(np.float64)
    slope = (values[-1] - values[0]) / (ranges[-1] - ranges[0])
    return float(values[0] - slope * ranges[0]), float(slope)
