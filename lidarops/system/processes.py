"""Local processes and threads for work that can be split into items.

Results and their order do not depend on the number of processes. If processes may not or cannot be
started, this process does the work. If one is lost, one does the rest, an item at a time; what an
item that ends this one and a fresh one amounts to, the caller states.
"""

from __future__ import annotations

import copy
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
from contextlib import AbstractContextManager, contextmanager
from itertools import chain, islice
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import BaseContext
from multiprocessing.process import BaseProcess
from typing import Any, Final, Generic, TypeVar

from lidarops.system import ONE_THREAD

_BATCHES_AHEAD: Final = 8
"""Batches of items submitted per process."""
_MMAP_THRESHOLD: Final = (-3, 32 << 20)
"""M_MMAP_THRESHOLD of glibc, and its largest value in bytes."""
_TRIM_THRESHOLD: Final = (-1, 256 << 20)
"""M_TRIM_THRESHOLD of glibc, and its value in bytes: more than a scene leaves, which the next scene
needs again."""
_PARENT: Final = "__LIDAROPS_PARENT_PID"
"""Variable with the id of this process, for its server, which loads this module and removes it."""
_PR_SET_PDEATHSIG: Final = 1
"""Of prctl on Linux: the signal that a process gets when its parent dies."""
_LIBRARY_VARIABLES: Final = frozenset(
    {*ONE_THREAD, _PARENT, "PYTHONHASHSEED", "__DASK_PARENT_PID", "HDF5_PLUGIN_PATH"}
)
"""Variables that dask, when it starts workers, netCDF4 and `preload_modules` set here, too."""

CRASHED: Final = "reading it crashed the process"
"""What to say of a file that ends each process that reads it."""

_NO_MORE: Final[Any] = object()

Kept = TypeVar("Kept")
Item = TypeVar("Item")
Result = TypeVar("Result")
Lost = Callable[[Item], Result] | None
_LOG = logging.getLogger(__name__)


def preload_modules(modules: Collection[str]) -> None:
    """Start a server process that loads modules, from which further processes are forked.

    Otherwise each process would take seconds to load the modules. The server ends with the last
    process that uses it. Does nothing if forks are not safe, or if the server exists.
    """
    if not sys.platform.startswith("linux") or os.getpid() in _LOADED:
        return
    # The kernel takes the thread that starts a process for its parent; only the main one stays.
    in_main = threading.current_thread() is threading.main_thread()
    multiprocessing.set_forkserver_preload([*([__name__] if in_main else []), *modules])
    unset = {name: value for name, value in ONE_THREAD.items() if name not in os.environ}
    if in_main:
        unset[_PARENT] = str(os.getpid())
    os.environ.update(unset)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    try:
        # First, because it unblocks signals.
        resource_tracker.ensure_running()
        # Ctrl-C reaches all processes of a terminal, but this process ends the others.
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
    """Return the start method of `multiprocessing` for new processes.

    They get the present environment of this process. The server of `preload_modules` is used only
    if it has the same environment.
    """
    # A fork of this process would inherit the locks of running threads.
    return "forkserver" if _LOADED.get(os.getpid()) == _environment() else "spawn"


def _environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name not in _LIBRARY_VARIABLES}


def prefetch_one(items: Iterable[Item]) -> Iterator[Item]:
    """Yield items, while another thread already computes the next one.

    Raises
    ------
    Exception
        The exception of an item, raised in its place.
    """
    rest = iter(items)
    with ThreadPoolExecutor(1, "ahead") as thread:
        upcoming = thread.submit(next, rest, _NO_MORE)
        while True:
            item = upcoming.result()
            if item is _NO_MORE:
                return
            upcoming = thread.submit(next, rest, _NO_MORE)
            yield item


