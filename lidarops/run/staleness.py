"""Decide which products are stale, and why.

A product is fresh if four things equal what the ledger recorded: its part of the plan, the settings
and the code that it depends on, the contents of all its inputs, and the content of its file. Every
other product is stale, and the reason is stated.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, NamedTuple

from lidarops.campaign.model import Campaign
from lidarops.catalog.raw_files import HEADER_BYTES, Source
from lidarops.catalog.store import Dependence, LastTry, RecordedProduct, Store, Verdict
from lidarops.errors import ProductError, RawFormatError
from lidarops.kinds import kinds
from lidarops.netcdf.comparison import planned_changes
from lidarops.netcdf.context import package_versions
from lidarops.raw.formats import parse_raw_header
from lidarops.raw.header import RawHeader
from lidarops.records import (
    FileNote,
    Granule,
    InputRecord,
    Plan,
    Role,
    Scene,
    Stamp,
    day_of,
    digest,
    first_of_month,
)
from lidarops.run.day_states import DARK_DAYS, DayStates
from lidarops.run.leftovers import (
    Leftovers,
    Lost,
    Orphan,
    find_lost,
    product_file,
    scenes_without_product,
    unmade_products,
)
from lidarops.run.options import Selection
from lidarops.run.outlying_headers import NEAR_DAYS, without_outlying
from lidarops.run.scenes import (
    Cut,
    RefusedFile,
    as_recorded,
    cut_scenes,
    months_of_products,
    name_unused,
    start_time,
)
from lidarops.scene import dependence
from lidarops.scene.dependence import ProductKey, ancillary_files
from lidarops.scene.job import Failure, Job, Place, guarded, recorded_settings
from lidarops.scene.plan import plan_scene
from lidarops.system.code_version import code_version, joint_code_version, source_version
from lidarops.system.files import sha256_of

MOST_GRANULES: Final = 50_000
"""Granules that are judged at a time, unless one day has more. Memory holds the current group and,
if workers process the scenes, the next group."""

_UNCOUNTED: Final = frozenset({"products", "files", "keys", "members"})
"""Settings that a product states, and that count otherwise; members count one by one."""


@dataclass(frozen=True, slots=True)
class Stale:
    """A product to be made, and the reason."""

    kind: str
    channel: str
    reason: str
    before: RecordedProduct | None = None
    """Its ledger entry, if it was made before."""
    restored: bool = False
    """Whether it depends on the same as before, so that only its file is made again."""

    @property
    def product(self) -> ProductKey:
        """Kind and channel."""
        return self.kind, self.channel

    @property
    def place(self) -> Place | None:
        """What stands at its place; None for a new product."""
        if self.before is None:
            return None
        former = self.before.stamp
        stamp = former if self.restored else Stamp(former.version + 1)
        return Place(stamp, self.before.sha256, former)


@dataclass(frozen=True, slots=True)
class Judgement:
    """The work that one scene needs."""

    scene: Scene
    plan: Plan
    """Plan of all products that the campaign requests."""
    requested: Plan
    """Part of the plan that the selection requests."""
    day: int
    """Day of the start, in days since 1970-01-01."""
    ancillaries: tuple[InputRecord, ...]
    """Present ancillary files that the steps of the plan read."""
    stale: tuple[Stale, ...]
    products: tuple[InputRecord, ...] = ()
    """Products of which those of the scene are made."""
    fresh: int = 0
    frozen: tuple[Stale, ...] = ()
    """Products of a frozen period that would be replaced."""
    kept: tuple[Stale, ...] = ()
    """Products that would be replaced, but for the raw files that are lost."""
    key: str = ""
    """Digest of everything that may change the outcome."""
    failure: Failure | None = None
    """Why the scene cannot be planned, or how its last try failed if it is held."""
    held: bool = False
    """Whether nothing has changed since the failure, so that the scene is not tried again."""
    planned: bool = True
    """Whether it could be planned; if not, its plan is empty."""
    suspect: bool = False
    """Whether an earlier try killed its process."""
    empty_reason: str = ""
    """Why the scene gives no product of its own and is used by no network; else empty."""

    @property
    def due(self) -> bool:
        """Whether the run must enter an outcome of the scene."""
        return bool(self.stale) or (self.failure is not None and not self.held)

    def needed(self) -> Plan:
        """Return the part of the plan that the stale products need."""
        return dependence.plan_closure(self.plan, [stale.product for stale in self.stale])

    def job(self, campaign: Campaign, profiles_per_chunk: int | None) -> Job:
        """Return the job that makes the stale products."""
        return Job(
            campaign,
            self.scene,
            self.needed(),
            profiles_per_chunk,
            products=tuple(stale.product for stale in self.stale),
            places={stale.product: stale.place for stale in self.stale if stale.place},
        )


class DaysJudged(NamedTuple):
    """Judgements of the scenes of some days."""

    judgements: tuple[Judgement, ...]
    orphans: tuple[Orphan, ...]
    set_aside: tuple[Granule, ...]
    file_notes: tuple[FileNote, ...]
    """Notes on files that only the files around them show."""
    verdicts: Mapping[int, Verdict]
    """Of days that may be settled, without signature."""
    unmade: Mapping[int, dict[str, list[str]]]
    """What no selected scene of each day gives; see `unmade_products`."""
    gone: Mapping[str, int]
    """Scenes with a recorded failure that no longer exist or are all fresh -> day."""
    touched: Mapping[str, int]
    """Products with the recorded content but a new modification time (ns), by path."""
    digests: Mapping[str, str]
    """SHA-256 of files that had to be read in full, by path; for the catalog."""


class Judge(DayStates):
    """Compares the products of a campaign with its ledger.

    Parameters
    ----------
    campaign, store, selection, known
        As of `DayStates`.
    force : bool
        Whether every selected product counts as stale.
    thaw : bool
        Whether products of frozen periods are replaced, too.
    """

    def __init__(
        self,
        campaign: Campaign,
        store: Store,
        *,
        selection: Selection | None = None,
        force: bool = False,
        thaw: bool = False,
        known: DayStates | None = None,
    ) -> None:
        super().__init__(campaign, store, selection, known=known)
        self._force = force
        self._thaw = thaw
        self._digests: dict[str, str] = {}
        self._touched: dict[str, int] = {}
        self._to_be_made: dict[str, str] = {}
        """Stale products of scenes that were judged, by path -> scene."""
        self._last: tuple[Plan | None, dict[ProductKey, tuple[Plan, Mapping[str, Any]]]] = None, {}
        """Plan of the scene that was judged last, and its parts. One pair, because two threads may
        judge different scenes."""

    # Days

    def batches(self, days: Iterable[int]) -> Iterator[tuple[int, ...]]:
        """Group days so that the granules of a group fit in memory."""
        days, counts = sorted(days), Counter[int]()
        for day_sum in self.store.day_sums() if days else ():
            counts[day_sum.day] += day_sum.good
        group: list[int] = []
        held = 0
        for day in days:
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
            Ascending; from `batches`.
        """
        first, last, within = days[0], days[-1], set(days)
        tried = self.store.last_tries(first, last)
        products = self.store.products_of_days(first, last)
        cut = self._cut(first, last, within, products)
        made = {product.path: product for product in products if product.day in within}
        self._touched, self._digests = {}, {}
        judgements = [self._judged(scene, made, tried.get(scene.id)) for scene in cut.scenes]
        planned = [(judged.scene, judged.plan) for judged in judgements]
        reasons = scenes_without_product(planned, self.campaign)
        judgements = [
            replace(judged, empty_reason=reasons.get(judged.scene.id, "") if judged.planned else "")
            for judged in judgements
        ]
        orphans = self._orphans(judgements, made.values(), cut)
        settled = within if self.selection.everything else set()
        settled = settled - self._unsettled(judgements, orphans)
        own = [one for one in judgements if self.selection.scene(one.scene.id, self.campaign)]
        unmade = {
            day: unmade_products(
                self.campaign, [(one.scene, one.requested) for one in own if one.day == day]
            )
            for day in days
        }
        instruments = {
            member.instrument for one in own for member in one.scene.members or (one.scene,)
        }
        return DaysJudged(
            judgements=tuple(own),
            orphans=tuple(
                one for one in orphans if self.selection.product(one.product, self.campaign)
            ),
            set_aside=cut.set_aside,
            file_notes=tuple(note for note in cut.file_notes if note.instrument in instruments),
            verdicts=_verdicts(settled, judgements, cut.set_aside, unmade),
            unmade=unmade,
            gone=self._gone(judgements, tried, within),
            touched=self._touched,
            digests=self._digests,
        )

    def _orphans(
        self, judgements: Sequence[Judgement], made: Iterable[RecordedProduct], cut: Cut
    ) -> list[Orphan]:
        """Return the products of some days that would not be made again, or are kept as they are.

        Without those of scenes that cannot be planned.
        """
        plans = {judged.scene.id: (judged.scene, judged.plan) for judged in judgements}
        unplanned = {judged.scene.id for judged in judgements if not judged.planned}
        leftovers = Leftovers(self.campaign, self.store, plans, cut, self._content, self.lost)
        left = [one for one in leftovers.orphans(made) if one.product.scene not in unplanned]
        kept = (stale for judged in judgements for stale in judged.kept)
        return left + [Orphan(s.before, s.reason, requested=True) for s in kept if s.before]

    def _unsettled(self, judgements: Iterable[Judgement], orphans: Iterable[Orphan]) -> set[int]:
        """Return the days of which every run reports something, or that it tries again.

        These are what is not replaced, and files that cannot be used; a signature does not hold
        all that may end an internal error.
        """
        return {orphan.product.day for orphan in orphans} | {
            judged.day
            for judged in judgements
            if judged.frozen
            or any(self.file_problem(used.path, used.role) for used in judged.ancillaries)
            or not judged.planned
            or (judged.failure and judged.failure.internal)
        }

    def _gone(
        self, judgements: Iterable[Judgement], tried: Mapping[str, LastTry], days: Collection[int]
    ) -> dict[str, int]:
        """Return the tried scenes that no longer exist, or are complete again -> day."""
        gone = {scene: last.day for scene, last in tried.items() if last.day in days}
        for judged in judgements:
            last = tried.get(judged.scene.id)
            # For example, because a file came back.
            incomplete = judged.stale or judged.failure or self.selection.kinds
            if last is None or incomplete or not last.error:
                gone.pop(judged.scene.id, None)
            else:
                gone[judged.scene.id] = judged.day
        return gone

    @cached_property
    def _source(self) -> Source:
        return Source.of(self.campaign.archive)

    @cached_property
    def lost(self) -> Lost:
        """Raw files of products that the archive no longer gives; looked up once."""
        return find_lost(self.campaign, self.store)

    def _cut(
        self, first: int, last: int, days: set[int], products: Sequence[RecordedProduct]
    ) -> Cut:
        stored = self.store.granules_of(first - NEAR_DAYS, last + NEAR_DAYS, dark_days=DARK_DAYS)
        granules = list(map(self.names.granule, stored))
        used = {day + near for day in days for near in range(-DARK_DAYS, DARK_DAYS + 1)}
        kept, refused, noted = without_outlying(granules, used, self._header, self._ahead)
        aside = [granule for granule in refused if day_of(start_time(granule)) in days]
        cut = cut_scenes(
            self.campaign,
            [
                granule
                for granule in kept
                if granule.role is Role.DARK or day_of(start_time(granule)) in days
            ],
        )
        unused = [
            *self.refused,
            *(RefusedFile(granule, start_time(granule)) for granule in refused),
        ]
        recorded = defaultdict[str, list[RecordedProduct]](list)
        for product in products:
            recorded[product.scene].append(product)
        known = [as_recorded(scene, recorded) for scene in cut.scenes]
        lost = {
            scene: [file for product in made for file in self.lost.unused.get(product.path, ())]
            for scene, made in recorded.items()
        }
        return cut._replace(
            scenes=(*name_unused(known, unused, lost), *self._months(days)),
            set_aside=(*cut.set_aside, *aside),
            file_notes=tuple(
                FileNote(granule.instrument, note, contradicts=False, files=1)
                for granule, note in noted
                if day_of(start_time(granule)) in days
            ),
        )

    def _ahead(self, granule: Granule) -> float | None:
        """Return the clock of the instrument minus UTC at a file, s; None of one without names."""
        instrument = self.campaign.instruments[granule.instrument]
        if instrument.name_times == "ignored":
            return None
        return instrument.facts_at(start_time(granule)).clock_offset

    def _months(self, days: set[int]) -> Iterator[Scene]:
        """Yield the months that begin on some days, of which products are made."""
        for first in days.intersection(self.months(days)):
            held = self.store.products_of_days(first, first_of_month(first + 31) - 1)
            made = {product.path: product for product in held}
            scenes = {path: product.scene for path, product in made.items()} | self._to_be_made
            records = {self._product_to_read(path, made): scene for path, scene in scenes.items()}
            yield from months_of_products(self.campaign, {first}, records)

    def _product_to_read(self, path: str, made: Mapping[str, RecordedProduct]) -> InputRecord:
        """Return a product of which another is made, with its content if that is known."""
        known = None if path in self._to_be_made else made.get(path)
        return InputRecord(path, Role.PRODUCT, known.sha256 if known else f"to be made: {path}")

    def _header(self, granule: Granule) -> RawHeader | None:
        """Return the header of a file; None where this file cannot be read now."""
        try:
            head = self._source.head(granule.path, HEADER_BYTES)
            return parse_raw_header(
                head, file=granule.path, size=granule.size, known=granule.format
            )
        # Not the error of a lost store: headers that are damaged would be accepted for good.
        except (OSError, RawFormatError):
            return None

    # One scene

    def _judged(
        self,
        scene: Scene,
        made: Mapping[str, RecordedProduct],
        last: LastTry | None,
    ) -> Judgement:
        """Return the judgement of a scene, also if a bug prevents its plan."""
        judged = guarded(lambda: self._planned(scene, made))
        if isinstance(judged, Failure):
            failure, plan = judged, Plan(scene.id, (), ())
            judged = replace(self.judgement(scene, plan, {}), failure=failure, planned=False)
        suspect = last is not None and last.crashes > 0
        judged = replace(judged, key=self.key(judged), suspect=suspect)
        if last is None or self._force or not (judged.due and last.final and last.error):
            return judged
        key = self.key(judged, internal=True) if last.internal else judged.key
        if last.key != key:
            return judged
        for one in judged.stale:
            self._to_be_made.pop(product_file(scene, one.product), None)
        failure = Failure(last.error, last.internal)
        return replace(judged, stale=(), failure=failure, held=True)

    def _planned(self, scene: Scene, made: Mapping[str, RecordedProduct]) -> Judgement:
        planned = plan_scene(scene, self.campaign, self.air)
        files = ancillary_files(planned.steps)
        problems = {
            name: problem
            for name, role in files.items()
            if (problem := self.file_problem(name, role))
        }
        whole = dependence.without_unusable_files(planned, problems) if problems else planned
        # Also files that cannot be used: the day is judged again when they change.
        judged = self.judgement(scene, whole, files)
        stale: list[Stale] = []
        frozen: list[Stale] = []
        kept: list[Stale] = []
        kinds_ = self.selection.kinds
        requested = dependence.plan_of_kinds(whole, kinds_) if kinds_ else whole
        products = requested.product_keys
        for kind, channel in products:
            path = product_file(scene, (kind, channel))
            known = made.get(path)
            if kinds()[kind].reads:
                read = self._products_read(judged, (kind, channel), made)
                judged = replace(judged, products=tuple(dict.fromkeys((*judged.products, *read))))
            reason, restored = self._reason(judged, (kind, channel), known)
            if reason:
                one = Stale(kind, channel, reason, known, restored)
                if known and known.path in self.lost.protected:
                    kept.append(one)
                elif (
                    known and not (restored or self._thaw) and self.campaign.is_frozen(scene.start)
                ):
                    if not (self.campaign.products_root / path).exists():
                        remedy = "only a copy restores this version, --thaw makes a new one"
                        one = replace(one, reason=f"{reason}; {remedy}")
                    frozen.append(one)
                else:
                    stale.append(one)
                    if not restored:
                        self._to_be_made[path] = scene.id
        return replace(
            judged,
            requested=requested,
            stale=tuple(stale),
            frozen=tuple(frozen),
            kept=tuple(kept),
            fresh=len(products) - len(stale) - len(frozen) - len(kept),
        )

    def _products_read(
        self, judged: Judgement, product: ProductKey, made: Mapping[str, RecordedProduct]
    ) -> tuple[InputRecord, ...]:
        """Return the products that are there or to be made, and of which a product is made."""
        scene = judged.scene
        closure, _ = self.plan_and_settings(scene, judged.plan, product)
        keys = [key for step in closure.products for key in dependence.read_products(step)]
        of_scene = (self._product_to_read(product_file(scene, key), made) for key in keys)
        return dependence.product_inputs(closure, of_scene if scene.granules else scene.products)

    def judgement(self, scene: Scene, whole: Plan, files: Mapping[str, Role]) -> Judgement:
        """Return a judgement by which every product of a scene is stale.

        Parameters
        ----------
        scene : Scene
        whole : Plan
        files : mapping of str to Role
            Ancillary files of the scene, by path; see `ancillary_files`.
        """
        stale = tuple(Stale(*one, "requested") for one in whole.product_keys)
        used = (InputRecord(name, files[name], self.ancillary(name)) for name in sorted(files))
        return Judgement(scene, whole, whole, day_of(scene.start), tuple(used), stale)

    def key(self, judged: Judgement, *, internal: bool = False) -> str:
        """Return the digest of everything that may change the outcome of a scene.

        Raw files enter by size and modification time, because their contents become known at
        different moments. A scene whose files were touched is therefore tried once more.

        Parameters
        ----------
        judged : Judgement
        internal : bool
            Whether the outcome is an internal error. Its cause may lie in any source of lidarops
            or in another package, so the key depends on all of them.
        """
        scene, whole = judged.scene, judged.plan
        products = whole.product_keys
        software = [source_version(), package_versions()] if internal else []
        return digest(
            [
                *software,
                whole.hash if judged.planned else self.base,
                joint_code_version({kind for kind, _ in products}),
                [
                    settings_digest(self.plan_and_settings(scene, whole, product)[1])
                    for product in products
                ],
                [
                    [granule.path, granule.size, granule.mtime_ns]
                    for granule in (*scene.granules, *scene.dark)
                ],
                [[used.path, used.sha256] for used in (*judged.ancillaries, *judged.products)],
            ]
        )

    def explained(self, judged: Judgement) -> Judgement:
        """Return a judgement whose reasons name the settings or steps that changed.

        Reads the products of which some did, which takes a few ms each.
        """
        stale, frozen, kept = (
            tuple(self._explained(judged, product) for product in products)
            for products in (judged.stale, judged.frozen, judged.kept)
        )
        return replace(judged, stale=stale, frozen=frozen, kept=kept)

    def _explained(self, judged: Judgement, stale: Stale) -> Stale:
        made = stale.before
        if made is None:
            return stale
        closure, settings = self.plan_and_settings(judged.scene, judged.plan, stale.product)
        known = made.depends_on
        if (known.plan_hash, known.settings_hash) == (closure.hash, settings_digest(settings)):
            return stale
        try:
            changes = planned_changes(self.campaign.products_root / made.path, settings, closure)
        except ProductError:
            # A file that is lost is a reason of its own.
            return stale
        return replace(stale, reason="; ".join([stale.reason, *changes]))

    def plan_and_settings(
        self, scene: Scene, whole: Plan, product: ProductKey
    ) -> tuple[Plan, Mapping[str, Any]]:
        """Return the part of a plan that a product needs, and the settings that it would state."""
        last, parts = self._last
        if last is not whole:
            parts = {}
            self._last = whole, parts
        if product not in parts:
            closure = dependence.plan_closure(whole, [product])
            job = Job(self.campaign, scene, whole)
            parts[product] = closure, recorded_settings(job, scene, closure, product)
        return parts[product]

    def depends_on(
        self, scene: Scene, whole: Plan, product: ProductKey, files: Sequence[InputRecord]
    ) -> tuple[Dependence, tuple[InputRecord, ...]]:
        """Return what a product depends on, and its files: used ones, and those stated unused."""
        closure, settings = self.plan_and_settings(scene, whole, product)
        used = dependence.product_inputs(closure, files)
        depends_on = Dependence(
            plan_hash=closure.hash,
            settings_hash=settings_digest(settings),
            inputs_hash=dependence.inputs_digest(used),
            code_version=code_version(product[0]),
        )
        unused = dependence.product_unused(scene, closure)
        return depends_on, (*used, *dependence.unused_inputs(unused))

    def _reason(
        self, judged: Judgement, product: ProductKey, known: RecordedProduct | None
    ) -> tuple[str, bool]:
        """Return why a product is stale, and whether it depends on the same as before.

        The reason is empty if it is fresh.
        """
        if known is None:
            return "forced" if self._force else "not made yet", False
        difference = self._dependence_reason(judged, product, known)
        lost = self._file_reason(known)
        reason = "; ".join(filter(None, (lost, difference)))
        return "forced" if self._force else reason, not difference

    def _dependence_reason(
        self, judged: Judgement, product: ProductKey, known: RecordedProduct
    ) -> str:
        """Return what has changed of what a product depends on; empty if nothing has."""
        recorded, code = known.depends_on, code_version(product[0])
        closure, settings = self.plan_and_settings(judged.scene, judged.plan, product)
        if recorded.code_version != code:
            return f"the code changed, from {recorded.code_version} to {code}"
        if recorded.plan_hash != closure.hash:
            return "its plan changed"
        if recorded.settings_hash != settings_digest(settings):
            unused = {file.path for file in judged.scene.unused}
            gone = [used for used in self.store.inputs_of(known.path) if used.path in unused]
            changed = "its settings in the campaign, or the files that are unused, changed"
            return _difference(gone, []) if gone else changed
        # Last, because files may have to be read for it.
        granules = {
            granule.path: granule for granule in (*judged.scene.granules, *judged.scene.dark)
        }
        raw = [InputRecord(path, granule.role, "") for path, granule in granules.items()]
        used = [
            replace(file, sha256=self._content(granules[file.path])) if not file.sha256 else file
            for file in dependence.product_inputs(
                closure, [*raw, *judged.ancillaries, *judged.products]
            )
        ]
        if recorded.inputs_hash != dependence.inputs_digest(used):
            return _difference(self.store.inputs_of(known.path), used)
        return ""

    def _file_reason(self, made: RecordedProduct) -> str:
        path = self.campaign.products_root / made.path
        try:
            status = path.stat()
            if (status.st_size, status.st_mtime_ns) == (made.size, made.mtime_ns):
                return ""
            if status.st_size == made.size and sha256_of(path) == made.sha256:
                self._touched[made.path] = status.st_mtime_ns
                return ""
        except FileNotFoundError:
            return "its file is missing"
        except OSError as error:
            return f"its file cannot be read: {error.strerror or error}"
        return "its file differs from the recorded one"

    def _content(self, granule: Granule) -> str:
        """Return the SHA-256 of a granule; if it cannot be read, a text that equals no SHA-256."""
        digest = granule.sha256 or self._digests.get(granule.path)
        if digest is None:
            try:
                digest = self._digests[granule.path] = self._source.digest(granule.path)
            except OSError:
                digest = None
        return digest or f"{granule.size}:{granule.mtime_ns}:{granule.path}"


