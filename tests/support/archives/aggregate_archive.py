"""Archives of synthetic products, one per day."""

from __future__ import annotations

from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lidarops.aggregate.facts import Facts, list_products, read_product_facts
from lidarops.netcdf.write import write_product
from lidarops.records import Stamp
from support.products.encoded_products import build_product
from support.products.made_products import MAKERS, SCENE, START, context, provenance

Change = Callable[[xr.Dataset], xr.Dataset]


def add_day(
    root: Path,
    day: int,
    kind: str = "homogeneous",
    *,
    change: Change = lambda data: data,
    of: dict[str, Any] | None = None,
    folder: str = "products",
    version: int = 1,
    **maker: Any,
) -> str:
    """Write the product of a day with values scaled by a random factor; return its path."""
    data = MAKERS[kind](**{"zenith": 0.0, **maker})
    shift = np.timedelta64(day, "D")
    data = data.assign_coords(time=data.time + shift, time_bnds=data.time_bnds + shift)
    for name in ("total_extinction", "signal"):
        if name in data:
            data[name] = data[name] * np.random.default_rng(1000 * version + day).uniform(0.5, 2.0)
    data = change(data)
    start = START + timedelta(days=day)
    settings = {"day": day} if version == 1 else {"day": day, "version": version}
    scene = f"{SCENE.rpartition('_')[0]}_{start:%Y%m%dT%H%M%S}"
    about = context(
        kind,
        start=start,
        stop=start + timedelta(days=1),
        provenance=provenance(kind, scene=scene, settings=settings),
        stamp=Stamp(version, start + timedelta(days=2)),
        **(of or {}),
    )
    path = f"{folder}/{about.path}".removeprefix("/")
    write_product(build_product(data, about), root / path)
    return path


def facts_of(root: Path) -> list[Facts]:
    """Return the facts of all products of an archive; none may be refused."""
    results = [read_product_facts(root, path) for path in list_products(root)]
    assert all(isinstance(facts, Facts) for facts in results), results
    return [facts for facts in results if isinstance(facts, Facts)]
