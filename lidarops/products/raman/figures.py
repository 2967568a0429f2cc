"""The figures of the ``raman`` product: an image of extinction, and a profile of all quantities."""

from __future__ import annotations

from typing import Final

from lidarops.figures.image_panels import ImageQuantity
from lidarops.figures.kind_figures import KindFigures, image_view
from lidarops.figures.profile_panels import ProfileQuantity, profile_view

_MEGA: Final = 1e6
_IMAGE: Final = ImageQuantity("aerosol extinction", _MEGA, "Mm⁻¹", (1.0, 1000.0))
"""Colours from background aerosol to dust and cirrus."""
_PROFILE: Final = (
    ProfileQuantity("aerosol_extinction", "aerosol extinction (Mm⁻¹)", _MEGA),
    ProfileQuantity("aerosol_backscatter", "aerosol backscatter (Mm⁻¹ sr⁻¹)", _MEGA),
    ProfileQuantity("lidar_ratio", "lidar ratio (sr)"),
)

FIGURES: Final = KindFigures(
    (
        image_view("raman", "aerosol_extinction", _IMAGE),
        profile_view("profile", _PROFILE, "range"),
    ),
    preferred="aerosol_extinction",
)
