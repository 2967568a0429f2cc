"""Compiled tests of the residuals of a homogeneous path."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from lidarops.retrieve.common.compiled_code import inlined, summing
from lidarops.retrieve.homogeneous._projection import (
    Grid,
    Point,
    Scratch,
    Sums,
    evaluate,
    largest_energy,
)
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

_Triple = tuple[float, float, float]


class Left(NamedTuple):
    """Products of the residuals with level, shape and slope of the model."""

    level: float
    shape: float
    slope: float


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


class _Residuals(NamedTuple):
    """Weighted sums of the residuals, times powers of phi and of x."""

    energy: float
    level: float
    shape: float
    lever: float
    bend: float
    square: float


@inlined
def _test_shapes(p: Point, free: float) -> _TestShapes:
    c, (q0, q1, q2), (p0, p1, p2, p3, p4) = p.centroid, p.sums_of_shape.phi, p.sums_of_shape.square
    c0, c1, c2 = p.sums_of_shape.cube
    mean_phi, mean_slope = free * p.mean_phi, free * p.mean_slope
    b0 = q2 - c * (2.0 * q1 - c * q0)
    b1 = p2 - c * (2.0 * p1 - c * p0)
    b2 = p3 - c * (3.0 * p2 - c * (3.0 * p1 - c * p0))
    return _TestShapes(
        (b0, b1 - mean_phi * b0, -2.0 * b2 - mean_slope * b0),
        (p0, c0 - mean_phi * p0, -2.0 * (c1 - c * c0) - mean_slope * p0),
        p4 - c * (4.0 * p3 - c * (6.0 * p2 - c * (4.0 * p1 - c * p0))),
        c2 - c * (2.0 * c1 - c * c0),
        p.sums_of_shape.fourth,
    )


@summing
def _sum_residuals(g: Grid, s: Scratch, p: Point) -> _Residuals:
    """Fill the residuals, and return their sums."""
    energy = level = shape = lever = bend = square = 0.0
    for i in range(s.z.size):
        phi, x = s.phi[i], g.x[i]
        residual = s.z[i] - p.level - p.b * phi
        s.residual[i] = residual
        pull = s.w[i] * residual
        energy += pull * residual
        level += pull
        pull *= phi
        shape += pull
        square += pull * phi
        lever += pull * x
        bend += pull * x * x
    return _Residuals(energy, level, shape, lever, bend, square)


@inlined
def _left(r: _Residuals, p: Point, free: float) -> Left:
    return Left(
        r.level,
        r.shape - free * p.mean_phi * r.level,
        -2.0 * (r.lever - p.centroid * r.shape) - free * p.mean_slope * r.level,
    )


@summing
def _second_differences(s: Scratch, spacing: int) -> tuple[float, float]:
    """Sum the squared second differences of residuals that many bins apart; count them.

    In units of the noise: the residuals become those.
    """
    for i in range(s.w.size):
        s.residual[i] *= math.sqrt(s.w[i])
    total = terms = 0.0
    # Slices: an index that might be negative keeps a loop from vectorising.
    last, middle = s.residual[2 * spacing :], s.residual[spacing:]
    used_last, used_middle = s.w[2 * spacing :], s.w[spacing:]
    for i in range(last.size):
        difference = last[i] - 2.0 * middle[i] + s.residual[i]
        valid = (used_last[i] > 0.0) & (used_middle[i] > 0.0) & (s.w[i] > 0.0)
        total += difference * difference if valid else 0.0
        terms += 1.0 if valid else 0.0
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
    left = _left(r, p, 1.0)
    model = (left.level, left.shape, left.slope)
    per = (1.0 / w0, 1.0 / p.norm, 1.0 / p.slope_norm)
    norm = _remainder(t.bent_norm, t.bent, t.bent, per)
    bent = r.bend - p.centroid * (2.0 * r.lever - p.centroid * r.shape)
    pulled = _remainder(bent, t.bent, model, per)
    if norm > THRESHOLDS.independent * t.bent_norm:
        energy += pulled * pulled / norm
        count += 1.0
        shared = _remainder(t.shared, t.bent, t.square, per) / norm
    norm = _remainder(t.square_norm, t.square, t.square, per) - shared * shared * norm
    if norm > THRESHOLDS.independent * t.square_norm:
        along = _remainder(r.square, t.square, model, per) - shared * pulled
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
    row.background_bend = free * (level / w0 - shape / p.norm * p.mean_phi - across * p.mean_slope)
    row.extinction_bend = across + 0.5 - p.centroid


@inlined
def judge_residuals(
    g: Grid, s: Scratch, p: Point, sums: Sums, noise_spacing: int, row: Any
) -> Left:
    """Write the tests of the fit in units of the scaled noise, and the effect of a bent signal.

    A spacing of 0 stands for a known variance.
    """
    w0, free = sums.weight, sums.free
    shapes = _test_shapes(p, free)
    _describe_bend(shapes, p, w0, free, row)
    residuals = _sum_residuals(g, s, p)
    row.misfit = residuals.energy
    row.largest = math.sqrt(largest_energy(s.residual, s))
    if free > 0.0:
        row.trend, row.trend_count = _trend(shapes, residuals, p, w0)
    else:
        # The test shapes are orthogonal to the background even where it is given.
        full = evaluate(p.tau, g, s, Sums(sums.bins, w0, sums.place, sums.value, sums.square, 1.0))
        shapes = _test_shapes(full, 1.0)
        row.trend, row.trend_count = _trend(shapes, residuals, full, w0)
    row.second_differences, row.difference_count = 0.0, 0.0
    if noise_spacing > 0:
        row.second_differences, row.difference_count = _second_differences(s, noise_spacing)
    left: Left = _left(residuals, p, free)
    return left
