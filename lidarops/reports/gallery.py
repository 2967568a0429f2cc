"""The figures of a run's report: reads products, draws them, compares them with the truth.

A missing or unreadable product does not stop the report; it is listed as a problem. Products are
read in one process or several; figures and their order do not depend on the number.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, groupby
from pathlib import Path
from typing import Any, Final, NamedTuple

import xarray as xr

from lidarops.errors import ProductError
from lidarops.figures.any_kind import views_of
from lidarops.figures.kind_figures import ProductSource, View
from lidarops.figures.panels import Figure
from lidarops.figures.product_names import attribute, light_in_words
from lidarops.figures.raster import COLUMNS
from lidarops.figures.series_data import Comparison
from lidarops.figures.wording import counted, named_shares, percent
from lidarops.flags import Severity
from lidarops.kinds import flags_of, kinds, rank_of
from lidarops.netcdf.read import UNREADABLE, open_product, opened_product, profiles_in
from lidarops.netcdf.variables import is_retrieved
from lidarops.records import ProductRecord, RunRecord, SceneOutcome
from lidarops.system.processes import CRASHED, Processes

FIGURES: Final = 40
"""Most figures of products in a report."""
FEWEST: Final = 50
"""Fewest products per process for which starting the process pays."""
_FLAG_ROWS: Final = 40
_AT_A_TIME: Final = 8
"""Products sent to a process together, so that it waits less."""
_DAMAGE: Final = ArithmeticError, LookupError, MemoryError, RuntimeError, ValueError
_UNREADABLE: Final = *_DAMAGE, ProductError
"""What values of a damaged product may raise; other errors are those of the program."""


_Item = tuple[str, ProductSource]
"""A product by its path, and what is known about it, without the truth."""
_Task = Callable[[Path, ProductSource], Any]


class Problem(NamedTuple):
    """A file that could not be used for the report."""

    path: str
    reason: str


class Compared(NamedTuple):
    """A comparison with the truth, with its instrument and channel."""

    instrument: str
    channel: str
    comparison: Comparison


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
        return named_shares(rejecting, sum(product.values for product in products))


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A figure of the report, equal to itself only, because arrays have no single equality."""

    view: str
    """Name of the view that drew it."""
    figure: Figure
    instrument: str
    caption: str
    lacking: str
    """Why its products have no usable value; empty if they have."""
    words: str
    """Description, with channel and number of scenes."""


