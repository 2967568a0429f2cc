"""What packages add to lidarops by entry points: kinds of product, raw formats."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Final, Protocol, TypeVar

from lidarops.errors import LidarOpsError

RAW_FORMATS: Final = "lidarops.raw_formats"
"""Group of entry points of raw formats."""


class _Named(Protocol):
    @property
    def name(self) -> str: ...


_Part = TypeVar("_Part", bound=_Named)


def registered(group: str, of: type[_Part], noun: str) -> dict[str, _Part]:
    """Return the objects of a group of entry points by name.

    Parameters
    ----------
    group : str
        Group of entry points.
    of : type
        Class of the objects, whose attribute ``name`` is that of the entry point.
    noun : str
        What they are, in messages.

    Raises
    ------
    LidarOpsError
        If an entry point of another package cannot be loaded, or one is of another class or name,
        or two have one name.
    """
    parts: dict[str, _Part] = {}
    for point in entry_points(group=group):
        try:
            part = point.load()
        except Exception as error:
            # The code of a package may raise anything; the cause is chained.
            if _package(point) == __package__:
                raise  # a bug of lidarops, whose traceback tells more
            raise LidarOpsError(
                f"{noun} {point.name!r} cannot be loaded from {point.value}: {error!r}",
                remedy=f"repair or remove the package {_distribution(point)}; python -c 'import"
                f" {point.module}' shows where it fails",
            ) from error
        if not isinstance(part, of) or part.name != point.name or part.name in parts:
            raise LidarOpsError(
                f"{noun} {point.name!r} of {point.value} is no {of.__name__} of that name, or the"
                " name is taken",
                remedy=f"repair or remove the package {_distribution(point)}",
            )
        parts[part.name] = part
    return parts


def _distribution(point: EntryPoint) -> str:
    """Return the distribution that registers an entry point, or else its package."""
    return point.dist.name if point.dist else _package(point)


def _package(point: EntryPoint) -> str:
    return point.module.partition(".")[0]


def by_name(
    parts: Mapping[str, _Part], name: str, noun: str, error: type[LidarOpsError] = LidarOpsError
) -> _Part:
    """Return the one of `registered` objects that has a name; raise `error` if none has."""
    if name not in parts:
        raise error(
            f"there is no {noun} {name!r}",
            remedy=f"{', '.join(parts)} are installed; install the package that adds it",
        )
    return parts[name]
