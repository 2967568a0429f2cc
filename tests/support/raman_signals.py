"""Raman and elastic signals of a known atmosphere: those of the stability benchmark."""

from __future__ import annotations

import numpy as np

from benchmarks.scenes.raman_skies import LASER, RAMAN, along, make_sky, mean_over

__all__ = ["LASER", "RAMAN", "along", "make_sky", "mean_over", "sliding_line"]


def sliding_line(signal, variance, step, ratio, cells):
    """Return extinction and standard error by lines through the logarithm of `cells` cells.

    The classical method (`ansmann1990`, `pappalardo2004`); NaN within half a window of the ends.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(signal > 0.0, -np.log(signal), np.nan)
        weight = signal**2 / variance
    z = step * (np.arange(cells) - cells // 2)
    value, error = np.full((2, signal.size), np.nan)
    for middle in range(cells // 2, signal.size - cells // 2):
        window = slice(middle - cells // 2, middle + cells // 2 + 1)
        w, y = weight[window], depth[window]
        away = z - (w * z).sum() / w.sum()
        spread = (w * away**2).sum()
        value[middle] = (w * away * y).sum() / spread
        error[middle] = np.sqrt(1.0 / spread)
    return value / (1.0 + ratio), error / (1.0 + ratio)
