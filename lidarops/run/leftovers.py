"""Find what is left over: scenes without product, and products that would not be made again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from functools import cached_property

from lidarops.campaign.model import Campaign
from lidarops.catalog.ledger import RecordedProduct
from lidarops.plan.scenes import Cut, parse_scene_id
from lidarops.records import GLUED, Granule, InputRecord, LeftOut, Plan, Scene
from lidarops.scene import dependence
from lidarops.scene.job import nothing_to_do

Planned = tuple[Scene, Plan]
"""A scene, and the plan of all its requested products."""


@dataclass(frozen=True, slots=True)
class Orphan:
    """A product that would not be made again."""

    path: str
    reason: str
    run: str
    """Id of the run that made it."""
    requested: bool = False
    """Whether the campaign still requests it but the present files do not allow it."""
    lost: bool = False
    """Whether the campaign still requests it, but no raw file of its scene is left."""


class Fate(StrEnum):
    """What happened to the signal files of a product whose scene no longer exists."""

    CUT_ANEW = "its files belong to other scenes now"
    UNUSED = "its raw files are refused, or belong to no scene"
    GONE = "no raw file of its scene is left"


class Fates:
    """Finds what happened to the signal files of products.

    Parameters
    ----------
    cut : Cut
        The scenes of some days, and the good granules that belong to none.
    refused : callable
        Returns the granules that the catalog refuses; called at most once.
    signals : callable
        Returns the signal files that a product was made from.
    """

    def __init__(
        self,
        cut: Cut,
        refused: Callable[[], Iterable[Granule]],
        signals: Callable[[RecordedProduct], Iterable[InputRecord]],
    ) -> None:
        self._cut = cut
        self._refused = refused
        self._signals = signals

    def of(self, made: RecordedProduct) -> Fate:
        """Return the fate of the files of a product; if some are left, the fate of these."""
        signals = list(self._signals(made))
        if any(used.path in self._in_scenes or used.sha256 in self._in_scenes for used in signals):
            return Fate.CUT_ANEW
        return Fate.UNUSED if any(used.path in self._idle for used in signals) else Fate.GONE

    @cached_property
    def _in_scenes(self) -> set[str | None]:
        granules = (granule for scene in self._cut.scenes for granule in scene.granules)
        return {name for granule in granules for name in (granule.path, granule.sha256)}

    @cached_property
    def _idle(self) -> set[str]:
        return {granule.path for granule in (*self._refused(), *self._cut.set_aside)}


def scenes_without_product(planned: Iterable[Planned], campaign: Campaign) -> dict[str, str]:
    """Return the scenes that give no product and are used by no network, and why.

    Parameters
    ----------
    planned : iterable of (Scene, Plan)
        All scenes of some days.
    campaign : Campaign
    """
    scenes = list(planned)
    without = [(scene, plan) for scene, plan in scenes if not dependence.planned_products(plan)]
    in_networks = {
        granule.path for scene, _ in scenes if scene.members for granule in scene.granules
    }
    reasons = {}
    for scene, plan in without:
        networks = _of_networks_alone(scene, campaign)
        if not networks:
            reasons[scene.id] = nothing_to_do(plan)
        elif not any(granule.path in in_networks for granule in scene.granules):
            reasons[scene.id] = (
                f"nothing to do: used only by network {' and '.join(networks)}, of which no other"
                " instrument has files at that time"
            )
    return reasons


def _of_networks_alone(scene: Scene, campaign: Campaign) -> list[str]:
    """Return the networks of an instrument that has no requested product of its own."""
    owner = campaign.instruments.get(scene.instrument)
    if owner is None or owner.products.requested():
        return []
    return [
        name
        for name, network in campaign.networks.items()
        if scene.instrument in network.instruments
    ]


def orphaned_products(
    planned: Sequence[Planned],
    made: Iterable[RecordedProduct],
    campaign: Campaign,
    other_files: Callable[[RecordedProduct, Scene], bool],
    fate: Callable[[RecordedProduct], Fate],
) -> list[tuple[RecordedProduct, Orphan]]:
    """Return the products that would not be made again, and why.

    Parameters
    ----------
    planned : sequence of (Scene, Plan)
        All scenes of some days.
    made : iterable of RecordedProduct
        The products of those days.
    campaign : Campaign
    other_files : callable
        Whether a product was made from other signal files than its scene has now.
    fate : callable
        Returns what happened to the signal files of a product whose scene is gone; `Fates.of`.

    Returns
    -------
    list of (RecordedProduct, Orphan)
    """
    scenes = {scene.id: (scene, plan) for scene, plan in planned}
    requested = {
        (scene.id, kind, channel)
        for scene, plan in planned
        for kind, channel in dependence.planned_products(plan)
    }
    orphans = []
    for product in made:
        if product.key in requested:
            continue
        reason, kept, lost = "the campaign no longer requests it", False, False
        if _requests(campaign, product):
            if product.scene in scenes:
                scene, plan = scenes[product.scene]
                omissions = _omissions(plan, product)
                reason = "; ".join(dict.fromkeys(left.reason for left in omissions))
                reason = reason or "its plan leaves it out"
                # The file may be mended, and the product is right.
                unusable = any(left.rule == dependence.UNUSABLE_FILE for left in omissions)
                kept = unusable or other_files(product, scene)
            else:
                missing = _missing_members(product, planned, campaign)
                file_fate = fate(product)
                # Unreadable files may be the only copies; keep the product.
                kept = bool(missing) or file_fate is Fate.UNUSED
                lost = not missing and file_fate is Fate.GONE
                reason = missing or file_fate.value
        orphans.append((product, Orphan(product.path, reason, product.run, kept, lost)))
    return orphans


def _requests(campaign: Campaign, product: RecordedProduct) -> bool:
    """Return whether the campaign requests a product of its instrument or network."""
    name, _ = parse_scene_id(product.scene)
    if name in campaign.networks:
        joint = campaign.networks[name].requested().get(product.kind)
        return joint is not None and joint.channel == product.channel
    owner = campaign.instruments.get(name)
    settings = None if owner is None else owner.products.requested().get(product.kind)
    of_files = not product.channel.startswith(GLUED)
    return settings is not None and settings.covers(product.channel, of_files=of_files)


def _omissions(plan: Plan, product: RecordedProduct) -> list[LeftOut]:
    """Return the omissions of a plan because of which it does not give a requested product."""
    return [
        omission
        for omission in plan.left_out
        if omission.channel == product.channel and omission.name in (product.kind, "read")
    ]


def _missing_members(
    product: RecordedProduct, planned: Sequence[Planned], campaign: Campaign
) -> str:
    """Return which instruments of a network have no files left; empty if this is not the cause."""
    name, start = parse_scene_id(product.scene)
    if name not in campaign.networks:
        return ""
    members = campaign.networks[name].instruments
    present = {scene.instrument for scene, _ in planned if _holds(scene, start)}
    missing = [member for member in members if member not in present]
    # If the network has a scene at that time, it replaces the one that is gone.
    if name in present or len(missing) in {0, len(members)}:
        return ""
    return f"no raw file of {' and '.join(missing)} is left"


def _holds(scene: Scene, moment: datetime) -> bool:
    return scene.start <= moment < scene.stop
