"""The content of a product for its page: quality counts, provenance, variables, times."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.product_names import attribute, scalar
from lidarops.figures.wording import named_shares, percent
from lidarops.netcdf.stored_flags import (
    READ_VALUES,
    FlagCounter,
    StoredBit,
    bits_of,
    blocks,
    quality_bits,
    rejecting_mask,
)
from lidarops.netcdf.variables import QUALITY_FLAG
from lidarops.site.paths import CALENDAR_HEIGHT

PROVENANCE: Final = "provenance"


@dataclass(frozen=True, slots=True)
class FlagRow:
    """Count of one quality bit."""

    bit: str
    severity: str
    css: str
    meaning: str
    count: int
    share: str
    width: int
    """Whole percent, for a bar."""


@dataclass(frozen=True, slots=True)
class QualityCounts:
    """Counts of the values of a product by quality."""

    values: int
    usable: int
    unflagged: int
    profiles: int
    available: int
    """Number of profiles with a usable value below a height above the station."""
    rows: tuple[FlagRow, ...]

    @property
    def lacking(self) -> str:
        """Why no value is usable: the rejecting bits that most values carry; empty if one is."""
        if self.usable or not self.values:
            return ""
        rejecting = ((row.meaning, row.count) for row in self.rows if row.css == "bad")
        return named_shares(rejecting, self.values)


@dataclass(frozen=True, slots=True)
class StepRow:
    """A step that was carried out or left out."""

    name: str
    channel: str
    """Channel; in a network with its instrument."""
    settings: str
    reason: str


@dataclass(frozen=True, slots=True)
class InputRow:
    """An input file of a product."""

    path: str
    role: str
    sha256: str


@dataclass(frozen=True, slots=True)
class Origin:
    """Provenance of a product from its PROV-JSON; empty without it."""

    id: str = ""
    plan_hash: str = ""
    code_version: str = ""
    versions: tuple[str, ...] = ()
    settings: str = ""
    steps: tuple[StepRow, ...] = ()
    left_out: tuple[StepRow, ...] = ()
    inputs: tuple[InputRow, ...] = ()
    problem: str = ""
    """Why the provenance is missing or incomplete."""


@dataclass(frozen=True, slots=True)
class VariableRow:
    """A variable of a product."""

    name: str
    dims: str
    units: str
    about: str


@dataclass(frozen=True, slots=True)
class Span:
    """Start and end of the data of a product, UTC, ISO 8601 to the second."""

    start: str
    stop: str


def count_quality(product: xr.Dataset, below: float = CALENDAR_HEIGHT) -> QualityCounts:
    """Count the values of a product by quality bit, and the profiles with a usable value.

    Parameters
    ----------
    product : Dataset
        May be lazy; flags are read in blocks of bounded memory.
    below : float, optional
        Height above the station, m, below which a profile must have a usable value to count.
    """
    if QUALITY_FLAG not in product:
        return QualityCounts(0, 0, 0, 0, 0, ())
    bits = bits_of(product)
    rejecting = rejecting_mask(bits)
    counts = FlagCounter(rejecting)
    profiles = available = 0
    low = _low(product, below)
    for block in blocks(product[QUALITY_FLAG], READ_VALUES):
        flags = np.atleast_1d(quality_bits(block))
        accepted = (flags & np.int64(rejecting)) == 0
        profiles += len(flags)
        seen = accepted[:, low].reshape(len(flags), -1) if accepted.ndim > 1 else accepted[:, None]
        available += int(np.count_nonzero(seen.any(axis=1)))
        counts.add(flags)
    verdicts, carried = counts.verdicts, counts.carried
    rows = [
        _flag_row(bit, carried[bit.mask], verdicts.values) for bit in bits if bit.mask in carried
    ]
    return QualityCounts(
        verdicts.values, verdicts.usable, verdicts.good, profiles, available, tuple(rows)
    )


def _low(product: xr.Dataset, below: float) -> NDArray[np.bool_] | slice:
    """Return which places of a profile are below a height above the station; all if unknown."""
    ground = {"altitude": scalar(product, "station_altitude"), "range": 0.0}
    for name, start in ground.items():
        along = product.variables.get(name)
        if start is not None and along is not None and along.dims == product[QUALITY_FLAG].dims[1:]:
            return np.asarray(along.values.astype(np.float64) - start <= below)
    return slice(None)


def _flag_row(bit: StoredBit, count: int, values: int) -> FlagRow:
    severity = "do not use" if bit.rejects else "use with care"
    return FlagRow(
        bit=bit.word,
        severity="unknown" if bit.severity is None else severity,
        css="bad" if bit.rejects else "care",
        meaning=bit.description,
        count=count,
        share=percent(count / values),
        width=max(1, round(100 * count / values)),
    )


def span(product: xr.Dataset) -> Span:
    """Return start and end of the data from the attributes, else from the times.

    Raises
    ------
    ValueError
        If the product has neither.
    """
    names = ("time_coverage_start", "time_coverage_end")
    ends = [str(product.attrs.get(name, "")) for name in names]
    if not all(ends):
        time = product["time"].values if "time" in product.variables else np.array([])
        if time.size == 0 or time.dtype.kind != "M":
            raise ValueError("has no time of measurement, neither as attributes nor as a variable")
        ends = [str(time.min()), str(time.max())]
    return Span(*(_second(text) for text in ends))


def _second(text: str) -> str:
    plain = text.strip().removesuffix("Z").removesuffix("+00:00")
    moment = np.datetime64(plain, "s")
    if np.isnat(moment):
        raise ValueError(f"has no time of measurement: {text!r}")
    return str(moment)


def variables(product: xr.Dataset) -> list[VariableRow]:
    """Return one row per variable except the provenance, coordinates first."""
    names = [*product.coords, *product.data_vars]
    return [
        VariableRow(
            name=str(name),
            dims=", ".join(f"{dim} {size}" for dim, size in product[name].sizes.items()),
            units=str(product[name].attrs.get("units", "")),
            about=str(product[name].attrs.get("long_name", "")),
        )
        for name in names
        if name != PROVENANCE
    ]


def campaign(product: xr.Dataset) -> str:
    """Return the title of the campaign, with which that of a product begins; its key without."""
    title, _, _ = attribute(product, "title", "").rpartition(": ")
    return title or attribute(product, "lidarops_campaign")


def middle(product: xr.Dataset, name: str) -> float | None:
    """Return the mean of a coordinate, of the crossings of a network; None without a value."""
    if name not in product.variables:
        return None
    values = product[name].values.astype(np.float64)
    values = values[np.isfinite(values)]
    return float(values.mean()) if values.size else None


def citation(product: xr.Dataset) -> str:
    """Return how to cite a product, from its attributes; empty without a title."""
    names = ("creator_name", "title", "product_version", "publisher_name", "naming_authority", "id")
    creator, title, version, publisher, authority, key = (
        attribute(product, name, "") for name in names
    )
    if not title:
        return ""
    year = attribute(product, "date_issued", attribute(product, "date_created", ""))[:4]
    who = " ".join(filter(None, (creator or publisher, year and f"({year})")))
    doi = attribute(product, "doi", "")
    identifier = doi or ":".join(filter(None, (authority, key)))
    issued = publisher if publisher != creator else ""
    # As in styles of citation: without an author the title comes first.
    begin = [who, title] if creator or publisher else [f"{title.rstrip('.')} {who}".strip()]
    parts = (*begin, version and f"Version {version}", issued, identifier)
    return " ".join(f"{part.rstrip('.')}." for part in parts if part)


def contact(product: xr.Dataset) -> str:
    """Return whom to ask about a product, by its attributes; empty without an address."""
    for role in ("creator", "publisher"):
        address = attribute(product, f"{role}_email", "")
        if address:
            return ", ".join(filter(None, (attribute(product, f"{role}_name", ""), address)))
    return ""


def origin(product: xr.Dataset) -> Origin:
    """Read the provenance of a product; problems are stated in the result, not raised."""
    if PROVENANCE not in product:
        return Origin(problem="the product has no provenance")
    try:
        document = json.loads(str(product[PROVENANCE].item()))
        return _origin(document)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        return Origin(problem=f"the provenance cannot be read: {error!r:.200}")


def _origin(document: Mapping[str, Any]) -> Origin:
    entities = document["entity"]
    product, plan = entities["lidarops:product"], entities["lidarops:plan"]
    software = document["agent"]["lidarops:software"]
    planned = json.loads(plan["lidarops:json"])
    return Origin(
        id=str(product["lidarops:id"]),
        plan_hash=str(plan["lidarops:sha256"]),
        code_version=str(software["lidarops:code_version"]),
        versions=tuple(str(item) for item in software["lidarops:versions"]),
        settings=json.dumps(
            json.loads(product["lidarops:settings"]), indent=1, sort_keys=True, ensure_ascii=False
        ),
        steps=tuple(_step(item) for item in planned["steps"]),
        left_out=tuple(_step(item) for item in planned["left_out"]),
        inputs=tuple(_inputs(document)),
    )


def _step(item: Mapping[str, Any]) -> StepRow:
    settings = item.get("settings", {})
    return StepRow(
        name=str(item["name"]),
        channel=" ".join(str(item[key]) for key in ("instrument", "channel") if item.get(key)),
        settings="\n".join(f"{key}: {_plain(settings[key])}" for key in sorted(settings)),
        reason=str(item["reason"]),
    )


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def _inputs(document: Mapping[str, Any]) -> list[InputRow]:
    roles: dict[str, set[str]] = {}
    for use in document["used"].values():
        roles.setdefault(use["prov:entity"], set()).add(str(use["prov:role"]))
    rows = []
    for key, entity in document["entity"].items():
        if "lidarops:path" in entity:
            paths = entity["lidarops:path"]
            role = ", ".join(sorted(roles.get(key, {"not stated"})))
            digest = str(entity["lidarops:sha256"])
            named = [paths] if isinstance(paths, str) else paths
            rows += [InputRow(str(path), role, digest) for path in named]
    return sorted(rows, key=lambda row: (row.role != "signal", row.role, row.path))
