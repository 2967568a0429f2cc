"""What a kernel of the homogeneous path finds out about a profile, before it is judged."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

# What became of a profile.
FITTED: Final = 0
EMPTY: Final = 1
CONSTANT: Final = 2
TOO_SHORT: Final = 3


@dataclass(frozen=True, slots=True)
class PathEstimate:
    """What a solver knows of a batch of profiles, one value each, before it is judged.

    Variances and energies are for noise of unit variance where the weights are relative.
    """

    status: Array
    """`FITTED`, `EMPTY`, `CONSTANT` or `TOO_SHORT`."""
    bins: Array
    """Bins used."""
    background: Array
    amplitude: Array
    extinction: Array
    background_variance: Array
    amplitude_relative_variance: Array
    extinction_variance: Array
    signal_energy: Array
    """Squared amplitude over its variance at known extinction."""
    misfit: Array
    """Weighted sum of squared residuals."""
    bends: Array
    """Sum of squared second differences of the weighted residuals, and their number."""
    bend_count: Array
    largest: Array
    """Largest weighted residual."""
    trend: Array
    """Energy of the residuals in shapes that the model lacks, and the number of shapes."""
    trend_count: Array
    rounding: Array
    """Variance that the rounding of the power alone explains."""
    mean_range: Array
    """Weighted, m."""
    bounded: Array
    """1 where the extinction lies at a bound."""
    background_bend: Array
    """What a signal bent by ``(x - 1/2)^2`` in relative terms, x from 0 to 1 along the section,
    does to the background, in the unit of the power times the length of the section."""
    extinction_bend: Array
    """The same of the extinction, times the length of the section."""


COLUMNS: Final = tuple(field.name for field in fields(PathEstimate))
"""The fields of an `PathEstimate`, as columns of the table that a kernel fills."""
(
    STATUS,
    BINS,
    BACKGROUND,
    AMPLITUDE,
    EXTINCTION,
    BACKGROUND_VARIANCE,
    AMPLITUDE_RELATIVE_VARIANCE,
    EXTINCTION_VARIANCE,
    SIGNAL_ENERGY,
    MISFIT,
    BENDS,
    BEND_COUNT,
    LARGEST,
    TREND,
    TREND_COUNT,
    ROUNDING,
    MEAN_RANGE,
    BOUNDED,
    BACKGROUND_BEND,
    EXTINCTION_BEND,
) = range(len(COLUMNS))
