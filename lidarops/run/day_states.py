"""The state of each day: if it is that of the last verdict, nothing of the day is stale.

And the names of channels, which follow from recorders, and from what the facts state.

A run with nothing to do imports this module, so it imports no numerics.
"""

from __future__ import annotations

import hashlib
import os
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from functools import cached_property
from math import ceil
from typing import Any, Final, NamedTuple

from lidarops.campaign.model import OPERATION, Campaign, InstrumentFacts
from lidarops.catalog.granules import joined_notes
from lidarops.catalog.store import RecordedProduct, Store, Verdict
from lidarops.constants import DARK_REACH
from lidarops.errors import AncillaryError
from lidarops.kinds import Scope, kinds_of
from lidarops.raw.header import Layout, named_layout, recorder_names
from lidarops.records import FileNote, Granule, Role, UnusedFile, day_of, digest, first_of_month
from lidarops.run.options import Selection, requested_kinds
from lidarops.run.outlying_headers import NEAR_DAYS
from lidarops.run.scenes import RefusedFile, dated
from lidarops.scene.air import AirFiles
from lidarops.system.code_version import joint_code_version
from lidarops.system.files import sha256_of

DARK_DAYS: Final = ceil(DARK_REACH.total_seconds() / 86400)
REACH: Final = NEAR_DAYS + DARK_DAYS
"""Days before and after a file on which products may use it."""

FIRST: Final = datetime.min.replace(tzinfo=UTC)
LAST: Final = datetime.max.replace(tzinfo=UTC)
"""Edges of facts that hold from the first time on, and to the last."""
_ROUNDING_OF_WAVELENGTHS: Final = 1e-9
"""m; headers hold whole nanometres."""
_PLANNING: Final = (
    "lidarops.run.day_states",
    "lidarops.run.outlying_headers",
    "lidarops.scene.plan",
    "lidarops.run.scenes",
)
"""Modules that decide which scenes and plans a day has. A product records its own scene and plan,
so that a change of these modules makes it stale only if they changed."""


class Signature(NamedTuple):
    """State of one day without ancillary files: if it and they are unchanged, nothing is stale."""

    sources: str
    """Digest of what its products are made from."""
    whole: str
    """Digest of the sources and the products; empty if a product file is not as recorded."""


