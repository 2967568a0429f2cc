"""Compiled least squares of a constant and a known shape, from sums over blocks of bins.

One pass over the bins of a profile sums them in `BLOCKS` equal blocks. Nested windows that begin at
the edges of blocks are then fitted, weighted and tested by these sums alone. Powers are summed less
that of the last bin, so that a background 1e8 times the signal costs no digits of the signal.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import HUGE, Array, Booleans
from lidarops.retrieve.common.compiled_code import compiled, inlined, summing

BLOCKS: Final = 14
"""Blocks of the longest window, whose mean residuals are tested."""
STEP: Final = 2
"""Blocks from the start of one window to that of the next shorter one."""
WINDOWS: Final = 5
_PASSES: Final = 2
"""Times that the counts of a window are weighed by a fit of it."""
_SINGULAR: Final = 1e-14
"""Squared contrast of the shape, relative to its mean, below which only rounding is left."""
_DEPENDENT: Final = 1e-9
"""Squared share of the tilted shape outside the fitted ones, below which it is rounding."""

# Sums of a block: bins, weights, weighted powers of shape and power.
BINS, WEIGHT, SHAPE, SHAPE2, SHAPE3, POWER, PRODUCT, POWER2 = range(8)

ROW: Final = np.dtype(
    [
        (name, np.float64)
        for name in (
            "background", "background_variance", "amplitude", "amplitude_variance", "chi2",
            "bins", "condition", "curvature", "waves", "window", "constant", "first", "past",
            "allowed",
        )
    ]
)  # fmt: skip
"""Fit of a window: fields of `known_shape.KnownShapeResult`; number of the window, whether all
powers are equal, first bin and first one past the window, bins from the first on that may be used.
"""


class Limits(NamedTuple):
    """Limits of the tests for a window without aerosol, and the odds that it has some."""

    nearest: float
    """Start of the longest window over the farthest usable range."""
    waves: Array
    """Limits of the chi-square of the mean residuals of blocks, one for each window."""
    deviation: float
    """Limit of the curvature and of the differences of backgrounds, in standard errors."""
    aerosol: float
    """Odds that the next shorter window is the first one without aerosol."""


class _Weights(NamedTuple):
    """Model of the counts whose inverse variances are the weights of a window."""

    exposure: float
    """Not positive for the weights of the sums themselves."""
    background: float
    amplitude: float


class _Scratch(NamedTuple):
    """Arrays of the profiles of a call."""

    weights: Array
    """(bin,) by variance and air, 0 where either is not usable."""
    sums: Array
    """(8, block)."""
    factors: Array
    """(block,) on the sums of a block."""


@summing
def _weigh(variance: Array, shape: Array, weights: Array) -> None:
    for i in range(weights.size):
        weight = 1.0 / variance[i]
        good = (weight > 0.0) & (weight < math.inf) & (shape[i] > 0.0) & (shape[i] < HUGE)
        weights[i] = weight if good else 0.0


@summing
def _sum_block(
    power: Array,
    shape: Array,
    weights: Array,
    mask: Booleans,
    reference: float,
    k: int,
    sums: Array,
) -> None:
    bins = weight = of_shape = of_shape2 = of_shape3 = of_power = product = of_power2 = 0.0
    for i in range(power.size):
        good = (abs(power[i]) < HUGE) & mask[i] & (weights[i] > 0.0)
        w = weights[i] if good else 0.0
        value, air = (power[i] - reference, shape[i]) if good else (0.0, 0.0)
        shaped = w * air
        bins += 1.0 if good else 0.0
        weight += w
        of_shape += shaped
        of_shape2 += shaped * air
        of_shape3 += shaped * air * air
        of_power += w * value
        product += shaped * value
        of_power2 += w * value * value
    sums[BINS, k], sums[WEIGHT, k] = bins, weight
    sums[SHAPE, k], sums[SHAPE2, k], sums[SHAPE3, k] = of_shape, of_shape2, of_shape3
    sums[POWER, k], sums[PRODUCT, k], sums[POWER2, k] = of_power, product, of_power2


@summing
def _fill_factors(s: _Scratch, by: _Weights, first: int) -> None:
    """Fill the factors on the sums of blocks."""
    for k in range(first, BLOCKS):
        bins = s.sums[WEIGHT, k]
        counted = by.exposure * bins / (by.background * bins + by.amplitude * s.sums[SHAPE, k])
        s.factors[k] = counted if bins > 0.0 else 0.0


@summing
def _solve(s: _Scratch, first: int) -> tuple[float, float, float, float, float]:
    """Return weight, mean shape and power, squared deviation of the shape, and amplitude."""
    sums = s.sums
    weight = of_shape = of_shape2 = of_power = product = 0.0
    for k in range(first, BLOCKS):
        factor = s.factors[k]
        weight += factor * sums[WEIGHT, k]
        of_shape += factor * sums[SHAPE, k]
        of_shape2 += factor * sums[SHAPE2, k]
        of_power += factor * sums[POWER, k]
        product += factor * sums[PRODUCT, k]
    mean_shape, mean_power = of_shape / weight, of_power / weight
    square = of_shape2 - mean_shape * of_shape
    square = square if square > _SINGULAR * of_shape2 else 0.0
    return weight, mean_shape, mean_power, square, (product - mean_shape * of_power) / square


@inlined
def _fit(s: _Scratch, exposure: float, reference: float, window: int, row: Any) -> None:
    """Fit and test a window, of which 0 is the longest."""
    first, size = STEP * window, 0.0
    row.window, row.bins = window, 0.0
    for k in range(first, BLOCKS):
        row.bins += s.sums[BINS, k]
        size += s.sums[POWER2, k]
        s.factors[k] = 1.0
    row.constant = size == 0.0
    if row.bins == 0.0:
        return
    by = _Weights(0.0, 1.0, 0.0)
    weight, mean_shape, mean_power, square, amplitude = _solve(s, first)
    for _ in range(_PASSES if exposure > 0.0 else 0):
        one = 1.0 / (row.bins * exposure)
        mean = reference + mean_power
        amplitude = max(amplitude, 0.0) if square > 0.0 else 0.0
        # A zero background is known to its standard error only, and to one count at best.
        least = math.sqrt(max(mean, 0.0) * one) + one
        by = _Weights(exposure, max(mean - amplitude * mean_shape, least), amplitude)
        _fill_factors(s, by, first)
        weight, mean_shape, mean_power, square, amplitude = _solve(s, first)
    if square == 0.0:
        row.condition = np.inf
        return
    level = mean_power - amplitude * mean_shape
    row.background, row.amplitude = reference + level, amplitude
    row.amplitude_variance = 1.0 / square
    if exposure > 0.0:
        row.amplitude_variance = _scatter(s, by, first, mean_shape) / (square * square)
    row.background_variance = 1.0 / weight + mean_shape * mean_shape / square
    row.condition = math.sqrt(row.background_variance * weight)
    chi2, row.waves, score, norm, with_level, with_shape = _residuals(s, first, level, amplitude)
    # Rounding of a fit without noise.
    row.chi2 = max(chi2, 0.0)
    with_shape -= mean_shape * with_level
    left = norm - with_level * with_level / weight - with_shape * with_shape / square
    # The tilted shape may be a mere combination of the shape and a constant.
    row.curvature = score / math.sqrt(left) if left > _DEPENDENT * norm else 0.0


@summing
def _scatter(s: _Scratch, by: _Weights, first: int, mean: float) -> float:
    """Return the variance of the weighted sum of counts times the deviation of their shape.

    Bins of a block share a weight, though near ones hold more counts.
    """
    total, sums = 0.0, s.sums
    for k in range(first, BLOCKS):
        factor = s.factors[k]
        level = sums[SHAPE2, k] - 2.0 * mean * sums[SHAPE, k] + mean * mean * sums[WEIGHT, k]
        shaped = sums[SHAPE3, k] - 2.0 * mean * sums[SHAPE2, k] + mean * mean * sums[SHAPE, k]
        total += factor * factor * (by.background * level + by.amplitude * shaped)
    return total / by.exposure


@summing
def _residuals(
    s: _Scratch, first: int, level: float, amplitude: float
) -> tuple[float, float, float, float, float, float]:
    """Return chi-square, that of block means, and products with the shape times range.

    These are of the residuals, of itself, of a constant, and of the shape.
    """
    sums = s.sums
    chi2 = waves = score = norm = with_level = with_shape = 0.0
    for k in range(first, BLOCKS):
        factor = s.factors[k]
        weight, of_shape = factor * sums[WEIGHT, k], factor * sums[SHAPE, k]
        residual = factor * sums[POWER, k] - level * weight - amplitude * of_shape
        inverse = 1.0 / weight if weight > 0.0 else 0.0
        tilted = of_shape * inverse * (k - first)
        waves += residual * residual * inverse
        score += residual * tilted
        norm += weight * tilted * tilted
        with_level += weight * tilted
        with_shape += of_shape * tilted
        products = level * sums[POWER, k] + amplitude * sums[PRODUCT, k]
        chi2 += factor * (sums[POWER2, k] - products)
    return chi2, waves, score, norm, with_level, with_shape


@inlined
def _passes(row: Any, limits: Limits) -> bool:
    waves = row.waves <= limits.waves[int(row.window)]
    return bool(abs(row.curvature) <= limits.deviation and waves)


@inlined
def _choose(rows: Any, limits: Limits) -> int:
    """Return the longest window that passes and agrees with all shorter ones, else the shortest."""
    shortest = rows.size - 1
    for k in range(shortest):
        agrees = _passes(rows[k], limits)
        for j in range(k + 1, rows.size):
            # The variance of a difference of nested fits is the difference of their variances.
            gap = rows[j].background_variance - rows[k].background_variance
            step = rows[j].background - rows[k].background
            agrees = agrees and not step * step > limits.deviation**2 * gap
        if agrees:
            return k
    return int(shortest)


@inlined
def _variance_with_choice(rows: Any, chosen: int, limits: Limits) -> float:
    """Return the variance of the chosen background, which includes the choice.

    It is the mean square about the chosen background over all windows that pass, weighted by the
    odds that the far range is clean from each on. Steps of the background between neighbouring
    windows are independent. Those beyond the first clean window are noise; each one before it has
    the odds of aerosol instead.
    """
    total = square = misfit = 0.0
    shorter = -1
    for k in range(rows.size - 1, -1, -1):
        if not math.isfinite(rows[k].background):
            continue
        gap = rows[shorter].background_variance - rows[k].background_variance
        if shorter >= 0 and gap > 0.0:
            misfit += (rows[shorter].background - rows[k].background) ** 2 / gap
        shorter = k
        if k == chosen or _passes(rows[k], limits):
            odds = limits.aerosol**k * math.exp(-0.5 * misfit)
            step = rows[k].background - rows[chosen].background
            total += odds
            square += odds * (rows[k].background_variance + step * step)
    return square / total


@inlined
def _span(
    power: Array, weights: Array, mask: Booleans, range_: Array, edges: tuple[float, float, float]
) -> tuple[int, int]:
    """Return the first bin of the longest window and the one past its last usable bin."""
    nearest, start, stop = edges
    past = int(np.searchsorted(range_, stop, side="right"))
    while past > 0 and not (abs(power[past - 1]) < HUGE and mask[past - 1] and weights[past - 1]):
        past -= 1
    if math.isnan(start):
        start = nearest * range_[max(past - 1, 0)]
    return min(int(np.searchsorted(range_, start)), past), past


@inlined
def _fit_profiles(
    power: Array,
    given: tuple[Array, Array, Booleans, Array],
    range_: Array,
    edges: tuple[Array, Array],
    limits: Limits,
    s: _Scratch,
    rows: Any,
    out: Any,
) -> None:
    shapes, variances, masks, exposure = given
    starts, stops = edges
    for k in range(power.shape[0]):
        row, shape, mask = power[k], shapes[k % shapes.shape[0]], masks[k % masks.shape[0]]
        if k < max(variances.shape[0], shapes.shape[0]):
            _weigh(variances[k % variances.shape[0]], shape, s.weights)
        ends = (limits.nearest, starts[k % starts.size], stops[k % stops.size])
        first, past = _span(row, s.weights, mask, range_, ends)
        reference = row[past - 1] if past > 0 else 0.0
        bins = past - first
        for j in range(BLOCKS):
            span = slice(first + j * bins // BLOCKS, first + (j + 1) * bins // BLOCKS)
            _sum_block(row[span], shape[span], s.weights[span], mask[span], reference, j, s.sums)
        for j in range(rows.size):
            rows[j] = out[k]
            _fit(s, exposure[k % exposure.size], reference, j, rows[j])
        chosen = _choose(rows, limits)
        out[k] = rows[chosen]
        out[k].background_variance = _variance_with_choice(rows, chosen, limits)
        first += STEP * chosen * (past - first) // BLOCKS
        out[k].first, out[k].past, out[k].allowed = first, past, mask[first:].sum()


@compiled
def fit_shape(
    power: Array,
    given: tuple[Array, Array, Booleans, Array],
    range_: Array,
    edges: tuple[Array, Array],
    limits: Limits,
    out: Any,
) -> None:
    """Fit every profile in its windows, and keep the fit of the chosen window.

    Parameters
    ----------
    power : (profile, bin) float64
    given : ((profile or 1, bin) float64, (profile or 1, bin) float64, (profile or 1, bin) bool, \
(profile or 1,) float64)
        Shapes and variances, of which a bin is left out where they are not positive and finite;
        True for bins that may be used; counts per unit of power, whose variances are 1, or 0.
    range_ : (bin,) float64
        m, ascending.
    edges : ((profile or 1,) float64, (profile or 1,) float64)
        m, start and stop; NaN for a start at a share of the farthest usable range.
    limits : Limits
        With a limit of the waves of every window.
    out : (profile,) `ROW`
        NaN before.
    """
    s = _Scratch(np.empty(range_.size), np.empty((8, BLOCKS)), np.empty(BLOCKS))
    rows = np.empty(limits.waves.size, ROW)
    _fit_profiles(power, given, range_, edges, limits, s, rows, out)
