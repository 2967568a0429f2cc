"""Find the scenes to which refused files belong: their products state that these are unused.

The header of a file that cannot be read gives no time. Names of raw files follow their time, so
such a file is taken to belong where the files beside it in its folder belong.
"""

from __future__ import annotations

import itertools
from bisect import bisect
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from operator import attrgetter
from typing import NamedTuple, Self

from lidarops.campaign.model import Campaign
from lidarops.catalog.granules import DatedFile
from lidarops.plan.scenes import DARK_REACH, window_at
from lidarops.records import Granule, Role, Scene
from lidarops.steps.dependence import with_unused


class Refused(NamedTuple):
    """A refused file, and a time to which it belongs."""

    granule: Granule
    time: datetime


def dated(
    campaign: Campaign,
    refused: Iterable[Granule],
    files_in: Callable[[str], Iterable[DatedFile]],
) -> Iterator[Refused]:
    """Yield refused files with the times of the good files beside which they belong.

    These are the ones before and after in the order of names, of the same folder, instrument and
    role. Where both are of one window, the file is of this window too. Elsewhere its name must have
    more in common with theirs than names of different windows have. A file for which this holds for
    neither is not yielded: the files of a whole day may be unreadable.

    Parameters
    ----------
    campaign : Campaign
    refused : iterable of Granule
    files_in : callable
        Returns the good files of a folder.
    """
    folders: dict[str, list[Granule]] = defaultdict(list)
    for granule in refused:
        folders[granule.path.rpartition("/")[0]].append(granule)
    for folder, granules in sorted(folders.items()):
        rows: dict[tuple[str, Role], list[DatedFile]] = defaultdict(list)
        for file in sorted(files_in(folder)):
            if file.instrument in campaign.instruments:
                rows[file.instrument, file.role].append(file)
        series = {key: _Series.of(campaign, files) for key, files in rows.items()}
        for granule in granules:
            beside = series.get((granule.instrument, granule.role))
            for time in beside.times_beside(granule.path) if beside else ():
                yield Refused(granule, time)


@dataclass(frozen=True, slots=True)
class _Series:
    """The good files of one instrument and role in a folder, by name."""

    files: Sequence[DatedFile]
    windows: Sequence[datetime]
    """Start of the window of each."""
    in_common: int
    """Most characters with which names of neighbours in different windows begin alike."""

    @classmethod
    def of(cls, campaign: Campaign, files: Sequence[DatedFile]) -> Self:
        windows = list(_windows(campaign, files))
        pairs = itertools.pairwise(zip(files, windows, strict=True))
        lengths = [_alike(a.path, b.path) for (a, first), (b, then) in pairs if first != then]
        return cls(files, windows, max(lengths, default=-1))

    def times_beside(self, path: str) -> list[datetime]:
        """Return the times of the files beside a path to which it belongs."""
        place = bisect(self.files, path, key=attrgetter("path"))
        near = range(max(place - 1, 0), min(place + 1, len(self.files)))
        between = len(near) == 2 and len({self.windows[index] for index in near}) == 1
        return [
            self.files[index].start
            for index in near
            if between or _alike(self.files[index].path, path) > self.in_common
        ]


def _windows(campaign: Campaign, files: Iterable[DatedFile]) -> Iterator[datetime]:
    opens = closes = datetime.min.replace(tzinfo=UTC)
    for file in files:
        if not opens <= file.start < closes:
            opens, closes = window_at(campaign, (file.instrument,), file.start)
        yield opens


def _alike(one: str, other: str) -> int:
    """Return how many characters two texts begin with that are the same."""
    pairs = enumerate(zip(one, other, strict=False))
    return next((n for n, (a, b) in pairs if a != b), min(len(one), len(other)))


def name_unused(scenes: Iterable[Scene], refused: Iterable[Refused]) -> tuple[Scene, ...]:
    """Return scenes that name the refused files of their instruments and time as unused."""
    of_instrument: dict[str, list[Refused]] = defaultdict(list)
    for file in refused:
        of_instrument[file.granule.instrument].append(file)
    return tuple(_named(scene, of_instrument) for scene in scenes) if of_instrument else (*scenes,)


def _named(scene: Scene, refused: dict[str, list[Refused]]) -> Scene:
    members = scene.members or (scene,)
    return with_unused(
        scene,
        (
            file.granule
            for member in members
            for file in refused.get(member.instrument, ())
            if _belongs(file, member)
        ),
    )


def _belongs(file: Refused, scene: Scene) -> bool:
    if file.granule.role is Role.SIGNAL:
        return scene.start <= file.time < scene.stop
    starts = [granule.start for granule in scene.granules if granule.start]
    return starts[0] - DARK_REACH <= file.time <= starts[-1] + DARK_REACH
