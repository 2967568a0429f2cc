"""Object stores and other file systems behind an fsspec URL: read raw files, write products.

``s3://``, ``gs://`` and all others that fsspec knows; ``http(s)://`` is read-only. The drivers find
keys and endpoints in variables such as ``AWS_ACCESS_KEY_ID`` and ``FSSPEC_S3_ENDPOINT_URL``; this
module stores none, and refuses URLs that hold them.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import re
import secrets
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from itertools import chain, islice
from pathlib import Path, PurePosixPath
from typing import Any, Final, NamedTuple, TypeVar
from urllib.parse import unquote, urlsplit

from lidarops.errors import CatalogError, LidarOpsError, ProductError, UnavailableError
from lidarops.system.files import sha256_of

_READ_ONLY: Final = frozenset({"http", "https"})
_ABSENT: Final = frozenset({404, 410})
"""Answers of a web server that lacks a file."""
_OF_STORE: Final = frozenset({407, 408, 425, 429})
"""Answers 4xx that concern the whole store: log in, too slow, too early, too often."""
_CODES_OF_STORE: Final = frozenset(
    {"ExpiredToken", "InvalidAccessKeyId", "InvalidToken", "NoSuchBucket", "RequestTimeTooSkewed",
     "RequestTimeout", "SignatureDoesNotMatch"}
)  # fmt: skip
"""Errors of S3 that concern the whole store though its answer is of another 4xx."""
_STAMPS: Final = (
    "mtime", "ETag", "etag", "LastModified", "last_modified", "updated", "created", "Last-Modified"
)  # fmt: skip
"""What drivers call the time or tag by which a file of the same size shows that it has changed."""
_NO_SUCH_RANGE: Final = 416
"""Answer where a file has none of the bytes, as an empty one."""
# Schemes by which an object appears only when its upload is complete.
_ATOMIC: Final = frozenset({"s3", "s3a", "gs", "gcs", "abfs", "abfss", "az"})
# A secret may hold slashes, so it is matched up to the last @. In Azure URLs the @ separates
# container and account.
_KEYS: Final = re.compile(r"(?<=://)(?:[^/:\s]*:\S*|(?<!abfs://)(?<!abfss://)[^/\s]*)@")
# Signatures and tokens stand in queries and fragments. Names of local files may hold their marks.
_QUERY: Final = re.compile(
    r"""(\b(?!file:)[A-Za-z][\w+.-]{0,30}://[^\s?#]*)[?#]\S*?(?=['")\]>,.;:]*(?:\s|$))"""
)
WITHOUT_KEYS: Final = rf"^(?!.*(?:{_KEYS.pattern}|{_QUERY.pattern}))"
"""Regular expression of texts that `without_keys` leaves as they are, for JSON schemas."""
_LONGEST_SILENCE: Final = 30.0
"""s after which a web server that sends nothing counts as unreachable; s3fs takes 5 and 15 s."""
_BATCH: Final = 100
"""Files that are transferred at the same time."""
_AT_ONCE: Final = 16
"""Concurrent requests for headers or sizes of files in a store."""
_NAMES_SHOWN: Final = 3

_LOG = logging.getLogger(__name__)

_Item = TypeVar("_Item")
_Read = TypeVar("_Read")

# Exceptions of drivers besides OSError and EOFError; only loaded drivers can raise them.
_DRIVER_ERRORS: Final = (
    ("aiohttp", "ClientError"),
    ("botocore.exceptions", "BotoCoreError"),
    ("botocore.exceptions", "ClientError"),
    ("botocore.parsers", "ResponseParserError"),
    ("google.auth.exceptions", "GoogleAuthError"),
    ("gcsfs.retry", "HttpError"),
    ("ftplib", "Error"),
    ("paramiko", "SSHException"),
    ("zipfile", "BadZipFile"),
    ("zlib", "error"),
)


class Stored(NamedTuple):
    """A file in the listing of a store, or of a folder."""

    path: str
    """Path relative to the URL or folder, as this states it; see `is_confined`."""
    size: int
    """Size in bytes."""
    mtime_ns: int
    """Changes with the file: its modification time in ns, or a number derived from its tag."""


@dataclass(frozen=True, slots=True)
class Published:
    """Result of `RemoteStore.publish`."""

    uploaded: tuple[str, ...]
    unchanged: int
    others: int
    """Number of objects in the store that are no products; they are left alone."""


