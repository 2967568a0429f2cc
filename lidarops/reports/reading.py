"""Products read for a report: one after another, or by several processes at the same time.

What is read is the same, and in the same order, whoever reads it. A product that is missing or
cannot be read stops nothing: the reason is handed over in place of what it holds.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Generic, Self, TypeVar

import xarray as xr

from lidarops.errors import ProductError
from lidarops.products.read import open_product

FEWEST: Final = 50
"""Products that a process must have to read, to be worth its start."""
UNREADABLE: Final = (OSError, RuntimeError, ValueError, KeyError, IndexError, ProductError)
"""What opening and reading a damaged or foreign file has been seen to raise."""
_AT_A_TIME: Final = 8
"""Products handed to a process together, so that it waits less for the next."""

Found = TypeVar("Found")
_Found_co = TypeVar("_Found_co", covariant=True)
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Reading(Generic[_Found_co]):
    """What is to be read of one product; goes to another process, so all of it can be pickled."""

    path: Path
    names: tuple[str, ...]
    """Of the variables that are read."""
    read: Callable[..., _Found_co]
    """Called with the product, and the truth of a simulation where it is asked for."""
    with_truth: bool = False


@dataclass(frozen=True, slots=True)
class Unread:
    """Why nothing was read of a product."""

    reason: str


class Readers:
    """Reads products, by several processes where there are enough products; to be used in a with.

    Parameters
    ----------
    workers : int
        Most processes; none is started for fewer than 2.
    products : int
        About how many there are to be read in all.
    truth : xr.Dataset, optional
        In memory, for the readings that ask for it.
    """

    def __init__(
        self, workers: int = 1, products: int = 0, truth: xr.Dataset | None = None
    ) -> None:
        self._truth = truth
        self._pool: ProcessPoolExecutor | None = None
        processes = min(workers, products // FEWEST)
        # A daemonic process, as a worker of dask is, may not have any of its own.
        if processes > 1 and not multiprocessing.current_process().daemon:
            # A fork would inherit the locks of whatever threads are running.
            self._pool = ProcessPoolExecutor(
                processes,
                mp_context=multiprocessing.get_context("spawn"),
                initializer=_prepare,
                initargs=(truth,),
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def one(self, reading: Reading[Found]) -> Found | Unread:
        """Read one product, in this process."""
        return _read(reading, self._truth)

    def each(self, readings: Sequence[Reading[Found]]) -> Iterator[Found | Unread]:
        """Read products; what is found of each, in their order."""
        done = 0
        if self._pool is not None and len(readings) > 1:
            try:
                for found in self._pool.map(_read_there, readings, chunksize=_AT_A_TIME):
                    yield found
                    done += 1
            # A process that was killed, for its memory say; or one that cannot be started.
            except (BrokenProcessPool, OSError) as error:
                _LOG.warning("a process that read products was lost, they are read here: %s", error)
                self._pool.shutdown(wait=False, cancel_futures=True)
                self._pool = None
        for reading in readings[done:]:
            yield self.one(reading)


def _read(reading: Reading[Found], truth: xr.Dataset | None) -> Found | Unread:
    try:
        with open_product(reading.path, reading.names) as product:
            return reading.read(product, truth) if reading.with_truth else reading.read(product)
    except UNREADABLE as error:
        return Unread(reason(reading.path, error))


def reason(path: Path, error: BaseException) -> str:
    """Return the words of an error, without the path that stands beside them."""
    words = str(error).removeprefix(f"{path}: ").replace(str(path), path.name)
    return words or type(error).__name__


_KEPT: dict[str, Any] = {}
"""The truth, in a process that reads: sent once, not with every product."""


def _prepare(truth: xr.Dataset | None) -> None:
    # Ctrl-C goes to all processes of a terminal; the one that started this one ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _KEPT["truth"] = truth


def _end_with_parent() -> None:
    """End this process where the one that started it was killed, and can no longer do so."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _read_there(reading: Reading[Found]) -> Found | Unread:
    return _read(reading, _KEPT["truth"])
