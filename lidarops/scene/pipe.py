"""The pipe from raw counts to the profiles of a channel: its stages, in their order."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, Generic, TypeVar

from lidarops.records import LeftOut, PlannedStep, is_glued
from lidarops.scene import conditioning, gluing
from lidarops.scene.case import ChannelCase, Entry
from lidarops.scene.channels import prepared_channels
from lidarops.scene.data import ChannelSignal, Source
from lidarops.settings import SettingsModel

S = TypeVar("S", bound=SettingsModel)


# No slots: typing sets an attribute of generic instances, where it can.
@dataclass(frozen=True)
class Stage(Generic[S]):
    """One stage: the settings that a plan states, the decision, and its execution."""

    settings: type[S]
    decide: Callable[[ChannelCase], Entry]
    carry_out: Callable[[S, ChannelSignal], None]


PIPE: Final[Mapping[str, Stage[Any]]] = MappingProxyType(
    {
        "read": Stage(conditioning.ReadSettings, conditioning.plan_read, conditioning.read),
        "overlap": Stage(
            conditioning.OverlapSettings, conditioning.plan_overlap, conditioning.overlap
        ),
        "range_offset": Stage(
            conditioning.RangeOffsetSettings,
            conditioning.plan_range_offset,
            conditioning.shift_ranges,
        ),
        "dark": Stage(
            conditioning.DarkSettings, conditioning.plan_dark, conditioning.subtract_dark
        ),
        "dead_time": Stage(
            conditioning.DeadTimeSettings,
            conditioning.plan_dead_time,
            conditioning.correct_dead_time,
        ),
        "noise": Stage(conditioning.NoiseSettings, conditioning.plan_noise, conditioning.weigh),
        "lag": Stage(gluing.LagSettings, gluing.plan_lag, gluing.give_lag),
        "glue": Stage(gluing.GlueSettings, gluing.plan_glue, gluing.glue),
        "molecular": Stage(
            conditioning.MolecularSettings, conditioning.plan_molecular, conditioning.give_air
        ),
    }
)
"""The stages by name, in the order in which they run."""
_OF_FILES: Final = ("read", "overlap", "range_offset", "dark", "dead_time", "noise")
"""From the counts of a channel of the files to its profiles."""
_OF_GLUED: Final = ("read", "overlap", "lag", "glue")
"""From two channels of the files to the profiles of the glued one."""
AIR: Final = "molecular"
"""Stage that runs once a channel, if one of its products needs it."""


def plan_stages(case: ChannelCase) -> list[Entry]:
    """Return what is decided from the counts of a channel to its profiles.

    Only that it is not read, if no product needs the channel.
    """
    reading, *others = _OF_GLUED if is_glued(case.channel.name) else _OF_FILES
    read = PIPE[reading].decide(case)
    if isinstance(read, LeftOut):
        return [read]
    return [read, *(PIPE[name].decide(case) for name in others)]


def channel_signal(source: Source, steps: Iterable[PlannedStep], channel: str) -> ChannelSignal:
    """Return the signal of a channel, for which the planned stages are carried out.

    Parameters
    ----------
    source : Source
    steps : iterable of PlannedStep
        Of the plan, in its order.
    channel : str
    """
    stages: Sequence[PlannedStep] = [step for step in steps if not step.product]
    signals: dict[str, ChannelSignal] = {}
    for name in prepared_channels(steps, channel):
        signals[name] = ChannelSignal(source, name, signals)
        for step in stages:
            if step.channel == name:
                stage = PIPE[step.name]
                stage.carry_out(stage.settings.model_validate(dict(step.settings)), signals[name])
    return signals[channel]
