"""Regularised differentiation: limits, errors on the published cloud, data share."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.oracles.multiangle import PER_KM, rms

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.multiangle import mld
from lidarops.retrieve.multiangle.mld import Regularisation
from lidarops.retrieve.multiangle.optical_depth import retrieve_optical_depth

LAYERS = np.array([5.0, 10.0, 15.0, 20.0, 15.0, 10.0, 8.0, 5.0]) * PER_KM
HEIGHT = 25.0 + 50.0 * np.arange(8)
TAU = np.cumsum(50.0 * LAYERS) - 25.0 * LAYERS
SCATTER = float(np.std(np.log1p(np.random.default_rng(0).uniform(-0.25, 0.25, 10**6))))


def weights(path, strength, order=0, average="path"):
    """Return the factors by which the method multiplies the logarithms."""
    settings = Regularisation(order=order, choice="fixed", strength=strength, average=average)
    operator = mld.make_operator(np.asarray(path, dtype=float), settings)
    kept = 1 / (1 + strength * operator.penalty)
    return (operator.gain * kept) @ operator.coordinates


def kano_hamilton(path):
    centred = np.asarray(path) - np.mean(path)
    return -0.5 * centred / np.sum(centred**2)


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
        robust=False,
        **options,
    )


# Limits -------------------------------------------------------------------------------------


@given(st.lists(st.floats(1.0, 5.0), min_size=3, max_size=12, unique_by=lambda x: round(x, 2)))
@settings(max_examples=60, deadline=None)
def test_between_the_end_beams_and_the_regression(path):
    # A constant slope is the straight line of Kano and Hamilton.
    line = kano_hamilton(path)
    assert weights(path, 1e12, order=1) == pytest.approx(line, abs=1e-9 * np.max(np.abs(line)))
    ends = np.zeros(len(path))
    span = max(path) - min(path)
    ends[np.argmin(path)], ends[np.argmax(path)] = 0.5 / span, -0.5 / span
    for order in (0, 1):
        assert weights(path, 0.0, order=order) == pytest.approx(ends, abs=1e-9 / span)
    assert weights(path, 1e15, order=0) == pytest.approx(0.0, abs=1e-9 / span)


def test_constant_slopes_are_the_regression_to_rounding():
    for last in (15.0, 75.0):
        path = 1 / np.cos(np.radians(np.linspace(0, last, 12)))
        line = kano_hamilton(path)
        error = weights(path, 1e12, order=1) - line
        assert np.max(np.abs(error)) < 1e-13 * np.max(np.abs(line))


@pytest.mark.parametrize("strength", [1e-6, 1e-2, 1.0, 1e4])
def test_order_1_has_no_bias_and_order_0_shrinks(strength):
    path = 1 / np.cos(np.radians(np.linspace(0, 30, 6)))
    assert -2 * weights(path, strength, order=1) @ path == pytest.approx(1.0, abs=1e-12)
    share = -2 * weights(path, strength) @ path
    assert 0 < share < 1
    assert share > -2 * weights(path, 10 * strength) @ path


def test_noise_gains_are_those_of_the_study():
    path = 1 / np.cos(np.radians(np.linspace(0, 15, 6)))
    gains = [np.linalg.norm(weights(path, 0.0, average=average)) for average in ("angles", "path")]
    assert gains == pytest.approx([88.66, 20.04], abs=0.01)


def test_two_beams_are_the_two_angle_formula():
    assert weights([1.0, 1.7], 1e12, order=1) == pytest.approx([0.5 / 0.7, -0.5 / 0.7], rel=1e-12)


def test_beams_almost_at_one_angle_are_one_node():
    path = 1 / np.cos(np.radians([0.0, 0.01, 7.0, 7.0, 15.0]))
    operator = mld.make_operator(path, Regularisation(order=1))
    assert operator.condition < 5
    line = kano_hamilton(path)
    assert weights(path, 1e12, order=1) == pytest.approx(line, rel=1e-6)


@pytest.mark.parametrize(("last", "beams", "largest"), [(15, 6, 18), (75, 6, 80), (84, 12, 1100)])
def test_condition_stays_moderate(last, beams, largest):
    path = 1 / np.cos(np.radians(np.linspace(0, last, beams)))
    assert mld.make_operator(path, Regularisation()).condition < largest


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
    assert result.flags.prior_dominated.mean() > 0.95
    assert np.all(np.isnan(result.extinction[result.flags.prior_dominated]))
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
    ("order", "choice", "expected"),
    [(0, "gcv", 2.46), (1, "discrepancy", 2.41), (1, "gcv", 2.54), (0, "cp", 2.08)],
)
def test_rules_of_choice_at_15_degrees(order, choice, expected):
    signal, angles = published(15.0)
    chosen = Regularisation(order=order, choice=choice)
    error = retrieve(signal, angles, "mld", regularisation=chosen).optical_depth - TAU
    assert rms(error) == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize(
    ("factor", "expected"), [(0.0, 2.07), (0.5, 1.35), (1.0, 0.87), (1.5, 1.35)]
)
def test_the_error_is_the_error_of_the_prior(factor, expected):
    signal, angles = published(15.0)
    result = retrieve(signal, angles, "mld_prior", prior_optical_depth=factor * TAU)
    assert rms(result.optical_depth - TAU) == pytest.approx(expected, abs=0.05)
    assert np.median(result.data_share) < 0.3


def test_prior_from_the_altitude_below_is_a_fixed_gain_filter():
    signal, angles = published(30.0, profiles=5, beams=2)
    chosen = Regularisation(choice="fixed", strength=0.7)
    result = retrieve(signal, angles, "mld_prior", regularisation=chosen)
    single = retrieve(signal, angles, "two_angle")
    gain = result.data_share[0, 0]
    assert result.data_share == pytest.approx(gain)
    expected, variance = np.zeros(5), np.zeros(5)
    for k in range(8):
        expected = (1 - gain) * expected + gain * single.optical_depth[:, k]
        error = gain * single.optical_depth_standard_error[:, k]
        variance = (1 - gain) ** 2 * variance + error**2
        assert result.optical_depth[:, k] == pytest.approx(expected, rel=1e-10)
        assert result.optical_depth_standard_error[:, k] ** 2 == pytest.approx(variance, rel=1e-10)


def test_standard_error_is_the_scatter_at_a_fixed_strength():
    signal, angles = published(30.0)
    chosen = Regularisation(choice="fixed", strength=0.3)
    result = retrieve(signal, angles, "mld", regularisation=chosen)
    scatter = result.optical_depth.std(axis=0)
    assert result.optical_depth_standard_error[0] == pytest.approx(scatter, rel=0.05)


def test_missing_beams_have_no_effect():
    signal, angles = published(30.0, profiles=20)
    signal[:, 2, 3:] = np.nan
    subset = retrieve(np.delete(signal, 2, axis=1), np.delete(angles, 2), "mld")
    whole = retrieve(signal, angles, "mld")
    assert whole.optical_depth[:, 3:] == pytest.approx(subset.optical_depth[:, 3:], rel=1e-12)
    assert not np.allclose(whole.optical_depth[:, :3], subset.optical_depth[:, :3])


# Input --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"order": 2}, "order"),
        ({"choice": "best"}, "choice"),
        ({"average": "all"}, "average"),
        ({"choice": "fixed"}, "strength"),
        ({"strength": 1.0}, "strength"),
        ({"choice": "fixed", "strength": -1.0}, "strength"),
        ({"choice": "fixed", "strength": np.nan}, "strength"),
    ],
)
def test_invalid_settings_are_refused(change, field):
    with pytest.raises(RetrievalInputError, match=field):
        Regularisation(**change)
