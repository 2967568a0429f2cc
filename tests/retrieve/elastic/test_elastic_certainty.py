"""Bins are withheld where their error is not of first order, and only there."""

from __future__ import annotations

import numpy as np
import pytest

from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.elastic.inversion import invert_elastic

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
    assert np.abs(result.budget.lidar_ratio[near] / backscatter[near]).max() < 0.01


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
