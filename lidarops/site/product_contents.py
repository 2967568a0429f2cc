"""What a product holds, as plain text and numbers for its page."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.figures.wording import bit_name, percent
from lidarops.flags import Quality, Severity
from lidarops.netcdf.variables import QUALITY_FLAG
from lidarops.site.product_entry import UNKNOWN

PROVENANCE: Final = "provenance"
_READ_BYTES: Final = 16_000_000
"""Bound on what is held in memory of the flags."""
_BITS: Final = 31


@dataclass(frozen=True, slots=True)
class FlagRow:
    """One quality bit that values carry."""

    bit: str
    severity: str
    css: str
    meaning: str
    count: int
    share: str
    width: int
    """Whole percent, for a bar."""


@dataclass(frozen=True, slots=True)
class Judged:
    """What the quality bits say of the values of a product."""

    values: int
    usable: int
    unflagged: int
    rows: tuple[FlagRow, ...]


@dataclass(frozen=True, slots=True)
class StepRow:
    """A step that ran, or one that was left out."""

    name: str
    of: str
    """Channel, and instrument in a network."""
    settings: str
    reason: str


@dataclass(frozen=True, slots=True)
class InputRow:
    """A file that a product was made from."""

    path: str
    role: str
    sha256: str


@dataclass(frozen=True, slots=True)
class Origin:
    """Where a product came from, read of its PROV-JSON; empty where it has none."""

    text: str = ""
    """The document itself."""
    id: str = ""
    plan_hash: str = ""
    code_version: str = ""
    versions: tuple[str, ...] = ()
    settings: str = ""
    steps: tuple[StepRow, ...] = ()
    left_out: tuple[StepRow, ...] = ()
    inputs: tuple[InputRow, ...] = ()
    problem: str = ""
    """Why there is none, or less than there should be."""


@dataclass(frozen=True, slots=True)
class VariableRow:
    """One variable of a product."""

    name: str
    dims: str
    units: str
    about: str


@dataclass(frozen=True, slots=True)
class Span:
    """When the data of a product begin and end, UTC, ISO 8601 to the second."""

    start: str
    stop: str


def judge(product: xr.Dataset) -> Judged:
    """Count the values of a product by quality bit.

    Parameters
    ----------
    product : Dataset
        May be lazy: flags are read in blocks of bounded memory.
    """
    if QUALITY_FLAG not in product:
        return Judged(0, 0, 0, ())
    counts = np.zeros(_BITS, dtype=np.int64)
    values = usable = unflagged = 0
    rejecting = np.int64(Quality.rejecting())
    for flags in _blocks(product[QUALITY_FLAG]):
        values += flags.size
        usable += int(np.count_nonzero((flags & rejecting) == 0))
        raised = flags[flags != 0]
        unflagged += flags.size - raised.size
        for bit in range(_BITS):
            counts[bit] += np.count_nonzero(raised & np.int64(1 << bit))
    rows = [_flag_row(1 << bit, int(counts[bit]), values) for bit in range(_BITS) if counts[bit]]
    return Judged(values, usable, unflagged, tuple(rows))


def _blocks(flags: xr.DataArray) -> Iterator[NDArray[np.int64]]:
    first = flags.dims[0] if flags.dims else None
    if first is None or flags.size == 0:
        yield _integers(flags)
        return
    length = flags.sizes[first]
    step = max(1, _READ_BYTES * length // (8 * flags.size))
    for start in range(0, length, step):
        yield _integers(flags.isel({first: slice(start, start + step)}))


def _integers(flags: xr.DataArray) -> NDArray[np.int64]:
    values = np.atleast_1d(flags.values)
    if values.dtype.kind == "f":
        values = np.where(np.isfinite(values), values, float(Quality.INPUT_MISSING))
    return np.asarray(values, dtype=np.int64)


def _flag_row(bit: int, count: int, values: int) -> FlagRow:
    known = bit in [int(member) for member in Quality]
    rejects = known and Quality(bit).severity is Severity.REJECT
    severity = "do not use" if rejects else "use with care"
    return FlagRow(
        bit=bit_name(Quality(bit)) if known else f"bit {bit.bit_length() - 1}",
        severity=severity if known else "unknown",
        css="bad" if rejects or not known else "care",
        meaning=Quality(bit).description
        if known
        else "this version of lidarops does not know the bit",
        count=count,
        share=percent(count / values),
        width=max(1, round(100 * count / values)),
    )


def span(product: xr.Dataset) -> Span:
    """Return when the data begin and end, from the attributes or else the times themselves.

    Raises
    ------
    ValueError
        If the product says neither.
    """
    names = ("time_coverage_start", "time_coverage_end")
    told = [str(product.attrs.get(name, "")) for name in names]
    if not all(told):
        time = product["time"].values if "time" in product.variables else np.array([])
        if time.size == 0 or time.dtype.kind != "M":
            raise ValueError("says neither in its attributes nor by a time when it was measured")
        told = [str(time.min()), str(time.max())]
    return Span(*(_second(text) for text in told))


def _second(text: str) -> str:
    plain = text.strip().removesuffix("Z").removesuffix("+00:00")
    moment = np.datetime64(plain, "s")
    if np.isnat(moment):
        raise ValueError(f"has no time of measurement: {text!r}")
    return str(moment)


def variables(product: xr.Dataset) -> list[VariableRow]:
    """Return one row for every variable but the provenance, coordinates first."""
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


def attribute(product: xr.Dataset, name: str, default: str = UNKNOWN) -> str:
    """Return a global attribute as text."""
    return str(product.attrs.get(name, "")).strip() or default


def origin(product: xr.Dataset) -> Origin:
    """Read the provenance of a product; what it lacks is named, not raised."""
    if PROVENANCE not in product:
        return Origin(problem="the product holds no provenance")
    try:
        text = str(product[PROVENANCE].item())
        document = json.loads(text)
        return _origin(text, document)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        return Origin(problem=f"the provenance cannot be read: {error!r:.200}")


def _origin(text: str, document: Mapping[str, Any]) -> Origin:
    entities = document["entity"]
    product, plan = entities["lidarops:product"], entities["lidarops:plan"]
    software = document["agent"]["lidarops:software"]
    planned = json.loads(plan["lidarops:json"])
    return Origin(
        text=json.dumps(document, indent=1, sort_keys=True) + "\n" if text else "",
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
        of=" ".join(str(item[key]) for key in ("instrument", "channel") if item.get(key)),
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
