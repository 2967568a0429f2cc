"""Logs: one line of text or JSON per event."""

from __future__ import annotations

import json
import logging
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Final

import typer

from lidarops.errors import CatalogError
from lidarops.figures.wording import visible

LogLevelOption = Annotated[
    str, typer.Option("--log-level", help="debug, info, warning or error.", metavar="LEVEL")
]
LogJsonOption = Annotated[
    bool, typer.Option("--log-json", help="Write one JSON object per log line.")
]
LogFileOption = Annotated[
    Path | None,
    typer.Option("--log-file", help="Append the log to this file instead of standard error."),
]

_LEVELS: Final = ("debug", "info", "warning", "error")
_EXTRA_FIELDS: Final = frozenset(
    {"run", "scene", "granule", "granules", "product", "products", "seconds", "reason"}
)


class JsonLines(logging.Formatter):
    """Formats a log record as one line of JSON, including the fields passed as `extra`."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        fields = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **{key: value for key, value in vars(record).items() if key in _EXTRA_FIELDS},
        }
        if record.exc_info:
            fields["exception"] = self.formatException(record.exc_info)
        return json.dumps(fields, default=str)


class TextLines(logging.Formatter):
    """Formats a log record as text, with control characters, as of file names, as escapes."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the text."""
        return visible(super().format(record))


def set_up(level: str, *, as_json: bool, file: Path | None) -> None:
    """Send the log of the package to a file or to standard error.

    Raises
    ------
    CatalogError
        If the file cannot be opened.
    typer.BadParameter
        If the level is unknown.
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
    text = TextLines("%(asctime)s %(levelname)s %(message)s", "%Y-%m-%dT%H:%M:%S")
    handler.setFormatter(JsonLines() if as_json else text)
    for previous in list(logger.handlers):
        logger.removeHandler(previous)
        previous.close()
    logger.addHandler(handler)
    logger.setLevel(level.upper())
    logger.propagate = False
