"""Compiled weighted least squares of a constant and a known shape, one profile at a time.

Sums are centred on weighted means, so that a background 1e8 times the signal costs no digits
of the signal. All sums of a profile run over its bins from near to far.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import HUGE, Array, Indices
from lidarops.retrieve.common.compiled_code import compiled, inlined, summing

GROUPS: Final = 16
"""Groups of neighbouring bins whose mean residuals are tested."""
FEWEST_GROUPS: Final = 4
SINGULAR: Final = 1e-14
"""Squared contrast of the shape, relative to its mean, below which only rounding is left."""

BACKGROUND: Final = 0
AMPLITUDE: Final = 1
BACKGROUND_VARIANCE: Final = 2
AMPLITUDE_VARIANCE: Final = 3
CHI2: Final = 4
BINS: Final = 5
CONDITION: Final = 6
CURVATURE: Final = 7
WAVES: Final = 8
WINDOW: Final = 9
CONSTANT: Final = 10
COLUMNS: Final = 11


class ShapeNoise(NamedTuple):
    """Noise from which the weights follow."""

    variance: Array
    """(profile or 1, bin), in the square of the power's unit; not used for counts."""
    exposure: Array
    """(profile or 1,), counts per unit of power; NaN where the noise is not Poisson noise."""


class Limits(NamedTuple):
    """Limits of the two tests for a window free of aerosol, and the odds that it has some."""

    waves: float
    """Limit of the chi-square of the mean residuals of `GROUPS` groups (it uses 2 degrees of
    freedom)."""
    deviation: float
    """Limit of the curvature and of the differences of backgrounds, in standard errors."""
    aerosol: float
    """Odds that the next shorter window is the first one without aerosol."""


@summing
def _sums(values: Array, phi: Array, weights: Array) -> Any:
    """Return total weight, weighted means of shape and power, and their centred sums."""
    total = shape = power = 0.0
    for i in range(weights.size):
        total += weights[i]
        shape += weights[i] * phi[i]
        power += weights[i] * values[i]
    shape /= total
    power /= total
    square = product = 0.0
    for i in range(weights.size):
        lever = weights[i] * (phi[i] - shape)
        square += lever * (phi[i] - shape)
        product += lever * (values[i] - power)
    return total, shape, power, square, product


@summing
def _bend(phi: Array, lever: Array, weights: Array, shape: float) -> Any:
    """Return the weighted sum of shape times distance, and its product with the centred shape."""
    bend = cross = 0.0
    for i in range(weights.size):
        tilted = weights[i] * phi[i] * lever[i]
        bend += tilted
        cross += tilted * (phi[i] - shape)
    return bend, cross


@summing
def _group(residuals: Array, phi: Array, lever: Array, weights: Array, tilt: Any) -> Any:
    """Return chi-square, weight and sum of residuals; norm and score of the curvature."""
    bend, slope, shape = tilt
    chi2 = weight = total = norm = score = 0.0
    for i in range(weights.size):
        curved = phi[i] * lever[i] - bend - slope * (phi[i] - shape)
        weighted = weights[i] * residuals[i]
        chi2 += weighted * residuals[i]
        weight += weights[i]
        total += weighted
        norm += weights[i] * curved * curved
        score += weighted * curved
    return chi2, weight, total, norm, score


@summing
def _fill_counts(
    weights: Array,
    phi: Array,
    usable: Array,
    exposure: float,
    background: float,
    amplitude: float,
) -> None:
    for i in range(weights.size):
        weights[i] = usable[i] * exposure / (background + amplitude * phi[i])


@inlined
def _weigh_counts(
    values: Array,
    phi: Array,
    usable: Array,
    exposure: float,
    bins: float,
    weights: Array,
) -> None:
    """Fill the weights of counts by the variance of the fitted model, in two passes."""
    weights[:] = usable
    for _ in range(2):
        _, shape, power, square, product = _sums(values, phi, weights)
        amplitude = max(product / square, 0.0) if square > 0.0 else 0.0
        background = power - amplitude * shape
        # A zero background is known to its standard error only, and to one count at best.
        level = max(power, 0.0) / (bins * exposure)
        least = math.sqrt(level) + 1.0 / (bins * exposure)
        _fill_counts(weights, phi, usable, exposure, max(background, least), amplitude)


