"""Opens products as one lazy dataset: from files, a folder, an index or a store."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Final

import xarray as xr

from lidarops.aggregate._join import join, open_piece, shared_attributes
from lidarops.aggregate.facts import (
    Facts,
    Refused,
    groups,
    list_products,
    read_facts,
    read_product_facts,
    refuse_duplicates,
    refuse_several,
)
from lidarops.aggregate.index import INDEX, find_in_index
from lidarops.aggregate.selection import ProductSelection, parse_selection
from lidarops.aggregate.versioned_store import is_store, open_store
from lidarops.errors import ProductError, RetrievalInputError
from lidarops.netcdf.read import reading
from lidarops.netcdf.variables import USABLE

CARE: Final = 1
ALL: Final = 2
Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]


def open_products(
    source: Paths,
    *,
    kind: str | None = None,
    channel: str | None = None,
    station: str | None = None,
    instrument: str | None = None,
    since: datetime | str | None = None,
    until: datetime | str | None = None,
    usable: int = CARE,
    version: str | None = None,
) -> xr.Dataset:
    """Open products of one instrument, kind, channel and grid as one dataset in order of time.

    Parameters
    ----------
    source : path or str, or iterable of these
        Product files; or a folder of products or of a campaign's output; or an index or a store
        that `lidarops aggregate` wrote, which is much faster for a large archive.
    kind, channel, station, instrument : str, optional
        Select products.
    since, until : datetime or ISO 8601 text, optional
        Only products that end after, or start before, this time; UTC without a time
        zone. Products are opened whole.
    usable : int
        Worst values to keep: 0 good, 1 also those to use with care, 2 all. Others are NaN.
        ``quality_flag`` and ``usable`` are not masked.
    version : str, optional
        Id of a snapshot of a store; without it the newest.

    Returns
    -------
    xarray.Dataset
        Decoded, with units as attributes, on dask arrays, with one chunk per product or smaller
        unless it is of a store.
        ``product`` (product) is the id of each product, ``product_index`` (time) the index of the
        product of each profile. Variables of a whole product, such as the assumed lidar ratio,
        have the dimension ``product``.

    Raises
    ------
    ProductError
        If a file cannot be read, is not a product, or has a profile that another file has too; if
        no product is found; if the products cannot be joined (the message lists instruments,
        kinds, channels and grids to choose from).
    RetrievalInputError
        If `usable`, `kind` or a time is invalid, or `version` is given without a store.

    Examples
    --------
    >>> data = lidarops.open_products("demo", kind="homogeneous", channel="analog_532o")
    >>> data.total_extinction.resample(time="1D").mean()  # doctest: +SKIP
    """
    selection = parse_selection(kind, channel, station, instrument, since, until)
    store = Path(source) if isinstance(source, str | os.PathLike) else None
    if store is not None and is_store(store):
        return _masked(open_store(store, selection, version), usable)
    if version is not None:
        raise RetrievalInputError(
            "only stores have versions", field="version", remedy="give the folder of a store"
        )
    root, all_products = _find(source, selection)
    if not all_products:
        raise ProductError("no product found", file=store, remedy=_remedy(store))
    by_group = groups(all_products)
    remedy = "select by kind, channel, station or instrument, or give the files of one grid"
    refuse_several([group.words for group in by_group], store, remedy)
    (products,) = by_group.values()
    return _masked(_opened(root, products), usable)


def _remedy(folder: Path | None) -> str:
    """Return what to do where a folder holds no products."""
    stores = [] if folder is None else [path for path in folder.glob("*") if is_store(path)]
    if not stores:
        return "select less strictly"
    return f"open one of the stores in it: {', '.join(sorted(path.name for path in stores))}"


def _find(source: Paths, selection: ProductSelection) -> tuple[Path, list[Facts]]:
    """Return the selected products, and the folder that their paths are relative to."""
    if not isinstance(source, str | os.PathLike):
        return _from_files([Path(file) for file in source], selection)
    path = Path(source)
    if path.name == INDEX:
        root, paths = find_in_index(path, selection)
        # The facts are read again from the files, because the index may be outdated.
        return root, [read_facts(root, indexed) for indexed in paths]
    if path.is_dir():
        return path, _strictly(read_product_facts(path, list_products(path), selection))
    return _from_files([path], selection)


def _from_files(files: Sequence[Path], selection: ProductSelection) -> tuple[Path, list[Facts]]:
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise ProductError("is not a file", file=missing[0])
    root = Path(os.path.commonpath([file.resolve().parent for file in files])) if files else Path()
    names = [file.resolve().relative_to(root).as_posix() for file in files]
    return root, _strictly(read_product_facts(root, names, selection))


def _strictly(scanned: Iterator[Facts | Refused]) -> list[Facts]:
    products = []
    for facts in scanned:
        if isinstance(facts, Refused):
            raise ProductError(facts.reason, file=facts.path, remedy="leave the file out")
        products.append(facts)
    return products


def _opened(root: Path, products: Sequence[Facts]) -> xr.Dataset:
    pieces = [open_piece(root, facts, dask=True) for facts in products]
    times = []
    for facts, piece in zip(products, pieces, strict=True):
        with reading(facts.path):
            times.append((facts.path, piece["time"].values))
    refuse_duplicates(times)
    joined = join(pieces)
    joined.attrs = shared_attributes([piece.attrs for piece in pieces])
    # Decoded once, which is much faster than decoding each piece.
    return xr.decode_cf(joined)


def _masked(data: xr.Dataset, worst: int) -> xr.Dataset:
    """Return data without the floating-point values whose ``usable`` is worse than `worst`."""
    if worst not in (0, CARE, ALL):
        raise RetrievalInputError(
            f"is {worst!r}",
            field="usable",
            remedy="0 keeps unflagged values, 1 also those to use with care, 2 all values",
        )
    if worst == ALL:
        return data
    quality = data[USABLE]
    kept = quality <= worst
    masked_values = {
        name: variable.where(kept)
        for name, variable in data.data_vars.items()
        if variable.dtype.kind == "f" and variable.dims == quality.dims
    }
    return data.assign(masked_values)
