r"""Compiled joint solution of a network: all crossings of a profile together.

With the constant k of a beam, w_p = exp(k) + I_p + I_(p+1) + ... is the signal over extinction at
its passage p, so that ln extinction there is y_p = u_p - ln w_p. The constants are those with
which the beams agree best at the crossings that they share. The equations are logarithmic,
because noise of the values is then additive. In rows that are linear in 1 / extinction, noise
multiplies the unknowns and biases long chains of rows.

Each pass linearises y in the constant, with g = exp(k) / w and the inverse W of the covariance of
y. M = W - W g g' W / (g' W g) is the information of a beam with its constant eliminated. The
crossings x follow from (sum A' M A + P) x = sum A' M y, where A selects the crossings of a beam
and P is the precision of the prior; then k changes by g' W (y - A x) / (g' W g).
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.network.thresholds import THRESHOLDS

CHI_SQUARE: Final = 0
"""Column of a summary: chi-square of the beams alone, at their best solution."""
TOTAL_CHI_SQUARE: Final = 1
"""That of the beams and the prior, if any, at the solution."""
LIKELIHOOD: Final = 2
"""-2 ln of the marginal likelihood, without a constant; NaN where nothing is determined."""
STEP: Final = 3
"""Largest change of a logarithm in the last pass."""
COLUMNS: Final = 4


@compiled
def _factorise(matrix: Array, size: int) -> float:
    """Overwrite the lower triangle by its Cholesky factor; return ln determinant, NaN if none."""
    logarithm = 0.0
    for i in range(size):
        diagonal = matrix[i, i]
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i != j:
                matrix[i, j] = total / matrix[j, j]
            elif total > THRESHOLDS.smallest_pivot * diagonal:
                matrix[i, i] = math.sqrt(total)
                logarithm += math.log(total)
            else:
                return math.nan
    return logarithm


@compiled
def _substitute(factor: Array, size: int, side: Array) -> None:
    """Overwrite the right side by the solution of the factorised system."""
    for i in range(size):
        total = side[i]
        for k in range(i):
            total -= factor[i, k] * side[k]
        side[i] = total / factor[i, i]
    for i in range(size - 1, -1, -1):
        total = side[i]
        for k in range(i + 1, size):
            total -= factor[k, i] * side[k]
        side[i] = total / factor[i, i]


@compiled
def _invert(factor: Array, size: int, out: Array) -> None:
    """Fill the inverse of a factorised system."""
    for v in range(size):
        for i in range(size):
            out[v, i] = 0.0
        out[v, v] = 1.0
        _substitute(factor, size, out[v])


@compiled
def _fill_covariance(
    packed: Array, count: int, quantities: int, weights: Array, half: Array, out: Array
) -> None:
    """Fill the covariance of u_p - ln w_p, from that of values and integrals."""
    first = (quantities + 1) // 2
    for i in range(count):
        for q in range(quantities):
            total = 0.0
            for s in range(i, count - 1):
                total += packed[(first + s) * quantities + q]
            half[i, q] = packed[i * quantities + q] - total / weights[i]
    for i in range(count):
        for j in range(i + 1):
            total = 0.0
            for s in range(j, count - 1):
                total += half[i, first + s]
            out[i, j] = half[i, j] - total / weights[j]


@compiled
def _linearise(
    values: Array,
    integrals: Array,
    packed: Array,
    quantities: int,
    constant: float,
    y: Array,
    gain: Array,
    information: Array,
    work: tuple[Array, Array, Array],
) -> tuple[float, float]:
    """Fill y, gain S j / (j' S j) and information M of a beam.

    Returns
    -------
    float
        ln determinant of covariance and information on the constant; NaN if there is none.
    float
        Derivative j of ln w at the first passage.
    """
    count = values.size
    weights, half, matrix = work
    end, remaining = math.exp(constant), 0.0
    for p in range(count - 1, -1, -1):
        if p < count - 1:
            remaining += integrals[p]
        weights[p] = end + remaining
        y[p] = values[p] - math.log(weights[p])
    _fill_covariance(packed, count, quantities, weights, half, matrix)
    logarithm = _factorise(matrix, count)
    if math.isnan(logarithm):
        return logarithm, 0.0
    _invert(matrix, count, information)
    known = 0.0
    for p in range(count):
        gain[p] = 0.0
        for q in range(count):
            gain[p] += information[p, q] * end / weights[q]
        known += gain[p] * end / weights[p]
    for p in range(count):
        for q in range(count):
            information[p, q] -= gain[p] * gain[q] / known
    for p in range(count):
        gain[p] /= known
        # Values that are not finite determine nothing.
        logarithm += 0.0 * y[p]
    return logarithm + math.log(known), end / weights[0]


@compiled
def _assemble(
    data: tuple[Array, Array, Array],
    geometry: tuple[Indices, Indices, Indices],
    counts: Indices,
    constants: Array,
    beams: tuple[Array, Array, Array, Array],
    work: tuple[Array, Array, Array],
    normal: Array,
    target: Array,
    seen: Booleans,
) -> tuple[float, float, float]:
    """Fill the normal equations of all beams; return y' M y, ln determinants and mean y.

    A beam with a singular covariance is left out: its count becomes 0. The mean is NaN without
    any beam.
    """
    values, integrals, covariance = data
    first_passage, offset, crossing = geometry
    y, gain, information, first_derivative = beams
    normal[:], target[:], seen[:] = 0.0, 0.0, False
    square = determinants = level = 0.0
    passages = 0
    for beam in range(counts.size):
        first, last = first_passage[beam], first_passage[beam] + counts[beam]
        if counts[beam] == 0:
            continue
        own = information[beam]
        quantities = 2 * (first_passage[beam + 1] - first) - 1
        logarithm, first_derivative[beam] = _linearise(
            values[first:last], integrals[first:last], covariance[offset[beam] : offset[beam + 1]],
            quantities, constants[beam], y[first:last], gain[first:last], own, work,
        )  # fmt: skip
        if not abs(logarithm) < math.inf:
            counts[beam] = 0
            continue
        determinants += logarithm
        for i in range(last - first):
            v = crossing[first + i]
            seen[v] = True
            level += y[first + i]
            passages += 1
            for k in range(last - first):
                normal[v, crossing[first + k]] += own[i, k]
                target[v] += own[i, k] * y[first + k]
                square += y[first + i] * own[i, k] * y[first + k]
    return square, determinants, level / passages if passages > 0 else math.nan


@compiled
def _move_constants(
    geometry: tuple[Indices, Indices, Indices],
    counts: Indices,
    beams: tuple[Array, Array, Array, Array],
    solution: Array,
    constants: Array,
) -> float:
    """Update the constants of the beams; return the largest change of a logarithm."""
    first_passage, _, crossing = geometry
    y, gain, _, first_derivative = beams
    moved = 0.0
    for beam in range(counts.size):
        step = 0.0
        for c in range(first_passage[beam], first_passage[beam] + counts[beam]):
            step += gain[c] * (y[c] - solution[crossing[c]])
        step = min(max(step, -THRESHOLDS.longest_step), THRESHOLDS.longest_step)
        constants[beam] += step
        if counts[beam] > 0:
            moved = max(moved, abs(step) * first_derivative[beam])
    return moved


@compiled
def _least_chi_square(matrix: Array, side: Array, seen: Booleans, square: float) -> float:
    """Return the smallest chi-square of the beams alone, at the constants found with the prior."""
    for v in range(side.size):
        matrix[v, v] += 0.0 if seen[v] else 1.0
    if math.isnan(_factorise(matrix, side.size)):
        return math.nan
    best = side.copy()
    _substitute(matrix, side.size, best)
    for v in range(side.size):
        square -= best[v] * side[v]
    return square


@compiled
def _carry(
    inverse: Array,
    information: Array,
    geometry: tuple[Indices, Indices, Indices],
    counts: Indices,
    out: Array,
) -> None:
    """Fill the derivatives C A' M of the solution by the values."""
    first_passage, _, crossing = geometry
    out[:] = 0.0
    for v in range(out.shape[0]):
        for beam in range(counts.size):
            first = first_passage[beam]
            for i in range(counts[beam]):
                for k in range(counts[beam]):
                    out[v, first + k] += inverse[v, crossing[first + i]] * information[beam, i, k]


@compiled
def solve_joint(
    values: Array,
    integrals: Array,
    covariance: Array,
    geometry: tuple[Indices, Indices, Indices],
    precision: Array,
    level_precision: float,
    passes: int,
    counts: Indices,
    constants: Array,
    solution: Array,
    inverse: Array,
    carried: Array,
    seen: Booleans,
    summary: Array,
) -> None:
    """Solve profiles for the logarithms of extinction at all crossings.

    Parameters
    ----------
    values, integrals, covariance
        From `lidarops.retrieve.network._condensed_signals.condense`.
    geometry : (beam + 1,), (beam + 1,) and (passage,) intp
        First passage and start of the covariance of each beam; crossing of each passage.
    precision : (crossing, crossing) float64
        Prior precision of ln extinction.
    level_precision : float
        Precision with which each crossing is drawn to the level of the profile; 0 with a prior.
    passes : int
        Number of linearisations.
    counts : (profile, beam) intp
        In: number of usable passages, 0 or at least 2. Out: 0 also where the covariance is
        singular or not finite.
    constants : (profile, beam) float64
        In: start values. Out: values after the last pass.
    solution : (profile, crossing) float64
        Out: ln(extinction / m-1). This and the next two are valid where determined.
    inverse : (profile, crossing, crossing) float64
        Out: covariance C of the solution, if the prior is true.
    carried : (profile, crossing, passage) float64
        Out: C A' M, the derivative of the solution by the values.
    seen : (profile, crossing) bool
        Out: whether any beam passes.
    summary : (profile, COLUMNS) float64
    """
    beams, crossings, total = counts.shape[1], solution.shape[1], values.shape[1]
    most = np.max(np.diff(geometry[0]))
    information = np.zeros((beams, most, most))
    state = np.zeros(total), np.zeros(total), information, np.zeros(beams)
    work = np.empty(most), np.empty((most, 2 * most)), np.empty((most, most))
    normal, factor = np.empty((crossings, crossings)), np.empty((crossings, crossings))
    target = np.empty(crossings)
    for n in range(values.shape[0]):
        data, x = (values[n], integrals[n], covariance[n]), solution[n]
        step = square = determinants = math.nan
        for _ in range(passes):
            square, determinants, level = _assemble(
                data, geometry, counts[n], constants[n], state, work, normal, target, seen[n]
            )
            factor[:] = normal + precision
            x[:] = target + level_precision * level
            # Without beams or with values that are not finite, nothing is determined.
            determinants += _factorise(factor, crossings) + 0.0 * (square + level)
            if math.isnan(determinants):
                break
            _substitute(factor, crossings, x)
            step = _move_constants(geometry, counts[n], state, x, constants[n])
        summary[n] = math.nan
        if math.isnan(determinants):
            continue
        _invert(factor, crossings, inverse[n])
        _carry(inverse[n], information, geometry, counts[n], carried[n])
        # Without a prior, its place holder is no part of chi-square.
        share = 0.0 if level_precision > 0.0 else 1.0
        chi_square = square
        for v in range(crossings):
            for w in range(crossings):
                chi_square += x[v] * (normal[v, w] + share * precision[v, w]) * x[w]
            chi_square -= 2.0 * x[v] * target[v]
        summary[n, CHI_SQUARE] = _least_chi_square(normal, target, seen[n], square)
        summary[n, TOTAL_CHI_SQUARE] = chi_square
        summary[n, LIKELIHOOD] = chi_square + determinants
        summary[n, STEP] = step
