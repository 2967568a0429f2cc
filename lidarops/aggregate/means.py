"""Daily and monthly means of products with errors, written as NetCDF files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops import __version__
from lidarops.aggregate._join import shared_attributes
from lidarops.aggregate._sums import Array, PeriodSums, Profiles, read_profiles
from lidarops.aggregate.facts import (
    FOLDER,
    PERIOD,
    Facts,
    Group,
    Period,
    Refused,
    Weights,
    coordinate_names,
    refuse_duplicates,
)
from lidarops.aggregate.means_variables import layout
from lidarops.errors import ProductError
from lidarops.netcdf import variables as rows
from lidarops.netcdf.context import (
    UNUSED_INPUTS,
    identifier,
    iso,
    package_versions,
    prov_document,
    prov_type,
)
from lidarops.netcdf.coordinates import auxiliary_names, on_altitude
from lidarops.netcdf.encoding import as_stored, as_text
from lidarops.netcdf.read import as_variable
from lidarops.netcdf.stored import StoredProduct, reading
from lidarops.netcdf.variables import QUANTIZATION, Layout, attributes, layout_of
from lidarops.netcdf.write import write_product
from lidarops.system.code_version import code_version

_MOVING: Final = ("zenith_angle", "azimuth")


@dataclass(frozen=True, slots=True)
class MeansFile:
    """A file of means that was written."""

    path: str
    """Relative to the root of the products, with forward slashes."""
    sha256: str
    size: int
    periods: int
    products: int


@dataclass(frozen=True, slots=True)
class MeansResult:
    """Files of means of one group, and products that could not be read."""

    files: tuple[MeansFile, ...]
    refused: tuple[Refused, ...]
    note: str = ""
    """Why the group has no means by its nature; empty where it has."""


class Means:
    """Writes the means of groups of products, one file per calendar year of each.

    Products are read one after the other, so that only one product and its periods are in memory.

    Parameters
    ----------
    root : path
        Folder that product paths are relative to; files are written to its ``aggregates/means``.
    groups : mapping of Group to sequence of Facts
        As of `lidarops.aggregate.facts.groups`.
    period : Period
    weights : Weights
    """

    def __init__(
        self,
        root: Path,
        groups: Mapping[Group, Sequence[Facts]],
        period: Period,
        weights: Weights = Weights.SHOTS,
    ) -> None:
        self._root, self.groups = root, groups
        self._new = partial(_Averaging, period, weights)
        self._done: dict[Group, MeansResult] = {}

    @contextmanager
    def averaging(self, group: Group) -> Iterator[_Averaging]:
        """Take the products of a group, which others read too, in order; then write its means."""
        averaging = self._new()
        yield averaging
        # `of` tries again what fails, and tells it.
        if averaging.taken == len(self.groups[group]):
            with suppress(ProductError):
                self._done[group] = averaging.write(self._root)

    def of(self, group: Group) -> MeansResult:
        """Return the means of a group, written unless they are; unreadable products are left out.

        Raises
        ------
        ProductError
            If two products have a profile at the same time, or a file cannot be written.
        """
        if group in self._done:
            return self._done[group]
        averaging = self._new()
        for facts in self.groups[group]:
            if averaging.note:
                break
            try:
                with facts.opened(self._root) as product:
                    averaging.take(facts, product)
            except ProductError as error:
                averaging.refused.append(Refused(facts.path, error.problem))
        return averaging.write(self._root)


@dataclass(slots=True)
class _Year:
    """Means of one calendar year, and of what they are made."""

    period: Period
    weights: Weights
    keys: list[np.datetime64] = field(default_factory=list)
    records: list[dict[str, NDArray[Any]]] = field(default_factory=list)
    inputs: dict[str, Facts] = field(default_factory=dict)
    """By path."""
    shared: dict[str, Any] | None = None
    """Attributes that are equal in all products so far."""
    modified: str = ""
    """``date_modified`` of the newest product so far; such times in UTC sort as texts."""
    version: int = 0
    """Sum of the versions of the products so far."""
    partial: int = 0
    """Number of products so far that lack raw files of their scenes."""

    def note(self, facts: Facts, stated: Mapping[str, Any]) -> None:
        """Note a product, with the attributes that it states."""
        if facts.path not in self.inputs:
            self.inputs[facts.path] = facts
            so_far = stated if self.shared is None else self.shared
            self.shared = shared_attributes([so_far, stated])
            self.version += int(stated["product_version"])
            self.partial += UNUSED_INPUTS in stated
            self.modified = max(self.modified, str(stated.get("date_modified", "")))

    @property
    def first(self) -> Facts:
        """The first of its products."""
        return next(iter(self.inputs.values()))

    @property
    def bounds(self) -> NDArray[np.datetime64]:
        """Start and end of each period, (time, 2)."""
        keys = np.array(self.keys)
        return np.stack([keys, keys + 1], axis=-1).astype("datetime64[s]")

    @property
    def span(self) -> tuple[datetime, datetime]:
        """Start of the first period, end of the last one."""
        return _datetime(self.bounds[0, 0]), _datetime(self.bounds[-1, 1])

    @property
    def code_version(self) -> str:
        """Digest of the code that makes products of the kind and their means."""
        return code_version(self.first.kind, "lidarops.aggregate.means")

    @property
    def id(self) -> str:
        """UUID version 5 of the inputs' sha256, period, weights, time and code version."""
        return identifier(
            {
                "means": {"period": self.period.value, "weights": self.weights.value},
                "inputs": sorted(facts.sha256 for facts in self.inputs.values()),
                "time": [moment.isoformat() for moment in self.span],
                "code_version": self.code_version,
            }
        )

    @property
    def path(self) -> str:
        """Path of its file relative to the root of the products."""
        group, period = self.first.group, self.period.value
        folder = f"{group.station}/{group.instrument}/{group.kind}/{period}"
        weighted = "" if self.weights is Weights.SHOTS else f"_{self.weights.value}"
        name = f"{group.name}_{period}{weighted}_{_year(self.keys[0])}.nc"
        return f"{FOLDER}/means/{folder}/{name}"


