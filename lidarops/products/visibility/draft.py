"""The section ``visibility`` of a network in the first campaign file of an archive."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from lidarops.catalog.folder import InstrumentHeaders


def _section(members: Sequence[InstrumentHeaders]) -> tuple[str, ...]:
    """Return the lines of the section; empty where the members share no elastic channel."""
    first, *others = (member.elastic_channels for member in members)
    shared = [name for name in first if all(name in other for other in others)]
    return (f"visibility: {{channel: {shared[0]}, average: 10min}}",) if shared else ()


DRAFT: Final = _section
