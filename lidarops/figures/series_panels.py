"""Panels of quantities against time: retrieved values with errors, flags and truth."""

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
    Mark,
    Panel,
    Tick,
    axis_of_times,
    finite,
    number,
    percentile_axis,
    span_in_words,
)
from lidarops.figures.series_data import TimeSeries, compare, normalised_error, thin
from lidarops.figures.time_axis import Times, days, segments
from lidarops.figures.wording import counted, percent

Floats = NDArray[np.float64]

SERIES: Final = len(SERIES_MARKS)
"""Most series in a panel."""
_POINTS: Final = 600
"""More values than this are drawn as block means."""
_BARS: Final = 160
"""Most values with marks and error bars; more values get a band."""
_FLAGGED: Final = 300
"""Most flagged values that are marked."""
_SCORES: Final = 1500
"""Most normalised errors of a series that are marked, but for those beyond 3."""
_FAR_OFF: Final = 10.0
"""Larger normalised errors are drawn at this value."""


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
    for few in _some(series):
        x = axis_of_times(_times(few))
        panels = [series_panel(x, few, quantity) for quantity in quantities]
        words = [series_in_words(few, quantities[0])]
        for quantity, panel in zip(quantities, panels, strict=True):
            values = quantity.factor * finite([_usable(one, quantity.name) for one in few])
            beyond = np.count_nonzero((values < panel.y.low) | (values > panel.y.high))
            if beyond:
                words.append(f"{counted(int(beyond), 'value')} of {quantity.words} beyond the axis")
        yield Figure(f"{caption} against time", "; ".join(words), tuple(panels))


