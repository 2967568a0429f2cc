"""Bring an archive up to date: catalog, plan, process, report.

The command line and the Prefect flows call these functions and add no logic of their own.
"""

from __future__ import annotations

import logging
import os
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from lidarops.campaign.model import Campaign
from lidarops.catalog import versions
from lidarops.catalog.ledger import RunStatus, Verdict
from lidarops.catalog.lock import Lock
from lidarops.catalog.scan import ScanSummary, scan_archive
from lidarops.catalog.store import Store
from lidarops.errors import LidarOpsError
from lidarops.plan.outlying_headers import joined_notes
from lidarops.records import FileNote, Findings, Granule, RunRecord
from lidarops.reports import run_record
from lidarops.run.executor import (
    EndedScene,
    StopRequest,
    local_client,
    process_jobs,
    process_one_by_one,
    read_bytes,
)
from lidarops.run.findings import find
from lidarops.run.leftovers import Orphan
from lidarops.run.options import NO_USABLE_VALUE, Options, Result
from lidarops.run.selection import Selection, check_selection
from lidarops.run.session import Session
from lidarops.run.staleness import REACH, DaysJudged, Judge, Judgement, Signature
from lidarops.scene.job import Job
from lidarops.system.files import only_one
from lidarops.system.processes import objects_frozen, prefetch_one, preload_modules

if TYPE_CHECKING:
    from distributed import Client

    from lidarops.reports.run_page import RunReport

__all__ = [
    "Options",
    "Result",
    "Selection",
    "assess",
    "bring_up_to_date",
    "remove_orphans",
    "report_earlier_runs",
    "report_run",
    "reprocess",
    "survey",
    "update_catalog",
]

MOST_FAILURES_IN_A_ROW = 5
"""The run stops after this many scenes in a row failed for a cause that may pass (a full disk)."""

MOST_DAYS_JUDGED_AGAIN: Final = 30
"""Unchanged days that are judged again to name their unused files and scenes; the unused ones of
other days are only counted."""

MOST_RUNS_REPORTED: Final = 20
"""Last runs whose missing reports are made; older ones are left to ``lidarops report``."""
PAGE_LOCK: Final = ".index.lock"
"""File in the folder of a report that is locked while its page is built."""

_WORKER_MODULES: Final = (
    "distributed.nanny",
    "lidarops.run.executor",
    "lidarops.scene.processing",
    "lidarops.reports.gallery",
)
"""Modules that workers need, for scenes and then for the report."""

_LOG = logging.getLogger(__name__)


class _OvertakenError(Exception):
    """Another run has worked on the catalog since it was read."""


def reprocess(
    campaign: Campaign,
    *,
    selection: Selection | None = None,
    options: Options | None = None,
    client: Client | None = None,
) -> RunRecord | None:
    """Do what `bring_up_to_date` does, and return the record; None if there was nothing to do."""
    return bring_up_to_date(campaign, selection=selection, options=options, client=client).record


def bring_up_to_date(
    campaign: Campaign,
    *,
    selection: Selection | None = None,
    options: Options | None = None,
    client: Client | None = None,
) -> Result:
    """Bring catalog and products up to date: make all stale products, and nothing else.

    Nothing is written if there is nothing to do.

    Parameters
    ----------
    campaign : Campaign
    selection : Selection, optional
        What to process; default everything.
    options : Options, optional
    client : distributed.Client, optional
        A cluster to run on.

    Returns
    -------
    Result
        What the run did, and the state of the archive after it.

    Raises
    ------
    CampaignError
        If the selection names something unknown.
    CatalogError
        If archive or catalog cannot be used, or another run holds the catalog.
    SceneError
        If the cluster is lost.
    """
    selection = selection or Selection()
    options = options or Options()
    check_selection(campaign, selection)
    with (
        Store(campaign.catalog_url, campaign.name) as store,
        Lock(store, wait=options.wait) as lock,
        objects_frozen(),
    ):
        # "Nothing to do" would not count what another run is about to do.
        lock.wait_until_free()
        while True:
            try:
                return _Pass(campaign, store, lock, selection, options).carry_out(client)
            except _OvertakenError:
                _LOG.info("another run has ended: judging again")


