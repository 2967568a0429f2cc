"""Compiled joint solution of a network: all crossings of a profile together.

Along a beam, a_p / extinction_p + 2 m (integral from the first crossing to p) is a constant. The
solution chooses one constant per beam so that beams agree at the crossings that they share. The
equations are logarithmic, because noise of the values is then additive. In rows that are linear
in 1 / extinction, noise multiplies the unknowns and biases long chains of rows. Each pass
linearises the constants, weights with the full covariance of a beam, eliminates its constant and
solves for the crossings by Cholesky factorisation.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Final

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.network.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Codes = npt.NDArray[np.uint8]

SOLVED: Final = 0
UNDETERMINED: Final = 1
"""No crossings, or a singular system."""
UNSETTLED: Final = 2
"""The solution did not converge."""

LIKELIHOOD: Final = 4
COLUMNS: Final = 5
"""Columns of a summary: chi-square and degrees of freedom of the beams alone, then of beams and
prior; -2 ln of the marginal likelihood, without a constant."""

LONGEST_STEP: Final = THRESHOLDS.longest_step
_THINNEST_BEAM: Final = THRESHOLDS.thinnest_beam
_CONVERGED_STEP: Final = THRESHOLDS.converged_step
_TINIEST_PIVOT: Final = THRESHOLDS.smallest_pivot
_WEAK_PRECISION: Final = THRESHOLDS.weak_precision
PRIOR_DOUBT: Final = THRESHOLDS.doubt
_LARGEST_VARIANCE: Final = THRESHOLDS.largest_variance

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def factorise(matrix: Array, size: int) -> bool:
    """Overwrite the lower triangle by its Cholesky factor; return False if it is singular."""
    for i in range(size):
        diagonal = matrix[i, i]
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not total > _TINIEST_PIVOT * diagonal:
                    return False
                matrix[i, i] = math.sqrt(total)
            else:
                matrix[i, j] = total / matrix[j, j]
    return True


@_compiled
def substitute_factorised(factor: Array, size: int, side: Array) -> None:
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


@_compiled
def _row_covariance(packed: Array, quantities: int, count: int, weights: Array, out: Array) -> None:
    """Fill the covariance of u_c - ln w_c, where w_c contains all integrals beyond c.

    With d_cs = -1 / w_c for the integrals s >= c, it is U + d V' + V d' + d W d', summed over
    the integrals.
    """
    first = (quantities + 1) // 2
    for i in range(count):
        for j in range(count):
            cross = 0.0
            for s in range(j, count - 1):
                cross += packed[i * quantities + first + s]
            out[i, j] = packed[i * quantities + j] - cross / weights[j]
    # Second half of the transformation: the rows.
    for i in range(count):
        for j in range(i + 1):
            row_term = 0.0
            for s in range(i, count - 1):
                row_term += packed[(first + s) * quantities + j]
                for t in range(j, count - 1):
                    row_term -= packed[(first + s) * quantities + first + t] / weights[j]
            out[i, j] -= row_term / weights[i]
    for i in range(count):
        for j in range(i + 1, count):
            out[i, j] = out[j, i]


@_compiled
def _invert(matrix: Array, size: int, inverse: Array) -> float:
    """Fill the inverse of a covariance, which is overwritten; return ln determinant or NaN."""
    if not factorise(matrix, size):
        return math.nan
    logarithm = 0.0
    for i in range(size):
        logarithm += 2.0 * math.log(matrix[i, i])
        for j in range(size):
            inverse[i, j] = 0.0
        inverse[i, i] = 1.0
        substitute_factorised(matrix, size, inverse[i])
    return logarithm


@_compiled
def _linearise_beam(
    values: Array,
    integrals: Array,
    packed: Array,
    quantities: int,
    count: int,
    constant: float,
    work: tuple[Array, Array, Array],
    columns: Array,
) -> tuple[float, float]:
    """Linearise a beam; return the information on its constant, and the log determinant.

    Columns filled: y = u - ln w, the derivative j of ln w by the constant, and P j.
    """
    covariance, inverse, weights = work
    remaining, end_value = 0.0, math.exp(constant)
    for c in range(count - 1, -1, -1):
        if c < count - 1:
            remaining += integrals[c]
        weights[c] = end_value + remaining
        columns[c, 0] = values[c] - math.log(weights[c])
        columns[c, 1] = end_value / weights[c]
    _row_covariance(packed, quantities, count, weights, covariance)
    logarithm = _invert(covariance, count, inverse)
    information = 0.0
    for i in range(count):
        total = 0.0
        for k in range(count):
            total += inverse[i, k] * columns[k, 1]
        columns[i, 2] = total
        information += total * columns[i, 1]
    return information, logarithm


@_compiled
def _homogeneous_constant(
    integrals: Array, exponent: float, count: int, extinction: float, length: float
) -> float:
    """Return the constant of a beam in homogeneous air."""
    total = 0.0
    for c in range(count - 1):
        total += integrals[c]
    depth = max(2.0 * exponent * extinction * length, _THINNEST_BEAM)
    return math.log(total / math.expm1(depth))


@_compiled
def start_constants(
    integrals: Array,
    usable: Codes,
    slopes: Array,
    lengths: Array,
    exponent: Array,
    first_passage: Indices,
    constants: Array,
) -> None:
    """Fill (profile, beam) constants of homogeneous air.

    Parameters
    ----------
    integrals, usable, slopes
        From `lidarops.retrieve.network._condensed_signals.condense`.
    lengths : (passage,) float64
        m, from a passage to the next one on its beam.
    exponent : (beam,) float64
    first_passage : (beam + 1,) intp
    constants : (profile, beam) float64
        Logarithms of the signal at the last passage over extinction there.
    """
    for n in range(integrals.shape[0]):
        weighted_sum = weight_sum = 0.0
        for c in range(lengths.size):
            if slopes[n, c, 1] > 0.0:
                weighted_sum += slopes[n, c, 0] / slopes[n, c, 1]
                weight_sum += 1.0 / slopes[n, c, 1]
        extinction = weighted_sum / weight_sum if weight_sum > 0.0 else 0.0
        for beam in range(exponent.size):
            first, last = first_passage[beam], first_passage[beam + 1]
            count = _count_usable(usable[n], first, last)
            length = 0.0
            for c in range(first, first + count - 1):
                length += lengths[c]
            constants[n, beam] = 0.0
            if count >= 2:
                constants[n, beam] = _homogeneous_constant(
                    integrals[n, first:last], exponent[beam], count, extinction, length
                )


@_compiled
def _count_usable(usable: Codes, first: int, last: int) -> int:
    """Return the number of usable passages before the first one that is not."""
    count = 0
    for c in range(first, last):
        if usable[c] == 0:
            break
        count += 1
    return count


@_compiled
def _add_beam(
    columns: Array,
    inverse: Array,
    information: float,
    crossing: Indices,
    matrix: Array,
    side: Array,
) -> float:
    """Add a beam without its constant to the normal equations; return y' M y."""
    count, square = crossing.size, 0.0
    for i in range(count):
        for k in range(count):
            entry = inverse[i, k] - columns[i, 2] * columns[k, 2] / information
            matrix[crossing[i], crossing[k]] += entry
            side[crossing[i]] += entry * columns[k, 0]
            square += columns[i, 0] * entry * columns[k, 0]
    return square


