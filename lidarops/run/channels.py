"""The channels of the files of a campaign: their names, and those that no or not all files hold.

Names follow from recorders, and from what the facts state. A requested channel that no file holds
is a typing error, one that some files lack is a changed lidar.
"""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from typing import Final

from lidarops.campaign.model import Campaign, Instrument, InstrumentFacts
from lidarops.catalog.granules import joined_notes
from lidarops.catalog.store import Store
from lidarops.raw.header import Layout, label_of, named_layout, recorder_names
from lidarops.records import (
    FactsNote,
    FileNote,
    Granule,
    Holding,
    Unmet,
    glued_parts,
    is_glued,
)
from lidarops.run.options import Selection
from lidarops.scene.case import (
    ABSENT,
    LAG_STEP,
    UNMATCHED,
    joined_layout,
    missing_channels,
    named_channels,
)

_ROUNDING_OF_WAVELENGTHS: Final = 1e-9
"""m; headers hold whole nanometres."""
FACTS: Final = "facts"
_FIRST: Final = datetime.min.replace(tzinfo=UTC)
_LAST: Final = datetime.max.replace(tzinfo=UTC)


def unused_lidar_ratios(
    name: str, facts: InstrumentFacts, instrument: Instrument
) -> Iterator[FactsNote]:
    """Yield the lidar ratios of analog channels that a glued channel does not take.

    Parameters
    ----------
    name : str
        Key of the instrument.
    facts : InstrumentFacts
    instrument : Instrument
    """
    named = named_channels(instrument.products.requested)
    for glued in [name for name in named if is_glued(name)]:
        analog, photon = glued_parts(glued)
        of_analog, of_photon = (_has_lidar_ratio(facts, part) for part in (analog, photon))
        if of_analog and not of_photon and analog not in named:
            reason = f"not used: {glued} takes the lidar ratio of {photon}"
            yield FactsNote(name, f"lidar ratio of {analog}", reason)


def _has_lidar_ratio(facts: InstrumentFacts, channel: str) -> bool:
    given = facts.channels.get(channel)
    return given is not None and (
        given.lidar_ratio is not None or given.lidar_ratio_profile is not None
    )


def validity_edges(campaign: Campaign) -> list[datetime]:
    """Return the times at which facts of any instrument change, rising."""
    edges = {
        edge
        for instrument in campaign.instruments.values()
        for facts in instrument.facts
        for edge in (facts.valid_from, facts.valid_to)
    }
    return sorted(edges - {_FIRST, _LAST})


def unavailable_channels(
    campaign: Campaign,
    holdings: Iterable[Holding],
    instruments: Collection[str],
    selection: Selection,
) -> tuple[Unmet, ...]:
    """Return the channels that are requested or have facts, and that files of an instrument lack.

    A requested channel is looked for in all files of its instrument, one with facts in the files
    of the period of the facts.

    Parameters
    ----------
    campaign : Campaign
    holdings : iterable of Holding
        Of all files, cut at `validity_edges`.
    instruments : collection of str
        Restricts the result to these instruments of the campaign.
    selection : Selection
        Restricts requested channels to its kinds, and facts to periods that touch its times.

    Returns
    -------
    tuple of Unmet
        Channels that no file holds come first.
    """
    all_files, held = Counter[tuple[str, str]](), Counter[tuple[str, str]]()
    lacking: dict[tuple[str, str, str], list[tuple[int, str]]] = defaultdict(list)
    for holding in holdings:
        name, files = holding.instrument, holding.files
        if name not in instruments:
            continue
        instrument = campaign.instruments[name]
        facts = instrument.facts_at(holding.since)
        held.update({(name, channel.name): files for channel in holding.layout})
        all_files.update({(name, requester): files for requester in ("", period_of(facts))})
        for requester, channel, reason in _lacking(holding, instrument, facts, selection):
            lacking[name, requester, channel].append((files, reason))
    unmet = []
    for (name, requester, channel), counts in lacking.items():
        of_facts = requester.startswith(FACTS)
        files = sum(count for count, _ in counts)
        whole = all_files[name, requester if of_facts else ""]
        having = held[name, channel] if of_facts else whole - files
        unmet.append(Unmet(name, channel, requester, max(counts)[1], files, whole, having))
    return tuple(sorted(unmet, key=lambda request: (not request.nowhere, request.instrument)))


