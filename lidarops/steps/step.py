"""What a plan is made of: choices, steps, and the steps that make products.

A choice has settings and a decision. A step is a choice that is carried out: it takes data from
other steps and gives data to them, by name. A making step takes such data and makes a product.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, TypeVar

from lidarops.records import LeftOut, Plan, PlannedStep, Role
from lidarops.settings import SettingsModel

if TYPE_CHECKING:
    from lidarops.steps.case import ChannelCase, ProductCase
    from lidarops.steps.data import Data, ProductStream
    from lidarops.steps.workload import Workload

T = TypeVar("T")
R = TypeVar("R")
S = TypeVar("S", bound=SettingsModel)
C_contra = TypeVar("C_contra", bound="ChannelCase", contravariant=True)

ALL_STEPS: Final = "all_steps is set: no bin, section or file is skipped"
REQUESTED: Final = "requested by the campaign"
NOT_REQUESTED: Final = "not requested by the campaign"
REQUEST: Final = "request"
"""Name of the rule that leaves out what the campaign does not request."""


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
    warning: str = ""
    """Why its results may be of no use; `lidarops plan` prints it."""


@dataclass(frozen=True, slots=True)
class Leave:
    """The decision that a step, or a part of it, is left out."""

    reason: str
    number: float | None = None
    """Number on which the rule decided, where there is one."""
    rule: str = ""
    """Name of the rule that decided, if not that of the step."""


Decisions = Iterator[Run | Leave]


class Definition(ABC, Generic[S]):
    """What an entry of a plan is about."""

    name: ClassVar[str]
    settings: type[S] = NoSettings  # type: ignore[assignment]  # of definitions without another
    """Model of the settings that a plan states."""

    def typed(self, planned: PlannedStep) -> S:
        """Return the settings of an entry of a plan as the model."""
        return self.settings.model_validate(dict(planned.settings))

    def settings_in(self, plan: Plan) -> S | None:
        """Return the settings in the plan of one product; None where it does not run."""
        return next((self.typed(step) for step in plan.steps if step.name == self.name), None)

    def files(self, settings: S) -> Mapping[str, Role]:  # noqa: ARG002 - most steps read none
        """Return the ancillary files that the step reads, by path, with their roles."""
        return {}

    def held(self, settings: S, work: Workload) -> float:  # noqa: ARG002 - most hold little
        """Return the estimated number of bytes that are held for the whole scene."""
        return 0.0

    def together(self, settings: S, work: Workload) -> int:  # noqa: ARG002 - most take any profiles
        """Return the largest number of profiles that a chunk must not part."""
        return 1


class Choice(Definition[S], Generic[C_contra, S]):
    """Something about a channel or a product that is decided from headers and campaign alone."""

    @abstractmethod
    def decide(self, case: C_contra) -> Decisions:
        """Yield at most one `Run`, and a `Leave` for whatever is left out."""

    def entries(self, case: C_contra) -> Iterator[PlannedStep | LeftOut]:
        """Yield what is decided, as entries of a plan."""
        for decision in self.decide(case):
            yield case.entry(self.name, decision)


class Step(Choice[C_contra, S]):
    """One step of the processing of a channel."""

    inputs: ClassVar[tuple[Datum[Any], ...]] = ()
    """What the step takes from other steps, where they run."""
    from_parts: ClassVar[tuple[Datum[Any], ...]] = ()
    """What the step takes from those of the two channels that are glued."""
    from_companions: ClassVar[tuple[Datum[Any], ...]] = ()
    """What the step takes from the steps of other channels."""
    outputs: ClassVar[tuple[Datum[Any], ...]] = ()

    def companions(self, settings: S) -> tuple[str, ...]:  # noqa: ARG002 - most need none
        """Return the other channels from which the step takes data."""
        return ()

    @abstractmethod
    def carry_out(self, settings: S, data: Data) -> None:
        """Put the outputs into the data of the channel."""


class MakingStep(Definition[S], Generic[R, S]):
    """The step that makes a product; it has the name of its kind."""

    inputs: ClassVar[tuple[Datum[Any], ...]] = ()
    """What it takes from steps, where they run."""
    parts: tuple[Definition[Any], ...] = ()
    """Other entries of the kind: steps, and choices by which the product is made."""


class ProductStep(MakingStep[R, S], Choice["ProductCase[R]", S]):
    """The step that makes a product of one channel."""

    parts: tuple[Choice[ProductCase[R], Any], ...] = ()
    """In the order in which they are decided."""
    from_companions: ClassVar[tuple[Datum[Any], ...]] = ()
    """What it takes from the steps of other channels."""

    def companions(self, settings: S) -> tuple[str, ...]:  # noqa: ARG002 - most need none
        """Return the other channels that the product is made of."""
        return ()

    @abstractmethod
    def stream(self, settings: S, data: Data) -> ProductStream:
        """Return the product in the making, which takes the profiles of the scene in chunks."""
