"""Enter a run and its scenes as they end: in the ledger, and in the record for its report.

And enter products again, from what their files say of themselves, where the ledger lacks them.
"""

from __future__ import annotations

import logging
import secrets
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from itertools import groupby, islice
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Final

from lidarops import __version__
from lidarops.campaign.model import Campaign
from lidarops.catalog import product_files
from lidarops.catalog.lock import Lock
from lidarops.catalog.raw_files import acknowledged
from lidarops.catalog.store import Dependence, LastTry, NewProduct, Run, RunStatus, Store, Verdict
from lidarops.errors import CatalogError, LidarOpsError, ProductError
from lidarops.kinds import kinds
from lidarops.netcdf.context import product_path
from lidarops.netcdf.stored import open_stored, reading
from lidarops.netcdf.stored_flags import (
    FlagCounter,
    all_bits,
    blocks,
    flags_names,
    rejecting_mask,
)
from lidarops.records import (
    Findings,
    Granule,
    LeftOut,
    Plan,
    ProductRecord,
    Role,
    RunRecord,
    SceneOutcome,
    Verdicts,
    day_of,
)
from lidarops.reports.run_record import Journal, save_run_record
from lidarops.run.leftovers import Orphan
from lidarops.run.scenes import MONTH, parse_scene_id
from lidarops.run.staleness import DaysJudged, Judge, Judgement, settings_digest
from lidarops.scene import dependence
from lidarops.system.code_version import joint_code_version
from lidarops.system.files import product_paths, sha256_of
from lidarops.system.stores import without_keys

if TYPE_CHECKING:
    from lidarops.run.reproduction import Recipe

MOST_INPUTS: Final = 100_000
"""Granules that the record of a run names; the ledger names all."""
MOST_EMPTY_SCENES: Final = 1000
"""Scenes without product that the record of a run names; it counts the others."""

_LOG = logging.getLogger(__name__)


@dataclass(slots=True)
class JudgedDays:
    """What the judging of some days told, as they were judged last."""

    orphans: dict[str, Orphan] = field(default_factory=dict)
    """By path."""
    set_aside: dict[str, Granule] = field(default_factory=dict)
    """By path."""
    held: dict[str, Judgement] = field(default_factory=dict)
    """By scene."""
    frozen: dict[str, str] = field(default_factory=dict)
    """Product of a frozen period that would be replaced -> why."""
    empty_scenes: dict[str, str] = field(default_factory=dict)
    """Scene -> why it can give no product."""
    verdicts: dict[int, Verdict] = field(default_factory=dict)
    """Of settled days, without signature; of those in `open` once all their scenes succeed."""
    open: dict[int, set[str]] = field(default_factory=lambda: defaultdict(set))
    """Days with stale products -> scenes."""

    def note(self, judged: DaysJudged) -> None:
        """Note what was told of some days, in place of what was told before."""
        self.orphans |= {orphan.path: orphan for orphan in judged.orphans}
        self.set_aside |= {granule.path: granule for granule in judged.set_aside}
        self.verdicts.update(judged.verdicts)
        for one in judged.judgements:
            scene = one.scene.id
            self.held.pop(scene, None)
            if one.held:
                self.held[scene] = one
            if one.empty_reason:
                self.empty_scenes[scene] = one.empty_reason
            if one.due:
                self.open[one.day].add(scene)
            self.frozen |= {stale.before.path: stale.reason for stale in one.frozen if stale.before}


