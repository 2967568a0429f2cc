"""Processes that a flow starts do without Prefect, which takes a second and 100 MB each."""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec
from typing import Final

_PREFECT_MODULES: Final = ("flows.", "prefect.")
"""Modules that run flows as main module: of a command, and of a deployment."""


def keep_main_module_out() -> None:
    """Let new processes not import the main module of this one again, if it is one of flows.

    All that they do is in modules of lidarops. `multiprocessing` leaves out a module of this name.
    """
    main = sys.modules["__main__"]
    if main.__spec__ is not None and main.__spec__.name.startswith(_PREFECT_MODULES):
        main.__spec__ = ModuleSpec("__main__", None)
