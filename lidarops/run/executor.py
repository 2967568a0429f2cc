"""Run many scenes, serially or on a dask cluster.

Nothing that happens to one scene stops the others: not an error, not the death of its worker.
"""

from __future__ import annotations

import logging
import math
import pickle
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import TYPE_CHECKING, Any, Final, Self

from lidarops.errors import SceneError
from lidarops.netcdf.provenance import code_version
from lidarops.process.scene import Job, attempt, failed
from lidarops.records import SceneOutcome
from lidarops.run import worker
from lidarops.system.processes import keep_memory, start_method

if TYPE_CHECKING:
    from distributed import Client
    from distributed import Future as AnyFuture

    Future = AnyFuture[Any]

AHEAD: Final = 2
"""Scenes a worker thread has at hand, the one that it works on included."""
LEAST_AHEAD: Final = 4
RECOUNT: Final = 5.0
"""s after which the threads of a cluster, which may grow and shrink, are counted anew."""
PATIENCE: Final = 120.0
"""s without any worker after which one is missed: on this machine, where none will come, for good.
"""
FIRM: Final = 1.0
"""s that a new worker is left without a scene that may take it down: dask starts no other for one
that dies before its nanny, which looks every few hundredths of a second, has seen that it runs."""
GRACE: Final = 20.0
"""s that scenes in hand get to end, on a cluster that is asked to stop."""
TRIES: Final = 3
"""Times that a scene may take its worker down before it is refused."""
TRIMMING: Final = "MALLOC_TRIM_THRESHOLD_"
"""Variable by which dask has the C library give back small pieces of memory at once."""
_DASK: Final = {
    # Every death of a worker is to be seen here, where it is counted for its scene alone.
    "distributed.scheduler.allowed-failures": 0,
    # Every process would wake a hundred times a second to sample stacks, for a page that is not
    # served, and fifty times to look how late it is.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "500ms",
    # Each process would read a dozen files of the system twice a second, for the same page.
    "distributed.admin.system-monitor.interval": "10s",
    # With it every array is mapped and given back for itself: a sixth of the time of small scenes.
    f"distributed.nanny.pre-spawn-environ.{TRIMMING}": None,
}

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Ended:
    """A scene that ended."""

    job: Job
    outcome: SceneOutcome
    final: bool
    """Whether another try on the same inputs cannot but end like this."""


class Stop:
    """A wish to stop: by signal, or by whoever calls `now`.

    The first SIGINT or SIGTERM lets scenes in hand end; the second abandons them. Where none is in
    hand, as told by `idle`, the first one breaks off at once.
    """

    def __init__(self) -> None:
        self.reason = ""
        self.signal = 0
        self._before: dict[int, Any] = {}
        self._idle = False

    def __bool__(self) -> bool:
        return bool(self.reason)

    def now(self, reason: str) -> None:
        """Ask to stop."""
        self.reason = self.reason or reason

    @contextmanager
    def idle(self) -> Iterator[None]:
        """Let a signal break off what is done within: no scene is in hand that is to end first.

        Whoever calls looks afterwards whether it came to that.
        """
        self._idle = True
        try:
            yield
        except KeyboardInterrupt:
            # Raised on, it would end the process as Ctrl-C does, whatever the signal was.
            if not self.signal:
                raise
        finally:
            self._idle = False

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._caught)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _caught(self, number: int, _frame: FrameType | None) -> None:
        if self.signal:
            raise KeyboardInterrupt
        self.signal = number
        self.now(f"stopped by {signal.Signals(number).name}")
        if self._idle:
            _LOG.warning("%s: no scene is in hand", self.reason)
            raise KeyboardInterrupt
        _LOG.warning("%s: scenes in hand are ended; once more to abandon them", self.reason)


def read_bytes(job: Job) -> int:
    """Return the bytes that a job reads."""
    return sum(granule.size for granule in job.scene.granules)


