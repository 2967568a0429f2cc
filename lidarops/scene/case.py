"""The case on which a plan is decided: one channel of a scene, with facts and requested products.

A decision is an entry of the plan: something runs, or is left out, with the reason.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from pydantic_core import to_jsonable_python

from lidarops.campaign.model import ChannelFacts, InstrumentFacts, channel_facts
from lidarops.errors import SceneError
from lidarops.kinds import kinds
from lidarops.raw.header import label_of
from lidarops.records import (
    ChannelLayout,
    DetectionMode,
    LeftOut,
    PlannedStep,
    Role,
    Scene,
    file_channels,
    glued_parts,
    is_glued,
)
from lidarops.settings import ChannelProduct, SettingsModel

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

R_co = TypeVar("R_co", covariant=True)

ALL_STEPS: Final = "all_steps is set: no bin, section or file is skipped"
REQUESTED: Final = "requested by the campaign"
NOT_REQUESTED: Final = "not requested by the campaign"
NO_PRODUCT: Final = "products_read"
"""Name of the rule that leaves out what is made of products that are missing."""
REQUEST: Final = "request"
"""Name of the rule that leaves out what the campaign does not request."""
ANCILLARY_FILES: Final = {
    "molecular_profile": Role.MOLECULAR,
    "overlap_profile": Role.OVERLAP,
    "lidar_ratio_profile": Role.LIDAR_RATIO,
}
"""Facts, and settings of a plan, that name ancillary files, with their roles."""

Entry = PlannedStep | LeftOut
Entries = Iterator[Entry]


class NoSettings(SettingsModel):
    """Settings of an entry of a plan that has none."""


@dataclass(frozen=True, slots=True)
class ChannelCase(Generic[R_co]):
    """One channel of a scene, as the pipe and kinds of product see it before any signal is read."""

    scene: Scene
    channel: ChannelLayout
    facts: InstrumentFacts
    facts_of_channel: ChannelFacts
    """Of a glued channel, those of its photon-counting part."""
    request: R_co
    """Settings of the kind in the campaign file; None for the pipe."""
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
        """Far end of the last bin, m."""
        return self.channel.bins * self.channel.bin_width + self.range_offset

    @property
    def range_offset(self) -> float:
        """Shift of the ranges of the channel, m."""
        return range_offset(self.channel, self.facts_of_channel)

    def run(
        self,
        name: str,
        reason: str,
        settings: Any = None,
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
        settings : SettingsModel or dataclass, optional
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
        stated = {} if settings is None else to_jsonable_python(settings, exclude_none=True)
        left = self.leave(name, reason, number=number, rule=rule)
        origin = {item.name: getattr(left, item.name) for item in fields(left)}
        return PlannedStep(settings=stated, needs=tuple(needs), warning=warning, **origin)

    def leave(
        self, name: str, reason: str, *, number: float | None = None, rule: str = ""
    ) -> LeftOut:
        """Return the entry of something, or of a part of it, that is left out; as `run`."""
        stated = f"{self.member}: {reason}" if self.member else reason
        return LeftOut(
            name, self.channel.name, stated, self.member, rule or name, number, self.product
        )


READ_STEP: Final = "read"
LAG_STEP: Final = "lag"
"""Names of steps, for commands that need no plan and should not load the steps."""
DARK_FILES: Final = "dark_files"
"""Rule that subtracts the dark signal where there are dark files near the scene."""
ABSENT: Final = "channel_present"
UNMATCHED: Final = "facts_fit"
"""Rules that leave out what the files lack."""


def sources(step: PlannedStep) -> tuple[str, ...]:
    """Return the other channels whose profiles a step takes.

    Not those with which it is compared, or whose products it reads.
    """
    parts = [need.rpartition("/") for need in step.needs if "/" in need]
    reads = kinds()[step.product].reads if parts and step.product else ()
    return tuple(
        channel for channel, _, name in parts if name != step.product and name not in reads
    )


def prepared_channels(steps: Iterable[PlannedStep], channel: str) -> tuple[str, ...]:
    """Return the channels from which the products of a channel take data, each after its parts.

    The last one is the channel itself.
    """
    needed: dict[str, list[str]] = {}
    for step in steps:
        needed.setdefault(step.channel, []).extend(sources(step))
    order: dict[str, None] = {}

    def visit(name: str) -> None:
        for other in needed.get(name, ()):
            if other not in order and other != name:
                visit(other)
        order[name] = None

    visit(channel)
    return tuple(order)


def counted_channels(steps: Iterable[PlannedStep], channel: str) -> tuple[str, ...]:
    """Return the channels of the files from which the products of a channel are made."""
    return tuple(name for name in prepared_channels(steps, channel) if not is_glued(name))


def product_channel(
    name: str, mode: DetectionMode = DetectionMode.PHOTON, wavelength: float = math.nan
) -> ChannelLayout:
    """Return a channel without bins: of a network, or of products made of other products."""
    return ChannelLayout(name, mode, wavelength, bins=0, bin_width=math.nan, adc_bits=0)


def estimated_against(
    channel: ChannelLayout, facts: ChannelFacts, layout: Iterable[ChannelLayout]
) -> str:
    """Return the analog channel against which the dead time of a channel is to be estimated.

    Empty where none is requested, or the files hold none with the same bin width.
    """
    if facts.dead_time != "estimate" or channel.mode is not DetectionMode.PHOTON:
        return ""
    if is_glued(channel.name):
        return ""
    analog = channel.name.replace("photon_", "analog_", 1)
    same = (other for other in layout if other.name == analog)
    return next((other.name for other in same if other.bin_width == channel.bin_width), "")


def lag_is_unknown(facts: InstrumentFacts, analog: str, photon: str) -> bool:
    """Return whether the lag of an analog channel is to be estimated.

    The campaign states it as a lag, or by range offsets that differ between both channels.
    """
    of_analog, of_photon = (channel_facts(facts, name) for name in (analog, photon))
    if of_analog.lag is not None:
        return of_analog.lag == "estimate"
    return (of_analog.range_offset or 0.0) == (of_photon.range_offset or 0.0)


def joined_layout(
    layout: Iterable[ChannelLayout], names: Iterable[str]
) -> tuple[ChannelLayout, ...]:
    """Return the glued channels whose two parts are in the files with one bin width.

    They are in photon-counting units. Names of other channels are skipped.
    """
    present = {channel.name: channel for channel in layout}
    glued = []
    for name in sorted({name for name in names if is_glued(name)}):
        analog, photon = (present.get(part) for part in glued_parts(name))
        if analog and photon and analog.bin_width == photon.bin_width:
            glued.append(replace(photon, name=name, bins=min(analog.bins, photon.bins)))
    return tuple(glued)


def range_offset(channel: ChannelLayout, facts: ChannelFacts) -> float:
    """Return the shift of the ranges of a channel, m: the given offset minus the given lag.

    With what is left of the bin in which the pulse leaves.
    """
    late = facts.lag * channel.bin_width if isinstance(facts.lag, float) else 0.0
    offset = (facts.range_offset or 0.0) - late
    if channel.pre_trigger:
        offset += channel.before * channel.bin_width - channel.pre_trigger
    return offset


def member_channel(layout: Iterable[ChannelLayout], name: str) -> ChannelLayout:
    """Return a channel of the files, or one glued from two of them.

    Raises
    ------
    SceneError
        If the files hold no such channel.
    """
    layout = tuple(layout)
    for channel in (*layout, *joined_layout(layout, [name])):
        if channel.name == name:
            return channel
    held = ", ".join(channel.name for channel in layout)
    raise SceneError(f"the files hold no channel {name}, only {held}")


def channel_ranges(channel: ChannelLayout, facts: ChannelFacts) -> npt.NDArray[np.float64]:
    """Return the ranges of the bin centres of a channel, m."""
    import numpy as np  # noqa: PLC0415 - a run with nothing to do needs no numerics

    middles = (np.arange(channel.bins) + 0.5) * channel.bin_width
    return np.asarray(middles + range_offset(channel, facts))


def named_channels(requested: Mapping[str, ChannelProduct]) -> list[str]:
    """Return the channels that requested products name, or are made of."""
    return list(
        dict.fromkeys(
            name
            for settings in requested.values()
            for channel in settings.named
            for name in (channel, *settings.companions(channel))
        )
    )


def missing_channels(
    layout: Iterable[ChannelLayout],
    glued: Iterable[ChannelLayout],
    requested: Mapping[str, ChannelProduct],
    facts: InstrumentFacts,
) -> Iterator[LeftOut]:
    """Yield the channels that a campaign requests or gives facts of, and that files lack.

    Parameters
    ----------
    layout : iterable of ChannelLayout
        Channels of the files.
    glued : iterable of ChannelLayout
        Those of the requested channels that can be glued from them.
    requested : mapping of str to ChannelProduct
        Settings of the products that are requested of the instrument, by kind.
    facts : InstrumentFacts
        The facts about it at the time of the files.
    """
    present = {channel.name: channel for channel in layout}
    made = {*present, *(channel.name for channel in glued)}
    for kind, settings in requested.items():
        for name in settings.named:
            if name not in made:
                reason = _why_absent(name, present, channel_facts(facts, name).recorder)
                yield LeftOut(kind, name, reason, rule=ABSENT, product=kind)
    for name, facts_of_channel in facts.channels.items():
        if name not in present:
            reason = f"the facts name a channel that the files lack; {_instead(name, present)}"
            yield LeftOut(READ_STEP, name, reason, rule=UNMATCHED)
        elif facts_of_channel.lag is not None and not name.startswith("analog_"):
            reason = "a lag belongs to the facts of the analog channel"
            yield LeftOut(LAG_STEP, name, reason, rule=UNMATCHED)


def _instead(name: str, present: Mapping[str, ChannelLayout]) -> str:
    if is_glued(name) and set(glued_parts(name)) <= set(present):
        analog, photon = glued_parts(name)
        return f"give the lag to {analog}, and dead time and lidar ratio to {photon}"
    return f"they hold {_held(name, present)}"


def _held(missing: str, present: Mapping[str, ChannelLayout]) -> str:
    """Return the channels of files, with the recorders of those that are like a missing one."""
    labels = {label_of(name) for name in file_channels(missing)}
    recorders = {n: c.recorder for n, c in present.items() if label_of(n) in labels and c.recorder}
    return ", ".join(f"{n} (recorder {recorders[n]})" if n in recorders else n for n in present)


def _why_absent(name: str, present: Mapping[str, ChannelLayout], recorder: str | None) -> str:
    if is_glued(name):
        parts = glued_parts(name)
        if set(parts) <= set(present):
            widths = [f"{present[part].bin_width:g} m" for part in parts]
            return f"its analog and photon-counting channels have bins of {' and '.join(widths)}"
        missing = [part for part in parts if part not in present]
        return f"the files hold no {' and no '.join(missing)} to glue"
    stated = f" of the recorder {recorder} that the facts state" if recorder else ""
    return f"the files hold no such channel{stated}, only {_held(name, present)}"
