"""Figures as data of a page, which ``figures.js`` draws: a description, and deflated arrays.

Positions have 16 bits between the least and the largest of an array, codes of images 8.
"""

from __future__ import annotations

import base64
import json
import zlib
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from lidarops.figures.panels import (
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

SCRIPT: Final = "figures.js"
"""Name of the script beside pages."""
_MOST: Final = 65534
"""Largest position; the next number stands for none."""
_BEYOND: Final = 1.0
"""Positions are clipped at this many axis lengths outside the ends."""
_OF_AXIS: Final = tuple(item.name for item in fields(Axis))


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
    """Return the texts and switches of a layer, and where its arrays are."""
    x, y, pack = panel.x, panel.y, packed.positions
    given = ((item.name, getattr(layer, item.name)) for item in fields(layer))
    words = {name: value for name, value in given if not isinstance(value, np.ndarray | tuple)}
    if "label" in words:
        words["label"] = visible(words["label"])
    match layer:
        case Image():
            # Together, so that columns that touch still do.
            sides = pack(np.concatenate([layer.left, layer.right]), x)
            codes = packed.add(layer.codes)
            return {"is": "image", "sides": sides, "edges": pack(layer.edges, y), "codes": codes}
        case Band():
            along, across = (y, x) if layer.upright else (x, y)
            ends = {"low": pack(layer.low, across), "high": pack(layer.high, across)}
            shape = "bars" if words.pop("bars") else "band"
            return {"is": shape, **words, "along": pack(layer.along, along), **ends}
        case Curve():
            shape = "curve"
        case _:
            shape, words["texts"] = "words", [visible(text) for text in layer.texts]
    return {"is": shape, **words, "x": pack(layer.x, x), "y": pack(layer.y, y)}
