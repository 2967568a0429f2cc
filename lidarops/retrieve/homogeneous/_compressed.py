"""Least squares of the homogeneous path from a few linear functionals of each profile.

For profiles without gaps, on a uniform grid, with common weights. A profile is read once and
multiplied with the basis of `lidarops.retrieve.homogeneous._functional_tables`, which reduces it
to K numbers y. The extinction follows from y by a look-up, one step to the right cell and three
Newton steps on the polynomial of the cell, without exponentials or loops over bins. A second pass
over the bins, which are still in the cache, computes the residuals.

Profiles are processed in blocks of `BLOCK`; the last block is padded with zeros and runs through
the same code. Every profile has its own accumulators, summed in the order of the bins, so that
the bits of a result depend on the profile alone.
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
from lidarops.retrieve.homogeneous._fit_quality import CommonLimits, curved_widening
from lidarops.retrieve.homogeneous._functional_tables import Tables
from lidarops.retrieve.homogeneous._vector_loops import (
    STRIDE,
    project_1_4,
    project_1_8,
    project_1_12,
    project_4_12,
    residuals,
)
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.int32]

BLOCK: Final = 48
"""Profiles in a block: whole tiles of `_TILE`, and whole vectors of any processor."""
_TILE: Final = 4
"""Profiles that are projected together."""
_LONGEST_LEAP: Final = 20.0
"""Most cells that the first step may cross."""
_STEPS: Final = 3
"""Newton steps on the polynomial of a cell."""
_FIRST_STEP: Final = 1.5
"""Half widths of a cell that the Gauss-Newton step before them may reach from its centre."""
_FARTHEST: Final = 3.0
"""Half widths that they may reach."""
_LEAST_CURVATURE: Final = THRESHOLDS.least_curvature
_EDGE: Final = 1.02
"""Half widths from the centre of a cell beyond which the polynomial of the next cell is used."""
_MOVES: Final = 40
"""Most moves from cell to cell, by 1.5 cells at most; thin sections start some 20 cells off.
Profiles that have not settled then are routed to other solvers."""
HUGE: Final = 1e140
_TINY: Final = 1e-140
CURVATURES: Final = 7
"""Functionals that are tested for misfit: further ones hold more noise than misfit."""
_INTERPOLATED: Final = 1e-22
"""Squared error of the direction of a shape, from the polynomials of the tables."""
_OK: Final = 0
_CONSTANT: Final = 1
ROUTED: Final = 2
"""State of a profile that this solver cannot handle: it has gaps, or exceeds the float range."""

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
_POORLY_DETERMINED: Final = int(HomogeneousQuality.POORLY_DETERMINED)
_NEGATIVE_AMPLITUDE: Final = int(Quality.NEGATIVE_AMPLITUDE)
_AT_BOUND: Final = int(HomogeneousQuality.AT_BOUND)
_POOR_FIT: Final = int(HomogeneousQuality.POOR_FIT)
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
    """What is known of the noise of a call."""

    known_variance: bool
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
    fit: Array
    row: Array
    remainder: Array
    powers: Array
    root: Any
    envelope: Any
    tail: Any
    residual: Any
    padded: Any
    state: npt.NDArray[np.int64]
    results: Array
    bits: Flags


# Rows of `_Scratch.fit`.
_F: Final = 0
_B: Final = 1
_P: Final = 2
_TAU: Final = 3
_TAU_ERROR: Final = 4
_B_ERROR: Final = 5
_LEVEL_ERROR: Final = 6
"""Of the background, at known extinction."""
_CURVATURE: Final = 7
_ENERGY: Final = 8
_LARGEST: Final = 9
_DIFFERENCES: Final = 10
_BOUNDED: Final = 11
_NOISE: Final = 12
_SQUARE: Final = 13
_SLOPE_ERROR: Final = 14
"""Of the background, by the error of extinction."""
_FIT_ROWS: Final = 15


@_compiled
def _scratch(power: Any, root: Any, envelope: Any) -> _Scratch:
    bins = power.shape[1]
    return _Scratch(
        np.zeros((_TILE, bins)),
        np.zeros(BLOCK),
        np.zeros((BLOCK, _functional_tables.COLUMNS)),
        np.ones(BLOCK),
        np.zeros(BLOCK, np.int64),
        np.zeros((8, BLOCK)),
        np.zeros(BLOCK),
        np.zeros((_functional_tables.SCALARS, BLOCK)),
        np.zeros((_FIT_ROWS, BLOCK)),
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
    stride, width = 8 * bins, block.itemsize
    values, columns = s.tile.ctypes.data, tables.columns.ctypes.data
    out, after = s.y.ctypes.data, block.ctypes.data
    for k in range(0, BLOCK, _TILE):
        for j in range(_TILE):
            profile, tile = block[k + j], s.tile[j]
            reference = np.float64(profile[bins - 1])
            s.reference[k + j] = reference
            # A loop over the size of the array itself needs no bounds checks.
            for i in range(profile.size):
                tile[i] = np.float64(profile[i]) - reference
        ahead, target = after + (k + _TILE) * bins * width, out + 8 * lanes * k
        project_4_12(values, stride, columns, bins, target, ahead, _TILE * width)


@_compiled
def _all_have_gaps(block: Any) -> bool:
    """Return whether no profile of the block can be solved here; look no further than needed."""
    for p in range(BLOCK):
        profile, gaps = block[p], False
        for i in range(profile.size):
            if not math.isfinite(profile[i]):
                gaps = True
                break
        if not gaps:
            return False
    return True


@_compiled
def _classify(tables: Tables, s: _Scratch) -> None:
    """Set aside profiles that cannot be solved here; change the sign of inverted signals."""
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
        share = y1 / (abs(y0) + abs(y1))
        turn = share if y0 >= 0.0 else (2.0 - share if y1 >= 0.0 else -2.0 - share)
        turn = turn if abs(turn) <= 2.0 else 0.0
        index = int((turn + 2.0) * (_functional_tables.START_BINS // 4))
        s.cell[p] = tables.lookup[min(index, _functional_tables.START_BINS - 1)]


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
        t = t if t < _FIRST_STEP else _FIRST_STEP
        t = t if t > -_FIRST_STEP else -_FIRST_STEP
        for _ in range(_STEPS):
            rise = f[6, p] + t * f[7, p]
            rise = f[3, p] + t * (f[4, p] + t * (f[5, p] + t * rise))
            rise = f[1, p] + t * (f[2, p] + t * rise)
            bend = 5.0 * f[6, p] + t * 6.0 * f[7, p]
            bend = 2.0 * f[3, p] + t * (3.0 * f[4, p] + t * (4.0 * f[5, p] + t * bend))
            bend = f[2, p] + t * bend
            bend = bend if bend <= _LEAST_CURVATURE * gauss else gauss
            t -= rise / bend
            t = t if t < _FARTHEST else _FARTHEST
            t = t if t > -_FARTHEST else -_FARTHEST
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
    """Evaluate the scalars of the results at the fitted extinctions."""
    last, row, powers = tables.centres.size - 1, s.row, s.powers
    out, terms = row.ctypes.data, powers.size - 1
    for p in range(BLOCK):
        t, cell = s.t[p], s.cell[p]
        at_end = (cell == 0 and t <= -1.0) or (cell == last and t >= 1.0)
        t = min(max(t, -1.0), 1.0) if at_end else t
        s.t[p] = t
        s.fit[_BOUNDED, p] = 1.0 if at_end else 0.0
        s.fit[_TAU, p] = tables.centres[cell] + tables.halves[cell] * t
        square = t * t
        powers[1], powers[2], powers[3] = t, square, square * t
        powers[4], powers[5], powers[6] = square * square, square * square * t, square**3
        matrix = tables.scalars.ctypes.data + 8 * _functional_tables.SCALARS * terms * cell
        project_1_12(powers.ctypes.data, 8, matrix, terms, out, out, 0)
        for j in range(_functional_tables.SCALARS):
            s.scalars[j, p] = row[j]


@_compiled
def _estimate(tables: Tables, s: _Scratch) -> None:
    """Fill the parameters and their errors, in the scaled variables, for unit noise."""
    f, c, fit = s.f, s.scalars, s.fit
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
        shape = c[_functional_tables.LEVEL_SHAPE, p]
        fit[_F, p] = size
        fit[_B, p] = s.sign[p] * size * inverse_norm
        fit[_TAU_ERROR, p] = error
        fit[_B_ERROR, p] = math.sqrt(1.0 / (size * size) + lever * lever)
        fit[_LEVEL_ERROR, p] = math.sqrt(level + shape * shape)
        fit[_SLOPE_ERROR, p] = c[_functional_tables.LEVEL_SLOPE, p]


@_compiled
def _measure_misfit(tables: Tables, s: _Scratch) -> None:
    """Fill the energy of the residuals in the first functionals.

    Also fill the projection of all residuals on the square of the shape, where a nonlinear or
    saturated detector shows.
    """
    lanes, terms, row, powers = s.y.shape[1], s.f.shape[0], s.row, s.powers
    out = row.ctypes.data
    for p in range(BLOCK):
        t, size = s.t[p], s.fit[_F, p]
        square = t * t
        powers[1], powers[2], powers[3] = t, square, square * t
        powers[4], powers[5] = square * square, square * square * t
        powers[6], powers[7] = square**3, square**3 * t
        matrix = tables.directions.ctypes.data + 8 * terms * lanes * s.cell[p]
        project_1_12(powers.ctypes.data, 8, matrix, terms, out, out, 0)
        energy = 0.0
        for j in range(tables.size):
            s.remainder[j] = s.y[p, j] - size * row[j]
        for j in range(CURVATURES):
            energy += s.remainder[j] * s.remainder[j]
        s.fit[_CURVATURE, p] = energy - _INTERPOLATED * size * size
        matrix = tables.squares.ctypes.data + 8 * terms * lanes * s.cell[p]
        project_1_12(powers.ctypes.data, 8, matrix, terms, out, out, 0)
        along = 0.0
        for j in range(tables.size):
            along += s.remainder[j] * row[j]
        s.fit[_SQUARE, p] = abs(along) - math.sqrt(_INTERPOLATED) * size


@_compiled
def _place_background(tables: Tables, s: _Scratch) -> None:
    for p in range(BLOCK):
        above = s.fit[_B, p] * s.scalars[_functional_tables.MEAN_SHAPE, p]
        s.fit[_P, p] = s.reference[p] + (s.y[p, tables.size] - above)


@_summing
def _second_differences(residual: Any) -> float:
    """Sum the squared second differences of the residuals."""
    total = residual.dtype.type(0.0)
    last, middle = residual[2:], residual[1:]
    for i in range(last.size):
        difference = last[i] - 2 * middle[i] + residual[i]
        total += difference * difference
    return np.float64(total)


@_compiled
def _take_residuals(block: Any, s: _Scratch, want_differences: bool) -> None:
    """Compute the residuals of the profiles, in units of the noise."""
    bins = block.shape[1]
    steps = (bins - 1) // STRIDE + 1
    rest = bins - STRIDE * (steps - 1)
    width = block.itemsize * bins
    for p in range(BLOCK):
        profile, background = block[p], s.fit[_P, p]
        for j in range(STRIDE):
            s.tail[j] = background
        for j in range(rest):
            s.tail[j] = profile[bins - rest + j]
        decay = s.scalars[_functional_tables.DECAY, p]
        e2 = decay * decay
        e4 = e2 * e2
        s.fit[_ENERGY, p], s.fit[_LARGEST, p] = residuals(
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
            s.fit[_B, p],
            background,
            s.residual.ctypes.data,
        )
        if want_differences:
            s.fit[_DIFFERENCES, p] = _second_differences(s.residual[:bins])


@_compiled
def _set_noise(tables: Tables, s: _Scratch, bins: int, mode: Mode) -> None:
    """Fill the noise variance of unit weight."""
    scale = mode.rounding**2 * tables.unit * tables.total_weight / bins
    for p in range(BLOCK):
        largest = abs(s.reference[p]) + abs(s.fit[_B, p])
        floor = scale * largest * largest
        noise = s.fit[_DIFFERENCES, p] / (6.0 * (bins - 2))
        noise = noise if noise > floor else floor
        s.fit[_NOISE, p] = 1.0 if mode.known_variance else noise


_curved_widening = _compiled(curved_widening)


@_compiled
def _relative_error(tables: Tables, s: _Scratch, bins: int, p: int) -> float:
    """Return the error of extinction over its scale."""
    # Where the signal dies within a bin, the error is that of the transmission of one bin.
    steepest = 0.5 * (bins - 1) / tables.length
    slope = min(s.results[4, p] + 1.0 / tables.mean_range, steepest)
    return float(s.results[5, p] / slope)


@_compiled
def _convert(tables: Tables, s: _Scratch, bins: int, widening: float) -> None:
    """Fill the results in SI units."""
    fit, results = s.fit, s.results
    for p in range(BLOCK):
        extinction = fit[_TAU, p] / tables.length
        results[2, p] = math.exp(2.0 * extinction * tables.start) * tables.start**2
    for p in range(BLOCK):
        noise = fit[_NOISE, p]
        root = math.sqrt(noise / tables.unit)
        size = fit[_B, p]
        amplitude = size * results[2, p]
        results[0, p] = fit[_P, p]
        wide = root * widening
        results[2, p] = amplitude
        results[3, p] = abs(amplitude) * (fit[_B_ERROR, p] * wide)
        results[4, p] = fit[_TAU, p] / tables.length
        results[5, p] = fit[_TAU_ERROR, p] * wide / tables.length
        slope = fit[_SLOPE_ERROR, p] * _curved_widening(_relative_error(tables, s, bins, p))
        results[1, p] = math.sqrt(fit[_LEVEL_ERROR, p] ** 2 + slope**2) * wide
        results[6, p] = s.sign[p] * fit[_F, p] / root
        results[7, p] = fit[_ENERGY, p] / (noise * (bins - 3))
        curvature = fit[_CURVATURE, p]
        results[8, p] = (curvature if curvature > 0.0 else 0.0) * tables.unit / noise
        results[9, p] = size * s.scalars[_functional_tables.BACKGROUND_BEND, p] * tables.length
        results[10, p] = s.scalars[_functional_tables.EXTINCTION_BEND, p]


@_compiled
def _judge(tables: Tables, s: _Scratch, bins: int, limits: CommonLimits) -> None:
    """Fill the quality bits. Tests are for a pass, so that NaN fails."""
    fit, results = s.fit, s.results
    for p in range(BLOCK):
        relative = _relative_error(tables, s, bins, p)
        determined = (relative >= 0.0) & (relative < limits.largest_relative_error)
        determined &= results[3, p] < HUGE * HUGE
        largest = limits.outlier * math.sqrt(fit[_NOISE, p])
        bits = 0 if abs(results[6, p]) > limits.lowest_signal else _LOW_SIGNAL
        bits |= 0 if determined else _POORLY_DETERMINED
        bits |= 0 if s.sign[p] > 0.0 else _NEGATIVE_AMPLITUDE
        bits |= 0 if fit[_BOUNDED, p] == 0.0 else _AT_BOUND
        straight = results[8, p] <= limits.curvature
        straight &= fit[_SQUARE, p] * math.sqrt(tables.unit / fit[_NOISE, p]) <= limits.square
        bits |= 0 if straight else _NOT_HOMOGENEOUS
        bits |= 0 if results[7, p] <= limits.misfit else _POOR_FIT
        bits |= 0 if fit[_LARGEST, p] <= largest else _OUTLIER
        s.bits[p] = bits


@_compiled
def _settle_constant(tables: Tables, s: _Scratch, mode: Mode) -> None:
    """Overwrite the results of constant profiles."""
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
    if _all_have_gaps(block):
        s.state[:] = ROUTED
        return
    _project(block, tables, s)
    _classify(tables, s)
    _start(tables, s)
    _leap(tables, s)
    _settle(tables, s)
    _read_scalars(tables, s)
    _estimate(tables, s)
    _measure_misfit(tables, s)
    _place_background(tables, s)
    _take_residuals(block, s, not mode.known_variance)
    bins = block.shape[1]
    _set_noise(tables, s, bins, mode)
    _convert(tables, s, bins, limits.widening)
    _judge(tables, s, bins, limits)
    _settle_constant(tables, s, mode)


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
        `ROUTED` where the profile is left to another solver; its results mean nothing.
    """
    count = power.shape[0]
    s = _scratch(power, root, envelope)
    for first in range(0, count, BLOCK):
        profiles = min(BLOCK, count - first)
        if profiles == BLOCK:
            _solve_block(power[first : first + BLOCK], tables, s, mode, limits)
        else:
            s.padded[:profiles] = power[first:]
            s.padded[profiles:] = 0
            _solve_block(s.padded, tables, s, mode, limits)
        for j in range(out.shape[0]):
            row, results = out[j, first : first + profiles], s.results[j]
            for p in range(profiles):
                row[p] = results[p]
        quality[first : first + profiles] = s.bits[:profiles]
        state[first : first + profiles] = s.state[:profiles]


def weight_roots(tables: Tables, weights: Array, like: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the square roots of the weights in the layout of `solve_compressed`."""
    padded = np.zeros(tables.envelope.size, like.dtype)
    padded[: weights.size] = np.sqrt(weights)
    return padded
