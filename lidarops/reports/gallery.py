"""The figures of a run: products are read, drawn, and compared with the truth.

A product that is missing or cannot be read never stops a report: it is named as a problem.
"""

from __future__ import annotations

import functools
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TypeVar

import xarray as xr

from lidarops.errors import ProductError
from lidarops.flags import Quality
from lidarops.records import ProductKind, ProductRecord, Role, RunRecord, SceneOutcome
from lidarops.reports import figures, network_figures, panels
from lidarops.reports.networks import (
    VertexSeries,
    instruments_of,
    join_vertices,
    read_map,
    read_vertices,
)
from lidarops.reports.profiles import clearest_profile
from lidarops.reports.raster import COLUMNS, Raster, read_raster
from lidarops.reports.record import write_atomically
from lidarops.reports.scans import clearest_cycle, read_extinction, read_residuals
from lidarops.reports.series import QUANTITIES, Comparison, Section, compare, join, read_sections
from lidarops.reports.words import counted

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
# What opening and reading a damaged or foreign file has been seen to raise.
_UNREADABLE: Final = (OSError, RuntimeError, ValueError, KeyError, IndexError, ProductError)

Found = TypeVar("Found")


@dataclass(frozen=True, slots=True)
class Picture:
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

    pictures: list[Picture] = field(default_factory=list)
    flags: Picture | None = None
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

    @property
    def label(self) -> str:
        return f"{self.instrument} \N{MIDDLE DOT} {self.channel}"


@dataclass(frozen=True, slots=True)
class _Drawn:
    name: str
    caption: str
    figure: figures.Rendered


def fill(record: RunRecord, folder: Path, *, limit: int = FIGURES) -> Gallery:
    """Draw the figures of a run into a folder.

    Parameters
    ----------
    record : RunRecord
    folder : Path
        Existing folder for the PNG files.
    limit : int, optional
        Most figures of products; comparisons with the truth are made for all.

    Returns
    -------
    Gallery
        One or more figures for every instrument and channel over all scenes.
    """
    gallery = Gallery()
    truth = _truth(record, gallery)
    taken: Counter[str] = Counter()
    for group in _groups(record):
        full = len(gallery.pictures) >= limit
        if full:
            gallery.undrawn.append(f"{group.label}, {group.kind}")
        for drawn in _draw(group, record, truth, gallery, full=full):
            name = _unique(drawn.name, taken)
            write_atomically(folder / name, drawn.figure.png)
            gallery.pictures.append(
                Picture(name, group.instrument, drawn.caption, drawn.figure.alt)
            )
    gallery.flags = _flags(record, folder)
    return gallery


def first_picture(record: RunRecord, folder: Path) -> Path | None:
    """Draw one figure of a run: of the first instrument and channel whose products are readable.

    Returns
    -------
    Path or None
        A PNG file in `folder`; None where no product can be drawn.
    """
    gallery = Gallery()
    truth = _truth(record, gallery)
    for group in _groups(record):
        for drawn in _draw(group, record, truth, gallery, full=False):
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / "quicklook.png"
            write_atomically(path, drawn.figure.png)
            return path
    return None


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
        group = _Group(kind, instrument, channel, tuple(found))
        ordered.append((_KINDS.index(kind), turn, instrument, channel, group))
    return [group for *_, group in sorted(ordered, key=lambda row: row[:4])]


def _draw(
    group: _Group, record: RunRecord, truth: xr.Dataset | None, gallery: Gallery, *, full: bool
) -> Iterator[_Drawn]:
    if group.kind is ProductKind.HOMOGENEOUS:
        if not full or truth is not None:
            yield from _homogeneous(group, record, truth, gallery, full=full)
    elif group.kind is ProductKind.VISIBILITY:
        yield from _visibility(group, record, truth, gallery, full=full)
    elif full:
        return
    elif group.kind is ProductKind.MULTIANGLE:
        yield from _multiangle(group, record, truth, gallery)
    elif group.kind is ProductKind.ELASTIC:
        yield from _elastic(group, record, gallery)
    else:
        yield from _signal(group, record, gallery)


