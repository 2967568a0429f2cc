"""Results of benchmarks as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

from lidarops.errors import CatalogError
from lidarops.system.files import write_atomically


def plain(result: object) -> Any:
    """Return a result, or a list of them, as lists and dicts for JSON."""
    if isinstance(result, list | tuple):
        return [plain(member) for member in result]
    if is_dataclass(result) and not isinstance(result, type):
        return asdict(result)
    return result


def save(result: object, path: Path) -> Path:
    """Write a result as JSON.

    Raises
    ------
    CatalogError
        If it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        content = json.dumps(plain(result), indent=1, allow_nan=False)
        write_atomically(path, content.encode())
    except OSError as error:
        raise CatalogError(
            f"the result cannot be written: {error}",
            file=path,
            remedy="choose a folder you can write to",
        ) from error
    return path
