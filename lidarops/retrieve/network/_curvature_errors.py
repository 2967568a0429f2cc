"""Errors of the values at crossings from the curvature of the signal, carried to the solution.

The value at a crossing comes from a straight line through the logarithms of the bins around it.
Where the logarithm f of the signal is curved along the beam, the line is too high by about

    f'' / 2 sum_i w_i (r_i - r)^2 = f'' (bins^2 - 1) step^2 / 24

for weights w_i of bins r_i; the right side holds in the middle of a fit. On the axis of a layer
with three times the extinction of its surroundings and a standard deviation of 20 m, a fit over
35 m is 8 percent too low. A polynomial of degree 4 through the same bins has almost none of this
error, but twice the noise, so it is not a better value. Their difference has much less noise in
the median of a block, which therefore shows the error with its sign. Beams amplify the error,
because a difference of values along a beam looks like attenuation. So it is carried to the
solution, and its square, less the contribution of noise, is added to the variance.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Final

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.network import _joint_solution
from lidarops.retrieve.network._fit_layout import FitLayout
from lidarops.retrieve.network.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Codes = npt.NDArray[np.uint8]

_MEDIAN_OVER_MEAN: Final = np.pi / 2.0
"""Variance of a median over the variance of a mean."""
_LEAST_REMAINDER: Final = THRESHOLDS.least_remainder

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


def curvature_weights(layout: FitLayout) -> Array:
    """Return the weights of the logarithms for the difference of line and polynomial.

    Returns
    -------
    (passage, bin) float64
        Their sum is 0, and so is their sum over a linear function of range.
    """
    passages, bins = layout.passages, layout.weights.shape[1]
    bins_at_crossing = layout.window[:, np.newaxis] + np.arange(bins)
    distance = (
        layout.range[passages.beam[:, np.newaxis], bins_at_crossing] - passages.range[:, np.newaxis]
    )
    order = np.arange(min(THRESHOLDS.curvature_degree, bins - 1) + 1)
    powers = (distance / np.ptp(distance, axis=1, keepdims=True))[..., np.newaxis] ** order
    return np.ascontiguousarray(layout.weights - np.linalg.pinv(powers)[:, 0])


@_compiled
def measure_curvature(
    row: tuple[Array, Array],
    exponent: float,
    passages: tuple[int, int],
    window: Indices,
    bin_weights: Array,
    out: Array,
) -> None:
    """Fill the difference of line and polynomial at passages, and its variance by noise.

    Parameters
    ----------
    row : (bin,) float64, (bin,) float64
        Logarithms of the signal along a beam, and their variances.
    exponent : float
    passages : int, int
        First passage, and the one behind the last.
    window : (passage,) intp
        First bin of each fit.
    bin_weights : (passage, bin) float64
        From `curvature_weights`.
    out : (passage, 2) float64
    """
    logs, noise = row
    for c in range(passages[0], passages[1]):
        value = spread = 0.0
        for i in range(bin_weights.shape[1]):
            g = window[c] + i
            # Corrected for E ln(1 + e) = -e^2 / 2, as the values at passages.
            value += bin_weights[c, i] * (logs[g] + 0.5 * noise[g] / exponent)
            spread += bin_weights[c, i] * bin_weights[c, i] * noise[g]
        out[c, 0], out[c, 1] = value, spread


def block_medians(curvature_errors: Array, usable: Codes) -> Array:
    """Return the medians over the profiles of a block, with their variances.

    Parameters
    ----------
    curvature_errors : (profile, passage, 2) float64
        From `measure_curvature`.
    usable : (profile, passage) uint8

    Returns
    -------
    (passage, 2) float64
        0 where no profile can use the passage.
    """
    number = np.count_nonzero(usable, axis=0)
    if np.all(number == len(usable)):
        medians = np.median(curvature_errors, axis=0)
    else:
        medians = np.zeros(curvature_errors.shape[1:])
        for c in np.flatnonzero(number):
            medians[c] = np.median(curvature_errors[usable[:, c] == 1, c], axis=0)
    # The median of one or two is their mean.
    medians[:, 1] *= np.where(number > 2, _MEDIAN_OVER_MEAN, 1.0) / np.maximum(number, 1)
    return medians


@_compiled
def _start_constant(
    values: Array, integrals: Array, crossing: Indices, count: int, solution: Array
) -> float:
    """Return the constant of a beam from its last determined crossing; NaN without one."""
    for c in range(count - 1, -1, -1):
        signal_over_extinction = math.exp(values[c] - solution[crossing[c]])
        if not signal_over_extinction < math.inf:
            continue
        remaining_integral = 0.0
        for s in range(c, count - 1):
            remaining_integral += integrals[s]
        return math.log(
            max(
                signal_over_extinction - remaining_integral,
                _LEAST_REMAINDER * signal_over_extinction,
            )
        )
    return math.nan


@_compiled
def _constant_step(
    columns: Array, crossing: Indices, count: int, solution: Array, information: float
) -> float:
    """Return the step of the constant of a beam to its best fit to a solution."""
    step = 0.0
    for c in range(count):
        residual = columns[c, 0] - solution[crossing[c]]
        # Undetermined crossings do not count.
        if abs(residual) < math.inf:
            step += columns[c, 2] * residual
    return min(max(step / information, -_joint_solution.LONGEST_STEP), _joint_solution.LONGEST_STEP)


@_compiled
def _carry_beam(
    columns: Array,
    inverse: Array,
    information: float,
    crossing: Indices,
    system_inverse: Array,
    shared: Array,
    own: Array,
    out: Array,
) -> None:
    """Add the shifts of the solution by errors of a beam's values, and their variances."""
    count = crossing.size
    for k in range(count):
        for v in range(out.shape[0]):
            total = 0.0
            for i in range(count):
                weight = inverse[i, k] - columns[i, 2] * columns[k, 2] / information
                total += system_inverse[v, crossing[i]] * weight
            out[v, 0] += total * shared[k, 0]
            out[v, 1] += total * total * shared[k, 1]
            out[v, 2] += total * own[k, 0]
            out[v, 3] += total * total * own[k, 1]


