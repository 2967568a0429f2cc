"""The case on which a step decides: one channel of a scene, with facts and requested products."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from lidarops.campaign.model import ChannelFacts, InstrumentFacts
from lidarops.records import ChannelLayout, LeftOut, PlannedStep, Scene
from lidarops.settings import ChannelProduct
from lidarops.steps.step import Leave, Run, Step


@dataclass(frozen=True, slots=True)
class ChannelCase:
    """One channel of a scene, as the steps see it before any signal is read."""

    scene: Scene
    channel: ChannelLayout
    facts: InstrumentFacts
    facts_of_channel: ChannelFacts
    all_steps: bool = False
    """Whether steps without effect run too."""
    member: str = ""
    """Instrument of a network; empty for a single instrument."""
    requests: Mapping[str, ChannelProduct] = field(default_factory=dict)
    """Requested kinds of product of the channel, with their settings."""
    request: Any = None
    """Settings of the kind of product whose steps are decided; None for shared steps."""
    product: str = ""
    """Name of that kind; empty for shared steps."""
    requesters: tuple[str, ...] = ()
    """Glued channels and networks for which the channel is read besides."""
    networks: tuple[str, ...] = ()
    """Networks that use the channel."""

    @property
    def last(self) -> float:
        """Far end of the last bin, m, without range offset."""
        return self.channel.bins * self.channel.bin_width

    def of_product(self, product: str, request: Any) -> ChannelCase:
        """Return the case for the steps of a kind of product, with its settings."""
        return replace(self, request=request, product=product)

    def decisions(self, step: Step[Any]) -> Iterator[PlannedStep | LeftOut]:
        """Yield what a step decides, as entries of a plan."""
        for decision in step.decide(self):
            yield self.entry(step.name, decision)

    def entry(self, name: str, decision: Run | Leave) -> PlannedStep | LeftOut:
        """Return a decision as an entry of a plan."""
        reason = f"{self.member}: {decision.reason}" if self.member else decision.reason
        common: dict[str, Any] = {
            "name": name,
            "channel": self.channel.name,
            "reason": reason,
            "instrument": self.member,
            "rule": decision.rule or name,
            "number": decision.number,
            "product": self.product,
        }
        if isinstance(decision, Leave):
            return LeftOut(**common)
        settings = decision.settings.model_dump(mode="json", exclude_none=True)
        return PlannedStep(settings=settings, **common)
