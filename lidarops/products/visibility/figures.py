"""The figures of the ``visibility`` product: series at crossings, and a map of beams."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.kind_figures import KindFigures, ProductSource, View
from lidarops.figures.panels import (
    SERIES_MARKS,
    Axis,
    Curve,
    Figure,
    Layer,
    Mark,
    Panel,
    Words,
    number,
)
from lidarops.figures.series_data import Comparison, NumberedSeries, compare, join
from lidarops.figures.series_panels import Quantity, series_figures
from lidarops.figures.wording import counted
from lidarops.products.visibility.figure_data import (
    CROSSING_VARIABLES,
    MAP_VARIABLES,
    NetworkMap,
    instruments_of,
    read_crossings,
    read_map,
)

_ACROSS: Final = 868.0
"""Width of a panel without a colour bar, in units of the figure."""
_HEIGHT: Final = 464.0
_ROOM: Final = 0.08
"""Margin on each side, relative to the extent."""
_LEAST: Final = 0.05
"""km, smallest span of an axis."""
_QUANTITIES: Final = (Quantity("visibility", 1.0, "km"), Quantity("total_extinction", 1e3, "km⁻¹"))


def _read_crossings(product: xr.Dataset, source: ProductSource) -> list[NumberedSeries] | None:
    instruments = instruments_of(source.scene) if source.scene else ()
    return read_crossings(product, source.truth, instruments=instruments) or None


def _read_map(product: xr.Dataset, source: ProductSource) -> NetworkMap:
    return read_map(product, instruments_of(source.scene) if source.scene else ())


def _crossings(contents: Sequence[list[NumberedSeries]]) -> list[NumberedSeries]:
    return join(crossing for crossings in contents for crossing in crossings)


def _draw_crossings(contents: Sequence[list[NumberedSeries]]) -> Iterator[Figure]:
    title = "Visibility and extinction at the crossings"
    return series_figures(_crossings(contents), _QUANTITIES, title)


def _compare(contents: Sequence[list[NumberedSeries]]) -> Iterator[Comparison | None]:
    return (compare(crossing, "total_extinction") for crossing in _crossings(contents))


def _draw_map(contents: Sequence[NetworkMap]) -> list[Figure]:
    """Return beams and crossings to scale, with the median visibility at each crossing."""
    network = contents[0]
    x, y = _axes(network)
    known = np.isfinite(network.visibility)
    texts = tuple(
        f"{crossing}: {_km(value)}" if has else f"{crossing}: no value"
        for crossing, value, has in zip(network.numbers, network.visibility, known, strict=True)
    )
    crossings: list[Layer] = [
        _points(network.crossings[where], style, Mark.DISC, label)
        for where, style, label in (
            (known, "c0", "crossing, with median visibility"),
            (~known, "soft hollow", "crossing without a usable value"),
        )
        if where.any()
    ]
    layers = (
        *_beams(network),
        *crossings,
        Words(network.crossings[:, 0], network.crossings[:, 1], texts),
    )
    panel = Panel(x, y, layers, _HEIGHT, to_scale=True)
    return [Figure("Map of beams and crossings", _in_words(network), (panel,))]


def _axes(network: NetworkMap) -> tuple[Axis, Axis]:
    """Return axes of equal scale that contain all points."""
    points = np.concatenate([network.stations, network.ends, network.crossings])
    low, high = points.min(axis=0), points.max(axis=0)
    span = np.maximum(high - low, _LEAST) * (1.0 + 2.0 * _ROOM)
    length = max(span[0] / _ACROSS, span[1] / _HEIGHT)
    half = 0.5 * length * np.array([_ACROSS, _HEIGHT])
    middle = (low + high) / 2.0
    ends = zip(network.axes, middle - half, middle + half, strict=True)
    x, y = (Axis(label, float(start), float(stop)) for label, start, stop in ends)
    return x, y


def _beams(network: NetworkMap) -> list[Layer]:
    """Return the beams of each instrument, with a mark at their station."""
    layers: list[Layer] = []
    gap = np.full(2, np.nan)
    for index, name in enumerate(dict.fromkeys(network.instruments)):
        of = [number_ for number_, other in enumerate(network.instruments) if other == name]
        ends = [point for beam in of for point in (network.stations[beam], network.ends[beam], gap)]
        layers.append(_points(np.array(ends), f"c1 d{index % 5}"))
        stations = network.stations[of]
        mark = SERIES_MARKS[-1 - index % len(SERIES_MARKS)]
        layers.append(_points(stations, "c1", mark, name))
    return layers


def _points(
    points: NDArray[np.float64], style: str, mark: Mark | None = None, label: str = ""
) -> Curve:
    """Return points of a map, shape (point, 2), as a line or marked."""
    return Curve(points[:, 0], points[:, 1], style, mark, joined=mark is None, label=label)


def _km(visibility: float) -> str:
    return f"{number(float(f'{visibility:.3g}'))} km"


def _in_words(network: NetworkMap) -> str:
    medians = zip(network.numbers, network.visibility, network.used, strict=True)
    known = [
        f"{_km(visibility)} at crossing {crossing} ({used} of {counted(network.values, 'value')})"
        for crossing, visibility, used in medians
        if np.isfinite(visibility)
    ]
    beams = counted(len(network.stations), "beam")
    instruments = counted(len(set(network.instruments)), "instrument")
    medians_ = ", ".join(known) or "no usable value"
    return f"{beams} of {instruments}; median visibility: {medians_}"


FIGURES: Final = KindFigures(
    (
        View("visibility", CROSSING_VARIABLES, _read_crossings, _draw_crossings, _compare),
        View("network", MAP_VARIABLES, _read_map, _draw_map, first=True),
    ),
    preferred="visibility_in_air",
    values=(Quantity("visibility_in_air", 1e-3, "km"), Quantity("total_extinction", 1e3, "km⁻¹")),
)
