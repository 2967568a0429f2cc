"""The variance of photon counts from the mean profile of a block."""

from __future__ import annotations

import numpy as np
import pytest

from lidarops.retrieve.background.photon_counts import mean_profile_variance
from lidarops.retrieve.background.thresholds import THRESHOLDS

SHOTS = np.array([3.0, 5.0])


def expected_mean(counts, shots):
    """Return the mean profile per shot: each bin averaged over as few neighbours as it needs."""
    mean = np.full(counts.size, np.nan)
    for bin_ in np.flatnonzero(shots > 0):
        for half in range(THRESHOLDS.widest + 1):
            window = slice(max(bin_ - half, 0), bin_ + half + 1)
            held = counts[window].sum()
            mean[bin_] = max(held, 0.5) / shots[window].sum()
            if held >= THRESHOLDS.enough_counts:
                break
    return mean


@pytest.mark.parametrize("missing", [[], [0, 7, 55]])
def test_each_bin_is_averaged_until_it_holds_enough_counts(missing):
    # Enough in one bin, in five, and not even in fifteen.
    level = np.repeat([1000.0, 30.0, 1.0, 0.0], 20)
    power = np.round(level * SHOTS[:, np.newaxis]) / SHOTS[:, np.newaxis]
    power[:, missing] = np.nan
    shots = np.where(np.isfinite(power[0]), SHOTS.sum(), 0.0)
    counts = np.where(shots > 0, (power * SHOTS[:, np.newaxis]).sum(axis=0), 0.0)
    expected = expected_mean(counts, shots) / SHOTS[:, np.newaxis]
    np.testing.assert_allclose(mean_profile_variance(power, SHOTS), expected, rtol=1e-12)
