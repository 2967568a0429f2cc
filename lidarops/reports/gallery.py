"""The figures of a run: products are read, drawn, and compared with the truth.

A product that is missing or cannot be read never stops a report: it is named as a problem.
"""

from __future__ import annotations

import functools
import re
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

import xarray as xr

from lidarops.errors import ProductError
from lidarops.figures import network_figures, panels, product_figures
from lidarops.figures.network_data import (
    CROSSING_VARIABLES,
    MAP_VARIABLES,
    instruments_of,
    join_crossings,
    read_crossings,
    read_map,
)
from lidarops.figures.profile_data import PROFILE_VARIABLES, clearest_profile
from lidarops.figures.raster import COLUMNS, Raster, raster_variables, read_raster
from lidarops.figures.reading import UNREADABLE, Readers, Reading, Unread, reason
from lidarops.figures.scan_data import (
    CYCLE_VARIABLES,
    EXTINCTION_VARIABLES,
    RESIDUAL_VARIABLES,
    clearest_cycle,
    read_extinction,
    read_residuals,
)
from lidarops.figures.series_data import (
    QUANTITIES,
    SECTION_VARIABLES,
    Comparison,
    compare,
    join,
    read_sections,
)
from lidarops.figures.wording import counted
from lidarops.flags import Quality
from lidarops.records import ProductKind, ProductRecord, Role, RunRecord, SceneOutcome
from lidarops.reports.run_record import write_atomically

FIGURES: Final = 40
"""Most figures of products in a report."""
_FLAG_ROWS: Final = 40
_DARK_STEP: Final = "dark"
"""Name of the step of a plan that subtracts dark files."""
_KINDS: Final = (
    ProductKind.HOMOGENEOUS,
    ProductKind.VISIBILITY,
    ProductKind.MULTIANGLE,
    ProductKind.ELASTIC,
    ProductKind.SIGNAL,
)
Found = TypeVar("Found")
Drawing = Callable[[], product_figures.Rendered]
"""Gives a figure when it is done."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of the report."""

    file: str
    """Name inside the report folder."""
    instrument: str
    caption: str
    alt: str


@dataclass(frozen=True, slots=True)
class Compared:
    """A comparison with the truth, and whose it is."""

    instrument: str
    channel: str
    comparison: Comparison


@dataclass(frozen=True, slots=True)
class Problem:
    """A file that could not be used for the report."""

    path: str
    reason: str


@dataclass(slots=True)
class Gallery:
    """What was made of the products of a run."""

    pictures: list[Figure] = field(default_factory=list)
    flags: Figure | None = None
    compared: list[Compared] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)
    undrawn: list[str] = field(default_factory=list)
    """Labels of channels that the limit of figures left out."""


@dataclass(frozen=True, slots=True)
class _Group:
    """Every product of one kind, instrument and channel."""

    kind: ProductKind
    instrument: str
    channel: str
    members: tuple[tuple[SceneOutcome, ProductRecord], ...]
    root: Path
    """Folder that the paths of products start from."""

    @property
    def label(self) -> str:
        return f"{self.instrument} \N{MIDDLE DOT} {self.channel}"


