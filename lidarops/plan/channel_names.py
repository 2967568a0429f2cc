"""Names of the channels of a campaign: by their recorders, and as the facts state them."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from datetime import datetime
from typing import Final

from lidarops.campaign.model import Campaign, InstrumentFacts, channel_facts
from lidarops.catalog.store import Store
from lidarops.plan.availability import validity_edges
from lidarops.plan.outlying_headers import joined_notes
from lidarops.raw.header import Layout, named_layout, recorder_names
from lidarops.records import FileNote, Granule

_ROUNDING_OF_WAVELENGTHS: Final = 1e-9
"""m; headers hold whole nanometres."""


def overridden_wavelengths(layout: Layout, facts: InstrumentFacts) -> Iterator[str]:
    """Yield facts of the campaign that override the wavelengths of headers."""
    for channel in layout if facts.channels else ():
        wavelength = channel_facts(facts, channel.name).wavelength
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
            replace(held, layout=self._layout(held.instrument, held.layout, held.since))
            for held in self._stored
            if held.instrument in campaign.instruments
        ]
        """Those of the instruments of the campaign, with these names."""

    def granule(self, granule: Granule) -> Granule:
        """Return a good granule whose channels have these names."""
        if granule.instrument not in self._instruments or granule.start is None:
            return granule
        layout = self._layout(granule.instrument, granule.layout, granule.start)
        facts = self._instruments[granule.instrument].facts_at(granule.start)
        notes = (*granule.notes, *overridden_wavelengths(layout, facts))
        return replace(granule, layout=layout, notes=notes)

    def notes(self, instruments: Collection[str]) -> Iterator[FileNote]:
        """Return a note for each wavelength in the headers of instruments that facts override."""
        return joined_notes(
            FileNote(held.instrument, text, contradicts=False, files=held.files)
            for held in self.holdings
            if held.instrument in instruments
            for facts in [self._instruments[held.instrument].facts_at(held.since)]
            for text in overridden_wavelengths(held.layout, facts)
        )

    def _layout(self, instrument: str, layout: Layout, moment: datetime) -> Layout:
        facts = self._instruments[instrument].facts_at(moment)
        stated = {name: fact.recorder for name, fact in facts.channels.items() if fact.recorder}
        key = (instrument, *stated.items())
        if (key, layout) not in self._layouts:
            own = (held for held in self._stored if held.instrument == instrument)
            files = ((held.layout, held.files, held.first) for held in own)
            names = recorder_names(files, stated, self._bound.get(instrument))
            self._layouts[key, layout] = named_layout(layout, names)
        return self._layouts[key, layout]
