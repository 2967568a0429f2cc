"""Standard errors where samples are missing: neighbouring altitudes from different beams."""

from __future__ import annotations

import numpy as np
import pytest
from support.oracles.multiangle import ANGLES, clear, cloud, rms, signals
from support.scan_arguments import retrieve_optical_depth

STEEP = np.linspace(0.0, 30.0, 6)


def errors_with_gaps(atmosphere, angles, correlation, missing, **noise):
    """Return errors and standard errors of optical depth and of extinction, of many blocks."""
    rng = np.random.default_rng(77)
    blocks = []
    for _ in range(24):
        signal, variance, tau = signals(
            rng, 16, angles, atmosphere, correlation=correlation, **noise
        )
        signal[rng.random(signal.shape) < missing] = np.nan
        result = retrieve_optical_depth(signal, angles, atmosphere[0], variance=variance)
        assert np.array_equal(
            np.isnan(result.extinction), np.isnan(result.extinction_standard_error)
        )
        blocks.append(
            (
                result.optical_depth - tau,
                result.optical_depth_standard_error,
                result.extinction - atmosphere[1],
                result.extinction_standard_error,
            )
        )
    return np.stack(blocks, axis=1)


# Standard errors of extinction are too large even without gaps: only too small ones matter.
@pytest.mark.parametrize(("correlation", "missing"), [(0.7, 0.3), (0.9, 0.1), (0.9, 0.3)], ids=str)
def test_stated_errors_of_a_cloud_hold_with_gaps(correlation, missing):
    depth, stated, extinction, of_extinction = errors_with_gaps(
        cloud(), STEEP, correlation, missing, ratio=1e7, inhomogeneity=0.144
    )
    assert 0.9 < rms(depth / stated) < 1.1
    assert rms(extinction / of_extinction) < 1.1


def test_stated_errors_of_clear_air_hold_with_gaps():
    depth, stated, extinction, of_extinction = errors_with_gaps(
        clear(120), ANGLES, 0.9, 0.3, ratio=3000.0, inhomogeneity=0.03
    )
    assert 0.9 < rms(depth / stated) < 1.1
    assert rms(extinction / of_extinction) < 1.1


@pytest.mark.parametrize("hole", [(1, 60, 61), (3, 30, 60)], ids=["one sample", "half a beam"])
def test_all_values_of_highly_correlated_scans_have_a_standard_error(hole):
    """The correlated share of the noise of an estimate must not exceed 1."""
    rng, atmosphere = np.random.default_rng(1), clear(120)
    deviations = []
    for correlation in (0.97, 0.99):
        for _ in range(8):
            signal, variance, _ = signals(
                rng, 16, ANGLES, atmosphere, ratio=3000.0, inhomogeneity=0.03,
                correlation=correlation,
            )  # fmt: skip
            beam, first, past = hole
            signal[:, [1, beam], first:past] = np.nan
            result = retrieve_optical_depth(signal, ANGLES, atmosphere[0], variance=variance)
            valued = np.isfinite(result.extinction)
            assert np.all(result.extinction_standard_error[valued] > 0.0)
            assert np.all(
                result.optical_depth_standard_error[np.isfinite(result.optical_depth)] > 0.0
            )
            deviations.append(
                ((result.extinction - atmosphere[1]) / result.extinction_standard_error)[valued]
            )
    assert np.mean(np.abs(np.concatenate(deviations)) > 4.0) < 5e-4
