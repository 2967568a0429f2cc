"""The pages of the Python API, from the docstrings: in full what users call, and all the rest."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Final

from tables import first_paragraph, table

REPOSITORY: Final = Path(__file__).resolve().parents[2]

MODULES: Final = (
    "lidarops",
    "lidarops.campaign.model",
    "lidarops.raw.licel",
    "lidarops.retrieve.air.molecular",
    "lidarops.retrieve.air.visibility",
    "lidarops.retrieve.background",
    "lidarops.retrieve.signal",
    "lidarops.retrieve.signal.labeled",
    "lidarops.retrieve.signal.labeled_gluing",
    "lidarops.retrieve.signal.labeled_averaging",
    "lidarops.retrieve.homogeneous",
    "lidarops.retrieve.homogeneous.labeled",
    "lidarops.retrieve.clouds",
    "lidarops.retrieve.elastic",
    "lidarops.retrieve.elastic.labeled",
    "lidarops.retrieve.raman.retrieval",
    "lidarops.retrieve.raman.settings",
    "lidarops.retrieve.raman.signals",
    "lidarops.retrieve.raman.scattering",
    "lidarops.retrieve.raman.depth_fit",
    "lidarops.retrieve.raman.backscatter",
    "lidarops.retrieve.multiangle",
    "lidarops.retrieve.multiangle.labeled",
    "lidarops.retrieve.network.extinction_field",
    "lidarops.retrieve.network.triangles",
    "lidarops.retrieve.network.geometry",
    "lidarops.retrieve.network.labeled",
    "lidarops.simulate.atmosphere",
    "lidarops.simulate.campaign",
    "lidarops.simulate.signal",
    "lidarops.simulate.pulse",
    "lidarops.simulate.counting",
    "lidarops.simulate.analog",
)
"""Modules whose public functions and classes users may call."""


def write_pages(folder: Path) -> None:
    """Write a page for each module that users may call; leave alone those that are as before."""
    folder.mkdir(exist_ok=True)
    texts = {f"{name}.md": _module_page(import_module(name)) for name in MODULES}
    for path in folder.iterdir():
        if path.name not in texts:
            path.unlink()
    for name, text in texts.items():
        path = folder / name
        if not path.exists() or path.read_text("utf-8") != text:
            path.write_text(text, "utf-8")


def _module_page(module: ModuleType) -> str:
    lines = [f"# {module.__name__}", "", "```{eval-rst}", f".. automodule:: {module.__name__}"]
    for name, value in public_names(module):
        directive = "autoclass" if inspect.isclass(value) else "autofunction"
        lines += ["", f".. {directive}:: {module.__name__}.{name}"]
        lines += ["   :members:"] if inspect.isclass(value) else []
    return "\n".join([*lines, "```", ""])


def public_names(module: ModuleType) -> Iterator[tuple[str, object]]:
    """Give the public functions and classes of a module: ``__all__``, or those it defines."""
    names = getattr(module, "__all__", None)
    for name in sorted(names if names is not None else vars(module)):
        value = getattr(module, name)
        own = names is not None or getattr(value, "__module__", "") == module.__name__
        documented = inspect.isclass(value) or inspect.isroutine(value)
        if own and not name.startswith("_") and documented:
            yield name, value


def offered() -> str:
    """Return the table of the modules that users may call."""
    rows = [
        (f"[{name}](made/{name}.md)", first_paragraph(import_module(name).__doc__))
        for name in MODULES
    ]
    return "\n".join(table(("module", "what it holds"), rows))


@cache
def every_function() -> str:
    """Return a section for each package, and within it the public functions of each module."""
    lines: list[str] = []
    package = ""
    for path in _sources():
        module = ".".join(path.relative_to(REPOSITORY).with_suffix("").parts)
        module = module.removesuffix(".__init__")
        tree = ast.parse(path.read_text(encoding="utf-8"))
        rows = [
            (f"`{node.name}`", first_paragraph(ast.get_docstring(node)))
            for node in tree.body
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_")
        ]
        if not rows:
            continue
        if _package(path) != package:
            package = _package(path)
            lines += [f"## `{package}`", ""]
        lines += [f"### `{module}`", "", first_paragraph(ast.get_docstring(tree))]
        lines += table(("name", "what it does or is"), rows)
    return "\n".join(lines)


def _sources() -> list[Path]:
    """Return the modules without underscore, and those of packages after the modules above."""
    paths = [path for root in ("lidarops", "flows") for path in (REPOSITORY / root).rglob("*.py")]
    public = [path for path in paths if path.stem == "__init__" or not path.stem.startswith("_")]
    return sorted(public, key=lambda path: (_package(path), path))


def _package(path: Path) -> str:
    """Return the package of a module, which is a retrieval within `lidarops.retrieve`."""
    parts = path.relative_to(REPOSITORY).parent.parts
    return ".".join(parts[: 3 if "retrieve" in parts else 2])
