"""Panels as values: what a figure shows, without how it is drawn.

``figures.js`` draws them in the browser, `lidarops.figures.stills` as files. A style is a colour of
`COLOURS` with ``d1`` to ``d5`` (dashes), ``thin``, ``thick``, ``hollow``, ``wide`` (a pale band) or
``full`` (an opaque one). Marks and dashes differ too: figures do not depend on colour alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.figures.time_axis import Times, days, usual_step
from lidarops.figures.wording import counted

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

COLOURS: Final = {
    "c0": ("#0072b2", "#56b4e9"),
    "c1": ("#b84f00", "#f0a060"),
    "c2": ("#007d5b", "#3fcfa3"),
    "c3": ("#a84f83", "#e6a4c9"),
    "c4": ("#6b6b00", "#d6d06a"),
    "c5": ("#6a4fb3", "#b7a3f0"),
    "ink": ("#1d2126", "#e4e7eb"),
    "soft": ("#5b6470", "#a1abb7"),
    "grid": ("#dfe3e8", "#353c45"),
    "page": ("#ffffff", "#15181c"),
    "good": ("#2a6f97", "#62a9d6"),
    "care": ("#e0a100", "#d9a520"),
    "reject": ("#b9bfc7", "#4a525c"),
    "negative": ("#808080", "#808080"),
}
"""Colours of styles and of the first codes of images, on light and on dark pages."""
DASHES: Final = {"d1": (7, 3), "d2": (2, 3), "d3": (9, 3, 2, 3), "d4": (12, 4), "d5": (1, 4)}
"""Lengths of dashes and gaps of styles."""
BLANK: Final = 0
"""Code of a block of an image without data, transparent."""
REJECTED: Final = 1
"""Code of a block that a quality bit rejects."""
NEGATIVE: Final = 2
"""Code of a usable block at or below zero, which a logarithmic scale cannot show."""
_MINUTE: Final = 1.0 / 1440.0
"""Day."""
FIRST: Final = 3
"""Code of the low end of the colour scale; 255 is the high end."""


class Mark(StrEnum):
    """Shape of a mark, by its name in matplotlib."""

    DISC = "o"
    SQUARE = "s"
    TRIANGLE = "^"
    DIAMOND = "D"
    CROSS = "x"
    DOWN = "v"


SERIES_MARKS: Final = (Mark.DISC, Mark.SQUARE, Mark.TRIANGLE, Mark.DIAMOND)
"""Marks of the series of a panel."""


PALETTE: Final = [
    *("#440154", "#481567", "#482677", "#453781", "#404788", "#39568c", "#33638d", "#2d708e"),
    *("#287d8e", "#238a8d", "#1f968b", "#20a387", "#29af7f", "#3cbb75", "#55c667", "#73d055"),
    *("#95d840", "#b8de29", "#dce319", "#fde725"),
]
"""Colours of images at equal steps of the scale, those of viridis in matplotlib."""


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis of a panel or a colour bar."""

    label: str
    low: float
    high: float
    log: bool = False
    time: bool = False
    """Whether values are days since 1970, UTC."""


@dataclass(frozen=True, slots=True)
class Curve:
    """Points, joined by a line that is interrupted where a point is not finite, or marked."""

    x: Floats
    y: Floats
    style: str = "c0"
    mark: Mark | None = None
    joined: bool = True
    label: str = ""


@dataclass(frozen=True, slots=True)
class Band:
    """Area between two curves, interrupted where they are not finite; or a bar at each point."""

    along: Floats
    low: Floats
    high: Floats
    style: str = "c0"
    upright: bool = False
    """Whether `along` is vertical."""
    bars: bool = False
    label: str = ""


@dataclass(frozen=True, slots=True)
class Image:
    """Blocks of values, each with a code of the colour scale that is the bar of the panel."""

    codes: NDArray[np.uint8]
    """(column, row) `BLANK`, `REJECTED`, `NEGATIVE`, or of `codes_of`."""
    left: Floats
    """(column,) Left edges, rising; between columns there may be gaps."""
    right: Floats
    """(column,)"""
    edges: Floats
    """(row + 1,) Rising edges of the rows along the vertical axis."""


@dataclass(frozen=True, slots=True)
class Words:
    """Texts, each to the upper right of its point."""

    x: Floats
    y: Floats
    texts: tuple[str, ...]


Layer = Curve | Band | Image | Words


@dataclass(frozen=True, slots=True)
class Panel:
    """A rectangle with axes, and layers from the lowest to the highest."""

    x: Axis
    y: Axis
    layers: tuple[Layer, ...]
    height: float = 240.0
    bar: Axis | None = None
    """Colour bar of the image."""
    to_scale: bool = False
    """Whether both axes have one scale."""