@dataclass(frozen=True, slots=True)
class _Sources:
    """What figures are made from; products that cannot be read are noted in the gallery."""

    readers: Readers
    truth: xr.Dataset | None
    gallery: Gallery

    def each(
        self,
        group: _Group,
        names: tuple[str, ...],
        reads: Iterable[Callable[..., Found]],
        *,
        with_truth: bool = False,
    ) -> Iterator[Found]:
        """Give what is read of each product of a group that can be read."""
        paths = [product.path for _, product in group.members]
        readings = [
            Reading(group.root / path, names, read, with_truth)
            for path, read in zip(paths, reads, strict=True)
        ]
        yield from self._read(paths, readings)

    def rasters(
        self, group: _Group, names: tuple[str, ...], read: Callable[..., Raster]
    ) -> list[Raster]:
        """Reduce all products of a group alike, as coarsely as their number asks for."""
        sizes: dict[str, int] = {}
        paths = [product.path for _, product in group.members]
        lengths = self.readers.lengths([group.root / path for path in paths])
        for path, length in zip(paths, lengths, strict=True):
            if isinstance(length, Unread):
                self._note(path, length.reason)
            else:
                sizes[path] = length
        profiles = -(-sum(sizes.values()) // COLUMNS)
        reduced = functools.partial(read, profiles=profiles)
        readings = [Reading(group.root / path, names, reduced) for path in sizes]
        return list(self._read(list(sizes), readings))

    def first(
        self,
        group: _Group,
        names: tuple[str, ...],
        read: Callable[..., Found | None],
        *,
        with_truth: bool = False,
    ) -> Found | None:
        """Return what is read of the first product of a group that has it."""
        told = {problem.path for problem in self.gallery.problems}
        for _, product in group.members:
            reading = Reading(group.root / product.path, names, read, with_truth)
            found = self.readers.one(reading)
            if isinstance(found, Unread):
                if product.path not in told:
                    self._note(product.path, found.reason)
            elif found is not None:
                return found
        return None

    def draw(self, draw: Callable[..., Any], of: object, title: str) -> Drawing:
        """Begin a figure, in another process where there is one."""
        return self.readers.later(
            product_figures.draw_figure, product_figures.Sketch(draw, of, title)
        )

    def _read(self, paths: list[str], readings: list[Reading[Found]]) -> Iterator[Found]:
        for path, found in zip(paths, self.readers.each(readings), strict=True):
            if isinstance(found, Unread):
                self._note(path, found.reason)
            else:
                yield found

    def _note(self, path: str, words: str) -> None:
        self.gallery.problems.append(Problem(path, words))


@dataclass(frozen=True, slots=True)
class _Drawn:
    name: str
    caption: str
    figure: Drawing


class _Album:
    """Keeps figures as files in the order they come in, some of them while they are drawn."""

    def __init__(self, folder: Path, ahead: int) -> None:
        self.pictures: list[Figure] = []
        self._folder = folder
        # What a figure is made from is held until it is done.
        self._ahead = ahead
        self._waiting: deque[tuple[str, _Drawn]] = deque()
        self._taken: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self.pictures) + len(self._waiting)

    def add(self, instrument: str, drawn: _Drawn) -> None:
        self._waiting.append((instrument, drawn))
        self._keep(self._ahead)

    def finish(self) -> list[Figure]:
        self._keep(0)
        return self.pictures

    def _keep(self, ahead: int) -> None:
        while len(self._waiting) > ahead:
            instrument, drawn = self._waiting.popleft()
            name = _unique(drawn.name, self._taken)
            rendered = drawn.figure()
            write_atomically(self._folder / name, rendered.png)
            self.pictures.append(Figure(name, instrument, drawn.caption, rendered.alt))


def fill(record: RunRecord, folder: Path, *, limit: int = FIGURES, workers: int = 1) -> Gallery:
    """Draw the figures of a run into a folder.

    Parameters
    ----------
    record : RunRecord
    folder : Path
        Existing folder for the PNG files.
    limit : int, optional
        Most figures of products; comparisons with the truth are made for all.
    workers : int, optional
        Most processes to read and draw with; changes no figure.

    Returns
    -------
    Gallery
        One or more figures for every instrument and channel over all scenes.
    """
    gallery = Gallery()
    with _sources(record, gallery, workers) as sources:
        flags = _flags(record, sources)
        album = _Album(folder, sources.readers.processes)
        for group in _groups(record):
            full = len(album) >= limit
            if full:
                gallery.undrawn.append(f"{group.label}, {group.kind}")
            for drawn in _draw(group, sources, full=full):
                album.add(group.instrument, drawn)
        gallery.pictures = album.finish()
        if flags is not None:
            name = f"{flags.name}.png"
            rendered = flags.figure()
            write_atomically(folder / name, rendered.png)
            gallery.flags = Figure(name, "", flags.caption, rendered.alt)
    return gallery


def missing(record: RunRecord) -> frozenset[str]:
    """Return the paths of the recorded products whose file is not there."""
    root = Path(record.products)
    return frozenset(
        product.path
        for scene in record.scenes
        for product in scene.products
        if not (root / product.path).is_file()
    )


def _groups(record: RunRecord) -> list[_Group]:
    """Return the groups, homogeneous first, the channels of all instruments in turn."""
    members: dict[tuple[ProductKind, str, str], list[tuple[SceneOutcome, ProductRecord]]]
    members = defaultdict(list)
    for scene in record.scenes:
        for product in scene.products:
            members[product.kind, scene.instrument, product.channel].append((scene, product))
    turns: Counter[tuple[ProductKind, str]] = Counter()
    ordered = []
    for (kind, instrument, channel), found in sorted(members.items()):
        turn = turns[kind, instrument]
        turns[kind, instrument] += 1
        group = _Group(kind, instrument, channel, tuple(found), Path(record.products))
        ordered.append((_KINDS.index(kind), turn, instrument, channel, group))
    return [group for *_, group in sorted(ordered, key=lambda row: row[:4])]


