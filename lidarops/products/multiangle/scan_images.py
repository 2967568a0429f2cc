"""Images of scans: range-corrected signal over distance and height, and over the map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.kind_figures import ProductSource
from lidarops.figures.panels import Axis, Curve, Figure, Image, Layer, Mark, Panel, codes_of, finite
from lidarops.figures.series_data import require
from lidarops.figures.wording import counted, utc
from lidarops.retrieve.multiangle.scan_cycles import vertical_planes
from lidarops.retrieve.multiangle.slant_paths import slant_path

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

VARIABLES: Final = (
    "time",
    "altitude",
    "station_altitude",
    "beam_zenith_angle",
    "beam_azimuth",
    "beam_signal",
    "beam_obstruction",
    "residual",
)
"""Variables that `read_scan_image` needs."""
_WIDTH: Final = 400
"""Columns of an image."""
_RHI_HEIGHT: Final = 170
_PPI_HEIGHT: Final = 420
_PPI_ROWS: Final = 300
_MOST_PLANES: Final = 4
_FEWEST_AZIMUTHS: Final = 3
"""Beams at one elevation that make a map."""
_SAME_ELEVATION: Final = 0.25
"""degree."""
_BESIDE: Final = 0.51
"""A beam fills pixels to this share of the step to the next one."""
_SHOWN: Final = (2.0, 98.0)
"""Percentiles of the signals at the ends of the colours; far signals are mostly noise."""
_BEHIND: Final = 1.5
"""A panel shows at least this many times the range of an obstruction."""
_ASPECT: Final = 1.75
"""Width over height of a map."""


@dataclass(frozen=True, slots=True)
class ScanImage:
    """The signals of the beams of a scan, those of a vertical plane from one cycle."""

    time: NDArray[np.datetime64]
    """(beam,) UTC, of the cycle."""
    height: Floats
    """(altitude,) m above the station."""
    zenith_angle: Floats
    """(beam,) degree."""
    azimuth: Floats
    """(beam,) degree."""
    signal: Floats
    """(beam, altitude) Range-corrected; NaN where it is not used."""
    obstruction: Floats
    """(beam,) m, range from which the beam is blocked; NaN for a free beam."""

    @property
    def distance(self) -> Floats:
        """(beam, altitude) m, horizontal distance from the lidar."""
        path = slant_path(self.zenith_angle, self.height) * self.height
        return np.asarray(path * np.sin(np.radians(self.zenith_angle))[:, np.newaxis])


def read_scan_image(product: xr.Dataset, _: ProductSource) -> ScanImage | None:
    """Return the beams of each vertical plane from the cycle with its most signals.

    None without azimuths or signals.

    Raises
    ------
    ProductError
        If a variable is missing or has other dimensions.
    """
    require(product, {"residual": ("time", "beam", "altitude"), "beam_zenith_angle": ("beam",)})
    if not {"beam_azimuth", "station_altitude", "beam_signal"} <= set(product.variables):
        return None
    count = product["residual"].notnull().sum("altitude").values
    height = product["altitude"].values - float(product["station_altitude"])
    zenith_angle, azimuth = (
        product[name].values.astype(np.float64) for name in ("beam_zenith_angle", "beam_azimuth")
    )
    cycle = np.zeros(zenith_angle.size, dtype=np.int64)
    obstruction = np.full(count.shape, np.nan)
    if "beam_obstruction" in product.variables:
        obstruction = product["beam_obstruction"].transpose("time", "beam").values.astype(float)
    blocked = np.isfinite(obstruction)
    for beams in vertical_planes(zenith_angle, azimuth):
        # All beams of a plane may be blocked where they begin.
        signals = count[:, beams].sum(axis=1) + 0.5 * blocked[:, beams].any(axis=1)
        cycle[beams] = np.argmax(signals)
    everything = np.arange(cycle.size)
    used = np.flatnonzero((count[cycle, everything] > 0) | blocked[cycle, everything])
    if not count[cycle, everything].any():
        return None
    which = {
        "time": xr.DataArray(cycle[used], dims="beam"),
        "beam": xr.DataArray(used, dims="beam"),
    }
    signal, residual = (
        product[name].isel(which).transpose("beam", "altitude").values.astype(np.float64)
        for name in ("beam_signal", "residual")
    )
    return ScanImage(
        product["time"].values.astype("datetime64[ns]")[cycle[used]],
        height,
        zenith_angle[used],
        azimuth[used],
        np.where(np.isfinite(residual) & (signal > 0.0), signal, np.nan),
        obstruction[cycle[used], used],
    )


def draw_scan_images(images: Sequence[ScanImage]) -> list[Figure]:
    """Return range-height images (RHI) of the vertical planes, and a map (PPI) of a volume."""
    image = images[0]
    lit = np.asarray(np.isfinite(image.signal).any(axis=1))
    every = vertical_planes(image.zenith_angle, image.azimuth)
    planes = [beams for beams in every if lit[beams].any()]
    if not planes:
        return []
    low, high = (float(end) for end in np.percentile(finite([image.signal]), _SHOWN))
    ends = low, max(high, 1.05 * low)
    shown = planes[:: -(-len(planes) // _MOST_PLANES)]
    panels = tuple(_range_height(image, beams, ends) for beams in shown)
    words = (
        f"{counted(len(shown), 'vertical plane')} of {len(planes)}; each beam is shown as far as"
        " its signal is used"
    )
    obstruction = image.obstruction[np.concatenate(shown)]
    blocked = obstruction[np.isfinite(obstruction)]
    if blocked.size:
        words += (
            f"; {counted(blocked.size, 'beam')} blocked, from {blocked.min():.0f} m: crosses, and"
            " lines behind"
        )
    if len(planes) < len(every):
        words += f"; {len(every) - len(planes)} more, blocked where the beams begin"
    figures = [Figure("Range-height scans (RHI)", words, panels)]
    beams = _of_one_elevation(image)
    if beams.size >= _FEWEST_AZIMUTHS and len(planes) >= _FEWEST_AZIMUTHS:
        elevation = 90.0 - float(np.mean(image.zenith_angle[beams]))
        words = f"{counted(beams.size, 'beam')} at an elevation of {elevation:.3g} degrees"
        caption = f"Plan-position scan (PPI) at {utc(image.time[beams[0]])}"
        figures.append(Figure(caption, words, (_plan_position(image, beams, ends),)))
    return figures


def _range_height(image: ScanImage, beams: Indices, ends: tuple[float, float]) -> Panel:
    """Return the signal of a vertical plane over signed horizontal distance and height."""
    zenith, azimuth = image.zenith_angle[beams], image.azimuth[beams]
    toward = float(azimuth[np.argmax(zenith)])
    side = np.where(np.cos(np.radians(azimuth - toward)) < 0.0, -1.0, 1.0)
    reached = np.where(np.isfinite(image.signal[beams]), image.distance[beams], 0.0)
    turned = np.radians(zenith)
    # Behind an obstruction, the panel goes on.
    shadow = _BEHIND * np.nan_to_num(image.obstruction[beams])
    reached = side * np.maximum(reached.max(axis=1), shadow * np.sin(turned))
    top = max(_top(image, beams), float((shadow * np.cos(turned)).max()))
    x = Axis(
        f"horizontal distance toward azimuth {toward:.0f}° (km)",
        min(float(reached.min()), 0.0) / 1e3,
        max(float(reached.max()), 1.0) / 1e3,
    )
    y = Axis("height (km)", 0.0, top / 1e3)
    along, up = _pixels(x, _WIDTH), _pixels(y, _RHI_HEIGHT)[:, np.newaxis]
    angle = np.degrees(np.arctan2(along, up))
    nearest = _nearest(angle, side * zenith)
    panel = _panel(image, beams, nearest, up * np.ones_like(angle), (x, y), ends)
    shadows = _shadows(image.obstruction[beams], side * np.sin(turned), np.cos(turned), (x, y))
    return replace(panel, layers=panel.layers + shadows, title=utc(image.time[beams[0]]))


def _plan_position(image: ScanImage, beams: Indices, ends: tuple[float, float]) -> Panel:
    """Return the signal of beams at one elevation on the map."""
    known = np.isfinite(image.signal[beams])
    far = np.where(known, image.distance[beams], 0.0).max(axis=1) / 1e3
    turned = np.radians(image.azimuth[beams])
    half_sector = np.radians(_BESIDE * _usual_step(image.azimuth[beams]))
    sides = turned[:, np.newaxis] + half_sector * np.array([-1.0, 0.0, 1.0])
    spans = [np.append(far[:, np.newaxis] * side, 0.0) for side in (np.sin(sides), np.cos(sides))]
    half = 0.5 * max(float(np.ptp(spans[0])) / _ASPECT, float(np.ptp(spans[1])), 1e-3)
    x, y = (
        Axis(f"to the {side} (km)", middle - extent, middle + extent)
        for side, middle, extent in zip(
            ("east", "north"),
            (0.5 * float(span.min() + span.max()) for span in spans),
            (_ASPECT * half, half),
            strict=True,
        )
    )
    east, north = _pixels(x, _WIDTH), _pixels(y, _PPI_ROWS)[:, np.newaxis]
    turn = np.degrees(np.arctan2(east, north)) % 360.0
    nearest = _nearest(turn, image.azimuth[beams], period=360.0)
    middle = beams[0]
    height = np.interp(np.hypot(east, north), image.distance[middle], image.height, right=np.inf)
    panel = _panel(image, beams, nearest, height, (x, y), ends, size=_PPI_HEIGHT)
    level = np.sin(np.radians(image.zenith_angle[beams]))
    towards = level * np.sin(turned), level * np.cos(turned)
    shadows = _shadows(image.obstruction[beams], *towards, (x, y))
    return replace(panel, layers=panel.layers + shadows, to_scale=True)


def _shadows(
    obstruction: Floats, along: Floats, up: Floats, axes: tuple[Axis, Axis]
) -> tuple[Layer, ...]:
    """Return crosses where beams are blocked, and lines from there to the edge of the panel.

    `along` and `up` are the steps of the beams on both axes per step along the beam.
    """
    blocked = np.flatnonzero(np.isfinite(obstruction))
    if not blocked.size:
        return ()
    start = obstruction[blocked] / 1e3
    steps = along[blocked], up[blocked]
    with np.errstate(divide="ignore"):
        limits = [
            np.where(step > 0.0, axis.high / step, np.where(step < 0.0, axis.low / step, np.inf))
            for step, axis in zip(steps, axes, strict=True)
        ]
    end = np.maximum(np.minimum(*limits), start)
    gap = np.full(blocked.size, np.nan)
    x, y = (np.stack([start * step, end * step, gap], axis=-1).ravel() for step in steps)
    label = f"blocked: {counted(blocked.size, 'beam')}"
    return (
        Curve(x, y, "soft d1"),
        Curve(start * steps[0], start * steps[1], "ink", Mark.CROSS, joined=False, label=label),
    )


def _panel(
    image: ScanImage,
    beams: Indices,
    nearest: Indices,
    height: Floats,
    axes: tuple[Axis, Axis],
    ends: tuple[float, float],
    size: int = _RHI_HEIGHT,
) -> Panel:
    """Return the panel whose pixels have a beam (-1 for none) and a height in m."""
    row = np.clip(np.searchsorted(image.height, height), 0, image.height.size - 1)
    seen = (nearest >= 0) & (height <= image.height[-1])
    value = np.log(np.where(seen, image.signal[beams[nearest], row], np.nan))
    low, high = np.log(ends)
    share = (value - low) / (high - low)
    bar = Axis("range-corrected signal", *ends, log=True)
    x, up = (
        np.linspace(axis.low, axis.high, n + 1) for axis, n in zip(axes, share.T.shape, strict=True)
    )
    return Panel(*axes, (Image(codes_of(share.T), x[:-1], x[1:], up),), height=size, bar=bar)


def _top(image: ScanImage, beams: Indices) -> float:
    """Return the highest altitude above the station with a signal, m."""
    known = np.isfinite(image.signal[beams]).any(axis=0)
    return float(image.height[known].max(initial=image.height[0]))


def _pixels(axis: Axis, count: int) -> Floats:
    """Return the middles of pixels along an axis in km, m."""
    return np.asarray(1e3 * (axis.low + (np.arange(count) + 0.5) / count * (axis.high - axis.low)))


def _nearest(angle: Floats, angles: Floats, period: float = np.inf) -> Indices:
    """Return the nearest of the angles to each pixel; -1 where none is near."""
    best, least = np.full(angle.shape, -1), np.full(angle.shape, _BESIDE * _usual_step(angles))
    for number, own in enumerate(angles):
        off = np.abs(angle - own)
        off = np.minimum(off, period - off) if np.isfinite(period) else off
        best, least = np.where(off <= least, number, best), np.minimum(off, least)
    return np.asarray(best, dtype=np.int64)


def _usual_step(angles: Floats) -> float:
    """Return the median step between neighbours, degree; 1 for a single angle."""
    return float(np.median(np.diff(np.sort(angles)))) if angles.size > 1 else 1.0


def _of_one_elevation(image: ScanImage) -> Indices:
    """Return the beams of the elevation with the most azimuths, the lowest of equals."""

    def groups() -> Iterator[Indices]:
        for angle in image.zenith_angle:
            yield np.flatnonzero(np.abs(image.zenith_angle - angle) <= _SAME_ELEVATION)

    return max(groups(), key=lambda beams: (beams.size, image.zenith_angle[beams[0]]))