class Processes(AbstractContextManager["Processes[Kept]"], Generic[Kept]):
    """A context manager of some processes, which start one by one when there is work.

    Parameters
    ----------
    number : int
        Largest number of further processes; none is started for fewer than 2.
    kept : object
        First argument of all tasks, sent to each process once.
    """

    def __init__(self, number: int, kept: Kept) -> None:
        self._kept = kept
        self._number = number
        self._pool: ProcessPoolExecutor | None = None
        self._started: list[BaseProcess] = []
        # A daemonic process, such as a dask worker, may not have child processes.
        self._alone = number < 2 or bool(multiprocessing.current_process().daemon)
        self._careful = False
        """Whether a process was lost, and one does each task by itself."""

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def map_items(
        self,
        task: Callable[[Kept, Item], Result],
        items: Iterable[Item],
        *,
        at_a_time: int,
        fewest: int = 2,
        lost: Lost[Item, Result] = None,
    ) -> Iterator[tuple[Item, Result]]:
        """Call a task for each item; items are consumed as needed, some ahead.

        Parameters
        ----------
        task : callable
            Called with `kept` and an item. All of these, and its result or exception, must be
            picklable.
        items : iterable
        at_a_time : int
            Number of items per batch for a process.
        fewest : int, optional
            Least number of items for which processes are started.
        lost : callable, optional
            Called with an item that ends each process that works on it (such as by a crash of a
            library, or for its memory); returns the result. No such item is worked on here.

        Yields
        ------
        item, result
            In the order of items.

        Raises
        ------
        BrokenProcessPool
            For an item that ends its process, without `lost`.
        """
        rest = iter(items)
        if not self._alone:
            first = list(islice(rest, fewest))
            rest = chain(first, rest)
            if len(first) == fewest:
                yield from self._each_in_processes(task, rest, at_a_time, lost)
                return
        for item in rest:
            yield item, task(self._kept, item)

    def _each_in_processes(
        self,
        task: Callable[[Kept, Item], Result],
        items: Iterator[Item],
        at_a_time: int,
        lost: Lost[Item, Result],
    ) -> Iterator[tuple[Item, Result]]:
        batches = iter(lambda: list(islice(items, at_a_time)), [])
        ahead: deque[tuple[list[Item], Future[list[Result]] | None]] = deque()
        while True:
            for batch in islice(batches, _BATCHES_AHEAD * self._number - len(ahead)):
                ahead.append((batch, self._submit(task, batch)))
            if not ahead:
                return
            batch, future = ahead.popleft()
            results = self._wait(future)
            if results is None:
                yield from ((item, self._by_itself(task, item, lost)) for item in batch)
            else:
                yield from zip(batch, results, strict=True)

    def _submit(
        self, task: Callable[[Kept, Item], Result], items: list[Item]
    ) -> Future[list[Result]] | None:
        """Start a task for some items; None if it is to be called for each when it is needed."""
        if self._alone or self._careful:
            return None
        try:
            return self._started_pool(self._number).submit(_run, task, items)
        # A process was lost, none can be started, or the server that forks them has ended.
        except (BrokenProcessPool, OSError, EOFError) as error:
            self._lost(error)
            return None

    def _started_pool(self, number: int) -> ProcessPoolExecutor:
        if self._pool is None:
            self._pool = ProcessPoolExecutor(
                number,
                mp_context=_context(self._started),
                initializer=_prepare,
                initargs=(self._kept,),
            )
        return self._pool

    def _wait(self, future: Future[list[Result]] | None) -> list[Result] | None:
        """Return the results of a started task; None if its process was lost."""
        # Never cancel here: the thread that marks the tasks of a lost process would stop at a
        # cancelled future, and the remaining processes would wait for ever.
        try:
            return None if future is None else future.result()
        # A process was killed (e.g. for its memory), or could not be started.
        except (BrokenProcessPool, CancelledError) as error:
            # Of several tasks of one lost pool, only the first one to be waited for says so.
            if not self._careful:
                self._lost(error)
        return None

    def _by_itself(
        self, task: Callable[[Kept, Item], Result], item: Item, lost: Lost[Item, Result]
    ) -> Result:
        """Call a task in one process, which does nothing else meanwhile.

        If that process is lost, too, in a fresh one, because what others left in it may be the
        cause. Only where no process can be started is the task called here.
        """
        # The second process is fresh.
        for _ in range(2):
            if not self._starts_one():
                return task(self._kept, item)
            try:
                return self._started_pool(1).submit(_run, task, [item]).result()[0]
            except BrokenProcessPool as error:
                self._lost(error)
        if lost is None:
            raise BrokenProcessPool(f"{item!r:.200} ends each process that works on it")
        return lost(item)

    def _starts_one(self) -> bool:
        """Whether a process for single tasks is at work, or can be started."""
        if self._pool is None and not self._alone:
            try:
                self._started_pool(1).submit(os.getpid).result()
            except (BrokenProcessPool, OSError, EOFError) as error:
                self._lost(error)
                _LOG.warning("no process can be started; this one does the work: %s", error)
                self._alone = True
        return not self._alone

    def _lost(self, error: BaseException) -> None:
        """Forget a broken pool; from now on one process does each task by itself."""
        if not self._careful:
            _LOG.warning("a process was lost; from now on one does each task by itself: %s", error)
            self._careful = True
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
            self._pool = None
        if isinstance(error, BrokenProcessPool):
            self._kill()

    def _kill(self) -> None:
        """Kill what is left of a broken pool: it misses a process that it was just starting."""
        for process in self._started:
            if process.is_alive():
                process.kill()


