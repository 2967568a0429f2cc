"""The raw files of an archive, in a folder or behind a URL: list them, read them one by one."""

from __future__ import annotations

import errno
import fnmatch
import hashlib
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path

from lidarops.errors import UnavailableError
from lidarops.system.stores import RemoteStore, Stored


def printable(path: str) -> str:
    """Return a path that can be stored and shown: names may hold bytes that are not UTF-8."""
    return path if path.isascii() else path.encode("utf-8", "backslashreplace").decode()


def path_pattern(pattern: str) -> re.Pattern[str]:
    """Return the expression of a pattern of paths: that of a shell, whose ** stands for folders."""
    expressions = {"**/": "(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}
    tokens = re.split(r"(\*\*/|\*\*|\*|\?|\[[!^]?\]?[^]/]*\])", pattern)
    expression = "".join(
        expressions.get(token) or (_choice(token) if number % 2 else re.escape(token))
        for number, token in enumerate(tokens)
    )
    return re.compile(expression + r"\Z")


def _choice(brackets: str) -> str:
    """Return the expression of characters in brackets, such as [67], [a-f], [!0]."""
    translated = fnmatch.translate(re.sub(r"^\[\^", "[!", brackets))
    return "(?!/)" + translated.removeprefix("(?s:")[: -len(r")\Z")]


def literal_pattern(path: str) -> str:
    """Return the pattern that matches one path only, whatever characters it holds."""
    return re.sub(r"[*?\[{]", r"[\g<0>]", path)


class Source:
    """An archive in a local folder."""

    def __init__(self, root: Path) -> None:
        self._root = root

    @staticmethod
    def of(archive: str) -> Source:
        """Return the source of an archive, given its folder or URL."""
        return RemoteSource(archive) if "://" in archive else Source(Path(archive))

    def files(
        self,
        is_used: Callable[[str], bool] = lambda _: True,  # noqa: ARG002 - sizes cost nothing here
    ) -> Iterator[Stored]:
        """List files, sorted by path; those that are not used may have no size."""
        self.refuse_absent()
        yield from self._files_below(str(self._root), "")

    def refuse_absent(self) -> None:
        """Raise an error if the folder does not exist.

        Raises
        ------
        CatalogError
        """
        if not self._root.is_dir():
            raise UnavailableError(
                "the archive is not a folder",
                file=self._root,
                remedy="set archive in the campaign file, --archive or LIDAROPS_ARCHIVE",
            )

    def _files_below(self, folder: str, prefix: str) -> Iterator[Stored]:
        try:
            with os.scandir(folder) as listing:
                entries = [(entry, entry.is_dir(follow_symlinks=False)) for entry in listing]
        except OSError as error:
            raise UnavailableError(
                f"cannot be listed: {error.strerror}", file=folder, remedy="check its permissions"
            ) from error
        # In the order of the paths of their files.
        entries.sort(key=lambda item: printable(item[0].name) + "/" * item[1])
        for entry, is_folder in entries:
            path = f"{prefix}{entry.name}"
            if is_folder:
                yield from self._files_below(entry.path, f"{path}/")
                continue
            try:
                status = entry.stat()
            except OSError:
                # A broken link is listed too, so that it is reported as unreadable.
                yield Stored(path, 0, 0)
            else:
                yield Stored(path, status.st_size, status.st_mtime_ns)

    def head(self, path: str, size: int) -> bytes:
        """Return the first bytes of a file."""
        descriptor = self._opened(path)
        try:
            return os.read(descriptor, size)
        finally:
            os.close(descriptor)

    def digest(self, path: str) -> str:
        """Return the SHA-256 of a file."""
        with open(self._opened(path), "rb") as stream:  # noqa: PTH123 - is open already
            return hashlib.file_digest(stream, "sha256").hexdigest()

    def _opened(self, path: str) -> int:
        file = f"{self._root}/{path}"
        # Opening a pipe would block for ever.
        if not os.path.isfile(file):  # noqa: PTH113 - a Path costs as much as reading the file
            raise OSError(errno.EINVAL, "is no regular file, or a broken link")
        return os.open(file, os.O_RDONLY | os.O_CLOEXEC)


class RemoteSource(RemoteStore, Source):
    """An archive behind an fsspec URL."""

    def refuse_absent(self) -> None:
        """Do nothing: checking a store may take as long as listing it."""
