"""Selection of what to process, and its check against the campaign and its files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime

from lidarops.campaign.model import Campaign
from lidarops.catalog.ledger import RecordedProduct
from lidarops.catalog.rows import day_of
from lidarops.catalog.store import Store
from lidarops.errors import CampaignError
from lidarops.kinds import kinds
from lidarops.plan.windows import parse_scene_id, scene_stop
from lidarops.records import Scene


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
            self.owner(owner, station_of(campaign, owner))
            and (self.since is None or scene_stop(scene, campaign) > self.since)
            and (self.until is None or start < self.until)
        )

    def scenes(self, scenes: Sequence[Scene]) -> tuple[Scene, ...]:
        """Return the selected scenes."""
        return tuple(
            scene
            for scene in scenes
            if self.owner(scene.instrument, scene.station)
            and (self.since is None or scene.stop > self.since)
            and (self.until is None or scene.start < self.until)
        )

    def owner(self, name: str, station: str) -> bool:
        """Return whether an instrument or network, and its station, are selected."""
        return (not self.instruments or name in self.instruments) and (
            not self.stations or station in self.stations
        )


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
    requested = requested_kinds(campaign)
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
        requested |= instrument.products.requested().keys()
    for network in campaign.networks.values():
        requested |= network.requested().keys()
    return [kind for kind in kinds() if kind in requested]


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
    from lidarops.plan.scenes import cut_scenes  # noqa: PLC0415 - loads numerics

    with Store(campaign.catalog_url, campaign.name, create=False) as store:
        days = selection.days(sorted({day_sum.day for day_sum in store.day_sums()}))
        # No scene is longer than a day; the first selected scene decides.
        return not any(
            selection.scenes(cut_scenes(campaign, store.granules_of(day, day, dark_days=0)).scenes)
            for day in days
        )


def station_of(campaign: Campaign, name: str) -> str:
    """Return the station of an instrument; of a network, its name."""
    owner = campaign.instruments.get(name)
    return owner.station if owner else name
