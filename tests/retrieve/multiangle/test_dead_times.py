"""The error of the dead time leaves out bins near the lidar, and changes no more than that."""

from __future__ import annotations

import numpy as np
from support.oracles.multiangle import ANGLES, PATHS, clear, signals
from support.scan_arguments import retrieve_optical_depth


def test_stated_errors_follow_that_of_the_dead_time_without_jumps():
    """Rates that it changes by more than 8 percent are missing; the others are the same.

    The air near the ground, which they show, is more correlated along altitude than that above.
    """
    atmosphere, rng = clear(80), np.random.default_rng(7)
    height, known = atmosphere[0], {"ratio": 1e4, "inhomogeneity": 0.03}
    low, variance, _ = signals(rng, 16, ANGLES, atmosphere, correlation=0.97, **known)
    high, _, _ = signals(rng, 16, ANGLES, atmosphere, correlation=0.82, **known)
    signal = np.where(height < 900.0, low, high)
    load = 0.6 * 300.0 / (PATHS[:, np.newaxis] * height)
    stated = []
    for error in np.arange(0.05, 0.301, 0.01):
        seen = load < 0.08 / (0.08 + error)
        result = retrieve_optical_depth(
            np.where(seen, signal, np.nan), ANGLES, height, variance=variance
        )
        stated.append(np.median(result.extinction_standard_error[:, 30:], axis=0))
    ratio = np.array(stated)[1:] / np.array(stated)[:-1]
    assert np.all((ratio > 0.5) & (ratio < 2.0))
