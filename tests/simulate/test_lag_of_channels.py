"""Two recorders of one detector with a lag record the same photoelectrons."""

from __future__ import annotations

import numpy as np
import pytest

from lidarops.raw.archive import open_archive
from lidarops.simulate.campaign import simulate_campaign

BIN = 7.5


def lag_of(analog, photon, lags=range(-4, 12)):
    """Return the lag, in bins, at which the noise of two channels correlates most."""
    window = np.arange(120, 520)
    noise = [channel - channel.mean(axis=0) for channel in (analog, photon)]
    correlation = []
    for lag in lags:
        first, second = noise[0][:, window + lag], noise[1][:, window]
        correlation.append((first * second).sum() / np.sqrt((first**2).sum() * (second**2).sum()))
    correlation = np.array(correlation)
    best = int(correlation.argmax())
    before, highest, after = correlation[best - 1 : best + 2]
    shift = 0.5 * (before - after) / (before - 2.0 * highest + after)
    return lags[best] + shift, highest


@pytest.mark.parametrize("lag", [0, 3, 7])
def test_lag_shows_in_the_noise(small, lag):
    def late(tree):
        del tree["simulation"]["instruments"]["hill-lidar"]
        tree["simulation"]["instruments"]["coast-lidar"]["acquisition"]["dark_files"] = 0
        tree["simulation"]["duration"] = 3600
        del tree["instruments"]["coast-lidar"]["dark_files"]
        for facts in tree["instruments"]["coast-lidar"]["facts"]:
            facts["channels"]["photon_532o"]["range_offset"] = 0.0
            # A recorder that starts before the laser shows the signal in later bins.
            facts["channels"]["analog_532o"] = {"range_offset": -lag * BIN}

    result = simulate_campaign(small(late, archive=f"lag{lag}"))
    archive = open_archive([str(result.archive / path) for path in result.paths])
    estimate, correlation = lag_of(
        archive["analog_532o"].to_numpy().astype(float),
        archive["photon_532o"].to_numpy().astype(float),
    )
    assert estimate == pytest.approx(lag, abs=0.2)
    assert correlation > 0.2
