"""The shape of the house: layers without cycles, small folders, one name for one thing."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest

MOST_PACKAGES = 17
MOST_LEVELS = 10
MOST_MODULES = 21
MOST_TEST_MODULES = 25
DEFINITIONS = (ast.FunctionDef, ast.ClassDef)
EMPTY_NAMES = frozenset({"_shown", "_around", "_beside", "_of", "_ANY"})
"""Names that do not say what is returned or held."""


@pytest.fixture(scope="module")
def picture(repository: Path) -> ModuleType:
    """The module that draws the packages and their imports."""
    spec = spec_from_file_location("picture", repository / "docs/architecture_picture.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Source(NamedTuple):
    """What a source imports and defines."""

    imported: frozenset[str]
    public: tuple[str, ...]
    """Functions and classes without underscore."""
    defined: frozenset[str]
    """See `defined_names`."""
    docstring: str | None


@cache
def source(path: Path) -> Source:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    definitions = (node.name for node in tree.body if isinstance(node, DEFINITIONS))
    public = tuple(name for name in definitions if not name.startswith("_"))
    imported, defined = frozenset(imported_modules(tree)), frozenset(defined_names(tree))
    return Source(imported, public, defined, ast.get_docstring(tree))


def sources(repository: Path, *roots: str) -> Iterator[tuple[Path, Source]]:
    for path in paths(repository, *roots):
        yield path, source(path)


def paths(repository: Path, *roots: str) -> Iterator[Path]:
    for root in roots:
        yield from sorted((repository / root).rglob("*.py"))


def imported_modules(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def defined_names(tree: ast.AST) -> Iterator[str]:
    """Yield the names of functions, of classes, and of what modules and classes assign."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        if isinstance(node, ast.Module | ast.ClassDef):
            for statement in node.body:
                targets = getattr(statement, "targets", [getattr(statement, "target", None)])
                yield from (name.id for name in targets if isinstance(name, ast.Name))


def test_packages_form_few_levels_and_import_only_downwards(picture: ModuleType):
    graph, rows = picture.imports(), picture.levels()
    level = {name: number for number, row in enumerate(rows) for name in row}
    assert set(graph) == set(level)
    assert len(level) <= MOST_PACKAGES
    assert len(rows) <= MOST_LEVELS
    upwards = [(a, b) for a, used in graph.items() for b in used if level[b] <= level[a]]
    assert upwards == []


def test_every_module_stands_in_a_package(repository: Path, picture: ModuleType):
    modules = {path.stem for path in (repository / "lidarops").glob("*.py")}
    assert modules == {"__init__", "__main__"} | picture.VOCABULARY
    packages = {path.parent.name for path in (repository / "lidarops").glob("*/__init__.py")}
    assert packages | {"flows", "vocabulary"} == set(picture.PURPOSES)


def test_no_folder_is_crowded(repository: Path):
    modules: dict[Path, int] = defaultdict(int)
    for path in paths(repository, "lidarops", "flows", "benchmarks", "tests"):
        modules[path.parent] += 1
    tests = repository / "tests"
    crowded = {
        folder: count
        for folder, count in modules.items()
        if count > (MOST_TEST_MODULES if folder.is_relative_to(tests) else MOST_MODULES)
    }
    assert crowded == {}


def test_a_public_name_means_one_thing_in_its_layer(repository: Path, picture: ModuleType):
    """But that a labeled shell has the name of what it wraps, and each retrieval its thresholds."""
    level = {name: number for number, row in enumerate(picture.levels()) for name in row}
    places: dict[tuple[int, str], list[str]] = defaultdict(list)
    for path, module in sources(repository, "lidarops"):
        package = path.relative_to(repository / "lidarops").parts[0]
        if package not in level or path.stem.startswith("labeled"):
            continue
        for name in module.public:
            places[level[package], name].append(str(path.relative_to(repository)))
    several = {name: paths for (_, name), paths in places.items() if len(paths) > 1}
    assert {name: paths for name, paths in several.items() if name != "Thresholds"} == {}


def test_a_name_says_what_it_is(repository: Path):
    """Functions, methods, classes and constants; not what a function calls its values."""
    for path in paths(repository, "lidarops", "flows", "benchmarks"):
        assert not EMPTY_NAMES & source(path).defined, path


def test_no_test_imports_another_test_and_no_retrieval_test_a_benchmark(repository: Path):
    tests = {path.stem for path in (repository / "tests").rglob("test_*.py")}
    # By the text, which is faster: one module for each statement, as ruff holds it.
    for path in (repository / "tests").rglob("*.py"):
        names = re.findall(r"^ *(?:from|import) +([\w.]+)", path.read_text("utf-8"), re.MULTILINE)
        assert not {name for name in names if name.split(".")[0] in tests}, path
        if path.is_relative_to(repository / "tests/retrieve"):
            assert not {name for name in names if name.startswith("benchmarks")}, path


def test_private_modules_are_imported_within_their_package_only(repository: Path):
    """But by studies, which switch guards off."""
    for path, module in sources(repository, "lidarops", "flows", "benchmarks"):
        if path.parent.name == "studies":
            continue
        package = ".".join(path.relative_to(repository).parent.parts)
        for name in module.imported:
            private = re.match(r"(lidarops\..*)\._[a-z]\w*", name)
            if private:
                assert package.startswith(private[1]), f"{path} imports {name}"


def test_every_package_and_module_says_what_it_is_for(repository: Path):
    for path, module in sources(repository, "lidarops", "flows", "benchmarks"):
        assert module.docstring, path


def test_the_picture_shows_the_packages_as_they_are(repository: Path, picture: ModuleType):
    drawn = (repository / "docs/architecture.svg").read_text(encoding="utf-8")
    assert drawn == picture.draw(), "run: python docs/architecture_picture.py"
