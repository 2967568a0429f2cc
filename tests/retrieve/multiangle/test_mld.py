"""Regularised differentiation: limits, errors on the published cloud, data share."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.oracles.multiangle import ANGLES, PER_KM, clear, rms, signals
from support.scan_arguments import retrieve_optical_depth

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.multiangle import mld
from lidarops.retrieve.multiangle.flags import MultiAngleQuality

LAYERS = np.array([5.0, 10.0, 15.0, 20.0, 15.0, 10.0, 8.0, 5.0]) * PER_KM
HEIGHT = 25.0 + 50.0 * np.arange(8)
TAU = np.cumsum(50.0 * LAYERS) - 25.0 * LAYERS
SCATTER = float(np.std(np.log1p(np.random.default_rng(0).uniform(-0.25, 0.25, 10**6))))


def weights(path, strength):
    """Return the factors by which the method multiplies the logarithms."""
    operator = mld.make_operator(np.asarray(path, dtype=float))
    kept = 1 / (1 + strength * operator.penalty)
    return (operator.gain * kept) @ operator.coordinates


def published(angle, profiles=4000, beams=6):
    """Return signals of the published cloud with 25 percent of backscatter varying."""
    rng = np.random.default_rng(21)
    angles = np.linspace(0.0, angle, beams)
    path = 1 / np.cos(np.radians(angles))[:, np.newaxis]
    varying = rng.uniform(-0.25, 0.25, (profiles, beams, 8))
    return np.exp(-2 * path * TAU) * (1 + varying), angles


def retrieve(signal, angles, method, **options):
    return retrieve_optical_depth(
        signal,
        angles,
        HEIGHT,
        variance=0.0,
        method=method,
        inhomogeneity=SCATTER,
        **options,
    )


# Limits -------------------------------------------------------------------------------------


@given(st.lists(st.floats(1.0, 5.0), min_size=3, max_size=12, unique_by=lambda x: round(x, 2)))
@settings(max_examples=60, deadline=None)
def test_between_the_end_beams_and_nothing(path):
    ends = np.zeros(len(path))
    span = max(path) - min(path)
    ends[np.argmin(path)], ends[np.argmax(path)] = 0.5 / span, -0.5 / span
    assert weights(path, 0.0) == pytest.approx(ends, abs=1e-9 / span)
    assert weights(path, 1e15) == pytest.approx(0.0, abs=1e-9 / span)


@pytest.mark.parametrize("strength", [1e-6, 1e-2, 1.0, 1e4])
def test_weights_minimise_the_functional(strength):
    """Slopes between beams minimise residuals plus the strength times the mean squared slope."""
    path = 1 / np.cos(np.radians(np.linspace(0, 50, 6)))
    y = np.random.default_rng(3).normal(size=path.size)
    width = np.diff(path) / np.ptp(path)
    sums = np.tril(np.ones((6, 5)), -1) * width
    centred = sums - sums.mean(axis=0)
    normal = centred.T @ centred + strength * np.diag(width)
    slope = np.linalg.solve(normal, centred.T @ (y - y.mean()))
    expected = -0.5 * (width @ slope) / np.ptp(path)
    assert weights(path, strength) @ y == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("strength", [0.0, 1e-2, 1.0])
def test_a_given_strength_is_used_at_every_altitude(strength):
    signal, angles = published(50.0, profiles=5)
    fixed = retrieve(signal, angles, "mld", regularisation=strength)
    path = 1 / np.cos(np.radians(angles))
    expected = np.einsum("b,tbk->tk", weights(path, strength), np.log(signal))
    np.testing.assert_allclose(fixed.optical_depth, expected, rtol=1e-9, atol=1e-12)
    share = -2 * weights(path, strength) @ path
    np.testing.assert_allclose(fixed.data_share, share, rtol=1e-9)


def test_a_strength_needs_a_method_with_a_penalty():
    signal, angles = published(50.0, profiles=2)
    with pytest.raises(RetrievalInputError, match="regularisation: is not accepted"):
        retrieve(signal, angles, "kano_hamilton", regularisation=1.0)


@pytest.mark.parametrize("strength", [1e-6, 1e-2, 1.0, 1e4])
def test_the_penalty_shrinks(strength):
    path = 1 / np.cos(np.radians(np.linspace(0, 30, 6)))
    share = -2 * weights(path, strength) @ path
    assert 0 < share < 1
    assert share > -2 * weights(path, 10 * strength) @ path


def test_noise_gain_is_that_of_the_study():
    path = 1 / np.cos(np.radians(np.linspace(0, 15, 6)))
    assert np.linalg.norm(weights(path, 0.0)) == pytest.approx(20.04, abs=0.01)


def test_two_beams_are_the_two_angle_formula():
    assert weights([1.0, 1.7], 0.0) == pytest.approx([0.5 / 0.7, -0.5 / 0.7], rel=1e-12)


def test_beams_almost_at_one_angle_are_one_node():
    path = 1 / np.cos(np.radians([0.0, 0.01, 7.0, 7.0, 15.0]))
    assert mld.make_operator(path).penalty.size == 2
    assert np.linalg.norm(weights(path, 0.0)) == pytest.approx(
        0.5 * np.sqrt(1.5) / 0.0353, rel=0.01
    )


# Errors on the published cloud --------------------------------------------------------------


def test_published_claim_is_not_reproduced_at_15_degrees():
    signal, angles = published(15.0)
    result = retrieve(signal, angles, "mld")
    error = result.optical_depth - TAU
    # Low on average by half of the optical depth: a fifth comes from the data, the rest is prior.
    assert rms(error) == pytest.approx(2.08, abs=0.05)
    assert error[:, -1].mean() == pytest.approx(-2.31, abs=0.1)
    assert np.median(result.data_share) == pytest.approx(0.23, abs=0.06)
    assert result.effective_degrees_of_freedom.mean() / 8 == pytest.approx(0.60, abs=0.06)
    assert result.raised(MultiAngleQuality.PRIOR_DOMINATED).mean() > 0.95
    assert np.all(np.isnan(result.extinction[result.raised(MultiAngleQuality.PRIOR_DOMINATED)]))
    regression = retrieve(signal, angles, "kano_hamilton")
    assert rms(regression.optical_depth - TAU) == pytest.approx(2.38, abs=0.05)
    # Two angles at 30 degrees with 10 percent of noise do better.
    rng = np.random.default_rng(22)
    angles = np.array([0.0, 30.0])
    path = 1 / np.cos(np.radians(angles))[:, np.newaxis]
    signal = np.exp(-2 * path * TAU) * (1 + 0.1 * rng.normal(size=(4000, 2, 8)))
    pair = retrieve(signal, angles, "two_angle").optical_depth - TAU
    assert rms(pair) == pytest.approx(0.45, abs=0.02)


@pytest.mark.parametrize(
    ("factor", "expected"), [(0.0, 2.07), (0.5, 1.35), (1.0, 0.87), (1.5, 1.35)]
)
def test_the_error_is_the_error_of_the_prior(factor, expected):
    """Signals over those of a model: formula 4 with independent measurements."""
    signal, angles = published(15.0)
    path = 1 / np.cos(np.radians(angles))[:, np.newaxis]
    result = retrieve(signal * np.exp(2 * path * factor * TAU), angles, "mld")
    assert rms(result.optical_depth + factor * TAU - TAU) == pytest.approx(expected, abs=0.05)
    assert np.median(result.data_share) < 0.3


def test_prior_from_the_altitude_below_is_a_filter_over_altitude():
    signal, angles = published(30.0, profiles=5, beams=2)
    result = retrieve(signal, angles, "mld_prior")
    single = retrieve(signal, angles, "two_angle")
    expected, variance = np.zeros(5), np.zeros(5)
    for k in range(8):
        gain = result.data_share[:, k]
        expected = (1 - gain) * expected + gain * single.optical_depth[:, k]
        error = gain * single.optical_depth_standard_error[:, k]
        variance = (1 - gain) ** 2 * variance + error**2
        assert result.optical_depth[:, k] == pytest.approx(expected, rel=1e-10)
        assert result.optical_depth_standard_error[:, k] ** 2 == pytest.approx(variance, rel=1e-10)


def test_missing_beams_have_no_effect():
    signal, angles = published(30.0, profiles=20)
    signal[:, 2, 3:] = np.nan
    subset = retrieve(np.delete(signal, 2, axis=1), np.delete(angles, 2), "mld")
    whole = retrieve(signal, angles, "mld")
    assert whole.optical_depth[:, 3:] == pytest.approx(subset.optical_depth[:, 3:], rel=1e-12)
    assert not np.allclose(whole.optical_depth[:, :3], subset.optical_depth[:, :3])


@pytest.mark.parametrize("method", ["mld", "mld_prior"])
def test_a_result_states_the_chosen_strength_and_the_prior(method):
    """Given back, the chosen strength gives the same values up to where another was chosen."""
    signal, angles = published(50.0, profiles=5)
    result = retrieve(signal, angles, method)
    chosen = result.regularisation
    assert np.isin(chosen, mld.STRENGTHS).all()
    below = np.pad(result.optical_depth, ((0, 0), (1, 0)))[:, :-1]
    prior = below if method == "mld_prior" else np.zeros_like(below)
    np.testing.assert_allclose(result.prior_optical_depth, prior, rtol=1e-12)
    path = 1 / np.cos(np.radians(angles))
    share = [[-2 * weights(path, strength) @ path for strength in row] for row in chosen]
    np.testing.assert_allclose(result.data_share, share, rtol=1e-9)
    for strength in np.unique(chosen[:, 0]):
        again = retrieve(signal, angles, method, regularisation=float(strength))
        same = np.logical_and.accumulate(chosen == strength, axis=1)
        np.testing.assert_array_equal(again.optical_depth[same], result.optical_depth[same])
    plain = retrieve(signal, angles, "kano_hamilton")
    assert np.isnan(plain.regularisation).all()


def test_methods_without_weights_leave_out_weak_samples():
    """With samples of 1.5 times their noise, ratios are 3.0 and 2.1."""
    atmosphere = clear()
    signal, variance, tau = signals(
        np.random.default_rng(9), 60, ANGLES, atmosphere, ratio=3000, inhomogeneity=0.03
    )
    error = {
        method: rms(
            retrieve_optical_depth(
                signal, ANGLES, atmosphere[0], variance=variance, method=method
            ).optical_depth
            - tau
        )
        for method in ("kano_hamilton", "two_angle", "mld_prior")
    }
    assert error["two_angle"] < 2.6 * error["kano_hamilton"]
    assert error["mld_prior"] < 1.8 * error["kano_hamilton"]
