"""Digest of modules with all that they import, found without running them."""

from __future__ import annotations

import ast
import hashlib
import json
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from lidarops.errors import LidarOpsError
from lidarops.system.files import write_atomically

_NO_DATA: Final = (".py", ".pyc", ".pyi", ".nbc", ".nbi", "~")
"""Endings of files beside modules that are no data of them."""
_MOST_KEPT: Final = 5000
"""Sources whose facts one file of the cache holds."""
_WITHOUT_MEANING: Final = frozenset({"ctx", "kind", "type_comment", "type_ignores"})
"""Fields of syntax nodes that follow from others or change nothing."""


class SourceFacts(NamedTuple):
    """What one source says."""

    digest: str
    """Equal for sources that differ in comments, docstrings, layout or line endings."""
    imports: tuple[str, ...]
    """Modules that it may import, also within functions, but not for type checking. ``from a
    import b`` gives ``a`` and ``a.b``, because ``b`` may be a module; a relative import begins with
    its dots."""


def source_facts(source: bytes) -> SourceFacts:
    """Return the digest of a source by its syntax tree, and its imports.

    Raises
    ------
    SyntaxError, ValueError, RecursionError
        If it is not Python, or an expression is nested too deeply.
    """
    imports: set[str] = set()
    content = _content(ast.parse(source), imports)
    return SourceFacts(hashlib.sha256(content.encode()).hexdigest(), tuple(sorted(imports)))


def _content(value: Any, imports: set[str]) -> str:
    """Return a syntax tree as text, and add its imports.

    `ast.dump` and `repr` write other text in other versions of Python.
    """
    if isinstance(value, list):
        items = [_content(item, imports) for item in _effective(value)]
        return f"[{','.join(items)}]" if items else ""
    if not isinstance(value, ast.AST):
        return ascii(value)
    imports.update(_imports(value))
    fields = (
        (name, getattr(value, name, None)) for name in value._fields if name not in _WITHOUT_MEANING
    )
    texts = [
        f"{name}={text}"
        for name, field in fields
        if field is not None and (text := _content(field, imports))
    ]
    return f"{type(value).__name__}({','.join(texts)})"


def _effective(items: Iterable[Any]) -> Iterator[Any]:
    """Yield the items of a list without those that change nothing."""
    for item in items:
        if isinstance(item, ast.If) and "TYPE_CHECKING" in (
            getattr(item.test, "id", ""),
            getattr(item.test, "attr", ""),
        ):
            yield from _effective(item.orelse)
        elif not isinstance(item, ast.Pass) and not (
            isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant)
        ):
            yield item


def _imports(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        module = "." * node.level + (node.module or "")
        yield module
        dot = "" if module.endswith(".") else "."
        yield from (f"{module}{dot}{alias.name}" for alias in node.names)


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
        contents = [f"{name}={self._of(path).digest}" for name, path in closure.items()]
        contents += [
            f"{name}:{data.relative_to(path.parent).as_posix()}={_data_digest(data)}"
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
        self._kept.save()
        return files

    def _imported(self, module: str, path: Path) -> tuple[str, ...]:
        """Return the modules that the import of a module runs, but for indirect ones."""
        if module not in self._imports:
            package = module if path.name == "__init__.py" else module.rpartition(".")[0]
            names = (
                name
                for target in self._of(path).imports
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

    def _of(self, path: Path) -> SourceFacts:
        if path not in self._facts:
            try:
                self._facts[path] = self._kept.of(path.read_bytes())
            except (OSError, SyntaxError, ValueError, RecursionError) as error:
                raise LidarOpsError(
                    f"is not a source that Python can read: {error}",
                    file=path,
                    remedy="mend it, or install its package again",
                ) from error
        return self._facts[path]

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


def _data_digest(path: Path) -> str:
    # Line endings depend on the checkout.
    return hashlib.sha256(path.read_bytes().replace(b"\r\n", b"\n")).hexdigest()


class _KeptFacts:
    """Facts about sources by their content, kept in a file because parsing takes long."""

    def __init__(self, folder: Path | None) -> None:
        # Facts are valid for the code that found them and for the grammar of this Python.
        code = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()[:16]
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
