"""Products read, and figures drawn, for a report: by one process, or several at the same time.

What is read is the same, and in the same order, whoever reads it. A product that is missing or
cannot be read stops nothing: the reason is handed over in place of what it holds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Generic, Self, TypeVar

import xarray as xr

from lidarops.errors import ProductError
from lidarops.netcdf.read import open_product, profiles_in
from lidarops.system.processes import Processes

FEWEST: Final = 50
"""Products that a process must have to read, to be worth its start."""
UNREADABLE: Final = (OSError, RuntimeError, ValueError, KeyError, IndexError, ProductError)
"""What opening and reading a damaged or foreign file has been seen to raise."""
_AT_A_TIME: Final = 8
"""Products handed to a process together, so that it waits less for the next."""
_LENGTHS_AT_A_TIME: Final = 32

Item = TypeVar("Item")
Found = TypeVar("Found")
_Found_co = TypeVar("_Found_co", covariant=True)


@dataclass(frozen=True, slots=True)
class Reading(Generic[_Found_co]):
    """What is to be read of one product; goes to another process, so all of it can be pickled."""

    path: Path
    names: tuple[str, ...]
    """Of the variables that are read."""
    read: Callable[..., _Found_co]
    """Called with the product, and the truth of a simulation where it is asked for."""
    with_truth: bool = False


@dataclass(frozen=True, slots=True)
class Unread:
    """Why nothing was read of a product."""

    reason: str


class Readers:
    """Reads products, by several processes where there are enough products; to be used in a with.

    Parameters
    ----------
    workers : int
        Most processes; none is started for fewer than 2.
    products : int
        About how many there are to be read in all.
    truth : xr.Dataset, optional
        In memory, for the readings that ask for it.
    """

    def __init__(
        self, workers: int = 1, products: int = 0, truth: xr.Dataset | None = None
    ) -> None:
        self._truth = truth
        self._processes = Processes(min(workers, products // FEWEST), truth)

    def __enter__(self) -> Self:
        self._processes.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._processes.__exit__(*error)

    def one(self, reading: Reading[Found]) -> Found | Unread:
        """Read one product, in this process."""
        return _read(self._truth, reading)

    def each(self, readings: Iterable[Reading[Found]]) -> Iterator[Found | Unread]:
        """Read products; what is found of each, in their order."""
        for _, found in self._processes.each(_read, readings, at_a_time=_AT_A_TIME):
            yield found

    def lengths(self, paths: Iterable[Path]) -> Iterator[int | Unread]:
        """Count the profiles of products, in their order, without reading any."""
        for _, found in self._processes.each(_length, paths, at_a_time=_LENGTHS_AT_A_TIME):
            yield found

    def later(self, task: Callable[[object, Item], Found], item: Item) -> Callable[[], Found]:
        """Begin something else; see `lidarops.system.processes.Processes.later`."""
        return self._processes.later(task, item)

    @property
    def processes(self) -> int:
        """How many processes there may be beside this one."""
        return self._processes.number


def _read(truth: xr.Dataset | None, reading: Reading[Found]) -> Found | Unread:
    try:
        with open_product(reading.path, reading.names) as product:
            return reading.read(product, truth) if reading.with_truth else reading.read(product)
    except UNREADABLE as error:
        return Unread(reason(reading.path, error))


def _length(_: object, path: Path) -> int | Unread:
    try:
        return profiles_in(path)
    except UNREADABLE as error:
        return Unread(reason(path, error))


def reason(path: Path, error: BaseException) -> str:
    """Return the words of an error, without the path that stands beside them."""
    words = str(error).removeprefix(f"{path}: ").replace(str(path), path.name)
    return words or type(error).__name__
