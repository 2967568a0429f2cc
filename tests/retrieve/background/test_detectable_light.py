"""Detection of backscatter on a few profiles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.background.detectable_light import detect_light, spaced_indices

RANGE = (np.arange(1000) + 0.5) * 7.5
SHAPE = (20, RANGE.size)


def noise(seed=0, level=3.0, sd=0.1):
    return level + sd * np.random.default_rng(seed).standard_normal(SHAPE)


def flags():
    return np.zeros(SHAPE, np.int32)


def test_pure_noise_has_unit_significance():
    variance = np.full(SHAPE, 0.01)
    largest = [
        detect_light(noise(seed)[:1], variance[:1], flags()[:1], RANGE, 500.0, 4000.0).significance
        for seed in range(400)
    ]
    # Half of the values are negative, which count as 0.
    assert np.mean(np.square(largest)) == pytest.approx(0.5, abs=0.12)


def test_significance_is_that_of_least_squares():
    amplitude = 4e4
    power = 3.0 + amplitude / RANGE**2 + np.zeros(SHAPE)
    detection = detect_light(power, np.full(SHAPE, 0.01), flags(), RANGE, 500.0, 4000.0)
    inside = ((RANGE >= 500) & (RANGE <= 4000)) | (np.arange(RANGE.size) >= 900)
    design = np.stack([np.ones(inside.sum()), RANGE[inside] ** -2.0], axis=1)
    error = np.sqrt(np.linalg.inv(design.T @ design / 0.01)[1, 1])
    assert detection.significance == pytest.approx(amplitude / error, rel=1e-6)
    assert detection.profiles == 20


def test_missing_profiles_do_not_count():
    power, quality = noise(), flags()
    power[:4] = np.nan
    quality[4:6] = int(Quality.INPUT_MISSING)
    variance = np.full(SHAPE, 0.01)
    assert detect_light(power, variance, quality, RANGE, 500.0, 4000.0).profiles == 14
    empty = detect_light(np.full(SHAPE, np.nan), variance, flags(), RANGE, 500.0, 4000.0)
    assert (empty.profiles, empty.significance) == (0, 0.0)
    assert detect_light(power, variance, quality, RANGE, 9e5, 1e6).profiles == 0


@given(st.integers(1, 500), st.integers(1, 40))
def test_spaced_profiles_are_few_and_hold_both_ends(count, most):
    indices = spaced_indices(count, most)
    assert len(indices) <= min(count, most)
    assert np.all(np.diff(indices) > 0)
    assert indices[0] == 0
    if most > 1:
        assert indices[-1] == count - 1


def test_wrong_shapes_are_refused():
    with pytest.raises(RetrievalInputError, match="do not fit"):
        detect_light(noise(), noise()[:, :5], flags(), RANGE, 0.0, 1e3)
    with pytest.raises(RetrievalInputError, match="cannot be chosen"):
        spaced_indices(0, 3)


def test_saturated_bins_count_though_they_have_no_values():
    power, quality = noise(), flags()
    power[:, 100:500] = np.nan
    quality[:, 100:500] = int(Quality.SATURATED | Quality.INPUT_MISSING)
    detection = detect_light(power, np.full(SHAPE, 0.01), quality, RANGE, 1000.0, 3000.0)
    assert (detection.profiles, detection.significance) == (20, 0.0)


def test_bins_between_the_stretch_and_the_tail_are_not_used():
    power, variance = noise(), np.full(SHAPE, 0.01)
    plain = detect_light(power, variance, flags(), RANGE, 500.0, 4000.0)
    power[:, 600:850] = 1e9
    assert detect_light(power, variance, flags(), RANGE, 500.0, 4000.0) == plain
