"""Panels of images: a quantity against time and range or altitude, and the background below."""

from __future__ import annotations

from collections.abc import Sequence
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
    finite,
    number,
    time_axis,
    units,
)
from lidarops.figures.raster import BEYOND, Raster, colour_limits, share_with_care
from lidarops.figures.series_panels import Quantity, background_panel
from lidarops.figures.time_axis import days
from lidarops.figures.wording import percent
from lidarops.flags import Quality, Severity

Floats = NDArray[np.float64]

_HEIGHT: Final = 306
_HALF: Final = 0.5
"""Share of the filled time that was measured, below which the words state it."""
_NO_TIME: Final = np.timedelta64(0, "ns")
_UPRIGHT: Final = 0.05
"""Change of altitude with range, below which altitude is no useful axis."""


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
    background: bool = True
    """Whether the background is drawn below."""
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
        altitude, with range at the right, where the beam is not nearly horizontal. Rejected bins
        are light grey, means at or below zero dark grey, times without measurement empty;
        triangles mark the lowest cloud bases.
    """
    x = time_axis(*(np.concatenate([getattr(r, edge) for r in rasters]) for edge in _ENDS))
    full = min(max(float(raster.edges[-1]) for raster in rasters), quantity.farthest)
    reach = max(raster.reach for raster in rasters)
    # Of a quantity that noise hides, such as particles of clean air, all usable bins are shown.
    last = reach or max(raster.usable_to for raster in rasters)
    far = min(full, BEYOND * last) if last > 0 else full
    shown = [raster.shown_to(far) for raster in rasters]
    near = min(float(raster.edges[0]) for raster in shown)
    far = max(float(raster.edges[-1]) for raster in shown)
    values = quantity.factor * np.concatenate([r.mean[~r.flagged] for r in shown], axis=None)
    ends = quantity.limits or colour_limits(values)
    altitude = _altitude(rasters)
    line = altitude or (0.0, 1.0)
    y, right = Axis(f"{along} (km)", near / 1e3, far / 1e3), None
    if altitude is not None:
        y, right = Axis("altitude (km)", *_kilometres(line, np.array([near, far])).tolist()), y
    label = f"{quantity.name} ({quantity.units or units(rasters[0].units)})"
    main = Panel(
        x,
        y,
        (*(_image(raster, quantity.factor, ends, line) for raster in shown), *_clouds(shown, line)),
        height=_HEIGHT,
        right=right,
        bar=Axis(label, *ends, log=True) if ends else None,
        note="" if (values > 0).any() else "no usable value above zero",
    )
    lower = _background(rasters, x) if quantity.background else ()
    below = ", with the background below" if lower else ""
    name = f"{quantity.name[:1].upper()}{quantity.name[1:]}"
    caption = f"{name} against time and {along if altitude is None else 'altitude'}{below}"
    return Figure(caption, _in_words(rasters, shown, reach, ends, along), (main, *lower))


_ENDS: Final = ("start", "stop")


def _image(
    raster: Raster, factor: float, ends: tuple[float, float] | None, line: tuple[float, float]
) -> Image:
    mean = factor * raster.mean
    shares = np.full(mean.shape, np.nan)
    if ends is not None:
        low, high = ends
        shares = np.log(np.clip(mean, low, high) / low) / np.log(high / low)
    codes = np.where(mean <= 0.0, NEGATIVE, codes_of(shares))
    codes = np.where(raster.flagged, REJECTED, codes).astype(np.uint8)
    edges = _kilometres(line, raster.edges)
    if line[1] < 0.0:
        codes, edges = codes[:, ::-1], edges[::-1]
    return Image(codes, days(raster.start), days(raster.stop), edges)


def _kilometres(line: tuple[float, float], ranges: Floats) -> Floats:
    """Return altitude, km, at ranges, m, by the altitude at range 0 and its change per range."""
    return np.asarray((line[0] + line[1] * ranges) / 1e3)


def _clouds(rasters: Sequence[Raster], line: tuple[float, float]) -> list[Curve]:
    base = _kilometres(line, np.concatenate([raster.clouds for raster in rasters]))
    if not np.isfinite(base).any():
        return []
    time = days(np.concatenate([raster.time for raster in rasters]))
    label = "base of the lowest cloud or dense layer"
    return [Curve(time, base, "cloud", Mark.DOWN, joined=False, label=label)]


def _altitude(rasters: Sequence[Raster]) -> tuple[float, float] | None:
    """Return altitude at range 0 and its change with range, if all rasters have the same."""
    lines = {raster.altitude for raster in rasters}
    line = lines.pop() if len(lines) == 1 else None
    return None if line is None or abs(line[1]) < _UPRIGHT else line


def _background(rasters: Sequence[Raster], x: Axis) -> tuple[Panel, ...]:
    time, level, error = (
        np.concatenate([getattr(raster, name) for raster in rasters])
        for name in ("time", "background", "background_error")
    )
    order = np.argsort(time, kind="stable")
    if not finite([level]).size:
        return ()
    quantity = Quantity("background", 1.0, units(rasters[0].background_units))
    return (background_panel(x, quantity, time[order], level[order], error[order]),)


def _in_words(
    rasters: Sequence[Raster],
    shown: Sequence[Raster],
    reach: float,
    ends: tuple[float, float] | None,
    along: str,
) -> str:
    far = max(float(raster.edges[-1]) for raster in shown)
    words = [f"Shown to {along} {far / 1e3:.3g} km"]
    if reach > 0:
        words.append(f"noise dominates beyond {reach / 1e3:.3g} km")
    if ends:
        words.append(
            f"colour scale from {number(ends[0])} to {number(ends[1])}, dark grey at or below 0"
        )
    measured = sum((raster.profiles.sum() * raster.length for raster in rasters), _NO_TIME)
    drawn = sum(((raster.stop - raster.start).sum() for raster in rasters), _NO_TIME)
    if measured < _HALF * drawn:
        words.append(f"measured in {percent(float(measured / drawn))} of the time that is filled")
    bits = sorted({bit for raster in rasters for bit in raster.bits})
    names = {
        severity: ", ".join(
            b.word for b in bits if b.severity is severity and b.word != Quality.INPUT_MISSING.word
        )
        for severity in Severity
    }
    flagged = np.concatenate([raster.flagged for raster in shown], axis=None).mean()
    if flagged:
        words.append(f"light grey, {percent(float(flagged))}: flagged {names[Severity.REJECT]}")
    care = share_with_care(rasters)
    if care:
        words.append(f"{percent(care)} of all bins: use with care ({names[Severity.CARE]})")
    clouds = np.concatenate([raster.clouds for raster in rasters])
    if np.isfinite(clouds).any():
        known = int(np.isfinite(clouds).sum())
        words.append(f"cloud base in {known} of {clouds.size} columns (triangles)")
    return "; ".join(words)
