"""Kerchunk references to the chunks of products, as one Zarr hierarchy.

Format: version 1 of the kerchunk specification with Zarr version 2. The HDF5 filters shuffle and
deflate map to Zarr filters one to one. Products whose chunks do not fit one regular grid along time
become several Zarr groups, called parts, because Zarr version 2 supports only regular chunks.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.aggregate.facts import (
    UNSHARED,
    Facts,
    coordinate_names,
    opened,
    plain,
    refuse_changed,
)
from lidarops.aggregate.means_variables import PRODUCT, PRODUCT_INDEX
from lidarops.errors import ProductError
from lidarops.netcdf.read import reading
from lidarops.netcdf.variables import attributes
from lidarops.netcdf.write import is_chunked
from lidarops.records import DetectionMode
from lidarops.system.files import within

Refs = dict[str, Any]

TEMPLATE: Final = "u"
_LEVEL: Final = 6
_PLAIN_ENCODING: Final = {"zlib": True, "shuffle": True, "fletcher32": False}


@dataclass(frozen=True, slots=True)
class ChunkLocations:
    """Locations of the chunks of one variable in the file of a product."""

    chunk: tuple[int, ...]
    bytes: Mapping[tuple[int, ...], tuple[int, int]]
    """Index of the chunk along each axis -> offset and size in bytes."""


@dataclass(frozen=True, slots=True)
class Source:
    """A product with its chunk locations and small variables."""

    facts: Facts
    seal: int
    """Offset of the product's id in its file, to check later that the file is unchanged."""
    attributes: Mapping[str, Any]
    """Global attributes."""
    inline: Mapping[str, NDArray[Any]]
    """Values of small variables along time and of scalars."""
    chunks: Mapping[str, ChunkLocations]


@dataclass(slots=True)
class Part:
    """Products whose chunks form one regular grid along time."""

    chunks: Mapping[str, tuple[int, ...]]
    sources: list[Source] = field(default_factory=list)
    full: bool = False
    """Whether the last chunk along time is incomplete, so that no product can follow."""

    def add(self, source: Source) -> None:
        """Append a product."""
        self.sources.append(source)
        profiles = source.facts.profiles
        self.full = any(profiles % chunk[0] for chunk in self.chunks.values())


@dataclass(frozen=True, slots=True)
class Template:
    """Variables and static coordinates of a group, from its first product."""

    kind: str
    variables: Mapping[str, xr.Variable]
    """Values are loaded only for coordinates that do not change with time."""

    def along_time(self, name: str) -> bool:
        """Return whether a variable changes with time."""
        return "time" in self.variables[name].dims

    def is_static(self, name: str) -> bool:
        """Return whether a variable is a coordinate that is equal in all products."""
        return not self.along_time(name) and name in coordinate_names(self.kind)

    def is_inline(self, name: str) -> bool:
        """Return whether the values of a variable are stored with the references."""
        variable = self.variables[name]
        dims = set(variable.dims) - {"time", "nv"}
        return not dims or not is_chunked(variable, "time")


def read_template(root: Path, first: Facts) -> Template:
    """Read variables and static coordinates of a group from its first product."""
    with opened(within(root, first.path)) as product:
        names = [str(name) for name in product.variables if name not in UNSHARED]
        alike = Template(first.kind, {name: product.variables[name] for name in names})
        for name in names:
            if alike.is_static(name):
                alike.variables[name].load()
    return alike


def read_source(root: Path, facts: Facts, alike: Template) -> Source:
    """Read the chunk locations and small variables of a product.

    Raises
    ------
    ProductError
        If the product changed since its facts were read, or is not stored as lidarops stores
        products.
    """
    file = within(root, facts.path)
    with opened(file) as product:
        refuse_changed(product, facts)
        names = [name for name in alike.variables if not alike.is_static(name)]
        attrs = dict(product.attrs)
        inline = {n: product.variables[n].values for n in names if alike.is_inline(n)}
        chunked = [name for name in names if not alike.is_inline(name)]
        for name in chunked:
            _refuse_foreign_encoding(product.variables[name], name, facts)
    seal = file.read_bytes().find(facts.id.encode())
    if seal < 0:
        raise ProductError("does not hold its id as plain text", file=facts.path, field="id")
    return Source(facts, seal, attrs, inline, _chunk_locations(file, chunked))


def _refuse_foreign_encoding(variable: xr.Variable, name: str, facts: Facts) -> None:
    encoding = variable.encoding
    if any(bool(encoding.get(key)) != value for key, value in _PLAIN_ENCODING.items()):
        raise ProductError(
            "is not stored as lidarops stores it (shuffle and deflate)",
            file=facts.path,
            field=name,
            remedy="process the scene again, or open the files with lidarops.open_products",
        )


def _chunk_locations(file: Path, names: Iterable[str]) -> dict[str, ChunkLocations]:
    locations = {}
    with reading(file), h5py.File(file, "r") as stored:
        for name in names:
            locations[name] = ChunkLocations(
                stored[name].chunks, dict(_places(file, name, stored[name]))
            )
    return locations


