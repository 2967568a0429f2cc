"""Carry out a run: judge the days that changed, process what is stale, enter it in the ledger."""

from __future__ import annotations

import logging
import secrets
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from itertools import chain, islice
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lidarops import __version__
from lidarops.campaign.model import Campaign
from lidarops.catalog import product_files
from lidarops.catalog.granules import joined_notes
from lidarops.catalog.lock import Lock
from lidarops.catalog.scan import ScanSummary
from lidarops.catalog.store import NewProduct, Run, RunStatus, SceneEntry, Verdict
from lidarops.errors import CatalogError
from lidarops.records import (
    FileNote,
    Findings,
    Granule,
    LeftOut,
    ProductRecord,
    RunRecord,
    Scene,
    SceneOutcome,
)
from lidarops.reports.run_journal import Journal
from lidarops.reports.run_record import save_run_record
from lidarops.run.clusters import local_client
from lidarops.run.day_states import REACH, DayStates, Signature
from lidarops.run.executor import EndedScene, StopRequest, process_jobs, read_bytes
from lidarops.run.findings import find
from lidarops.run.leftovers import Orphan
from lidarops.run.options import Options, Result, unused
from lidarops.run.staleness import DaysJudged, Judge, Judgement
from lidarops.scene.job import Job
from lidarops.system.code_version import joint_code_version
from lidarops.system.processes import prefetch_one, preload_modules
from lidarops.system.stores import without_keys

if TYPE_CHECKING:
    from distributed import Client


MOST_INPUTS: Final = 100_000
"""Granules that the record of a run names; the ledger names all."""
MOST_EMPTY_SCENES: Final = 1000
"""Scenes without product that the record of a run names; it counts the others."""
MOST_FAILURES_IN_A_ROW = 5
"""The run stops after this many scenes in a row failed for a cause that may pass (a full disk)."""

_WORKER_MODULES: Final = (
    "distributed.nanny",
    "lidarops.run.executor",
    "lidarops.scene.processing",
    "lidarops.reports.gallery",
)
"""Modules that workers need, for scenes and then for the report."""

_LOG = logging.getLogger(__name__)


