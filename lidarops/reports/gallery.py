"""The figures of a run's report: reads products, draws them, compares them with the truth.

A missing or unreadable product does not stop the report; it is listed as a problem.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import xarray as xr

from lidarops.errors import ProductError
from lidarops.figures.any_kind import views_of
from lidarops.figures.kind_figures import View
from lidarops.figures.panels import Figure
from lidarops.figures.product_names import attribute, light_in_words
from lidarops.figures.wording import counted
from lidarops.flags import Severity
from lidarops.kinds import flags_of, kinds, rank_of
from lidarops.netcdf.read import UNREADABLE, opened_product
from lidarops.netcdf.variables import is_retrieved
from lidarops.records import ProductRecord, RunRecord, SceneOutcome
from lidarops.reports.reading import Compared, Group, Problem, Readers, Sources, reason

FIGURES: Final = 40
"""Most figures of products in a report."""
_FLAG_ROWS: Final = 40


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
    with Readers(workers, products, truth) as readers:
        sources = Sources(readers, gallery.problems)
        for group in _groups(record):
            full = len(gallery.pictures) >= limit
            if full:
                gallery.undrawn.append(f"{group.label}, {group.kind}")
            for view in views_of(group.kind):
                compares = truth is not None and view.compare is not None
                contents = list(sources.read(group, view)) if compares or not full else []
                if contents and compares:
                    gallery.compared += _compared(view, contents, group)
                for drawn in view.draw(contents) if contents and not full else ():
                    gallery.pictures.append(_picture(view.name, drawn, group))
    return gallery


def _compared(view: View[Any], contents: Sequence[Any], group: Group) -> Iterator[Compared]:
    for comparison in view.compare(contents) if view.compare else ():
        if comparison is not None:
            yield Compared(group.instrument, group.channel, comparison)


def _picture(view: str, drawn: Figure, group: Group) -> Picture:
    scenes = counted(len(group.members), "scene")
    words = f"{scenes}. {drawn.words}."
    caption = f"{drawn.caption}: {_title(group)}"
    return Picture(view, drawn, group.instrument, caption, group.lacking, words)


def _title(group: Group) -> str:
    """Return channel and instrument as people call them, by the first product that can be read."""
    for _, product in group.members:
        try:
            with opened_product(group.root / product.path) as opened:
                name = attribute(opened, "instrument", group.instrument)
                return f"{light_in_words(opened) or group.channel}, {name}"
        except ProductError:
            continue
    return group.label


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
        gallery.problems.append(Problem(record.truth, reason(path, error)))
        return None
    return truth


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
