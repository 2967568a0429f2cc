"""Versions of products that a rerun replaces: kept beside the products where that is wanted."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from lidarops.errors import CatalogError

FOLDER: Final = "superseded"
"""Below the output folder."""

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
        What the ledger says of its content, which names the version.

    Returns
    -------
    str
        Path of the kept version below `output`; empty where there is no file to keep.

    Raises
    ------
    CatalogError
        If it cannot be kept.
    """
    source = output / "products" / product
    name = Path(FOLDER) / Path(product).with_suffix(f".{sha256[:12]}{source.suffix}")
    target = output / name
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # A product is replaced by renaming, so that a second link keeps the old one without a copy.
        target.unlink(missing_ok=True)
        _link(source, target)
    except FileNotFoundError:
        return ""
    except OSError as error:
        raise CatalogError(
            f"the version that is replaced cannot be kept: {error.strerror or error}",
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
        temporary = target.with_name(f".{target.name}.tmp")
        shutil.copy2(source, temporary)
        temporary.replace(target)


def drop(output: Path, kept: str) -> None:
    """Remove a kept version, where it turned out that nothing replaced it."""
    if kept:
        with suppress(OSError):
            (output / kept).unlink(missing_ok=True)


def sweep(output: Path) -> list[str]:
    """Remove the hidden temporary files that a killed process left among products and reports.

    Returns
    -------
    list of str
        Their paths.
    """
    swept = []
    for folder in ("products", FOLDER, "report"):
        for path in _temporaries(str(output / folder)):
            with suppress(OSError):
                Path(path).unlink()
                swept.append(path)
    return swept


def _temporaries(folder: str) -> Iterator[str]:
    try:
        entries = list(os.scandir(folder))
    except OSError:
        return
    for entry in entries:
        if entry.is_dir(follow_symlinks=False):
            yield from _temporaries(entry.path)
        elif entry.name.startswith(".") and entry.name.endswith(".tmp"):
            yield entry.path
