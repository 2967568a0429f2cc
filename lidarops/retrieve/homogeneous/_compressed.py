"""Least squares of the homogeneous path from a handful of linear functionals of each profile.

For profiles without gaps, on a uniform grid, with common weights. A profile is read once,
multiplied with the basis of `lidarops.retrieve.homogeneous._functional_tables` in registers, and is then K numbers y.
The extinction is found from them by a look-up, one step to the right cell and three Newton steps
on the polynomial of the cell: no exponential, no loop over bins. A second look at the bins, still
in the cache, takes the residuals.

Profiles go in blocks of `BLOCK`; the last is filled up with zeros and runs through the same code.
Every profile has its own accumulators, summed in the order of the bins. So the bits of a result
depend on nothing but the profile.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from lidarops.flags import Quality
from lidarops.retrieve.homogeneous import _functional_tables
from lidarops.retrieve.homogeneous._fit_quality import CommonLimits
from lidarops.retrieve.homogeneous._functional_tables import Tables
from lidarops.retrieve.homogeneous._vector_loops import (
    STRIDE,
    project_1_4,
    project_1_8,
    project_1_12,
    project_4_12,
    project_6_8,
    residuals,
)

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.int32]

BLOCK: Final = 48
"""Profiles in a block: whole tiles of 4 and of 6, and whole vectors of any processor."""
_LONGEST_LEAP: Final = 20.0
"""Cells that the first step may cross."""
_EDGE: Final = 1.02
"""Half widths from the centre of a cell beyond which its polynomial is left for the next one's."""
_MOVES: Final = 40
"""From cell to cell, one and a half at most; thin sections start some 20 cells off. What has not
settled then is routed to others."""
HUGE: Final = 1e140
_TINY: Final = 1e-140
CURVATURES: Final = 7
"""Functionals in which misfit is looked for: further ones hold more noise than misfit."""
_INTERPOLATED: Final = 1e-22
"""Squared error of the direction of a shape, from the polynomials of the tables."""
_OK: Final = 0
_CONSTANT: Final = 1
ROUTED: Final = 2
"""State of a profile that this solver cannot take: it has gaps, or leaves the range of floats."""

RESULTS: Final = (
    "background",
    "background_standard_error",
    "amplitude",
    "amplitude_standard_error",
    "extinction",
    "extinction_standard_error",
    "signal_to_noise",
    "reduced_chi2",
    "curvature_misfit",
    "background_bend",
    "extinction_bend",
)
"""Rows of the results."""

_LOW_SIGNAL: Final = int(Quality.LOW_SIGNAL)
_POORLY_DETERMINED: Final = int(Quality.POORLY_DETERMINED)
_NEGATIVE_AMPLITUDE: Final = int(Quality.NEGATIVE_AMPLITUDE)
_AT_BOUND: Final = int(Quality.AT_BOUND)
_POOR_FIT: Final = int(Quality.POOR_FIT)
_NOT_HOMOGENEOUS: Final = int(Quality.NOT_HOMOGENEOUS)
_OUTLIER: Final = int(Quality.OUTLIER)
_NO_SIGNAL: Final = int(Quality.NO_SIGNAL)

_compiled = numba.njit(
    cache=True, nogil=True, error_model="numpy", forceinline=True, fastmath={"contract", "nsz"}
)
_summing = numba.njit(
    cache=True,
    nogil=True,
    error_model="numpy",
    forceinline=True,
    fastmath={"contract", "nsz", "reassoc"},
)


class Mode(NamedTuple):
    """How a call wants its profiles judged."""

    known_variance: bool
    with_residuals: bool
    """Without, chi-square and outliers are left out; only for a known variance."""
    rounding: float
    """Relative rounding error of the power."""


class _Scratch(NamedTuple):
    tile: Array
    reference: Array
    y: Array
    sign: Array
    cell: npt.NDArray[np.int64]
    f: Array
    """(8, profile): F at the centre of the cell and the polynomial of its derivative."""
    t: Array
    scalars: Array
    found: Array
    row: Array
    left: Array
    powers: Array
    root: Any
    envelope: Any
    tail: Any
    residual: Any
    padded: Any
    state: npt.NDArray[np.int64]
    results: Array
    bits: Flags


