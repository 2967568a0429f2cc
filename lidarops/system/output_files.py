"""Names of files in the output folder of a campaign that several packages share."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

SITE: Final = "site"
"""Folder of the site beside the products, also where it is published."""
MANIFEST: Final = "manifest.json"
"""File that lists the products of a site. It also identifies a folder as a site."""
COPIES: Final = "files"
"""Folder of the site with copies of the products."""


def product_paths(folder: Path) -> list[str]:
    """List the NetCDF files below a folder, sorted, without hidden files and folders.

    Links to folders are not followed, so that the search ends and stays inside.
    """
    paths = []
    for parent, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        paths += [
            (Path(parent) / name).relative_to(folder).as_posix()
            for name in files
            if name.endswith(".nc") and not name.startswith(".")
        ]
    return sorted(paths)
