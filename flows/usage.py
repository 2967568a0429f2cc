"""What flows do with command lines and parameters: show errors, keep secrets from the server."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer
from prefect.exceptions import ParameterTypeError
from pydantic import AfterValidator, Field

from lidarops.campaign.model import CATALOG_VARIABLE
from lidarops.catalog.database import WITHOUT_PASSWORD, holds_password
from lidarops.errors import CatalogError, LidarOpsError
from lidarops.system.stores import WITHOUT_KEYS, is_url, refuse_keys

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


def _without_keys(location: str) -> str:
    if is_url(location):
        refuse_keys(location)
    return location


def _without_password(url: str) -> str:
    if holds_password(url):
        raise CatalogError(
            "the URL holds a password, which the Prefect server would keep",
            field="catalog",
            remedy=f"set {CATALOG_VARIABLE} where the flow runs",
            wrong_use=True,
        )
    return url


# The server refuses other parameters by these patterns before it stores them.
Location = Annotated[
    str, AfterValidator(_without_keys), Field(json_schema_extra={"pattern": WITHOUT_KEYS})
]
"""A folder, or a URL without credentials."""
CatalogUrl = Annotated[
    str, AfterValidator(_without_password), Field(json_schema_extra={"pattern": WITHOUT_PASSWORD})
]
"""SQLAlchemy URL without password."""


def catalog_parameter(url: str | None) -> str | None:
    """Return the URL as a parameter of a flow; one with a password goes into the environment."""
    if url is None or not holds_password(url):
        return url
    os.environ[CATALOG_VARIABLE] = url
    return None
