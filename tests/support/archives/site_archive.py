"""A small archive of products of every kind, and a browser for its site."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lidarops.netcdf.write import write_product
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, START, context, provenance

CHROMIUM = Path("/usr/bin/chromium")
_ARGUMENTS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


def add(output: Path, kind: str, days: int = 0, **changes: Any) -> Path:
    """Write the product of a day into an archive."""
    start = START + timedelta(days=days)
    scene = f"lidar-1_{start:%Y%m%dT%H%M%S}"
    record = provenance(kind, scene=scene)
    about = {"start": start, "stop": start + timedelta(days=1)}
    whole = context(kind, **(about | {"provenance": record} | changes))
    data = MAKERS[kind]()
    shift = np.timedelta64(days, "D")
    data = data.assign_coords(time=data["time"] + shift)
    data["time_bnds"] = (("time", "nv"), data["time_bnds"].values + shift)
    path = output / "products" / whole.path
    write_product(build_product(data, whole), path)
    return path


def add_unknown(output: Path, name: str = "wind", **attributes: str) -> Path:
    """Write a product of an unknown kind: several series over time."""
    rng = np.random.default_rng(5)
    time = np.datetime64("2026-03-02T06:00", "ns") + np.arange(8) * np.timedelta64(10, "m")
    attrs = {
        "lidarops_kind": name,
        "lidarops_station": "odesa",
        "lidarops_instrument": "lidar-1",
        "lidarops_channel": "photon_532o",
        "platform": "Odesa",
    }
    data = xr.Dataset(
        {
            "speed": (("time", "crossing"), rng.normal(8.0, 1.0, (8, 6)), {"units": "m s-1"}),
            "speed_standard_error": (("time", "crossing"), np.full((8, 6), 0.2)),
            "quality_flag": (("time", "crossing"), np.zeros((8, 6), np.int32)),
        },
        coords={"time": time},
        attrs=attrs | attributes,
    )
    path = output / "products" / "odesa" / f"{name}.nc"
    path.parent.mkdir(parents=True, exist_ok=True)
    data.to_netcdf(path)
    return path


def small_archive(output: Path) -> Path:
    """Write products of every kind on three days of two years."""
    for days in (0, 1, 40):
        for kind in MAKERS:
            add(output, kind, days)
    add(output, "homogeneous", 400)
    return output


def contents(site: Path) -> dict[str, bytes]:
    """Return every file of a site."""
    return {
        path.relative_to(site).as_posix(): path.read_bytes()
        for path in sorted(site.rglob("*"))
        if path.is_file()
    }


@contextmanager
def browser() -> Iterator[Any]:
    """Yield a headless Chromium."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=_ARGUMENTS)
        try:
            yield opened
        finally:
            opened.close()