def assess(
    campaign: Campaign,
    *,
    selection: Selection | None = None,
    everything: bool = False,
    update: bool = True,
    wait: float = 0.0,
) -> Iterator[Judgement]:
    """Judge what every scene needs, and why. Processes nothing.

    Parameters
    ----------
    campaign : Campaign
    selection : Selection, optional
        What to process; default everything.
    everything : bool
        Whether to yield also scenes that need nothing.
    update : bool
        Whether to update the catalog first.
    wait : float
        s to wait for another run on the same catalog.

    Yields
    ------
    Judgement
    """
    selection = selection or Selection()
    check_selection(campaign, selection)
    if update:
        update_catalog(campaign, wait=wait)
    with Store(campaign.catalog_url, campaign.name) as store:
        judge = Judge(campaign, store, selection=selection)
        verdicts, signatures = store.verdicts(), judge.signatures()
        days = [
            day
            for day, now in signatures.items()
            if everything or not judge.is_settled(now, verdicts.get(day))
        ]
        for batch in judge.batches(selection.days(days)):
            for judged in judge.days(batch).judgements:
                if everything or judged.due or judged.held or judged.frozen or judged.kept:
                    yield judge.explained(judged)


def survey(
    campaign: Campaign, *, selection: Selection | None = None, wait: float = 0.0
) -> Findings:
    """Update the catalog, and return where the archive is not what the campaign states.

    Parameters
    ----------
    campaign : Campaign
    selection : Selection, optional
        Limits the findings to its instruments, kinds and times; default everything.
    wait : float
        s to wait for another run on the same catalog.
    """
    selection = selection or Selection()
    check_selection(campaign, selection)
    summary = update_catalog(campaign, wait=wait)
    with Store(campaign.catalog_url, campaign.name) as store:
        judge = Judge(campaign, store, selection=selection)
        return find(judge, summary.idle_patterns)


class EarlierProblems(NamedTuple):
    """Scenes that gave nothing when they were last processed, with the reasons."""

    failed: dict[str, str]
    unusable: dict[str, str]


def earlier_problems(campaign: Campaign, selection: Selection) -> EarlierProblems:
    """Return the selected scenes that failed or gave no usable value; a catalog must exist."""
    with Store(campaign.catalog_url, campaign.name, create=False) as store:
        unusable = dict.fromkeys(store.unusable_scenes(), NO_USABLE_VALUE)
        return EarlierProblems(
            *(
                {scene: why for scene, why in found.items() if selection.scene(scene, campaign)}
                for found in (store.failures(), unusable)
            )
        )


def update_catalog(
    campaign: Campaign,
    *,
    progress: Callable[[int], None] | None = None,
    wait: float = 0.0,
    workers: int = 1,
) -> ScanSummary:
    """Update the catalog from the archive; see `lidarops.catalog.scan.scan_archive`."""
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store, wait=wait) as lock:
        write = partial(_acquire, lock)
        while True:
            try:
                return scan_archive(
                    campaign, store, progress=progress, before_write=write, workers=workers
                )
            except _OvertakenError:
                continue


def _acquire(lock: Lock) -> None:
    """Take the lock before the first write."""
    if lock.acquire():
        raise _OvertakenError