def settings_digest(settings: Mapping[str, Any]) -> str:
    """Return the sha256 of the settings that a product states, as far as they count.

    Requested settings count by the plan, files by their content, and keys by the scene.
    """
    parts = {"": settings, **settings.get("members", {})}
    return digest(
        [
            [name, {key: value for key, value in part.items() if key not in _UNCOUNTED}]
            for name, part in sorted(parts.items())
        ]
    )


def _verdicts(
    days: Iterable[int],
    judgements: Iterable[Judgement],
    set_aside: Iterable[Granule],
    unmade: Mapping[int, dict[str, list[str]]],
) -> dict[int, Verdict]:
    """Return the verdicts on some days, without signature."""
    verdicts = {day: Verdict("", {}, {}, {}, unmade[day]) for day in days}
    for judged in judgements:
        if verdict := verdicts.get(judged.day):
            verdict.files.update({used.path: used.sha256 for used in judged.ancillaries})
            if judged.empty_reason:
                verdict.empty_scenes[judged.scene.id] = judged.empty_reason
    for granule in set_aside:
        if verdict := verdicts.get(day_of(start_time(granule))):
            verdict.set_aside[granule.path] = granule.reason
    return verdicts


def _difference(before: Sequence[InputRecord], now: Sequence[InputRecord]) -> str:
    """Describe how the inputs of a product changed; name the first file of each change."""
    old, new = ({used.sha256: used for used in files} for files in (before, now))
    lost = [old[sha256] for sha256 in old.keys() - new.keys()]
    fresh = [new[sha256] for sha256 in new.keys() - old.keys()]
    changed = {used.path for used in lost} & {used.path for used in fresh}
    changes = []
    for word, files in (
        ("changed", [used for used in fresh if used.path in changed]),
        ("new", [used for used in fresh if used.path not in changed]),
        ("gone", [used for used in lost if used.path not in changed]),
    ):
        if files:
            first = min(files, key=lambda used: used.path)
            others = f" and {len(files) - 1} more" if len(files) > 1 else ""
            changes.append(f"{word}: {first.role.value} {first.path}{others}")
    return "; ".join(changes) or "its inputs changed"
