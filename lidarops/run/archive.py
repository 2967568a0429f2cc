"""The way of the data for whoever runs it: catalog -> scenes -> run -> report.

The command line and the Prefect flows call these; neither holds logic of its own.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Final

from lidarops.campaign.model import Campaign
from lidarops.catalog.ledger import RunStatus
from lidarops.catalog.lock import Lock
from lidarops.catalog.scan import ScanSummary, scan_archive
from lidarops.catalog.store import Store
from lidarops.errors import CatalogError
from lidarops.process.scene import Job, failed
from lidarops.records import Granule, RunRecord, Unmet
from lidarops.reports import run_page, run_record
from lidarops.run import selection as asked
from lidarops.run.executor import Ended, Stop, alone, local_client, process_jobs, read_bytes
from lidarops.run.leftovers import Orphan
from lidarops.run.options import Options, Result
from lidarops.run.session import Session
from lidarops.run.staleness import DaysJudged, Judge, Judgement, Selection, Signature
from lidarops.system.processes import load_ahead, one_ahead, unswept

if TYPE_CHECKING:
    from distributed import Client

__all__ = [
    "Options",
    "Result",
    "Selection",
    "assess",
    "bring_up_to_date",
    "remove_orphans",
    "report_run",
    "reprocess",
    "update_catalog",
]

GIVE_UP = 5
"""Scenes in a row that fail for the sake of a disk, after which the others are not tried."""

AGAIN: Final = 30
"""Days in which nothing changed that are looked at again, to tell what is wrong with them."""

_OF_WORKERS: Final = ("distributed.nanny", "lidarops.run.executor", "lidarops.reports.gallery")
"""Modules that a worker needs, for scenes and then for the report."""

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
    """Bring catalog and products up to date: what is stale is made, nothing else.

    Parameters
    ----------
    campaign : Campaign
    selection : Selection, optional
        What is asked for; everything where not given.
    options : Options, optional
    client : distributed.Client, optional
        A cluster to run on.

    Returns
    -------
    RunRecord or None
        None where there was nothing to do; nothing was written then.

    Raises
    ------
    CampaignError
        If what is asked for is unknown.
    CatalogError
        If archive or catalog cannot be used, or another run holds the catalog.
    SceneError
        If the cluster is lost.
    """
    found = bring_up_to_date(campaign, selection=selection, options=options, client=client)
    return found.record


def bring_up_to_date(
    campaign: Campaign,
    *,
    selection: Selection | None = None,
    options: Options | None = None,
    client: Client | None = None,
) -> Result:
    """Do what `reprocess` does, and tell all that is known at the end."""
    selection = selection or Selection()
    options = options or Options()
    asked.refuse_unknown(campaign, selection)
    with (
        Store(campaign.catalog_url, campaign.name) as store,
        Lock(store, wait=options.wait) as lock,
        unswept(),
    ):
        while True:
            try:
                return _Work(campaign, store, lock, selection, options).carry_out(client)
            except _OvertakenError:
                _LOG.info("another run has ended: looking again")


def assess(
    campaign: Campaign,
    *,
    selection: Selection | None = None,
    force: bool = False,
    everything: bool = False,
    wait: float = 0.0,
) -> Iterator[Judgement]:
    """Tell for every scene that may have something to be done what that is, and why.

    Brings the catalog up to date, and processes nothing.

    Parameters
    ----------
    campaign : Campaign
    selection : Selection, optional
        What is asked for; everything where not given.
    force : bool
        Whether all of it counts as stale.
    everything : bool
        Whether to tell of scenes too for which nothing is to be done.
    wait : float
        s to wait for another run on the same catalog.

    Yields
    ------
    Judgement
    """
    selection = selection or Selection()
    asked.refuse_unknown(campaign, selection)
    update_catalog(campaign, wait=wait)
    with Store(campaign.catalog_url, campaign.name) as store:
        judge = Judge(campaign, store, selection=selection, force=force)
        days = _dirty(judge, store, selection, force=force or everything)
        for batch in judge.batches(days):
            for each in judge.days(batch).judgements:
                if everything or each.stale or each.held:
                    yield each


def update_catalog(
    campaign: Campaign,
    *,
    progress: Callable[[int], None] | None = None,
    wait: float = 0.0,
    workers: int = 1,
) -> ScanSummary:
    """Bring the catalog up to date with the archive; see `lidarops.catalog.scan.scan_archive`."""
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store, wait=wait) as lock:
        return _scan(campaign, store, lock, progress, workers)


def _scan(
    campaign: Campaign,
    store: Store,
    lock: Lock,
    progress: Callable[[int], None] | None,
    workers: int,
) -> ScanSummary:
    write = _Writer(lock)
    while True:
        try:
            return scan_archive(
                campaign, store, progress=progress, before_write=write, workers=workers
            )
        except _OvertakenError:
            continue


class _Writer:
    """Takes the lock before the first write."""

    def __init__(self, lock: Lock) -> None:
        self._lock = lock

    def __call__(self) -> None:
        if self._lock.acquire():
            raise _OvertakenError


def _dirty(judge: Judge, store: Store, selection: Selection, *, force: bool) -> list[int]:
    verdicts = store.verdicts()
    signatures = judge.signatures()
    days = selection.days(sorted(signatures))
    if force:
        return days
    return [
        day
        for day in days
        if not signatures[day].whole or verdicts.get(day, ("",))[0] != signatures[day].whole
    ]


@dataclass(slots=True)
class _Found:
    """What is gathered on the way."""

    fresh: int = 0
    orphans: list[Orphan] = field(default_factory=list)
    set_aside: list[Granule] = field(default_factory=list)
    held: list[Judgement] = field(default_factory=list)
    barren: list[Judgement] = field(default_factory=list)
    told: dict[int, tuple[int, int]] = field(default_factory=dict)
    """Days that are settled, or will be where they are in `open` and all goes well."""
    open: dict[int, set[str]] = field(default_factory=lambda: defaultdict(set))
    """Days on which something is stale -> scenes."""


class _Work:
    """One pass: catalog, judge, process what is stale, enter it."""

    def __init__(
        self,
        campaign: Campaign,
        store: Store,
        lock: Lock,
        selection: Selection,
        options: Options,
    ) -> None:
        self._campaign = campaign
        self._store = store
        self._lock = lock
        self._selection = selection
        self._options = options
        self._write = _Writer(lock)
        self._found = _Found()
        self._judgements: dict[str, Judgement] = {}
        self._suspects: list[Job] = []
        self._session: Session | None = None
        self._failing = 0

    def carry_out(self, client: Client | None) -> Result:
        self._summary = scan_archive(
            self._campaign, self._store, before_write=self._write, workers=self._options.workers
        )
        self._judge = self._new_judge()
        signatures = self._judge.signatures()
        verdicts = self._store.verdicts()
        days = _dirty(self._judge, self._store, self._selection, force=self._options.force)
        clean = [
            day
            for day in sorted(signatures.keys() - set(days))
            if day in verdicts and any(verdicts[day][1:])
        ]
        self._forget(self._store.tried_on_others(signatures))
        status, caught = RunStatus.FINISHED, 0
        if days:
            if self._options.workers > 1 and not self._options.cluster and client is None:
                # Meanwhile it is judged what they are to do.
                load_ahead(_OF_WORKERS)
            with Stop() as stop:
                self._process(days, client, stop)
                caught = stop.signal
                if stop:
                    status = RunStatus.INTERRUPTED if caught else RunStatus.STOPPED
            self._settle(signatures)
        unmet = asked.unmet_requests(self._campaign, self._store, self._selection)
        run = self._conclude(status, unmet)
        found = self._found
        self._look_again(clean[:AGAIN])
        return Result(
            record=run,
            status=status,
            summary=self._summary,
            fresh=found.fresh,
            orphans=tuple(found.orphans),
            failures=self._store.failures(),
            # Nothing would ever make these again, so that they would be told for ever.
            empty=tuple(self._store.empty(without={each.path for each in found.orphans})),
            barren={each.scene.id: each.barren for each in found.barren},
            set_aside={each.path: each.reason for each in found.set_aside},
            untold=sum(sum(verdicts[day][1:]) for day in clean[AGAIN:]),
            unmet=unmet,
            signal=caught,
        )

    def _look_again(self, days: Sequence[int]) -> None:
        """Find out what it was that days were settled with."""
        judge = Judge(self._campaign, self._store)
        for batch in judge.batches(days):
            judged = judge.days(batch)
            self._found.set_aside += judged.set_aside
            self._found.barren += [each for each in judged.judgements if each.barren]

    def _new_judge(self, *, again: bool = False) -> Judge:
        force = self._options.force and not again
        return Judge(self._campaign, self._store, selection=self._selection, force=force)

    # Processing

    def _process(self, days: Sequence[int], client: Client | None, stop: Stop) -> None:
        jobs = self._jobs(days, client)
        first = next(jobs, None)
        if first is None and not self._suspects:
            return
        options = self._options
        with ExitStack() as stack:
            used = client
            if client is None and (options.cluster or options.workers > 1):
                # First, as a run that this one has to wait for may leave nothing to do.
                self._write()
                used = self._reached(self._started, stack, stop)
            taken = partial(self._take, note=used is None)
            if first is not None:
                others = chain([first], jobs)
                self._enter(process_jobs(others, client=used, stop=stop, taken=taken), stop)
            if self._suspects and not stop:
                if used is None:
                    own = partial(local_client, 1, memory=options.memory)
                    used = self._reached(own, stack, stop)
                if used is not None:
                    self._enter_suspects(used, stop)

    def _enter_suspects(self, client: Client, stop: Stop) -> None:
        for job in self._suspects:
            self._take(job)
        self._enter(alone(self._suspects, client=client, stop=stop), stop)

    def _reached(
        self,
        start: Callable[[], AbstractContextManager[Client]],
        stack: ExitStack,
        stop: Stop,
    ) -> Client | None:
        """Start a cluster; None where a signal came first, which the run is then entered with."""
        # A queue may take an hour, in which a signal would wait for no scene at all.
        if not stop:
            with stop.idle():
                client = stack.enter_context(start())
        if stop:
            self._running()
            return None
        return client

    def _started(self) -> AbstractContextManager[Client]:
        options = self._options
        if options.cluster:
            return options.cluster()
        return local_client(options.workers, memory=options.memory)

    def _enter(self, ended: Iterator[Ended], stop: Stop) -> None:
        session = self._running()
        for each in ended:
            judged = self._judgements.pop(each.job.scene.id)
            outcome = session.end(judged, each.outcome, final=each.final)
            self._failing = self._failing + 1 if outcome.error and not each.final else 0
            if self._failing >= GIVE_UP:
                stop.now(f"the last {GIVE_UP} scenes failed alike: {outcome.error}")
            if self._options.progress:
                self._options.progress(outcome)

    def _judged(self, days: Sequence[int], client: Client | None) -> Iterator[DaysJudged]:
        judged = map(self._judge.days, self._judge.batches(days))
        apart = client is not None or self._options.cluster or self._options.workers > 1
        # Workers would wait while this process looks at what they are to do next.
        return one_ahead(judged) if apart else judged

    def _jobs(self, days: Sequence[int], client: Client | None) -> Iterator[Job]:
        """Give what is stale, the largest scenes of some days first."""
        for judged in self._judged(days, client):
            self._note(judged)
            stale = [each for each in judged.judgements if each.stale]
            jobs = [
                Job(self._campaign, each.scene, each.needed(), self._options.profiles_per_chunk)
                for each in stale
            ]
            self._judgements.update((each.scene.id, each) for each in stale)
            for each in stale:
                self._found.open[each.day].add(each.scene.id)
            if self._options.expect:
                self._options.expect(sum(len(each.scene.granules) for each in stale))
            suspect = {each.scene.id for each in stale if each.suspect}
            self._suspects += [job for job in jobs if job.scene.id in suspect]
            # The largest scene last would keep one worker busy while the others idle.
            for job in sorted(jobs, key=read_bytes, reverse=True):
                if job.scene.id not in suspect:
                    yield job

    def _note(self, judged: DaysJudged) -> None:
        found = self._found
        found.fresh += sum(each.fresh for each in judged.judgements)
        found.orphans += judged.orphans
        found.set_aside += judged.set_aside
        found.told.update(judged.told)
        found.barren += [each for each in judged.judgements if each.barren]
        found.held += [each for each in judged.judgements if each.held]
        if judged.digests or judged.touched or judged.gone:
            self._write()
            self._store.store_digests(judged.digests)
            self._store.touch_products(judged.touched)
            self._forget(judged.gone)

    def _forget(self, scenes: Collection[str]) -> None:
        if scenes:
            self._write()
            self._store.forget_scenes(scenes)

    def _take(self, job: Job, *, note: bool = False) -> None:
        self._running().take(self._judgements[job.scene.id], note=note)

    def _running(self) -> Session:
        if self._session is None:
            self._write()
            self._session = Session(self._campaign, self._store, self._lock, self._judge)
            self._session.begin()
        return self._session

    # The end

    def _settle(self, signatures: Mapping[int, Signature]) -> None:
        """Note the days on which everything is fresh, so that they need no second look."""
        found = self._found
        settled = _verdicts(signatures, found.told, found.told.keys() - found.open.keys())
        if found.open and self._selection.everything:
            judge = self._new_judge(again=True)
            again = judge.signatures(found.open)
            clear = {
                day
                for day, now in again.items()
                # Files may have joined or left it, or a profile changed, after its scenes ended.
                if now.sources == signatures[day].sources and self._went_as_planned(day)
            }
            settled |= _verdicts(again, found.told, clear & found.told.keys())
            # A day with scenes that were not tried stays open, whatever became of the others.
            waiting = {each.day for each in self._judgements.values()}
            for batch in judge.batches(again.keys() - clear - waiting):
                judged = judge.days(batch)
                settled |= _verdicts(again, judged.told, judged.told.keys() - judged.open)
        known = self._store.verdicts()
        new = {day: told for day, told in settled.items() if told[0] and known.get(day) != told}
        if new:
            self._write()
            self._store.store_verdicts(new)

    def _went_as_planned(self, day: int) -> bool:
        """Return whether another look would find all that was stale on a day to be fresh."""
        done = self._session.settled if self._session else set()
        return self._found.open[day] <= done

    def _conclude(self, status: RunStatus, unmet: tuple[Unmet, ...]) -> RunRecord | None:
        if self._session is None:
            return None
        for each in self._found.held:
            job = Job(self._campaign, each.scene, each.plan)
            self._session.add(failed(job, f"{each.held} (not tried again: nothing has changed)"))
        barren = {each.scene.id: each.barren for each in self._found.barren}
        return self._session.finish(status, self._found.set_aside, barren=barren, unmet=unmet)


def _verdicts(
    signatures: Mapping[int, Signature], told: Mapping[int, tuple[int, int]], days: Iterable[int]
) -> dict[int, tuple[str, int, int]]:
    return {day: (signatures[day].whole, *told[day]) for day in days}


def remove_orphans(campaign: Campaign, found: Result, *, wait: float = 0.0) -> int:
    """Remove products that nothing asks for any more, files and ledger rows.

    Products that another run has made again since are left, and those that the campaign still asks
    for where other files of their scene no longer allow them.

    Parameters
    ----------
    campaign : Campaign
    found : Result
        Of the run that found them.
    wait : float
        s to wait for another run on the same catalog.

    Returns
    -------
    int
        How many files were removed.

    Raises
    ------
    CatalogError
        If the archive holds no file at all, as where it is not mounted, or another run holds the
        catalog.
    """
    # A file that was removed by hand leaves nothing to keep.
    unasked = [
        each
        for each in found.orphans
        if not (each.asked and (campaign.products_root / each.path).exists())
    ]
    if not unasked:
        return 0
    if not found.summary.files:
        raise CatalogError(
            f"holds no raw file, so that {len(unasked)} products would be removed",
            file=campaign.archive,
            field="archive",
            remedy="see that it is mounted; where it is to be empty, remove the products by hand",
        )
    removed = 0
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store, wait=wait) as lock:
        lock.acquire()
        with store.all_made() as made:
            runs = {each.path: each.run for each in made}
        still = [each.path for each in unasked if runs.get(each.path) == each.run]
        for name in still:
            path = campaign.products_root / name
            removed += path.exists()
            path.unlink(missing_ok=True)
        store.forget_products(still, lock.token)
    return removed


def report_run(campaign: Campaign, run: RunRecord, *, workers: int = 1) -> run_page.RunReport:
    """Keep the record of a run and build its page.

    Parameters
    ----------
    campaign : Campaign
    run : RunRecord
    workers : int, optional
        Most processes of this machine to read products and to draw with; changes nothing that
        is shown.

    Returns
    -------
    Report
    """
    folder = campaign.report_root / run.id
    run_record.save_run_record(run, folder)
    return run_page.build_report(run, folder, workers=workers)
