"""Registry of the kinds of product, and what else packages add by entry point: raw formats.

A kind of product is one package: its ``__init__`` holds a `Kind` and its settings, and its modules
``retrieval``, ``variables`` and ``figures`` hold everything else about it. Without ``figures``, its
main variable is drawn. A package outside lidarops adds a kind by an entry point of the group
``lidarops.product_kinds``::

    [project.entry-points."lidarops.product_kinds"]
    wind = "mypackage.wind:KIND"
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from math import inf
from types import MappingProxyType
from typing import Any, Final, Protocol, TypeVar

from lidarops.errors import LidarOpsError
from lidarops.flags import Flags
from lidarops.settings import ChannelProduct, MonthProduct, NetworkProduct

GROUP: Final = "lidarops.product_kinds"
"""Group of entry points of kinds of product."""
RAW_FORMATS: Final = "lidarops.raw_formats"
"""Group of entry points of raw formats."""


class _Named(Protocol):
    @property
    def name(self) -> str: ...


_Part = TypeVar("_Part", bound=_Named)


class Registry(dict[str, _Part]):
    """Objects that packages add by entry point, by name.

    Parameters
    ----------
    parts : iterable
    noun : str
        What they are, in messages.
    error : type
        What is raised for a name that none has.
    """

    def __init__(
        self, parts: Iterable[_Part], noun: str, error: type[LidarOpsError] = LidarOpsError
    ) -> None:
        super().__init__({part.name: part for part in parts})
        self._noun, self._error = noun, error

    def __missing__(self, name: str) -> _Part:
        """Raise an error that names those that are installed."""
        raise self._error(
            f"there is no {self._noun} {name!r}",
            remedy=f"{', '.join(self)} are installed; install the package that adds it",
        )


class Scope(StrEnum):
    """Data that one product is made of."""

    CHANNEL = "channel"
    """One channel of one instrument."""
    MONTH = "month"
    """Products of one instrument in a calendar month, UTC."""
    NETWORK = "network"
    """One channel of several instruments, whose beams cross."""


@dataclass(frozen=True, slots=True)
class CommonQuantity:
    """What all channels of a wavelength measure alike, whatever their detection and polarisation.

    Its errors are the standard error and the systematic errors that its own variables state.
    """

    variable: str
    along: str
    """The coordinate along its profiles."""
    errors_of_channel: tuple[str, ...] = ()
    """Variables of systematic errors that differ between channels."""
    errors_of_air: tuple[str, ...] = ()
    """Variables of systematic errors with one cause in all channels, of which only the difference
    remains in the difference of two channels."""
    parts_of_air: tuple[str, ...] = ()
    """Variables of parts of the standard error that the air makes, which all channels see."""

    @property
    def errors(self) -> tuple[str, ...]:
        """Variables of all errors, without their parts."""
        own = (f"{self.variable}_standard_error", *self.errors_of_channel)
        return own + self.errors_of_air


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of product."""

    name: str
    """Its name in campaign files, in paths of products and on the command line."""
    title: str
    """Heading of its products on pages."""
    package: str
    """Package of its modules."""
    settings: type[ChannelProduct] | type[NetworkProduct]
    """Model of its settings in a campaign file."""
    rank: int
    """Place on pages and in lists, smallest first."""
    expects_usable: bool = True
    """Whether a scene should give usable values. False where the method is applied to any air, so
    that fog or darkness may reject all values."""

    common: CommonQuantity | None = None
    draft: Callable[[Any], tuple[str, ...]] | None = None
    """Returns the lines of its section in a new campaign file from the headers of an instrument, or
    of the members of a network; none where it does not suit them. None: it is never drafted."""
    reads: tuple[str, ...] = ()
    """Kinds of product that it is made of, of smaller rank, so that they are made before; of the
    same scene or, with a `MonthProduct` as settings, of a month. Empty for kinds made of raw files.
    """
    scope: Scope = field(init=False)
    """Data that one product is made of."""

    def __post_init__(self) -> None:
        of_month = issubclass(self.settings, MonthProduct)
        scope = Scope.MONTH if of_month else Scope.CHANNEL
        if issubclass(self.settings, NetworkProduct):
            scope = Scope.NETWORK
        object.__setattr__(self, "scope", scope)

    def part(self, module: str, name: str) -> Any:
        """Return an object of one of the modules of the kind, such as ``variables``.

        Raises
        ------
        LidarOpsError
            If the package lacks it.
        """
        path = f"{self.package}.{module}"
        # An error while the module is imported is a bug of the package, and is not hidden.
        found = import_module(path) if find_spec(path) else None
        if not hasattr(found, name):
            raise LidarOpsError(
                f"kind of product {self.name!r} is incomplete: {path} has no {name}",
                remedy=f"complete or remove the package {self.package}",
            )
        return getattr(found, name)

    def optional_part(self, module: str, name: str) -> Any | None:
        """Return an object of one of the modules of the kind; None if it has no such module."""
        has = find_spec(f"{self.package}.{module}") is not None
        return self.part(module, name) if has else None


