"""The quality of the values of a product: counts by bit, usable profiles, shares over time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.panels import Axis, Band, Figure, Panel, time_axis
from lidarops.figures.product_names import scalar
from lidarops.figures.time_axis import column_edges, column_starts, days, profile_bounds
from lidarops.figures.wording import named_shares, percent
from lidarops.netcdf.stored_flags import (
    READ_VALUES,
    FlagCounter,
    StoredBit,
    all_bits,
    blocks,
    flags_names,
    quality_bits,
    rejecting_mask,
)
from lidarops.netcdf.variables import QUALITY_FLAG
from lidarops.records import Verdicts
from lidarops.site.paths import CALENDAR_HEIGHT

Floats = NDArray[np.float64]

_COLUMNS: Final = 240
"""Most columns of the figure."""
_NONE: Final = Verdicts(0, 0, 0)
_HEIGHT: Final = 110


@dataclass(frozen=True, slots=True)
class Quality:
    """The quality of the values of a product; all zero for one without flags."""

    verdicts: Verdicts = _NONE
    profiles: int = 0
    available: int = 0
    """Number of profiles with a usable value below a height above the station."""
    bits: tuple[tuple[StoredBit, int], ...] = ()
    """The bits that values carry, with the number of these."""
    figure: Figure | None = None
    """Shares over time; None without flags over time."""

    @property
    def lacking(self) -> str:
        """Why no value is usable: the rejecting bits that most values carry; empty if one is."""
        if self.verdicts.usable or not self.verdicts.values:
            return ""
        rejecting = ((bit.description, count) for bit, count in self.bits if bit.rejects)
        return named_shares(rejecting, self.verdicts.values)


def read_quality(product: xr.Dataset, below: float = CALENDAR_HEIGHT) -> Quality:
    """Return the quality of the values of a product.

    Parameters
    ----------
    product : Dataset
        Of any kind; may be lazy, because flags are read in blocks.
    below : float, optional
        Height above the station, m, below which a profile must have a usable value to count.
    """
    flags = product.variables.get(QUALITY_FLAG)
    if flags is None or not flags.size:
        return Quality()
    bits = all_bits(product)
    rejecting = rejecting_mask(bits)
    counts = FlagCounter(rejecting)
    available, shares, low = 0, [], _low(product, below)
    for block in blocks(flags, READ_VALUES):
        values = np.atleast_1d(quality_bits(block))
        counts.add(values)
        rejected = (values & rejecting) != 0
        seen = ~rejected[:, low] if values.ndim > 1 else ~rejected
        available += int(np.count_nonzero(seen.reshape(len(values), -1).any(axis=1)))
        parts = (part.reshape(len(values), -1) for part in (values == 0, rejected))
        shares.append([part.mean(axis=1) for part in parts])
    for name in flags_names(product)[1:]:
        for block in blocks(product.variables[name], READ_VALUES):
            counts.add(quality_bits(block))
    over_time = np.concatenate(shares, axis=1)
    time = product.variables.get("time") if flags.dims[:1] == ("time",) else None
    return Quality(
        counts.verdicts,
        over_time.shape[1],
        available,
        tuple((bit, counts.carried[bit.mask]) for bit in bits if bit.mask in counts.carried),
        _figure(product, over_time) if time is not None and time.dtype.kind == "M" else None,
    )


def _low(product: xr.Dataset, below: float) -> NDArray[np.bool_] | slice:
    """Return which places of a profile are below a height above the station; all if unknown."""
    ground = {"altitude": scalar(product, "station_altitude"), "range": 0.0}
    for name, start in ground.items():
        along = product.variables.get(name)
        dims = product.variables[QUALITY_FLAG].dims[1:]
        if start is not None and along is not None and along.dims == dims:
            return np.asarray(along.values.astype(np.float64) - start <= below)
    return slice(None)


def _figure(product: xr.Dataset, shares: Floats) -> Figure:
    """Return a figure of the shares of good values, values to use with care, and others.

    Parameters
    ----------
    product : Dataset
    shares : ndarray, shape (2, time)
        Of good values, and of rejected ones.
    """
    order = np.argsort(product.variables["time"].values, kind="stable")
    start, stop = (edge[order] for edge in profile_bounds(product))
    columns = column_starts(start, stop, -(-order.size // _COLUMNS))
    profiles = np.diff([*columns, order.size])
    good, rejected = np.add.reduceat(shares[:, order], columns, axis=1) / profiles
    left, right = column_edges(start, stop, columns)
    # An area of its own for each column, so that nothing is drawn where nothing was measured.
    along = np.insert(np.stack([days(left), days(right)], axis=-1), 2, np.nan, axis=1).ravel()
    good, usable = (np.repeat(100.0 * part, 3) for part in (good, np.maximum(1.0 - rejected, good)))
    layers = (
        Band(along, np.zeros(along.size), good, "full good", label="good"),
        Band(along, good, usable, "full care", label="use with care"),
        Band(along, usable, np.full(along.size, 100.0), "full reject", label="do not use"),
    )
    panel = Panel(time_axis(left, right), Axis("values (%)", 0.0, 100.0), layers, _HEIGHT)
    mean = shares.mean(axis=1)
    words = (
        f"On average {percent(mean[0])} of the values good,"
        f" {percent(max(0.0, 1.0 - mean.sum()))} to use with care, {percent(mean[1])} not to use"
    )
    return Figure("Quality over time", words, (panel,))
