"""Where the chunks of products lie in their files, as kerchunk references to one Zarr hierarchy.

Format: version 1 of the kerchunk specification over Zarr version 2, which h5py's filters shuffle
and deflate map to one by one. Products whose chunks do not fit one regular grid along time become
several Zarr groups, called parts, because Zarr version 2 has regular chunks only.
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

from lidarops.aggregate.facts import UNSHARED, Facts, coordinate_names, opened, plain, within
from lidarops.aggregate.means_variables import PRODUCT, PRODUCT_INDEX
from lidarops.errors import ProductError
from lidarops.netcdf.variables import attributes
from lidarops.records import DetectionMode, ProductKind

Refs = dict[str, Any]

TEMPLATE: Final = "u"
_LEVEL: Final = 6
_PLAIN_ENCODING: Final = {"zlib": True, "shuffle": True, "fletcher32": False}


@dataclass(frozen=True, slots=True)
class Lying:
    """The chunks of one variable of one product, in its file."""

    chunk: tuple[int, ...]
    places: Mapping[tuple[int, ...], tuple[int, int]]
    """Number of the chunk along each axis -> offset and size in bytes."""


@dataclass(frozen=True, slots=True)
class Source:
    """One product, as references need it."""

    facts: Facts
    seal: int
    """Offset of the product's id in its file: what stands there tells whether it is still it."""
    attributes: Mapping[str, Any]
    """Global attributes."""
    inline: Mapping[str, NDArray[Any]]
    """Small variables along time, scalars of the product."""
    lying: Mapping[str, Lying]


@dataclass(slots=True)
class Part:
    """Products whose chunks make one regular grid along time."""

    chunks: Mapping[str, tuple[int, ...]]
    sources: list[Source] = field(default_factory=list)
    full: bool = False
    """Whether the last chunk along time is not filled, so that nothing can follow it."""

    def add(self, source: Source) -> None:
        """Put a product at the end."""
        self.sources.append(source)
        profiles = source.facts.profiles
        self.full = any(profiles % chunk[0] for chunk in self.chunks.values())


@dataclass(frozen=True, slots=True)
class Template:
    """What all products of a group have alike, from the first of them."""

    kind: ProductKind
    variables: Mapping[str, xr.Variable]
    """With the values of the coordinates that do not change with time, without other values."""

    def along_time(self, name: str) -> bool:
        """Say whether a variable changes with time."""
        return "time" in self.variables[name].dims

    def is_static(self, name: str) -> bool:
        """Say whether a variable is a coordinate that all products have alike."""
        return not self.along_time(name) and name in coordinate_names(self.kind)

    def is_inline(self, name: str) -> bool:
        """Say whether the values of a variable stand among the references."""
        dims = set(self.variables[name].dims) - {"time", "nv"}
        return not dims


def template(root: Path, first: Facts) -> Template:
    """Read what all products of a group have alike."""
    with opened(within(root, first.path)) as product:
        names = [str(name) for name in product.variables if name not in UNSHARED]
        found = Template(first.kind, {name: product.variables[name] for name in names})
        for name in names:
            if found.is_static(name):
                found.variables[name].load()
    return found


def source(root: Path, facts: Facts, alike: Template) -> Source:
    """Find where the chunks of a product lie.

    Raises
    ------
    ProductError
        If the product changed since its facts were read, or is stored otherwise than lidarops
        writes it.
    """
    file = within(root, facts.path)
    with opened(file) as product:
        if product.attrs["id"] != facts.id:
            raise ProductError("changed while it was read", file=facts.path, remedy="run again")
        names = [name for name in alike.variables if not alike.is_static(name)]
        found = dict(product.attrs)
        inline = {n: product.variables[n].values for n in names if alike.is_inline(n)}
        lying = [name for name in names if not alike.is_inline(name)]
        for name in lying:
            _refuse_foreign_encoding(product.variables[name], name, facts)
    seal = file.read_bytes().find(facts.id.encode())
    if seal < 0:
        raise ProductError("does not hold its id as plain text", file=facts.path, field="id")
    return Source(facts, seal, found, inline, _lying(file, lying))


def _refuse_foreign_encoding(variable: xr.Variable, name: str, facts: Facts) -> None:
    encoding = variable.encoding
    if any(bool(encoding.get(key)) != value for key, value in _PLAIN_ENCODING.items()):
        raise ProductError(
            "is not stored as lidarops stores it: shuffled and deflated",
            file=facts.path,
            field=name,
            remedy="process the scene again, or open the files with lidarops.open_products",
        )


