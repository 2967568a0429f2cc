"""Bins are withheld where their error is not of first order, and only there."""

from __future__ import annotations

import numpy as np
import pytest
from support.inversions import invert_elastic

from lidarops.retrieve.air.molecular import MolecularProfile

AIR = MolecularProfile.us_standard()
RANGE = 7.5 * (np.arange(1400) + 0.5)[20:]


@pytest.mark.parametrize("wavelength", [355e-9, 532e-9])
@pytest.mark.parametrize("ratio_error", [0.0, 10.0, 25.0])
def test_an_uncertain_lidar_ratio_does_not_withhold_clean_air(wavelength, ratio_error):
    # Clean air does not depend on the lidar ratio of particles, wherever the reference is.
    backscatter, extinction = AIR.backscatter(RANGE, wavelength), AIR.extinction(RANGE, wavelength)
    depth = np.cumsum(extinction) * 7.5
    power = 1e12 * backscatter * np.exp(-2.0 * depth) / RANGE**2
    result = invert_elastic(
        power,
        RANGE,
        molecular_backscatter=backscatter,
        molecular_extinction=extinction,
        lidar_ratio=50.0,
        lidar_ratio_standard_error=ratio_error,
        molecular_relative_error=0.01,
        reference=(7e3, 8e3),
        reference_relative_error=0.02,
        variance=(0.01 * power) ** 2,
    )
    near = RANGE < 8e3
    assert result.valid[near].all()
    assert np.abs(result.budget["lidar_ratio"][near] / backscatter[near]).max() < 0.01


def test_bins_beyond_a_thick_layer_of_uncertain_lidar_ratio_are_withheld():
    backscatter, extinction = AIR.backscatter(RANGE, 532e-9), AIR.extinction(RANGE, 532e-9)
    layer = np.where((RANGE > 4e3) & (RANGE < 5e3), 2e-5, 0.0)
    depth = np.cumsum(extinction + 50.0 * layer) * 7.5
    power = 1e14 * (backscatter + layer) * np.exp(-2.0 * depth) / RANGE**2
    result = invert_elastic(
        power,
        RANGE,
        molecular_backscatter=backscatter,
        molecular_extinction=extinction,
        lidar_ratio=50.0,
        lidar_ratio_standard_error=15.0,
        reference=(2e3, 3e3),
        variance=(0.001 * power) ** 2,
    )
    # Beyond the reference the layer reduces the denominator of the solution.
    assert result.valid[RANGE < 4e3].all()
    assert result.unstable[RANGE > 5.1e3].all()


@pytest.mark.slow
def test_errors_hold_where_the_reference_is_noisy():
    """A reference that is too high by noise makes values and their first-order errors too low."""
    r = RANGE[::5]
    backscatter, extinction = AIR.backscatter(r, 532e-9), AIR.extinction(r, 532e-9)
    power = backscatter * np.exp(-2.0 * np.cumsum(extinction) * 37.5) / r**2
    window = (r > 7e3) & (r < 8e3)
    noise = power[window].mean() * np.sqrt(window.sum()) / 6.0
    draws = power + noise * np.random.default_rng(1).normal(size=(20_000, r.size))
    result = invert_elastic(
        draws,
        r,
        molecular_backscatter=backscatter,
        molecular_extinction=extinction,
        lidar_ratio=8.0,
        reference=(7e3, 8e3),
        variance=noise**2,
    )
    near = np.searchsorted(r, 700.0)
    error = np.abs(result.backscatter / result.backscatter_standard_error)[:, near]
    assert result.valid[:, near].mean() > 0.9
    assert (error[result.valid[:, near]] > 4.0).mean() < 1e-3
