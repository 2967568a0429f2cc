"""Compiled tests of the residuals of a homogeneous path."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.homogeneous._projection import (
    Grid,
    Point,
    ProjectionScratch,
    Sums,
    evaluate,
    inlined,
    largest_of,
    summing,
)
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

_Triple = tuple[float, float, float]


class _TestShapes(NamedTuple):
    """Weighted products of two shapes that the model lacks with its orthogonal shapes.

    The bent signal is ``phi (x - centroid)^2``, as of backscatter that bends along the path, the
    square ``phi^2``, as of a nonlinear detector.
    """

    bent: _Triple
    """With level, shape and slope."""
    square: _Triple
    bent_norm: float
    shared: float
    square_norm: float


@summing
def _sum_test_shapes(x: Array, w: Array, phi: Array, p: Point) -> _TestShapes:
    b0 = b1 = b2 = q0 = q1 = q2 = bb = bq = qq = 0.0
    for i in range(phi.size):
        lever, first, square = x[i] - p.centroid, w[i] * phi[i], phi[i] * phi[i]
        bent, weighted_square = first * lever * lever, w[i] * square
        b0 += bent
        b1 += bent * phi[i]
        b2 += bent * phi[i] * lever
        q0 += weighted_square
        q1 += weighted_square * phi[i]
        q2 += weighted_square * phi[i] * lever
        bb += bent * phi[i] * lever * lever
        bq += bent * square
        qq += weighted_square * square
    return _TestShapes(
        (b0, b1 - p.mean_phi * b0, -2.0 * b2 - p.mean_t * b0),
        (q0, q1 - p.mean_phi * q0, -2.0 * q2 - p.mean_t * q0),
        bb,
        bq,
        qq,
    )


class _Residuals(NamedTuple):
    """Weighted sums over the residuals."""

    energy: float
    model: _Triple
    """Products with level, shape and slope."""
    bent: float
    square: float


@summing
def _sum_residuals(g: Grid, s: ProjectionScratch, fit: Point, p: Point) -> _Residuals:
    """Fill the squared residuals in units of the noise; return the sums of the residuals."""
    energy = level = shape = slope = bent = square = 0.0
    above = fit.mean_z - fit.b * fit.mean_phi
    for i in range(s.z.size):
        phi, lever = s.phi[i], g.x[i] - p.centroid
        residual = s.z[i] - above - fit.b * phi
        pull = s.w[i] * residual
        s.residual[i] = pull * residual
        energy += pull * residual
        level += pull
        pull *= phi
        shape += pull
        square += pull * phi
        pull *= lever
        slope += pull
        bent += pull * lever
    model = (level, shape - p.mean_phi * level, -2.0 * slope - p.mean_t * level)
    return _Residuals(energy, model, bent, square)


@inlined
def _fill_residuals(s: ProjectionScratch, fit: Point) -> None:
    """Fill the residuals in units of the noise."""
    above = fit.mean_z - fit.b * fit.mean_phi
    for i in range(s.z.size):
        s.residual[i] = math.sqrt(s.w[i]) * (s.z[i] - above - fit.b * s.phi[i])


@summing
def _second_differences(s: ProjectionScratch, spacing: int) -> tuple[float, float]:
    """Sum the squared second differences of residuals that many bins apart; count them."""
    total = terms = 0.0
    # Slices: an index that might be negative keeps a loop from vectorising.
    last, middle = s.residual[2 * spacing :], s.residual[spacing:]
    used_last, used_middle = s.used[2 * spacing :], s.used[spacing:]
    for i in range(last.size):
        difference = last[i] - 2.0 * middle[i] + s.residual[i]
        valid = used_last[i] * used_middle[i] * s.used[i]
        total += valid * difference * difference
        terms += valid
    return total, terms


@inlined
def _remainder(product: float, a: _Triple, b: _Triple, per: _Triple) -> float:
    """Return the part of the product of two vectors that is orthogonal to the model.

    `per` are the inverse squared lengths of level, shape and slope.
    """
    return product - (a[0] * b[0] * per[0] + a[1] * b[1] * per[1] + a[2] * b[2] * per[2])


@inlined
def _trend(t: _TestShapes, r: _Residuals, p: Point, w0: float) -> tuple[float, float]:
    """Return the energy of the residuals in the two test shapes, and their number.

    Both are orthogonalised against the model, and the square against the bent signal.
    """
    energy = count = shared = 0.0
    per = (1.0 / w0, 1.0 / p.norm, 1.0 / p.slope_norm)
    norm = _remainder(t.bent_norm, t.bent, t.bent, per)
    pulled = _remainder(r.bent, t.bent, r.model, per)
    if norm > THRESHOLDS.independent * t.bent_norm:
        energy += pulled * pulled / norm
        count += 1.0
        shared = _remainder(t.shared, t.bent, t.square, per) / norm
    norm = _remainder(t.square_norm, t.square, t.square, per) - shared * shared * norm
    if norm > THRESHOLDS.independent * t.square_norm:
        along = _remainder(r.square, t.square, r.model, per) - shared * pulled
        energy += along * along / norm
        count += 1.0
    return energy, count


@inlined
def _describe_bend(t: _TestShapes, p: Point, w0: float, free: float, row: Any) -> None:
    """Write the effect of a bent signal on the fit, relative to the amplitude.

    Parabolas about different ranges differ by shapes of the model only: the background is the
    same, and the extinction is converted to the middle of the section.
    """
    level, shape, slope = t.bent
    across = slope / p.slope_norm
    row.background_bend = free * level / w0 - shape / p.norm * p.mean_phi - across * p.mean_t
    row.extinction_bend = across + 0.5 - p.centroid


@inlined
def describe_bend_given(p: Point, row: Any) -> None:
    """Overwrite the same for a given extinction, which absorbs neither bend nor slope.

    The slope is as large as that of the bend at either end, and independent of it.
    """
    bent = row.background_bend + row.extinction_bend * p.mean_t
    row.background_bend = math.hypot(bent, 0.5 * p.mean_t)
    row.extinction_bend = 0.0


@inlined
def judge_residuals(
    g: Grid,
    s: ProjectionScratch,
    p: Point,
    tau: float,
    sums: Sums,
    noise_spacing: int,
    row: Any,
) -> _Triple:
    """Write the tests of the fit in units of the scaled noise, and the effect of a bent signal.

    A spacing of 0 stands for a known variance. Returns the products of the residuals with level,
    shape and slope.
    """
    w0, free = sums.weight, sums.free
    shapes = _sum_test_shapes(g.x, s.w, s.phi, p)
    _describe_bend(shapes, p, w0, free, row)
    full = p
    if free == 0.0:
        # The test shapes are orthogonal to the background even where it is given.
        full = evaluate(tau, g, s, Sums(sums.bins, w0, sums.value, sums.square, 1.0))
        shapes = _sum_test_shapes(g.x, s.w, s.phi, full)
    residuals: _Residuals = _sum_residuals(g, s, p, full)
    row.misfit = residuals.energy
    row.largest = math.sqrt(largest_of(s.residual))
    row.trend, row.trend_count = _trend(shapes, residuals, full, w0)
    row.second_differences, row.difference_count = 0.0, 0.0
    if noise_spacing > 0:
        _fill_residuals(s, p)
        row.second_differences, row.difference_count = _second_differences(s, noise_spacing)
    return residuals.model
