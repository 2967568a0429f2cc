"""Find what is left over or lost, of scenes, products and raw files.

Scenes may give no product, and products may not be made again. Raw files that products were made
from may be lost: a product is neither removed nor replaced by one of fewer files where more than a
few are lost, of it or of all products with lost files, or all its dark files. The listing may be
incomplete, or a disk not mounted.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, NamedTuple

from lidarops.campaign.model import Campaign
from lidarops.campaign.path_patterns import path_matcher
from lidarops.catalog.store import RecordedProduct, Store
from lidarops.netcdf.context import product_path
from lidarops.records import (
    INVALID,
    MISDATED,
    FactsNote,
    Granule,
    LostFiles,
    Plan,
    Role,
    Scene,
    UnusedFile,
    is_glued,
)
from lidarops.run.options import requested_products
from lidarops.run.scenes import Cut, parse_scene_id
from lidarops.scene import dependence
from lidarops.scene.case import NO_PRODUCT, READ_STEP, REQUEST
from lidarops.scene.dependence import ProductKey
from lidarops.scene.job import nothing_to_do

_NAMES_SHOWN: Final = 3
_IDLE: Final = (
    "matches no raw file that is lost, refused or unused: take the entry out, or correct it"
)
_OVER: Final = "has expired: its files count again; take the entry out, or set until later"

Planned = tuple[Scene, Plan]
"""A scene, and the plan of all its requested products."""


class Orphan(NamedTuple):
    """A product that would not be made again."""

    product: RecordedProduct
    reason: str
    requested: bool = False
    """Whether the campaign still requests it but the present files do not allow it."""
    lost: bool = False
    """Whether the campaign still requests it, but no raw file of its scene is left."""

    @property
    def path(self) -> str:
        """Path of the product."""
        return self.product.path


@dataclass(frozen=True, slots=True)
class Lost:
    """The lost raw files of a campaign."""

    findings: tuple[LostFiles, ...] = ()
    """What a report says of those that the campaign does not acknowledge, by instrument."""
    protected: frozenset[str] = frozenset()
    """Products that are neither replaced nor removed."""
    excused: frozenset[str] = frozenset()
    """Products of which the campaign acknowledges lost files."""
    idle: tuple[FactsNote, ...] = ()
    """Entries of `acknowledged` that match no lost file, or have expired."""
    unused: Mapping[str, Collection[UnusedFile]] = field(default_factory=dict)
    """Lost files of each product, without acknowledged ones: a product made again states them."""


def scenes_without_product(planned: Sequence[Planned], campaign: Campaign) -> dict[str, str]:
    """Return the scenes that give no product and are used by no network, and why.

    Parameters
    ----------
    planned : sequence of (Scene, Plan)
        All scenes of some days.
    campaign : Campaign
    """
    in_networks = {
        granule.path for scene, _ in planned if scene.members for granule in scene.granules
    }
    reasons = {}
    for scene, plan in planned:
        if plan.product_keys:
            continue
        owner = campaign.instruments.get(scene.instrument)
        networks = [
            name
            for name, network in campaign.networks.items()
            if owner and scene.instrument in network.instruments
        ]
        if not networks or (owner and owner.products.requested):
            reasons[scene.id] = nothing_to_do(plan)
        elif not any(granule.path in in_networks for granule in scene.granules):
            reasons[scene.id] = (
                f"nothing to do: used only by network {' and '.join(networks)}, of which no other"
                " instrument has files at that time"
            )
    return reasons


def unmade_products(campaign: Campaign, planned: Iterable[Planned]) -> dict[str, list[str]]:
    """Return the requested products that no scene gives, by ``OWNER KIND CHANNEL``, and why.

    There is no reason where an instrument or network has no scene.
    """
    plans = defaultdict[str, list[Plan]](list)
    for scene, plan in planned:
        plans[scene.instrument].append(plan)
    unmade = {}
    for owner in (*campaign.instruments, *campaign.networks):
        made = {(step.name, step.channel) for plan in plans[owner] for step in plan.products}
        for kind, channel in requested_products(campaign, owner):
            if any(kind == name and channel in ("", other) for name, other in made):
                continue
            reasons = dict.fromkeys(
                left.reason
                for plan in plans[owner]
                for left in plan.left_out
                if left.name in (kind, READ_STEP)
                and channel in ("", left.channel)
                and left.rule != REQUEST
            )
            unmade[f"{owner} {kind} {channel}"] = list(reasons) or [""] * bool(plans[owner])
    return unmade


@dataclass(frozen=True)
class Leftovers:
    """Finds the products of some days that would not be made again, and why."""

    campaign: Campaign
    store: Store
    planned: Mapping[str, Planned]
    """All scenes of these days, by id."""
    cut: Cut
    """The same scenes, and the good granules that belong to none."""
    content: Callable[[Granule], str]
    """Returns the SHA-256 of a granule."""
    lost: Lost

    def orphans(self, made: Iterable[RecordedProduct]) -> list[Orphan]:
        """Return those of the products of these days that no scene would give.

        Without those whose raw files the campaign acknowledges as lost. Products whose raw files
        may come back are kept.
        """
        wanted = {
            product_file(scene, product)
            for scene, plan in self.planned.values()
            for product in plan.product_keys
        }
        orphans = []
        for product in made:
            if product.path in wanted:
                continue
            reason, kept, lost = self._fate(product)
            stays = product.path in self.lost.protected
            if stays or not (lost and product.path in self.lost.excused):
                orphans.append(Orphan(product, reason, kept or stays, lost and not stays))
        return orphans

    def _fate(self, product: RecordedProduct) -> tuple[str, bool, bool]:
        """Return why no scene gives a product, whether it is kept, and whether it is lost."""
        if not _requests(self.campaign, product):
            return "the campaign no longer requests it", False, False
        if product.scene in self.planned:
            return *self._left_out(product), False
        missing = self._missing_members(product)
        if missing:
            return missing, True, False
        signals = self._signals(product)
        if not self._in_scenes.isdisjoint({*signals, *signals.values()}):
            return "its files belong to other scenes now", False, False
        idle = [self._idle[path] for path in signals if path in self._idle]
        if idle:
            # Unreadable files may be the only copies.
            kept = not all(reason.startswith((INVALID, MISDATED)) for reason in idle)
            why = "are refused, or belong to no scene" if kept else "are invalid or of another date"
            return f"its raw files {why}", kept, False
        return "no raw file of its scene is left", False, True

    def _left_out(self, product: RecordedProduct) -> tuple[str, bool]:
        """Return why the plan of its scene gives a product no more, and whether it is kept."""
        scene, plan = self.planned[product.scene]
        if (product.kind, product.channel) in plan.product_keys:
            return "it has another name now", False
        omissions = [
            left
            for left in plan.left_out
            if left.channel == product.channel and left.name in (product.kind, "read")
        ]
        reason = "; ".join(dict.fromkeys(left.reason for left in omissions))
        # The file may be mended, or the product come that is missing, and this one is right.
        mending = (dependence.UNUSABLE_FILE, NO_PRODUCT)
        unusable = any(left.rule in mending for left in omissions)
        kept = unusable or set(self._signals(product).values()) != {
            self.content(granule) for granule in scene.granules
        }
        return reason or "its plan leaves it out", kept

    def _missing_members(self, product: RecordedProduct) -> str:
        """Return which instruments of a network have no files left; empty if not the cause."""
        name, start = parse_scene_id(product.scene)
        if name not in self.campaign.networks:
            return ""
        members = self.campaign.networks[name].instruments
        scenes = (scene for scene, _ in self.planned.values())
        present = {scene.instrument for scene in scenes if scene.start <= start < scene.stop}
        missing = [member for member in members if member not in present]
        # If the network has a scene at that time, it replaces the one that is gone.
        if name in present or len(missing) in {0, len(members)}:
            return ""
        return f"no raw file of {' and '.join(missing)} is left"

    def _signals(self, product: RecordedProduct) -> dict[str, str]:
        """Return path -> SHA-256 of the signal files that a product was made from."""
        inputs = self.store.inputs_of(product.path)
        return {used.path: used.sha256 for used in inputs if used.role is Role.SIGNAL}

    @cached_property
    def _in_scenes(self) -> set[str | None]:
        granules = (granule for scene in self.cut.scenes for granule in scene.granules)
        return {name for granule in granules for name in (granule.path, granule.sha256)}

    @cached_property
    def _idle(self) -> dict[str, str]:
        """Files that belong to no scene, and why they are refused."""
        idle = (*self.store.refused(), *self.cut.set_aside)
        return {granule.path: granule.reason for granule in idle}


def product_file(scene: Scene, product: ProductKey) -> str:
    """Return the path of a product, by which it is known, below the folder of products."""
    return product_path((scene.station, scene.instrument, *product), scene.id, scene.start)


def _requests(campaign: Campaign, product: RecordedProduct) -> bool:
    """Return whether the campaign requests a product of its instrument or network."""
    name, _ = parse_scene_id(product.scene)
    if name in campaign.networks:
        joint = campaign.networks[name].requested.get(product.kind)
        return joint is not None and joint.channel == product.channel
    owner = campaign.instruments.get(name)
    settings = None if owner is None else owner.products.requested.get(product.kind)
    of_files = not is_glued(product.channel)
    return settings is not None and settings.covers(product.channel, of_files=of_files)


def find_lost(campaign: Campaign, store: Store) -> Lost:
    """Return the raw files that products were made from and the archive does not give.

    Files whose content is found under another path, and those that no instrument of the campaign
    claims any more, are not lost.
    """
    claims = {
        name: path_matcher((*instrument.files, *instrument.dark_files))
        for name, instrument in campaign.instruments.items()
    }
    inputs = store.lost_inputs()
    owners = {path: name for _, path in inputs for name, has in claims.items() if has(path)}
    unused_paths = {granule.path for granule in store.refused()}
    for verdict in store.verdicts().values():
        unused_paths.update(verdict.set_aside)
    known, idle = _acknowledged(campaign, owners, unused_paths)
    if not owners:
        return Lost(idle=idle)
    sets = store.raw_sets()
    size, lost, gone = Counter[str](), Counter[str](), Counter[str]()
    excused, products_of = set[str](), defaultdict[str, set[str]](set)
    unused = defaultdict[str, set[UnusedFile]](set)
    is_dark = {name: path_matcher(each.dark_files) for name, each in campaign.instruments.items()}
    for raw in sets.values():
        size.update(dict.fromkeys(raw.products, raw.files))
    for name, path in inputs:
        products, owner = sets[name].products, owners.get(path)
        gone[name] += path in owners
        if path in known:
            excused.update(products)
        elif owner is not None:
            lost.update(products)
            products_of[owner].update(products)
            file = UnusedFile.lost(path, Role.DARK if is_dark[owner](path) else Role.SIGNAL)
            for product in products:
                unused[product].add(file)
    unknown = sorted(owners.keys() - known)
    concerned = {name for name, raw in sets.items() if not lost.keys().isdisjoint(raw.products)}
    total = store.count_raw(concerned, known) if concerned else 0

    def too_many(files: int, of: int) -> bool:
        return files > 1 and files > campaign.vanished_share * of

    many = too_many(len(unknown), total)
    without_dark = {
        product
        for name, files in gone.items()
        if sets[name].role is Role.DARK and files == sets[name].files
        for product in sets[name].products
        if campaign.vanished_share < 1
    }
    protected = frozenset(
        product
        for product, files in lost.items()
        if many or product in without_dark or too_many(files, size[product])
    )
    findings = []
    for owner, products_with in sorted(products_of.items()):
        paths = tuple(path for path in unknown if owners[path] == owner)
        kept = len(products_with & protected)
        findings.append(LostFiles(owner, len(paths), total, paths[:_NAMES_SHOWN], kept))
    return Lost(tuple(findings), protected, frozenset(excused), idle, unused)


def _acknowledged(
    campaign: Campaign, lost: Iterable[str], unused: Iterable[str]
) -> tuple[set[str], tuple[FactsNote, ...]]:
    """Return the lost files that the campaign acknowledges, and its entries that match nothing.

    They may match files that are refused or belong to no scene (`unused`), too.
    """
    known: set[str] = set()
    idle = []
    for entry in campaign.acknowledged:
        matches = path_matcher(entry.what)
        if entry.holds:
            known.update(filter(matches, lost))
        if not entry.holds or not any(map(matches, (*lost, *unused))):
            reason = _IDLE if entry.holds else _OVER
            idle.append(FactsNote("all", f"acknowledged: {', '.join(entry.what)}", reason))
    return known, tuple(idle)
