"""Reads the products of which a report shows figures, in one process or several.

Results and their order do not depend on the number of processes. For a product that is missing or
cannot be read, the result is a `ReadFailure` with the reason.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Generic, Self, TypeVar

import xarray as xr

from lidarops.errors import ProductError
from lidarops.figures.kind_figures import ProductSource, View
from lidarops.figures.raster import COLUMNS
from lidarops.figures.series_data import Comparison
from lidarops.figures.wording import named_shares
from lidarops.flags import Severity
from lidarops.kinds import flags_of, kinds
from lidarops.netcdf.read import open_product, profiles_in
from lidarops.records import ProductRecord, SceneOutcome
from lidarops.system.processes import Processes

FEWEST: Final = 50
"""Fewest products per process for which starting the process pays."""
_UNREADABLE: Final = (
    ArithmeticError,
    LookupError,
    MemoryError,
    RuntimeError,
    ValueError,
    ProductError,
)
"""What values of a damaged product may raise; other errors are those of the program."""
_AT_A_TIME: Final = 8
"""Products sent to a process together, so that it waits less."""
_LENGTHS_AT_A_TIME: Final = 32

Content = TypeVar("Content")
_Content_co = TypeVar("_Content_co", covariant=True)


@dataclass(frozen=True, slots=True)
class ReadTask(Generic[_Content_co]):
    """A product to read, and how. Can be pickled, for another process."""

    path: Path
    names: tuple[str, ...]
    """Names of the variables to read."""
    read: Callable[[xr.Dataset, ProductSource], _Content_co]
    source: ProductSource
    """Without the truth, which `Readers` add."""


@dataclass(frozen=True, slots=True)
class ReadFailure:
    """Why a product could not be read."""

    reason: str


class Readers:
    """Reads products, in several processes if there are enough products. A context manager.

    Parameters
    ----------
    workers : int
        Most processes; with fewer than 2, no process is started.
    products : int
        Approximate number of products to read in all.
    truth : xr.Dataset, optional
        In memory, for the sources of tasks.
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

    def read(self, task: ReadTask[Content]) -> Content | ReadFailure:
        """Read one product, in this process."""
        return _read(self._truth, task)

    def read_all(self, tasks: Iterable[ReadTask[Content]]) -> Iterator[Content | ReadFailure]:
        """Yield the content of each product, in their order."""
        for _, content in self._processes.map_items(_read, tasks, at_a_time=_AT_A_TIME):
            yield content

    def lengths(self, paths: Iterable[Path]) -> Iterator[int | ReadFailure]:
        """Yield the number of profiles of each product, in their order, without reading data."""
        for _, length in self._processes.map_items(_length, paths, at_a_time=_LENGTHS_AT_A_TIME):
            yield length


def _read(truth: xr.Dataset | None, task: ReadTask[Content]) -> Content | ReadFailure:
    try:
        with open_product(task.path, task.names) as product:
            return task.read(product, replace(task.source, truth=truth))
    except _UNREADABLE as error:
        return ReadFailure(reason(task.path, error))


def _length(_: object, path: Path) -> int | ReadFailure:
    try:
        return profiles_in(path)
    except ProductError as error:
        return ReadFailure(reason(path, error))


def reason(path: Path, error: BaseException) -> str:
    """Return the message of an error without the path, which is shown beside it."""
    words = str(error).removeprefix(f"{path}: ").replace(str(path), path.name)
    return words or type(error).__name__


@dataclass(frozen=True, slots=True)
class Group:
    """All products of one kind, instrument and channel in a run."""

    kind: str
    instrument: str
    channel: str
    members: tuple[tuple[SceneOutcome, ProductRecord], ...]
    root: Path
    """Folder that product paths are relative to."""

    @property
    def label(self) -> str:
        """Instrument and channel, for titles."""
        return f"{self.instrument} \N{MIDDLE DOT} {self.channel}"

    @property
    def good(self) -> float:
        """Share of values without a quality bit."""
        values = sum(product.values for _, product in self.members)
        return sum(product.unflagged for _, product in self.members) / values if values else 0.0

    @property
    def lacking(self) -> str:
        """Why no value is usable: the rejecting bits that most values carry; empty if one is."""
        products = [product for _, product in self.members]
        values = sum(product.values for product in products)
        if self.kind not in kinds() or any(product.usable != 0 for product in products):
            return ""
        flags = flags_of(self.kind)
        counts: Counter[str] = Counter()
        for product in products:
            counts.update(product.flagged)
        rejecting = (
            (bit.description, count)
            for name, count in counts.items()
            if (bit := flags.named(name)) is not None and bit.severity is Severity.REJECT
        )
        return named_shares(rejecting, values)


@dataclass(frozen=True, slots=True)
class Compared:
    """A comparison with the truth, with its instrument and channel."""

    instrument: str
    channel: str
    comparison: Comparison


@dataclass(frozen=True, slots=True)
class Problem:
    """A file that could not be used for the report."""

    path: str
    reason: str


@dataclass(frozen=True, slots=True)
class Sources:
    """Reads products for figures; unreadable products are noted as problems."""

    readers: Readers
    problems: list[Problem]

    def read(self, group: Group, view: View[Content]) -> Iterator[Content]:
        """Yield what a view shows of every readable product of a group, or of the first."""
        tasks = self._tasks(group, view)
        read_all = self.readers.read_all
        contents = (
            map(self.readers.read, tasks.values()) if view.first else read_all(tasks.values())
        )
        for path, content in zip(tasks, contents, strict=True):
            if isinstance(content, ReadFailure):
                self._note(path, content.reason)
            elif content is not None:
                yield content
                if view.first:
                    return

    def _tasks(self, group: Group, view: View[Content]) -> dict[str, ReadTask[Content | None]]:
        scenes = {product.path: scene for scene, product in group.members}
        source = ProductSource(group.instrument, group.channel)
        if view.shows:
            # All products get the same resolution, which follows from their total length.
            lengths = self._lengths(group, scenes)
            scenes = {path: scenes[path] for path in lengths}
            source = replace(source, profiles=-(-sum(lengths.values()) // COLUMNS))
        return {
            path: ReadTask(
                group.root / path, view.variables, view.read, replace(source, scene=scene)
            )
            for path, scene in scenes.items()
        }

    def _lengths(self, group: Group, paths: Iterable[str]) -> dict[str, int]:
        """Return the number of profiles of each readable product."""
        known: dict[str, int] = {}
        lengths = self.readers.lengths(group.root / path for path in paths)
        for path, length in zip(paths, lengths, strict=True):
            if isinstance(length, ReadFailure):
                self._note(path, length.reason)
            else:
                known[path] = length
        return known

    def _note(self, path: str, words: str) -> None:
        if all(problem.path != path for problem in self.problems):
            self.problems.append(Problem(path, words))
