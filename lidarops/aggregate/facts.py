"""Facts of a product that aggregates need, from its file; what users choose; groups of products."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from enum import StrEnum
from functools import cache
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from lidarops.errors import ProductError, RetrievalInputError
from lidarops.kinds import kinds
from lidarops.netcdf.stored import (
    StoredProduct,
    changed,
    open_stored,
    reading,
)
from lidarops.netcdf.stored_flags import FlagCounter, all_bits, flags_names, rejecting_mask
from lidarops.netcdf.variables import PROVENANCE, RECORDERS, layout_of
from lidarops.records import DetectionMode, Verdicts, mode_of_signal
from lidarops.system.files import product_paths, sha256_of, within

NAMES: Final = ("kind", "station", "instrument", "channel")


class Period(StrEnum):
    """Period of a mean: a calendar day or month, UTC."""

    DAY = "day"
    MONTH = "month"

    @property
    def unit(self) -> str:
        """Unit of numpy and of durations in ISO 8601."""
        return self.value[0].upper()


class Weights(StrEnum):
    """Weights of profiles in a mean."""

    SHOTS = "shots"
    """Number of laser shots: a profile of a few shots counts less than a whole one."""
    PLAIN = "plain"
    """Equal weights."""
    INVERSE_VARIANCE = "inverse-variance"
    """Inverse squares of the standard errors."""

    @property
    def description(self) -> str:
        """Description for the attributes of a file."""
        return {
            "shots": "usable profiles are weighted by their number of laser shots",
            "plain": "usable profiles have equal weights",
            "inverse-variance": "usable profiles have the weights 1 / standard_error^2",
        }[self.value]


@dataclass(frozen=True, slots=True)
class ProductSelection:
    """Selection of products; None selects all."""

    kind: str | None = None
    channel: str | None = None
    station: str | None = None
    instrument: str | None = None
    since: datetime | None = None
    """Select products that end after this time."""
    until: datetime | None = None
    """Select products that start before this time."""

    @property
    def names(self) -> dict[str, str]:
        """Names that a product must have, by what they name."""
        names = {name: getattr(self, name) for name in NAMES}
        return {name: value for name, value in names.items() if value is not None}

    def admits(self, stated: Mapping[str, str], start: datetime, stop: datetime) -> bool:
        """Return whether a product with these names and times is selected."""
        return (
            all(stated.get(name) == value for name, value in self.names.items())
            and (self.since is None or stop > self.since)
            and (self.until is None or start < self.until)
        )


EVERYTHING: Final = ProductSelection()


def parse_selection(
    kind: str | None,
    channel: str | None,
    station: str | None,
    instrument: str | None,
    since: datetime | str | None,
    until: datetime | str | None,
) -> ProductSelection:
    """Return a selection from names and times.

    Raises
    ------
    RetrievalInputError
        If the kind is unknown or a time is not ISO 8601.
    """
    if kind is not None and kind not in kinds():
        raise RetrievalInputError(
            f"is {kind!r}", field="kind", remedy=f"choose one of {', '.join(kinds())}"
        )
    times = (_parse_time(since, "since"), _parse_time(until, "until"))
    return ProductSelection(kind, channel, station, instrument, *times)


def _parse_time(text: datetime | str | None, name: str) -> datetime | None:
    """Return a time; without a time zone it is UTC."""
    if text is None:
        return None
    try:
        time = text if isinstance(text, datetime) else datetime.fromisoformat(text)
    except ValueError as error:
        raise RetrievalInputError(
            f"is {text!r}", field=name, remedy="give a time such as 2026-03-01T12:00"
        ) from error
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)


FOLDER: Final = "aggregates"
"""Folder of aggregates beside the products."""
PERIOD: Final = "lidarops_period"
"""Global attribute that only means have, not products."""
UNSHARED: Final = frozenset({PROVENANCE.name, "station", "quantization_info"})
"""Variables of single products that aggregates do not contain."""

_SCHEMA_ATTRIBUTES: Final = ("units", "standard_name", "flag_masks", "flag_meanings")
_GRID_DIGITS: Final = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """What a product states of itself."""

    path: str
    """Relative to the folder of the aggregate's products, with forward slashes."""
    id: str
    kind: str
    station: str
    instrument: str
    channel: str
    mode: str
    """analog, photon, or glued of both."""
    start: datetime
    """Start of the first profile."""
    stop: datetime
    profiles: int
    grid: str
    """Digest of what must be equal in products that are joined along time."""
    recorder: str = ""
    """What digitised its channels; empty where the raw files name none. Part of the grid."""

    @property
    def names(self) -> dict[str, str]:
        """Values of `NAMES`."""
        return {name: getattr(self, name) for name in NAMES}

    @property
    def counting(self) -> DetectionMode:
        """How the signal is stated: glued ones as counted."""
        return mode_of_signal(self.channel, self.mode)

    @property
    def group(self) -> Group:
        """Group of products that this one can be joined with."""
        return Group(*(getattr(self, name) for name in Group._fields))

    @contextmanager
    def opened(self, root: Path) -> Iterator[StoredProduct]:
        """Open the product of this header, of a root; what else is raised meanwhile passes.

        Raises
        ------
        ProductError
            If it cannot be read, or is another product now.
        """
        file = within(root, self.path)
        with open_stored(file) as product:
            with reading(file):
                if product.attrs.get("id") != self.id:
                    raise changed(self.path)
            yield product


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts(Header):
    """Facts of one product, with numbers of its values."""

    campaign: str
    wavelength: float
    """m; NaN if unknown."""
    latitude: float
    """degree, of the station; mean over the stations of a network."""
    longitude: float
    altitude: float
    """m above the geoid, of the station or mean over the network."""
    sha256: str
    size: int
    verdicts: Verdicts
    """Of the values of ``quality_flag``."""
    code_version: str
    flagged: Mapping[str, int] = field(default_factory=dict)
    """Quality bit name -> number of values that carry it, if any."""