def is_url(location: str) -> bool:
    """Return whether a location is a URL, not a folder."""
    return "://" in location


def without_keys(text: str) -> str:
    """Return a text without the credentials in its URLs: before the @, in queries, fragments."""
    return _QUERY.sub(r"\1", _KEYS.sub("", text))


def refuse_keys(url: str) -> None:
    """Refuse a URL that holds credentials, which commands, logs and databases would keep.

    Raises
    ------
    CatalogError
    """
    if without_keys(url) != url:
        raise CatalogError(
            "the URL holds a key, password or query, which others can read in commands, logs and"
            " databases",
            file=without_keys(url),
            remedy="leave it out, and give keys to the driver: AWS_ACCESS_KEY_ID and"
            " AWS_SECRET_ACCESS_KEY for s3://, GOOGLE_APPLICATION_CREDENTIALS for gs://, else"
            " FSSPEC_SCHEME_OPTION, such as FSSPEC_SFTP_PASSWORD, or a file in ~/.config/fsspec",
            wrong_use=True,
        )


def is_confined(path: str) -> bool:
    """Return whether a path of a store stays below its root, also where it is percent-encoded."""
    plain = unquote(path)
    return not {"", ".", ".."} & set(plain.split("/")) and not {"\\", "\0"} & set(plain)


def _confine(path: str) -> None:
    # A listing is not to be trusted: a web server may name any path.
    if not is_confined(path):
        raise OSError(errno.EINVAL, "its path leads out of the archive")