def series_panel(x: Axis, series: Sequence[TimeSeries], quantity: Quantity) -> Panel:
    """Return a quantity of up to `SERIES` series: unflagged values with errors, flags, truth."""
    name, factor = quantity.name, quantity.factor
    layers: list[Layer] = []
    for place, one in enumerate(series):
        layers += _values(one, quantity, place)
    truths = [_truth(one, quantity) for one in series]
    known = [truth for truth in truths if np.isfinite(truth.y).any()]
    layers += [
        Curve(k.x, k.y, k.style, label="" if i else "simulated truth") for i, k in enumerate(known)
    ]
    for label, style, mark, rejected in (
        ("use with care", "ink hollow", Mark.DISC, False),
        ("flagged, do not use", "soft hollow", Mark.CROSS, True),
    ):
        masks = [(one.flag != 0) & (one.rejected == rejected) for one in series]
        count = sum(int(mask.sum()) for mask in masks)
        if count:
            some = slice(None, None, -(-count // _FLAGGED))
            at = np.concatenate([days(one.time[m]) for one, m in zip(series, masks, strict=True)])
            value = np.concatenate(
                [one.estimates[name].value[m] for one, m in zip(series, masks, strict=True)]
            )
            words = f"{label}: {count:,}"
            marks = Curve(at[some], factor * value[some], style, mark, joined=False, label=words)
            layers.append(marks)
    good = [factor * _usable(one, name) for one in series]
    if not finite(good).size:
        good = [factor * one.estimates[name].value for one in series]
    y = percentile_axis(quantity.label, [*good, *(truth.y for truth in known)])
    return Panel(x, y, tuple(layers))


def background_panel(x: Axis, line: Quantity, time: Times, value: Floats, error: Floats) -> Panel:
    """Return a background against time with its standard error."""
    layers = _line(time, value, error, "c0", Mark.DISC, "")
    return Panel(x, percentile_axis(line.label, [value]), tuple(layers), height=110)


def score_figures(series: Sequence[TimeSeries], quantities: Sequence[str]) -> Iterator[Figure]:
    """Yield figures of (retrieved - truth) / standard error of unflagged values with a truth."""
    for few in _some(series):
        x = axis_of_times(_times(few))
        words = []
        panels = []
        for quantity in quantities:
            layers: list[Layer] = []
            for place, one in enumerate(few):
                comparison = compare(one, quantity)
                if comparison is not None:
                    share = f"{percent(comparison.within_3)} of {comparison.count:,} within 3"
                    label = f"{one.label}: {share}"
                    words.append(f"{quantity} {label} standard errors")
                    layers.append(_scores(one, quantity, place, label))
            if layers:
                largest = float(np.abs(finite([_y(layer) for layer in layers])).max(initial=3.6))
                panels.append(_score_panel(x, quantity, layers, 1.1 * largest))
        if panels:
            caption = "Unflagged values compared with the simulated truth"
            yield Figure(caption, "; ".join(words), tuple(panels))


def _y(layer: Layer) -> Floats:
    return layer.y if isinstance(layer, Curve) else np.array([])


def _scores(one: TimeSeries, quantity: str, place: int, label: str) -> Curve:
    score = np.where(one.flag == 0, normalised_error(one, quantity), np.nan)
    known = np.flatnonzero(np.isfinite(score))
    # Values beyond 3 are always drawn, the others thinned.
    shown = np.union1d(known[:: -(-known.size // _SCORES) or 1], known[np.abs(score[known]) > 3.0])
    far = int((np.abs(score[known]) > _FAR_OFF).sum())
    label += f", {far:,} beyond {_FAR_OFF:g} drawn there" if far else ""
    values = np.clip(score[shown], -_FAR_OFF, _FAR_OFF)
    x = days(one.time[shown])
    return Curve(x, values, f"c{place}", SERIES_MARKS[place], joined=False, label=label)


def _score_panel(x: Axis, quantity: str, layers: Sequence[Layer], limit: float) -> Panel:
    ends = np.array([x.low, x.high])
    levels = [Curve(ends, np.full(2, level), "ink thin d1") for level in (-3.0, 3.0)]
    one = Band(ends, np.full(2, -1.0), np.full(2, 1.0), "soft wide")
    ticks = tuple(
        Tick(level, number(level)) for level in (-6.0, -3.0, 0.0, 3.0, 6.0) if abs(level) < limit
    )
    name = quantity.replace("_", " ")
    y = Axis(f"{name}: error / \N{GREEK SMALL LETTER SIGMA}", -limit, limit, ticks=ticks)
    zero = Curve(ends, np.zeros(2), "ink thin")
    return Panel(x, y, (one, zero, *layers, *levels), height=150)


def _values(one: TimeSeries, quantity: Quantity, place: int) -> list[Layer]:
    drawn = thin(one, _POINTS)
    estimate = drawn.estimates[quantity.name]
    profiles = round(int((one.flag == 0).sum()) / max(drawn.time.size, 1))
    means = f", means of {profiles} profiles" if profiles > 1 else ""
    return _line(
        drawn.time,
        quantity.factor * estimate.value,
        quantity.factor * estimate.standard_error,
        f"c{place} d{place}" if place else "c0",
        SERIES_MARKS[place],
        f"{one.label}{means}".removeprefix(", "),
    )


def _line(
    time: Times, value: Floats, error: Floats, style: str, mark: Mark, label: str
) -> list[Layer]:
    """Return values with bars and marks if they are few, else with a band."""
    few = time.size <= _BARS
    x, y, wide = _with_gaps(time, value, error)
    band = Band(x, y - wide, y + wide, style, bars=few)
    return [band, Curve(x, y, style, mark if few else None, label=label)]


def _truth(one: TimeSeries, quantity: Quantity) -> Curve:
    truth = one.estimates[quantity.name].truth
    some = slice(None, None, -(-truth.size // _POINTS) or 1)
    x, y = _with_gaps(one.time[some], quantity.factor * truth[some])
    return Curve(x, y, "ink d1")


def _usable(one: TimeSeries, name: str) -> Floats:
    return np.asarray(one.estimates[name].value[one.flag == 0])


def _with_gaps(time: Times, *values: Floats) -> tuple[Floats, ...]:
    """Return positions and values with NaN at gaps, so that no line crosses a gap."""
    cuts = [stretch.start for stretch in segments(time)][1:]
    x = days(time)
    return np.insert(x, cuts, x[cuts]), *(np.insert(value, cuts, np.nan) for value in values)


def _some(series: Sequence[TimeSeries]) -> Iterator[Sequence[TimeSeries]]:
    for first in range(0, len(series), SERIES):
        yield series[first : first + SERIES]


def _times(series: Sequence[TimeSeries]) -> Times:
    return np.unique(np.concatenate([one.time for one in series]))


def series_in_words(series: Sequence[TimeSeries], quantity: Quantity) -> str:
    """Return the span of unflagged values and the number of flagged values of each series."""
    words = []
    for one in series:
        span = span_in_words(quantity.factor * _usable(one, quantity.name), quantity.units)
        flagged = counted(int(np.count_nonzero(one.flag)), "flagged value")
        words.append(f"{one.label}: {span}, {flagged}".removeprefix(": "))
    return "; ".join(words)
