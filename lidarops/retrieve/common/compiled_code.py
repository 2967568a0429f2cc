"""Where numba keeps compiled code: apart for every state of the sources."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Final

from numba import config

_SOURCES: Final = Path(__file__).parents[1]


def keep_apart(sources: Path = _SOURCES) -> str:
    """Have numba keep what it compiles in a folder named after the sources of all that it compiles.

    Numba looks whether the file of a function has changed, not whether those have that hold the
    functions it calls: their old code would go on to be used.

    Parameters
    ----------
    sources : Path
        Folder of the modules, in folders of its own too.

    Returns
    -------
    str
        The folder: in that of ``NUMBA_CACHE_DIR``, else beside the sources. Where it cannot be
        written numba looks for another.
    """
    digest = hashlib.sha256()
    for path in sorted(sources.rglob("*.py")):
        content = path.read_bytes()
        if b"numba" in content:
            digest.update(content)
    name = f"lidarops-{digest.hexdigest()[:16]}"
    settings = vars(config)
    kept = Path(settings["CACHE_DIR"] or sources / "__pycache__")
    # A second time where it was set before.
    folder = str((kept.parent if kept.name.startswith("lidarops-") else kept) / name)
    settings["CACHE_DIR"] = folder
    return folder