class RemoteStore:
    """The objects below one URL.

    Raises
    ------
    CatalogError
        If the URL holds credentials, fsspec does not know it or lacks its driver, or the store
        cannot be reached.
    """

    def __init__(self, url: str) -> None:
        import fsspec  # noqa: PLC0415 - most archives are local, and the import is slow

        refuse_keys(url)
        self.url = url
        self._scheme = url.partition("://")[0]
        try:
            # Some drivers connect here.
            with self._unavailable("cannot be reached"):
                # Raises an error for a port or address of no server, which the driver meets later.
                _ = self._scheme in _READ_ONLY and urlsplit(url).port
                self._fs, prefix = fsspec.core.url_to_fs(url)
        except (ValueError, ImportError, TypeError, AttributeError) as error:
            raise CatalogError(
                f"the URL cannot be opened: {without_keys(str(error))}",
                file=self.url,
                remedy="use a URL that fsspec knows and install its driver: lidarops[s3] for s3://",
                # An ImportError means that only the driver is missing.
                wrong_use=not isinstance(error, ImportError),
            ) from error
        self._prefix = prefix.rstrip("/")
        self._given = ""
        """Name of the last object of which the store gave the begin."""
        if self._scheme in _READ_ONLY:
            self._fs.client_kwargs = {**_client_options(), **self._fs.client_kwargs}

    def files(self, is_used: Callable[[str], bool] = lambda _: True) -> Iterator[Stored]:
        """List all objects below the URL, sorted by path.

        Names that lead out of the URL are listed too, and a warning tells of them. None of them can
        be read. An object that the store denies has the size 0.

        Parameters
        ----------
        is_used : callable, optional
            Whether the size of a path is used. A web server is requested for no other.

        Raises
        ------
        CatalogError
            If the store cannot be reached or listed.
        """
        with self._unavailable("cannot be listed"):
            # Another process may have written since the last listing.
            self._fs.invalidate_cache()
            listing = dict(self._sized(self._find(), is_used))
        outside = sorted(path for path in map(self._path, listing) if not is_confined(path))
        if outside:
            named = ", ".join(map(repr, outside[:_NAMES_SHOWN]))
            _LOG.warning(
                "%s lists %d names that lead out of it, which are not read, such as %s",
                self.url,
                len(outside),
                named,
            )
        for name in sorted(listing):
            info = listing[name]
            yield Stored(self._path(name), int(info.get("size") or 0), _stamp(info))

    def _sized(
        self, listing: dict[str, Any], is_used: Callable[[str], bool]
    ) -> Iterator[tuple[str, Any]]:
        """Yield names with their sizes, which the index of a web server lacks."""
        lacking = []
        for name, info in listing.items():
            path = self._path(name)
            if info.get("size") is None and is_confined(path) and is_used(path):
                lacking.append((name, info))
            else:
                yield name, info
        yield from self.map(self._asked, lacking)

    def _asked(self, listed: tuple[str, Any]) -> tuple[str, Any]:
        """Return a name with what the store says of it alone."""
        name, info = listed
        try:
            return name, self._fs.info(name)
        except FileNotFoundError as error:
            # Drivers of the web raise this whatever the server answers.
            if not self._is_of_one_object(error, name):
                problem = f"the size of {self._path(name)} is not given: {error.__cause__!r}"
                raise OSError(errno.EIO, problem) from error
            # Whoever reads the file learns of it.
            return name, info

    def map(self, read: Callable[[_Item], _Read], items: Iterable[_Item]) -> Iterator[_Read]:
        """Yield what is read of each item, in order; some at once, where the driver can."""
        rest = iter(items)
        with ThreadPoolExecutor(_AT_ONCE if self._fs.async_impl else 1) as threads:
            while batch := list(islice(rest, _BATCH)):
                yield from threads.map(read, batch)

    def _path(self, name: str) -> str:
        return name.removeprefix(self._prefix).removeprefix("/")

    def _find(self) -> dict[str, Any]:
        try:
            listing: dict[str, Any] = (
                self._fs.find(self._prefix, detail=True)
                if self._scheme in _ATOMIC
                else dict(self._walk(self._prefix))
            )
        except KeyError as error:
            raise UnavailableError(
                "cannot be listed: a page says that more follow, and not where",
                file=self.url,
                remedy="try again, or ask who runs the store",
            ) from error
        if not listing:
            # Raises an error if the place does not exist.
            self._fs.ls(self._prefix, detail=False)
        return listing

    def _walk(self, folder: str) -> Iterator[tuple[str, Any]]:
        """Yield the files below a folder; `find` would leave out folders that cannot be listed."""
        for info in self._fs.ls(folder, detail=True):
            inner = info["name"].rstrip("/")
            is_folder = info["type"] == "directory"
            if is_folder and inner == folder:
                continue
            if is_folder and is_confined(self._path(inner)):
                yield from self._walk(inner)
            else:
                yield info["name"], info

    def head(self, path: str, size: int) -> bytes:
        """Return the first bytes of a file.

        Raises
        ------
        CatalogError
            If the store fails.
        OSError
            If the store does not give this file, or its path leads out of the URL.
        """
        with self._one_object(path):
            try:
                data: bytes = self._fs.cat_file(self._name(path), start=0, end=size)
            except _failures() as error:
                if _status(error) != _NO_SUCH_RANGE or self._fs.size(self._name(path)):
                    raise
                return b""
        self._given = self._name(path)
        return data

    def digest(self, path: str) -> str:
        """Return the SHA-256 of a file.

        Raises
        ------
        CatalogError, OSError
            As `head`.
        """
        with self._one_object(path), self._fs.open(self._name(path), "rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()

    def fetch(self, paths: Sequence[str], folder: Path) -> dict[str, str]:
        """Copy files to a local folder under their paths, without those that the store lacks.

        Returns
        -------
        dict
            Path of a file that the store has and does not give -> why.

        Raises
        ------
        CatalogError
            If the store fails.
        OSError
            If a path leads out of the folder; no file is copied then.
        """
        for path in paths:
            _confine(path)
        names, targets = list(map(self._name, paths)), [str(folder / path) for path in paths]
        refused: dict[str, str] = {}
        with self._unavailable("cannot be read"):
            for path in paths:
                (folder / path).parent.mkdir(parents=True, exist_ok=True)
            try:
                self._fs.get(names, targets, batch_size=_BATCH)
            except _failures() as error:
                if not self._is_of_one_object(error):
                    raise
                # Rare, so existing files may be fetched twice.
                for path, name, target in zip(paths, names, targets, strict=True):
                    try:
                        with self._one_object(path):
                            self._fs.get_file(name, target)
                    except FileNotFoundError:
                        continue
                    except OSError as answer:
                        refused[path] = answer.strerror or str(answer)
        return refused

    def publish(
        self, root: Path, products: Mapping[str, str], journal: Path, *, beside: str = ""
    ) -> Published:
        """Upload the products that the store lacks or holds in another version.

        Readers of the store always see a complete product, the old or the new one. After an
        interruption, the next call completes the work. A journal records what was sent, because
        the clock of the store may differ from the local one.

        Parameters
        ----------
        root : path
            The folder of the products.
        products : mapping of str to str
            Path relative to `root` -> SHA-256 in the ledger.
        journal : path
            Text file of this method, one per store; without it everything is sent again.
        beside : str, optional
            Folder of the store that is published by itself; its files are no others.

        Raises
        ------
        ProductError
            If the store is read-only or holds less than was sent, or if a product is missing or
            differs from the ledger.
        UnavailableError
            If the store cannot be reached.
        """
        if self._scheme in _READ_ONLY:
            raise ProductError(
                "is read-only",
                file=self.url,
                remedy="publish to s3://, gs:// or a mounted folder",
                wrong_use=True,
            )
        held = {stored.path: stored for stored in self._existing()}
        sent = _read_journal(journal)
        due = [
            path
            for path, sha256 in sorted(products.items())
            if path not in held
            or held[path].size != _size(root / path)
            or sent.get(path) not in {sha256, _as_held(sha256, held[path])}
        ]
        for first in range(0, len(due), _BATCH):
            batch = {path: products[path] for path in due[first : first + _BATCH]}
            with self._unavailable("cannot be written"):
                self._upload(root, batch)
            _append_journal(journal, batch)
        if due:
            # As a listing states it: an answer about one object may state its time otherwise.
            made = {one.path: one for one in self._existing()}
            _append_journal(
                journal,
                {path: _as_held(products[path], made[path]) for path in due if path in made},
            )
        others = [
            path
            for path in held.keys() - products.keys()
            if not (beside and path.startswith(f"{beside}/"))
        ]
        return Published(tuple(due), len(products) - len(due), len(others))

    def _existing(self) -> Sequence[Stored]:
        try:
            return tuple(self.files())
        except CatalogError as error:
            if isinstance(error.__cause__, FileNotFoundError):
                return ()
            raise

    def _upload(self, root: Path, products: Mapping[str, str]) -> None:
        for path, sha256 in products.items():
            with _reading(root / path):
                if sha256_of(root / path) != sha256:
                    raise ProductError(
                        "differs from the ledger", file=root / path, remedy="run lidarops reprocess"
                    )
        targets = [self._name(path) for path in products]
        sources = [str(root / path) for path in products]
        if self._scheme in _ATOMIC:
            self._fs.put(sources, targets, batch_size=_BATCH)
        else:
            for source, target in zip(sources, targets, strict=True):
                self._put_and_rename(source, target)
        for path, target in zip(products, targets, strict=True):
            sent, held = _size(root / path), int(self._fs.info(target)["size"])
            if sent != held:
                raise ProductError(f"holds {held} of {sent} bytes", file=f"{self.url}/{path}")

    def _put_and_rename(self, source: str, target: str) -> None:
        path = PurePosixPath(target)
        self._fs.makedirs(str(path.parent), exist_ok=True)
        temporary = str(path.with_name(f".{path.name}.{secrets.token_hex(8)}.part"))
        try:
            self._fs.put_file(source, temporary)
            self._fs.mv(temporary, target)
        except OSError:
            with suppress(OSError):
                self._fs.rm_file(temporary)
            raise

    def _name(self, path: str) -> str:
        return f"{self._prefix}/{path}"

    @contextmanager
    def _one_object(self, path: str) -> Iterator[None]:
        """Raise an OSError where an answer concerns one object, else as `_unavailable`."""
        _confine(path)
        try:
            with self._unavailable(f"{path} cannot be read"):
                yield
        except CatalogError as error:
            cause = error.__cause__
            if not (
                isinstance(cause, Exception) and self._is_of_one_object(cause, self._name(path))
            ):
                raise
            status = _status(cause)
            # Drivers of the web do not state this one.
            absent = isinstance(cause, FileNotFoundError) if status is None else status in _ABSENT
            if status is None and not absent:
                raise cause from None
            kind = FileNotFoundError if absent else OSError
            raise kind(errno.EIO, f"the server answers {status or 404}") from error

    def _is_of_one_object(self, error: Exception, name: str = "") -> bool:
        """Return whether an error concerns one object, so that the store gives others."""
        status = _status(error)
        if status is None:
            # Drivers of the web raise FileNotFoundError for whatever happened, and state its cause.
            lacking = isinstance(error, FileNotFoundError | PermissionError | IsADirectoryError)
            return lacking and error.__cause__ is None
        code = _response(error).get("Error", {}).get("Code")
        if 400 <= status < 500 and status not in _OF_STORE and code not in _CODES_OF_STORE:
            return True
        # Any other answer is one of the store if it gives neither the object read last nor a list.
        try:
            if self._given not in {"", name}:
                self._fs.cat_file(self._given, start=0, end=1)
            else:
                self._fs.invalidate_cache()
                self._fs.ls(self._prefix, detail=False)
        except _failures():
            return False
        return True

    @contextmanager
    def _unavailable(self, problem: str) -> Iterator[None]:
        """Raise what a driver raises as an error that states the problem."""
        try:
            yield
        except LidarOpsError:
            raise
        except _failures() as error:
            raise UnavailableError(
                f"{problem}: {without_keys(repr(error))}",
                file=self.url,
                remedy="check address, network and keys",
            ) from error


def _client_options() -> dict[str, Any]:
    """Return how web servers are asked: a page that is cut, and silence, raise an error."""
    from aiohttp import ClientTimeout  # noqa: PLC0415 - the driver of http and https

    # Large files may take longer than the 5 min that the driver allows, but not without any byte.
    silence = ClientTimeout(total=None, sock_connect=_LONGEST_SILENCE, sock_read=_LONGEST_SILENCE)
    return {"response_class": _whole_page(), "timeout": silence}


@cache
def _whole_page() -> type:
    """Return the class of answers of a web server that raise an error for a page that is cut."""
    import aiohttp  # noqa: PLC0415 - the driver of http and https, which may be missing

    class WholePage(aiohttp.ClientResponse):
        async def text(self, encoding: str | None = None, errors: str = "strict") -> str:
            page = await super().text(encoding, errors)
            unclosed = re.search("<html", page, re.I) and not re.search("</html", page, re.I)
            if unclosed or page.rfind("<") > page.rfind(">"):
                raise aiohttp.ClientPayloadError(f"the index {self.url} ends before its end")
            return page

    return WholePage


@contextmanager
def _reading(product: Path) -> Iterator[None]:
    """Raise a ProductError that names the product if it cannot be read."""
    try:
        yield
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        raise ProductError(
            "is missing" if missing else f"cannot be read: {error.strerror}",
            file=product,
            remedy="run lidarops reprocess",
        ) from error


def _size(product: Path) -> int:
    with _reading(product):
        return product.stat().st_size


def _as_held(sha256: str, stored: Stored) -> str:
    """Return the digest of a product with what changes if its copy in a store does."""
    return f"{sha256} {stored.mtime_ns}"


def _read_journal(journal: Path) -> dict[str, str]:
    """Read lines in the format of sha256sum; the last line of a path counts."""
    try:
        lines = journal.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return {}
    # A crash may have cut the last line; its product is then sent again.
    pairs = (line.split("  ", 1) for line in lines if "  " in line)
    return {path: sha256 for sha256, path in pairs}


def _append_journal(journal: Path, products: Mapping[str, str]) -> None:
    journal.parent.mkdir(parents=True, exist_ok=True)
    with journal.open("a", encoding="utf-8") as file:
        # Start with a line break, because a crash may have cut the last line.
        file.write("\n" + "".join(f"{sha256}  {path}\n" for path, sha256 in products.items()))


def _failures() -> tuple[type[Exception], ...]:
    loaded = ((sys.modules.get(module), name) for module, name in _DRIVER_ERRORS)
    return (
        OSError,
        EOFError,
        NotImplementedError,  # raised by fsspec of drivers that cannot list files
        *(getattr(module, name) for module, name in loaded if module is not None),
    )


def _response(error: Exception) -> Mapping[str, Any]:
    """Return what a server of S3 answered that made an error; empty for other servers."""
    answer = getattr(error, "response", getattr(error.__cause__, "response", None))
    return answer if isinstance(answer, Mapping) else {}


def _status(error: Exception) -> int | None:
    """Return the status of the answer that made an error; None if it was none of a server."""
    stated = _response(error).get("ResponseMetadata", {}).get("HTTPStatusCode")
    places = ((place, name) for place in (error, error.__cause__) for name in ("status", "code"))
    found = chain([stated], (getattr(place, name, None) for place, name in places))
    return next((status for status in found if isinstance(status, int)), None)


def _stamp(info: dict[str, Any]) -> int:
    for key in _STAMPS:
        value = info.get(key)
        if isinstance(value, int | float):
            return int(value * 1e9)
        if value is not None:
            text = value.isoformat() if hasattr(value, "isoformat") else str(value)
            return int.from_bytes(hashlib.sha256(text.encode()).digest()[:7], "big")
    return 0
