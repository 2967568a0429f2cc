"""Drawing primitives: panels, axes, lines, marks and images as SVG text.

Pages contain figures as SVG: text and lines are sharp, colours adapt to light and dark mode, and
drawing takes milliseconds. Colours are classes of the style sheet. Marks and dashes differ too, so
that figures do not depend on colour alone.
"""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from lidarops.figures.wording import visible

Floats = NDArray[np.float64]

WIDTH: Final = 960
"""Width of a figure in its own units."""
THUMB: Final = (240, 84)
"""Width and height of a thumbnail."""
LEFT: Final = 74
RIGHT: Final = 18
BAR: Final = 122
"""Space on the right for a colour bar."""
COLOURS: Final = 253
"""Steps of the colour scale of images."""
BLANK: Final = 0
"""Palette index of blocks without data (transparent)."""
REJECTED: Final = 1
"""Palette index of the dark stripes of rejected blocks; the light stripes have the next index."""

# viridis without its dark end, as in the figures of a run's report.
_VIRIDIS: Final = (
    "463480 404588 3a538b 33628d 2e6f8e 287c8e 23898e 1f958b 1fa287 28ae80 3bbb75 56c667 73d056"
    " 95d840 b8de29 dde318 fde725"
)


@dataclass(frozen=True, slots=True)
class Scale:
    """Maps values to positions along an axis."""

    low: float
    high: float
    start: float
    """Position of `low`, in units of the figure."""
    stop: float
    """Position of `high`."""
    log: bool = False

    def __call__(self, values: Floats | float) -> Floats:
        """Return positions, clipped at one axis length outside the ends."""
        low, high = (np.log(self.low), np.log(self.high)) if self.log else (self.low, self.high)
        with np.errstate(invalid="ignore", divide="ignore"):
            along = np.log(np.asarray(values)) if self.log else np.asarray(values, dtype=np.float64)
        share = (along - low) / (high - low)
        return self.start + np.clip(share, -1.0, 2.0) * (self.stop - self.start)

    def ticks(self, at_most: int = 6) -> list[float]:
        """Return round values between the ends."""
        return _decades(self.low, self.high) if self.log else _round_steps(*self.ends, at_most)

    @property
    def ends(self) -> tuple[float, float]:
        """The lower and the higher end."""
        return min(self.low, self.high), max(self.low, self.high)


def _round_steps(low: float, high: float, at_most: int) -> list[float]:
    """Return multiples of 1, 2, 2.5 or 5 times a power of ten between two values."""
    rough = (high - low) / max(at_most, 1)
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(power * m for m in (1.0, 2.0, 2.5, 5.0, 10.0) if power * m >= rough * (1 - 1e-9))
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    return [float(step * number) for number in range(first, last + 1)]


def _decades(low: float, high: float) -> list[float]:
    first, last = int(np.floor(np.log10(low))), int(np.ceil(np.log10(high)))
    for steps in ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)):
        ticks = [s * 10.0**p for p in range(first, last + 1) for s in steps]
        ticks = [value for value in ticks if low * (1 - 1e-9) <= value <= high * (1 + 1e-9)]
        if len(ticks) >= 3:
            return ticks
    return [low, high]


def _labelled(scale: Scale, at_most: int) -> list[tuple[float, str]]:
    """Return ticks with labels, with equal decimals on a linear scale."""
    ticks = scale.ticks(at_most)
    words = [number(tick) for tick in ticks]
    if not scale.log and not any("\N{MULTIPLICATION SIGN}" in text for text in words):
        decimals = max((len(text.partition(".")[2]) for text in words), default=0)
        words = [f"{tick:.{decimals}f}".replace("-", "\N{MINUS SIGN}") for tick in ticks]
    return list(zip(ticks, words, strict=True))


def number(value: float) -> str:
    """Return a number for axes: with a minus sign, and powers of ten if it is long."""
    if value == 0.0:
        return "0"
    text = f"{value:.4g}"
    if "e" in text:
        digits, power = text.split("e")
        text = f"{digits}\N{MULTIPLICATION SIGN}10{_raised(int(power))}"
        text = text.removeprefix("1\N{MULTIPLICATION SIGN}")
    return text.replace("-", "\N{MINUS SIGN}")


_SUPERSCRIPT: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _raised(power: int) -> str:
    return str(power).translate(_SUPERSCRIPT)


