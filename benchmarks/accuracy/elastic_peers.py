"""Backgrounds and inversions of elastic profiles in a few lines of numpy, for comparison."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.integrate import cumulative_trapezoid

from benchmarks.harness.figure import Array
from benchmarks.scenes.elastic_skies import (
    CLEAN_FROM,
    GIVEN_WINDOW,
    LIDAR_RATIO,
    Backgrounds,
    SimulatedSky,
    count_weight,
)

LINEAR: Final = "least squares {1, shape}"
"""The range from 6 km is given, and the weights are those of the mean profile."""
KLETT: Final = "Klett, numpy"


def linear_backgrounds(counts: Array, sky: SimulatedSky) -> Backgrounds:
    """Return backgrounds by linear least squares with a constant and the shape of air."""
    first = int(np.searchsorted(sky.range, CLEAN_FROM))
    shape = sky.shape[first:] / sky.shape[first]
    slopes = np.stack([np.ones_like(shape), shape], axis=1)
    weighted = slopes * count_weight(counts[:, first:])[:, np.newaxis]
    covariance = np.linalg.inv(weighted.T @ slopes)
    background = counts[:, first:] @ (weighted @ covariance[:, 0])
    error = np.full(len(counts), np.sqrt(covariance[0, 0]))
    return Backgrounds(background, error, np.zeros(len(counts), dtype=np.bool_))


def klett_numpy(counts: Array, sky: SimulatedSky) -> Array:
    """Return the backscatter of particles without errors, by the background of the peer.

    fernald1984, backward and forward from the middle of `GIVEN_WINDOW`, by trapezoids.
    """
    power = counts - linear_backgrounds(counts, sky).background[:, np.newaxis]
    inside = np.flatnonzero((sky.range >= GIVEN_WINDOW[0]) & (sky.range <= GIVEN_WINDOW[1]))
    start = inside[inside.size // 2]
    depth = _from(start, sky.molecular_extinction - LIDAR_RATIO * sky.molecular_backscatter, sky)
    corrected = power * sky.range**2 * np.exp(2.0 * depth)
    integral = _from(start, LIDAR_RATIO * corrected, sky)
    ratio = np.mean(corrected[:, inside] / sky.molecular_backscatter[inside], axis=1)
    total = corrected / (ratio[:, np.newaxis] - 2.0 * integral)
    return np.asarray(total - sky.molecular_backscatter)


def _from(start: int, values: Array, sky: SimulatedSky) -> Array:
    """Return the integral over range from a bin."""
    integral = cumulative_trapezoid(values, sky.range, initial=0.0)
    return np.asarray(integral - integral[..., start : start + 1])
