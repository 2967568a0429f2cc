"""Compiled solution of networks of beams: all crossings of a profile at once.

Along a beam, a_p / extinction_p + 2 m (integral from the first crossing to p) is a constant. The
network chooses one constant per beam so that the beams agree in the crossings that they share. The
equations are taken in logarithms, where the noise of the values is additive: written as rows that
are linear in 1 / extinction, the noise multiplies the unknowns, and long chains of rows are biased
by it. Each pass linearises the constants, weighs with the full covariance of a beam, eliminates
its constant and solves for the crossings by Cholesky's method.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Final

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Codes = npt.NDArray[np.uint8]

SOLVED: Final = 0
UNDETERMINED: Final = 1
"""No crossings, or a singular system."""
UNSETTLED: Final = 2
"""The last pass still moved the solution."""

LIKELIHOOD: Final = 4
COLUMNS: Final = 5
"""Of a summary: chi-square and degrees of freedom of the beams alone, and of beams and prior; -2 ln
of the marginal likelihood, but a constant."""

LONGEST_STEP: Final = 1.5
_THINNEST: Final = 1e-3
"""Optical depth of the thinnest beam that a start is made from."""
_SETTLED: Final = 1e-3
_TINIEST_PIVOT: Final = 1e-13
_NEARLY_NONE: Final = 1e-2
DOUBT: Final = 2.0
"""Times the standard deviation of the prior, by which a field may deviate, for what is stated."""
_LARGEST_VARIANCE: Final = 4.0
"""Of ln extinction; beyond, it is not determined."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def factorise(matrix: Array, size: int) -> bool:
    """Overwrite the lower triangle by Cholesky's factor; False where it is singular."""
    for i in range(size):
        whole = matrix[i, i]
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not total > _TINIEST_PIVOT * whole:
                    return False
                matrix[i, i] = math.sqrt(total)
            else:
                matrix[i, j] = total / matrix[j, j]
    return True


@_compiled
def substitute_factorised(factor: Array, size: int, side: Array) -> None:
    """Overwrite a right side by the solution of the factorised system."""
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
    """Fill the covariance of u_c - ln w_c, of which w_c holds all integrals beyond c.

    With d_cs = -1 / w_c for the integrals s >= c, it is U + d V' + V d' + d W d', summed over the
    integrals from the far end, so that each entry costs one addition.
    """
    first = (quantities + 1) // 2
    for i in range(count):
        for j in range(count):
            cross = 0.0
            for s in range(j, count - 1):
                cross += packed[i * quantities + first + s]
            out[i, j] = packed[i * quantities + j] - cross / weights[j]
    # The other half of the transformation, of rows.
    for i in range(count):
        for j in range(i + 1):
            other = 0.0
            for s in range(i, count - 1):
                other += packed[(first + s) * quantities + j]
                for t in range(j, count - 1):
                    other -= packed[(first + s) * quantities + first + t] / weights[j]
            out[i, j] -= other / weights[i]
    for i in range(count):
        for j in range(i + 1, count):
            out[i, j] = out[j, i]


