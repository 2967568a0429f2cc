"""Compiled tests of whether a profile has the shape of the molecular signal in a window."""

from __future__ import annotations

import math
from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

HUGE: Final = 1e300

# Values that `compare_with_air` writes for each window.
SCALE, SCALE_ERROR, SLOPE, SLOPE_ERROR = 0, 1, 2, 3
CURVATURE, SCATTER, COUNT, EXCLUDED_BINS = 4, 5, 6, 7
FIELDS: Final = 8

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def _usable(power: float, variance: float) -> bool:
    return abs(power) < HUGE and 0.0 < variance < HUGE


@_compiled
def _fit(
    power: Any, variance: Array, shape: Array, range_: Array, excluded: Any, out: Array
) -> None:
    """Fit the molecular shape times polynomials in range that are orthogonal under the noise."""
    middle = 0.5 * (range_[0] + range_[-1])
    half = max(0.5 * (range_[-1] - range_[0]), 1e-9)
    s0 = s1 = s2 = s3 = s4 = y0 = y1 = y2 = 0.0
    count, out[EXCLUDED_BINS] = 0, 0.0
    for i in range(range_.size):
        if excluded[i]:
            out[EXCLUDED_BINS] += 1.0
        if excluded[i] or not _usable(power[i], variance[i]):
            continue
        t = (range_[i] - middle) / half
        f = shape[i]
        w = f * f / variance[i]
        y = f * power[i] / variance[i]
        count += 1
        s0 += w
        s1 += w * t
        s2 += w * t * t
        s3 += w * t**3
        s4 += w * t**4
        y0 += y
        y1 += y * t
        y2 += y * t * t
    out[COUNT] = count
    if not s0 > 0.0:
        return
    # 1, t - a and t^2 - b (t - a) - c are orthogonal.
    scale, a, c = y0 / s0, s1 / s0, s2 / s0
    norm1 = s2 - a * s1
    out[SCALE], out[SCALE_ERROR] = scale, 1.0 / math.sqrt(s0)
    residual = 0.0
    for i in range(range_.size):
        if not excluded[i] and _usable(power[i], variance[i]):
            residual += (power[i] - scale * shape[i]) ** 2 / variance[i]
    out[SCATTER] = residual / max(count - 1, 1)
    if count < 3 or not norm1 > 1e-12 * s0:
        return
    slope = (y1 - a * y0) / norm1
    out[SLOPE], out[SLOPE_ERROR] = slope / scale / half, 1.0 / math.sqrt(norm1) / abs(scale) / half
    b = (s3 - a * s2) / norm1
    norm2 = s4 - c * s2 - b * (s3 - a * s2)
    if norm2 > 1e-12 * s0:
        out[CURVATURE] = (y2 - c * y0 - b * (y1 - a * y0)) / math.sqrt(norm2)


@_compiled
def compare_with_air(
    power: Any,
    variance: Array,
    shape: Array,
    range_: Array,
    excluded: Any,
    edges: npt.NDArray[np.int64],
    out: Array,
) -> None:
    """Compare each profile with the molecular shape in each window.

    Parameters
    ----------
    power : (profile, bin) float32 or float64
    variance, shape : (profile or 1, bin) float64
    range_ : (bin,) float64
        m, ascending.
    excluded : (profile or 1, bin) bool
    edges : (window, 2) int64
        First bin of the window, and first bin beyond it.
    out : (profile, window, `FIELDS`) float64
        Output, NaN before: scale of the shape with its error, slope of the logarithm of the
        ratio to the shape in m-1 with its error, curvature over its error, chi-square over the
        degrees of freedom, number of bins, number of excluded bins.
    """
    for k in range(power.shape[0]):
        noise, air = variance[k % variance.shape[0]], shape[k % shape.shape[0]]
        masked = excluded[k % excluded.shape[0]]
        for j in range(edges.shape[0]):
            first, stop = edges[j, 0], edges[j, 1]
            if stop > first:
                _fit(
                    power[k, first:stop], noise[first:stop], air[first:stop], range_[first:stop],
                    masked[first:stop], out[k, j],
                )  # fmt: skip
