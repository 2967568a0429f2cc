"""How a product differs from another one of the same kind, channel and scene, and why."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.errors import ProductError
from lidarops.flags import Severity
from lidarops.netcdf.read import open_product, read_provenance
from lidarops.netcdf.stored import reading
from lidarops.netcdf.stored_flags import flags_names, parts
from lidarops.netcdf.variables import PROVENANCE, judging, summary_of
from lidarops.records import Change, Grade, Measure, Plan

MINOR: Final = 0.1
"""Largest difference of a minor change, in standard errors: an interval of 95 % that is off by it
covers 94.9 %."""

MOST_STATES: Final = 0.01
"""Largest share of the values whose state (cloud or none) differs in a minor change, but for a
single one. Of `usable` it is a share of the good ones: whoever keeps these only then keeps 99 %."""

_MAKING: Final = frozenset(
    {
        "id", "history", "product_version", "date_created", "date_modified", "date_issued",
        "date_metadata_modified", "lidarops_plan_sha256", "lidarops_code_version",
    }
)  # fmt: skip
"""Global attributes that state how and when a product was made, not what it holds."""
_BLOCK: Final = 1 << 24
"""Values of a variable that are compared at a time."""
_MOST_CAUSES: Final = 20
_MOST_REASONS: Final = 3
"""Changes that name why a product is to be made again; the rest is counted."""
_EMPTY: Final = frozenset({"", "null", "{}", "[]"})
"""Values of settings that are the same as none."""
_LONGEST: Final = 60
"""Characters of a value of a cause."""
_SHARED: Final = 15
"""Of those, characters before the first that differs."""
_ERROR: Final = "_standard_error"
_MEANING: Final = ("standard_name", "units")
"""Attributes of a variable without which its values mean something else."""
_SAME: Final = ("kind", "station", "instrument", "channel", "scene")
"""Attributes ``lidarops_...`` that versions of a product share."""


@dataclass(frozen=True, slots=True)
class _Difference:
    """How a variable differs."""

    variable: str
    count: int
    """Number of values that differ."""
    lost: int = 0
    """Number of those that are missing or rejected in only one of the two."""
    flags: int = 0
    moved: str = ""
    """How its values are of another place, time, wavelength, unit or state."""
    largest: float = 0.0
    measure: Measure = Measure.SIZE


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
        within that share of their size where no error is stated, at the same coordinates and in
        the same units, the same values are missing and rejected, and at most `MOST_STATES` of the
        values, of `usable` of the good ones, are in another state. Values that are rejected in
        both are not measured, and other flags of a value are counted only.

    Raises
    ------
    ProductError
        If a file cannot be read, is no product, or is another product.
    """
    then, now = _making(old), _making(new)
    causes = [cause for what in then for cause in _changes(what, then[what], now[what])]
    try:
        with reading(new), _opened(old) as before, _opened(new) as after:
            _refuse_another(before, after, new)
            differences = [d for d in _differences(before, after) if d.count or d.lost or d.moved]
            same_texts = _texts(before) == _texts(after)
            sizes = {name: part[name].size for part in (before, after) for name in _measured(part)}
    except ProductError:
        # It names the new one, also where values of the old one cannot be read.
        with reading(old), _opened(old) as before:
            for variable in before.variables.values():
                for part in parts(variable, _BLOCK):
                    _ = variable[part].values
        raise
    most = max(differences, key=lambda d: d.largest, default=_Difference("", 0))
    lost = sum(d.lost for d in differences)
    first_lost = next((d.variable for d in differences if d.lost), "")
    moved = next((d.moved for d in differences if d.moved), "")
    grade = Grade.MAJOR if lost or moved or most.largest > MINOR else Grade.MINOR
    if not differences and same_texts:
        grade = Grade.NONE
    return Change(
        grade,
        most.largest,
        most.variable if most.largest else first_lost,
        sum(d.count for d in differences) / max(sum(sizes.values()), 1),
        _first_causes(causes, _MOST_CAUSES),
        measure=most.measure,
        lost=lost,
        flags=sum(d.flags for d in differences),
        moved=moved,
    )


