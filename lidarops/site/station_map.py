"""A map of stations as markup: latitude and longitude, without coastlines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from lidarops.figures.svg import round_steps, text
from lidarops.figures.wording import visible

Floats = NDArray[np.float64]

WIDTH: Final = 460
_HEIGHT: Final = 260
_LEFT: Final = 76
_FOOT: Final = 26
_EDGE: Final = 12
"""Space above and at the right."""
_PIN: Final = 5
"""Radius of a mark."""
_ROOM: Final = 0.25
"""Margin around the stations, relative to their extent."""
_LEAST: Final = 0.02
"""Smallest extent in degrees, about 2 km."""
_LINE: Final = 15
"""Least height between names, so that they do not touch."""
_FIRST, _LAST = _EDGE + 8, _HEIGHT - _FOOT - 8
"""Heights between which names are."""
_CIRCLE: Final = 360.0


@dataclass(frozen=True, slots=True)
class Place:
    """A station on the map."""

    name: str
    anchor: str
    """Identifier of its section on the page."""
    latitude: float
    longitude: float


def station_map(places: Sequence[Place]) -> Markup:
    """Return the map of stations with known positions, each a link; empty without any.

    Names that find no room are left out.
    """
    if not places:
        return Markup()
    latitude = np.array([place.latitude for place in places])
    longitude = _unwrapped(np.array([place.longitude for place in places]))
    south, north = (float(end) for end in np.clip(_ends(latitude), -90.0, 90.0))
    west, east = _ends(longitude)
    across, up = WIDTH - _LEFT - _EDGE, _HEIGHT - _FOOT - _EDGE
    x = _LEFT + (longitude - west) / (east - west) * across
    y = _EDGE + (north - latitude) / (north - south) * up
    parts = [f'<rect class="sea" x="{_LEFT}" y="{_EDGE}" width="{across}" height="{up}"/>']
    for value in round_steps(west, east, 4):
        at = _LEFT + (value - west) / (east - west) * across
        parts.append(f'<path class="grid" d="M{at:.1f} {_EDGE}v{up}"/>')
        parts.append(text(at, _HEIGHT - 8, _degrees(_turned(value), "E", "W"), "m s"))
    for value in round_steps(south, north, 4):
        at = _EDGE + (north - value) / (north - south) * up
        parts.append(f'<path class="grid" d="M{_LEFT} {at:.1f}h{across}"/>')
        parts.append(text(_LEFT - 7, at + 4, _degrees(value, "N", "S"), "e s"))
    for place, a, b, height in zip(places, x.tolist(), y.tolist(), _spread(y), strict=True):
        right = a > _LEFT + 0.6 * across
        shift, css = (-9, "e b") if right else (9, "b")
        name = "" if height is None else text(a + shift, height + 4, place.name, css)
        parts.append(
            f'<a href="#{escape(place.anchor)}" aria-label="{escape(visible(place.name))}">'
            f'<circle class="pin" cx="{a:.1f}" cy="{b:.1f}" r="{_PIN}"/>{name}</a>'
        )
    return Markup(  # noqa: S704 - every text is escaped
        f'<svg class="map" viewBox="0 0 {WIDTH} {_HEIGHT}" role="group"'
        f' aria-label="Map of the stations, without coastlines">{"".join(parts)}</svg>'
    )


def _unwrapped(longitude: Floats) -> Floats:
    """Return longitudes that rise eastward from the widest gap between stations."""
    around = np.sort(longitude % _CIRCLE)
    gaps = np.diff(around, append=around[0] + _CIRCLE)
    first = around[(int(np.argmax(gaps)) + 1) % around.size]
    return np.asarray(_turned(first) + (longitude - first) % _CIRCLE)


def _turned(longitude: float) -> float:
    """Return a longitude from -180 to 180."""
    return (longitude + _CIRCLE / 2) % _CIRCLE - _CIRCLE / 2


def _ends(values: Floats) -> tuple[float, float]:
    span = max(float(np.ptp(values)), _LEAST)
    middle, half = 0.5 * float(values.min() + values.max()), (0.5 + _ROOM) * span
    return middle - half, middle + half


def _spread(y: Floats) -> list[float | None]:
    """Return heights of names at least a line apart, of the northernmost if there are too many."""
    order = np.argsort(y, kind="stable")[: int((_LAST - _FIRST) // _LINE) + 1]
    heights = np.clip(y[order], _FIRST, _LAST).tolist()
    for k in range(1, len(heights)):
        heights[k] = max(heights[k], heights[k - 1] + _LINE)
    # Back up from the foot, where the names have been pushed beyond it.
    last = float(_LAST)
    for k in reversed(range(len(heights))):
        heights[k] = min(heights[k], last)
        last = heights[k] - _LINE
    names = dict(zip(order.tolist(), heights, strict=True))
    return [names.get(place) for place in range(y.size)]


def _degrees(value: float, positive: str, negative: str) -> str:
    side = positive if value > 0 else negative if value < 0 else ""
    return f"{abs(value):.6g}° {'' if abs(value) == _CIRCLE / 2 else side}".rstrip()
