"""The section ``raman`` of the first campaign file of an archive."""

from __future__ import annotations

from typing import Final

from lidarops.catalog.folder import InstrumentHeaders
from lidarops.scene.pointing import FIXED, STEEPEST


def _section(headers: InstrumentHeaders) -> tuple[str, ...]:
    """Return the lines of the section; empty without a nitrogen channel or a steep beam."""
    pairs = headers.nitrogen_channels
    if not pairs or headers.zenith_span > FIXED or headers.zenith_angle > STEEPEST:
        return ()
    return (
        "# ? Needs dark nights: use it if these were measured at night.",
        "# raman:",
        f"#   channels: [{', '.join(pairs)}]",
        f"#   nitrogen: {{{', '.join(f'{elastic}: {raman}' for elastic, raman in pairs.items())}}}",
    )


DRAFT: Final = _section
