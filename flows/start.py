"""What a flow does before its work.

It shows errors in one line, keeps secrets from the server, lets the processes that it starts do
without Prefect, and a temporary server end with it.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import wraps
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from prefect.exceptions import ParameterTypeError
from pydantic import AfterValidator, Field

from lidarops.campaign.model import CATALOG_VARIABLE
from lidarops.catalog.database import WITHOUT_PASSWORD, holds_password
from lidarops.errors import WRONG_USE, CatalogError, LidarOpsError
from lidarops.system.stores import WITHOUT_KEYS, is_url, refuse_keys

_PREFECT_MODULES: Final = ("flows.", "prefect.")
"""Modules that run flows as main module: of a command, and of a deployment."""
_WATCH: Final = Path(__file__).with_name("watch.py")
_START: Final = "_run_uvicorn_command"
_LOG = logging.getLogger(__name__)
_watchers: list[subprocess.Popen[bytes]] = []


@contextmanager
def plain_errors() -> Iterator[None]:
    """Show an error as one line and exit with its code."""
    try:
        yield
    except (LidarOpsError, ParameterTypeError) as error:
        typer.echo(f"error: {error}", err=True)
        code = error.exit_code if isinstance(error, LidarOpsError) else WRONG_USE
        raise typer.Exit(code) from error


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


def keep_main_module_out() -> None:
    """Let new processes not import the main module of this one again, if it is one of flows.

    All that they do is in modules of lidarops; Prefect takes a second and 100 MB of each.
    `multiprocessing` leaves out a module of this name.
    """
    main = sys.modules["__main__"]
    if main.__spec__ is not None and main.__spec__.name.startswith(_PREFECT_MODULES):
        main.__spec__ = ModuleSpec("__main__", None)


def tie_to_this_process() -> None:
    """Let a temporary server end with this process; does nothing where a server is configured.

    Prefect stops its server at exit, which a killed process does not reach.
    """
    from prefect.settings import get_current_settings  # noqa: PLC0415 - read after `flows` set it

    if get_current_settings().api.url or not hasattr(os, "pidfd_open"):
        return
    # It takes seconds to import; Prefect imports it where it starts a server.
    from prefect.server.api.server import SubprocessASGIServer  # noqa: PLC0415

    # No public hook has the process, and another release of Prefect may start it otherwise.
    start = getattr(SubprocessASGIServer, _START, None)
    if start is None:
        _LOG.warning("this Prefect starts servers otherwise: one may outlive a killed flow")
        return
    if hasattr(start, "__wrapped__"):
        return

    @wraps(start)
    def tied(server: SubprocessASGIServer) -> subprocess.Popen[Any]:
        process: subprocess.Popen[Any] = start(server)
        _watch(process.pid)
        return process

    setattr(SubprocessASGIServer, _START, tied)
    running = SubprocessASGIServer().server_process
    if running is not None:
        _watch(running.pid)


def _watch(process: int) -> None:
    # Its standard input ends with this process. In a session of its own: Ctrl-C reaches all
    # processes of a terminal, but Prefect stops the server.
    command = [sys.executable, "-I", "-S", str(_WATCH), str(process)]
    _watchers.append(subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True))  # noqa: S603