class QuantityChange(NamedTuple):
    """How a quantity differs where both versions have a usable value, in its unit."""

    quantity: str
    unit: str
    values: int
    before: float
    """Mean."""
    change: float
    """Mean of the differences, new less old."""
    largest: float
    """Difference of the largest size."""


def quantity_changes(old: Path, new: Path) -> list[QuantityChange]:
    """Return how each quantity with a standard error differs from that of an older product.

    Raises
    ------
    ProductError
        If a file cannot be read.
    """
    found = []
    with reading(new), _opened(old) as before, _opened(new) as after:
        names = [name for name in _measured(before) if f"{name}{_ERROR}" in before]
        for name in (name for name in names if name in after and "time" in before[name].dims):
            pair = before[name].variable, after[name].variable
            if pair[0].shape != pair[1].shape or not pair[0].size:
                continue
            values, total, moved, largest = 0, 0.0, 0.0, 0.0
            for part in parts(pair[0], _BLOCK):
                both = _stated(before, name, part) & _stated(after, name, part)
                then, now = (_numbers(variable, part)[both] for variable in pair)
                change = now - then
                values += then.size
                total, moved = total + float(then.sum()), moved + float(change.sum())
                ends = float(change.min(initial=0.0)), float(change.max(initial=0.0))
                largest = max(largest, *ends, key=abs)
            unit, of = str(pair[0].attrs.get("units", "")), max(values, 1)
            found.append(QuantityChange(name, unit, values, total / of, moved / of, largest))
    return found


def _opened(file: Path) -> AbstractContextManager[xr.Dataset]:
    """Open a product whose missing values are NaN, and are not decoded otherwise."""
    return open_product(file, decode_times=False)


def _refuse_another(before: xr.Dataset, after: xr.Dataset, new: Path) -> None:
    for name in (f"lidarops_{word}" for word in _SAME):
        states = [str(product.attrs.get(name, "")) for product in (before, after)]
        if states[0] != states[1]:
            raise ProductError(
                f"is {states[1]!r}, not {states[0]!r} as in the older file",
                file=new,
                field=name,
                remedy="compare two versions of one product",
            )


def _measured(product: xr.Dataset) -> list[str]:
    """Return the variables whose values are compared."""
    return [str(name) for name, array in product.variables.items() if array.dtype.kind in "if"]


def _texts(product: xr.Dataset) -> Mapping[str, Any]:
    """Return the texts and attributes that state what a product holds."""
    own = {key: value for key, value in product.attrs.items() if key not in _MAKING}
    names = [str(name) for name in product.variables if name != PROVENANCE.name]
    owners = {"": own, **{name: product[name].attrs for name in names}}
    attributes = {
        f"{owner}:{key}": np.asarray(value).tolist()
        for owner, attributes in owners.items()
        for key, value in attributes.items()
    }
    texts = {name: product[name].values.tolist() for name in set(names) - {*_measured(product)}}
    return {**attributes, **texts}


def _differences(old: xr.Dataset, new: xr.Dataset) -> Iterator[_Difference]:
    """Yield the differences of all variables."""
    names = _measured(old)
    for name in sorted(set(names) ^ set(_measured(new))):
        size = (old if name in old.variables else new)[name].size
        yield _Difference(name, size, lost=size)
    quantities = dict(_quantities(old))
    places = _places(old) | _places(new)
    summaries = {summary_of(flags) for flags in flags_names(old)}
    for name in names:
        if name not in new.variables:
            continue
        before, after = old[name].variable, new[name].variable
        if (before.shape, before.dtype) != (after.shape, after.dtype):
            size = max(before.size, after.size)
            yield _Difference(name, size, lost=size)
            continue
        count = sum(int(_differs(before, after, part).sum()) for part in parts(before, _BLOCK))
        is_summary = name in summaries
        good = int((before.to_numpy() == 0).sum()) if is_summary else 0
        allowed = max(MOST_STATES * (good or before.size), 1)
        many = f"other states of {name}" if count > allowed else ""
        if any(before.attrs.get(key) != after.attrs.get(key) for key in _MEANING):
            yield _Difference(name, before.size, moved=f"another meaning of {name}")
        elif name in places:
            yield _Difference(name, count, moved=f"another {name}" if count else "")
        elif is_summary:
            # What it changes is counted as lost values, or as other flags.
            yield _Difference(name, count, moved=many)
        elif "flag_meanings" in before.attrs:
            of_states = "flag_masks" not in before.attrs
            yield _Difference(name, count, flags=count, moved=many if of_states else "")
        else:
            yield _difference(old, new, name, quantities.get(name, name), count)


