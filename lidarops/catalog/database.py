"""A database that holds catalog and ledger: SQLite by default, PostgreSQL by URL."""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
import tempfile
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Self, TypeVar

import sqlalchemy as sa
from sqlalchemy.dialects import sqlite

from lidarops.campaign.model import Campaign
from lidarops.catalog.raw_files import Source
from lidarops.errors import CatalogError, LidarOpsError, UnavailableError

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


def _of_campaigns(name: str, *columns: Any) -> sa.Table:
    """Return a table whose rows belong to campaigns."""
    campaign = sa.Column("campaign", _NAME, primary_key=True)
    return sa.Table(name, METADATA, campaign, *columns, sqlite_with_rowid=False)


SCHEMA = sa.Table("schema_version", METADATA, sa.Column("version", sa.Integer, primary_key=True))

LAYOUT = sa.Table(
    "layout",
    METADATA,
    sa.Column("hash", sa.String(16), primary_key=True),
    sa.Column("channels", sa.Text, nullable=False),
)

GRANULE = _of_campaigns(
    "granule",
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
)

CHANNEL_NAME = _of_campaigns(
    "channel_name",
    sa.Column("instrument", _NAME, primary_key=True),
    sa.Column("name", sa.Text, primary_key=True),
    # JSON of the recorder that has this name for good.
    sa.Column("recorder", sa.Text, nullable=False),
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

PRODUCT = _of_campaigns(
    "product",
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
)

PRODUCT_INPUT = _of_campaigns(
    "product_input",
    sa.Column("product", _PATH, primary_key=True),
    sa.Column("role", sa.String(16), primary_key=True),
    # The products of a scene share their files, so each set of files is stored once.
    sa.Column("file_set", sa.String(32), nullable=False),
    sa.Index("product_input_by_set", "file_set"),
)

FILE_SET = sa.Table(
    "file_set",
    METADATA,
    sa.Column("id", sa.String(32), primary_key=True),
    sa.Column("path", _PATH, primary_key=True),
    sa.Column("sha256", _DIGEST, nullable=False),
    sqlite_with_rowid=False,
)

SCENE = _of_campaigns(
    "scene",
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

VERDICT = _of_campaigns(
    "verdict",
    sa.Column("day", sa.Integer, primary_key=True),
    # State of the day (see Signature) when all its requested products were fresh.
    sa.Column("signature", _DIGEST, nullable=False),
    # JSON of the other fields of `Verdict`.
    sa.Column("facts", sa.Text, nullable=False),
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


_T = TypeVar("_T")

_BATCH: Final = 1000
"""Largest number of values in the list of one statement."""
_MOVE_AWAY: Final = "move it away; lidarops then makes a new one, and all products again"
_URLS: Final = "give sqlite:///FILE or postgresql+psycopg://USER@HOST/NAME"
_SECRET: Final = re.compile("passw|secret")
"""Names of passwords in the query of a URL: password, passwd, sslpassword, oauth_client_secret."""
WITHOUT_PASSWORD: Final = rf"^(?![^:]*://[^/:]*:[^@]+@)(?!.*[?&][^=&]*(?:{_SECRET.pattern})[^=&]*=)"
"""Regular expression of URLs without password, for JSON schemas."""
_LOCK_SCHEMA: Final = "SELECT pg_advisory_xact_lock(7235106412)"
"""The number is arbitrary."""
_PATIENCE: Final = 30
"""s, for which SQLite waits for another process, and a connection for a server."""
_PAUSE: Final = 0.02
"""s."""
_REMEDIES: Final = (
    (("full", "No space left"), "make space on the disk, then run again: finished scenes are kept"),
    (
        ("readonly", "read-only"),
        "make the folder writable, or choose another with --out or LIDAROPS_CATALOG",
    ),
    (
        ("password", "pg_hba.conf"),
        "give the password in PGPASSWORD or ~/.pgpass, or ask who runs the server to let you in",
    ),
    (("permission denied",), "ask who runs the server for the right to make and change tables"),
    (("does not exist",), "correct user and name in the URL, or make the database: createdb NAME"),
    (("too many", "reserved for"), "run again when fewer programs use the server"),
    (
        ("terminating connection", "closed the connection", "shutting down", "starting up"),
        "run again when the server runs: finished scenes are kept",
    ),
)
"""Words in the messages of databases, and what to do."""
_BROKEN: Final = ("malformed", "not a database", "decode")
"""Words in the messages of SQLite about a damaged file."""


class Database:
    """Transactions on the tables of `lidarops.catalog.database`, for one campaign.

    Parameters
    ----------
    url : str
        SQLAlchemy URL, such as ``sqlite:///catalog.sqlite`` or ``postgresql+psycopg://...``.
    campaign : str
        Name of the campaign; several may share a database.
    create : bool
        Whether to make the catalog if there is none.

    Raises
    ------
    CatalogError
        If the database does not exist, cannot be opened, or has another schema version.
    """

    def __init__(self, url: str, campaign: str, *, create: bool = True) -> None:
        self._create = create
        self.campaign = campaign
        self._url = _parsed(url)
        self._sqlite = self._url.get_backend_name() == "sqlite"
        if self._sqlite and self._url.database:
            # Check first, because opening would create the file.
            if not create and not Path(self._url.database).exists():
                raise self._absent()
            folder = Path(self._url.database).parent
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise UnavailableError(
                    f"the folder of the catalog cannot be made: {error.strerror}",
                    file=folder,
                    remedy="choose another folder with --out",
                ) from error
        self._copied = ExitStack()
        self._upserts: dict[tuple[str, bool], sa.TextClause] = {}
        self._engine = _engine(self._url if create else self._readable())
        if self._sqlite:
            sa.event.listen(self._engine, "connect", _tune_sqlite)
        with self.transaction() as connection:
            self._settle_schema(connection)

    def __enter__(self) -> Self:
        return self

    @property
    def place(self) -> str:
        """The URL without its password."""
        return _without_passwords(self._url)

    def close(self, *_: object) -> None:
        """Close the database connections."""
        self._engine.dispose()
        self._copied.close()

    __exit__ = close

    @contextmanager
    def transaction(self) -> Iterator[sa.Connection]:
        """Yield a connection; commit all its changes at the end, or none if an error is raised."""
        try:
            with self._engine.begin() as connection:
                yield connection
        except sa.exc.SQLAlchemyError as error:
            raise self._catalog_error(error) from error

    @contextmanager
    def stream(self, query: sa.Select[Any]) -> Iterator[Iterator[sa.Row[Any]]]:
        """Yield the rows of a query one by one, with at most a few thousand in memory."""
        try:
            with self._engine.connect() as connection:
                options = {"stream_results": True, "yield_per": 5000}
                yield self.decoded(connection.execution_options(**options).execute(query))
        except sa.exc.SQLAlchemyError as error:
            raise self._catalog_error(error) from error

    def read(self, query: sa.Select[Any], make: Callable[[Any], _T]) -> list[_T]:
        """Return what is made of each row of a query."""
        with self.transaction() as connection:
            return list(self.decoded(map(make, connection.execute(query))))

    def execute(self, statement: Any, rows: list[dict[str, Any]]) -> None:
        """Carry out a statement for each of some rows, in one transaction."""
        if rows:
            with self.transaction() as connection:
                connection.execute(statement, rows)

    def read_batches(self, names: Collection[str], query: Callable[[list[str]], Any]) -> list[Any]:
        """Return the rows of a query on many names, some of which make a statement."""
        ordered = sorted(names)
        batches = (ordered[k : k + _BATCH] for k in range(0, len(ordered), _BATCH))
        with self.transaction() as connection:
            return [row for batch in batches for row in connection.execute(query(batch))]

    def decoded(self, records: Iterable[_T]) -> Iterator[_T]:
        """Yield rows, or what is made of them as they are read.

        Raises
        ------
        CatalogError
            Where a stored value is not what lidarops stores.
        """
        try:
            yield from records
        except LidarOpsError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise CatalogError(
                f"the catalog cannot be used: it holds {error!r}",
                file=self.place,
                remedy=_MOVE_AWAY,
            ) from error

    def insert(self, table: sa.Table) -> Any:
        """Return an insert statement that can handle rows that already exist."""
        if self._sqlite:
            return sqlite.insert(table)
        from sqlalchemy.dialects import postgresql  # noqa: PLC0415 - few catalogs need it

        return postgresql.insert(table)

    def upsert(self, table: sa.Table, *, replacing: bool = True) -> sa.TextClause:
        """Return an insert of complete rows that replaces existing rows, or leaves them.

        As text: SQLAlchemy does not cache the compiled form of such an insert, and compiling it
        each time takes longer than executing it.
        """
        key = table.name, replacing
        if key not in self._upserts:
            statement = self.insert(table)
            if replacing:
                others = {c.name: statement.excluded[c.name] for c in table.c if not c.primary_key}
                keys = table.primary_key.columns.keys()
                statement = statement.on_conflict_do_update(index_elements=keys, set_=others)
            else:
                statement = statement.on_conflict_do_nothing()
            # Dialects take it, their interface does not state it.
            dialect = self._url.get_dialect()(paramstyle="named")  # type: ignore[call-arg]
            # Types are needed because a text statement does not know how times are stored.
            typed = [sa.bindparam(column.name, type_=column.type) for column in table.columns]
            text = str(statement.compile(dialect=dialect))
            self._upserts[key] = sa.text(text).bindparams(*typed)
        return self._upserts[key]

    def clock(self) -> sa.ColumnElement[float]:
        """Return the time of the database in s, the one clock that all its users share."""
        if self._sqlite:
            return sa.literal_column("(julianday('now') - 2440587.5) * 86400.0", sa.Float())
        return sa.literal_column("extract(epoch from clock_timestamp())::float8", sa.Float())

    def copy_to(self, file: Path) -> None:
        """Copy this SQLite database to a file."""
        try:
            with (
                closing(self._engine.raw_connection()) as source,
                closing(sqlite3.connect(file)) as target,
            ):
                own: sqlite3.Connection = source.driver_connection  # type: ignore[assignment]
                own.backup(target)
        except sqlite3.Error as error:
            raise UnavailableError(f"cannot be copied: {error}", file=self.place) from error

    def _readable(self) -> sa.URL:
        """Return a URL that can be read also where the folder of the database cannot be written."""
        file = Path(self._url.database or "")
        if not self._sqlite or not self._url.database or os.access(file.parent, os.W_OK):
            return self._url
        journal, index = Path(f"{file}-wal"), Path(f"{file}-shm")
        if journal.exists() and index.exists():
            # Another user may write now.
            return self._as_uri(file, mode="ro")
        with suppress(FileNotFoundError):
            if journal.stat().st_size:
                # Left by a killed process; SQLite would make its index.
                folder = self._copied.enter_context(tempfile.TemporaryDirectory(prefix="lidarops-"))
                for part in (file, journal):
                    shutil.copy(part, folder)
                return self._url.set(database=str(Path(folder, file.name)))
        # Nobody has it open, or no longer: that removes the journal. SQLite would make files.
        return self._as_uri(file, immutable="1")

    def _as_uri(self, file: Path, **query: str) -> sa.URL:
        return self._url.set(database=file.absolute().as_uri(), query={"uri": "true", **query})

    def _settle_schema(self, connection: sa.Connection) -> None:
        version = _version(connection)
        if version is None:
            if not self._create:
                raise self._absent()
            # Waits for a process that is making it, and ends with the transaction.
            connection.exec_driver_sql("BEGIN IMMEDIATE" if self._sqlite else _LOCK_SCHEMA)
            version = _version(connection)
        # Also where a process was killed before it had written the version.
        if version is None:
            METADATA.create_all(connection)
            version = SCHEMA_VERSION
            connection.execute(sa.insert(SCHEMA), {"version": version})
        if version != SCHEMA_VERSION:
            raise CatalogError(
                f"is a catalog of schema version {version}; this lidarops needs {SCHEMA_VERSION}",
                file=self.place,
                remedy=_MOVE_AWAY,
            )

    def _absent(self) -> CatalogError:
        return CatalogError(
            "there is no catalog yet", file=self.place, remedy="run lidarops reprocess first"
        )

    def _catalog_error(self, error: sa.exc.SQLAlchemyError) -> CatalogError:
        cause = str(getattr(error, "orig", None) or error).strip()
        problem = f"the catalog cannot be used: {cause}"
        if self._sqlite and any(word in cause for word in _BROKEN):
            return CatalogError(problem, file=self.place, remedy=_MOVE_AWAY)
        remedy = "check that the server runs, and host, user, password and name in the URL"
        if self._sqlite:
            remedy = "check that the folder is writable and the file is a lidarops catalog"
        found = (remedy for words, remedy in _REMEDIES if any(word in cause for word in words))
        return UnavailableError(problem, file=self.place, remedy=next(found, remedy))


def check_archive_and_catalog(campaign: Campaign, *, archive: str | None) -> None:
    """Refuse an archive that does not exist and a catalog whose URL names no database.

    Parameters
    ----------
    campaign : Campaign
        As loaded.
    archive : str, optional
        Archive that overrides the campaign file. It is wrong use if this one does not exist; the
        archive of a campaign file may be temporarily unavailable.

    Raises
    ------
    CatalogError
    """
    _engine(_parsed(campaign.catalog_url)).dispose()
    try:
        Source.of(campaign.archive).refuse_absent()
    except CatalogError as error:
        error.wrong_use = error.wrong_use or bool(archive)
        raise


@contextmanager
def without_writing(campaign: Campaign) -> Iterator[Campaign]:
    """Yield a campaign whose catalog may be updated without a trace in its output folder.

    A catalog in a folder that does not exist, or cannot be written, is replaced by a temporary one,
    which starts as its copy. Any other is the campaign's own: its update saves the next run work.
    """
    file = Path(sa.make_url(campaign.catalog_url).database or "")
    in_file = campaign.catalog_url.startswith("sqlite") and file.name
    if not in_file or os.access(file.parent, os.W_OK):
        yield campaign
        return
    with tempfile.TemporaryDirectory(prefix="lidarops-") as folder:
        copy = Path(folder, file.name)
        if file.exists():
            with Database(campaign.catalog_url, campaign.name, create=False) as source:
                source.copy_to(copy)
        yield campaign.model_copy(update={"catalog": f"sqlite:///{copy}"})


def holds_password(url: str) -> bool:
    """Return whether a database URL holds a password, also in its query.

    Raises
    ------
    CatalogError
        If the URL is invalid.
    """
    parsed = _parsed(url)
    return bool(parsed.password) or any(map(_SECRET.search, parsed.query))


def _version(connection: sa.Connection) -> int | None:
    """Return the version of the schema; None where there is none yet."""
    if not sa.inspect(connection).has_table(SCHEMA.name):
        return None
    version: int | None = connection.scalar(sa.select(sa.func.max(SCHEMA.c.version)))
    return version


def _without_passwords(url: sa.URL) -> str:
    """Return a URL without its passwords."""
    secrets = filter(_SECRET.search, url.query)
    return url.difference_update_query(secrets).render_as_string(hide_password=True)


def _parsed(url: str) -> sa.URL:
    try:
        return sa.make_url(url)
    except sa.exc.ArgumentError as error:
        raise CatalogError(
            "is not a database URL",
            # A password may stand before the @, or in the query.
            file=url.rpartition("@")[2].partition("?")[0],
            remedy=_URLS,
            wrong_use=True,
        ) from error


def _engine(url: sa.URL) -> sa.Engine:
    # A host that does not answer would hold a run for ever.
    if url.get_backend_name() == "postgresql" and "connect_timeout" not in url.query:
        url = url.update_query_dict({"connect_timeout": str(_PATIENCE)})
    try:
        return sa.create_engine(url)
    except sa.exc.NoSuchModuleError as error:
        raise CatalogError(
            f"unknown kind of database: {error}",
            file=_without_passwords(url),
            remedy=_URLS,
            wrong_use=True,
        ) from error
    except (ImportError, sa.exc.SQLAlchemyError) as error:
        raise CatalogError(
            f"cannot be opened: {error}",
            file=_without_passwords(url),
            remedy="install its driver: pip install lidarops[postgresql]",
        ) from error


def _tune_sqlite(connection: Any, _record: Any) -> None:
    cursor = connection.cursor()
    cursor.execute(f"PRAGMA busy_timeout={1000 * _PATIENCE}")
    # Query first, because setting it writes.
    is_set = cursor.execute("PRAGMA journal_mode").fetchone()[0] == "wal"
    end = time.monotonic() + _PATIENCE
    while not is_set:
        try:
            cursor.execute("PRAGMA journal_mode=WAL")
            is_set = True
        except sqlite3.OperationalError as error:
            # Two processes that set it at once would wait for each other: SQLite waits for neither.
            if "locked" not in str(error) or time.monotonic() > end:
                raise
            time.sleep(_PAUSE)
    cursor.execute("PRAGMA synchronous=NORMAL")
    cursor.execute("PRAGMA foreign_keys=ON")
    cursor.close()
