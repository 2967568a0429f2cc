"""The products that the figures of a report show, and their reading."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from lidarops.figures.kind_figures import ProductSource, View
from lidarops.figures.raster import COLUMNS
from lidarops.figures.series_data import Comparison
from lidarops.records import ProductRecord, SceneOutcome
from lidarops.reports.reading import Readers, ReadFailure, ReadTask

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
        if view.image:
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
