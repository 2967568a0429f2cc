"""What dask runs on every worker of this machine before its first scene."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from lidarops.system import processes

_NOISY: Final = ("distributed.scheduler", "distributed.nanny", "distributed.worker.state_machine")
"""Loggers that show, some in tracebacks, what lidarops tells in its own words: workers that died,
and scenes that were abandoned. What a worker's memory comes to is told by another."""


@contextmanager
def quiet() -> Iterator[None]:
    """Keep dask from telling what lidarops tells itself."""
    before = {name: logging.getLogger(name).level for name in _NOISY}
    _hush()
    try:
        yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)


def _hush() -> None:
    for name in _NOISY:
        logging.getLogger(name).setLevel(logging.CRITICAL)


def dask_setup(_worker: object) -> None:
    """Prepare a worker; dask calls a function of this name."""
    _hush()
    processes.keep_memory()
    # Ctrl-C goes to all processes of a terminal, and the workers are to end their scenes.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
