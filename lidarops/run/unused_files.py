"""Find the scenes to which refused files belong: their products state that these are unused.

Where a header gives no time, and the catalog knew none before, a file is taken to belong where the
files beside it in its folder belong, because names of raw files follow their time.
"""

from __future__ import annotations

import itertools
from bisect import bisect
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from operator import attrgetter
from typing import Final, NamedTuple, Self

from lidarops.campaign.model import Campaign
from lidarops.catalog.granules import DatedFile
from lidarops.constants import DARK_REACH
from lidarops.records import Granule, Role, Scene, UnusedFile
from lidarops.run.scenes import window_at

MOST_IN_DOUBT: Final = 10
"""Dark files of unknown time that a scene names; all those of an archive may be refused."""
_ALWAYS: Final = (datetime.min.replace(tzinfo=UTC), datetime.max.replace(tzinfo=UTC))


class RefusedFile(NamedTuple):
    """A refused file, and a time to which it belongs."""

    granule: Granule
    time: datetime
    in_doubt: bool = False
    """Whether it belongs only to scenes without dark files, of which it may be the one."""


def dated(
    campaign: Campaign,
    refused: Iterable[Granule],
    files_in: Callable[[str], Iterable[DatedFile]],
    days_below: Callable[[str, str], Sequence[datetime]],
) -> Iterator[RefusedFile]:
    """Yield refused files with the times of the good files beside which they belong.

    These are the ones before and after in the order of names, of the same folder, instrument and
    role. Where both are of one window, the file is of this window too. Elsewhere its name must have
    more in common with theirs than names of different windows have. A file for which this holds for
    neither is not yielded: the files of a whole day may be unreadable. But a dark file may be the
    only one of its time, so it is yielded, in doubt, with all days of the nearest signal files from
    the dark file before to the one after.

    Parameters
    ----------
    campaign : Campaign
    refused : iterable of Granule
    files_in : callable
        Returns the good files of a folder.
    days_below : callable
        Returns times of the good signal files of an instrument below a folder, one for each day.
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
        undated: dict[tuple[str, datetime, datetime], list[Granule]] = defaultdict(list)
        for granule in granules:
            if granule.start:
                yield RefusedFile(granule, granule.start)
                continue
            beside = series.get((granule.instrument, granule.role))
            times = beside.times_beside(granule.path) if beside else []
            yield from (RefusedFile(granule, time) for time in times)
            # Where good dark files are of one window, their names do not show how those of others
            # differ.
            sure = beside and times and beside.in_common >= 0
            if granule.role is Role.DARK and not sure:
                since, until = beside.times_around(granule.path) if beside else _ALWAYS
                undated[granule.instrument, since, until].append(granule)
        for (instrument, since, until), dark in undated.items():
            days = _nearest(folder, instrument, days_below)
            within = [day for day in days if since <= day <= until]
            for granule in dark[:MOST_IN_DOUBT]:
                yield from (RefusedFile(granule, day, in_doubt=True) for day in within)


def _nearest(
    folder: str, instrument: str, days_below: Callable[[str, str], Sequence[datetime]]
) -> Sequence[datetime]:
    """Return the days of an instrument in a folder, or in the first above it that holds some."""
    days = days_below(folder, instrument)
    while folder and not days:
        folder = folder.rpartition("/")[0]
        days = days_below(folder, instrument)
    return days


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
        lengths = [
            _common_begin(a.path, b.path) for (a, first), (b, then) in pairs if first != then
        ]
        return cls(files, windows, max(lengths, default=-1))

    def times_beside(self, path: str) -> list[datetime]:
        """Return the times of the files beside a path to which it belongs."""
        place = bisect(self.files, path, key=attrgetter("path"))
        near = range(max(place - 1, 0), min(place + 1, len(self.files)))
        between = len(near) == 2 and len({self.windows[index] for index in near}) == 1
        return [
            self.files[index].start
            for index in near
            if between or _common_begin(self.files[index].path, path) > self.in_common
        ]

    def times_around(self, path: str) -> tuple[datetime, datetime]:
        """Return the times of the files before and after a path; of no file, all times."""
        place = bisect(self.files, path, key=attrgetter("path"))
        before, after = _ALWAYS
        if place:
            before = self.files[place - 1].start
        if place < len(self.files):
            after = self.files[place].start
        # The order of names need not be that of times.
        return min(before, after), max(before, after)


def _windows(campaign: Campaign, files: Iterable[DatedFile]) -> Iterator[datetime]:
    opens = closes = datetime.min.replace(tzinfo=UTC)
    for file in files:
        if not opens <= file.start < closes:
            opens, closes = window_at(campaign, (file.instrument,), file.start)
        yield opens


def _common_begin(one: str, other: str) -> int:
    """Return how many characters two texts begin with that are the same."""
    pairs = enumerate(zip(one, other, strict=False))
    return next((n for n, (a, b) in pairs if a != b), min(len(one), len(other)))


def name_unused(
    scenes: Iterable[Scene],
    refused: Iterable[RefusedFile],
    lost: Mapping[str, Iterable[UnusedFile]],
) -> tuple[Scene, ...]:
    """Return scenes that name as unused the refused files of their instruments and time.

    So they name files that the archive has lost, which are given by the id of the scene.
    """
    of_instrument: dict[str, list[RefusedFile]] = defaultdict(list)
    for file in refused:
        of_instrument[file.granule.instrument].append(file)
    named = []
    for scene in scenes:
        unused = {*scene.unused, *lost.get(scene.id, ())} | {
            UnusedFile.of(file.granule)
            for member in scene.members or (scene,)
            for file in of_instrument[member.instrument]
            if _belongs(file, member)
        }
        named.append(replace(scene, unused=tuple(sorted(unused))) if unused else scene)
    return tuple(named)


def _belongs(file: RefusedFile, scene: Scene) -> bool:
    if file.granule.role is Role.SIGNAL:
        return scene.start <= file.time < scene.stop
    if file.in_doubt and scene.dark:
        return False
    starts = [granule.start for granule in scene.granules if granule.start]
    return starts[0] - DARK_REACH <= file.time <= starts[-1] + DARK_REACH
