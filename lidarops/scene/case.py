"""The case on which a plan is decided: one channel of a scene, with facts and requested products.

A decision is an entry of the plan: something runs, or is left out, with the reason.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Final, Generic, TypeVar

from lidarops.campaign.model import ChannelFacts, InstrumentFacts
from lidarops.records import ChannelLayout, LeftOut, PlannedStep, Scene
from lidarops.settings import ChannelProduct, SettingsModel

R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)

ALL_STEPS: Final = "all_steps is set: no bin, section or file is skipped"
REQUESTED: Final = "requested by the campaign"
NOT_REQUESTED: Final = "not requested by the campaign"
REQUEST: Final = "request"
"""Name of the rule that leaves out what the campaign does not request."""

Entry = PlannedStep | LeftOut
Entries = Iterator[Entry]


class NoSettings(SettingsModel):
    """Settings of an entry of a plan that has none."""


@dataclass(frozen=True, slots=True)
class ChannelCase:
    """One channel of a scene, as the pipe sees it before any signal is read."""

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
    """Kind of product that is decided; empty for the pipe."""

    @property
    def last(self) -> float:
        """Far end of the last bin, m, without range offset."""
        return self.channel.bins * self.channel.bin_width

    def of_product(self, product: str, request: R) -> ProductCase[R]:
        """Return the case of a kind of product, with its settings."""
        shared = {known.name: getattr(self, known.name) for known in fields(self)}
        return ProductCase(**{**shared, "product": product}, request=request)

    def run(
        self,
        name: str,
        reason: str,
        settings: SettingsModel | None = None,
        *,
        needs: Sequence[str] = (),
        number: float | None = None,
        rule: str = "",
        warning: str = "",
    ) -> PlannedStep:
        """Return the entry of something that runs.

        Parameters
        ----------
        name, reason : str
        settings : SettingsModel, optional
        needs : sequence of str
            Entries from which it takes something, if the plan holds them: ``name``, or
            ``channel/name`` of another channel.
        number : float, optional
            On which the rule decided.
        rule : str
            That decided, if not of that name.
        warning : str
            Why its results may be of no use; `lidarops plan` prints it.
        """
        stated = {} if settings is None else settings.model_dump(mode="json", exclude_none=True)
        origin = self._origin(name, reason, number, rule)
        return PlannedStep(settings=stated, needs=tuple(needs), warning=warning, **origin)

    def leave(
        self, name: str, reason: str, *, number: float | None = None, rule: str = ""
    ) -> LeftOut:
        """Return the entry of something, or of a part of it, that is left out; as `run`."""
        return LeftOut(**self._origin(name, reason, number, rule))

    def _origin(self, name: str, reason: str, number: float | None, rule: str) -> dict[str, Any]:
        return {
            "name": name,
            "channel": self.channel.name,
            "reason": f"{self.member}: {reason}" if self.member else reason,
            "instrument": self.member,
            "rule": rule or name,
            "number": number,
            "product": self.product,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class ProductCase(ChannelCase, Generic[R_co]):
    """One channel of a scene, as a kind of product sees it."""

    request: R_co
    """Settings of the kind in the campaign file."""
