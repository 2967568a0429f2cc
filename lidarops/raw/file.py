"""Open local raw files and read their bytes."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Sequence
from contextlib import suppress
from types import TracebackType
from typing import Any, Final, Self, TypeVar

from lidarops.errors import RawFormatError, UnreadableFileError
from lidarops.raw.header import IncompleteHeaderError

_Header = TypeVar("_Header")

_PREFIX: Final = 8 * 1024
_HEADER_LIMIT: Final = 512 * 1024


class RawFile:
    """An open local raw file; all raw files are opened here.

    Raises
    ------
    RawFormatError
        If the file cannot be opened, or is not a regular file.
    """

    __slots__ = ("_descriptor", "mtime_ns", "path", "size")

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = os.fspath(path)
        try:
            # Without O_NONBLOCK, opening a pipe would wait for a writer.
            self._descriptor = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise UnreadableFileError(f"cannot be opened: {error}", file=self.path) from None
        except ValueError as error:
            raise RawFormatError(f"cannot be opened: {error}", file=self.path) from None
        try:
            status = os.fstat(self._descriptor)
        except OSError as error:
            os.close(self._descriptor)
            raise self._unreadable(error) from None
        self.size = status.st_size
        self.mtime_ns = status.st_mtime_ns
        if not stat.S_ISREG(status.st_mode):
            os.close(self._descriptor)
            raise RawFormatError("is not a regular file", file=self.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # What was read is right, whether the file can be closed or not.
        with suppress(OSError):
            os.close(self._descriptor)

    def read_header(self, parse: Callable[[bytes], _Header]) -> _Header:
        """Return what `parse` makes of the first bytes, of more where these are too few.

        Raises
        ------
        RawFormatError
            As `parse`.
        """
        head = self.read(0, _PREFIX)
        try:
            return parse(head)
        except IncompleteHeaderError:
            if len(head) < _PREFIX:
                raise
        return parse(self.read(0, _HEADER_LIMIT))

    def read(self, offset: int, length: int) -> bytes:
        """Return at most `length` bytes from `offset` on."""
        try:
            return os.pread(self._descriptor, length, offset)
        except OSError as error:
            raise self._unreadable(error) from None

    def read_into(self, offset: int, buffers: Sequence[Any]) -> int:
        """Fill buffers with the bytes from `offset` on; return the number of bytes read."""
        try:
            return os.preadv(self._descriptor, buffers, offset)
        except OSError as error:
            raise self._unreadable(error) from None

    def expect(self, size: int) -> None:
        """Raise if the size of the file has changed since its header was read."""
        if self.size != size:
            raise RawFormatError(
                f"had {size} bytes when its header was read, has {self.size} now",
                file=self.path,
                field="size",
                remedy="open the archive again when no process writes to it",
            )

    def _unreadable(self, error: OSError) -> UnreadableFileError:
        return UnreadableFileError(f"cannot be read: {error.strerror}", file=self.path)
