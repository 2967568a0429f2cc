"""Thresholds of networks of lidars, each with what set it."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np


class Thresholds(NamedTuple):
    """Numbers of the retrieval, dimensionless unless stated.

    The last words of each entry state what set the number; "assumed" where nothing is recorded.
    "Ablation": the guard, not its number, is measured in ``docs/algorithms/network.md``.
    """

    # Crossings
    tolerance: float = 15.0
    """m, largest distance of beams that meet: two bins of 7.5 m; assumed."""
    smallest_angle: float = 2.0
    """degree between beams that meet. Below, a pointing error of 0.1 degree moves the crossing by
    more than 5 percent of its range; geometry."""
    most_beams: int = 512
    """Largest number of beams of a network; assumed."""

    # Signals
    exponents: tuple[float, float] = (0.1, 10.0)
    """Smallest and largest exponent m of backscatter ~ extinction^(1/m); assumed."""
    fit_bins: int = 7
    """Bins of the fit that gives the signal at a crossing; the study of the method."""
    lowest_overlap: float = 0.5
    """Overlap below which the error of the overlap function dominates the signal; assumed."""
    largest_bin_error: float = 0.3
    """Relative standard error of a bin at a crossing in a block, beyond which the beam is not used:
    signals that are positive by chance would be selected; assumed."""
    negative: float = 4.0
    """Standard errors below zero at which a mean signal is faulty, not weak; assumed."""
    noisy_profile: float = 10.0
    """Ratio to the median variance of a block, beyond which a profile does not count for it;
    assumed."""

    # Outlying bins: ablation
    outlier: float = 6.0
    """Standard errors by which a bin deviates from its neighbours: 2e-9 of the normal
    distribution lie beyond 6 on either side, where the variance is known."""
    suspect: float = 4.5
    """Standard errors of a deviation near a bridged bin, beyond which the bin may be an edge of a
    layer; assumed."""
    reach: int = 8
    """Bins on either side among which neighbours are searched; assumed."""
    margin: int = 4
    """Bins before and behind the used ones of a beam that help to test these; assumed."""
    air_deviation: float = 1e-3
    """Largest relative deviation that air causes, with one neighbour on one side; a plume of 50 m
    in bins of 7.5 m; calculated."""
    air_deviation_beyond: float = 5e-2
    """The same at an end of a beam, where all neighbours are on one side; assumed."""
    widest_bin: float = 10.0
    """m. A layer may fill a wider bin; assumed."""
    step: float = 0.1
    """Change of the logarithm over 4 bins that air may cause: for a visibility of 2 km; assumed."""
    edge_bins: int = 14
    """Bins that deviate at two edges of layers; assumed."""
    outlying_share: float = 0.2
    """Share of the bins of a beam that may be outlying in addition; assumed."""

    # Curved signals: ablation
    curvature_degree: int = 4
    """Degree of the polynomial. A parabola leaves half of the error from a layer of 10 m over 35 m;
    calculated."""
    shared_noise: float = 4.0
    """Noise variances subtracted from the square of the shared error. Noise alone then leaves 0.08
    of one variance on average; normal distribution."""
    profile_noise: float = 9.0
    """The same for a single profile, which leaves 0.005 of one variance; normal distribution."""
    chance: float = 3.0
    """Standard deviations by which a mean square of noise may be larger by chance; assumed."""

    # The prior: ablation
    gradient: float = 0.15
    """Standard deviation of ln extinction over the crossings by a gradient; simulations."""
    deviations: tuple[float, ...] = tuple(np.geomspace(0.01, 1.0, 9).tolist())
    """Standard deviations of ln extinction at single crossings that are tried; assumed."""
    strengths: tuple[float, ...] = (1.0, 2.0, 4.0)
    """Factors of the standard deviations that are tried before the prior is dropped; assumed."""
    likelihood_tolerance: float = 4.0
    """Difference in -2 ln likelihood from the minimum: two standard errors."""
    doubt: float = 2.0
    """Factor of the prior's standard deviation by which the stated error lets a field deviate;
    assumed."""
    well_determined: float = 0.15
    """Standard error of ln extinction below which beams alone determine a crossing; assumed."""
    determined_share: float = 0.9
    """Share of the profiles in which a crossing that contradicts a prior is determined; assumed."""
    contradiction: float = 3.5
    """Standard errors of the difference at which beams contradict a prior; assumed."""
    harmless: float = 0.5
    """Share of the stated error that a difference may reach without effect; assumed."""
    testing_quantile: float = 0.75
    """Quantile of the degrees of freedom that decides whether profiles test the prior; assumed."""
    least_probability_of_mean: float = 1e-2
    """Probability of the chi-square of the mean with the prior, below which the prior is rejected;
    chosen."""
    open_in_mean: float = 1.0
    """Standard error of ln extinction beyond which the mean leaves a crossing open; assumed."""

    # The solution
    longest_step: float = 1.5
    """Largest step of the logarithm of a constant in one pass; assumed."""
    converged_step: float = 1e-3
    """Largest change of a logarithm in the last pass of a converged solution; assumed."""
    thinnest_beam: float = 1e-3
    """Smallest optical depth of a beam for the start constants; assumed."""
    thickest_beam: float = 30.0
    """The largest one; assumed."""
    smallest_pivot: float = 1e-13
    """Smallest pivot of a regular matrix over its diagonal; rounding."""
    weak_precision: float = 1e-2
    """Precision of ln extinction in place of a prior: a standard deviation of 10; assumed."""
    largest_variance: float = 4.0
    """Variance of ln extinction beyond which it is not determined; assumed."""

    # Errors that the block shows: ablation
    nonlinear_error: float = 0.1
    """Typical relative error of a block, beyond which the error of a profile depends on its noise;
    assumed."""
    bend: float = 0.15
    """Standard deviation of ln extinction over the crossings by the curvature of a field: that of a
    gradient; the largest part of the errors of single profiles. With half of it and a `doubt` of
    1.5, or with at most the deviation of the prior, fewer than 94 percent of the 95 percent
    intervals of plumes hold the truth in blocks of 1 (``benchmarks stability``), and those of
    homogeneous air are still too wide: what makes these right makes plumes false."""
    largest_deviation: float = 8.0
    """Limit of the deviation of a profile from the median, in median standard errors; assumed."""

    # Flags and systematic errors
    largest_relative_error: float = 1.0 / 3.0
    """Relative standard error beyond which a linear error does not describe a value: it is flagged;
    assumed."""
    least_probability: float = 1e-4
    """Probability of a chi-square below which a fit is poor; chosen."""
    relative_change: float = 1e-2
    """Relative change of signals for sensitivities; assumed."""
    bins_beyond: int = 200
    """Bins kept beyond the farthest crossing: over twice the widest window of a bin."""
    most_separate_beams: int = 16
    """Number of beams up to which their errors are computed one by one; assumed, for run time."""


THRESHOLDS: Final = Thresholds()
