"""Images of block means: quantities against time and range or altitude."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.figures import svg
from lidarops.figures.raster import Raster, colour_limits
from lidarops.figures.svg import BAR, BLANK, COLOURS, LEFT, REJECTED, WIDTH, Scale, Sheet, SvgPanel
from lidarops.figures.svg_series import Line, draw_time_ticks, limits, time_scale, values
from lidarops.figures.time_axis import TimeAxis, time_axis

Floats = NDArray[np.float64]

COLUMNS: Final = 780
"""Most columns of block means, about what the eye resolves across a figure."""
ROWS: Final = 200
_STRIPE: Final = 5
"""Width of a stripe over rejected blocks, pixels."""
_BEYOND: Final = 1.2
"""A signal is shown to this many times its reach."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Block means with their position."""

    left: Floats
    """(column,) Start along the time axis."""
    right: Floats
    """(column,) End along the time axis."""
    edges: Floats
    """(row + 1,) Range or altitude, m."""
    mean: Floats
    """(column, row) NaN without a usable value."""
    flagged: NDArray[np.bool_]
    """(column, row) Whether at least half of the block is rejected."""


def grid(raster: Raster, axis: TimeAxis) -> Grid:
    """Cut a raster where noise dominates, and merge its rows to the resolution of a page."""
    full, reach = float(raster.edges[-1]), raster.reach
    cut = raster.shown_to(min(full, _BEYOND * reach) if reach > 0 else full)
    rows = cut.bins.size
    starts = np.arange(0, rows, -(-rows // ROWS))

    def merged(sums: Floats | NDArray[np.float32]) -> Floats:
        return np.add.reduceat(np.asarray(sums, dtype=np.float64), starts, axis=-1)

    used, rejected = merged(cut.used), merged(cut.rejected)
    blocks = cut.profiles[:, None] * merged(cut.bins)[None, :]
    return Grid(
        left=axis.x(cut.start),
        right=axis.x(cut.stop),
        edges=np.append(cut.edges[starts], cut.edges[-1]),
        mean=np.where(used > 0, merged(cut.total) / np.maximum(used, 1.0), np.nan),
        flagged=(rejected > 0) & (2 * rejected >= blocks),
    )


def pixels(blocks: Grid, axis: TimeAxis, width: int, height: int) -> NDArray[np.uint8]:
    """Return the image of a grid, shape (height, width), farthest row on top."""
    first, last = axis.limits
    x = first + (np.arange(width) + 0.5) / width * (last - first)
    column = np.clip(np.searchsorted(blocks.left, x, side="right") - 1, 0, blocks.left.size - 1)
    within = (x >= blocks.left[column]) & (x <= blocks.right[column])
    near, far = blocks.edges[0], blocks.edges[-1]
    along = far - (np.arange(height) + 0.5) / height * (far - near)
    row = np.clip(np.searchsorted(blocks.edges, along, side="right") - 1, 0, blocks.edges.size - 2)
    where = np.ix_(column, row)
    image = np.where(blocks.flagged, REJECTED, _colours(blocks))[where].T
    stripes = (np.arange(height)[:, None] + np.arange(width)[None, :]) // _STRIPE % 2
    image = np.where(image == REJECTED, REJECTED + stripes, image)
    return np.where(within[None, :], image, BLANK).astype(np.uint8)


def _colours(blocks: Grid) -> NDArray[np.int64]:
    ends = colour_limits(blocks.mean[~blocks.flagged])
    if ends is None:
        return np.full(blocks.mean.shape, BLANK)
    low, high = ends
    # On the logarithmic scale, means at or below zero take the lowest colour.
    level = np.clip(np.nan_to_num(blocks.mean, nan=low), low, high)
    share = np.log(level / low) / np.log(high / low)
    steps = 3 + np.rint(share * (COLOURS - 1)).astype(np.int64)
    return np.where(np.isfinite(blocks.mean), steps, BLANK)


def image_sheet(raster: Raster, *, along: str, label: str, key: str) -> tuple[Sheet, str]:
    """Draw a raster, with the background below it if known.

    Parameters
    ----------
    raster : Raster
    along : str
        ``range`` or ``altitude``.
    label : str
        Label of the colour bar.
    key : str
        Unique on the page.

    Returns
    -------
    Sheet
    str
        Description in words.
    """
    axis = time_axis(raster.middle)
    has_background = bool(np.isfinite(raster.background).any())
    blocks = grid(raster, axis)
    sheet = Sheet(height=520 if has_background else 390)
    right = WIDTH - BAR
    near, far = float(blocks.edges[0]) / 1e3, float(blocks.edges[-1]) / 1e3
    upper = SvgPanel(time_scale(axis, right), Scale(near, far, 330, 24))
    sheet.parts.append(f'<rect class="gap" x="{LEFT}" y="24" width="{right - LEFT}" height="306"/>')
    lower = _background(raster, axis, right) if has_background else None
    panels = [upper, lower[0]] if lower else [upper]
    draw_time_ticks(sheet, axis, panels)
    sheet.frame(upper, f"{along} (km)")
    sheet.image(upper, svg.png(pixels(blocks, axis, right - LEFT, 306)))
    _clouds(sheet, upper, axis, raster)
    if lower:
        sheet.frame(lower[0], f"background ({svg.units(raster.background_units)})", at_most=4)
        values(sheet, lower[0], axis, [lower[1]], f"{key}-b")
    ends = colour_limits(blocks.mean[~blocks.flagged])
    if ends is None:
        sheet.text((LEFT + right) / 2, 180, "no usable value above zero", css="t m s")
    else:
        _bar(sheet, ends, label, right)
    return sheet, _in_words(raster, blocks, ends, along)


def _background(raster: Raster, axis: TimeAxis, right: float) -> tuple[SvgPanel, Line]:
    middle, empty = raster.middle, np.array([])
    line = Line("", middle, raster.background, raster.background_error, middle[:0], empty)
    return SvgPanel(time_scale(axis, right), Scale(*limits([line]), 470, 356)), line


def _clouds(sheet: Sheet, panel: SvgPanel, axis: TimeAxis, raster: Raster) -> None:
    x, y = panel.x(axis.x(raster.middle)), panel.y(raster.clouds / 1e3)
    low, high = panel.y.ends
    shown = (raster.clouds / 1e3 >= low) & (raster.clouds / 1e3 <= high)
    sheet.path(
        svg.marks(x[shown], y[shown], lambda a, b: f"M{a - 5:.1f} {b - 8:.1f}h10l-5 8z"), "cloud"
    )


def _bar(sheet: Sheet, ends: tuple[float, float], label: str, right: float) -> None:
    left = right + 14
    ramp = np.repeat(np.arange(COLOURS + 2, 2, -1, dtype=np.uint8)[:, None], 4, axis=1)
    panel = SvgPanel(Scale(0, 1, left, left + 14), Scale(*ends, 330, 24, log=True))
    sheet.image(panel, svg.png(ramp))
    for value in panel.y.ticks():
        y = float(panel.y(value))
        sheet.path(f"M{left + 14:.1f} {y:.1f}h4", "axis")
        sheet.text(left + 21, y + 4, svg.number(float(f"{value:.2g}")), css="t")
    sheet.text(WIDTH - 6, 177, label, css="t m s", turned=True)


def _in_words(raster: Raster, blocks: Grid, ends: tuple[float, float] | None, along: str) -> str:
    far = float(blocks.edges[-1]) / 1e3
    words = [f"Shown to {along} {far:.3g} km"]
    if raster.reach > 0:
        words.append(f"noise dominates beyond {raster.reach / 1e3:.3g} km")
    if ends:
        words.append(f"colour scale from {svg.number(ends[0])} to {svg.number(ends[1])}")
    words.append(f"{np.mean(blocks.flagged):.0%} of the image rejected by quality bits (striped)")
    cloudy = int(np.isfinite(raster.clouds).sum())
    if cloudy:
        words.append(f"cloud base in {cloudy} of {raster.clouds.size} columns (triangles)")
    return "; ".join(words)


def thumbnail(raster: Raster) -> Sheet:
    """Return the image of a raster without axes."""
    width, height = svg.THUMB
    axis = time_axis(raster.middle)
    sheet = Sheet(height=height, width=width, stretched=True)
    panel = SvgPanel(Scale(0, 1, 0, width), Scale(0, 1, height, 0))
    sheet.image(panel, svg.png(pixels(grid(raster, axis), axis, width, height)))
    return sheet
