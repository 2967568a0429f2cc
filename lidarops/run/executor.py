"""Process jobs, in this process or on a dask cluster.

No scene stops the others, neither by an error nor by the death of its worker.
"""

from __future__ import annotations

import faulthandler
import logging
import math
import pickle
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import FrameType
from typing import TYPE_CHECKING, Any, Final, Self

from lidarops.errors import SceneError
from lidarops.records import Plan, Scene, SceneOutcome
from lidarops.run.clusters import WORKER_TIMEOUT, ClusterError
from lidarops.scene.job import Failure, Job, guarded, scene_memory
from lidarops.system.code_version import joint_code_version
from lidarops.system.processes import keep_memory

if TYPE_CHECKING:
    from distributed import Client
    from distributed import Future as AnyFuture

    Future = AnyFuture[Any]

SCENES_PER_THREAD: Final = 2
"""Scenes submitted per worker thread, including the one in work."""
LEAST_SCENES_AHEAD: Final = 4
"""Least number of scenes submitted to a cluster."""
RECOUNT_INTERVAL: Final = 5.0
"""s between counts of the threads of a cluster, which may grow and shrink."""
START_DELAY: Final = 1.0
"""s before a new worker gets a scene that may kill it: dask replaces no worker that dies before its
nanny, which polls every few hundredths of a second, has seen it running."""
GRACE_PERIOD: Final = 20.0
"""s that running scenes get to end on a cluster after a request to stop."""
LEAST_TIME: Final = 600.0
"""s that a scene may take on a cluster; assumed."""
TIME_OF_A_BYTE: Final = 2e-6
"""s more for each byte of its files: hundreds of times what is measured."""
MOST_TRIES: Final = 3
"""A scene that kills its worker this often is refused."""
USABLE: Final = 0.9
"""Share of a limit that a scene may use; dask ends a worker at 0.95."""

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class EndedScene:
    """A scene that has ended."""

    outcome: SceneOutcome
    final: bool
    """Whether another try on the same inputs would end the same way."""
    refused: bool = False
    """Whether it was not read, because it does not fit into the memory limit."""
    lost_worker: bool = False
    """Whether a worker died of it, which may have left half a file."""

    @classmethod
    def failed(cls, failure: Failure, scene: Scene, plan: Plan) -> Self:
        """Return a scene that gave no product."""
        return cls(failure.outcome(scene, plan), failure.final)


class StopRequest:
    """A request to stop, by a signal or by a call of `now`.

    After the first SIGINT or SIGTERM running scenes may end; the second abandons them. Within
    `idle` no scene is running, and the first signal interrupts at once.
    """

    def __init__(self) -> None:
        self.reason = ""
        self.signal = 0
        self._before: dict[int, Any] = {}
        self._idle = False

    def __bool__(self) -> bool:
        return bool(self.reason)

    def now(self, reason: str) -> None:
        """Request to stop."""
        self.reason = self.reason or reason

    @contextmanager
    def idle(self) -> Iterator[None]:
        """Let a signal interrupt the body, while no scene is running.

        The caller checks afterwards whether a stop was requested.
        """
        self._idle = True
        try:
            yield
        except KeyboardInterrupt:
            # Re-raised, it would end the process like Ctrl-C, whatever the signal was.
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
            _LOG.warning("%s: no scene is running", self.reason)
            raise KeyboardInterrupt
        _LOG.warning("%s: running scenes may end; signal again to abandon them", self.reason)


def process_jobs(
    jobs: Iterable[Job],
    *,
    client: Client | None = None,
    stop: StopRequest | None = None,
    taken: Callable[[Job], None] | None = None,
    memory: int | None = None,
    alone: bool = False,
) -> Iterator[EndedScene]:
    """Process jobs and yield the scenes in the order in which they end.

    Parameters
    ----------
    jobs : iterable of Job
        Consumed one by one, only a few more than there are workers.
    client : distributed.Client, optional
        Cluster to run on; None processes in this process.
    stop : StopRequest, optional
        Checked before every scene.
    taken : callable, optional
        Called with a job before it starts.
    memory : int, optional
        Bytes that this process may use; workers have limits of their own.
    alone : bool, optional
        Whether scenes may kill their worker: on a cluster only one runs at a time, to know which
        one does. A scene that kills its worker every time ends as failed.

    Yields
    ------
    EndedScene
    """
    stop = StopRequest() if stop is None else stop
    started = _started(jobs, stop, taken)
    if client is not None:
        cluster = _ClusterQueue(client, stop)
        yield from cluster.one_by_one(started) if alone else cluster.all_at_once(started)
        return
    keep_memory()
    for job in started:
        yield EndedScene(*_attempt(job, memory))


