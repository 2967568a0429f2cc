"""Copy the products of a campaign, and its site, to an object store."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Final

from lidarops.campaign.model import Campaign
from lidarops.catalog.store import Store
from lidarops.errors import CatalogError
from lidarops.system.files import COPIES, MANIFEST, SITE, sha256_of
from lidarops.system.stores import Published, RemoteStore

_PUBLISHED: Final = ".."
"""Where the products are in a store, relative to the site."""
_ADDRESSES: Final = ("https://", "http://")


def publish_products(campaign: Campaign, url: str) -> Published:
    """Copy the products in the ledger of a campaign to a store, as far as they changed.

    Parameters
    ----------
    campaign : Campaign
    url : str
        Destination, such as ``s3://bucket/prefix``; the driver finds the credentials.

    Returns
    -------
    Published

    Raises
    ------
    CatalogError
        If there is no ledger or it cannot be read, or the URL is unknown.
    ProductError
        If the store cannot be written, or a product is missing or differs from the ledger.
    """
    with (
        Store(campaign.catalog_url, campaign.name, create=False) as store,
        store.all_products() as made,
    ):
        products = {product.path: product.sha256 for product in made}
    journal = _journal(campaign, url)
    return RemoteStore(url).publish(campaign.products_root, products, journal, beside=SITE)


def publish_site(campaign: Campaign, url: str) -> Published:
    """Copy the site of a campaign to the folder ``site`` of a store, as far as it changed.

    Parameters
    ----------
    campaign : Campaign
    url : str
        Destination of the products; the site goes beside them.

    Returns
    -------
    Published

    Raises
    ------
    CatalogError
        If there is no site, or its downloads would not lead to published products.
    ProductError
        If the store cannot be written.
    """
    site = Path(campaign.output) / SITE
    _check_links(site)
    files = {
        path.relative_to(site).as_posix(): sha256_of(path)
        for path in sorted(site.rglob("*"))
        if path.is_file() and not path.is_symlink()
    }
    place = f"{url.rstrip('/')}/{SITE}"
    return RemoteStore(place).publish(site, files, _journal(campaign, place))


def _check_links(site: Path) -> None:
    """Refuse a site whose downloads lead to the disk that it was made on."""
    manifest = site / MANIFEST
    try:
        place = str(json.loads(manifest.read_bytes())["products_at"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CatalogError(
            "there is no complete site", file=manifest, remedy="run lidarops site OUT first"
        ) from error
    if place.rstrip("/") not in (_PUBLISHED, COPIES) and not place.startswith(_ADDRESSES):
        raise CatalogError(
            f"downloads lead to {place}, but published products are beside the site",
            file=manifest,
            field="products_at",
            remedy=f"run lidarops site OUT --products-at {_PUBLISHED}, or --copies",
        )


def _journal(campaign: Campaign, url: str) -> Path:
    """Return the journal of what was sent to a store."""
    name = hashlib.sha256(url.encode()).hexdigest()[:12]
    return Path(campaign.output) / f"published-{name}.sha256"