@dataclass(frozen=True, slots=True)
class Figure:
    """Panels below each other, or side by side, with their description."""

    caption: str
    words: str
    """What the figure shows, in words."""
    panels: tuple[Panel, ...]
    beside: bool = False

    @property
    def text(self) -> str:
        """Caption and description."""
        return f"{self.caption}. {self.words}."


def time_axis(start: Times, stop: Times) -> Axis:
    """Return the horizontal axis of panels over time, from the first start to the last stop."""
    first, last = float(days(start.min())), float(days(stop.max()))
    # A single profile without a length still needs a place.
    return Axis("time (UTC)", first, last if last > first else first + _MINUTE, time=True)


def axis_of_times(time: Times) -> Axis:
    """Return the axis of profiles by their middles, with half the usual step at both ends."""
    half = usual_step(np.sort(time)) / 2
    return time_axis(time - half, time + half)


def flag_marks(x: Floats, y: Floats, care: Mask, rejected: Mask, most: int) -> list[Curve]:
    """Return marks of values to use with care and of rejected ones, about `most` of each."""
    marks = []
    for where, style, mark, words in (
        (care, "ink hollow", Mark.DISC, "use with care"),
        (rejected, "soft hollow", Mark.CROSS, "do not use"),
    ):
        index = np.flatnonzero(where)
        if index.size:
            some = index[:: -(-index.size // most)]
            label = f"{words}: {counted(index.size, 'value')}"
            marks.append(Curve(x[some], y[some], style, mark, joined=False, label=label))
    return marks


def codes_of(shares: Floats) -> NDArray[np.uint8]:
    """Return the codes of shares of the colour scale, 0 to 1; blank for NaN."""
    inside = np.clip(np.nan_to_num(shares), 0.0, 1.0)
    level = FIRST + np.rint(inside * (255 - FIRST)).astype(np.uint8)
    return np.where(np.isfinite(shares), level, BLANK).astype(np.uint8)


def finite(parts: Sequence[Floats]) -> Floats:
    """Return the finite values of arrays."""
    whole: Floats = np.concatenate([*(np.ravel(values) for values in parts), np.array([])])
    return np.asarray(whole[np.isfinite(whole)])


def percentile_axis(
    label: str, values: Sequence[Floats], share: float = 1.0, room: float = 0.15
) -> Axis:
    """Return a linear axis from a percentile to its counterpart, with a margin on both sides.

    Parameters
    ----------
    label : str
    values : sequence of ndarray
    share : float, optional
        Percentile, so that a few noisy values do not set the axis.
    room : float, optional
        Margin, relative to the span.
    """
    known = finite(values)
    if known.size == 0:
        return Axis(label, 0.0, 1.0)
    low, high = (float(level) for level in np.percentile(known, [share, 100.0 - share]))
    margin = room * (high - low) or 0.1 * abs(high) or 1.0
    return Axis(label, low - margin, high + margin)


def decade_axis(label: str, values: Sequence[Floats]) -> Axis:
    """Return a logarithmic axis of five decades at most."""
    known = finite(values)
    known = known[known > 0]
    if known.size == 0:
        return Axis(label, 0.1, 1.0, log=True)
    high = 1.5 * float(known.max())
    return Axis(label, max(0.7 * float(np.percentile(known, 2.0)), 1e-5 * high), high, log=True)


def number(value: float) -> str:
    """Return a number for axes and texts: with a minus sign, and powers of ten if it is long."""
    if value == 0.0:
        return "0"
    text = f"{value:.4g}"
    if "e" in text:
        digits, power = text.split("e")
        text = f"{digits}\N{MULTIPLICATION SIGN}10{str(int(power)).translate(_SUPERSCRIPT)}"
        text = text.removeprefix("1\N{MULTIPLICATION SIGN}")
    return text.replace("-", "\N{MINUS SIGN}")


_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def units(text: str) -> str:
    """Return CF units with superscript exponents: ``m-1 sr-1`` becomes m⁻¹ sr⁻¹."""
    words = []
    for word in text.split():
        name = word.rstrip("-0123456789")
        words.append(name + word[len(name) :].translate(_SUPERSCRIPT) if name else word)
    return " ".join(words)


def span_in_words(values: Floats, unit: str) -> str:
    """Return the least and the largest value in words."""
    known = finite([values])
    if known.size == 0:
        return "no usable value"
    return f"{number(float(known.min()))} to {number(float(known.max()))} {unit}".strip()
