"""The errors that lidarops raises: one base, few leaves.

Every message names what was wrong, where, and what to do about it, so that it can be
shown to a user as it is.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

NO_FILE: Final = (FileNotFoundError, IsADirectoryError, NotADirectoryError)
"""What opening raises of a name that is not one of a file: another one was meant."""


class LidarOpsError(Exception):
    """Base of every error that lidarops raises on purpose.

    Parameters
    ----------
    problem : str
        What is wrong, in one sentence.
    file : path or str, optional
        The file in which it was found.
    field : str, optional
        The field, key, variable or argument in which it was found.
    remedy : str, optional
        What the user can do about it.
    wrong_use : bool, optional
        Whether it is what was asked for that cannot be meant, so that to ask again will not help;
        that of the class where not given.
    """

    wrong_use: bool = False

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

    def __str__(self) -> str:
        where = ": ".join(part for part in (self.file, self.field) if part)
        text = f"{where}: {self.problem}" if where else self.problem
        return f"{text} ({self.remedy})" if self.remedy else text

    def __reduce__(self) -> tuple[object, ...]:
        # Keyword-only arguments are lost by the default, and errors cross process borders.
        told = (self.problem, self.file, self.field, self.remedy, self.wrong_use)
        return _rebuild, (type(self), *told)


def _rebuild(
    kind: type[LidarOpsError],
    problem: str,
    file: str | None,
    field: str | None,
    remedy: str | None,
    wrong_use: bool,  # noqa: FBT001 - pickle gives what it was given by position
) -> LidarOpsError:
    return kind(problem, file=file, field=field, remedy=remedy, wrong_use=wrong_use)


class RawFormatError(LidarOpsError, ValueError):
    """A raw file that cannot be read as the format it claims."""


class CampaignError(LidarOpsError, ValueError):
    """A campaign file that is missing, unreadable or inconsistent, or not what it is asked for."""

    wrong_use = True


class AncillaryError(LidarOpsError, ValueError):
    """A sounding or overlap file that is missing, unreadable or holds something else."""


class CatalogError(LidarOpsError):
    """A catalog or archive that cannot be opened, read or written."""


class SceneError(LidarOpsError):
    """A scene that cannot be processed as planned."""


class RetrievalInputError(LidarOpsError, ValueError):
    """Arguments of a retrieval whose shapes, units or values cannot be right."""

    wrong_use = True


class ProductError(LidarOpsError):
    """A product that cannot be built, written or read."""
