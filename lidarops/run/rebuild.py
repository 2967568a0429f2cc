"""Enter products in the ledger again, from what their files say of themselves."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Final

from lidarops.campaign.model import Campaign
from lidarops.catalog.lock import Lock
from lidarops.catalog.store import Dependence, LastTry, NewProduct, RunStatus, Store
from lidarops.errors import LidarOpsError, ProductError
from lidarops.kinds import kinds
from lidarops.netcdf.context import product_path
from lidarops.netcdf.read import opened_product, reading
from lidarops.netcdf.stored_flags import (
    FlagCounter,
    all_bits,
    blocks,
    flags_names,
    rejecting_mask,
)
from lidarops.records import Findings, ProductRecord, Role, SceneOutcome, Verdicts, day_of
from lidarops.run.ledger_run import JudgedDays, LedgerRun
from lidarops.run.recipe import Recipe
from lidarops.run.scenes import MONTH, parse_scene_id
from lidarops.run.staleness import Judge, settings_digest
from lidarops.scene import dependence
from lidarops.system.files import product_paths, sha256_of

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


_Product = tuple[Recipe, NewProduct]
"""What a product file says of itself, and its entry."""


def _scene(product: _Product) -> str:
    return product[0].plan.scene


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
    file = campaign.products_root / path
    with reading(file):
        recipe = Recipe.of(file)
        keys, kind, channel = recipe.settings["keys"], recipe.kind, recipe.channel
        if recipe.campaign_name != campaign.name:
            raise ProductError(f"is a product of campaign {recipe.campaign_name!r}", file=file)
        if kind not in kinds():
            raise ProductError(f"is of the unknown kind {kind!r}", file=file)
        names = (keys["station"], keys["instrument"], kind, channel)
        start = datetime.fromisoformat(recipe.settings["window"][0])
        name = product_path(names, recipe.plan.scene, start)
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
    with opened_product(file, in_parts=True, decode_cf=False) as product:
        counts = FlagCounter(rejecting_mask(all_bits(product)))
        for name in flags_names(product):
            for block in blocks(product[name], _BLOCK):
                counts.add(block.to_numpy())
    return counts.verdicts


def _outcome(products: tuple[_Product, ...]) -> tuple[SceneOutcome, tuple[NewProduct, ...]]:
    """Return the outcome of a scene that gave some products, and these."""
    recipe = products[0][0]
    keys, scene = recipe.settings["keys"], recipe.plan.scene
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
