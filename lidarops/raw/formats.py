"""Open raw files, and find their format: the registry of raw formats, by entry point.

A raw format is one `RawFormat`. A package outside lidarops adds one by an entry point of the group
``lidarops.raw_formats``, and lidarops then catalogues and processes its files like any others::

    [project.entry-points."lidarops.raw_formats"]
    myformat = "mypackage.myformat:FORMAT"
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, TypeVar

from lidarops.errors import RawFormatError, UnreadableFileError
from lidarops.kinds import RAW_FORMATS, Registry, registered
from lidarops.raw.header import IncompleteHeaderError, RawHeader, Stretches, holds_text
from lidarops.records import UNKNOWN_FORMAT

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_Header = TypeVar("_Header")

_PREFIX: Final = 8 * 1024
_HEADER_LIMIT: Final = 512 * 1024


class RawFile(AbstractContextManager["RawFile"]):
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

    def __exit__(self, *_: object) -> None:
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


@dataclass(frozen=True, slots=True)
class RawFormat:
    """One raw format. Its functions raise `RawFormatError` for what is damaged."""

    name: str
    """Its name in the catalog."""
    title: str
    """Its name in attributes of products."""
    conversion: str
    """How counts become physical values, in words."""
    recognises: Callable[[bytes], bool]
    """First bytes of a file, 8192 or more if there are so many -> whether it is of this format."""
    parse_header: Callable[[bytes, str, int], RawHeader]
    """First bytes or a whole file, its path for messages, its size in bytes -> header.

    `header.IncompleteHeaderError` requests more bytes. Given a whole file, it may check more."""
    read_counts: Callable[[RawFile, int, Stretches | None, NDArray[np.int32]], None]
    """Fill a row with the counts at one of the `places` of a channel: open file, place, stretches
    of bins (None for all), row."""
    read_start: Callable[[bytes], datetime | None] = lambda _: None
    """First bytes of a file that is refused -> when it starts; None where they do not tell."""
    named_time: Callable[[str], datetime | None] = lambda _: None
    """Name of a file -> about when it was recorded, by its clock; None where it does not tell."""

    def read_channel(
        self,
        file: RawFile,
        places: Sequence[int],
        stretches: Stretches | None,
        row: NDArray[np.int32],
    ) -> None:
        """Fill a row with the counts of a channel, the sum of those at its places."""
        self.read_counts(file, places[0], stretches, row)
        if len(places) == 1:
            return
        import numpy as np  # noqa: PLC0415 - a run with nothing to do needs no numerics

        total, further = row.astype(np.int64), np.empty_like(row)
        for place in places[1:]:
            self.read_counts(file, place, stretches, further)
            total += further
        # A sum beyond 32 bits stays above full scale.
        limits = np.iinfo(np.int32)
        row[:] = np.clip(total, limits.min, limits.max)


@cache
def raw_formats() -> Mapping[str, RawFormat]:
    """Return all raw formats by name, in alphabetical order; see `lidarops.kinds.Registry`.

    Raises
    ------
    LidarOpsError
        If an entry point cannot be loaded, or two have one name.
    """
    noun = "raw format"
    formats = sorted(registered(RAW_FORMATS, RawFormat, noun).items())
    return MappingProxyType(Registry((known for _, known in formats), noun, RawFormatError))


def time_in_path(path: str, known: str) -> datetime | None:
    """Return the time that the name of a file of a known format tells, by its clock; or None."""
    return raw_formats()[known].named_time(path.rpartition("/")[2])


def parse_raw_header(head: bytes, *, file: str, size: int, known: str = "") -> RawHeader:
    """Return the header at the start of `head`.

    Parameters
    ----------
    head : bytes
        A whole file or its beginning.
    file : str
        Name for messages.
    size : int
        Bytes of the whole file.
    known : str, optional
        Name of its format; by default the one that recognises the first bytes.

    Raises
    ------
    RawFormatError
        If no format or more than one recognises the file, or if it is damaged; the error names
        file and field.
    """
    if known:
        return raw_formats()[known].parse_header(head, file, size)
    formats = _recognised(head)
    if len(formats) == 1:
        return formats[0].parse_header(head, file, size)
    if formats:
        raise RawFormatError(
            f"is recognised by several raw formats: {', '.join(raw.name for raw in formats)}",
            file=file,
            remedy="remove the package of one of them",
        )
    raise RawFormatError(
        UNKNOWN_FORMAT + (": it is text" if holds_text(head) else ""),
        file=file,
        remedy=f"formats are {', '.join(raw_formats())}; install the package of any other format,"
        " or make the pattern of the instrument leave the file out",
    )


def _recognised(head: bytes) -> list[RawFormat]:
    return [raw for raw in raw_formats().values() if raw.recognises(head)]


def read_start(head: bytes) -> datetime | None:
    """Return when a refused file starts by its first bytes; None where they do not tell."""
    formats = _recognised(head)
    return formats[0].read_start(head) if len(formats) == 1 else None


def read_raw_header(file: RawFile, known: str = "") -> RawHeader:
    """Read and check the header of a file, not its counts; see `parse_raw_header`."""
    return file.read_header(
        lambda head: parse_raw_header(head, file=file.path, size=file.size, known=known)
    )


def read_all_counts(file: RawFile, header: RawHeader) -> None:
    """Read the counts of all channels of a file, to find out whether they can be read.

    Raises
    ------
    RawFormatError
        If one cannot.
    """
    import numpy as np  # noqa: PLC0415 - a run with nothing to do needs no numerics

    raw = raw_formats()[header.format]
    for channel in header.channels:
        raw.read_channel(file, channel.places, None, np.empty(channel.bins, np.dtype("<i4")))
