"""A map of stations as markup: latitude and longitude, without coastlines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from markupsafe import Markup, escape

from lidarops.figures.svg import round_steps
from lidarops.figures.wording import visible

WIDTH: Final = 460
_HEIGHT: Final = 260
_LEFT: Final = 58
_FOOT: Final = 26
_ROOM: Final = 0.25
"""Margin around the stations, relative to their extent."""
_LEAST: Final = 0.02
"""Smallest extent in degrees, about 2 km."""
_LINE: Final = 15
"""Least height between names, so that they do not touch."""


@dataclass(frozen=True, slots=True)
class Place:
    """A station on the map."""

    name: str
    anchor: str
    """Identifier of its section on the page."""
    latitude: float
    longitude: float


def station_map(places: Sequence[Place]) -> Markup:
    """Return the map of stations with known positions, each a link; empty without any."""
    if not places:
        return Markup()
    latitude = np.array([place.latitude for place in places])
    longitude = np.array([place.longitude for place in places])
    south, north = _ends(latitude, 90.0)
    west, east = _ends(longitude, 360.0)
    across, up = WIDTH - _LEFT - 12, _HEIGHT - _FOOT - 12
    x = _LEFT + (longitude - west) / (east - west) * across
    y = 12 + (north - latitude) / (north - south) * up
    parts = [f'<rect class="sea" x="{_LEFT}" y="12" width="{across}" height="{up}"/>']
    for value in round_steps(west, east, 4):
        at = _LEFT + (value - west) / (east - west) * across
        parts.append(f'<path class="grid" d="M{at:.1f} 12v{up}"/>')
        parts.append(_words(at, _HEIGHT - 8, _degrees(value, "E", "W"), "m s"))
    for value in round_steps(south, north, 4):
        at = 12 + (north - value) / (north - south) * up
        parts.append(f'<path class="grid" d="M{_LEFT} {at:.1f}h{across}"/>')
        parts.append(_words(_LEFT - 7, at + 4, _degrees(value, "N", "S"), "e s"))
    for place, a, b, text in zip(places, x, y, _spread(y), strict=True):
        right = a > _LEFT + 0.6 * across
        label = _words(a - 9 if right else a + 9, text + 4, place.name, "e b" if right else "b")
        parts.append(
            f'<a href="#{escape(place.anchor)}"><path class="pin" d="M{a - 5:.1f} {b:.1f}'
            f'a5 5 0 1 0 10 0a5 5 0 1 0-10 0"/>{label}</a>'
        )
    return Markup(  # noqa: S704 - every text is escaped
        f'<svg class="map" viewBox="0 0 {WIDTH} {_HEIGHT}" role="group"'
        f' aria-label="Map of the stations, without coastlines">{"".join(parts)}</svg>'
    )


def _ends(values: np.ndarray[tuple[int], np.dtype[np.float64]], most: float) -> tuple[float, float]:
    span = max(float(np.ptp(values)), _LEAST)
    middle, half = 0.5 * float(values.min() + values.max()), (0.5 + _ROOM) * span
    return max(middle - half, -most), min(middle + half, most)


def _spread(y: np.ndarray[tuple[int], np.dtype[np.float64]]) -> list[float]:
    """Return heights of names, in the order of the stations, at least a line apart."""
    heights = np.array(y, dtype=np.float64)
    order = np.argsort(heights, kind="stable")
    for before, after in pairwise(order):
        heights[after] = max(heights[after], heights[before] + _LINE)
    heights -= max(0.0, float(heights.max()) - (_HEIGHT - _FOOT - 8))
    return [float(height) for height in heights]


def _degrees(value: float, positive: str, negative: str) -> str:
    side = positive if value > 0 else negative if value < 0 else ""
    return f"{abs(value):.6g}° {side}".rstrip()


def _words(x: float, y: float, words: str, css: str) -> str:
    return f'<text class="t {css}" x="{x:.1f}" y="{y:.1f}">{escape(visible(words))}</text>'
