"""A map of the beams of a network and their crossings."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.figures import svg
from lidarops.figures.svg import LEFT, RIGHT, WIDTH, Scale, Sheet, SvgPanel
from lidarops.figures.wording import counted
from lidarops.products.visibility.figure_data import NetworkMap

Floats = NDArray[np.float64]

_TOP: Final = 28
_FOOT: Final = 492
_ROOM: Final = 0.08
"""Margin on each side, relative to the extent."""
_LEAST: Final = 0.05
"""km, smallest span of an axis."""
_RING: Final = "M-5 0a5 5 0 1 0 10 0a5 5 0 1 0-10 0"
_TRIANGLE: Final = "M-5 4h10l-5-9z"


def draw_network_map(network: NetworkMap) -> tuple[Sheet, str]:
    """Draw beams and crossings to scale, with the median visibility at each crossing.

    Parameters
    ----------
    network : NetworkMap
        From `lidarops.products.visibility.figure_data.read_map`.

    Returns
    -------
    Sheet
    str
        Description in words.
    """
    sheet = Sheet(height=_FOOT + 50)
    panel = _panel(np.concatenate([network.stations, network.ends, network.crossings]))
    sheet.frame(panel, network.axes[1], below=network.axes[0])
    for start, end in zip(
        _placed(panel, network.stations), _placed(panel, network.ends), strict=True
    ):
        sheet.path(f"M{start[0]:.1f} {start[1]:.1f}L{end[0]:.1f} {end[1]:.1f}", "line d2 c1")
    for station in _placed(panel, network.stations):
        _mark(sheet, station, _TRIANGLE, "mark c1")
    crossings = _placed(panel, network.crossings)
    for place, number, visibility in zip(
        crossings, network.numbers, network.visibility, strict=True
    ):
        known = bool(np.isfinite(visibility))
        _mark(sheet, place, _RING, "mark c0" if known else "off")
        sheet.text(
            place[0] + 9, place[1] - 7, f"{number}: {_km(visibility)}" if known else f"{number}"
        )
    svg.draw_legend(
        sheet,
        LEFT + 14,
        14,
        [
            (_TRIANGLE, "mark c1", "lidar"),
            ("M-9 0H9", "line d2 c1", "beam"),
            (_RING, "mark c0", "crossing, with median visibility"),
            (_RING, "off", "crossing without a usable value"),
        ],
    )
    return sheet, _words(network)


def _panel(points: Floats) -> SvgPanel:
    """Return a panel with equal scales on both axes that contains all points."""
    across, up = WIDTH - RIGHT - LEFT, _FOOT - _TOP
    low, high = points.min(axis=0), points.max(axis=0)
    span = np.maximum(high - low, _LEAST) * (1.0 + 2.0 * _ROOM)
    length = max(span[0] / across, span[1] / up)
    middle = (low + high) / 2.0
    half = 0.5 * length * np.array([across, up])
    (left, bottom), (right, top) = middle - half, middle + half
    return SvgPanel(
        Scale(float(left), float(right), LEFT, WIDTH - RIGHT),
        Scale(float(bottom), float(top), _FOOT, _TOP),
    )


def _placed(panel: SvgPanel, points: Floats) -> list[tuple[float, float]]:
    return list(zip(panel.x(points[:, 0]).tolist(), panel.y(points[:, 1]).tolist(), strict=True))


def _mark(sheet: Sheet, place: tuple[float, float], data: str, css: str) -> None:
    sheet.parts.append(
        f'<path class="{css}" transform="translate({place[0]:.1f} {place[1]:.1f})" d="{data}"/>'
    )


def _km(visibility: float) -> str:
    return f"{svg.number(float(f'{visibility:.3g}'))} km"


def _words(network: NetworkMap) -> str:
    medians = zip(network.numbers, network.visibility, network.used, strict=True)
    known = [
        f"{_km(visibility)} at crossing {number} ({used} of {counted(network.values, 'value')})"
        for number, visibility, used in medians
        if np.isfinite(visibility)
    ]
    beams = counted(len(network.stations), "beam")
    return f"{beams}; median visibility: {', '.join(known) or 'no usable value'}"
