"""Paths of pages, and links to them, to products, the STAC catalog and reports."""

from __future__ import annotations

import hashlib
import os
import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final
from urllib.parse import quote

from lidarops.errors import CatalogError, ProductError
from lidarops.system.files import last_change

if TYPE_CHECKING:
    from lidarops.site.product_entry import Entry

CALENDAR_HEIGHT: Final = 5000.0
"""Height above the station, m, below which a profile with a usable value counts in the calendar."""
BESIDE: Final = "../products"
"""Where products are in the output of a campaign, relative to the site."""
STAC_BESIDE: Final = "../aggregates/stac"
REPORTS_BESIDE: Final = "../report"
_ADDRESS: Final = re.compile(r"https?://[^\s\"<>]+")
_RELATIVE: Final = re.compile(r"(?:[A-Za-z0-9._-]+/?)+")
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
            wrong_use=True,
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


@dataclass(frozen=True, slots=True)
class Links:
    """Links to files beside the site."""

    output: Path
    """Output of the campaign."""
    products: str = BESIDE
    """Address of the products, or their place relative to the site."""
    stac_at: str = ""
    """The same of the STAC catalog; empty: beside the products in the output, else nowhere."""
    reports_at: str = ""
    """The same of the reports of runs."""

    def __post_init__(self) -> None:
        for field, place in (
            ("products", self.products),
            ("stac", self.stac_at or STAC_BESIDE),
            ("reports", self.reports_at or REPORTS_BESIDE),
        ):
            if not (_ADDRESS.fullmatch(place) or _RELATIVE.fullmatch(place)):
                raise CatalogError(
                    f"is neither an address nor a relative place: {place!r}",
                    field=field,
                    remedy="give https://..., or a place relative to the site such as ../products",
                    wrong_use=True,
                )

    @property
    def beside(self) -> bool:
        """Whether the site is used in the output of the campaign, with all other files."""
        return self.products == BESIDE

    def product(self, entry: Entry, page: str) -> str:
        """Return the link from a page to the file of a product."""
        return _link(self.products, entry.path, page)

    def stac(self, entry: Entry, page: str) -> str:
        """Return the link to the STAC item of a product; empty if there is none."""
        name = PurePosixPath(entry.path).stem
        return self._stac(f"{entry.kind}/{name}/{name}.json", page)

    def catalog(self, page: str) -> str:
        """Return the link to the STAC catalog; empty if there is none."""
        return self._stac("catalog.json", page)

    def report(self, page: str) -> str:
        """Return the link to the report of the last run; empty if there is none."""
        # The names of runs begin with their time.
        reports = sorted(self.output.glob("report/*/index.html"))
        place = self.reports_at or (REPORTS_BESIDE if self.beside else "")
        if not (reports and place):
            return ""
        return _link(place, f"{reports[-1].parent.name}/index.html", page)

    def changed(self, since: float) -> bool:
        """Return whether the STAC catalog may be another one than at a time, s since 1970."""
        folder = self.output / "aggregates"
        return folder.is_dir() and last_change(folder) >= since

    def _stac(self, name: str, page: str) -> str:
        place = self.stac_at or (STAC_BESIDE if self.beside else "")
        exists = (self.output / "aggregates/stac" / name).is_file()
        return _link(place, name, page) if place and exists else ""


def _link(place: str, name: str, page: str) -> str:
    """Return the link from a page to a file at a place."""
    base = place.rstrip("/")
    return f"{base}/{quote(name)}" if _ADDRESS.fullmatch(place) else href(f"{base}/{name}", page)
