"""An archive whose processing takes seconds, and checks of its state after a crash."""

from __future__ import annotations

import hashlib
import os
import sqlite3
import subprocess
import sys
from pathlib import Path

import yaml

from lidarops.campaign.model import Campaign, load_campaign
from support.archives import raw_archives

RUNNER = Path(__file__).with_name("crash_runs.py")
SCENES = 24


def make(folder: Path, *, scenes: int = SCENES) -> Campaign:
    """Write raw files of some days and their campaign file."""
    for day in range(scenes):
        for k in range(6):
            data = raw_archives.content(day * 1440 + k, bins=4000, seed=day * 10 + k)
            raw_archives.write(folder / "raw" / f"h{day:02d}{k}", data)
    tree = {
        "name": "crash", "title": "Crash", "archive": "raw", "output": "out",
        "stations": {"coast": {"name": "Coast", "latitude": 46.4, "longitude": 30.7}},
        "instruments": {
            "lidar": {
                "station": "coast", "files": "h*",
                "products": {
                    "signal": {},
                    "homogeneous": {"channels": ["photon_532o"], "sections": [[750, 4500]]},
                },
            }
        },
    }  # fmt: skip
    (folder / "campaign.yaml").write_text(yaml.safe_dump(tree))
    return load_campaign(folder / "campaign.yaml")


def start(folder: Path, mode: str, **environment: str) -> subprocess.Popen[bytes]:
    """Start a run in its own session, so that all its processes can be killed at once."""
    return subprocess.Popen(
        [sys.executable, str(RUNNER), str(folder), mode],
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        cwd=RUNNER.parents[3],
        env={**os.environ, "OMP_NUM_THREADS": "1", "PREFECT_HOME": str(folder / "prefect")}
        | {"PYTHONPATH": str(RUNNER.parents[3]), **environment},
    )


def products(folder: Path) -> dict[str, str]:
    """Return path -> SHA-256 of every product file, including hidden files."""
    root = folder / "out" / "products"
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def wrong_rows(folder: Path) -> list[str]:
    """Return the products in the ledger whose file is missing or differs."""
    database = folder / "out" / "catalog.sqlite"
    if not database.exists():
        return []
    present = products(folder)
    with sqlite3.connect(database) as connection:
        names = {row[0] for row in connection.execute("select name from sqlite_master")}
        if "product" not in names:
            return []
        assert connection.execute("pragma integrity_check").fetchone() == ("ok",)
        rows = connection.execute("select path, sha256 from product").fetchall()
    return [path for path, sha256 in rows if present.get(path) != sha256]


def visible_partial(folder: Path, whole: dict[str, str]) -> list[str]:
    """Return the products that differ from those of an undisturbed run."""
    return [
        path
        for path, sha256 in products(folder).items()
        if not Path(path).name.startswith(".") and whole.get(path) != sha256
    ]
