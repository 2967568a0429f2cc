"""What curved signals put into the values at passages, and what that makes of a solution.

The value at a passage is that of a straight line through the logarithms of the bins about it.
Of a signal that bends there, with f its logarithm along the beam, the line has about

    f'' / 2 sum_i w_i (r_i - r)^2 = f'' (bins^2 - 1) step^2 / 24

more, for weights w_i of bins r_i, and the right side in the middle of a fit: 8 percent too little
on the axis of a layer of three times the air about it and a standard deviation of 20 m, through
35 m. A polynomial of the fourth degree through the same bins has next to nothing of that, but
twice the noise: it is no better value. What noise puts into the difference of the two is much less
in the median of a block, and that tells the error, sign included. Beams amplify it, as a difference
of values along them passes for attenuation; so it is carried over to the solution, and its square
added to the variance, less what noise makes of it.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.network import _joint_solution

if TYPE_CHECKING:
    from lidarops.retrieve.network._condensed_signals import Layout

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Codes = npt.NDArray[np.uint8]

DEGREE: Final = 4
"""Of the polynomial. Through 35 m it has what a layer of a standard deviation of 10 m along the beam
takes from a value to within a tenth, a parabola to within a half."""
_BY_NOISE: Final = 4.0
"""Variances by noise that are taken from a square: beyond, noise alone leaves 0.08 of one."""
_BY_OWN_NOISE: Final = 9.0
"""The same of a single profile, which has more noise than its value: 0.005 of one."""
_CHANCE: Final = 3.0
"""Standard deviations by which a mean square of noise is larger by chance, at most."""
_LOUDER: Final = 10.0
"""Times the median variance, from which on a profile does not count."""
_OF_MEDIAN: Final = np.pi / 2.0
"""Variance of a median over that of a mean."""
_LEAST_PART: Final = 1e-3
"""Of the signal at a crossing over extinction there, that is left behind the last integral."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


def weights(layout: Layout) -> Array:
    """Return the weights of logarithms for what a line has more than a polynomial.

    Returns
    -------
    (passage, bin) float64
        They sum to 0, and to 0 over what is linear in range.
    """
    passages, bins = layout.passages, layout.weights.shape[1]
    near = layout.window[:, np.newaxis] + np.arange(bins)
    apart = layout.range[passages.beam[:, np.newaxis], near] - passages.range[:, np.newaxis]
    order = np.arange(min(DEGREE, bins - 1) + 1)
    powers = (apart / np.ptp(apart, axis=1, keepdims=True))[..., np.newaxis] ** order
    return np.ascontiguousarray(layout.weights - np.linalg.pinv(powers)[:, 0])


@_compiled
def measure_curvature(
    row: tuple[Array, Array, Codes],
    exponent: float,
    passages: tuple[int, int],
    window: Indices,
    shares: Array,
    out: Array,
) -> None:
    """Fill what lines have more than polynomials at passages, and its variance by noise.

    Parameters
    ----------
    row : (bin,) float64, (bin,) float64, (bin,) uint8
        Logarithms of the signal along a beam, their variances and codes. Without bins that may be
        wild: what these change is told otherwise.
    exponent : float
    passages : int, int
        The first one, and that behind the last.
    window : (passage,) intp
        First bin of each fit.
    shares : (passage, bin) float64
        Of `weights`.
    out : (passage, 2) float64
    """
    logs, noise, _ = row
    for c in range(passages[0], passages[1]):
        value = spread = 0.0
        for i in range(shares.shape[1]):
            g = window[c] + i
            # As values at passages, freed of E ln(1 + e) = -e^2 / 2.
            value += shares[c, i] * (logs[g] + 0.5 * noise[g] / exponent)
            spread += shares[c, i] * shares[c, i] * noise[g]
        out[c, 0], out[c, 1] = value, spread


def usual(departures: Array, usable: Codes) -> Array:
    """Return the medians of the profiles of a block, with their variances.

    Parameters
    ----------
    departures : (profile, passage, 2) float64
        Of `measure_curvature`.
    usable : (profile, passage) uint8

    Returns
    -------
    (passage, 2) float64
        0 where no profile sees the passage.
    """
    number = np.count_nonzero(usable, axis=0)
    if np.all(number == len(usable)):
        out = np.median(departures, axis=0)
    else:
        out = np.zeros(departures.shape[1:])
        for c in np.flatnonzero(number):
            out[c] = np.median(departures[usable[:, c] == 1, c], axis=0)
    # Of one or two, it is their mean.
    out[:, 1] *= np.where(number > 2, _OF_MEDIAN, 1.0) / np.maximum(number, 1)
    return out


@_compiled
def _place_constant(
    values: Array, integrals: Array, crossing: Indices, count: int, solution: Array
) -> float:
    """Return the constant of a beam at the last crossing that is determined; NaN where none is."""
    for c in range(count - 1, -1, -1):
        whole = math.exp(values[c] - solution[crossing[c]])
        if not whole < math.inf:
            continue
        beyond = 0.0
        for s in range(c, count - 1):
            beyond += integrals[s]
        return math.log(max(whole - beyond, _LEAST_PART * whole))
    return math.nan


