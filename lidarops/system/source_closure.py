"""Digest of modules with all that they import, found without running them."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from lidarops.errors import LidarOpsError

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


def imported_modules(source: str) -> tuple[str, ...]:
    """Return the modules that a source may import, also within functions, but not for types.

    ``from a import b`` gives ``a`` and ``a.b``, because ``b`` may be a module; a relative import
    begins with its dots. A text that reads like an import counts as one.
    """
    statements = _FOR_TYPES.sub("", _NO_STATEMENT.sub(" ", source))
    found: set[str] = set()
    for module, names, modules in _IMPORT.findall(statements):
        dot = "" if module.endswith(".") else "."
        found |= {module} if module else set()
        found |= {f"{module}{dot}{name}" for name in _listed(names)}
        found |= set(_listed(modules))
    return tuple(sorted(found))


def _listed(names: str) -> list[str]:
    """Return the names in ``a as b, c``, with or without parentheses."""
    return [words[0] for part in names.strip("() \t\n").split(",") if (words := part.split())]


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
    """

    def __init__(
        self,
        roots: Mapping[str, Sequence[Path]],
        *,
        apart: Collection[str] = (),
        with_data: Collection[str] = (),
    ) -> None:
        self._roots = roots
        self._apart = apart
        self._with_data = with_data
        self._texts: dict[Path, str] = {}
        self._paths: dict[str, Path | None] = {}
        self._imports: dict[str, tuple[str, ...]] = {}

    def has(self, module: str) -> bool:
        """Whether a module exists."""
        return self._path(module) is not None

    def digest(self, starts: Iterable[str]) -> str:
        """Return a digest of some modules and of all that they import.

        Returns
        -------
        str
            16 hexadecimal digits, which do not depend on where the sources are installed.

        Raises
        ------
        LidarOpsError
            If a source is missing or cannot be read.
        """
        closure = self.closure(starts)
        contents = [f"{name}={_digest(self._text(path))}" for name, path in closure.items()]
        contents += [
            f"{name}:{data.relative_to(path.parent).as_posix()}={_digest(_read(data))}"
            for name, path in closure.items()
            if path.name == "__init__.py" and _within(name, self._with_data)
            for data in _data(path.parent)
        ]
        return hashlib.sha256("\n".join(sorted(contents)).encode()).hexdigest()[:16]

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
            if not self.has(start):
                raise LidarOpsError(
                    f"the source of {start} is missing",
                    remedy="install its package with its sources",
                )
            waiting += self._run_by(start)
        while waiting:
            name = waiting.pop()
            path = self._path(name)
            if path is not None and name not in files:
                files[name] = path
                waiting += self._imported(name, path)
        return files

    def _imported(self, module: str, path: Path) -> tuple[str, ...]:
        """Return the modules that the import of a module runs, but for indirect ones."""
        if module not in self._imports:
            package = module if path.name == "__init__.py" else module.rpartition(".")[0]
            names = (
                name
                for target in imported_modules(self._text(path))
                for name in self._run_by(_absolute(target, package))
            )
            self._imports[module] = tuple(dict.fromkeys(names))
        return self._imports[module]

    def _run_by(self, target: str) -> Iterator[str]:
        """Yield the packages around a target of an import and, unless it is a function, itself."""
        if _within(target, self._roots) and not _within(target, self._apart):
            parts = target.split(".")
            names = (".".join(parts[:count]) for count in range(1, len(parts) + 1))
            yield from (name for name in names if self.has(name))

    def _text(self, path: Path) -> str:
        if path not in self._texts:
            try:
                self._texts[path] = _read(path)
            except OSError as error:
                raise LidarOpsError(
                    f"cannot be read: {error.strerror}",
                    file=path,
                    remedy="mend it, or install its package again",
                ) from error
        return self._texts[path]

    def _path(self, module: str) -> Path | None:
        if module not in self._paths:
            root, *names = module.split(".")
            paths = (
                path
                for folder in self._roots.get(root, ())
                for place in [folder.joinpath(*names)]
                for path in (place / "__init__.py", place.with_suffix(".py"))
                if path.is_file()
            )
            self._paths[module] = next(paths, None)
        return self._paths[module]


def _within(name: str, packages: Collection[str]) -> bool:
    """Return whether a module is one of some packages or modules, or lies in one."""
    return name in packages or any(name.startswith(f"{package}.") for package in packages)


def _absolute(target: str, package: str) -> str:
    """Return the full name of an imported module, whose leading dots stand for a package."""
    name = target.lstrip(".")
    if name == target:
        return name
    around = package.split(".")
    return ".".join([*around[: len(around) - (len(target) - len(name)) + 1], *name.split()])


def _data(folder: Path) -> Iterator[Path]:
    """Yield the files of a package that are no modules, but not those of its subpackages."""
    for path in folder.iterdir():
        if path.name.startswith((".", "__pycache__")) or path.name.endswith(_NO_DATA):
            continue
        if not path.is_dir():
            yield path
        elif not (path / "__init__.py").exists():
            yield from _data(path)


def _read(path: Path) -> str:
    """Return the bytes of a file as text; line ends depend on the checkout."""
    return path.read_bytes().decode("latin-1").replace("\r\n", "\n")


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("latin-1")).hexdigest()