def _homogeneous(
    group: _Group, record: RunRecord, truth: xr.Dataset | None, gallery: Gallery, *, full: bool
) -> Iterator[_Drawn]:
    found: list[Section] = []
    scenes = 0
    for scene, product in group.members:
        path = Path(record.products) / product.path
        paths = [item.path for item in scene.inputs if item.role is Role.SIGNAL]
        try:
            with _opened(path) as opened:
                found += read_sections(
                    opened,
                    truth,
                    instrument=group.instrument,
                    channel=group.channel,
                    paths=paths,
                    dark_subtracted=_dark_subtracted(scene, group.channel),
                )
            scenes += 1
        except _UNREADABLE as error:
            gallery.problems.append(Problem(product.path, _reason(path, error)))
    sections = [section for section in join(found) if section.time.size > 0]
    compared = [
        Compared(group.instrument, group.channel, comparison)
        for section in sections
        for quantity in QUANTITIES
        if (comparison := compare(section, quantity)) is not None
    ]
    gallery.compared += compared
    for first in range(0, 0 if full else len(sections), panels.SECTIONS):
        few = sections[first : first + panels.SECTIONS]
        where = f"{group.label}, {', '.join(section.label for section in few)}"
        yield _Drawn(
            f"homogeneous_{group.instrument}_{group.channel}",
            f"Extinction and background with their standard errors: {where};"
            f" {counted(scenes, 'scene')}.",
            figures.render(figures.draw_retrieval(few, title=group.label)),
        )
        if compared:
            yield _Drawn(
                f"truth_{group.instrument}_{group.channel}",
                f"Unflagged values against the truth of the simulation: {where}.",
                figures.render(figures.draw_comparison(few, title=group.label)),
            )


def _visibility(
    group: _Group, record: RunRecord, truth: xr.Dataset | None, gallery: Gallery, *, full: bool
) -> Iterator[_Drawn]:
    found: list[VertexSeries] = []
    for scene, product in group.members:
        path = Path(record.products) / product.path
        try:
            with _opened(path) as opened:
                found += read_vertices(opened, truth, instruments=instruments_of(scene))
        except _UNREADABLE as error:
            gallery.problems.append(Problem(product.path, _reason(path, error)))
    series = join_vertices(found)
    gallery.compared += [
        Compared(group.instrument, group.channel, comparison)
        for one in series
        if (comparison := compare(one, "extinction")) is not None
    ]
    if full or not series:
        return
    scene = group.members[0][0]
    network = _first(
        group, record, gallery, functools.partial(read_map, instruments=instruments_of(scene))
    )
    if network is not None:
        yield _Drawn(
            f"network_{group.instrument}_{group.channel}",
            f"Beams, and visibility where they meet: {group.label}.",
            figures.render(network_figures.draw_map(network, title=group.label)),
        )
    for first in range(0, len(series), network_figures.VERTICES):
        few = series[first : first + network_figures.VERTICES]
        yield _Drawn(
            f"visibility_{group.instrument}_{group.channel}",
            f"Visibility and extinction with their errors:"
            f" {group.label}, {', '.join(one.label for one in few)}.",
            figures.render(network_figures.draw_series(few, title=group.label)),
        )


def _dark_subtracted(scene: SceneOutcome, channel: str) -> bool:
    steps = scene.plan.steps if scene.plan else ()
    return any(step.name == _DARK_STEP and step.channel == channel for step in steps)


def _signal(group: _Group, record: RunRecord, gallery: Gallery) -> Iterator[_Drawn]:
    rasters = _rasters(group, record, gallery, read_raster)
    if rasters:
        yield _Drawn(
            f"signal_{group.instrument}_{group.channel}",
            f"Range-corrected signal and background: {group.label};"
            f" {counted(len(rasters), 'scene')}.",
            figures.render(figures.draw_quicklook(rasters, title=group.label)),
        )


def _elastic(group: _Group, record: RunRecord, gallery: Gallery) -> Iterator[_Drawn]:
    read = functools.partial(read_raster, quantity="attenuated_backscatter")
    rasters = _rasters(group, record, gallery, read)
    if rasters:
        yield _Drawn(
            f"elastic_{group.instrument}_{group.channel}",
            f"Attenuated backscatter, clouds and background: {group.label};"
            f" {counted(len(rasters), 'scene')}.",
            figures.render(figures.draw_backscatter(rasters, title=group.label)),
        )
    profile = _first(group, record, gallery, clearest_profile)
    if profile is not None:
        yield _Drawn(
            f"profile_{group.instrument}_{group.channel}",
            f"The profile of a scene with most unflagged gates, and its error budget:"
            f" {group.label}.",
            figures.render(figures.error_budget(profile, title=group.label)),
        )