@dataclass(slots=True)
class _Pass:
    """One pass: update the catalog, judge, process what is stale, enter it in the ledger."""

    campaign: Campaign
    store: Store
    lock: Lock
    selection: Selection
    options: Options
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
    reduced: set[int] = field(default_factory=set)
    """Days whose products may use a file that the processing has refused."""
    failing: int = 0
    """Number of scenes in a row that failed for a cause that may pass."""

    def carry_out(self, client: Client | None) -> Result:
        write = partial(_acquire, self.lock)
        workers = self.options.workers
        summary = scan_archive(self.campaign, self.store, before_write=write, workers=workers)
        self.judge = self._new_judge()
        signatures = self.judge.signatures()
        verdicts = self.store.verdicts()
        days = self.selection.days(
            day
            for day, now in signatures.items()
            if self.options.force or not self.judge.is_settled(now, verdicts.get(day))
        )
        clean = [
            day
            for day in sorted(signatures.keys() - set(days))
            if day in verdicts and verdicts[day].unused
        ]
        self._forget(self.store.scenes_of_other_days(signatures))
        status, caught = RunStatus.FINISHED, 0
        if days:
            if workers > 1 and not self.options.cluster and client is None:
                # The modules load while this process judges the scenes.
                preload_modules(_WORKER_MODULES)
            with StopRequest() as stop:
                self._process(days, client, stop)
                self._process_reduced(signatures.keys(), client, stop)
                caught = stop.signal
                if stop:
                    status = RunStatus.INTERRUPTED if caught else RunStatus.STOPPED
                    self.lost_worker = True
            self._settle(signatures, stopped=status is not RunStatus.FINISHED)
        self._clear_up()
        findings = find(self.judge, summary.idle_patterns, self.orphans.keys(), settled=not days)
        file_notes = (*findings.file_notes, *joined_notes(self.file_notes))
        findings = replace(findings, file_notes=file_notes)
        record = self._conclude(status, findings)
        self._collect_unused(clean[:MOST_DAYS_JUDGED_AGAIN])
        return Result(
            record=record,
            status=status,
            summary=summary,
            orphans=tuple(self.orphans.values()),
            failures=self.store.failures(),
            internal=self.store.internal_errors(),
            # Orphans are never made again, so they would be reported for ever.
            unusable=tuple(self.store.unusable_scenes(without=self.orphans.keys())),
            empty_scenes=self.empty_scenes,
            set_aside={path: granule.reason for path, granule in self.set_aside.items()},
            more_unused=sum(verdicts[day].unused for day in clean[MOST_DAYS_JUDGED_AGAIN:]),
            frozen=self.frozen,
            findings=findings,
            signal=caught,
        )

    def _collect_unused(self, days: Sequence[int]) -> None:
        """Collect the unused scenes and files of settled days."""
        judge = Judge(self.campaign, self.store)
        for batch in judge.batches(days):
            judged = judge.days(batch)
            self.set_aside |= {granule.path: granule for granule in judged.set_aside}
            self.empty_scenes |= _empty_scenes(judged)

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
                _acquire(self.lock)
                used_client = self._reached(self._started, stack, stop)
            taken = partial(self._take, note=used_client is None)
            if first is not None:
                others = chain([first], jobs)
                memory = _bytes(options.memory)
                ended = process_jobs(
                    others, client=used_client, stop=stop, taken=taken, memory=memory
                )
                self._enter(ended, stop)
            if self.suspects and not stop:
                if used_client is None:
                    own = partial(local_client, 1, memory=options.memory)
                    used_client = self._reached(own, stack, stop)
                if used_client is not None:
                    for job in self.suspects:
                        self._take(job)
                    ended = process_one_by_one(self.suspects, client=used_client, stop=stop)
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
            due = [scene for scene in judged.judgements if scene.due]
            for scene in due:
                self.judgements[scene.scene.id] = scene
                self.open[scene.day].add(scene.scene.id)
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
        self.empty_scenes |= _empty_scenes(judged)
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
            _acquire(self.lock)
            self.store.store_digests(judged.digests)
            self.store.touch_products(judged.touched)
            self._forget(judged.gone)

    def _forget(self, scenes: Collection[str]) -> None:
        if scenes:
            _acquire(self.lock)
            self.store.forget_scenes(scenes)

    def _take(self, job: Job, *, note: bool = False) -> None:
        self._running().take(self.judgements[job.scene.id], note=note)

    def _running(self) -> Session:
        if self.session is None:
            _acquire(self.lock)
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
                # Files may have come or gone after its scenes ended.
                if now.sources != signatures[day].sources or not self.open[day] <= done
            }
            settled |= _signed(after, self.verdicts, other)
            for batch in () if stopped else judge.batches(other):
                judged = judge.days(batch)
                # Of a forced scene that failed, the former products are fresh: the next run judges
                # its day, and forgets the failure.
                settled |= _signed(after, judged.verdicts, {*judged.open, *judged.gone.values()})
        known = self.store.verdicts()
        new = {day: verdict for day, verdict in settled.items() if known.get(day) != verdict}
        if new:
            _acquire(self.lock)
            self.store.store_verdicts(new)

    def _clear_up(self) -> None:
        """Remove what a killed run left, if this one has not; another run may be at work."""
        if self.session is None and (self.store.has_dead_run() or self._is_littered()):
            _acquire(self.lock)
            if versions.sweep(Path(self.campaign.output), self.store.others_at_work):
                self.store.close_runs(self.lock.token)

    def _is_littered(self) -> bool:
        """Return whether there are temporary files that no run writes and this one may remove."""
        files = versions.temporary_files(Path(self.campaign.output))
        if self.store.in_use() or self.store.others_at_work():
            return False
        return any(os.access(file.parent, os.W_OK) for file in files)

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


