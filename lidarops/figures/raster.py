"""Signals and backscatter as images small enough to draw, read in blocks of bounded memory."""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import ProductError
from lidarops.figures.series_data import require
from lidarops.figures.time_axis import Times, segments, usual_step
from lidarops.flags import Quality, Severity

Floats = NDArray[np.float64]
Sums = NDArray[np.float32]
"""Sums are taken in double precision and kept in single: an image needs no more."""

COLUMNS: Final = 1500
"""Most columns of an image: about the pixels of a figure's width."""
ROWS: Final = 800
"""Most rows of an image."""
_ALONG_TIME: Final = ("time", "background", "background_standard_error")
_COLUMNWISE: Final = (
    "start",
    "stop",
    "total",
    "variance",
    "used",
    "rejected",
    "profiles",
    "background",
    "background_error",
    "clouds",
)
"""What a raster has along its columns."""
_READ_ROWS: Final = 4096
"""Most rows while reading: the part that is shown is known only afterwards."""
_READ_BYTES: Final = 48_000_000
"""Bound on what is held in memory of one variable."""
_VISIBLE: Final = 1.0
"""The signal reaches as far as its median exceeds this many standard errors."""

_REJECTED: Final = int(Quality.rejecting() & ~Quality.INPUT_MISSING)
_WITH_CARE: Final = int(sum(bit for bit in Quality if bit.severity is Severity.CARE))


