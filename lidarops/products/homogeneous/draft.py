"""The section ``homogeneous`` of the first campaign file of an archive."""

from __future__ import annotations

from typing import Final

from lidarops.catalog.folder import InstrumentHeaders
from lidarops.scene.pointing import FIXED

_LEVEL: Final = 1.9
"""degree above or below the horizon, at which 3 km of path climb 100 m."""


def _section(headers: InstrumentHeaders) -> tuple[str, ...]:
    """Return the lines of the section; empty where no fixed beam is level."""
    channels = ", ".join(headers.elastic_channels)
    if not channels or headers.zenith_span > FIXED or abs(headers.zenith_angle - 90.0) > _LEVEL:
        return ()
    return (
        "homogeneous:",
        f"  channels: [{channels}]",
        "  sections: [[1000, 4000]]  # ? m, where the air is homogeneous and the signal strong",
    )


DRAFT: Final = _section