class LedgerRun:
    """One run in the ledger, which begins before its first scene is processed.

    Parameters
    ----------
    campaign : Campaign
    store : Store
    lock : Lock
    journal : bool
        Whether to note each scene in the report folder as it ends.
    """

    def __init__(self, campaign: Campaign, store: Store, lock: Lock, *, journal: bool) -> None:
        self._campaign, self._store, self._lock = campaign, store, lock
        self._output = Path(campaign.output)
        self._journals = journal
        self._keeps = campaign.superseded != "remove"
        """Whether replaced versions of products are kept."""
        self._journal: Journal | None = None
        self._run: Run | None = None
        self._outcomes: dict[str, SceneOutcome] = {}
        """By scene, for the record of the run."""
        self._named = 0
        """Granules that the record names."""
        self._left_out: dict[tuple[LeftOut, ...], tuple[LeftOut, ...]] = {}
        self._plans: dict[str, Plan] = {}
        """Last plan by instrument."""
        self.fresh: set[str] = set()
        """Scenes whose products are all fresh now."""

    def begin(self) -> Run:
        """Return the run; enter it first in the ledger, and remove what killed runs left."""
        if self._run is None:
            self._lock.acquire_unchanged()
            started = datetime.now(UTC)
            self._run = Run(
                id=f"{started:%Y%m%dT%H%M%S}-{secrets.token_hex(3)}",
                started=started,
                finished=None,
                status=RunStatus.RUNNING,
                holder=Lock.holder_name(),
                version=__version__,
                code_version=joint_code_version(),
                archive=without_keys(self._campaign.archive),
                folder=str(self._campaign.folder),
            )
            swept = product_files.sweep(self._output, self._store)
            self._store.begin_run(self._run, self._lock.token, swept=swept)
            if self._journals:
                self._journal = Journal(self._campaign.report_root / self._run.id)
                self._journal.write(self._record(self._run))
        return self._run

    def take(self, judged: Judgement, *, note: bool = False) -> None:
        """Prepare for a scene that is about to start: keep replaced versions.

        On request, note the start in the ledger, because the scene runs in this process: if the
        process dies, the next run knows the suspect.
        """
        run, scene = self.begin(), judged.scene.id
        for stale in judged.stale:
            _LOG.info("%s %s of %s: %s", stale.kind, stale.channel, scene, stale.reason)
            if stale.before is not None and self._keeps:
                product_files.keep(self._output, stale.before.path, stale.before.sha256)
        if note:
            self._store.begin_scene(scene, judged.day, run.id, self._lock.token)

    def end(
        self, judge: Judge, judged: Judgement, outcome: SceneOutcome, *, final: bool
    ) -> SceneOutcome:
        """Enter the outcome of a scene in the ledger, and return it as entered.

        It failed if its product files are missing or changed, which another try may mend.
        """
        run, reported = self.begin(), len(outcome.products)
        new, outcome = self._new_products(judge, judged, outcome)
        raw = (*judged.scene.granules, *judged.scene.dark)
        known = {granule.path: granule.sha256 for granule in raw}
        read = {used.path: used.sha256 for used in outcome.inputs if used.path in known}
        key = judge.key(judged, internal=True) if outcome.internal else judged.key
        final = final and len(new) == reported
        tried = LastTry(key, outcome.error, outcome.internal, final, crashes=0, day=judged.day)
        digests = dict(read.items() - known.items())
        planned = set(() if outcome.plan is None else outcome.plan.left_out)
        others = tuple(left for left in judged.requested.left_out if left not in planned)
        # Share equal tuples: nearly all scenes of an instrument have the same.
        others = self._left_out.setdefault(others, others)
        outcome = replace(outcome, left_out=others, plan=self._shared(outcome))
        self._named += outcome.granules
        # A million file names would fill memory, and the page shows few.
        brief = outcome if self._named <= MOST_INPUTS else replace(outcome, inputs=())
        if outcome.scene in self._outcomes:
            brief = _joined(self._outcomes[outcome.scene], brief)
        # First, so that whatever the ledger knows is in the report, also of a run that is killed.
        if self._journal:
            self._journal.write(brief)
        token = self._lock.token
        self._store.record(outcome, new, digests, tried, run=run.id, token=token)
        if _went_as_planned(judged, outcome, known):
            self.fresh.add(judged.scene.id)
        now = {record.path: record.sha256 for record in outcome.products}
        for before in (stale.before for stale in judged.stale if self._keeps):
            # A kept version that was not replaced.
            if before and now.get(before.path, before.sha256) == before.sha256:
                product_files.drop(self._output, before.path, before.sha256)
        _log(outcome)
        self._outcomes[outcome.scene] = brief
        return outcome

    def _shared(self, outcome: SceneOutcome) -> Plan | None:
        """Return the plan of a scene with the entries of the last one where they are equal."""
        if outcome.plan is None:
            return None
        plan, last = outcome.plan, self._plans.get(outcome.instrument, outcome.plan)
        if (plan.steps, plan.left_out) == (last.steps, last.left_out):
            plan = Plan(plan.scene, last.steps, last.left_out)
        self._plans[outcome.instrument] = plan
        return plan

    def _new_products(
        self, judge: Judge, judged: Judgement, outcome: SceneOutcome
    ) -> tuple[list[NewProduct], SceneOutcome]:
        new = []
        for record in outcome.products:
            try:
                status = (self._campaign.products_root / record.path).stat()
            except OSError:
                status = None
            if status is None or status.st_size != record.size:
                error = f"{record.path}: vanished or changed after it was written"
                return [], replace(outcome, products=(), error=error)
            product = record.kind, record.channel
            depends_on, used = judge.depends_on(judged.scene, judged.plan, product, outcome.inputs)
            new.append(NewProduct(record, status.st_mtime_ns, depends_on, used))
        return new, outcome

    def clear_up(self, *, lost_worker: bool) -> None:
        """Remove half files, of workers of this run, or of a killed one if this has not begun."""
        if self._run is not None:
            if lost_worker:
                product_files.sweep(self._output, self._store)
        # Another run may be at work.
        elif self._store.has_dead_run() or product_files.is_littered(self._output, self._store):
            self._lock.acquire_unchanged()
            if product_files.sweep(self._output, self._store):
                self._store.close_runs(self._lock.token)

    def _stated(self, outcome: SceneOutcome) -> SceneOutcome:
        """Return what a record states of a scene."""
        refused = acknowledged(self._campaign, outcome.refused)
        return replace(outcome, refused=tuple(refused)) if refused else outcome

    def conclude(self, status: RunStatus, findings: Findings, told: JudgedDays) -> RunRecord | None:
        """Close the run in the ledger and return its record; None if it has not begun."""
        if self._run is None:
            return None
        for judged in told.held.values():
            if judged.failure:
                error = f"{judged.failure.error} (not tried again, because nothing has changed)"
                outcome = judged.failure.outcome(judged.scene, judged.plan)
                self._outcomes[judged.scene.id] = replace(outcome, error=error)
        if isinstance(self._campaign.superseded, timedelta):
            product_files.remove_kept(self._output, self._campaign.superseded)
        aside = acknowledged(self._campaign, (*self._store.refused(), *told.set_aside.values()))
        stated = {file.path for outcome in self._outcomes.values() for file in outcome.refused}
        listed = dict(islice(told.empty_scenes.items(), MOST_EMPTY_SCENES))
        record = replace(
            self._record(self._run),
            refused=tuple(granule for granule in aside if granule.path not in stated),
            findings=findings,
            scenes=tuple(self._stated(self._outcomes[scene]) for scene in sorted(self._outcomes)),
            empty_scenes=listed,
            more_empty_scenes=len(told.empty_scenes) - len(listed),
            frozen=dict(told.frozen),
        )
        if self._journal:
            # Before the run has ended: from then on, another process may report it.
            try:
                save_run_record(record, self._campaign.report_root / record.id)
            except CatalogError as error:
                _LOG.warning("the journal of the run stays: %s", error)
        self._store.end_run(record.id, status, refused=len(aside), token=self._lock.token)
        _LOG.info("run %s %s: %d scenes", record.id, status.value, len(self._outcomes))
        return record

    def _record(self, run: Run) -> RunRecord:
        """Return the record of the run without its scenes."""
        return RunRecord(
            id=run.id,
            campaign=self._campaign.name,
            title=self._campaign.title,
            started=run.started,
            finished=datetime.now(UTC),
            version=run.version,
            archive=run.archive,
            products=str(self._campaign.products_root),
            scenes=(),
            refused=(),
        )


