"""Images of signals, backscatter and extinction: block means over time and range.

Products are read in blocks of bounded memory.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import ProductError
from lidarops.figures.series_data import quality_bits, require
from lidarops.figures.time_axis import Times, segments, usual_step
from lidarops.flags import FlagBit, Flags, Quality
from lidarops.kinds import flags_of

Floats = NDArray[np.float64]
Sums = NDArray[np.float32]
"""Sums are computed in double and kept in single precision, enough for an image."""

COLUMNS: Final = 400
"""Most columns of an image, but for those that gaps in time add."""
ROWS: Final = 300
"""Most rows of an image."""
_BACKGROUND: Final = ("background", "background_standard_error")
TIME_BOUNDS: Final = "time_bnds"
_TOUCHING: Final = 10.0
"""Columns touch across a pause of at most this many of their profiles that is no gap: one minute
measured in every ten is shown as one area, but not five seconds in an hour."""
_READ_ROWS: Final = 4096
"""Most rows while reading, because the range to show is known only afterwards."""
_READ_BYTES: Final = 48_000_000
"""Most bytes of one variable in memory."""
_VISIBLE: Final = 1.0
"""The reach of a signal ends where its median falls below this many standard errors."""
_SOMETIMES: Final = 90.0, 3.0
"""It also goes on where this percentile over time exceeds this many, as in a cloud that passes; of
noise alone it is 1.3."""
_SMOOTH: Final = 25
"""Places of the running mean along range, so that a single noisy one does not count as signal."""
BEYOND: Final = 1.2
"""A signal is shown to this many times its reach."""
_DECADES: Final = 4.0
"""Most decades of a colour scale."""


@dataclass(frozen=True, slots=True)
class Raster:
    """A quantity of a product reduced to block means over time and range.

    It keeps sums instead of means, so that rows can be merged without loss.
    """

    start: Times
    """(column,) Start of each column, UTC."""
    stop: Times
    """(column,) End of each column."""
    time: Times
    """(column,) Mean time of its profiles; columns that touch reach farther than their profiles."""
    edges: Floats
    """(row + 1,) Edges of the rows along range, m."""
    total: Sums
    """(column, row) Sum of the quantity over usable bins."""
    variance: Sums
    """(column, row) Variance of that sum."""
    used: Sums
    """(column, row) Number of usable bins."""
    rejected: Sums
    """(column, row) Number of bins that a quality bit rejects, without missing data."""
    with_care: int
    """Total number of bins to use with care."""
    bins: Floats
    """(row,) Number of bins along range in a row."""
    profiles: NDArray[np.int64]
    """(column,) Number of profiles in a column."""
    length: np.timedelta64
    """Usual length of a profile."""
    background: Floats
    """(column,) Mean background."""
    background_error: Floats
    """(column,) Standard error of that mean."""
    clouds: Floats
    """(column,) Range of the lowest cloud base, m; NaN without a cloud."""
    units: str
    background_units: str
    bits: tuple[FlagBit, ...]
    """All bits that any bin carries."""
    altitude: tuple[float, float] | None
    """Altitude at range 0 in m, and its change per m of range; None if unknown."""

    @property
    def mean(self) -> Floats:
        """(column, row) Mean over usable bins; NaN without any."""
        return np.where(self.used > 0, self.total / np.maximum(self.used, 1), np.nan)

    @property
    def flagged(self) -> NDArray[np.bool_]:
        """(column, row) Whether at least half of the bins of a block are rejected."""
        blocks = self.profiles[:, None] * self.bins[None, :]
        return np.asarray((self.rejected > 0) & (2 * self.rejected >= blocks))

    @property
    def reach(self) -> float:
        """Range up to which the signal exceeds its noise, m; 0 if it never does.

        Columns without any usable bin do not count.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.where(self.used > 0, self.total / np.sqrt(self.variance), 0.0)
        measured = self.used.any(axis=1)
        return signal_reach(ratio[measured], self.edges[1:]) if measured.any() else 0.0

    @property
    def usable_to(self) -> float:
        """Range of the last usable bin, m; 0 without any."""
        usable = np.flatnonzero(self.used.any(axis=0))
        return float(self.edges[usable[-1] + 1]) if usable.size else 0.0

    def shown_to(self, far: float) -> Raster:
        """Return the rows up to `far` (m), merged to at most `ROWS` rows."""
        rows = int(np.clip(np.searchsorted(self.edges, far), 1, self.edges.size - 1))
        starts = np.arange(0, rows, -(-rows // ROWS))

        def merged(sums: Sums) -> Sums:
            return np.asarray(np.add.reduceat(sums[..., :rows], starts, axis=-1))

        return replace(
            self,
            edges=np.append(self.edges[starts], self.edges[rows]),
            total=merged(self.total),
            variance=merged(self.variance),
            used=merged(self.used),
            rejected=merged(self.rejected),
            bins=np.add.reduceat(self.bins[:rows], starts),
        )


def signal_reach(ratio: Floats, places: Floats) -> float:
    """Return the last place at which a signal exceeds its noise; 0 if it never does.

    Parameters
    ----------
    ratio : ndarray, shape (time, place)
        Value over standard error; 0 is taken where it is not finite.
    places : ndarray, shape (place,)
        Rising.
    """
    ratio = np.where(np.isfinite(ratio), ratio, 0.0)
    width = min(_SMOOTH, ratio.shape[1])
    often, many = _SOMETIMES
    usual, best = (
        np.convolve(level, np.full(width, 1.0 / width), mode="same")
        for level in np.percentile(ratio, [50.0, often], axis=0)
    )
    visible = np.flatnonzero((usual > _VISIBLE) | (best > many))
    return float(places[visible[-1]]) if visible.size else 0.0


def raster_variables(quantity: str, along: str = "range") -> tuple[str, ...]:
    """Return the variables that `read_raster` reads, including optional ones."""
    optional = (TIME_BOUNDS, "cloud_base_range", "altitude", *_BACKGROUND)
    return ("time", along, *_along_both(quantity), *optional)


def _along_both(quantity: str) -> tuple[str, ...]:
    return quantity, f"{quantity}_standard_error", "quality_flag"


def read_raster(
    product: xr.Dataset, *, quantity: str, kind: str, profiles: int = 0, along: str = "range"
) -> Raster:
    """Reduce one quantity of a product to block means.

    Parameters
    ----------
    product : Dataset
        May be lazy, because it is read in blocks.
    quantity : str
        A variable of the product, dims (time, `along`), with a standard error.
    kind : str
        Kind of the product, whose quality bits it has.
    profiles : int, optional
        Profiles per column; 0 for about `COLUMNS` columns. Columns neither extend across gaps in
        time nor touch there.
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
    _check(product, quantity, along)
    time = product["time"].values.astype("datetime64[ns]")
    if np.any(time[1:] < time[:-1]):
        order = np.argsort(time, kind="stable")
        product, time = product.isel(time=order), time[order]
    ranges = product[along].values.astype(np.float64)
    size = profiles or -(-time.size // COLUMNS)
    starts, stops = profile_bounds(product)
    columns = column_starts(starts, stops, size)
    rows = np.arange(0, ranges.size, -(-ranges.size // _READ_ROWS))
    read = [*_along_both(quantity)]
    blocks = list(_reduced(product[read], quantity, flags_of(kind), columns, rows))
    background, background_error = _background(product, columns)
    start, stop = column_edges(starts, stops, columns)
    return Raster(
        start=start,
        stop=stop,
        time=_mean_time(starts + (stops - starts) / 2, columns),
        edges=bin_edges(ranges)[[*rows, ranges.size]],
        total=np.concatenate([block.total for block in blocks]),
        variance=np.concatenate([block.variance for block in blocks]),
        used=np.concatenate([block.used for block in blocks]),
        rejected=np.concatenate([block.rejected for block in blocks]),
        with_care=sum(block.with_care for block in blocks),
        bins=np.diff([*rows, ranges.size]).astype(np.float64),
        profiles=np.diff([*columns, time.size]),
        length=np.median(stops - starts),
        background=background,
        background_error=background_error,
        clouds=_clouds(product, columns),
        units=_units(product, quantity),
        background_units=_units(product, "background"),
        bits=flags_of(kind).raised(int(np.bitwise_or.reduce([block.bits for block in blocks]))),
        altitude=_altitude(product, ranges),
    )


def _units(product: xr.Dataset, name: str) -> str:
    return str(product[name].attrs.get("units", "")) if name in product else ""


@dataclass(frozen=True, slots=True)
class _Block:
    """Sums over a block of columns."""

    total: Sums
    variance: Sums
    used: Sums
    rejected: Sums
    with_care: int
    bits: int


def _reduced(
    product: xr.Dataset,
    quantity: str,
    flags: Flags,
    columns: NDArray[np.intp],
    rows: NDArray[np.intp],
) -> Iterator[_Block]:
    bins = product[quantity].shape[1]
    edges = [*columns, product.sizes["time"]]
    first = 0
    while first < columns.size:
        last = first + 1
        while last < columns.size and (edges[last + 1] - edges[first]) * bins * 8 <= _READ_BYTES:
            last += 1
        block = product.isel(time=slice(int(edges[first]), int(edges[last])))
        yield _sums(block, quantity, flags, columns[first:last] - edges[first], rows)
        first = last


def _sums(
    product: xr.Dataset,
    quantity: str,
    flags: Flags,
    columns: NDArray[np.intp],
    rows: NDArray[np.intp],
) -> _Block:
    def total(values: Floats | NDArray[np.bool_]) -> Sums:
        if values.dtype == np.bool_ and not values.any():
            return np.zeros((columns.size, rows.size), dtype=np.float32)
        by_row = values.astype(np.float64, copy=False)
        # With one bin per row there is nothing to add.
        if rows.size < values.shape[1]:
            by_row = np.add.reduceat(by_row, rows, axis=1)
        return np.asarray(np.add.reduceat(by_row, columns, axis=0), dtype=np.float32)

    signal = product[quantity].values.astype(np.float64)
    error = product[f"{quantity}_standard_error"].values.astype(np.float64)
    flag = quality_bits(product["quality_flag"])
    missing = (flag & int(Quality.INPUT_MISSING)) != 0
    rejected = (flag & flags.rejecting & ~int(Quality.INPUT_MISSING)) != 0
    usable = (flag & flags.rejecting) == 0
    good = np.isfinite(signal) & ~rejected & ~missing
    return _Block(
        total=total(np.where(good, signal, 0.0)),
        variance=total(np.where(good, error, 0.0) ** 2),
        used=total(good),
        rejected=total(rejected),
        with_care=int(np.count_nonzero((flag & flags.caring).astype(bool) & usable)),
        bits=int(np.bitwise_or.reduce(flag, axis=None)),
    )


def _mean_time(time: Times, columns: NDArray[np.intp]) -> Times:
    since = (time - time[0]).astype("timedelta64[ns]").astype(np.int64)
    count = np.diff([*columns, time.size])
    return np.asarray(
        time[0] + (np.add.reduceat(since, columns) // count).astype("timedelta64[ns]")
    )


def _background(product: xr.Dataset, columns: NDArray[np.intp]) -> tuple[Floats, Floats]:
    if not set(_BACKGROUND) <= set(product.variables):
        return np.full(columns.size, np.nan), np.full(columns.size, np.nan)
    value, error = (product[name].values.astype(np.float64) for name in _BACKGROUND)
    good = np.isfinite(value)
    count = np.add.reduceat(good.astype(np.float64), columns)
    total = np.add.reduceat(np.where(good, value, 0.0), columns)
    variance = np.add.reduceat(np.where(good, error, 0.0) ** 2, columns)
    divisor = np.maximum(count, 1)
    missing = np.where(count > 0, 0.0, np.nan)
    return total / divisor + missing, np.sqrt(variance) / divisor + missing


def _clouds(product: xr.Dataset, columns: NDArray[np.intp]) -> Floats:
    if "cloud_base_range" not in product:
        return np.full(columns.size, np.nan)
    base = product["cloud_base_range"].values.astype(np.float64)
    lowest = np.minimum.reduceat(np.where(np.isfinite(base), base, np.inf), columns)
    return np.where(np.isfinite(lowest), lowest, np.nan)


def profile_bounds(product: xr.Dataset) -> tuple[Times, Times]:
    """Return start and end of each profile; without bounds half the usual step around its time."""
    if TIME_BOUNDS in product.variables:
        bounds = product[TIME_BOUNDS].values.astype("datetime64[ns]")
        return bounds[:, 0], bounds[:, 1]
    time = product["time"].values.astype("datetime64[ns]")
    half = usual_step(np.sort(time)) / 2
    return np.asarray(time - half), np.asarray(time + half)


def column_starts(start: Times, stop: Times, size: int) -> NDArray[np.intp]:
    """Return the first profile of each column of `size` profiles; none extends across a gap."""
    stretches = segments(start + (stop - start) / 2)
    return np.concatenate([np.arange(s.start, s.stop, size) for s in stretches])


def column_edges(start: Times, stop: Times, columns: NDArray[np.intp]) -> tuple[Times, Times]:
    """Return the edges of columns; they touch where the pause between them is short and no gap."""
    last = np.append(columns[1:], start.size) - 1
    left, right = start[columns], stop[last]
    length = np.median(stop - start)
    pause = left[1:] - right[:-1]
    gaps = [stretch.start for stretch in segments(start + (stop - start) / 2)]
    touching = np.flatnonzero((np.abs(pause) <= _TOUCHING * length) & ~np.isin(columns[1:], gaps))
    middle = right[touching] + pause[touching] / 2
    left[touching + 1], right[touching] = middle, middle
    return left, right


def bin_edges(middles: Floats) -> Floats:
    """Return the edges of bins, half way between the given middles; at least two bins."""
    between = 0.5 * (middles[1:] + middles[:-1])
    ends = [1.5 * middles[0] - 0.5 * middles[1], 1.5 * middles[-1] - 0.5 * middles[-2]]
    return np.concatenate([ends[:1], between, ends[1:]])


def _altitude(product: xr.Dataset, ranges: Floats) -> tuple[float, float] | None:
    if "altitude" not in product.variables or product["altitude"].dims != ("range",):
        return None
    values = product["altitude"].values.astype(np.float64)
    slope = (values[-1] - values[0]) / (ranges[-1] - ranges[0])
    return float(values[0] - slope * ranges[0]), float(slope)


def _check(product: xr.Dataset, quantity: str, along: str) -> None:
    dims: dict[str, tuple[str, ...]] = {"time": ("time",), along: (along,)}
    require(product, dims | dict.fromkeys(_along_both(quantity), ("time", along)))
    if product.sizes["time"] < 1 or product.sizes[along] < 2:
        raise ProductError("holds no profile of at least 2 bins", field=quantity)


def share_with_care(rasters: Sequence[Raster]) -> float:
    """Return the share of bins to use with care."""
    bins = sum(float((r.profiles[:, None] * r.bins).sum()) for r in rasters)
    return sum(raster.with_care for raster in rasters) / bins if bins else 0.0


def colour_limits(values: Floats) -> tuple[float, float] | None:
    """Return round ends of a logarithmic colour scale for `values`; None if none is positive."""
    positive = values[np.isfinite(values) & (values > 0)]
    if positive.size == 0:
        return None
    low, high = (float(level) for level in np.percentile(positive, [2.0, 99.8]))
    high = _round(max(high, 1.05 * low), up=True)
    return _round(max(low, high * 10.0**-_DECADES), up=False), high


def _round(value: float, *, up: bool) -> float:
    """Return the next 1, 2 or 5 times a power of ten that is not below, or not above, a value."""
    power = 10.0 ** np.floor(np.log10(value))
    rounded = [float(power * step) for step in (1.0, 2.0, 5.0, 10.0)]
    # A value that is round already stays, also where its power is off by a rounding error.
    if up:
        return next(step for step in rounded if step >= value * (1.0 - 1e-9))
    return next(step for step in rounded[::-1] if step <= value * (1.0 + 1e-9))