def _started(
    jobs: Iterable[Job], stop: StopRequest, taken: Callable[[Job], None] | None
) -> Iterator[Job]:
    """Yield the jobs that start, each once, however often it is tried."""
    for job in jobs:
        if stop:
            return
        if taken:
            taken(job)
        yield job


def fitted(job: Job, limit: int | None) -> Job:
    """Return a job with chunks that fit into a limit; results do not depend on chunks.

    Parameters
    ----------
    job : Job
        Unchanged where it states the profiles of a chunk.
    limit : int or None
        Bytes of the process; None for no limit.

    Raises
    ------
    SceneError
        If the scene does not fit even with one profile in a chunk.
    """
    if limit is None or job.profiles_per_chunk is not None:
        return job
    memory = scene_memory(job.scene, job.plan)
    if memory.total <= USABLE * limit:
        return job
    profiles = memory.profiles_within(USABLE * limit)
    if not profiles:
        raise SceneError(
            f"needs about {_size(memory.of(1))} of memory even with one profile in a chunk"
            f" ({_size(memory.process)} for the process, {_size(memory.held)} held for the whole"
            f" scene); {USABLE:.0%} of the limit of {_size(limit)} may be used",
            remedy="raise --memory-limit, or the limit of the workers, to"
            f" {_size(memory.of(1) / USABLE)}; or give a shorter window of scenes or longer"
            " averaging intervals in the campaign file; --profiles-per-chunk 1 tries it"
            " nevertheless",
        )
    return replace(job, profiles_per_chunk=profiles)


def _size(memory: float) -> str:
    return f"{memory / 1e6:.0f} MB"


def attempt(job: Job) -> tuple[SceneOutcome, bool]:
    """Process a scene; see `lidarops.scene.processing.attempt`."""
    # It loads the libraries of arrays and files, which a run with nothing to do does not need.
    from lidarops.scene import processing  # noqa: PLC0415

    return processing.attempt(job)


def _attempt(job: Job, memory: int | None) -> tuple[SceneOutcome, bool, bool]:
    """Process a scene within a memory limit; return the outcome as `EndedScene` states it."""
    fit = guarded(lambda: fitted(job, memory))
    if isinstance(fit, Failure):
        # With a larger limit it may be processed.
        return fit.outcome(job.scene, job.plan), bool(fit.internal), not fit.internal
    return *attempt(fit), False


def time_limit(job: Job) -> float:
    """Return after how many s a worker is ended with the scene of a job."""
    stated = job.campaign.scenes.time_limit
    if stated is not None:
        return stated.total_seconds()
    files = (*job.scene.granules, *job.scene.dark)
    return LEAST_TIME + TIME_OF_A_BYTE * sum(file.size for file in files)


def _submit(client: Client, job: Job) -> Future:
    # As bytes: the scheduler would unpickle and pickle a job.
    arguments = (pickle.dumps(job), joint_code_version(), time_limit(job))
    return client.submit(_on_worker, *arguments, pure=False)


def _on_worker(pickled: bytes, code: str, seconds: float) -> tuple[SceneOutcome, bool, bool] | str:
    """Process a scene; return how it ended, or why it was not tried."""
    from distributed import get_worker  # noqa: PLC0415 - takes a second to import

    # First, because other code may not be able to unpickle the job.
    if joint_code_version() != code:
        return f"the worker has other code of lidarops: {joint_code_version()}, not {code}"
    job: Job = pickle.loads(pickled)  # noqa: S301 - from the process that started this scene
    # Ends a process that takes longer, with the tracebacks of its threads. Not by a thread of
    # Python, which would wait for a library that holds the interpreter.
    faulthandler.dump_traceback_later(seconds, exit=True)
    try:
        return _attempt(job, get_worker().memory_manager.memory_limit)
    finally:
        faulthandler.cancel_dump_traceback_later()


