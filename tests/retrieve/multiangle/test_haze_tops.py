"""Errors of hazes with a sharp top that noise may hide."""

import numpy as np
import pytest

from lidarops.retrieve.multiangle.smooth_profile import smooth_optical_depth


@pytest.mark.parametrize("profiles", [1, 4, 12])
def test_errors_around_the_top_of_a_haze_cover_the_truth(profiles):
    """Noise hides the top in some of the hazes, and a straight line fits best."""
    rng = np.random.default_rng(5)
    altitude = 300.0 + 60.0 * np.arange(36)
    depths, extinctions = [], []
    for _ in range(100):
        haze, top = rng.uniform(2e-4, 1e-3), rng.uniform(1400.0, 2200.0)
        depth = haze * np.minimum(altitude, top) + 5e-5 * altitude
        noise = depth[-1] * np.exp(rng.uniform(np.log(0.02), np.log(0.5)))
        error = noise * np.exp(2.0 * (depth / depth[-1] - 1.0))
        single = depth + error * rng.normal(size=(profiles, altitude.size))
        information = np.broadcast_to(error**-2.0, single.shape)
        result = smooth_optical_depth(single, information, altitude)
        extinction = np.diff(depth, prepend=0.0) / np.diff(altitude, prepend=0.0)
        depths.append((result.optical_depth - depth) / result.optical_depth_standard_error)
        extinctions.append((result.extinction - extinction) / result.extinction_standard_error)
    for scores in (depths, extinctions):
        score = np.abs(np.concatenate(scores))
        assert np.mean(score > 4.0) < 1e-3
        assert 0.93 <= np.mean(score < 1.96) <= 0.99