@inlined
def _test_residuals(
    residuals: Array, phi: Array, lever: Array, weights: Array, sums: Any, row: Array
) -> None:
    """Fill the chi-square of all residuals and of their group means, and the curvature."""
    total, shape, square = sums
    bend, cross = _bend(phi, lever, weights, shape)
    tilt = (bend / total, cross / square, shape)
    chi2 = norm = score = waves = 0.0
    groups = edge = 0
    for group in range(GROUPS):
        until = (group + 1) * weights.size // GROUPS
        bins = slice(edge, until)
        group_chi2, weight, total_residual, group_norm, group_score = _group(
            residuals[bins], phi[bins], lever[bins], weights[bins], tilt
        )
        chi2 += group_chi2
        norm += group_norm
        score += group_score
        if weight > 0.0:
            groups += 1
            waves += total_residual * total_residual / weight
        edge = until
    row[CHI2] = chi2
    # The tilted shape may be a mere combination of the shape and a constant.
    least = SINGULAR * square * lever[-1] ** 2
    row[CURVATURE] = score / math.sqrt(norm) if norm > least else 0.0
    row[WAVES] = waves if groups >= FEWEST_GROUPS else 0.0


@summing
def _subtract(values: Array, phi: Array, row: Array, residuals: Array) -> None:
    background, amplitude = row[BACKGROUND], row[AMPLITUDE]
    for i in range(residuals.size):
        residuals[i] = values[i] - background - amplitude * phi[i]


@summing
def _count(usable: Array) -> int:
    bins = 0
    for i in range(usable.size):
        bins += 1 if usable[i] > 0.0 else 0
    return bins


@compiled
def _is_constant(values: Array, usable: Array) -> bool:
    first = -1
    for i in range(values.size):
        if usable[i] == 0.0:
            continue
        if first < 0:
            first = i
        elif values[i] != values[first]:
            return False
    return True


@inlined
def _fit(
    values: Array,
    phi: Array,
    lever: Array,
    usable: Array,
    exposure: float,
    weights: Array,
    residuals: Array,
    row: Array,
) -> None:
    """Fit one window of one profile; `usable` is 0 or the weight of the bin."""
    row[:] = np.nan
    bins = _count(usable)
    row[BINS] = bins
    row[CONSTANT] = _is_constant(values, usable)
    if bins == 0:
        return
    if exposure > 0.0:
        _weigh_counts(values, phi, usable, exposure, float(bins), weights)
    else:
        weights[:] = usable
    total, shape, power, square, product = _sums(values, phi, weights)
    if not square > SINGULAR * total * shape * shape:
        row[CONDITION] = np.inf
        return
    row[AMPLITUDE] = product / square
    row[BACKGROUND] = power - row[AMPLITUDE] * shape
    row[AMPLITUDE_VARIANCE] = 1.0 / square
    row[BACKGROUND_VARIANCE] = 1.0 / total + shape * shape / square
    row[CONDITION] = math.sqrt(row[BACKGROUND_VARIANCE] * total)
    _subtract(values, phi, row, residuals)
    sums = (total, shape, square)
    _test_residuals(residuals, phi, lever, weights, sums, row)


@compiled
def _passes(row: Array, limits: Limits) -> bool:
    return bool(abs(row[CURVATURE]) <= limits.deviation and row[WAVES] <= limits.waves)


@compiled
def _choose(rows: Array, limits: Limits) -> int:
    """Return the longest window that passes and agrees with all shorter ones, else the shortest."""
    shortest = rows.shape[0] - 1
    for k in range(shortest):
        if not (rows[k, BINS] > 0 and _passes(rows[k], limits)):
            continue
        agrees = True
        for j in range(k + 1, rows.shape[0]):
            # The variance of a difference of nested fits is the difference of their variances.
            gap = rows[j, BACKGROUND_VARIANCE] - rows[k, BACKGROUND_VARIANCE]
            step = rows[j, BACKGROUND] - rows[k, BACKGROUND]
            if step * step > limits.deviation**2 * gap:
                agrees = False
        if agrees:
            return int(k)
    return int(shortest)


@inlined
def _relative_odds(rows: Array, chosen: int, limits: Limits, odds: Array) -> None:
    """Fill how likely it is that the far range is clean from each window on, relative to others.

    Steps of the background between neighbouring windows are independent. Those beyond the first
    clean window are noise; each one before it has the odds of aerosol instead.
    """
    odds[:] = 0.0
    misfit = 0.0
    shorter = -1
    for k in range(rows.shape[0] - 1, -1, -1):
        if not math.isfinite(rows[k, BACKGROUND]):
            continue
        gap = rows[shorter, BACKGROUND_VARIANCE] - rows[k, BACKGROUND_VARIANCE]
        if shorter >= 0 and gap > 0.0:
            step = rows[shorter, BACKGROUND] - rows[k, BACKGROUND]
            misfit += step * step / gap
        shorter = k
        if k == chosen or _passes(rows[k], limits):
            odds[k] = limits.aerosol**k * math.exp(-0.5 * misfit)