@_compiled
def add_prior(
    matrix: Array, side: Array, level: float, precision: Array, without_prior: bool
) -> None:
    """Add the prior to the normal equations.

    Without a prior, a standard deviation of 10 about the level of the profile takes its place, so
    that undetermined crossings do not make the system singular.
    """
    for v in range(side.size):
        if without_prior:
            matrix[v, v] += _WEAK_PRECISION
            side[v] += _WEAK_PRECISION * level
            continue
        for w in range(side.size):
            matrix[v, w] += precision[v, w]


@_compiled
def invert_system(factor: Array, size: int, out: Array) -> None:
    """Fill the inverse of a factorised system."""
    for v in range(size):
        for i in range(size):
            out[v, i] = 0.0
        out[v, v] = 1.0
        substitute_factorised(factor, size, out[v])


@_compiled
def count_passages(usable: Codes, first_passage: Indices, counts: Indices) -> None:
    """Fill the number of usable passages of each beam; 0 where there is only one."""
    for beam in range(counts.size):
        count = _count_usable(usable, first_passage[beam], first_passage[beam + 1])
        counts[beam] = count if count >= 2 else 0


@_compiled
def _count_observations(
    first_passage: Indices, crossing: Indices, counts: Indices, seen: Codes
) -> tuple[int, int, int]:
    """Fill which crossings are seen; return the numbers of beams, passages and crossings."""
    used = observations = crossings = 0
    for v in range(seen.size):
        seen[v] = 0
    for beam in range(counts.size):
        if counts[beam] == 0:
            continue
        used += 1
        observations += counts[beam]
        for c in range(first_passage[beam], first_passage[beam] + counts[beam]):
            crossings += 1 - seen[crossing[c]]
            seen[crossing[c]] = 1
    return used, observations, crossings


