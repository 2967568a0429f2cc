"""The figures of a run's report: reads products, draws them, compares them with the truth.

A missing or unreadable product does not stop the report; it is listed as a problem.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import xarray as xr

from lidarops.errors import ProductError
from lidarops.figures import any_kind_report, product_figures
from lidarops.figures.kind_figures import ReportFigure, report_figures_of
from lidarops.figures.reading import UNREADABLE, Readers, reason
from lidarops.figures.report_sources import Compared, Group, Problem, Sources
from lidarops.flags import Severity
from lidarops.kinds import flags_of, kinds, rank_of
from lidarops.records import ProductRecord, RunRecord, SceneOutcome
from lidarops.system.files import write_atomically

FIGURES: Final = 40
"""Most figures of products in a report."""
_FLAG_ROWS: Final = 40


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of the report."""

    file: str
    """File name in the report folder."""
    instrument: str
    caption: str
    alt: str


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
class _PendingFigure:
    """A figure that is being drawn."""

    name: str
    """Start of its file name."""
    instrument: str
    caption: str
    rendered: Callable[[], product_figures.Rendered]
    """Returns the figure once it is drawn."""


class _Album:
    """Writes figures to files in their order; a bounded number is drawn at the same time."""

    def __init__(self, folder: Path, readers: Readers) -> None:
        self.pictures: list[Figure] = []
        self._folder = folder
        self._readers = readers
        self._waiting: deque[_PendingFigure] = deque()
        self._taken: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self.pictures) + len(self._waiting)

    def add(self, figure: ReportFigure, group: Group) -> None:
        name = f"{figure.name}_{group.instrument}_{group.channel}"
        self._waiting.append(_started(self._readers, figure, group.label, name, group.instrument))
        # Bounded, because the data of a figure stay in memory until it is drawn.
        self._keep(self._readers.processes)

    def finish(self) -> list[Figure]:
        self._keep(0)
        return self.pictures

    def _keep(self, ahead: int) -> None:
        while len(self._waiting) > ahead:
            figure = self._waiting.popleft()
            self.pictures.append(_written(self._folder, figure, _unique(figure.name, self._taken)))


def _started(
    readers: Readers, figure: ReportFigure, title: str, name: str, instrument: str
) -> _PendingFigure:
    """Start to draw a figure, in another process if there is one."""
    sketch = product_figures.Sketch(figure.draw, figure.content, title)
    rendered = readers.later(product_figures.draw_figure, sketch)
    return _PendingFigure(name, instrument, figure.caption, rendered)


def _written(folder: Path, figure: _PendingFigure, file: str) -> Figure:
    rendered = figure.rendered()
    write_atomically(folder / file, rendered.png)
    return Figure(file, figure.instrument, figure.caption, rendered.alt)


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
        flags = _flags(record, sources.readers)
        album = _Album(folder, sources.readers)
        for group in _groups(record):
            full = len(album) >= limit
            if full:
                gallery.undrawn.append(f"{group.label}, {group.kind}")
            for figure in _draw(group, sources, full=full):
                album.add(figure, group)
        gallery.pictures = album.finish()
        if flags is not None:
            gallery.flags = _written(folder, flags, f"{flags.name}.png")
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


def _groups(record: RunRecord) -> list[Group]:
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
        group = Group(kind, instrument, channel, tuple(products), Path(record.products))
        ordered.append((rank_of(kind), kind, turn, instrument, channel, group))
    return [group for *_, group in sorted(ordered, key=lambda row: row[:5])]


def _draw(group: Group, sources: Sources, *, full: bool) -> Iterator[ReportFigure]:
    """Yield the figures of a group; none if the report is full, but compare with the truth."""
    report = report_figures_of(group.kind) or any_kind_report.REPORT
    figures = report.figures(group, sources)
    if not full:
        yield from figures
    elif report.compares and sources.truth is not None:
        # All comparisons are made before the first figure.
        next(figures, None)


def _flags(record: RunRecord, readers: Readers) -> _PendingFigure | None:
    shares = _shares(record)
    if not shares:
        return None
    caption = "Share of values with each quality bit, by channel and product kind, over all scenes."
    figure = ReportFigure("flags", caption, product_figures.flags_overview, shares)
    return _started(readers, figure, "Flagged values", figure.name, "")


def _shares(record: RunRecord) -> Mapping[str, Mapping[str, float]]:
    """Return label -> name of a bit, with * where it asks for care only -> share, by place."""
    values: Counter[str] = Counter()
    order: dict[str, int] = {}
    carried: dict[str, Counter[str]] = defaultdict(Counter)
    for group in _groups(record):
        label = f"{group.label}, {group.kind}"
        for _, product in group.members:
            values[label] += product.values
            flags = flags_of(group.kind) if group.kind in kinds() else None
            for name, count in product.flagged.items():
                bit = flags.named(name) if flags is not None else None
                if bit is not None:
                    shown = bit.word if bit.severity is Severity.REJECT else f"{bit.word} *"
                    order.setdefault(shown, int(bit))
                    carried[label][shown] += count
    rows = {
        label: {
            bit: carried[label][bit] / values[label]
            for bit in sorted(order, key=lambda name: order[name])
        }
        for label in values
        if values[label] > 0
    }
    worst = sorted(rows, key=lambda label: -max(rows[label].values(), default=0.0))
    return {label: rows[label] for label in sorted(worst[:_FLAG_ROWS])}


@contextmanager
def _sources(record: RunRecord, gallery: Gallery, workers: int) -> Iterator[Sources]:
    truth = _truth(record, gallery)
    products = sum(len(scene.products) for scene in record.scenes)
    with Readers(workers, products, truth) as readers:
        yield Sources(readers, truth, gallery.compared, gallery.problems)


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
