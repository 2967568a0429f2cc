"""Series over time of the quantities of a product.

Also checks and reads variables of any product.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import ProductError
from lidarops.figures.time_axis import Times, segments

Floats = NDArray[np.float64]
_TOGETHER: Final = 64
"""Series that are joined before more are read, because short arrays take more memory."""


@dataclass(frozen=True, slots=True, eq=False)
class TimeSeries:
    """The quantities of one series over time."""

    time: Times
    """(time,) Middles of profiles, UTC, rising."""
    quantities: Mapping[str, Floats]
    """(time,) Each quantity, and its ``_standard_error``."""
    flag: NDArray[np.int64]
    """(time,) Bits of the kind."""
    rejecting: int
    """Union of the bits of the kind that reject a value."""
    label: str = ""
    """Name in legends."""
    key: tuple[float, ...] = ()
    """Identity and place among the series of a product: bounds in m, or a number."""

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """(time,) Whether a quality bit rejects the value."""
        return np.asarray((self.flag & self.rejecting) != 0)

    def at(self, places: NDArray[np.intp]) -> TimeSeries:
        """Return the series at some of its times."""
        values = {name: value[places] for name, value in self.quantities.items()}
        return replace(self, time=self.time[places], quantities=values, flag=self.flag[places])


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
        group = groups.setdefault(part.key, [])
        group.append(part)
        if len(group) == _TOGETHER:
            group[:] = [_joined(group)]
    joined = (_joined(group) for _, group in sorted(groups.items()))
    return [one.at(np.argsort(one.time, kind="stable")) for one in joined]


def _joined(group: Sequence[TimeSeries]) -> TimeSeries:
    first = group[0]
    return replace(
        first,
        time=np.concatenate([part.time for part in group]),
        quantities={
            name: np.concatenate([part.quantities[name] for part in group])
            for name in first.quantities
        },
        flag=np.concatenate([part.flag for part in group]),
    )


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
    known = section.at(good)
    if good.size <= points:
        return known
    size = -(-good.size // points)
    edges = np.concatenate([np.arange(s.start, s.stop, size) for s in segments(section.time)])
    block = np.searchsorted(edges, good, side="right")
    table = pd.DataFrame(dict(known.quantities), index=known.time)
    means = table.groupby(block).mean()
    errors = [name for name in table if str(name).endswith("_standard_error")]
    squares = (table[errors] ** 2).groupby(block)
    # Error of a mean of n independent values: root mean square of their errors / sqrt(n).
    means[errors] = np.sqrt(squares.mean() / squares.count())
    middles = pd.DatetimeIndex(table.index.to_series().groupby(block).mean())
    values = {name: np.asarray(means[name]) for name in known.quantities}
    flags = np.zeros(len(means), np.int64)
    return replace(known, time=np.asarray(middles), quantities=values, flag=flags)


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
        found = product.variables[name].dims
        if found != expected:
            raise ProductError(f"has the dims {found}, not {expected}", field=name)
    if not np.issubdtype(product.variables["time"].dtype, np.datetime64):
        raise ProductError("does not hold CF times", field="time")


def float_values(product: xr.Dataset, name: str) -> Floats:
    """Return a variable in double precision."""
    return np.asarray(product.variables[name].values, dtype=np.float64)
