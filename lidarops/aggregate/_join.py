"""Joins products along time, and what a product states as a whole along products."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import xarray as xr
from dask.array import map_blocks
from dask.base import tokenize
from numpy.typing import NDArray

from lidarops.aggregate.facts import UNSHARED, Header, coordinate_names
from lidarops.aggregate.means_variables import PRODUCT, PRODUCT_INDEX
from lidarops.netcdf.coordinates import on_altitude
from lidarops.netcdf.read import as_variable
from lidarops.netcdf.stored import StoredProduct, stored_values
from lidarops.netcdf.variables import attributes

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
        and all(_is_same(value, other.get(key)) for other in attributes[1:])
    }


def _is_same(one: Any, other: Any) -> bool:
    # Most are texts, which need no arrays.
    return one == other if isinstance(one, str) else np.array_equal(one, other)


class Part(NamedTuple):
    """One of the products that are joined."""

    header: Header
    file: Path
    attributes: Mapping[str, Any]
    times: NDArray[np.float64]
    """s since 1970, of each profile."""


def pattern_of(product: StoredProduct, header: Header) -> xr.Dataset:
    """Return the variables of joined products, by the first of them.

    Parameters
    ----------
    product : StoredProduct
    header : Header

    Returns
    -------
    xr.Dataset
        Not decoded, in memory, with ``product`` (product,) and ``product_index`` (time,).
        Variables of the whole product have the dimension ``product``; those of a vertical lidar
        lie along altitude. Only coordinates that do not change with time have values.
    """
    static = coordinate_names(header.kind)
    variables: dict[Any, xr.Variable] = {}
    for name, variable in product.variables.items():
        if name in UNSHARED:
            continue
        if name in static and "time" not in variable.dims:
            variables[name] = as_variable(variable).load()
            continue
        whole = "time" not in variable.dims
        dims = (PRODUCT.name, *variable.dims) if whole else variable.dims
        shape = (1, *variable.shape) if whole else variable.shape
        hollow = np.broadcast_to(np.zeros((), variable.dtype), shape)
        variables[name] = xr.Variable(dims, hollow, variable.attrs.whole())
    about = {row.name: attributes(row, mode=header.counting) for row in (PRODUCT, PRODUCT_INDEX)}
    about[PRODUCT.name].pop("_Encoding")
    index = np.zeros(header.profiles, np.int32)
    own = {
        PRODUCT.name: (PRODUCT.dims, np.array([header.id]), about[PRODUCT.name]),
        PRODUCT_INDEX.name: (PRODUCT_INDEX.dims, index, about[PRODUCT_INDEX.name]),
    }
    return xr.Dataset(on_altitude(variables), coords=own, attrs=product.attrs.whole())


def join(parts: Sequence[Part], pattern: xr.Dataset) -> xr.Dataset:
    """Join products of one group along time and along products.

    Parameters
    ----------
    parts : sequence of Part
    pattern : xr.Dataset
        From `pattern_of` the first.

    Returns
    -------
    xr.Dataset
        Not decoded, sorted by time, on dask arrays of one chunk for each product.
    """
    lengths = [part.header.profiles for part in parts]
    known = {
        "time": np.concatenate([part.times for part in parts]),
        PRODUCT.name: np.array([part.header.id for part in parts]),
        PRODUCT_INDEX.name: np.repeat(np.arange(len(parts), dtype=np.int32), lengths),
    }
    rows = {"time": tuple(lengths), PRODUCT.name: (1,) * len(parts)}
    sources = tuple((part.file, part.header.id) for part in parts)
    variables = {
        name: xr.Variable(variable.dims, known[name], variable.attrs)
        if name in known
        else _on_dask(str(name), variable, rows, sources)
        for name, variable in pattern.variables.items()
    }
    coordinates = {name: variables.pop(name) for name in pattern.coords}
    shared = shared_attributes([part.attributes for part in parts])
    return sorted_by_time(xr.Dataset(variables, coords=coordinates, attrs=shared))


def sorted_by_time(data: xr.Dataset) -> xr.Dataset:
    """Return data in the order of time."""
    times = data["time"].values
    if (times[1:] < times[:-1]).any():
        return data.isel(time=np.argsort(times, kind="stable"))
    return data


def _on_dask(
    name: str,
    variable: xr.Variable,
    rows: Mapping[Any, tuple[int, ...]],
    sources: tuple[tuple[Path, str], ...],
) -> xr.Variable:
    """Return a variable of all products, of which one is read at a time."""
    along = next((dim for dim in variable.dims if dim in rows), None)
    if along is None:
        return variable
    axis, whole = variable.dims.index(along), along == PRODUCT.name
    data = map_blocks(  # type: ignore[no-untyped-call]
        partial(_read_block, name, axis, whole, sources),
        name=f"{name}-{tokenize(sources, name)}",
        chunks=tuple(
            rows.get(dim, (size,)) for dim, size in zip(variable.dims, variable.shape, strict=True)
        ),
        dtype=variable.dtype,
        meta=np.empty((0,) * variable.ndim, variable.dtype),
    )
    return xr.Variable(variable.dims, data, variable.attrs)


def _read_block(
    name: str,
    axis: int,
    whole: bool,  # noqa: FBT001 - of a partial
    sources: tuple[tuple[Path, str], ...],
    block_id: tuple[int, ...],
) -> NDArray[Any]:
    """Return a variable of one product; one of the `whole` product gets the dimension `axis`."""
    values = stored_values(*sources[block_id[axis]], name)
    return np.expand_dims(values, axis) if whole else values
