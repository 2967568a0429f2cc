"""Small archives of a lidar some of whose recorders are off for a time, or were exchanged."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from lidarops.campaign.model import Campaign, load_campaign
from lidarops.raw import licel
from support import factories
from support.archives import raw_archives
from support.licel_lines import new_dataset, new_header

DAY = 1440
BINS = 400
FAR, NEAR = ("BT5", "BC5"), ("BT12", "BC12")
BOTH = (*FAR, *NEAR)
LEVELS = {"5": 1, "7": 1, "12": 3, "0": 1, "1": 3, "2": 5}
"""Light of each recorder, by its number."""


class RecorderArchive:
    """One lidar with channels of 532 nm; a recorder BT records analog, BC photon counting."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / "campaign.yaml"
        self.facts: list[dict[str, Any]] = [_period()]
        self.dark_files: list[str] = []
        self.products: dict[str, Any] = {"signal": {"channels": "all"}}

    def raw(self, name: str, minutes: float, recorders: Iterable[str]) -> Path:
        """Write a raw file with the datasets of some recorders, in this order."""
        return raw_archives.write(self.folder / "raw" / name, content(minutes, tuple(recorders)))

    def write(self) -> Campaign:
        """Write the campaign file and load it."""
        lidar = {
            "station": "coast",
            "files": "h*",
            "dark_files": self.dark_files,
            "facts": self.facts,
            "products": self.products,
        }
        tree = {
            "name": "recorders", "title": "Recorders", "archive": "raw", "output": "out",
            "stations": {"coast": {"name": "Coast", "latitude": 46.4, "longitude": 30.7}},
            "instruments": {"lidar": lidar},
        }  # fmt: skip
        self.file.write_text(yaml.safe_dump(tree))
        return load_campaign(self.file)


def _period(**changes: Any) -> dict[str, Any]:
    return {"zenith_angle": 0, "full_overlap_range": 100, **changes}


def periods(edge: str, before: dict[str, Any], after: dict[str, Any]) -> list[dict[str, Any]]:
    """Return facts about channels before and after a time."""
    return [_period(valid_to=edge, channels=before), _period(valid_from=edge, channels=after)]


def content(minutes: float, recorders: tuple[str, ...]) -> bytes:
    """Return a file that starts so long after midnight."""
    start = factories.DAY + timedelta(minutes=minutes)
    common: dict[str, Any] = {"wavelength": 532e-9, "bins": BINS, "bin_width": 7.5, "shots": 600}
    header = new_header(
        name=f"h{start:%y}{start.month:X}{start:%d%H}.{start:%M%S}00",
        site="Coast",
        start=start,
        stop=start + timedelta(minutes=1),
        altitude=0.0,
        latitude=46.4,
        longitude=30.7,
        zenith_angle=0.0,
        datasets=[
            new_dataset(
                kind=licel.DatasetKind.PHOTON if name[1] == "C" else licel.DatasetKind.ANALOG,
                device=name,
                **common,
            )
            for name in recorders
        ],
        lasers=[licel.Laser(600, 10), licel.Laser(0, 0)],
    )
    shape = np.exp(-np.arange(BINS) / 40.0)
    noise = np.random.default_rng(int(minutes)).integers(0, 3, (len(recorders), BINS))
    counts = {
        dataset.name: (1000 * LEVELS[dataset.device[2:]] * shape).astype(np.int32) + added
        for dataset, added in zip(header.datasets, noise.astype(np.int32), strict=True)
    }
    return licel.encode(header, counts)
