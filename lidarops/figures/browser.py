"""Figures as data of a page, which ``figures.js`` draws: a description, and deflated arrays.

Positions have 16 bits between the least and the largest of an array, codes of images 8.
"""

from __future__ import annotations

import base64
import io
import json
import zlib
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from lidarops.figures.panels import (
    BLANK,
    COLOURS,
    DASHES,
    FIRST,
    PALETTE,
    Axis,
    Band,
    Curve,
    Figure,
    Image,
    Layer,
    Panel,
)
from lidarops.figures.wording import visible

if TYPE_CHECKING:
    from PIL import ImageDraw

SCRIPT: Final = "figures.js"
"""Name of the script beside pages."""
_MOST: Final = 65534
"""Largest position; the next number stands for none."""
_BEYOND: Final = 1.0
"""Positions are clipped at this many axis lengths outside the ends."""
_NO_AXIS: Final = Axis("", 0.0, 1.0)
_OF_AXIS: Final = tuple(item.name for item in fields(Axis))
THUMBNAIL: Final = (240, 84)
"""Width and height of a thumbnail in pixels."""
_PEN: Final = 110
"""Code of the lines of thumbnails, a colour that can be seen on light and dark pages."""


@cache
def script() -> bytes:
    """Return the script that draws, with the colours and codes of panels."""
    text = Path(__file__).with_name(SCRIPT).read_text(encoding="utf-8")
    constants = {"COLOURS": COLOURS, "DASHES": DASHES, "PALETTE": PALETTE, "FIRST": FIRST}
    head = "".join(f"const {name} = {json.dumps(value)};\n" for name, value in constants.items())
    return f'"use strict";\n{head}{text}'.encode()


def inline(figure: Figure) -> Markup:
    """Return a figure as markup for a page that loads `SCRIPT`."""
    # Data that look like markup would end the element; axes that are not finite are no JSON.
    data = json.dumps(_described(figure), allow_nan=False).replace("<", "\\u003c")
    words = escape(visible(figure.text))
    return Markup(  # noqa: S704 - text is escaped
        f'<div class="fig" data-words="{words}"><script type="application/json">{data}</script>'
        "<noscript><p>The figure is drawn by a script.</p></noscript></div>"
    )


@dataclass(slots=True)
class _Packed:
    """Arrays, one after the other."""

    parts: dict[bytes, int] = field(default_factory=dict)
    """Where each begins; equal ones are stored once."""
    size: int = 0

    def add(self, values: NDArray[Any]) -> int:
        """Append values; return where they begin."""
        content = values.tobytes()
        if content not in self.parts:
            self.parts[content] = self.size
            self.size += len(content)
        return self.parts[content]

    def positions(self, values: NDArray[np.float64], axis: Axis) -> dict[str, Any]:
        """Append positions along an axis; return what they mean, as logarithms on a log axis."""
        low, high = axis.low, axis.high
        if axis.log:
            low, high = np.log(low), np.log(high)
            values = np.log(np.where(values > 0.0, values, np.nan))
        low, high = sorted((low, high))
        room = _BEYOND * (high - low)
        known = np.clip(values, low - room, high + room)
        finite = known[np.isfinite(known)]
        least, most = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
        steps = np.rint((known - least) / ((most - least) or 1.0) * _MOST)
        codes = np.where(np.isfinite(steps), steps, _MOST + 1).astype("<u2")
        return {"n": codes.size, "lo": least, "hi": most, "at": self.add(codes)}


def _described(figure: Figure) -> dict[str, Any]:
    packed = _Packed()
    panels = [_panel(panel, packed) for panel in figure.panels]
    data = base64.b64encode(zlib.compress(b"".join(packed.parts), 6)).decode("ascii")
    return {"beside": figure.beside, "panels": panels, "data": data}


def _panel(panel: Panel, packed: _Packed) -> dict[str, Any]:
    return {
        "x": _axis(panel.x),
        "y": _axis(panel.y),
        "bar": _axis(panel.bar),
        "height": panel.height,
        "toScale": panel.to_scale,
        "layers": [_layer(layer, panel, packed) for layer in panel.layers],
    }


def _axis(axis: Axis | None) -> dict[str, Any] | None:
    if axis is None:
        return None
    return {name: getattr(axis, name) for name in _OF_AXIS} | {"label": visible(axis.label)}