def _log(outcome: SceneOutcome) -> None:
    made = [record.path for record in outcome.products]
    fields = {
        "scene": outcome.scene,
        "granules": outcome.granules,
        "products": made,
        "seconds": dict(outcome.seconds),
    }
    if outcome.internal:
        words = (outcome.scene, outcome.error, outcome.internal)
        _LOG.error("scene %s: %s\n%s", *words, extra=fields)
    elif outcome.error:
        _LOG.error("scene %s failed: %s", outcome.scene, outcome.error, extra=fields)
    else:
        numbers = (outcome.scene, outcome.granules, len(made))
        _LOG.info("scene %s: %d granules, %d products", *numbers, extra=fields)
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


def _went_as_planned(
    judged: Judgement, outcome: SceneOutcome, raw: Mapping[str, str | None]
) -> bool:
    """Return whether every product that was stale was made from the files that were judged.

    `raw` gives the SHA-256 of raw files by path, as the catalog knew them.
    """
    # A refused file no longer belongs to the scene.
    if outcome.error or outcome.refused:
        return False
    made = {(product.kind, product.channel) for product in outcome.products}
    known = {**raw, **{used.path: used.sha256 for used in judged.ancillaries}}
    same = all(known.get(used.path) in (None, "", used.sha256) for used in outcome.inputs)
    return same and made.issuperset(stale.product for stale in judged.stale)


