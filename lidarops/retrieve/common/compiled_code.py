"""Options of compiled code, and its cache, separate for every state of the sources."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numba
from numba import config

_SOURCES: Final = Path(__file__).parents[1]
_CONSTANTS: Final = ("constants.py", "flags.py")
"""Modules of lidarops beside the sources whose constants are compiled in."""

compiled: Final = numba.njit(cache=True, nogil=True, error_model="numpy")
# Forced inlining lets functions share loops. Without the runtime they cannot allocate, and count no
# references to arrays, which takes longer than a loop.
_BARE: Final[dict[str, Any]] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "forceinline": True,
    "_nrt": False,
}
inlined: Final = numba.njit(**_BARE)
"""Compile what calls a sum and is called by compiled code, for the reason that `summing` gives."""
summing: Final = numba.njit(**_BARE, fastmath={"reassoc", "contract", "nsz"})
"""Compile a sum whose terms the compiler may reassociate, so that it vectorises.

NaN and infinity keep their meaning. The function has to be inlined. As a symbol of its own it would
be optimised once alone and once within each caller, with different last digits, and the linker
takes the one or the other depending on what was compiled before and what came from the cache."""


def keep_apart(sources: Path = _SOURCES) -> str:
    """Set the cache folder of numba to one named after a hash of the sources.

    Numba checks whether the file of a function has changed, but not the files of the functions
    that it calls, nor those of constants such as thresholds: it would keep their old values.

    Parameters
    ----------
    sources : Path
        Folder of the modules, searched recursively; modules of constants lie in the folder above.

    Returns
    -------
    str
        The cache folder: within ``NUMBA_CACHE_DIR``; else beside the sources; where that is not
        writable, in the user's folder for caches. A folder elsewhere begins as a copy of the one
        beside the sources, so that users and workers share what was compiled at installation.
    """
    digest = hashlib.sha256()
    constants = (path for name in _CONSTANTS if (path := sources.parent / name).exists())
    for path in (*sorted(sources.rglob("*.py")), *constants):
        digest.update(path.read_bytes())
    installed = sources / "__pycache__" / f"lidarops-{digest.hexdigest()[:16]}"
    settings = vars(config)
    folder = _base(settings["CACHE_DIR"], sources) / installed.name
    if folder != installed and installed.is_dir() and not folder.exists():
        _copy(installed, folder)
    settings["CACHE_DIR"] = str(folder)
    return str(folder)


def _base(requested: str, sources: Path) -> Path:
    """Return the folder of caches, for the requested one or none."""
    if requested:
        # A former call may have set the folder already.
        base = Path(requested)
        return base.parent if base.name.startswith("lidarops-") else base
    if os.access(sources, os.W_OK):
        return sources / "__pycache__"
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111 - never raises
    return Path(home) / "lidarops"


def _copy(installed: Path, folder: Path) -> None:
    """Copy a cache; another process may do the same. Without the copy, numba compiles anew."""
    with suppress(OSError):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent) as building:
            copy = Path(building) / folder.name
            shutil.copytree(installed, copy)
            copy.rename(folder)