def _layer(layer: Layer, panel: Panel, packed: _Packed) -> dict[str, Any]:
    x, y, pack = panel.x, panel.y, packed.positions
    match layer:
        case Image():
            return {
                "is": "image",
                # Together, so that columns that touch still do.
                "sides": pack(np.concatenate([layer.left, layer.right]), x),
                "edges": pack(layer.edges, y),
                "codes": packed.add(layer.codes),
            }
        case Band():
            along, across = (y, x) if layer.upright else (x, y)
            return {
                "is": "bars" if layer.bars else "band",
                "upright": layer.upright,
                "style": layer.style,
                "label": visible(layer.label),
                "along": pack(layer.along, along),
                "low": pack(layer.low, across),
                "high": pack(layer.high, across),
            }
        case Curve():
            return {
                "is": "curve",
                "joined": layer.joined,
                "mark": layer.mark,
                "style": layer.style,
                "label": visible(layer.label),
                "x": pack(layer.x, x),
                "y": pack(layer.y, y),
            }
        case _:
            texts = [visible(text) for text in layer.texts]
            return {"is": "words", "texts": texts, "x": pack(layer.x, x), "y": pack(layer.y, y)}


# Thumbnails ----------------------------------------------------------------------------------


def thumbnail(figure: Figure | None) -> bytes:
    """Return the first panel of a figure without axes as PNG; an empty one without a figure."""
    from PIL import Image as Pictures  # noqa: PLC0415 - only where something is drawn
    from PIL import ImageDraw  # noqa: PLC0415

    codes = np.full(THUMBNAIL[::-1], BLANK, dtype=np.uint8)
    panel = figure.panels[0] if figure else Panel(_NO_AXIS, _NO_AXIS, ())
    images = [layer for layer in panel.layers if isinstance(layer, Image)]
    for image in images:
        _fill(codes, image, panel)
    picture = Pictures.fromarray(codes, "P")
    picture.putpalette(_colours())
    pen = ImageDraw.Draw(picture)
    for layer in panel.layers if not images else ():
        if isinstance(layer, Curve):
            x = _pixels(layer.x, panel.x, THUMBNAIL[0])
            y = THUMBNAIL[1] - _pixels(layer.y, panel.y, THUMBNAIL[1])
            _draw(pen, np.stack([x, y], axis=-1), joined=layer.joined)
    out = io.BytesIO()
    picture.save(out, "PNG", transparency=BLANK, optimize=True)
    return out.getvalue()


def _draw(pen: ImageDraw.ImageDraw, points: NDArray[np.float64], *, joined: bool) -> None:
    known = np.isfinite(points).all(axis=1)
    if not joined:
        pen.point(points[known].ravel().tolist(), _PEN)
        return
    for part in np.split(points, np.flatnonzero(~known)):
        line = part[np.isfinite(part).all(axis=1)]
        pen.line(line.ravel().tolist(), _PEN, width=2)


def _pixels(values: NDArray[np.float64], axis: Axis, size: int) -> NDArray[np.float64]:
    """Return the places of values along an axis in pixels."""
    low, high = axis.low, axis.high
    if axis.log:
        low, high, values = np.log(low), np.log(high), np.log(np.where(values > 0, values, np.nan))
    return np.clip((values - low) / (high - low), -1.0, 2.0) * size


def _fill(codes: NDArray[np.uint8], image: Image, panel: Panel) -> None:
    """Fill in an image, whose columns have at least a pixel each."""
    height, width = codes.shape
    up = _pixels(image.edges, panel.y, height)
    row = np.searchsorted(up, height - 0.5 - np.arange(height), side="right") - 1
    inside = (row >= 0) & (row < image.codes.shape[1])
    left, right = (
        np.rint(_pixels(ends, panel.x, width)).astype(int).clip(0, width)
        for ends in (image.left, image.right)
    )
    for column, (start, stop) in enumerate(zip(left, right, strict=True)):
        first = min(start, width - 1)
        codes[inside, first : max(stop, first + 1)] = image.codes[column, row[inside], np.newaxis]


@cache
def _colours() -> bytes:
    """Return the colours of all codes."""
    greys = [_rgb(COLOURS[name][0]) for name in ("page", "reject", "negative")]
    anchors = np.array([_rgb(colour) for colour in PALETTE], dtype=np.float64)
    places = np.linspace(0.0, len(anchors) - 1.0, 256 - FIRST)
    scale = [np.interp(places, np.arange(len(anchors)), channel) for channel in anchors.T]
    return bytes(np.concatenate([greys, np.rint(np.stack(scale, -1))]).astype(np.uint8))


def _rgb(colour: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(colour.removeprefix("#")))