@_compiled
def assemble(
    data: tuple[Array, Array, Array],
    geometry: tuple[Indices, Indices, Indices],
    counts: Indices,
    constants: Array,
    work: tuple[Array, Array, Array, Array, Array],
    matrix: Array,
    side: Array,
) -> tuple[float, float, float]:
    """Fill the normal equations of all beams; return y' M y, log determinants and mean level.

    A beam with a singular covariance is left out: its count becomes 0.
    """
    values, integrals, covariance = data
    first_passage, offset, crossing = geometry
    scratch, inverses, weights, columns, information = work
    for v in range(side.size):
        side[v] = 0.0
        for w in range(side.size):
            matrix[v, w] = 0.0
    square = logarithms = level = 0.0
    passages = 0
    for beam in range(counts.size):
        if counts[beam] == 0:
            continue
        first = first_passage[beam]
        last = first + counts[beam]
        quantities = 2 * (first_passage[beam + 1] - first) - 1
        information[beam], logarithm = _linearise_beam(
            values[first:last], integrals[first:last],
            covariance[offset[beam] : offset[beam + 1]], quantities, counts[beam],
            constants[beam], (scratch, inverses[beam], weights), columns[beam],
        )  # fmt: skip
        for c in range(counts[beam]):
            logarithm += 0.0 * columns[beam, c, 0]
        if not (math.isfinite(logarithm) and 0.0 < information[beam] < math.inf):
            counts[beam] = 0
            continue
        square += _add_beam(
            columns[beam], inverses[beam], information[beam], crossing[first:last], matrix, side
        )
        logarithms += logarithm + math.log(information[beam])
        for c in range(counts[beam]):
            level += columns[beam, c, 0]
            passages += 1
    return square, logarithms, level / max(passages, 1)


@_compiled
def _move_constants(
    geometry: tuple[Indices, Indices, Indices],
    counts: Indices,
    columns: Array,
    information: Array,
    solution: Array,
    constants: Array,
) -> float:
    """Update the constants of the beams; return the largest change of a logarithm."""
    first_passage, _, crossing = geometry
    moved = 0.0
    for beam in range(counts.size):
        if counts[beam] == 0:
            continue
        step = 0.0
        for c in range(counts[beam]):
            residual = columns[beam, c, 0] - solution[crossing[first_passage[beam] + c]]
            step += columns[beam, c, 2] * residual
        step = min(max(step / information[beam], -LONGEST_STEP), LONGEST_STEP)
        constants[beam] += step
        moved = max(moved, abs(step) * columns[beam, 0, 1])
    return moved


