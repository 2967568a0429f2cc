"""Where the pages of the site find what is not a page: products, the STAC catalog, reports."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final
from urllib.parse import quote

from lidarops.errors import CatalogError
from lidarops.site.paths import href
from lidarops.site.product_entry import Entry

BESIDE: Final = "../products"
"""Where products are in the output of a campaign, relative to the site."""
STAC_BESIDE: Final = "../aggregates/stac"
REPORTS_BESIDE: Final = "../report"
_ADDRESS: Final = re.compile(r"https?://[^\s\"<>]+")
_RELATIVE: Final = re.compile(r"(?:[A-Za-z0-9._-]+/?)+")


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

    def _stac(self, name: str, page: str) -> str:
        place = self.stac_at or (STAC_BESIDE if self.beside else "")
        exists = (self.output / "aggregates/stac" / name).is_file()
        return _link(place, name, page) if place and exists else ""


def _link(place: str, name: str, page: str) -> str:
    """Return the link from a page to a file at a place."""
    base = place.rstrip("/")
    return f"{base}/{quote(name)}" if _ADDRESS.fullmatch(place) else href(f"{base}/{name}", page)
