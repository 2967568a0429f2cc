"""Profiles against range or altitude, in two panels side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lidarops.figures.profile_data import Profile
from lidarops.figures.scan_data import QUANTITIES, ScanProfile
from lidarops.site import svg
from lidarops.site.svg import LEFT, RIGHT, WIDTH, Panel, Scale, Sheet

Floats = NDArray[np.float64]

_TOP: Final = 44
_FOOT: Final = 410
_HEIGHT: Final = 456
_MIDDLE: Final = (WIDTH + LEFT - RIGHT) / 2
_CAUSES: Final = {
    "noise": "noise",
    "background": "background",
    "reference": "reference",
    "lidar_ratio": "lidar ratio",
    "molecular": "molecules",
}
_MARKS: Final = 120
"""Most marks of flagged values."""


@dataclass(frozen=True, slots=True)
class _Curve:
    label: str
    value: Floats
    css: str


def _panels(height: Floats, spans: Sequence[tuple[float, float]], *, log: bool) -> list[Panel]:
    low, high = float(height.min()), float(height.max())
    y = (low, high if high > low else low + 1.0, _FOOT, _TOP)
    ends = ((LEFT, _MIDDLE - 36), (_MIDDLE + 36, WIDTH - RIGHT))
    return [
        Panel(Scale(*span, *end, log=log and number == 1), Scale(*y))
        for number, (span, end) in enumerate(zip(spans, ends, strict=True))
    ]


def _span(values: Sequence[Floats]) -> tuple[float, float]:
    whole = np.concatenate(list(values))
    whole = whole[np.isfinite(whole)]
    if whole.size == 0:
        return 0.0, 1.0
    low, high = (float(level) for level in np.percentile(whole, [1.0, 99.0]))
    room = 0.1 * (high - low) or 0.1 * abs(high) or 1.0
    return min(low - room, 0.0), high + room


def _decades(values: Sequence[Floats]) -> tuple[float, float]:
    whole = np.concatenate(list(values))
    whole = whole[np.isfinite(whole) & (whole > 0)]
    if whole.size == 0:
        return 0.1, 1.0
    high = 1.5 * float(whole.max())
    return max(0.7 * float(np.percentile(whole, 2.0)), 1e-5 * high), high


def error_budget_panels(profile: Profile, key: str) -> tuple[Sheet, str]:
    """Draw a backscatter profile with its standard error, and its error budget."""
    sheet = Sheet(height=_HEIGHT)
    y = profile.range / 1e3
    value, error, molecular = (
        1e6 * part for part in (profile.backscatter, profile.standard_error, profile.molecular)
    )
    causes = {name: 1e6 * part for name, part in profile.budget.items()}
    spans = (_span([value - error, value + error, molecular]), _decades([*causes.values(), error]))
    left, right = _panels(y, spans, log=True)
    up = left.y(y)

    def draw_values() -> None:
        low, high = left.x(value - error), left.x(value + error)
        sheet.path(svg.band(up, low, high, upright=True), "band c0")
        sheet.path(svg.line(left.x(value), up), "line c0")
        sheet.path(svg.line(left.x(molecular), up), "line d2 c1")

    def draw_causes() -> None:
        for number, part in enumerate(causes.values()):
            sheet.path(svg.line(right.x(_positive(part)), up), f"line d{number} c{number}")
        sheet.path(svg.line(right.x(_positive(error)), up), "line ink")

    unit = "10⁻⁶ m⁻¹ sr⁻¹"
    sheet.frame(left, "range (km)", below=f"backscatter ({unit})")
    sheet.frame(right, "", below=f"error of backscatter ({unit})")
    sheet.clipped(left, draw_values, f"{key}-p")
    sheet.clipped(right, draw_causes, f"{key}-p")
    named = [("M-9 0H9", "line c0", "particles"), ("M-9 0H9", "line d2 c1", "molecules")]
    svg.legend(sheet, LEFT + 14, 20, named)
    rows = [("M-9 0H9", f"line d{n} c{n}", _CAUSES[name]) for n, name in enumerate(causes)]
    svg.legend(sheet, LEFT + 330, 20, [*rows, ("M-9 0H9", "line ink", "total")])
    bottom, top = (f"{edge / 1e3:.3g}" for edge in profile.reference)
    good = value[np.isfinite(value)]
    reach = f"{svg.number(float(good.min()))} to {svg.number(float(good.max()))} {unit}"
    return sheet, (
        f"Particle backscatter {reach}, lidar ratio {profile.lidar_ratio:g} sr, reference"
        f" window {bottom} to {top} km; the band is the standard error"
    )


def _positive(values: Floats) -> Floats:
    return np.where(values > 0, values, np.nan)


def scan_panels(profile: ScanProfile, key: str) -> tuple[Sheet, str]:
    """Draw optical depth and extinction of one scan cycle against altitude."""
    sheet = Sheet(height=_HEIGHT)
    y = profile.altitude / 1e3
    factors = {"optical_depth": 1.0, "extinction": 1e3}
    shown = {}
    for name in QUANTITIES:
        estimate = profile.estimates[name]
        shown[name] = [
            factors[name] * part
            for part in (
                estimate.value,
                estimate.standard_error,
                estimate.standard_error + np.nan_to_num(estimate.gradient_error),
                estimate.rejected,
            )
        ]
    spans = [_span([value - error, value + error]) for value, error, _, _ in shown.values()]
    panels = _panels(y, spans, log=False)
    labels = ("optical depth", "extinction (km⁻¹)")
    for number, (panel, label, parts) in enumerate(
        zip(panels, labels, shown.values(), strict=True)
    ):
        sheet.frame(panel, "" if number else "altitude (km)", below=label)
        _estimate(sheet, panel, panel.y(y), parts, f"{key}-s{number}")
    named = [("M-9 0H9", "line c0", "retrieved, with standard error")]
    wide = ("M-9-4H9V4H-9z", "band wide c0", "plus largest error from a horizontal gradient")
    svg.legend(sheet, LEFT + 14, 20, [*named, wide, (svg.cross(0, 0), "off", "rejected")])
    value = shown["extinction"][0]
    good = value[np.isfinite(value)]
    reach = (
        f"{svg.number(float(good.min()))} to {svg.number(float(good.max()))} km⁻¹"
        if good.size
        else "no usable value"
    )
    flagged = int((profile.flag != 0).sum())
    return sheet, f"Extinction {reach}; {flagged} of {profile.flag.size} altitudes flagged"


def _estimate(sheet: Sheet, panel: Panel, up: Floats, parts: Sequence[Floats], key: str) -> None:
    value, error, wide, rejected = parts

    def draw() -> None:
        for width, css in ((wide, "band wide c0"), (error, "band c0")):
            low, high = panel.x(value - width), panel.x(value + width)
            sheet.path(svg.band(up, low, high, upright=True), css)
        sheet.path(svg.line(panel.x(value), up), "line c0")
        some = slice(None, None, max(1, -(-rejected.size // _MARKS)))
        sheet.path(svg.marks(panel.x(rejected[some]), up[some], svg.cross), "off")

    sheet.clipped(panel, draw, key)
