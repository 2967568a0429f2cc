"""Standard errors where samples are missing: neighbouring altitudes from different beams."""

from __future__ import annotations

import numpy as np
import pytest
from support.oracles.multiangle import ANGLES, clear, cloud, rms, signals
from support.scan_arguments import retrieve_optical_depth

from lidarops.retrieve.multiangle import _block
from lidarops.retrieve.multiangle import altitude_correlation as correlation_of_air

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


def noise_with_gaps(rng, correlation, beams=8, altitudes=60):
    """Return information, share and true covariance of means over beams, a third missing.

    The noise of each beam is fully correlated along altitude, with variance 1.
    """
    present = rng.random((altitudes, beams)) > 1.0 / 3.0
    present[:, 0] |= ~present.any(axis=1)
    weight = present / present.sum(axis=1, keepdims=True)
    apart = np.abs(np.subtract.outer(np.arange(altitudes), np.arange(altitudes)))
    covariance = (weight @ weight.T) * correlation**apart
    information = present.sum(axis=1).astype(np.float64)
    return information, information / beams, covariance


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.7, 0.9, 0.95])
def test_precision_with_gaps_gives_the_variance_of_a_mean(correlation):
    """The variance of a constant by the precision is that of the mean with its weights."""
    rng, ratios = np.random.default_rng(3), []
    for _ in range(100):
        information, share, covariance = noise_with_gaps(rng, correlation)
        bands = correlation_of_air.gap_precision(information[None], share[None], correlation)[:, 0]
        dense = np.diag(bands[0])
        for step in (1, 2):
            dense += np.diag(bands[step, :-step], step) + np.diag(bands[step, :-step], -step)
        assert np.linalg.eigvalsh(dense).min() > 0.0
        weight = dense.sum(axis=0)
        stated = 1.0 / weight.sum()
        ratios.append((weight @ covariance @ weight) * stated**2 / stated)
    assert np.sqrt(np.mean(ratios)) == pytest.approx(1.0, abs=0.1)


def test_precision_of_uniform_noise_is_that_without_gaps():
    information, share = np.full((2, 30), 5.0), np.full((2, 30), 0.8)
    plain = correlation_of_air.correlated_precision(information, share, 0.9)
    bands = correlation_of_air.gap_precision(information, share, 0.9)
    np.testing.assert_allclose(bands, plain, rtol=1e-12)


def test_altitudes_without_correlated_noise_stay_independent():
    information = np.tile([4.0, 0.0, 9.0], (1, 5))
    share = np.where(np.arange(15) % 2 == 0, 0.0, 1e-300)[np.newaxis]
    bands = correlation_of_air.gap_precision(information, share, 0.9)
    np.testing.assert_array_equal(bands[0], information)
    assert not bands[1:].any()


def test_only_samples_missing_between_others_are_gaps():
    signal = np.ones((6, 2, 5))
    signal[1, 0, 2] = np.nan
    signal[2, 1, :2] = np.nan
    signal[3, 1, 3:] = np.nan
    signal[4, 1] = np.nan
    signal[5, 0, 2] = -1.0
    variance = np.full(signal.shape, 0.1)
    present = signal > 0.0
    gappy = _block.profiles_with_gaps(present, signal, variance)
    np.testing.assert_array_equal(gappy, [False, True, False, False, False, False])
    variance[0, 1, 3], present[0, 1, 3] = np.nan, False
    assert _block.profiles_with_gaps(present, signal, variance)[0]