# Rows of `_Scratch.found`.
_F: Final = 0
_B: Final = 1
_P: Final = 2
_TAU: Final = 3
_TAU_ERROR: Final = 4
_B_ERROR: Final = 5
_P_ERROR: Final = 6
_CURVATURE: Final = 7
_ENERGY: Final = 8
_LARGEST: Final = 9
_BENDS: Final = 10
_BOUNDED: Final = 11
_NOISE: Final = 12
_SQUARE: Final = 13
_FOUND: Final = 14


@_compiled
def _scratch(power: Any, root: Any, envelope: Any, lanes: int) -> _Scratch:
    bins = power.shape[1]
    return _Scratch(
        np.zeros((6, bins)),
        np.zeros(BLOCK),
        np.zeros((BLOCK, lanes)),
        np.ones(BLOCK),
        np.zeros(BLOCK, np.int64),
        np.zeros((8, BLOCK)),
        np.zeros(BLOCK),
        np.zeros((_functional_tables.SCALARS, BLOCK)),
        np.zeros((_FOUND, BLOCK)),
        np.zeros(12),
        np.zeros(12),
        np.ones(_functional_tables.DEGREE + 2),
        root,
        envelope,
        np.zeros(STRIDE, power.dtype),
        np.zeros(envelope.size, power.dtype),
        np.zeros((BLOCK, bins), power.dtype),
        np.zeros(BLOCK, np.int64),
        np.zeros((len(RESULTS), BLOCK)),
        np.zeros(BLOCK, np.int32),
    )


@_compiled
def _project(block: Any, tables: Tables, s: _Scratch) -> None:
    """Fill y: the projections of the profiles less their last bins, and their means."""
    bins, lanes = block.shape[1], s.y.shape[1]
    rows = 6 if lanes == 8 else 4
    stride, width = 8 * bins, block.itemsize
    values, columns = s.tile.ctypes.data, tables.columns.ctypes.data
    out, after = s.y.ctypes.data, block.ctypes.data
    for k in range(0, BLOCK, rows):
        for j in range(rows):
            profile, tile = block[k + j], s.tile[j]
            reference = np.float64(profile[bins - 1])
            s.reference[k + j] = reference
            # Over the size of the array itself, for which the compiler needs no checks.
            for i in range(profile.size):
                tile[i] = np.float64(profile[i]) - reference
        ahead, here = after + (k + rows) * bins * width, out + 8 * lanes * k
        if lanes == 8:
            project_6_8(values, stride, columns, bins, here, ahead, rows * width)
        else:
            project_4_12(values, stride, columns, bins, here, ahead, rows * width)


