"""Many products as one: a lazy dataset, means over time, an index, stores, STAC items.

Everything here is derived from product files, and can be deleted and made again. Optional packages
are imported only by the functions that need them.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from lidarops.errors import LidarOpsError


def need(module: str) -> Any:
    """Import a package of the optional extra ``aggregate``.

    Parameters
    ----------
    module : str
        Such as ``pyarrow.parquet``.

    Returns
    -------
    module

    Raises
    ------
    LidarOpsError
        If the package is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise LidarOpsError(
            f"the package {module.partition('.')[0]} cannot be imported: {error}",
            remedy="pip install 'lidarops[aggregate]'",
        ) from error
