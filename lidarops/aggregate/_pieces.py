"""Opens one product as a piece that can be joined with others of its group."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from lidarops.aggregate.facts import UNSHARED, Facts, coordinate_names, refuse_changed
from lidarops.aggregate.means_variables import PRODUCT, PRODUCT_INDEX
from lidarops.errors import ProductError
from lidarops.netcdf.read import reading
from lidarops.netcdf.variables import attributes


def open_piece(file: Path, facts: Facts, *, dask: bool) -> xr.Dataset:
    """Open a product, with the dimension ``product`` for variables of the whole product.

    Parameters
    ----------
    file : path
    facts : Facts
    dask : bool
        Whether values become dask arrays; without it, each read costs less.

    Returns
    -------
    xr.Dataset
        Lazy, not decoded, with ``product`` (product,) and ``product_index`` (time,). The caller
        closes it.

    Raises
    ------
    ProductError
        If the file cannot be read, or has changed since its facts were read.
    """
    chunks: dict[str, int] | None = {} if dask else None
    with reading(file):
        opened = xr.open_dataset(
            file, engine="netcdf4", chunks=chunks, drop_variables=list(UNSHARED), decode_cf=False
        )
    try:
        refuse_changed(opened, facts)
    except ProductError:
        opened.close()
        raise
    static = coordinate_names(facts.kind)
    variables = {}
    for name, variable in opened.variables.items():
        whole = "time" not in variable.dims and name not in static
        variables[name] = variable.expand_dims("product") if whole else variable
    index = np.zeros(facts.profiles, np.int32)
    mode = facts.counting
    about = {row.name: attributes(row, mode=mode) for row in (PRODUCT, PRODUCT_INDEX)}
    about[PRODUCT.name].pop("_Encoding")
    own = {
        PRODUCT.name: (PRODUCT.dims, np.array([facts.id]), about[PRODUCT.name]),
        PRODUCT_INDEX.name: (PRODUCT_INDEX.dims, index, about[PRODUCT_INDEX.name]),
    }
    piece = xr.Dataset(variables, coords=own, attrs=opened.attrs)
    piece.set_close(opened.close)
    return piece
