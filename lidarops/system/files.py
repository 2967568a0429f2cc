"""Local files: names in an output folder, digests, and writing that is complete or absent."""

from __future__ import annotations

import errno
import hashlib
import math
import os
import stat
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path, PurePosixPath
from typing import Final

from lidarops.errors import ProductError

SITE: Final = "site"
"""Folder of the site beside the products, also where it is published."""
_COARSE: Final = 2.0
"""s, the coarsest step of times of files (FAT)."""
MANIFEST: Final = "manifest.json"
"""File that lists the products of a site. It also identifies a folder as a site."""


@contextmanager
def opened_regular(path: Path) -> Iterator[BufferedReader]:
    """Open a file to read it.

    Raises
    ------
    OSError
        If it cannot be read, or is no regular file.
    """
    # Opening a pipe would block for ever, and a device may have no end.
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK), "rb") as stream:
        if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
            raise OSError(errno.EINVAL, "is no regular file")
        yield stream


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a regular file; raise OSError as `opened_regular` does."""
    with opened_regular(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def within(folder: Path, path: str) -> Path:
    """Return a file of a folder; refuse paths that lead out of it.

    Parameters
    ----------
    folder : Path
    path : str
        Relative, with forward slashes.

    Raises
    ------
    ProductError
        If the path is absolute, goes up, holds a backslash, or is a link to the outside.
    """
    pure = PurePosixPath(path)
    if pure.is_absolute() or ".." in pure.parts or not pure.parts or "\\" in path:
        raise ProductError("is not a path inside its folder", file=path)
    file = folder / pure
    if os.path.commonpath([os.path.realpath(file), inside := os.path.realpath(folder)]) != inside:
        raise ProductError(
            "is a link that leads out of its folder", file=path, remedy="put the file in its place"
        )
    return file


def product_paths(folder: Path) -> list[str]:
    """List the NetCDF files below a folder, sorted, without hidden files and folders.

    Links to folders are not followed, so that the search ends and stays inside.
    """
    paths = []
    for parent, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        place = Path(parent).relative_to(folder)
        inside = "" if place == Path() else f"{place.as_posix()}/"
        shown = (name for name in files if name.endswith(".nc") and not name.startswith("."))
        paths += [inside + name for name in shown]
    return sorted(paths)


@contextmanager
def only_one(lock: Path, *, wait: bool) -> Iterator[None]:
    """Let one process at a time through, by the lock on a file, which ends with its process.

    Parameters
    ----------
    lock : Path
        Made if absent, and left; its folder must exist.
    wait : bool
        Whether to wait for another process.

    Raises
    ------
    BlockingIOError
        If another process is through, unless this one waits.
    """
    # Who only reads products needs no locks, nor a system that has them.
    import fcntl  # noqa: PLC0415

    with lock.open("a") as opened:
        fcntl.flock(opened, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield


def settled_before() -> float:
    """Return a time, s since 1970: files of earlier times will not change at these times any more.

    Clocks of file systems have coarse steps, and are behind that of the system.
    """
    return time.time() - _COARSE


def last_change(file: Path) -> float:
    """Return when a file, or a link to it, was last written or put there, s since 1970.

    Infinite without one.
    """
    try:
        states = (file.lstat(), file.stat())
    except OSError:
        return math.inf
    # A copy may keep the time of its content.
    return max(moment for state in states for moment in (state.st_mtime, state.st_ctime))


def write_atomically(
    target: Path, content: bytes | Iterable[bytes], as_of: float | None = None, *, sync: bool = True
) -> None:
    """Write `content` to a temporary file beside `target`, sync it and rename it.

    Parameters
    ----------
    target : Path
        File to create or replace; its folder must exist.
    content : bytes, or iterable of bytes
        Whole content, or its parts.
    as_of : float, optional
        Time that the file states as that of its change, s since 1970; default now.
    sync : bool, optional
        Whether the content must be on the disk before the name is: not where it is soon replaced.

    Raises
    ------
    OSError
        If the file system refuses; `target` is then unchanged.
    """
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".tmp")
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.writelines([content] if isinstance(content, bytes) else content)
            if sync:
                stream.flush()
                os.fsync(stream.fileno())
        # mkstemp makes files that only their owner can read, but reports are shared.
        temporary.chmod(0o644)
        if as_of is not None:
            os.utime(temporary, (as_of, as_of))
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
