"""Write docs/api.md, the public Python API, from the docstrings: ``python docs/api_page.py``."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Final

PAGE: Final = Path(__file__).with_name("api.md")

MODULES: Final = (
    "lidarops",
    "lidarops.aggregate.virtual_dataset",
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
    "lidarops.retrieve.elastic",
    "lidarops.retrieve.elastic.labeled",
    "lidarops.retrieve.raman.retrieval",
    "lidarops.retrieve.raman.cells",
    "lidarops.retrieve.raman.scattering",
    "lidarops.retrieve.raman.extinction",
    "lidarops.retrieve.raman.backscatter",
    "lidarops.retrieve.multiangle",
    "lidarops.retrieve.multiangle.labeled",
    "lidarops.retrieve.network.extinction_field",
    "lidarops.retrieve.network.geometry",
    "lidarops.retrieve.network.labeled",
    "lidarops.simulate.campaign",
    "lidarops.simulate.signal",
    "lidarops.simulate.pulse",
    "lidarops.simulate.overlap",
    "lidarops.simulate.mie",
    "lidarops.simulate.counting",
    "lidarops.simulate.analog",
    "lidarops.simulate.lidar",
)
"""Modules whose public functions and classes users may call."""

HEAD: Final = """# Python API

Functions and classes for use in scripts and notebooks. `help(NAME)` shows shapes, units, formulas,
sources and the errors raised. Everything else is internal and may change without notice.
"""


def page() -> str:
    """Return the text of the page."""
    return HEAD + "".join(_section(import_module(name)) for name in MODULES)


def public_names(module: ModuleType) -> Iterator[tuple[str, object]]:
    """Give the public functions and classes of a module: ``__all__``, or those it defines."""
    names = getattr(module, "__all__", None)
    for name in sorted(names if names is not None else vars(module)):
        value = getattr(module, name)
        own = names is not None or getattr(value, "__module__", "") == module.__name__
        documented = inspect.isclass(value) or inspect.isroutine(value)
        if own and not name.startswith("_") and documented:
            yield name, value


def _section(module: ModuleType) -> str:
    lines = [f"\n## `{module.__name__}`\n", _first_line(module), ""]
    lines += ["| name | what it does or is |", "| --- | --- |"]
    for name, value in public_names(module):
        lines.append(f"| `{name}` | {_first_line(value)} |")
    return "\n".join(lines) + "\n"


def _first_line(documented: object) -> str:
    text = inspect.getdoc(documented) or ""
    return text.split("\n\n")[0].replace("\n", " ").replace("|", "/")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