def _places(
    file: Path, name: str, dataset: Any
) -> Iterator[tuple[tuple[int, ...], tuple[int, int]]]:
    for number in range(dataset.id.get_num_chunks()):
        info = dataset.id.get_chunk_info(number)
        index = tuple(
            start // step for start, step in zip(info.chunk_offset, dataset.chunks, strict=True)
        )
        if info.filter_mask:
            # HDF5 may skip a filter for single chunks; Zarr does not support this.
            raise ProductError("has a chunk that is not deflated", file=file, field=name)
        yield index, (info.byte_offset, info.size)


def group_parts(sources: Iterable[Source], alike: Template) -> list[Part]:
    """Group products into as few parts as their chunks allow, in their order."""
    open_parts: dict[tuple[Any, ...], Part] = {}
    all_parts = []
    for product in sources:
        chunks = {
            name: stored.chunk for name, stored in product.chunks.items() if alike.along_time(name)
        }
        key = tuple(sorted(chunks.items()))
        part = open_parts.get(key)
        if part is None or part.full:
            part = open_parts[key] = Part(chunks)
            all_parts.append(part)
        part.add(product)
    return all_parts


def references(part: Part, alike: Template, mode: DetectionMode, shared: Mapping[str, Any]) -> Refs:
    """Return a part as Zarr metadata, small values and chunk locations.

    Parameters
    ----------
    part : Part
    alike : Template
    mode : DetectionMode
    shared : mapping
        Global attributes.

    Returns
    -------
    dict of str to str or list
        Key in the Zarr group -> content, or file, offset and size.
    """
    refs: Refs = {
        ".zgroup": _json({"zarr_format": 2}),
        ".zattrs": _json({key: plain(value) for key, value in shared.items()}),
    }
    for name, variable in alike.variables.items():
        if alike.is_static(name):
            refs |= _inlined(name, variable.values, variable.dims, variable.attrs)
        elif alike.is_inline(name):
            refs |= _small(name, part, alike)
        else:
            refs |= _referred(name, part, alike)
    ids = np.array([source.facts.id for source in part.sources], "S")
    counts = [source.facts.profiles for source in part.sources]
    index = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    for row, values in ((PRODUCT, ids), (PRODUCT_INDEX, index)):
        attrs = attributes(row, mode=mode)
        attrs.pop("_Encoding", None)
        refs |= _inlined(row.name, values, row.dims, attrs)
    return refs


def _small(name: str, part: Part, alike: Template) -> Refs:
    variable = alike.variables[name]
    values = [source.inline[name] for source in part.sources]
    if alike.along_time(name):
        return _inlined(name, np.concatenate(values), variable.dims, variable.attrs)
    return _inlined(name, np.stack(values), ("product", *variable.dims), variable.attrs)


def _referred(name: str, part: Part, alike: Template) -> Refs:
    variable = alike.variables[name]
    along_time = alike.along_time(name)
    chunk = part.sources[0].chunks[name].chunk
    refs: Refs = {}
    profiles = first = 0
    for number, source in enumerate(part.sources):
        address = f"{{{{{TEMPLATE}}}}}/{source.facts.path}"
        for index, location in source.chunks[name].bytes.items():
            key = (first + index[0], *index[1:]) if along_time else (number, *index)
            refs[f"{name}/{'.'.join(map(str, key))}"] = [address, *location]
        profiles += source.facts.profiles
        first += -(-source.facts.profiles // chunk[0])
    rest = variable.shape[1:] if along_time else variable.shape
    dims = variable.dims if along_time else ("product", *variable.dims)
    shape = (profiles if along_time else len(part.sources), *rest)
    filters = [
        {"id": "shuffle", "elementsize": variable.dtype.itemsize},
        {"id": "zlib", "level": _LEVEL},
    ]
    return refs | _described(
        name, variable.dtype, shape, chunk if along_time else (1, *chunk), dims, variable.attrs,
        filters,
    )  # fmt: skip


def _inlined(
    name: str, values: NDArray[Any], dims: tuple[Any, ...], attrs: Mapping[Any, Any]
) -> Refs:
    """Return values as one chunk that is stored with the references."""
    stored = np.ascontiguousarray(values).reshape(values.shape)
    packed = base64.b64encode(zlib.compress(stored.tobytes(), _LEVEL)).decode()
    key = ".".join("0" for _ in stored.shape) or "0"
    filters = [{"id": "zlib", "level": _LEVEL}]
    return {f"{name}/{key}": f"base64:{packed}"} | _described(
        name, stored.dtype, stored.shape, stored.shape, dims, attrs, filters
    )


def _described(
    name: str,
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
    chunk: tuple[int, ...],
    dims: tuple[Any, ...],
    attrs: Mapping[Any, Any],
    filters: list[dict[str, Any]],
) -> Refs:
    plain_attrs = {str(key): plain(value) for key, value in attrs.items() if key != "_FillValue"}
    fill = plain(attrs.get("_FillValue"))
    array = {
        "zarr_format": 2,
        "shape": shape,
        "chunks": chunk,
        "dtype": dtype.str,
        "fill_value": fill,
        "order": "C",
        "filters": filters,
        "compressor": None,
        "dimension_separator": ".",
    }
    return {
        f"{name}/.zarray": _json(array),
        f"{name}/.zattrs": _json({"_ARRAY_DIMENSIONS": dims, **plain_attrs}),
    }


def _json(value: Any) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", ":"))
