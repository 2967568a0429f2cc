"""Time axes of figures: UTC; gaps stay gaps, and are cut out and marked if they dominate."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.datetime64]
Floats = NDArray[np.float64]

_GAP: Final = 2.5
"""An interval between profiles of more than this many usual intervals is a gap."""
_SPARSE: Final = 0.35
"""If measurements cover less than this share of the span, gaps are cut out of the axis."""
_NARROWEST: Final = 1.0 / 250.0
"""Smallest width of a stretch of measurements, as a share of all stretches."""
_DAY: Final = np.timedelta64(1, "D")
_MINUTES: Final = (1, 2, 5, 10, 15, 30, 60, 120, 180, 360, 720, 1440, 2880, 7200, 14400)
_MONTHS: Final = (1, 2, 3, 6, 12, 24, 60, 120)


@dataclass(frozen=True, slots=True)
class Tick:
    """A labelled position on the axis."""

    x: float
    label: str


@dataclass(frozen=True, slots=True)
class TimeAxis:
    """Positions of times along an axis, in days of measurement.

    An unbroken axis has one stretch, from the first to the last profile.
    """

    starts: Times
    """(stretch,) Start of each stretch."""
    stops: Times
    """(stretch,) End of each stretch."""
    left: Floats
    """(stretch,) Position where the stretch starts."""
    width: Floats
    """(stretch,) Length of the stretch along the axis."""

    @property
    def broken(self) -> bool:
        """Whether gaps are cut out."""
        return self.starts.size > 1

    @property
    def limits(self) -> tuple[float, float]:
        """First and last position."""
        return float(self.left[0]), float(self.left[-1] + self.width[-1])

    @property
    def breaks(self) -> Floats:
        """Positions in the middle of the cut gaps."""
        return 0.5 * (self.left[1:] + (self.left + self.width)[:-1])

    def x(self, time: Times) -> Floats:
        """Return positions of times; times inside a cut gap lie at its start.

        Parameters
        ----------
        time : ndarray of datetime64
            Any shape.
        """
        index = np.clip(np.searchsorted(self.starts, time, side="right") - 1, 0, None)
        spans = (self.stops - self.starts) / _DAY
        share = ((time - self.starts[index]) / _DAY) / spans[index]
        return np.asarray(self.left[index] + np.clip(share, 0.0, 1.0) * self.width[index])

    def ticks(self, at_most: int = 8) -> list[Tick]:
        """Return labelled positions at round UTC times; the date is shown once per day."""
        times = self._round_times(at_most)
        least = (self.limits[1] - self.limits[0]) / (at_most + 2)
        kept: list[np.datetime64] = []
        last = -np.inf
        for time, position in zip(times, self.x(times), strict=True):
            if position - last >= least:
                kept.append(time)
                last = position
        labels = _labels(np.array(kept, dtype="datetime64[m]"))
        positions = self.x(np.array(kept, dtype="datetime64[ns]"))
        return [Tick(float(x), label) for x, label in zip(positions, labels, strict=True)]

    def _round_times(self, at_most: int) -> Times:
        measured = float(((self.stops - self.starts) / np.timedelta64(1, "m")).sum())
        step = next((m for m in _MINUTES if measured / m <= at_most), None)
        times: list[Times] = []
        for start, stop in zip(self.starts, self.stops, strict=True):
            inside = _multiples(start, stop, step, measured, at_most)
            times.append(inside if inside.size else np.array([start]))
        return np.concatenate(times)


def segments(time: Times) -> list[slice]:
    """Split sorted times at gaps.

    Parameters
    ----------
    time : ndarray of datetime64, shape (n,)
        Middles of profiles, rising.

    Returns
    -------
    list of slice
        One per stretch without a gap, in order; empty for no times.
    """
    if time.size == 0:
        return []
    cuts = 1 + np.flatnonzero(np.diff(time) > _GAP * usual_step(time))
    edges = [0, *(int(cut) for cut in cuts), time.size]
    return [slice(start, stop) for start, stop in pairwise(edges)]


def usual_step(time: Times) -> np.timedelta64:
    """Return the median interval of sorted times; one minute if there is none."""
    steps = np.diff(time.astype("datetime64[ns]").astype(np.int64))
    steps = steps[steps > 0]
    return np.timedelta64(int(np.median(steps)) if steps.size else 60_000_000_000, "ns")


def time_axis(time: Times, bounds: tuple[Times, Times] | None = None) -> TimeAxis:
    """Lay out an axis for sorted times; gaps are cut out if they take most of the span.

    Parameters
    ----------
    time : ndarray of datetime64, shape (n,)
        Middles of profiles, rising; at least one.
    bounds : tuple of ndarray, optional
        Start and end of each profile; by default half the usual step around it.
    """
    half = usual_step(time) / 2
    start, stop = bounds or (time - half, time + half)
    stretches = segments(time)
    starts = np.asarray(start[[s.start for s in stretches]])
    stops = np.asarray([stop[s].max() for s in stretches])
    # A single profile without a length still needs a place.
    stops = np.where(stops > starts, stops, starts + 2 * half)
    spans = (stops - starts) / _DAY
    if spans.sum() >= _SPARSE * ((stops[-1] - starts[0]) / _DAY):
        whole = (stops[-1] - starts[0]) / _DAY
        return TimeAxis(starts[:1], stops[-1:], np.zeros(1), np.array([whole]))
    width = np.maximum(spans, spans.sum() * _NARROWEST)
    gap = min(0.04, 0.3 / (len(stretches) - 1)) * width.sum()
    left = np.concatenate([[0.0], np.cumsum(width + gap)[:-1]])
    return TimeAxis(starts, stops, left, width)


def _multiples(
    start: np.datetime64, stop: np.datetime64, step: int | None, measured: float, at_most: int
) -> Times:
    if step is not None:
        first = start.astype("datetime64[m]").astype(np.int64)
        last = stop.astype("datetime64[m]").astype(np.int64)
        units = np.arange(-(-first // step) * step, last + 1, step)
        times = units.astype("datetime64[m]").astype("datetime64[ns]")
    else:
        months = next((m for m in _MONTHS if measured / (m * 43_830) <= at_most), _MONTHS[-1])
        first = start.astype("datetime64[M]").astype(np.int64)
        last = stop.astype("datetime64[M]").astype(np.int64)
        units = np.arange(-(-first // months) * months, last + 1, months)
        times = units.astype("datetime64[M]").astype("datetime64[ns]")
    return np.asarray(times[(times >= start) & (times <= stop)])


def _labels(times: Times) -> list[str]:
    days = times.astype("datetime64[D]")
    clock = bool((times != days).any())
    labels: list[str] = []
    for i, (time, day) in enumerate(zip(times, days, strict=True)):
        new = i == 0 or days[i - 1] != day
        parts = [str(time)[11:16]] if clock else []
        parts += [str(day)] if new else []
        labels.append("\n".join(parts))
    return labels