@_compiled
def workspace(first_passage: Indices, beams: int) -> tuple[Array, Array, Array, Array, Array]:
    """Return scratch, inverse covariances, weights, columns and information of the beams."""
    most_passages = 1
    for beam in range(beams):
        most_passages = max(most_passages, first_passage[beam + 1] - first_passage[beam])
    return (
        np.empty((most_passages, most_passages)), np.empty((beams, most_passages, most_passages)),
        np.empty(most_passages), np.empty((beams, most_passages, 3)), np.empty(beams),
    )  # fmt: skip


@_compiled
def solve_joint(
    values: Array,
    integrals: Array,
    usable: Codes,
    covariance: Array,
    geometry: tuple[Indices, Indices, Indices],
    precision: Array,
    excluded_fields: Array,
    norm: float,
    without_prior: bool,
    passes: int,
    constants: Array,
    logarithms: Array,
    variances: Array,
    prior_true_variance: Array,
    excluded_variance: Array,
    summary: Array,
    status: Codes,
    left_out: Codes,
) -> None:
    """Solve profiles for the logarithms of extinction at all crossings.

    Parameters
    ----------
    values, integrals, usable, covariance
        From `lidarops.retrieve.network._condensed_signals.condense`.
    geometry : (beam + 1,), (beam + 1,) and (passage,) intp
        First passage and start of the covariance of each beam; crossing of each passage.
    precision : (crossing, crossing) float64
        Prior precision of ln extinction, with a free common level.
    excluded_fields : (field, crossing) float64
        Fields of ln extinction that the prior excludes, each with its possible size.
    norm : float
        -ln of the determinant of the precision.
    without_prior : bool
    passes : int
        Number of linearisations.
    constants : (profile, beam) float64
        In: start values. Out: values after the last pass.
    logarithms, variances, prior_true_variance, excluded_variance : (profile, crossing) float64
        Out: ln(extinction / m-1), its variance for a field that deviates by `PRIOR_DOUBT` times
        the prior, its variance if the prior is true, and the variance that `excluded_fields` add.
        NaN where undetermined or unseen.
    summary : (profile, COLUMNS) float64
    status : (profile,) uint8
    left_out : (profile, beam) uint8
        Out: 1 where two or more passages of a beam are usable, but their covariance is singular
        or not finite.
    """
    beams, crossings = constants.shape[1], logarithms.shape[1]
    work = workspace(geometry[0], beams)
    inverse = np.empty((crossings, crossings))
    matrix, side, target = (
        np.empty((crossings, crossings)),
        np.empty(crossings),
        np.empty(crossings),
    )
    counts, seen = np.zeros(beams, dtype=np.intp), np.zeros(crossings, dtype=np.uint8)
    for n in range(values.shape[0]):
        count_passages(usable[n], geometry[0], counts)
        used, observations, count = _count_observations(geometry[0], geometry[2], counts, seen)
        determined, largest_step, square, determinants = used > 0, math.inf, 0.0, 0.0
        data = (values[n], integrals[n], covariance[n])
        for _ in range(passes):
            square, determinants, level = assemble(
                data, geometry, counts, constants[n], work, matrix, side
            )
            for v in range(crossings):
                target[v] = side[v]
                for w in range(crossings):
                    inverse[v, w] = matrix[v, w]
            add_prior(matrix, side, level, precision, without_prior)
            used, observations, count = _count_observations(geometry[0], geometry[2], counts, seen)
            determined = used > 0 and math.isfinite(square + determinants)
            determined = determined and factorise(matrix, crossings)
            if not determined:
                break
            substitute_factorised(matrix, crossings, side)
            largest_step = _move_constants(geometry, counts, work[3], work[4], side, constants[n])
        for beam in range(beams):
            first = geometry[0][beam]
            usable_count = _count_usable(usable[n], first, geometry[0][beam + 1])
            left_out[n, beam] = counts[beam] == 0 and usable_count >= 2
        for v in range(crossings):
            determinants += 2.0 * math.log(matrix[v, v]) if determined else math.nan
        freedom = (
            observations - used - count,
            observations - used - (count if without_prior else 1),
        )
        chi_square_here = (
            _chi_square_at(inverse, target, side, square)
            if without_prior and determined
            else math.nan
        )
        summary[n, 0] = _least_chi_square(inverse, target, seen, square, determined)
        summary[n, 2] = (
            summary[n, 0] if without_prior or not determined else square - _dot(side, target)
        )
        if without_prior and determined and math.isnan(summary[n, 0]):
            # Beams may disagree even if crossings stay undetermined or constants diverged.
            summary[n, 2], freedom = chi_square_here, (freedom[0], observations - used - 1)
        summary[n, 1], summary[n, 3] = freedom
        summary[n, 4] = summary[n, 2] + determinants + norm
        status[n] = (
            UNDETERMINED
            if not determined
            else (SOLVED if largest_step < _CONVERGED_STEP else UNSETTLED)
        )
        _store_solution(
            matrix, side, precision, excluded_fields, seen, determined, (inverse, target),
            logarithms[n], variances[n], prior_true_variance[n], excluded_variance[n],
        )  # fmt: skip


