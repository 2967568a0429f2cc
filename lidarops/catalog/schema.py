"""The tables of catalog and ledger, and their schema version."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any, Final

import sqlalchemy as sa

SCHEMA_VERSION: Final = 12
"""Raised with every change of a table; a database of another version is refused."""

METADATA: Final = sa.MetaData()


class Moment(sa.TypeDecorator[datetime]):
    """A time, stored in UTC without a zone."""

    impl = sa.DateTime
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Any) -> datetime | None:  # noqa: ARG002
        """Return a time as it is stored."""
        return None if value is None else value.astimezone(UTC).replace(tzinfo=None)

    def process_result_value(self, value: datetime | None, dialect: Any) -> datetime | None:  # noqa: ARG002
        """Return a stored time with its zone."""
        return None if value is None else value.replace(tzinfo=UTC)


# Paths are listed by code point; PostgreSQL would sort them by the locale of the server.
_PATH = sa.String(1024).with_variant(sa.String(1024, collation="C"), "postgresql")
_NAME = sa.String(40)
_SCENE = sa.String(160)
_DIGEST = sa.String(64)

SCHEMA = sa.Table("schema_version", METADATA, sa.Column("version", sa.Integer, primary_key=True))

LAYOUT = sa.Table(
    "layout",
    METADATA,
    sa.Column("hash", sa.String(16), primary_key=True),
    sa.Column("channels", sa.Text, nullable=False),
)

GRANULE = sa.Table(
    "granule",
    METADATA,
    sa.Column("campaign", _NAME, primary_key=True),
    sa.Column("path", _PATH, primary_key=True),
    sa.Column("size", sa.BigInteger, nullable=False),
    sa.Column("mtime_ns", sa.BigInteger, nullable=False),
    sa.Column("scan_key", sa.String(16), nullable=False),
    sa.Column("instrument", _NAME, nullable=False),
    sa.Column("role", sa.String(8), nullable=False),
    sa.Column("status", sa.String(8), nullable=False),
    sa.Column("reason", sa.Text, nullable=False),
    # JSON lists of sentences.
    sa.Column("notes", sa.Text, nullable=False),
    sa.Column("contradictions", sa.Text, nullable=False),
    sa.Column("start", Moment),
    sa.Column("stop", Moment),
    *(
        sa.Column(name, sa.Float)
        for name in ("zenith_angle", "azimuth", "latitude", "longitude", "altitude")
    ),
    sa.Column("layout", sa.ForeignKey("layout.hash")),
    sa.Column("sha256", _DIGEST),
    # Name of the raw format; empty where the file is refused.
    sa.Column("format", _NAME, nullable=False),
    sa.Column("header_digest", sa.String(16)),
    sa.Column("setup", sa.String(16), nullable=False),
    # Day of the start, in days since 1970-01-01; null if the start is unknown.
    sa.Column("day", sa.Integer),
    # Two halves of a digest of the row; their sums over a day change if any row of it changes.
    sa.Column("stamp_low", sa.BigInteger, nullable=False),
    sa.Column("stamp_high", sa.BigInteger, nullable=False),
    sa.Index("granule_by_day", "campaign", "day", "role", "status", "stamp_low", "stamp_high"),
    sqlite_with_rowid=False,
)

CHANNEL_NAME = sa.Table(
    "channel_name",
    METADATA,
    sa.Column("campaign", _NAME, primary_key=True),
    sa.Column("instrument", _NAME, primary_key=True),
    sa.Column("name", sa.Text, primary_key=True),
    # JSON of the recorder that has this name for good.
    sa.Column("recorder", sa.Text, nullable=False),
    sqlite_with_rowid=False,
)

RUN_COUNTS: Final = ("scenes", "products", "granules", "failed", "refused")

RUN = sa.Table(
    "run",
    METADATA,
    sa.Column("id", _NAME, primary_key=True),
    sa.Column("campaign", _NAME, nullable=False),
    sa.Column("started", Moment, nullable=False),
    sa.Column("finished", Moment),
    sa.Column("status", sa.String(12), nullable=False),
    sa.Column("holder", sa.Text, nullable=False),
    sa.Column("version", _NAME, nullable=False),
    sa.Column("code_version", _NAME, nullable=False),
    # Folder or URL of the raw files, without keys, and folder of the campaign file.
    sa.Column("archive", sa.Text, nullable=False),
    sa.Column("folder", sa.Text, nullable=False),
    *(sa.Column(name, sa.Integer, nullable=False) for name in RUN_COUNTS),
    sa.Index("run_by_time", "campaign", "started"),
)

PRODUCT = sa.Table(
    "product",
    METADATA,
    sa.Column("campaign", _NAME, primary_key=True),
    sa.Column("path", _PATH, primary_key=True),
    sa.Column("scene", _SCENE, nullable=False),
    sa.Column("day", sa.Integer, nullable=False),
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("channel", _NAME, nullable=False),
    sa.Column("sha256", _DIGEST, nullable=False),
    sa.Column("size", sa.BigInteger, nullable=False),
    sa.Column("mtime_ns", sa.BigInteger, nullable=False),
    sa.Column("plan_hash", _DIGEST, nullable=False),
    sa.Column("settings_hash", _DIGEST, nullable=False),
    sa.Column("inputs_hash", _DIGEST, nullable=False),
    sa.Column("code_version", _NAME, nullable=False),
    sa.Column("run", sa.ForeignKey("run.id"), nullable=False),
    # Number of usable values; null if they were not counted.
    sa.Column("usable", sa.BigInteger),
    # Number of the version of the content, and when its file was written.
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("written", Moment),
    # How it differs from the product that it replaced, as JSON; empty for a new one.
    sa.Column("change", sa.Text, nullable=False),
    sa.Index("product_by_day", "campaign", "day"),
    sqlite_with_rowid=False,
)

PRODUCT_INPUT = sa.Table(
    "product_input",
    METADATA,
    sa.Column("campaign", _NAME, primary_key=True),
    sa.Column("product", _PATH, primary_key=True),
    sa.Column("role", sa.String(16), primary_key=True),
    # The products of a scene share their files, so each set of files is stored once.
    sa.Column("file_set", sa.String(32), nullable=False),
    sa.Index("product_input_by_set", "file_set"),
    sqlite_with_rowid=False,
)

FILE_SET = sa.Table(
    "file_set",
    METADATA,
    sa.Column("id", sa.String(32), primary_key=True),
    sa.Column("path", _PATH, primary_key=True),
    sa.Column("sha256", _DIGEST, nullable=False),
    sqlite_with_rowid=False,
)

SCENE = sa.Table(
    "scene",
    METADATA,
    sa.Column("campaign", _NAME, primary_key=True),
    sa.Column("scene", _SCENE, primary_key=True),
    sa.Column("day", sa.Integer, nullable=False),
    # Digest of everything that could affect the outcome of the last try.
    sa.Column("key", _DIGEST, nullable=False),
    sa.Column("run", sa.ForeignKey("run.id"), nullable=False),
    sa.Column("error", sa.Text, nullable=False),
    # Traceback if the error is internal, a bug of lidarops; else empty.
    sa.Column("internal", sa.Text, nullable=False),
    # Whether another try on the same inputs would fail again.
    sa.Column("final", sa.Boolean, nullable=False),
    # Number of tries that started and did not end because the process died.
    sa.Column("crashes", sa.Integer, nullable=False),
    sa.Index("scene_by_day", "campaign", "day"),
    sqlite_with_rowid=False,
)

STAGE = sa.Table(
    "stage",
    METADATA,
    sa.Column("run", sa.ForeignKey("run.id"), primary_key=True),
    sa.Column("scene", _SCENE, primary_key=True),
    sa.Column("stage", _NAME, primary_key=True),
    sa.Column("seconds", sa.Float, nullable=False),
    sqlite_with_rowid=False,
)

VERDICT = sa.Table(
    "verdict",
    METADATA,
    sa.Column("campaign", _NAME, primary_key=True),
    sa.Column("day", sa.Integer, primary_key=True),
    # State of the day (see Signature) when all its requested products were fresh.
    sa.Column("signature", _DIGEST, nullable=False),
    # JSON of the other fields of `Verdict`.
    sa.Column("facts", sa.Text, nullable=False),
    sqlite_with_rowid=False,
)

LOCK = sa.Table(
    "lock",
    METADATA,
    sa.Column("campaign", _NAME, primary_key=True),
    sa.Column("token", sa.String(32), nullable=False),
    sa.Column("holder", sa.Text, nullable=False),
    sa.Column("machine", sa.Text, nullable=False),
    sa.Column("process", sa.BigInteger, nullable=False),
    sa.Column("process_started", sa.Text, nullable=False),
    sa.Column("acquired", sa.Float, nullable=False),
    sa.Column("heartbeat", sa.Float, nullable=False),
)
