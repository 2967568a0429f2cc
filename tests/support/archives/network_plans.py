"""A campaign of a network of three lidars, and granules of it, for tests of plans."""

from __future__ import annotations

from typing import Any

from lidarops.campaign.model import Campaign
from lidarops.records import Granule
from support.factories import granule

PLACES = {
    "west": (47.25, 11.3, 70.0),
    "east": (47.25, 11.353, 310.0),
    "north": (47.2811, 11.3265, 190.0),
}
MEMBERS = [f"{name}-lidar" for name in PLACES]


def campaign(
    visibility: dict[str, Any] | None = None, facts: dict[str, Any] | None = None, **changes: Any
) -> Campaign:
    """Three lidars; `facts` by instrument replace those of it."""
    known = [{"full_overlap_range": 150.0}]
    return Campaign.model_validate(
        {
            "name": "net",
            "title": "Network",
            "archive": "raw",
            "output": "out",
            "stations": {
                name: {"name": name, "latitude": lat, "longitude": lon, "altitude": 600}
                for name, (lat, lon, _) in PLACES.items()
            },
            "instruments": {
                f"{name}-lidar": {
                    "station": name,
                    "files": f"{name}/*",
                    "facts": (facts or {}).get(f"{name}-lidar", known),
                }
                for name in PLACES
            },
            "networks": {
                "valley": {
                    "instruments": MEMBERS,
                    "visibility": {"channel": "photon_532o"} | (visibility or {}),
                }
            },
        }
        | changes
    )


def granules(minutes: float = 0.0, **changes: Any) -> list[Granule]:
    """One granule of each member."""
    return [
        granule(
            minutes,
            **(
                {"path": f"{name}/{minutes}", "instrument": f"{name}-lidar", "azimuth": azimuth}
                | changes
            ),
        )
        for name, (_, _, azimuth) in PLACES.items()
    ]
