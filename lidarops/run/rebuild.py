"""Enter products in the ledger again, from what their files say of themselves."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import groupby
from operator import attrgetter
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np

from lidarops.campaign.model import Campaign
from lidarops.catalog.ledger import Dependence, NewProduct, Run, RunStatus, SceneEntry
from lidarops.catalog.lock import Lock
from lidarops.catalog.rows import day_of
from lidarops.catalog.store import Store
from lidarops.errors import LidarOpsError, ProductError
from lidarops.figures.series_data import blocks
from lidarops.kinds import flags_of, kinds
from lidarops.netcdf.context import path_of_product
from lidarops.netcdf.read import opened_product, reading
from lidarops.netcdf.stored_flags import recoding
from lidarops.netcdf.variables import QUALITY_FLAG
from lidarops.plan.scenes import parse_scene_id
from lidarops.records import Plan, ProductRecord, Role, SceneOutcome
from lidarops.run.recipe import Recipe
from lidarops.run.session import new_run
from lidarops.run.staleness import Judge, Judgement
from lidarops.scene import dependence
from lidarops.scene.context import recorded_settings
from lidarops.scene.job import Job
from lidarops.system.files import sha256_of
from lidarops.system.output_files import product_paths

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


@dataclass(frozen=True, slots=True)
class _ProductFile:
    """What a product file says of itself."""

    path: str
    recipe: Recipe
    record: ProductRecord
    mtime_ns: int

    @property
    def scene(self) -> str:
        return self.recipe.plan.scene

    @property
    def start(self) -> datetime:
        return parse_scene_id(self.scene)[1]


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
        return _Rebuilding(campaign, store, lock, progress).carry_out()


@dataclass(slots=True)
class _Rebuilding:
    """Enters the products of one day after the other, so that memory holds those of one."""

    campaign: Campaign
    store: Store
    lock: Lock
    progress: Callable[[int], None]
    rebuilt: Rebuilt = field(default_factory=Rebuilt)
    run: Run | None = None
    """None until there is something to enter."""

    def carry_out(self) -> Rebuilt:
        with self.store.all_products() as made:
            known = {product.path for product in made}
        paths: dict[int | None, list[str]] = defaultdict(list)
        for path in product_paths(self.campaign.products_root):
            if path in known:
                self.rebuilt.known += 1
                self.progress(1)
            else:
                paths[_day_in(path)].append(path)
        # Says which name each of them should have.
        self._read(paths.pop(None, []))
        judge = Judge(self.campaign, self.store)
        for batch in judge.batches(day for day in paths if day is not None):
            judgements = {judged.scene.id: judged for judged in judge.days(batch).judgements}
            for day in batch:
                products = sorted(self._read(paths[day]), key=_order)
                for scene, members in groupby(products, attrgetter("scene")):
                    self._enter(judge, judgements.get(scene), day, tuple(members))
        if self.run is not None:
            refused = len(self.store.refused())
            self.store.end_run(
                self.run.id, RunStatus.FINISHED, refused=refused, token=self.lock.token
            )
        return self.rebuilt

    def _read(self, paths: Iterable[str]) -> list[_ProductFile]:
        """Return the products among some files, and note what the others are."""
        products = []
        for path in paths:
            self.progress(1)
            try:
                products.append(_read_product(self.campaign, path))
            except LidarOpsError as error:
                root = f"{self.campaign.products_root}/"
                self.rebuilt.problems[path] = str(error).removeprefix(root)
        return products

    def _enter(
        self, judge: Judge, judged: Judgement | None, day: int, products: tuple[_ProductFile, ...]
    ) -> None:
        if self.run is None:
            self.run = new_run(self.campaign)
            self.store.begin_run(self.run, self.lock.token)
        self.rebuilt.entered += len(products)
        self.rebuilt.without_scene += len(products) if judged is None else 0
        self.store.record(_entry(judge, judged, day, products), self.run.id, self.lock.token)


def _day_in(path: str) -> int | None:
    """Return the day in the name of a product; None if it is no such name."""
    try:
        return day_of(parse_scene_id(PurePosixPath(path).stem)[1])
    except ValueError:
        return None


def _order(product: _ProductFile) -> tuple[str, str]:
    return product.scene, product.path


def _read_product(campaign: Campaign, path: str) -> _ProductFile:
    file = campaign.products_root / path
    with reading(file):
        return _read_file(campaign, path, file)


def _read_file(campaign: Campaign, path: str, file: Path) -> _ProductFile:
    recipe = Recipe.of(file)
    if recipe.campaign_name != campaign.name:
        raise ProductError(f"is a product of campaign {recipe.campaign_name!r}", file=file)
    if recipe.kind not in kinds():
        raise ProductError(f"is of the unknown kind {recipe.kind!r}", file=file)
    if path != _expected_path(recipe):
        raise ProductError(f"should have the name {_expected_path(recipe)}", file=file)
    status = file.stat()
    values, unflagged, usable = _counts(file, recipe.kind)
    record = ProductRecord(
        path=path,
        kind=recipe.kind,
        channel=recipe.channel,
        sha256=sha256_of(file),
        size=status.st_size,
        values=values,
        flagged={},
        unflagged=unflagged,
        usable=usable,
        stamp=recipe.stamp,
    )
    return _ProductFile(path, recipe, record, status.st_mtime_ns)


def _counts(file: Path, kind: str) -> tuple[int, int, int]:
    """Return the numbers of all values of a product, of those without any bit, and of usable ones.

    The file may be larger than memory.
    """
    rejecting = np.int32(flags_of(kind).rejecting)
    unflagged = usable = 0
    with opened_product(file, in_parts=True, decode_cf=False) as product:
        flags = product[QUALITY_FLAG]
        recode = recoding(flags.attrs, kind)
        for block in blocks(flags, _BLOCK):
            values = recode(block.to_numpy()) if recode else block.to_numpy()
            unflagged += int(np.count_nonzero(values == 0))
            usable += int(np.count_nonzero(values & rejecting == 0))
    return flags.size, unflagged, usable


def _expected_path(recipe: Recipe) -> str:
    keys, window = recipe.settings["keys"], recipe.settings["window"]
    names = (keys["station"], keys["instrument"], recipe.kind, recipe.channel)
    return path_of_product(names, recipe.plan.scene, datetime.fromisoformat(window[0]))


def _entry(
    judge: Judge, judged: Judgement | None, day: int, products: tuple[_ProductFile, ...]
) -> SceneEntry:
    first = products[0]
    keys = first.recipe.settings["keys"]
    signals = {used.path for used in first.recipe.inputs if used.role is Role.SIGNAL}
    outcome = SceneOutcome(
        scene=first.scene,
        station=keys["station"],
        instrument=keys["instrument"],
        start=first.start,
        granules=len(signals),
        plan=None,
        products=tuple(product.record for product in products),
    )
    new = tuple(
        NewProduct(
            product.record,
            product.mtime_ns,
            _dependence(judge, judged, product.recipe),
            (*product.recipe.inputs, *dependence.unused_inputs(product.recipe.unused)),
        )
        for product in products
    )
    return SceneEntry(outcome=outcome, day=day, key="", final=False, products=new)


def _dependence(judge: Judge, judged: Judgement | None, recipe: Recipe) -> Dependence:
    """Return what a product depends on; as of now, as far as it was made so."""
    recorded = Dependence(
        plan_hash=recipe.plan.hash,
        settings_hash=dependence.digest(recipe.settings),
        inputs_hash=dependence.inputs_digest(recipe.inputs),
        code_version=recipe.code_version,
    )
    product = (recipe.kind, recipe.channel)
    if judged is None or product not in dependence.planned_products(judged.plan):
        return recorded
    closure = dependence.plan_closure(judged.plan, [product])
    job = Job(judge.campaign, judged.scene, judged.plan)
    settings = recorded_settings(job, judged.scene, closure, product)
    now, _ = judge.depends_on(judged.scene, judged.plan, product, recipe.inputs)
    if dependence.digest(settings) == recorded.settings_hash:
        recorded = replace(recorded, settings_hash=now.settings_hash)
    if _is_carried_out(closure, recipe.plan):
        recorded = replace(recorded, plan_hash=now.plan_hash)
    return recorded


def _is_carried_out(planned: Plan, recorded: Plan) -> bool:
    """Return whether a plan became another one when the data were looked at.

    That leaves out parts of products, and changes nothing else.
    """
    recorded_omissions = [omission.as_dict() for omission in recorded.left_out]
    planned_omissions = [omission.as_dict() for omission in planned.left_out]
    return (
        _comparable(planned) == _comparable(recorded)
        and recorded_omissions[: len(planned_omissions)] == planned_omissions
    )


def _comparable(plan: Plan) -> list[dict[str, Any]]:
    """Return the steps of a plan without the settings of products, which a look may change."""
    return [
        step.as_dict() | ({"settings": {}} if dependence.is_product(step) else {})
        for step in plan.steps
    ]
