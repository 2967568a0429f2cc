"""Figures that several kinds of product share, and their conversion to PNG files.

Figures are built from `matplotlib.figure.Figure` directly, without the global state of matplotlib,
so that any thread may draw. Times are UTC. `alt_text` describes a figure in words.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lidarops.figures import panels
from lidarops.figures.kind_figures import ReportFigure
from lidarops.figures.kind_images import KindImage
from lidarops.figures.raster import Raster
from lidarops.figures.report_sources import Group, Sources
from lidarops.figures.series_data import TimeSeries
from lidarops.figures.time_axis import Times, time_axis
from lidarops.figures.wording import counted, percent, visible

DPI: Final = 150


def draw_image(
    rasters: Sequence[Raster],
    *,
    title: str = "",
    what: str = "range-corrected signal",
    along: str = "range",
) -> Figure:
    """Draw a quantity against time and range or altitude, and the background below if known.

    Parameters
    ----------
    rasters : sequence of Raster
        At least one, of one instrument and channel.
    title : str, optional
    what : str, optional
        Name of the quantity.
    along : {"range", "altitude"}, optional

    Returns
    -------
    Figure
        Block means on a logarithmic colour scale, up to the range where noise dominates. Rejected
        bins are black, gaps white, triangles mark the lowest cloud bases.
    """
    below = any(np.isfinite(raster.background).any() for raster in rasters)
    figure, panel_stack = stack((3.9, 1.2) if below else (3.9,), title)
    axis = time_axis(middles(rasters))
    label = what.replace(" ", "\n", 1)
    words = panels.image(figure, panel_stack[0], axis, rasters, label, along)
    if below:
        panels.background(panel_stack[1], axis, rasters)
    panels.time_ticks(panel_stack, axis)
    also = ", and background" if below else ""
    return described(figure, f"{title}: {what} against time and {along}{also}. {words}.")


def image_figures(
    image: KindImage, caption: str, group: Group, sources: Sources
) -> Iterator[ReportFigure]:
    """Yield the figure of the image of a group of products, if any can be read."""
    rasters = sources.rasters(group, image.variables, image.read)
    if rasters:
        yield ReportFigure(
            group.kind,
            f"{caption}: {group.label}; {counted(len(rasters), 'scene')}.",
            functools.partial(draw_image, what=image.what, along=image.along),
            rasters,
        )


def draw_series(
    series: Sequence[TimeSeries],
    quantities: Sequence[str],
    *,
    title: str = "",
    heights: Sequence[float] = (3.0, 2.2),
) -> tuple[Figure, list[Axes]]:
    """Draw quantities of series against time, one panel each.

    Parameters
    ----------
    series : sequence of TimeSeries
        One to `panels.SECTIONS`, of one instrument and channel, joined in time.
    quantities : sequence of str
    title : str, optional
    heights : sequence of float, optional
        Of the panels, in inches.

    Returns
    -------
    Figure
        Unflagged values of each series with 1-sigma bars or a band, rejected values as hollow
        grey crosses, the truth as a black dashed line. Extinction in km-1. To be `described`.
    list of Axes
    """
    axis = time_axis(times(series))
    figure, panel_stack = stack(heights, title)
    for panel, quantity in zip(panel_stack, quantities, strict=True):
        panels.estimates(panel, axis, series, quantity)
    panels.time_ticks(panel_stack, axis)
    for panel in panel_stack:
        panels.legend(panel, other=None if panel is panel_stack[0] else panel_stack[0])
    return figure, panel_stack


def flags_overview(shares: Mapping[str, Mapping[str, float]], *, title: str = "") -> Figure:
    """Draw the share of values that carry each quality bit, by product.

    Parameters
    ----------
    shares : mapping
        Label of a product -> name of a bit, with * where it asks for care -> share of its values,
        0 to 1. At least one product. Bits are shown in the order of their first product.
    title : str, optional

    Returns
    -------
    Figure
        A shaded table of percentages; only bits that occur.
    """
    named = dict.fromkeys(bit for share in shares.values() for bit in share)
    bits = [bit for bit in named if any(share.get(bit, 0.0) > 0 for share in shares.values())]
    labels = [" ".join(visible(label).split()) for label in shares]
    width = 1.5 + 0.085 * max(len(label) for label in labels) + 0.8 * max(len(bits), 5)
    figure = Figure(figsize=(width, 1.9 + 0.32 * len(labels)), dpi=DPI, layout="constrained")
    panel = figure.subplots()
    panels.title(figure, title)
    if not bits:
        panel.set_axis_off()
        panels.nothing(panel, "no value of any product carries a quality bit")
        return described(figure, f"{title}: no value carries a quality bit.")
    values = np.array([[share.get(bit, 0.0) for bit in bits] for share in shares.values()])
    panel.imshow(values, cmap="Blues", vmin=0.0, vmax=1.3, aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        ink = "white" if value > 0.8 else panels.INK if value > 0 else panels.GREY
        panel.text(column, row, percent(value), ha="center", va="center", fontsize=8.5, color=ink)
    panel.set_xticks(range(len(bits)), bits, rotation=30, ha="right", fontsize=9)
    panel.set_yticks(range(len(labels)), labels, fontsize=9, parse_math=False)
    panel.tick_params(length=0)
    panel.spines[:].set_visible(False)
    panel.set_xlabel("share of values; bits with *: use with care, others: do not use")
    row, column = np.unravel_index(int(values.argmax()), values.shape)
    return described(
        figure,
        f"{title}: share of values by quality bit. The largest share is"
        f" {percent(values[row, column])}, {bits[column].removesuffix(' *')} in {labels[row]}.",
    )


@dataclass(frozen=True, slots=True)
class Sketch:
    """A figure to draw. Can be pickled, for another process."""

    draw: Callable[..., Figure]
    """Called with the content and the title."""
    content: object
    title: str


@dataclass(frozen=True, slots=True)
class Rendered:
    """A figure as a PNG file with its description."""

    png: bytes
    alt: str
    """Description in words."""


def render(figure: Figure) -> Rendered:
    """Convert a figure to PNG with its description; equal figures give equal bytes."""
    buffer = io.BytesIO()
    alt = alt_text(figure)
    FigureCanvasAgg(figure)
    figure.savefig(
        buffer,
        format="png",
        metadata={"Software": None, "Description": alt},
        # Higher levels save at most 4 % of size and cost 8 % of the drawing time.
        pil_kwargs={"compress_level": 3},
    )
    return Rendered(buffer.getvalue(), alt)


def draw_figure(_: object, sketch: Sketch) -> Rendered:
    """Draw and render a sketch; the first argument (data of the process) is not used."""
    return render(sketch.draw(sketch.content, title=sketch.title))


def alt_text(figure: Figure) -> str:
    """Return the description of a figure in words."""
    return str(figure.get_label())


def stack(heights: Sequence[float], title: str) -> tuple[Figure, list[Axes]]:
    """Return a figure with panels above each other that share a time axis; heights in inches."""
    figure = Figure(figsize=(10.0, 1.1 + sum(heights)), dpi=DPI, layout="constrained")
    axes = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)
    panels.title(figure, title)
    return figure, list(axes[:, 0])


def described(figure: Figure, words: str) -> Figure:
    """Return a figure with its description, which `alt_text` returns."""
    figure.set_label(visible(words))
    return figure


def times(series: Sequence[TimeSeries]) -> Times:
    """Return all times of series."""
    return np.unique(np.concatenate([part.time for part in series]))


def middles(rasters: Sequence[Raster]) -> Times:
    """Return the times of all columns of rasters, which may be none."""
    columns = [raster.middle for raster in rasters]
    return np.unique(np.concatenate([*columns, np.array([], dtype="datetime64[ns]")]))
