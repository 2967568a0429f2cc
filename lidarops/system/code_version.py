"""Versions of code: of what makes a product, for every kind, and of what reads headers.

A version is a digest of modules with all that they import, which is found without running them.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec, resolve_name
from itertools import accumulate
from pathlib import Path
from typing import Final

from lidarops.errors import LidarOpsError
from lidarops.kinds import RAW_FORMATS, Kind, kinds

_EVERY_PRODUCT: Final = (
    "lidarops.scene.processing",
    "lidarops.netcdf.product_file",
    "lidarops.netcdf.write",
)
"""Modules that every product passes through."""
_CATALOGUES: Final = "lidarops.catalog.raw_files"
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
_NO_DATA: Final = (".py", ".pyc", ".pyi", ".nbc", ".nbi", "~")
"""Endings of files beside modules that are no data of them."""
_NO_STATEMENT: Final = re.compile(r"#[^\n]*|\\\n")
_FOR_TYPES: Final = re.compile(
    r"^([ \t]*)if (?:\w+\.)?TYPE_CHECKING:[^\n]*\n(?:\1[ \t]+[^\n]*\n|[ \t]*\n)*", re.MULTILINE
)
_IMPORT: Final = re.compile(
    r"(?:^|[;:])[ \t]*"
    r"(?:from[ \t]+([\w.]+)[ \t]+import[ \t]*(\([^)]*\)|[^\n;]+)|import[ \t]+([^\n;]+))",
    re.MULTILINE,
)


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
    return version_of(kinds()[kind], _installed(), *others)


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
    chosen = sorted(kinds() if names is None else names)
    text = "\n".join(f"{name}={code_version(name, *others)}" for name in chosen)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def version_of(kind: Kind, sources: Sources, *others: str) -> str:
    """Return the code version of a kind by some sources, as `code_version` does by the installed.

    Parameters
    ----------
    kind : Kind
    sources : Sources
        Of all packages that `source_roots` gives.
    *others : str
        Further modules that count.
    """
    modules = filter(sources.path, (f"{kind.package}.{name}" for name in _OF_KIND))
    return sources.digest((*_EVERY_PRODUCT, *_formats(), kind.package, *modules, *others))


def reading_version() -> str:
    """Return a digest of the sources that decide what the catalog holds of a raw file.

    Returns
    -------
    str
        16 hexadecimal digits.
    """
    return _installed().digest((_CATALOGUES, *_formats()))


def module_version(name: str) -> str:
    """Return a digest of the source of a module and of what it imports, 16 hexadecimal digits."""
    return _installed().digest((name,))


def pages_version(sources: Sources | None = None) -> str:
    """Return a digest of the sources that decide what the pages of products hold.

    Parameters
    ----------
    sources : Sources, optional
        By default the installed ones.

    Returns
    -------
    str
        16 hexadecimal digits.
    """
    sources = sources or _installed()
    packages = [kind.package for kind in kinds().values()]
    of_kinds = (f"{package}.{name}" for package in packages for name in _ON_PAGES)
    return sources.digest(filter(sources.path, (_PAGES, *packages, *of_kinds)))


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
    return Sources(source_roots())


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


def imported_modules(source: str) -> tuple[str, ...]:
    """Return the modules that a source may import, also within functions, but not for types.

    ``from a import b`` gives ``a`` and ``a.b``, because ``b`` may be a module; a relative import
    begins with its dots. A text that reads like an import counts as one.
    """
    statements = _FOR_TYPES.sub("", _NO_STATEMENT.sub(" ", source))
    found: set[str] = set()
    for module, names, modules in _IMPORT.findall(statements):
        # ``a as b, c``, with or without parentheses.
        parts = (names or modules).strip("() \t\n").split(",")
        listed = [words[0] for words in map(str.split, parts) if words]
        dot = "." if module.strip(".") else ""
        found |= {module, *(f"{module}{dot}{name}" for name in listed)} - {""}
    return tuple(sorted(found))


class Sources:
    """Modules of lidarops, and of packages with kinds of product or raw formats.

    Parameters
    ----------
    roots : mapping of str to sequence of Path
        Folders of each top-level package, or the file of a top-level module. Modules of others do
        not count.
    apart : collection of str, optional
        Modules and packages that do not count, whoever imports them.
    """

    def __init__(
        self,
        roots: Mapping[str, Sequence[Path]],
        *,
        apart: Collection[str] = _APART,
    ) -> None:
        self._roots = roots
        self.path = cache(self._find)
        """Module -> its file; None where there is no such module."""
        self._content = cache(_read)
        self._apart = frozenset(apart)
        self._imports = cache(self._imported)

    def digest(self, starts: Iterable[str]) -> str:
        """Return a digest of some modules, of all that they import, and of the data of packages.

        Returns
        -------
        str
            16 hexadecimal digits, which do not depend on where the sources are installed.

        Raises
        ------
        LidarOpsError
            If a source is missing or cannot be read.
        """
        files = self.closure(starts)
        for name, path in list(files.items()):
            if path.name == "__init__.py":
                data = ((file.relative_to(path.parent), file) for file in _data(path.parent))
                files |= {f"{name}:{place.as_posix()}": file for place, file in data}
        whole = "\n".join(
            sorted(f"{name}={self._content(path)[1]}" for name, path in files.items())
        )
        return hashlib.sha256(whole.encode()).hexdigest()[:16]

    def closure(self, starts: Iterable[str]) -> dict[str, Path]:
        """Return the files of some modules and of all modules that these import.

        A module runs the packages around it, so these count with their own imports.

        Raises
        ------
        LidarOpsError
            If a source is missing or cannot be read.
        """
        files: dict[str, Path] = {}
        waiting: list[str] = []
        for start in starts:
            if self.path(start) is None:
                raise LidarOpsError(
                    f"the source of {start} is missing",
                    remedy="install its package with its sources",
                )
            waiting += accumulate(start.split("."), "{}.{}".format)
        while waiting:
            name = waiting.pop()
            path = self.path(name)
            if path is not None and name not in files:
                files[name] = path
                waiting += self._imports(name, path)
        return files

    def _imported(self, module: str, path: Path) -> tuple[str, ...]:
        """Return the modules that the import of a module runs, but for indirect ones."""
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        names: dict[str, None] = {}
        for target in imported_modules(self._content(path)[0]):
            # A text that only reads like an import may have too many dots.
            with suppress(ImportError):
                # The packages around it and, unless it is a function, the target itself.
                parts = resolve_name(target, package).split(".")
                around = list(accumulate(parts, "{}.{}".format))
                if parts[0] in self._roots and self._apart.isdisjoint(around):
                    names |= dict.fromkeys(filter(self.path, around))
        return tuple(names)

    def _find(self, module: str) -> Path | None:
        root, *names = module.split(".")
        places = [folder.joinpath(*names) for folder in self._roots.get(root, ())]
        paths = ((place / "__init__.py", place.with_suffix(".py")) for place in places)
        return next((path for both in paths for path in both if path.is_file()), None)


def _data(folder: Path) -> Iterator[Path]:
    """Yield the files of a package that are no modules, but not those of its subpackages."""
    for path in folder.iterdir():
        if path.name.startswith((".", "__pycache__")) or path.name.endswith(_NO_DATA):
            continue
        if not path.is_dir():
            yield path
        elif not (path / "__init__.py").exists():
            yield from _data(path)


def _read(path: Path) -> tuple[str, str]:
    """Return a file as text, whose line ends depend on the checkout, and its digest."""
    try:
        content = path.read_bytes().replace(b"\r\n", b"\n")
    except OSError as error:
        raise LidarOpsError(
            f"cannot be read: {error.strerror}",
            file=path,
            remedy="mend it, or install its package again",
        ) from error
    return content.decode("latin-1"), hashlib.sha256(content).hexdigest()