@contextmanager
def local_client(workers: int, *, memory: str | None = None) -> Iterator[Client]:
    """Start a dask cluster of single-threaded processes on this machine.

    netCDF4 writes from one thread of a process only, and BLAS and numba gain nothing from more.

    Parameters
    ----------
    workers : int
    memory : str, optional
        Most memory of a worker, such as ``2GiB``; an equal share of the machine's where not
        given. A worker that needs more is restarted, and its scene tried again.
    """
    import dask  # noqa: PLC0415 - takes a second to import
    from distributed import Client, LocalCluster  # noqa: PLC0415 - takes a second to import

    started = {"distributed.worker.multiprocessing-method": start_method()}
    with (
        worker.quiet(),
        dask.config.set({**_DASK, **started}),
        LocalCluster(
            # A signal while they start would leave a cluster that nobody can close.
            n_workers=0,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
            # Without a dashboard dask still answers by HTTP, on a port of all interfaces.
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
            memory_limit=memory or "auto",
            preload=worker.__name__,
        ) as cluster,
        Client(cluster) as client,
    ):
        cluster.scale(workers)
        _await_workers(client, workers)
        yield client


def _await_workers(client: Client, workers: int) -> None:
    """Wait for workers that are starting; fewer are better than none."""
    try:
        client.wait_for_workers(workers, timeout=PATIENCE)
    except TimeoutError as error:
        there = len(client.nthreads())
        if not there:
            raise SceneError(
                f"no worker has started within {PATIENCE:.0f} s",
                remedy="give more memory to each, or ask for fewer",
            ) from error
        _LOG.warning("%d of %d workers have started within %.0f s", there, workers, PATIENCE)


def process_jobs(
    jobs: Iterable[Job],
    *,
    client: Client | None = None,
    stop: Stop | None = None,
    taken: Callable[[Job], None] | None = None,
) -> Iterator[Ended]:
    """Process scenes as they come, in the order in which they end.

    Parameters
    ----------
    jobs : iterable of Job
        Taken one by one, never many more than there are workers.
    client : distributed.Client, optional
        A cluster; in this process where None.
    stop : Stop, optional
        Asked before every scene.
    taken : callable, optional
        Called with a job before it starts.

    Yields
    ------
    Ended
    """
    # A wish that nobody has had yet is false.
    stop = Stop() if stop is None else stop
    if client is None:
        yield from _serial(jobs, stop, taken)
    else:
        yield from _Window(client, stop, taken).run(jobs)


def _serial(
    jobs: Iterable[Job], stop: Stop, taken: Callable[[Job], None] | None
) -> Iterator[Ended]:
    keep_memory()
    for job in jobs:
        if stop:
            return
        if taken:
            taken(job)
        yield Ended(job, *attempt(job))


def alone(jobs: Sequence[Job], *, client: Client, stop: Stop) -> Iterator[Ended]:
    """Process scenes that may take their worker down: one at a time, so that it is known which.

    Parameters
    ----------
    jobs : sequence of Job
    client : distributed.Client
    stop : Stop

    Yields
    ------
    Ended
        A scene that takes its worker down every time ends as failed, by name.
    """
    staff = _Staff(client)
    for job in jobs:
        for _ in range(TRIES):
            staff.ready(stop)
            if stop:
                return
            future = _submitted(client, job)
            _wait(future, staff)
            ended = _ended(future, job)
            future.release()
            if ended is not None:
                yield ended
                break
        else:
            reason = f"its worker died {TRIES} times: too little memory, or a damaged file"
            yield Ended(job, failed(job, reason), final=True)


def _submitted(client: Client, job: Job) -> Future:
    # As bytes, which the scheduler hands on: a job it would unpickle and pickle again.
    return client.submit(_on_worker, pickle.dumps(job), code_version(), pure=False)


def _on_worker(pickled: bytes, code: str) -> tuple[SceneOutcome, bool] | str:
    """Process a scene; return its outcome and whether it is final, or why it cannot be tried."""
    # First, as other code may know other jobs.
    if code_version() != code:
        return f"the worker has other code of lidarops: {code_version()}, not {code}"
    job: Job = pickle.loads(pickled)  # noqa: S301 - from the process that started this scene
    return attempt(job)


def _wait(future: Future, staff: _Staff) -> None:
    """Wait for a scene to end, while there is somebody who may end it."""
    done: queue.SimpleQueue[Future] = queue.SimpleQueue()
    future.add_done_callback(done.put)
    while True:
        staff.count()
        try:
            done.get(timeout=RECOUNT)
        except queue.Empty:
            continue
        return


