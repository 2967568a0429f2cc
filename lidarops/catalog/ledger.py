"""The ledger part of the database: products, their inputs, and the runs that made them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from datetime import UTC, datetime
from enum import StrEnum
from itertools import groupby
from operator import attrgetter
from typing import Any, Final, NamedTuple

import sqlalchemy as sa

from lidarops.catalog.database import BATCH
from lidarops.catalog.granules import Granules
from lidarops.catalog.rows import RETRY, aware, naive, row_of
from lidarops.catalog.schema import (
    FILE_SET,
    GRANULE,
    LOCK,
    PRODUCT,
    PRODUCT_INPUT,
    RUN,
    SCENE,
    STAGE,
    SUPERSEDED,
    VERDICT,
)
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


@dataclass(frozen=True, slots=True)
class RecordedProduct:
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

    @property
    def key(self) -> tuple[str, str, str]:
        """Scene, kind and channel."""
        return self.scene, self.kind, self.channel


@dataclass(frozen=True, slots=True)
class NewProduct:
    """A new product for the ledger."""

    record: ProductRecord
    mtime_ns: int
    depends_on: Dependence
    inputs: tuple[InputRecord, ...]
    kept: str = ""
    """Path of the kept previous version below the output folder; empty if none is kept."""


@dataclass(frozen=True, slots=True)
class SceneEntry:
    """The outcome of one scene, entered as it ends."""

    outcome: SceneOutcome
    day: int
    key: str
    final: bool
    """Whether another try on the same inputs would end the same way."""
    products: tuple[NewProduct, ...] = ()
    digests: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 of raw files by path, as far as the catalog does not have them yet."""


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
    crashes: int
    day: int


class Verdict(NamedTuple):
    """That all requested products of a day were fresh."""

    signature: str
    """State of the day; see `lidarops.run.staleness.Signature`."""
    empty_scenes: int
    """Number of scenes of the day without product."""
    set_aside: int
    """Number of good granules of the day that belong to no scene."""
    files: Mapping[str, str]
    """Ancillary files that the steps of the day read -> SHA-256."""

    @property
    def unused(self) -> int:
        """Number of empty scenes and of granules set aside."""
        return self.empty_scenes + self.set_aside


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


@dataclass(frozen=True, slots=True)
class SupersededVersion:
    """A version of a product that was replaced."""

    path: str
    sha256: str
    run: str
    replaced_by: str
    kept: str
    """Path below the output folder; empty if the file was not kept."""


_P: Final = PRODUCT.c
_MADE: Final = (
    _P.path, _P.scene, _P.day, _P.kind, _P.channel, _P.sha256, _P.size, _P.mtime_ns,
    _P.plan_hash, _P.settings_hash, _P.inputs_hash, _P.code_version, _P.run,
    _P.version, _P.written,
)  # fmt: skip


