"""Read what means need of products, and sum it: values, error components, flags, shots, clouds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lidarops.aggregate.facts import Weights
from lidarops.aggregate.means_variables import (
    averaged,
    budget_of,
    share_names,
    systematic,
)
from lidarops.flags import Quality
from lidarops.netcdf.quantities import CLOUD_FRACTION, CLOUD_MASK
from lidarops.netcdf.stored import StoredProduct
from lidarops.netcdf.stored_flags import flags_names, refuse_moved_flags
from lidarops.netcdf.variables import QUALITY_FLAG, Layout, Row, judging, whole_error

_ALL_BITS: Final = np.int32(-1)
_WEIGHED: Final = np.int32(Quality.LOW_SIGNAL_TO_NOISE)

Array = NDArray[np.float64]


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

    totals: dict[str | int, Any] = field(default_factory=dict)
    """Sums of weights, and of values and errors times their weights; of shared errors by their
    number, of systematic ones by their variable."""
    count: Any = 0
    centre: Any = 0.0
    """Unweighted mean so far, for `spread`."""
    spread: Any = 0.0
    """Sum of squared deviations from `centre`."""

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
        for key, term in _terms(sample, weights):
            self.totals[key] = self.totals.get(key, 0.0) + np.where(used, term, 0.0).sum(axis=0)
        self._spread(np.where(used, sample.values, 0.0), used)

    def _spread(self, values: Array, used: NDArray[np.bool_]) -> None:
        """Add the spread of a product (`chan1983`)."""
        count = used.sum(axis=0)
        total = self.count + count
        centre = values.sum(axis=0) / np.maximum(count, 1)
        inner = np.where(used, (values - centre) ** 2, 0.0).sum(axis=0)
        shift = np.where(count > 0, centre - self.centre, 0.0)
        self.spread = self.spread + (inner + shift**2 * (self.count * count / np.maximum(total, 1)))
        self.centre = self.centre + shift * (count / np.maximum(total, 1))
        self.count = total

    def mean(self, name: str) -> dict[str, NDArray[Any]]:
        """Return the variables of the mean of a quantity with this name.

        They have the shape (...) of a profile, and are NaN without a usable value.
        """
        totals = self.totals
        weight = np.where(self.count > 0, totals["weight"], np.nan)
        variance = totals["random"] / weight**2
        for key, total in totals.items():
            if isinstance(key, int):
                variance += (total / weight) ** 2
        degrees = np.where(self.count > 1, self.count - 1.0, np.nan)
        plain = ("weight", "value", "random")
        return {
            name: totals["value"] / weight,
            f"{name}_standard_error": np.sqrt(variance),
            f"{name}_standard_deviation": np.sqrt(self.spread / degrees),
            f"{name}_observations": self.count,
            **{
                key: total / weight
                for key, total in totals.items()
                if isinstance(key, str) and key not in plain
            },
        }


def _used(sample: Sample) -> NDArray[np.bool_]:
    used = sample.usable.copy()
    for part in (sample.values, sample.errors, sample.random, *sample.shared):
        used &= np.isfinite(part)
    if sample.systematic:
        # One that does not apply, as that of the dead time to analog signals, is missing.
        used &= np.any([np.isfinite(error) for error in sample.systematic.values()], axis=0)
    return used


def _terms(sample: Sample, weights: Array) -> Iterator[tuple[str | int, Array]]:
    """Yield what is summed, by its key in `Sums.totals`."""
    yield "weight", weights
    yield "value", weights * sample.values
    yield "random", weights**2 * sample.random**2
    # The error of a mean is unknown where that of one profile is.
    yield from ((number, weights * error) for number, error in enumerate(sample.shared))
    yield from ((name, weights * error) for name, error in sample.systematic.items())


@dataclass(frozen=True, slots=True)
class Profiles:
    """What means need of the profiles of one product, in memory."""

    samples: Mapping[str, Sample]
    flags: Mapping[str, NDArray[np.int32]]
    """Variable of flags -> bits."""
    shots: Array
    clouds: Sample | None
    """Share of cloudy profiles of each value. None for kinds that seek no clouds."""


def read_profiles(product: StoredProduct, layout: Layout) -> Profiles:
    """Read what means need from a product, completely, so that a damaged product affects no sum.

    Parameters
    ----------
    product : StoredProduct
    layout : Layout
        Of its kind.

    Raises
    ------
    ProductError
        If it has bits of flags at other places than its kind has now.
    """
    refuse_moved_flags(product)
    flags = {name: product[name][...] for name in flags_names(product)}
    usable = {name: (bits & np.int32(layout.flags.rejecting)) == 0 for name, bits in flags.items()}
    return Profiles(
        {
            row.name: _sample(product, row, usable[judging(row.name, flags)])
            for row in averaged(layout)
            if row.name in product
        },
        flags,
        product["shots"][...].astype(np.float64),
        _clouds(product, layout, usable[QUALITY_FLAG]),
    )


def _clouds(product: StoredProduct, layout: Layout, usable: NDArray[np.bool_]) -> Sample | None:
    """Return the share of cloudy profiles: 1 also where only the mean shows a cloud."""
    if CLOUD_FRACTION not in layout.rows:
        return None
    exact = np.zeros(usable.shape)
    fraction = np.full(usable.shape, np.nan)
    if CLOUD_FRACTION in product:
        fraction = _numbers(product, CLOUD_FRACTION)
        cloudy = product[CLOUD_MASK][...] == layout.rows[CLOUD_MASK].code("cloudy")
        fraction = np.where(cloudy & np.isnan(fraction), 1.0, fraction)
    return Sample(fraction, exact, exact, (), {}, usable)


def _sample(product: StoredProduct, row: Row, usable: NDArray[np.bool_]) -> Sample:
    values = _numbers(product, row.name)
    errors = _numbers(product, f"{row.name}_standard_error")
    has_flags = row.dims == product[judging(row.name, flags_names(product))].dims
    return Sample(
        values,
        errors,
        *_divided(product, row, errors),
        _systematic_errors(product, row, values, errors),
        usable if has_flags else np.ones(values.shape, np.bool_),
    )


def _systematic_errors(
    product: StoredProduct, row: Row, values: Array, errors: Array
) -> dict[str, Array]:
    """Return the systematic errors that are not part of the standard error, by variable."""
    names = systematic(row)
    if row.lower_end:
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = values / _numbers(product, row.lower_end) - 1.0
            # With hardly any systematic error, rounding may give a negative difference.
            error = values * np.sqrt(np.maximum(relative**2 - (errors / values) ** 2, 0.0))
        return dict.fromkeys(names, error)
    return {name: _numbers(product, name) for name in names if name in product}


def _divided(product: StoredProduct, row: Row, errors: Array) -> tuple[Array, tuple[Array, ...]]:
    """Divide a standard error into a part independent between profiles and shared parts."""
    budget = budget_of(row)
    if budget is None:
        return errors, ()
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


def _numbers(product: StoredProduct, name: str) -> Array:
    """Return a variable of a product in double precision; missing values are NaN."""
    stored = product[name][...]
    values: Array = stored.astype(np.float64)
    fill = product[name].attrs.get("_FillValue")
    return values if fill is None else np.where(stored == fill, np.nan, values)


@dataclass(slots=True)
class FlagSums:
    """Bits of the values of one period, with the shape of flags without time."""

    usable: Any = 0
    """Number of usable profiles."""
    good: Any = 0
    """Number of profiles whose value has no bit."""
    all: Any = 0
    """Bits of all values."""
    kept: Any = 0
    """Bits of the usable values."""
    common: Any = _ALL_BITS
    """Bits that all usable values have."""

    def add(self, flags: NDArray[np.int32], rejecting: int) -> None:
        """Add the flags of some profiles, of which some bits reject a value."""
        usable = (flags & np.int32(rejecting)) == 0
        self.usable = self.usable + usable.sum(axis=0)
        self.good = self.good + (flags == 0).sum(axis=0)
        self.all = self.all | np.bitwise_or.reduce(flags, axis=0)
        # That of the mean, not of its members: see `PeriodSums.record`.
        kept = np.where(usable, flags & ~_WEIGHED, np.int32(0))
        self.kept = self.kept | np.bitwise_or.reduce(kept, axis=0)
        common = np.bitwise_and.reduce(np.where(usable, flags, _ALL_BITS), axis=0)
        self.common = self.common & common

    def of_mean(self, cloud: int, partly: int) -> Any:
        """Return the bits of a mean, of which some values or all in it are those of clouds."""
        cloudy = ((self.kept & np.int32(cloud | partly)) != 0) & (
            (self.common & np.int32(cloud)) == 0
        )
        kept = np.where(cloudy, self.kept & ~np.int32(cloud) | np.int32(partly), self.kept)
        return np.where(self.usable > 0, kept, self.all)


@dataclass(slots=True)
class PeriodSums:
    """Sums of all quantities over one period."""

    layout: Layout
    """Of the kind of product."""
    weights: Weights
    quantities: dict[str, Sums] = field(default_factory=dict)
    flags: dict[str, FlagSums] = field(default_factory=dict)
    profiles: int = 0
    shots: float = 0.0
    clouds: Sums | None = None

    def add(self, profiles: Profiles, chosen: NDArray[np.intp]) -> None:
        """Add some of the profiles of a product."""
        shots = profiles.shots[chosen]
        for name, sample in profiles.samples.items():
            part = sample.take(chosen)
            sums = self.quantities.setdefault(name, Sums())
            sums.add(part, _weights(self.weights, part, shots))
        self.profiles += chosen.size
        for name, flags in profiles.flags.items():
            self.flags.setdefault(name, FlagSums()).add(flags[chosen], self.layout.flags.rejecting)
        self.shots += float(shots.sum())
        if profiles.clouds is not None:
            clouds = profiles.clouds.take(chosen)
            plain = self.weights is Weights.PLAIN
            weights = _weights(Weights.PLAIN if plain else Weights.SHOTS, clouds, shots)
            self.clouds = self.clouds or Sums()
            self.clouds.add(clouds, weights)

    def record(self) -> dict[str, NDArray[Any]]:
        """Return the variables of the period, without dimension time."""
        variables: dict[str, NDArray[Any]] = {"shots": np.asarray(self.shots)}
        cloud, partly = 0, 0
        if self.clouds is not None:
            variables[CLOUD_FRACTION] = self.clouds.mean(CLOUD_FRACTION)[CLOUD_FRACTION]
            named = (self.layout.flags.named(word) for word in ("cloud", "partly_cloudy"))
            cloud, partly = (int(bit or 0) for bit in named)
        flags = {name: bits.of_mean(cloud, partly) for name, bits in self.flags.items()}
        for name, bits in self.flags.items():
            usable_share, good_share = share_names(name)
            variables[usable_share] = bits.usable / np.float64(self.profiles)
            variables[good_share] = bits.good / np.float64(self.profiles)
        for name, sums in self.quantities.items():
            variables |= sums.mean(name)
            mean, judge = variables[name], judging(name, flags)
            if name in self.layout.weighed:
                error = whole_error(variables, name)
                flags[judge] = flags[judge] | np.where(np.abs(mean) < error, _WEIGHED, np.int32(0))
            if mean.shape == flags[judge].shape:
                # Usable values without an error for weighting give no mean: flag it as missing.
                unflagged = ~np.isfinite(mean) & (flags[judge] == 0)
                flags[judge] = np.where(unflagged, np.int32(Quality.INPUT_MISSING), flags[judge])
        return variables | flags


def _weights(weights: Weights, sample: Sample, shots: Array) -> Array:
    """Return the weights of the values of a sample."""
    if weights is Weights.INVERSE_VARIANCE:
        with np.errstate(divide="ignore"):
            return np.asarray(sample.errors**-2.0)
    of_profiles = shots if weights is Weights.SHOTS else np.ones(shots.size)
    along = of_profiles.reshape(-1, *(1,) * (sample.values.ndim - 1))
    return np.broadcast_to(along, sample.values.shape)
