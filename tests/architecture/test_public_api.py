"""No public name exists for tests alone."""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path

import python_api

import lidarops


def test_every_public_name_is_used_or_belongs_to_the_api(repository: Path):
    used: set[str] = set()
    defined: dict[str, Path] = {}
    for root in ("lidarops", "flows", "benchmarks", "examples", "docs"):
        for path in sorted((repository / root).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            for node in ast.walk(tree):
                if isinstance(node, ast.Name):
                    used.add(node.id)
                elif isinstance(node, ast.Attribute):
                    used.add(node.attr)
                elif isinstance(node, ast.alias) and path.name != "__init__.py":
                    used.add(node.name)
            if root == "lidarops" and path.parent.name != "cli":
                defined |= {
                    node.name: path.relative_to(repository)
                    for node in tree.body
                    if isinstance(node, ast.FunctionDef | ast.ClassDef)
                    and not node.name.startswith("_")
                }
    # Named in pyproject.toml, looked up by dask, run in a process of its own.
    entry_points = {"LicelBackendEntrypoint", "dask_setup", "first_times"}
    offered = {
        name
        for module in map(import_module, python_api.MODULES)
        for name, _ in python_api.public_names(module)
    }
    unused = {name: str(path) for name, path in defined.items() if name not in used}
    assert {name: path for name, path in unused.items() if name not in offered | entry_points} == {}


def test_public_functions_are_listed():
    assert dir(lidarops) == sorted(lidarops.__all__)
    assert all(getattr(lidarops, name) is not None for name in dir(lidarops))
