"""False values where the model holds: enough values to find twice the target."""

from __future__ import annotations

from itertools import takewhile

import numpy as np
import pytest
from scipy import stats

from lidarops.bench.stability import (
    random_elastic,
    random_homogeneous,
    random_networks,
    random_scans,
)
from lidarops.bench.stability.random_scenes import FALSE, SATISFIED
from lidarops.flags import Quality, rejecting

FOUND = 0.95
"""Probability that twice the target is found."""


def most_false(values):
    """Return the largest count of false values that twice the target seldom stays below."""
    counts = np.arange(values)
    return int(np.sum(stats.binom.cdf(counts, values, 2.0 * SATISFIED) <= 1.0 - FOUND)) - 1


def test_twice_the_target_is_found_and_a_third_of_it_is_not():
    for values in (5_000, 10_000, 50_000):
        limit = most_false(values)
        assert stats.binom.sf(limit, values, 2.0 * SATISFIED) >= FOUND
        assert stats.binom.sf(limit + 1, values, 2.0 * SATISFIED) < FOUND
        assert stats.binom.sf(limit, values, SATISFIED / 3.0) < 0.03
    # The former sample: 900 values, of which fewer than 0.5 % had to be false.
    assert most_false(900) < 0


def independent(values):
    """Return errors over stated ones of values without a flag, one of each profile.

    The values of one profile share its reference and its background.
    """
    rejected = (values.bits & rejecting((*Quality, *values.own))) != 0
    good = np.isfinite(values.error) & ~rejected
    if values.uncertain is not None:
        good &= ~values.uncertain
    with np.errstate(invalid="ignore", divide="ignore"):
        errors = np.where(good, np.abs(values.error) / values.random, np.nan)
    if errors.ndim == 1:
        return errors[np.isfinite(errors)]
    order = np.random.default_rng(1).permutation(errors.shape[1])
    first = np.argmax(np.isfinite(errors[:, order]), axis=1)
    chosen = errors[:, order][np.arange(len(errors)), first]
    return chosen[np.isfinite(chosen)]


@pytest.mark.parametrize(
    ("score", "clusters", "profiles"),
    [
        pytest.param(random_homogeneous.score_homogeneous, 60, 100, id="homogeneous"),
        pytest.param(random_elastic.score_elastic, 500, 8, id="elastic"),
        pytest.param(random_scans.score_scans, 350, 8, id="multi-angle"),
        pytest.param(random_networks.score_networks, 70, 50, id="network"),
    ],
)
@pytest.mark.slow
def test_where_the_model_holds_few_values_are_false(score, clusters, profiles):
    errors = {}
    for cluster in range(clusters):
        # The first classes are those where the model holds.
        scored = takewhile(lambda chunk: chunk[0].failure.satisfied, score(cluster, profiles))
        for values, _ in scored:
            errors.setdefault(values.quantity, []).append(independent(values))
    assert errors
    for quantity, parts in errors.items():
        kept = np.concatenate(parts)
        false = np.count_nonzero(~(kept <= FALSE))
        assert most_false(kept.size) >= 0, (quantity, kept.size)
        assert false <= most_false(kept.size), (quantity, kept.size, false)
