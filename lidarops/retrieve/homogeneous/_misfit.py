"""Compiled tests of the residuals of a homogeneous path."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.homogeneous._estimate import (
    BACKGROUND_BEND,
    BOUNDED,
    DIFFERENCE_COUNT,
    EXTINCTION_BEND,
    LARGEST,
    MISFIT,
    SECOND_DIFFERENCES,
    TREND,
    TREND_COUNT,
)
from lidarops.retrieve.homogeneous._projection import (
    Grid,
    Point,
    ProjectionScratch,
    compiled,
    evaluate,
    largest_of,
    product,
    summing,
)
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]

INDEPENDENT: Final = THRESHOLDS.independent


@compiled
def _residuals(s: ProjectionScratch, p: Point) -> None:
    """Fill the residuals in units of the noise, and times weight; 0 for unused bins."""
    for i in range(s.z.size):
        residual = s.z[i] - p.mean_z - p.b * (s.phi[i] - p.mean_phi)
        s.residual[i] = math.sqrt(s.w[i]) * residual
        s.pull[i] = s.w[i] * residual


@summing
def _second_differences(s: ProjectionScratch) -> tuple[float, float]:
    """Sum the squared second differences of the residuals between neighbours; count them."""
    total = terms = 0.0
    # Slices: an index that might be negative keeps a loop from vectorising.
    last, middle = s.residual[2:], s.residual[1:]
    used_last, used_middle = s.used[2:], s.used[1:]
    for i in range(last.size):
        difference = last[i] - 2.0 * middle[i] + s.residual[i]
        valid = used_last[i] * used_middle[i] * s.used[i]
        total += valid * difference * difference
        terms += valid
    return total, terms


@summing
def _model_products(weighted: Array, g: Grid, phi: Array, p: Point) -> tuple[float, float, float]:
    """Return the products of a weighted vector with the orthogonal shapes of the model."""
    level = shape = slope = 0.0
    for i in range(weighted.size):
        level += weighted[i]
        shape += weighted[i] * (phi[i] - p.mean_phi)
        slope += weighted[i] * (-2.0 * (g.x[i] - p.centroid) * phi[i] - p.mean_t)
    return level, shape, slope


@compiled
def _remainder(
    product: float,
    a: tuple[float, float, float],
    b: tuple[float, float, float],
    p: Point,
    w0: float,
) -> float:
    """Return the part of the product of two vectors that is orthogonal to the model."""
    return product - (a[0] * b[0] / w0 + a[1] * b[1] / p.norm + a[2] * b[2] / p.slope_norm)


@compiled
def _trend(g: Grid, s: ProjectionScratch, p: Point, w0: float) -> tuple[float, float]:
    """Return the energy of the residuals in two shapes that the model lacks, and their number.

    One is backscatter that bends along the path, ``phi x^2``, the other a nonlinear detector,
    ``phi^2``; both are orthogonalised against the model.
    """
    bent, square, weighted_bent, weighted_square = s.tests
    for i in range(g.x.size):
        lever = g.x[i] - p.centroid
        bent[i] = lever * lever * s.phi[i]
        square[i] = s.phi[i] * s.phi[i]
        weighted_bent[i] = s.w[i] * bent[i]
        weighted_square[i] = s.w[i] * square[i]
    bent_products = _model_products(weighted_bent, g, s.phi, p)
    square_products = _model_products(weighted_square, g, s.phi, p)
    residual_products = _model_products(s.pull, g, s.phi, p)
    energy = count = shared = 0.0
    square_norm = product(bent, weighted_bent)
    norm = _remainder(square_norm, bent_products, bent_products, p, w0)
    pulled = _remainder(product(bent, s.pull), bent_products, residual_products, p, w0)
    if norm > INDEPENDENT * square_norm:
        energy += pulled * pulled / norm
        count += 1.0
        shared = (
            _remainder(product(bent, weighted_square), bent_products, square_products, p, w0) / norm
        )
    square_norm = product(square, weighted_square)
    norm = _remainder(square_norm, square_products, square_products, p, w0) - shared * shared * norm
    if norm > INDEPENDENT * square_norm:
        along = (
            _remainder(product(square, s.pull), square_products, residual_products, p, w0)
            - shared * pulled
        )
        energy += along * along / norm
        count += 1.0
    return energy, count


@summing
def _bent_signal_products(g: Grid, s: ProjectionScratch, p: Point) -> tuple[float, float, float]:
    """Return the products of ``phi (x - centroid)^2`` with the orthogonal shapes of the model."""
    level = shape = slope = 0.0
    for i in range(g.x.size):
        lever = g.x[i] - p.centroid
        weighted = s.w[i] * s.phi[i] * lever * lever
        level += weighted
        shape += weighted * (s.phi[i] - p.mean_phi)
        slope += weighted * (-2.0 * lever * s.phi[i] - p.mean_t)
    return level, shape, slope


@compiled
def describe_bend(
    g: Grid, s: ProjectionScratch, p: Point, w0: float, free: float, row: Array
) -> None:
    """Write the effect of a bent signal on the fit, relative to the amplitude.

    Parabolas about different ranges differ by shapes of the model only: the background is the
    same, and the extinction is converted to the middle of the section.
    """
    level, shape, slope = _bent_signal_products(g, s, p)
    across = slope / p.slope_norm
    row[BACKGROUND_BEND] = free * level / w0 - shape / p.norm * p.mean_phi - across * p.mean_t
    row[EXTINCTION_BEND] = across + 0.5 - p.centroid


@compiled
def describe_bend_given(p: Point, row: Array) -> None:
    """Overwrite the same for a given extinction, which absorbs neither bend nor slope.

    The slope is as large as that of the bend at either end, and independent of it.
    """
    bent = row[BACKGROUND_BEND] + row[EXTINCTION_BEND] * p.mean_t
    row[BACKGROUND_BEND] = math.hypot(bent, 0.5 * p.mean_t)
    row[EXTINCTION_BEND] = 0.0


@compiled
def judge_residuals(
    g: Grid,
    s: ProjectionScratch,
    p: Point,
    tau: float,
    sums: tuple[float, float, float],
    row: Array,
) -> None:
    """Write the tests of the fit, in units of the scaled noise."""
    w0, wz, free = sums
    _residuals(s, p)
    row[MISFIT] = product(s.residual, s.residual)
    row[SECOND_DIFFERENCES], row[DIFFERENCE_COUNT] = _second_differences(s)
    row[LARGEST] = largest_of(s.residual)
    # The test shapes are orthogonal to the background even where it is given.
    full = p if free > 0.0 else evaluate(tau, g, s, w0, wz, 1.0)
    row[TREND], row[TREND_COUNT] = _trend(g, s, full, w0)
    row[BOUNDED] = tau <= g.nodes[0] or tau >= g.nodes[-1]