@_compiled
def _invert(matrix: Array, size: int, inverse: Array) -> float:
    """Fill the inverse of a covariance, overwriting it; return its log determinant or NaN."""
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
def _beam(
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

    Columns: y = u - ln w, the derivative j of ln w by the constant, and P j.
    """
    covariance, inverse, weights = work
    beyond, last = 0.0, math.exp(constant)
    for c in range(count - 1, -1, -1):
        if c < count - 1:
            beyond += integrals[c]
        weights[c] = last + beyond
        columns[c, 0] = values[c] - math.log(weights[c])
        columns[c, 1] = last / weights[c]
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
def _start(
    integrals: Array, exponent: float, count: int, extinction: float, length: float
) -> float:
    total = 0.0
    for c in range(count - 1):
        total += integrals[c]
    depth = max(2.0 * exponent * extinction * length, _THINNEST)
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
    """Fill (profile, beam) constants as if the air were homogeneous.

    Parameters
    ----------
    integrals, usable, slopes
        As `lidarops.retrieve.network._condensed_signals.condense` gives them.
    lengths : (passage,) float64
        m, from a passage to the next on its beam.
    exponent : (beam,) float64
    first_passage : (beam + 1,) intp
    constants : (profile, beam) float64
        Logarithms of the signal at the last passage over extinction there.
    """
    for n in range(integrals.shape[0]):
        top = bottom = 0.0
        for c in range(lengths.size):
            if slopes[n, c, 1] > 0.0:
                top += slopes[n, c, 0] / slopes[n, c, 1]
                bottom += 1.0 / slopes[n, c, 1]
        extinction = top / bottom if bottom > 0.0 else 0.0
        for beam in range(exponent.size):
            first, last = first_passage[beam], first_passage[beam + 1]
            count = _count(usable[n], first, last)
            length = 0.0
            for c in range(first, first + count - 1):
                length += lengths[c]
            constants[n, beam] = 0.0
            if count >= 2:
                constants[n, beam] = _start(
                    integrals[n, first:last], exponent[beam], count, extinction, length
                )


@_compiled
def _count(usable: Codes, first: int, last: int) -> int:
    count = 0
    for c in range(first, last):
        if usable[c] == 0:
            break
        count += 1
    return count


@_compiled
def _enter(
    columns: Array,
    inverse: Array,
    information: float,
    crossing: Indices,
    matrix: Array,
    side: Array,
) -> float:
    """Add a beam, its constant eliminated, to the normal equations; return y' M y."""
    count, square = crossing.size, 0.0
    for i in range(count):
        for k in range(count):
            entry = inverse[i, k] - columns[i, 2] * columns[k, 2] / information
            matrix[crossing[i], crossing[k]] += entry
            side[crossing[i]] += entry * columns[k, 0]
            square += columns[i, 0] * entry * columns[k, 0]
    return square


@_compiled
def add_prior(matrix: Array, side: Array, level: float, precision: Array, flat: bool) -> None:
    """Add the prior to the normal equations.

    In place of none, a tenfold of e about the level of the profile is put, so that what is
    undetermined does not keep the rest from being solved.
    """
    for v in range(side.size):
        if flat:
            matrix[v, v] += _NEARLY_NONE
            side[v] += _NEARLY_NONE * level
            continue
        for w in range(side.size):
            matrix[v, w] += precision[v, w]


@_compiled
def invert_system(factor: Array, size: int, out: Array) -> None:
    for v in range(size):
        for i in range(size):
            out[v, i] = 0.0
        out[v, v] = 1.0
        substitute_factorised(factor, size, out[v])


@_compiled
def add_observations(usable: Codes, first_passage: Indices, counts: Indices) -> None:
    """Fill the passages of each beam; 0 where there is one only."""
    for beam in range(counts.size):
        count = _count(usable, first_passage[beam], first_passage[beam + 1])
        counts[beam] = count if count >= 2 else 0


@_compiled
def _tally(
    first_passage: Indices, crossing: Indices, counts: Indices, seen: Codes
) -> tuple[int, int, int]:
    """Fill the crossings seen; return beams, passages, crossings."""
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
    """Fill the normal equations of all beams; return square, log determinants and mean level.

    A beam of singular covariance is left out: its count gets zero.
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
        information[beam], logarithm = _beam(
            values[first:last], integrals[first:last],
            covariance[offset[beam] : offset[beam + 1]], quantities, counts[beam],
            constants[beam], (scratch, inverses[beam], weights), columns[beam],
        )  # fmt: skip
        for c in range(counts[beam]):
            logarithm += 0.0 * columns[beam, c, 0]
        if not (math.isfinite(logarithm) and 0.0 < information[beam] < math.inf):
            counts[beam] = 0
            continue
        square += _enter(
            columns[beam], inverses[beam], information[beam], crossing[first:last], matrix, side
        )
        logarithms += logarithm + math.log(information[beam])
        for c in range(counts[beam]):
            level += columns[beam, c, 0]
            passages += 1
    return square, logarithms, level / max(passages, 1)


@_compiled
def _move(
    geometry: tuple[Indices, Indices, Indices],
    counts: Indices,
    columns: Array,
    information: Array,
    solution: Array,
    constants: Array,
) -> float:
    """Move the constants of the beams; return by how much the farthest logarithm follows."""
    first_passage, _, crossing = geometry
    moved = 0.0
    for beam in range(counts.size):
        if counts[beam] == 0:
            continue
        step = 0.0
        for c in range(counts[beam]):
            gap = columns[beam, c, 0] - solution[crossing[first_passage[beam] + c]]
            step += columns[beam, c, 2] * gap
        step = min(max(step / information[beam], -LONGEST_STEP), LONGEST_STEP)
        constants[beam] += step
        moved = max(moved, abs(step) * columns[beam, 0, 1])
    return moved


@_compiled
def workspace(first_passage: Indices, beams: int) -> tuple[Array, Array, Array, Array, Array]:
    most = 1
    for beam in range(beams):
        most = max(most, first_passage[beam + 1] - first_passage[beam])
    return (
        np.empty((most, most)), np.empty((beams, most, most)), np.empty(most),
        np.empty((beams, most, 3)), np.empty(beams),
    )  # fmt: skip


@_compiled
def solve_joint(
    values: Array,
    integrals: Array,
    usable: Codes,
    covariance: Array,
    geometry: tuple[Indices, Indices, Indices],
    precision: Array,
    doubts: Array,
    norm: float,
    flat: bool,
    passes: int,
    constants: Array,
    logarithms: Array,
    variances: Array,
    believed: Array,
    missed: Array,
    summary: Array,
    status: Codes,
    left_out: Codes,
) -> None:
    """Solve profiles for the logarithms of extinction at all crossings.

    Parameters
    ----------
    values, integrals, usable, covariance
        As `lidarops.retrieve.network._condensed_signals.condense` gives them.
    geometry : (beam + 1,), (beam + 1,) and (passage,) intp
        Where passages and where covariances of a beam start; the crossing of each passage.
    precision : (crossing, crossing) float64
        Prior precision of ln extinction, which leaves a common level free.
    doubts : (field, crossing) float64
        Fields of ln extinction that the prior rules out, each of the size that it may have.
    norm : float
        -ln of its determinant.
    flat : bool
        Whether to leave the prior out.
    passes : int
    constants : (profile, beam) float64
        In: where to start; out: where the passes ended.
    logarithms, variances, believed, missed : (profile, crossing) float64
        Get ln(extinction / m-1), its variance where fields deviate by more than the prior has it
        (`DOUBT`), and where they do not, and what `doubts` add to it; NaN where undetermined, or
        unseen.
    summary : (profile, COLUMNS) float64
    status : (profile,) uint8
    left_out : (profile, beam) uint8
        Gets 1 where two passages or more of a beam are usable, and their covariance is singular
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
        add_observations(usable[n], geometry[0], counts)
        used, observations, count = _tally(geometry[0], geometry[2], counts, seen)
        fine, moved, square, determinants = used > 0, math.inf, 0.0, 0.0
        data = (values[n], integrals[n], covariance[n])
        for _ in range(passes):
            square, determinants, level = assemble(
                data, geometry, counts, constants[n], work, matrix, side
            )
            for v in range(crossings):
                target[v] = side[v]
                for w in range(crossings):
                    inverse[v, w] = matrix[v, w]
            add_prior(matrix, side, level, precision, flat)
            used, observations, count = _tally(geometry[0], geometry[2], counts, seen)
            fine = used > 0 and math.isfinite(square + determinants)
            fine = fine and factorise(matrix, crossings)
            if not fine:
                break
            substitute_factorised(matrix, crossings, side)
            moved = _move(geometry, counts, work[3], work[4], side, constants[n])
        for beam in range(beams):
            first = geometry[0][beam]
            usual = _count(usable[n], first, geometry[0][beam + 1])
            left_out[n, beam] = counts[beam] == 0 and usual >= 2
        for v in range(crossings):
            determinants += 2.0 * math.log(matrix[v, v]) if fine else math.nan
        free = (observations - used - count, observations - used - (count if flat else 1))
        rough = _square_at(inverse, target, side, square) if flat and fine else math.nan
        summary[n, 0] = _least_square(inverse, target, seen, square, fine)
        summary[n, 2] = summary[n, 0] if flat or not fine else square - _dot(side, target)
        if flat and fine and math.isnan(summary[n, 0]):
            # Beams that leave some crossings open, or whose constants have run away, may disagree.
            summary[n, 2], free = rough, (free[0], observations - used - 1)
        summary[n, 1], summary[n, 3] = free
        summary[n, 4] = summary[n, 2] + determinants + norm
        status[n] = UNDETERMINED if not fine else (SOLVED if moved < _SETTLED else UNSETTLED)
        _hand_over(
            matrix, side, precision, doubts, seen, fine, (inverse, target), logarithms[n],
            variances[n], believed[n], missed[n],
        )  # fmt: skip


@_compiled
def _dot(left: Array, right: Array) -> float:
    total = 0.0
    for v in range(left.size):
        total += left[v] * right[v]
    return total


@_compiled
def _square_at(matrix: Array, side: Array, solution: Array, square: float) -> float:
    """Return chi-square of the beams alone at a solution, which need not be their least."""
    total = square
    for v in range(side.size):
        here = 0.0
        for w in range(side.size):
            here += matrix[v, w] * solution[w]
        total += solution[v] * (here - 2.0 * side[v])
    return total


@_compiled
def _least_square(matrix: Array, side: Array, seen: Codes, square: float, fine: bool) -> float:
    """Return chi-square of the beams alone, at the constants that the prior has led to."""
    for v in range(side.size):
        matrix[v, v] += 1.0 - seen[v]
    if not (fine and factorise(matrix, side.size)):
        return math.nan
    best = side.copy()
    substitute_factorised(matrix, side.size, best)
    return square - _dot(best, side)


@_compiled
def _hand_over(
    factor: Array,
    solution: Array,
    precision: Array,
    doubts: Array,
    seen: Codes,
    fine: bool,
    work: tuple[Array, Array],
    logarithms: Array,
    variances: Array,
    believed: Array,
    missed: Array,
) -> None:
    """Fill the solution and its variances where crossings are seen, NaN elsewhere.

    The inverse C of all information is the covariance of a field of which the prior P is true;
    C + (d^2 - 1) C P C that of one which deviates by d times as much. A field f that the prior
    rules out moves the solution by C P f.
    """
    inverse, pull = work
    if fine:
        invert_system(factor, solution.size, inverse)
    for v in range(solution.size):
        good = fine and seen[v] == 1 and inverse[v, v] < _LARGEST_VARIANCE
        logarithms[v] = solution[v] if good else math.nan
        variances[v], believed[v], missed[v] = math.nan, math.nan, math.nan
        if good:
            believed[v] = inverse[v, v]
            told = 0.0
            for i in range(solution.size):
                pull[i] = 0.0
                for k in range(solution.size):
                    pull[i] += precision[i, k] * inverse[k, v]
                told += inverse[v, i] * pull[i]
            missed[v] = 0.0
            for field in range(doubts.shape[0]):
                reach = _dot(doubts[field], pull)
                missed[v] += reach * reach
            variances[v] = inverse[v, v] + (DOUBT * DOUBT - 1.0) * max(told, 0.0)
