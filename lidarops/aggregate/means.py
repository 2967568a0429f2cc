"""Daily and monthly means of products with errors, written as NetCDF files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.aggregate._join import shared_attributes
from lidarops.aggregate._sums import Array, PeriodSums, Profiles, read_profiles
from lidarops.aggregate.facts import (
    FOLDER,
    Facts,
    Group,
    Refused,
    coordinate_names,
    opened,
    refuse_duplicates,
)
from lidarops.aggregate.means_variables import (
    MeansDescription,
    Period,
    Weights,
    global_attributes,
    layout,
)
from lidarops.errors import ProductError
from lidarops.netcdf import variables as rows
from lidarops.netcdf.context import UNUSED_INPUTS
from lidarops.netcdf.encoding import as_stored, as_text
from lidarops.netcdf.provenance import package_versions, prov_document, prov_type
from lidarops.netcdf.variables import QUANTIZATION, Layout, Row, attributes
from lidarops.netcdf.write import write_product
from lidarops.records import DetectionMode
from lidarops.system.files import within

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


def write_means(
    root: Path,
    products: Sequence[Facts],
    period: Period,
    *,
    weights: Weights = Weights.SHOTS,
) -> MeansResult:
    """Write the means of one group of products, one file per calendar year.

    Products are read one after the other, so that only one product and its periods are in memory.
    Unreadable products are reported and left out.

    Parameters
    ----------
    root : path
        Folder that product paths are relative to; files are written to its ``aggregates/means``.
    products : sequence of Facts
        Of one group, sorted by time (`lidarops.aggregate.facts.groups`).
    period : Period
    weights : Weights

    Returns
    -------
    MeansResult

    Raises
    ------
    ProductError
        If two products have a profile at the same time, or a file cannot be
        written.
    """
    averaging = _Averaging(period, weights)
    frame: _Frame | None = None
    refused = []
    for facts in products:
        try:
            group_frame = frame or _read_frame(root, facts)
            profiles = read_profiles(root, facts)
        except ProductError as error:
            refused.append(Refused(facts.path, error.problem))
            continue
        if group_frame.moving:
            note = f"no means of {facts.kind}: profiles of several directions have none"
            return MeansResult((), tuple(refused), f"{note} ({facts.path})")
        frame = group_frame
        averaging.add(profiles)
    averaging.finish()
    files = () if frame is None else tuple(_written(root, products[0].group, frame, averaging))
    return MeansResult(files, tuple(refused))


@dataclass(slots=True)
class _Year:
    """Means of one calendar year and their inputs."""

    keys: list[np.datetime64] = field(default_factory=list)
    records: list[dict[str, NDArray[Any]]] = field(default_factory=list)
    inputs: dict[str, Facts] = field(default_factory=dict)
    shared: dict[str, Any] | None = None
    """Attributes that are equal in all products so far."""
    modified: str = ""
    """``date_modified`` of the newest product so far; such times in UTC sort as texts."""
    version: int = 0
    """Sum of the versions of the products so far."""
    partial: int = 0
    """Number of products so far that lack raw files of their scenes."""

    def note(self, profiles: Profiles) -> None:
        path = profiles.facts.path
        if path not in self.inputs:
            self.inputs[path] = profiles.facts
            so_far = profiles.attributes if self.shared is None else self.shared
            self.shared = shared_attributes([so_far, profiles.attributes])
            self.version += int(profiles.attributes["product_version"])
            self.partial += UNUSED_INPUTS in profiles.attributes
            self.modified = max(self.modified, str(profiles.attributes.get("date_modified", "")))


@dataclass(slots=True)
class _Averaging:
    """Accumulates products and collects the means by year."""

    period: Period
    weights: Weights
    years: dict[int, _Year] = field(default_factory=dict)
    _open: dict[np.datetime64, PeriodSums] = field(default_factory=dict)
    _times: list[tuple[str, Array]] = field(default_factory=list)

    def add(self, profiles: Profiles) -> None:
        """Add a product; products must be added in order of their start."""
        facts = profiles.facts
        self._close(before=np.datetime64(facts.start.replace(tzinfo=None), "ms"))
        self._times.append((facts.path, profiles.times))
        for key, chosen in self._periods(profiles.times):
            self.years.setdefault(_year(key), _Year()).note(profiles)
            sums = self._open.setdefault(key, PeriodSums(facts.kind, self.weights))
            sums.add(profiles, chosen)

    def finish(self) -> None:
        """Close all periods.

        Raises
        ------
        ProductError
            If two products have a profile at the same time.
        """
        if self._times:
            refuse_duplicates(self._times)
        self._close(before=None)

    def _close(self, *, before: np.datetime64 | None) -> None:
        done = [key for key in self._open if before is None or key + 1 <= before]
        for key in sorted(done):
            year = self.years[_year(key)]
            year.keys.append(key)
            year.records.append(self._open.pop(key).record())

    def _periods(self, times: Array) -> Iterator[tuple[np.datetime64, NDArray[np.intp]]]:
        # Rounded to milliseconds, the accuracy of the middle of a profile.
        moments = np.datetime64(0, "ms") + np.rint(times * 1e3).astype("timedelta64[ms]")
        keys = moments.astype(f"datetime64[{self.period.unit}]")
        for key in np.unique(keys):
            yield key, np.flatnonzero(keys == key)


def _year(key: np.datetime64) -> int:
    return int(key.astype("datetime64[Y]").astype(int)) + 1970


@dataclass(frozen=True, slots=True)
class _Frame:
    """Coordinates and attributes of means that are equal in all products of a group."""

    kind: str
    mode: DetectionMode
    variables: Mapping[str, xr.Variable]
    """Coordinates that do not change with time, and the station; in memory."""
    listed: Mapping[tuple[str, ...], tuple[str, ...]]
    """Dimensions -> auxiliary coordinates of the data that have them."""
    moving: tuple[str, ...]
    """Names of beam angles that change with time."""


def _read_frame(root: Path, facts: Facts) -> _Frame:
    """Read static coordinates and attributes from a product."""
    with opened(within(root, facts.path)) as product:
        static = coordinate_names(facts.kind)
        kept = [
            str(name)
            for name, variable in product.variables.items()
            if (name in static and "time" not in variable.dims)
            or name in ("station", QUANTIZATION.name)
        ]
        return _Frame(
            facts.kind,
            facts.counting,
            {name: product.variables[name].load() for name in kept},
            {
                tuple(str(dim) for dim in variable.dims): tuple(
                    variable.attrs["coordinates"].split()
                )
                for variable in product.variables.values()
                if "coordinates" in variable.attrs
            },
            tuple(name for name in _MOVING if name in product and product[name].dims),
        )


def _written(root: Path, group: Group, frame: _Frame, averaging: _Averaging) -> Iterator[MeansFile]:
    for number, year in sorted(averaging.years.items()):
        keys = np.array(year.keys)
        about = MeansDescription(
            tuple(year.inputs.values()),
            averaging.period,
            averaging.weights,
            np.stack([keys, keys + 1], axis=-1).astype("datetime64[s]"),
            year.partial,
            year.modified,
            year.version,
        )
        path = _path(group, averaging.period, averaging.weights, number)
        done = write_product(_encoded(frame, year, about), root / path)
        yield MeansFile(path, done.sha256, done.size, len(keys), len(year.inputs))


def _path(group: Group, period: Period, weights: Weights, year: int) -> str:
    folder = f"{group.station}/{group.instrument}/{group.kind}/{period.value}"
    weighted = "" if weights is Weights.SHOTS else f"_{weights.value}"
    return f"{FOLDER}/means/{folder}/{group.name}_{period.value}{weighted}_{year}.nc"


def _encoded(frame: _Frame, year: _Year, about: MeansDescription) -> xr.Dataset:
    """Return the dataset of a file of means, for `lidarops.netcdf.write.write_product`."""
    table = layout(about.kind, about.period, about.weights)
    time = table.row("time")
    bounds = about.bounds.astype(np.float64)
    provenance = as_text(rows.PROVENANCE, _provenance(about), frame.mode)
    variables = {
        time.name: xr.Variable(time.dims, bounds.mean(axis=1), attributes(time, mode=frame.mode)),
        f"{time.bounds}": xr.Variable((*time.dims, rows.BOUNDS_DIM), bounds),
        **{name: values for name, values in frame.variables.items() if name != "station"},
        **dict(_data(table, year.records, frame)),
        "station": frame.variables["station"],
        rows.PROVENANCE.name: provenance,
    }
    dataset = xr.Dataset(variables, attrs=global_attributes(year.shared or {}, table, about))
    dataset.encoding["unlimited_dims"] = {"time"}
    return dataset


def _data(
    table: Layout, records: Sequence[Mapping[str, NDArray[Any]]], frame: _Frame
) -> Iterator[tuple[str, xr.Variable]]:
    """Yield the variables of means, from their values in each period."""
    flags = np.stack([record[rows.QUALITY_FLAG] for record in records]).astype(np.int32)
    # An optional variable may be in no product.
    present = [row for row in table.variables if row.summary or row.name in records[0]]
    names = {row.name for row in present}
    for row in present:
        values: NDArray[Any]
        if row.summary:
            values = rows.summarize_flags(flags, table.flags)
        elif row.name == rows.QUALITY_FLAG:
            values = flags
        else:
            values = as_stored(row, np.stack([record[row.name] for record in records]))
        ancillaries = tuple(name for name in row.ancillaries if name in names)
        attrs = _attributes(replace(row, ancillaries=ancillaries), frame)
        yield row.name, xr.Variable(row.dims, values, attrs)


def _attributes(row: Row, frame: _Frame) -> dict[str, Any]:
    attrs = attributes(row, mode=frame.mode, coordinates=frame.listed.get(row.dims, ()))
    if row.dtype == "f8":
        # A sum that is never missing; the fill value is for 4 bytes only.
        del attrs["_FillValue"]
    return attrs


def _provenance(about: MeansDescription) -> str:
    """Return the provenance of means as W3C PROV-JSON, whatever the order of inputs."""
    inputs = sorted(about.inputs, key=lambda facts: (facts.sha256, facts.path))
    group = inputs[0].group
    averaging = {
        "lidarops:period": about.period.value,
        "lidarops:weights": about.weights.value,
        "prov:startTime": about.start.isoformat(),
        "prov:endTime": about.stop.isoformat(),
    }
    return prov_document(
        "lidarops:means",
        ("lidarops:averaging", averaging),
        {
            "lidarops:means": {
                "prov:type": prov_type("lidarops:Means"),
                "lidarops:id": about.id,
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
        (about.code_version, package_versions()),
        {},
    )