class _Workers:
    """Counts the threads of a cluster, which may grow, shrink or be lost."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._threads = 0
        self._recount = -math.inf
        self._missing_since: float | None = None

    def count(self) -> int:
        """Return the number of threads, counted at most every `RECOUNT_INTERVAL`."""
        now = time.monotonic()
        if now >= self._recount:
            try:
                self._threads = sum(self._client.nthreads().values())
            except OSError as gone:
                raise _scheduler_lost() from gone
            self._recount = now + RECOUNT_INTERVAL
            self._check_missing(now)
        return self._threads

    def ready(self, stop: StopRequest) -> None:
        """Wait for a worker that dask would replace if it died."""
        while not stop:
            self._recount = -math.inf
            if self.count():
                break
            time.sleep(0.1)
        time.sleep(START_DELAY)

    def _check_missing(self, now: float) -> None:
        if self._threads:
            self._missing_since = None
        # Time counts from this first miss: the last count may be long ago.
        elif self._missing_since is None:
            self._missing_since = now
        elif now - self._missing_since > WORKER_TIMEOUT:
            self._missing_since = now
            from distributed import LocalCluster  # noqa: PLC0415 - takes a second to import

            if isinstance(self._client.cluster, LocalCluster):
                raise ClusterError(
                    "the workers on this machine are gone, and none replaces them",
                    remedy="find out what ended them, and run again: finished scenes are kept",
                )
            _LOG.warning("there is no worker: scenes wait for one")


class _ClusterQueue:
    """Keeps a cluster busy with a few scenes per worker, whatever the number of scenes."""

    def __init__(self, client: Client, stop: StopRequest) -> None:
        self._client = client
        self._stop = stop
        self._done: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._running: dict[Future, Job] = {}
        self._suspects: list[Job] = []
        self._workers = _Workers(client)

    def all_at_once(self, jobs: Iterable[Job]) -> Iterator[EndedScene]:
        yield from self._ended(iter(jobs))
        # Those whose worker died: another scene on it may be the cause.
        suspects, self._suspects = self._suspects, []
        for ended in self.one_by_one(suspects):
            yield replace(ended, lost_worker=True)

    def one_by_one(self, jobs: Iterable[Job]) -> Iterator[EndedScene]:
        for job in jobs:
            ended = self._alone(job)
            if ended is None:
                return
            yield ended

    def _alone(self, job: Job) -> EndedScene | None:
        """Return how a scene ends that no other may disturb; None where a stop was requested."""
        limit = time_limit(job)
        for tries in range(MOST_TRIES):
            self._workers.ready(self._stop)
            begin = time.monotonic()
            ended = [] if self._stop else list(self._ended(iter([job])))
            if ended:
                return replace(ended[0], lost_worker=tries > 0)
            if self._stop:
                return None
            if time.monotonic() - begin >= limit:
                words = f"takes longer than {limit:.0f} s, the time_limit of scenes"
                failure = Failure(words, final=False)
                break
        else:
            failure = Failure(
                f"its worker died {MOST_TRIES} times: too little memory, or a damaged file"
            )
        return replace(EndedScene.failed(failure, job.scene, job.plan), lost_worker=True)

    def _ended(self, source: Iterator[Job]) -> Iterator[EndedScene]:
        self._fill(source)
        stop_requested = None
        while self._running:
            if self._stop:
                stop_requested = stop_requested or time.monotonic()
                if time.monotonic() - stop_requested > GRACE_PERIOD:
                    self._client.cancel(list(self._running), force=True)
                    return
            try:
                future = self._done.get(timeout=0.2)
            except queue.Empty:
                # More workers may have joined.
                self._fill(source)
                continue
            job = self._running.pop(future)
            # First, so that no worker waits while the outcome is entered in the ledger.
            self._fill(source)
            ended = _outcome_of(future, job)
            future.release()
            if ended is None:
                _LOG.warning("scene %s: its worker died", job.scene.id)
                self._suspects.append(job)
            else:
                yield ended

    def _fill(self, source: Iterator[Job]) -> None:
        room = max(LEAST_SCENES_AHEAD, SCENES_PER_THREAD * self._workers.count())
        while len(self._running) < room and not self._stop:
            job = next(source, None)
            if job is None:
                return
            future = _submit(self._client, job)
            self._running[future] = job
            future.add_done_callback(self._done.put)


def _outcome_of(future: Future, job: Job) -> EndedScene | None:
    """Return how a scene ended, or None if its worker died."""
    from concurrent.futures import CancelledError  # noqa: PLC0415 - used where it is caught

    from distributed import KilledWorker  # noqa: PLC0415 - takes a second to import

    try:
        error = None if future.status == "finished" else future.exception()
        if isinstance(error, CancelledError):
            raise error
    except CancelledError as gone:
        raise _scheduler_lost() from gone
    if error is None:
        result = future.result()
        if not isinstance(result, str):
            return EndedScene(*result)
        failure = Failure(result, final=False)
    elif isinstance(error, KilledWorker):
        return None
    elif isinstance(error, OSError | ImportError | MemoryError):
        failure = Failure(f"the worker failed: {error!r}", final=False)
    else:
        failure = Failure.of_bug(error.with_traceback(future.traceback()), final=False)
    return EndedScene.failed(failure, job.scene, job.plan)


def _scheduler_lost() -> ClusterError:
    return ClusterError(
        "the dask scheduler is gone, and with it the running scenes",
        remedy="run again: finished scenes are kept",
    )
