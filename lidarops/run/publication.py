"""Copy the products of a campaign to an object store."""

from __future__ import annotations

import hashlib
from pathlib import Path

from lidarops.campaign.model import Campaign
from lidarops.catalog.store import Store
from lidarops.system.stores import Published, RemoteStore


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
    # One journal per store.
    name = hashlib.sha256(url.encode()).hexdigest()[:12]
    journal = Path(campaign.output) / f"published-{name}.sha256"
    return RemoteStore(url).publish(campaign.products_root, products, journal)
