"""The map of stations: latitude and longitude, without coastlines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarops.figures.panels import Curve, Figure, Mark, Panel, Words, percentile_axis

Floats = NDArray[np.float64]
_CIRCLE: Final = 360.0


class Place(NamedTuple):
    """A station on the map."""

    name: str
    latitude: float
    longitude: float


def station_map(places: Sequence[Place]) -> Figure:
    """Return the map of at least one station with a known position."""
    names, latitude, longitude = zip(*places, strict=True)
    north, east = np.array(latitude), _unwrapped(np.array(longitude))
    x, y = (
        percentile_axis(f"{name} (°)", [values], share=0.0, room=0.25)
        for name, values in (("longitude", east), ("latitude", north))
    )
    layers = (
        Curve(east, north, mark=Mark.DISC, joined=False),
        Words(east, north, names),
    )
    words = "; ".join(
        f"{name} at {up:.4g}° north, {across:.4g}° east" for name, up, across in places
    )
    return Figure("Map of the stations, without coastlines", words, (Panel(x, y, layers),))


def _unwrapped(longitude: Floats) -> Floats:
    """Return longitudes that rise eastward from the widest gap between stations."""
    around = np.sort(longitude % _CIRCLE)
    gaps = np.diff(around, append=around[0] + _CIRCLE)
    first = around[(int(np.argmax(gaps)) + 1) % around.size]
    turned = (first + _CIRCLE / 2) % _CIRCLE - _CIRCLE / 2
    return np.asarray(turned + (longitude - first) % _CIRCLE)
