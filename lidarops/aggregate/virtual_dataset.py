"""Views: virtual datasets over all products of one instrument, kind, channel and grid.

A view is a JSON file of kerchunk references; only small variables along time are copied. It is
derived from the products and can be deleted and made again. `open_view` refuses a view whose
products have changed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr

from lidarops.aggregate._join import join, shared_attributes
from lidarops.aggregate._optional_packages import need
from lidarops.aggregate._references import (
    TEMPLATE,
    Part,
    Refs,
    Source,
    Template,
    group_parts,
    read_source,
    read_template,
    references,
)
from lidarops.aggregate.facts import FOLDER, Facts, Group, Refused, refuse_duplicates
from lidarops.aggregate.usable import CARE, masked
from lidarops.errors import ProductError
from lidarops.records import DetectionMode
from lidarops.system.files import within, write_atomically

FORMAT: Final = 1
_BRACES: Final = ("{", "}")
_CODECS: Final = {"shuffle", "zlib"}


@dataclass(frozen=True, slots=True)
class View:
    """A view that was written."""

    path: str
    """Relative to the root of the products, with forward slashes."""
    products: int
    profiles: int
    parts: int
    """Number of Zarr groups: 1 if the chunks of all products fit one regular grid."""
    refused: tuple[Refused, ...] = ()
    """Products that could not be read and are not in the view."""


def write_view(root: Path, products: Sequence[Facts]) -> View:
    """Write the view of one group of products.

    Parameters
    ----------
    root : path
        Folder that product paths are relative to; the view is written to its
        ``aggregates/views``.
    products : sequence of Facts
        Of one group (`lidarops.aggregate.facts.groups`).

    Returns
    -------
    View

    Raises
    ------
    ProductError
        If the products are not of one group, have a time twice, or none can be read.
    """
    group = _group(products)
    alike, sources, refused = _sources(root, products)
    _refuse_duplicates(sources)
    all_parts = group_parts(sources, alike)
    target = root / FOLDER / "views" / f"{group.name}.json"
    content = _document(all_parts, alike, products[0].counting)
    target.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(target, json.dumps(content, sort_keys=True, separators=(",", ":")).encode())
    profiles = sum(source.facts.profiles for source in sources)
    path = target.relative_to(root).as_posix()
    return View(path, len(sources), profiles, len(all_parts), refused)


def _sources(
    root: Path, products: Sequence[Facts]
) -> tuple[Template, list[Source], tuple[Refused, ...]]:
    alike: Template | None = None
    sources, refused = [], []
    for product in products:
        try:
            alike = alike or read_template(root, product)
            sources.append(read_source(root, product, alike))
        except ProductError as error:
            refused.append(Refused(product.path, error.problem))
    if alike is None or not sources:
        raise ProductError(f"cannot be read: {refused[0].reason}", file=refused[0].path)
    return alike, sources, tuple(refused)


def _group(products: Sequence[Facts]) -> Group:
    all_groups = {product.group for product in products}
    if len(all_groups) != 1:
        names = ", ".join(sorted(group.name for group in all_groups)) or "none"
        raise ProductError(f"a view needs products of one group, not of {names}")
    for product in products:
        if any(brace in product.path for brace in _BRACES):
            raise ProductError(
                "has braces in its path, which references cannot hold", file=product.path
            )
    return all_groups.pop()


def _refuse_duplicates(sources: Sequence[Source]) -> None:
    times = np.concatenate([source.inline["time"] for source in sources])
    owners = [source.facts.path for source in sources for _ in range(source.facts.profiles)]
    refuse_duplicates(times, owners)


def _document(all_parts: Sequence[Part], alike: Template, mode: DetectionMode) -> dict[str, Any]:
    shared = shared_attributes([source.attributes for part in all_parts for source in part.sources])
    names = [""] if len(all_parts) == 1 else [f"part{number}" for number in range(len(all_parts))]
    refs: Refs = {}
    for name, part in zip(names, all_parts, strict=True):
        inner = references(part, alike, mode, shared)
        refs |= {f"{name}/{key}".removeprefix("/"): value for key, value in inner.items()}
    refs.setdefault(".zgroup", json.dumps({"zarr_format": 2}))
    return {
        "version": 1,
        "templates": {TEMPLATE: "../.."},
        "refs": refs,
        "lidarops": {
            "format": FORMAT,
            "parts": names,
            "products": [
                {
                    "path": source.facts.path,
                    "size": source.facts.size,
                    "sha256": source.facts.sha256,
                    "id": source.facts.id,
                    "seal": source.seal,
                }
                for part in all_parts
                for source in part.sources
            ],
        },
    }


def open_view(path: str | os.PathLike[str], *, usable: int = CARE) -> xr.Dataset:
    """Open a view as one lazy dataset, sorted by time.

    Parameters
    ----------
    path : path or str
        File from `write_view`, at its place below the root of the products.
    usable : int
        Worst values to keep: 0 good, 1 also those to use with care, 2 all. Others are NaN; flags
        are not masked.

    Returns
    -------
    xarray.Dataset
        Decoded, on dask arrays with one chunk per product or smaller. ``product`` (product) is
        the id of each product, ``product_index`` (time) the index of the product of each profile.
        Variables of a whole product have the dimension ``product``.

    Raises
    ------
    ProductError
        If the file is not a view, or a product is missing or has changed since.
    LidarOpsError
        If zarr is not installed.
    """
    view = Path(path)
    document = _read(view)
    root = view.resolve().parents[2]
    refs: dict[str, Refs] = {name: {} for name in document["lidarops"]["parts"]}
    for key, content in document["refs"].items():
        part, _, inner = key.partition("/")
        if part in refs:
            refs[part][inner] = content
        elif "" in refs:
            refs[""][key] = content
    pieces = [_part(root, part_refs) for part_refs in refs.values()]
    return masked(join(pieces), usable)


def _part(root: Path, refs: Refs) -> xr.Dataset:
    zarr, fsspec = need("zarr"), need("fsspec")
    # Zarr reads asynchronously; fsspec wraps the local files.
    system = fsspec.filesystem(
        "reference",
        fo={"version": 1, "templates": {TEMPLATE: root.as_posix()}, "refs": refs},
        remote_protocol="file",
        asynchronous=True,
    )
    store = zarr.storage.FsspecStore(system, read_only=True)
    dataset = xr.open_zarr(store, consolidated=False, zarr_format=2, chunks={}, decode_coords=True)
    dataset = dataset.assign_coords(product=dataset["product"].astype(str, keep_attrs=True))
    with_coords: xr.Dataset = dataset.set_coords(["product", "product_index"])
    return with_coords


def _read(view: Path) -> dict[str, Any]:
    try:
        document: Any = json.loads(view.read_bytes())
    except (OSError, ValueError) as error:
        raise ProductError(f"cannot be read as a view: {error}", file=view) from error
    header = document.get("lidarops") if isinstance(document, dict) else None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ProductError(
            "is not a view of this version of lidarops",
            file=view,
            remedy="write it again: lidarops aggregate",
        )
    try:
        for key, content in document["refs"].items():
            if key.endswith(".zarray"):
                _refuse_strange_array(json.loads(content), view, key)
        _check_products(view.resolve().parents[2], document, view)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ProductError(f"is a damaged view: {error!r}", file=view) from error
    return dict(document)


def _refuse_strange_array(array: dict[str, Any], view: Path, key: str) -> None:
    """Refuse codecs that views do not use, because some codecs execute what they decode."""
    codecs = {codec["id"] for codec in array["filters"]}
    if array["compressor"] is not None or not codecs <= _CODECS or "O" in array["dtype"]:
        raise ProductError("is not stored as in views of lidarops", file=view, field=key)


def _check_products(root: Path, document: dict[str, Any], view: Path) -> None:
    """Refuse a view whose products have changed, or that refers to other files."""
    known = set()
    prefix = f"{{{{{TEMPLATE}}}}}/"
    for product in document["lidarops"]["products"]:
        known.add(prefix + product["path"])
        file = within(root, product["path"])
        if not _is_unchanged(file, product):
            raise ProductError(
                "is missing or has changed since the view was written",
                file=file,
                remedy="write the view again: lidarops aggregate",
            )
    for key, place in document["refs"].items():
        if isinstance(place, list) and place[0] not in known:
            raise ProductError(
                "refers to a file that is not one of its products", file=view, field=key
            )


def _is_unchanged(file: Path, product: dict[str, Any]) -> bool:
    try:
        with file.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            stream.seek(product["seal"])
            stored_id = stream.read(len(product["id"]))
    except OSError:
        return False
    return bool(size == product["size"] and stored_id == product["id"].encode())
