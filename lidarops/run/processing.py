"""Carry out a run: judge the days that changed, process what is stale, enter it in the ledger."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from itertools import chain, islice
from typing import TYPE_CHECKING, Final

from lidarops.catalog.granules import joined_notes
from lidarops.catalog.lock import Lock
from lidarops.catalog.raw_files import acknowledged, acknowledged_reasons
from lidarops.catalog.scan import ScanSummary
from lidarops.catalog.store import RunStatus, Verdict
from lidarops.records import FileNote, SceneOutcome
from lidarops.run.clusters import local_client
from lidarops.run.day_states import REACH, DayStates, Signature
from lidarops.run.executor import EndedScene, StopRequest, process_jobs
from lidarops.run.findings import find
from lidarops.run.ledger_run import JudgedDays, LedgerRun
from lidarops.run.options import MOST_OF_A_BATCH, Options, Result, unused
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


class Pass:
    """One pass over the days to judge, after the catalog was updated.

    Parameters
    ----------
    states : DayStates
        Since which no file was refused.
    lock : Lock
    options : Options
    summary : ScanSummary
    days : sequence of int
        To be judged.
    signatures : mapping of int to Signature
        Of all days.
    known : mapping of int to Verdict
        Verdicts before the pass.
    """

    def __init__(
        self,
        states: DayStates,
        lock: Lock,
        options: Options,
        summary: ScanSummary,
        days: Sequence[int],
        signatures: Mapping[int, Signature],
        known: Mapping[int, Verdict],
    ) -> None:
        campaign, self.store = states.campaign, states.store
        self.campaign, self.states, self.lock, self.options = campaign, states, lock, options
        self.summary = summary
        self.days, self.signatures, self.known = days, signatures, known
        self.run = LedgerRun(campaign, self.store, lock, journal=options.journal)
        self.told = JudgedDays()
        self.stop = StopRequest()
        self.reduced: set[int] = set()
        """Days whose products may use a file that the processing has refused."""
        self.judge = self._new_judge()
        self.file_notes: list[FileNote] = []
        """Notes on files of the days that were judged, which the catalog does not know."""
        self.judgements: dict[str, Judgement] = {}
        """Of the scenes that are yet to end."""
        self.suspects: list[Job] = []
        self.lost_worker = False
        """Whether a worker died, or was abandoned at a stop."""
        self.again = self.months = False
        """Whether days are judged again, and whether for their months."""
        self.failing = 0
        """Number of scenes in a row that failed for a cause that may pass."""
        self.on_workers = bool(options.cluster or options.dashboard) or options.workers > 1

    def carry_out(self) -> Result:
        """Return what was done, and the state of the archive after it.

        Raises
        ------
        OvertakenError
            If another run has worked on the catalog since it was read.
        """
        options, told = self.options, self.told
        clean = unused(self.known, self.signatures.keys() - set(self.days))
        gone = self.store.scenes_of_other_days(self.signatures)
        if gone:
            self.lock.acquire_unchanged()
            self.store.forget_scenes(gone)
        status = RunStatus.FINISHED
        if self.days:
            if options.workers > 1 and not options.cluster:
                # The modules load while this process judges the scenes.
                preload_modules(_WORKER_MODULES)
            with self.stop as stop:
                for days in self._rounds():
                    self._process(days)
                if stop:
                    status = RunStatus.INTERRUPTED if stop.signal else RunStatus.STOPPED
                    self.lost_worker = True
            self._settle(stopped=status is not RunStatus.FINISHED)
        self.run.clear_up(lost_worker=self.lost_worker)
        findings = find(
            self.judge,
            self.summary.idle_patterns,
            told.orphans.keys(),
            lost=self.judge.lost if self.days or self.campaign.acknowledged else None,
        )
        file_notes = (*findings.file_notes, *joined_notes(self.file_notes))
        findings = replace(findings, file_notes=file_notes)
        record = self.run.conclude(status, findings, told)
        set_aside = {path: granule.reason for path, granule in told.set_aside.items()} | clean[1]
        return Result(
            record=record,
            status=status,
            summary=self.summary,
            orphans=tuple(told.orphans.values()),
            failures=self.store.failures(),
            internal=self.store.failures(internal=True),
            # Orphans are never made again, so they would be reported for ever.
            unusable=tuple(self.store.unusable_scenes(without=told.orphans.keys())),
            empty_scenes=told.empty_scenes | clean[0],
            set_aside=acknowledged_reasons(self.campaign, set_aside),
            frozen=told.frozen,
            findings=findings,
            refused=() if record else acknowledged(self.campaign, self.store.refused()),
            signal=self.stop.signal,
        )

    def _new_judge(self, *, force: bool = True) -> Judge:
        return Judge(
            self.campaign,
            self.store,
            selection=self.states.selection,
            force=force and self.options.force,
            thaw=self.options.thaw,
            known=None if self.reduced else self.states,
        )

    def _rounds(self) -> Iterator[Sequence[int]]:
        """Yield days to judge: all; those of refused files; months, whose products then stay."""
        yield self.days
        self.again, selection = True, self.states.selection
        while self.reduced and not self.stop:
            # Without the refused files, other scenes or plans may follow.
            days = selection.days(sorted(self.reduced.intersection(self.signatures)))
            self.states = self.judge = self._new_judge(force=False)
            self.reduced, self.suspects = set(), []
            yield days
        days = selection.days(self.judge.months({*self.days, *self.told.open}))
        if days and not self.stop:
            self.judge, self.months, self.suspects = self._new_judge(), True, []
            yield days

    def _process(self, days: Sequence[int]) -> None:
        """Process the stale scenes of some days; at the end those that may kill their worker."""
        jobs = self._jobs(days)
        first = next(jobs, None)
        if first is None and not self.suspects:
            return
        with ExitStack() as stack:
            client = None
            if self.on_workers:
                # Take the lock first: another run may leave nothing to do.
                self.lock.acquire_unchanged()
                client = self._cluster(stack, self.options.workers)
            if first is not None:
                self._make(chain([first], jobs), client)
            if self.suspects and not self.stop:
                client = client or self._cluster(stack, 1)
                if client is not None:
                    self._make(self.suspects, client, alone=True)

    def _make(self, jobs: Iterable[Job], client: Client | None, *, alone: bool = False) -> None:
        """Carry out jobs, here where there is no cluster, and enter them as they end."""
        memory = None
        if self.options.memory is not None:
            from dask.utils import parse_bytes  # noqa: PLC0415 - most runs have no limit

            memory = int(parse_bytes(self.options.memory))
        ended = process_jobs(
            jobs,
            client=client,
            stop=self.stop,
            taken=lambda job: self.run.take(self.judgements[job.scene.id], note=client is None),
            memory=memory,
            alone=alone,
        )
        # Between batches, a cluster is as busy as within one.
        carry_out = partial(self._enter, ended, MOST_OF_A_BATCH)
        while self.options.batch(carry_out) == MOST_OF_A_BATCH:
            pass

    def _cluster(self, stack: ExitStack, workers: int) -> Client | None:
        """Start or reach a cluster; None if a signal came first, which then ends the run."""
        options = self.options
        served = options.dashboard is not None
        start = options.cluster or partial(
            local_client, workers, memory=options.memory, dashboard=served
        )
        client = None
        # A queue may take an hour; a signal must not wait for it.
        if not self.stop:
            with self.stop.idle():
                client = stack.enter_context(start())
            if options.dashboard and client is not None:
                options.dashboard(f"dashboard: {client.dashboard_link}")
        if self.stop:
            self.run.begin()
            return None
        return client

    def _enter(self, ended: Iterable[EndedScene], most: int | None = None) -> list[SceneOutcome]:
        self.run.begin()
        outcomes = []
        for scene in islice(ended, most):
            judged = self.judgements.pop(scene.outcome.scene)
            outcome = self.run.end(self.judge, judged, scene.outcome, final=scene.final)
            self.lost_worker = self.lost_worker or scene.lost_worker
            if outcome.refused:
                self.reduced.update(range(judged.day - REACH, judged.day + REACH + 1))
            if not scene.refused:
                self.failing = self.failing + 1 if outcome.error and not scene.final else 0
            if self.failing >= MOST_FAILURES_IN_A_ROW:
                self.stop.now(
                    f"{MOST_FAILURES_IN_A_ROW} scenes in a row failed, the last: {outcome.error}"
                )
            if self.options.progress:
                self.options.progress(outcome)
            outcomes.append(outcome)
        return outcomes

    def _jobs(self, days: Sequence[int]) -> Iterator[Job]:
        """Yield the jobs of stale scenes, the largest of each group of days first."""
        groups = map(self.judge.days, self.judge.batches(days))
        # Judge ahead, so that workers do not wait.
        for judged in prefetch_one(groups) if self.on_workers else groups:
            self._note(judged)
            due = [
                scene
                for scene in judged.judgements
                if scene.due and bool(scene.scene.granules) != self.months
            ]
            self.judgements |= {scene.scene.id: scene for scene in due}
            if self.options.expect:
                self.options.expect(sum(len(scene.scene.granules) for scene in due))
            unplanned = [
                EndedScene.failed(scene.failure, scene.scene, scene.plan)
                for scene in due
                if scene.failure and not scene.planned
            ]
            if unplanned:
                self._enter(unplanned)
            jobs = [
                scene.job(self.campaign, self.options.profiles_per_chunk)
                for scene in due
                if scene.stale
            ]
            # A large scene at the end would keep one worker busy while the others idle.
            jobs.sort(key=lambda job: -sum(granule.size for granule in job.scene.granules))
            for job in jobs:
                if self.judgements[job.scene.id].suspect:
                    self.suspects.append(job)
                else:
                    yield job

    def _note(self, judged: DaysJudged) -> None:
        self.told.note(judged)
        if not self.again:
            self.file_notes += judged.file_notes
        if judged.digests or judged.touched or judged.gone:
            self.lock.acquire_unchanged()
            self.store.store_digests(judged.digests)
            self.store.touch_products(judged.touched)
            self.store.forget_scenes(judged.gone)

    def _settle(self, *, stopped: bool) -> None:
        """Record the days on which everything is fresh; they are not judged again until changed."""
        signatures, verdicts, opened = self.signatures, self.told.verdicts, self.told.open
        settled = _signed(signatures, verdicts, opened)
        if opened and self.states.selection.everything:
            judge = self._new_judge(force=False)
            after = judge.signatures(opened)
            other = {
                day
                for day, now in after.items()
                # Files, or products of its month, may have come or gone after its scenes ended.
                if day not in signatures
                or now.sources != signatures[day].sources
                or not opened[day] <= self.run.fresh
            }
            settled |= _signed(after, verdicts, other)
            for batch in () if stopped else judge.batches(other):
                judged = judge.days(batch)
                # Of a forced scene that failed, the former products are fresh: the next run judges
                # its day, and forgets the failure.
                due = (one.day for one in judged.judgements if one.due)
                settled |= _signed(after, judged.verdicts, {*due, *judged.gone.values()})
        # Failures have removed some.
        known = self.store.verdicts()
        new = {day: verdict for day, verdict in settled.items() if known.get(day) != verdict}
        if new:
            self.lock.acquire_unchanged()
            self.store.store_verdicts(new)


def _signed(
    signatures: Mapping[int, Signature], verdicts: Mapping[int, Verdict], without: Collection[int]
) -> dict[int, Verdict]:
    """Return verdicts with the signatures of their days, without those on some days."""
    return {
        day: verdict._replace(signature=signatures[day].whole)
        for day, verdict in verdicts.items()
        if day in signatures and day not in without and signatures[day].whole
    }
