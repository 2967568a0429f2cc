"""Compiled cubic of the background, free of cancellation, one profile at a time.

Three bins at equal distance, ``r0 < r1 < r2``, of a homogeneous path obey
``(P0 - x) r0^2 (P2 - x) r2^2 = (P1 - x)^2 r1^4`` at the background x. The sum over all triples of
the squared differences is a quartic in x; its derivative is the cubic of `bobrovsky2024`. Here it
has the outer square and the coefficient that the paper misprints, and an arbitrary lag. The
expectation of the noise is subtracted from the coefficients, and no large numbers cancel.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.common.compiled_code import compiled

HUGE: Final = 1e150
"""Larger powers count as not finite: the quartic needs their fourth power."""


# Status of a profile.
SOLVED: Final = 0
MISSING: Final = 1
CONSTANT: Final = 2
UNSOLVED: Final = 3

STATUS, BACKGROUND, VARIANCE, CONTRAST, CURVATURE_SHIFT = range(5)
COLUMNS: Final = 5
"""Status; background; its variance; curvature of the quartic over the contribution of the noise;
shift of the background, in standard errors, by signal curvature mistaken for noise."""


class Triples(NamedTuple):
    """Coefficients of every triple of bins, ranges over the last range."""

    lag: int
    u: Array
    """``(r0 r2)^2``."""
    v: Array
    """``r1^4``."""
    a: Array
    """``v - u``, without cancellation."""


class _Coefficients(NamedTuple):
    """Coefficients of half the derivative of the quartic."""

    cubic: float
    square: float
    linear: float
    constant: float
    noise: float
    """Noise subtracted from the linear coefficient."""
    moved: float
    """Noise in the constant coefficient."""


def make_triples(range_: Array, lag: int) -> Triples:
    """Tabulate the triples of an ascending range grid."""
    r = range_ / range_[-1]
    r0, r1, r2 = r[: -2 * lag], r[lag:-lag], r[2 * lag :]
    before, after = r1 - r0, r2 - r1
    a = (before * after + r1 * (before - after)) * (r1 * r1 + r0 * r2)
    return Triples(lag, (r0 * r2) ** 2, r1**4, a)


@compiled
def _coefficients(p: Array, v: Array, t: Triples) -> _Coefficients:
    """Sum the coefficients over the triples, less the expectation of their noise."""
    s3 = s2 = s1 = s0 = noise = moved = 0.0
    for i in range(t.a.size):
        p0, p1, p2 = p[i], p[i + t.lag], p[i + 2 * t.lag]
        v0, v1, v2 = v[i], v[i + t.lag], v[i + 2 * t.lag]
        a, u, w = t.a[i], t.u[i], t.v[i]
        b = u * (p0 - 2.0 * p1 + p2) - 2.0 * a * p1
        c = a * p1 * p1 - u * (p0 * p2 - p1 * p1)
        s3 += a * a
        s2 += a * b
        s1 += 2.0 * a * c + b * b
        noise += 2.0 * a * w * v1 + u * u * (v0 + v2) + 4.0 * w * w * v1
        s0 += b * c
        s0 -= u * w * v1 * (p0 + p2) - u * u * (v0 * p2 + v2 * p0)
        s0 += w * w * v1 * (6.0 * p1)
        moved += 6.0 * w * w * v1 * p1 - u * w * v1 * (p0 + p2) + u * u * (v0 * p2 + v2 * p0)
    return _Coefficients(2.0 * s3, 3.0 * s2, s1 - noise, s0, noise, moved)


@compiled
def largest_root(a: float, b: float, c: float) -> float:
    """Return the largest real root of ``x^3 + a x^2 + b x + c``."""
    p = b - a * a / 3.0
    q = 2.0 * (a / 3.0) ** 3 - a * b / 3.0 + c
    discriminant = (p / 3.0) ** 3 + (0.5 * q) ** 2
    # Within rounding, a double root is real: as a single one it would be lost.
    if discriminant <= 1e-13 * q * q and p < 0.0:
        radius = 2.0 * math.sqrt(-p / 3.0)
        product = p * radius
        cosine = min(max(3.0 * q / product, -1.0), 1.0) if product != 0.0 else 1.0
        return radius * math.cos(math.acos(cosine) / 3.0) - a / 3.0
    # The summand without cancellation; the other follows from their product -p / 3.
    cube = 0.5 * abs(q) + math.sqrt(max(discriminant, 0.0))
    big = -math.copysign(cube ** (1.0 / 3.0), q)
    small = -p / (3.0 * big) if big != 0.0 else 0.0
    return big + small - a / 3.0


@compiled
def _bends(p: Array, relative: Array) -> tuple[float, float, float]:
    """Return the sums of squared fourth differences, of their neighbours' products, and the norm.

    The sum over the norm is the variance of unit relative variance.
    """
    total = product = before = norm = 0.0
    for i in range(p.size - 4):
        bend = p[i] - 4.0 * p[i + 1] + 6.0 * p[i + 2] - 4.0 * p[i + 3] + p[i + 4]
        total += bend * bend
        product += bend * before
        before = bend
        norm += relative[i] + relative[i + 4] + 36.0 * relative[i + 2]
        norm += 16.0 * (relative[i + 1] + relative[i + 3])
    return total, product, norm


@compiled
def _noise_and_curvature(p: Array, relative: Array) -> tuple[float, float]:
    """Return the variance of unit relative variance, and the share of it that is signal.

    Neighbouring fourth differences have a correlation of -56 / 70 where they are noise, and of 1
    where they are curvature of the signal.
    """
    total, product, norm = _bends(p, relative)
    share = (product + 0.8 * total) / (1.8 * total)
    return total / norm, share if share > 0.0 else 0.0


@compiled
def _gradient(p: Array, v: Array, t: Triples, out: Array) -> None:
    """Fill the derivatives of the constant coefficient with respect to the power of each bin."""
    for i in range(out.size):
        out[i] = 0.0
    for i in range(t.a.size):
        j, k = i + t.lag, i + 2 * t.lag
        a, u, w = t.a[i], t.u[i], t.v[i]
        b = u * (p[i] - 2.0 * p[j] + p[k]) - 2.0 * a * p[j]
        c = a * p[j] * p[j] - u * (p[i] * p[k] - p[j] * p[j])
        noise = u * w * v[j]
        out[i] += u * (c - b * p[k]) - noise + u * u * v[k]
        out[k] += u * (c - b * p[i]) - noise + u * u * v[i]
        out[j] += 2.0 * w * (b * p[j] - c) + 6.0 * w * w * v[j]


@compiled
def _coarse(value: float, step: float) -> float:
    """Round to a multiple of `step`, a power of two, so that subtracting it is exact."""
    return math.floor(value / step + 0.5) * step


@compiled
def _solve_profile(
    p: Array, v: Array, t: Triples, curved: float, gradient: Array, row: Array
) -> None:
    """Solve one loaded profile: the root about a rough centre, then one Newton step about it."""
    if np.all(p == p[0]):
        row[STATUS], row[BACKGROUND] = CONSTANT, p[0]
        return
    centre = float(np.mean(p[p.size // 2 :]))
    largest = float(np.max(np.abs(p - centre)))
    scale = math.ldexp(1.0, math.frexp(largest)[1])
    centre = _coarse(centre, scale * 2.0**-20)
    for i in range(p.size):
        p[i] = (p[i] - centre) / scale
        v[i] /= scale * scale
    s = _coefficients(p, v, t)
    x = largest_root(s.square / s.cubic, s.linear / s.cubic, s.constant / s.cubic)
    x = _coarse(x, 2.0**-26)
    for i in range(p.size):
        p[i] -= x
    s = _coefficients(p, v, t)
    row[BACKGROUND] = centre + scale * (x - s.constant / s.linear)
    row[STATUS] = SOLVED if s.linear > 0.0 and math.isfinite(row[BACKGROUND]) else UNSOLVED
    row[CONTRAST] = s.linear / s.noise
    _gradient(p, v, t, gradient)
    variance = 0.0
    for i in range(p.size):
        gradient[i] /= -s.linear
        variance += gradient[i] * gradient[i] * v[i]
    row[VARIANCE] = variance * scale * scale
    row[CURVATURE_SHIFT] = curved * abs(s.moved / s.linear) / math.sqrt(variance)


@compiled
def _all_alike(variance: Array) -> bool:
    """Return whether all variances are positive, or all 0; a 0 among others is not usable."""
    return bool(np.all(variance > 0.0) or np.all(variance == 0.0))


@compiled
def solve_cubic_profiles(
    power: Array,
    variance: Array,
    known_variance: bool,
    t: Triples,
    gradients: Array,
    out: Array,
) -> None:
    """Solve every profile of a batch.

    Parameters
    ----------
    power : (profile, bin) float64
    variance : (profile or 1, bin) float64
        Absolute, or relative where it is not known.
    known_variance : bool
    t : Triples
        Of `make_triples`.
    gradients : (profile or 1, bin) float64
        Receives the derivatives of the backgrounds with respect to the power; one row where
        they are not needed.
    out : (profile, column) float64
        Filled with NaN.
    """
    for k in range(power.shape[0]):
        p, relative = power[k].copy(), variance[k % variance.shape[0]]
        level, curved = (1.0, 0.0) if known_variance else _noise_and_curvature(p, relative)
        if not math.isfinite(level):
            level = 0.0
        v = level * relative
        usable = np.all(np.abs(p) < HUGE) and np.all(np.isfinite(v))
        if not (usable and _all_alike(relative)):
            out[k, STATUS] = MISSING
            continue
        _solve_profile(p, v, t, curved, gradients[k % gradients.shape[0]], out[k])
        # Without a noise level there is no standard error: 0 / 0 gives NaN.
        out[k, VARIANCE] *= level / level
