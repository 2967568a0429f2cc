"""Series over time of the quantities of a product, as tables.

Also checks and reads variables of any product.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import ProductError
from lidarops.figures.time_axis import Times, segments

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TimeSeries:
    """The quantities of one series over time."""

    table: pd.DataFrame
    """Indexed by the middles of profiles, UTC, rising: each quantity, its ``_standard_error``, and
    ``flag``, bits of the kind."""
    rejecting: int
    """Union of the bits of the kind that reject a value."""
    label: str = ""
    """Name in legends."""
    key: tuple[float, ...] = ()
    """Identity and place among the series of a product: bounds in m, or a number."""

    @property
    def time(self) -> Times:
        """(time,) Middles of profiles, UTC, rising."""
        return np.asarray(self.table.index)

    @property
    def flag(self) -> NDArray[np.int64]:
        """(time,) Bits of the kind."""
        return np.asarray(self.table["flag"], dtype=np.int64)

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """(time,) Whether a quality bit rejects the value."""
        return np.asarray((self.flag & self.rejecting) != 0)

    def values(self, name: str) -> Floats:
        """(time,) Values of a quantity, or its standard errors."""
        return np.asarray(self.table[name], dtype=np.float64)


def join(series: Iterable[TimeSeries]) -> list[TimeSeries]:
    """Join series of the same key in time.

    Parameters
    ----------
    series : iterable of TimeSeries
        Of one instrument and channel, from any number of products.

    Returns
    -------
    list of TimeSeries
        One per key, sorted by key.
    """
    groups: dict[tuple[float, ...], list[TimeSeries]] = {}
    for part in series:
        groups.setdefault(part.key, []).append(part)
    return [
        replace(group[0], table=pd.concat([part.table for part in group]).sort_index(kind="stable"))
        for _, group in sorted(groups.items())
    ]


def thin(section: TimeSeries, points: int) -> TimeSeries:
    """Reduce the unflagged profiles of a section to about `points` block means for drawing.

    A block has the mean of its unflagged profiles and the standard error of that mean, as if errors
    were independent between profiles. Blocks do not extend across gaps.

    Parameters
    ----------
    section : TimeSeries
    points : int
        Each gap may add one block.

    Returns
    -------
    TimeSeries
        Unflagged profiles only; block means if there are more than `points`.
    """
    good = np.flatnonzero(section.flag == 0)
    table = section.table.iloc[good]
    if good.size <= points:
        return replace(section, table=table)
    size = -(-good.size // points)
    edges = np.concatenate([np.arange(s.start, s.stop, size) for s in segments(section.time)])
    block = np.searchsorted(edges, good, side="right")
    means = table.groupby(block).mean()
    errors = [name for name in table if str(name).endswith("_standard_error")]
    squares = (table[errors] ** 2).groupby(block)
    # Error of a mean of n independent values: root mean square of their errors / sqrt(n).
    means[errors] = np.sqrt(squares.mean() / squares.count())
    means.index = pd.DatetimeIndex(table.index.to_series().groupby(block).mean())
    return replace(section, table=means)


def require(product: xr.Dataset, dims: Mapping[str, tuple[str, ...]]) -> None:
    """Refuse a product that lacks a variable, or has it with other dimensions.

    Raises
    ------
    ProductError
        Naming the variable and its dimensions.
    """
    for name, expected in dims.items():
        if name not in product.variables:
            raise ProductError("is missing from the product", field=name)
        if product[name].dims != expected:
            raise ProductError(f"has the dims {product[name].dims}, not {expected}", field=name)
    if not np.issubdtype(product["time"].dtype, np.datetime64):
        raise ProductError("does not hold CF times", field="time")


def float_values(product: xr.Dataset, name: str) -> Floats:
    """Return a variable in double precision."""
    return np.asarray(product[name].values, dtype=np.float64)
