"""The products that a figure of a report is drawn from, and their reading."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import xarray as xr

from lidarops.figures.raster import COLUMNS, Raster
from lidarops.figures.reading import Readers, ReadFailure, ReadTask
from lidarops.figures.series_data import Comparison
from lidarops.records import ProductRecord, SceneOutcome

Content = TypeVar("Content")


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
    truth: xr.Dataset | None
    """Truth of a simulated campaign."""
    compared: list[Compared]
    problems: list[Problem]

    def read_all(
        self,
        group: Group,
        names: tuple[str, ...],
        reads: Iterable[Callable[..., Content]],
        *,
        with_truth: bool = False,
    ) -> Iterator[Content]:
        """Yield the content of every readable product of a group."""
        paths = [product.path for _, product in group.members]
        readings = [
            ReadTask(group.root / path, names, read, with_truth)
            for path, read in zip(paths, reads, strict=True)
        ]
        yield from self._read(paths, readings)

    def rasters(
        self, group: Group, names: tuple[str, ...], read: Callable[..., Raster]
    ) -> list[Raster]:
        """Reduce all products of a group to the same resolution, given by their total length."""
        sizes: dict[str, int] = {}
        paths = [product.path for _, product in group.members]
        lengths = self.readers.lengths([group.root / path for path in paths])
        for path, length in zip(paths, lengths, strict=True):
            if isinstance(length, ReadFailure):
                self._note(path, length.reason)
            else:
                sizes[path] = length
        profiles = -(-sum(sizes.values()) // COLUMNS)
        reduced = functools.partial(read, profiles=profiles)
        readings = [ReadTask(group.root / path, names, reduced) for path in sizes]
        return list(self._read(list(sizes), readings))

    def read_first(
        self,
        group: Group,
        names: tuple[str, ...],
        read: Callable[..., Content | None],
        *,
        with_truth: bool = False,
    ) -> Content | None:
        """Return the content of the first product of a group that has any, or None."""
        noted = {problem.path for problem in self.problems}
        for _, product in group.members:
            reading = ReadTask(group.root / product.path, names, read, with_truth)
            content = self.readers.read(reading)
            if isinstance(content, ReadFailure):
                if product.path not in noted:
                    self._note(product.path, content.reason)
            elif content is not None:
                return content
        return None

    def compare(self, group: Group, comparisons: Iterable[Comparison | None]) -> None:
        """Note comparisons of the products of a group with the truth; None is left out."""
        self.compared.extend(
            Compared(group.instrument, group.channel, comparison)
            for comparison in comparisons
            if comparison is not None
        )

    def _read(self, paths: list[str], readings: list[ReadTask[Content]]) -> Iterator[Content]:
        for path, content in zip(paths, self.readers.read_all(readings), strict=True):
            if isinstance(content, ReadFailure):
                self._note(path, content.reason)
            else:
                yield content

    def _note(self, path: str, words: str) -> None:
        self.problems.append(Problem(path, words))