def _places(product: xr.Dataset) -> set[str]:
    """Return the variables that state where, when and at which wavelength values are."""
    names = {str(name) for name in product.dims}
    for attributes in (product.attrs, *(array.attrs for array in product.variables.values())):
        names |= {*str(attributes.get("coordinates", "")).split(), attributes.get("bounds", "")}
    return names


def _quantities(product: xr.Dataset) -> Iterator[tuple[str, str]]:
    """Yield the variables that hold an error, with the quantity that it is of."""
    names = _measured(product)
    # The longest name comes last, and counts.
    for quantity in sorted((name for name in names if name + _ERROR in names), key=len):
        for name in names:
            is_error = name.startswith(f"{quantity}_") and "error_kind" in product[name].attrs
            if is_error and product[name].shape == product[quantity].shape:
                yield name, quantity


def _difference(
    old: xr.Dataset, new: xr.Dataset, name: str, quantity: str, count: int
) -> _Difference:
    """Return how a variable differs that holds a quantity, or one of the errors of a quantity."""
    before, after = old[name].variable, new[name].variable
    error = old.variables.get(f"{quantity}{_ERROR}")
    measure = Measure.SIZE
    if error is not None:
        measure = Measure.ERROR if name == quantity else Measure.OF_ERROR
    usual = 0.0
    if count:
        # The root mean square.
        total = sum(float(np.sum(_numbers(before, part) ** 2)) for part in parts(before, _BLOCK))
        usual = math.sqrt(total / max(before.size, 1))
    lost, largest = 0, 0.0
    for part in parts(before, _BLOCK):
        stated, now_stated = (_stated(product, quantity, part) for product in (old, new))
        if name == quantity:
            lost += int(np.count_nonzero(stated != now_stated))
        both = stated & now_stated
        then, now = (_numbers(variable, part)[both] for variable in (before, after))
        scale = np.maximum(np.abs(then), usual)
        if error is not None:
            errors = _numbers(error, part)[both]
            scale = np.where(errors > 0.0, errors, scale)
        scale = np.where(scale > 0.0, scale, np.abs(now))
        moved = np.abs(now - then)
        largest = max(largest, float(np.max(moved[moved > 0.0] / scale[moved > 0.0], initial=0.0)))
    return _Difference(name, count, lost=lost, largest=largest, measure=measure)


def _differs(before: xr.Variable, after: xr.Variable, part: Any) -> NDArray[np.bool_]:
    """Return which values of a part differ."""
    then, now = (variable[part].values for variable in (before, after))
    differs: NDArray[np.bool_] = (then != now) & ~(np.isnan(then) & np.isnan(now))
    return differs


def _stated(product: xr.Dataset, name: str, part: Any) -> NDArray[np.bool_]:
    """Return which values of a part are finite, not missing and not rejected."""
    variable = product[name].variable
    stated: NDArray[np.bool_] = np.isfinite(variable[part].values)
    usable = product.variables.get(summary_of(judging(name, flags_names(product))))
    if usable is None or usable.dims != variable.dims:
        return stated
    kept: NDArray[np.bool_] = usable[part].values != int(Severity.REJECT)
    return stated & kept


