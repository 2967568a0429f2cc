"""Steps, rules and cases: what every rule of a plan shares."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Final

from lidarops.campaign.model import ChannelFacts, InstrumentFacts
from lidarops.products.elastic.settings import ElasticSettings
from lidarops.products.homogeneous.settings import HomogeneousSettings
from lidarops.products.multiangle.settings import MultiAngleSettings
from lidarops.products.signal.settings import SignalSettings
from lidarops.records import ChannelLayout, LeftOut, Scene, Step

ALL_STEPS: Final = "all_steps is set: no bin, section or file is skipped"
REQUESTED: Final = "requested by the campaign"
NOT_REQUESTED: Final = "not requested by the campaign"
NO_PRODUCT: Final = "no product of the campaign uses this channel"
NO_WAVELENGTH: Final = "the wavelength in the header is implausible, and no facts give one"
ANALOG_NOISE: Final = "the noise of an analog record is estimated from all its bins"


class StepName(StrEnum):
    """Names of the steps, in the order in which they run."""

    READ = "read"
    RANGE_WINDOW = "range_window"
    OVERLAP = "overlap"
    RANGE_OFFSET = "range_offset"
    DARK = "dark"
    DEAD_TIME = "dead_time"
    NOISE = "noise"
    LAG = "lag"
    GLUE = "glue"
    BACKGROUND = "background"
    SIGNAL = "signal"
    LOOK = "look"
    HOMOGENEOUS = "homogeneous"
    ALONG_PATH = "along_path"
    AVERAGE = "average"
    MOLECULAR = "molecular"
    KNOWN_SHAPE = "known_shape"
    REFERENCE = "reference"
    ELASTIC = "elastic"
    GRADIENT = "gradient"
    GRADIENT_REGRESSOR = "gradient_regressor"
    ROBUST = "robust"
    VERTICAL = "vertical"
    CORRELATION = "correlation"
    LAYERS = "layers"
    MULTIANGLE = "multiangle"
    PRIOR = "prior"
    VISIBILITY = "visibility"


WHOLE: Final = (StepName.SIGNAL, StepName.ELASTIC, StepName.MULTIANGLE)
"""Products that need all bins of a channel."""


@dataclass(frozen=True, slots=True)
class Case:
    """One channel of a scene, as the rules see it."""

    scene: Scene
    channel: ChannelLayout
    facts: InstrumentFacts
    facts_of_channel: ChannelFacts
    member: str
    """Instrument of a network; empty for a single instrument."""

    def step(
        self, name: StepName, reason: str, *, number: float | None = None, **settings: Any
    ) -> Step:
        """Return a step of the channel; `number` is the number on which the rule decided."""
        return Step(
            name.value,
            self.channel.name,
            settings,
            self._of_member(reason),
            self.member,
            number=number,
        )

    def without(self, name: StepName, reason: str, *, number: float | None = None) -> LeftOut:
        """Return a step that is left out of the channel."""
        return LeftOut(
            name.value, self.channel.name, self._of_member(reason), self.member, number=number
        )

    def _of_member(self, reason: str) -> str:
        return f"{self.member}: {reason}" if self.member else reason


@dataclass(frozen=True, slots=True)
class ChannelCase(Case):
    """One channel of a single instrument, with the settings of its requested products."""

    signal: SignalSettings | None
    """None where the ``signal`` product of the channel is not requested."""
    homogeneous: HomogeneousSettings | None
    """None where the ``homogeneous`` product of the channel is not requested."""
    elastic: ElasticSettings | None
    """None where the ``elastic`` product of the channel is not requested."""
    multiangle: MultiAngleSettings | None
    """None where the ``multiangle`` product of the channel is not requested."""
    glued: tuple[str, ...]
    """Glued channels that use this one."""
    networks: tuple[str, ...]
    """Networks that use the channel."""
    all_steps: bool
    """Whether steps without effect run too."""

    @property
    def last(self) -> float:
        """Far end of the last bin, m, without range offset."""
        return self.channel.bins * self.channel.bin_width


Decisions = Iterator[Step | LeftOut]


@dataclass(frozen=True, slots=True)
class Rule:
    """A named rule: the step it concerns, its question, and the function that decides."""

    name: str
    step: StepName
    question: str
    decide: Callable[[Any], Decisions]
    """Takes the case of its stage, mostly a `Case`; yields nothing where the question does not
    arise."""

    def decisions(self, case: Any) -> Decisions:
        """Yield the decisions of the rule, with its name unless another rule has named them."""
        for decision in self.decide(case):
            yield replace(decision, rule=decision.rule or self.name)


def applied(rules: Iterable[Rule], case: Any) -> Decisions:
    """Yield the decisions of rules, in their order."""
    for rule in rules:
        yield from rule.decisions(case)