def _draw(group: _Group, sources: _Sources, *, full: bool) -> Iterator[_Drawn]:
    if group.kind is ProductKind.HOMOGENEOUS:
        if not full or sources.truth is not None:
            yield from _homogeneous(group, sources, full=full)
    elif group.kind is ProductKind.VISIBILITY:
        yield from _visibility(group, sources, full=full)
    elif full:
        return
    elif group.kind is ProductKind.MULTIANGLE:
        yield from _multiangle(group, sources)
    elif group.kind is ProductKind.ELASTIC:
        yield from _elastic(group, sources)
    else:
        yield from _signal(group, sources)


def _homogeneous(group: _Group, sources: _Sources, *, full: bool) -> Iterator[_Drawn]:
    read = [
        functools.partial(
            read_sections,
            instrument=group.instrument,
            channel=group.channel,
            paths=[item.path for item in scene.inputs if item.role is Role.SIGNAL],
            dark_subtracted=_dark_subtracted(scene, group.channel),
        )
        for scene, _ in group.members
    ]
    by_scene = list(sources.each(group, SECTION_VARIABLES, read, with_truth=True))
    scenes = len(by_scene)
    found = [section for sections in by_scene for section in sections]
    sections = [section for section in join(found) if section.time.size > 0]
    compared = [
        Compared(group.instrument, group.channel, comparison)
        for section in sections
        for quantity in QUANTITIES
        if (comparison := compare(section, quantity)) is not None
    ]
    sources.gallery.compared += compared
    for first in range(0, 0 if full else len(sections), panels.SECTIONS):
        few = sections[first : first + panels.SECTIONS]
        where = f"{group.label}, {', '.join(section.label for section in few)}"
        yield _Drawn(
            f"homogeneous_{group.instrument}_{group.channel}",
            f"Extinction and background with their standard errors: {where};"
            f" {counted(scenes, 'scene')}.",
            sources.draw(product_figures.draw_retrieval, few, group.label),
        )
        if compared:
            yield _Drawn(
                f"truth_{group.instrument}_{group.channel}",
                f"Unflagged values against the truth of the simulation: {where}.",
                sources.draw(product_figures.draw_comparison, few, group.label),
            )


def _visibility(group: _Group, sources: _Sources, *, full: bool) -> Iterator[_Drawn]:
    read = [
        functools.partial(read_crossings, instruments=instruments_of(scene))
        for scene, _ in group.members
    ]
    by_scene = list(sources.each(group, CROSSING_VARIABLES, read, with_truth=True))
    series = join_crossings([one for crossings in by_scene for one in crossings])
    sources.gallery.compared += [
        Compared(group.instrument, group.channel, comparison)
        for one in series
        if (comparison := compare(one, "extinction")) is not None
    ]
    if full or not series:
        return
    scene = group.members[0][0]
    read_network = functools.partial(read_map, instruments=instruments_of(scene))
    network = sources.first(group, MAP_VARIABLES, read_network)
    if network is not None:
        yield _Drawn(
            f"network_{group.instrument}_{group.channel}",
            f"Beams, and visibility where they meet: {group.label}.",
            sources.draw(network_figures.draw_map, network, group.label),
        )
    for first in range(0, len(series), network_figures.CROSSINGS):
        few = series[first : first + network_figures.CROSSINGS]
        yield _Drawn(
            f"visibility_{group.instrument}_{group.channel}",
            f"Visibility and extinction with their errors:"
            f" {group.label}, {', '.join(one.label for one in few)}.",
            sources.draw(network_figures.draw_series, few, group.label),
        )


def _dark_subtracted(scene: SceneOutcome, channel: str) -> bool:
    steps = scene.plan.steps if scene.plan else ()
    return any(step.name == _DARK_STEP and step.channel == channel for step in steps)


def _signal(group: _Group, sources: _Sources) -> Iterator[_Drawn]:
    rasters = sources.rasters(group, raster_variables(), read_raster)
    if rasters:
        yield _Drawn(
            f"signal_{group.instrument}_{group.channel}",
            f"Range-corrected signal and background: {group.label};"
            f" {counted(len(rasters), 'scene')}.",
            sources.draw(product_figures.draw_quicklook, rasters, group.label),
        )


def _elastic(group: _Group, sources: _Sources) -> Iterator[_Drawn]:
    quantity = "attenuated_backscatter"
    read = functools.partial(read_raster, quantity=quantity)
    rasters = sources.rasters(group, raster_variables(quantity), read)
    if rasters:
        yield _Drawn(
            f"elastic_{group.instrument}_{group.channel}",
            f"Attenuated backscatter, clouds and background: {group.label};"
            f" {counted(len(rasters), 'scene')}.",
            sources.draw(product_figures.draw_backscatter, rasters, group.label),
        )
    profile = sources.first(group, PROFILE_VARIABLES, clearest_profile)
    if profile is not None:
        yield _Drawn(
            f"profile_{group.instrument}_{group.channel}",
            f"The profile of a scene with most unflagged bins, and its error budget:"
            f" {group.label}.",
            sources.draw(product_figures.error_budget_figure, profile, group.label),
        )