_Stated = TypeVar("_Stated", bound=Header)


class Group(NamedTuple):
    """Products that can be joined along time: one instrument, kind, channel and grid."""

    station: str
    instrument: str
    kind: str
    channel: str
    grid: str
    recorder: str = ""

    @property
    def grid_words(self) -> str:
        """The grid, with the recorder where it is known."""
        return self.grid[:8] + (f" of recorder {self.recorder}" if self.recorder else "")

    @property
    def words(self) -> str:
        """The group in words, to select it by."""
        return f"{' '.join(self[:4])} grid {self.grid_words}"

    @property
    def name(self) -> str:
        """Name of the group in file names."""
        return f"{self.station}_{self.instrument}_{self.kind}_{self.channel}_{self.grid[:8]}"


@dataclass(frozen=True, slots=True)
class Refused:
    """A file that is not a readable product."""

    path: str
    reason: str


def list_products(root: Path) -> list[str]:
    """List the NetCDF files of an output folder or a folder of products.

    Parameters
    ----------
    root : path
        Output of a campaign, of which only ``products`` is searched, or a folder of products.
        Hidden files and the folder ``aggregates`` are left out.

    Returns
    -------
    list of str
        Relative to `root`, sorted.

    Raises
    ------
    ProductError
        If the folder does not exist.
    """
    if not root.is_dir():
        raise ProductError(
            "is not a folder", file=root, remedy="give the folder of products", wrong_use=True
        )
    if (root / "products").is_dir():
        return [f"products/{path}" for path in product_paths(root / "products")]
    return [path for path in product_paths(root) if not path.startswith(f"{FOLDER}/")]


def read_product_facts(
    root: Path, path: str, selection: ProductSelection = EVERYTHING
) -> Facts | Refused | None:
    """Read the facts of a product, a path from `list_products`; None where it is not selected.

    An unreadable file is refused whatever the selection, because its kind is unknown.
    """
    try:
        file = within(root, path)
        with reading(file), open_stored(file) as product:
            header = read_header(product, path, selection)
            return None if header is None else _facts(product, file, header)
    except ProductError as error:
        return Refused(path, error.problem)


def read_header(product: StoredProduct, path: str, selection: ProductSelection) -> Header | None:
    """Return what an open product states of itself; None where it is not selected.

    Parameters
    ----------
    product : StoredProduct
    path : str
    selection : ProductSelection

    Raises
    ------
    ProductError
        If it is not a product of lidarops, or of an unknown kind.
    """
    attributes = product.attrs
    kind = attributes.get("lidarops_kind")
    if kind not in set(kinds()):
        problem = "is not a product of lidarops" if kind is None else f"has an unknown kind: {kind}"
        raise ProductError(problem, file=path)
    if PERIOD in attributes:
        raise ProductError("holds means of products and is not a product itself", file=path)
    try:
        ends = (attributes[f"time_coverage_{end}"] for end in ("start", "end"))
        start, stop = (datetime.fromisoformat(text).astimezone(UTC) for text in ends)
        names = {name: attributes[f"lidarops_{name}"] for name in NAMES}
        if not selection.admits(names, start, stop):
            return None
        return Header(
            path=path,
            id=attributes["id"],
            mode=attributes["lidarops_detection_mode"],
            start=start,
            stop=stop,
            profiles=product.sizes["time"],
            grid=_grid_digest(product, kind),
            recorder=attributes.get(RECORDERS, ""),
            **names,
        )
    except KeyError as error:
        problem = f"is not a product of lidarops: it has no {error}"
        raise ProductError(problem, file=path) from error


