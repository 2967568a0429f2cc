"""Keep the versions of products that a rerun replaces, if the campaign says so."""

from __future__ import annotations

import errno
import logging
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from lidarops.catalog.lock import process_start
from lidarops.errors import CatalogError

FOLDER: Final = "superseded"
"""Folder of kept versions, below the output folder."""
LONGEST_WRITE: Final = 3600.0
"""s for which a temporary file of a report is left alone, because reports are built outside the
lock. What it holds is in memory before it is made: its writer only writes and syncs it."""
_WRITER: Final = re.compile(r"\.(\d+)-[0-9a-f]+\.tmp$")
"""The number of the process that writes a temporary file, in its name."""
_LOADED: Final = time.time()

_LOG = logging.getLogger(__name__)
_NO_LINKS: Final = frozenset({errno.EPERM, errno.ENOTSUP, errno.EXDEV, errno.EMLINK, errno.ENOSYS})


def keep(output: Path, product: str, sha256: str) -> str:
    """Keep the present file of a product under a name of its own.

    Parameters
    ----------
    output : Path
        The output folder.
    product : str
        Path below the folder of products.
    sha256 : str
        Digest of its content in the ledger, which becomes part of the name.

    Returns
    -------
    str
        Path of the kept version below `output`; empty if there is no file.

    Raises
    ------
    CatalogError
        If the version cannot be kept.
    """
    source = output / "products" / product
    name = Path(FOLDER) / Path(product).with_suffix(f".{sha256[:12]}{source.suffix}")
    target = output / name
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # New products replace old ones by renaming, so a hard link keeps the old file.
        target.unlink(missing_ok=True)
        _link(source, target)
    except FileNotFoundError:
        return ""
    except OSError as error:
        raise CatalogError(
            f"the replaced version cannot be kept: {error.strerror or error}",
            file=target,
            remedy="make space, or set superseded: remove in the campaign file",
        ) from error
    return name.as_posix()


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        temporary = target.with_name(f".{target.name}.{os.getpid()}-0.tmp")
        shutil.copy2(source, temporary)
        temporary.replace(target)


def drop(output: Path, kept: str) -> None:
    """Remove a kept version that was not replaced after all."""
    if kept:
        with suppress(OSError):
            (output / kept).unlink(missing_ok=True)


def sweep(output: Path, is_written: Callable[[], bool]) -> bool:
    """Remove hidden temporary files that killed processes left among products and reports.

    Parameters
    ----------
    output : Path
        The output folder.
    is_written : callable
        Whether another run may write into it. Called once the files are listed: those of a run that
        begins later are not among them.

    Returns
    -------
    bool
        Whether all could be found and removed; if not, a later run has to try again.
    """
    failures: list[OSError] = []
    paths = list(temporary_files(output, failures))
    if is_written():
        return False
    for path in paths:
        try:
            path.unlink(missing_ok=True)
            _LOG.warning("removed %s, left by a killed process", path)
        except OSError as error:
            failures.append(error)
    return not failures


def temporary_files(output: Path, failures: list[OSError] | None = None) -> Iterator[Path]:
    """Yield the hidden temporary files among products and reports that no process here writes.

    Processes of other machines may write them, if a run is at work. Folders that exist and cannot
    be read are appended to the failures.
    """
    unread: list[OSError] = [] if failures is None else failures
    for kept in ("products", FOLDER, "report"):
        for folder, _, names in os.walk(output / kept, onerror=unread.append):
            for name in names:
                path = Path(folder, name)
                hidden = name.startswith(".") and name.endswith(".tmp")
                old = hidden and (kept != "report" or _age(path) > LONGEST_WRITE)
                if old and not _has_writer(path):
                    yield path
    unread[:] = [error for error in unread if not isinstance(error, FileNotFoundError)]


def _has_writer(path: Path) -> bool:
    """Return whether the process that a name states runs on this machine."""
    writer = _WRITER.search(path.name)
    if writer is None:
        return False
    if int(writer[1]) == os.getpid():
        # In containers, another process had the same number before.
        return _age(path) <= time.time() - _LOADED
    return bool(process_start(int(writer[1])))


def _age(path: Path) -> float:
    """Return the time since a file was last written, s; 0 where it is gone."""
    try:
        return time.time() - path.stat().st_mtime
    except OSError:
        return 0.0
