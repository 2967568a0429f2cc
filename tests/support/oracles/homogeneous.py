"""Independent reference of the homogeneous path: model, information, slow exact solvers."""

from __future__ import annotations

import mpmath as mp
import numpy as np
from scipy.optimize import least_squares

GEOMETRIES = ((2500.0, 8000.0), (2500.0, 1700.0), (10500.0, 2500.0))
"""First range and length of a section, m."""


def section(start, length, bins=225):
    return np.linspace(start, start + length, bins)


def signal(r, height, extinction):
    """Return the signal whose value at the first bin is `height`, without background."""
    extinction = np.asarray(extinction)[..., np.newaxis]
    return height * (r[0] / r) ** 2 * np.exp(-2 * extinction * (r - r[0]))


def amplitude(r, height, extinction):
    """Return B of ``P = P* + B R^-2 exp(-2 extinction R)`` for `height` at the first bin."""
    return height * r[0] ** 2 * np.exp(2 * extinction * r[0])


def lowest_errors(r, height, extinction, weights=None):
    """Return the Cramer-Rao standard deviations of background, amplitude / B and extinction."""
    shape = signal(r, 1.0, extinction)
    jacobian = np.stack([np.ones_like(r), shape, -2 * height * shape * (r - r[0])], axis=1)
    weights = np.ones_like(r) if weights is None else weights
    covariance = np.linalg.inv(jacobian.T @ (weights[:, np.newaxis] * jacobian))
    # d ln B = d ln(height) + 2 R_0 d(extinction)
    gradient = np.array([0.0, 1.0 / height, 2.0 * r[0]])
    return np.sqrt([covariance[0, 0], gradient @ covariance @ gradient, covariance[2, 2]])


def iterated_fit(r, power, weights, bounds):
    """Fit one profile by trust-region least squares from many starts; return the best.

    Returns
    -------
    background, height at the first bin, extinction
    """
    valid = weights > 0
    r_, p_, root = r[valid], power[valid], np.sqrt(weights[valid])
    length = r[-1] - r[0]

    def linear(extinction):
        design = np.stack([np.ones_like(r_), signal_from(r_, r[0], extinction)], axis=1)
        coefficients, *_ = np.linalg.lstsq(design * root[:, None], p_ * root, rcond=None)
        return coefficients, root * (p_ - design @ coefficients)

    starts = np.arcsinh(np.array(bounds) * length)
    candidates = np.sinh(np.linspace(*starts, 60)) / length
    losses = [np.sum(linear(candidate)[1] ** 2) for candidate in candidates]
    k = int(np.argmin(losses))
    low, high = candidates[max(k - 1, 0)], candidates[min(k + 1, candidates.size - 1)]
    solution = least_squares(
        lambda t: linear(t[0] / length)[1],
        [0.5 * (low + high) * length],
        bounds=([low * length], [high * length]),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    extinction = solution.x[0] / length
    (background, height), _ = linear(extinction)
    return background, height, extinction


def signal_from(r, start, extinction):
    return (start / r) ** 2 * np.exp(-2 * extinction * (r - start))


def quartic_derivative(r, power, lag):
    """Return half the derivative of the quartic of all triples, as exact mpmath coefficients."""
    r, power = [mp.mpf(x) for x in r], [mp.mpf(x) for x in power]
    cubic = square = linear = constant = mp.mpf(0)
    for i in range(len(r) - 2 * lag):
        j, k = i + lag, i + 2 * lag
        u, v = (r[i] * r[k]) ** 2, r[j] ** 4
        a, b = v - u, u * (power[i] + power[k]) - 2 * v * power[j]
        c = v * power[j] ** 2 - u * power[i] * power[k]
        cubic += 2 * a * a
        square += 3 * a * b
        linear += 2 * a * c + b * b
        constant += b * c
    return cubic, square, linear, constant


def real_roots(coefficients):
    """Return the real roots of a polynomial, ascending."""
    a, b, c, d = coefficients
    roots = mp.polyroots([mp.mpf(1), b / a, c / a, d / a], maxsteps=400, extraprec=400)
    size = max(abs(root) for root in roots) + 1
    tiny = mp.mpf(10) ** (-mp.mp.dps // 3)
    return sorted(mp.re(root) for root in roots if abs(mp.im(root)) < tiny * size)


def linear_step(r, power, weights, prior):
    """Return background, amplitude and extinction after one linear step from a prior.

    By the weighted normal equations of potapova2021 and a general routine. The centroid is the
    origin at which shape and slope, cleared of the background, are orthogonal.
    """
    root = np.sqrt(weights)

    def cleared(column):
        return root * (column - np.sum(weights * column) / np.sum(weights))

    shape = signal_from(r, r[0], prior)
    origin = cleared(shape * r) @ cleared(shape) / (cleared(shape) @ cleared(shape))
    length = r[-1] - r[0]
    design = np.stack([np.ones_like(r), shape, shape * (r - origin) / length], axis=1)
    (background, b, g), *_ = np.linalg.lstsq(design * root[:, None], power * root, rcond=None)
    step = -g / length / (2 * b)
    height = b * r[0] ** 2 * np.exp(2 * prior * r[0]) * np.exp(2 * step * origin)
    return background, height, prior + step


def published_background(r, power, extinction):
    """Return the background at a given extinction by equation (4) of potapova2021, as printed."""
    x, n = np.exp(-2 * extinction * r), r.size
    square, first = np.sum(x**2 / r**4), np.sum(x / r**2)
    return (square * np.sum(power) - first * np.sum(power * x / r**2)) / (n * square - first**2)


TABLE_SIGNAL = 17.0
"""Signal at 2.5 km, in units of the noise, with which noise alone explains the published bias."""
TABLE_BIAS = ((1000.0, 10.2), (4000.0, 2.7), (6000.0, 1.4), (8000.0, 0.8))
"""bobrovsky2024, table 1: length of a section from 2.5 km, and the bias of its background in units
of the noise where the background is 370 (the paper does not say)."""


def table_profiles(start, length, count, seed):
    """Return range and profiles like those of the tables of bobrovsky2024; background 370."""
    r = np.arange(start, start + length + 1.0, 15.0)
    extinction = 3e-5
    height = TABLE_SIGNAL * (2500.0 / start) ** 2 * np.exp(-2 * extinction * (start - 2500.0))
    noise = np.random.default_rng(seed).normal(size=(count, r.size))
    return r, 370.0 + signal(r, height, extinction) + noise


def brute_force(r, power, bounds, count=1201):
    """Return the least sum of squares on a dense grid of extinctions, and its extinction.

    Background and amplitude are eliminated at every node; the grid is refined three times about
    the best node.
    """
    length = r[-1] - r[0]
    low, high = np.array(bounds) * length

    def losses(depths):
        shapes = signal_from(r, r[0], depths[:, np.newaxis] / length)
        centred = shapes - shapes.mean(axis=1, keepdims=True)
        norms = np.maximum(np.sum(centred**2, axis=1), 1e-300)
        height = centred @ (power - power.mean()) / norms
        residuals = power - power.mean() - height[:, np.newaxis] * centred
        return np.sum(residuals**2, axis=1)

    depths = np.sinh(np.linspace(np.arcsinh(low / 0.3), np.arcsinh(high / 0.3), count)) * 0.3
    for _ in range(4):
        squares = losses(depths)
        k = int(np.argmin(squares))
        least, best = squares[k], depths[k] / length
        depths = np.linspace(depths[max(k - 1, 0)], depths[min(k + 1, depths.size - 1)], 101)
    return least, best
