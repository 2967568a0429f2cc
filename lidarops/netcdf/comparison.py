"""How a product differs from another one of the same kind, channel and scene, and why."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import ProductError
from lidarops.netcdf.provenance import read_provenance
from lidarops.netcdf.variables import PROVENANCE
from lidarops.records import Change, Grade

MINOR: Final = 0.1
"""Largest difference of a minor change, in standard errors: an interval of 95 % that is off by it
covers 94.9 %."""

_MAKING: Final = frozenset(
    {
        "id", "history", "product_version", "date_created", "date_modified", "date_issued",
        "date_metadata_modified", "lidarops_plan_sha256", "lidarops_code_version",
    }
)  # fmt: skip
"""Global attributes that state how and when a product was made, not what it holds."""
_BLOCK: Final = 1 << 26
"""Bytes of a variable that are compared at a time."""
_MOST_CAUSES: Final = 20
_ERROR: Final = "_standard_error"

Values = NDArray[Any]


def compare_products(old: Path, new: Path) -> Change:
    """Return how a product differs from an older one.

    Parameters
    ----------
    old, new : Path
        Files of products.

    Returns
    -------
    Change
        None where values and texts are the same, apart from those that state how and when a
        product was made; minor where all values are within `MINOR` standard errors of `old`, or
        within that share of their size where no error is stated, and the same values are missing
        and rejected.

    Raises
    ------
    ProductError
        If a file cannot be read, or is no product.
    """
    causes = tuple(_causes(_making(old), _making(new)))
    try:
        with (
            xr.open_dataset(old, engine="netcdf4", decode_cf=False, cache=False) as before,
            xr.open_dataset(new, engine="netcdf4", decode_cf=False, cache=False) as after,
        ):
            differences = dict(_differences(before, after))
            same_texts = _texts(before) == _texts(after)
            values = sum(before[name].size for name in _measured(before))
    # The type of HDF5's error depends on the place of the damage.
    except (OSError, RuntimeError, ValueError) as error:
        raise ProductError(f"cannot be compared with {old}: {error}", file=new) from error
    largest = max((size for size, _ in differences.values()), default=0.0)
    variable = next((name for name, (size, _) in differences.items() if size == largest), "")
    changed = sum(count for _, count in differences.values())
    grade = Grade.MAJOR if largest > MINOR else Grade.MINOR
    if not differences and same_texts:
        grade = Grade.NONE
    return Change(grade, largest, variable, changed / values if values else 0.0, causes)


def _measured(product: xr.Dataset) -> list[str]:
    """Return the variables whose values are compared."""
    return [str(name) for name in product.variables if name != PROVENANCE.name]


def _texts(product: xr.Dataset) -> Mapping[str, Any]:
    """Return the attributes that state what a product holds."""
    own = {key: value for key, value in product.attrs.items() if key not in _MAKING}
    owners = {"": own, **{name: product[name].attrs for name in _measured(product)}}
    return {
        f"{owner}:{key}": np.asarray(value).tolist()
        for owner, attributes in owners.items()
        for key, value in attributes.items()
    }


def _differences(old: xr.Dataset, new: xr.Dataset) -> Iterator[tuple[str, tuple[float, int]]]:
    """Yield the variables that differ, with the largest difference and the number of values."""
    names = _measured(old)
    for name in sorted(set(names) ^ set(_measured(new))):
        yield name, (math.inf, old[name].size if name in old.variables else 0)
    for name in names:
        if name not in new.variables:
            continue
        before, after = old[name].variable, new[name].variable
        if (before.shape, before.dtype) != (after.shape, after.dtype):
            yield name, (math.inf, before.size)
            continue
        error = old[name + _ERROR].variable if name + _ERROR in old.variables else None
        pieces = [
            _difference(
                before[part].values,
                after[part].values,
                None if error is None or error.shape != before.shape else error[part].values,
                before.attrs.get("_FillValue"),
            )
            for part in _parts(before)
        ]
        count = sum(number for _, number in pieces)
        if count:
            yield name, (max(size for size, _ in pieces), count)


def _parts(variable: xr.Variable) -> Iterator[Any]:
    """Yield indices of parts of a variable that fit in memory."""
    if not variable.ndim or not variable.size:
        yield ...
        return
    rows = max(1, _BLOCK * variable.shape[0] // max(variable.nbytes, 1))
    for first in range(0, variable.shape[0], rows):
        yield slice(first, first + rows)


def _difference(old: Values, new: Values, error: Values | None, fill: object) -> tuple[float, int]:
    """Return the largest difference of some values, and the number of values that differ."""
    if old.dtype.kind not in "if":
        count = int(np.count_nonzero(old != new))
        return (math.inf if count else 0.0), count
    missing, now_missing = ((_missing(values, fill)) for values in (old, new))
    differs = (old != new) & ~(missing & now_missing)
    count = int(np.count_nonzero(differs))
    if not count:
        return 0.0, 0
    if old.dtype.kind == "i" or (missing != now_missing)[differs].any():
        # Bits and counts have no size; values came or went.
        return math.inf, count
    before, after = (np.float64(values[differs]) for values in (old, new))
    if not (np.isfinite(before) & np.isfinite(after)).all():
        # The distance from an infinite bound has no size: inf / inf is NaN.
        return math.inf, count
    scale = np.abs(before)
    if error is not None:
        scale = np.where(_missing(error, fill)[differs], scale, np.float64(error[differs]))
    with np.errstate(divide="ignore"):
        return float(np.max(np.abs(after - before) / scale)), count


def _missing(values: Values, fill: object) -> NDArray[np.bool_]:
    unknown = np.isnan(values) if values.dtype.kind == "f" else np.zeros(values.shape, np.bool_)
    return unknown if fill is None else unknown | (values == fill)


def _making(file: Path) -> dict[str, dict[str, str]]:
    """Return what a product was made from and with, by its provenance."""
    document = read_provenance(file)
    try:
        return {
            "input": _inputs(document),
            "setting": _settings(document),
            "step": _steps(document),
            "software": _software(document),
        }
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise ProductError(
            f"does not say how it was made: {error!r}",
            file=file,
            field="provenance",
            remedy="compare products of lidarops",
        ) from error


def _causes(
    old: Mapping[str, Mapping[str, str]], new: Mapping[str, Mapping[str, str]]
) -> Iterator[str]:
    """Yield what differs in the making of two products."""
    causes = [cause for what in old for cause in _changes(what, old[what], new[what])]
    yield from causes[:_MOST_CAUSES]
    if len(causes) > _MOST_CAUSES:
        yield f"and {len(causes) - _MOST_CAUSES} more"


def _changes(what: str, old: Mapping[str, str], new: Mapping[str, str]) -> Iterator[str]:
    for name in sorted({*old, *new}):
        before, after = old.get(name, "absent"), new.get(name, "absent")
        if before != after:
            yield f"{what} {name}: {_short(before)} -> {_short(after)}"


def _short(text: str) -> str:
    return text if len(text) <= 60 else f"{text[:57]}..."


def _inputs(document: Mapping[str, Any]) -> dict[str, str]:
    """Return path -> digest of the inputs."""
    inputs = {}
    for entity in document["entity"].values():
        paths = entity.get("lidarops:path", ())
        for path in [paths] if isinstance(paths, str) else paths:
            inputs[str(path)] = str(entity["lidarops:sha256"])[:12]
    return inputs


def _settings(document: Mapping[str, Any]) -> dict[str, str]:
    """Return setting -> value, of facts, settings and texts of the campaign."""
    settings = json.loads(document["entity"]["lidarops:product"]["lidarops:settings"])
    return dict(_flat("", settings))


def _flat(key: str, value: Any) -> Iterator[tuple[str, str]]:
    if isinstance(value, dict) and value:
        for name, item in value.items():
            yield from _flat(f"{key}.{name}" if key else name, item)
    else:
        yield key, json.dumps(value)


def _steps(document: Mapping[str, Any]) -> dict[str, str]:
    """Return step and channel -> its settings, of the plan."""
    plan = json.loads(document["entity"]["lidarops:plan"]["lidarops:json"])
    return {
        " ".join(part for part in (step["name"], step.get("channel", "")) if part): json.dumps(
            step.get("settings", {}), sort_keys=True
        )
        for step in plan["steps"]
    }


def _software(document: Mapping[str, Any]) -> dict[str, str]:
    """Return the version of each package, and of the code."""
    software = document["agent"]["lidarops:software"]
    packages = dict(package.split(" ", 1) for package in software["lidarops:versions"])
    return {**packages, "code": str(software["lidarops:code_version"])}
