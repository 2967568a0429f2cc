"""Reprocess archives of atmospheric lidar data into CF-compliant products."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version as _version
from typing import Any, Final

__all__ = ["__version__", "find_products", "open_archive", "open_products"]

__version__ = _version("lidarops")

# Imported on first use: xarray and dask take a second to import, too long for `lidarops --help`.
_MODULES: Final = {
    "open_archive": "lidarops.raw.archive",
    "open_products": "lidarops.aggregate.open_products",
    "find_products": "lidarops.aggregate.index",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
