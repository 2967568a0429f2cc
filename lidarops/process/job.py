"""A job: everything that a worker needs to process one scene."""

from __future__ import annotations

from dataclasses import dataclass

from lidarops.campaign.model import Campaign, InstrumentFacts
from lidarops.records import Plan, PlannedStep, Scene
from lidarops.steps.dependence import scene_facts


@dataclass(frozen=True, slots=True)
class Job:
    """Everything that a worker needs to process one scene."""

    campaign: Campaign
    scene: Scene
    plan: Plan
    profiles_per_chunk: int | None = None
    only: str | None = None
    """The channel whose products are made; all channels where None."""

    def concerns(self, step: PlannedStep) -> bool:
        """Whether the products of the step's channel are made."""
        return self.only in (None, step.channel)

    @property
    def facts(self) -> InstrumentFacts:
        """Facts about the instrument at the time of the scene."""
        return scene_facts(self.campaign, self.scene)