def _lacking(
    holding: Holding, instrument: Instrument, facts: InstrumentFacts, selection: Selection
) -> Iterator[tuple[str, str, str]]:
    """Yield what requests a channel that some files lack, the channel, and why."""
    since, until = selection.since, selection.until
    touched = (since is None or facts.valid_to > since) and (
        until is None or facts.valid_from < until
    )
    reasons = {}
    requested = instrument.products.requested
    glued = joined_layout(holding.layout, named_channels(requested))
    for left in missing_channels(holding.layout, glued, requested, facts):
        if left.rule == ABSENT and (not selection.kinds or left.name in selection.kinds):
            reasons[left.name, left.channel] = left.reason
        elif left.rule == UNMATCHED and touched and left.name != LAG_STEP:
            reasons[period_of(facts), left.channel] = left.reason
    for (requester, channel), reason in reasons.items():
        yield requester, channel, reason


def exchanged_recorders(holdings: Iterable[Holding]) -> Iterator[FactsNote]:
    """Yield the channels of which no file holds both recorders: one may have replaced the other."""
    found: dict[tuple[str, str], dict[tuple[str, str], set[int]]] = defaultdict(dict)
    for number, held in enumerate(holdings):
        for channel in held.layout:
            alike = found[held.instrument, label_of(channel.name)]
            alike.setdefault((channel.name, channel.recorder), set()).add(number)
    for (instrument, _), alike in sorted(found.items()):
        for (name, recorder), (other, new) in itertools.combinations(sorted(alike), 2):
            if name != other and new and alike[name, recorder].isdisjoint(alike[other, new]):
                reason = (
                    f"no file holds both its recorder {new} and {recorder} of {name}: if it took"
                    f" its place, state recorder: {new} for {name} in the facts from then on"
                )
                yield FactsNote(instrument, other, reason)


def period_of(facts: InstrumentFacts) -> str:
    """Return the period of facts, such as ``facts from 2024-01-01T00:00:00Z``."""
    first = "" if facts.valid_from == _FIRST else f" from {facts.valid_from:%Y-%m-%dT%H:%M:%SZ}"
    last = "" if facts.valid_to == _LAST else f" to {facts.valid_to:%Y-%m-%dT%H:%M:%SZ}"
    return f"{FACTS}{first}{last}"


def overridden_wavelengths(layout: Layout, facts: InstrumentFacts) -> Iterator[str]:
    """Yield facts of the campaign that override the wavelengths of headers."""
    for channel in layout:
        given = facts.channels.get(channel.name)
        wavelength = given.wavelength if given else None
        # Not where the wavelength of the header is implausible, and so NaN.
        if wavelength and abs(wavelength - channel.wavelength) > _ROUNDING_OF_WAVELENGTHS:
            yield (
                f"{channel.name}: wavelength {wavelength * 1e9:.5g} nm of the campaign overrides"
                f" {channel.wavelength * 1e9:.5g} nm of the header"
            )


class ChannelNames:
    """Names that mean one recorder in all files of an instrument that the catalog knows."""

    def __init__(self, campaign: Campaign, store: Store) -> None:
        self._instruments = campaign.instruments
        self._stored = store.holdings(validity_edges(campaign))
        self._bound = store.channel_names()
        self._layouts: dict[tuple[object, Layout], Layout] = {}
        self.holdings = [
            replace(held, layout=self._layout(held.instrument, held.layout, facts))
            for held in self._stored
            if held.instrument in campaign.instruments
            for facts in [campaign.instruments[held.instrument].facts_at(held.since)]
        ]
        """Those of the instruments of the campaign, with these names."""

    def granule(self, granule: Granule) -> Granule:
        """Return a good granule whose channels have these names."""
        if granule.instrument not in self._instruments or granule.start is None:
            return granule
        facts = self._instruments[granule.instrument].facts_at(granule.start)
        layout = self._layout(granule.instrument, granule.layout, facts)
        notes = (*granule.notes, *overridden_wavelengths(layout, facts))
        return replace(granule, layout=layout, notes=notes)

    def notes(self, instruments: Collection[str]) -> tuple[FileNote, ...]:
        """Return a note for each wavelength in the headers of instruments that facts override."""
        return joined_notes(
            FileNote(held.instrument, text, contradicts=False, files=held.files)
            for held in self.holdings
            if held.instrument in instruments
            for facts in [self._instruments[held.instrument].facts_at(held.since)]
            for text in overridden_wavelengths(held.layout, facts)
        )

    def _layout(self, instrument: str, layout: Layout, facts: InstrumentFacts) -> Layout:
        stated = {name: fact.recorder for name, fact in facts.channels.items() if fact.recorder}
        key = (instrument, *stated.items())
        if (key, layout) not in self._layouts:
            own = (held for held in self._stored if held.instrument == instrument)
            files = ((held.layout, held.files, held.first) for held in own)
            names = recorder_names(files, stated, self._bound.get(instrument))
            self._layouts[key, layout] = named_layout(layout, names)
        return self._layouts[key, layout]
