r"""Compiled inversion of the two-component lidar equation, with its first-order errors.

With the particle lidar ratio :math:`S`, the power :math:`P` and the molecular backscatter and
extinction :math:`\beta_m, \alpha_m`, let :math:`g = R^2 e^{2 E}` with
:math:`E(R) = \int_{R_0}^{R} (\alpha_m - S \beta_m)` and :math:`q = g P`. Then the total
backscatter is :math:`\beta = q / D`, :math:`D(R) = D_c - 2 \int_{R_c}^{R} S q`. Numerator and
denominator are linear in the power, so the first-order errors are exact sums.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Codes, usable
from lidarops.retrieve.common.compiled_code import compiled

# Rows that `_trace_path` writes.
GAIN, RATIO, AIR, SHAPE = 0, 1, 2, 3
DEPTH, DEPTH_RATIO, DEPTH_AIR = 4, 5, 6
GAIN_RATIO, SOURCE_RATIO = 7, 8
GAIN_AIR, SOURCE_AIR, OWN_AIR = 9, 10, 11
COLUMN, COLUMN_AIR, RATIO_ERROR, AIR_ERROR, DISTANCE = 12, 13, 14, 15, 16
PATH_ROWS: Final = 17

# Values that `invert_fernald` writes for each bin, and for each profile.
BACKSCATTER, ATTENUATED, ATTENUATED_ERROR = 0, 1, 2
NOISE, BACKGROUND, REFERENCE, LIDAR_RATIO, MOLECULAR = 3, 4, 5, 6, 7
FIELDS: Final = 8
CONSTANT, CONSTANT_ERROR = 0, 1
DERIVED: Final = (
    "backscatter_standard_error", "extinction", "extinction_standard_error", "scattering_ratio",
    "scattering_ratio_standard_error",
)  # fmt: skip
"""Values that `derive` writes for each bin."""
SCALARS: Final = 2

# Rows of the work array. For the denominator of each bin: its value, its derivative with respect
# to the power of the bin, its variance by the other bins, its changes by the causes, and the
# excess of its square over the least one that its errors allow.
DENOMINATOR, OWN_SHARE, OTHERS, BY_OFFSET, BY_RATIO, BY_AIR, CERTAINTY = 0, 1, 2, 3, 4, 5, 6
WORK_ROWS: Final = 7

# The state of a bin.
MISSING, VALID, UNSTABLE = 0, 1, 2


class Given(NamedTuple):
    """What is given beside the power, (profile or 1, bin), read-only."""

    variance: Array
    window: Booleans
    """Bins of the reference window."""
    range: Array
    """(bin,), m, ascending."""
    air: tuple[Array, Array, Array]
    """Backscatter and extinction of the air, lidar ratio of the particles."""
    scattering_ratio: Array
    """(profile or 1,); in the reference window."""
    errors: tuple[Array, Array]
    """Of the lidar ratio in sr, and of the air, relative."""
    causes: Array
    """(profile or 1, 3): standard error of the background, relative one of the scattering ratio,
    and the integral correlation length of the noise in bins."""


@compiled
def _trace_path(
    range_: Array,
    backscatter: Array,
    extinction: Array,
    lidar_ratio: Array,
    scattering_ratio: float,
    ratio_error: Array,
    air_error: Array,
    path: Array,
) -> None:
    """Integrate the quantities that do not depend on the power, by trapezoids from the first bin.

    Parameters
    ----------
    range_, backscatter, extinction, lidar_ratio : (bin,) float64
        m, m-1 sr-1 and m-1 of the air, sr of the particles.
    scattering_ratio : float
        In the reference window.
    ratio_error, air_error : (bin,) float64
        sr; relative. Each is one error of this shape, common to all bins.
    path : (`PATH_ROWS`, bin) float64
        Output: the rows named at the top of this module.
    """
    e = u = u_ratio = u_air = b_ratio = e_air = 0.0
    column, column_air = extinction[0] * range_[0], extinction[0] * air_error[0] * range_[0]
    for i in range(range_.size):
        if i > 0:
            half = 0.5 * (range_[i] - range_[i - 1])
            s0, s1, m0, m1 = lidar_ratio[i - 1], lidar_ratio[i], backscatter[i - 1], backscatter[i]
            a0, a1, r0, r1 = air_error[i - 1], air_error[i], ratio_error[i - 1], ratio_error[i]
            e += half * (extinction[i - 1] - s0 * m0 + extinction[i] - s1 * m1)
            e_air += half * ((extinction[i - 1] - s0 * m0) * a0 + (extinction[i] - s1 * m1) * a1)
            b_ratio += half * (r0 * m0 + r1 * m1)
            u += half * scattering_ratio * (s0 * m0 + s1 * m1)
            u_ratio += half * scattering_ratio * (r0 * m0 + r1 * m1)
            u_air += half * scattering_ratio * (s0 * m0 * a0 + s1 * m1 * a1)
            column += half * (extinction[i - 1] + extinction[i])
            column_air += half * (extinction[i - 1] * a0 + extinction[i] * a1)
        path[GAIN, i] = range_[i] ** 2 * math.exp(2.0 * e)
        path[RATIO, i] = lidar_ratio[i]
        path[AIR, i] = backscatter[i]
        path[SHAPE, i] = scattering_ratio * backscatter[i] * math.exp(-2.0 * u) / path[GAIN, i]
        path[DEPTH, i], path[DEPTH_RATIO, i], path[DEPTH_AIR, i] = u, u_ratio, u_air
        path[GAIN_RATIO, i] = -2.0 * b_ratio
        path[SOURCE_RATIO, i] = ratio_error[i] - 2.0 * b_ratio * lidar_ratio[i]
        path[GAIN_AIR, i] = 2.0 * e_air
        path[SOURCE_AIR, i] = 2.0 * e_air * lidar_ratio[i]
        path[OWN_AIR, i] = backscatter[i] * air_error[i]
        path[COLUMN, i], path[COLUMN_AIR, i] = column, column_air
        path[RATIO_ERROR, i], path[AIR_ERROR, i] = ratio_error[i], air_error[i]
        path[DISTANCE, i] = range_[i]


@compiled
def _calibrate(power: Array, variance: Array, window: Booleans, path: Array, out: Array) -> int:
    """Calibrate with the summed power of the window over that expected for its scattering ratio.

    Returns
    -------
    int
        The bin in the middle of the window, from which the integrals start; -1 without a
        positive signal. `out` gets the denominator there, the weight of a bin of the window in
        it, its variance, the number of bins, and the relative changes of the expected power with
        the scattering ratio, the lidar ratio and the air density.
    """
    count, signal, shape, noise = 0, 0.0, 0.0, 0.0
    by_scattering_ratio = by_lidar_ratio = by_air = 0.0
    for i in range(path.shape[1]):
        if not (window[i] and usable(power[i], variance[i])):
            continue
        expected = path[SHAPE, i]
        count += 1
        signal += power[i]
        shape += expected
        noise += variance[i]
        by_scattering_ratio += expected * (1.0 - 2.0 * path[DEPTH, i])
        by_lidar_ratio -= expected * (2.0 * path[DEPTH_RATIO, i] + path[GAIN_RATIO, i])
        by_air += expected * (path[AIR_ERROR, i] - 2.0 * path[DEPTH_AIR, i] - path[GAIN_AIR, i])
    if not (shape > 0.0 and signal > 0.0):
        return -1
    passed, centre = 0, -1
    for i in range(path.shape[1]):
        if window[i] and usable(power[i], variance[i]):
            if passed == count // 2:
                centre = i
                break
            passed += 1
    weight = math.exp(-2.0 * path[DEPTH, centre]) / shape
    out[0], out[1], out[2], out[3] = signal * weight, weight, noise * weight * weight, count
    out[4] = by_scattering_ratio / shape + 2.0 * path[DEPTH, centre]
    out[5] = by_lidar_ratio / shape + 2.0 * path[DEPTH_RATIO, centre]
    out[6] = by_air / shape + 2.0 * path[DEPTH_AIR, centre]
    return centre


@compiled
def _integrate(
    power: Array,
    variance: Array,
    window: Booleans,
    path: Array,
    start: int,
    direction: int,
    calibration: Array,
    longest_gap: float,
    work: Array,
    state: Codes,
) -> None:
    """Integrate from the reference bin `start`, away from the lidar (`direction` 1) or towards it.

    Bins that are reached become `VALID`.
    """
    d_start, weight = calibration[0], calibration[1]
    window_variance, count = calibration[2], calibration[3]
    passed_variance = integral = gain_integral = ratio_integral = air_integral = half = 0.0
    twice, last = 2.0 * direction, -1
    last_power = last_gain = last_ratio = last_air = 0.0
    last_distance = last_variance = last_slope = 0.0
    for steps in range(power.size - start if direction > 0 else start + 1):
        i = start + direction * steps
        p, v = power[i], variance[i]
        if not usable(p, v):
            continue
        g, s, distance = path[GAIN, i], path[RATIO, i], path[DISTANCE, i]
        q = g * p
        gain_term, power_term = s * g, s * q
        ratio_term, air_term = q * path[SOURCE_RATIO, i], q * path[SOURCE_AIR, i]
        if last >= 0:
            step = abs(distance - last_distance)
            if abs(i - last) > 1 and step > longest_gap:
                break
            half = 0.5 * step
            share = last_slope - twice * half * last_gain
            passed_variance += last_variance * share * share
            integral += half * (last_power + power_term)
            gain_integral += half * (last_gain + gain_term)
            ratio_integral += half * (last_ratio + ratio_term)
            air_integral += half * (last_air + air_term)
        slope = -twice * half * gain_term
        if window[i]:
            slope += weight
            window_variance -= weight * weight * v
        work[DENOMINATOR, i] = d_start - twice * integral
        work[OWN_SHARE, i], work[OTHERS, i] = slope, passed_variance + max(window_variance, 0.0)
        work[BY_OFFSET, i] = count * weight - twice * gain_integral
        work[BY_RATIO, i] = -d_start * calibration[5] - twice * ratio_integral
        work[BY_AIR, i] = -d_start * calibration[6] - twice * air_integral
        state[i] = VALID
        last, last_distance, last_variance, last_slope = i, distance, v, slope
        last_power, last_gain = power_term, gain_term
        last_ratio, last_air = ratio_term, air_term


@compiled
def _solve_bins(
    power: Array,
    variance: Array,
    path: Array,
    by_reference: float,
    offset: float,
    limits: Array,
    work: Array,
    state: Codes,
    out: Array,
) -> None:
    """Write the backscatter of all bins that are reached, and its error by each cause.

    Denominators are compared with their errors, less the changes that the gain of a bin shares.
    `limits` are the least square of the denominator over its variance, and the ratio of that
    square to the variance by noise below which noise errors are skewed; these are widened.
    """
    for i in range(power.size):
        if state[i] == MISSING:
            continue
        d, share, other_variance = work[DENOMINATOR, i], work[OWN_SHARE, i], work[OTHERS, i]
        by_offset, by_ratio, by_air = work[BY_OFFSET, i], work[BY_RATIO, i], work[BY_AIR, i]
        gain, inverse = path[GAIN, i], 1.0 / d
        total = gain * power[i] * inverse
        out[BACKSCATTER, i] = total - path[AIR, i]
        out[BACKGROUND, i] = offset * (gain - total * by_offset) * inverse
        out[REFERENCE, i] = -total * by_reference * inverse
        # Errors that change the relative gain of a bin and the denominator.
        out[LIDAR_RATIO, i] = total * (path[GAIN_RATIO, i] - by_ratio * inverse)
        out[MOLECULAR, i] = total * (path[GAIN_AIR, i] - by_air * inverse) - path[OWN_AIR, i]
        noise = other_variance + share * share * variance[i]
        noise += offset * offset * by_offset * by_offset
        square = noise + by_reference * by_reference
        ratio_change = by_ratio - d * path[GAIN_RATIO, i]
        air_change = by_air - d * path[GAIN_AIR, i]
        square += ratio_change * ratio_change + air_change * air_change
        work[CERTAINTY, i] = d * d - limits[0] * square
        own_change = gain - total * share
        square = own_change * own_change * variance[i] + total * total * other_variance
        skewed = limits[1] * noise / (d * d)
        widening = max(1.0, 0.98 + skewed * math.sqrt(skewed))
        out[NOISE, i] = math.sqrt(square) * inverse * widening


@compiled
def _mark_unstable(start: int, least: float, work: Array, state: Codes) -> int:
    """Mark uncertain bins, and all farther than one beyond `start`; return the first valid bin."""
    stable_so_far, first = True, -1
    for i in range(state.size):
        if state[i] == MISSING:
            continue
        # NaN, an unknown error of a cause, does not make a bin unstable.
        if work[DENOMINATOR, i] <= least or work[CERTAINTY, i] <= 0.0:
            state[i] = UNSTABLE
            stable_so_far = stable_so_far and i < start
        elif not stable_so_far:
            state[i] = UNSTABLE
        elif first < 0:
            first = i
    return first


@compiled
def _scale(
    i: int,
    variance: Array,
    range_: Array,
    path: Array,
    by_reference: float,
    offset: float,
    work: Array,
    out: Array,
) -> tuple[float, float, float, float]:
    """Return the lidar constant and its relative errors: noise, background, all other causes.

    The particle extinction of bin `i`, the nearest solved one, is assumed down to the lidar.
    """
    d, g, reach = work[DENOMINATOR, i], path[GAIN, i], 2.0 * path[RATIO, i] * range_[i]
    particles = out[BACKSCATTER, i]
    total = particles + path[AIR, i]
    constant = d * range_[i] ** 2 / g * math.exp(reach * particles + 2.0 * path[COLUMN, i])
    # The logarithm changes by that of d plus `reach` times the change of the backscatter.
    damped = 1.0 - reach * total
    own_change = damped * work[OWN_SHARE, i] + reach * g
    noise = math.sqrt(damped * damped * work[OTHERS, i] + own_change * own_change * variance[i]) / d
    background = work[BY_OFFSET, i] * offset / d + reach * out[BACKGROUND, i]
    reference = by_reference / d + reach * out[REFERENCE, i]
    ratio = work[BY_RATIO, i] / d - path[GAIN_RATIO, i] + reach * out[LIDAR_RATIO, i]
    ratio += 2.0 * range_[i] * path[RATIO_ERROR, i] * particles
    air = work[BY_AIR, i] / d - path[GAIN_AIR, i] + reach * out[MOLECULAR, i]
    air += 2.0 * path[COLUMN_AIR, i]
    return constant, noise, background, math.sqrt(reference**2 + ratio**2 + air**2)


@compiled
def _attenuate(
    power: Array,
    variance: Array,
    offset: float,
    range_: Array,
    scale: Any,
    values: Array,
    errors: Array,
) -> None:
    constant, noise, background, other_errors = scale
    inverse, constant_error = 1.0 / constant, noise * noise + other_errors * other_errors
    for i in range(range_.size):
        factor = range_[i] * range_[i] * inverse
        value = factor * power[i]
        common = factor * offset - value * background
        square = factor * factor * variance[i] + value * value * constant_error
        values[i] = value
        errors[i] = math.sqrt(square + common * common)


@compiled
def _withhold(
    power: Array, variance: Array, calibrated: bool, state: Codes, k: int, out: Array
) -> None:
    for i in range(state.size):
        if state[i] == VALID:
            continue
        out[BACKSCATTER, k, i] = np.nan
        for field in (NOISE, BACKGROUND, REFERENCE, LIDAR_RATIO, MOLECULAR):
            out[field, k, i] = np.nan
        if not (calibrated and usable(power[i], variance[i])):
            out[ATTENUATED, k, i] = out[ATTENUATED_ERROR, k, i] = np.nan


@compiled
def invert_fernald(
    power: Array, given: Given, limits: Array, out: Array, scalars: Array, state: Codes
) -> None:
    """Invert profiles one by one.

    Parameters
    ----------
    power : (profile, bin) float64
        Background subtracted.
    given : Given
    limits : (4,) float64
        Longest gap that is integrated over, m; least share of the denominator at the reference;
        least square of the denominator over its variance; that over the variance by noise below
        which errors are skewed.
    out : (`FIELDS`, profile, bin) float64
        Output: the fields named at the top of this module, NaN where there is no value.
    scalars : (profile, `SCALARS`) float64
        Output: the lidar constant and its standard error, NaN where there is no value.
    state : (profile, bin) uint8
        Output: the state of each bin.
    """
    variance, window, range_, air, scattering_ratio, errors, causes = given
    varied = max(
        air[0].shape[0], air[1].shape[0], air[2].shape[0], scattering_ratio.size,
        errors[0].shape[0], errors[1].shape[0],
    )  # fmt: skip
    path = np.empty((PATH_ROWS, range_.size))
    work, calibration = np.zeros((WORK_ROWS, range_.size)), np.empty(7)
    for k in range(power.shape[0]):
        if k == 0 or varied > 1:
            _trace_path(
                range_,
                air[0][k % air[0].shape[0]],
                air[1][k % air[1].shape[0]],
                air[2][k % air[2].shape[0]],
                scattering_ratio[k % scattering_ratio.size],
                errors[0][k % errors[0].shape[0]],
                errors[1][k % errors[1].shape[0]],
                path,
            )
        noise, in_window = variance[k % variance.shape[0]], window[k % window.shape[0]]
        cause = causes[k % causes.shape[0]]
        scalars[k], state[k] = np.nan, MISSING
        start = _calibrate(power[k], noise, in_window, path, calibration)
        nearest = -1
        if start >= 0:
            for direction in (1, -1):
                _integrate(
                    power[k], noise, in_window, path, start, direction, calibration, limits[0],
                    work, state[k],
                )  # fmt: skip
            # Means and integrals over many bins.
            work[OTHERS] *= cause[2]
            by_reference = -calibration[0] * cause[1] * calibration[4]
            _solve_bins(
                power[k], noise, path, by_reference, cause[0], limits[2:], work, state[k],
                out[:, k],
            )  # fmt: skip
            nearest = _mark_unstable(start, limits[1] * calibration[0], work, state[k])
        if nearest >= 0:
            scale = _scale(nearest, noise, range_, path, by_reference, cause[0], work, out[:, k])
            _attenuate(
                power[k], noise, cause[0], range_, scale, out[ATTENUATED, k],
                out[ATTENUATED_ERROR, k],
            )  # fmt: skip
            scalars[k, CONSTANT] = scale[0]
            relative = scale[1] ** 2 + scale[2] ** 2 + scale[3] ** 2
            scalars[k, CONSTANT_ERROR] = scale[0] * math.sqrt(relative)
        _withhold(power[k], noise, nearest >= 0, state[k], k, out)


@compiled
def derive(given: Given, out: Array, dead_time: Array, baseline: Array, derived: Array) -> None:
    """Write (`DERIVED`, profile, bin) values from those of `invert_fernald`.

    Dead time and baseline stand for (profile or 1, bin) errors of the backscatter by them.
    """
    (airs, _, ratios), (ratio_errors, air_errors) = given.air, given.errors
    for k in range(out.shape[1]):
        air, ratio = airs[k % len(airs)], ratios[k % len(ratios)]
        own_ratio, own_air = ratio_errors[k % len(ratio_errors)], air_errors[k % len(air_errors)]
        by_dead_time, by_baseline = dead_time[k % len(dead_time)], baseline[k % len(baseline)]
        for i in range(out.shape[2]):
            value = out[BACKSCATTER, k, i]
            by_ratio, by_air = out[LIDAR_RATIO, k, i], out[MOLECULAR, k, i]
            others = out[NOISE, k, i] ** 2 + out[BACKGROUND, k, i] ** 2
            others += out[REFERENCE, k, i] ** 2 + by_dead_time[i] ** 2 + by_baseline[i] ** 2
            inverse = 1.0 / air[i] if air[i] > 0.0 else math.nan
            derived[0, k, i] = math.sqrt(others + by_ratio**2 + by_air**2)
            derived[1, k, i] = ratio[i] * value
            own = ratio[i] * by_ratio + own_ratio[i] * value
            derived[2, k, i] = math.sqrt(ratio[i] * ratio[i] * (others + by_air**2) + own**2)
            derived[3, k, i] = 1.0 + inverse * value
            own = by_air - own_air[i] * value
            derived[4, k, i] = inverse * math.sqrt(others + by_ratio**2 + own**2)
