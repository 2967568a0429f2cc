"""Catalog and ledger of a campaign in one database."""

from __future__ import annotations

from lidarops.catalog.ledger import Ledger


class Store(Ledger):
    """The catalog and ledger of one campaign: granules, and what was made from them.

    Parameters
    ----------
    url : str
        SQLAlchemy URL, such as ``sqlite:///catalog.sqlite`` or ``postgresql+psycopg://...``.
    campaign : str
        Name of the campaign; several may share a database.
    create : bool
        Whether to make the catalog where there is none.

    Raises
    ------
    CatalogError
        If the database cannot be opened, or is of another version of lidarops, or is not there.
    """