_BLOCK: Final = 1 << 24
"""Quality flags that are read at a time."""


@dataclass(slots=True)
class Rebuilt:
    """What a rebuilt ledger was made from."""

    entered: int = 0
    """Products that were entered."""
    known: int = 0
    """Products that the ledger knew already."""
    without_scene: int = 0
    """Entered products of scenes that present raw files and campaign do not give."""
    problems: dict[str, str] = field(default_factory=dict)
    """Path -> why it was not entered."""


def rebuild_ledger(
    campaign: Campaign,
    *,
    wait: float = 0.0,
    progress: Callable[[int], None] = lambda _done: None,
) -> Rebuilt:
    """Enter the products that the ledger does not know, day by day.

    Each product states its inputs, plan, settings and code. One that was made with the present
    settings from the present files is fresh afterwards; any other is stale. Products whose raw
    files are gone are entered, too: the next run names them.

    Parameters
    ----------
    campaign : Campaign
        Its catalog must be up to date: `lidarops.run.archive.update_catalog`.
    wait : float
        s to wait for another run on the same catalog.
    progress : callable, optional
        Called with 1 for each product that was read.

    Raises
    ------
    CatalogError
        If the catalog cannot be used, or another run holds it.
    """
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store, wait=wait) as lock:
        lock.acquire()
        with store.all_products() as made:
            known = {product.path for product in made}
        files = product_paths(campaign.products_root)
        rebuilt = Rebuilt(known=len(known.intersection(files)))
        progress(rebuilt.known)
        # Months last: they exist by the products of their days.
        parts: tuple[dict[int, list[str]], ...] = (defaultdict(list), defaultdict(list))
        unnamed = []
        for path in files:
            day = None if path in known else _day_in(path)
            if day is not None:
                parts[PurePosixPath(path).stem.endswith(MONTH)][day].append(path)
            elif path not in known:
                unnamed.append(path)
        read = partial(_read_products, campaign, rebuilt, progress)
        # Says which name each of them should have.
        read(unnamed)
        judge, run = Judge(campaign, store), LedgerRun(campaign, store, lock, journal=False)
        for days, batch in [(part, batch) for part in parts for batch in judge.batches(part)]:
            present = {judged.scene.id for judged in judge.days(batch).judgements}
            scenes = ((day, *group) for day in batch for group in groupby(read(days[day]), _scene))
            for day, scene, products in scenes:
                outcome, new = _outcome(tuple(products))
                tried = LastTry("", "", "", final=False, crashes=0, day=day)
                store.record(outcome, new, {}, tried, run=run.begin().id, token=lock.token)
                rebuilt.entered += len(new)
                rebuilt.without_scene += 0 if scene in present else len(new)
        run.conclude(RunStatus.FINISHED, Findings(), JudgedDays())
    return rebuilt


