"""A job: everything that a worker needs to process one scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from lidarops.campaign.model import Campaign, InstrumentFacts
from lidarops.records import Plan, Scene, Stamp
from lidarops.scene.case import REQUEST
from lidarops.scene.dependence import ProductKey, is_product, scene_facts


@dataclass(frozen=True, slots=True)
class Place:
    """What stands at the place of a product that is made."""

    stamp: Stamp
    """Of the product to be made."""
    sha256: str = ""
    """Of the product that it replaces; empty where it replaces none."""
    former: Stamp = field(default_factory=Stamp)
    """Of that product."""


@dataclass(frozen=True, slots=True)
class Job:
    """Everything that a worker needs to process one scene."""

    campaign: Campaign
    scene: Scene
    plan: Plan
    profiles_per_chunk: int | None = None
    products: tuple[ProductKey, ...] | None = None
    """Those to write; all of the plan where None. The others are only compared with them."""
    places: Mapping[ProductKey, Place] = field(default_factory=dict)
    """Of products that were made before."""

    def place(self, kind: str, channel: str) -> Place:
        """Return what stands at the place of a product."""
        return self.places.get((kind, channel), Place(Stamp()))

    def writes(self, kind: str, channel: str) -> bool:
        """Whether a product is written."""
        return self.products is None or (kind, channel) in self.products

    @property
    def facts(self) -> InstrumentFacts:
        """Facts about the instrument at the time of the scene."""
        return scene_facts(self.campaign, self.scene)


def nothing_to_do(plan: Plan) -> str:
    """Return why a plan makes no product: omissions of requested steps, those of products first."""
    requested = [omission for omission in plan.left_out if omission.rule != REQUEST]
    omissions = sorted(requested or plan.left_out, key=lambda omission: not is_product(omission))
    reasons = dict.fromkeys(
        f"{omission.name} of {omission.channel}: {omission.reason}" for omission in omissions
    )
    return "nothing to do: " + "; ".join(reasons)
