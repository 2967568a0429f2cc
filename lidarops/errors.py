"""The exceptions that lidarops raises: one base class and one class a source of errors.

A message states the problem, the file and field concerned, and a remedy. It is meant to be shown
to the user.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import ClassVar, Final

REFUSED: Final = 1
"""Exit code: something was refused, failed or is empty."""
WRONG_USE: Final = 2
"""Exit code: the request is invalid."""
UNAVAILABLE: Final = 3
"""Exit code: a database, a disk, a store or a cluster does not serve."""
NO_FILE: Final = (FileNotFoundError, IsADirectoryError, NotADirectoryError)
"""What `open` raises for a path that is not that of a file."""


class LidarOpsError(Exception):
    """Base of every error that lidarops raises on purpose.

    Parameters
    ----------
    problem : str
        What is wrong, in one sentence.
    file : path or str, optional
        The file concerned.
    field : str, optional
        The field, key, variable or argument concerned.
    remedy : str, optional
        What the user can do about it.
    wrong_use : bool, optional
        Whether the request itself is invalid, so that a retry cannot help; by default that of the
        class.
    """

    wrong_use: bool = False
    unavailable: ClassVar[bool] = False
    """Whether something that lidarops needs does not serve, so that a later try may succeed."""

    def __init__(
        self,
        problem: str,
        *,
        file: str | Path | None = None,
        field: str | None = None,
        remedy: str | None = None,
        wrong_use: bool | None = None,
    ) -> None:
        self.problem = problem
        self.file = None if file is None else str(file)
        self.field = field
        self.remedy = remedy
        if wrong_use is not None:
            self.wrong_use = wrong_use
        super().__init__(str(self))

    @property
    def exit_code(self) -> int:
        """Of a command that it ends."""
        return WRONG_USE if self.wrong_use else UNAVAILABLE if self.unavailable else REFUSED

    def __str__(self) -> str:
        where = ": ".join(place for place in (self.file, self.field) if place)
        text = f"{where}: {self.problem}" if where else self.problem
        return f"{text} ({self.remedy})" if self.remedy else text

    def __reduce__(self) -> tuple[object, ...]:
        # The default loses keyword-only arguments, and errors are pickled between processes.
        named = {"file": self.file, "field": self.field, "remedy": self.remedy}
        return partial(type(self), self.problem, **named, wrong_use=self.wrong_use), ()


class RawFormatError(LidarOpsError, ValueError):
    """A raw file that cannot be read in its format."""


class UnreadableFileError(RawFormatError):
    """A raw file that the disk or the network did not give; another try may succeed."""


class CampaignError(LidarOpsError, ValueError):
    """A campaign file that is missing, unreadable, inconsistent or unsuitable for the request."""

    wrong_use = True


class AncillaryError(LidarOpsError, ValueError):
    """A sounding or overlap file that is missing, unreadable or of other content."""


class CatalogError(LidarOpsError):
    """A catalog or archive that cannot be opened, read or written."""


class UnavailableError(CatalogError):
    """A database, disk or store that does not serve."""

    unavailable = True


class SceneError(LidarOpsError):
    """A scene that cannot be processed as planned."""


class RetrievalInputError(LidarOpsError, ValueError):
    """Arguments of a retrieval with invalid shapes, units or values."""

    wrong_use = True


class ProductError(LidarOpsError):
    """A product that cannot be built, written or read."""