@_compiled
def _classify(tables: Tables, s: _Scratch) -> None:
    """Set aside what cannot be solved here, so that only numbers go on; turn signals upright."""
    size = tables.size
    for p in range(BLOCK):
        y = s.y[p]
        norm = 0.0
        for j in range(size):
            norm += y[j] * y[j]
        norm *= tables.unit
        usable = abs(s.reference[p]) < HUGE and abs(y[size]) < HUGE
        state = _OK
        if norm == 0.0 and y[size] == 0.0 and usable:
            state = _CONSTANT
        elif not (_TINY < norm < HUGE and usable):
            state = ROUTED
        s.state[p] = state
        s.sign[p] = 1.0
        if state != _OK:
            y[:] = 0.0
            y[0] = 1.0
        elif (
            y[0] * tables.slopes[_functional_tables.CELLS // 2, 0, 0]
            + (y[1] * tables.slopes[_functional_tables.CELLS // 2, 1, 0])
            < 0.0
        ):
            s.sign[p] = -1.0
            for j in range(size):
                y[j] = -y[j]


@_compiled
def _start(tables: Tables, s: _Scratch) -> None:
    """Look up the cell by the direction of the first two components."""
    for p in range(BLOCK):
        y0, y1 = s.y[p, 0], s.y[p, 1]
        part = y1 / (abs(y0) + abs(y1))
        turn = part if y0 >= 0.0 else (2.0 - part if y1 >= 0.0 else -2.0 - part)
        turn = turn if abs(turn) <= 2.0 else 0.0
        place = int((turn + 2.0) * (_functional_tables.START_BINS // 4))
        s.cell[p] = tables.lookup[min(place, _functional_tables.START_BINS - 1)]


@_compiled
def _enter(tables: Tables, s: _Scratch, p: int, cell: int) -> None:
    """Put a profile into a cell."""
    size, row = tables.size, s.row
    y, out = s.y.ctypes.data + 8 * s.y.shape[1] * p, row.ctypes.data
    project_1_8(y, 8, tables.slopes.ctypes.data + 64 * size * cell, size, out, out, 0)
    s.cell[p] = cell
    for j in range(8):
        s.f[j, p] = row[j]


@_compiled
def _leap(tables: Tables, s: _Scratch) -> None:
    """Move each profile to the cell where a Gauss-Newton step from its first cell ends."""
    size, row, last = tables.size, s.row, tables.centres.size - 1
    out = row.ctypes.data
    for p in range(BLOCK):
        cell = s.cell[p]
        y = s.y.ctypes.data + 8 * s.y.shape[1] * p
        project_1_4(y, 8, tables.starts.ctypes.data + 32 * size * cell, size, out, out, 0)
        step = 0.5 * row[1] / (row[0] * tables.steepness[cell])
        step = step if step < _LONGEST_LEAP else _LONGEST_LEAP
        step = step if step > -_LONGEST_LEAP else -_LONGEST_LEAP
        cell += int(np.rint(step))
        cell = cell if cell < last else last
        _enter(tables, s, p, cell if cell > 0 else 0)


@_compiled
def _newton(tables: Tables, s: _Scratch) -> None:
    """Find the maximum of F on the polynomial of each profile's cell."""
    f = s.f
    for p in range(BLOCK):
        gauss = -f[0, p] * tables.steepness[s.cell[p]]
        t = -f[1, p] / gauss
        t = t if t < 1.5 else 1.5
        t = t if t > -1.5 else -1.5
        for _ in range(3):
            rise = f[6, p] + t * f[7, p]
            rise = f[3, p] + t * (f[4, p] + t * (f[5, p] + t * rise))
            rise = f[1, p] + t * (f[2, p] + t * rise)
            bend = 5.0 * f[6, p] + t * 6.0 * f[7, p]
            bend = 2.0 * f[3, p] + t * (3.0 * f[4, p] + t * (4.0 * f[5, p] + t * bend))
            bend = f[2, p] + t * bend
            bend = bend if bend <= 0.3 * gauss else gauss
            t -= rise / bend
            t = t if t < 3.0 else 3.0
            t = t if t > -3.0 else -3.0
        s.t[p] = t


@_compiled
def _settle(tables: Tables, s: _Scratch) -> None:
    """Iterate Newton steps until each maximum lies in the cell whose polynomial found it."""
    last = tables.centres.size - 1
    for _ in range(_MOVES):
        _newton(tables, s)
        moved = False
        for p in range(BLOCK):
            if abs(s.t[p]) > _EDGE:
                cell = min(max(s.cell[p] + int(np.rint(0.5 * s.t[p])), 0), last)
                if cell != s.cell[p]:
                    _enter(tables, s, p, cell)
                    moved = True
        if not moved:
            return
    for p in range(BLOCK):
        if abs(s.t[p]) > _EDGE and 0 < s.cell[p] < last and s.state[p] == _OK:
            s.state[p] = ROUTED


@_compiled
def _read_scalars(tables: Tables, s: _Scratch) -> None:
    """Evaluate what the results need at the extinctions found."""
    last, row, powers = tables.centres.size - 1, s.row, s.powers
    out, terms = row.ctypes.data, powers.size - 1
    for p in range(BLOCK):
        t, cell = s.t[p], s.cell[p]
        at_end = (cell == 0 and t <= -1.0) or (cell == last and t >= 1.0)
        t = min(max(t, -1.0), 1.0) if at_end else t
        s.t[p] = t
        s.found[_BOUNDED, p] = 1.0 if at_end else 0.0
        s.found[_TAU, p] = tables.centres[cell] + tables.halves[cell] * t
        square = t * t
        powers[1], powers[2], powers[3] = t, square, square * t
        powers[4], powers[5], powers[6] = square * square, square * square * t, square**3
        here = tables.scalars.ctypes.data + 8 * _functional_tables.SCALARS * terms * cell
        project_1_12(powers.ctypes.data, 8, here, terms, out, out, 0)
        for j in range(_functional_tables.SCALARS):
            s.scalars[j, p] = row[j]


@_compiled
def _estimate(tables: Tables, s: _Scratch) -> None:
    """Fill what was found and its errors, in the scaled variables, for unit noise."""
    f, c, found = s.f, s.scalars, s.found
    leverage = 2.0 * tables.start / tables.length
    level = 1.0 / tables.total_weight
    for p in range(BLOCK):
        t = s.t[p]
        high = f[5, p] / 5.0 + t * (f[6, p] / 6.0 + t * f[7, p] / 7.0)
        middle = f[2, p] / 2.0 + t * (f[3, p] / 3.0 + t * (f[4, p] / 4.0 + t * high))
        size = f[0, p] + t * (f[1, p] + t * middle)
        inverse_norm, coupling = (
            c[_functional_tables.INVERSE_NORM, p],
            c[_functional_tables.COUPLING, p],
        )
        inverse_slope = c[_functional_tables.INVERSE_SLOPE, p]
        error = inverse_slope / size
        # Extinction moves the logarithm of B, which is the amplitude at range zero.
        lever = (leverage - coupling / (inverse_norm * inverse_slope)) * error
        shape, slope = c[_functional_tables.LEVEL_SHAPE, p], c[_functional_tables.LEVEL_SLOPE, p]
        found[_F, p] = size
        found[_B, p] = s.sign[p] * size * inverse_norm
        found[_TAU_ERROR, p] = error
        found[_B_ERROR, p] = math.sqrt(1.0 / (size * size) + lever * lever)
        found[_P_ERROR, p] = math.sqrt(level + shape * shape + slope * slope)


@_compiled
def _seek_curvature(tables: Tables, s: _Scratch) -> None:
    """Fill the energy of the first functionals that the model leaves over.

    And what all of them leave over along the square of the shape, where a detector leaves its
    trace that is not linear or driven into saturation.
    """
    lanes, terms, row, powers = s.y.shape[1], s.f.shape[0], s.row, s.powers
    out = row.ctypes.data
    for p in range(BLOCK):
        t, size = s.t[p], s.found[_F, p]
        square = t * t
        powers[1], powers[2], powers[3] = t, square, square * t
        powers[4], powers[5] = square * square, square * square * t
        powers[6], powers[7] = square**3, square**3 * t
        here = tables.directions.ctypes.data + 8 * terms * lanes * s.cell[p]
        if lanes == 8:
            project_1_8(powers.ctypes.data, 8, here, terms, out, out, 0)
        else:
            project_1_12(powers.ctypes.data, 8, here, terms, out, out, 0)
        energy = 0.0
        for j in range(tables.size):
            s.left[j] = s.y[p, j] - size * row[j]
        for j in range(CURVATURES):
            energy += s.left[j] * s.left[j]
        s.found[_CURVATURE, p] = energy - _INTERPOLATED * size * size
        here = tables.squares.ctypes.data + 8 * terms * lanes * s.cell[p]
        if lanes == 8:
            project_1_8(powers.ctypes.data, 8, here, terms, out, out, 0)
        else:
            project_1_12(powers.ctypes.data, 8, here, terms, out, out, 0)
        along = 0.0
        for j in range(tables.size):
            along += s.left[j] * row[j]
        s.found[_SQUARE, p] = abs(along) - math.sqrt(_INTERPOLATED) * size


@_compiled
def _place_background(tables: Tables, s: _Scratch) -> None:
    for p in range(BLOCK):
        above = s.found[_B, p] * s.scalars[_functional_tables.MEAN_SHAPE, p]
        s.found[_P, p] = s.reference[p] + (s.y[p, tables.size] - above)


@_summing
def _bends(residual: Any) -> float:
    """Sum the squared second differences of the residuals."""
    total = residual.dtype.type(0.0)
    last, middle = residual[2:], residual[1:]
    for i in range(last.size):
        bend = last[i] - 2 * middle[i] + residual[i]
        total += bend * bend
    return np.float64(total)


@_compiled
def _look_back(block: Any, s: _Scratch, want_bends: bool) -> None:
    """Take the residuals of the profiles, in units of the noise."""
    bins = block.shape[1]
    steps = (bins - 1) // STRIDE + 1
    rest = bins - STRIDE * (steps - 1)
    width = block.itemsize * bins
    for p in range(BLOCK):
        profile, background = block[p], s.found[_P, p]
        for j in range(STRIDE):
            s.tail[j] = background
        for j in range(rest):
            s.tail[j] = profile[bins - rest + j]
        decay = s.scalars[_functional_tables.DECAY, p]
        e2 = decay * decay
        e4 = e2 * e2
        s.found[_ENERGY, p], s.found[_LARGEST, p] = residuals(
            block,
            block.ctypes.data + width * p,
            s.tail.ctypes.data,
            steps,
            s.envelope.ctypes.data,
            s.root.ctypes.data,
            decay,
            e2,
            e4,
            e4 * e4,
            s.found[_B, p],
            background,
            s.residual.ctypes.data,
        )
        if want_bends:
            s.found[_BENDS, p] = _bends(s.residual[:bins])


@_compiled
def _set_noise(tables: Tables, s: _Scratch, bins: int, mode: Mode) -> None:
    """Fill the variance of the noise over that of unit weight."""
    scale = mode.rounding**2 * tables.unit * tables.total_weight / bins
    for p in range(BLOCK):
        largest = abs(s.reference[p]) + abs(s.found[_B, p])
        floor = scale * largest * largest
        noise = s.found[_BENDS, p] / (6.0 * (bins - 2))
        noise = noise if noise > floor else floor
        s.found[_NOISE, p] = 1.0 if mode.known_variance else noise


@_compiled
def _convert(tables: Tables, s: _Scratch, bins: int, widening: float) -> None:
    """Fill the results in SI units."""
    found, results = s.found, s.results
    for p in range(BLOCK):
        extinction = found[_TAU, p] / tables.length
        results[2, p] = math.exp(2.0 * extinction * tables.start) * tables.start**2
    for p in range(BLOCK):
        noise = found[_NOISE, p]
        root = math.sqrt(noise / tables.unit)
        size = found[_B, p]
        amplitude = size * results[2, p]
        results[0, p] = found[_P, p]
        wide = root * widening
        results[1, p] = found[_P_ERROR, p] * wide
        results[2, p] = amplitude
        results[3, p] = abs(amplitude) * (found[_B_ERROR, p] * wide)
        results[4, p] = found[_TAU, p] / tables.length
        results[5, p] = found[_TAU_ERROR, p] * wide / tables.length
        results[6, p] = s.sign[p] * found[_F, p] / root
        results[7, p] = found[_ENERGY, p] / (noise * (bins - 3))
        curvature = found[_CURVATURE, p]
        results[8, p] = (curvature if curvature > 0.0 else 0.0) * tables.unit / noise
        results[9, p] = size * s.scalars[_functional_tables.BACKGROUND_BEND, p] * tables.length
        results[10, p] = s.scalars[_functional_tables.EXTINCTION_BEND, p]


@_compiled
def _judge(tables: Tables, s: _Scratch, mode: Mode, limits: CommonLimits) -> None:
    """Fill the quality. Passed, not failed, is asked for: NaN does not pass."""
    found, results = s.found, s.results
    steepest = 1.0 / tables.mean_range
    for p in range(BLOCK):
        relative = results[5, p] / (results[4, p] + steepest)
        determined = (relative >= 0.0) & (relative < limits.largest_relative_error)
        determined &= results[3, p] < HUGE * HUGE
        misfit = results[7, p]
        fits = (limits.least_misfit <= misfit) & (misfit <= limits.most_misfit)
        largest = limits.outlier * math.sqrt(found[_NOISE, p])
        bits = 0 if abs(results[6, p]) > limits.lowest_signal else _LOW_SIGNAL
        bits |= 0 if determined else _POORLY_DETERMINED
        bits |= 0 if s.sign[p] > 0.0 else _NEGATIVE_AMPLITUDE
        bits |= 0 if found[_BOUNDED, p] == 0.0 else _AT_BOUND
        straight = results[8, p] <= limits.curvature
        straight &= found[_SQUARE, p] * math.sqrt(tables.unit / found[_NOISE, p]) <= limits.square
        bits |= 0 if straight else _NOT_HOMOGENEOUS
        tested = 0 if fits else _POOR_FIT
        tested |= 0 if found[_LARGEST, p] <= largest else _OUTLIER
        s.bits[p] = bits | (tested if mode.with_residuals else 0)


@_compiled
def _settle_exceptions(tables: Tables, s: _Scratch, mode: Mode) -> None:
    """Overwrite what holds for constant profiles, and what was not asked for."""
    if not mode.with_residuals:
        s.results[7, :] = math.nan
    for p in range(BLOCK):
        if s.state[p] == _CONSTANT:
            s.results[:, p] = math.nan
            s.results[0, p] = s.reference[p]
            s.results[2, p] = 0.0
            if mode.known_variance:
                s.results[1, p] = math.sqrt(1.0 / (tables.total_weight * tables.unit))
            s.bits[p] = _NO_SIGNAL


@_compiled
def _solve_block(block: Any, tables: Tables, s: _Scratch, mode: Mode, limits: CommonLimits) -> None:
    _project(block, tables, s)
    _classify(tables, s)
    _start(tables, s)
    _leap(tables, s)
    _settle(tables, s)
    _read_scalars(tables, s)
    _estimate(tables, s)
    _seek_curvature(tables, s)
    _place_background(tables, s)
    if mode.with_residuals:
        _look_back(block, s, not mode.known_variance)
    bins = block.shape[1]
    _set_noise(tables, s, bins, mode)
    _convert(tables, s, bins, limits.widening)
    _judge(tables, s, mode, limits)
    _settle_exceptions(tables, s, mode)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def solve_compressed(
    power: Any,
    root: Any,
    envelope: Any,
    tables: Tables,
    mode: Mode,
    limits: CommonLimits,
    out: Array,
    quality: Flags,
    state: npt.NDArray[np.int64],
) -> None:
    """Solve every profile of a batch.

    Parameters
    ----------
    power : (profile, bin) float32 or float64
        Contiguous.
    root : (bin,), padded like `envelope`
        Square roots of the weights, in the type of the power.
    envelope : (bin,)
        `Tables.envelope` in the type of the power.
    tables : Tables
    mode : Mode
    limits : CommonLimits
    out : (len(RESULTS), profile) float64
    quality : (profile,) int32
    state : (profile,) int64
        `ROUTED` where the profile is left to others; its results mean nothing.
    """
    count = power.shape[0]
    s = _scratch(power, root, envelope, tables.columns.shape[1])
    for first in range(0, count, BLOCK):
        here = min(BLOCK, count - first)
        if here == BLOCK:
            _solve_block(power[first : first + BLOCK], tables, s, mode, limits)
        else:
            s.padded[:here] = power[first:]
            s.padded[here:] = 0
            _solve_block(s.padded, tables, s, mode, limits)
        for j in range(out.shape[0]):
            row, results = out[j, first : first + here], s.results[j]
            for p in range(here):
                row[p] = results[p]
        quality[first : first + here] = s.bits[:here]
        state[first : first + here] = s.state[:here]


def weight_roots(tables: Tables, weights: Array, like: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the square roots of the weights as `solve_compressed` wants them."""
    padded = np.zeros(tables.envelope.size, like.dtype)
    padded[: weights.size] = np.sqrt(weights)
    return padded
