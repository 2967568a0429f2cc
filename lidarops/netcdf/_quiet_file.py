"""A file for HDF5 that never fails, because HDF5 may crash where it cannot write."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


class QuietFile(io.FileIO):
    """A local file that keeps its first error, and from then on drops what is written.

    Parameters
    ----------
    path : Path
        An existing file.

    Raises
    ------
    OSError
        If the file cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "r+")
        self._error: OSError | None = None

    def write(self, data: ReadableBuffer, /) -> int:
        """Write all of `data`, and return its length even where it was dropped."""
        rest = memoryview(data)
        size = rest.nbytes
        try:
            while rest and self._error is None:
                rest = rest[self._write_some(rest) :]
        except OSError as error:
            self._error = error
        return size

    def _write_some(self, data: memoryview) -> int:
        """Write as much as the disk takes at once, and return its length."""
        return super().write(data)

    def truncate(self, size: int | None = None, /) -> int:
        """Set the size of the file, unless it failed before."""
        try:
            return super().truncate(size) if self._error is None else 0
        except OSError as error:
            self._error = error
            return 0

    def discard(self) -> None:
        """Drop all that is written from now on: the file will be removed."""
        self._error = self._error or OSError("the file is discarded")

    def check(self) -> None:
        """Raise the first error.

        Raises
        ------
        OSError
            If the file is not as it was written.
        """
        if self._error is not None:
            raise self._error
