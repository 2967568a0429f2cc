"""The section ``signal`` of the first campaign file of an archive."""

from __future__ import annotations

from typing import Final

from lidarops.catalog.folder import InstrumentHeaders


def _section(headers: InstrumentHeaders) -> tuple[str, ...]:
    """Return the lines of the section; empty where the headers hold no channel."""
    return ("signal: {channels: all}",) if headers.layout else ()


DRAFT: Final = _section
