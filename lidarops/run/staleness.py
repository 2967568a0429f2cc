"""Which products are stale, and why.

A product is fresh when its part of the plan, the settings and the code that it depends on, and
the contents of all its inputs are those that the ledger recorded, and its file is there with the
recorded content. Anything else is stale, for a reason that can be said.
"""

from __future__ import annotations

import hashlib
import os
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from math import ceil
from pathlib import Path
from typing import Any, Final, NamedTuple

from lidarops.campaign.model import Campaign, as_settings
from lidarops.catalog.ledger import Dependence, Made, Tried
from lidarops.catalog.rows import day_of
from lidarops.catalog.sources import Source
from lidarops.catalog.store import Store
from lidarops.netcdf.provenance import code_version
from lidarops.plan import product_dependence
from lidarops.plan.product_dependence import Wanted
from lidarops.plan.scene_plan import plan_scene
from lidarops.plan.scenes import (
    DARK_REACH,
    Cut,
    cut_scenes,
    instrument_and_start,
    select_scenes,
    stop_of,
)
from lidarops.records import Granule, InputRecord, Plan, ProductKind, Role, Scene
from lidarops.run import leftovers
from lidarops.run.leftovers import Orphan

DARK_DAYS: Final = ceil(DARK_REACH.total_seconds() / 86400)
MOST_GRANULES: Final = 50_000
"""Granules that are judged at a time, unless one day has more; held in memory are those at work
and, where workers process them, those that come next."""
CRASHES: Final = 3
"""Tries in which a scene may take its process down before it is refused."""

_PROFILE_ROLES: Final = {"molecular_profile": Role.MOLECULAR, "overlap_profile": Role.OVERLAP}
# What may change without a scene being cut or a product being made in another way.
_OPERATION: Final = frozenset({"archive", "output", "catalog", "superseded", "simulation"})


@dataclass(frozen=True, slots=True)
class Selection:
    """What is asked for; everything where empty."""

    stations: tuple[str, ...] = ()
    instruments: tuple[str, ...] = ()
    kinds: tuple[ProductKind, ...] = ()
    since: datetime | None = None
    until: datetime | None = None

    @property
    def everything(self) -> bool:
        """Whether nothing is left out."""
        return self == Selection()

    def days(self, days: Iterable[int]) -> list[int]:
        """Return those of the days on which there may be something that is asked for."""
        first = None if self.since is None else day_of(self.since)
        last = None if self.until is None else day_of(self.until)
        return [
            day for day in days if (first is None or day >= first) and (last is None or day <= last)
        ]

    def product(self, made: Made, campaign: Campaign) -> bool:
        """Return whether a product, whose scene may be gone, is one of what is asked for."""
        instrument, start = instrument_and_start(made.scene)
        owner = campaign.instruments.get(instrument)
        return (
            (not self.kinds or made.kind in self.kinds)
            and (not self.instruments or instrument in self.instruments)
            and (not self.stations or (owner.station if owner else instrument) in self.stations)
            and (self.since is None or stop_of(made.scene, campaign) > self.since)
            and (self.until is None or start < self.until)
        )

    def scenes(self, scenes: Sequence[Scene]) -> tuple[Scene, ...]:
        """Return those of the scenes that are asked for."""
        return tuple(
            scene
            for scene in select_scenes(scenes, since=self.since, until=self.until)
            if (not self.instruments or scene.instrument in self.instruments)
            and (not self.stations or scene.station in self.stations)
        )


