"""The section ``multiangle`` of the first campaign file of an archive."""

from __future__ import annotations

from typing import Final

from lidarops.catalog.folder import InstrumentHeaders
from lidarops.scene.pointing import LEAST_SPREAD


def _section(headers: InstrumentHeaders) -> tuple[str, ...]:
    """Return the lines of the section; empty where the beam does not scan."""
    channels = ", ".join(headers.scanned_channels)
    if not channels or headers.zenith_span < LEAST_SPREAD:
        return ()
    return (
        "multiangle:",
        "  # all elastic channels, which test each other; leave out what has no usable detector",
        f"  channels: [{channels}]",
        "  highest: 3000  # ? m above the station, where signals end",
    )


DRAFT: Final = _section
