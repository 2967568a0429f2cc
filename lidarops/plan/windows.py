"""Windows of scenes, and the ids of scenes, which name them.

A run with nothing to do imports this module, so it imports no numerics.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Final

from lidarops.campaign.model import Campaign, InstrumentFacts

DARK_REACH: Final = timedelta(hours=24)
"""Longest time between a scene and the dark files that it uses."""
STAMP: Final = "%Y%m%dT%H%M%S"
"""Format of the start time in the id of a scene."""
Window = tuple[datetime, datetime]
"""Start and end of a window."""


def parse_scene_id(scene: str) -> tuple[str, datetime]:
    """Return the instrument or network, and the start time, from the id of a scene."""
    instrument, _, rest = scene.rpartition("_")
    return instrument, datetime.strptime(rest.partition("-")[0], STAMP).replace(tzinfo=UTC)


def scene_stop(scene: str, campaign: Campaign) -> datetime:
    """Return when a scene with this id would end with the present campaign file."""
    key, start = parse_scene_id(scene)
    members = campaign.networks[key].instruments if key in campaign.networks else [key]
    return window_at(campaign, [name for name in members if name in campaign.instruments], start)[1]


def window_at(campaign: Campaign, instruments: Sequence[str], start: datetime) -> Window:
    """Return the window that holds `start`, narrowed so that no fact changes within it."""
    length = timedelta(days=1) if campaign.scenes.window == "day" else campaign.scenes.window
    midnight = start.astimezone(UTC).replace(hour=0, minute=0, second=0, microsecond=0)
    opens = midnight + (start - midnight) // length * length
    closes = opens + length
    for instrument in instruments:
        for fact in campaign.instruments[instrument].facts:
            opens, closes = _narrow(fact, start, opens, closes)
    return opens, closes


def _narrow(
    fact: InstrumentFacts, moment: datetime, opens: datetime, closes: datetime
) -> tuple[datetime, datetime]:
    """Narrow a window around `moment` so that no edge of the validity period lies inside."""
    for edge in (fact.valid_from, fact.valid_to):
        if opens < edge <= moment:
            opens = edge
        elif moment < edge < closes:
            closes = edge
    return opens, closes
