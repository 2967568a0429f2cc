"""Means over time: weights, gaps, and variances that do or do not average down."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.signal.averaging import RunningMean


def by_hand(values, variance, shared, weights):
    """Return the averages of one bin, by the formulas of the docstring."""
    valid = np.isfinite(values) & (weights > 0)
    w = weights[valid]
    if not valid.any():
        return np.nan, np.nan, np.nan
    total = w.sum()
    return (
        (w * values[valid]).sum() / total,
        (w**2 * variance[valid]).sum() / total**2,
        ((w * np.sqrt(shared[valid])).sum() / total) ** 2,
    )


def mean_of(profiles, variance=1.0, groups=None, **settings):
    """Return the averages of profiles; all in one group where none are given."""
    group = np.zeros(len(profiles), np.intp) if groups is None else np.asarray(groups)
    sums = RunningMean((max(int(group.max(initial=0)), 0) + 1, np.shape(profiles)[-1]))
    sums.add(profiles, variance, groups=group, **settings)
    return sums.averages()


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 5))
@settings(max_examples=60, deadline=None)
def test_mean_follows_its_formulas(seed, length, bins):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(length, bins))
    values[rng.random(values.shape) < 0.2] = np.nan
    variance, shared = rng.random(values.shape), rng.random(values.shape)
    weights = rng.integers(0, 4, length).astype(float)
    groups = rng.integers(-1, 3, length)
    result = mean_of(values, variance, groups, weights=weights, shared_variance=shared)
    for g, i in np.ndindex(max(int(groups.max()), 0) + 1, bins):
        inside = groups == g
        expected = by_hand(
            values[inside, i], variance[inside, i], shared[inside, i], weights[inside]
        )
        actual = (
            result.values[g, i],
            result.variance[g, i],
            result.shared_variance[g, i],
        )
        np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-14)


def test_noise_averages_down_and_shared_errors_do_not():
    """The standard error of a mean is its scatter over many realisations."""
    rng = np.random.default_rng(1)
    shots = np.array([100.0, 200.0, 600.0, 100.0])
    noise = 3.0 / np.sqrt(shots)
    dark = rng.normal(0.0, 0.5, 12_000)
    profiles = 7.0 + dark + rng.normal(size=(4, 12_000)) * noise[:, np.newaxis]
    result = mean_of(profiles, noise[:, np.newaxis] ** 2, weights=shots, shared_variance=0.25)
    deviation = result.values - 7.0
    both = result.variance + result.shared_variance
    assert np.var(deviation) == pytest.approx(both[0, 0], rel=0.05)
    assert result.variance[0, 0] == pytest.approx(9.0 / shots.sum(), rel=1e-12)
    assert result.shared_variance[0, 0] == pytest.approx(0.25, rel=1e-12)
    assert np.var(deviation - dark) == pytest.approx(9.0 / shots.sum(), rel=0.05)


def test_gaps_bias_neither_the_mean_nor_its_variance():
    rng = np.random.default_rng(2)
    profiles = rng.normal(5.0, 1.0, (8, 3000, 4))
    profiles[:5, :, 1] = np.nan
    profiles[:, :, 2] = np.inf
    profiles[1:, :, 3] = np.nan
    result = mean_of(profiles.reshape(8, -1))
    np.testing.assert_allclose(result.variance[0, [0, 1, 3]], [1 / 8, 1 / 3, 1.0])
    assert np.isnan(result.values[0, 2::4]).all()
    assert np.isnan(result.variance[0, 2::4]).all()
    for i in (0, 1, 3):
        spread, values = np.sqrt(result.variance[0, i]), result.values[0, i::4]
        assert values.mean() == pytest.approx(5.0, abs=4 * spread / np.sqrt(3000))
        assert values.std() == pytest.approx(spread, rel=0.06)


def test_means_of_no_values_are_gaps():
    profiles = np.ones((5, 2))
    profiles[:, 1] = np.nan
    result = mean_of(profiles)
    np.testing.assert_array_equal(result.values, [[1.0, np.nan]])
    assert np.isnan(result.shared_variance[0, 1])


def test_a_variance_that_is_not_known_stays_so():
    variance = np.ones((4, 2))
    variance[1, 0] = np.nan
    result = mean_of(np.ones((4, 2)), variance)
    np.testing.assert_array_equal(result.values, [[1.0, 1.0]])
    np.testing.assert_array_equal(np.isnan(result.variance), [[True, False]])


@pytest.mark.parametrize("dtype", ["<f4", "<f8", ">f8"])
def test_no_bit_depends_on_the_chunks(dtype):
    rng = np.random.default_rng(3)
    profiles = rng.normal(1e6, 1.0, (50, 198)).astype(dtype)
    profiles[rng.random(profiles.shape) < 0.1] = np.nan
    variance = rng.random(profiles.shape)
    groups = np.repeat(np.arange(5), 10)
    whole = mean_of(profiles, variance, groups)
    for bins in (slice(0, 33), slice(73, 74), slice(166, 197, 3)):
        chunk = mean_of(profiles[:, bins], variance[:, bins], groups)
        np.testing.assert_array_equal(whole.values[:, bins], chunk.values)
        np.testing.assert_array_equal(whole.variance[:, bins], chunk.variance)
    in_parts = RunningMean((5, 198))
    for rows in (slice(0, 3), slice(3, 14), slice(14, 50)):
        in_parts.add(profiles[rows], variance[rows], groups=groups[rows])
    np.testing.assert_array_equal(whole.values, in_parts.averages().values)
    for g in range(5):
        inside = groups == g
        alone = mean_of(profiles[inside], variance[inside])
        np.testing.assert_array_equal(whole.values[g : g + 1], alone.values)


def test_no_profiles_give_gaps():
    result = mean_of(np.empty((0, 4)))
    assert np.isnan(result.values).all()
    dark = mean_of(np.ones((3, 4)), weights=[0.0, 0.0, np.nan])
    assert np.isnan(dark.values).all()


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"variance": -1.0}, "variance"),
        ({"variance": np.ones((3, 3))}, "variance"),
        ({"shared_variance": [-1.0, 0.0]}, "shared_variance"),
        ({"weights": -np.ones(4)}, "weights"),
        ({"weights": np.ones(3)}, "weights"),
        ({"groups": [0, 0]}, "profiles"),
        ({"profiles": np.array([["a", "b"]])}, "profiles"),
    ],
)
def test_impossible_arguments_are_refused(change, field):
    arguments = {"profiles": np.ones((4, 2)), "variance": 1.0, "groups": [0] * 4} | change
    sums = RunningMean((1, 2))
    with pytest.raises(RetrievalInputError) as error:
        sums.add(arguments.pop("profiles"), arguments.pop("variance"), **arguments)
    assert error.value.field == field
