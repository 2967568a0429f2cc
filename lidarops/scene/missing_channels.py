"""Channels that a campaign requests or gives facts of, and that the files of a scene lack."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

from lidarops.campaign.model import Instrument, InstrumentFacts, channel_facts
from lidarops.raw.recorders import label_of
from lidarops.records import ChannelLayout, LeftOut, is_glued
from lidarops.scene.channels import LAG_STEP, READ_STEP, file_channels, glued_parts, joined_layout

ABSENT: Final = "channel_present"
UNMATCHED: Final = "facts_fit"
"""Rules that leave out what the files lack."""


def named_channels(instrument: Instrument) -> list[str]:
    """Return the channels that the products of an instrument request by name, or are made of."""
    requested = instrument.products.requested().values()
    return list(
        dict.fromkeys(
            name
            for settings in requested
            for channel in settings.named
            for name in (channel, *settings.companions(channel))
        )
    )


def missing_channels(
    layout: tuple[ChannelLayout, ...], instrument: Instrument, facts: InstrumentFacts
) -> Iterator[LeftOut]:
    """Yield the channels that a campaign requests or gives facts of, and that files lack.

    Parameters
    ----------
    layout : tuple of ChannelLayout
        Channels of the files.
    instrument : Instrument
    facts : InstrumentFacts
        The facts about it at the time of the files.
    """
    present = {channel.name: channel for channel in layout}
    glued = [channel.name for channel in joined_layout(layout, named_channels(instrument))]
    for kind, settings in instrument.products.requested().items():
        for name in settings.named:
            if name not in present and name not in glued:
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