def _multiangle(
    group: _Group, record: RunRecord, truth: xr.Dataset | None, gallery: Gallery
) -> Iterator[_Drawn]:
    rasters = _rasters(group, record, gallery, read_extinction)
    if rasters:
        yield _Drawn(
            f"multiangle_{group.instrument}_{group.channel}",
            f"Extinction over time and altitude: {group.label}; {counted(len(rasters), 'scene')}.",
            figures.render(figures.draw_extinction(rasters, title=group.label)),
        )
    clearest = functools.partial(clearest_cycle, truth=truth, instrument=group.instrument)
    profile = _first(group, record, gallery, clearest)
    if profile is not None:
        yield _Drawn(
            f"scan-profile_{group.instrument}_{group.channel}",
            f"The cycle of a scene with most unflagged values: {group.label}.",
            figures.render(figures.scan_profile(profile, title=group.label)),
        )
    residuals = _first(group, record, gallery, read_residuals)
    if residuals is not None:
        yield _Drawn(
            f"scan-residuals_{group.instrument}_{group.channel}",
            f"What the fit over angles leaves of the signal, mean of the cycles of a scene:"
            f" {group.label}.",
            figures.render(figures.scan_residuals(residuals, title=group.label)),
        )


def _first(
    group: _Group,
    record: RunRecord,
    gallery: Gallery,
    read: Callable[[xr.Dataset], Found | None],
) -> Found | None:
    """Return what is read of the first product of a group that has it."""
    told = {problem.path for problem in gallery.problems}
    for _, product in group.members:
        path = Path(record.products) / product.path
        try:
            with _opened(path) as opened:
                found = read(opened)
        except _UNREADABLE as error:
            if product.path not in told:
                gallery.problems.append(Problem(product.path, _reason(path, error)))
            continue
        if found is not None:
            return found
    return None


def _rasters(
    group: _Group, record: RunRecord, gallery: Gallery, read: Callable[..., Raster]
) -> list[Raster]:
    root = Path(record.products)
    sizes: dict[str, int] = {}
    for _, product in group.members:
        try:
            with _opened(root / product.path) as opened:
                sizes[product.path] = opened.sizes.get("time", 0)
        except _UNREADABLE as error:
            reason = _reason(root / product.path, error)
            gallery.problems.append(Problem(product.path, reason))
    rasters: list[Raster] = []
    profiles = -(-sum(sizes.values()) // COLUMNS)
    for path in sizes:
        try:
            with _opened(root / path) as opened:
                rasters.append(read(opened, profiles=profiles))
        except _UNREADABLE as error:
            gallery.problems.append(Problem(path, _reason(root / path, error)))
    return rasters


def _flags(record: RunRecord, folder: Path) -> Picture | None:
    shares = _shares(record)
    if not shares:
        return None
    rendered = figures.render(figures.flags_overview(shares, title="Flagged values"))
    name = "flags.png"
    write_atomically(folder / name, rendered.png)
    caption = "Share of the values of every product that carry a quality bit, over all scenes."
    return Picture(name, "", caption, rendered.alt)


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


def _truth(record: RunRecord, gallery: Gallery) -> xr.Dataset | None:
    if not record.truth:
        return None
    path = Path(record.truth)
    try:
        with _opened(path) as opened:
            truth: xr.Dataset = opened.load()
        for name in ("path", "instrument", "time", "extinction"):
            if name not in truth.variables or truth[name].dims != ("granule",):
                raise ProductError("is not a variable along granule", field=name)
    except _UNREADABLE as error:
        gallery.problems.append(Problem(record.truth, _reason(path, error)))
        return None
    return truth


def _opened(path: Path) -> xr.Dataset:
    if not path.is_file():
        raise ProductError("the file is missing")
    return xr.open_dataset(path, engine="netcdf4", decode_timedelta=False)


def _reason(path: Path, error: BaseException) -> str:
    # The path stands beside the reason: no need to have it twice, in full.
    words = str(error).replace(str(path), path.name)
    return words or type(error).__name__


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
