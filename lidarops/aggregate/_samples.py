"""Reads from a product what means need: values, error components, flags and times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.aggregate._sums import Array, Sample
from lidarops.aggregate.facts import Facts, opened, refuse_changed
from lidarops.aggregate.means_variables import averaged, budget_of, states_clouds, systematic
from lidarops.kinds import flags_of
from lidarops.netcdf.quantities import CLOUD_FRACTION, CLOUD_MASK
from lidarops.netcdf.stored_flags import with_current_flags
from lidarops.netcdf.variables import (
    QUALITY_FLAG,
    ErrorBudget,
    Row,
    layout_of,
)
from lidarops.system.files import within


@dataclass(frozen=True, slots=True)
class Profiles:
    """The profiles of one product, in memory."""

    facts: Facts
    attributes: Mapping[str, Any]
    times: Array
    """s since 1970, middle of each profile."""
    samples: Mapping[str, Sample]
    flags: NDArray[np.int32]
    """Bits at the places of now, whatever their places in the file."""
    shots: Array
    cloud_fraction: Array | None
    """Share of cloudy profiles of each value; NaN where it is not known. None for kinds that seek
    no clouds."""


def read_profiles(root: Path, facts: Facts) -> Profiles:
    """Read what means need from a product, completely, so that a damaged product affects no sum.

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
        If the product cannot be read, has changed since its facts were read, or carries a quality
        bit that its kind does not have.
    """
    with opened(within(root, facts.path)) as product:
        refuse_changed(product, facts)
        flags = with_current_flags(product)[QUALITY_FLAG].values
        usable = (flags & np.int32(flags_of(facts.kind).rejecting)) == 0
        rows = [row for row in averaged(facts.kind) if row.name in product]
        return Profiles(
            facts,
            dict(product.attrs),
            product["time"].values,
            {row.name: _sample(product, facts.kind, row, usable) for row in rows},
            flags,
            product["shots"].values.astype(np.float64),
            _cloud_fraction(product, facts.kind),
        )


def _cloud_fraction(product: xr.Dataset, kind: str) -> Array | None:
    """Return the share of cloudy profiles: 1 also where only the mean shows a cloud."""
    if not states_clouds(kind):
        return None
    if CLOUD_FRACTION not in product:
        return np.full(product[QUALITY_FLAG].shape, np.nan)
    fraction = numbers(product, CLOUD_FRACTION)
    cloudy = product[CLOUD_MASK].values == layout_of(kind).row(CLOUD_MASK).code("cloudy")
    return np.where(cloudy & np.isnan(fraction), 1.0, fraction)


def _sample(product: xr.Dataset, kind: str, row: Row, usable: NDArray[np.bool_]) -> Sample:
    values = numbers(product, row.name)
    errors = numbers(product, f"{row.name}_standard_error")
    budget = budget_of(row)
    random, shared = (errors, ()) if budget is None else _divide(product, budget, errors)
    has_flags = row.dims == product[QUALITY_FLAG].dims
    return Sample(
        values,
        errors,
        random,
        shared,
        _systematic_errors(product, kind, row, values, errors),
        usable if has_flags else np.ones(values.shape, np.bool_),
    )


def _systematic_errors(
    product: xr.Dataset, kind: str, row: Row, values: Array, errors: Array
) -> dict[str, Array]:
    """Return the systematic errors that are not part of the standard error, by variable."""
    names = systematic(kind, row.name)
    if row.lower_end:
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = values / numbers(product, row.lower_end) - 1.0
            # With hardly any systematic error, rounding may give a negative difference.
            error = values * np.sqrt(np.maximum(relative**2 - (errors / values) ** 2, 0.0))
        return dict.fromkeys(names, error)
    return {name: numbers(product, name) for name in names if name in product}


def _divide(
    product: xr.Dataset, budget: ErrorBudget, errors: Array
) -> tuple[Array, tuple[Array, ...]]:
    """Divide a standard error into a part independent between profiles and shared parts."""
    variance = np.zeros_like(errors)
    for name in budget.random:
        variance += numbers(product, name) ** 2
    random = np.sqrt(variance)
    if budget.times:
        random = random * numbers(product, budget.times)
    if budget.over:
        random = random / numbers(product, budget.over)
    if budget.shared:
        return random, tuple(numbers(product, name) for name in budget.shared)
    # Stored errors are rounded, so the difference may be slightly negative.
    return random, (np.sqrt(np.maximum(errors**2 - random**2, 0.0)),)


def numbers(product: xr.Dataset, name: str) -> Array:
    """Return a variable of an undecoded product in double precision; missing values are NaN."""
    variable = product[name]
    values: Array = variable.values.astype(np.float64)
    fill = variable.attrs.get("_FillValue")
    return values if fill is None else np.where(variable.values == fill, np.nan, values)
