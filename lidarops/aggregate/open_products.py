"""Opens products as one lazy dataset: from files, a folder, an index or a store."""

from __future__ import annotations

import os
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path
from typing import Final

import xarray as xr

from lidarops.aggregate._join import Part, join, pattern_of
from lidarops.aggregate.facts import (
    Header,
    ProductSelection,
    groups,
    list_products,
    parse_selection,
    read_header,
    refuse_duplicates,
    refuse_several,
)
from lidarops.aggregate.index import INDEX, find_in_index, without_unselected
from lidarops.aggregate.versioned_store import is_store, open_store
from lidarops.errors import ProductError, RetrievalInputError
from lidarops.netcdf.stored import open_stored, reading
from lidarops.netcdf.variables import judging, summary_of
from lidarops.system.files import within

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
        that `lidarops aggregate` wrote. Of a folder with an index, only files that are selected
        or have changed since are opened, which is much faster for a large archive.
    kind, channel, station, instrument : str, optional
        Select products.
    since, until : datetime or ISO 8601 text, optional
        Only products that end after, or start before, this time; UTC without a time
        zone. Products are opened whole.
    usable : int
        Worst values to keep: 0 good, 1 also those to use with care, 2 all. Others are NaN. Each
        quantity is masked by the flags that judge it; flags and ``usable`` are not masked.
    version : str, optional
        Id of a snapshot of a store; without it the newest.

    Returns
    -------
    xarray.Dataset
        Decoded, with units as attributes, on dask arrays, with one chunk per product unless it is
        of a store.
        Those of vertical lidars have the dimension ``altitude``, m above the geoid, of slant beams
        ``range``.
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
        return _usable_values(open_store(store, selection, version), usable)
    if version is not None:
        raise RetrievalInputError(
            "only stores have versions", field="version", remedy="give the folder of a store"
        )
    root, paths = _candidates(source, selection)
    parts = _read(root, paths, selection)
    if not parts:
        raise ProductError("no product found", file=store, remedy=_remedy(store))
    by_group = groups(parts)
    remedy = "select by kind, channel, station or instrument, or give the files of one grid"
    refuse_several([group.words for group in by_group], store, remedy)
    (headers,) = by_group.values()
    ordered = [parts[header] for header in headers]
    refuse_duplicates((part.header.path, part.times) for part in ordered)
    with headers[0].opened(root) as product, reading(headers[0].path):
        pattern = pattern_of(product, headers[0])
    # Decoded once, which is much faster than decoding each product.
    return _usable_values(xr.decode_cf(join(ordered, pattern)), usable)


def _remedy(folder: Path | None) -> str:
    """Return what to do where a folder holds no products."""
    stores = [] if folder is None else [path for path in folder.glob("*") if is_store(path)]
    if not stores:
        return "select less strictly"
    return f"open one of the stores in it: {', '.join(sorted(path.name for path in stores))}"


def _candidates(source: Paths, selection: ProductSelection) -> tuple[Path, list[str]]:
    """Return files that may be selected products, and the folder that they are relative to."""
    if isinstance(source, str | os.PathLike):
        path = Path(source)
        if path.name == INDEX:
            return find_in_index(path, selection)
        if path.is_dir():
            return path, without_unselected(path, list_products(path), selection)
    files = [Path(source)] if isinstance(source, str | os.PathLike) else [*map(Path, source)]
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise ProductError("is not a file", file=missing[0])
    root = Path(os.path.commonpath([file.resolve().parent for file in files])) if files else Path()
    return root, [file.resolve().relative_to(root).as_posix() for file in files]


def _read(root: Path, paths: Iterable[str], selection: ProductSelection) -> dict[Header, Part]:
    """Return the selected products."""
    parts = {}
    for path in paths:
        try:
            file = within(root, path)
            with reading(file), open_stored(file) as product:
                header = read_header(product, path, selection)
                if header is not None:
                    parts[header] = Part(header, file, product.attrs.whole(), product["time"][...])
        except ProductError as error:
            raise ProductError(error.problem, file=path, remedy="leave the file out") from error
    return parts


def _usable_values(data: xr.Dataset, worst: int) -> xr.Dataset:
    """Return data without the floating-point values that their flags call worse than `worst`."""
    if worst not in (0, CARE, ALL):
        raise RetrievalInputError(
            f"is {worst!r}",
            field="usable",
            remedy="0 keeps unflagged values, 1 also those to use with care, 2 all values",
        )
    if worst == ALL:
        return data
    names = [str(name) for name in data.data_vars]
    masked_values = {}
    for name in names:
        variable, quality = data[name], data[summary_of(judging(name, names))]
        if variable.dtype.kind == "f" and variable.dims == quality.dims:
            masked_values[name] = variable.where(quality <= worst)
    return data.assign(masked_values)