@_compiled
def _dot(left: Array, right: Array) -> float:
    """Return the scalar product, summed in order."""
    total = 0.0
    for v in range(left.size):
        total += left[v] * right[v]
    return total


@_compiled
def _chi_square_at(matrix: Array, side: Array, solution: Array, square: float) -> float:
    """Return chi-square of the beams alone at a solution that need not be its minimum."""
    total = square
    for v in range(side.size):
        product = 0.0
        for w in range(side.size):
            product += matrix[v, w] * solution[w]
        total += solution[v] * (product - 2.0 * side[v])
    return total


@_compiled
def _least_chi_square(
    matrix: Array, side: Array, seen: Codes, square: float, determined: bool
) -> float:
    """Return the smallest chi-square of the beams alone, at the constants found with the prior."""
    for v in range(side.size):
        matrix[v, v] += 1.0 - seen[v]
    if not (determined and factorise(matrix, side.size)):
        return math.nan
    best = side.copy()
    substitute_factorised(matrix, side.size, best)
    return square - _dot(best, side)


@_compiled
def _store_solution(
    factor: Array,
    solution: Array,
    precision: Array,
    excluded_fields: Array,
    seen: Codes,
    determined: bool,
    work: tuple[Array, Array],
    logarithms: Array,
    variances: Array,
    prior_true_variance: Array,
    excluded_variance: Array,
) -> None:
    """Fill the solution and its variances where crossings are seen, NaN elsewhere.

    The inverse C of all information is the covariance if the prior P is true, and
    C + (d^2 - 1) C P C if the field deviates d times as much. A field f that the prior excludes
    shifts the solution by C P f.
    """
    inverse, gain = work
    if determined:
        invert_system(factor, solution.size, inverse)
    for v in range(solution.size):
        valid = determined and seen[v] == 1 and inverse[v, v] < _LARGEST_VARIANCE
        logarithms[v] = solution[v] if valid else math.nan
        variances[v], prior_true_variance[v], excluded_variance[v] = math.nan, math.nan, math.nan
        if valid:
            prior_true_variance[v] = inverse[v, v]
            prior_share = 0.0
            for i in range(solution.size):
                gain[i] = 0.0
                for k in range(solution.size):
                    gain[i] += precision[i, k] * inverse[k, v]
                prior_share += inverse[v, i] * gain[i]
            excluded_variance[v] = 0.0
            for field in range(excluded_fields.shape[0]):
                shift = _dot(excluded_fields[field], gain)
                excluded_variance[v] += shift * shift
            variances[v] = inverse[v, v] + (PRIOR_DOUBT * PRIOR_DOUBT - 1.0) * max(prior_share, 0.0)
