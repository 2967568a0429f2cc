"""The figure of quality over time: shares of good values, of those to use with care, of others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.panels import Axis, Band, Figure, Panel, time_axis
from lidarops.figures.time_axis import Times, column_edges, column_starts, days, profile_bounds
from lidarops.figures.wording import percent
from lidarops.netcdf.stored_flags import (
    READ_VALUES,
    bits_of,
    blocks,
    quality_bits,
    rejecting_mask,
)
from lidarops.netcdf.variables import QUALITY_FLAG

Floats = NDArray[np.float64]

_COLUMNS: Final = 240
"""Most columns."""
_HEIGHT: Final = 110


@dataclass(frozen=True, slots=True)
class QualityOverTime:
    """Shares of the values of a product by quality, over time."""

    start: Times
    """(column,) UTC."""
    stop: Times
    good: Floats
    """(column,) Share of values without a bit."""
    rejected: Floats
    """(column,) Share of values not to use."""
    profiles: NDArray[np.int64]
    """(column,) Number of profiles."""

    def mean(self, share: Floats) -> float:
        """Return the share of all values, as all profiles have equally many."""
        return float(np.average(share, weights=self.profiles))


def read_quality(product: xr.Dataset) -> QualityOverTime | None:
    """Return the quality of a product over time; None without flags over time.

    Parameters
    ----------
    product : Dataset
        Of any kind; may be lazy, because flags are read in blocks.
    """
    if QUALITY_FLAG not in product or product[QUALITY_FLAG].dims[:1] != ("time",):
        return None
    flags = product[QUALITY_FLAG]
    if flags.size == 0 or product["time"].dtype.kind != "M":
        return None
    order = np.argsort(product["time"].values, kind="stable")
    start, stop = (edge[order] for edge in profile_bounds(product))
    rejecting = rejecting_mask(bits_of(product))
    shares = []
    for block in blocks(flags, READ_VALUES):
        bits = quality_bits(block).reshape(block.sizes["time"], -1)
        shares.append([(bits == 0).mean(axis=1), ((bits & rejecting) != 0).mean(axis=1)])
    of_profiles = np.concatenate(shares, axis=1)[:, order]
    columns = column_starts(start, stop, -(-order.size // _COLUMNS))
    profiles = np.diff([*columns, order.size])
    good, rejected = np.add.reduceat(of_profiles, columns, axis=1) / profiles
    return QualityOverTime(*column_edges(start, stop, columns), good, rejected, profiles)


def quality_figure(quality: QualityOverTime) -> Figure:
    """Return a figure of the shares of good values, values to use with care, and others."""
    x = np.stack([days(quality.start), days(quality.stop)], axis=-1)
    # An area of its own for each column, so that nothing is drawn where nothing was measured.
    along = np.insert(x, 2, np.nan, axis=1).ravel()

    def steps(share: Floats) -> Floats:
        return np.repeat(100.0 * share, 3)

    usable = np.maximum(steps(1.0 - quality.rejected), steps(quality.good))
    good, none, whole = steps(quality.good), np.zeros(along.size), np.full(along.size, 100.0)
    layers = (
        Band(along, none, good, "full good", label="good"),
        Band(along, good, usable, "full care", label="use with care"),
        Band(along, usable, whole, "full reject", label="do not use"),
    )
    y = Axis("values (%)", 0.0, 100.0)
    mean = quality.mean(quality.good), quality.mean(quality.rejected)
    words = (
        f"On average {percent(mean[0])} of the values good,"
        f" {percent(max(0.0, 1.0 - sum(mean)))} to use with care, {percent(mean[1])} not to use"
    )
    axis = time_axis(quality.start, quality.stop)
    return Figure("Quality over time", words, (Panel(axis, y, layers, _HEIGHT),))