class Ledger(Granules):
    """Products, their inputs, and the runs that made them."""

    # Runs

    def begin_run(self, run: Run, token: str, *, swept: bool = True) -> None:
        """Enter a starting run; close runs whose process died, if what they left is swept."""
        with self.transaction() as connection:
            self._hold(connection, token)
            if swept:
                connection.execute(self._closing())
            values = asdict(run) | {
                "campaign": self.campaign,
                "started": naive(run.started),
                "status": run.status.value,
            }
            del values["seconds"]
            connection.execute(sa.insert(RUN), values)

    def _closing(self) -> sa.Update:
        return sa.update(RUN).where(*self._open_runs()).values(status=RunStatus.DIED.value)

    def _open_runs(self) -> tuple[sa.ColumnElement[bool], ...]:
        return RUN.c.campaign == self.campaign, RUN.c.status == RunStatus.RUNNING.value

    def has_open_run(self) -> bool:
        """Return whether a run has begun and not ended."""
        with self.transaction() as connection:
            query = sa.select(RUN.c.id).where(*self._open_runs()).limit(1)
            return connection.execute(query).first() is not None

    def close_runs(self, token: str) -> None:
        """Close runs whose process died."""
        with self.transaction() as connection:
            self._hold(connection, token)
            connection.execute(self._closing())

    def end_run(self, run: str, status: RunStatus, *, refused: int, token: str) -> None:
        """Enter the end of a run."""
        with self.transaction() as connection:
            self._hold(connection, token)
            connection.execute(
                sa.update(RUN)
                .where(RUN.c.id == run)
                .values(status=status.value, refused=refused, finished=naive(datetime.now(UTC)))
            )

    def runs(self, *, limit: int | None = None) -> list[Run]:
        """Return the runs of the campaign, the newest first, with their stage timings."""
        query = (
            sa.select(RUN)
            .where(RUN.c.campaign == self.campaign)
            .order_by(RUN.c.started.desc(), RUN.c.id.desc())
            .limit(limit)
        )
        with self.transaction() as connection:
            rows = list(self.decoded(connection.execute(query)))
            return list(self.decoded(_run_from(row, _stages(connection, row.id)) for row in rows))

    # Outcomes

    def begin_scene(self, scene: str, day: int, run: str, token: str) -> None:
        """Note the start of a scene; the note stays if the process dies."""
        row = {
            "campaign": self.campaign, "scene": scene, "day": day, "key": "", "run": run,
            "error": "", "internal": "", "final": False, "crashes": 1,
        }  # fmt: skip
        with self.transaction() as connection:
            self._hold(connection, token)
            statement = self.insert(SCENE)
            connection.execute(
                statement.on_conflict_do_update(
                    index_elements=["campaign", "scene"],
                    set_={"crashes": SCENE.c.crashes + 1, "run": run, "day": day},
                ),
                row,
            )

    def record(self, entry: SceneEntry, run: str, token: str) -> None:
        """Enter the outcome of a scene in one transaction: products, inputs, digests, timings."""
        outcome = entry.outcome
        with self.transaction() as connection:
            self._hold(connection, token)
            self._enter_products(connection, entry, run)
            self._enter_scene(connection, entry, run)
            if outcome.error:
                day = VERDICT.c.campaign == self.campaign, VERDICT.c.day == entry.day
                connection.execute(sa.delete(VERDICT).where(*day))
            self._enter_digests(connection, entry.digests)
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

    def _hold(self, connection: sa.Connection, token: str) -> None:
        """Refuse to write if the lock was lost."""
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

    def _enter_products(self, connection: sa.Connection, entry: SceneEntry, run: str) -> None:
        if not entry.products:
            return
        rows = [self._product_row(new, entry, run) for new in entry.products]
        paths = [row["path"] for row in rows]
        before = connection.execute(
            sa.select(_P.path, _P.sha256, _P.run).where(
                _P.campaign == self.campaign, _P.path.in_(paths)
            )
        )
        shas = {new.record.path: (new.record.sha256, new.kept) for new in entry.products}
        replaced = [
            {
                "campaign": self.campaign, "path": path, "sha256": sha256, "run": old,
                "replaced_by": run, "kept": shas[path][1],
            }
            for path, sha256, old in before
            if shas[path][0] != sha256
        ]  # fmt: skip
        if replaced:
            connection.execute(self.insert_new(SUPERSEDED), replaced)
        self._drop_products(connection, paths)
        connection.execute(sa.insert(PRODUCT), rows)
        self._enter_inputs(connection, entry.products)

    def _product_row(self, new: NewProduct, entry: SceneEntry, run: str) -> dict[str, Any]:
        stated = ("path", "kind", "channel", "sha256", "size", "usable")
        change, written = new.record.change, new.record.stamp.written
        return {
            "campaign": self.campaign,
            "scene": entry.outcome.scene,
            "day": entry.day,
            "mtime_ns": new.mtime_ns,
            "run": run,
            **{name: getattr(new.record, name) for name in stated},
            **asdict(new.depends_on),
            "version": new.record.stamp.version,
            "written": None if written is None else naive(written),
            "change": "" if change is None else json.dumps(change.as_dict()),
        }

    def _enter_inputs(self, connection: sa.Connection, products: Sequence[NewProduct]) -> None:
        sets: dict[str, list[InputRecord]] = {}
        rows = []
        for new in products:
            by_role = sorted(new.inputs, key=attrgetter("role", "path"))
            for role, files in groupby(by_role, key=attrgetter("role")):
                members = list(files)
                name = _set_id(members)
                sets[name] = members
                rows.append(
                    {
                        "campaign": self.campaign, "product": new.record.path,
                        "role": role.value, "file_set": name,
                    }
                )  # fmt: skip
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
            connection.execute(self.insert_new(FILE_SET), files_of_sets)
        if rows:
            connection.execute(sa.insert(PRODUCT_INPUT), rows)

    def _enter_scene(self, connection: sa.Connection, entry: SceneEntry, run: str) -> None:
        outcome = entry.outcome
        row = {
            "campaign": self.campaign, "scene": outcome.scene, "day": entry.day,
            "key": entry.key, "run": run, "error": outcome.error, "internal": outcome.internal,
            "final": entry.final, "crashes": 0,
        }  # fmt: skip
        connection.execute(self.upsert(SCENE), row)
        stages = [
            {"run": run, "scene": outcome.scene, "stage": stage, "seconds": seconds}
            for stage, seconds in outcome.seconds.items()
        ]
        if stages:
            connection.execute(self.insert_new(STAGE), stages)

    def _refuse(self, connection: sa.Connection, refused: Iterable[Granule]) -> None:
        """Enter granules that cannot be used; the next scan tries what was not read again."""
        # Whole rows: a scan leaves a row whose stamp is that of the file as it reads it.
        rows = [
            row_of(granule, self.campaign, self._scan_key(connection, granule)).values
            for granule in refused
        ]
        if rows:
            connection.execute(self.upsert(GRANULE), rows)

    def _scan_key(self, connection: sa.Connection, refused: Granule) -> str:
        """Return the key by which a scan knows a damaged file, or `RETRY` if it was not read."""
        here = GRANULE.c.campaign == self.campaign, GRANULE.c.path == refused.path
        known = sa.select(GRANULE.c.scan_key).where(*here)
        return (connection.scalar(known) if refused.sha256 else None) or RETRY

    # Products

    def products_of_days(self, first: int, last: int) -> list[RecordedProduct]:
        """Return the products of scenes that start on days `first` to `last`."""
        query = sa.select(*_MADE).where(_P.campaign == self.campaign, _P.day.between(first, last))
        with self.transaction() as connection:
            rows = connection.execute(query)
            return list(self.decoded(_made_from(row) for row in rows))

    @contextmanager
    def all_products(self) -> Iterator[Iterator[RecordedProduct]]:
        """Yield every product, ordered by path, without holding them all."""
        query = sa.select(*_MADE).where(_P.campaign == self.campaign).order_by(_P.path)
        with self.stream(query) as rows:
            yield self.decoded(_made_from(row) for row in rows)

    def made_by_any_campaign(self, paths: Collection[str]) -> set[str]:
        """Return those of some paths that are products of any campaign of the database."""
        made: set[str] = set()
        ordered = sorted(paths)
        with self.transaction() as connection:
            for first in range(0, len(ordered), BATCH):
                batch = ordered[first : first + BATCH]
                made.update(connection.scalars(sa.select(_P.path).where(_P.path.in_(batch))))
        return made

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
        with self.transaction() as connection:
            return [dict(row) for row in connection.execute(query).mappings()]

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
        with self.transaction() as connection:
            rows = connection.execute(query)
            return list(
                self.decoded(InputRecord(path, Role(role), sha256) for path, role, sha256 in rows)
            )

    def lost_inputs(self) -> list[tuple[str, str]]:
        """Return set and path of raw inputs of products that the catalog lacks or could not read.

        Also of files that products state as unused, and the catalog lacks. Without those whose
        content is known under another path.
        """
        listed = sa.exists().where(
            GRANULE.c.campaign == self.campaign,
            GRANULE.c.path == FILE_SET.c.path,
            GRANULE.c.reason.not_like(f"{UNREADABLE}%") | (FILE_SET.c.sha256 == ""),
        )
        query = sa.select(FILE_SET).where(FILE_SET.c.id.in_(self._raw_sets()), ~listed)
        with self.stream(query) as rows:
            lost = [(name, path, sha256) for name, path, sha256 in rows]
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
        with self.transaction() as connection:
            size = dict(connection.execute(sizes.group_by(files.id)).tuples().all())
            rows = list(connection.execute(self._raw_sets().add_columns(link.role, link.product)))
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
        if stamps:
            with self.transaction() as connection:
                connection.execute(
                    sa.update(PRODUCT)
                    .where(_P.campaign == self.campaign, _P.path == sa.bindparam("file"))
                    .values(mtime_ns=sa.bindparam("stamp")),
                    [{"file": path, "stamp": stamp} for path, stamp in stamps.items()],
                )

    def forget_products(self, paths: Collection[str], token: str) -> None:
        """Remove products, and their inputs that no other product uses."""
        with self.transaction() as connection:
            self._hold(connection, token)
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

    def superseded(self) -> list[SupersededVersion]:
        """Return the replaced versions of products, ordered by path."""
        old = SUPERSEDED.c
        columns = (old[field.name] for field in fields(SupersededVersion))
        query = sa.select(*columns).where(old.campaign == self.campaign)
        query = query.order_by(old.path, old.run)
        with self.transaction() as connection:
            return [SupersededVersion(*row) for row in connection.execute(query)]

    # Scenes and verdicts

    def last_tries(self, first: int, last: int) -> dict[str, LastTry]:
        """Return the result of the last try of every scene on days `first` to `last`."""
        known = SCENE.c
        columns = (known[name] for name in ("scene", *LastTry._fields))
        query = sa.select(*columns).where(
            known.campaign == self.campaign, known.day.between(first, last)
        )
        with self.transaction() as connection:
            return {row[0]: LastTry(*row[1:]) for row in connection.execute(query)}

    def scenes_of_other_days(self, days: Collection[int]) -> list[str]:
        """Return the scenes of other days than these that were tried."""
        known = SCENE.c
        where = known.campaign == self.campaign
        with self.transaction() as connection:
            tried = set(connection.scalars(sa.select(known.day).where(where).distinct()))
            others = sorted(tried.difference(days))
            query = sa.select(known.scene).where(where, known.day == sa.bindparam("other"))
            return [scene for day in others for scene in connection.scalars(query, {"other": day})]

    def failures(self) -> dict[str, str]:
        """Return scene -> error of the scenes whose last try failed."""
        return self._said_of_scenes(SCENE.c.error)

    def internal_errors(self) -> dict[str, str]:
        """Return scene -> traceback of the scenes whose last try ended with an internal error."""
        return self._said_of_scenes(SCENE.c.internal)

    def _said_of_scenes(self, column: sa.Column[str]) -> dict[str, str]:
        query = sa.select(SCENE.c.scene, column).where(
            SCENE.c.campaign == self.campaign, column != ""
        )
        with self.transaction() as connection:
            return dict(connection.execute(query).tuples().all())

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
        names = sorted(scenes)
        with self.transaction() as connection:
            for first in range(0, len(names), BATCH):
                connection.execute(
                    sa.delete(SCENE).where(
                        SCENE.c.campaign == self.campaign,
                        SCENE.c.scene.in_(names[first : first + BATCH]),
                    )
                )

    def verdicts(self) -> dict[int, Verdict]:
        """Return the verdicts on settled days."""
        query = sa.select(*(VERDICT.c[name] for name in ("day", *Verdict._fields))).where(
            VERDICT.c.campaign == self.campaign
        )
        with self.transaction() as connection:
            rows = connection.execute(query)
            return dict(self.decoded((row.day, _verdict_from(row)) for row in rows))

    def store_verdicts(self, verdicts: Mapping[int, Verdict]) -> None:
        """Note that all requested products of these days are fresh."""
        if not verdicts:
            return
        rows = [
            {
                "campaign": self.campaign,
                "day": day,
                **verdict._asdict(),
                "files": json.dumps(verdict.files),
            }
            for day, verdict in verdicts.items()
        ]
        with self.transaction() as connection:
            connection.execute(self.upsert(VERDICT), rows)


