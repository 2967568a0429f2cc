"""The NetCDF dataset of means: coordinates of the products, rows of the table, provenance."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any, Final
from uuid import NAMESPACE_URL, uuid5

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.aggregate.facts import Facts, coordinate_names, opened, within
from lidarops.aggregate.means_variables import (
    About,
    Period,
    Weights,
    global_attributes,
    layout,
)
from lidarops.errors import ProductError
from lidarops.netcdf import variables as rows
from lidarops.netcdf.build import bitround
from lidarops.netcdf.provenance import NAMESPACE, code_version, package_versions
from lidarops.netcdf.variables import QUANTIZATION, Layout, Row, attributes
from lidarops.records import DetectionMode, ProductKind

_MOVING: Final = ("zenith_angle", "azimuth")


@dataclass(frozen=True, slots=True)
class Frame:
    """What the means of a group have from any of its products."""

    kind: ProductKind
    mode: DetectionMode
    variables: Mapping[str, xr.Variable]
    """Coordinates that do not change with time, the station, in memory."""
    listed: Mapping[tuple[str, ...], tuple[str, ...]]
    """Dimensions -> auxiliary coordinates of the data that have them."""
    moving: tuple[str, ...]
    """Angles of the beam that change with time."""

    def refuse_moving_beam(self, file: str) -> None:
        """Refuse products of a beam that moves: several directions have no mean.

        Raises
        ------
        ProductError
            If they are such.
        """
        if self.moving:
            raise ProductError(
                "the beam moves, and profiles of several directions have no mean",
                file=file,
                field=self.moving[0],
                remedy="choose a kind that is made of scans, or instruments that stand still",
            )


def read_frame(root: Path, facts: Facts) -> Frame:
    """Read what the means have from a product.

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
            DetectionMode(facts.mode),
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
    """The means of a file: when, and what."""

    bounds: NDArray[np.float64]
    """(time, 2), s since 1970."""
    records: Sequence[Mapping[str, NDArray[Any]]]
    """One a period: variable -> values without time."""


def encode_means(
    frame: Frame, periods: Periods, shared: Mapping[str, Any], about: About, provenance: str
) -> xr.Dataset:
    """Make the dataset of a file of means.

    Parameters
    ----------
    frame : Frame
    periods : Periods
    shared : mapping
        Global attributes that the products have alike.
    about : About
    provenance : str
        From `means_provenance`.

    Returns
    -------
    xr.Dataset
        Encoded, as `lidarops.netcdf.write.write_product` takes it.
    """
    found = layout(frame.kind, about.period, about.weights)
    texts = {rows.PROVENANCE.name: _text(rows.PROVENANCE, provenance, frame.mode)}
    variables = {
        **dict(_times(found, periods.bounds, frame.mode)),
        **{name: each for name, each in frame.variables.items() if name != "station"},
        **dict(_data(found, periods, frame)),
        "station": frame.variables["station"],
        **texts,
    }
    told = global_attributes(shared, found, about, frame.kind)
    dataset = xr.Dataset(variables, attrs=told)
    dataset.encoding["unlimited_dims"] = {"time"}
    return dataset


def _times(
    found: Layout, bounds: NDArray[np.float64], mode: DetectionMode
) -> Iterator[tuple[str, xr.Variable]]:
    row = found.row("time")
    yield row.name, xr.Variable(row.dims, bounds.mean(axis=1), attributes(row, mode=mode))
    yield f"{row.bounds}", xr.Variable((*row.dims, rows.BOUNDS_DIM), bounds)


def _data(found: Layout, periods: Periods, frame: Frame) -> Iterator[tuple[str, xr.Variable]]:
    flags = np.stack([record[rows.QUALITY_FLAG] for record in periods.records]).astype(np.int32)
    for row in found.variables:
        values: NDArray[Any]
        if row.summary:
            values = rows.sum_up(flags)
        elif row.name == rows.QUALITY_FLAG:
            values = flags
        elif row.name in periods.records[0]:
            values = _stored(row, np.stack([record[row.name] for record in periods.records]))
        else:
            # Optional in the products, and none of these has it.
            continue
        yield row.name, xr.Variable(row.dims, values, _attributes(row, frame))