@_compiled
def _settle(
    columns: Array, crossing: Indices, count: int, solution: Array, information: float
) -> float:
    """Return by how much the constant of a beam moves to fit a solution best."""
    step = 0.0
    for c in range(count):
        gap = columns[c, 0] - solution[crossing[c]]
        # A crossing that nothing determines has no part in it.
        if abs(gap) < math.inf:
            step += columns[c, 2] * gap
    return min(max(step / information, -_joint_solution.LONGEST_STEP), _joint_solution.LONGEST_STEP)


@_compiled
def _carry_beam(
    columns: Array,
    inverse: Array,
    information: float,
    crossing: Indices,
    whole: Array,
    shared: Array,
    own: Array,
    out: Array,
) -> None:
    """Add what the errors of a beam's values move the solution by, and the variance of that."""
    count = crossing.size
    for k in range(count):
        for v in range(out.shape[0]):
            total = 0.0
            for i in range(count):
                entry = inverse[i, k] - columns[i, 2] * columns[k, 2] / information
                total += whole[v, crossing[i]] * entry
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
    flat: bool,
    logarithms: Array,
    shared: Array,
    own: Array,
    out: Array,
) -> None:
    """Carry errors of the values at passages over to the solution, to first order.

    Errors e of the log values of a beam move the solution by C A' M e, summed over the beams: A
    picks the crossings of the beam, M = S - S j j' S / (j' S j) is what it tells of them whatever
    its constant, with S the inverse covariance of y = u - ln w and j the derivative of ln w by
    the constant, and C is the inverse of all information, (sum A' M A + P)^-1 with P the prior's.
    What an error at the first passage changes by scaling the whole beam goes into the constant.

    Parameters
    ----------
    values, integrals, usable, covariance
        As `lidarops.retrieve.network._condensed_signals.condense` gives them.
    geometry, precision, flat
        As of `solve_profiles`.
    logarithms : (profile, crossing) float64
        The solution; NaN where undetermined.
    shared, own : (passage, 2) and (profile, passage, 2) float64
        Errors of the log values that profiles share, and those of each; with their variances.
        Passages are independent.
    out : (profile, crossing, 4) float64
        0; gets what the shared ones and what the own ones move the solution by, each followed by
        its variance.
    """
    beams, crossings = geometry[0].size - 1, logarithms.shape[1]
    work = _joint_solution.workspace(geometry[0], beams)
    constants = np.zeros(beams)
    matrix, side = np.empty((crossings, crossings)), np.empty(crossings)
    whole = np.empty((crossings, crossings))
    counts = np.zeros(beams, dtype=np.intp)
    for n in range(values.shape[0]):
        data = (values[n], integrals[n], covariance[n])
        _joint_solution.add_observations(usable[n], geometry[0], counts)
        for turn in range(2):
            for beam in range(beams):
                if counts[beam] == 0:
                    continue
                first, last = geometry[0][beam], geometry[0][beam] + counts[beam]
                mine = geometry[2][first:last]
                if turn == 0:
                    constants[beam] = _place_constant(
                        values[n, first:last], integrals[n, first:last], mine, counts[beam],
                        logarithms[n],
                    )  # fmt: skip
                else:
                    constants[beam] += _settle(
                        work[3][beam], mine, counts[beam], logarithms[n], work[4][beam]
                    )
            # Beams that are not determined drop out here.
            _joint_solution.assemble(data, geometry, counts, constants, work, matrix, side)
        _joint_solution.add_prior(matrix, side, 0.0, precision, flat)
        if not _joint_solution.factorise(matrix, crossings):
            continue
        _joint_solution.invert_system(matrix, crossings, whole)
        for beam in range(beams):
            first, last = geometry[0][beam], geometry[0][beam] + counts[beam]
            if counts[beam] > 0:
                _carry_beam(
                    work[3][beam], work[1][beam], work[4][beam], geometry[2][first:last], whole,
                    shared[first:last], own[n, first:last], out[n],
                )  # fmt: skip


def variance(moved: Array) -> Array:
    """Return the squares of what solutions are moved by, less what noise makes of them.

    The largest of what a block shares, of the mean square of its profiles, as a layer may rise or
    sink, and of what a profile shows by itself, where noise hides more.

    Parameters
    ----------
    moved : (profile, crossing, 4) float64
        Of `carry_errors`, of the profiles of one block.

    Returns
    -------
    (profile, crossing) float64
    """
    # What overflows has a variance by noise that leaves nothing else to say.
    with np.errstate(over="ignore", invalid="ignore"):
        shared = moved[..., 0] ** 2 - _BY_NOISE * moved[..., 1]
        own, noise = moved[..., 2] ** 2, moved[..., 3]
        # A loud profile would hide what all others show, or pass for it.
        quiet = (noise > 0.0) & (noise <= _LOUDER * np.median(noise, axis=0))
        number = np.maximum(quiet.sum(axis=0), 1)
        excess = np.where(quiet, own - (1.0 + _CHANCE * np.sqrt(2.0 / number)) * noise, 0.0)
        largest = np.fmax(shared, own - _BY_OWN_NOISE * noise)
        return np.asarray(np.fmax(np.fmax(largest, excess.sum(axis=0) / number), 0.0))
