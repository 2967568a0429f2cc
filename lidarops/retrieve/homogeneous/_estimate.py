"""The fit of a homogeneous path as the kernels return it, before it is judged."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array

# Status of a profile.
FITTED: Final = 0
EMPTY: Final = 1
CONSTANT: Final = 2
TOO_SHORT: Final = 3


@dataclass(frozen=True, slots=True)
class PathEstimate:
    """Fit of a batch of profiles, one value each, before it is judged.

    Where the weights are relative, variances and energies are those for noise of unit variance.
    """

    status: Array
    """`FITTED`, `EMPTY`, `CONSTANT` or `TOO_SHORT`."""
    bins: Array
    """Bins used."""
    background: Array
    amplitude: Array
    extinction: Array
    background_variance: Array
    background_slope_variance: Array
    """The part of it that the error of extinction makes."""
    amplitude_relative_variance: Array
    extinction_variance: Array
    signal_energy: Array
    """Squared amplitude over its variance at known extinction."""
    misfit: Array
    """Weighted sum of squared residuals."""
    second_differences: Array
    """Sum of squared second differences of the weighted residuals."""
    difference_count: Array
    """Number of second differences."""
    largest: Array
    """Largest absolute weighted residual."""
    trend: Array
    """Energy of the residuals in the test shapes that the model lacks."""
    trend_count: Array
    """Number of test shapes."""
    rounding: Array
    """Variance due to rounding of the power alone."""
    mean_range: Array
    """Weighted, m."""
    bounded: Array
    """1 where the extinction lies at a bound."""
    background_bend: Array
    """Change of the background by a signal bent by ``(x - 1/2)^2`` in relative terms, x from 0 to 1
    along the section; unit of the power times the length of the section."""
    extinction_bend: Array
    """The same for the extinction, times the length of the section."""


COLUMNS: Final = tuple(field.name for field in fields(PathEstimate))
"""Fields of `PathEstimate`."""
ROW: Final = np.dtype([(name, np.float64) for name in COLUMNS])
"""Type of the record of a profile that a kernel fills."""
