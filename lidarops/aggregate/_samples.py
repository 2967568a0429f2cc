"""What means need of a product: quantities with the parts of their errors, flags, times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.aggregate._sums import Array, Sample
from lidarops.aggregate.facts import Facts, opened, within
from lidarops.aggregate.means_variables import (
    INTERVALS,
    Budget,
    averaged,
    budget_of,
    systematic,
)
from lidarops.errors import ProductError
from lidarops.flags import Quality
from lidarops.netcdf.variables import QUALITY_FLAG, Row
from lidarops.records import ProductKind


@dataclass(frozen=True, slots=True)
class Profiles:
    """The profiles of one product, in memory."""

    facts: Facts
    attributes: Mapping[str, Any]
    times: Array
    """s since 1970, middle of each profile."""
    samples: Mapping[str, Sample]
    flags: NDArray[np.int32]
    shots: Array


def read_profiles(root: Path, facts: Facts) -> Profiles:
    """Read what means need of a product, all of it, so that a damaged one spoils no sum.

    Parameters
    ----------
    root : path
    facts : Facts

    Returns
    -------
    Profiles

    Raises
    ------
    ProductError
        If the product cannot be read, has changed since its facts were read.
    """
    with opened(within(root, facts.path)) as product:
        if product.attrs["id"] != facts.id:
            raise ProductError("changed while it was read", file=facts.path, remedy="run again")
        flags = product[QUALITY_FLAG].values
        wanted = (flags & np.int32(Quality.rejecting())) == 0
        rows = [row for row in averaged(facts.kind) if row.name in product]
        return Profiles(
            facts,
            dict(product.attrs),
            product["time"].values,
            {row.name: _sample(product, facts.kind, row, wanted) for row in rows},
            flags,
            product["shots"].values.astype(np.float64),
        )


def _sample(product: xr.Dataset, kind: ProductKind, row: Row, wanted: NDArray[np.bool_]) -> Sample:
    values = numbers(product, row.name)
    errors = numbers(product, f"{row.name}_standard_error")
    found = budget_of(kind, row.name)
    random, shared = (errors, ()) if found is None else _divided(product, found, errors)
    judged = row.dims == product[QUALITY_FLAG].dims
    return Sample(
        values,
        errors,
        random,
        shared,
        _apart(product, kind, row.name, values, errors),
        wanted if judged else np.ones(values.shape, np.bool_),
    )


def _apart(
    product: xr.Dataset, kind: ProductKind, name: str, values: Array, errors: Array
) -> Array | None:
    """Return the error that stands apart from the standard error, or that an interval tells."""
    if name in INTERVALS:
        with np.errstate(divide="ignore", invalid="ignore"):
            whole = values / numbers(product, INTERVALS[name]) - 1.0
            # Where there is nearly no systematic error, rounding may leave less than nothing.
            apart: Array = values * np.sqrt(np.maximum(whole**2 - (errors / values) ** 2, 0.0))
        return apart
    found = systematic(kind, name)
    return numbers(product, found) if found and found in product else None


def _divided(product: xr.Dataset, found: Budget, errors: Array) -> tuple[Array, tuple[Array, ...]]:
    """Divide a standard error into what is new in every profile and what is shared."""
    variance = np.zeros_like(errors)
    for name in found.random:
        variance += numbers(product, name) ** 2
    random = np.sqrt(variance)
    if found.times:
        random = random * numbers(product, found.times)
    if found.over:
        random = random / numbers(product, found.over)
    if found.shared:
        return random, tuple(numbers(product, name) for name in found.shared)
    # Stored errors are rounded, so that the difference may be a little less than nothing.
    return random, (np.sqrt(np.maximum(errors**2 - random**2, 0.0)),)


def numbers(product: xr.Dataset, name: str) -> Array:
    """Return a variable of a product that is not decoded, NaN where it is missing."""
    variable = product[name]
    values: Array = variable.values.astype(np.float64)
    fill = variable.attrs.get("_FillValue")
    return values if fill is None else np.where(variable.values == fill, np.nan, values)
