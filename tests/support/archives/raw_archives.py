"""Small Licel files for tests that need real bytes."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from lidarops.raw import licel
from support import factories
from support.licel_lines import new_dataset, new_header


def content(
    minutes: float = 0.0,
    *,
    bins: int = 64,
    seed: int = 0,
    position: tuple[float, float] = (46.4, 30.7),
    site: str = "Coast",
    zenith_angle: float = 90.0,
    azimuth: float | None = None,
    altitude: float = 20.0,
) -> bytes:
    """Return a file with an analog and a photon channel that starts so long after midnight."""
    start: datetime = factories.DAY + timedelta(minutes=minutes)
    common: dict[str, Any] = {"wavelength": 532e-9, "bins": bins, "bin_width": 7.5, "shots": 600}
    header = new_header(
        name=f"h{start:%y}{start.month:X}{start:%d%H}.{start:%M%S}00",
        site=site,
        start=start,
        stop=start + timedelta(minutes=1),
        altitude=altitude,
        latitude=position[0],
        longitude=position[1],
        zenith_angle=zenith_angle,
        azimuth=azimuth,
        datasets=[
            new_dataset(kind=licel.DatasetKind.ANALOG, **common),
            new_dataset(kind=licel.DatasetKind.PHOTON, **common),
        ],
        lasers=[licel.Laser(600, 10), licel.Laser(0, 0)],
    )
    rng = np.random.default_rng(seed)
    return licel.encode(
        header,
        {
            "analog_532o": rng.integers(10_000, 400_000, bins, dtype=np.int32),
            "photon_532o": rng.integers(0, 2000, bins, dtype=np.int32),
        },
    )


def write(path: Path, data: bytes) -> Path:
    """Write bytes, with the folders on the way."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path
