"""The content of a product in words: times, position, provenance, variables, citation."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import datetime
from typing import Any, Final

import numpy as np
import xarray as xr

from lidarops.figures.product_names import attribute
from lidarops.netcdf.stored import StoredProduct

PROVENANCE: Final = "provenance"
_PLACES: Final = "range", "altitude", "latitude", "longitude", "station_altitude", "wavelength"
USED: Final = PROVENANCE, *_PLACES
"""Variables that tell the content of any product."""


def span(product: xr.Dataset) -> tuple[str, str]:
    """Return start and end of the data, UTC, ISO 8601 to the second.

    They are those of the attributes, else of the times.

    Raises
    ------
    ValueError
        If the product has neither.
    """
    names = ("time_coverage_start", "time_coverage_end")
    ends = [str(product.attrs.get(name, "")) for name in names]
    if not all(ends):
        time = product.variables["time"].values if "time" in product.variables else np.array([])
        if time.size == 0 or time.dtype.kind != "M":
            raise ValueError("has no time of measurement, neither as attributes nor as a variable")
        ends = [str(time.min()), str(time.max())]
    return _second(ends[0]), _second(ends[1])


def utc_moment(text: str) -> np.datetime64:
    """Return a time in UTC; without an offset from UTC it is UTC.

    Raises
    ------
    ValueError
        If the text is not a date or a time with its date, ISO 8601.
    """
    moment = datetime.fromisoformat(text)
    offset = np.timedelta64(moment.utcoffset() or 0)
    return np.datetime64(moment.replace(tzinfo=None)) - offset


def _second(text: str) -> str:
    plain = text.strip().removesuffix("Z").removesuffix("+00:00")
    moment = np.datetime64(plain, "s")
    if np.isnat(moment):
        raise ValueError(f"has no time of measurement: {text!r}")
    return str(moment)


def variables(product: StoredProduct) -> list[tuple[str, str, str, str]]:
    """Return name, dimensions, units and meaning of all variables but the provenance."""
    return [
        (
            name,
            ", ".join(map("{} {}".format, variable.written, variable.shape)),
            str(variable.attrs.get("units", "")),
            str(variable.attrs.get("long_name", "")),
        )
        for name, variable in product.variables.items()
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
    values = product.variables[name].values.astype(np.float64)
    values = values[np.isfinite(values)]
    return float(values.mean()) if values.size else None


def citation(product: StoredProduct | xr.Dataset) -> str:
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


def contact(product: StoredProduct) -> str:
    """Return whom to ask about a product, by its attributes; empty without an address."""
    for role in ("creator", "publisher"):
        address = attribute(product, f"{role}_email", "")
        if address:
            return ", ".join(filter(None, (attribute(product, f"{role}_name", ""), address)))
    return ""


def origin(product: xr.Dataset) -> dict[str, Any]:
    """Return the provenance of a product as its page shows it, or `problem`: why there is none."""
    if PROVENANCE not in product.variables:
        return {"problem": "the product has no provenance", "inputs": []}
    try:
        return _origin(json.loads(str(product.variables[PROVENANCE].values.item())))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        return {"problem": f"the provenance cannot be read: {error!r:.200}", "inputs": []}


def _origin(document: Mapping[str, Any]) -> dict[str, Any]:
    entities = document["entity"]
    product, plan = entities["lidarops:product"], entities["lidarops:plan"]
    software = document["agent"]["lidarops:software"]
    planned = json.loads(plan["lidarops:json"])
    settings = json.loads(product["lidarops:settings"])
    return {
        "problem": "",
        "id": product["lidarops:id"],
        "plan": plan["lidarops:sha256"],
        "code_version": software["lidarops:code_version"],
        "versions": ", ".join(software["lidarops:versions"]),
        "settings": json.dumps(settings, indent=1, sort_keys=True, ensure_ascii=False),
        "steps": [_step(item) for item in planned["steps"]],
        "left_out": [(name, of, why) for name, of, _, why in map(_step, planned["left_out"])],
        "inputs": _inputs(document),
    }


def _step(item: Mapping[str, Any]) -> tuple[str, str, str, str]:
    """Return name, channel (in a network with its instrument), settings and reason of a step."""
    settings = {
        key: value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
        for key, value in sorted(item.get("settings", {}).items())
    }
    return (
        str(item["name"]),
        " ".join(str(item[key]) for key in ("instrument", "channel") if item.get(key)),
        "\n".join(f"{key}: {value}" for key, value in settings.items()) or "none",
        str(item["reason"]),
    )


def _inputs(document: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return path, role and sha256 of the raw files, signals first."""
    roles: dict[str, set[str]] = {}
    for use in document["used"].values():
        roles.setdefault(use["prov:entity"], set()).add(str(use["prov:role"]))
    rows = []
    for key, entity in document["entity"].items():
        paths = entity.get("lidarops:path", [])
        for path in [paths] if isinstance(paths, str) else paths:
            role = ", ".join(sorted(roles.get(key, {"not stated"})))
            rows.append((str(path), role, str(entity["lidarops:sha256"])))
    return sorted(rows, key=lambda row: (row[1] != "signal", row[1], row[0]))
