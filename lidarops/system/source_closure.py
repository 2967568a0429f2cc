"""Digest of modules with all that they import, found without running them."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from lidarops.errors import LidarOpsError
from lidarops.system import syntax_trees
from lidarops.system.files import write_atomically
from lidarops.system.syntax_trees import SourceFacts, source_facts

_NO_DATA: Final = (".py", ".pyc", ".pyi", ".nbc", ".nbi", "~")
"""Endings of files beside modules that are no data of them."""
_MOST_KEPT: Final = 5000
"""Sources whose facts one file of the cache holds."""


class Sources:
    """Modules of some packages.

    Parameters
    ----------
    roots : mapping of str to sequence of Path
        Folders of each top-level package, or the file of a top-level module. Modules of others do
        not count.
    apart : collection of str
        Modules and packages that do not count, whoever imports them.
    with_data : collection of str
        Packages whose other files, such as tables, count also, if one of their modules counts.
    cache : Path, optional
        Folder that keeps facts about sources by their content. Without it, or where it cannot be
        used, sources are parsed anew.
    """

    def __init__(
        self,
        roots: Mapping[str, Sequence[Path]],
        *,
        apart: Collection[str] = (),
        with_data: Collection[str] = (),
        cache: Path | None = None,
    ) -> None:
        self._roots = roots
        self._apart = apart
        self._with_data = with_data
        self._kept = _KeptFacts(cache)
        self._facts: dict[Path, SourceFacts] = {}
        self._paths: dict[str, Path | None] = {}
        self._imports: dict[str, tuple[str, ...]] = {}
        self._listings: dict[Path, dict[str, bool]] = {}

    def has(self, module: str) -> bool:
        """Whether a module exists."""
        return self._path(module) is not None

    def digest(self, starts: Iterable[str]) -> str:
        """Return a digest of some modules and of all that they import.

        Parameters
        ----------
        starts : iterable of str

        Returns
        -------
        str
            16 hexadecimal digits. Equal for sources with equal syntax trees, but for docstrings,
            wherever they are installed.

        Raises
        ------
        LidarOpsError
            If a source is missing or cannot be read.
        """
        closure = self.closure(starts)
        contents = [f"{name}={self._of(path).digest}" for name, path in closure.items()]
        contents += [
            f"{package}:{data.relative_to(folder).as_posix()}={_data_digest(data)}"
            for package, folder in _folders(closure)
            if _within(package, self._with_data)
            for data in self._data(folder)
        ]
        return hashlib.sha256("\n".join(sorted(contents)).encode()).hexdigest()[:16]

    def closure(self, starts: Iterable[str]) -> dict[str, Path]:
        """Return the files of some modules and of all modules that these import.

        A module runs the packages around it, so these count with their own imports.

        Parameters
        ----------
        starts : iterable of str

        Raises
        ------
        LidarOpsError
            If a source is missing or cannot be read.
        """
        waiting = list(starts)
        for start in waiting:
            if not self.has(start):
                raise LidarOpsError(
                    f"the source of {start} is missing",
                    remedy="install its package with its sources",
                )
        files: dict[str, Path] = {}
        waiting = [module for start in waiting for module in self._run_by(start)]
        while waiting:
            name = waiting.pop()
            path = self._path(name)
            if path is not None and name not in files:
                files[name] = path
                waiting += self._imported(name, path)
        self._kept.save()
        return files

    def _imported(self, module: str, path: Path) -> tuple[str, ...]:
        """Return the modules that the import of a module runs, but for indirect ones."""
        if module not in self._imports:
            targets = _absolute(self._of(path).imports, module, path)
            names = (name for target in targets for name in self._run_by(target))
            self._imports[module] = tuple(dict.fromkeys(names))
        return self._imports[module]

    def _run_by(self, target: str) -> Iterator[str]:
        """Yield the packages around a target of an import and, unless it is a function, itself."""
        if _within(target, self._roots) and not _within(target, self._apart):
            parts = target.split(".")
            names = (".".join(parts[:count]) for count in range(1, len(parts) + 1))
            yield from (name for name in names if self.has(name))

    def _of(self, path: Path) -> SourceFacts:
        if path not in self._facts:
            try:
                self._facts[path] = self._kept.of(path.read_bytes())
            except (OSError, SyntaxError, ValueError) as error:
                raise LidarOpsError(
                    f"is not a source that Python can read: {error}",
                    file=path,
                    remedy="mend it, or install its package again",
                ) from error
        return self._facts[path]

    def _path(self, module: str) -> Path | None:
        if module not in self._paths:
            root, *names = module.split(".")
            paths = (self._path_below(folder, names) for folder in self._roots.get(root, ()))
            self._paths[module] = next((path for path in paths if path is not None), None)
        return self._paths[module]

    def _path_below(self, folder: Path, names: Sequence[str]) -> Path | None:
        if folder.suffix == ".py":
            return None if names else folder
        for name in names[:-1]:
            if not self._listing(folder).get(name):
                return None
            folder /= name
        listing = self._listing(folder)
        if not names or listing.get(names[-1]):
            package = folder.joinpath(*names[-1:])
            if "__init__.py" in self._listing(package):
                return package / "__init__.py"
        if names and f"{names[-1]}.py" in listing:
            return folder / f"{names[-1]}.py"
        return None

    def _listing(self, folder: Path) -> Mapping[str, bool]:
        """Return the names in a folder, and whether each is a folder."""
        if folder not in self._listings:
            with os.scandir(folder) as entries:
                self._listings[folder] = {entry.name: entry.is_dir() for entry in entries}
        return self._listings[folder]

    def _data(self, folder: Path) -> Iterator[Path]:
        """Yield the files of a package that are no modules, but not those of its subpackages."""
        for name, is_folder in self._listing(folder).items():
            path = folder / name
            if name.startswith((".", "__pycache__")) or name.endswith(_NO_DATA):
                continue
            if not is_folder:
                yield path
            elif "__init__.py" not in self._listing(path):
                yield from self._data(path)


def _within(name: str, packages: Collection[str]) -> bool:
    """Return whether a module is one of some packages or modules, or lies in one."""
    return name in packages or any(name.startswith(f"{package}.") for package in packages)


def _folders(closure: Mapping[str, Path]) -> Iterator[tuple[str, Path]]:
    for name, path in closure.items():
        if path.name == "__init__.py":
            yield name, path.parent


def _absolute(imports: Iterable[str], module: str, path: Path) -> Iterator[str]:
    """Yield the full names of modules that a module imports."""
    package = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
    for name in imports:
        target = name.lstrip(".")
        level = len(name) - len(target)
        around = package[: len(package) - level + 1] if level else []
        yield ".".join([*around, *([target] if target else [])])


def _data_digest(path: Path) -> str:
    # Line endings depend on the checkout.
    return hashlib.sha256(path.read_bytes().replace(b"\r\n", b"\n")).hexdigest()


class _KeptFacts:
    """Facts about sources by their content, kept in a file because parsing takes long.

    Parameters
    ----------
    folder : Path, optional
        Without it, nothing is kept.
    """

    def __init__(self, folder: Path | None) -> None:
        # Facts are valid for the code that found them and for the grammar of this Python.
        code = hashlib.sha256(Path(syntax_trees.__file__).read_bytes()).hexdigest()[:16]
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        self._file = None if folder is None else folder / f"syntax-{version}-{code}.json"
        self._facts: dict[str, SourceFacts] = {}
        self._used: set[str] = set()
        self._new = False
        if self._file is not None:
            # Absent, or damaged: it is written anew.
            with suppress(OSError, ValueError, TypeError):
                self._facts = {
                    content: SourceFacts(digest, tuple(imports))
                    for content, digest, *imports in json.loads(self._file.read_bytes())
                }

    def of(self, source: bytes) -> SourceFacts:
        content = hashlib.sha256(source).hexdigest()
        self._used.add(content)
        if content not in self._facts:
            self._facts[content] = source_facts(source)
            self._new = True
        return self._facts[content]

    def save(self) -> None:
        if self._file is None or not self._new:
            return
        self._new = False
        names = self._used if len(self._facts) > _MOST_KEPT else self._facts
        rows = [[name, self._facts[name].digest, *self._facts[name].imports] for name in names]
        # Where the folder cannot be written, every process parses the sources.
        with suppress(OSError):
            self._file.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self._file, json.dumps(rows).encode())
