"""Products as one lazy dataset: files, a folder, or what an index finds."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from pathlib import Path

import numpy as np
import xarray as xr

from lidarops.aggregate._join import join, shared_attributes
from lidarops.aggregate.facts import (
    UNSHARED,
    Facts,
    Group,
    ProductSelection,
    Refused,
    coordinate_names,
    groups,
    list_products,
    read_facts,
    read_product_facts,
    refuse_duplicates,
    within,
)
from lidarops.aggregate.index import INDEX, Found, find_in_index
from lidarops.aggregate.means_variables import PRODUCT, PRODUCT_INDEX
from lidarops.aggregate.selection import select
from lidarops.aggregate.usable import CARE, masked
from lidarops.errors import ProductError
from lidarops.netcdf.variables import attributes
from lidarops.records import DetectionMode, ProductKind

Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]


def open_products(
    source: Paths,
    *,
    kind: ProductKind | str | None = None,
    channel: str | None = None,
    station: str | None = None,
    instrument: str | None = None,
    since: datetime | str | None = None,
    until: datetime | str | None = None,
    usable: int = CARE,
) -> xr.Dataset:
    """Open products of one instrument, kind, channel and grid as one dataset in order of time.

    Parameters
    ----------
    source : path or str, or iterable of these
        Product files; or a folder of products or of a campaign's output; or an index that
        `lidarops aggregate` wrote, which is much faster in a large archive.
    kind, channel, station, instrument : str, optional
        Only products of these.
    since, until : datetime or ISO 8601 text, optional
        Only products that end after, or start before, this time; UTC where no zone is told.
        Whole products are opened: their profiles are not cut.
    usable : int
        Worst values that are wanted: 0 good, 1 also those to use with care, 2 all. Others are
        NaN. ``quality_flag`` and ``usable`` always stay.

    Returns
    -------
    xarray.Dataset
        Decoded, with units as attributes, on dask arrays of one chunk a product or smaller.
        ``product`` (product) is the id of each product, ``product_index`` (time) tells which one
        holds a profile; what belongs to a product as a whole, such as the lidar ratio assumed,
        has the dimension ``product``.

    Raises
    ------
    ProductError
        Naming the file, where one cannot be read, is no product, or holds a profile that another
        holds too; where nothing is found; where what is found cannot be joined, naming the
        instruments, kinds, channels and grids to choose from.
    RetrievalInputError
        If `usable`, `kind` or a time is no such thing.

    Examples
    --------
    >>> data = lidarops.open_products("demo", kind="homogeneous", channel="analog_532o")
    >>> data.extinction.resample(time="1D").mean()  # doctest: +SKIP
    """
    selection = select(kind, channel, station, instrument, since, until)
    root, found = _found(source, selection)
    if not found:
        raise ProductError("no product is found", file=_told(source), remedy="ask for less")
    sorted_ = groups(found)
    if len(sorted_) > 1:
        raise ProductError(
            f"products of {len(sorted_)} groups cannot be joined: {_choices(sorted_)}",
            file=_told(source),
            remedy="choose by kind, channel, station, instrument, or give the files of one grid",
        )
    (products,) = sorted_.values()
    return masked(_opened(root, products), usable)


def _told(source: Paths) -> str | None:
    return os.fspath(source) if isinstance(source, str | os.PathLike) else None


def _choices(found: Iterable[Group]) -> str:
    return "; ".join(
        f"{each.station} {each.instrument} {each.kind.value} {each.channel} grid {each.grid[:8]}"
        for each in found
    )


def _found(source: Paths, selection: ProductSelection) -> tuple[Path, list[Facts]]:
    """Return the products that are asked for, and the folder that their paths start from."""
    if not isinstance(source, str | os.PathLike):
        files = [Path(each) for each in source]
        return _of_files(files, selection)
    path = Path(source)
    if path.name == INDEX:
        return _indexed(find_in_index(path, selection))
    if path.is_dir():
        return path, _strictly(read_product_facts(path, list_products(path), selection))
    return _of_files([path], selection)


def _of_files(files: Sequence[Path], selection: ProductSelection) -> tuple[Path, list[Facts]]:
    # Each in its own folder: nothing here joins two paths.
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise ProductError("is no file", file=missing[0])
    root = Path(os.path.commonpath([file.resolve().parent for file in files])) if files else Path()
    names = [file.resolve().relative_to(root).as_posix() for file in files]
    return root, _strictly(read_product_facts(root, names, selection))


def _strictly(scanned: Iterator[Facts | Refused]) -> list[Facts]:
    found = []
    for each in scanned:
        if isinstance(each, Refused):
            raise ProductError(each.reason, file=each.path, remedy="leave the file out")
        found.append(each)
    return found


def _indexed(found: Found) -> tuple[Path, list[Facts]]:
    # The index is a view, not the truth: the facts are read from the files that it names.
    return found.root, [read_facts(found.root, path) for path in found.paths]


def _opened(root: Path, products: Sequence[Facts]) -> xr.Dataset:
    pieces = [_piece(within(root, each.path), each) for each in products]
    owners = [each.path for each in products for _ in range(each.profiles)]
    refuse_duplicates(np.concatenate([piece["time"].values for piece in pieces]), owners)
    joined = join(pieces)
    joined.attrs = shared_attributes([piece.attrs for piece in pieces])
    # Once for all of them, which is much faster than one by one.
    return xr.decode_cf(joined)


def _piece(file: Path, facts: Facts) -> xr.Dataset:
    """Open one product with what belongs to it as a whole along ``product``."""
    try:
        opened = xr.open_dataset(
            file, engine="netcdf4", chunks={}, drop_variables=list(UNSHARED), decode_cf=False
        )
    except (OSError, RuntimeError, ValueError) as error:
        raise ProductError(f"cannot be read: {error}", file=file) from error
    static = coordinate_names(facts.kind)
    variables = {}
    for name, variable in opened.variables.items():
        whole = "time" not in variable.dims and name not in static
        variables[name] = variable.expand_dims("product") if whole else variable
    index = np.zeros(facts.profiles, np.int32)
    mode = DetectionMode(facts.mode)
    about = {row.name: attributes(row, mode=mode) for row in (PRODUCT, PRODUCT_INDEX)}
    about[PRODUCT.name].pop("_Encoding")
    own = {
        PRODUCT.name: (PRODUCT.dims, np.array([facts.id]), about[PRODUCT.name]),
        PRODUCT_INDEX.name: (PRODUCT_INDEX.dims, index, about[PRODUCT_INDEX.name]),
    }
    return xr.Dataset(variables, coords=own, attrs=opened.attrs)
