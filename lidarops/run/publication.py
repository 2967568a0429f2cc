"""Copy the products of a campaign to an object store, for those who have no access to its disk."""

from __future__ import annotations

import hashlib
from pathlib import Path

from lidarops.campaign.model import Campaign
from lidarops.catalog.store import Store
from lidarops.system.stores import Published, RemoteStore


def publish_products(campaign: Campaign, url: str) -> Published:
    """Bring a store up to date with the products in the ledger of a campaign.

    Parameters
    ----------
    campaign : Campaign
    url : str
        Where the products go, such as ``s3://bucket/prefix``; credentials come from where the
        driver looks for them.

    Returns
    -------
    Published

    Raises
    ------
    CatalogError
        If there is no ledger or it cannot be read, or the URL is unknown.
    ProductError
        If the store cannot be written, or a product is missing or not what the ledger
        says.
    """
    with (
        Store(campaign.catalog_url, campaign.name, create=False) as store,
        store.all_made() as made,
    ):
        products = {each.path: each.sha256 for each in made}
    # One a store: what was sent to one says nothing of another.
    name = hashlib.sha256(url.encode()).hexdigest()[:12]
    journal = Path(campaign.output) / f"published-{name}.sha256"
    return RemoteStore(url).publish(campaign.products_root, products, journal)
