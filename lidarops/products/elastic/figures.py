"""The figures of the ``elastic`` product: an image of backscatter, and a profile with errors."""

from __future__ import annotations

from typing import Final

from lidarops.figures.image_panels import ImageQuantity
from lidarops.figures.kind_figures import KindFigures, image_view
from lidarops.figures.profile_panels import ProfileQuantity, profile_view
from lidarops.products.elastic.variables import LAYOUT

_MEGA: Final = 1e6
_UNIT: Final = "Mm⁻¹ sr⁻¹"
_IMAGE: Final = ImageQuantity("aerosol backscatter", _MEGA, _UNIT, (0.01, 10.0))
"""Colours from background aerosol to dust and cirrus."""
_PROFILE: Final = ProfileQuantity(
    "aerosol_backscatter",
    f"backscatter ({_UNIT})",
    _MEGA,
    reference="molecular_backscatter",
    window=("reference_bottom", "reference_top"),
    budget=tuple(error.cause for error in LAYOUT.rows["aerosol_backscatter"].errors),
)

FIGURES: Final = KindFigures(
    (
        image_view("elastic", "aerosol_backscatter", _IMAGE),
        profile_view("profile", (_PROFILE,), "range"),
    ),
    preferred="aerosol_backscatter",
)
