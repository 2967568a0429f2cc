"""Product kind ``multiangle``: optical depth and extinction from scans over zenith angle."""

from __future__ import annotations

from typing import Final

from lidarops.kinds import CommonQuantity, Kind
from lidarops.products.multiangle.settings import MultiAngleSettings

KIND: Final = Kind(
    name="multiangle",
    title="Optical depth and extinction of scans",
    package=__name__,
    settings=MultiAngleSettings,
    rank=30,
    common=CommonQuantity(
        "vertical_optical_depth",
        "altitude",
        errors_of_channel=(
            "vertical_optical_depth_dead_time_error",
            "vertical_optical_depth_baseline_error",
        ),
        errors_of_air=("vertical_optical_depth_gradient_error",),
    ),
)
