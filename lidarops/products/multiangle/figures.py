"""The figures of the ``multiangle`` product: extinction, one profile, the signal of the scan."""

from __future__ import annotations

from typing import Final

from lidarops.figures.image_panels import ImageQuantity
from lidarops.figures.kind_figures import KindFigures, View, image_view
from lidarops.figures.profile_panels import ProfileQuantity, profile_view
from lidarops.products.multiangle.scan_images import VARIABLES, draw_scan, read_scan

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
