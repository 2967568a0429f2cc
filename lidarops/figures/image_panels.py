"""Panels of images: a quantity against time and range or altitude, and the background below."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.figures import pixels
from lidarops.figures.panels import (
    Axis,
    Curve,
    Figure,
    Image,
    Mark,
    Panel,
    finite,
    number,
    time_panel_axis,
    units,
)
from lidarops.figures.raster import COLUMNS, Raster, colour_limits, share_with_care
from lidarops.figures.series_panels import Quantity, background_panel
from lidarops.figures.time_axis import TimeAxis, time_axis
from lidarops.figures.wording import percent
from lidarops.flags import Quality, Severity

Floats = NDArray[np.float64]

_HEIGHT: Final = 306
"""Height of a panel in units of the figure, and of its image in pixels."""
_BEYOND: Final = 1.2
"""A signal is shown to this many times its reach."""
_UPRIGHT: Final = 0.05
"""Change of altitude with range, below which altitude is no useful axis."""


def image_figure(rasters: Sequence[Raster], what: str, along: str) -> Figure:
    """Return a quantity against time and `along`, ``range`` or ``altitude``.

    Parameters
    ----------
    rasters : sequence of Raster
        At least one, of one instrument and channel.
    what : str
        Name of the quantity.
    along : str

    Returns
    -------
    Figure
        Block means on a logarithmic colour scale, up to the range where noise dominates. Rejected
        bins are striped, gaps empty, triangles mark the lowest cloud bases.
    """
    axis = time_axis(np.unique(np.concatenate([raster.middle for raster in rasters])))
    x = time_panel_axis(axis)
    full = max(float(raster.edges[-1]) for raster in rasters)
    reach = max(raster.reach for raster in rasters)
    far = min(full, _BEYOND * reach) if reach > 0 else full
    shown = [raster.shown_to(far) for raster in rasters]
    near = min(float(raster.edges[0]) for raster in shown)
    far = max(float(raster.edges[-1]) for raster in shown)
    ends = colour_limits(np.concatenate([r.mean[~r.flagged] for r in shown], axis=None))
    image = np.full((_HEIGHT, COLUMNS), pixels.BLANK, dtype=np.uint8)
    for raster in shown:
        _fill(image, raster, axis, (near, far), ends)
    y = Axis(f"{along} (km)", near / 1e3, far / 1e3)
    label = f"{what} ({units(rasters[0].units)})"
    main = Panel(
        x,
        y,
        (Image(pixels.striped(image)), *_clouds(rasters, axis)),
        height=_HEIGHT,
        right=_altitude(rasters, y),
        bar=Axis(label, *ends, log=True) if ends else None,
        note="" if ends else "no usable value above zero",
    )
    lower = _background(rasters, x, axis)
    below = ", with the background below" if lower else ""
    caption = f"{what[:1].upper()}{what[1:]} against time and {along}{below}"
    words = _in_words(rasters, shown, reach, ends, along)
    return Figure(caption, words, (main, *lower))


def _fill(
    image: NDArray[np.uint8],
    raster: Raster,
    axis: TimeAxis,
    span: tuple[float, float],
    ends: tuple[float, float] | None,
) -> None:
    """Fill the pixels that lie in a raster; the first row of the image is the farthest."""
    height, width = image.shape
    first, last = axis.limits
    x = first + (np.arange(width) + 0.5) / width * (last - first)
    along = span[1] - (np.arange(height) + 0.5) / height * (span[1] - span[0])
    left, right = axis.x(raster.start), axis.x(raster.stop)
    column = np.searchsorted(left, x, side="right") - 1
    row = np.searchsorted(raster.edges, along, side="right") - 1
    across = np.flatnonzero((column >= 0) & (x <= right[column]))
    up = np.flatnonzero((row >= 0) & (row < raster.edges.size - 1))
    mean = raster.mean
    if ends is None:
        shares = np.full(mean.shape, np.nan)
    else:
        # On the logarithmic scale, means at or below zero take the lowest colour.
        low, high = ends
        shares = np.log(np.clip(mean, low, high) / low) / np.log(high / low)
    blocks = np.where(raster.flagged, pixels.REJECTED, pixels.steps(shares)).astype(np.uint8)
    image[np.ix_(up, across)] = blocks[np.ix_(column[across], row[up])].T


def _clouds(rasters: Sequence[Raster], axis: TimeAxis) -> list[Curve]:
    base = np.concatenate([raster.clouds for raster in rasters]) / 1e3
    time = np.concatenate([raster.middle for raster in rasters])
    if not np.isfinite(base).any():
        return []
    label = "base of the lowest cloud or dense layer"
    return [Curve(axis.x(time), base, "cloud", Mark.DOWN, joined=False, label=label)]


def _altitude(rasters: Sequence[Raster], y: Axis) -> Axis | None:
    lines = {raster.altitude for raster in rasters}
    line = lines.pop() if len(lines) == 1 else None
    if line is None or abs(line[1]) < _UPRIGHT:
        return None
    low, high = (line[0] / 1e3 + line[1] * end for end in (y.low, y.high))
    return Axis("altitude (km)", low, high)


def _background(rasters: Sequence[Raster], x: Axis, axis: TimeAxis) -> tuple[Panel, ...]:
    time = np.concatenate([raster.middle for raster in rasters])
    order = np.argsort(time, kind="stable")
    level = np.concatenate([raster.background for raster in rasters])[order]
    error = np.concatenate([raster.background_error for raster in rasters])[order]
    if not finite([level]).size:
        return ()
    quantity = Quantity("background", 1.0, units(rasters[0].background_units))
    return (background_panel(x, axis, quantity, time[order], level, error),)


def _in_words(
    rasters: Sequence[Raster],
    shown: Sequence[Raster],
    reach: float,
    ends: tuple[float, float] | None,
    along: str,
) -> str:
    far = max(float(raster.edges[-1]) for raster in shown)
    words = [f"Shown to {along} {far / 1e3:.3g} km"]
    if reach > 0:
        words.append(f"noise dominates beyond {reach / 1e3:.3g} km")
    if ends:
        words.append(f"colour scale from {number(ends[0])} to {number(ends[1])}")
    bits = sorted({bit for raster in rasters for bit in raster.bits})
    names = {
        severity: ", ".join(
            b.word for b in bits if b.severity is severity and b.word != Quality.INPUT_MISSING.word
        )
        for severity in Severity
    }
    flagged = np.concatenate([raster.flagged for raster in shown], axis=None).mean()
    if flagged:
        words.append(f"striped, {percent(float(flagged))}: flagged {names[Severity.REJECT]}")
    care = share_with_care(rasters)
    if care:
        words.append(f"{percent(care)} of all bins: use with care ({names[Severity.CARE]})")
    clouds = np.concatenate([raster.clouds for raster in rasters])
    if np.isfinite(clouds).any():
        known = int(np.isfinite(clouds).sum())
        words.append(f"cloud base in {known} of {clouds.size} columns (triangles)")
    return "; ".join(words)
