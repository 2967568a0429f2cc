"""Prepare the dask workers of this machine before their first scene."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from lidarops.system import processes

_SILENCED: Final = (
    "distributed.scheduler",
    "distributed.nanny",
    "distributed.worker.state_machine",
)
"""Loggers that report, partly in tracebacks, what lidarops reports itself: workers that died, and
abandoned scenes. Another logger warns about the memory of a worker, and stays."""


@contextmanager
def quiet() -> Iterator[None]:
    """Silence the loggers of dask that repeat what lidarops reports."""
    before = {name: logging.getLogger(name).level for name in _SILENCED}
    _silence()
    try:
        yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)


def _silence() -> None:
    for name in _SILENCED:
        logging.getLogger(name).setLevel(logging.CRITICAL)


def dask_setup(_worker: object) -> None:
    """Prepare a worker; dask calls a function of this name."""
    _silence()
    processes.keep_memory()
    # Ctrl-C reaches all processes of a terminal, but workers should finish their scenes.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
