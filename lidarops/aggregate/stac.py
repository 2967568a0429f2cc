"""Products as a static STAC catalog: one Item per product, one Collection per kind."""

from __future__ import annotations

import math
import os
import re
import shutil
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any, Final
from urllib.parse import quote

from lidarops.aggregate import need
from lidarops.aggregate.facts import FOLDER, Facts
from lidarops.errors import ProductError
from lidarops.kinds import kinds
from lidarops.netcdf.variables import layout_of

_NETCDF: Final = "application/x-netcdf"
_PREFIX: Final = "lidarops"
_ADDRESS: Final = re.compile(r"(?:https?://[^\s\"<>]+)?\Z")


def write_stac(root: Path, products: Sequence[Facts], products_at: str = "") -> str:
    """Write a self-contained STAC catalog of products; replace a previous one.

    All links are relative, including those to products, so that the whole output can be moved or
    served from anywhere; or those to products lead to an address. The content does not depend on
    time or place of writing.

    Parameters
    ----------
    root : path
        Folder that product paths are relative to; the catalog is written to its
        ``aggregates/stac``.
    products : sequence of Facts
    products_at : str, optional
        Address at which the products are published; default: beside the catalog in the output.

    Returns
    -------
    str
        Path of ``catalog.json`` relative to `root`.

    Raises
    ------
    ProductError
        If two products have the same file name, there are no products, or `products_at` is no
        address.
    LidarOpsError
        If pystac is not installed.
    OSError
        If the files cannot be written.
    """
    pystac = need("pystac")
    if not products:
        raise ProductError("there is no product to list", file=root)
    if not _ADDRESS.match(products_at):
        raise ProductError(
            f"{products_at!r} is no address of products", remedy="give https://..., or none"
        )
    _refuse_equal_names(products)
    catalog = pystac.Catalog(
        id=" ".join(sorted({product.campaign for product in products})),
        description="Products of lidarops, one Collection for each kind.",
    )
    target = root / FOLDER / "stac"
    for kind in kinds():
        of_kind = sorted((p for p in products if p.kind == kind), key=lambda facts: facts.path)
        if of_kind:
            catalog.add_child(_collection(pystac, kind, of_kind))
    catalog.normalize_hrefs(target.resolve().as_posix(), skip_unresolved=False)
    for item in catalog.get_items(recursive=True):
        _link_product(item, root.resolve(), products_at)
    # Written beside the old catalog, so that readers find a complete one.
    building = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        catalog.save(pystac.CatalogType.SELF_CONTAINED, dest_href=building.as_posix())
        shutil.rmtree(target, ignore_errors=True)
        building.rename(target)
    finally:
        shutil.rmtree(building, ignore_errors=True)
    return (target / "catalog.json").relative_to(root).as_posix()


def _refuse_equal_names(products: Sequence[Facts]) -> None:
    names: dict[str, str] = {}
    for product in products:
        other = names.setdefault(_name(product), product.path)
        if other != product.path:
            raise ProductError(
                f"has the file name of {other}", file=product.path, remedy="leave one out"
            )


def _name(product: Facts) -> str:
    return PurePosixPath(product.path).stem


def _collection(pystac: Any, kind: str, products: Sequence[Facts]) -> Any:
    layout = layout_of(kind)
    places = [(product.longitude, product.latitude) for product in products]
    west, south = (min(axis) for axis in zip(*places, strict=True))
    east, north = (max(axis) for axis in zip(*places, strict=True))
    times = [[min(p.start for p in products), max(p.stop for p in products)]]
    collection = pystac.Collection(
        id=kind,
        title=layout.title,
        description=layout.summary,
        keywords=list(layout.keywords),
        extent=pystac.Extent(
            pystac.SpatialExtent([[west, south, east, north]]), pystac.TemporalExtent(times)
        ),
    )
    for product in products:
        collection.add_item(_item(pystac, product))
    return collection


def _item(pystac: Any, product: Facts) -> Any:
    place = [product.longitude, product.latitude]
    wavelength = product.wavelength if math.isfinite(product.wavelength) else None
    own = {
        "id": product.id,
        "kind": product.kind,
        "channel": product.channel,
        "recorder": product.recorder or None,
        "wavelength": wavelength,
        "station_altitude": product.altitude,
        "profiles": product.profiles,
        "values": product.verdicts.values,
        **product.verdicts._asdict(),
        "grid": product.grid,
        "code_version": product.code_version,
        "flags": {name.lower(): count for name, count in product.flagged.items()},
    }
    item = pystac.Item(
        id=_name(product),
        geometry={"type": "Point", "coordinates": place},
        bbox=[*place, *place],
        datetime=None,
        start_datetime=product.start,
        end_datetime=product.stop,
        properties={
            "platform": product.station,
            "instruments": [product.instrument],
            "mission": product.campaign,
            **{f"{_PREFIX}:{name}": value for name, value in own.items() if value is not None},
        },
    )
    asset = pystac.Asset(
        href=product.path,
        media_type=_NETCDF,
        roles=["data"],
        extra_fields={f"{_PREFIX}:size": product.size, f"{_PREFIX}:sha256": product.sha256},
    )
    item.add_asset("product", asset)
    return item


def _link_product(item: Any, root: Path, products_at: str) -> None:
    """Make the link to the product lead to its address, or relative to the item."""
    asset = item.assets["product"]
    if products_at:
        place = quote(asset.href.removeprefix("products/"))
        asset.href = f"{products_at.rstrip('/')}/{place}"
        return
    folder = Path(item.get_self_href()).parent
    asset.href = Path(os.path.relpath(root / asset.href, folder)).as_posix()
