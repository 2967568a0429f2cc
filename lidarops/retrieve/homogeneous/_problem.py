"""Input and output of the solvers of a homogeneous path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarops.retrieve.common.arrays import Array, Flags, Floats


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
    """(profile or 1, bin): variances or weights; a bin is left out where that is not positive
    and finite."""
    known_variance: bool
    """Whether `noise` holds variances, else weights up to a common factor."""
    bounds: tuple[float, float]
    """Lowest and highest extinction, m-1."""
    correlation_length: Array | None = None
    """(profile or 1,), bins, of the noise; None for independent bins."""
    extinction: Array | None = None
    """(profile or 1,), m-1: the prior of the linearised method, or the known extinction."""
    background: Array | None = None
    """(profile or 1,): the known background."""
    background_variance: Array | None = None
    """(profile or 1,): variance of the known background."""
    exposure: Array | None = None
    """(profile or 1,): counts per unit of power; None where the noise is not that of counts."""
    lag: int | None = None
    """Bins between those of a triple of the cubic; chosen by the number of bins if None."""

    @property
    def rounding(self) -> float:
        """Relative rounding error of the power and the kernels, as a standard deviation."""
        return 0.3 * float(np.finfo(self.power.dtype).eps) + 8.0 * float(np.finfo(np.float64).eps)

    @property
    def bin_width(self) -> float:
        """Mean spacing of the bins, those without data included, m; 1 for a single bin."""
        if self.range.size < 2:
            return 1.0
        return float(self.range[-1] - self.range[0]) / (self.range.size - 1)


@dataclass(frozen=True, slots=True)
class PathSolution:
    """Solution of a batch, (profile,) each; see `path_fit.HomogeneousResult` for the fields."""

    background: Array
    background_standard_error: Array
    amplitude: Array
    amplitude_standard_error: Array
    extinction: Array
    extinction_standard_error: Array
    signal_to_noise: Array
    """Amplitude over its standard error at known extinction, with the sign of the amplitude."""
    reduced_chi2: Array
    mean_range: Array
    """m, weighted over the bins used; NaN where nothing was fitted."""
    background_bend: Array
    """Change of the background by a signal bent by ``(x - 1/2)^2`` in relative terms, x from 0 to 1
    along the section, times the length of the section; NaN where nothing was fitted."""
    extinction_bend: Array
    """The same for the extinction."""
    valid_bins: Flags
    quality: Flags
