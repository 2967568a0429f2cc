"""Several processes of this machine, or threads, for work that is done piece by piece.

What is found is the same, and in the same order, whoever finds it: where no process may or can
be started, or one is lost, the work is done in this one.
"""

from __future__ import annotations

import ctypes
import gc
import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from itertools import chain, islice
from multiprocessing import forkserver, resource_tracker
from typing import Any, Final, Generic, Self, TypeVar

_AHEAD: Final = 8
"""Lots of items for a process that are on their way at the same time."""
_MAPPED_ALONE: Final = (-3, 32 << 20)
"""glibc's M_MMAP_THRESHOLD, and the most it admits in byte."""
_GIVEN_BACK: Final = (-1, 256 << 20)
"""glibc's M_TRIM_THRESHOLD, byte: a task of a scene leaves 100 to 200 MB, which the next one
needs."""
_ONE_THREAD: Final = dict.fromkeys(
    ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"
)
"""What a library looks at as it is loaded; as dask has it for its workers."""
_OF_LIBRARIES: Final = frozenset(
    {*_ONE_THREAD, "PYTHONHASHSEED", "__DASK_PARENT_PID", "HDF5_PLUGIN_PATH"}
)
"""Variables that dask sets in this process too, as it starts workers, and netCDF4 for itself."""

_NO_MORE: Final[Any] = object()

Kept = TypeVar("Kept")
Item = TypeVar("Item")
Found = TypeVar("Found")
_LOG = logging.getLogger(__name__)


def load_ahead(modules: Collection[str]) -> None:
    """Begin a process that loads modules, and that those started here from now on are forked from.

    Each of them would take seconds to load them for itself. It ends with the last process that
    knows of it. Does nothing where forks are not safe, or where there is one.

    Parameters
    ----------
    modules : collection of str
    """
    if not sys.platform.startswith("linux") or os.getpid() in _LOADED:
        return
    multiprocessing.set_forkserver_preload(list(modules))
    unset = {name: value for name, value in _ONE_THREAD.items() if name not in os.environ}
    os.environ.update(unset)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    try:
        # First, as it lets signals through again.
        resource_tracker.ensure_running()
        # Ctrl-C goes to all processes of a terminal; this one ends the others.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        forkserver.ensure_running()
        _LOADED[os.getpid()] = _environment()
    except OSError as error:
        _LOG.warning("no process can be started to load modules: %s", error)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name in unset:
            os.environ.pop(name, None)


def start_method() -> str:
    """Return how processes are to be started, as `multiprocessing` names it.

    They have the environment of this process as it is now, the one of `load_ahead` only where
    that is the same.
    """
    # A fork of this process would inherit the locks of whatever threads are running.
    return "forkserver" if _LOADED.get(os.getpid()) == _environment() else "spawn"


def _environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name not in _OF_LIBRARIES}


def one_ahead(items: Iterable[Item]) -> Iterator[Item]:
    """Give items, the next of which another thread finds while one is in use.

    Raises
    ------
    Exception
        What finding an item raises, in its place.
    """
    rest = iter(items)
    with ThreadPoolExecutor(1, "ahead") as thread:
        coming = thread.submit(next, rest, _NO_MORE)
        while True:
            item = coming.result()
            if item is _NO_MORE:
                return
            coming = thread.submit(next, rest, _NO_MORE)
            yield item


