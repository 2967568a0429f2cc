"""How the flows tell wrong use where they are called from a command line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import typer
from prefect.exceptions import ParameterTypeError

from lidarops.clusters import ClusterError
from lidarops.errors import CampaignError

_WRONG_USE = 2


@contextmanager
def told() -> Iterator[None]:
    """Show wrong use as a sentence and exit with 2; looked for before a server is started."""
    try:
        yield
    except (CampaignError, ClusterError, ParameterTypeError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(_WRONG_USE) from error
