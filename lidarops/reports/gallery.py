"""The figures of a run's report: reads products, draws them, compares them with the truth.

A missing or unreadable product does not stop the report; it is listed as a problem.
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
from lidarops.figures.reading import UNREADABLE, Readers, ReadFailure, ReadTask, reason
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
from lidarops.records import ProductRecord, Role, RunRecord, SceneOutcome
from lidarops.system.files import write_atomically

FIGURES: Final = 40
"""Most figures of products in a report."""
_FLAG_ROWS: Final = 40
_DARK_STEP: Final = "dark"
"""Name of the step of a plan that subtracts dark files."""
_KIND_ORDER: Final = (
    "homogeneous",
    "visibility",
    "multiangle",
    "elastic",
    "signal",
)
Content = TypeVar("Content")
Drawing = Callable[[], product_figures.Rendered]
"""Returns a figure once it is drawn."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of the report."""

    file: str
    """File name in the report folder."""
    instrument: str
    caption: str
    alt: str


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


@dataclass(slots=True)
class Gallery:
    """Figures, comparisons and problems from the products of a run."""

    pictures: list[Figure] = field(default_factory=list)
    flags: Figure | None = None
    compared: list[Compared] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)
    undrawn: list[str] = field(default_factory=list)
    """Labels of channels that are not drawn because of the limit on figures."""


@dataclass(frozen=True, slots=True)
class _Group:
    """All products of one kind, instrument and channel."""

    kind: str
    instrument: str
    channel: str
    members: tuple[tuple[SceneOutcome, ProductRecord], ...]
    root: Path
    """Folder that product paths are relative to."""

    @property
    def label(self) -> str:
        return f"{self.instrument} \N{MIDDLE DOT} {self.channel}"


@dataclass(frozen=True, slots=True)
class _Sources:
    """Reads products for figures; unreadable products are noted as problems of the gallery."""

    readers: Readers
    truth: xr.Dataset | None
    gallery: Gallery

    def read_all(
        self,
        group: _Group,
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
        self, group: _Group, names: tuple[str, ...], read: Callable[..., Raster]
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
        group: _Group,
        names: tuple[str, ...],
        read: Callable[..., Content | None],
        *,
        with_truth: bool = False,
    ) -> Content | None:
        """Return the content of the first product of a group that has any, or None."""
        noted = {problem.path for problem in self.gallery.problems}
        for _, product in group.members:
            reading = ReadTask(group.root / product.path, names, read, with_truth)
            content = self.readers.read(reading)
            if isinstance(content, ReadFailure):
                if product.path not in noted:
                    self._note(product.path, content.reason)
            elif content is not None:
                return content
        return None

    def draw(self, draw: Callable[..., Any], content: object, title: str) -> Drawing:
        """Start drawing a figure, in another process if there is one."""
        return self.readers.later(
            product_figures.draw_figure, product_figures.Sketch(draw, content, title)
        )

    def _read(self, paths: list[str], readings: list[ReadTask[Content]]) -> Iterator[Content]:
        for path, content in zip(paths, self.readers.read_all(readings), strict=True):
            if isinstance(content, ReadFailure):
                self._note(path, content.reason)
            else:
                yield content

    def _note(self, path: str, words: str) -> None:
        self.gallery.problems.append(Problem(path, words))


@dataclass(frozen=True, slots=True)
class _PendingFigure:
    name: str
    caption: str
    draw: Drawing


class _Album:
    """Writes figures to files in their order; a bounded number is drawn at the same time."""

    def __init__(self, folder: Path, ahead: int) -> None:
        self.pictures: list[Figure] = []
        self._folder = folder
        # Bounded, because the data of a figure stay in memory until it is drawn.
        self._ahead = ahead
        self._waiting: deque[tuple[str, _PendingFigure]] = deque()
        self._taken: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self.pictures) + len(self._waiting)

    def add(self, instrument: str, figure: _PendingFigure) -> None:
        self._waiting.append((instrument, figure))
        self._keep(self._ahead)

    def finish(self) -> list[Figure]:
        self._keep(0)
        return self.pictures

    def _keep(self, ahead: int) -> None:
        while len(self._waiting) > ahead:
            instrument, figure = self._waiting.popleft()
            name = _unique(figure.name, self._taken)
            rendered = figure.draw()
            write_atomically(self._folder / name, rendered.png)
            self.pictures.append(Figure(name, instrument, figure.caption, rendered.alt))


