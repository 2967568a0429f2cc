"""Backgrounds with which the beams of a scan agree, in simulated scans of known backgrounds."""

from __future__ import annotations

import numpy as np
import pytest
from support.scan_arguments import retrieve_optical_depth

from lidarops.retrieve.multiangle import slant_paths
from lidarops.retrieve.multiangle.beam_backgrounds import ScanSignals

HEIGHT = 60.0 * np.arange(5, 61)
ZENITH = np.array([0.0, 20.0, 35.0, 45.0, 55.0, 62.0, 68.0, 72.0, 75.0])
PATH = slant_paths.slant_path(ZENITH, HEIGHT)
RESPONSE = (PATH * HEIGHT) ** 2
DEPTH = 0.25 * -np.expm1(-HEIGHT / 1500.0)
CLEAN = 1e12 * np.exp(-HEIGHT / 3000.0 - 2.0 * PATH * DEPTH)
LEFT = 80.0 * np.linspace(0.5, 1.0, ZENITH.size)
"""Standard error of the backgrounds: 0.3 to 30 percent of the signals at the highest altitude."""


def scans(cycles, rng, *, common, noise=0.01, beams=slice(None)):
    """Return signals with wrong backgrounds, and what is wrong."""
    own, shared = rng.normal(size=(cycles, ZENITH.size)), rng.normal(size=(cycles, 1))
    wrong = LEFT * (np.sqrt(common) * shared + np.sqrt(1.0 - common) * own)
    scatter = 1.0 + noise * rng.normal(size=(cycles, *CLEAN.shape))
    signal = CLEAN * scatter + wrong[..., np.newaxis] * RESPONSE
    variance = np.broadcast_to((noise * CLEAN) ** 2, signal.shape)
    left = np.broadcast_to(LEFT, wrong.shape)
    parts = (signal[:, beams], variance[:, beams], left[:, beams], PATH[beams], RESPONSE[beams])
    return ScanSignals.of(*parts), wrong[:, beams]


def fit(signals, beams=slice(None), method="kano_hamilton"):
    return retrieve_optical_depth(
        signals.signal,
        ZENITH[beams],
        HEIGHT,
        variance=signals.variance,
        method=method,
        inhomogeneity=0.0,
        largest_gradient=0.0,
    )


def agreed(prior, beams=slice(None)):
    first = prior.agreed(fit(prior, beams))
    return prior.agreed(fit(first, beams))


@pytest.mark.parametrize("common", [0.0, 0.5, 1.0])
def test_backgrounds_come_closer_and_keep_within_their_errors(common):
    prior, wrong = scans(300, np.random.default_rng(1), common=common)
    after = agreed(prior)
    found = (prior.signal - after.signal)[..., 0] / RESPONSE[:, 0]
    error = found - wrong
    stated = np.sqrt(np.diagonal(after.covariance, axis1=1, axis2=2))
    remaining = np.sqrt(np.mean(error**2, axis=0)) / LEFT
    # Signals of the first beams hardly change with their background.
    assert np.all(remaining < 1.05)
    assert np.all(remaining[-3:] < 0.45)
    scores = error / stated
    assert 0.7 < np.sqrt(np.mean(scores**2)) < 1.2
    assert np.mean(np.abs(scores) > 4.0) < 2e-3


@pytest.mark.parametrize(("common", "remaining"), [(0.0, 0.95), (0.5, 0.6)])
def test_optical_depths_hold_the_error_of_backgrounds(common, remaining):
    """Beside the noise, which is small here."""
    prior, _ = scans(300, np.random.default_rng(2), common=common, noise=0.002)
    after = agreed(prior)
    result = fit(after)
    shift = after.shift(result)
    before = (fit(prior).optical_depth - DEPTH)[:, -10:]
    error = (result.optical_depth - DEPTH)[:, -10:]
    assert np.sqrt(np.mean(error**2)) < remaining * np.sqrt(np.mean(before**2))
    stated = np.hypot(shift, result.optical_depth_standard_error)[:, -10:]
    assert 0.8 < np.sqrt(np.mean((error / stated) ** 2)) < 1.2
    assert np.mean(np.abs(error / stated) > 4.0) < 2e-3


def test_two_beams_agree_with_any_background():
    pair = slice(0, None, 8)
    prior, _ = scans(5, np.random.default_rng(3), common=0.5, beams=pair)
    after = agreed(prior, pair)
    np.testing.assert_allclose(after.covariance, prior.covariance, rtol=1e-6)
    np.testing.assert_allclose(after.signal, prior.signal, rtol=1e-6)


def test_altitudes_that_two_noisy_beams_reach_say_nothing_about_backgrounds():
    """Their own optical depths are off by hundreds, and those of the smooth profile are not."""
    prior, wrong = scans(20, np.random.default_rng(6), common=0.5, noise=0.02)
    signal, noise = prior.signal.copy(), prior.noise.copy()
    few = slice(-12, None)
    signal[:, 2:, few] = np.nan
    signal[:, :2, few] *= 1.0 + 0.3 * np.random.default_rng(7).normal(size=(20, 2, 12))
    noise[:, :2, few] = (0.3 * CLEAN[:2, few]) ** 2
    left = np.broadcast_to(LEFT, wrong.shape)
    high = ScanSignals.of(signal, noise, left, PATH, RESPONSE)
    after = high.agreed(fit(high, method="joint"))
    result = fit(after, method="joint")
    found = (signal - after.signal)[..., 0] / RESPONSE[:, 0]
    assert np.all(np.abs(found) < 4.0 * LEFT)
    error = np.hypot(after.shift(result), result.optical_depth_standard_error)
    assert np.nanmax(error) < 0.5
    assert np.nanmax(np.abs(result.optical_depth - DEPTH) / error) < 5.0


def test_known_backgrounds_and_missing_beams_stay():
    rng = np.random.default_rng(4)
    prior, _ = scans(4, rng, common=0.5)
    left = np.broadcast_to(LEFT, (4, ZENITH.size)).copy()
    left[:, 0], left[1, 3] = 0.0, np.nan
    signal = prior.signal.copy()
    signal[1, 3] = np.nan
    before = ScanSignals.of(signal, prior.noise, left, PATH, RESPONSE)
    after = agreed(before)
    np.testing.assert_array_equal(after.signal[:, 0], before.signal[:, 0])
    assert np.isnan(after.signal[1, 3]).all()
    assert np.isfinite(np.delete(after.signal, 3, axis=1)).all()
    assert np.isfinite(after.covariance).all()


def test_a_cycle_does_not_depend_on_the_others():
    """But for the correlation over altitude, which is that of the block."""
    prior, _ = scans(6, np.random.default_rng(5), common=0.5)
    whole = prior.agreed(fit(prior)).covariance
    order = np.array([3, 0, 5, 1, 2, 4])
    turned = ScanSignals(
        *(values[order] for values in (prior.signal, prior.noise, prior.variance)),
        prior.covariance[order],
        PATH,
        RESPONSE,
    )
    np.testing.assert_allclose(turned.agreed(fit(turned)).covariance, whole[order], rtol=1e-9)