_Product = tuple["Recipe", NewProduct]
"""What a product file says of itself, and its entry."""


def _scene(product: _Product) -> str:
    return product[0].scene


def _day_in(path: str) -> int | None:
    """Return the day in the name of a product; None if it is no such name."""
    try:
        return day_of(parse_scene_id(PurePosixPath(path).stem)[1])
    except ValueError:
        return None


def _read_products(
    campaign: Campaign, rebuilt: Rebuilt, progress: Callable[[int], None], paths: Iterable[str]
) -> list[_Product]:
    """Return the products among some files, by scene and path, and note what the others are."""
    products = []
    for path in paths:
        progress(1)
        try:
            products.append(_read_product(campaign, path))
        except LidarOpsError as error:
            problem = str(error).removeprefix(f"{campaign.products_root}/")
            rebuilt.problems[path] = problem
    return sorted(products, key=lambda product: (_scene(product), product[1].record.path))


def _read_product(campaign: Campaign, path: str) -> _Product:
    from lidarops.run.reproduction import Recipe  # noqa: PLC0415 - loads what makes products

    file = campaign.products_root / path
    with reading(file):
        recipe = Recipe.of(file)
        keys, kind, channel = recipe.settings["keys"], recipe.kind, recipe.channel
        if recipe.campaign != campaign.name:
            raise ProductError(f"is a product of campaign {recipe.campaign!r}", file=file)
        if kind not in kinds():
            raise ProductError(f"is of the unknown kind {kind!r}", file=file)
        names = (keys["station"], keys["instrument"], kind, channel)
        start = datetime.fromisoformat(recipe.settings["window"][0])
        name = product_path(names, recipe.scene, start)
        if path != name:
            raise ProductError(f"should have the name {name}", file=file)
        status = file.stat()
        verdicts = _verdicts(file)
        record = ProductRecord(
            path, kind, channel, sha256_of(file), status.st_size, verdicts.values, {},
            verdicts.good, verdicts.usable, stamp=recipe.stamp,
        )  # fmt: skip
        depends_on = Dependence(
            plan_hash=recipe.plan.hash,
            settings_hash=settings_digest(recipe.settings),
            inputs_hash=dependence.inputs_digest(recipe.inputs),
            code_version=recipe.code_version,
        )
        inputs = (*recipe.inputs, *dependence.unused_inputs(recipe.unused))
        return recipe, NewProduct(record, status.st_mtime_ns, depends_on, inputs)


def _verdicts(file: Path) -> Verdicts:
    """Return the numbers of values of a product, which may be larger than memory."""
    with open_stored(file) as product:
        counts = FlagCounter(rejecting_mask(all_bits(product)))
        for name in flags_names(product):
            for block in blocks(product[name], _BLOCK):
                counts.add(block)
    return counts.verdicts


def _outcome(products: tuple[_Product, ...]) -> tuple[SceneOutcome, tuple[NewProduct, ...]]:
    """Return the outcome of a scene that gave some products, and these."""
    recipe = products[0][0]
    keys, scene = recipe.settings["keys"], recipe.scene
    inputs = [used for stated, _ in products for used in stated.inputs]
    new = tuple(entry for _, entry in products)
    outcome = SceneOutcome(
        scene=scene,
        station=keys["station"],
        instrument=keys["instrument"],
        start=parse_scene_id(scene)[1],
        granules=len({used.path for used in inputs if used.role is Role.SIGNAL}),
        plan=None,
        products=tuple(entry.record for entry in new),
    )
    return outcome, new
