"""What is called of lidarops in one run: ``python -m support.trace CAMPAIGN...``.

Makes the stale products of each campaign, and prints as a line of JSON how many modules of lidarops
were entered, how many functions called, and how often a function called one of another package.
Code that numba has compiled is not seen. Each run is a process of its own: what an earlier one
cached is not called again. Prefect is absent, as where only the command line is installed.
"""

from __future__ import annotations

import importlib
import importlib.abc
import json
import os
import pkgutil
import sys
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import lidarops
from lidarops.campaign.model import load_campaign
from lidarops.run.archive import reprocess

ROOT = Path(lidarops.__file__).parent


class Absent(importlib.abc.MetaPathFinder):
    """Finder of modules by which Prefect is not installed."""

    def find_spec(self, name: str, *_: Any) -> None:
        """Refuse Prefect."""
        if name.partition(".")[0] == "prefect":
            raise ModuleNotFoundError(name)

    def find_distributions(self, _: object) -> tuple[()]:
        """Name no package."""
        return ()


class Trace:
    """Counts calls, as a profile function of `sys.setprofile`."""

    def __init__(self) -> None:
        self.functions: set[CodeType] = set()
        self.changes = 0
        """Number of calls from one package at the root to another."""
        self._modules: dict[str, str] = {}

    def __call__(self, frame: FrameType, event: str, argument: object) -> None:
        """Count one call."""
        module = self._module(frame)
        if event != "call" or not module or frame.f_code.co_name.startswith("<"):
            return
        self.functions.add(frame.f_code)
        caller = frame.f_back
        while caller is not None and not self._module(caller):
            caller = caller.f_back
        if caller is not None:
            self.changes += self._module(caller).split(".")[0] != module.split(".")[0]

    def _module(self, frame: FrameType) -> str:
        """Return the name of a module within lidarops; empty for one of others."""
        file = frame.f_code.co_filename
        if file not in self._modules:
            path = Path(file)
            inside = path.is_relative_to(ROOT)
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts) if inside else ""
            self._modules[file] = name
        return self._modules[file]

    def figures(self) -> dict[str, int]:
        """Return what was counted."""
        return {
            "modules": len({self._modules[code.co_filename] for code in self.functions}),
            "functions": len(self.functions),
            "changes": self.changes,
        }


def main(paths: list[Path]) -> None:
    """Trace a run over each campaign, and print the figures."""
    if "prefect" in sys.modules:
        raise ImportError("lidarops.run imports Prefect")
    sys.meta_path.insert(0, Absent())
    # What is imported late would count as called.
    for module in pkgutil.walk_packages(lidarops.__path__, "lidarops."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    for path in paths:
        if os.fork() == 0:
            _print_figures(path)
            return
        if os.wait()[1]:
            raise SystemExit(1)


def _print_figures(path: Path) -> None:
    campaign = load_campaign(path)
    trace = Trace()
    sys.setprofile(trace)
    record = reprocess(campaign)
    sys.setprofile(None)
    made = [product.kind for scene in record.scenes for product in scene.products] if record else []
    sys.stdout.write(json.dumps({**trace.figures(), "products": made}) + "\n")


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