@dataclass(frozen=True, slots=True)
class Raster:
    """A quantity of a product reduced to block means over time and range.

    Sums are kept, not means, so that rows can be merged further without loss.
    """

    start: Times
    """(column,) Where each column starts, UTC."""
    stop: Times
    """(column,) Where each column ends."""
    edges: Floats
    """(row + 1,) Edges of the rows along range, m."""
    total: Sums
    """(column, row) Sum of the quantity over bins that are not rejected."""
    variance: Sums
    """(column, row) Variance of that sum."""
    used: Sums
    """(column, row) Number of those bins."""
    rejected: Sums
    """(column, row) Number of bins that a quality bit rejects, missing data aside."""
    with_care: int
    """Number of bins in all to use with care."""
    bins: Floats
    """(row,) Number of bins along range in a row."""
    profiles: NDArray[np.int64]
    """(column,) Number of profiles in a column."""
    background: Floats
    """(column,) Mean."""
    background_error: Floats
    """(column,) Standard error of that mean."""
    clouds: Floats
    """(column,) Range of the lowest cloud base, m; NaN where there is none."""
    units: str
    background_units: str
    bits: Quality
    """Every bit that a bin carries."""
    altitude: tuple[float, float] | None
    """Altitude at range 0 in m and its change per m of range, where the product has it."""

    @property
    def mean(self) -> Floats:
        """(column, row) Mean signal; NaN where no bin can be used."""
        return np.where(self.used > 0, self.total / np.maximum(self.used, 1), np.nan)

    @property
    def flagged(self) -> NDArray[np.bool_]:
        """(column, row) Whether at least half of the bins of the block are rejected."""
        blocks = self.profiles[:, None] * self.bins[None, :]
        return np.asarray((self.rejected > 0) & (2 * self.rejected >= blocks))

    @property
    def reach(self) -> float:
        """Range to which the signal stands out from its noise, m; 0 where it never does."""
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.where(self.used > 0, self.total / np.sqrt(self.variance), 0.0)
        ratio = np.where(np.isfinite(ratio), ratio, 0.0)
        width = min(25, ratio.shape[1])
        # The running mean along range keeps a single noisy row from being taken for signal.
        smooth = np.convolve(np.median(ratio, axis=0), np.full(width, 1.0 / width), mode="same")
        rows = np.flatnonzero(smooth > _VISIBLE)
        return float(self.edges[rows[-1] + 1]) if rows.size else 0.0

    def shown_to(self, far: float) -> Raster:
        """Return the rows up to `far` m, merged to at most `ROWS` of them."""
        rows = int(np.clip(np.searchsorted(self.edges, far), 1, self.edges.size - 1))
        starts = np.arange(0, rows, -(-rows // ROWS))

        def merged(sums: Sums) -> Sums:
            return np.asarray(np.add.reduceat(sums[..., :rows], starts, axis=-1))

        return Raster(
            start=self.start,
            stop=self.stop,
            edges=np.append(self.edges[starts], self.edges[rows]),
            total=merged(self.total),
            variance=merged(self.variance),
            used=merged(self.used),
            rejected=merged(self.rejected),
            with_care=self.with_care,
            bins=np.add.reduceat(self.bins[:rows], starts),
            profiles=self.profiles,
            background=self.background,
            background_error=self.background_error,
            clouds=self.clouds,
            units=self.units,
            background_units=self.background_units,
            bits=self.bits,
            altitude=self.altitude,
        )


def raster_variables(quantity: str = "signal") -> tuple[str, ...]:
    """Return the variables that `read_raster` reads, those too that a product need not have."""
    return (*_ALONG_TIME, "range", *_along_both(quantity), "cloud_base_range", "altitude")


def _along_both(quantity: str) -> tuple[str, ...]:
    return quantity, f"{quantity}_standard_error", "quality_flag"


def read_raster(product: xr.Dataset, *, quantity: str = "signal", profiles: int = 0) -> Raster:
    """Reduce one quantity of a product to block means.

    Parameters
    ----------
    product : Dataset
        Dims (time, range); may be lazy: it is read block by block.
    quantity : str, optional
        A variable of the product that has a standard error.
    profiles : int, optional
        Profiles to a column; as many as give `COLUMNS` columns where 0. Columns never reach
        across a gap in time.

    Returns
    -------
    Raster
        With at most 4096 rows.

    Raises
    ------
    ProductError
        Where a variable is missing or has other dims, or nothing was measured.
    """
    _check(product, quantity)
    time = product["time"].values.astype("datetime64[ns]")
    if np.any(time[1:] < time[:-1]):
        order = np.argsort(time, kind="stable")
        product, time = product.isel(time=order), time[order]
    span = product["range"].values.astype(np.float64)
    size = profiles or -(-time.size // COLUMNS)
    columns = np.concatenate([np.arange(s.start, s.stop, size) for s in segments(time)])
    rows = np.arange(0, span.size, -(-span.size // _READ_ROWS))
    parts = list(_reduced(product, quantity, columns, rows))
    background, background_error = _background(product, columns)
    start, stop = _column_edges(time, columns)
    return Raster(
        start=start,
        stop=stop,
        edges=_row_edges(span, rows),
        total=np.concatenate([part.total for part in parts]),
        variance=np.concatenate([part.variance for part in parts]),
        used=np.concatenate([part.used for part in parts]),
        rejected=np.concatenate([part.rejected for part in parts]),
        with_care=sum(part.with_care for part in parts),
        bins=np.diff([*rows, span.size]).astype(np.float64),
        profiles=np.diff([*columns, time.size]),
        background=background,
        background_error=background_error,
        clouds=_clouds(product, columns),
        units=str(product[quantity].attrs.get("units", "")),
        background_units=str(product["background"].attrs.get("units", "")),
        bits=Quality(int(np.bitwise_or.reduce([part.bits for part in parts]))),
        altitude=_altitude(product, span),
    )


def joined(rasters: Sequence[Raster]) -> list[Raster]:
    """Join rasters that follow one another in time and have the same rows: one is drawn sooner.

    Parameters
    ----------
    rasters : sequence of Raster
        Of one quantity.

    Returns
    -------
    list of Raster
        With the columns of all in their order. One that starts before another ends is not joined
        to it.
    """
    found: list[list[Raster]] = []
    for raster in rasters:
        last = found[-1][-1] if found else None
        if (
            last is not None
            and last.stop[-1] <= raster.start[0]
            and np.array_equal(last.edges, raster.edges)
        ):
            found[-1].append(raster)
        else:
            found.append([raster])
    return [_joined(following) for following in found]


def _joined(rasters: Sequence[Raster]) -> Raster:
    if len(rasters) == 1:
        return rasters[0]
    along_time: dict[str, Any] = {
        name: np.concatenate([getattr(raster, name) for raster in rasters]) for name in _COLUMNWISE
    }
    return replace(
        rasters[0],
        **along_time,
        with_care=sum(raster.with_care for raster in rasters),
        bits=functools.reduce(operator.or_, (raster.bits for raster in rasters)),
    )


@dataclass(frozen=True, slots=True)
class _Part:
    total: Sums
    variance: Sums
    used: Sums
    rejected: Sums
    with_care: int
    bits: int


def _reduced(
    product: xr.Dataset, quantity: str, columns: NDArray[np.intp], rows: NDArray[np.intp]
) -> Iterator[_Part]:
    bins = product.sizes["range"]
    edges = [*columns, product.sizes["time"]]
    first = 0
    while first < columns.size:
        last = first + 1
        while last < columns.size and (edges[last + 1] - edges[first]) * bins * 8 <= _READ_BYTES:
            last += 1
        part = product.isel(time=slice(int(edges[first]), int(edges[last])))
        yield _sums(part, quantity, columns[first:last] - edges[first], rows)
        first = last


def _sums(
    part: xr.Dataset, quantity: str, columns: NDArray[np.intp], rows: NDArray[np.intp]
) -> _Part:
    def total(values: Floats | NDArray[np.bool_]) -> Sums:
        if values.dtype == np.bool_ and not values.any():
            return np.zeros((columns.size, rows.size), dtype=np.float32)
        by_row = values.astype(np.float64, copy=False)
        # Up to as many bins as rows a row is a bin.
        if rows.size < values.shape[1]:
            by_row = np.add.reduceat(by_row, rows, axis=1)
        return np.asarray(np.add.reduceat(by_row, columns, axis=0), dtype=np.float32)

    signal = part[quantity].values.astype(np.float64)
    error = part[f"{quantity}_standard_error"].values.astype(np.float64)
    flag = _flags(part)
    rejected = (flag & _REJECTED) != 0
    good = np.isfinite(signal) & ~rejected & ((flag & int(Quality.INPUT_MISSING)) == 0)
    return _Part(
        total=total(np.where(good, signal, 0.0)),
        variance=total(np.where(good, error, 0.0) ** 2),
        used=total(good),
        rejected=total(rejected),
        with_care=int(np.count_nonzero(flag & _WITH_CARE)),
        bits=int(np.bitwise_or.reduce(flag, axis=None)),
    )


def _flags(part: xr.Dataset) -> NDArray[np.int64]:
    values = part["quality_flag"].values
    if values.dtype.kind == "f":
        values = np.where(np.isfinite(values), values, float(Quality.INPUT_MISSING))
    return np.asarray(values, dtype=np.int64)


def _background(product: xr.Dataset, columns: NDArray[np.intp]) -> tuple[Floats, Floats]:
    value = product["background"].values.astype(np.float64)
    error = product["background_standard_error"].values.astype(np.float64)
    good = np.isfinite(value)
    count = np.add.reduceat(good.astype(np.float64), columns)
    total = np.add.reduceat(np.where(good, value, 0.0), columns)
    variance = np.add.reduceat(np.where(good, error, 0.0) ** 2, columns)
    some = np.maximum(count, 1)
    none = np.where(count > 0, 0.0, np.nan)
    return total / some + none, np.sqrt(variance) / some + none


def _clouds(product: xr.Dataset, columns: NDArray[np.intp]) -> Floats:
    if "cloud_base_range" not in product:
        return np.full(columns.size, np.nan)
    base = product["cloud_base_range"].values.astype(np.float64)
    lowest = np.minimum.reduceat(np.where(np.isfinite(base), base, np.inf), columns)
    return np.where(np.isfinite(lowest), lowest, np.nan)


def _column_edges(time: Times, columns: NDArray[np.intp]) -> tuple[Times, Times]:
    """Let neighbouring columns touch, and give the last before a gap its usual width."""
    half = usual_step(time) / 2
    last = np.append(columns[1:], time.size) - 1
    start, stop = time[columns] - half, time[last] + half
    touching = np.zeros(columns.size, dtype=bool)
    touching[1:] = time[columns[1:]] - time[columns[1:] - 1] <= 5 * half
    where = np.flatnonzero(touching)
    middle = stop[where - 1] + (start[where] - stop[where - 1]) / 2
    start[where], stop[where - 1] = middle, middle
    return start, stop


def _row_edges(span: Floats, rows: NDArray[np.intp]) -> Floats:
    middles = 0.5 * (span[1:] + span[:-1])
    ends = [1.5 * span[0] - 0.5 * span[1], 1.5 * span[-1] - 0.5 * span[-2]]
    bins = np.concatenate([ends[:1], middles, ends[1:]])
    return np.asarray(bins[[*rows, span.size]])


def _altitude(product: xr.Dataset, span: Floats) -> tuple[float, float] | None:
    if "altitude" not in product.variables or product["altitude"].dims != ("range",):
        return None
    values = product["altitude"].values.astype(np.float64)
    slope = (values[-1] - values[0]) / (span[-1] - span[0])
    return float(values[0] - slope * span[0]), float(slope)


def _check(product: xr.Dataset, quantity: str) -> None:
    wanted: dict[str, tuple[str, ...]] = dict.fromkeys(_ALONG_TIME, ("time",))
    wanted |= {"range": ("range",)} | dict.fromkeys(_along_both(quantity), ("time", "range"))
    require(product, wanted)
    if product.sizes["time"] < 1 or product.sizes["range"] < 2:
        raise ProductError("holds no profile of at least 2 bins", field=quantity)


def share_with_care(rasters: Sequence[Raster]) -> float:
    """Return the share of bins that are to be used with care."""
    bins = sum(float((r.profiles[:, None] * r.bins).sum()) for r in rasters)
    return sum(raster.with_care for raster in rasters) / bins if bins else 0.0