@cache
def kinds() -> Mapping[str, Kind]:
    """Return all kinds of product by name, in the order of their rank; see `Registry`.

    Raises
    ------
    LidarOpsError
        If an entry point cannot be loaded, two have one name, or a kind reads none that is made
        before it.
    """
    noun = "kind of product"
    unordered = registered(GROUP, Kind, noun)
    order = sorted(unordered.values(), key=lambda kind: (kind.rank, kind.name))
    before: dict[str, Kind] = {}
    for kind in order:
        for name in kind.reads:
            if name not in before or before[name].scope is not Scope.CHANNEL:
                raise LidarOpsError(
                    f"kind of product {kind.name!r} reads {name!r}, which is no kind of one channel"
                    f" with a smaller rank than {kind.rank}",
                    remedy=f"correct reads or rank of {kind.package}, or install the package that"
                    f" adds {name!r}",
                )
        before[kind.name] = kind
    return MappingProxyType(Registry(order, noun))


@cache
def flags_of(name: str) -> Flags:
    """Return the quality bits of a kind of product, by the name of the kind.

    Raises
    ------
    LidarOpsError
        If there is no such kind, or it has no valid flags.
    """
    kind = kinds()[name]
    try:
        flags: Flags = kind.part("variables", "LAYOUT").flags
    except ValueError as error:
        raise LidarOpsError(
            str(error), remedy=f"correct the bits in {kind.package}.variables"
        ) from error
    return flags


def kinds_of(*scopes: Scope) -> tuple[Kind, ...]:
    """Return the kinds of product of some scopes, in the order of their rank."""
    return tuple(kind for kind in kinds().values() if kind.scope in scopes)


def with_read(names: Iterable[str]) -> set[str]:
    """Return the names of some kinds of product, and of all kinds that these are made of."""
    found: set[str] = set()
    for name in names:
        found |= {name} | with_read(kinds()[name].reads)
    return found


def rank_of(name: str) -> float:
    """Return the rank of a kind of product by its name; infinite if there is none."""
    known = kinds().get(name)
    return known.rank if known else inf


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
        package = point.module.partition(".")[0]
        remedy = f"repair or remove the package {point.dist.name if point.dist else package}"
        try:
            part = point.load()
        except Exception as error:
            # The code of a package may raise anything; the cause is chained.
            if package == __package__:
                raise  # a bug of lidarops, whose traceback tells more
            raise LidarOpsError(
                f"{noun} {point.name!r} cannot be loaded from {point.value}: {error!r}",
                remedy=f"{remedy}; python -c 'import {point.module}' shows where it fails",
            ) from error
        if not isinstance(part, of) or part.name != point.name or part.name in parts:
            raise LidarOpsError(
                f"{noun} {point.name!r} of {point.value} is no {of.__name__} of that name, or the"
                " name is taken",
                remedy=remedy,
            )
        parts[part.name] = part
    return parts
