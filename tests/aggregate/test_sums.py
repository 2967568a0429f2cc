"""Means and their errors, compared with explicit formulas."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from lidarops.aggregate._sums import Sample, Sums


def sample(values, errors, *, random=None, shared=(), systematic=None, usable=None) -> Sample:
    values, errors = (np.asarray(array, np.float64) for array in (values, errors))
    return Sample(
        values,
        errors,
        errors if random is None else np.asarray(random, np.float64),
        tuple(np.asarray(part, np.float64) for part in shared),
        {name: np.asarray(part, np.float64) for name, part in (systematic or {}).items()},
        np.ones(values.shape, np.bool_) if usable is None else np.asarray(usable),
    )


def mean(*samples: Sample, inverse_variance: bool = False):
    sums = Sums()
    for part in samples:
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = part.errors**-2.0
        sums.add(part, inverse if inverse_variance else np.ones(part.values.shape))
    return sums.mean("x")


def test_a_plain_mean_of_independent_errors():
    result = mean(sample([1.0, 2.0, 6.0], [0.3, 0.4, 1.2]))
    assert result["x"] == pytest.approx(3.0)
    assert result["x_standard_error"] == pytest.approx(1.3 / 3.0)
    assert result["x_standard_deviation"] == pytest.approx(np.sqrt(7.0))
    assert result["x_observations"] == 3


def test_a_weighted_mean_has_the_least_error():
    values, errors = np.array([1.0, 2.0]), np.array([0.1, 0.2])
    result = mean(sample(values, errors), inverse_variance=True)
    assert result["x"] == pytest.approx((1.0 / 0.01 + 2.0 / 0.04) / 125.0)
    assert result["x_standard_error"] == pytest.approx(1.0 / np.sqrt(125.0))


def test_shared_errors_do_not_decrease():
    result = mean(sample([1.0] * 100, [0.5] * 100, random=[0.3] * 100, shared=([0.4] * 100,)))
    assert result["x_standard_error"] == pytest.approx(np.hypot(0.03, 0.4))


def test_shared_errors_keep_their_signs():
    result = mean(sample([1.0, 1.0], [0.4, 0.4], random=[0.0, 0.0], shared=([0.4, -0.4],)))
    assert result["x_standard_error"] == 0.0


def test_systematic_errors_are_averaged_with_the_weights():
    given_ = sample([1.0, 1.0], [0.1, 0.2], systematic={"a": [0.3, 0.8], "b": [0.1, np.nan]})
    plain, weighted = mean(given_), mean(given_, inverse_variance=True)
    assert plain["a"] == pytest.approx(0.55)
    assert weighted["a"] == pytest.approx((30 + 20) / 125)
    assert np.isnan([plain["b"], weighted["b"]]).all()


@pytest.mark.parametrize("inverse_variance", [False, True])
def test_unusable_and_missing_values_do_not_count(inverse_variance: bool):
    values = [[1.0, np.nan], [3.0, 5.0], [1e30, 7.0], [2.0, 8.0]]
    errors = [[0.1, 0.1], [0.1, np.nan], [0.1, 0.1], [np.nan, 0.1]]
    usable = [[True, True], [True, True], [False, False], [True, False]]
    result = mean(sample(values, errors, usable=usable), inverse_variance=inverse_variance)
    np.testing.assert_allclose(result["x"], [2.0, np.nan])
    np.testing.assert_array_equal(result["x_observations"], [2, 0])
    assert np.isnan(result["x_standard_error"][1])
    assert np.isnan(result["x_standard_deviation"][1])


def test_a_zero_error_cannot_be_a_weight():
    given_ = sample([1.0, 5.0], [0.0, 0.1])
    assert mean(given_, inverse_variance=True)["x"] == pytest.approx(5.0)
    assert mean(given_)["x"] == pytest.approx(3.0)


@given(
    st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30),
    st.integers(0, 30),
    st.booleans(),
)
def test_adding_in_parts_gives_the_same_mean(values, cut, inverse_variance):
    errors = np.linspace(1.0, 2.0, len(values))
    whole = sample(values, errors)
    parts = [whole.take(np.arange(len(values))[part]) for part in (slice(cut), slice(cut, None))]
    result, expected = (
        mean(*samples, inverse_variance=inverse_variance) for samples in (parts, [whole])
    )
    scale = 1e-12 * max(1.0, np.max(np.abs(values)))
    np.testing.assert_allclose(result["x"], expected["x"], atol=scale, rtol=1e-12)
    np.testing.assert_allclose(result["x_standard_error"], expected["x_standard_error"], rtol=1e-12)
    np.testing.assert_allclose(
        result["x_standard_deviation"],
        expected["x_standard_deviation"],
        atol=1e3 * scale,
        rtol=1e-9,
    )
    if len(values) > 1:
        np.testing.assert_allclose(
            result["x_standard_deviation"], np.std(values, ddof=1), atol=1e3 * scale, rtol=1e-9
        )


@pytest.mark.parametrize("inverse_variance", [False, True])
def test_the_standard_error_covers_the_truth(inverse_variance: bool):
    rng = np.random.default_rng(5)
    trials, profiles, truth = 4000, 12, 3.0
    noise = rng.uniform(0.1, 1.0, profiles)
    slope = rng.uniform(-0.3, 0.3, profiles)
    cause = rng.standard_normal(trials)
    values = truth + rng.standard_normal((profiles, trials)) * noise[:, None]
    values += slope[:, None] * cause
    total = np.broadcast_to(np.hypot(noise, slope)[:, None], values.shape)
    result = mean(
        sample(
            values,
            total,
            random=np.broadcast_to(noise[:, None], values.shape),
            shared=(np.broadcast_to(slope[:, None], values.shape),),
        ),
        inverse_variance=inverse_variance,
    )
    normalised = (result["x"] - truth) / result["x_standard_error"]
    # Chi-square limits of the sample variance, exceeded with a probability of 1e-3.
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], trials) / trials
    assert low < np.mean(normalised**2) < high