@compiled
def _include_choice(rows: Array, chosen: int, limits: Limits, odds: Array, row: Array) -> None:
    """Fill the fit of the chosen window; the variance of its background includes the choice.

    It is the mean square about the chosen background, over all windows from which on the far
    range may be clean.
    """
    row[:] = rows[chosen]
    _relative_odds(rows, chosen, limits, odds)
    total = square = 0.0
    for k in range(rows.shape[0]):
        if odds[k] > 0.0:
            step = rows[k, BACKGROUND] - row[BACKGROUND]
            total += odds[k]
            square += odds[k] * (rows[k, BACKGROUND_VARIANCE] + step * step)
    if total > 0.0:
        row[BACKGROUND_VARIANCE] = square / total


@summing
def _prepare(
    power: Array,
    shape: Array,
    mask: Array,
    variance: Array,
    usable: Array,
    values: Array,
    scaled: Array,
) -> float:
    """Copy usable bins, with the shape divided by its mean; return that mean."""
    total = count = 0.0
    for i in range(values.size):
        weight = 1.0 / variance[i]
        value = power[i]
        good = (abs(value) < HUGE) & (shape[i] > 0.0) & (shape[i] < HUGE)
        good &= (weight > 0.0) & (weight < HUGE) & (mask[i] > 0.0)
        usable[i] = weight if good else 0.0
        values[i] = value if good else 0.0
        scaled[i] = shape[i] if good else 0.0
        total += scaled[i]
        count += 1.0 if good else 0.0
    unit = total / count if total > 0.0 else 1.0
    for i in range(values.size):
        scaled[i] /= unit
    return unit


@compiled
def _tilt(range_: Array, lever: Array) -> None:
    for i in range(range_.size):
        lever[i] = range_[i] - range_[0]


@compiled
def fill_pasts(power: Array, mask: Array, pasts: Indices) -> None:
    """Lower the end of each window to the bin past its last usable bin.

    Parameters
    ----------
    power : (profile, bin) float64
    mask : (profile or 1, bin) float64
    pasts : (profile,) int
    """
    for k in range(pasts.size):
        allowed = mask[k % mask.shape[0]]
        past = pasts[k]
        while past > 0 and not (abs(power[k, past - 1]) < HUGE and allowed[past - 1] > 0.0):
            past -= 1
        pasts[k] = past


@compiled
def fit_shape(
    power: Array,
    shape: Array,
    range_: Array,
    mask: Array,
    noise: ShapeNoise,
    firsts: Indices,
    pasts: Indices,
    limits: Limits,
    out: Array,
) -> None:
    """Fit every profile in its windows, and keep the fit of the chosen window.

    Parameters
    ----------
    power : (profile, bin) float64
    shape, mask : (profile or 1, bin) float64
        Bins are skipped where the mask is 0.
    range_ : (bin,) float64
        m, ascending.
    noise : ShapeNoise
    firsts : (profile or 1, window) int
        First bins of nested windows, the longest first.
    pasts : (profile or 1,) int
        First bins past the windows.
    limits : Limits
    out : (profile, COLUMNS) float64
    """
    count, bins = power.shape
    windows = firsts.shape[1]
    usable, values, scaled = np.empty(bins), np.empty(bins), np.empty(bins)
    weights, residuals, lever = np.empty(bins), np.empty(bins), np.empty(bins)
    rows, odds = np.empty((windows, COLUMNS)), np.empty(windows)
    for k in range(count):
        exposure = noise.exposure[k % noise.exposure.shape[0]]
        first_bins = firsts[k % firsts.shape[0]]
        past = pasts[k % pasts.shape[0]]
        full = slice(first_bins[0], max(past, first_bins[0]))
        unit = _prepare(
            power[k][full],
            shape[k % shape.shape[0]][full],
            mask[k % mask.shape[0]][full],
            noise.variance[k % noise.variance.shape[0]][full],
            usable[full],
            values[full],
            scaled[full],
        )
        for j in range(windows):
            window = slice(first_bins[j], max(past, first_bins[j]))
            _tilt(range_[window], lever[window])
            _fit(
                values[window],
                scaled[window],
                lever[window],
                usable[window],
                exposure,
                weights[window],
                residuals[window],
                rows[j],
            )
            rows[j, WINDOW] = j
        chosen = _choose(rows, limits) if windows > 1 else 0
        _include_choice(rows, chosen, limits, odds, out[k])
        out[k, AMPLITUDE] /= unit
        out[k, AMPLITUDE_VARIANCE] /= unit * unit