def _numbers(variable: xr.Variable, part: Any) -> NDArray[np.float64]:
    """Return the values of a part, 0 where they are missing."""
    values = np.asarray(variable[part].values, np.float64)
    return np.where(np.isfinite(values), values, 0.0)


def _making(file: Path) -> dict[str, dict[str, str]]:
    """Return what a product was made from and with, by its provenance."""
    document = read_provenance(file)
    try:
        entities, software = document["entity"], document["agent"]["lidarops:software"]
        settings = json.loads(entities["lidarops:product"]["lidarops:settings"])
        packages = dict(package.split(" ", 1) for package in software["lidarops:versions"])
        return {
            "input": dict(_inputs(entities)),
            "setting": dict(_flat("", settings)),
            "step": _steps(json.loads(entities["lidarops:plan"]["lidarops:json"])),
            "software": {**packages, "code": str(software["lidarops:code_version"])},
        }
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise ProductError(
            f"does not say how it was made: {error!r}",
            file=file,
            field="provenance",
            remedy="compare products of lidarops",
        ) from error


def planned_changes(file: Path, settings: Mapping[str, Any], plan: Plan) -> tuple[str, ...]:
    """Return in what a product differs from what would be made now: settings, or else steps.

    Parameters
    ----------
    file : Path
        The product.
    settings : mapping
        Those that a new product would record.
    plan : Plan
        Its plan.

    Raises
    ------
    ProductError
        If the file cannot be read or does not say how it was made.
    """
    making = _making(file)
    changes = [*_changes("setting", making["setting"], dict(_flat("", settings)))]
    changes = changes or [*_changes("step", making["step"], _steps(plan.as_dict()))]
    return _first_causes(changes, _MOST_REASONS)


def _first_causes(causes: Sequence[str], most: int) -> tuple[str, ...]:
    """Return the first causes, and the number of the others."""
    more = (f"and {len(causes) - most} more",) if len(causes) > most else ()
    return (*causes[:most], *more)


def _changes(what: str, old: Mapping[str, str], new: Mapping[str, str]) -> Iterator[str]:
    for name in sorted({*old, *new}):
        before, after = (_value(part, name) for part in (old, new))
        if before != after:
            # Long texts from shortly before the first difference on.
            pairs = enumerate(zip(before, after, strict=False))
            shared = next((place for place, (old_one, new_one) in pairs if old_one != new_one), 0)
            first = max(shared - _SHARED, 0)
            yield f"{what} {name}: {_short(before, first)} -> {_short(after, first)}"


def _value(stated: Mapping[str, str], name: str) -> str:
    value = stated.get(name, "")
    return "absent" if value in _EMPTY else value


def _short(text: str, first: int) -> str:
    """Return a text of `_LONGEST` characters at most; of longer ones the part from `first` on."""
    if len(text) <= _LONGEST:
        return text
    part = text[first : first + _LONGEST]
    return f"{'...' * (first > 0)}{part}{'...' * (first + _LONGEST < len(text))}"


def _inputs(entities: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield path and digest of the inputs."""
    for entity in entities.values():
        paths = entity.get("lidarops:path", ())
        for path in [paths] if isinstance(paths, str) else paths:
            yield str(path), str(entity["lidarops:sha256"])[:12]


def _flat(key: str, value: Any) -> Iterator[tuple[str, str]]:
    if isinstance(value, dict) and (value or not key):
        for name, item in value.items():
            yield from _flat(f"{key}.{name}" if key else name, item)
    else:
        yield key, json.dumps(value)


def _steps(plan: Mapping[str, Any]) -> dict[str, str]:
    """Return step, channel and setting -> value, of a plan."""
    stated = {}
    for step in plan["steps"]:
        name = " ".join(part for part in (step["name"], step.get("channel", "")) if part)
        stated[name] = "runs"
        stated |= {f"{name} {key}": value for key, value in _flat("", step.get("settings") or {})}
    return stated
