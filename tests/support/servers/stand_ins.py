"""A stand-in for a web server and for an object store, over one folder, with faults of both."""

from __future__ import annotations

import html
import http.server
import io
import os
import threading
import urllib.parse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from http import HTTPStatus
from pathlib import Path
from xml.sax.saxutils import escape

import pytest

from support.servers.ports import KEYS

BUCKET = "archive"
SCHEMES = ("http", pytest.param("s3", marks=pytest.mark.slow))


@dataclass
class StandIn:
    """Serves a folder as ``http://`` and as ``s3://``; its fields may change at any time."""

    folder: Path
    port: int = 0
    statuses: dict[str, int] = field(default_factory=dict)
    """Answer for paths with this end."""
    damaged: Callable[[bytes], bytes] = bytes
    """What becomes of a page of a listing on its way."""
    page: int = 1000
    """Objects in a page of a listing of S3."""
    promises_more: bool = False
    """Whether the last page of S3 says that more follow."""
    ends_after: int = 1000
    """Pages of S3 that are sent; the last one of them says that no other follows."""
    states_length: bool = False
    """Whether an answer states its length, also where it is cut."""

    def url(self, scheme: str) -> str:
        """Return the URL of the folder."""
        return f"s3://{BUCKET}" if scheme == "s3" else f"http://127.0.0.1:{self.port}/{BUCKET}"

    def status_of(self, path: str) -> int | None:
        """Return the fault with which a path is answered."""
        plain = path.partition("?")[0]
        return next((s for end, s in self.statuses.items() if plain.endswith(end)), None)

    def names(self) -> list[str]:
        """Return the paths of all files."""
        files = (path for path in self.folder.rglob("*") if path.is_file())
        return sorted(path.relative_to(self.folder).as_posix() for path in files)


class _Handler(http.server.SimpleHTTPRequestHandler):
    def __init__(self, *arguments: object, stand_in: StandIn, **named: object) -> None:
        self._stand_in = stand_in
        super().__init__(*arguments, directory=str(stand_in.folder), **named)  # type: ignore[arg-type]

    def log_message(self, *arguments: object) -> None:
        """Do not log."""

    def translate_path(self, path: str) -> str:
        return super().translate_path(path.removeprefix(f"/{BUCKET}"))

    def send_head(self) -> io.BytesIO | None:  # type: ignore[override]
        status = self._stand_in.status_of(self.path)
        path = Path(self.translate_path(self.path))
        if (
            status is None
            and path.is_file()
            and not path.stat().st_size
            and "Range" in self.headers
        ):
            status = HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE
        if status is not None:
            self.send_error(status)
            return None
        if "list-type=2" in self.path:
            return self._listed(self._objects(), "application/xml")
        return super().send_head()  # type: ignore[return-value]

    def list_directory(self, path: str | os.PathLike[str]) -> io.BytesIO:
        names = sorted(f"{e.name}/" if e.is_dir() else e.name for e in os.scandir(path))
        links = "".join(f'<li><a href="{name}">{html.escape(name)}</a></li>\n' for name in names)
        page = f"<!DOCTYPE HTML>\n<html>\n<body>\n<ul>\n{links}</ul>\n</body>\n</html>\n"
        return self._listed(page, "text/html; charset=utf-8")

    def _listed(self, page: str, kind: str) -> io.BytesIO:
        whole = page.encode()
        sent = self._stand_in.damaged(whole)
        self.send_response(200)
        self.send_header("Content-Type", kind)
        if self._stand_in.states_length:
            self.send_header("Content-Length", str(len(whole)))
        self.send_header("Connection", "close")
        self.end_headers()
        return io.BytesIO(sent)

    def _objects(self) -> str:
        query = dict(urllib.parse.parse_qsl(urllib.parse.urlsplit(self.path).query))
        prefix, first = query.get("prefix", ""), int(query.get("continuation-token", "0"))
        names = [name for name in self._stand_in.names() if name.startswith(prefix)]
        last = first + self._stand_in.page
        names = names[: self._stand_in.ends_after * self._stand_in.page]
        rows = []
        for name in names[first:last]:
            status = (self._stand_in.folder / name).stat()
            rows.append(
                f"<Contents><Key>{escape(name)}</Key><Size>{status.st_size}</Size>"
                f"<ETag>&quot;{status.st_mtime_ns}&quot;</ETag></Contents>"
            )
        more = last < len(names) or self._stand_in.promises_more
        token = f"<NextContinuationToken>{last}</NextContinuationToken>"
        token = token if last < len(names) else ""
        return (
            '<?xml version="1.0" encoding="UTF-8"?>'
            '<ListBucketResult xmlns="http://s3.amazonaws.com/doc/2006-03-01/">'
            f"<Name>{BUCKET}</Name><KeyCount>{len(rows)}</KeyCount>"
            f"<IsTruncated>{str(more).lower()}</IsTruncated>{token}{''.join(rows)}"
            "</ListBucketResult>"
        )


@contextmanager
def served(folder: Path) -> Iterator[StandIn]:
    """Serve a folder; S3 is reached by the keys and the endpoint in the environment."""
    pytest.importorskip("aiohttp")
    s3fs = pytest.importorskip("s3fs")
    stand_in = StandIn(folder)
    handler = partial(_Handler, stand_in=stand_in)
    with (
        http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server,
        pytest.MonkeyPatch.context() as patch,
    ):
        # Its end is looked for every half a second otherwise.
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        stand_in.port = server.server_port
        for name, value in KEYS.items():
            patch.setenv(name, value)
        patch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.server_port}")
        patch.setenv("AWS_MAX_ATTEMPTS", "1")
        patch.setattr(s3fs.S3FileSystem, "retries", 1)
        s3fs.S3FileSystem.clear_instance_cache()
        try:
            yield stand_in
        finally:
            s3fs.S3FileSystem.clear_instance_cache()
            server.shutdown()
