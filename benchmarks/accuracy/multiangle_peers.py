"""Methods for scans written directly with numpy and scipy, for comparison."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.optimize import lsq_linear

from benchmarks.accuracy.multiangle_cases import Scan, ScanEstimates, ScanSolver
from benchmarks.harness.figure import Array

_STRENGTHS: Final = np.logspace(-6.0, 4.0, 25)
_SPLINE_STRENGTHS: Final = np.geomspace(1e-4, 1e9, 60)
"""In the weights of the data, for altitudes one apart."""
_LEAST_SNR: Final = 3.0
_FEWEST_BEAMS: Final = 3
_FEWEST_KNOTS: Final = 5
_RUN: Final = 9
"""Altitudes of the running mean by which the spline peer selects samples."""
_LEAST_SCATTER: Final = 1e-20
LINES: Final = "straight lines, numpy"
SPLINE: Final = "straight lines, GCV spline"
TIKHONOV: Final = "Tikhonov, L-curve"
BOUNDED: Final = "scipy lsq_linear"


def scan_peers() -> Mapping[str, ScanSolver]:
    """Return methods written directly with numpy and scipy.

    They know the true scatter, and use samples of more than 3 times their noise, the spline those
    of which a running mean is. All but the spline solve each altitude on its own.
    """
    return {LINES: lines, SPLINE: spline, TIKHONOV: tikhonov, BOUNDED: bounded}


SLOW: Final = frozenset({TIKHONOV, BOUNDED})
"""Peers that loop over altitudes."""
_Line = tuple[Array, Array, Array]
"""Slant path, logarithm and weight (the reciprocal standard error) of each beam."""


def lines(scan: Scan) -> ScanEstimates:
    """Fit straight lines to all altitudes at once: Kano-Hamilton in closed form."""
    return _fit_lines(scan, scan.signal)


def _fit_lines(scan: Scan, level: Array) -> ScanEstimates:
    """Fit straight lines to logarithms at a level of the signal, which also selects samples."""
    x = scan.scene.path[:, np.newaxis]
    used = level > _LEAST_SNR * np.sqrt(scan.variance)
    with np.errstate(divide="ignore", invalid="ignore"):
        scatter = scan.variance / level**2 + scan.scene.inhomogeneity**2
        # Without scatter and noise, all beams have the same weight.
        weight = np.where(used, 1.0 / np.maximum(scatter, _LEAST_SCATTER), 0.0)
        positive = np.where(used, level, 1.0)
        y = np.where(used, np.log(positive) + (scan.signal - level) / positive, 0.0)
        total = weight.sum(axis=1, keepdims=True)
        away = x - (weight * x).sum(axis=1, keepdims=True) / total
        information = (weight * away**2).sum(axis=1)
        depth = -0.5 * (weight * away * y).sum(axis=1) / information
        error = 0.5 / np.sqrt(information)
    solvable = used.sum(axis=1) >= _FEWEST_BEAMS
    return ScanEstimates(np.where(solvable, depth, np.nan), np.where(solvable, error, np.nan))


def spline(scan: Scan) -> ScanEstimates:
    """Smooth optical depths by a discrete spline, its strength by generalised cross validation.

    All profiles share one singular value decomposition and one strength, for the altitudes that all
    of them reach and the medians of their errors. A running mean of the signal selects samples, so
    that noise does not: bright samples alone would bias the lines.
    """
    level = uniform_filter1d(scan.signal, _RUN, axis=-1, mode="nearest")
    unsmoothed = _fit_lines(scan, level)
    smooth = np.full(unsmoothed.optical_depth.shape, np.nan)
    known = np.isfinite(unsmoothed.optical_depth).all(axis=0)
    if known.sum() >= _FEWEST_KNOTS:
        error = np.median(np.asarray(unsmoothed.standard_error)[:, known], axis=0)
        smooth[:, known] = _cross_validated(unsmoothed.optical_depth[:, known], error)
    return ScanEstimates(smooth)


def _cross_validated(depth: Array, error: Array) -> Array:
    """Return profiles at even altitudes, smoothed by second differences weighted by the errors."""
    count = error.size
    error = error / error.mean()
    roughness = np.diff(np.eye(count), 2, axis=0) * error
    _, singular, modes = np.linalg.svd(roughness, full_matrices=True)
    penalty = np.append(singular**2, np.zeros(count - singular.size))
    kept = 1.0 / (1.0 + _SPLINE_STRENGTHS[:, np.newaxis] * penalty)
    data = (depth / error) @ modes.T
    misfit = (1.0 - kept) ** 2 @ np.sum(data**2, axis=0)
    best = np.argmin(misfit / (count - kept.sum(axis=1)) ** 2)
    return np.asarray((data * kept[best]) @ modes * error)


def bounded(scan: Scan) -> ScanEstimates:
    """Fit straight lines with the optical depth constrained to be non-negative."""

    def fit(x: Array, y: Array, root: Array) -> float:
        design = np.stack([root, -2.0 * x * root], axis=1)
        least = ([-np.inf, 0.0], [np.inf, np.inf])
        return float(lsq_linear(design, y * root, bounds=least).x[1])

    return _solve_lines(scan, fit)


def tikhonov(scan: Scan, strengths: Array = _STRENGTHS) -> ScanEstimates:
    """Differentiate along the slant path, with the strength at the corner of the L-curve.

    Parameters
    ----------
    scan : Scan
    strengths : (strength,) float
        Ascending; one strength is taken as it is.
    """

    def fit(x: Array, y: Array, root: Array) -> float:
        order = np.argsort(x)
        x, y, root = x[order], y[order], root[order]
        width = np.diff(x) / (x[-1] - x[0])
        matrix = np.where(np.arange(width.size) < np.arange(x.size)[:, np.newaxis], width, 0.0)
        square = root**2 / np.sum(root**2)
        matrix = root[:, np.newaxis] * (matrix - square @ matrix) / np.sqrt(width)
        left, values, right = np.linalg.svd(matrix, full_matrices=False)
        data = left.T @ (root * (y - square @ y))
        kept = values**2 / (values**2 + strengths[:, np.newaxis])
        size = np.sqrt(np.sum((kept * data / values) ** 2, axis=1))
        misfit = np.sqrt(np.sum(((1.0 - kept) * data) ** 2, axis=1))
        slope = right.T @ (kept[_corner(misfit, size)] * data / values)
        return float(-0.5 * np.sum(np.sqrt(width) * slope) / (x[-1] - x[0]))

    return _solve_lines(scan, fit)


def _corner(misfit: Array, size: Array) -> int:
    """Return the index of the largest curvature of the L-curve."""
    if misfit.size == 1:
        return 0
    tiny = np.finfo(np.float64).tiny
    x, y = np.log(np.maximum(misfit, tiny)), np.log(np.maximum(size, tiny))
    dx, dy = np.gradient(x), np.gradient(y)
    speed = np.maximum(np.hypot(dx, dy), tiny)
    bend = (dx * np.gradient(dy) - dy * np.gradient(dx)) / speed**3
    return int(np.argmax(np.where(np.isfinite(bend), bend, -np.inf)))


def _solve_lines(scan: Scan, fit: Callable[[Array, Array, Array], float]) -> ScanEstimates:
    profiles, _, bins = scan.signal.shape
    depth = np.full((profiles, bins), np.nan)
    for t in range(profiles):
        for k in range(bins):
            line = _line(scan, t, k)
            if line[0].size >= _FEWEST_BEAMS:
                depth[t, k] = fit(*line)
    return ScanEstimates(depth)


def _line(scan: Scan, t: int, k: int) -> _Line:
    signal, variance = scan.signal[t, :, k], scan.variance[t, :, k]
    used = signal > _LEAST_SNR * np.sqrt(variance)
    signal, variance = signal[used], variance[used]
    scatter = variance / signal**2 + scan.scene.inhomogeneity**2
    # Without scatter and noise, all beams have the same weight.
    root = 1.0 / np.sqrt(scatter) if np.all(scatter > 0.0) else np.ones(signal.size)
    return scan.scene.path[used], np.log(signal), root
