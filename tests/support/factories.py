"""Small records for tests that need no files."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

from lidarops.campaign.model import Campaign
from lidarops.records import ChannelLayout, DetectionMode, Granule, Role, Status

DAY = datetime(2026, 3, 1, tzinfo=UTC)

PHOTON = ChannelLayout("photon_532o", DetectionMode.PHOTON, 532e-9, 2000, 7.5, 0)
ANALOG = ChannelLayout("analog_532o", DetectionMode.ANALOG, 532e-9, 2000, 7.5, 12)


def campaign(**changes: Any) -> Campaign:
    """Return a small campaign; `changes` replace keys of its one instrument."""
    instrument = {
        "station": "coast",
        "files": ["coast/h*"],
        "dark_files": ["dark/*"],
        "facts": [{"full_overlap_range": 300.0, "channels": {"photon_532o": {"dead_time": 4e-9}}}],
        "products": {
            "homogeneous": {"channels": ["photon_532o"], "sections": [[750, 4500]]},
        },
    }
    return Campaign.model_validate(
        {
            "name": "test",
            "title": "Test campaign",
            "archive": "raw",
            "output": "out",
            "stations": {
                "coast": {"name": "Coast", "latitude": 46.4, "longitude": 30.7, "altitude": 20.0}
            },
            "instruments": {"lidar": {**instrument, **changes}},
        }
    )


def granule(minutes: float = 0.0, **changes: Any) -> Granule:
    """Return a good granule that starts so many minutes after midnight."""
    start = DAY + timedelta(minutes=minutes)
    facts: dict[str, Any] = {
        "path": f"coast/h{minutes:08.2f}",
        "size": 1000,
        "mtime_ns": 1,
        "instrument": "lidar",
        "role": Role.SIGNAL,
        "status": Status.GOOD,
        "start": start,
        "stop": start + timedelta(minutes=1),
        "zenith_angle": 90.0,
        "latitude": 46.4,
        "longitude": 30.7,
        "altitude": 20.0,
        "layout": (PHOTON, ANALOG),
    }
    return Granule(**{**facts, **changes})
