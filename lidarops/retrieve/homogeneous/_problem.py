"""Input of the solvers of a homogeneous path, the estimate of a kernel, and the result."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Flags, Floats

# Status of a profile.
FITTED: Final = 0
EMPTY: Final = 1
CONSTANT: Final = 2
TOO_SHORT: Final = 3
UNKNOWNS: Final = 3
"""Background, amplitude and extinction: a fit needs more bins."""


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
    amplitude_slope: Array
    """Derivative of the logarithm of the amplitude by a given background."""
    extinction_slope: Array
    """The same of the extinction."""
    background_shift: Array
    """Change by another linear step, of a fit from a prior."""
    amplitude_shift: Array
    """The same, of the logarithm of the amplitude."""
    extinction_shift: Array
    background_bend: Array
    """Change of the background by a signal bent by ``(x - 1/2)^2`` in relative terms, x from 0 to 1
    along the section; unit of the power times the length of the section."""
    extinction_bend: Array
    """The same for the extinction, times the length of the section."""


COLUMNS: Final = tuple(field.name for field in fields(PathEstimate))
"""Fields of `PathEstimate`."""
ROW: Final = np.dtype([(name, np.float64) for name in COLUMNS])
"""Type of the record of a profile that a kernel fills."""


@dataclass(frozen=True, slots=True)
class PathProblem:
    """Profiles of one section, with what is known about them.

    "(profile or 1,)" stands for one value for each profile, or one for all.
    """

    power: Floats
    """(profile, bin), contiguous; bins that are not finite are left out."""
    range: Array
    """(bin,), m, ascending."""
    noise: Array
    """(profile or 1, bin): variances; a bin whose weight is not positive and finite is left out."""
    known_variance: bool
    """Whether they are known, else up to a common factor."""
    bounds: tuple[float, float]
    """Lowest and highest extinction, m-1."""
    correlation_length: Array
    """(profile or 1,), bins, of the noise; 1 for independent bins."""
    given: Array
    """(profile or 1,): the prior of the linearised method or the known extinction, m-1; or the
    known background; NaN where all is fitted."""
    background_variance: Array
    """(profile or 1,): variance of the known background."""
    exposure: Array | None = None
    """(profile or 1,): counts per unit of power; None where the noise is not that of counts."""
    lag: int | None = None
    """Bins between those of a triple of the cubic; chosen by the number of bins if None."""


@dataclass(frozen=True, slots=True)
class HomogeneousResult:
    """Parameters of a homogeneous path, with the leading axes of the power.

    Standard errors are conditional on the model. A change of the profile along the model's own
    shapes leaves no trace in the residuals: backscatter that decreases along the path as
    ``exp(-R / H)`` mimics an extinction of 1 / (2 H), on a vertical path as on any other.
    `extinction_model_error` and `background_model_error` allow for that, separately from the
    random error; they are not bounds. ``benchmarks stability`` gives the share of false values
    for every kind of violation.
    """

    background: Array
    """P*, in the unit of the power."""
    background_standard_error: Array
    """In the unit of the power; random error only."""
    background_model_error: Array
    """In the unit of the power: first-order change of the background by a signal whose logarithmic
    slope departs from the model at both ends of the section, with opposite signs, as where
    backscatter bends along the path. The departure is `Thresholds.model_error` times the slope at
    mean range, 2 (absolute extinction + 1 / mean range)."""
    amplitude: Array
    """B of ``P = P* + B R^-2 exp(-2 extinction R)``, in the unit of the power times m2."""
    amplitude_standard_error: Array
    """To first order. B is extrapolated to range zero: above some 30 percent, the interval holds
    for the logarithm of B rather than for B."""
    extinction: Array
    """m-1."""
    extinction_standard_error: Array
    """m-1; random error only."""
    extinction_model_error: Array
    """m-1; `Thresholds.model_error` times (absolute extinction + 1 / mean range), for the departure
    of the slope of `background_model_error` all along the section, and, in quadrature, the
    first-order change of extinction by the bend there. The second term dominates where extinction
    and background are hard to separate."""
    reduced_chi2: Array
    """1 where the residuals are noise; relative to the estimated noise without a variance."""
    valid_bins: Flags
    """Bins used."""
    quality: Flags
    """Bits of `lidarops.flags.Quality`; 0 where no test failed."""