def _set_id(files: Sequence[InputRecord]) -> str:
    digest = hashlib.sha256()
    for used in files:
        digest.update(f"{used.path}\0{used.sha256}\0".encode("utf-8", "surrogateescape"))
    return digest.hexdigest()[:32]


def _made_from(row: Any) -> RecordedProduct:
    # In the order of `_MADE`.
    stamp = Stamp(row.version, None if row.written is None else aware(row.written))
    return RecordedProduct(*(*row[:8], Dependence(*row[8:12]), row.run, stamp))


def _verdict_from(row: Any) -> Verdict:
    return Verdict(row.signature, row.empty_scenes, row.set_aside, json.loads(row.files))


def _stages(connection: sa.Connection, run: str) -> dict[str, float]:
    query = (
        sa.select(STAGE.c.stage, sa.func.sum(STAGE.c.seconds))
        .where(STAGE.c.run == run)
        .group_by(STAGE.c.stage)
        .order_by(STAGE.c.stage)
    )
    return {stage: float(seconds) for stage, seconds in connection.execute(query)}


def _run_from(row: Any, seconds: Mapping[str, float]) -> Run:
    values = {field.name: getattr(row, field.name) for field in fields(Run)[:-1]}
    return Run(
        **values
        | {
            "started": row.started.replace(tzinfo=UTC),
            "finished": aware(row.finished),
            "status": RunStatus(row.status),
            "seconds": seconds,
        }
    )
