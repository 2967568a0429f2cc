"""Enter one run in the ledger, every scene as it ends."""

from __future__ import annotations

import logging
import secrets
from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Final

from lidarops import __version__
from lidarops.campaign.model import Campaign
from lidarops.catalog import product_files
from lidarops.catalog.lock import Lock
from lidarops.catalog.store import NewProduct, Run, RunStatus, SceneEntry, Store
from lidarops.errors import CatalogError
from lidarops.records import (
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
from lidarops.run.staleness import Judge, Judgement
from lidarops.scene.dependence import ProductKey
from lidarops.system.code_version import joint_code_version
from lidarops.system.stores import without_keys

MOST_INPUTS: Final = 100_000
"""Granules that the record of a run names; the ledger names all."""
MOST_EMPTY_SCENES: Final = 1000
"""Scenes without product that the record of a run names; it counts the others."""

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


class Session:
    """A run that enters each scene in the ledger as it ends.

    Parameters
    ----------
    campaign : Campaign
    store : Store
    lock : Lock
        Must be held when the session begins.
    judge : Judge
    journal : bool, optional
        Whether to keep a journal, for the report of a run that is killed.
    """

    def __init__(
        self,
        campaign: Campaign,
        store: Store,
        lock: Lock,
        judge: Judge,
        *,
        journal: bool = False,
    ) -> None:
        self._campaign = campaign
        self._store = store
        self._lock = lock
        self._judge = judge
        self._output = Path(campaign.output)
        self._outcomes: dict[str, SceneOutcome] = {}
        self._left_out: dict[tuple[LeftOut, ...], tuple[LeftOut, ...]] = {}
        self._named = 0
        self.settled: set[str] = set()
        """Scenes whose products are all fresh now."""
        self._run = new_run(campaign)
        self.id, self.started = self._run.id, self._run.started
        self._journal = Journal(campaign.report_root / self.id) if journal else None

    def begin(self) -> None:
        """Enter the run in the ledger, and remove temporary files of killed runs."""
        swept = product_files.sweep(self._output, self._store)
        self._store.begin_run(self._run, self._lock.token, swept=swept)
        if self._journal:
            self._journal.begin(self._record((), Findings()))

    def take(self, judged: Judgement, *, note: bool) -> None:
        """Prepare for a scene that is about to start: keep replaced versions.

        Parameters
        ----------
        judged : Judgement
        note : bool
            Whether to note the start in the ledger, because the scene runs in this process: if the
            process dies, the next run knows the suspect.
        """
        for stale in judged.stale:
            reason = stale.reason
            _LOG.info("%s %s of %s: %s", stale.kind, stale.channel, judged.scene.id, reason)
            if stale.before is not None and self._campaign.superseded == "keep":
                product_files.keep(self._output, stale.before.path, stale.before.sha256)
        if note:
            self._store.begin_scene(judged.scene.id, judged.day, self.id, self._lock.token)

    def end(self, judged: Judgement, outcome: SceneOutcome, *, final: bool) -> SceneOutcome:
        """Enter the outcome of a scene.

        Returns
        -------
        SceneOutcome
            As entered; failed if its product files are missing or changed, which another try may
            mend.
        """
        reported = len(outcome.products)
        new, outcome = self._new_products(judged, outcome)
        entry = SceneEntry(
            outcome=outcome,
            day=judged.day,
            key=self._judge.key(judged, internal=bool(outcome.internal)),
            final=final and len(new) == reported,
            products=tuple(new),
            digests=_unknown_digests(judged.scene, outcome),
        )
        outcome = replace(outcome, left_out=self._beyond(judged, outcome))
        self._named += outcome.granules
        # A million file names would fill memory, and the page shows few.
        brief = outcome if self._named <= MOST_INPUTS else replace(outcome, inputs=())
        if outcome.scene in self._outcomes:
            brief = _joined(self._outcomes[outcome.scene], brief)
        # First, so that whatever the ledger knows is in the report, also of a run that is killed.
        if self._journal:
            self._journal.add(brief)
        self._store.record(entry, self.id, self._lock.token)
        if _went_as_planned(judged, outcome):
            self.settled.add(judged.scene.id)
        self._settle_versions(judged, outcome)
        self._log(outcome)
        self._outcomes[outcome.scene] = brief
        return outcome

    def add(self, outcome: SceneOutcome) -> None:
        """Add a scene that was not tried to the record of the run."""
        self._outcomes[outcome.scene] = outcome

    def finish(
        self,
        status: RunStatus,
        findings: Findings,
        *,
        set_aside: Iterable[Granule],
        empty_scenes: Mapping[str, str],
        frozen: Mapping[str, str],
        lost_worker: bool,
    ) -> RunRecord:
        """Close the run in the ledger and return its record.

        Parameters
        ----------
        status : RunStatus
        findings : Findings
        set_aside : iterable of Granule
            Good granules that belong to no scene.
        empty_scenes : mapping of str to str
            Scene -> why it can give no product.
        frozen : mapping of str to str
            Product of a frozen period that would be replaced -> why.
        lost_worker : bool
            Whether a worker may have left half a file.
        """
        if lost_worker:
            product_files.sweep(self._output, self._store)
        unused = (*self._store.refused(), *set_aside)
        stated = {file.path for outcome in self._outcomes.values() for file in outcome.refused}
        refused = tuple(granule for granule in unused if granule.path not in stated)
        listed = dict(islice(empty_scenes.items(), MOST_EMPTY_SCENES))
        record = replace(
            self._record(refused, findings),
            scenes=tuple(self._outcomes[scene] for scene in sorted(self._outcomes)),
            empty_scenes=listed,
            more_empty_scenes=len(empty_scenes) - len(listed),
            frozen=dict(frozen),
        )
        if self._journal:
            self._save(record)
        self._store.end_run(self.id, status, refused=len(unused), token=self._lock.token)
        _LOG.info("run %s %s: %d scenes", self.id, status.value, len(self._outcomes))
        return record

    def _save(self, record: RunRecord) -> None:
        """Save the record before the run has ended: from here on, another process may report it."""
        try:
            save_run_record(record, self._campaign.report_root / self.id)
        except CatalogError as error:
            _LOG.warning("the journal of the run stays: %s", error)

    def _record(self, refused: tuple[Granule, ...], findings: Findings) -> RunRecord:
        """Return the record of the run without its scenes."""
        truth = self._campaign.truth_path
        return RunRecord(
            id=self.id,
            campaign=self._campaign.name,
            title=self._campaign.title,
            started=self.started,
            finished=datetime.now(UTC),
            version=__version__,
            archive=without_keys(self._campaign.archive),
            products=str(self._campaign.products_root),
            scenes=(),
            refused=refused,
            truth=str(truth) if self._campaign.simulation and truth.exists() else "",
            findings=findings,
        )

    def _beyond(self, judged: Judgement, outcome: SceneOutcome) -> tuple[LeftOut, ...]:
        """Return the left-out steps of the request that are in no plan of a product."""
        planned = set(() if outcome.plan is None else outcome.plan.left_out)
        others = tuple(left for left in judged.requested.left_out if left not in planned)
        # Share equal tuples: nearly all scenes of an instrument have the same.
        return self._left_out.setdefault(others, others)

    def _new_products(
        self, judged: Judgement, outcome: SceneOutcome
    ) -> tuple[list[NewProduct], SceneOutcome]:
        new = []
        for record in outcome.products:
            mtime_ns = self._written(record)
            if mtime_ns is None:
                error = f"{record.path}: vanished or changed after it was written"
                return [], replace(outcome, products=(), error=error)
            product: ProductKey = (record.kind, record.channel)
            depends_on, used = self._judge.depends_on(
                judged.scene, judged.plan, product, outcome.inputs
            )
            new.append(NewProduct(record, mtime_ns, depends_on, used))
        return new, outcome

    def _written(self, record: ProductRecord) -> int | None:
        try:
            status = (self._campaign.products_root / record.path).stat()
        except OSError:
            return None
        return status.st_mtime_ns if status.st_size == record.size else None

    def _settle_versions(self, judged: Judgement, outcome: SceneOutcome) -> None:
        """Drop kept versions that were not replaced."""
        now = {record.path: record.sha256 for record in outcome.products}
        kept = [stale.before for stale in judged.stale if self._campaign.superseded == "keep"]
        for before in filter(None, kept):
            if now.get(before.path, before.sha256) == before.sha256:
                product_files.drop(self._output, before.path, before.sha256)

    def _log(self, outcome: SceneOutcome) -> None:
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
