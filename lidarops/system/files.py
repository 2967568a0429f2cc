"""Local files: their digest, and writing so that they are complete or absent after a kill."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file.

    Raises
    ------
    OSError
        If it cannot be read.
    """
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def write_atomically(target: Path, content: bytes) -> None:
    """Write `content` to a temporary file beside `target`, sync it and rename it.

    Parameters
    ----------
    target : Path
        File to create or replace; its folder must exist.
    content : bytes
        Whole content.

    Raises
    ------
    OSError
        If the file system refuses; `target` is then unchanged.
    """
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".tmp")
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        # mkstemp makes files that only their owner can read, but reports are shared.
        temporary.chmod(0o644)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
