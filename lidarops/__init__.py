"""Reprocess archives of atmospheric lidar data into CF-compliant products."""

from __future__ import annotations

from importlib.metadata import version as _version
from typing import Any

__all__ = ["__version__", "find_products", "open_archive", "open_products"]

__version__ = _version("lidarops")


def __getattr__(name: str) -> Any:
    # xarray and dask take a second to import: `lidarops --help` must not wait for them.
    if name == "open_archive":
        from lidarops.raw.archive import open_archive

        return open_archive
    if name == "open_products":
        from lidarops.aggregate.opening import open_products

        return open_products
    if name == "find_products":
        from lidarops.aggregate.index import find_products

        return find_products
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
