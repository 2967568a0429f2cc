"""Paths of products, pages and links."""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path, PurePosixPath
from typing import Final
from urllib.parse import quote

from lidarops.errors import ProductError

CALENDAR_HEIGHT: Final = 5000.0
"""Height above the station, m, below which a profile with a usable value counts in the calendar."""
_SAFE: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


def product_folder(output: Path) -> Path:
    """Return the folder of the products of a campaign's output.

    Parameters
    ----------
    output : Path
        Output of a campaign, which holds a folder ``products``.

    Raises
    ------
    ProductError
        If there is no such folder.
    """
    folder = output / "products"
    if not folder.is_dir():
        raise ProductError(
            "holds no folder `products`",
            file=output,
            remedy="give the output folder of a campaign that was reprocessed",
            wrong_use=not output.is_dir(),
        )
    return folder


def slug(name: str) -> str:
    """Return a name as a part of a path: the name itself if it is plain, else a digest."""
    if _SAFE.fullmatch(name) and not name.endswith("."):
        return name
    return f"x-{hashlib.sha256(name.encode('utf-8', 'surrogateescape')).hexdigest()[:16]}"


def product_page(path: str) -> str:
    """Return the page of a product, relative to the site."""
    parts = [slug(part) for part in PurePosixPath(path.removesuffix(".nc")).parts]
    return "/".join(("product", *parts)) + ".html"


def year_page(station: str, year: str) -> str:
    """Return the page of a station's year, relative to the site."""
    return f"station/{slug(station)}/{year}.html"


def month_list(station: str, month: str) -> str:
    """Return the list of the files of a station's month, ``2024-09``, relative to the site."""
    return f"station/{slug(station)}/{month}.txt"


def day_page(station: str, day: str) -> str:
    """Return the page of a station's day, relative to the site."""
    return f"station/{slug(station)}/{day[:4]}/{day}.html"


def href(target: str, page: str) -> str:
    """Return the link from one page of the site to a file, both relative to the site.

    Parameters
    ----------
    target : str
        May begin with ``../`` for files beside the site.
    page : str
    """
    relative = os.path.relpath(target, os.path.dirname(page) or ".")  # noqa: PTH120
    return quote(os.fsencode(relative.replace(os.sep, "/")))