def _context(started: list[BaseProcess]) -> BaseContext:
    """Return the context of new processes, which are also appended to a list."""
    whole: Any = multiprocessing.get_context(start_method())
    context: BaseContext = copy.copy(whole)

    def process(*arguments: Any, **options: Any) -> BaseProcess:
        started.append(whole.Process(*arguments, **options))
        return started[-1]

    setattr(context, "Process", process)  # noqa: B010 - a class there, a function here
    return context


_LOADED: dict[int, dict[str, str]] = {}
"""Id of this process, if it started a server of `preload_modules` -> environment of the server."""
_KEPT: list[Any] = []
"""In a started process: the first argument of all tasks."""


def _prepare(kept: object) -> None:
    # Ctrl-C reaches all processes of a terminal, but the parent ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # It would wait for tasks for ever where its parent is killed.
    threading.Thread(target=_await_parent, daemon=True).start()
    keep_memory()
    _KEPT[:] = [kept]


def _await_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def keep_memory() -> None:
    """Let the C library of this process keep the memory of freed arrays for new ones.

    Small tasks and scenes would otherwise spend much of their time on mapping it anew.
    """
    try:
        set_option = ctypes.CDLL(None).mallopt
    # Not glibc.
    except (OSError, TypeError, AttributeError):
        return
    for option, value in (_MMAP_THRESHOLD, _TRIM_THRESHOLD):
        set_option(option, value)


@contextmanager
def objects_frozen() -> Iterator[None]:
    """Exclude all existing objects from garbage collection within the context.

    Each collection would otherwise scan all loaded modules, for little garbage.
    Reference counting is not affected.
    """
    if gc.get_freeze_count():
        # Frozen by other code; unfreezing would also unfreeze its objects.
        yield
        return
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def _run(task: Callable[[Any, Item], Result], items: list[Item]) -> list[Result]:
    return [task(_KEPT[0], item) for item in items]


def _die_with(parent: int) -> None:
    """Let the kernel kill this server of `preload_modules` when its parent is killed.

    While it loads modules, for seconds, it does not see that its parent has gone.
    """
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        # It was killed before, for which no signal comes.
        os._exit(1)


# Who else imports this module has no parent to end with.
if _PARENT in os.environ:
    _die_with(int(os.environ.pop(_PARENT)))
