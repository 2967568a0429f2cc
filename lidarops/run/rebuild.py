"""Enter products in the ledger again, from what their files say of themselves."""

from __future__ import annotations

import secrets
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import groupby
from operator import attrgetter
from typing import Any, Final

import numpy as np
import xarray as xr

from lidarops import __version__
from lidarops.campaign.model import Campaign
from lidarops.catalog.ledger import Dependence, NewProduct, Run, RunStatus, SceneEntry
from lidarops.catalog.lock import Lock
from lidarops.catalog.rows import day_of
from lidarops.catalog.store import Store
from lidarops.errors import ProductError
from lidarops.kinds import flags_of, kinds
from lidarops.netcdf.context import path_of_product
from lidarops.netcdf.stored_flags import with_current_flags
from lidarops.netcdf.variables import QUALITY_FLAG
from lidarops.plan.scenes import parse_scene_id
from lidarops.process.context import recorded_settings
from lidarops.process.job import Job
from lidarops.records import Plan, ProductRecord, Role, SceneOutcome
from lidarops.run.archive import update_catalog
from lidarops.run.recipe import Recipe
from lidarops.run.staleness import Judge, Judgement
from lidarops.steps import dependence
from lidarops.system.code_version import joint_code_version
from lidarops.system.files import sha256_of
from lidarops.system.output_files import product_paths
from lidarops.system.stores import without_keys

_UNREADABLE: Final = (
    ProductError, OSError, RuntimeError, ValueError, KeyError, IndexError, TypeError,
)  # fmt: skip
"""Exceptions of damaged and foreign files; that of HDF5 depends on the place of the damage."""


@dataclass(slots=True)
class Rebuilt:
    """What a rebuilt ledger was made from."""

    entered: int = 0
    """Products that were entered."""
    known: int = 0
    """Products that the ledger knew already."""
    without_scene: int = 0
    """Entered products of scenes of which no raw file is left."""
    problems: dict[str, str] = field(default_factory=dict)
    """Path -> why it was not entered."""


@dataclass(frozen=True, slots=True)
class _Found:
    """A product file."""

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
    """Update the catalog, and enter the products that the ledger does not know.

    Each product states its inputs, plan, settings and code. One that was made with the present
    settings from the present files is fresh afterwards; any other is stale. Products whose raw
    files are gone are entered, too: the next run names them.

    Parameters
    ----------
    campaign : Campaign
    wait : float
        s to wait for another run on the same catalog.
    progress : callable, optional
        Called with 1 for each product that was read.

    Raises
    ------
    CatalogError
        If the catalog cannot be used, or another run holds it.
    """
    update_catalog(campaign, wait=wait)
    rebuilt = Rebuilt()
    with Store(campaign.catalog_url, campaign.name) as store, Lock(store, wait=wait) as lock:
        lock.acquire()
        with store.all_products() as made:
            known = {product.path for product in made}
        found: dict[int, list[_Found]] = defaultdict(list)
        for path in product_paths(campaign.products_root):
            progress(1)
            if path in known:
                rebuilt.known += 1
                continue
            try:
                product = _found(campaign, path)
                found[day_of(product.start)].append(product)
            except _UNREADABLE as error:
                rebuilt.problems[path] = str(error).removeprefix(f"{campaign.products_root}/")
        if found:
            _enter(campaign, store, lock, found, rebuilt)
    return rebuilt


def _found(campaign: Campaign, path: str) -> _Found:
    """Return what a product file says of itself."""
    file = campaign.products_root / path
    recipe = Recipe.of(file)
    if recipe.campaign_name != campaign.name:
        raise ProductError(f"is a product of campaign {recipe.campaign_name!r}", file=file)
    if recipe.kind not in kinds():
        raise ProductError(f"is of the unknown kind {recipe.kind!r}", file=file)
    if path != _expected_path(recipe):
        raise ProductError(f"should have the name {_expected_path(recipe)}", file=file)
    status = file.stat()
    with xr.open_dataset(file, decode_cf=False) as product:
        values = with_current_flags(product[[QUALITY_FLAG]].load())[QUALITY_FLAG].to_numpy()
    rejecting = np.int32(flags_of(recipe.kind).rejecting)
    record = ProductRecord(
        path=path,
        kind=recipe.kind,
        channel=recipe.channel,
        sha256=sha256_of(file),
        size=status.st_size,
        values=values.size,
        flagged={},
        unflagged=int(np.count_nonzero(values == 0)),
        usable=int(np.count_nonzero(values & rejecting == 0)),
        stamp=recipe.stamp,
    )
    return _Found(path, recipe, record, status.st_mtime_ns)


def _expected_path(recipe: Recipe) -> str:
    keys, window = recipe.settings["keys"], recipe.settings["window"]
    names = (keys["station"], keys["instrument"], recipe.kind, recipe.channel)
    return path_of_product(names, recipe.plan.scene, datetime.fromisoformat(window[0]))


def _enter(
    campaign: Campaign,
    store: Store,
    lock: Lock,
    found: Mapping[int, list[_Found]],
    rebuilt: Rebuilt,
) -> None:
    now = datetime.now(UTC)
    run = Run(
        id=f"{now:%Y%m%dT%H%M%S}-{secrets.token_hex(3)}",
        started=now,
        finished=None,
        status=RunStatus.RUNNING,
        holder=Lock.holder_name(),
        version=__version__,
        code_version=joint_code_version(),
        archive=without_keys(campaign.archive),
        folder=str(campaign.folder),
    )
    store.begin_run(run, lock.token)
    judge = Judge(campaign, store)
    for batch in judge.batches(found):
        judgements = {judged.scene.id: judged for judged in judge.days(batch).judgements}
        for day in batch:
            for scene, members in groupby(sorted(found[day], key=_order), attrgetter("scene")):
                judged = judgements.get(scene)
                products = tuple(members)
                rebuilt.entered += len(products)
                rebuilt.without_scene += len(products) if judged is None else 0
                entry = _entry(judge, judged, day, products)
                store.record(entry, run.id, lock.token)
    store.end_run(run.id, RunStatus.FINISHED, refused=len(store.refused()), token=lock.token)


def _order(found: _Found) -> tuple[str, str]:
    return found.scene, found.path


def _entry(
    judge: Judge, judged: Judgement | None, day: int, products: tuple[_Found, ...]
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
            product.recipe.inputs,
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
