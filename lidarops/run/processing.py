"""Carry out a run: judge the days that changed, process what is stale, enter it in the ledger."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lidarops.campaign.model import Campaign
from lidarops.catalog import product_files
from lidarops.catalog.granules import joined_notes
from lidarops.catalog.lock import Lock
from lidarops.catalog.scan import ScanSummary
from lidarops.catalog.store import RunStatus, Store, Verdict
from lidarops.records import FileNote, Findings, Granule, RunRecord
from lidarops.run.clusters import local_client
from lidarops.run.day_states import REACH, Signature
from lidarops.run.executor import (
    EndedScene,
    StopRequest,
    process_jobs,
    read_bytes,
)
from lidarops.run.findings import find
from lidarops.run.leftovers import Orphan
from lidarops.run.options import Options, Result, Selection, unused
from lidarops.run.session import Session
from lidarops.run.staleness import DaysJudged, Judge, Judgement
from lidarops.scene.job import Job
from lidarops.system.processes import prefetch_one, preload_modules

if TYPE_CHECKING:
    from distributed import Client


MOST_FAILURES_IN_A_ROW = 5
"""The run stops after this many scenes in a row failed for a cause that may pass (a full disk)."""

_WORKER_MODULES: Final = (
    "distributed.nanny",
    "lidarops.run.executor",
    "lidarops.scene.processing",
    "lidarops.reports.gallery",
)
"""Modules that workers need, for scenes and then for the report."""


@dataclass(slots=True)
class Pass:
    """One pass over the days to judge, after the catalog was updated."""

    campaign: Campaign
    store: Store
    lock: Lock
    selection: Selection
    options: Options
    summary: ScanSummary
    days: Sequence[int]
    """To be judged."""
    signatures: Mapping[int, Signature]
    """Of all days."""
    judge: Judge = field(init=False)
    orphans: dict[str, Orphan] = field(default_factory=dict)
    """By path; this and what follows as it was judged last."""
    set_aside: dict[str, Granule] = field(default_factory=dict)
    """By path."""
    file_notes: list[FileNote] = field(default_factory=list)
    """Notes on files of the days that were judged, which the catalog does not know."""
    held: dict[str, Judgement] = field(default_factory=dict)
    """By scene."""
    frozen: dict[str, str] = field(default_factory=dict)
    """Product of a frozen period that would be replaced -> why."""
    empty_scenes: dict[str, str] = field(default_factory=dict)
    """Scene -> why it can give no product."""
    verdicts: dict[int, Verdict] = field(default_factory=dict)
    """Of days that are settled, without signature; of those in `open` only once all their scenes
    succeed."""
    open: dict[int, set[str]] = field(default_factory=lambda: defaultdict(set))
    """Days with stale products -> scenes."""
    judgements: dict[str, Judgement] = field(default_factory=dict)
    """Of the scenes that are yet to end."""
    suspects: list[Job] = field(default_factory=list)
    session: Session | None = None
    lost_worker: bool = False
    """Whether a worker died, or was abandoned at a stop."""
    months: bool = False
    """Whether months are processed now, or all other scenes, of whose products they are made."""
    reduced: set[int] = field(default_factory=set)
    """Days whose products may use a file that the processing has refused."""
    failing: int = 0
    """Number of scenes in a row that failed for a cause that may pass."""

    def carry_out(self, client: Client | None) -> Result:
        """Return what was done, and the state of the archive after it.

        Raises
        ------
        OvertakenError
            If another run has worked on the catalog since it was read.
        """
        self.judge = self._new_judge()
        days, signatures = self.days, self.signatures
        workers = self.options.workers
        clean = unused(self.store.verdicts(), signatures.keys() - set(days))
        self._forget(self.store.scenes_of_other_days(signatures))
        status, caught = RunStatus.FINISHED, 0
        if days:
            if workers > 1 and not self.options.cluster and client is None:
                # The modules load while this process judges the scenes.
                preload_modules(_WORKER_MODULES)
            with StopRequest() as stop:
                self._process(days, client, stop)
                self._process_reduced(signatures.keys(), client, stop)
                self._process_months(client, stop)
                caught = stop.signal
                if stop:
                    status = RunStatus.INTERRUPTED if caught else RunStatus.STOPPED
                    self.lost_worker = True
            self._settle(signatures, stopped=status is not RunStatus.FINISHED)
        self._clear_up()
        findings = find(
            self.judge,
            self.summary.idle_patterns,
            self.orphans.keys(),
            lost=self.judge.lost if days or self.campaign.acknowledged else None,
        )
        file_notes = (*findings.file_notes, *joined_notes(self.file_notes))
        findings = replace(findings, file_notes=file_notes)
        record = self._conclude(status, findings)
        return Result(
            record=record,
            status=status,
            summary=self.summary,
            orphans=tuple(self.orphans.values()),
            failures=self.store.failures(),
            internal=self.store.internal_errors(),
            # Orphans are never made again, so they would be reported for ever.
            unusable=tuple(self.store.unusable_scenes(without=self.orphans.keys())),
            empty_scenes=self.empty_scenes | clean[0],
            set_aside={path: granule.reason for path, granule in self.set_aside.items()} | clean[1],
            frozen=self.frozen,
            findings=findings,
            signal=caught,
        )

    def _new_judge(self, *, again: bool = False) -> Judge:
        force = self.options.force and not again
        thaw = self.options.thaw
        return Judge(self.campaign, self.store, selection=self.selection, force=force, thaw=thaw)

    # Processing

    def _process(self, days: Sequence[int], client: Client | None, stop: StopRequest) -> None:
        jobs = self._jobs(days, client, stop)
        first = next(jobs, None)
        if first is None and not self.suspects:
            return
        options = self.options
        with ExitStack() as stack:
            used_client = client
            if client is None and (options.cluster or options.workers > 1):
                # Take the lock first: another run may leave nothing to do.
                self.lock.acquire_unchanged()
                used_client = self._reached(self._started, stack, stop)
            taken = partial(self._take, note=used_client is None)
            if first is not None:
                others = chain([first], jobs)
                memory = None
                if options.memory is not None:
                    from dask.utils import parse_bytes  # noqa: PLC0415 - most runs have no limit

                    memory = int(parse_bytes(options.memory))
                ended = process_jobs(
                    others, client=used_client, stop=stop, taken=taken, memory=memory
                )
                self._enter(ended, stop)
            if self.suspects and not stop:
                if used_client is None:
                    own = partial(local_client, 1, memory=options.memory)
                    used_client = self._reached(own, stack, stop)
                if used_client is not None:
                    ended = process_jobs(
                        self.suspects, client=used_client, stop=stop, taken=self._take, alone=True
                    )
                    self._enter(ended, stop)

    def _process_reduced(
        self, known: Collection[int], client: Client | None, stop: StopRequest
    ) -> None:
        """Process what is stale without the refused files: other scenes or plans may follow."""
        notes = list(self.file_notes)
        while self.reduced and not stop:
            days = self.selection.days(sorted(self.reduced.intersection(known)))
            self.judge, self.reduced, self.suspects = self._new_judge(again=True), set(), []
            self._process(days, client, stop)
        self.file_notes = notes

    def _process_months(self, client: Client | None, stop: StopRequest) -> None:
        """Process the months of the days that were judged, whose products are as they stay."""
        days = self.selection.days(self.judge.months({*self.days, *self.open}))
        if days and not stop:
            notes = list(self.file_notes)
            self.judge, self.months, self.suspects = self._new_judge(), True, []
            self._process(days, client, stop)
            self.file_notes = notes

    def _reached(
        self,
        start: Callable[[], AbstractContextManager[Client]],
        stack: ExitStack,
        stop: StopRequest,
    ) -> Client | None:
        """Start or reach a cluster; None if a signal came first, which then ends the run."""
        # A queue may take an hour; a signal must not wait for it.
        if not stop:
            with stop.idle():
                client = stack.enter_context(start())
        if stop:
            self._running()
            return None
        return client

    def _started(self) -> AbstractContextManager[Client]:
        options = self.options
        if options.cluster:
            return options.cluster()
        return local_client(options.workers, memory=options.memory)

    def _enter(self, ended: Iterable[EndedScene], stop: StopRequest) -> None:
        session = self._running()
        for scene in ended:
            judged = self.judgements.pop(scene.outcome.scene)
            outcome = session.end(judged, scene.outcome, final=scene.final)
            self.lost_worker = self.lost_worker or scene.lost_worker
            if outcome.refused:
                self.reduced.update(range(judged.day - REACH, judged.day + REACH + 1))
            if not scene.refused:
                self.failing = self.failing + 1 if outcome.error and not scene.final else 0
            if self.failing >= MOST_FAILURES_IN_A_ROW:
                stop.now(
                    f"{MOST_FAILURES_IN_A_ROW} scenes in a row failed, the last: {outcome.error}"
                )
            if self.options.progress:
                self.options.progress(outcome)

    def _judged(self, days: Sequence[int], client: Client | None) -> Iterator[DaysJudged]:
        judged = map(self.judge.days, self.judge.batches(days))
        on_workers = client is not None or self.options.cluster or self.options.workers > 1
        # Judge ahead, so that workers do not wait.
        return prefetch_one(judged) if on_workers else judged

    def _jobs(self, days: Sequence[int], client: Client | None, stop: StopRequest) -> Iterator[Job]:
        """Yield the jobs of stale scenes, the largest of each group of days first."""
        for judged in self._judged(days, client):
            self._note(judged)
            due = []
            for scene in filter(attrgetter("due"), judged.judgements):
                self.open[scene.day].add(scene.scene.id)
                if bool(scene.scene.granules) != self.months:
                    self.judgements[scene.scene.id] = scene
                    due.append(scene)
            if self.options.expect:
                self.options.expect(sum(len(scene.scene.granules) for scene in due))
            unplanned = [
                EndedScene.failed(scene.failure, scene.scene, scene.plan)
                for scene in due
                if scene.failure and not scene.planned
            ]
            if unplanned:
                self._enter(unplanned, stop)
            jobs = [
                scene.job(self.campaign, self.options.profiles_per_chunk)
                for scene in due
                if scene.stale
            ]
            # A large scene at the end would keep one worker busy while the others idle.
            for job in sorted(jobs, key=read_bytes, reverse=True):
                if self.judgements[job.scene.id].suspect:
                    self.suspects.append(job)
                else:
                    yield job

    def _note(self, judged: DaysJudged) -> None:
        self.orphans |= {orphan.path: orphan for orphan in judged.orphans}
        self.set_aside |= {granule.path: granule for granule in judged.set_aside}
        self.file_notes += judged.file_notes
        self.verdicts.update(judged.verdicts)
        self.empty_scenes |= {
            one.scene.id: one.empty_reason for one in judged.judgements if one.empty_reason
        }
        for scene in judged.judgements:
            self.held.pop(scene.scene.id, None)
        self.held |= {scene.scene.id: scene for scene in judged.judgements if scene.held}
        self.frozen |= {
            stale.before.path: stale.reason
            for scene in judged.judgements
            for stale in scene.frozen
            if stale.before
        }
        if judged.digests or judged.touched or judged.gone:
            self.lock.acquire_unchanged()
            self.store.store_digests(judged.digests)
            self.store.touch_products(judged.touched)
            self._forget(judged.gone)

    def _forget(self, scenes: Collection[str]) -> None:
        if scenes:
            self.lock.acquire_unchanged()
            self.store.forget_scenes(scenes)

    def _take(self, job: Job, *, note: bool = False) -> None:
        self._running().take(self.judgements[job.scene.id], note=note)

    def _running(self) -> Session:
        if self.session is None:
            self.lock.acquire_unchanged()
            journal = self.options.journal
            self.session = Session(
                self.campaign, self.store, self.lock, self.judge, journal=journal
            )
            self.session.begin()
        return self.session

    # The end

    def _settle(self, signatures: Mapping[int, Signature], *, stopped: bool) -> None:
        """Record the days on which everything is fresh; they are not judged again until changed."""
        settled = _signed(signatures, self.verdicts, self.open)
        if self.open and self.selection.everything:
            judge = self._new_judge(again=True)
            after = judge.signatures(self.open)
            done = self.session.settled if self.session else set()
            other = {
                day
                for day, now in after.items()
                # Files, or products of its month, may have come or gone after its scenes ended.
                if day not in signatures
                or now.sources != signatures[day].sources
                or not self.open[day] <= done
            }
            settled |= _signed(after, self.verdicts, other)
            for batch in () if stopped else judge.batches(other):
                judged = judge.days(batch)
                # Of a forced scene that failed, the former products are fresh: the next run judges
                # its day, and forgets the failure.
                due = (one.day for one in judged.judgements if one.due)
                settled |= _signed(after, judged.verdicts, {*due, *judged.gone.values()})
        known = self.store.verdicts()
        new = {day: verdict for day, verdict in settled.items() if known.get(day) != verdict}
        if new:
            self.lock.acquire_unchanged()
            self.store.store_verdicts(new)

    def _clear_up(self) -> None:
        """Remove what a killed run left, if this one has not; another run may be at work."""
        output = Path(self.campaign.output)
        littered = self.store.has_dead_run() or product_files.is_littered(output, self.store)
        if self.session is None and littered:
            self.lock.acquire_unchanged()
            if product_files.sweep(output, self.store):
                self.store.close_runs(self.lock.token)

    def _conclude(self, status: RunStatus, findings: Findings) -> RunRecord | None:
        if self.session is None:
            return None
        for held in self.held.values():
            if held.failure:
                error = f"{held.failure.error} (not tried again, because nothing has changed)"
                outcome = held.failure.outcome(held.scene, held.plan)
                self.session.add(replace(outcome, error=error))
        return self.session.finish(
            status,
            findings,
            set_aside=self.set_aside.values(),
            empty_scenes=self.empty_scenes,
            frozen=self.frozen,
            lost_worker=self.lost_worker,
        )


def _signed(
    signatures: Mapping[int, Signature], verdicts: Mapping[int, Verdict], without: Collection[int]
) -> dict[int, Verdict]:
    """Return verdicts with the signatures of their days, without those on some days."""
    return {
        day: verdict._replace(signature=signatures[day].whole)
        for day, verdict in verdicts.items()
        if day in signatures and day not in without and signatures[day].whole
    }
