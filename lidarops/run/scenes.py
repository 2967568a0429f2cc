"""Group granules into scenes, which are processed together.

A scene holds the granules of one instrument in one window of the campaign (a UTC day or a part of
it); those of a scan cycle that crosses the end of a window belong to the window in which it began.
A scene is split where the facts about the instrument change, because a scene has one plan, and
where the channels or the range grid of the files change, because a product has one grid.

A month of products is a scene, too, without granules.

A scene of a network holds one member scene for each instrument, in the same window. It is split
where the facts about any member change.

Refused files belong to scenes too, whose products state them as unused. Where a header gives no
time, and the catalog knew none before, a file is taken to belong where the files beside it in its
folder belong, because names of raw files follow their time.

A run with nothing to do imports this module, so it imports numerics where they are needed.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from bisect import bisect
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from operator import attrgetter
from typing import Any, Final, NamedTuple, Self

from lidarops.campaign.model import Campaign, InstrumentFacts
from lidarops.catalog.granules import DatedFile, Granules
from lidarops.constants import DARK_REACH, LEAST_SPREAD
from lidarops.errors import RetrievalInputError, SceneError
from lidarops.kinds import Scope, kinds_of
from lidarops.records import (
    MISDATED,
    ChannelLayout,
    FileNote,
    Granule,
    InputRecord,
    Role,
    Scene,
    Status,
    UnusedFile,
    after_pulse,
    day_of,
)

STAMP: Final = "%Y%m%dT%H%M%S"
"""Format of the start time in the id of a scene."""
MONTH: Final = "-month"
"""End of the id of the scene of a month of products."""
Window = tuple[datetime, datetime]
"""Start and end of a window."""
MOST_NOTES = 20
"""Different notes on the files of a scene that are kept."""
MOST_IN_DOUBT: Final = 10
"""Dark files of unknown time that a scene names; all those of an archive may be refused."""
_ALWAYS: Final = (datetime.min.replace(tzinfo=UTC), datetime.max.replace(tzinfo=UTC))


class Cut(NamedTuple):
    """Scenes, and the granules that belong to no scene."""

    scenes: tuple[Scene, ...]
    set_aside: tuple[Granule, ...]
    """Granules that start at the time of another one of the instrument; refused for that reason."""
    file_notes: tuple[FileNote, ...] = ()
    """Notes on its granules that only the files around them show."""


def cut_scenes(campaign: Campaign, granules: Iterable[Granule]) -> Cut:
    """Group the good granules of a campaign into scenes.

    Parameters
    ----------
    campaign : Campaign
        Defines the window and the validity periods.
    granules : iterable of Granule
        In any order; refused ones are ignored.

    Returns
    -------
    Cut
        Scenes by instrument and time, then those of networks, independent of the order of
        `granules`.
    """
    good = sorted(
        (granule for granule in granules if granule.status is Status.GOOD),
        key=lambda granule: (granule.instrument, start_time(granule), granule.path),
    )
    signal, twins = _without_twins([g for g in good if g.role is Role.SIGNAL])
    dark = [granule for granule in good if granule.role is Role.DARK]
    scenes: list[Scene] = []
    for instrument, own in itertools.groupby(signal, key=attrgetter("instrument")):
        if instrument in campaign.instruments:
            windows = _by_window(campaign, (instrument,), list(own))
            _keep_cycles_whole(windows, campaign.instruments[instrument].facts)
            for window, members in sorted(windows.items()):
                scenes += _by_layout(campaign, instrument, window, members, dark)
    for key in sorted(campaign.networks):
        scenes += _of_network(campaign, key, signal, dark)
    return Cut(tuple(scenes), tuple(twins))


def months_of_products(
    campaign: Campaign, days: Collection[int], products: Mapping[InputRecord, str]
) -> Iterator[Scene]:
    """Yield the months that begin on some days, of instruments with products of months.

    Parameters
    ----------
    campaign : Campaign
    days : collection of int
        In days since 1970-01-01.
    products : mapping of InputRecord to str
        Products that are there or are to be made -> their scenes.
    """
    held: defaultdict[tuple[str, Window], list[InputRecord]] = defaultdict(list)
    for product, scene in products.items():
        instrument, start = parse_scene_id(scene)
        window = month_of(start)
        if day_of(window[0]) in days and not scene.endswith(MONTH):
            held[instrument, window].append(product)
    for (name, window), own in sorted(held.items()):
        owner = campaign.instruments.get(name)
        requested = owner.products.requested if owner else ()
        if owner and any(kind.name in requested for kind in kinds_of(Scope.MONTH)):
            read = tuple(sorted(own, key=attrgetter("path")))
            yield _scene(campaign, name, window, MONTH, granules=(), products=read)


def _of_network(
    campaign: Campaign, key: str, signal: list[Granule], dark: list[Granule]
) -> list[Scene]:
    """Return the scenes of a network: windows in which at least two members have granules.

    Where a member changed its range grid within a window, each grid makes a scene of its own with
    the other members.
    """
    names = tuple(campaign.networks[key].instruments)
    groups = _by_window(campaign, names, [g for g in signal if g.instrument in names])
    scenes = []
    for window, granules in sorted(groups.items()):
        own = ([g for g in granules if g.instrument == name] for name in names)
        member_scenes = [
            _by_layout(campaign, members[0].instrument, window, members, dark)
            for members in own
            if members
        ]
        combinations = list(itertools.product(*member_scenes)) if len(member_scenes) > 1 else []
        for members in combinations:
            suffix = f"-{_grids_key(members)}" if len(combinations) > 1 else ""
            scenes.append(
                _scene(
                    campaign,
                    key,
                    window,
                    suffix,
                    granules=_in_time(g for member in members for g in member.granules),
                    dark=_in_time(g for member in members for g in member.dark),
                    members=members,
                    notes=tuple(
                        f"{member.instrument}: {note}"
                        for member in members
                        for note in member.notes
                    ),
                )
            )
    return scenes


def _scene(campaign: Campaign, key: str, window: Window, suffix: str, **held: Any) -> Scene:
    """Return the scene of an instrument or network in a window, with what it holds."""
    owner = campaign.instruments.get(key)
    return Scene(
        id=f"{key}_{window[0]:{STAMP}}{suffix}",
        campaign=campaign.name,
        station=owner.station if owner else key,
        instrument=key,
        start=window[0],
        stop=window[1],
        **held,
    )


def _in_time(granules: Iterable[Granule]) -> tuple[Granule, ...]:
    return tuple(sorted(granules, key=lambda granule: (start_time(granule), granule.path)))


def _grids_key(members: Sequence[Scene]) -> str:
    text = " ".join(_layout_key(member.granules[0].layout) for member in members)
    return hashlib.sha256(text.encode()).hexdigest()[:6]


def as_recorded(scene: Scene, recorded: Collection[str]) -> Scene:
    """Return a scene with its suffix if a recorded one has it, whose window held others then."""
    members = tuple(as_recorded(member, recorded) for member in scene.members)
    whole = (
        f"{scene.id}-{_grids_key(members) if members else _layout_key(scene.granules[0].layout)}"
    )
    return replace(scene, id=whole if whole in recorded else scene.id, members=members)


def start_time(granule: Granule) -> datetime:
    """Return when a good granule starts."""
    if granule.start is None:
        raise SceneError("has no start time", file=granule.path)
    return granule.start


def _without_twins(granules: list[Granule]) -> tuple[list[Granule], list[Granule]]:
    kept: list[Granule] = []
    twins: list[Granule] = []
    first: dict[tuple[str, datetime], Granule] = {}
    for granule in granules:
        key = (granule.instrument, start_time(granule))
        if key in first:
            reason = f"starts at the same time as {first[key].path}, which is used"
            twins.append(replace(granule, status=Status.REFUSED, reason=reason))
        else:
            first[key] = granule
            kept.append(granule)
    return kept, twins


def _windows(
    campaign: Campaign, instruments: Sequence[str], times: Iterable[datetime]
) -> Iterator[Window]:
    """Yield the windows that hold some times; fast where these rise."""
    opens = closes = datetime.min.replace(tzinfo=UTC)
    for time in times:
        if not opens <= time < closes:
            opens, closes = window_at(campaign, instruments, time)
        yield opens, closes


def _by_window(
    campaign: Campaign, instruments: Sequence[str], granules: Sequence[Granule]
) -> dict[Window, list[Granule]]:
    held: dict[Window, list[Granule]] = defaultdict(list)
    windows = _windows(campaign, instruments, map(start_time, granules))
    for granule, window in zip(granules, windows, strict=True):
        held[window].append(granule)
    return held


def _keep_cycles_whole(
    windows: dict[Window, list[Granule]], facts: Sequence[InstrumentFacts]
) -> None:
    """Move granules to the window in which the cycle of their scan began.

    No cycle crosses a moment at which facts change.
    """
    if any(fact.zenith_angle is not None for fact in facts):
        return
    edges = {edge for fact in facts for edge in (fact.valid_from, fact.valid_to)}
    for before, after in itertools.pairwise(sorted(windows)):
        earlier, later = windows[before], windows[after]
        if before[1] != after[0] or after[0] in edges or not earlier:
            continue
        numbers = scan_cycles_of([*earlier, *later])
        last = numbers[len(earlier) - 1]
        crossing = sum(1 for number in numbers[len(earlier) :] if number == last)
        earlier += later[:crossing]
        del later[:crossing]


def scan_cycles_of(granules: Sequence[Granule]) -> list[int]:
    """Return the scan cycle of each granule; all differ where the beam does not scan."""
    angles = [granule.zenith_angle for granule in granules]
    known = [angle for angle in angles if angle is not None]
    # A run with nothing to do needs no numerics.
    from lidarops.retrieve.multiangle import scan_cycles  # noqa: PLC0415

    if len(known) < len(angles) or max(known) - min(known) < LEAST_SPREAD:
        return list(range(len(granules)))
    azimuth = [math.nan if g.azimuth is None else g.azimuth for g in granules]
    bounds = [[moment.timestamp() for moment in (g.start, g.stop) if moment] for g in granules]
    try:
        return [int(number) for number in scan_cycles.cycles(known, azimuth, bounds)]
    except RetrievalInputError:
        # The retrieval raises the same error with its message.
        return list(range(len(granules)))


def _by_layout(
    campaign: Campaign,
    instrument: str,
    window: Window,
    members: list[Granule],
    dark: list[Granule],
) -> list[Scene]:
    layouts: dict[str, list[Granule]] = defaultdict(list)
    owner = campaign.instruments[instrument]
    dark = [granule for granule in dark if granule.instrument == instrument]
    if members and any(fact.pre_trigger for fact in owner.facts):
        before = owner.facts_at(start_time(members[0])).pre_trigger
        members, dark = (
            [replace(g, layout=after_pulse(g.layout, before)) for g in own]
            for own in (members, dark)
        )
    for granule in members:
        layouts[_layout_key(granule.layout)].append(granule)
    scenes = []
    for key, group in sorted(layouts.items()):
        suffix = f"-{key}" if len(layouts) > 1 else ""
        scenes.append(
            _scene(
                campaign,
                instrument,
                window,
                suffix,
                granules=tuple(group),
                dark=tuple(
                    granule
                    for granule in dark
                    if _layout_key(granule.layout) == key
                    and [c.recorder for c in granule.layout]
                    == [c.recorder for c in group[0].layout]
                    and start_time(group[0]) - DARK_REACH
                    <= start_time(granule)
                    <= start_time(group[-1]) + DARK_REACH
                ),
                notes=_notes(group),
            )
        )
    return scenes


def _notes(granules: Sequence[Granule]) -> tuple[str, ...]:
    files = Counter(
        note for granule in granules for note in (*granule.contradictions, *granule.notes)
    )
    shown = [f"{note}: {count} of {len(granules)} files" for note, count in files.items()]
    more = [f"{len(shown) - MOST_NOTES} other notes"] if len(shown) > MOST_NOTES else []
    return (*shown[:MOST_NOTES], *more)


# An archive has few layouts.
@lru_cache(maxsize=128)
def _layout_key(layout: tuple[ChannelLayout, ...]) -> str:
    text = repr([(c.name, c.bins, c.bin_width, c.adc_bits) for c in layout])
    return hashlib.sha256(text.encode()).hexdigest()[:6]


def parse_scene_id(scene: str) -> tuple[str, datetime]:
    """Return the instrument or network, and the start time, from the id of a scene."""
    instrument, _, rest = scene.rpartition("_")
    return instrument, datetime.strptime(rest.partition("-")[0], STAMP).replace(tzinfo=UTC)


def scene_stop(scene: str, campaign: Campaign) -> datetime:
    """Return when a scene with this id would end with the present campaign file."""
    key, start = parse_scene_id(scene)
    if scene.endswith(MONTH):
        return month_of(start)[1]
    members = campaign.networks[key].instruments if key in campaign.networks else [key]
    return window_at(campaign, [name for name in members if name in campaign.instruments], start)[1]


def month_of(moment: datetime) -> Window:
    """Return the calendar month that holds a moment, UTC."""
    first = moment.astimezone(UTC).replace(day=1, hour=0, minute=0, second=0, microsecond=0)
    return first, (first + timedelta(days=31)).replace(day=1)


def window_at(campaign: Campaign, instruments: Sequence[str], start: datetime) -> Window:
    """Return the window that holds `start`, narrowed so that no fact changes within it."""
    length = timedelta(days=1) if campaign.scenes.window == "day" else campaign.scenes.window
    midnight = start.astimezone(UTC).replace(hour=0, minute=0, second=0, microsecond=0)
    opens = midnight + (start - midnight) // length * length
    closes = opens + length
    for instrument in instruments:
        for fact in campaign.instruments[instrument].facts:
            for edge in (fact.valid_from, fact.valid_to):
                if opens < edge <= start:
                    opens = edge
                elif start < edge < closes:
                    closes = edge
    return opens, closes


class RefusedFile(NamedTuple):
    """A refused file, and a time to which it belongs."""

    granule: Granule
    time: datetime
    in_doubt: bool = False
    """Whether it belongs only to scenes without dark files, of which it may be the one."""


def dated(
    campaign: Campaign, catalog: Granules, refused: Iterable[Granule]
) -> Iterator[RefusedFile]:
    """Yield refused files with the times of the good files beside which they belong.

    These are the ones before and after in the order of names, of the same folder, instrument and
    role. Where both are of one window, the file is of this window too. Elsewhere its name must have
    more in common with theirs than names of different windows have. A file for which this holds for
    neither is not yielded: the files of a whole day may be unreadable. But a dark file may be the
    only one of its time, so it is yielded, in doubt, with all days of the nearest signal files from
    the dark file before to the one after.
    """
    folders: dict[str, list[Granule]] = defaultdict(list)
    for granule in refused:
        folders[granule.path.rpartition("/")[0]].append(granule)
    for folder, granules in sorted(folders.items()):
        rows: dict[tuple[str, Role], list[DatedFile]] = defaultdict(list)
        for file in sorted(catalog.files_in(folder)):
            if file.instrument in campaign.instruments and not file.reason:
                rows[file.instrument, file.role].append(file)
        series = {key: _Series.of(campaign, files) for key, files in rows.items()}
        undated: dict[tuple[str, datetime, datetime], list[Granule]] = defaultdict(list)
        for granule in granules:
            if granule.start and not granule.reason.startswith(MISDATED):
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
            days = catalog.nearest_days(folder, instrument)
            within = [day for day in days if since <= day <= until]
            for granule in dark[:MOST_IN_DOUBT]:
                yield from (RefusedFile(granule, day, in_doubt=True) for day in within)


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
        times = (file.start for file in files)
        windows = [opens for opens, _ in _windows(campaign, (files[0].instrument,), times)]
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
        before = self.files[place - 1].start if place else _ALWAYS[0]
        after = self.files[place].start if place < len(self.files) else _ALWAYS[1]
        # The order of names need not be that of times.
        return min(before, after), max(before, after)


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
        unused = {*scene.unused} | {
            UnusedFile.of(file.granule)
            for member in scene.members or (scene,)
            for file in of_instrument[member.instrument]
            if _belongs(file, member)
        }
        # One that is empty or cannot be read is refused, and no longer gives what it gave.
        paths = {file.path for file in unused}
        unused |= {file for file in lost.get(scene.id, ()) if file.path not in paths}
        named.append(replace(scene, unused=tuple(sorted(unused))))
    return tuple(named)


def _belongs(file: RefusedFile, scene: Scene) -> bool:
    if file.granule.role is Role.SIGNAL:
        return scene.start <= file.time < scene.stop
    if file.in_doubt and scene.dark:
        return False
    starts = [granule.start for granule in scene.granules if granule.start]
    return starts[0] - DARK_REACH <= file.time <= starts[-1] + DARK_REACH
