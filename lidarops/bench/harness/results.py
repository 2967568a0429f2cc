"""Results of benchmarks as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from lidarops.errors import CatalogError
from lidarops.system.files import write_atomically

_Result = TypeVar("_Result")


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


def load(kind: type[_Result], path: Path) -> _Result:
    """Return a result that `save` wrote.

    Raises
    ------
    CatalogError
        If the file is missing or holds something else.
    """
    try:
        return TypeAdapter(kind).validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise CatalogError(
            f"no result of a benchmark: {error}", file=path, remedy="run the benchmark again"
        ) from error
