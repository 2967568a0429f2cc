"""Panels of images: a quantity against time and range or altitude."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.figures.panels import (
    NEGATIVE,
    REJECTED,
    Axis,
    Curve,
    Figure,
    Image,
    Mark,
    Panel,
    codes_of,
    time_axis,
    units,
)
from lidarops.figures.raster import Kept, Raster
from lidarops.figures.time_axis import days
from lidarops.figures.wording import percent

Floats = NDArray[np.float64]
Line = tuple[float, float]
"""Altitude at range 0, m, and its change per m of range."""

_HEIGHT: Final = 306
_HALF: Final = 0.5
"""Share of the filled time that was measured, below which the words state it."""
_NO_TIME: Final = np.timedelta64(0, "ns")
_UPRIGHT: Final = 0.05
"""Change of altitude with range, below which altitude is no useful axis."""
_BEYOND: Final = 1.2
"""A signal is shown to this many times its reach."""
_DECADES: Final = 4.0
"""Most decades of a colour scale."""


@dataclass(frozen=True, slots=True)
class ImageQuantity:
    """A quantity as an image shows it."""

    name: str
    """In words."""
    factor: float = 1.0
    """From the unit of the product to the displayed unit."""
    units: str = ""
    """Displayed unit; empty for that of the product."""
    limits: tuple[float, float] | None = None
    """Ends of the colour scale in the displayed unit, the same in all products, so that their
    images can be compared; None for those of the data, where a scale has no absolute meaning."""
    farthest: float = np.inf
    """Farthest range that is shown, m, so that the lowest kilometres can be told apart."""


def image_figure(rasters: Sequence[Raster], quantity: ImageQuantity, along: str) -> Figure:
    """Return a quantity against time and `along`, ``range`` or ``altitude``.

    Parameters
    ----------
    rasters : sequence of Raster
        At least one, of one instrument and channel.
    quantity : ImageQuantity
    along : str

    Returns
    -------
    Figure
        Block means on a logarithmic colour scale, up to the range where noise dominates; against
        altitude where the beam is not nearly horizontal. Rejected bins are light grey, means at or
        below zero dark grey, times without measurement empty; triangles mark the lowest cloud
        bases.
    """
    x = time_axis(*(np.concatenate([getattr(r, edge) for r in rasters]) for edge in _ENDS))
    full = min(max(float(raster.edges[-1]) for raster in rasters), quantity.farthest)
    reach = max(raster.reach for raster in rasters)
    # Of a quantity that noise hides, such as particles of clean air, all usable bins are shown.
    last = reach or max(raster.usable_to for raster in rasters)
    far = min(full, _BEYOND * last) if last > 0 else full
    shown = Kept(raster.shown_to(far) for raster in rasters)
    near = min(float(raster.edges[0]) for raster in shown)
    far = max(float(raster.edges[-1]) for raster in shown)
    values = quantity.factor * np.concatenate([r.mean[~r.flagged] for r in shown], axis=None)
    ends = quantity.limits or colour_limits(values)
    line = _altitude(rasters)
    name = along if line is None else "altitude"
    y = Axis(f"{name} (km)", *np.sort(_kilometres(line, np.array([near, far]))).tolist())
    label = f"{quantity.name} ({quantity.units or units(rasters[0].units)})"
    panel = Panel(
        x,
        y,
        (*_images(shown, quantity.factor, ends, line), *_clouds(shown, line)),
        height=_HEIGHT,
        bar=Axis(label, *ends, log=True) if ends else None,
    )
    words = ["Dark grey at or below zero", *_in_words(shown, reach)]
    if not (values > 0).any():
        words[0] = "No usable value above zero"
    title = f"{quantity.name[:1].upper()}{quantity.name[1:]}"
    return Figure(f"{title} against time and {name}", "; ".join(words), (panel,))


_ENDS: Final = ("start", "stop")


def _images(
    rasters: Sequence[Raster], factor: float, ends: tuple[float, float] | None, line: Line | None
) -> Iterator[Image]:
    known: dict[bytes, Floats] = {}
    for raster in rasters:
        mean = factor * raster.mean
        shares = np.full(mean.shape, np.nan)
        if ends is not None:
            low, high = ends
            shares = np.log(np.clip(mean, low, high) / low) / np.log(high / low)
        codes = np.where(mean <= 0.0, NEGATIVE, codes_of(shares))
        codes = np.where(raster.flagged, REJECTED, codes).astype(np.uint8)
        edges = _kilometres(line, raster.edges)
        if edges[-1] < edges[0]:
            codes, edges = codes[:, ::-1], edges[::-1]
        edges = known.setdefault(edges.tobytes(), edges)
        yield Image(codes, days(raster.start), days(raster.stop), edges)


def _kilometres(line: Line | None, ranges: Floats) -> Floats:
    """Return altitude, km, at ranges, m; without a line the ranges."""
    start, slope = line or (0.0, 1.0)
    return np.asarray((start + slope * ranges) / 1e3)


def _clouds(rasters: Sequence[Raster], line: Line | None) -> list[Curve]:
    base = _kilometres(line, np.concatenate([raster.clouds for raster in rasters]))
    if not np.isfinite(base).any():
        return []
    time = np.concatenate([raster.start + (raster.stop - raster.start) / 2 for raster in rasters])
    label = "base of the lowest cloud or dense layer"
    return [Curve(days(time), base, "cloud", Mark.DOWN, joined=False, label=label)]


def _altitude(rasters: Sequence[Raster]) -> Line | None:
    """Return altitude at range 0 and its change with range, if all rasters have the same."""
    lines = {raster.altitude for raster in rasters}
    line = lines.pop() if len(lines) == 1 else None
    return None if line is None or abs(line[1]) < _UPRIGHT else line


def _in_words(rasters: Sequence[Raster], reach: float) -> Iterator[str]:
    if reach > 0:
        yield f"noise dominates beyond {reach / 1e3:.3g} km"
    measured = sum((raster.profiles.sum() * raster.length for raster in rasters), _NO_TIME)
    drawn = sum(((raster.stop - raster.start).sum() for raster in rasters), _NO_TIME)
    if measured < _HALF * drawn:
        yield f"measured in {percent(float(measured / drawn))} of the time that is filled"
    flagged = float(np.concatenate([raster.flagged for raster in rasters], axis=None).mean())
    if flagged:
        yield f"light grey, {percent(flagged)}: not to use"
    clouds = np.concatenate([raster.clouds for raster in rasters])
    if np.isfinite(clouds).any():
        known = int(np.isfinite(clouds).sum())
        yield f"cloud base in {known} of {clouds.size} columns (triangles)"


def colour_limits(values: Floats) -> tuple[float, float] | None:
    """Return round ends of a logarithmic colour scale for `values`; None if none is positive."""
    positive = values[np.isfinite(values) & (values > 0)]
    if positive.size == 0:
        return None
    low, high = (float(level) for level in np.percentile(positive, [2.0, 99.8]))
    high = _round(max(high, 1.05 * low), up=True)
    return _round(max(low, high * 10.0**-_DECADES), up=False), high


def _round(value: float, *, up: bool) -> float:
    """Return the next 1, 2 or 5 times a power of ten that is not below, or not above, a value."""
    power = 10.0 ** np.floor(np.log10(value))
    rounded = [float(power * step) for step in (1.0, 2.0, 5.0, 10.0)]
    # A value that is round already stays, also where its power is off by a rounding error.
    if up:
        return next(step for step in rounded if step >= value * (1.0 - 1e-9))
    return next(step for step in rounded[::-1] if step <= value * (1.0 + 1e-9))
