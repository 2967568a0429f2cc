"""Opens products as pieces, and joins them along time and their own variables along products."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr

from lidarops.aggregate.facts import UNSHARED, Facts, coordinate_names
from lidarops.aggregate.means_variables import PRODUCT, PRODUCT_INDEX
from lidarops.errors import ProductError
from lidarops.netcdf.read import reading
from lidarops.netcdf.variables import attributes
from lidarops.system.files import within

_PER_PRODUCT: Final = (
    "date_", "history", "id", "lidarops_input_count", "lidarops_plan", "lidarops_scene",
    "lidarops_steps", "lidarops_unused_inputs", "lidarops_window_", "measurement_ID",
    "time_coverage_",
)  # fmt: skip
"""Prefixes of global attributes that apply to one product only."""


def shared_attributes(attributes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the global attributes that are equal in all products and apply to all, in order."""
    first = attributes[0]
    return {
        key: value
        for key, value in first.items()
        if not key.startswith(_PER_PRODUCT)
        and all(key in other and np.array_equal(other[key], value) for other in attributes[1:])
    }


def open_piece(root: Path, facts: Facts, *, dask: bool) -> xr.Dataset:
    """Open a product, with the dimension ``product`` for variables of the whole product.

    Parameters
    ----------
    root : path
        Folder that the path of the product is relative to.
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
    file = within(root, facts.path)
    with reading(file):
        opened = xr.open_dataset(
            file, engine="netcdf4", chunks=chunks, drop_variables=list(UNSHARED), decode_cf=False
        )
    try:
        facts.refuse_changed(opened)
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


def join(pieces: Sequence[xr.Dataset]) -> xr.Dataset:
    """Join datasets along time and along products.

    Parameters
    ----------
    pieces : sequence of xr.Dataset
        Of one group, each with ``product`` (product,) and ``product_index`` (time,). Variables
        with neither dimension must be equal in all.

    Returns
    -------
    xr.Dataset
        Sorted by time.
    """
    joined = pieces[0] if len(pieces) == 1 else _joined(pieces)
    times = joined["time"].values
    if (times[1:] < times[:-1]).any():
        joined = joined.isel(time=np.argsort(times, kind="stable"))
    return joined


def _joined(pieces: Sequence[xr.Dataset]) -> xr.Dataset:
    starts = np.cumsum([0, *(piece.sizes["product"] for piece in pieces[:-1])])
    first = pieces[0]
    variables = {}
    for name, variable in first.variables.items():
        parts = [piece.variables[name].to_base_variable() for piece in pieces]
        if name == PRODUCT_INDEX.name:
            # Each piece counts its own products from 0.
            parts = [part + np.int32(start) for part, start in zip(parts, starts, strict=True)]
            parts[0].attrs = variable.attrs
        dim = next((dim for dim in ("time", PRODUCT.name) if dim in variable.dims), None)
        variables[name] = variable if dim is None else _concat(parts, dim)
    coordinates = {name: variables.pop(name) for name in first.coords}
    shared = shared_attributes([piece.attrs for piece in pieces])
    return xr.Dataset(variables, coords=coordinates, attrs=shared)


def _concat(parts: Sequence[xr.Variable], dim: str) -> xr.Variable:
    joined: xr.Variable = xr.Variable.concat(parts, dim)  # type: ignore[no-untyped-call]
    return joined
