"""Read what means need of products, and sum it: values, error components, flags, shots, clouds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops.aggregate.facts import Facts, opened, refuse_changed
from lidarops.aggregate.means_variables import (
    Weights,
    averaged,
    budget_of,
    states_clouds,
    systematic,
)
from lidarops.flags import Quality
from lidarops.kinds import flags_of
from lidarops.netcdf.quantities import CLOUD_FRACTION, CLOUD_MASK
from lidarops.netcdf.stored_flags import with_current_flags
from lidarops.netcdf.variables import QUALITY_FLAG, ErrorBudget, Row, layout_of, whole_error
from lidarops.system.files import within

_ALL_BITS: Final = np.int32(-1)
_WEIGHED: Final = np.int32(Quality.LOW_SIGNAL_TO_NOISE)

Array = NDArray[np.float64]
Counts = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Sample:
    """A quantity of one product; arrays of shape (time, ...)."""

    values: Array
    """NaN where missing."""
    errors: Array
    """Standard errors."""
    random: Array
    """The part of `errors` that is independent between profiles."""
    shared: tuple[Array, ...]
    """Signed errors that all profiles share, one array per cause."""
    systematic: Mapping[str, Array]
    """Variable -> systematic error that is not part of `errors`, shared by all profiles; NaN where
    it is missing."""
    usable: NDArray[np.bool_]
    """Whether no quality bit rejects the value."""

    def take(self, chosen: NDArray[np.intp]) -> Sample:
        """Return some of the profiles."""
        return Sample(
            self.values[chosen],
            self.errors[chosen],
            self.random[chosen],
            tuple(part[chosen] for part in self.shared),
            {name: error[chosen] for name, error in self.systematic.items()},
            self.usable[chosen],
        )


@dataclass(frozen=True, slots=True)
class Mean:
    """Mean and errors of a period; arrays of shape (...), NaN without a usable value."""

    mean: Array
    standard_error: Array
    standard_deviation: Array
    systematic: Mapping[str, Array]
    observations: Counts


@dataclass(slots=True)
class Sums:
    r"""Weighted sums of one quantity over the profiles of one period.

    With weights :math:`w_i`, random errors :math:`r_i` and shared errors :math:`s_{ki}` of cause
    :math:`k`, the mean and its variance are

    .. math::
        \bar x = \sum_i w_i x_i / W, \quad W = \sum_i w_i, \quad
        \sigma^2 = \sum_i w_i^2 r_i^2 / W^2 + \sum_k \left(\sum_i w_i s_{ki} / W\right)^2 .

    Shared errors are fully correlated between profiles, so they are averaged before they are
    squared (`gum2008`, section 5.2).
    """

    weight: Array
    value: Array
    random: Array
    shared: tuple[Array, ...]
    systematic: Mapping[str, Array]
    count: Counts
    centre: Array
    """Unweighted mean so far, for `spread`."""
    spread: Array
    """Sum of squared deviations from `centre`."""

    @classmethod
    def like(cls, sample: Sample) -> Sums:
        """Return empty sums with the shape of a sample."""
        zeros = np.zeros(sample.values.shape[1:])
        return cls(
            weight=zeros.copy(),
            value=zeros.copy(),
            random=zeros.copy(),
            shared=tuple(zeros.copy() for _ in sample.shared),
            systematic={name: zeros.copy() for name in sample.systematic},
            count=zeros.astype(np.int64),
            centre=zeros.copy(),
            spread=zeros.copy(),
        )

    def add(self, sample: Sample, weights: Array) -> None:
        """Add the profiles of one product.

        Parameters
        ----------
        sample : Sample
        weights : (time, ...) float
            Of each value; one that is not positive and finite is not used.
        """
        used = _used(sample) & (weights > 0.0) & np.isfinite(weights)
        # Unused values must be finite too, because 0 x NaN is NaN.
        weights = np.where(used, weights, 0.0)
        self.weight += weights.sum(axis=0)
        self.value += _sum(weights, sample.values, used)
        self.random += _sum(weights**2, sample.random**2, used)
        for total, part in zip(self.shared, sample.shared, strict=True):
            np.add(total, _sum(weights, part, used), out=total)
        for name, total in self.systematic.items():
            # The error of a mean is unknown where that of one profile is.
            np.add(total, np.where(used, weights * sample.systematic[name], 0.0).sum(0), out=total)
        self._spread(np.where(used, sample.values, 0.0), used)

    def _spread(self, values: Array, used: NDArray[np.bool_]) -> None:
        """Add the spread of a product (`chan1983`)."""
        count = used.sum(axis=0)
        total = self.count + count
        centre = values.sum(axis=0) / np.maximum(count, 1)
        inner = np.where(used, (values - centre) ** 2, 0.0).sum(axis=0)
        shift = np.where(count > 0, centre - self.centre, 0.0)
        self.spread += inner + shift**2 * (self.count * count / np.maximum(total, 1))
        self.centre += shift * (count / np.maximum(total, 1))
        self.count = total

    def mean(self) -> Mean:
        """Return the mean and its errors."""
        weight = np.where(self.count > 0, self.weight, np.nan)
        variance = self.random / weight**2
        for part in self.shared:
            variance += (part / weight) ** 2
        degrees = np.where(self.count > 1, self.count - 1.0, np.nan)
        return Mean(
            self.value / weight,
            np.sqrt(variance),
            np.sqrt(self.spread / degrees),
            {name: total / weight for name, total in self.systematic.items()},
            self.count,
        )


def _used(sample: Sample) -> NDArray[np.bool_]:
    parts = [sample.values, sample.errors, sample.random, *sample.shared]
    used = sample.usable.copy()
    for part in parts:
        used &= np.isfinite(part)
    if sample.systematic:
        # One that does not apply, as that of the dead time to analog signals, is missing.
        used &= np.any([np.isfinite(error) for error in sample.systematic.values()], axis=0)
    return used


def _sum(weights: Array, values: Array, used: NDArray[np.bool_]) -> Array:
    total: Array = (weights * np.where(used, values, 0.0)).sum(axis=0)
    return total


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
    fraction = _numbers(product, CLOUD_FRACTION)
    cloudy = product[CLOUD_MASK].values == layout_of(kind).row(CLOUD_MASK).code("cloudy")
    return np.where(cloudy & np.isnan(fraction), 1.0, fraction)


def _sample(product: xr.Dataset, kind: str, row: Row, usable: NDArray[np.bool_]) -> Sample:
    values = _numbers(product, row.name)
    errors = _numbers(product, f"{row.name}_standard_error")
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
            relative = values / _numbers(product, row.lower_end) - 1.0
            # With hardly any systematic error, rounding may give a negative difference.
            error = values * np.sqrt(np.maximum(relative**2 - (errors / values) ** 2, 0.0))
        return dict.fromkeys(names, error)
    return {name: _numbers(product, name) for name in names if name in product}


def _divide(
    product: xr.Dataset, budget: ErrorBudget, errors: Array
) -> tuple[Array, tuple[Array, ...]]:
    """Divide a standard error into a part independent between profiles and shared parts."""
    variance = np.zeros_like(errors)
    for name in budget.random:
        variance += _numbers(product, name) ** 2
    random = np.sqrt(variance)
    if budget.times:
        random = random * _numbers(product, budget.times)
    if budget.over:
        random = random / _numbers(product, budget.over)
    if budget.shared:
        return random, tuple(_numbers(product, name) for name in budget.shared)
    # Stored errors are rounded, so the difference may be slightly negative.
    return random, (np.sqrt(np.maximum(errors**2 - random**2, 0.0)),)


def _numbers(product: xr.Dataset, name: str) -> Array:
    """Return a variable of an undecoded product in double precision; missing values are NaN."""
    variable = product[name]
    values: Array = variable.values.astype(np.float64)
    fill = variable.attrs.get("_FillValue")
    return values if fill is None else np.where(variable.values == fill, np.nan, values)


@dataclass(slots=True)
class PeriodSums:
    """Sums of all quantities over one period."""

    kind: str
    weights: Weights
    quantities: dict[str, Sums] = field(default_factory=dict)
    profiles: int = 0
    usable: Any = 0
    """Number of usable profiles, with the shape of the flags without time."""
    good: Any = 0
    """Number of profiles whose value has no bit."""
    flags: Any = 0
    """Bits of all values."""
    usable_flags: Any = 0
    """Bits of the usable values."""
    common_flags: Any = _ALL_BITS
    """Bits that all usable values have."""
    shots: float = 0.0
    clouds: Sums | None = None

    def add(self, profiles: Profiles, chosen: NDArray[np.intp]) -> None:
        """Add some of the profiles of a product."""
        for name, sample in profiles.samples.items():
            part = sample.take(chosen)
            if name not in self.quantities:
                self.quantities[name] = Sums.like(part)
            self.quantities[name].add(part, _weights(self.weights, part, profiles.shots[chosen]))
        flags = profiles.flags[chosen]
        usable = (flags & np.int32(flags_of(self.kind).rejecting)) == 0
        self.profiles += chosen.size
        self.usable = self.usable + usable.sum(axis=0)
        self.good = self.good + (flags == 0).sum(axis=0)
        self.flags = self.flags | np.bitwise_or.reduce(flags, axis=0)
        # Of the mean, not of its members: see `record`.
        kept = np.where(usable, flags & ~_WEIGHED, np.int32(0))
        self.usable_flags = self.usable_flags | np.bitwise_or.reduce(kept, axis=0)
        common = np.bitwise_and.reduce(np.where(usable, flags, _ALL_BITS), axis=0)
        self.common_flags = self.common_flags & common
        shots = profiles.shots[chosen]
        self.shots += float(shots.sum())
        if profiles.cloud_fraction is not None:
            fraction = profiles.cloud_fraction[chosen]
            exact = np.zeros(fraction.shape)
            clouds = Sample(fraction, exact, exact, (), {}, usable)
            plain = self.weights is Weights.PLAIN
            weights = Weights.PLAIN if plain else Weights.SHOTS
            self.clouds = self.clouds or Sums.like(clouds)
            self.clouds.add(clouds, _weights(weights, clouds, shots))

    def record(self) -> dict[str, NDArray[Any]]:
        """Return the variables of the period, without dimension time."""
        usable_flags = self.usable_flags
        if self.clouds is not None:
            usable_flags = _cloudy_flags(self.kind, usable_flags, self.common_flags)
        flags = np.where(self.usable > 0, usable_flags, self.flags)
        weighed = layout_of(self.kind).weighed
        variables: dict[str, NDArray[Any]] = {
            "usable_share": self.usable / np.float64(self.profiles),
            "good_share": self.good / np.float64(self.profiles),
            "shots": np.asarray(self.shots),
        }
        if self.clouds is not None:
            variables[CLOUD_FRACTION] = self.clouds.mean().mean
        for name, sums in self.quantities.items():
            mean = sums.mean()
            variables[name] = mean.mean
            variables[f"{name}_standard_error"] = mean.standard_error
            variables[f"{name}_standard_deviation"] = mean.standard_deviation
            variables[f"{name}_observations"] = mean.observations
            variables |= mean.systematic
            if name in weighed:
                error = whole_error(variables, name)
                flags = flags | np.where(np.abs(mean.mean) < error, _WEIGHED, np.int32(0))
            if mean.mean.shape == flags.shape:
                # Usable values without an error for weighting give no mean: flag it as missing.
                unflagged = ~np.isfinite(mean.mean) & (flags == 0)
                flags = np.where(unflagged, np.int32(Quality.INPUT_MISSING), flags)
        return {**variables, "quality_flag": flags}


def _cloudy_flags(kind: str, flags: Any, common: Any) -> Any:
    """Return the bits of a mean, of which some values or all in it are those of clouds."""
    bits = (flags_of(kind).named(word) for word in ("cloud", "partly_cloudy"))
    cloud, partly = (np.int32(bit or 0) for bit in bits)
    some = ((flags & (cloud | partly)) != 0) & ((common & cloud) == 0)
    return np.where(some, flags & ~cloud | partly, flags)


def _weights(weights: Weights, sample: Sample, shots: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights of the values of a sample."""
    if weights is Weights.INVERSE_VARIANCE:
        with np.errstate(divide="ignore"):
            return np.asarray(sample.errors**-2.0)
    of_profiles = shots if weights is Weights.SHOTS else np.ones(shots.size)
    along = of_profiles.reshape(-1, *(1,) * (sample.values.ndim - 1))
    return np.broadcast_to(along, sample.values.shape)