class Processes(Generic[Kept]):
    """Some processes, to be used in a with; started when there is work for them, one by one.

    Parameters
    ----------
    number : int
        Most processes beside this one; none is ever started for fewer than 2.
    kept : object
        What all tasks are called with, sent to each process once.
    """

    def __init__(self, number: int, kept: Kept) -> None:
        self._kept = kept
        self._number = number
        self._pool: ProcessPoolExecutor | None = None
        # A daemonic process, as a worker of dask is, may not have any of its own.
        self._alone = number < 2 or bool(multiprocessing.current_process().daemon)

    @property
    def number(self) -> int:
        """How many there may be beside this one: none where all is done here."""
        return 0 if self._alone else self._number

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def each(
        self,
        task: Callable[[Kept, Item], Found],
        items: Iterable[Item],
        *,
        at_a_time: int,
        fewest: int = 2,
    ) -> Iterator[tuple[Item, Found]]:
        """Do a task for each item; items are taken as they are needed, some ahead.

        Parameters
        ----------
        task : callable
            Called with what is kept and an item. All three, and what it returns or raises, can
            be pickled.
        items : iterable
        at_a_time : int
            Items that are handed to a process together, so that it waits less for the next.
        fewest : int, optional
            Items for which processes are worth their start.

        Yields
        ------
        item, found
            In the order of items.
        """
        rest = iter(items)
        if not self._alone:
            first = list(islice(rest, fewest))
            rest = chain(first, rest)
            if len(first) == fewest:
                yield from self._each_there(task, rest, at_a_time)
                return
        for item in rest:
            yield item, task(self._kept, item)

    def _each_there(
        self, task: Callable[[Kept, Item], Found], items: Iterator[Item], at_a_time: int
    ) -> Iterator[tuple[Item, Found]]:
        lots = iter(lambda: list(islice(items, at_a_time)), [])
        ahead: deque[tuple[list[Item], Callable[[], list[Found]]]] = deque()
        while True:
            for lot in islice(lots, _AHEAD * self._number - len(ahead)):
                ahead.append((lot, self.later(partial(_lot, task), lot)))
            if not ahead:
                return
            lot, found = ahead.popleft()
            yield from zip(lot, found(), strict=True)

    def later(self, task: Callable[[Kept, Item], Found], item: Item) -> Callable[[], Found]:
        """Begin a task; return what gives, or raises, what it came to.

        It waits for that. Without processes the task is done when it is asked for.
        """
        here = partial(task, self._kept, item)
        there = self._submit(task, item)
        return here if there is None else partial(self._waited, there, here)

    def _submit(self, task: Callable[[Kept, Item], Found], item: Item) -> Future[Found] | None:
        if self._alone:
            return None
        if self._pool is None:
            self._pool = ProcessPoolExecutor(
                self._number,
                mp_context=multiprocessing.get_context(start_method()),
                initializer=_prepare,
                initargs=(self._kept,),
            )
        try:
            return self._pool.submit(_there, task, item)
        # One was lost, or none can be started; or what forks them ended as it was asked to.
        except (BrokenProcessPool, OSError, EOFError) as error:
            self._lost(error)
            return None

    def _waited(self, there: Future[Found], here: Callable[[], Found]) -> Found:
        # Never cancelled here: the thread that marks what a lost process leaves undone would stop
        # at a future that was, and the processes that are left would wait for ever.
        try:
            return there.result()
        # A process was killed, for its memory say; or not begun when one could not be started.
        except (BrokenProcessPool, CancelledError) as error:
            self._lost(error)
        return here()

    def _lost(self, error: BaseException) -> None:
        if not self._alone:
            _LOG.warning("a process was lost, its work is done here: %s", error)
            self._alone = True
            if self._pool is not None:
                self._pool.shutdown(wait=False, cancel_futures=True)
                self._pool = None


_LOADED: dict[int, dict[str, str]] = {}
"""This process, where one that loads modules was begun -> the environment that it has."""
_KEPT: list[Any] = []
"""In a process that was started here: what it keeps for all tasks."""


def _prepare(kept: object) -> None:
    # Ctrl-C goes to all processes of a terminal; the one that started this one ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    keep_memory()
    _KEPT[:] = [kept]


def _end_with_parent() -> None:
    """End this process where the one that started it was killed, and can no longer do so."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def keep_memory() -> None:
    """Let the C library of this process keep what arrays leave, for the next ones.

    To map each anew takes a third of the time of small work, a sixth of that of scenes.
    """
    try:
        set_option = ctypes.CDLL(None).mallopt
    # Of another system.
    except (OSError, TypeError, AttributeError):
        return
    for option, value in (_MAPPED_ALONE, _GIVEN_BACK):
        set_option(option, value)


@contextmanager
def unswept() -> Iterator[None]:
    """Keep the garbage collector off what is there now; counted references are dropped as ever.

    It would go through all that was loaded, in a fifth of a second, for a little garbage.
    """
    if gc.get_freeze_count():
        # Of somebody else, and what is frozen is thawed together.
        yield
        return
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def _there(task: Callable[[Any, Item], Found], item: Item) -> Found:
    return task(_KEPT[0], item)


def _lot(task: Callable[[Kept, Item], Found], kept: Kept, items: list[Item]) -> list[Found]:
    return [task(kept, item) for item in items]
