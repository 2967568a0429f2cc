"""Panels as values: what a figure shows, without how it is drawn.

`lidarops.figures.svg` draws them. Style names are classes of ``figure.css``: ``c0`` to ``c4`` are
colours of series, ``d1`` to ``d4`` dashes; marks and dashes differ too, so that figures do not
depend on colour alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np
from numpy.typing import NDArray

from lidarops.figures.time_axis import Tick, TimeAxis

Floats = NDArray[np.float64]


class Mark(Enum):
    """Shape of a mark."""

    DISC = auto()
    SQUARE = auto()
    TRIANGLE = auto()
    DIAMOND = auto()
    CROSS = auto()
    DOWN = auto()
    DASH = auto()


SERIES_MARKS = (Mark.DISC, Mark.SQUARE, Mark.TRIANGLE, Mark.DIAMOND)
"""Marks of the series of a panel."""


class Palette(Enum):
    """Colours of an image. Both become lighter with the value."""

    SIGNAL = auto()
    SIGNED = auto()
    """Neutral in the middle."""


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis of a panel or a colour bar."""

    label: str
    low: float
    high: float
    log: bool = False
    ticks: tuple[Tick, ...] | None = None
    """Round values where None."""
    breaks: tuple[float, ...] = ()
    """Positions where a gap in time is cut out."""


@dataclass(frozen=True, slots=True)
class Curve:
    """Points, joined by a line that is interrupted where a point is not finite, or marked."""

    x: Floats
    y: Floats
    style: str = "c0"
    mark: Mark | None = None
    joined: bool = True
    steps: bool = False
    """Whether the line runs horizontally to the next point, then vertically."""
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
    """Pixels that fill the panel, the first row on top; see `lidarops.figures.pixels`."""

    pixels: NDArray[np.uint8]
    palette: Palette = Palette.SIGNAL


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
    right: Axis | None = None
    """Second vertical axis."""
    bar: Axis | None = None
    """Colour bar of the image."""
    title: str = ""
    note: str = ""
    """Why the panel is empty."""
    to_scale: bool = False
    """Whether both axes have one scale, so that the height follows the width."""


@dataclass(frozen=True, slots=True)
class Figure:
    """Panels below each other, or side by side, with their description."""

    caption: str
    words: str
    """What the figure shows, in words."""
    panels: tuple[Panel, ...]
    beside: bool = False
    above: tuple[Panel, ...] = ()
    """Panels of a figure above it over the same times: its axis begins and ends below theirs."""

    @property
    def text(self) -> str:
        """Caption and description."""
        return f"{self.caption}. {self.words}."


def time_panel_axis(axis: TimeAxis) -> Axis:
    """Return the horizontal axis of panels over time."""
    note = "; gaps cut out at the marks" if axis.broken else ""
    return Axis(
        f"time (UTC{note})", *axis.limits, ticks=tuple(axis.ticks(8)), breaks=tuple(axis.breaks)
    )


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