def _attributes(row: Row, frame: Frame) -> dict[str, Any]:
    found = attributes(row, mode=frame.mode, coordinates=frame.listed.get(row.dims, ()))
    if row.dtype == "f8":
        # A sum of what is never missing; the fill value is one of 4 bytes.
        del found["_FillValue"]
    return found


def _stored(row: Row, values: NDArray[Any]) -> NDArray[Any]:
    stored: NDArray[Any] = values.astype(row.dtype)
    if row.dtype != "f4":
        return stored
    if row.significant_bits is not None:
        stored = bitround(stored, row.significant_bits)
    stored[~np.isfinite(stored)] = rows.FILL_VALUE
    return stored


def _text(row: Row, text: str, mode: DetectionMode) -> xr.Variable:
    return xr.Variable(row.dims, np.frombuffer(text.encode(), "S1"), attributes(row, mode=mode))


@dataclass(frozen=True, slots=True)
class Lineage:
    """What means were made of, and how."""

    inputs: tuple[Facts, ...]
    period: Period
    weights: Weights
    start: datetime
    stop: datetime

    @property
    def id(self) -> str:
        """UUID version 5 of the inputs' sha256, period, weights, time and code version."""
        content = {
            "means": {"period": self.period.value, "weights": self.weights.value},
            "inputs": sorted(each.sha256 for each in self.inputs),
            "time": [self.start.isoformat(), self.stop.isoformat()],
            "code_version": means_version(),
        }
        return str(uuid5(NAMESPACE_URL, NAMESPACE + _canonical(content)))


def means_provenance(lineage: Lineage) -> str:
    """Write the provenance of means as W3C PROV-JSON (`provo2013`).

    Parameters
    ----------
    lineage : Lineage

    Returns
    -------
    str
        ASCII, keys sorted; equal for equal inputs, in whatever order they come.
    """
    inputs = sorted(lineage.inputs, key=lambda each: (each.sha256, each.path))
    group = inputs[0].group
    software = [f"{name} {number}" for name, number in sorted(package_versions().items())]
    document = {
        "prefix": {"lidarops": NAMESPACE, "sha256": "urn:sha256:"},
        "entity": {
            "lidarops:means": {
                "prov:type": _type("lidarops:Means"),
                "lidarops:id": lineage.id,
                "lidarops:kind": group.kind.value,
                "lidarops:channel": group.channel,
                "lidarops:grid": group.grid,
            },
            **{
                f"sha256:{each.sha256}": {
                    "prov:type": _type("lidarops:Product"),
                    "lidarops:id": each.id,
                    "lidarops:path": each.path,
                    "lidarops:sha256": each.sha256,
                }
                for each in inputs
            },
        },
        "activity": {
            "lidarops:averaging": {
                "lidarops:period": lineage.period.value,
                "lidarops:weights": lineage.weights.value,
                "prov:startTime": lineage.start.isoformat(),
                "prov:endTime": lineage.stop.isoformat(),
            }
        },
        "agent": {
            "lidarops:software": {
                "prov:type": _type("prov:SoftwareAgent"),
                "lidarops:code_version": means_version(),
                "lidarops:versions": software,
            }
        },
        "wasGeneratedBy": {
            "_:generation": {
                "prov:entity": "lidarops:means",
                "prov:activity": "lidarops:averaging",
            }
        },
        "used": {
            f"_:use{number}": {
                "prov:activity": "lidarops:averaging",
                "prov:entity": f"sha256:{each.sha256}",
            }
            for number, each in enumerate(inputs, start=1)
        },
        "wasAssociatedWith": {
            "_:association": {
                "prov:activity": "lidarops:averaging",
                "prov:agent": "lidarops:software",
            }
        },
    }
    return _canonical(document)


@cache
def means_version() -> str:
    """Return a digest of the sources that means come from: those of the products, and these."""
    digest = hashlib.sha256(code_version().encode())
    for file in sorted(Path(__file__).resolve().parent.glob("*.py")):
        digest.update(f"{file.name}\0".encode() + file.read_bytes().replace(b"\r\n", b"\n"))
    return digest.hexdigest()[:16]


def _type(name: str) -> dict[str, str]:
    return {"$": name, "type": "prov:QUALIFIED_NAME"}


def _canonical(value: Any) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", ":"))