def _datetime(moment: np.datetime64) -> datetime:
    plain: datetime = moment.astype("datetime64[us]").item()
    return plain.replace(tzinfo=UTC)


def _year(key: np.datetime64) -> int:
    return int(key.astype("datetime64[Y]").astype(int)) + 1970


@dataclass(slots=True)
class _Averaging:
    """Accumulates products of one group, in order of their start, and collects means by year."""

    period: Period
    weights: Weights
    refused: list[Refused] = field(default_factory=list)
    """Products that could not be read."""
    taken: int = 0
    """Number of products, with those that could not be read."""
    note: str = ""
    """Why there are no means; the others then need not be taken."""
    _frame: dict[str, xr.Variable] = field(default_factory=dict)
    """Variables of the first product that its means take over."""
    _years: dict[int, _Year] = field(default_factory=dict)
    _open: dict[np.datetime64, PeriodSums] = field(default_factory=dict)
    _times: list[tuple[str, Array]] = field(default_factory=list)

    def take(self, facts: Facts, product: StoredProduct) -> None:
        """Add an open product; one that cannot be read is refused."""
        self.taken += 1
        if self.note:
            return
        try:
            with reading(facts.path):
                source = layout_of(facts.kind)
                profiles, times = read_profiles(product, source), product["time"][...]
                if any(product[name].dims for name in _MOVING if name in product):
                    note = f"no means of {facts.kind}: profiles of several directions have none"
                    self.note = f"{note} ({facts.path})"
                    return
                self._frame = self._frame or _frame(product, facts.kind)
                stated = product.attrs.whole()
        except ProductError as error:
            self.refused.append(Refused(facts.path, error.problem))
        else:
            self._add(facts, profiles, times, stated)

    def _add(
        self, facts: Facts, profiles: Profiles, times: Array, stated: Mapping[str, Any]
    ) -> None:
        """Add a product, with its times (s since 1970) and what it states."""
        self._close(before=np.datetime64(facts.start.replace(tzinfo=None), "ms"))
        self._times.append((facts.path, times))
        # Rounded to milliseconds, the accuracy of the middle of a profile.
        moments = np.datetime64(0, "ms") + np.rint(times * 1e3).astype("timedelta64[ms]")
        keys = moments.astype(f"datetime64[{self.period.unit}]")
        for key in np.unique(keys):
            year = self._years.setdefault(_year(key), _Year(self.period, self.weights))
            year.note(facts, stated)
            sums = self._open.setdefault(key, PeriodSums(layout_of(facts.kind), self.weights))
            sums.add(profiles, np.flatnonzero(keys == key))

    def _close(self, *, before: np.datetime64 | None = None) -> None:
        done = [key for key in self._open if before is None or key + 1 <= before]
        for key in sorted(done):
            year = self._years[_year(key)]
            year.keys.append(key)
            year.records.append(self._open.pop(key).record())

    def write(self, root: Path) -> MeansResult:
        """Close all periods and write the files.

        Raises
        ------
        ProductError
            If two products have a profile at the same time, or a file cannot be written.
        """
        files = []
        if not self.note:
            refuse_duplicates(self._times)
            self._close()
            for _, year in sorted(self._years.items()):
                done = write_product(_encoded(self._frame, year), root / year.path)
                periods, inputs = len(year.keys), len(year.inputs)
                files.append(MeansFile(year.path, done.sha256, done.size, periods, inputs))
        return MeansResult(tuple(files), tuple(self.refused), self.note)


