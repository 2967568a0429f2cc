"""A temporary Prefect server ends with the process that started it, however that ends."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from functools import wraps
from pathlib import Path
from typing import Any, Final

_WATCH: Final = Path(__file__).with_name("watch.py")
_START: Final = "_run_uvicorn_command"
_LOG = logging.getLogger(__name__)
_watchers: list[subprocess.Popen[bytes]] = []


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
