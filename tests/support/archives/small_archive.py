"""A small archive whose products have every kind of dependence."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import yaml

from lidarops.campaign.model import Campaign, load_campaign
from lidarops.records import RunRecord
from support.archives import raw_archives

BINS = 1500
DAY = 1440
SOUNDING = "altitude,pressure,temperature\n" + "\n".join(
    f"{height},{101325 * (1 - 2.25577e-5 * height) ** 5.2559:.1f},{288.15 - 0.0065 * height:.2f}"
    for height in range(0, 11000, 500)
)
OVERLAP = "range,overlap\n0,0.1\n300,0.6\n600,1.0\n"


def tree() -> dict[str, Any]:
    """Return the campaign file: one lidar with all kinds of input, one with raw files only."""
    products = {
        "signal": {},
        "homogeneous": {"channels": ["photon_532o"], "sections": [[750, 840]]},
        "elastic": {
            "channels": ["analog_532o"],
            "average": "1h",
            "reference": {"lowest": 3000, "highest": 9000},
        },
    }
    common = {"zenith_angle": 0, "overlap_profile": "overlap.csv"}
    return {
        "name": "small",
        "title": "Small",
        "archive": "raw",
        "output": "out",
        "stations": {"coast": {"name": "Coast", "latitude": 46.4, "longitude": 30.7}},
        "instruments": {
            "rich": {
                "station": "coast",
                "files": "rich/h*",
                "dark_files": "rich/d*",
                "facts": [
                    {**common, "valid_to": "2026-03-03T00:00:00Z", "molecular_profile": "air.csv"},
                    {
                        **common,
                        "valid_from": "2026-03-03T00:00:00Z",
                        "channels": {"photon_532o": {"dead_time": 4e-9}},
                    },
                ],
                "products": products,
            },
            "poor": {"station": "coast", "files": "poor/h*", "products": {"signal": {}}},
        },
    }


class Archive:
    """A campaign file with its raw and ancillary files."""

    def __init__(self, folder: Path, *, days: int = 4) -> None:
        self.folder = folder
        self.file = folder / "campaign.yaml"
        self.tree = tree()
        if self.file.exists():
            # A copy of an existing archive.
            return
        for day in range(days):
            for k in range(3):
                self.raw(f"rich/h{day}{k}", day * DAY + 600 + k, seed=day * 10 + k)
                self.raw(f"poor/h{day}{k}", day * DAY + 600 + k, seed=day * 10 + k + 5)
        self.raw("rich/d0", 700, seed=99)
        raw_archives.write(folder / "air.csv", SOUNDING.encode())
        raw_archives.write(folder / "overlap.csv", OVERLAP.encode())
        self.write()

    def raw(self, name: str, minutes: float, *, seed: int) -> Path:
        """Write a raw file."""
        data = raw_archives.content(minutes, bins=BINS, seed=seed, zenith_angle=0.0)
        return raw_archives.write(self.folder / "raw" / name, data)

    def write(self) -> Campaign:
        """Write the campaign file and load it."""
        self.file.write_text(yaml.safe_dump(self.tree))
        return load_campaign(self.file)

    def flip(self, name: str, place: int = -40) -> None:
        """Change one byte of a file."""
        path = self.folder / name
        data = bytearray(path.read_bytes())
        data[place] ^= 1
        path.write_bytes(bytes(data))

    def contents(self, below: str = "out") -> dict[str, str]:
        """Return path -> SHA-256 of all files in a folder, without the journal of the database."""
        root = self.folder / below
        return {
            str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(root.rglob("*"))
            if path.is_file() and not path.name.endswith(("-wal", "-shm"))
        }


def made(record: RunRecord | None) -> set[str]:
    """Return instrument, day, kind and channel of a run's products, as ``rich 1 signal photon``."""
    return {
        f"{scene.instrument} {scene.start.day} {product.kind} {product.channel[:6]}"
        for scene in (() if record is None else record.scenes)
        for product in scene.products
    }
