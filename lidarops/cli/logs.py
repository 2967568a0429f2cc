"""Logs: a line of text or of JSON an event."""

from __future__ import annotations

import json
import logging
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Final

import typer

from lidarops.errors import CatalogError

LogLevelOption = Annotated[
    str, typer.Option("--log-level", help="debug, info, warning or error.", metavar="LEVEL")
]
LogJsonOption = Annotated[bool, typer.Option("--log-json", help="One JSON object a log line.")]
LogFileOption = Annotated[
    Path | None, typer.Option("--log-file", help="Append the log here, not to standard error.")
]

_LEVELS: Final = ("debug", "info", "warning", "error")
_OURS: Final = frozenset(
    {"run", "scene", "granule", "granules", "product", "products", "seconds", "reason"}
)


class JsonLines(logging.Formatter):
    """Formats a record as one line of JSON, with the facts that came as `extra`."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        about = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **{key: value for key, value in vars(record).items() if key in _OURS},
        }
        if record.exc_info:
            about["exception"] = self.formatException(record.exc_info)
        return json.dumps(about, default=str)


def set_up(level: str, *, as_json: bool, file: Path | None) -> None:
    """Let the package's log go to a file or to standard error.

    Raises
    ------
    CatalogError
        If the file cannot be opened.
    typer.BadParameter
        If there is no such level.
    """
    if level.lower() not in _LEVELS:
        raise typer.BadParameter(f"{level!r} is not one of {', '.join(_LEVELS)}")
    logger = logging.getLogger("lidarops")
    try:
        handler: logging.Handler = (
            logging.StreamHandler() if file is None else logging.FileHandler(file, delay=False)
        )
    except OSError as error:
        raise CatalogError(
            f"cannot be written: {error.strerror}", file=file, remedy="choose another --log-file"
        ) from error
    text = logging.Formatter("%(asctime)s %(levelname)s %(message)s", "%Y-%m-%dT%H:%M:%S")
    handler.setFormatter(JsonLines() if as_json else text)
    for old in list(logger.handlers):
        logger.removeHandler(old)
        old.close()
    logger.addHandler(handler)
    logger.setLevel(level.upper())
    logger.propagate = False
