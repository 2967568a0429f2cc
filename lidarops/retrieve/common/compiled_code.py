"""Cache of compiled code, separate for every state of the sources."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Final

from numba import config

_SOURCES: Final = Path(__file__).parents[1]


def keep_apart(sources: Path = _SOURCES) -> str:
    """Set the cache folder of numba to one named after a hash of all compiled sources.

    Numba checks whether the file of a function has changed, but not the files of the functions
    that it calls: it would keep using their old code.

    Parameters
    ----------
    sources : Path
        Folder of the modules, searched recursively.

    Returns
    -------
    str
        The cache folder: within ``NUMBA_CACHE_DIR``, else beside the sources. Where it is not
        writable, numba chooses another.
    """
    digest = hashlib.sha256()
    for path in sorted(sources.rglob("*.py")):
        content = path.read_bytes()
        if b"numba" in content:
            digest.update(content)
    name = f"lidarops-{digest.hexdigest()[:16]}"
    settings = vars(config)
    base = Path(settings["CACHE_DIR"] or sources / "__pycache__")
    # A former call may have set the folder already.
    folder = str((base.parent if base.name.startswith("lidarops-") else base) / name)
    settings["CACHE_DIR"] = folder
    return folder
