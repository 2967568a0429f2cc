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
    most_beams: int = 512
    """Largest number of beams of a network; assumed."""

    # Signals
    fit_bins: int = 7
    """Bins of the fit that gives the signal at a crossing; the study of the method."""
    lowest_overlap: float = 0.5
    """Overlap below which the error of the overlap function dominates the signal; assumed."""
    largest_bin_error: float = 0.3
    """Relative standard error of a bin at a crossing in a block, beyond which the beam is not used:
    signals that are positive by chance would be selected; assumed."""
    noisy_profile: float = 10.0
    """Ratio to the median variance of a block, beyond which a profile does not count for it;
    assumed."""

    # Outlying bins: ablation
    suspect: float = 4.5
    """Standard errors of a deviation near a bridged bin, beyond which the bin may be an edge of a
    layer; assumed."""
    air_deviation: float = 1e-3
    """Largest relative deviation that air causes, with one neighbour on one side; a plume of 50 m
    in bins of 7.5 m; calculated."""
    air_deviation_beyond: float = 5e-2
    """The same at an end of a beam, where all neighbours are on one side; assumed."""
    widest_bin: float = 10.0
    """m. A layer may fill a wider bin; assumed."""
    edge_bins: int = 14
    """Bins that deviate at two edges of layers; assumed."""
    outlying_share: float = 0.2
    """Share of the bins of a beam that may be outlying in addition; assumed."""

    # Curved signals: ablation
    curvature_degree: int = 4
    """Degree of the polynomial. A parabola leaves half of the error from a layer of 10 m over 35 m;
    calculated."""
    curvature_left: float = 0.1
    """Share of the error of a straight line that a polynomial may leave: 0.24 of a Gaussian layer
    of 10 m, 0.05 of one of 15 m in bins of 5 m; calculated."""

    # The field: ablation
    stratified: tuple[float, float] = (2.0, 300.0)
    """Standard deviation of ln extinction over height, and its length in m; simulations."""
    volumes: tuple[float, float] = (0.5, 500.0)
    """The same of single volumes of air, over distance; assumed."""
    least_deviation: float = 0.03
    """The same at single crossings, added; simulations."""
    lengths: tuple[float, ...] = (100.0, 500.0, 2500.0)
    """m, lengths of changes that are tried; assumed."""
    changes: tuple[float, ...] = tuple(np.geomspace(0.01, 0.32, 7).tolist())
    """Standard deviations of ln extinction by changes within a block that are tried. Larger ones
    follow the noise of triangles: errors in a drifting plume grow by a fifth; simulations."""
    correlations: tuple[float, ...] = (0.3, 0.7, 0.95, 0.995)
    """Correlations of changes from one profile to the next that are tried; assumed."""
    linear_change: float = 0.02
    """Standard deviation of ln extinction in a block, beyond which profiles are not linear about
    its mean; simulations."""
    linear_noise: float = 0.015
    """Standard deviation by noise of the logarithm of a signal at a crossing, below which a profile
    needs no running mean; simulations."""
    settled_share: float = 0.1
    """Share of its error by which a field may change in the last pass; chosen."""
    neighbours: int = 3
    """Profiles before and after each one, with whose medians it is compared: one of three may be
    unlike the others; assumed."""
    least_neighbourly: float = 1e-9
    """Probability of the chi-square of a beam about its neighbours, below which its profile is no
    part of a block; chosen."""
    default_overlap_error: float = 0.005
    """Relative error of the overlap at the nearest crossing of each beam, which those of others do
    not show where it is alike; products replace it by the declared one. Simulations."""

    # The solution
    longest_step: float = 1.5
    """Largest step of the logarithm of a constant in one pass; assumed."""
    converged_step: float = 1e-3
    """Largest change of a logarithm in the last pass of a converged solution; assumed."""
    least_fall: float = 1e-3
    """Least fall of the signals along all beams, for the start constants; assumed."""
    weak_precision: float = 1e-2
    """Precision of ln extinction in place of a prior: a standard deviation of 10; assumed."""
    largest_variance: float = 4.0
    """Variance of ln extinction beyond which it is not determined; assumed."""

    # Flags
    bins_beyond: int = 200
    """Bins kept beyond the farthest crossing: over twice the widest window of a bin."""


THRESHOLDS: Final = Thresholds()
