"""Values against time, with one panel per quantity and one mark and line per series."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.figures import svg
from lidarops.figures.kind_figures import Drawn, PageFigures
from lidarops.figures.series_data import TimeSeries, thin
from lidarops.figures.svg import LEFT, RIGHT, WIDTH, Scale, Sheet, SvgPanel
from lidarops.figures.time_axis import TimeAxis, Times, segments, time_axis
from lidarops.figures.wording import counted

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

POINTS: Final = 600
"""More values than this are drawn as block means."""
_BARS: Final = 160
"""Most values with error bars; more values get a band."""
_CROSSES: Final = 300
_LABELS: Final = 50
"""Height of the labels below the lowest panel."""
SERIES: Final = 4
"""Most series in a panel, one per mark."""


@dataclass(frozen=True, slots=True)
class Line:
    """A series to draw."""

    label: str
    time: Times
    value: Floats
    """Unflagged values."""
    error: Floats
    """Their standard errors; NaN where unknown."""
    off_time: Times
    off_value: Floats
    """Flagged values; NaN without a value."""


def line_of(section: TimeSeries, quantity: str, factor: float) -> Line:
    """Return a quantity of a series, multiplied by `factor`."""
    few = thin(section, POINTS)
    estimate = few.estimates[quantity]
    off = section.flag != 0
    return Line(
        label=section.label,
        time=few.time,
        value=factor * estimate.value,
        error=factor * estimate.standard_error,
        off_time=section.time[off],
        off_value=factor * section.estimates[quantity].value[off],
    )


def limits(lines: Sequence[Line]) -> tuple[float, float]:
    """Return the limits of a panel: the 1st and 99th percentile with a margin."""
    good = _finite([line.value for line in lines])
    values = good if good.size else _finite([line.off_value for line in lines])
    if values.size == 0:
        return 0.0, 1.0
    low, high = (float(level) for level in np.percentile(values, [1.0, 99.0]))
    errors = _finite([line.error for line in lines])
    room = 0.15 * (high - low) + (float(np.median(errors)) if errors.size else 0.0)
    room = room or 0.1 * abs(high) or 1.0
    return low - room, high + room


def _finite(parts: Sequence[Floats]) -> Floats:
    whole: Floats = np.concatenate([*parts, np.array([])])
    return np.asarray(whole[np.isfinite(whole)])


def time_scale(axis: TimeAxis, right: float = WIDTH - RIGHT) -> Scale:
    """Return the scale of a time axis across a figure."""
    first, last = axis.limits
    return Scale(first, last, LEFT, right)


def draw_time_ticks(sheet: Sheet, axis: TimeAxis, panels: Sequence[SvgPanel]) -> None:
    """Draw UTC ticks through panels, labels below the last panel, and marks at cut gaps."""
    scale = panels[-1].x
    _, top, _, height = panels[-1].box
    for tick in axis.ticks(8):
        x = float(scale(tick.x))
        for panel in panels:
            _, above, _, tall = panel.box
            sheet.path(f"M{x:.1f} {above:.1f}v{tall:.1f}", "grid")
        sheet.path(f"M{x:.1f} {top + height:.1f}v4", "axis")
        for row, words in enumerate(tick.label.split("\n")):
            sheet.text(x, top + height + 19 + 16 * row, words, css="t m")
    for x in scale(axis.breaks).tolist() if axis.broken else ():
        sheet.path(f"M{x - 5:.1f} {top + height + 5:.1f}l4-10m2 10l4-10", "axis")
    sheet.text(panels[0].box[0], 14, "time in UTC", css="t s")


def values(sheet: Sheet, panel: SvgPanel, axis: TimeAxis, lines: Sequence[Line], key: str) -> int:
    """Draw series into a panel; return the number of values beyond its limits."""
    sheet.clipped(panel, lambda: _draw(sheet, panel, axis, lines), key)
    low, high = panel.y.ends
    finite = _finite([line.value for line in lines])
    return int(np.count_nonzero((finite < low) | (finite > high)))


def _draw(sheet: Sheet, panel: SvgPanel, axis: TimeAxis, lines: Sequence[Line]) -> None:
    for line in lines:
        _rejected(sheet, panel, axis, line)
    for index, line in enumerate(lines):
        x, y = panel.x(axis.x(line.time)), panel.y(line.value)
        low, high = panel.y(line.value - line.error), panel.y(line.value + line.error)
        parts = segments(line.time)
        if line.time.size > _BARS:
            for part in parts:
                sheet.path(svg.band(x[part], low[part], high[part]), f"band c{index}")
        else:
            bars = "".join(
                f"M{a:.1f} {b:.1f}V{c:.1f}"
                for a, b, c in zip(x.tolist(), low.tolist(), high.tolist(), strict=True)
                if np.isfinite(a + b + c)
            )
            sheet.path(bars, f"err c{index}")
        sheet.path("".join(svg.line(x[part], y[part]) for part in parts), f"line c{index}")
        if line.time.size <= _BARS:
            sheet.path(svg.marks(x, y, svg.MARKS[index]), f"mark c{index}")


def _rejected(sheet: Sheet, panel: SvgPanel, axis: TimeAxis, line: Line) -> None:
    some = slice(None, None, max(1, -(-line.off_time.size // _CROSSES)))
    x, y = panel.x(axis.x(line.off_time[some])), panel.y(line.off_value[some])
    sheet.path(svg.marks(x, y, svg.cross), "off")
    # Times without a value are marked by a short line at the bottom of the panel.
    foot = panel.box[1] + panel.box[3]
    lost = x[~np.isfinite(y)]
    sheet.path("".join(f"M{a:.1f} {foot:.1f}v-8" for a in lost.tolist()), "off")


def series_legend(sheet: Sheet, y: float, lines: Sequence[Line], x: float = LEFT + 110) -> None:
    """Draw the legend of series and flagged values."""
    rows = [
        (f"M-9 0H9{svg.MARKS[index](0.0, 0.0)}", f"mark line c{index}", line.label)
        for index, line in enumerate(lines)
    ]
    if any(line.off_time.size for line in lines):
        rows.append((svg.cross(0.0, 0.0), "off", "flagged"))
    svg.draw_legend(sheet, x, y, rows)


def in_words(lines: Sequence[Line], units: str) -> str:
    """Return the range of values and the number of flagged values of each series in words."""
    words = []
    for line in lines:
        good = _finite([line.value])
        reach = (
            f"{svg.number(float(good.min()))} to {svg.number(float(good.max()))} {units}"
            if good.size
            else "no unflagged value"
        )
        flagged = counted(line.off_time.size, "flagged value")
        words.append(f"{line.label}: {reach.strip()}, {flagged}".removeprefix(": "))
    return "; ".join(words)


def sparkline(lines: Sequence[Line]) -> Sheet:
    """Return series without axes, for a thumbnail."""
    width, height = svg.THUMB
    sheet = Sheet(height=height, width=width)
    times = np.unique(np.concatenate([line.time for line in lines]))
    low, high = limits(lines)
    if times.size == 0:
        sheet.text(width / 2, height / 2 + 5, "no unflagged value", css="t m")
        return sheet
    first, last = times[0].astype(np.int64), times[-1].astype(np.int64)
    x = Scale(float(first), float(max(last, first + 1)), 6, width - 6)
    y = Scale(low, high, height - 5, 5)
    for index, line in enumerate(lines):
        some = slice(None, None, max(1, -(-line.time.size // 150)))
        at = x(line.time[some].astype(np.int64).astype(np.float64))
        sheet.path(svg.marks(at, y(line.value[some]), svg.MARKS[index]), f"mark c{index}")
    return sheet


@dataclass(frozen=True, slots=True)
class Quantity:
    """A quantity of series in one of two panels."""

    name: str
    factor: float
    """From the unit of the series to the displayed unit."""
    units: str


def stacked_page(
    series: Sequence[TimeSeries], quantities: Sequence[Quantity], title: str
) -> PageFigures:
    """Draw one or two quantities of series against time, a few series per figure.

    Parameters
    ----------
    series : sequence of TimeSeries
        At least one.
    quantities : sequence of Quantity
        The thumbnail shows the first.
    title : str
        Start of the captions.
    """
    drawn = []
    for number, first in enumerate(range(0, len(series), SERIES), start=1):
        sheet, words = _stack(series[first : first + SERIES], quantities, f"f{number}")
        drawn.append(Drawn.of(sheet, f"{title} against time", words, f"f{number}"))
    main = quantities[0]
    lines = [line_of(part, main.name, main.factor) for part in series[:SERIES]]
    name = main.name.replace("_", " ").capitalize()
    alt = f"{name} against time. {in_words(lines, main.units)}"
    return PageFigures(tuple(drawn), sparkline(lines), alt)


def _stack(
    series: Sequence[TimeSeries], quantities: Sequence[Quantity], key: str
) -> tuple[Sheet, str]:
    axis = time_axis(np.unique(np.concatenate([part.time for part in series])))
    places = ((268, 28), (466, 292)) if len(quantities) > 1 else ((330, 28),)
    sheet = Sheet(height=places[-1][0] + _LABELS)
    drawn: list[tuple[str, SvgPanel, list[Line]]] = []
    for quantity, (foot, top) in zip(quantities, places, strict=True):
        name, unit = quantity.name.replace("_", " "), quantity.units
        lines = [line_of(part, quantity.name, quantity.factor) for part in series]
        panel = SvgPanel(time_scale(axis), Scale(*limits(lines), foot, top))
        sheet.frame(panel, f"{name} ({unit})" if unit not in ("", "1") else name)
        drawn.append((name, panel, lines))
    draw_time_ticks(sheet, axis, [panel for _, panel, _ in drawn])
    words = [in_words(drawn[0][2], quantities[0].units)]
    for name, panel, lines in drawn:
        beyond = values(sheet, panel, axis, lines, f"{key}-{name.replace(' ', '-')}")
        if beyond:
            words.append(f"{counted(beyond, 'value')} of {name} beyond the axis")
    series_legend(sheet, 14, drawn[0][2])
    return sheet, "; ".join(words)
