"""Find the layers of panels, and draw figures as a page does."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from lidarops.figures import browser
from lidarops.figures.kind_figures import figures_of
from lidarops.figures.panels import BLANK, FIRST, Axis, Band, Curve, Figure, Image, Panel
from lidarops.figures.raster import COLUMNS
from lidarops.figures.series_data import TimeSeries

STEPS = 65534


def views(kind: str) -> dict[str, Any]:
    """Return the views of a kind of product by name."""
    figures = figures_of(kind)
    assert figures is not None
    return {view.name: view for view in figures.views}


def figures(kind: str, name: str, products: Sequence[Any], columns: int = COLUMNS) -> list[Figure]:
    """Return the figures of a view of products, each of which can be drawn."""
    view = views(kind)[name]
    contents = [view.read(product, columns) for product in products]
    drawn = list(view.draw([content for content in contents if content is not None]))
    for figure in drawn:
        content = browser.inline(figure)
        assert described(content)["panels"]
        assert content == browser.inline(figure)
    return drawn


def labelled(panel: Panel, start: str) -> list[Any]:
    """Return the curves and bands of a panel whose label starts with some words."""
    return [
        layer
        for layer in panel.layers
        if isinstance(layer, Curve | Band) and layer.label.startswith(start) and layer.label
    ]


def images(panel: Panel) -> list[Image]:
    """Return the images of a panel."""
    return [layer for layer in panel.layers if isinstance(layer, Image)]


def pixels(panel: Panel, height: int = 306, width: int = COLUMNS) -> Any:
    """Return the codes of the images of a panel at pixels, the first row on top."""
    shown = np.full((height, width), BLANK, dtype=np.uint8)
    x = panel.x.low + (np.arange(width) + 0.5) / width * (panel.x.high - panel.x.low)
    y = panel.y.high - (np.arange(height) + 0.5) / height * (panel.y.high - panel.y.low)
    for layer in images(panel):
        for column, (left, right) in enumerate(zip(layer.left, layer.right, strict=True)):
            row = np.searchsorted(layer.edges, y, side="right") - 1
            inside = (row >= 0) & (row < layer.edges.size - 1)
            across = (x >= left) & (x < right)
            shown[np.ix_(inside, across)] = layer.codes[column, row[inside], None]
    return shown


def described(markup: str) -> dict[str, Any]:
    """Return what a page says of a figure, with arrays in place of their packed form."""
    text = markup.partition('<script type="application/json">')[2].partition("</script>")[0]
    figure: dict[str, Any] = json.loads(text)
    data = zlib.decompress(base64.b64decode(figure.pop("data")))
    for panel in figure["panels"]:
        for layer in panel["layers"]:
            for name, array in list(layer.items()):
                if isinstance(array, dict):
                    codes = np.frombuffer(data, "<u2", array["n"], array["at"])
                    share = np.where(codes <= STEPS, codes / STEPS, np.nan)
                    layer[name] = array["lo"] + share * (array["hi"] - array["lo"])
            if layer["is"] == "image":
                layer["left"], layer["right"] = np.split(layer.pop("sides"), 2)
                shape = layer["left"].size, layer["edges"].size - 1
                codes = np.frombuffer(data, np.uint8, shape[0] * shape[1], layer["codes"])
                layer["codes"] = codes.reshape(shape)
    return figure


def decoded(codes: Any, bar: Axis) -> Any:
    """Return the values of codes of a logarithmic colour scale; NaN where they hold none."""
    share = np.where(codes >= FIRST, (codes.astype(float) - FIRST) / (255 - FIRST), np.nan)
    return bar.low * (bar.high / bar.low) ** share


def assert_same_series(found: TimeSeries, expected: TimeSeries) -> None:
    """Check that two series have the same times, flags and values."""
    np.testing.assert_array_equal(found.time, expected.time)
    np.testing.assert_array_equal(found.flag, expected.flag)
    assert found.quantities.keys() == expected.quantities.keys()
    for name, values in expected.quantities.items():
        np.testing.assert_array_equal(found.quantities[name], values)