def _facts(product: StoredProduct, file: Path, header: Header) -> Facts:
    bits = all_bits(product)
    counts = FlagCounter(rejecting_mask(bits))
    for name in flags_names(product):
        counts.add(product[name][...])
    height = "station_altitude" if "station_altitude" in product else "altitude"
    return Facts(
        **{stated.name: getattr(header, stated.name) for stated in fields(header)},
        campaign=product.attrs["lidarops_campaign"],
        wavelength=_middle(product, "wavelength") * 1e-9,
        latitude=_middle(product, "latitude"),
        longitude=_middle(product, "longitude"),
        altitude=_middle(product, height),
        sha256=sha256_of(file),
        size=file.stat().st_size,
        verdicts=counts.verdicts,
        code_version=product.attrs["lidarops_code_version"],
        flagged={
            bit.word.upper(): counts.carried[bit.mask] for bit in bits if bit.mask in counts.carried
        },
    )


@cache
def coordinate_names(kind: str) -> frozenset[str]:
    """Return the names of the coordinates of a product kind, including bounds."""
    rows = layout_of(kind).coordinates
    bounds = (row.bounds for row in rows if row.bounds)
    return frozenset({*(row.name for row in rows), *bounds})


def _grid_digest(product: StoredProduct, kind: str) -> str:
    """Return a digest of what must be equal in products that are joined along time.

    These are names, types, dimensions, units and flags of the variables, the recorders, and the
    values of all coordinates that do not change with time, including the position of the station.
    """
    digest = hashlib.sha256(f"{kind}{product.attrs.get(RECORDERS, '')}".encode())
    coordinates = coordinate_names(kind)
    for name, variable in sorted(product.variables.items()):
        if name in UNSHARED:
            continue
        dims = variable.dims
        sizes = [each for each in zip(dims, variable.shape, strict=True) if each[0] != "time"]
        schema = [plain(variable.attrs.get(key)) for key in _SCHEMA_ATTRIBUTES]
        digest.update(repr((name, variable.dtype.str, dims, sizes, schema)).encode())
        if name in coordinates and "time" not in dims:
            digest.update(np.ascontiguousarray(variable[...]).tobytes())
    return digest.hexdigest()[:_GRID_DIGITS]


def plain(value: Any) -> Any:
    """Return an attribute as a JSON type."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def groups(products: Iterable[_Stated]) -> dict[Group, list[_Stated]]:
    """Group products that can be joined, each group sorted by time.

    Parameters
    ----------
    products : iterable of Header or Facts

    Returns
    -------
    dict of Group to list of Header or Facts
        Groups sorted by name, products by start, then path.
    """
    by_group: dict[Group, list[_Stated]] = {}
    for product in sorted(products, key=lambda header: (header.start, header.path)):
        by_group.setdefault(product.group, []).append(product)
    return dict(sorted(by_group.items()))


def refuse_several(names: Sequence[str], file: str | Path | None, remedy: str) -> None:
    """Refuse products of several groups, with these names, to be joined.

    Raises
    ------
    ProductError
        If there is more than one group.
    """
    if len(names) > 1:
        problem = f"products of {len(names)} groups cannot be joined: {'; '.join(names)}"
        raise ProductError(problem, file=file, remedy=remedy)


def grid_notes(all_groups: Iterable[Group]) -> list[str]:
    """Return notes on instruments, kinds and channels with products of several grids.

    Parameters
    ----------
    all_groups : iterable of Group
        Sorted.

    Returns
    -------
    list of str
        One sentence each.
    """
    notes = []
    for series, alike in groupby(all_groups, key=itemgetter(slice(4))):
        names = [group.grid_words for group in alike]
        if len(names) > 1:
            grids = f"products of {len(names)} grids, which are not joined: {', '.join(names)}"
            notes.append(f"{' '.join(series)}: {grids}")
    return notes


def refuse_duplicates(profiles: Iterable[tuple[str, NDArray[np.float64]]]) -> None:
    """Refuse several profiles at the same time, naming their products.

    Parameters
    ----------
    profiles : iterable of (str, ndarray)
        Path of each product, and times of its profiles.

    Raises
    ------
    ProductError
        If a time occurs twice.
    """
    paths, parts = zip(("", np.empty(0)), *profiles, strict=True)
    times = np.concatenate(parts)
    owners = np.repeat(np.arange(len(paths)), [part.size for part in parts])
    order = np.argsort(times, kind="stable")
    same = np.flatnonzero(np.diff(times[order]) == 0)
    if same.size:
        first, second = (paths[owners[order[at]]] for at in (same[0], same[0] + 1))
        moment = datetime.fromtimestamp(float(times[order[same[0]]]), UTC)
        raise ProductError(
            f"holds a profile at {moment:%Y-%m-%dT%H:%M:%SZ} that is also in {second}",
            file=first,
            remedy="leave one of the products out",
        )


def _middle(product: StoredProduct, name: str) -> float:
    """Return a coordinate of the station, or its mean over a network; NaN if missing."""
    return float(product[name][...].mean()) if name in product else float("nan")
