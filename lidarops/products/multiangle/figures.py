"""The figures of the ``multiangle`` product: extinction, one profile, the signal of the scan.

The signal is shown over distance and height (RHI), or of a volume over the map (PPI).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.image_panels import ImageQuantity
from lidarops.figures.kind_figures import KindFigures, View, image_view
from lidarops.figures.panels import Axis, Curve, Figure, Image, Mark, Panel, codes_of, finite
from lidarops.figures.profile_panels import ProfileQuantity, profile_view
from lidarops.figures.raster import COLUMNS, ROWS
from lidarops.figures.series_data import require
from lidarops.figures.wording import counted, utc
from lidarops.retrieve.multiangle.scan_cycles import vertical_planes
from lidarops.retrieve.multiangle.slant_paths import slant_path

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

VARIABLES: Final = (
    *("time", "altitude", "station_altitude", "beam_zenith_angle", "beam_azimuth"),
    *("beam_signal", "beam_obstruction", "residual"),
)
"""Variables that `read_scan` needs."""
_HEIGHT: Final = 420
_FEWEST_AZIMUTHS: Final = 3
"""Beams at one elevation that make a map."""
_SAME_ELEVATION: Final = 0.25
"""degree."""
_BESIDE: Final = 0.51
"""A beam fills pixels to this share of the step to the next one."""
_SHOWN: Final = (2.0, 98.0)
"""Percentiles of the signals at the ends of the colours; far signals are mostly noise."""
_LEAST: Final = 100.0
"""m, least extent of an axis."""


@dataclass(frozen=True, slots=True)
class Scan:
    """The signals of beams that lie in a vertical plane, or have one elevation."""

    time: np.datetime64
    """UTC, of the cycle."""
    angle: Floats
    """(beam,) degree, of a plane from the zenith to one side, else clockwise from north."""
    elevation: float | None
    """degree, of all beams; None for those of a plane."""
    toward: float
    """degree, azimuth of the side of a plane to which angles are positive."""
    distance: Floats
    """(beam, altitude) m, along the beam, over the ground for beams of one elevation."""
    signal: Floats
    """(beam, altitude) Range-corrected; NaN where it is not used."""
    obstruction: Floats
    """(beam,) m, range from which the beam is blocked; NaN for a free beam."""


def read_scan(product: xr.Dataset, _: int) -> Scan | None:
    """Return the beams of the cycle with the most signals.

    Of a volume, those of the lowest elevation with the most azimuths, else those of the vertical
    plane with the most signals. None without azimuths or signals.

    Raises
    ------
    ProductError
        If a variable is missing or has other dimensions.
    """
    require(product, {"residual": ("time", "beam", "altitude"), "beam_zenith_angle": ("beam",)})
    if not {"beam_azimuth", "station_altitude", "beam_signal"} <= set(product.variables):
        return None
    zenith, azimuth = (
        product[name].values.astype(np.float64) for name in ("beam_zenith_angle", "beam_azimuth")
    )
    count = product["residual"].notnull().sum("altitude").values
    near = np.abs(zenith[:, None] - zenith) <= _SAME_ELEVATION
    lowest = max(np.arange(zenith.size), key=lambda beam: (near[beam].sum(), zenith[beam]))
    level = np.flatnonzero(near[lowest])
    planes = vertical_planes(zenith, azimuth)
    of_map = len(planes) >= _FEWEST_AZIMUTHS and level.size >= _FEWEST_AZIMUTHS
    groups = [level] if of_map else planes
    beams = max(groups, key=lambda group: count[:, group].sum(axis=1).max(), default=level)
    cycle = int(np.argmax(count[:, beams].sum(axis=1)))
    if not count[cycle, beams].any():
        return None
    chosen = product.isel(time=cycle, beam=beams)
    signal, residual = (
        chosen[name].transpose("beam", "altitude").values.astype(np.float64)
        for name in ("beam_signal", "residual")
    )
    height = product["altitude"].values - float(product["station_altitude"])
    zenith, azimuth = zenith[beams], azimuth[beams]
    toward = float(azimuth[np.argmax(zenith)])
    side = np.where(np.cos(np.radians(azimuth - toward)) < 0.0, -1.0, 1.0)
    along = slant_path(zenith, height) * height
    obstruction = np.full(beams.size, np.nan)
    if "beam_obstruction" in chosen.variables:
        obstruction = chosen["beam_obstruction"].values.astype(np.float64)
    over_ground = np.sin(np.radians(zenith)) if of_map else np.ones(beams.size)
    return Scan(
        product["time"].values.astype("datetime64[ns]")[cycle],
        azimuth if of_map else side * zenith,
        90.0 - float(zenith.mean()) if of_map else None,
        toward,
        along * over_ground[:, None],
        np.where(np.isfinite(residual) & (signal > 0.0), signal, np.nan),
        obstruction * over_ground,
    )


def draw_scan(scans: Sequence[Scan]) -> list[Figure]:
    """Return the polar image of a scan."""
    scan = scans[0]
    if not finite([scan.signal]).size:
        return []
    low, high = (float(end) for end in np.percentile(finite([scan.signal]), _SHOWN))
    bar = Axis("range-corrected signal", low, max(high, 1.05 * low), log=True)
    far = np.where(np.isfinite(scan.signal), scan.distance, 0.0).max(axis=1)
    far = np.fmax(far, scan.obstruction)
    turned = np.radians(scan.angle)
    # Angles are from the vertical axis, toward the horizontal one.
    ends = far * np.sin(turned), far * np.cos(turned)
    if scan.elevation is None:
        what, names = (
            "Range-height scan (RHI)",
            (
                f"horizontal distance toward azimuth {scan.toward:.0f}° (km)",
                "height (km)",
            ),
        )
        beams = f"{counted(scan.angle.size, 'beam')} of a vertical plane"
    else:
        what, names = "Plan-position scan (PPI)", ("to the east (km)", "to the north (km)")
        beams = (
            f"{counted(scan.angle.size, 'beam')} at an elevation of {scan.elevation:.3g} degrees"
        )
    x, y = (
        Axis(name, min(end.min(), 0.0) / 1e3, max(end.max(), _LEAST) / 1e3)
        for name, end in zip(names, ends, strict=True)
    )
    layers: list[Image | Curve] = [_image(scan, x, y, bar)]
    blocked = np.flatnonzero(np.isfinite(scan.obstruction))
    words = f"{beams}; each is shown as far as its signal is used"
    if blocked.size:
        at = scan.obstruction[blocked] / 1e3
        label = f"blocked: {counted(blocked.size, 'beam')}"
        place = at * np.sin(turned[blocked]), at * np.cos(turned[blocked])
        layers.append(Curve(*place, "ink", Mark.CROSS, joined=False, label=label))
        words += f"; {counted(blocked.size, 'beam')} blocked, from {1e3 * at.min():.0f} m: crosses"
    panel = Panel(x, y, tuple(layers), _HEIGHT, bar=bar, to_scale=scan.elevation is not None)
    return [Figure(f"{what} at {utc(scan.time)}", words, (panel,))]


def _image(scan: Scan, x: Axis, y: Axis, bar: Axis) -> Image:
    """Return the signals at pixels: those of the nearest beam, at their distance."""
    left, up = (
        np.linspace(axis.low, axis.high, size + 1) for axis, size in ((x, COLUMNS), (y, ROWS))
    )
    across, along = np.meshgrid(
        0.5 * (left[1:] + left[:-1]), 0.5 * (up[1:] + up[:-1]), indexing="ij"
    )
    turn, distance = np.degrees(np.arctan2(across, along)), 1e3 * np.hypot(across, along)
    ordered = np.sort(scan.angle)
    step = float(np.median(np.diff(ordered))) if ordered.size > 1 else 1.0
    shares = np.full(turn.shape, np.nan)
    nearest = np.full(turn.shape, _BESIDE * step)
    for angle, places, signal in zip(scan.angle, scan.distance, scan.signal, strict=True):
        off = np.abs((turn - angle + 180.0) % 360.0 - 180.0)
        own = off <= nearest
        bins = np.searchsorted(places, distance[own])
        value = np.append(signal, np.nan)[bins]
        shares[own] = np.log(value / bar.low) / np.log(bar.high / bar.low)
        nearest[own] = off[own]
    return Image(codes_of(shares), left[:-1], left[1:], up)


_EXTINCTION: Final = ImageQuantity("total extinction", 1e3, "km⁻¹", limits=(0.01, 10.0))
"""From clean air at the ground to fog."""
_OF_CHANNEL: Final = ("dead_time_error", "baseline_error")
_PROFILE: Final = (
    ProfileQuantity(
        "vertical_optical_depth",
        "vertical optical depth from the lidar",
        more_errors=_OF_CHANNEL,
        bound="gradient_error",
    ),
    ProfileQuantity(
        "total_extinction",
        "total extinction (km⁻¹)",
        1e3,
        more_errors=_OF_CHANNEL,
        bound="gradient_error",
    ),
)

FIGURES: Final = KindFigures(
    (
        image_view("multiangle", "total_extinction", _EXTINCTION, "altitude"),
        profile_view("profile", _PROFILE, "altitude"),
        View("scan", VARIABLES, read_scan, draw_scan, first=True),
    ),
    preferred="vertical_optical_depth",
)