def _bytes(size: str | None) -> int | None:
    if size is None:
        return None
    from dask.utils import parse_bytes  # noqa: PLC0415 - most runs have no limit

    return int(parse_bytes(size))


def _empty_scenes(judged: DaysJudged) -> dict[str, str]:
    return {one.scene.id: one.empty_reason for one in judged.judgements if one.empty_reason}


def _signed(
    signatures: Mapping[int, Signature], verdicts: Mapping[int, Verdict], without: Collection[int]
) -> dict[int, Verdict]:
    """Return verdicts with the signatures of their days, without those on some days."""
    return {
        day: verdict._replace(signature=signatures[day].whole)
        for day, verdict in verdicts.items()
        if day in signatures and day not in without and signatures[day].whole
    }


def remove_orphans(campaign: Campaign, result: Result, *, wait: float = 0.0) -> int:
    """Remove products that the campaign no longer requests: files and ledger rows.

    Products stay if another run has made them again since, or if the campaign still requests them
    although the present files of their scene do not allow them, or their raw files are lost.

    Parameters
    ----------
    campaign : Campaign
    result : Result
        Of the run that listed them.
    wait : float
        s to wait for another run on the same catalog.

    Returns
    -------
    int
        Number of files removed.

    Raises
    ------
    CatalogError
        If another run holds the catalog.
    """
    # A requested product is kept, unless its file was removed by hand.
    removable = [
        orphan
        for orphan in result.orphans
        if not (orphan.requested and (campaign.products_root / orphan.path).exists())
    ]
    if not removable:
        return 0
    removed = 0
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store, wait=wait) as lock:
        lock.acquire()
        with store.all_products() as made:
            runs = {product.path: product.run for product in made}
        paths = [orphan.path for orphan in removable if runs.get(orphan.path) == orphan.run]
        for name in paths:
            path = campaign.products_root / name
            removed += path.exists()
            path.unlink(missing_ok=True)
        store.forget_products(paths, lock.token)
    return removed


def report_run(campaign: Campaign, run: RunRecord, *, workers: int = 1) -> RunReport:
    """Save the record of a run, unless the run has, and build its report page.

    While another process builds it, this one waits.

    Parameters
    ----------
    campaign : Campaign
    run : RunRecord
    workers : int, optional
        Largest number of local processes that read products and draw; does not affect the page.

    Returns
    -------
    Report
    """
    folder = campaign.report_root / run.id
    if not (folder / run_record.FILE_NAME).exists():
        run_record.save_run_record(run, folder)
    with only_one(folder / PAGE_LOCK, wait=True):
        return _build_page(run, folder, workers)


def _build_page(run: RunRecord, folder: Path, workers: int) -> RunReport:
    from lidarops.reports import run_page  # noqa: PLC0415 - loads what draws

    return run_page.build_report(run, folder, workers=workers)


def report_earlier_runs(campaign: Campaign, *, without: str = "", workers: int = 1) -> list[Path]:
    """Build the missing report pages of runs that were killed or met a full disk; return them.

    A record that cannot be read, and a page that cannot be made, is logged and left. So is a page
    that another process builds.

    Parameters
    ----------
    campaign : Campaign
        A catalog must exist.
    without : str, optional
        Id of a run that is left out.
    workers : int, optional
    """
    with Store(campaign.catalog_url, campaign.name, create=False) as store:
        runs = store.runs(limit=MOST_RUNS_REPORTED)
    pages = []
    for run in runs:
        folder = campaign.report_root / run.id
        if run.id == without or run.status is RunStatus.RUNNING or not _lacks_page(folder):
            continue
        try:
            with only_one(folder / PAGE_LOCK, wait=False):
                # Another process may have built it before.
                if _lacks_page(folder):
                    record = run_record.load_run_record(folder)
                    run_record.save_run_record(record, folder)
                    pages.append(_build_page(record, folder, workers).page)
        except BlockingIOError:
            _LOG.info("the report of run %s is being built by another process", run.id)
        except LidarOpsError as error:
            _LOG.warning("run %s has no report: %s", run.id, error)
    return pages


def _lacks_page(folder: Path) -> bool:
    """Return whether a run has a record and no page."""
    return run_record.exists(folder) and not (folder / run_record.INDEX).exists()
