"""Draws figures as SVG text.

Text and lines are sharp, colours adapt to light and dark mode, and drawing takes milliseconds.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from lidarops.figures import pixels
from lidarops.figures.panels import (
    Axis,
    Band,
    Curve,
    Figure,
    Image,
    Layer,
    Mark,
    Palette,
    Panel,
    Words,
    number,
)
from lidarops.figures.wording import visible

Floats = NDArray[np.float64]

WIDTH: Final = 960
"""Width of a figure in its own units."""
NARROW: Final = 460
"""Width of a figure for a telephone, whose letters are then of about the size of text."""
THUMB: Final = (240, 84)
"""Width and height of a thumbnail."""
_LEFT: Final = 74
_LETTER: Final = 6.9
"""Mean width of a letter."""
_LINE: Final = 18
"""Height of a line of text."""
_BAR: Final = 110
"""Space for a colour bar."""
_RIGHT: Final = 72
"""Space for an axis at the right, with labels of four characters."""
_EDGE: Final = 18
"""Least space at the right of a panel."""
_BETWEEN: Final = 72
"""Space between panels side by side, for the labels of an axis."""
_LOWER: Final = 0.6
"""Height of panels that are below each other in a narrow figure, but side by side in a wide one."""
_TICK: Final = 16
"""Least space between the labels of ticks along the horizontal axis of a narrow figure."""
_FEWEST_TICKS: Final = 2
"""Without a second tick an axis has no scale."""
_NARROW_PIXELS: Final = 390
"""Most columns of an image in a narrow figure."""
_FEW: Final = 150
"""Most points of a curve in a thumbnail."""

Place = Callable[[Floats], Floats]


@dataclass(frozen=True, slots=True)
class _Scale:
    """Maps values to positions along an axis."""

    axis: Axis
    start: float
    """Position of the low end."""
    stop: float

    def __call__(self, values: Floats | float) -> Floats:
        """Return positions, clipped at one axis length outside the ends."""
        low, high, along = self.axis.low, self.axis.high, np.asarray(values, dtype=np.float64)
        if self.axis.log:
            along = np.log(np.where(along > 0, along, np.nan))
            low, high = np.log(low), np.log(high)
        return self.start + np.clip((along - low) / (high - low), -1.0, 2.0) * (
            self.stop - self.start
        )

    def ticks(self, at_most: int) -> list[tuple[float, str]]:
        """Return positions and labels of ticks."""
        labelled = (
            _round_ticks(self.axis, at_most)
            if self.axis.ticks is None
            else [(tick.x, tick.label) for tick in self.axis.ticks]
        )
        return [(float(self(value)), words) for value, words in labelled]


@dataclass(frozen=True, slots=True)
class _Box:
    """The place of a panel in a figure."""

    panel: Panel
    left: float
    top: float
    width: float
    labelled: bool
    """Whether the horizontal axis has labels."""
    legend: tuple[Curve | Band, ...]
    """Layers whose label no earlier panel has."""

    @property
    def foot(self) -> float:
        """Lower edge."""
        return self.top + self.panel.height

    @property
    def x(self) -> _Scale:
        """Horizontal scale."""
        return _Scale(self.panel.x, self.left, self.left + self.width)

    @property
    def y(self) -> _Scale:
        """Vertical scale."""
        return _Scale(self.panel.y, self.foot, self.top)


def inline(figure: Figure) -> Markup:
    """Return a figure as markup for a page whose style includes `style`, wide and narrow.

    The style shows the one that suits the width of the window.
    """
    alt = escape(visible(figure.text))
    parts = []
    for css, width in (("wide", WIDTH), ("narrow", NARROW)):
        content, height = _content(figure, width)
        parts.append(
            f'<svg class="fig {css}" viewBox="0 0 {width} {height:.0f}" role="img"'
            f' aria-label="{alt}">{content}</svg>'
        )
    return Markup("".join(parts))  # noqa: S704 - `text` escapes every text of the content


def file(figure: Figure, width: int = WIDTH) -> bytes:
    """Return a figure as an SVG file."""
    content, height = _content(figure, width)
    return _file(f"<title>{escape(visible(figure.text))}</title>{content}", width, height)


def thumbnail(figure: Figure | None, words: str = "") -> bytes:
    """Return the first panel of a figure without axes as an SVG file; `words` without a figure."""
    width, height = THUMB
    if figure is None:
        return _file(text(width / 2, height / 2 + 5, words, "m s"), width, height)
    panel = figure.panels[0]
    x, y = _Scale(panel.x, 0, width), _Scale(panel.y, height - 4, 4)
    content = "".join(_layer(layer, x, y) for layer in map(_small, panel.layers) if layer)
    stretched = any(isinstance(layer, Image) for layer in panel.layers)
    return _file(content, width, height, ' preserveAspectRatio="none"' if stretched else "")


def _small(layer: Layer) -> Layer | None:
    """Return a layer with few points or pixels; None if a thumbnail does not show it."""
    match layer:
        case Image():
            rows = -(-layer.pixels.shape[0] // THUMB[1])
            return Image(pixels.narrowed(layer.pixels[::rows], THUMB[0]), layer.palette)
        case Curve():
            few = slice(None, None, -(-layer.x.size // _FEW) or 1)
            return Curve(layer.x[few], layer.y[few], layer.style, layer.mark, layer.joined)
    return None


@cache
def style() -> str:
    """Return the style sheet of figures."""
    return Path(__file__).with_name("figure.css").read_text(encoding="utf-8")


def _file(content: str, width: float, height: float, aspect: str = "") -> bytes:
    size = f'width="{width:g}" height="{height:.0f}"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:.0f}" {size}'
        f"{aspect}><style>{style()}</style>{content}</svg>\n"
    ).encode()


def _content(figure: Figure, width: int) -> tuple[str, float]:
    panels, above, beside = figure.panels, figure.above, figure.beside
    if width < WIDTH:
        above = tuple(replace(panel, right=None) for panel in above)
        beside, lower = False, _LOWER if figure.beside else 1.0
        panels = tuple(_narrowed(panel, width, lower) for panel in panels)
    boxes = list(_side_by_side(panels, width) if beside else _stacked(panels, width, above))
    return "".join(map(_panel, boxes)), max(box.foot + _below(box) for box in boxes)


def _narrowed(panel: Panel, width: int, lower: float) -> Panel:
    """Return a panel without its second axis, and with fewer pixels of images."""
    if panel.to_scale:
        left, right = _margins([panel])
        lower = (width - left - right) / (WIDTH - left - right)
    layers = tuple(
        Image(pixels.narrowed(layer.pixels, _NARROW_PIXELS), layer.palette)
        if isinstance(layer, Image)
        else layer
        for layer in panel.layers
    )
    return replace(panel, layers=layers, right=None, height=lower * panel.height)


# Layout --------------------------------------------------------------------------------------


def _margins(panels: Sequence[Panel]) -> tuple[float, float]:
    """Return the space left and right of panels."""
    left = max(_LEFT, *(_label_width(panel) + (31 if panel.y.label else 24) for panel in panels))
    right = _RIGHT * any(panel.right for panel in panels) + _BAR * any(p.bar for p in panels)
    return left, right or _EDGE


def _label_width(panel: Panel) -> float:
    """Return the width of the widest label of the vertical axis of a panel."""
    ticks = _Scale(panel.y, panel.height, 0).ticks(_most_ticks(panel.height))
    return 1.1 * _LETTER * max((len(label) for _, label in ticks), default=0)


def _most_ticks(height: float) -> int:
    """Return the most ticks of a vertical axis."""
    return max(3, round(height / 45))


def _stacked(panels: Sequence[Panel], whole: int, above: Sequence[Panel]) -> Iterator[_Box]:
    left, right = _margins([*panels, *above])
    width = whole - left - right
    y = 0.0
    for place, (panel, legend) in enumerate(zip(panels, _legends(panels), strict=True), 1):
        labelled = place == len(panels) or panels[place].x is not panel.x
        top = y + _above(panel, legend, width)
        box = _Box(panel, left, top, width, labelled, legend)
        yield box
        y = box.foot + _below(box)


def _side_by_side(panels: Sequence[Panel], whole: int) -> Iterator[_Box]:
    left, right = _margins(panels)
    width = (whole - left - right - _BETWEEN * (len(panels) - 1)) / len(panels)
    legends = list(_legends(panels))
    top = max(_above(panel, legend, width) for panel, legend in zip(panels, legends, strict=True))
    for place, (panel, legend) in enumerate(zip(panels, legends, strict=True)):
        yield _Box(panel, left + place * (width + _BETWEEN), top, width, True, legend)  # noqa: FBT003


def _legends(panels: Sequence[Panel]) -> Iterator[tuple[Curve | Band, ...]]:
    """Yield the labelled layers of each panel that no panel before has with the same look."""
    known: set[tuple[object, ...]] = set()
    for panel in panels:
        labelled = {_look(la): la for la in panel.layers if isinstance(la, Curve | Band)}
        yield tuple(la for look, la in labelled.items() if la.label and look not in known)
        known |= labelled.keys()


def _look(layer: Curve | Band) -> tuple[object, ...]:
    """Return what a legend shows of a layer."""
    line = (layer.mark, layer.joined) if isinstance(layer, Curve) else ()
    return layer.label, layer.style, *line


def _above(panel: Panel, legend: Sequence[Curve | Band], width: float) -> float:
    return 12 + _LINE * (len([*_legend_lines(legend, width)]) + bool(panel.title))


def _below(box: _Box) -> float:
    if not box.labelled:
        return 2
    two = any("\n" in tick.label for tick in box.panel.x.ticks or ())
    return 26 + 16 * two + _LINE * bool(box.panel.x.label)


# Axes ----------------------------------------------------------------------------------------


def _panel(box: _Box) -> str:
    panel, height = box.panel, box.panel.height
    grid, edge, words = "", f"M{box.left:.1f} {box.top:.1f}v{height:.1f}h{box.width:.1f}", []
    for y, label in box.y.ticks(_most_ticks(height)):
        grid += f"M{box.left:.1f} {y:.1f}h{box.width:.1f}"
        edge += f"M{box.left:.1f} {y:.1f}h-4"
        words.append(text(box.left - 9, y + 4, label, "e"))
    end = box.left + box.width + _EDGE
    for x, label in _spaced(box.x.ticks(max(2, round(box.width / 110))), end):
        grid += f"M{x:.1f} {box.top:.1f}v{height:.1f}"
        edge += f"M{x:.1f} {box.foot:.1f}v4"
        for row, line in enumerate(label.split("\n") if box.labelled else ()):
            words.append(text(_centre(x, label, end), box.foot + 19 + 16 * row, line, "m"))
    for x in box.x(np.array(panel.x.breaks)).tolist():
        edge += f"M{x - 5:.1f} {box.foot + 5:.1f}l4-10m2 10l4-10"
    middle = box.top + height / 2
    aside = max(56, _label_width(panel) + 20)
    words.append(text(box.left - aside, middle, panel.y.label, "m s", turned=True))
    if box.labelled and panel.x.label:
        below = box.foot + _below(box) - 8
        words.append(text(box.left + box.width / 2, below, panel.x.label, "m s"))
    if panel.note:
        words.append(text(box.left + box.width / 2, middle, panel.note, "m s"))
    layers = [_layer(layer, box.x, box.y) for layer in panel.layers]
    clip = f"{box.left:.1f} {box.top:.1f} {box.width:.1f} {height:.1f}"
    left, top, width, tall = clip.split()
    return (
        f'<path class="gap" d="M{left} {top}h{width}v{tall}h-{width}z"/>'
        * any(isinstance(layer, Image) for layer in panel.layers)
        + f'<path class="grid" d="{grid}"/>'
        # An inner svg element clips what lies outside its rectangle.
        f'<svg x="{left}" y="{top}" width="{width}" height="{tall}" viewBox="{clip}">'
        f'{"".join(layers)}</svg><path class="axis" d="{edge}"/>'
        f"{''.join(words)}{_sides(box)}{_legend(box)}"
    )


def _centre(x: float, label: str, end: float) -> float:
    """Return the middle of the label of a tick at a place, with which it does not pass an end."""
    # Letters of some fonts are wider by a fifth.
    return min(x, end - 1.2 * _half_width(label))


def _spaced(ticks: Sequence[tuple[float, str]], end: float) -> Sequence[tuple[float, str]]:
    """Return every tick, or every second, third, ... so that their labels do not touch."""
    for every in range(1, len(ticks)):
        kept = ticks[::every]
        if all(
            _centre(*after, end) - before[0]
            >= _half_width(before[1]) + _half_width(after[1]) + _TICK / 2
            for before, after in pairwise(kept)
        ):
            return kept
    return ticks[:1]


def _half_width(label: str) -> float:
    return 0.5 * _LETTER * max(map(len, label.split("\n")))


def _sides(box: _Box) -> str:
    """Return the axis at the right of a panel, and its colour bar."""
    x, parts = box.left + box.width, []
    for axis, space in ((box.panel.right, _RIGHT), (box.panel.bar, _BAR)):
        if axis is None:
            continue
        if axis is box.panel.bar:
            x += 14
            palette = next(la.palette for la in box.panel.layers if isinstance(la, Image))
            parts.append(_image(pixels.ramp(), palette, x, box.top, 14, box.panel.height))
            x += 14
        edge = f"M{x:.1f} {box.top:.1f}v{box.panel.height:.1f}"
        for y, label in _Scale(axis, box.foot, box.top).ticks(6):
            edge += f"M{x:.1f} {y:.1f}h4"
            parts.append(text(x + 7, y + 4, label))
        parts.append(f'<path class="axis" d="{edge}"/>')
        middle = box.top + box.panel.height / 2
        across = x + space - (42 if axis is box.panel.bar else 16)
        parts.append(text(across, middle, axis.label, "m s", turned=True))
        x += space - 14 if axis is box.panel.right else 0
    return "".join(parts)


def _legend(box: _Box) -> str:
    lines = [*_legend_lines(box.legend, box.width)]
    y = box.top - 8 - _LINE * (len(lines) - 1)
    parts = [text(box.left, box.top - 8 - _LINE * len(lines), box.panel.title, "b")]
    for row, line in enumerate(lines):
        for x, layer in line:
            at = f"translate({box.left + 14 + x:.1f} {y + _LINE * row - 4:.1f})"
            parts.append(f'<g transform="{at}">{_sample(layer)}</g>')
            parts.append(text(box.left + 28 + x, y + _LINE * row, layer.label, "s"))
    return "".join(parts)


def _legend_lines(
    legend: Sequence[Curve | Band], width: float
) -> Iterator[list[tuple[float, Curve | Band]]]:
    """Yield the lines of a legend: positions and layers."""
    line: list[tuple[float, Curve | Band]] = []
    x = 0.0
    for layer in legend:
        step = 40 + _LETTER * len(layer.label)
        if line and x + step > width:
            yield line
            line, x = [], 0.0
        line.append((x, layer))
        x += step
    if line:
        yield line


def _sample(layer: Curve | Band) -> str:
    ends = np.array([-9.0, 9.0])
    if isinstance(layer, Band):
        return _path("band", layer.style, _band(ends, np.full(2, -4.0), np.full(2, 4.0)))
    line = _path("line", layer.style, _line(ends, np.zeros(2))) if layer.joined else ""
    return line + (_path("mark", layer.style, _MARKS[layer.mark](0, 0)) if layer.mark else "")


def _round_ticks(axis: Axis, at_most: int) -> list[tuple[float, str]]:
    """Return round values and their labels, with equal decimals on a linear axis."""
    if axis.log:
        return [(tick, number(tick)) for tick in _decades(axis.low, axis.high)]
    low, high = min(axis.low, axis.high), max(axis.low, axis.high)
    ticks = round_steps(low, high, at_most)
    while len(ticks) < _FEWEST_TICKS:
        at_most += 1
        ticks = round_steps(low, high, at_most)
    words = [number(tick) for tick in ticks]
    if not any("\N{MULTIPLICATION SIGN}" in text for text in words):
        decimals = max((len(text.partition(".")[2]) for text in words), default=0)
        words = [f"{tick:.{decimals}f}".replace("-", "\N{MINUS SIGN}") for tick in ticks]
    return list(zip(ticks, words, strict=True))


def round_steps(low: float, high: float, at_most: int) -> list[float]:
    """Return multiples of 1, 2, 2.5 or 5 times a power of ten between two values."""
    rough = (high - low) / at_most
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(power * m for m in (1.0, 2.0, 2.5, 5.0, 10.0) if power * m >= rough * (1 - 1e-9))
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    return [float(step * count) for count in range(first, last + 1)]


def _decades(low: float, high: float) -> list[float]:
    first, last = int(np.floor(np.log10(low))), int(np.ceil(np.log10(high)))
    for steps in ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)):
        ticks = [s * 10.0**p for p in range(first, last + 1) for s in steps]
        ticks = [value for value in ticks if low * (1 - 1e-9) <= value <= high * (1 + 1e-9)]
        if len(ticks) >= 3:
            return ticks
    return [low, high]


# Layers --------------------------------------------------------------------------------------


def _layer(layer: Layer, x: _Scale, y: _Scale) -> str:
    match layer:
        case Image():
            top, height = min(y.start, y.stop), abs(y.start - y.stop)
            return _image(layer.pixels, layer.palette, x.start, top, x.stop - x.start, height)
        case Band():
            along, across = (y, x) if layer.upright else (x, y)
            edges = along(layer.along), across(layer.low), across(layer.high)
            if layer.bars:
                return _path("err", layer.style, _bars(*edges))
            return _path("band", layer.style, _band(*edges, upright=layer.upright))
        case Curve():
            return _curve(layer, x(layer.x), y(layer.y))
        case Words():
            places = zip(x(layer.x).tolist(), y(layer.y).tolist(), layer.texts, strict=True)
            return "".join(text(a + 9, b - 7, words) for a, b, words in places)


def _curve(curve: Curve, x: Floats, y: Floats) -> str:
    drawn = ""
    if curve.joined:
        ends = (np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]) if curve.steps else (x, y)
        drawn = _path("line", curve.style, _line(*ends))
    if curve.mark is not None:
        shape, good = _MARKS[curve.mark], np.isfinite(x) & np.isfinite(y)
        marks = zip(x[good].tolist(), y[good].tolist(), strict=True)
        drawn += _path("mark", curve.style, "".join(shape(a, b) for a, b in marks))
    return drawn


def _line(x: Floats, y: Floats) -> str:
    """Return a path through points, interrupted at points that are not finite."""
    parts, pen = [], "M"
    for a, b, good in zip(
        x.tolist(), y.tolist(), (np.isfinite(x) & np.isfinite(y)).tolist(), strict=True
    ):
        if good:
            parts.append(f"{pen}{a:.1f} {b:.1f}")
        pen = "L" if good else "M"
    return "".join(parts)


def _band(along: Floats, low: Floats, high: Floats, *, upright: bool = False) -> str:
    """Return closed paths between two curves, one per stretch without a gap."""
    good = np.isfinite(along) & np.isfinite(low) & np.isfinite(high)
    cuts = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
    parts = []
    for start, stop in list(pairwise(cuts.tolist()))[::2]:
        a = np.concatenate([along[start:stop], along[start:stop][::-1]])
        b = np.concatenate([low[start:stop], high[start:stop][::-1]])
        parts.append((_line(b, a) if upright else _line(a, b)) + "Z")
    return "".join(parts)


def _bars(x: Floats, low: Floats, high: Floats) -> str:
    good = np.isfinite(x + low + high)
    ends = zip(x[good].tolist(), low[good].tolist(), high[good].tolist(), strict=True)
    return "".join(f"M{a:.1f} {b:.1f}V{c:.1f}" for a, b, c in ends)


_MARKS: Final[Mapping[Mark, Callable[[float, float], str]]] = {
    Mark.DISC: lambda x, y: f"M{x - 3:.1f} {y:.1f}a3 3 0 1 0 6 0a3 3 0 1 0-6 0",
    Mark.SQUARE: lambda x, y: f"M{x - 3:.1f} {y - 3:.1f}h6v6h-6z",
    Mark.TRIANGLE: lambda x, y: f"M{x - 3.6:.1f} {y + 3:.1f}h7.2l-3.6-6.4z",
    Mark.DIAMOND: lambda x, y: f"M{x:.1f} {y - 4:.1f}l4 4l-4 4l-4-4z",
    Mark.CROSS: lambda x, y: f"M{x - 3:.1f} {y - 3:.1f}l6 6m0-6l-6 6",
    Mark.DOWN: lambda x, y: f"M{x - 5:.1f} {y - 8:.1f}h10l-5 8z",
    Mark.DASH: lambda x, y: f"M{x - 5:.1f} {y:.1f}h10",
}


def _path(what: str, css: str, data: str) -> str:
    return f'<path class="{what} {css}" d="{data}"/>' if data else ""


def _image(
    values: NDArray[np.uint8],
    palette: Palette,
    x: float,
    y: float,
    width: float,
    tall: float,
) -> str:
    data = base64.b64encode(pixels.png(values, palette)).decode("ascii")
    return (
        f'<image class="px" x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{tall:.1f}"'
        f' preserveAspectRatio="none" href="data:image/png;base64,{data}"/>'
    )


def text(x: float, y: float, words: str, css: str = "", *, turned: bool = False) -> str:
    """Return a text as markup, escaped; `css` names style and anchor."""
    if not words:
        return ""
    turn = f' transform="rotate(-90 {x:.1f} {y:.1f})"' if turned else ""
    return f'<text class="t {css}" x="{x:.1f}" y="{y:.1f}"{turn}>{escape(visible(words))}</text>'
