"""Catalog and ledger in one database: SQLite by default, PostgreSQL by URL.

Tables: ``layout`` (channels of raw files, shared by most granules), ``granule`` (one row a raw
file), ``run`` (one row an execution), ``product`` and ``product_input`` (what was written from
which bytes).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from lidarops.errors import CatalogError
from lidarops.records import (
    ChannelLayout,
    DetectionMode,
    Granule,
    Role,
    RunRecord,
    Status,
)

_METADATA = sa.MetaData()

_LAYOUT = sa.Table(
    "layout",
    _METADATA,
    sa.Column("hash", sa.String(16), primary_key=True),
    sa.Column("channels", sa.Text, nullable=False),
)

_GRANULE = sa.Table(
    "granule",
    _METADATA,
    sa.Column("campaign", sa.String(40), primary_key=True),
    sa.Column("path", sa.String(1024), primary_key=True),
    sa.Column("size", sa.BigInteger, nullable=False),
    sa.Column("mtime_ns", sa.BigInteger, nullable=False),
    sa.Column("scan_key", sa.String(16), nullable=False),
    sa.Column("instrument", sa.String(40), nullable=False),
    sa.Column("role", sa.String(8), nullable=False),
    sa.Column("status", sa.String(8), nullable=False),
    sa.Column("reason", sa.Text, nullable=False),
    sa.Column("notes", sa.Text, nullable=False),
    sa.Column("start", sa.DateTime),
    sa.Column("stop", sa.DateTime),
    sa.Column("zenith_angle", sa.Float),
    sa.Column("azimuth", sa.Float),
    sa.Column("latitude", sa.Float),
    sa.Column("longitude", sa.Float),
    sa.Column("altitude", sa.Float),
    sa.Column("layout", sa.ForeignKey("layout.hash")),
    sa.Column("sha256", sa.String(64)),
    sa.Index("granule_by_time", "campaign", "instrument", "start"),
)

_RUN = sa.Table(
    "run",
    _METADATA,
    sa.Column("id", sa.String(40), primary_key=True),
    sa.Column("campaign", sa.String(40), nullable=False),
    sa.Column("started", sa.DateTime, nullable=False),
    sa.Column("finished", sa.DateTime, nullable=False),
    sa.Column("version", sa.String(40), nullable=False),
    sa.Column("scenes", sa.Integer, nullable=False),
    sa.Column("failed", sa.Integer, nullable=False),
)

_PRODUCT = sa.Table(
    "product",
    _METADATA,
    sa.Column("campaign", sa.String(40), primary_key=True),
    sa.Column("path", sa.String(1024), primary_key=True),
    sa.Column("scene", sa.String(120), nullable=False),
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("channel", sa.String(40), nullable=False),
    sa.Column("sha256", sa.String(64), nullable=False),
    sa.Column("size", sa.BigInteger, nullable=False),
    sa.Column("plan_hash", sa.String(64), nullable=False),
    sa.Column("run", sa.ForeignKey("run.id"), nullable=False),
    sa.Index("product_by_scene", "campaign", "scene"),
)

_PRODUCT_INPUT = sa.Table(
    "product_input",
    _METADATA,
    sa.Column("campaign", sa.String(40), primary_key=True),
    sa.Column("product", sa.String(1024), primary_key=True),
    sa.Column("path", sa.String(1024), primary_key=True),
    sa.Column("role", sa.String(8), nullable=False),
    sa.Column("sha256", sa.String(64), nullable=False),
)


class Store:
    """The catalog and ledger of one campaign.

    Parameters
    ----------
    url : str
        SQLAlchemy URL, such as ``sqlite:///catalog.sqlite`` or ``postgresql+psycopg://...``.
    campaign : str
        Name of the campaign; several may share a database.

    Raises
    ------
    CatalogError
        If the database cannot be opened.
    """

    def __init__(self, url: str, campaign: str) -> None:
        self.campaign = campaign
        self._url = sa.make_url(url)
        if self._url.get_backend_name() == "sqlite" and self._url.database:
            _make_folder(Path(self._url.database).parent)
        self._engine = sa.create_engine(self._url)
        if self._url.get_backend_name() == "sqlite":
            sa.event.listen(self._engine, "connect", _tune_sqlite)
        with self._transaction() as connection:
            _METADATA.create_all(connection)

    @contextmanager
    def _transaction(self) -> Iterator[sa.Connection]:
        try:
            with self._engine.begin() as connection:
                yield connection
        except sa.exc.SQLAlchemyError as error:
            cause = getattr(error, "orig", None) or error
            raise CatalogError(
                f"the catalog cannot be used: {cause}",
                file=self._url.render_as_string(hide_password=True),
                remedy="check that the folder is writable and the file is a lidarops catalog",
            ) from error

    def close(self) -> None:
        """Give the database connections back."""
        self._engine.dispose()

    def fingerprints(self) -> dict[str, tuple[int, int, str]]:
        """Return path -> (size, mtime_ns, scan key) of every granule of the campaign."""
        columns = _GRANULE.c
        query = sa.select(columns.path, columns.size, columns.mtime_ns, columns.scan_key).where(
            columns.campaign == self.campaign
        )
        with self._transaction() as connection:
            return {
                row.path: (row.size, row.mtime_ns, row.scan_key)
                for row in connection.execute(query)
            }

    def replace(self, granules: Iterable[tuple[Granule, str]]) -> None:
        """Insert granules, each with its scan key, in place of rows of the same path."""
        rows = []
        layouts: dict[str, str] = {}
        for granule, scan_key in granules:
            digest, text = _layout_row(granule.layout)
            layouts[digest] = text
            rows.append(_granule_row(granule, self.campaign, scan_key, digest))
        if not rows:
            return
        with self._transaction() as connection:
            known = set(connection.scalars(sa.select(_LAYOUT.c.hash)))
            fresh = [
                {"hash": key, "channels": text} for key, text in layouts.items() if key not in known
            ]
            if fresh:
                connection.execute(sa.insert(_LAYOUT), fresh)
            self._remove(connection, [row["path"] for row in rows])
            connection.execute(sa.insert(_GRANULE), rows)

    def forget(self, paths: Iterable[str]) -> None:
        """Remove the rows of files that are no longer in the archive."""
        with self._transaction() as connection:
            self._remove(connection, list(paths))

    def _remove(self, connection: sa.Connection, paths: list[str]) -> None:
        if not paths:
            return
        statement = sa.delete(_GRANULE).where(
            _GRANULE.c.campaign == self.campaign, _GRANULE.c.path == sa.bindparam("gone")
        )
        connection.execute(statement, [{"gone": path} for path in paths])

    def granules(self, *, status: Status | None = None) -> list[Granule]:
        """Return the granules of the campaign, by instrument, start time and path."""
        columns = _GRANULE.c
        query = sa.select(_GRANULE).where(columns.campaign == self.campaign)
        if status is not None:
            query = query.where(columns.status == status.value)
        query = query.order_by(columns.instrument, columns.start, columns.path)
        with self._transaction() as connection:
            layouts = {
                row.hash: _layout_from(row.channels)
                for row in connection.execute(sa.select(_LAYOUT))
            }
            return [_granule_from(row, layouts) for row in connection.execute(query)]

    def record_run(self, record: RunRecord) -> None:
        """Enter a finished run, its products and their inputs, in one transaction."""
        products: list[dict[str, Any]] = []
        inputs: list[dict[str, Any]] = []
        for outcome in record.scenes:
            for product in outcome.products:
                products.append(
                    {
                        "campaign": self.campaign,
                        "path": product.path,
                        "scene": outcome.scene,
                        "kind": product.kind.value,
                        "channel": product.channel,
                        "sha256": product.sha256,
                        "size": product.size,
                        "plan_hash": outcome.plan.hash if outcome.plan else "",
                        "run": record.id,
                    }
                )
                inputs.extend(
                    {
                        "campaign": self.campaign,
                        "product": product.path,
                        "path": used.path,
                        "role": used.role.value,
                        "sha256": used.sha256,
                    }
                    for used in outcome.inputs
                )
        with self._transaction() as connection:
            connection.execute(sa.insert(_RUN), [_run_row(record)])
            self._replace_products(connection, products, inputs)
            self._store_digests(connection, record)

    def _replace_products(
        self,
        connection: sa.Connection,
        products: list[dict[str, Any]],
        inputs: list[dict[str, Any]],
    ) -> None:
        gone = [{"gone": product["path"]} for product in products]
        if not gone:
            return
        for table, column in ((_PRODUCT_INPUT, "product"), (_PRODUCT, "path")):
            connection.execute(
                sa.delete(table).where(
                    table.c.campaign == self.campaign, table.c[column] == sa.bindparam("gone")
                ),
                gone,
            )
        connection.execute(sa.insert(_PRODUCT), products)
        if inputs:
            connection.execute(sa.insert(_PRODUCT_INPUT), inputs)

    def _store_digests(self, connection: sa.Connection, record: RunRecord) -> None:
        digests = {used.path: used.sha256 for scene in record.scenes for used in scene.inputs}
        if digests:
            connection.execute(
                sa.update(_GRANULE)
                .where(
                    _GRANULE.c.campaign == self.campaign, _GRANULE.c.path == sa.bindparam("file")
                )
                .values(sha256=sa.bindparam("digest")),
                [{"file": path, "digest": digest} for path, digest in digests.items()],
            )

    def products(self) -> list[Mapping[str, Any]]:
        """Return the ledger's rows of products, by path."""
        query = (
            sa.select(_PRODUCT)
            .where(_PRODUCT.c.campaign == self.campaign)
            .order_by(_PRODUCT.c.path)
        )
        with self._transaction() as connection:
            return [dict(row._mapping) for row in connection.execute(query)]  # noqa: SLF001

    def product_inputs(self, product: str) -> dict[str, str]:
        """Return input path -> sha256 of one product."""
        query = sa.select(_PRODUCT_INPUT.c.path, _PRODUCT_INPUT.c.sha256).where(
            _PRODUCT_INPUT.c.campaign == self.campaign, _PRODUCT_INPUT.c.product == product
        )
        with self._transaction() as connection:
            return {row.path: row.sha256 for row in connection.execute(query)}


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CatalogError(
            f"the catalog's folder cannot be made: {error.strerror}",
            file=folder,
            remedy="choose another folder with --out",
        ) from error