@dataclass(slots=True)
class Gallery:
    """Figures, comparisons and problems from the products of a run."""

    pictures: list[Picture] = field(default_factory=list)
    flags: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Label of channel and kind -> name of a bit, with * where it asks for care -> share."""
    compared: list[Compared] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)
    undrawn: list[str] = field(default_factory=list)
    """Labels of channels that are not drawn because of the limit on figures."""


def fill(record: RunRecord, *, limit: int = FIGURES, workers: int = 1) -> Gallery:
    """Return the figures of a run.

    Parameters
    ----------
    record : RunRecord
    limit : int, optional
        Most figures of products. Comparisons with the truth are made for all products.
    workers : int, optional
        Most processes that read. The figures do not depend on it.

    Returns
    -------
    Gallery
        One or more figures per instrument and channel, over all scenes.
    """
    gallery = Gallery(flags=_shares(record))
    truth = _truth(record, gallery)
    products = sum(len(scene.products) for scene in record.scenes)
    with Processes(min(workers, products // FEWEST), truth) as processes:
        for group in _groups(record):
            full = len(gallery.pictures) >= limit
            if full:
                gallery.undrawn.append(f"{group.label}, {group.kind}")
            for view in views_of(group.kind):
                compares = truth is not None and view.compare is not None
                if full and not compares:
                    continue
                contents = list(_read(processes, group, view, gallery.problems))
                if contents and compares:
                    gallery.compared += _compared(view, contents, group)
                for drawn in view.draw(contents) if contents and not full else ():
                    title = _title(group, {problem.path for problem in gallery.problems})
                    gallery.pictures.append(_picture(view.name, drawn, group, title))
    return gallery


def _read(
    processes: Processes[xr.Dataset | None],
    group: Group,
    view: View[Any],
    problems: list[Problem],
) -> Iterator[Any]:
    """Yield what a view shows of every readable product of a group, or of the first."""
    source = ProductSource(group.instrument, group.channel)
    items = [(product.path, replace(source, scene=scene)) for scene, product in group.members]

    def each(task: _Task, items: Sequence[_Item]) -> Iterator[tuple[_Item, Any]]:
        """Yield what a task returns of each product; note those that it fails on."""
        called = partial(processes.map_items, partial(_guarded, task, group.root), lost=_crashed)
        # None ahead where mostly the first one is enough.
        results = (
            chain.from_iterable(called([item], at_a_time=1, fewest=1) for item in items)
            if view.first
            else called(items, at_a_time=_AT_A_TIME)
        )
        for item, (content, reason) in results:
            if not reason:
                yield item, content
            elif all(problem.path != item[0] for problem in problems):
                problems.append(Problem(item[0], reason))

    if view.shows:
        # All products get the same resolution, which follows from their total length.
        known = list(each(_length, items))
        profiles = -(-sum(length for _, length in known) // COLUMNS)
        items = [(path, replace(own, profiles=profiles)) for (path, own), _ in known]
    for _, content in each(partial(_content, view.variables, view.read), items):
        if content is not None:
            yield content
            if view.first:
                return


def _guarded(task: _Task, root: Path, truth: xr.Dataset | None, item: _Item) -> tuple[Any, str]:
    """Return what a task returns of a product, or why the product cannot be read."""
    path, source = item
    try:
        return task(root / path, replace(source, truth=truth)), ""
    except _UNREADABLE as error:
        return None, _reason(root / path, error)


def _crashed(_: _Item) -> tuple[Any, str]:
    return None, CRASHED


def _length(file: Path, _: ProductSource) -> int:
    return profiles_in(file)


def _content(
    names: tuple[str, ...],
    read: Callable[[xr.Dataset, ProductSource], Any],
    file: Path,
    source: ProductSource,
) -> Any:
    with open_product(file, names) as product:
        return read(product, source)


def _reason(path: Path, error: BaseException) -> str:
    """Return the message of an error without the path, which is shown beside it."""
    words = str(error).removeprefix(f"{path}: ").replace(str(path), path.name)
    return words or type(error).__name__


def _compared(view: View[Any], contents: Sequence[Any], group: Group) -> Iterator[Compared]:
    for comparison in view.compare(contents) if view.compare else ():
        if comparison is not None:
            yield Compared(group.instrument, group.channel, comparison)


def _picture(view: str, drawn: Figure, group: Group, title: str) -> Picture:
    scenes = counted(len(group.members), "scene")
    words = f"{scenes}. {drawn.words}."
    caption = f"{drawn.caption}: {title}"
    return Picture(view, drawn, group.instrument, caption, group.lacking, words)


def _title(group: Group, unreadable: Collection[str]) -> str:
    """Return channel and instrument as people call them, by the first product that can be read."""
    for _, product in group.members:
        # What crashed another process would crash this one.
        if product.path in unreadable:
            continue
        try:
            with opened_product(group.root / product.path) as opened:
                name = attribute(opened, "instrument", group.instrument)
                return f"{light_in_words(opened) or group.channel}, {name}"
        except ProductError:
            continue
    return group.label


def _groups(record: RunRecord) -> list[Group]:
    """Return the groups in the order in which an operator looks at them.

    First one quicklook of each instrument, then what is retrieved, by kind and with the first
    channel of every instrument first, then the other signals, and last what has no usable value.
    """
    members: dict[tuple[str, str, str], list[tuple[SceneOutcome, ProductRecord]]]
    members = defaultdict(list)
    for scene in record.scenes:
        for product in scene.products:
            members[product.kind, scene.instrument, product.channel].append((scene, product))
    groups = [Group(*key, tuple(rows), Path(record.products)) for key, rows in members.items()]
    groups.sort(key=lambda group: (group.instrument, -group.good, group.channel))
    signals = [group for group in groups if not is_retrieved(group.kind)]
    quicklooks = [next(first) for _, first in groupby(signals, lambda group: group.instrument)]
    turns: Counter[tuple[str, str]] = Counter()
    placed = []
    for group in sorted(groups, key=lambda group: group.channel):
        stage = 1 if is_retrieved(group.kind) else 0 if group in quicklooks else 2
        turns[group.kind, group.instrument] += 1
        turn = turns[group.kind, group.instrument], group.instrument
        place = bool(group.lacking), stage, rank_of(group.kind), group.kind, turn
        placed.append((place, group))
    return [group for _, group in sorted(placed, key=lambda pair: pair[0])]


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
    names = [
        name
        for name in sorted(order, key=lambda name: order[name])
        if any(row.get(name) for row in rows.values())
    ]
    return {
        label: {name: rows[label][name] for name in names} for label in sorted(worst[:_FLAG_ROWS])
    }


def _truth(record: RunRecord, gallery: Gallery) -> xr.Dataset | None:
    if not record.truth:
        return None
    path = Path(record.truth)
    try:
        if not path.is_file():
            raise ProductError("the file is missing")
        with opened_product(path, decode_timedelta=False) as opened:
            truth = opened.load()
        for name in ("path", "instrument", "time", "total_extinction"):
            if name not in truth.variables or truth[name].dims != ("granule",):
                raise ProductError("is not a variable along granule", field=name)
    except UNREADABLE as error:
        gallery.problems.append(Problem(record.truth, _reason(path, error)))
        return None
    return truth


def compared_in_words(compared: Sequence[Compared]) -> Mapping[str, str]:
    """Return for each quantity the shares of its values within 1 and 3 errors of the truth."""
    totals: dict[str, Counter[str]] = defaultdict(Counter)
    for _, _, one in compared:
        total = totals[one.quantity]
        total["all"] += one.count
        if one.count:
            total["1"] += round(one.within_1 * one.count)
            total["3"] += round(one.within_3 * one.count)
    return {
        quantity: f"{percent(total['1'] / total['all'])} within 1 and"
        f" {percent(total['3'] / total['all'])} within 3 standard errors of the truth, of"
        f" {total['all']:,} unflagged values"
        for quantity, total in totals.items()
        if total["all"]
    }