def fill(record: RunRecord, folder: Path, *, limit: int = FIGURES, workers: int = 1) -> Gallery:
    """Draw the figures of a run into a folder.

    Parameters
    ----------
    record : RunRecord
    folder : Path
        Existing folder for the PNG files.
    limit : int, optional
        Most figures of products. Comparisons with the truth are made for all products.
    workers : int, optional
        Most processes that read and draw. The figures do not depend on it.

    Returns
    -------
    Gallery
        One or more figures per instrument and channel, over all scenes.
    """
    gallery = Gallery()
    with _sources(record, gallery, workers) as sources:
        flags = _flags(record, sources)
        album = _Album(folder, sources.readers.processes)
        for group in _groups(record):
            full = len(album) >= limit
            if full:
                gallery.undrawn.append(f"{group.label}, {group.kind}")
            for figure in _draw(group, sources, full=full):
                album.add(group.instrument, figure)
        gallery.pictures = album.finish()
        if flags is not None:
            name = f"{flags.name}.png"
            rendered = flags.draw()
            write_atomically(folder / name, rendered.png)
            gallery.flags = Figure(name, "", flags.caption, rendered.alt)
    return gallery


def missing_products(record: RunRecord) -> frozenset[str]:
    """Return the paths of recorded products whose file is missing."""
    root = Path(record.products)
    return frozenset(
        product.path
        for scene in record.scenes
        for product in scene.products
        if not (root / product.path).is_file()
    )


def _groups(record: RunRecord) -> list[_Group]:
    """Return the groups by kind; within a kind, the first channel of every instrument first."""
    members: dict[tuple[str, str, str], list[tuple[SceneOutcome, ProductRecord]]]
    members = defaultdict(list)
    for scene in record.scenes:
        for product in scene.products:
            members[product.kind, scene.instrument, product.channel].append((scene, product))
    turns: Counter[tuple[str, str]] = Counter()
    ordered = []
    for (kind, instrument, channel), products in sorted(members.items()):
        turn = turns[kind, instrument]
        turns[kind, instrument] += 1
        group = _Group(kind, instrument, channel, tuple(products), Path(record.products))
        ordered.append((_KIND_ORDER.index(kind), turn, instrument, channel, group))
    return [group for *_, group in sorted(ordered, key=lambda row: row[:4])]


def _draw(group: _Group, sources: _Sources, *, full: bool) -> Iterator[_PendingFigure]:
    if group.kind == "homogeneous":
        if not full or sources.truth is not None:
            yield from _homogeneous(group, sources, full=full)
    elif group.kind == "visibility":
        yield from _visibility(group, sources, full=full)
    elif full:
        return
    elif group.kind == "multiangle":
        yield from _multiangle(group, sources)
    elif group.kind == "elastic":
        yield from _elastic(group, sources)
    else:
        yield from _signal(group, sources)


def _homogeneous(group: _Group, sources: _Sources, *, full: bool) -> Iterator[_PendingFigure]:
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
    by_scene = list(sources.read_all(group, SECTION_VARIABLES, read, with_truth=True))
    scenes = len(by_scene)
    unjoined = [section for sections in by_scene for section in sections]
    sections = [section for section in join(unjoined) if section.time.size > 0]
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
        yield _PendingFigure(
            f"homogeneous_{group.instrument}_{group.channel}",
            f"Extinction and background with their standard errors: {where};"
            f" {counted(scenes, 'scene')}.",
            sources.draw(product_figures.draw_retrieval, few, group.label),
        )
        if compared:
            yield _PendingFigure(
                f"truth_{group.instrument}_{group.channel}",
                f"Unflagged values compared with the simulated truth: {where}.",
                sources.draw(product_figures.draw_comparison, few, group.label),
            )