def _frame(product: StoredProduct, kind: str) -> dict[str, xr.Variable]:
    """Read the coordinates of a product that do not change with time, and its station."""
    static = coordinate_names(kind)
    return {
        name: as_variable(variable).load()
        for name, variable in product.variables.items()
        if (name in static and "time" not in variable.dims)
        or name in ("station", QUANTIZATION.name)
    }


def _encoded(frame: Mapping[str, xr.Variable], year: _Year) -> xr.Dataset:
    """Return the dataset of a file of means, for `lidarops.netcdf.write.write_product`."""
    mode = year.first.counting
    table = layout(year.first.kind, year.period, year.weights)
    time = table.rows["time"]
    bounds = year.bounds.astype(np.float64)
    variables = {
        time.name: xr.Variable(time.dims, bounds.mean(axis=1), attributes(time, mode=mode)),
        f"{time.bounds}": xr.Variable((*time.dims, rows.BOUNDS_DIM), bounds),
        **{name: values for name, values in frame.items() if name != "station"},
        **dict(_data(table, year, frame)),
        "station": frame["station"],
        rows.PROVENANCE.name: as_text(rows.PROVENANCE, _provenance(year), mode),
    }
    dataset = xr.Dataset(on_altitude(variables), attrs=_global_attributes(table, year))
    dataset.encoding["unlimited_dims"] = {"time"}
    return dataset


def _data(
    table: Layout, year: _Year, frame: Mapping[str, xr.Variable]
) -> Iterator[tuple[str, xr.Variable]]:
    """Yield the variables of means, from their values in each period."""
    records = year.records
    flags = {
        row.name: np.stack([record[row.name] for record in records]).astype(np.int32)
        for row in table.judges
        if row.name in records[0]
    }
    summaries = {rows.summary_of(name): bits for name, bits in flags.items()}
    # An optional variable may be in no product.
    present = [row for row in table.variables if row.name in {*summaries, *records[0]}]
    names = {row.name for row in present}
    located = {row.name: frame[row.name] for row in table.coordinates if row.name in frame}
    for row in present:
        values: NDArray[Any]
        if row.name in summaries:
            values = rows.summarize_flags(summaries[row.name], table.flags)
        elif row.name in flags:
            values = flags[row.name]
        else:
            values = as_stored(row, np.stack([record[row.name] for record in records]))
        known = replace(row, ancillaries=tuple(name for name in row.ancillaries if name in names))
        listed = auxiliary_names(row, located)
        attrs = attributes(known, mode=year.first.counting, coordinates=listed)
        if row.dtype == "f8":
            # A sum that is never missing; the fill value is for 4 bytes only.
            del attrs["_FillValue"]
        yield row.name, xr.Variable(row.dims, values, attrs)


