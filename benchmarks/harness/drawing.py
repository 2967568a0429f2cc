"""Charts of benchmarks: marks on logarithmic axes, distinguishable in colour and in grey."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from lidarops.figures import panels
from lidarops.figures.panels import SERIES_MARKS, Band, Curve, Figure, Layer, finite
from lidarops.figures.time_axis import Tick

_HEIGHT: Final = 340
_ROW: Final = 28
_COLOURS: Final = 5
_DASHES: Final = 5
_MARGIN: Final = 0.05
"""Room at both ends of an axis, relative to its length."""


@dataclass(frozen=True, slots=True)
class Series:
    """One series of points with its label and style."""

    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    low: tuple[float, ...] = ()
    """Lower ends of vertical bars; empty without bars."""
    high: tuple[float, ...] = ()
    hollow: bool = False
    joined: bool = False


@dataclass(frozen=True, slots=True)
class ChartPanel:
    """One panel of a chart."""

    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
    x_log: bool = True
    y_log: bool = True
    level: float | None = None
    """Height of a thin horizontal line."""
    front: tuple[tuple[float, float], ...] = ()
    """Corners of the Pareto front from left to right, drawn as steps."""


@dataclass(frozen=True, slots=True)
class Chart:
    """A figure of panels side by side with a common vertical axis and order of series."""

    name: str
    """File name without suffix."""
    title: str
    caption: str
    panels: tuple[ChartPanel, ...]


@dataclass(frozen=True, slots=True)
class Ladder:
    """A figure with a row per name and a mark per series on a logarithmic axis."""

    name: str
    title: str
    caption: str
    x_label: str
    rows: tuple[str, ...]
    series: tuple[tuple[str, tuple[float | None, ...]], ...]
    """Label, and one value per row."""


def draw_chart(chart: Chart | Ladder) -> Figure:
    """Return a chart as a figure."""
    drawn = _chart(chart) if isinstance(chart, Chart) else (_ladder(chart),)
    return Figure(chart.title, chart.caption.removesuffix("."), drawn, beside=True)


def pareto(
    points: Sequence[tuple[float, float]], gain: float = 1.0
) -> tuple[tuple[float, float], ...]:
    """Return the points with no other point below and to the left of them, from left to right.

    Each point is lower than `gain` times the height of the previous point.
    """
    front: list[tuple[float, float]] = []
    for x, y in sorted(points):
        if not front or y < gain * front[-1][1]:
            front.append((x, y))
    return tuple(front)


def _chart(chart: Chart) -> tuple[panels.Panel, ...]:
    first = chart.panels[0]
    heights = [y for panel in chart.panels for y in _heights(panel)]
    y = _axis(first.y_label, heights, log=first.y_log)
    labels = list(dict.fromkeys(series.label for panel in chart.panels for series in panel.series))
    return tuple(_panel(panel, replace(y, label=panel.y_label), labels) for panel in chart.panels)


def _heights(panel: ChartPanel) -> Iterator[float]:
    for series in panel.series:
        yield from (*series.y, *series.low, *series.high)
    yield from (y for _, y in panel.front)
    if panel.level is not None:
        yield panel.level


def _panel(panel: ChartPanel, y: panels.Axis, labels: Sequence[str]) -> panels.Panel:
    across = [x for series in panel.series for x in series.x]
    x = _axis(panel.x_label, [*across, *(at for at, _ in panel.front)], log=panel.x_log)
    layers: list[Layer] = []
    if panel.level is not None:
        layers.append(Curve(np.array([x.low, x.high]), np.full(2, panel.level), "soft thin"))
    if panel.front:
        at, front = np.array(panel.front, dtype=np.float64).T
        layers.append(Curve(at, front, "ink thin", steps=True, label="Pareto front"))
    for series in panel.series:
        layers += _series(series, labels.index(series.label))
    return panels.Panel(x, y, tuple(layers), height=_HEIGHT, title=panel.title)


def _series(series: Series, number: int) -> Iterator[Layer]:
    x = np.array(series.x, dtype=np.float64)
    style = f"c{number % _COLOURS}"
    if series.low:
        low, high = (np.array(ends, dtype=np.float64) for ends in (series.low, series.high))
        yield Band(x, low, high, style, bars=True)
    style += f" d{number % _DASHES}" + " hollow" * series.hollow
    mark = SERIES_MARKS[number % len(SERIES_MARKS)]
    y = np.array(series.y, dtype=np.float64)
    yield Curve(x, y, style, mark, joined=series.joined, label=series.label)


def _ladder(ladder: Ladder) -> panels.Panel:
    count = len(ladder.rows)
    ticks = tuple(Tick(float(place), name) for place, name in enumerate(ladder.rows))
    y = panels.Axis("", count - 0.5, -0.5, ticks=ticks)
    times = [value for _, values in ladder.series for value in values if value]
    layers = []
    for number, (label, values) in enumerate(ladder.series):
        x = np.array([value or np.nan for value in values])
        style = f"c{number % _COLOURS}" + " hollow" * (number % 2)
        mark = SERIES_MARKS[number % len(SERIES_MARKS)]
        layers.append(
            Curve(x, np.arange(count, dtype=np.float64), style, mark, joined=False, label=label)
        )
    return panels.Panel(_axis(ladder.x_label, times, log=True), y, tuple(layers), _ROW * count + 20)


def _axis(label: str, values: Iterable[float], *, log: bool) -> panels.Axis:
    known = finite([np.array([*values], dtype=np.float64)])
    known = np.log10(known[known > 0]) if log else known
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    room = _MARGIN * (high - low) or 0.3
    low, high = low - room, high + room
    return panels.Axis(label, 10.0**low if log else low, 10.0**high if log else high, log)
