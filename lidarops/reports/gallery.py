"""The figures of a run's report: reads products and draws them.

A missing or unreadable product does not stop the report; it is listed as a problem. Products are
read in one process or several; figures and their order do not depend on the number.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, groupby
from pathlib import Path
from typing import Any, Final

import xarray as xr

from lidarops.errors import ProductError
from lidarops.figures.kind_figures import View, views_of
from lidarops.figures.panels import Figure
from lidarops.figures.product_names import attribute, light_in_words
from lidarops.figures.raster import COLUMNS, Kept
from lidarops.figures.wording import counted, named_shares
from lidarops.flags import Severity
from lidarops.kinds import flags_of, kinds, rank_of
from lidarops.netcdf.read import open_product
from lidarops.netcdf.stored import reading
from lidarops.netcdf.variables import is_retrieved
from lidarops.records import ProductRecord, RunRecord
from lidarops.system.processes import CRASHED, Processes

FIGURES: Final = 40
"""Most figures of products in a report."""
FEWEST: Final = 50
"""Fewest products per process for which starting the process pays."""
_AT_A_TIME: Final = 8
"""Products sent to a process together, so that it waits less."""
_DAMAGE: Final = ArithmeticError, LookupError, MemoryError, RuntimeError, ValueError
_UNREADABLE: Final = *_DAMAGE, ProductError
"""What values of a damaged product may raise; other errors are those of the program."""


_Read = Callable[[Path], Any]


@dataclass(frozen=True, slots=True)
class Group:
    """All products of one kind, instrument and channel in a run."""

    kind: str
    instrument: str
    channel: str
    products: tuple[ProductRecord, ...]
    root: Path
    """Folder that product paths are relative to."""

    @property
    def label(self) -> str:
        """Instrument and channel, for titles."""
        return f"{self.instrument} \N{MIDDLE DOT} {self.channel}"

    @property
    def good(self) -> float:
        """Share of values without a quality bit."""
        values = sum(product.values for product in self.products)
        return sum(product.unflagged for product in self.products) / values if values else 0.0

    @property
    def lacking(self) -> str:
        """Why no value is usable: the rejecting bits that most values carry; empty if one is."""
        if self.kind not in kinds() or any(product.usable != 0 for product in self.products):
            return ""
        known, counts = flags_of(self.kind), Counter[str]()
        for product in self.products:
            counts.update(product.flagged)
        rejecting = (
            (bit.description, count)
            for name, count in counts.items()
            if (bit := known.named(name)) is not None and bit.severity is Severity.REJECT
        )
        return named_shares(rejecting, sum(product.values for product in self.products))


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A figure of the report, equal to itself only, because arrays have no single equality."""

    figure: Figure
    instrument: str
    caption: str
    lacking: str
    """Why its products have no usable value; empty if they have."""
    words: str
    """Description, with channel and number of scenes."""


@dataclass(slots=True)
class Gallery:
    """Figures and problems from the products of a run."""

    pictures: list[Picture] = field(default_factory=list)
    problems: dict[str, str] = field(default_factory=dict)
    """Files that could not be used for the report, with the reason."""
    undrawn: list[str] = field(default_factory=list)
    """Labels of channels that are not drawn because of the limit on figures."""


def fill(record: RunRecord, *, limit: int = FIGURES, workers: int = 1) -> Gallery:
    """Return the figures of a run.

    Parameters
    ----------
    record : RunRecord
    limit : int, optional
        Most figures of products.
    workers : int, optional
        Most processes that read. The figures do not depend on it.

    Returns
    -------
    Gallery
        One or more figures per instrument and channel, over all scenes.
    """
    gallery = Gallery()
    products = sum(len(scene.products) for scene in record.scenes)
    with Processes(min(workers, products // FEWEST), None) as processes:
        for group in _groups(record):
            if len(gallery.pictures) >= limit:
                gallery.undrawn.append(f"{group.label}, {group.kind}")
                continue
            for view in views_of(group.kind):
                contents = Kept(_read(processes, group, view, gallery.problems))
                if contents:
                    title = _title(group, gallery.problems)
                    gallery.pictures += [_picture(one, group, title) for one in view.draw(contents)]
    return gallery


def _read(
    processes: Processes[None], group: Group, view: View[Any], problems: dict[str, str]
) -> Iterator[Any]:
    """Yield what a view shows of every readable product of a group, or of the first."""
    # All products of a group share the columns of an image.
    columns = max(COLUMNS // len(group.products), 1)
    paths = [product.path for product in group.products]
    read = partial(_content, view.variables, view.read, columns)
    guarded = partial(_guarded, read, group.root)
    called = partial(processes.map_items, guarded, lost=_crashed)
    # None ahead where mostly the first one is enough.
    results = (
        chain.from_iterable(called([path], at_a_time=1, fewest=1) for path in paths)
        if view.first
        else called(paths, at_a_time=_AT_A_TIME)
    )
    for path, (content, reason) in results:
        if reason:
            problems.setdefault(path, reason)
        elif content is not None:
            yield content
            if view.first:
                return


def _guarded(read: _Read, root: Path, _: None, path: str) -> tuple[Any, str]:
    """Return what a view reads of a product, or why the product cannot be read."""
    try:
        return read(root / path), ""
    except _UNREADABLE as error:
        return None, _reason(root / path, error)


def _crashed(_: str) -> tuple[Any, str]:
    return None, CRASHED


def _content(
    names: tuple[str, ...],
    read: Callable[[xr.Dataset, int], Any],
    columns: int,
    file: Path,
) -> Any:
    with open_product(file, names) as product:
        return read(product, columns)


def _reason(path: Path, error: BaseException) -> str:
    """Return the message of an error without the path, which is shown beside it."""
    words = str(error).removeprefix(f"{path}: ").replace(str(path), path.name)
    return words or type(error).__name__


def _picture(drawn: Figure, group: Group, title: str) -> Picture:
    words = f"{counted(len(group.products), 'scene')}. {drawn.words}."
    return Picture(drawn, group.instrument, f"{drawn.caption}: {title}", group.lacking, words)


def _title(group: Group, unreadable: Collection[str]) -> str:
    """Return channel and instrument as people call them, by the first product that can be read."""
    # What crashed another process would crash this one.
    for path in (one.path for one in group.products if one.path not in unreadable):
        file = group.root / path
        with suppress(ProductError), reading(file), open_product(file, ["wavelength"]) as opened:
            name = attribute(opened, "instrument", group.instrument)
            return f"{light_in_words(opened) or group.channel}, {name}"
    return group.label


def _groups(record: RunRecord) -> list[Group]:
    """Return the groups in the order in which an operator looks at them.

    First one quicklook of each instrument, then what is retrieved, by kind and with the first
    channel of every instrument first, then the other signals, and last what has no usable value.
    """
    products: dict[tuple[str, str, str], list[ProductRecord]] = defaultdict(list)
    for scene in record.scenes:
        for product in scene.products:
            products[product.kind, scene.instrument, product.channel].append(product)
    groups = [Group(*key, tuple(own), Path(record.products)) for key, own in products.items()]
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