@_compiled
def carry_errors(
    values: Array,
    integrals: Array,
    usable: Codes,
    covariance: Array,
    geometry: tuple[Indices, Indices, Indices],
    precision: Array,
    without_prior: bool,
    logarithms: Array,
    shared: Array,
    own: Array,
    out: Array,
) -> None:
    """Fill the shifts of the solution by errors of the values at passages, to first order.

    Errors e of the log values of a beam shift the solution by C A' M e, summed over the beams. A
    selects the crossings of the beam. M = S - S j j' S / (j' S j) is the information of the beam
    on them with its constant eliminated, where S is the inverse covariance of y = u - ln w and j
    the derivative of ln w by the constant. C = (sum A' M A + P)^-1 is the inverse of all
    information, with P that of the prior. An error at the first passage that scales the whole
    beam goes into the constant.

    Parameters
    ----------
    values, integrals, usable, covariance
        From `lidarops.retrieve.network._condensed_signals.condense`.
    geometry, precision, without_prior
        As in `lidarops.retrieve.network._joint_solution.solve_joint`.
    logarithms : (profile, crossing) float64
        The solution, ln(extinction / m-1); NaN where undetermined.
    shared, own : (passage, 2) and (profile, passage, 2) float64
        Errors of the log values: those shared by the profiles, and those of each profile, with
        their variances. Passages are independent.
    out : (profile, crossing, 4) float64
        In: 0. Out: shifts by the shared errors and by the profile's own, each followed by its
        variance.
    """
    beams, crossings = geometry[0].size - 1, logarithms.shape[1]
    work = _joint_solution.workspace(geometry[0], beams)
    constants = np.zeros(beams)
    matrix, side = np.empty((crossings, crossings)), np.empty(crossings)
    system_inverse = np.empty((crossings, crossings))
    counts = np.zeros(beams, dtype=np.intp)
    for n in range(values.shape[0]):
        data = (values[n], integrals[n], covariance[n])
        _joint_solution.count_passages(usable[n], geometry[0], counts)
        for iteration in range(2):
            for beam in range(beams):
                if counts[beam] == 0:
                    continue
                first, last = geometry[0][beam], geometry[0][beam] + counts[beam]
                beam_crossings = geometry[2][first:last]
                if iteration == 0:
                    constants[beam] = _start_constant(
                        values[n, first:last], integrals[n, first:last], beam_crossings,
                        counts[beam], logarithms[n],
                    )  # fmt: skip
                else:
                    constants[beam] += _constant_step(
                        work[3][beam], beam_crossings, counts[beam], logarithms[n], work[4][beam]
                    )
            # This removes beams that are not determined.
            _joint_solution.assemble(data, geometry, counts, constants, work, matrix, side)
        _joint_solution.add_prior(matrix, side, 0.0, precision, without_prior)
        if not _joint_solution.factorise(matrix, crossings):
            continue
        _joint_solution.invert_system(matrix, crossings, system_inverse)
        for beam in range(beams):
            first, last = geometry[0][beam], geometry[0][beam] + counts[beam]
            if counts[beam] > 0:
                _carry_beam(
                    work[3][beam], work[1][beam], work[4][beam], geometry[2][first:last],
                    system_inverse, shared[first:last], own[n, first:last], out[n],
                )  # fmt: skip


def curvature_variance(shifts: Array) -> Array:
    """Return the squares of the shifts of the solution, less the contribution of noise.

    The result is the largest of three: the square of the shift that the block shares, the mean
    square of the shifts of its profiles (a layer may rise or sink), and the square of the shift
    of the profile itself, where noise hides more.

    Parameters
    ----------
    shifts : (profile, crossing, 4) float64
        From `carry_errors`, for the profiles of one block.

    Returns
    -------
    (profile, crossing) float64
    """
    # Values that overflow have a noise variance that dominates everything else.
    with np.errstate(over="ignore", invalid="ignore"):
        shared_excess = shifts[..., 0] ** 2 - THRESHOLDS.shared_noise * shifts[..., 1]
        profile_square, noise = shifts[..., 2] ** 2, shifts[..., 3]
        # A noisy profile would hide the shift of the others, or imitate one.
        counted = (noise > 0.0) & (noise <= THRESHOLDS.noisy_profile * np.median(noise, axis=0))
        number = np.maximum(counted.sum(axis=0), 1)
        excess = np.where(
            counted, profile_square - (1.0 + THRESHOLDS.chance * np.sqrt(2.0 / number)) * noise, 0.0
        )
        largest = np.fmax(shared_excess, profile_square - THRESHOLDS.profile_noise * noise)
        return np.asarray(np.fmax(np.fmax(largest, excess.sum(axis=0) / number), 0.0))