class DayStates:
    """States of the days of a campaign.

    Parameters
    ----------
    campaign : Campaign
    store : Store
    selection : Selection, optional
        What to process; default everything.
    known : DayStates, optional
        Earlier states, since which the catalog has not changed.
    """

    def __init__(
        self,
        campaign: Campaign,
        store: Store,
        selection: Selection | None = None,
        *,
        known: DayStates | None = None,
    ) -> None:
        self.campaign = campaign
        self.store = store
        self.selection = selection or Selection()
        self._ancillaries: dict[str, str] = {}
        self._problems: dict[tuple[str, Role], str] = {}
        self.air = AirFiles(campaign) if campaign.atmosphere else None
        if known is not None:
            self.base, self.names, self.refused = known.base, known.names, known.refused
            self.air, self.read_by_months = known.air, known.read_by_months

    def signatures(self, days: Collection[int] | None = None) -> dict[int, Signature]:
        """Return the state of every day.

        Parameters
        ----------
        days : collection of int, optional
            Days to return; default all days with granules or products.
        """
        files: dict[int, list[tuple[Any, ...]]] = defaultdict(list)
        for day_sum in self.store.day_sums():
            fingerprint = (day_sum.role.value, day_sum.good, day_sum.low, day_sum.high)
            _add_to_days(files, day_sum.day, day_sum.role, fingerprint)
        for file in self.refused:
            unused = UnusedFile.of(file.granule)
            _add_to_days(files, day_of(file.time), unused.role, unused)
        root, base = str(self.campaign.products_root), self.base
        products: dict[int, Any] = defaultdict(hashlib.sha256)
        months: dict[int, Any] = defaultdict(hashlib.sha256)
        broken: set[int] = set()
        with self.store.all_products() as rows:
            for made in rows:
                products[made.day].update(f"{made.path}\0{made.sha256}\0".encode())
                if made.kind in self.read_by_months:
                    month = first_of_month(made.day)
                    months[month].update(f"{made.path}\0{made.sha256}\0".encode())
                if not _looks_right(root, made):
                    broken.add(made.day)
        for day, state in months.items():
            files[day].append(("month", state.hexdigest()))
        signatures = {}
        for day in sorted(files.keys() | products.keys()):
            if days is None or day in days:
                state = hashlib.sha256(f"{base}{day}{sorted(files[day], key=repr)}".encode())
                sources = state.hexdigest()
                state.update(products[day].digest() if day in products else b"")
                signatures[day] = Signature(sources, "" if day in broken else state.hexdigest())
        return signatures

    @cached_property
    def base(self) -> str:
        """Digest of settings, code and recorders on which scenes, plans and products depend."""
        settings, held = self.campaign.model_dump(mode="json"), self.names.holdings
        return digest(
            [
                {key: value for key, value in settings.items() if key not in OPERATION},
                [entry.what for entry in self.campaign.acknowledged if entry.holds],
                self.air and self.air.state,
                joint_code_version(requested_kinds(self.campaign), *_PLANNING),
                sorted({(h.instrument, c.name, c.recorder) for h in held for c in h.layout}),
            ]
        )

    @cached_property
    def read_by_months(self) -> frozenset[str]:
        """Kinds of which requested products of months are made."""
        months = kinds_of(Scope.MONTH)
        requested = requested_kinds(self.campaign) if months else ()
        return frozenset(n for kind in months if kind.name in requested for n in kind.reads)

    def months(self, days: Iterable[int]) -> list[int]:
        """Return the first days of the months of some days; none where no product reads a month."""
        return sorted(set(map(first_of_month, days))) if self.read_by_months else []

    def is_settled(self, signature: Signature, verdict: Verdict | None) -> bool:
        """Return whether nothing has changed on a day since its verdict."""
        return (
            verdict is not None
            and bool(signature.whole)
            and signature.whole == verdict.signature
            and all(self.ancillary(name) == known for name, known in verdict.files.items())
        )

    @cached_property
    def names(self) -> ChannelNames:
        """Names of the channels of all files in the catalog."""
        return ChannelNames(self.campaign, self.store)

    @cached_property
    def all_refused(self) -> list[Granule]:
        """Files that the catalog refuses."""
        return self.store.refused()

    @cached_property
    def refused(self) -> tuple[RefusedFile, ...]:
        """Those with times to which they belong."""
        return tuple(dated(self.campaign, self.store, self.all_refused))

    def ancillary(self, name: str) -> str:
        """Return the SHA-256 of an ancillary file when it was first needed."""
        if name not in self._ancillaries:
            try:
                self._ancillaries[name] = sha256_of(self.campaign.folder / name)
            except (OSError, ValueError):
                # The processing of the scene reports the problem.
                self._ancillaries[name] = "unreadable"
        return self._ancillaries[name]

    def file_problem(self, name: str, role: Role) -> str:
        """Return why an ancillary file cannot be used; empty if it can."""
        if (name, role) not in self._problems:
            from lidarops.campaign.ancillary_files import Ancillaries  # noqa: PLC0415 - loads xarray

            try:
                Ancillaries.read(self.campaign.folder, {name: role})
                self._problems[name, role] = ""
            except AncillaryError as error:
                self._problems[name, role] = str(error).removeprefix(f"{name}: ")
        return self._problems[name, role]


def _add_to_days(
    files: dict[int, list[tuple[Any, ...]]], day: int, role: Role, known: tuple[Any, ...]
) -> None:
    """Add what is known of files of a day to all days whose products may use them."""
    reach = REACH if role is Role.DARK else NEAR_DAYS
    for offset in range(-reach, reach + 1):
        files[day + offset].append((-offset, *known) if offset else known)


def _looks_right(root: str, made: RecordedProduct) -> bool:
    try:
        status = os.stat(f"{root}/{made.path}")  # noqa: PTH116 - for each file, a Path is slow
    except OSError:
        return False
    return (status.st_size, status.st_mtime_ns) == (made.size, made.mtime_ns)


def validity_edges(campaign: Campaign) -> list[datetime]:
    """Return the times at which facts of any instrument change, rising."""
    edges = {
        edge
        for instrument in campaign.instruments.values()
        for facts in instrument.facts
        for edge in (facts.valid_from, facts.valid_to)
    }
    return sorted(edges - {FIRST, LAST})


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
