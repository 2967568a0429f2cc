"""Show errors of flows that are called from a command line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import typer
from prefect.exceptions import ParameterTypeError

from lidarops.errors import LidarOpsError

_WRONG_USE = 2
_REFUSED = 1


@contextmanager
def plain_errors() -> Iterator[None]:
    """Show an error as one line and exit with code 2 for wrong use, else with 1."""
    try:
        yield
    except (LidarOpsError, ParameterTypeError) as error:
        typer.echo(f"error: {error}", err=True)
        wrong_use = not isinstance(error, LidarOpsError) or error.wrong_use
        raise typer.Exit(_WRONG_USE if wrong_use else _REFUSED) from error