@dataclass(frozen=True, slots=True)
class Stale:
    """A product that has to be made, and why."""

    kind: ProductKind
    channel: str
    reason: str
    before: Made | None = None
    """What the ledger holds of it, where it was made before."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """What is to be done for one scene."""

    scene: Scene
    plan: Plan
    """All that the campaign asks for."""
    asked: Plan
    """What of it the selection asks for."""
    day: int
    key: str
    """Changes with anything that may change the outcome."""
    stale: tuple[Stale, ...]
    fresh: int
    held: str = ""
    """Why the scene is not tried again, though products of it are missing."""
    suspect: bool = False
    """Whether an earlier try took its process down."""
    barren: str = ""
    """Why the scene can give no product, and serves none of a network; empty where it does."""

    def needed(self) -> Plan:
        """Return the part of the plan that the stale products need."""
        return product_dependence.plan_closure(
            self.plan, [(each.kind, each.channel) for each in self.stale]
        )


class Signature(NamedTuple):
    """What a day looks like: equal where nothing can have become stale."""

    sources: str
    """What its products are made from."""
    whole: str
    """That, and its products; empty where the file of one is not as recorded."""


@dataclass(frozen=True, slots=True)
class DaysJudged:
    """What was found for some days."""

    judgements: tuple[Judgement, ...]
    orphans: tuple[Orphan, ...]
    set_aside: tuple[Granule, ...]
    told: Mapping[int, tuple[int, int]]
    """Days that may be settled -> barren scenes, granules set aside."""
    open: frozenset[int]
    """Days with something to do, after which they may be."""
    gone: frozenset[str]
    """Scenes of which the ledger notes a failure, and that are no more or all fresh."""
    touched: Mapping[str, int]
    """Products with a new modification time, but the recorded content."""
    digests: Mapping[str, str]
    """Contents of files that had to be read whole, by path; for the catalog."""


class Judge:
    """Judges the products of a campaign against its ledger.

    Parameters
    ----------
    campaign : Campaign
    store : Store
    selection : Selection
    force : bool
        Whether everything that is asked for counts as stale.
    """

    def __init__(
        self,
        campaign: Campaign,
        store: Store,
        *,
        selection: Selection | None = None,
        force: bool = False,
    ) -> None:
        self._campaign = campaign
        self._store = store
        self._selection = selection or Selection()
        self._force = force
        self._settings = product_dependence.Settings(campaign)
        self._profiles: dict[str, str] = {}
        self._source = Source.of(campaign.archive)
        self._digests: dict[str, str] = {}

    # Days

    def signatures(self, days: Collection[int] | None = None) -> dict[int, Signature]:
        """Return what every day looks like.

        Parameters
        ----------
        days : collection of int, optional
            Only of these; all with granules or products where not given.
        """
        sums: dict[int, list[tuple[Any, ...]]] = defaultdict(list)
        for each in self._store.day_sums():
            told = (each.role.value, each.good, each.low, each.high)
            sums[each.day].append(told)
            if each.role is Role.DARK:
                for near in range(1, DARK_DAYS + 1):
                    sums[each.day - near].append((near, *told))
                    sums[each.day + near].append((-near, *told))
        products, broken = self._product_days()
        base = self._base()
        found = {}
        for day in sums.keys() | products.keys():
            if days is None or day in days:
                digest = hashlib.sha256(f"{base}{day}{sorted(sums[day], key=repr)}".encode())
                sources = digest.hexdigest()
                digest.update(products[day].digest() if day in products else b"")
                found[day] = Signature(sources, "" if day in broken else digest.hexdigest())
        return found

    def _product_days(self) -> tuple[dict[int, Any], set[int]]:
        root = str(self._campaign.products_root)
        products: dict[int, Any] = defaultdict(hashlib.sha256)
        broken: set[int] = set()
        with self._store.all_made() as rows:
            for made in rows:
                products[made.day].update(f"{made.path}\0{made.sha256}\0".encode())
                if not _looks_right(root, made):
                    broken.add(made.day)
        return products, broken

    def _base(self) -> str:
        told = as_settings(self._campaign)
        names = sorted(
            {
                name
                for instrument in self._campaign.instruments.values()
                for facts in instrument.facts
                for name in (facts.molecular_profile, facts.overlap_profile)
                if name
            }
        )
        return product_dependence.digest(
            [
                {key: value for key, value in told.items() if key not in _OPERATION},
                code_version(),
                [[name, self._profile(name)] for name in names],
            ]
        )

    def batches(self, days: Iterable[int]) -> Iterator[tuple[int, ...]]:
        """Group days so that the granules of a group fit in memory."""
        counts: dict[int, int] = defaultdict(int)
        for each in self._store.day_sums():
            counts[each.day] += each.good
        group: list[int] = []
        held = 0
        for day in sorted(days):
            if group and held + counts[day] > MOST_GRANULES:
                yield tuple(group)
                group, held = [], 0
            group.append(day)
            held += counts[day]
        if group:
            yield tuple(group)

    def days(self, days: Sequence[int]) -> DaysJudged:
        """Judge every product of some days.

        Parameters
        ----------
        days : sequence of int
            Rising; from `batches`.
        """
        first, last, wanted = days[0], days[-1], set(days)
        found = self._cut(first, last, wanted)
        tried = self._store.tried(first, last)
        made = {each.key: each for each in self._store.made(first, last) if each.day in wanted}
        touched: dict[str, int] = {}
        everything = [self._scene(scene, made, tried, touched) for scene in found.scenes]
        planned = [(each.scene, each.plan) for each in everything]
        barren = leftovers.scenes_without_product(planned, self._campaign)
        everything = [
            replace(each, barren=barren[each.scene.id]) if each.scene.id in barren else each
            for each in everything
        ]
        chosen = {scene.id for scene in self._selection.scenes(found.scenes)}
        fates = leftovers.Fates(found, self._store.refused, self._signals)
        orphans = leftovers.orphaned_products(
            planned, made.values(), self._campaign, self._other_files, fates.of
        )
        orphaned = {known.day for known, _ in orphans}
        digests, self._digests = self._digests, {}
        counts = _counts(everything, found.set_aside)
        gone = {each.scene.id for each in everything if self._healed(each, tried)}
        there = {scene.id for scene in found.scenes}
        gone |= {name for name, each in tried.items() if each.day in wanted and name not in there}
        return DaysJudged(
            judgements=tuple(each for each in everything if each.scene.id in chosen),
            orphans=tuple(
                each for known, each in orphans if self._selection.product(known, self._campaign)
            ),
            set_aside=found.set_aside,
            told={day: counts[day] for day in days if day not in orphaned}
            if self._selection.everything
            else {},
            open=frozenset(each.day for each in everything if each.stale),
            gone=frozenset(gone),
            touched=touched,
            digests=digests,
        )

    def _healed(self, judged: Judgement, tried: Mapping[str, Tried]) -> bool:
        """Return whether a scene that failed needs no try any more, as when a file came back."""
        last = tried.get(judged.scene.id)
        complete = not (judged.stale or judged.held or self._selection.kinds)
        return last is not None and bool(last.error) and complete

    def _cut(self, first: int, last: int, days: set[int]) -> Cut:
        granules = self._store.granules_of(first, last, dark_days=DARK_DAYS)
        return cut_scenes(
            self._campaign,
            [
                granule
                for granule in granules
                if granule.role is Role.DARK or day_of(_moment(granule)) in days
            ],
        )

    # One scene

    def _scene(
        self,
        scene: Scene,
        made: Mapping[tuple[str, str, str], Made],
        tried: Mapping[str, Tried],
        touched: dict[str, int],
    ) -> Judgement:
        whole = plan_scene(scene, self._campaign)
        judged = self.judgement(scene, whole)
        last = tried.get(scene.id)
        stale = []
        asked = product_dependence.of_kinds(whole, self._selection.kinds)
        for kind, channel in product_dependence.wanted(asked):
            known = made.get((scene.id, kind.value, channel))
            reason = self._reason(scene, whole, (kind, channel), known, touched)
            if reason:
                stale.append(Stale(kind, channel, reason, known))
        judged = replace(
            judged,
            asked=asked,
            key=self.key(judged),
            stale=tuple(stale),
            fresh=len(product_dependence.wanted(asked)) - len(stale),
            suspect=last is not None and last.crashes > 0,
        )
        if last is None or self._force or not stale:
            return judged
        if last.final and last.error and last.key == judged.key:
            return replace(judged, stale=(), held=last.error)
        return judged

    def judgement(self, scene: Scene, whole: Plan) -> Judgement:
        """Return a judgement that asks for every product of a scene."""
        stale = tuple(Stale(*each, "asked for") for each in product_dependence.wanted(whole))
        return Judgement(scene, whole, whole, day_of(scene.start), "", stale, 0)

    def key(self, judged: Judgement) -> str:
        """Return what changes with anything that may change the outcome of a scene.

        Raw files are told by size and time: contents become known at different moments, and
        what this costs is one try more of a scene whose files were touched.
        """
        scene, whole = judged.scene, judged.plan
        return product_dependence.digest(
            [
                whole.hash,
                code_version(),
                [self._settings.of(scene, whole, channel) for channel in _channels(whole)],
                [
                    [granule.path, granule.size, granule.mtime_ns]
                    for granule in (*scene.granules, *scene.dark)
                ],
                [[name, self._profile(name)] for name, _ in _profiles(whole)],
            ]
        )

    def depends_on(
        self, scene: Scene, whole: Plan, product: Wanted, files: Sequence[InputRecord]
    ) -> tuple[Dependence, tuple[InputRecord, ...]]:
        """Return what a product depends on, and those of the files that it was made from."""
        mine = product_dependence.plan_closure(whole, [product])
        used = product_dependence.inputs(mine, files)
        settings = self._settings.of(scene, mine, product[1])
        found = Dependence(
            plan_hash=mine.hash,
            settings_hash=product_dependence.digest(settings),
            inputs_hash=product_dependence.digest_of_inputs(used),
            code_version=code_version(),
        )
        return found, used

    def settles(
        self, judged: Judgement, files: Sequence[InputRecord], made: Mapping[Wanted, Dependence]
    ) -> bool:
        """Return whether another look at a scene would find all that was stale to be fresh.

        Parameters
        ----------
        judged : Judgement
        files : sequence of InputRecord
            What its products were made from.
        made : mapping of (ProductKind, str) to Dependence
            What each depends on, by kind and channel.
        """
        contents = {used.path: used.sha256 for used in files}
        scene, whole = judged.scene, judged.plan
        for granule in (*scene.granules, *scene.dark):
            # Other products may have been found fresh by what is no longer there.
            if granule.sha256 and contents.get(granule.path, granule.sha256) != granule.sha256:
                return False
        now = self._files(
            scene, whole, lambda granule: contents.get(granule.path) or granule.sha256 or ""
        )
        for stale in judged.stale:
            product = (stale.kind, stale.channel)
            used = product_dependence.inputs(product_dependence.plan_closure(whole, [product]), now)
            if product not in made:
                return False
            if made[product].inputs_hash != product_dependence.digest_of_inputs(used):
                return False
        return True

    def _reason(
        self,
        scene: Scene,
        whole: Plan,
        product: Wanted,
        known: Made | None,
        touched: dict[str, int],
    ) -> str:
        """Return why a product is stale; empty where it is fresh."""
        if self._force or known is None:
            return "forced" if self._force else "not made yet"
        was = known.depends_on
        mine = product_dependence.plan_closure(whole, [product])
        settings = product_dependence.digest(self._settings.of(scene, mine, product[1]))
        if (was.code_version, was.plan_hash, was.settings_hash) != (
            code_version(),
            mine.hash,
            settings,
        ):
            return _changed(was, mine.hash)
        # Only now, as files may have to be read for it.
        used = product_dependence.inputs(mine, self._files(scene, whole, self._content))
        if was.inputs_hash != product_dependence.digest_of_inputs(used):
            return _difference(self._store.inputs_of(known.path), used)
        return self._file_reason(known, touched)

    def _file_reason(self, made: Made, touched: dict[str, int]) -> str:
        path = self._campaign.products_root / made.path
        try:
            about = path.stat()
            if (about.st_size, about.st_mtime_ns) == (made.size, made.mtime_ns):
                return ""
            if about.st_size == made.size:
                with path.open("rb") as stream:
                    if hashlib.file_digest(stream, "sha256").hexdigest() == made.sha256:
                        touched[made.path] = about.st_mtime_ns
                        return ""
        except FileNotFoundError:
            return "its file is missing"
        except OSError as error:
            return f"its file cannot be read: {error.strerror or error}"
        return "its file is not the one that was recorded"

    def _files(
        self, scene: Scene, whole: Plan, content: Callable[[Granule], str]
    ) -> tuple[InputRecord, ...]:
        """Return the inputs of a scene as they are now."""
        raw = [
            InputRecord(granule.path, granule.role, content(granule))
            for granule in (*scene.granules, *scene.dark)
        ]
        return (
            *raw,
            *(InputRecord(name, role, self._profile(name)) for name, role in _profiles(whole)),
        )

    def _content(self, granule: Granule) -> str:
        """Return the sha256 of a granule, or what no sha256 is where it cannot be read."""
        known = granule.sha256 or self._digests.get(granule.path)
        if known is None:
            try:
                known = self._digests[granule.path] = self._source.digest(granule.path)
            except OSError:
                known = None
        return known or f"{granule.size}:{granule.mtime_ns}:{granule.path}"

    def _other_files(self, made: Made, scene: Scene) -> bool:
        return {used.sha256 for used in self._signals(made)} != {
            self._content(granule) for granule in scene.granules
        }

    def _signals(self, made: Made) -> list[InputRecord]:
        """Return the signal files that a product was made from."""
        return [used for used in self._store.inputs_of(made.path) if used.role is Role.SIGNAL]

    def _profile(self, name: str) -> str:
        if name not in self._profiles:
            try:
                with (Path(self._campaign.folder) / name).open("rb") as stream:
                    self._profiles[name] = hashlib.file_digest(stream, "sha256").hexdigest()
            except (OSError, ValueError):
                # The processing of the scene will say what is wrong with it.
                self._profiles[name] = "unreadable"
        return self._profiles[name]


def _looks_right(root: str, made: Made) -> bool:
    try:
        about = os.stat(f"{root}/{made.path}")  # noqa: PTH116 - a Path takes five times as long
    except OSError:
        return False
    return (about.st_size, about.st_mtime_ns) == (made.size, made.mtime_ns)


def _profiles(whole: Plan) -> tuple[tuple[str, Role], ...]:
    found = {
        (step.settings[key], role)
        for step in whole.steps
        for key, role in _PROFILE_ROLES.items()
        if step.settings.get(key)
    }
    return tuple(sorted(found))


def _channels(whole: Plan) -> list[str]:
    return sorted({channel for _, channel in product_dependence.wanted(whole)})


def _counts(
    judgements: Sequence[Judgement], set_aside: Sequence[Granule]
) -> dict[int, tuple[int, int]]:
    barren: dict[int, int] = defaultdict(int)
    aside: dict[int, int] = defaultdict(int)
    for each in judgements:
        barren[each.day] += bool(each.barren)
    for granule in set_aside:
        aside[day_of(_moment(granule))] += 1
    return defaultdict(
        lambda: (0, 0),
        {day: (barren[day], aside[day]) for day in barren.keys() | aside.keys()},
    )


def _changed(was: Dependence, plan_hash: str) -> str:
    if was.code_version != code_version():
        return f"the code changed, from {was.code_version} to {code_version()}"
    if was.plan_hash != plan_hash:
        return "its plan changed"
    return "the campaign changed in what it tells of it"


def _difference(before: Sequence[InputRecord], now: Sequence[InputRecord]) -> str:
    """Say how the inputs of a product changed, by name where they are few."""
    old = {used.sha256: used for used in before}
    new = {used.sha256: used for used in now}
    lost = [old[sha256] for sha256 in old.keys() - new.keys()]
    fresh = [new[sha256] for sha256 in new.keys() - old.keys()]
    changed = {used.path for used in lost} & {used.path for used in fresh}
    parts = [
        _named("changed", [used for used in fresh if used.path in changed]),
        _named("new", [used for used in fresh if used.path not in changed]),
        _named("gone", [used for used in lost if used.path not in changed]),
    ]
    return "; ".join(part for part in parts if part) or "its inputs changed"


def _named(word: str, files: Sequence[InputRecord]) -> str:
    if not files:
        return ""
    first = min(files, key=lambda used: used.path)
    more = f" and {len(files) - 1} more" if len(files) > 1 else ""
    return f"{word}: {first.role.value} {first.path}{more}"


def _moment(granule: Granule) -> datetime:
    return granule.start or datetime.min.replace(tzinfo=UTC)
