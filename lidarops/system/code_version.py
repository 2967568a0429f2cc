"""Versions of code: of what makes a product, for every kind, and of what reads headers."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from lidarops.kinds import Kind, kind_of, kinds
from lidarops.registry import RAW_FORMATS
from lidarops.system.source_closure import Sources

_EVERY_PRODUCT: Final = (
    "lidarops.scene.processing",
    "lidarops.netcdf.product_file",
    "lidarops.netcdf.write",
)
"""Modules that every product passes through."""
_CATALOGUES: Final = "lidarops.catalog.headers"
"""Module that makes an entry of the catalog from the header of a raw file."""
_OF_KIND: Final = ("settings", "retrieval", "variables")
"""Modules of a kind that make its products, as far as it has them."""
_PAGES: Final = "lidarops.site.build"
"""Module that makes the pages of products."""
_ON_PAGES: Final = ("figures", "variables")
"""Modules of a kind that decide what its pages hold, as far as it has them."""
_APART: Final = (
    # Fetches raw files, whose contents each product records.
    "lidarops.system",
    # Fields of the campaign file that no product depends on.
    "lidarops.campaign.simulation",
    # Words of errors.
    "lidarops.campaign.yaml_errors",
)
"""Modules and packages that the others import, and that cannot change a product."""
_WITH_DATA: Final = (
    "lidarops.figures",
    "lidarops.products",
    "lidarops.retrieve",
    "lidarops.site",
)
"""Packages of lidarops whose tables, templates and other data count."""


@cache
def code_version(kind: str, *others: str) -> str:
    """Return a digest of the sources that can change a product of a kind.

    These are the modules of the kind, those that every product passes through, those of all raw
    formats, and all that they import of lidarops and of the packages that add kinds or formats.
    Every change of their text counts, that of a comment too.

    Parameters
    ----------
    kind : str
    *others : str
        Further modules that count, with what they import.

    Returns
    -------
    str
        16 hexadecimal digits.

    Raises
    ------
    LidarOpsError
        If there is no such kind, or a source is missing or cannot be read.
    """
    return version_of(kind_of(kind), _installed(), *others)


def joint_code_version(names: Iterable[str] | None = None, *others: str) -> str:
    """Return a digest of the code versions of several kinds, by default of all.

    Parameters
    ----------
    names : iterable of str, optional
        In any order.
    *others : str
        Further modules that count, with what they import.

    Returns
    -------
    str
        16 hexadecimal digits.
    """
    chosen = kinds() if names is None else names
    versions = {name: code_version(name, *others) for name in chosen}
    text = "\n".join(f"{name}={versions[name]}" for name in sorted(versions))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def version_of(kind: Kind, sources: Sources, *others: str) -> str:
    """Return the code version of a kind by some sources, as `code_version` does by the installed.

    Parameters
    ----------
    kind : Kind
    sources : Sources
        From `sources_in`; of all packages that `source_roots` gives.
    *others : str
        Further modules that count.
    """
    own = (f"{kind.package}.{name}" for name in _OF_KIND)
    modules = (name for name in own if sources.has(name))
    return sources.digest((*_EVERY_PRODUCT, *_formats(), kind.package, *modules, *others))


def sources_in(roots: Mapping[str, Sequence[Path]]) -> Sources:
    """Return the sources of lidarops and of packages with kinds of product or raw formats.

    Parameters
    ----------
    roots : mapping of str to sequence of Path
        Folders of each top-level package.
    """
    with_data = (*_WITH_DATA, *(root for root in roots if root != "lidarops"))
    return Sources(roots, apart=_APART, with_data=with_data)


def reading_version() -> str:
    """Return a digest of the sources that decide what the catalog holds of a raw file.

    Returns
    -------
    str
        16 hexadecimal digits.
    """
    return _installed().digest((_CATALOGUES, *_formats()))


def pages_version(sources: Sources | None = None) -> str:
    """Return a digest of the sources that decide what the pages of products hold.

    Parameters
    ----------
    sources : Sources, optional
        From `sources_in`; by default the installed ones.

    Returns
    -------
    str
        16 hexadecimal digits.
    """
    sources = sources or _installed()
    packages = [kind.package for kind in kinds().values()]
    of_kinds = (f"{package}.{name}" for package in packages for name in _ON_PAGES)
    starts = (_PAGES, *packages, *of_kinds)
    return sources.digest(name for name in starts if sources.has(name))


@cache
def source_version() -> str:
    """Return a digest of all sources of lidarops and of packages with kinds or raw formats.

    Returns
    -------
    str
        16 hexadecimal digits; changes also with sources that can change no product.
    """
    digest = hashlib.sha256()
    for package, folders in source_roots().items():
        for folder in folders:
            for path in [folder] if folder.is_file() else sorted(folder.rglob("*.py")):
                content = path.read_bytes()
                name = path.relative_to(folder).as_posix()
                digest.update(f"{package}/{name}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()[:16]


@cache
def _installed() -> Sources:
    return sources_in(source_roots())


def source_roots() -> dict[str, tuple[Path, ...]]:
    """Return the folders of lidarops and of the packages with kinds of product or raw formats."""
    modules = ("lidarops", *(kind.package for kind in kinds().values()), *_formats())
    roots: dict[str, tuple[Path, ...]] = {}
    for package in sorted({module.partition(".")[0] for module in modules}):
        spec = find_spec(package)
        folders = spec.submodule_search_locations if spec else None
        # A module that is no package has an origin only.
        places = folders or ([spec.origin] if spec and spec.origin else [])
        roots[package] = tuple(Path(place) for place in places)
    return roots


@cache
def _formats() -> tuple[str, ...]:
    """Return the modules of raw formats. No import leads to them, and any file may need any."""
    return tuple(point.module for point in entry_points(group=RAW_FORMATS))
