"""Charts of benchmarks: marks on logarithmic axes, distinguishable in colour and in grey."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from lidarops.figures import panels

_DPI: Final = 150
_HEIGHT: Final = 4.6
_WIDTH: Final = 10.0
_ROW: Final = 0.3
_FEW_DECADES: Final = 2e3
"""Axes that span less than this ratio are labelled at 1, 2 and 5 of each decade."""
_COLORS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
_MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*", "h", "d")
_LINES: Final = ("-", "--", "-.", ":")


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
    band: bool = False
    """Whether `low` and `high` are drawn as a filled area, which need not contain the points."""


@dataclass(frozen=True, slots=True)
class Panel:
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
    panels: tuple[Panel, ...]


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
    """Draw a chart; `lidarops.figures.product_figures.render` converts it to a file."""
    figure = _chart(chart) if isinstance(chart, Chart) else _ladder(chart)
    panels.title(figure, chart.title)
    figure.set_label(f"{chart.title}. {chart.caption}")
    return figure


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


def _chart(chart: Chart) -> Figure:
    figure = Figure(figsize=(_WIDTH, _HEIGHT), dpi=_DPI, layout="constrained")
    axes = figure.subplots(1, len(chart.panels), squeeze=False, sharey=True)[0]
    for panel, drawn in zip(axes, chart.panels, strict=True):
        _panel(panel, drawn)
    if chart.panels[0].y_log:
        _plain_ticks(axes[0].yaxis)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8.5, frameon=False)
    return figure


def _panel(panel: Axes, drawn: Panel) -> None:
    panel.set_title(drawn.title, fontsize=10, loc="left")
    panel.set_xlabel(drawn.x_label)
    panel.set_ylabel(drawn.y_label)
    if drawn.x_log:
        panel.set_xscale("log")
    if drawn.y_log:
        panel.set_yscale("log")
    if drawn.level is not None:
        panel.axhline(drawn.level, color=panels.GREY, linewidth=0.8)
    if drawn.front:
        x, y = zip(*drawn.front, strict=True)
        panel.step(x, y, where="post", color=panels.INK, linewidth=1.0, label="Pareto front")
    for number, series in enumerate(drawn.series):
        _series(panel, series, number)
    if drawn.x_log:
        _plain_ticks(panel.xaxis)
    _calm(panel)


def _series(panel: Axes, series: Series, number: int) -> None:
    color = _COLORS[number % len(_COLORS)]
    bars = None
    if series.band:
        panel.fill_between(series.x, series.low, series.high, color=color, alpha=0.18, linewidth=0)
    elif series.low:
        bars = (
            [y - low for y, low in zip(series.y, series.low, strict=True)],
            [high - y for y, high in zip(series.y, series.high, strict=True)],
        )
    panel.errorbar(
        series.x,
        series.y,
        yerr=bars,
        label=series.label,
        color=color,
        marker=_MARKERS[number % len(_MARKERS)],
        markerfacecolor="none" if series.hollow else color,
        markersize=5.5,
        linestyle=_LINES[number % len(_LINES)] if series.joined else "none",
        linewidth=1.0,
        elinewidth=0.8,
        capsize=2,
    )


def _ladder(ladder: Ladder) -> Figure:
    height = 1.6 + _ROW * len(ladder.rows)
    figure = Figure(figsize=(_WIDTH, height), dpi=_DPI, layout="constrained")
    panel = figure.subplots()
    panel.set_xscale("log")
    panel.set_xlabel(ladder.x_label)
    places = range(len(ladder.rows))
    panel.set_yticks(places, ladder.rows)
    panel.invert_yaxis()
    for number, (label, values) in enumerate(ladder.series):
        drawn = [(value, at) for at, value in zip(places, values, strict=True) if value]
        x, y = zip(*drawn, strict=True) if drawn else ((), ())
        panel.plot(
            x,
            y,
            label=label,
            linestyle="none",
            color=_COLORS[number % len(_COLORS)],
            marker=_MARKERS[number % len(_MARKERS)],
            markerfacecolor="none" if number % 2 else _COLORS[number % len(_COLORS)],
        )
    panels.legend(panel, columns=4)
    _calm(panel)
    return figure


def _plain_ticks(axis: Axis) -> None:
    low, high = axis.get_view_interval()
    if high / low < _FEW_DECADES:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.6g}"))
        axis.set_minor_formatter(NullFormatter())


def _calm(panel: Axes) -> None:
    panel.spines[["top", "right"]].set_visible(False)
    panel.grid(which="major", color="#dddddd", linewidth=0.6)
    panel.set_axisbelow(True)
