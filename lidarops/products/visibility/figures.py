"""The figures of the ``visibility`` product: series at crossings, a map of beams."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.kind_figures import KindFigures, View
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
from lidarops.figures.series_data import TimeSeries, float_values, join, require
from lidarops.figures.series_panels import Quantity, series_figures
from lidarops.figures.wording import counted
from lidarops.kinds import flags_of
from lidarops.products.visibility import NAME
from lidarops.retrieve.network.geometry import Beam, local_axes, locate, to_earth_centred

Floats = NDArray[np.float64]

_EXTINCTION: Final = (
    "total_extinction",
    "total_extinction_standard_error",
    "total_extinction_systematic_error",
)
_VISIBILITY: Final = ("visibility_in_air", "visibility_in_air_lower", "visibility_in_air_upper")
_ANGLES: Final = ("latitude", "longitude", "altitude", "zenith_angle", "azimuth")
_SHARED: Final = ("time", "crossing_id", "quality_flag")
CROSSING_VARIABLES: Final = (*_SHARED, *_EXTINCTION, *_VISIBILITY)
"""Variables that `read_crossings` needs."""
MAP_VARIABLES: Final = (
    *_SHARED,
    "beam_range",
    "visibility_in_air",
    *(f"beam_{name}" for name in _ANGLES),
    *_ANGLES[:3],
    "provenance",
)
"""Variables that `read_map` needs."""
_PAIR: Final = ("time", "crossing")
_FLAT: Final = 0.2
"""Smallest horizontal extent of a map that shows the ground, relative to the larger extent."""
_HEIGHT: Final = 464.0
_ROOM: Final = 0.08
"""Margin on each side, relative to the extent."""
_NARROW: Final = 0.3
"""Smallest extent of an axis of a map, relative to the other one."""
_QUANTITIES: Final = (Quantity("visibility", 1.0, "km"), Quantity("total_extinction", 1e3, "km⁻¹"))


@dataclass(frozen=True, slots=True)
class NetworkMap:
    """Beams and crossings projected on two axes."""

    stations: Floats
    """(beam, 2) km."""
    ends: Floats
    """(beam, 2) km, far ends of the beams, just beyond the last crossing."""
    crossings: Floats
    """(crossing, 2) km."""
    numbers: tuple[int, ...]
    visibility: Floats
    """(crossing,) km, median over time of usable values; NaN without any."""
    axes: tuple[str, str]
    """Labels of the two axes."""
    instruments: tuple[str, ...]
    """Instrument of each beam."""


def instruments_of(product: xr.Dataset) -> tuple[str, ...]:
    """Return the instrument of each beam by the plan of a product; numbers if it states none."""
    try:
        entities = json.loads(str(product["provenance"].item()))["entity"]
        steps = json.loads(entities["lidarops:plan"]["lidarops:json"])["steps"]
        beams = next(step["settings"]["beams"] for step in steps if step["name"] == NAME)
        return tuple(str(beam["instrument"]) for beam in beams)
    except (ValueError, LookupError, TypeError, StopIteration):
        return tuple(f"beam {beam}" for beam in range(product.sizes["beam"]))


def read_crossings(product: xr.Dataset) -> list[TimeSeries]:
    """Return the series at each crossing of a product; errors include the systematic error.

    Parameters
    ----------
    product : Dataset
        Kind ``visibility``.

    Raises
    ------
    ProductError
        If a variable is missing or has other dimensions.
    """
    require(
        product,
        {"time": ("time",), "crossing_id": ("crossing",)}
        | dict.fromkeys((*_EXTINCTION, *_VISIBILITY, "quality_flag"), _PAIR),
    )
    value, random, systematic = (float_values(product, name) for name in _EXTINCTION)
    visibility, lower, upper = (float_values(product, name) / 1e3 for name in _VISIBILITY)
    values = {
        "total_extinction": value,
        "total_extinction_standard_error": np.hypot(random, systematic),
        "visibility": visibility,
        "visibility_standard_error": np.abs(upper - lower) / 2.0,
    }
    flags = product["quality_flag"].values.astype(np.int64)
    time = product["time"].values.astype("datetime64[ns]")
    rejecting = flags_of("visibility").rejecting
    return [
        TimeSeries(
            time,
            {name: both[:, v] for name, both in values.items()},
            flags[:, v],
            rejecting,
            f"crossing {number}",
            (number,),
        )
        for v, number in enumerate(product["crossing_id"].values.tolist())
    ]


def read_map(product: xr.Dataset, _: int = 0) -> NetworkMap:
    """Return beams and crossings of a product, projected on two axes.

    Parameters
    ----------
    product : Dataset
        Kind ``visibility``.

    Raises
    ------
    ProductError
        If a variable is missing or has other dimensions.
    """
    require(
        product,
        {"time": ("time",), "beam_range": ("beam", "crossing"), "visibility_in_air": _PAIR}
        | {"quality_flag": _PAIR, "crossing_id": ("crossing",)}
        | {f"beam_{name}": ("beam",) for name in _ANGLES},
    )
    columns = [float_values(product, f"beam_{name}") for name in _ANGLES]
    beams = [
        Beam(lat, lon, alt, azimuth, 90.0 - zenith)
        for lat, lon, alt, zenith, azimuth in zip(*columns, strict=True)
    ]
    origin, direction = locate(beams)
    reach = np.nanmax(float_values(product, "beam_range"), axis=1, initial=0.0)
    position = [float_values(product, name) for name in _ANGLES[:3]]
    first = to_earth_centred(beams[0].latitude, beams[0].longitude, beams[0].altitude)
    turn = local_axes(beams[0].latitude, beams[0].longitude)
    crossings = (to_earth_centred(*position) - first) @ turn.T
    ends = origin + 1.08 * reach[:, np.newaxis] * direction
    pair, names = _plane(np.concatenate([origin, crossings]))
    rejected = (
        product["quality_flag"].values.astype(np.int64) & flags_of("visibility").rejecting
    ) != 0
    visibility = np.where(rejected, np.nan, float_values(product, "visibility_in_air")) / 1e3
    medians = [np.nanmedian(own) if np.isfinite(own).any() else np.nan for own in visibility.T]
    return NetworkMap(
        stations=origin[:, pair] / 1e3,
        ends=ends[:, pair] / 1e3,
        crossings=crossings[:, pair] / 1e3,
        numbers=tuple(int(number) for number in product["crossing_id"].values),
        visibility=np.array(medians),
        axes=names,
        instruments=instruments_of(product),
    )


def _plane(points: Floats) -> tuple[list[int], tuple[str, str]]:
    """Return the two axes of a map and their labels: the ground, or a vertical plane if narrow."""
    east, north, up = np.ptp(points, axis=0)
    labels = ("east of the first lidar (km)", "north of the first lidar (km)")
    level = 0 if east >= north else 1
    if up > 0 and min(east, north) < _FLAT * min(max(east, north), up):
        return [level, 2], (labels[level], "above the first lidar (km)")
    return [0, 1], labels


# Figures -----------------------------------------------------------------------------------------


def _read_crossings(product: xr.Dataset, _: int) -> list[TimeSeries] | None:
    return read_crossings(product) or None


def _draw_crossings(contents: Sequence[list[TimeSeries]]) -> Iterator[Figure]:
    crossings = join(crossing for crossings in contents for crossing in crossings)
    title = "Visibility and extinction at the crossings"
    return series_figures(crossings, _QUANTITIES, title)


def _draw_map(contents: Sequence[NetworkMap]) -> list[Figure]:
    """Return beams and crossings to scale, with the median visibility at each crossing."""
    network = contents[0]
    known = np.isfinite(network.visibility)
    texts = tuple(
        f"{crossing}: {number(float(f'{value:.3g}'))} km" if has else f"{crossing}: no value"
        for crossing, value, has in zip(network.numbers, network.visibility, known, strict=True)
    )
    layers: list[Layer] = []
    gap = np.full(2, np.nan)
    for index, name in enumerate(dict.fromkeys(network.instruments)):
        beams = [beam for beam, other in enumerate(network.instruments) if other == name]
        ends = [
            part for beam in beams for part in (network.stations[beam], network.ends[beam], gap)
        ]
        layers.append(_points(np.array(ends), f"c1 d{index % 5}"))
        mark = SERIES_MARKS[-1 - index % len(SERIES_MARKS)]
        layers.append(_points(network.stations[beams], "c1", mark, name))
    for where, style, label in (
        (known, "c0", "crossing, with median visibility"),
        (~known, "soft hollow", "crossing without a usable value"),
    ):
        if where.any():
            layers.append(_points(network.crossings[where], style, Mark.DISC, label))
    layers.append(Words(network.crossings[:, 0], network.crossings[:, 1], texts))
    points = np.concatenate([network.stations, network.ends, network.crossings])
    span = np.ptp(points, axis=0)
    half = (0.5 + _ROOM) * np.maximum(span, _NARROW * span.max())
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    x, y = (
        Axis(label, float(start), float(stop))
        for label, start, stop in zip(network.axes, middle - half, middle + half, strict=True)
    )
    words = (
        f"{counted(len(network.stations), 'beam')} of"
        f" {counted(len(set(network.instruments)), 'instrument')}; median visibility at each"
        f" crossing: {', '.join(texts)}"
    )
    panel = Panel(x, y, tuple(layers), _HEIGHT, to_scale=True)
    return [Figure("Map of beams and crossings", words, (panel,))]


def _points(points: Floats, style: str, mark: Mark | None = None, label: str = "") -> Curve:
    """Return points of a map, shape (point, 2), as a line or marked."""
    return Curve(points[:, 0], points[:, 1], style, mark, joined=mark is None, label=label)


FIGURES: Final = KindFigures(
    (
        View("visibility", CROSSING_VARIABLES, _read_crossings, _draw_crossings),
        View("network", MAP_VARIABLES, read_map, _draw_map, first=True),
    ),
    preferred="visibility_in_air",
)
