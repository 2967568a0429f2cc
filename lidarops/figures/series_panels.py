"""Panels of quantities against time: retrieved values with errors, and flags."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.figures.panels import (
    SERIES_MARKS,
    Axis,
    Band,
    Curve,
    Figure,
    Layer,
    Panel,
    axis_of_times,
    finite,
    flag_marks,
    percentile_axis,
    span_in_words,
)
from lidarops.figures.series_data import TimeSeries, thin
from lidarops.figures.time_axis import Times, days, segments
from lidarops.figures.wording import counted

Floats = NDArray[np.float64]

SERIES: Final = len(SERIES_MARKS)
"""Most series in a panel."""
_POINTS: Final = 300
"""More values than this are drawn as block means."""
_BARS: Final = 160
"""Most values with marks and error bars; more values get a band."""
_FLAGGED: Final = 300
"""Most flagged values that are marked."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """A quantity of series in a panel."""

    name: str
    factor: float
    """From the unit of the series to the displayed unit."""
    units: str

    @property
    def label(self) -> str:
        """Name and unit."""
        return f"{self.words} ({self.units})" if self.units not in ("", "1") else self.words

    @property
    def words(self) -> str:
        """Name as words."""
        return self.name.replace("_", " ")


def series_figures(
    series: Sequence[TimeSeries], quantities: Sequence[Quantity], caption: str
) -> Iterator[Figure]:
    """Yield figures of quantities against time, `SERIES` series in each, one panel per quantity."""
    for first in range(0, len(series), SERIES):
        few = series[first : first + SERIES]
        x = axis_of_times(np.unique(np.concatenate([one.time for one in few])))
        panels = [series_panel(x, few, quantity) for quantity in quantities]
        words = [series_in_words(few, quantities[0])]
        for quantity, panel in zip(quantities, panels, strict=True):
            good = finite([one.quantities[quantity.name][one.flag == 0] for one in few])
            values = quantity.factor * good
            beyond = np.count_nonzero((values < panel.y.low) | (values > panel.y.high))
            if beyond:
                words.append(f"{counted(int(beyond), 'value')} of {quantity.words} beyond the axis")
        yield Figure(f"{caption} against time", "; ".join(words), tuple(panels))


def series_panel(x: Axis, series: Sequence[TimeSeries], quantity: Quantity) -> Panel:
    """Return a quantity of up to `SERIES` series: unflagged values with errors, and flags."""
    name, factor = quantity.name, quantity.factor
    layers: list[Layer] = []
    for place, one in enumerate(series):
        layers += _values(one, quantity, place)
    parts = [
        (days(one.time), factor * one.quantities[name], one.flag, one.rejected) for one in series
    ]
    at, value, flag, rejected = (np.concatenate(part) for part in zip(*parts, strict=True))
    layers += flag_marks(at, value, (flag != 0) & ~rejected, rejected, _FLAGGED)
    good = [factor * one.quantities[name][one.flag == 0] for one in series]
    if not finite(good).size:
        good = [factor * one.quantities[name] for one in series]
    return Panel(x, percentile_axis(quantity.label, good), tuple(layers))


def _values(one: TimeSeries, quantity: Quantity, place: int) -> list[Layer]:
    """Return values with bars and marks if they are few, else with a band."""
    drawn = thin(one, _POINTS)
    profiles = round(int((one.flag == 0).sum()) / max(drawn.time.size, 1))
    means = f", means of {profiles} profiles" if profiles > 1 else ""
    few = drawn.time.size <= _BARS
    names = quantity.name, f"{quantity.name}_standard_error"
    x, y, wide = _with_gaps(
        drawn.time, *(quantity.factor * drawn.quantities[name] for name in names)
    )
    style, mark = f"c{place} d{place}" if place else "c0", SERIES_MARKS[place] if few else None
    label = f"{one.label}{means}".removeprefix(", ")
    band = Band(x, y - wide, y + wide, style, bars=few)
    return [band, Curve(x, y, style, mark, label=label)]


def _with_gaps(time: Times, *values: Floats) -> tuple[Floats, ...]:
    """Return positions and values with NaN at gaps, so that no line crosses a gap."""
    cuts = [stretch.start for stretch in segments(time)][1:]
    x = days(time)
    return np.insert(x, cuts, x[cuts]), *(np.insert(value, cuts, np.nan) for value in values)


def series_in_words(series: Sequence[TimeSeries], quantity: Quantity) -> str:
    """Return the span of usable values and the number of flagged values of each series."""
    words = []
    for one in series:
        usable = one.quantities[quantity.name][~one.rejected]
        span = span_in_words(quantity.factor * usable, quantity.units)
        flagged = counted(int(np.count_nonzero(one.flag)), "flagged value")
        words.append(f"{one.label}: {span}, {flagged}".removeprefix(": "))
    return "; ".join(words)