def _multiangle(group: _Group, sources: _Sources) -> Iterator[_Drawn]:
    rasters = sources.rasters(group, EXTINCTION_VARIABLES, read_extinction)
    if rasters:
        yield _Drawn(
            f"multiangle_{group.instrument}_{group.channel}",
            f"Extinction over time and altitude: {group.label}; {counted(len(rasters), 'scene')}.",
            sources.draw(product_figures.draw_extinction, rasters, group.label),
        )
    clearest = functools.partial(clearest_cycle, instrument=group.instrument)
    profile = sources.first(group, CYCLE_VARIABLES, clearest, with_truth=True)
    if profile is not None:
        yield _Drawn(
            f"scan-profile_{group.instrument}_{group.channel}",
            f"The cycle of a scene with most unflagged values: {group.label}.",
            sources.draw(product_figures.scan_profile, profile, group.label),
        )
    residuals = sources.first(group, RESIDUAL_VARIABLES, read_residuals)
    if residuals is not None:
        yield _Drawn(
            f"scan-residuals_{group.instrument}_{group.channel}",
            f"What the fit over angles leaves of the signal, mean of the cycles of a scene:"
            f" {group.label}.",
            sources.draw(product_figures.scan_residuals, residuals, group.label),
        )


def _flags(record: RunRecord, sources: _Sources) -> _Drawn | None:
    shares = _shares(record)
    if not shares:
        return None
    return _Drawn(
        "flags",
        "Share of the values of every product that carry a quality bit, over all scenes.",
        sources.draw(product_figures.flags_overview, shares, "Flagged values"),
    )


def _shares(record: RunRecord) -> Mapping[str, Mapping[Quality, float]]:
    values: Counter[str] = Counter()
    carried: dict[str, Counter[Quality]] = defaultdict(Counter)
    for group in _groups(record):
        label = f"{group.label}, {group.kind}"
        for _, product in group.members:
            values[label] += product.values
            for name, count in product.flagged.items():
                if name.upper() in Quality.__members__:
                    carried[label][Quality[name.upper()]] += count
    rows = {
        label: {bit: count / values[label] for bit, count in carried[label].items()}
        for label in values
        if values[label] > 0
    }
    worst = sorted(rows, key=lambda label: -max(rows[label].values(), default=0.0))
    return {label: rows[label] for label in sorted(worst[:_FLAG_ROWS])}


@contextmanager
def _sources(record: RunRecord, gallery: Gallery, workers: int) -> Iterator[_Sources]:
    truth = _truth(record, gallery)
    products = sum(len(scene.products) for scene in record.scenes)
    with Readers(workers, products, truth) as readers:
        yield _Sources(readers, truth, gallery)


def _truth(record: RunRecord, gallery: Gallery) -> xr.Dataset | None:
    if not record.truth:
        return None
    path = Path(record.truth)
    try:
        if not path.is_file():
            raise ProductError("the file is missing")
        with xr.open_dataset(path, engine="netcdf4", decode_timedelta=False) as opened:
            truth = opened.load()
        for name in ("path", "instrument", "time", "extinction"):
            if name not in truth.variables or truth[name].dims != ("granule",):
                raise ProductError("is not a variable along granule", field=name)
    except UNREADABLE as error:
        gallery.problems.append(Problem(record.truth, reason(path, error)))
        return None
    return truth


def _unique(name: str, taken: Counter[str]) -> str:
    plain = re.sub(r"[^A-Za-z0-9_-]+", "-", name)[:100]
    taken[plain] += 1
    return f"{plain}.png" if taken[plain] == 1 else f"{plain}_{taken[plain]}.png"


def comparisons_by_quantity(compared: Sequence[Compared]) -> Mapping[str, tuple[int, int, int]]:
    """Return for every quantity how many values were compared, within 1 and 3 standard errors."""
    totals: dict[str, tuple[int, int, int]] = {}
    for item in compared:
        c = item.comparison
        if c.count:
            count, one, three = totals.get(c.quantity, (0, 0, 0))
            totals[c.quantity] = (
                count + c.count,
                one + round(c.within_1 * c.count),
                three + round(c.within_3 * c.count),
            )
    return totals
