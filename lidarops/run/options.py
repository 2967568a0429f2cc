"""Selection and options of a run, and its result."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Final

from lidarops.campaign.model import Campaign
from lidarops.catalog.scan import ScanSummary
from lidarops.catalog.store import RecordedProduct, RunStatus, Store, Verdict
from lidarops.errors import CampaignError
from lidarops.kinds import kinds
from lidarops.records import ACKNOWLEDGED, Findings, Granule, RunRecord, SceneOutcome, day_of
from lidarops.run.scenes import parse_scene_id, scene_stop

if TYPE_CHECKING:
    from distributed import Client

    from lidarops.run.leftovers import Orphan

Progress = Callable[[SceneOutcome], None]
Batch = Callable[[], Sequence[SceneOutcome]]
"""Carries out the next scenes, and returns how they ended."""
MOST_OF_A_BATCH: Final = 50
NO_USABLE_VALUE: Final = "no retrieval gave a usable value"


@dataclass(frozen=True, slots=True)
class Selection:
    """Stations, instruments, kinds of product and times to process; empty fields select all."""

    stations: tuple[str, ...] = ()
    instruments: tuple[str, ...] = ()
    kinds: tuple[str, ...] = ()
    since: datetime | None = None
    until: datetime | None = None

    @property
    def everything(self) -> bool:
        """Whether the selection contains everything."""
        return self == Selection()

    @property
    def day_limits(self) -> tuple[int | None, int | None]:
        """The first and the last day that may hold selected scenes; None without a limit."""
        return (
            None if self.since is None else day_of(self.since),
            None if self.until is None else day_of(self.until),
        )

    def days(self, days: Iterable[int]) -> list[int]:
        """Return the days that may hold selected scenes."""
        first, last = self.day_limits
        return [
            day for day in days if (first is None or day >= first) and (last is None or day <= last)
        ]

    def product(self, made: RecordedProduct, campaign: Campaign) -> bool:
        """Return whether a product is selected; its scene may no longer exist."""
        return (not self.kinds or made.kind in self.kinds) and self.scene(made.scene, campaign)

    def scene(self, scene: str, campaign: Campaign) -> bool:
        """Return whether the scene of an id is selected; it may no longer exist."""
        owner, start = parse_scene_id(scene)
        return (
            self.owner(owner, campaign)
            and (self.since is None or scene_stop(scene, campaign) > self.since)
            and (self.until is None or start < self.until)
        )

    def owner(self, name: str, campaign: Campaign) -> bool:
        """Return whether an instrument, and its station, or a network are selected."""
        instrument = campaign.instruments.get(name)
        station = instrument.station if instrument else name
        return (not self.instruments or name in self.instruments) and (
            not self.stations or station in self.stations
        )


def selected(
    instruments: Iterable[str] | None,
    stations: Iterable[str] | None,
    products: Iterable[str] | None,
    since: datetime | None,
    until: datetime | None,
) -> Selection:
    """Return the selection of some names and an interval of time; None selects all."""
    stations, instruments, products = (tuple(n or ()) for n in (stations, instruments, products))
    return Selection(stations, instruments, products, since, until)


@dataclass(frozen=True, slots=True)
class Options:
    """How to run; affects no product."""

    force: bool = False
    """Process everything selected, also what is fresh."""
    thaw: bool = False
    """Replace products of frozen periods, too."""
    workers: int = 1
    """Local processes; they scan and report also if a cluster processes the scenes."""
    memory: str | None = None
    """Memory limit of this process, or of a local worker, such as ``2GiB``."""
    cluster: Callable[[], AbstractContextManager[Client]] | None = None
    """Starts or reaches a cluster to run on instead; called only if something is stale."""
    dashboard: Callable[[str], None] | None = None
    """Called with the address of the pages of dask, which are then served to this machine."""
    wait: float = 0.0
    """s to wait for another run on the same catalog."""
    profiles_per_chunk: int | None = None
    journal: bool = False
    """Note each scene in the report folder as it ends, for the report of a run that is killed."""
    progress: Progress | None = None
    """Called with the outcome of each scene as it ends."""
    expect: Callable[[int], None] | None = None
    """Called with the number of granules of each group of stale scenes before processing."""
    batch: Callable[[Batch], int] = lambda carry_out: len(carry_out())
    """Carries out a batch, and returns the number of its scenes."""


@dataclass(frozen=True, slots=True)
class Result:
    """What a run did, and the state of the archive after it."""

    record: RunRecord | None
    """None if there was nothing to do."""
    status: RunStatus
    summary: ScanSummary
    failures: Mapping[str, str]
    """Scene -> error, of every scene whose last try failed."""
    internal: Mapping[str, str]
    """Scene -> traceback, of those that ended with an internal error: a bug of lidarops."""
    unusable: tuple[str, ...]
    """Scenes whose retrievals gave no usable value; orphaned products do not count."""
    empty_scenes: Mapping[str, str] = field(default_factory=dict)
    """Scene -> why it can give no product."""
    set_aside: Mapping[str, str] = field(default_factory=dict)
    """Path of a good granule that belongs to no scene -> why."""
    orphans: tuple[Orphan, ...] = ()
    frozen: Mapping[str, str] = field(default_factory=dict)
    """Product of a frozen period that would be replaced -> why."""
    findings: Findings = field(default_factory=Findings)
    refused: Sequence[Granule] = ()
    """Files that the catalog refuses, where there was nothing to do."""
    signal: int = 0
    """The signal that stopped the run."""

    @property
    def scenes(self) -> tuple[SceneOutcome, ...]:
        """Scenes of the run."""
        return () if self.record is None else self.record.scenes

    @property
    def failed_scenes(self) -> Mapping[str, str]:
        """Scene -> error, now or since an earlier run, without internal errors."""
        errors = self._errors
        return {scene: errors[scene] for scene in errors if scene not in self.internal}

    @property
    def internal_errors(self) -> Mapping[str, str]:
        """Scene -> internal error, now or since an earlier run."""
        errors = self._errors
        return {scene: errors[scene] for scene in errors if scene in self.internal}

    @property
    def _errors(self) -> dict[str, str]:
        now = {scene.scene: scene.error for scene in self.scenes if scene.error}
        return {**self.failures, **now}

    @property
    def unusable_scenes(self) -> tuple[str, ...]:
        """Scenes whose retrievals gave no usable value: of the archive, and of this run."""
        now = (scene.scene for scene in self.scenes if scene.unusable)
        return tuple(dict.fromkeys((*self.unusable, *now)))

    @property
    def lost(self) -> Mapping[str, str]:
        """Requested products of whose scene no raw file is left -> why."""
        return {orphan.path: orphan.reason for orphan in self.orphans if orphan.lost}

    @property
    def has_failures(self) -> bool:
        """Whether anything is refused, failed, empty or lost, now or since an earlier run.

        What the campaign acknowledges does not count.
        """
        return bool(
            self.summary.refused
            or self.failures
            or self.unusable
            or self.empty_scenes
            or not all(reason.startswith(ACKNOWLEDGED) for reason in self.set_aside.values())
            or self.findings.failed
            or self.lost
            or self.status is not RunStatus.FINISHED
            or (self.record is not None and self.record.failed)
        )


def unused(
    verdicts: Mapping[int, Verdict], days: Collection[int]
) -> tuple[dict[str, str], dict[str, str]]:
    """Return the empty scenes and the files set aside of some days, as verdicts state them."""
    empty_scenes: dict[str, str] = {}
    set_aside: dict[str, str] = {}
    for day, verdict in verdicts.items():
        if day in days:
            empty_scenes |= verdict.empty_scenes
            set_aside |= verdict.set_aside
    return empty_scenes, set_aside


def check_selection(campaign: Campaign, selection: Selection) -> None:
    """Refuse a selection that names what the campaign does not have.

    Raises
    ------
    CampaignError
        If the campaign has no such station or instrument or requests no such kind of product, or if
        the interval of time is empty.
    """
    known = {
        "instrument": (selection.instruments, (*campaign.instruments, *campaign.networks)),
        "station": (selection.stations, (*campaign.stations, *campaign.networks)),
    }
    for word, (selected, names) in known.items():
        for name in selected:
            if name not in names:
                raise CampaignError(
                    f"the campaign has no {word} {name!r}",
                    remedy=f"known: {', '.join(sorted(set(names)))}",
                )
    requested = requested_kinds(campaign) if selection.kinds else []
    for kind in selection.kinds:
        if kind not in requested:
            raise CampaignError(
                f"no instrument or network of the campaign requests product {kind!r}",
                remedy=f"requested: {', '.join(requested) or 'none'}",
            )
    since, until = selection.since, selection.until
    if since is not None and until is not None and since >= until:
        raise CampaignError(
            f"the interval from {since.isoformat()} to {until.isoformat()} is empty",
            field="since, until",
            remedy="since must be earlier than until",
        )


def requested_kinds(campaign: Campaign) -> list[str]:
    """Return the kinds of product that a campaign requests."""
    requested: set[str] = set()
    for instrument in campaign.instruments.values():
        requested |= instrument.products.requested.keys()
    for network in campaign.networks.values():
        requested |= network.requested.keys()
    return [kind for kind in kinds() if kind in requested]


def requested_products(campaign: Campaign, owner: str) -> Iterator[tuple[str, str]]:
    """Yield kind and channel of the products that are requested of an instrument or network.

    The channel is empty if all are requested.
    """
    if owner in campaign.networks:
        for kind, joint in campaign.networks[owner].requested.items():
            yield kind, joint.channel
        return
    for kind, settings in campaign.instruments[owner].products.requested.items():
        for channel in settings.named or [""]:
            yield kind, channel


def selects_no_scene(campaign: Campaign, selection: Selection) -> bool:
    """Return whether a selection is limited and contains no scene of the catalog.

    Parameters
    ----------
    campaign : Campaign
        A catalog must exist.
    selection : Selection
    """
    if selection.everything:
        return False
    from lidarops.run.scenes import cut_scenes  # noqa: PLC0415 - loads numerics

    with Store(campaign.catalog_url, campaign.name, create=False) as store:
        days = selection.days(sorted({day_sum.day for day_sum in store.day_sums()}))
        # No scene is longer than a day; the first selected scene decides.
        return not any(
            selection.scene(scene.id, campaign)
            for day in days
            for scene in cut_scenes(campaign, store.granules_of(day, day, dark_days=0)).scenes
        )
