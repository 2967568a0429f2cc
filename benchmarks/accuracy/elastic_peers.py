"""Backgrounds and inversions of elastic profiles in a few lines of numpy, for comparison."""

from __future__ import annotations

from typing import Final

import numpy as np

from benchmarks.accuracy.elastic_cases import (
    CLEAN_FROM,
    GIVEN_WINDOW,
    LIDAR_RATIO,
    BackgroundEstimates,
    SimulatedSky,
    count_weight,
)
from benchmarks.harness.figure import Array

LINEAR: Final = "least squares {1, shape}"
"""The range from 6 km is given, and the weights are those of the mean profile."""


def linear_backgrounds(counts: Array, sky: SimulatedSky) -> BackgroundEstimates:
    """Return backgrounds by linear least squares with a constant and the shape of air."""
    first = int(np.searchsorted(sky.range, CLEAN_FROM))
    shape = sky.shape[first:] / sky.shape[first]
    slopes = np.stack([np.ones_like(shape), shape], axis=1)
    weighted = slopes * count_weight(counts[:, first:])[:, np.newaxis]
    covariance = np.linalg.inv(weighted.T @ slopes)
    background = counts[:, first:] @ (weighted @ covariance[:, 0])
    error = np.full(len(counts), np.sqrt(covariance[0, 0]))
    return BackgroundEstimates(background, error, np.zeros(len(counts), dtype=np.bool_))


def klett_numpy(power: Array, sky: SimulatedSky) -> Array:
    """Return the backscatter of particles profile by profile, without errors.

    fernald1984, backward and forward from the middle of `GIVEN_WINDOW`, by trapezoids.
    """
    inside = np.flatnonzero((sky.range >= GIVEN_WINDOW[0]) & (sky.range <= GIVEN_WINDOW[1]))
    start = inside[inside.size // 2]
    excess = sky.molecular_extinction - LIDAR_RATIO * sky.molecular_backscatter
    backscatter = np.empty(power.shape)
    for row, profile in enumerate(power):
        depth = _cumulated(excess, sky.range)
        corrected = profile * sky.range**2 * np.exp(2.0 * (depth - depth[start]))
        integral = _cumulated(LIDAR_RATIO * corrected, sky.range)
        ratio = np.mean(corrected[inside] / sky.molecular_backscatter[inside])
        total = corrected / (ratio - 2.0 * (integral - integral[start]))
        backscatter[row] = total - sky.molecular_backscatter
    return backscatter


def _cumulated(values: Array, distance: Array) -> Array:
    slices = 0.5 * (values[1:] + values[:-1]) * np.diff(distance)
    return np.concatenate([[0.0], np.cumsum(slices)])
