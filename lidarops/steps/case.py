"""The case on which a step decides: one channel of a scene, with facts and requested products."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Generic, TypeVar

from lidarops.campaign.model import ChannelFacts, InstrumentFacts
from lidarops.records import ChannelLayout, LeftOut, PlannedStep, Scene
from lidarops.settings import ChannelProduct
from lidarops.steps.step import Leave, Run

R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)


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
    requesters: tuple[str, ...] = ()
    """Glued channels and networks for which the channel is read besides."""
    networks: tuple[str, ...] = ()
    """Networks that use the channel."""
    product: str = ""
    """Kind of product whose steps are decided; empty for shared steps."""

    @property
    def last(self) -> float:
        """Far end of the last bin, m, without range offset."""
        return self.channel.bins * self.channel.bin_width

    def of_product(self, product: str, request: R) -> ProductCase[R]:
        """Return the case for the steps of a kind of product, with its settings."""
        shared = {known.name: getattr(self, known.name) for known in fields(self)}
        return ProductCase(**{**shared, "product": product}, request=request)

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
        return PlannedStep(settings=settings, warning=decision.warning, **common)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProductCase(ChannelCase, Generic[R_co]):
    """One channel of a scene, as the steps of a kind of product see it."""

    request: R_co
    """Settings of the kind in the campaign file."""
