"""The NetCDF dataset of means: coordinates, variables and provenance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.aggregate.facts import Facts, coordinate_names, opened
from lidarops.aggregate.means_variables import (
    MeansDescription,
    Period,
    Weights,
    global_attributes,
    layout,
)
from lidarops.netcdf import variables as rows
from lidarops.netcdf.encoding import as_stored, as_text
from lidarops.netcdf.provenance import identifier, package_versions, prov_document, prov_type
from lidarops.netcdf.variables import QUANTIZATION, Layout, Row, attributes
from lidarops.records import DetectionMode
from lidarops.system.code_version import code_version
from lidarops.system.files import within

_MOVING: Final = ("zenith_angle", "azimuth")


@dataclass(frozen=True, slots=True)
class Frame:
    """Coordinates and attributes of means that are equal in all products of a group."""

    kind: str
    mode: DetectionMode
    variables: Mapping[str, xr.Variable]
    """Coordinates that do not change with time, and the station; in memory."""
    listed: Mapping[tuple[str, ...], tuple[str, ...]]
    """Dimensions -> auxiliary coordinates of the data that have them."""
    moving: tuple[str, ...]
    """Names of beam angles that change with time."""


def read_frame(root: Path, facts: Facts) -> Frame:
    """Read static coordinates and attributes from a product.

    Raises
    ------
    ProductError
        If the product cannot be read.
    """
    with opened(within(root, facts.path)) as product:
        static = coordinate_names(facts.kind)
        kept = [
            str(name)
            for name, variable in product.variables.items()
            if (name in static and "time" not in variable.dims)
            or name in ("station", QUANTIZATION.name)
        ]
        return Frame(
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


@dataclass(frozen=True, slots=True)
class Periods:
    """Periods and means of a file."""

    bounds: NDArray[np.float64]
    """(time, 2), s since 1970."""
    records: Sequence[Mapping[str, NDArray[Any]]]
    """One per period: variable -> values without time."""


def encode_means(
    frame: Frame,
    periods: Periods,
    shared: Mapping[str, Any],
    about: MeansDescription,
    provenance: str,
) -> xr.Dataset:
    """Return the dataset of a file of means.

    Parameters
    ----------
    frame : Frame
    periods : Periods
    shared : mapping
        Global attributes that are equal in all products.
    about : MeansDescription
    provenance : str
        From `means_provenance`.

    Returns
    -------
    xr.Dataset
        Encoded, for `lidarops.netcdf.write.write_product`.
    """
    table = layout(frame.kind, about.period, about.weights)
    texts = {rows.PROVENANCE.name: as_text(rows.PROVENANCE, provenance, frame.mode)}
    variables = {
        **dict(_times(table, periods.bounds, frame.mode)),
        **{name: values for name, values in frame.variables.items() if name != "station"},
        **dict(_data(table, periods, frame)),
        "station": frame.variables["station"],
        **texts,
    }
    attrs = global_attributes(shared, table, about, frame.kind)
    dataset = xr.Dataset(variables, attrs=attrs)
    dataset.encoding["unlimited_dims"] = {"time"}
    return dataset


def _times(
    table: Layout, bounds: NDArray[np.float64], mode: DetectionMode
) -> Iterator[tuple[str, xr.Variable]]:
    row = table.row("time")
    yield row.name, xr.Variable(row.dims, bounds.mean(axis=1), attributes(row, mode=mode))
    yield f"{row.bounds}", xr.Variable((*row.dims, rows.BOUNDS_DIM), bounds)


def _data(table: Layout, periods: Periods, frame: Frame) -> Iterator[tuple[str, xr.Variable]]:
    flags = np.stack([record[rows.QUALITY_FLAG] for record in periods.records]).astype(np.int32)
    # An optional variable may be in no product.
    present = [row for row in table.variables if row.summary or row.name in periods.records[0]]
    names = {row.name for row in present}
    for row in present:
        values: NDArray[Any]
        if row.summary:
            values = rows.summarize_flags(flags, table.flags)
        elif row.name == rows.QUALITY_FLAG:
            values = flags
        else:
            values = as_stored(row, np.stack([record[row.name] for record in periods.records]))
        ancillaries = tuple(name for name in row.ancillaries if name in names)
        attrs = _attributes(replace(row, ancillaries=ancillaries), frame)
        yield row.name, xr.Variable(row.dims, values, attrs)


def _attributes(row: Row, frame: Frame) -> dict[str, Any]:
    attrs = attributes(row, mode=frame.mode, coordinates=frame.listed.get(row.dims, ()))
    if row.dtype == "f8":
        # A sum that is never missing; the fill value is for 4 bytes only.
        del attrs["_FillValue"]
    return attrs


@dataclass(frozen=True, slots=True)
class Lineage:
    """Inputs and settings of means."""

    inputs: tuple[Facts, ...]
    period: Period
    weights: Weights
    start: datetime
    stop: datetime

    @property
    def id(self) -> str:
        """UUID version 5 of the inputs' sha256, period, weights, time and code version."""
        return identifier(
            {
                "means": {"period": self.period.value, "weights": self.weights.value},
                "inputs": sorted(facts.sha256 for facts in self.inputs),
                "time": [self.start.isoformat(), self.stop.isoformat()],
                "code_version": means_version(self.inputs[0].kind),
            }
        )


def means_provenance(lineage: Lineage) -> str:
    """Return the provenance of means as W3C PROV-JSON, whatever the order of inputs."""
    inputs = sorted(lineage.inputs, key=lambda facts: (facts.sha256, facts.path))
    group = inputs[0].group
    averaging = {
        "lidarops:period": lineage.period.value,
        "lidarops:weights": lineage.weights.value,
        "prov:startTime": lineage.start.isoformat(),
        "prov:endTime": lineage.stop.isoformat(),
    }
    return prov_document(
        "lidarops:means",
        ("lidarops:averaging", averaging),
        {
            "lidarops:means": {
                "prov:type": prov_type("lidarops:Means"),
                "lidarops:id": lineage.id,
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
        (means_version(group.kind), package_versions()),
        {},
    )


def means_version(kind: str) -> str:
    """Return a digest of the code that makes products of a kind and their means."""
    return code_version(kind, "lidarops.aggregate.means")
