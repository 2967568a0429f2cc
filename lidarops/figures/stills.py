"""Figures as files: PNG, SVG or PDF, by matplotlib, which is imported only here."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
from matplotlib import colormaps, dates, rc_context
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import LogFormatter

from lidarops.figures.panels import (
    BLANK,
    COLOURS,
    DASHES,
    FIRST,
    Axis,
    Band,
    Curve,
    Figure,
    Image,
    Layer,
    Panel,
    number,
)
from lidarops.figures.wording import visible

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WIDTH: Final = 9.6
"""Width of a figure, inches."""
_INCH: Final = 100.0
"""Units of the height of a panel in an inch."""
_ROOM: Final = 0.9
"""Height of the labels of a panel, inches."""
_SCREEN: Final = 150
"""Dots per inch."""
_UNDATED: Final = {
    ".png": {"Software": None},
    ".svg": {"Date": None},
    ".pdf": {"CreationDate": None},
}
"""Metadata that would make equal figures differ."""
_COLOURS: Final = colormaps["viridis"]
_STYLE: Final[dict[str, Any]] = {
    "svg.hashsalt": "lidarops",
    # Dollar signs of names of files are no formulas.
    "text.parse_math": False,
    "font.size": 9.0,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": COLOURS["grid"][0],
    "axes.edgecolor": COLOURS["soft"][0],
    "axes.spines.top": False,
    "legend.frameon": False,
}


def still(figure: Figure, suffix: str) -> bytes:
    """Return a figure as a file of a type: one of `_UNDATED`. Equal figures give equal bytes."""
    panels = figure.panels
    with rc_context(rc=cast("Any", _STYLE)):
        heights = [panel.height / _INCH for panel in panels]
        tall = max(heights) + _ROOM if figure.beside else sum(heights) + _ROOM + 0.3 * len(panels)
        canvas = Canvas(figsize=(_WIDTH, tall), dpi=_SCREEN, layout="constrained")
        shape = (1, len(panels)) if figure.beside else (len(panels), 1)
        ratios = {} if figure.beside else {"height_ratios": heights}
        every = canvas.subplots(*shape, squeeze=False, gridspec_kw=ratios).ravel()
        seen: set[str] = set()
        for place, (axes, panel) in enumerate(zip(every, panels, strict=True)):
            last = figure.beside or place + 1 == len(panels) or panels[place + 1].x != panel.x
            _draw(canvas, axes, panel, seen, labelled=last)
        canvas.suptitle(visible(figure.caption), fontsize=10)
        out = io.BytesIO()
        canvas.savefig(out, format=suffix.removeprefix("."), metadata=_UNDATED[suffix])
    return out.getvalue()


def _draw(canvas: Canvas, axes: Axes, panel: Panel, seen: set[str], *, labelled: bool) -> None:
    """Draw a panel; `seen` are the labels that earlier panels have in their legends."""
    for layer in panel.layers:
        _layer(axes, layer)
    axes.set(xlim=(panel.x.low, panel.x.high), xscale="log" if panel.x.log else "linear")
    axes.set(ylim=(panel.y.low, panel.y.high), yscale="log" if panel.y.log else "linear")
    if panel.x.time:
        locator = dates.AutoDateLocator()  # type: ignore[no-untyped-call]
        axes.xaxis.set_major_locator(locator)
        words = dates.ConciseDateFormatter(locator)  # type: ignore[no-untyped-call]
        axes.xaxis.set_major_formatter(words)
    _name_ticks(axes.xaxis, panel.x)
    _name_ticks(axes.yaxis, panel.y)
    axes.tick_params(labelbottom=labelled)
    axes.set_ylabel(visible(panel.y.label))
    axes.set_xlabel(visible(panel.x.label) if labelled else "")
    if panel.to_scale:
        axes.set_aspect("equal")
    if panel.bar is not None:
        _bar(canvas, axes, panel.bar)
    _legend(axes, seen)


class _Numbers(LogFormatter):
    """Labels of logarithmic axes, as texts write numbers: those of matplotlib are formulas."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return number(x) if super().__call__(x, pos) else ""


def _name_ticks(drawn: Any, axis: Axis) -> None:
    if axis.log:
        drawn.set_major_formatter(_Numbers())
        drawn.set_minor_formatter(_Numbers())


def _legend(axes: Axes, seen: set[str]) -> None:
    shown = zip(*axes.get_legend_handles_labels(), strict=True)
    new = {words: handle for handle, words in shown if words not in seen}
    seen.update(new)
    if new:
        axes.legend(
            new.values(), new.keys(), loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2,
            fontsize=8, borderaxespad=0.2,
        )  # fmt: skip


def _bar(canvas: Canvas, axes: Axes, bar: Axis) -> None:
    norm = LogNorm(bar.low, bar.high) if bar.log else Normalize(bar.low, bar.high)
    shown = ScalarMappable(norm, _COLOURS)
    drawn = canvas.colorbar(shown, ax=axes, label=visible(bar.label), pad=0.02, aspect=25)
    _name_ticks(drawn.ax.yaxis, bar)


def _layer(axes: Axes, layer: Layer) -> None:
    match layer:
        case Image():
            _image(axes, layer)
        case Band():
            _band(axes, layer)
        case Curve():
            style = _style(layer.style)
            if not layer.joined:
                style["linestyle"] = "none"
            face = "none" if "hollow" in layer.style.split() else style["color"]
            style |= {"marker": layer.mark or "none", "label": visible(layer.label)}
            style["markersize"] = 4
            style["markerfacecolor"] = "white" if layer.style == "cloud" else face
            axes.plot(layer.x, layer.y, **style)
        case _:
            for x, y, words in zip(layer.x, layer.y, layer.texts, strict=True):
                axes.annotate(visible(words), (x, y), (6, 5), textcoords="offset points")


def _style(words: str) -> dict[str, Any]:
    """Return what a style means to matplotlib."""
    parts = words.split()
    colour = next((COLOURS[part][0] for part in parts if part in COLOURS), COLOURS["ink"][0])
    dash = next((DASHES[part] for part in parts if part in DASHES), None)
    width = 1.8 if "thick" in parts else 0.8 if "thin" in parts else 1.2
    return {"color": colour, "linewidth": width, "linestyle": (0, dash) if dash else "-"}


def _band(axes: Axes, band: Band) -> None:
    colour, parts = _style(band.style)["color"], band.style.split()
    if band.bars:
        axes.vlines(band.along, band.low, band.high, colour, linewidth=0.8, alpha=0.6)
        return
    fill = axes.fill_betweenx if band.upright else axes.fill_between
    alpha = 1.0 if "full" in parts else 0.16 if "wide" in parts else 0.28
    good = np.isfinite(band.low + band.high)
    label = visible(band.label)
    fill(band.along, band.low, band.high, good, color=colour, alpha=alpha, linewidth=0, label=label)


def _image(axes: Axes, image: Image) -> None:
    """Draw an image: between its columns, those of gaps are blank."""
    scale = _COLOURS(np.linspace(0.0, 1.0, 256 - FIRST))
    greys = [(0, 0, 0, 0), COLOURS["reject"][0], COLOURS["negative"][0]]
    codes = np.full((image.codes.shape[1], 2 * image.left.size - 1), BLANK, dtype=np.uint8)
    codes[:, ::2] = image.codes.T
    edges = np.maximum.accumulate(np.stack([image.left, image.right], axis=-1).ravel())
    colours = ListedColormap([*greys, *scale])
    axes.pcolormesh(
        edges, image.edges, codes, cmap=colours, vmin=-0.5, vmax=255.5, rasterized=True, zorder=1
    )
