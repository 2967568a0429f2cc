"""Check what a NetCDF file states against its size, before anything of it is read.

A crafted file of some kB can state variables of many GB, or take values from other files.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import h5py

from lidarops.errors import ProductError

OTHER_DIMENSION: Final = "_nc4_non_coord_"
"""Prefix in HDF5 of a variable that has the name of a dimension but does not lie along it."""

_HDF5: Final = b"\x89HDF"
_DEFLATE_LIMIT: Final = 1032
"""Largest factor by which deflate, the only compression of our products, shrinks data (zlib)."""
_UNWRITTEN: Final = 64 * 2**20
"""Bytes that a file may state beyond that: HDF5 stores no chunk where nothing was written."""
_MEMORY_SHARE: Final = 0.5
"""Share of the memory of this machine that one variable may take; assumed."""
_GIGABYTE: Final = 1e9
_DISTRUST: Final = "lidarops does not write such files: do not trust this one"
_NO_VARIABLE: Final = b"This is a netCDF dimension but not a netCDF variable"


def check_sizes(path: str | Path) -> None:
    """Refuse a NetCDF-4 file whose variables cannot be in it, or do not fit into memory.

    For readers that load whole variables; see `check_contents`.

    Parameters
    ----------
    path : path or str

    Raises
    ------
    ProductError
        Naming the variable.
    OSError
        If the file cannot be read.
    """
    stated = check_contents(path)
    largest = _largest(stated)
    most = _MEMORY_SHARE * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    _refuse_more(stated.get(largest, 0), most, Path(path), largest, "be read on this machine")


def check_contents(path: str | Path) -> dict[str, int]:
    """Refuse a NetCDF-4 file whose variables cannot be in it.

    Other files pass: those of NetCDF-3 are no larger in memory than on disk.

    Parameters
    ----------
    path : path or str

    Returns
    -------
    dict of str to int
        Variable -> its bytes in memory; empty for other files.

    Raises
    ------
    ProductError
        Naming the variable.
    OSError
        If the file cannot be read.
    """
    file = Path(path)
    with file.open("rb") as stream:
        if stream.read(len(_HDF5)) != _HDF5:
            return {}
        size = os.fstat(stream.fileno()).st_size
    with h5py.File(file, "r") as opened:
        stated = {name: _stated_bytes(opened, name, file) for name in opened}
    most = _DEFLATE_LIMIT * size + _UNWRITTEN
    _refuse_more(sum(stated.values()), most, file, _largest(stated), "hold")
    return stated


def _largest(stated: Mapping[str, int]) -> str:
    return max(stated, key=lambda name: stated[name], default="")


def is_bare_dimension(stored: h5py.h5d.DatasetID) -> bool:
    """Return whether a dataset is a dimension without a variable of its name."""
    if not h5py.h5ds.is_scale(stored):
        return False
    return bool(h5py.h5ds.get_scale_name(stored).startswith(_NO_VARIABLE))


def _refuse_more(stated: int, most: float, file: Path, field: str, able: str) -> None:
    if stated > most:
        raise ProductError(
            f"states {stated / _GIGABYTE:.3g} GB of values, but a file of {file.stat().st_size}"
            f" bytes can {able} at most {most / _GIGABYTE:.3g} GB",
            file=file,
            field=field,
            remedy=_DISTRUST,
        )


def _stated_bytes(opened: h5py.File, name: str, file: Path) -> int:
    """Return the bytes of a variable in memory; at least one chunk is read of it."""
    place = name.encode()
    hard = opened.id.links.get_info(place).type == h5py.h5l.TYPE_HARD
    # Untyped: the types of h5py differ between its releases.
    stored: Any = h5py.h5o.open(opened.id, place) if hard else None
    if isinstance(stored, h5py.h5g.GroupID):
        return 0
    # Faster than the attributes of a dataset.
    layout: Any = stored.get_create_plist() if isinstance(stored, h5py.h5d.DatasetID) else None
    if layout is None or layout.get_external_count() or layout.get_layout() == h5py.h5d.VIRTUAL:
        raise ProductError(
            "takes its values from elsewhere, which could be any file of this machine",
            file=file,
            field=name,
            remedy=_DISTRUST,
        )
    if stored.get_type().get_class() == h5py.h5t.VLEN:
        raise ProductError(
            "has values of variable length, of which the file does not state how large they are",
            file=file,
            field=name,
            remedy=_DISTRUST,
        )
    chunk = math.prod(layout.get_chunk()) if layout.get_layout() == h5py.h5d.CHUNKED else 0
    # A dimension without variable holds no values.
    values = 0 if is_bare_dimension(stored) else stored.get_space().get_simple_extent_npoints()
    return int(stored.get_type().get_size() * max(values, chunk))
