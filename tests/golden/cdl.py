"""Dump of NetCDF files as text like that of ncdump, independent of library versions."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np

TYPES = {"S1": "char", "i1": "byte", "i2": "short", "i4": "int", "f4": "float", "f8": "double"}
SUFFIXES = {"i1": "b", "i2": "s", "f4": "f"}
SHOWN = 3
"""Values at each end of a variable."""
OF_VERSIONS = {
    "date_created",
    "date_issued",
    "date_metadata_modified",
    "date_modified",
    "history",
    "id",
    "implementation",
    "lidarops_code_version",
    "product_version",
}
"""Attributes that change with every release: the dump names them without their value."""


def dump(path: Path) -> str:
    """Return the text of a file: dimensions, variables, attributes and a few values."""
    with netCDF4.Dataset(path) as file:
        file.set_auto_mask(False)
        file.set_auto_scale(False)
        file.set_auto_chartostring(False)
        return "\n".join(_lines(file)) + "\n"


def _lines(file: netCDF4.Dataset) -> Iterator[str]:
    yield "dimensions:"
    for name, dimension in file.dimensions.items():
        size = "of versions" if name == "provenance_strlen" else str(len(dimension))
        yield f"  {name} = {f'UNLIMITED ; // {size}' if dimension.isunlimited() else size} ;"
    yield "variables:"
    for name, variable in file.variables.items():
        dims = f"({', '.join(variable.dimensions)})" if variable.dimensions else ""
        yield f"  {TYPES[variable.dtype.str[1:]]} {name}{dims} ;"
        yield from _attributes(name, variable)
    yield "// global attributes:"
    yield from _attributes("", file)
    yield "data:"
    for name, variable in file.variables.items():
        if name != "provenance":
            yield f"  {name} = {_values(variable)} ;"


def _attributes(owner: str, thing: Any) -> Iterator[str]:
    for name in thing.ncattrs():
        value = "(of versions)" if name in OF_VERSIONS else _attribute(thing.getncattr(name))
        yield f"    {owner}:{name} = {value} ;"


def _attribute(value: Any) -> str:
    if isinstance(value, str):
        # One line a sentence, so that a changed word is one changed line.
        return '"' + value.replace("\n", "\\n\n        ").replace(". ", ".\n        ") + '"'
    numbers = np.atleast_1d(value)
    suffix = SUFFIXES.get(numbers.dtype.str[1:], "")
    return ", ".join(f"{_number(number)}{suffix}" for number in numbers)


def _values(variable: netCDF4.Variable) -> str:
    values = np.asarray(variable[...])
    if values.dtype.kind == "S":
        return '"' + values.tobytes().decode() + '"'
    flat = values.reshape(-1)
    if flat.size <= 2 * SHOWN:
        return ", ".join(map(_number, flat))
    first, last = (", ".join(map(_number, part)) for part in (flat[:SHOWN], flat[-SHOWN:]))
    return f"{first}, ... {flat.size - 2 * SHOWN} more ..., {last}"


def _number(number: Any) -> str:
    if number == netCDF4.default_fillvals["f4"]:
        return "_"
    return f"{number:.7g}" if number.dtype == np.float32 else f"{number:.12g}"
