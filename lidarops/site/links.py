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
_ADDRESS: Final = re.compile(r"https?://[^\s\"<>]+")
_RELATIVE: Final = re.compile(r"(?:[A-Za-z0-9._-]+/?)+")


@dataclass(frozen=True, slots=True)
class Links:
    """Links to files beside the site."""

    output: Path
    """Output of the campaign."""
    products: str = BESIDE
    """Address of the products, or their place relative to the site."""

    def __post_init__(self) -> None:
        if not (_ADDRESS.fullmatch(self.products) or _RELATIVE.fullmatch(self.products)):
            raise CatalogError(
                f"is neither an address nor a relative place: {self.products!r}",
                field="products",
                remedy="give https://..., or a place relative to the site such as ../products",
                wrong_use=True,
            )

    @property
    def beside(self) -> bool:
        """Whether the site is used in the output of the campaign, with all other files."""
        return self.products == BESIDE

    def product(self, entry: Entry, page: str) -> str:
        """Return the link from a page to the file of a product."""
        base = self.products.rstrip("/")
        if _ADDRESS.fullmatch(self.products):
            return f"{base}/{quote(entry.path)}"
        return href(f"{base}/{entry.path}", page)

    def stac(self, entry: Entry, page: str) -> str:
        """Return the link to the STAC item of a product; empty if there is none beside the site."""
        name = PurePosixPath(entry.path).stem
        return self._beside(f"aggregates/stac/{entry.kind}/{name}/{name}.json", page)

    def catalog(self, page: str) -> str:
        """Return the link to the STAC catalog; empty if there is none beside the site."""
        return self._beside("aggregates/stac/catalog.json", page)

    def report(self, page: str) -> str:
        """Return the link to the report of the last run; empty if there is none."""
        # The names of runs begin with their time.
        reports = sorted(self.output.glob("report/*/index.html"))
        return self._beside(f"report/{reports[-1].parent.name}/index.html", page) if reports else ""

    def _beside(self, name: str, page: str) -> str:
        exists = self.beside and (self.output / name).is_file()
        return href(f"../{name}", page) if exists else ""