class _Staff:
    """The threads of a cluster, which may grow in number, shrink, or be gone for good."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._threads = 0
        self._recount = -math.inf
        self._missed_since: float | None = None

    def count(self) -> int:
        """Return their number, counted anew where that was not done just now."""
        now = time.monotonic()
        if now >= self._recount:
            try:
                self._threads = sum(self._client.nthreads().values())
            except OSError as gone:
                raise _lost() from gone
            self._recount = now + RECOUNT
            self._miss(now)
        return self._threads

    def ready(self, stop: Stop) -> None:
        """Wait for a worker, and until another one would take its place."""
        while not stop:
            self._recount = -math.inf
            if self.count():
                break
            time.sleep(0.1)
        time.sleep(FIRM)

    def _miss(self, now: float) -> None:
        if self._threads:
            self._missed_since = None
        # From the first count on, as the last one may lie far back.
        elif self._missed_since is None:
            self._missed_since = now
        elif now - self._missed_since > PATIENCE:
            self._missed_since = now
            if _is_local(self._client):
                raise SceneError(
                    "the workers on this machine are gone, and none takes their place",
                    remedy="see what ended them, and run again: what is done stays done",
                )
            _LOG.warning("no worker is there: scenes wait for one")


class _Window:
    """Keeps a cluster busy with a few scenes a worker, whatever the number of scenes."""

    def __init__(self, client: Client, stop: Stop, taken: Callable[[Job], None] | None) -> None:
        self._client = client
        self._stop = stop
        self._taken = taken
        self._done: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._at_work: dict[Future, Job] = {}
        self._suspects: list[Job] = []
        self._staff = _Staff(client)

    def run(self, jobs: Iterable[Job]) -> Iterator[Ended]:
        source = iter(jobs)
        self._fill(source)
        asked = None
        while self._at_work:
            if self._stop:
                asked = asked or time.monotonic()
                if time.monotonic() - asked > GRACE:
                    self._client.cancel(list(self._at_work), force=True)
                    return
            try:
                future = self._done.get(timeout=0.2)
            except queue.Empty:
                # There may be more workers by now.
                self._fill(source)
                continue
            job = self._at_work.pop(future)
            # First, so that no worker waits while the outcome is entered.
            self._fill(source)
            ended = _ended(future, job)
            future.release()
            if ended is None:
                _LOG.warning("scene %s: its worker died", job.scene.id)
                self._suspects.append(job)
            else:
                yield ended
        yield from alone(self._suspects, client=self._client, stop=self._stop)

    def _fill(self, source: Iterator[Job]) -> None:
        room = max(LEAST_AHEAD, AHEAD * self._staff.count())
        while len(self._at_work) < room and not self._stop:
            job = next(source, None)
            if job is None:
                return
            if self._taken:
                self._taken(job)
            future = _submitted(self._client, job)
            self._at_work[future] = job
            future.add_done_callback(self._done.put)


def _is_local(client: Client) -> bool:
    from distributed import LocalCluster  # noqa: PLC0415 - takes a second to import

    return isinstance(client.cluster, LocalCluster)


def _ended(future: Future, job: Job) -> Ended | None:
    """Return how a scene ended, or None where its worker died."""
    from distributed import KilledWorker  # noqa: PLC0415 - takes a second to import

    error = None if future.status == "finished" else _error_of(future)
    if error is None:
        found = future.result()
        if isinstance(found, str):
            return Ended(job, failed(job, found), final=False)
        return Ended(job, *found)
    if isinstance(error, KilledWorker):
        return None
    return Ended(job, failed(job, f"the worker failed: {error!r}"), final=False)


def _error_of(future: Future) -> BaseException | None:
    from concurrent.futures import CancelledError  # noqa: PLC0415 - used where it is caught

    try:
        error: BaseException | None = future.exception()
    except CancelledError as gone:
        raise _lost() from gone
    if isinstance(error, CancelledError):
        raise _lost() from error
    return error


def _lost() -> SceneError:
    return SceneError(
        "the dask scheduler is gone, and with it the scenes in hand",
        remedy="run again: what is done stays done",
    )
