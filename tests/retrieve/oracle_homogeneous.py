"""Independent oracles of the homogeneous path: the model, its information, slow exact solvers."""

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
    of_logarithm = np.array([0.0, 1.0 / height, 2.0 * r[0]])
    return np.sqrt([covariance[0, 0], of_logarithm @ covariance @ of_logarithm, covariance[2, 2]])


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
    found = least_squares(
        lambda t: linear(t[0] / length)[1],
        [0.5 * (low + high) * length],
        bounds=([low * length], [high * length]),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    extinction = found.x[0] / length
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
    roots = mp.polyroots([d / a, c / a, b / a, mp.mpf(1)], maxsteps=400, extraprec=400, asc=True)
    size = max(abs(root) for root in roots) + 1
    tiny = mp.mpf(10) ** (-mp.mp.dps // 3)
    return sorted(mp.re(root) for root in roots if abs(mp.im(root)) < tiny * size)