def units(text: str) -> str:
    """Return CF units with superscript exponents: ``m-1 sr-1`` becomes m⁻¹ sr⁻¹."""
    plain = text.replace("$^{-1}$", "-1")
    words = []
    for word in plain.split():
        name = word.rstrip("-0123456789")
        power = word[len(name) :]
        words.append(name + power.translate(_SUPERSCRIPT) if name else word)
    return " ".join(words)


@dataclass(frozen=True, slots=True)
class SvgPanel:
    """A rectangle with two scales."""

    x: Scale
    y: Scale

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Left, top, width and height."""
        left, right = self.x.start, self.x.stop
        return left, self.y.stop, right - left, self.y.start - self.y.stop


@dataclass(slots=True)
class Sheet:
    """A figure that is being drawn."""

    height: float
    width: float = WIDTH
    stretched: bool = False
    """Whether the aspect ratio of the file may change; for images only."""
    parts: list[str] = field(default_factory=list)
    _clips: int = 0

    def text(self, x: float, y: float, words: str, *, css: str = "t", turned: bool = False) -> None:
        """Write text; `css` names style and anchor."""
        turn = f' transform="rotate(-90 {x:.1f} {y:.1f})"' if turned else ""
        plain = escape(visible(words))
        self.parts.append(f'<text class="{css}" x="{x:.1f}" y="{y:.1f}"{turn}>{plain}</text>')

    def path(self, data: str, css: str) -> None:
        """Draw a path."""
        if data:
            self.parts.append(f'<path class="{css}" d="{data}"/>')

    def clipped(self, panel: SvgPanel, draw: Callable[[], None], key: str) -> None:
        """Draw with clipping at the edges of a panel; `key` must be unique on a page."""
        self._clips += 1
        name = f"{key}-{self._clips}"
        left, top, width, height = panel.box
        self.parts.append(
            f'<clipPath id="{name}"><rect x="{left:.1f}" y="{top:.1f}" width="{width:.1f}"'
            f' height="{height:.1f}"/></clipPath><g clip-path="url(#{name})">'
        )
        draw()
        self.parts.append("</g>")

    def frame(self, panel: SvgPanel, label: str, *, below: str = "", at_most: int = 5) -> None:
        """Draw the axes of a panel; the horizontal axis only if `below` labels it."""
        left, top, width, height = panel.box
        bottom = top + height
        grid, edge = "", f"M{left:.1f} {top:.1f}V{bottom:.1f}h{width:.1f}"
        for value, words in _labelled(panel.y, at_most):
            y = float(panel.y(value))
            grid += f"M{left:.1f} {y:.1f}h{width:.1f}"
            edge += f"M{left:.1f} {y:.1f}h-4"
            self.text(left - 9, y + 4, words, css="t e")
        if below:
            for value, words in _labelled(panel.x, 6):
                x = float(panel.x(value))
                grid += f"M{x:.1f} {top:.1f}v{height:.1f}"
                edge += f"M{x:.1f} {bottom:.1f}v4"
                self.text(x, bottom + 19, words, css="t m")
            self.text(left + width / 2, bottom + 38, below, css="t m s")
        self.path(grid, "grid")
        self.path(edge, "axis")
        self.text(left - 56, top + height / 2, label, css="t m s", turned=True)

    def image(self, panel: SvgPanel, png: bytes) -> None:
        """Fill a panel with an image."""
        left, top, width, height = panel.box
        data = base64.b64encode(png).decode("ascii")
        self.parts.append(
            f'<image class="px" x="{left:.1f}" y="{top:.1f}" width="{width:.1f}"'
            f' height="{height:.1f}" preserveAspectRatio="none"'
            f' href="data:image/png;base64,{data}"/>'
        )

    def svg(self, key: str, alt: str) -> Markup:
        """Return the figure as markup for a page; `alt` describes it."""
        return Markup(  # noqa: S704 - every text in `parts` was escaped by `text`
            f'<svg class="fig" viewBox="0 0 {self.width:g} {self.height:g}" role="img"'
            f' aria-labelledby="{key}-t"><title id="{key}-t">{escape(visible(alt))}</title>'
            f"{''.join(self.parts)}</svg>"
        )

    def file(self, style: str) -> bytes:
        """Return the figure as an SVG file that includes its style."""
        aspect = ' preserveAspectRatio="none"' if self.stretched else ""
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {self.width:g}'
            f' {self.height:g}" width="{self.width:g}" height="{self.height:g}"{aspect}>'
            f"<style>{style}</style>{''.join(self.parts)}</svg>\n"
        ).encode()


def line(x: Floats, y: Floats) -> str:
    """Return a path through points, interrupted at points that are not finite."""
    parts, pen = [], "M"
    for px, py in zip(x.tolist(), y.tolist(), strict=True):
        if not (np.isfinite(px) and np.isfinite(py)):
            pen = "M"
            continue
        parts.append(f"{pen}{px:.1f} {py:.1f}")
        pen = "L"
    return "".join(parts)


def band(along: Floats, low: Floats, high: Floats, *, upright: bool = False) -> str:
    """Return closed paths between two curves, one per stretch without a gap.

    Parameters
    ----------
    along, low, high : ndarray, shape (n,)
        Positions; `along` is vertical if `upright`.
    """
    good = np.isfinite(along) & np.isfinite(low) & np.isfinite(high)
    cuts = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
    parts = []
    for start, stop in zip(cuts[::2], cuts[1::2], strict=True):
        a = np.concatenate([along[start:stop], along[start:stop][::-1]])
        b = np.concatenate([low[start:stop], high[start:stop][::-1]])
        parts.append((line(b, a) if upright else line(a, b)) + "Z")
    return "".join(parts)


MARKS: Final[Sequence[Callable[[float, float], str]]] = (
    lambda x, y: f"M{x - 3:.1f} {y:.1f}a3 3 0 1 0 6 0a3 3 0 1 0-6 0",
    lambda x, y: f"M{x - 3:.1f} {y - 3:.1f}h6v6h-6z",
    lambda x, y: f"M{x - 3.6:.1f} {y + 3:.1f}h7.2l-3.6-6.4z",
    lambda x, y: f"M{x:.1f} {y - 4:.1f}l4 4l-4 4l-4-4z",
)
"""Marks of the series of a panel: disc, square, triangle, diamond."""


def cross(x: float, y: float) -> str:
    """Return the mark of a rejected value."""
    return f"M{x - 3:.1f} {y - 3:.1f}l6 6m0-6l-6 6"


def marks(x: Floats, y: Floats, mark: Callable[[float, float], str]) -> str:
    """Return a mark at every finite point."""
    good = np.isfinite(x) & np.isfinite(y)
    return "".join(mark(px, py) for px, py in zip(x[good].tolist(), y[good].tolist(), strict=True))


def draw_legend(sheet: Sheet, x: float, y: float, entries: Iterable[tuple[str, str, str]]) -> None:
    """Draw a legend in one line; entries are path data around the origin, style and text."""
    for data, css, words in entries:
        sheet.parts.append(
            f'<path class="{css}" transform="translate({x:.1f} {y - 4:.1f})" d="{data}"/>'
        )
        sheet.text(x + 14, y, words, css="t s")
        x += 40 + 6.9 * len(words)


def png(pixels: NDArray[np.uint8]) -> bytes:
    """Return an indexed image as PNG: blank, two kinds of stripes, and the colour scale.

    Parameters
    ----------
    pixels : ndarray of uint8, shape (row, column)
        `BLANK`, `REJECTED`, `REJECTED` + 1, or 3 + the step of the colour scale.
    """
    height, width = pixels.shape
    rows = np.zeros((height, width + 1), dtype=np.uint8)
    rows[:, 1:] = pixels
    header = struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        _chunk(kind, data)
        for kind, data in (
            (b"IHDR", header),
            (b"PLTE", _palette()),
            (b"tRNS", b"\x00"),
            (b"IDAT", zlib.compress(rows.tobytes(), 6)),
            (b"IEND", b""),
        )
    )


def _chunk(kind: bytes, data: bytes) -> bytes:
    body = kind + data
    return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))


def _palette() -> bytes:
    anchors = np.array([list(bytes.fromhex(color)) for color in _VIRIDIS.split()], dtype=float)
    places = np.linspace(0.0, len(anchors) - 1.0, COLOURS)
    scale = [np.interp(places, np.arange(len(anchors)), anchors[:, c]) for c in range(3)]
    colors = np.rint(np.stack(scale, axis=-1)).astype(np.uint8)
    special = np.array([[0, 0, 0], [20, 20, 20], [170, 174, 180]], dtype=np.uint8)
    return np.concatenate([special, colors]).tobytes()
