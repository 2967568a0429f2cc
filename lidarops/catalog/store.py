"""The database of a campaign: catalog and ledger, of products, their inputs, and runs."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import UTC, datetime
from enum import StrEnum
from itertools import groupby
from operator import attrgetter
from typing import Any, Final, NamedTuple

import sqlalchemy as sa

from lidarops.catalog.database import (
    FILE_SET,
    GRANULE,
    LOCK,
    PRODUCT,
    PRODUCT_INPUT,
    RUN,
    SCENE,
    STAGE,
    VERDICT,
)
from lidarops.catalog.granules import Granules
from lidarops.catalog.lock import Lock
from lidarops.catalog.raw_files import RETRY, row_of
from lidarops.errors import CatalogError
from lidarops.kinds import kinds
from lidarops.records import (
    UNREADABLE,
    Granule,
    InputRecord,
    ProductRecord,
    Role,
    SceneOutcome,
    Stamp,
    digest,
)


class RunStatus(StrEnum):
    """Status of a run."""

    RUNNING = "running"
    FINISHED = "finished"
    INTERRUPTED = "interrupted"
    STOPPED = "stopped"
    """Products could not be written."""
    DIED = "died"
    """Its process died."""


@dataclass(frozen=True, slots=True)
class Dependence:
    """What the content of one product depends on, as digests."""

    plan_hash: str
    settings_hash: str
    inputs_hash: str
    code_version: str


class RecordedProduct(NamedTuple):
    """A product in the ledger."""

    path: str
    scene: str
    day: int
    kind: str
    channel: str
    sha256: str
    size: int
    mtime_ns: int
    depends_on: Dependence
    run: str
    stamp: Stamp


class NewProduct(NamedTuple):
    """A new product for the ledger."""

    record: ProductRecord
    mtime_ns: int
    depends_on: Dependence
    inputs: tuple[InputRecord, ...]


class RawSet(NamedTuple):
    """Raw files of one role that belong to some products."""

    role: Role
    files: int
    products: list[str]


class LastTry(NamedTuple):
    """Result of the last try of a scene."""

    key: str
    error: str
    internal: str
    """Traceback if the error is internal, a bug of lidarops; else empty."""
    final: bool
    """Whether another try on the same inputs would end the same way."""
    crashes: int
    day: int


class Verdict(NamedTuple):
    """That all requested products of a day were fresh, and what each run tells of the day."""

    signature: str
    """State of the day; see `lidarops.run.day_states.Signature`."""
    files: dict[str, str]
    """Ancillary files that the steps of the day read -> SHA-256."""
    empty_scenes: dict[str, str]
    """Scene without product -> why."""
    set_aside: dict[str, str]
    """Path of a good granule that belongs to no scene -> why."""
    unmade: dict[str, list[str]]
    """Requested product that no scene of the day gives -> why; nothing where it has no scene."""


@dataclass(frozen=True, slots=True)
class Run:
    """One run in the ledger."""

    id: str
    started: datetime
    finished: datetime | None
    status: RunStatus
    holder: str
    version: str
    code_version: str
    archive: str
    """Folder or URL of the raw files, without keys."""
    folder: str
    """Folder of the campaign file."""
    scenes: int = 0
    products: int = 0
    granules: int = 0
    failed: int = 0
    refused: int = 0
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Time per stage, s, summed over scenes."""


_P: Final = PRODUCT.c
_MADE: Final = (
    _P.path, _P.scene, _P.day, _P.kind, _P.channel, _P.sha256, _P.size, _P.mtime_ns,
    _P.plan_hash, _P.settings_hash, _P.inputs_hash, _P.code_version, _P.run,
    _P.version, _P.written,
)  # fmt: skip