def _provenance(year: _Year) -> str:
    """Return the provenance of means as W3C PROV-JSON, whatever the order of inputs."""
    inputs = sorted(year.inputs.values(), key=lambda facts: (facts.sha256, facts.path))
    group = inputs[0].group
    start, stop = year.span
    averaging = {
        "lidarops:period": year.period.value,
        "lidarops:weights": year.weights.value,
        "prov:startTime": start.isoformat(),
        "prov:endTime": stop.isoformat(),
    }
    return prov_document(
        "lidarops:means",
        ("lidarops:averaging", averaging),
        {
            "lidarops:means": {
                "prov:type": prov_type("lidarops:Means"),
                "lidarops:id": year.id,
                "lidarops:kind": group.kind,
                "lidarops:channel": group.channel,
                "lidarops:grid": group.grid,
            },
            **{
                f"sha256:{facts.sha256}": {
                    "prov:type": prov_type("lidarops:Product"),
                    "lidarops:id": facts.id,
                    "lidarops:path": facts.path,
                    "lidarops:sha256": facts.sha256,
                }
                for facts in inputs
            },
        },
        ({"prov:entity": f"sha256:{facts.sha256}"} for facts in inputs),
        (year.code_version, package_versions()),
        {},
    )


def _global_attributes(table: Layout, year: _Year) -> dict[str, Any]:
    """Return the global attributes of means, in the order in which they are written."""
    shared, source = year.shared or {}, layout_of(year.first.kind)
    comment = _replaced(shared.get("comment", ""), source.comment, table.comment)
    program = f"lidarops {__version__} ({year.code_version})"
    count, (start, stop) = len(year.inputs), year.span
    first, last = (_datetime(pair[0] + (pair[1] - pair[0]) // 2) for pair in year.bounds[[0, -1]])
    dates = ("date_created", "date_modified", "date_issued", "date_metadata_modified")
    stated = {
        **shared,
        "title": _replaced(shared.get("title", ""), source.title, table.title),
        "summary": _replaced(shared.get("summary", ""), source.summary, table.summary),
        "id": year.id,
        "processing_level": table.processing_level,
        "product_version": str(year.version),
        "history": f"{year.modified} averaged {count} products over UTC"
        f" {year.period.value}s, weights {year.weights.value} [{program}]",
        "comment": f"{comment} Dates of creation and change are those of the newest product, and"
        " product_version is the sum of those of the products, so that equal inputs give equal"
        " files: it grows with each product that is added or replaced.",
        # As ACDD has it: the times of the first and last value, which are middles of periods.
        "time_coverage_start": iso(first),
        "time_coverage_end": iso(last),
        "time_coverage_duration": f"P{(stop - start).days}D",
        "time_coverage_resolution": f"P1{year.period.unit}",
        **dict.fromkeys(dates, year.modified),
        PERIOD: year.period.value,
        "lidarops_weights": year.weights.value,
        "lidarops_code_version": year.code_version,
        "lidarops_input_count": np.int32(count),
    }
    if year.partial:
        stated[UNUSED_INPUTS] = f"{year.partial} of {count} products lack raw files, and name them"
    return stated


def _replaced(text: str, old: str, new: str) -> str:
    """Return a text with the text of the product kind replaced by that of means."""
    return text.replace(old, new) if old in text else new
