"""What is left over: scenes that can give no product, and products that would not be made again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from functools import cached_property

from lidarops.campaign.model import Campaign
from lidarops.campaign.product_settings import Products
from lidarops.catalog.ledger import Made
from lidarops.plan import product_dependence
from lidarops.plan.scenes import Cut, instrument_and_start
from lidarops.plan.signal_rules import GLUED, StepName
from lidarops.process.scene import nothing_to_do
from lidarops.records import Granule, InputRecord, Plan, ProductKind, Scene

Planned = tuple[Scene, Plan]
"""A scene, and all that the campaign asks for of it."""


@dataclass(frozen=True, slots=True)
class Orphan:
    """A product that would not be made again."""

    path: str
    reason: str
    run: str
    """The one that made it."""
    asked: bool = False
    """Whether the campaign still asks for it, and its files, or others of its scene, no longer
    allow it."""
    lost: bool = False
    """Whether the campaign still asks for it, and no raw file of its scene is left."""


class Fate(StrEnum):
    """What became of the signal files that a product was made from, whose scene is gone."""

    CUT_ANEW = "its files are cut into other scenes now"
    UNUSED = "its raw files are refused, or stand in no scene"
    GONE = "no raw file of its scene is left"


class Fates:
    """Tells what became of the signal files of products.

    Parameters
    ----------
    found : Cut
        The scenes of some days, and the good granules that stand in none.
    refused : callable
        Gives the granules that the catalog refuses; asked once, and only where it matters.
    signals : callable
        Of a product, the signal files that it was made from.
    """

    def __init__(
        self,
        found: Cut,
        refused: Callable[[], Iterable[Granule]],
        signals: Callable[[Made], Iterable[InputRecord]],
    ) -> None:
        self._found = found
        self._refused = refused
        self._signals = signals

    def of(self, made: Made) -> Fate:
        """Return what became of the files of a product, of those that are left where some are."""
        signals = list(self._signals(made))
        if any(used.path in self._in_scenes or used.sha256 in self._in_scenes for used in signals):
            return Fate.CUT_ANEW
        return Fate.UNUSED if any(used.path in self._idle for used in signals) else Fate.GONE

    @cached_property
    def _in_scenes(self) -> set[str | None]:
        granules = (granule for scene in self._found.scenes for granule in scene.granules)
        return {name for granule in granules for name in (granule.path, granule.sha256)}

    @cached_property
    def _idle(self) -> set[str]:
        return {granule.path for granule in (*self._refused(), *self._found.set_aside)}


def scenes_without_product(planned: Iterable[Planned], campaign: Campaign) -> dict[str, str]:
    """Return the scenes that can give no product and serve none of a network, and why.

    Parameters
    ----------
    planned : iterable of (Scene, Plan)
        All of some days.
    campaign : Campaign
    """
    everything = list(planned)
    idle = [(scene, told) for scene, told in everything if not product_dependence.wanted(told)]
    serving = {each.path for scene, _ in everything if scene.members for each in scene.granules}
    found = {}
    for scene, told in idle:
        networks = _of_networks_alone(scene, campaign)
        if not networks:
            found[scene.id] = nothing_to_do(told)
        elif not any(granule.path in serving for granule in scene.granules):
            found[scene.id] = (
                f"nothing to do: used by network {' and '.join(networks)} alone, of which no other"
                " instrument has files then"
            )
    return found


def _of_networks_alone(scene: Scene, campaign: Campaign) -> list[str]:
    """Return the networks of an instrument that is asked for nothing itself."""
    owner = campaign.instruments.get(scene.instrument)
    if owner is None or owner.products != Products():
        return []
    return [
        name for name, each in campaign.networks.items() if scene.instrument in each.instruments
    ]


def orphaned_products(
    planned: Sequence[Planned],
    made: Iterable[Made],
    campaign: Campaign,
    other_files: Callable[[Made, Scene], bool],
    fate: Callable[[Made], Fate],
) -> list[tuple[Made, Orphan]]:
    """Return the products that would not be made again, and why.

    Parameters
    ----------
    planned : sequence of (Scene, Plan)
        All of some days.
    made : iterable of Made
        The products of those days.
    campaign : Campaign
    other_files : callable
        Whether a product was made from other signal files than its scene has now.
    fate : callable
        What became of the signal files of a product whose scene is gone; `Fates.of`.

    Returns
    -------
    list of (Made, Orphan)
    """
    scenes = {scene.id: (scene, told) for scene, told in planned}
    asked = {
        (scene.id, kind.value, channel)
        for scene, told in planned
        for kind, channel in product_dependence.wanted(told)
    }
    found = []
    for each in made:
        if each.key in asked:
            continue
        reason, kept, lost = "the campaign does not ask for it any more", False, False
        if _asks(campaign, each):
            if each.scene in scenes:
                scene, told = scenes[each.scene]
                reason, kept = _why(told, each), other_files(each, scene)
            else:
                absent = _absent(each, planned, campaign)
                became = fate(each)
                # What cannot be read now may have been the only good bytes.
                kept = bool(absent) or became is Fate.UNUSED
                lost = not absent and became is Fate.GONE
                reason = absent or became.value
        found.append((each, Orphan(each.path, reason, each.run, kept, lost)))
    return found


def _asks(campaign: Campaign, product: Made) -> bool:
    """Return whether the campaign asks its instrument or network for a product."""
    name, _ = instrument_and_start(product.scene)
    if name in campaign.networks:
        channel = campaign.networks[name].visibility.channel
        return (product.kind, product.channel) == (ProductKind.VISIBILITY.value, channel)
    owner = campaign.instruments.get(name)
    settings = None if owner is None else getattr(owner.products, product.kind, None)
    if settings is None:
        return False
    if settings.channels == "all":
        return not product.channel.startswith(GLUED)
    return product.channel in settings.channels


def _why(told: Plan, product: Made) -> str:
    """Return why a plan leaves out a product that is asked for."""
    reasons = dict.fromkeys(
        left.reason
        for left in told.left_out
        if left.channel == product.channel and left.name in (product.kind, StepName.READ)
    )
    return "; ".join(reasons) or "its plan leaves it out"


def _absent(product: Made, planned: Sequence[Planned], campaign: Campaign) -> str:
    """Return which instruments of a network lack files, so that too few are left; else nothing."""
    name, start = instrument_and_start(product.scene)
    if name not in campaign.networks:
        return ""
    there = {scene.instrument for scene, _ in planned if _holds(scene, start)}
    lost = [each for each in campaign.networks[name].instruments if each not in there]
    # Where the network has a scene then, that one replaces the one that is gone.
    if name in there or len(lost) in {0, len(campaign.networks[name].instruments)}:
        return ""
    return f"no raw file of {' and '.join(lost)} is left"


def _holds(scene: Scene, moment: datetime) -> bool:
    return scene.start <= moment < scene.stop
