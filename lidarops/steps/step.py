"""What a step is: typed settings, inputs and outputs by name, a decision, and its execution."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, TypeVar

from lidarops.records import LeftOut, Plan, PlannedStep, Role, Scene
from lidarops.settings import SettingsModel

if TYPE_CHECKING:
    from lidarops.steps.case import ChannelCase
    from lidarops.steps.data import Data, ProductStream

T = TypeVar("T")
S = TypeVar("S", bound=SettingsModel)

ALL_STEPS: Final = "all_steps is set: no bin, section or file is skipped"
REQUESTED: Final = "requested by the campaign"
NOT_REQUESTED: Final = "not requested by the campaign"


# No slots: typing sets an attribute of generic instances, where it can.
@dataclass(frozen=True)
class Datum(Generic[T]):
    """Name of something that one step gives and others take."""

    name: str


class NoSettings(SettingsModel):
    """Settings of a step that has none."""


@dataclass(frozen=True, slots=True)
class Run:
    """The decision that a step runs."""

    reason: str
    settings: SettingsModel = field(default_factory=NoSettings)
    number: float | None = None
    """Number on which the rule decided, where there is one."""
    rule: str = ""
    """Name of the rule that decided, if not that of the step."""


@dataclass(frozen=True, slots=True)
class Leave:
    """The decision that a step, or a part of it, is left out."""

    reason: str
    number: float | None = None
    """Number on which the rule decided, where there is one."""
    rule: str = ""
    """Name of the rule that decided, if not that of the step."""


Decisions = Iterator[Run | Leave]


class Step(ABC, Generic[S]):
    """One step of the processing of a channel."""

    name: ClassVar[str]
    settings: ClassVar[type[SettingsModel]] = NoSettings
    """Model of the settings that a plan states."""
    inputs: ClassVar[tuple[Datum[Any], ...]] = ()
    """What the step takes from other steps, where they run."""
    outputs: ClassVar[tuple[Datum[Any], ...]] = ()

    @abstractmethod
    def decide(self, case: ChannelCase) -> Decisions:
        """Yield at most one `Run`, and a `Leave` for whatever is left out."""

    @abstractmethod
    def carry_out(self, settings: S, data: Data) -> None:
        """Put the outputs into the data of the channel."""

    def files(self, settings: S) -> Mapping[str, Role]:  # noqa: ARG002 - most steps read none
        """Return the ancillary files that the step reads, by path, with their roles."""
        return {}


@dataclass(frozen=True, slots=True)
class UnitCosts:
    """CPU time and memory of a kind of product on a common server core, without a calibration."""

    product: float
    """s for one product."""
    value: float
    """s for one value of `ProductStep.values`."""
    figure: float
    """s for the figures of one channel of an instrument, for all scenes together."""
    load: float = 0.0
    """s to load the compiled code of the kind, once a process."""


class MakingStep(Step[S]):
    """The step that makes a product; it has the name of its kind, and is the last of its steps."""

    costs: ClassVar[UnitCosts]
    drawn_whole: ClassVar[bool] = False
    """Whether figures show every value, so that their cost grows with the number of values."""

    @abstractmethod
    def values(self, settings: S, scene: Scene, plan: Plan) -> float:
        """Return the number of values that are computed, which the CPU time is proportional to."""

    def held(self, settings: S, scene: Scene, plan: Plan) -> float:  # noqa: ARG002
        """Return the number of bytes that the product holds for the whole scene."""
        return 0.0


class ProductStep(MakingStep[S]):
    """The step that makes a product of one channel."""

    @abstractmethod
    def stream(self, settings: S, data: Data) -> ProductStream:
        """Return the product in the making, which takes the profiles of the scene in chunks."""

    def carry_out(self, settings: S, data: Data) -> None:
        """Put the stream into the data of the product."""
        data.stream = self.stream(settings, data)

    def refined(self, planned: PlannedStep, look: Look) -> tuple[PlannedStep, list[LeftOut]]:  # noqa: ARG002
        """Return the planned step without the parts in which sampled profiles show nothing.

        For steps whose decision needs data; `look` gives the profiles of some granules.
        """
        return planned, []


@dataclass(frozen=True, slots=True)
class Look:
    """Some profiles of a scene, for a decision that needs data."""

    plan: Plan
    scene: Scene
    """With usable granules only."""
    profiles: Any
    """Callable (channel, granules) -> power, variance and quality of the channel."""
