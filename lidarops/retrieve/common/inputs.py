"""Checks of the input of retrievals along range, and its conversion for compiled kernels."""

from __future__ import annotations

from dataclasses import fields, replace
from enum import StrEnum
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common.arrays import Array, Block, Floats

_Choice = TypeVar("_Choice", bound=StrEnum)
_Array = TypeVar("_Array", bound=Block)
_Result = TypeVar("_Result", bound=Any)

SHORTEST_REACH = 100.0
"""m. No lidar section ends nearer, but every section in km does: detects wrong units."""


def real_array(values: npt.ArrayLike, name: str) -> Floats:
    """Return `values` as float32 if they are, else float64; masked entries as NaN.

    Raises
    ------
    RetrievalInputError
        Where they are not real numbers.
    """
    if isinstance(values, np.ma.MaskedArray):
        values = np.where(np.ma.getmaskarray(values), np.nan, values.data)
    array = np.asarray(values)
    if array.dtype.kind not in "iuf":
        raise RetrievalInputError(
            f"holds {array.dtype}, not real numbers", field=name, remedy="give floats or integers"
        )
    if array.dtype.kind == "f" and array.dtype.itemsize == 4:
        return array.astype(np.float32, copy=False)
    return array.astype(np.float64, copy=False)


def broadcast(array: _Array, shape: tuple[int, ...], name: str) -> _Array:
    """Return an array in a shape to which it broadcasts.

    Raises
    ------
    RetrievalInputError
        Where it does not.
    """
    try:
        return np.broadcast_to(array, shape)  # type: ignore[return-value]
    except ValueError:
        problem = f"has the shape {array.shape}, which does not broadcast to {shape}"
        raise RetrievalInputError(problem, field=name) from None


def range_grid(values: npt.ArrayLike) -> Array:
    """Return the checked range axis, (bin,) m.

    Raises
    ------
    RetrievalInputError
        Where it is not one-dimensional, finite, positive and strictly ascending, or ends below
        100 m, as ranges in km do.
    """
    grid = real_array(values, "range").astype(np.float64)
    if grid.ndim != 1 or grid.size == 0:
        raise RetrievalInputError(
            f"has the shape {grid.shape}", field="range", remedy="give one value in m per bin"
        )
    if not np.all(np.isfinite(grid)) or not np.all(np.diff(grid) > 0):
        raise RetrievalInputError("is not finite and strictly ascending", field="range")
    if grid[0] <= 0:
        raise RetrievalInputError(
            f"starts at {grid[0]:g} m",
            field="range",
            remedy="remove the bins at and behind the lidar",
        )
    if grid[-1] < SHORTEST_REACH:
        raise RetrievalInputError(
            f"ends at {grid[-1]:g} m: range must be in m, this looks like km",
            field="range",
            remedy="multiply by 1000",
        )
    return np.ascontiguousarray(grid)


def profiles(
    power: npt.ArrayLike, grid: Array, name: str = "power"
) -> tuple[Floats, tuple[int, ...]]:
    """Return powers as contiguous (profile, bin), and the shape of their leading axes.

    Raises
    ------
    RetrievalInputError
        Where the last axis does not match the range.
    """
    array = real_array(power, name)
    if array.ndim == 0 or array.shape[-1] != grid.size:
        raise RetrievalInputError(
            f"has the shape {array.shape}, but range has {grid.size} bins",
            field=name,
            remedy="the last axis is range",
        )
    leading = array.shape[:-1]
    rows: Block = array.reshape(int(np.prod(leading, dtype=np.int64)), grid.size)
    return np.ascontiguousarray(rows), leading


def profiles_and_air(
    power: npt.ArrayLike, molecular_attenuated: npt.ArrayLike, grid: Array
) -> tuple[Array, tuple[int, ...], Array]:
    """Return `profiles` as float64, and the shape of the signal of air, (profile or 1, bin).

    Raises
    ------
    RetrievalInputError
        Where the last axis does not match the range, or the air is negative or not known.
    """
    rows, leading = profiles(power, grid)
    name = "molecular_attenuated"
    shape = noise_rows(molecular_attenuated, name, grid, leading)
    if not np.all(shape >= 0.0) or np.any(np.isinf(shape)):
        raise RetrievalInputError(
            "is negative or not finite", field=name, remedy="give a value for each bin"
        )
    return rows.astype(np.float64, copy=False), leading, shape


def with_leading_axes(result: _Result, leading: tuple[int, ...]) -> _Result:
    """Return a dataclass of (profile, ...) arrays with the leading axes of the profiles."""
    arrays = {field.name: getattr(result, field.name) for field in fields(result)}
    shaped = {name: array.reshape((*leading, *array.shape[1:])) for name, array in arrays.items()}
    return replace(result, **shaped)


def noise_rows(
    noise: npt.ArrayLike | None,
    name: str,
    grid: Array,
    leading: tuple[int, ...],
    *,
    negative: bool = True,
) -> Array:
    """Return values of bins, such as variances, as contiguous (profile or 1, bin); ones for None.

    Raises
    ------
    RetrievalInputError
        Where they do not broadcast to the power, or are negative although they must not be.
    """
    if noise is None:
        return np.ones((1, grid.size))
    array = real_array(noise, name).astype(np.float64, copy=False)
    shared = array.size == 1 or all(length == 1 for length in array.shape[:-1])
    target = (*((1,) * len(leading) if shared else leading), grid.size)
    rows = broadcast(array.reshape(array.shape[-1:]) if shared else array, target, name)
    if not negative and np.fmin.reduce(rows, axis=None, initial=0.0) < 0:
        raise RetrievalInputError("is negative", field=name)
    count = 1 if shared else int(np.prod(leading, dtype=np.int64))
    return np.ascontiguousarray(rows.reshape(count, grid.size))


def profile_values(
    values: npt.ArrayLike, name: str, leading: tuple[int, ...], *, finite: bool = True
) -> Array:
    """Return one value per profile as (profile or 1,).

    Raises
    ------
    RetrievalInputError
        Where they do not broadcast to the profiles, or are not finite although they must be.
    """
    array = real_array(values, name).astype(np.float64, copy=False)
    spread = array if array.size == 1 else broadcast(array, leading, name)
    flat = np.ascontiguousarray(spread.reshape(-1))
    if finite and not np.all(np.isfinite(flat)):
        raise RetrievalInputError("is not finite", field=name)
    return flat


def choice(name: str, kind: type[_Choice], field: str) -> _Choice:
    """Return the member of an enumeration with this name.

    Raises
    ------
    RetrievalInputError
        Where there is none; the message lists all names.
    """
    try:
        return kind(name)
    except ValueError:
        raise RetrievalInputError(
            f"is {name!r}", field=field, remedy=f"choose one of {', '.join(kind)}"
        ) from None