def _visibility(group: _Group, sources: _Sources, *, full: bool) -> Iterator[_PendingFigure]:
    read = [
        functools.partial(read_crossings, instruments=instruments_of(scene))
        for scene, _ in group.members
    ]
    by_scene = list(sources.read_all(group, CROSSING_VARIABLES, read, with_truth=True))
    series = join_crossings([crossing for crossings in by_scene for crossing in crossings])
    sources.gallery.compared += [
        Compared(group.instrument, group.channel, comparison)
        for crossing in series
        if (comparison := compare(crossing, "extinction")) is not None
    ]
    if full or not series:
        return
    scene = group.members[0][0]
    read_network = functools.partial(read_map, instruments=instruments_of(scene))
    network = sources.read_first(group, MAP_VARIABLES, read_network)
    if network is not None:
        yield _PendingFigure(
            f"network_{group.instrument}_{group.channel}",
            f"Beams, crossings and median visibility at the crossings: {group.label}.",
            sources.draw(network_figures.draw_map, network, group.label),
        )
    for first in range(0, len(series), network_figures.CROSSINGS):
        few = series[first : first + network_figures.CROSSINGS]
        yield _PendingFigure(
            f"visibility_{group.instrument}_{group.channel}",
            f"Visibility and extinction at the crossings, with standard errors:"
            f" {group.label}, {', '.join(crossing.label for crossing in few)}.",
            sources.draw(network_figures.draw_series, few, group.label),
        )


def _dark_subtracted(scene: SceneOutcome, channel: str) -> bool:
    steps = scene.plan.steps if scene.plan else ()
    return any(step.name == _DARK_STEP and step.channel == channel for step in steps)


def _signal(group: _Group, sources: _Sources) -> Iterator[_PendingFigure]:
    rasters = sources.rasters(group, raster_variables(), read_raster)
    if rasters:
        yield _PendingFigure(
            f"signal_{group.instrument}_{group.channel}",
            f"Range-corrected signal and background: {group.label};"
            f" {counted(len(rasters), 'scene')}.",
            sources.draw(product_figures.draw_quicklook, rasters, group.label),
        )


def _elastic(group: _Group, sources: _Sources) -> Iterator[_PendingFigure]:
    quantity = "attenuated_backscatter"
    read = functools.partial(read_raster, quantity=quantity)
    rasters = sources.rasters(group, raster_variables(quantity), read)
    if rasters:
        yield _PendingFigure(
            f"elastic_{group.instrument}_{group.channel}",
            f"Attenuated backscatter, clouds and background: {group.label};"
            f" {counted(len(rasters), 'scene')}.",
            sources.draw(product_figures.draw_backscatter, rasters, group.label),
        )
    profile = sources.read_first(group, PROFILE_VARIABLES, clearest_profile)
    if profile is not None:
        yield _PendingFigure(
            f"profile_{group.instrument}_{group.channel}",
            f"Profile with the most unflagged bins in a scene, and its error budget:"
            f" {group.label}.",
            sources.draw(product_figures.error_budget_figure, profile, group.label),
        )


def _multiangle(group: _Group, sources: _Sources) -> Iterator[_PendingFigure]:
    rasters = sources.rasters(group, EXTINCTION_VARIABLES, read_extinction)
    if rasters:
        yield _PendingFigure(
            f"multiangle_{group.instrument}_{group.channel}",
            f"Extinction over time and altitude: {group.label}; {counted(len(rasters), 'scene')}.",
            sources.draw(product_figures.draw_extinction, rasters, group.label),
        )
    clearest = functools.partial(clearest_cycle, instrument=group.instrument)
    profile = sources.read_first(group, CYCLE_VARIABLES, clearest, with_truth=True)
    if profile is not None:
        yield _PendingFigure(
            f"scan-profile_{group.instrument}_{group.channel}",
            f"Scan cycle with the most unflagged values in a scene: {group.label}.",
            sources.draw(product_figures.scan_profile, profile, group.label),
        )
    residuals = sources.read_first(group, RESIDUAL_VARIABLES, read_residuals)
    if residuals is not None:
        yield _PendingFigure(
            f"scan-residuals_{group.instrument}_{group.channel}",
            f"Residuals of the fit over zenith angle, mean over the cycles of a scene:"
            f" {group.label}.",
            sources.draw(product_figures.scan_residuals, residuals, group.label),
        )


def _flags(record: RunRecord, sources: _Sources) -> _PendingFigure | None:
    shares = _shares(record)
    if not shares:
        return None
    return _PendingFigure(
        "flags",
        "Share of values with each quality bit, by channel and product kind, over all scenes.",
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
    """Return for each quantity the number of values compared, within 1 and within 3 errors."""
    totals: dict[str, tuple[int, int, int]] = {}
    for item in compared:
        c = item.comparison
        if c.count:
            count, within_1, within_3 = totals.get(c.quantity, (0, 0, 0))
            totals[c.quantity] = (
                count + c.count,
                within_1 + round(c.within_1 * c.count),
                within_3 + round(c.within_3 * c.count),
            )
    return totals
