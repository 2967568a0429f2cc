"""The section ``elastic`` of the first campaign file of an archive."""

from __future__ import annotations

from typing import Final

from lidarops.catalog.folder import InstrumentHeaders
from lidarops.scene.pointing import FIXED, STEEPEST


def _section(headers: InstrumentHeaders) -> tuple[str, ...]:
    """Return the lines of the section; empty where no fixed beam reaches clean air."""
    channels = ", ".join(headers.joined_channels)
    if not channels or headers.zenith_span > FIXED or headers.zenith_angle > STEEPEST:
        return ()
    return (
        "elastic:",
        f"  channels: [{channels}]",
        "  lidar_ratio: 50  # ? sr, of the particles: about 25 (sea salt) to 75 (smoke)",
        "  lidar_ratio_standard_error: 15  # ? sr",
        "  average: 30min",
    )


DRAFT: Final = _section