def new_run(campaign: Campaign) -> Run:
    """Return a run of this process that starts now."""
    started = datetime.now(UTC)
    return Run(
        id=f"{started:%Y%m%dT%H%M%S}-{secrets.token_hex(3)}",
        started=started,
        finished=None,
        status=RunStatus.RUNNING,
        holder=Lock.holder_name(),
        version=__version__,
        code_version=joint_code_version(),
        archive=without_keys(campaign.archive),
        folder=str(campaign.folder),
    )


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
        self.campaign, self.store = states.campaign, states.store
        self.states, self.lock, self.options, self.summary = states, lock, options, summary
        self.days, self.signatures, self.known = days, signatures, known
        self.reduced: set[int] = set()
        """Days whose products may use a file that the processing has refused."""
        self.judge = self._new_judge()
        self.orphans: dict[str, Orphan] = {}
        """By path; this and what follows as it was judged last."""
        self.set_aside: dict[str, Granule] = {}
        """By path."""
        self.file_notes: list[FileNote] = []
        """Notes on files of the days that were judged, which the catalog does not know."""
        self.held: dict[str, Judgement] = {}
        """By scene."""
        self.frozen: dict[str, str] = {}
        """Product of a frozen period that would be replaced -> why."""
        self.empty_scenes: dict[str, str] = {}
        """Scene -> why it can give no product."""
        self.verdicts: dict[int, Verdict] = {}
        """Of settled days, without signature; of those in `open` once all their scenes succeed."""
        self.open: dict[int, set[str]] = defaultdict(set)
        """Days with stale products -> scenes."""
        self.judgements: dict[str, Judgement] = {}
        """Of the scenes that are yet to end."""
        self.suspects: list[Job] = []
        self.run: Run | None = None
        """Begun before the first scene is processed."""
        self.journal: Journal | None = None
        self.outcomes: dict[str, SceneOutcome] = {}
        """By scene, for the record of the run."""
        self.named = 0
        """Granules that the record names."""
        self.left_out: dict[tuple[LeftOut, ...], tuple[LeftOut, ...]] = {}
        self.fresh: set[str] = set()
        """Scenes whose products are all fresh now."""
        self.lost_worker = False
        """Whether a worker died, or was abandoned at a stop."""
        self.months = False
        """Whether months are processed now, or the scenes of whose products they are made."""
        self.failing = 0
        """Number of scenes in a row that failed for a cause that may pass."""

    def carry_out(self, client: Client | None) -> Result:
        """Return what was done, and the state of the archive after it.

        Raises
        ------
        OvertakenError
            If another run has worked on the catalog since it was read.
        """
        days, signatures = self.days, self.signatures
        workers = self.options.workers
        clean = unused(self.known, signatures.keys() - set(days))
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
        return Judge(
            self.campaign,
            self.store,
            selection=self.states.selection,
            force=force,
            thaw=thaw,
            known=None if self.reduced else self.states,
        )

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
            taken = partial(self.take, note=used_client is None)
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
                        self.suspects, client=used_client, stop=stop, taken=self.take, alone=True
                    )
                    self._enter(ended, stop)

    def _process_reduced(
        self, known: Collection[int], client: Client | None, stop: StopRequest
    ) -> None:
        """Process what is stale without the refused files: other scenes or plans may follow."""
        notes = list(self.file_notes)
        while self.reduced and not stop:
            days = self.states.selection.days(sorted(self.reduced.intersection(known)))
            self.states = self.judge = self._new_judge(again=True)
            self.reduced, self.suspects = set(), []
            self._process(days, client, stop)
        self.file_notes = notes

    def _process_months(self, client: Client | None, stop: StopRequest) -> None:
        """Process the months of the days that were judged, whose products are as they stay."""
        days = self.states.selection.days(self.judge.months({*self.days, *self.open}))
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
            self.begin()
            return None
        return client

    def _started(self) -> AbstractContextManager[Client]:
        options = self.options
        if options.cluster:
            return options.cluster()
        return local_client(options.workers, memory=options.memory)

    def _enter(self, ended: Iterable[EndedScene], stop: StopRequest) -> None:
        self.begin()
        for scene in ended:
            judged = self.judgements.pop(scene.outcome.scene)
            outcome = self.end(judged, scene.outcome, final=scene.final)
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

    # The scenes of the run

    def begin(self) -> Run:
        """Return the run; enter it first in the ledger, and remove what killed runs left."""
        if self.run is None:
            self.lock.acquire_unchanged()
            self.run = new_run(self.campaign)
            swept = product_files.sweep(Path(self.campaign.output), self.store)
            self.store.begin_run(self.run, self.lock.token, swept=swept)
            if self.options.journal:
                self.journal = Journal(self.campaign.report_root / self.run.id)
                self.journal.write(self._record(self.run))
        return self.run

    def take(self, job: Job, *, note: bool = False) -> None:
        """Prepare for a scene that is about to start: keep replaced versions.

        On request, note the start in the ledger, because the scene runs in this process: if the
        process dies, the next run knows the suspect.
        """
        run, judged = self.begin(), self.judgements[job.scene.id]
        for stale in judged.stale:
            reason = stale.reason
            _LOG.info("%s %s of %s: %s", stale.kind, stale.channel, judged.scene.id, reason)
            if stale.before is not None and self.campaign.superseded == "keep":
                output = Path(self.campaign.output)
                product_files.keep(output, stale.before.path, stale.before.sha256)
        if note:
            self.store.begin_scene(judged.scene.id, judged.day, run.id, self.lock.token)

    def end(self, judged: Judgement, outcome: SceneOutcome, *, final: bool) -> SceneOutcome:
        """Enter the outcome of a scene in the ledger, and return it as entered.

        It failed if its product files are missing or changed, which another try may mend.
        """
        run, reported = self.begin(), len(outcome.products)
        new, outcome = self._new_products(judged, outcome)
        entry = SceneEntry(
            outcome=outcome,
            day=judged.day,
            key=self.judge.key(judged, internal=bool(outcome.internal)),
            final=final and len(new) == reported,
            products=tuple(new),
            digests=_unknown_digests(judged.scene, outcome),
        )
        outcome = replace(outcome, left_out=self._beyond(judged, outcome))
        self.named += outcome.granules
        # A million file names would fill memory, and the page shows few.
        brief = outcome if self.named <= MOST_INPUTS else replace(outcome, inputs=())
        if outcome.scene in self.outcomes:
            brief = _joined(self.outcomes[outcome.scene], brief)
        # First, so that whatever the ledger knows is in the report, also of a run that is killed.
        if self.journal:
            self.journal.write(brief)
        self.store.record(entry, run.id, self.lock.token)
        if _went_as_planned(judged, outcome):
            self.fresh.add(judged.scene.id)
        self._settle_versions(judged, outcome)
        _log(outcome)
        self.outcomes[outcome.scene] = brief
        return outcome

    def _beyond(self, judged: Judgement, outcome: SceneOutcome) -> tuple[LeftOut, ...]:
        """Return the left-out steps of the request that are in no plan of a product."""
        planned = set(() if outcome.plan is None else outcome.plan.left_out)
        others = tuple(left for left in judged.requested.left_out if left not in planned)
        # Share equal tuples: nearly all scenes of an instrument have the same.
        return self.left_out.setdefault(others, others)

    def _new_products(
        self, judged: Judgement, outcome: SceneOutcome
    ) -> tuple[list[NewProduct], SceneOutcome]:
        new = []
        for record in outcome.products:
            mtime_ns = self._written(record)
            if mtime_ns is None:
                error = f"{record.path}: vanished or changed after it was written"
                return [], replace(outcome, products=(), error=error)
            product = record.kind, record.channel
            depends_on, used = self.judge.depends_on(
                judged.scene, judged.plan, product, outcome.inputs
            )
            new.append(NewProduct(record, mtime_ns, depends_on, used))
        return new, outcome

    def _written(self, record: ProductRecord) -> int | None:
        try:
            status = (self.campaign.products_root / record.path).stat()
        except OSError:
            return None
        return status.st_mtime_ns if status.st_size == record.size else None

    def _settle_versions(self, judged: Judgement, outcome: SceneOutcome) -> None:
        """Drop kept versions that were not replaced."""
        now = {record.path: record.sha256 for record in outcome.products}
        kept = [stale.before for stale in judged.stale if self.campaign.superseded == "keep"]
        for before in filter(None, kept):
            if now.get(before.path, before.sha256) == before.sha256:
                product_files.drop(Path(self.campaign.output), before.path, before.sha256)

    # The end

    def _settle(self, signatures: Mapping[int, Signature], *, stopped: bool) -> None:
        """Record the days on which everything is fresh; they are not judged again until changed."""
        settled = _signed(signatures, self.verdicts, self.open)
        if self.open and self.states.selection.everything:
            judge = self._new_judge(again=True)
            after = judge.signatures(self.open)
            other = {
                day
                for day, now in after.items()
                # Files, or products of its month, may have come or gone after its scenes ended.
                if day not in signatures
                or now.sources != signatures[day].sources
                or not self.open[day] <= self.fresh
            }
            settled |= _signed(after, self.verdicts, other)
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

    def _clear_up(self) -> None:
        """Remove what a killed run left, if this one has not; another run may be at work."""
        output = Path(self.campaign.output)
        if self.run is not None:
            return
        if self.store.has_dead_run() or product_files.is_littered(output, self.store):
            self.lock.acquire_unchanged()
            if product_files.sweep(output, self.store):
                self.store.close_runs(self.lock.token)

    def _conclude(self, status: RunStatus, findings: Findings) -> RunRecord | None:
        """Close the run in the ledger and return its record; None if there was none."""
        if self.run is None:
            return None
        for held in self.held.values():
            if held.failure:
                error = f"{held.failure.error} (not tried again, because nothing has changed)"
                outcome = held.failure.outcome(held.scene, held.plan)
                self.outcomes[held.scene.id] = replace(outcome, error=error)
        if self.lost_worker:
            # It may have left half a file.
            product_files.sweep(Path(self.campaign.output), self.store)
        aside = (*self.store.refused(), *self.set_aside.values())
        stated = {file.path for outcome in self.outcomes.values() for file in outcome.refused}
        listed = dict(islice(self.empty_scenes.items(), MOST_EMPTY_SCENES))
        record = replace(
            self._record(self.run),
            refused=tuple(granule for granule in aside if granule.path not in stated),
            findings=findings,
            scenes=tuple(self.outcomes[scene] for scene in sorted(self.outcomes)),
            empty_scenes=listed,
            more_empty_scenes=len(self.empty_scenes) - len(listed),
            frozen=dict(self.frozen),
        )
        if self.journal:
            # Before the run has ended: from then on, another process may report it.
            try:
                save_run_record(record, self.campaign.report_root / record.id)
            except CatalogError as error:
                _LOG.warning("the journal of the run stays: %s", error)
        self.store.end_run(record.id, status, refused=len(aside), token=self.lock.token)
        _LOG.info("run %s %s: %d scenes", record.id, status.value, len(self.outcomes))
        return record

    def _record(self, run: Run) -> RunRecord:
        """Return the record of the run without its scenes."""
        truth = self.campaign.truth_path
        return RunRecord(
            id=run.id,
            campaign=self.campaign.name,
            title=self.campaign.title,
            started=run.started,
            finished=datetime.now(UTC),
            version=run.version,
            archive=run.archive,
            products=str(self.campaign.products_root),
            scenes=(),
            refused=(),
            truth=str(truth) if self.campaign.simulation and truth.exists() else "",
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


def _log(outcome: SceneOutcome) -> None:
    fields = {
        "scene": outcome.scene,
        "granules": outcome.granules,
        "products": [record.path for record in outcome.products],
        "seconds": dict(outcome.seconds),
    }
    if outcome.internal:
        words = (outcome.scene, outcome.error, outcome.internal)
        _LOG.error("scene %s: %s\n%s", *words, extra=fields)
    elif outcome.error:
        _LOG.error("scene %s failed: %s", outcome.scene, outcome.error, extra=fields)
    else:
        _LOG.info(
            "scene %s: %d granules, %d products",
            outcome.scene,
            outcome.granules,
            len(outcome.products),
            extra=fields,
        )
    for granule in outcome.refused:
        facts = {"scene": outcome.scene, "granule": granule.path}
        _LOG.warning("refused %s: %s", granule.path, granule.reason, extra=facts)


def _joined(before: SceneOutcome, after: SceneOutcome) -> SceneOutcome:
    """Return the outcome of a scene that was processed again without files that were refused."""
    made = {product.path: product for product in (*before.products, *after.products)}
    refused = {file.path: file for file in (*before.refused, *after.refused)}
    return replace(
        after,
        granules=before.granules,
        products=tuple(made.values()),
        refused=tuple(refused.values()),
    )


def _went_as_planned(judged: Judgement, outcome: SceneOutcome) -> bool:
    """Return whether every product that was stale was made from the files that were judged."""
    # A refused file no longer belongs to the scene.
    if outcome.error or outcome.refused:
        return False
    made = {(product.kind, product.channel) for product in outcome.products}
    granules = (*judged.scene.granules, *judged.scene.dark)
    known = {granule.path: granule.sha256 for granule in granules if granule.sha256}
    known |= {used.path: used.sha256 for used in judged.ancillaries}
    same = all(known.get(used.path, used.sha256) == used.sha256 for used in outcome.inputs)
    return same and made.issuperset(stale.product for stale in judged.stale)


def _unknown_digests(scene: Scene, outcome: SceneOutcome) -> dict[str, str]:
    """Return path -> SHA-256 of the files of a scene whose digest differs from the catalog's."""
    known = {granule.path: granule.sha256 for granule in (*scene.granules, *scene.dark)}
    return {
        used.path: used.sha256
        for used in outcome.inputs
        if used.path in known and used.sha256 != known[used.path]
    }