class Store(Granules):
    """Catalog and ledger of one campaign: granules, runs and products; opened as `Database`."""

    @contextmanager
    def _writing(self, token: str) -> Iterator[sa.Connection]:
        """Yield a connection for a transaction; refuse it if the lock was lost."""
        with self.transaction() as connection:
            held = connection.execute(
                sa.update(LOCK)
                .where(LOCK.c.campaign == self.campaign, LOCK.c.token == token)
                .values(heartbeat=self.clock())
            )
            if held.rowcount != 1:
                raise CatalogError(
                    "another run has taken over, because this one sent no heartbeat",
                    file=self.place,
                    remedy="see lidarops runs; the scenes that this run entered are kept",
                )
            yield connection

    # Runs

    def begin_run(self, run: Run, token: str, *, swept: bool = True) -> None:
        """Enter a starting run; close runs whose process died, if what they left is swept."""
        if swept:
            self.close_runs(token)
        with self._writing(token) as connection:
            values = asdict(run) | {"campaign": self.campaign}
            del values["seconds"]
            connection.execute(sa.insert(RUN), values)

    def has_dead_run(self) -> bool:
        """Return whether the process of a run that did not end has died."""
        running = RUN.c.status == RunStatus.RUNNING.value
        query = sa.select(RUN.c.id).where(RUN.c.campaign == self.campaign, running).limit(1)
        return bool(self.read(query, tuple)) and not Lock(self).is_taken()

    def close_runs(self, token: str) -> None:
        """Close runs whose process died."""
        with self._writing(token) as connection:
            connection.execute(
                sa.update(RUN)
                .where(RUN.c.campaign == self.campaign, RUN.c.status == RunStatus.RUNNING.value)
                .values(status=RunStatus.DIED.value)
            )

    def end_run(self, run: str, status: RunStatus, *, refused: int, token: str) -> None:
        """Enter the end of a run."""
        with self._writing(token) as connection:
            connection.execute(
                sa.update(RUN)
                .where(RUN.c.id == run)
                .values(status=status.value, refused=refused, finished=datetime.now(UTC))
            )

    def runs(self, *, limit: int | None = None) -> list[Run]:
        """Return the runs of the campaign, the newest first, with their stage timings.

        A run that is marked as running has died if no living process holds the lock.
        """
        query = (
            sa.select(RUN)
            .where(RUN.c.campaign == self.campaign)
            .order_by(RUN.c.started.desc(), RUN.c.id.desc())
            .limit(limit)
        )
        stage = STAGE.c
        seconds = sa.select(stage.stage, sa.func.sum(stage.seconds)).group_by(stage.stage)
        seconds = seconds.order_by(stage.stage)
        died = {} if Lock(self).is_taken() else {RunStatus.RUNNING: RunStatus.DIED}
        return [
            replace(
                run,
                status=died.get(run.status, run.status),
                seconds=dict(self.read(seconds.where(stage.run == run.id), tuple)),
            )
            for run in self.read(query, _run_from)
        ]

    # Outcomes

    def campaign_folders(self) -> list[str]:
        """Return the folders of the campaign files of all runs in the database."""
        return self.read(sa.select(RUN.c.folder).distinct(), lambda row: str(row[0]))

    def begin_scene(self, scene: str, day: int, run: str, token: str) -> None:
        """Note the start of a scene; the note stays if the process dies."""
        row = {
            "campaign": self.campaign, "scene": scene, "day": day, "key": "", "run": run,
            "error": "", "internal": "", "final": False, "crashes": 1,
        }  # fmt: skip
        with self._writing(token) as connection:
            again = {"crashes": SCENE.c.crashes + 1, "run": run, "day": day}
            keys = ["campaign", "scene"]
            statement = self.insert(SCENE).on_conflict_do_update(index_elements=keys, set_=again)
            connection.execute(statement, row)

    def record(
        self,
        outcome: SceneOutcome,
        products: Collection[NewProduct],
        digests: Mapping[str, str],
        tried: LastTry,
        *,
        run: str,
        token: str,
    ) -> None:
        """Enter the outcome of a scene in one transaction, as it ends.

        Parameters
        ----------
        outcome : SceneOutcome
        products : collection of NewProduct
        digests : mapping of str to str
            SHA-256 of raw files by path, as far as the catalog does not have them yet.
        tried : LastTry
        run, token : str
        """
        ours = {"campaign": self.campaign, "scene": outcome.scene}
        with self._writing(token) as connection:
            if products:
                self._enter_products(connection, products, {**ours, "day": tried.day, "run": run})
            connection.execute(self.upsert(SCENE), {**ours, "run": run, **tried._asdict()})
            place = {"run": run, "scene": outcome.scene}
            stages = [{**place, "stage": name, "seconds": s} for name, s in outcome.seconds.items()]
            if stages:
                connection.execute(self.upsert(STAGE, replacing=False), stages)
            if outcome.error:
                day = VERDICT.c.campaign == self.campaign, VERDICT.c.day == tried.day
                connection.execute(sa.delete(VERDICT).where(*day))
            if digests:
                connection.execute(*self._digests(digests))
            self._refuse(connection, outcome.refused)
            connection.execute(
                sa.update(RUN)
                .where(RUN.c.id == run)
                .values(
                    scenes=RUN.c.scenes + 1,
                    products=RUN.c.products + len(outcome.products),
                    granules=RUN.c.granules + outcome.granules,
                    failed=RUN.c.failed + int(bool(outcome.error)),
                )
            )

    def _enter_products(
        self, connection: sa.Connection, products: Iterable[NewProduct], scene: Mapping[str, Any]
    ) -> None:
        made = {new.record.path: new for new in products}
        ours = {"campaign": self.campaign}
        self._drop_products(connection, made)
        rows = [{**scene, **_product_row(new)} for new in made.values()]
        connection.execute(sa.insert(PRODUCT), rows)
        sets: dict[str, list[InputRecord]] = {}
        links = []
        for path, new in made.items():
            by_role = sorted(new.inputs, key=attrgetter("role", "path"))
            for role, files in groupby(by_role, key=attrgetter("role")):
                members = list(files)
                name = digest([[used.path, used.sha256] for used in members])[:32]
                sets[name] = members
                links.append({**ours, "product": path, "role": role.value, "file_set": name})
        known = set(
            connection.scalars(sa.select(FILE_SET.c.id).where(FILE_SET.c.id.in_(sets)).distinct())
        )
        files_of_sets = [
            {"id": name, "path": used.path, "sha256": used.sha256}
            for name, members in sets.items()
            if name not in known
            for used in members
        ]
        if files_of_sets:
            connection.execute(self.upsert(FILE_SET, replacing=False), files_of_sets)
        if links:
            connection.execute(sa.insert(PRODUCT_INPUT), links)

    def _refuse(self, connection: sa.Connection, refused: Iterable[Granule]) -> None:
        """Enter granules that cannot be used; the next scan tries what was not read again."""
        # Whole rows: a scan leaves a row whose stamp is that of the file as it reads it.
        own = GRANULE.c.campaign == self.campaign
        for granule in refused:
            # By this key a scan knows a damaged file.
            query = sa.select(GRANULE.c.scan_key).where(own, GRANULE.c.path == granule.path)
            known = connection.scalar(query) if granule.sha256 else None
            row = row_of(granule, self.campaign, known or RETRY)
            connection.execute(self.upsert(GRANULE), row.values)

    # Products

    def products_of_days(self, first: int, last: int) -> list[RecordedProduct]:
        """Return the products of scenes that start on days `first` to `last`."""
        query = sa.select(*_MADE).where(_P.campaign == self.campaign, _P.day.between(first, last))
        return self.read(query, _made_from)

    @contextmanager
    def all_products(self) -> Iterator[Iterator[RecordedProduct]]:
        """Yield every product, ordered by path, without holding them all."""
        query = sa.select(*_MADE).where(_P.campaign == self.campaign).order_by(_P.path)
        with self.stream(query) as rows:
            yield self.decoded(_made_from(row) for row in rows)

    def made_by_any_campaign(self, paths: Collection[str]) -> set[str]:
        """Return those of some paths that are products of any campaign of the database."""
        made = sa.select(_P.path)
        return {path for (path,) in self.read_batches(paths, lambda b: made.where(_P.path.in_(b)))}

    def scenes_with_product(
        self, owner: str, kind: str, channel: str, *, without: Collection[str]
    ) -> Iterator[str]:
        """Yield the ids of the scenes of which an instrument or network has a product.

        Parameters
        ----------
        owner : str
            Key of the instrument or network.
        kind, channel : str
            An empty channel means any.
        without : collection of str
            Paths of products that do not count.
        """
        # Keys hold no underscore, which stands before the time in the id of a scene.
        query = (
            sa.select(_P.path, _P.scene)
            .where(_P.campaign == self.campaign, _P.kind == kind)
            .where(_P.scene.startswith(f"{owner}_", autoescape=True))
        )
        if channel:
            query = query.where(_P.channel == channel)
        with self.stream(query) as rows:
            for path, scene in rows:
                if path not in without:
                    yield scene

    def products(self) -> list[Mapping[str, Any]]:
        """Return the rows of all products, ordered by path."""
        query = sa.select(PRODUCT).where(_P.campaign == self.campaign).order_by(_P.path)
        return self.read(query, lambda row: dict(row._mapping))  # noqa: SLF001 - is public

    def inputs_of(self, product: str) -> list[InputRecord]:
        """Return the files that a product was made from."""
        link = PRODUCT_INPUT.c
        query = (
            sa.select(FILE_SET.c.path, link.role, FILE_SET.c.sha256)
            .join(PRODUCT_INPUT, link.file_set == FILE_SET.c.id)
            .where(link.campaign == self.campaign, link.product == product)
            .where(link.role != Role.UNUSED.value)
            .order_by(link.role, FILE_SET.c.path)
        )
        return self.read(query, lambda row: InputRecord(row[0], Role(row[1]), row[2]))

    def lost_inputs(self) -> list[tuple[str, str]]:
        """Return set and path of raw inputs of products that the archive no longer gives.

        The catalog lacks them, could not read them, or knows them as empty.

        Also of files that products state as unused, and the catalog lacks. Without those whose
        content is known under another path.
        """
        listed = sa.exists().where(
            GRANULE.c.campaign == self.campaign,
            GRANULE.c.path == FILE_SET.c.path,
            (GRANULE.c.reason.not_like(f"{UNREADABLE}%") & (GRANULE.c.size > 0))
            | (FILE_SET.c.sha256 == ""),
        )
        query = sa.select(FILE_SET).where(FILE_SET.c.id.in_(self._raw_sets()), ~listed)
        lost = self.read(query, tuple)
        if not lost:
            return []
        # In one pass, because digests have no index.
        query = sa.select(GRANULE.c.sha256).where(GRANULE.c.campaign == self.campaign)
        with self.stream(query) as rows:
            moved = {sha256 for _, _, sha256 in lost}.intersection(sha256 for (sha256,) in rows)
        return [(name, path) for name, path, sha256 in lost if sha256 not in moved]

    def _raw_sets(self) -> sa.Select[tuple[str]]:
        link = PRODUCT_INPUT.c
        raw = link.role.in_([Role.SIGNAL.value, Role.DARK.value, Role.UNUSED.value])
        return sa.select(link.file_set).where(link.campaign == self.campaign, raw)

    def raw_sets(self) -> dict[str, RawSet]:
        """Return the sets of raw files of products, by their ids."""
        link, files = PRODUCT_INPUT.c, FILE_SET.c
        sizes = sa.select(files.id, sa.func.count()).where(files.id.in_(self._raw_sets()))
        size = dict(self.read(sizes.group_by(files.id), tuple))
        rows = self.read(self._raw_sets().add_columns(link.role, link.product), tuple)
        sets: dict[str, RawSet] = {}
        for name, role, product in rows:
            sets.setdefault(name, RawSet(Role(role), size[name], [])).products.append(product)
        return sets

    def count_raw(self, sets: Collection[str], without: Collection[str]) -> int:
        """Return the number of different raw files in some sets, without some paths."""
        query = sa.select(FILE_SET.c.path, FILE_SET.c.id).order_by(FILE_SET.c.path)
        with self.stream(query.where(FILE_SET.c.id.in_(self._raw_sets()))) as rows:
            return sum(
                any(name in sets for _, name in same)
                for path, same in groupby(rows, key=attrgetter("path"))
                if path not in without
            )

    @contextmanager
    def all_inputs(self) -> Iterator[Iterator[tuple[str, str, str]]]:
        """Yield role, path and SHA-256 of every input of a product, ordered by path."""
        link = PRODUCT_INPUT.c
        query = (
            sa.select(link.role, FILE_SET.c.path, FILE_SET.c.sha256)
            .join(PRODUCT_INPUT, link.file_set == FILE_SET.c.id)
            .where(link.campaign == self.campaign, link.role != Role.UNUSED.value)
            .distinct()
            .order_by(FILE_SET.c.path, link.role, FILE_SET.c.sha256)
        )
        with self.stream(query) as rows:
            yield ((role, path, sha256) for role, path, sha256 in rows)

    def touch_products(self, stamps: Mapping[str, int]) -> None:
        """Enter new modification times (ns) of products whose content is unchanged."""
        statement = (
            sa.update(PRODUCT)
            .where(_P.campaign == self.campaign, _P.path == sa.bindparam("file"))
            .values(mtime_ns=sa.bindparam("stamp"))
        )
        self.execute(statement, [{"file": path, "stamp": stamp} for path, stamp in stamps.items()])

    def forget_products(self, paths: Collection[str], token: str) -> None:
        """Remove products, and their inputs that no other product uses."""
        with self._writing(token) as connection:
            self._drop_products(connection, paths)
            used = sa.select(PRODUCT_INPUT.c.file_set)
            connection.execute(sa.delete(FILE_SET).where(FILE_SET.c.id.not_in(used)))

    def _drop_products(self, connection: sa.Connection, paths: Collection[str]) -> None:
        gone = [{"gone": path} for path in paths]
        if not gone:
            return
        for table, column in ((PRODUCT_INPUT, "product"), (PRODUCT, "path")):
            connection.execute(
                sa.delete(table).where(
                    table.c.campaign == self.campaign, table.c[column] == sa.bindparam("gone")
                ),
                gone,
            )

    # Scenes and verdicts

    def last_tries(self, first: int, last: int) -> dict[str, LastTry]:
        """Return the result of the last try of every scene on days `first` to `last`."""
        known = SCENE.c
        columns = (known[name] for name in ("scene", *LastTry._fields))
        query = sa.select(*columns).where(
            known.campaign == self.campaign, known.day.between(first, last)
        )
        return {scene: LastTry(*tried) for scene, *tried in self.read(query, tuple)}

    def scenes_of_other_days(self, days: Collection[int]) -> list[str]:
        """Return the scenes of other days than these that were tried."""
        own = SCENE.c.campaign == self.campaign
        tried = {day for (day,) in self.read(sa.select(SCENE.c.day).where(own).distinct(), tuple)}
        scenes = sa.select(SCENE.c.scene).where(own)
        return [
            scene
            for day in sorted(tried.difference(days))
            for (scene,) in self.read(scenes.where(SCENE.c.day == day), tuple)
        ]

    def failures(self, *, internal: bool = False) -> dict[str, str]:
        """Return scene -> error of the scenes whose last try failed, or traceback of a bug."""
        column = SCENE.c.internal if internal else SCENE.c.error
        query = sa.select(SCENE.c.scene, column)
        own = SCENE.c.campaign == self.campaign
        return dict(self.read(query.where(own, column != ""), tuple))

    def unusable_scenes(self, *, without: Collection[str] = ()) -> list[str]:
        """Return the scenes whose retrievals gave no usable value; see `SceneOutcome.unusable`.

        Parameters
        ----------
        without : collection of str
            Paths of products to ignore.
        """
        # Not stored with the scene: a run over a selection leaves its other products unchanged.
        judged = (
            _P.campaign == self.campaign,
            _P.kind.in_([kind.name for kind in kinds().values() if kind.expects_usable]),
        )
        # Paths are compared below, because a statement can hold only a limited number.
        candidates = sa.select(_P.scene).where(*judged, _P.usable == 0)
        query = sa.select(_P.scene, _P.path, _P.usable).where(*judged, _P.scene.in_(candidates))
        unusable: dict[str, bool] = {}
        with self.stream(query) as rows:
            for scene, path, usable in rows:
                if path not in without:
                    unusable[scene] = unusable.get(scene, True) and usable == 0
        return sorted(scene for scene, all_rejected in unusable.items() if all_rejected)

    def forget_scenes(self, scenes: Collection[str]) -> None:
        """Remove the entries of scenes that no longer exist."""
        own = SCENE.c.campaign == self.campaign, SCENE.c.scene == sa.bindparam("gone")
        self.execute(sa.delete(SCENE).where(*own), [{"gone": scene} for scene in sorted(scenes)])

    def verdicts(self) -> dict[int, Verdict]:
        """Return the verdicts on settled days."""
        query = sa.select(VERDICT).where(VERDICT.c.campaign == self.campaign)
        return dict(
            self.read(query, lambda row: (row.day, Verdict(row.signature, **json.loads(row.facts))))
        )

    def store_verdicts(self, verdicts: Mapping[int, Verdict]) -> None:
        """Note that all requested products of these days are fresh."""
        rows = []
        for day, verdict in verdicts.items():
            facts = verdict._asdict()
            row = {"campaign": self.campaign, "day": day, "signature": facts.pop("signature")}
            rows.append({**row, "facts": json.dumps(facts)})
        self.execute(self.upsert(VERDICT), rows)


def _product_row(new: NewProduct) -> dict[str, Any]:
    """Return the columns of a product without those of its scene."""
    record, change = new.record, new.record.change
    return {
        **{name: getattr(record, name) for name in ("path", "kind", "channel", "sha256", "size")},
        **asdict(new.depends_on),
        "mtime_ns": new.mtime_ns,
        "usable": record.usable,
        "version": record.stamp.version,
        "written": record.stamp.written,
        "change": "" if change is None else json.dumps(change.as_dict()),
    }


def _made_from(row: Any) -> RecordedProduct:
    # In the order of `_MADE`.
    stamp = Stamp(row.version, row.written)
    return RecordedProduct(*(*row[:8], Dependence(*row[8:12]), row.run, stamp))


def _run_from(row: Any) -> Run:
    values = {item.name: getattr(row, item.name) for item in fields(Run)[:-1]}
    return Run(**values | {"status": RunStatus(row.status)})