def _lying(file: Path, names: Iterable[str]) -> dict[str, Lying]:
    found = {}
    try:
        with h5py.File(file, "r") as stored:
            for name in names:
                found[name] = Lying(stored[name].chunks, dict(_places(file, name, stored[name])))
    except (OSError, KeyError, RuntimeError) as error:
        raise ProductError(f"cannot be read: {error}", file=file) from error
    return found


def _places(
    file: Path, name: str, dataset: Any
) -> Iterator[tuple[tuple[int, ...], tuple[int, int]]]:
    for number in range(dataset.id.get_num_chunks()):
        info = dataset.id.get_chunk_info(number)
        at = tuple(at // step for at, step in zip(info.chunk_offset, dataset.chunks, strict=True))
        if info.filter_mask:
            # HDF5 may leave out a filter for one chunk; Zarr knows no such chunk.
            raise ProductError("has a chunk that is not deflated", file=file, field=name)
        yield at, (info.byte_offset, info.size)


def parts(sources: Iterable[Source], alike: Template) -> list[Part]:
    """Put products into as few parts as their chunks allow, in their order."""
    open_parts: dict[tuple[Any, ...], Part] = {}
    found = []
    for each in sources:
        chunks = {name: lying.chunk for name, lying in each.lying.items() if alike.along_time(name)}
        key = tuple(sorted(chunks.items()))
        part = open_parts.get(key)
        if part is None or part.full:
            part = open_parts[key] = Part(chunks)
            found.append(part)
        part.add(each)
    return found


def references(part: Part, alike: Template, mode: DetectionMode, shared: Mapping[str, Any]) -> Refs:
    """Write a part as Zarr metadata, small values, and places in files.

    Parameters
    ----------
    part : Part
    alike : Template
    mode : DetectionMode
    shared : mapping
        Attributes of the whole.

    Returns
    -------
    dict of str to str or list
        Key in the Zarr group -> content, or address, offset and size.
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
    ids = np.array([each.facts.id for each in part.sources], "S")
    counts = [each.facts.profiles for each in part.sources]
    index = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    for row, values in ((PRODUCT, ids), (PRODUCT_INDEX, index)):
        refs |= _inlined(row.name, values, row.dims, _without_encoding(attributes(row, mode=mode)))
    return refs


def _without_encoding(found: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in found.items() if key != "_Encoding"}


def _small(name: str, part: Part, alike: Template) -> Refs:
    variable = alike.variables[name]
    values = [each.inline[name] for each in part.sources]
    if alike.along_time(name):
        return _inlined(name, np.concatenate(values), variable.dims, variable.attrs)
    return _inlined(name, np.stack(values), ("product", *variable.dims), variable.attrs)


def _referred(name: str, part: Part, alike: Template) -> Refs:
    variable = alike.variables[name]
    along_time = alike.along_time(name)
    chunk = part.sources[0].lying[name].chunk
    refs: Refs = {}
    profiles = first = 0
    for number, each in enumerate(part.sources):
        address = f"{{{{{TEMPLATE}}}}}/{each.facts.path}"
        for at, lies in each.lying[name].places.items():
            place = (first + at[0], *at[1:]) if along_time else (number, *at)
            refs[f"{name}/{'.'.join(map(str, place))}"] = [address, *lies]
        profiles += each.facts.profiles
        first += -(-each.facts.profiles // chunk[0])
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
    """Write values as one chunk that stands among the references."""
    stored = np.ascontiguousarray(values).reshape(values.shape)
    packed = _as_text(zlib.compress(stored.tobytes(), _LEVEL))
    key = ".".join("0" for _ in stored.shape) or "0"
    filters = [{"id": "zlib", "level": _LEVEL}]
    return {f"{name}/{key}": packed} | _described(
        name, stored.dtype, stored.shape, stored.shape, dims, attrs, filters
    )


def _as_text(content: bytes) -> str:
    return f"base64:{base64.b64encode(content).decode()}"


def _described(
    name: str,
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
    chunk: tuple[int, ...],
    dims: tuple[Any, ...],
    attrs: Mapping[Any, Any],
    filters: list[dict[str, Any]],
) -> Refs:
    told = {str(key): plain(value) for key, value in attrs.items() if key != "_FillValue"}
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
        f"{name}/.zattrs": _json({"_ARRAY_DIMENSIONS": dims, **told}),
    }


def _json(value: Any) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", ":"))