def _tune_sqlite(connection: Any, _record: Any) -> None:
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=NORMAL")
    cursor.execute("PRAGMA foreign_keys=ON")
    cursor.execute("PRAGMA busy_timeout=30000")
    cursor.close()


def _layout_row(layout: tuple[ChannelLayout, ...]) -> tuple[str, str]:
    text = json.dumps([asdict(channel) for channel in layout], separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16], text


def _layout_from(text: str) -> tuple[ChannelLayout, ...]:
    return tuple(
        ChannelLayout(**{**channel, "mode": DetectionMode(channel["mode"])})
        for channel in json.loads(text)
    )


def _naive(moment: datetime | None) -> datetime | None:
    return None if moment is None else moment.astimezone(UTC).replace(tzinfo=None)


def _aware(moment: datetime | None) -> datetime | None:
    return None if moment is None else moment.replace(tzinfo=UTC)


def _granule_row(granule: Granule, campaign: str, scan_key: str, layout: str) -> dict[str, Any]:
    return {
        "campaign": campaign,
        "path": granule.path,
        "size": granule.size,
        "mtime_ns": granule.mtime_ns,
        "scan_key": scan_key,
        "instrument": granule.instrument,
        "role": granule.role.value,
        "status": granule.status.value,
        "reason": granule.reason,
        "notes": json.dumps(granule.notes),
        "start": _naive(granule.start),
        "stop": _naive(granule.stop),
        "zenith_angle": granule.zenith_angle,
        "azimuth": granule.azimuth,
        "latitude": granule.latitude,
        "longitude": granule.longitude,
        "altitude": granule.altitude,
        "layout": layout,
        "sha256": granule.sha256,
    }


def _granule_from(row: Any, layouts: Mapping[str, tuple[ChannelLayout, ...]]) -> Granule:
    return Granule(
        path=row.path,
        size=row.size,
        mtime_ns=row.mtime_ns,
        instrument=row.instrument,
        role=Role(row.role),
        status=Status(row.status),
        reason=row.reason,
        notes=tuple(json.loads(row.notes)),
        start=_aware(row.start),
        stop=_aware(row.stop),
        zenith_angle=row.zenith_angle,
        azimuth=row.azimuth,
        latitude=row.latitude,
        longitude=row.longitude,
        altitude=row.altitude,
        layout=layouts[row.layout],
        sha256=row.sha256,
    )


def _run_row(record: RunRecord) -> dict[str, Any]:
    return {
        "id": record.id,
        "campaign": record.campaign,
        "started": _naive(record.started),
        "finished": _naive(record.finished),
        "version": record.version,
        "scenes": len(record.scenes),
        "failed": sum(bool(scene.error) for scene in record.scenes),
    }
