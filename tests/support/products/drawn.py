"""Find the layers of panels, and draw figures as a page does."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree as ET

from lidarops.figures import svg
from lidarops.figures.kind_figures import ProductSource, figures_of
from lidarops.figures.panels import Band, Curve, Figure, Image, Panel


def views(kind: str) -> dict[str, Any]:
    """Return the views of a kind of product by name."""
    figures = figures_of(kind)
    assert figures is not None
    return {view.name: view for view in figures.views}


def figures(kind: str, name: str, products: Sequence[Any], **source: Any) -> list[Figure]:
    """Return the figures of a view of products, each of which can be drawn."""
    view = views(kind)[name]
    contents = [view.read(product, ProductSource(**source)) for product in products]
    drawn = list(view.draw([content for content in contents if content is not None]))
    for figure in drawn:
        content = svg.file(figure)
        ET.fromstring(content)
        assert not re.search(rb'="[^",]*nan', content)
        assert content == svg.file(figure)
    return drawn


def labelled(panel: Panel, start: str) -> list[Any]:
    """Return the curves and bands of a panel whose label starts with some words."""
    return [
        layer
        for layer in panel.layers
        if isinstance(layer, Curve | Band) and layer.label.startswith(start) and layer.label
    ]


def image(panel: Panel) -> Any:
    """Return the pixels of a panel."""
    (layer,) = (layer for layer in panel.layers if isinstance(layer, Image))
    return layer.pixels
