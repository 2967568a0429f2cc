"""Running sums over profiles, from which means and their errors follow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
