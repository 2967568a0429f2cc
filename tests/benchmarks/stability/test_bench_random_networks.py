"""Random networks of the stability benchmark that once had false values without a flag."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.scenes import lidar_networks
from benchmarks.scenes.lidar_networks import score_networks
from lidarops.retrieve.network import _block_solution, _changing_field
from lidarops.retrieve.network.thresholds import THRESHOLDS

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("cluster", "failure", "false_before"),
    [
        # Curvature of the field over the network, which looks like attenuation to the beams.
        (89, "none, plume", 863),
        # Three crossings in thin air that only the prior determines.
        (523, "outliers", 96),
        # Thin air, where noise shifts all profiles to one side of their mean.
        (647, "plume that drifts within a block", 124),
        (169, "outliers", 106),
        # The same, in the profiles with the highest values.
        (623, "none, layered", 127),
        # A profile with almost no signal in a bin of a beam.
        (338, "plume that drifts within a block", 22),
    ],
)
def test_networks_with_once_too_small_errors_state_them(
    cluster, failure, false_before, monkeypatch
):
    """These random networks once had almost all false values of the benchmark."""

    def scored_values():
        return next(
            values for values in score_networks(cluster, 50) if values.failure.name == failure
        )

    scored = scored_values()
    kept = np.isfinite(scored.error) & (scored.bits == 0)
    false = kept & (np.abs(scored.error) > 4.0 * scored.random)
    assert false.sum() <= 0.01 * false_before
    if kept.sum() > 50:
        # The stated errors are not much too large, without the error of an overlap that is right.
        known = THRESHOLDS._replace(default_overlap_error=0.0)
        monkeypatch.setattr(_block_solution, "THRESHOLDS", known)
        scored = scored_values()
        assert np.median((scored.random / np.abs(scored.error))[kept]) < 2.0


def test_random_networks_state_the_errors_of_thin_layers():
    scored = [
        values
        for cluster in range(24)
        for values in score_networks(cluster, 10)
        if values.failure.name == "layer of a few bins"
    ]
    assert 6 < len(scored) <= 12
    kept = [np.isfinite(values.error) & (values.bits == 0) for values in scored]
    errors = np.concatenate(
        [np.abs(values.error)[k] / values.random[k] for values, k in zip(scored, kept, strict=True)]
    )
    assert errors.size > 200
    assert np.mean(errors > 4.0) < 0.005


@pytest.mark.parametrize(("cluster", "length", "errors"), [(102, 3, 1.96), (20, 1, 4.0)])
def test_the_errors_of_stratified_air_are_right(cluster, length, errors, monkeypatch):
    """Without a prior for it, values of layered air deviate by more than their errors."""

    def beyond():
        (values,) = lidar_networks.score_short_blocks(
            cluster, 6, draw_air=lidar_networks.layered, name="layered", length=length
        )
        kept = np.isfinite(values.error) & (values.bits == 0)
        assert kept.mean() > 0.5
        return np.mean((np.abs(values.error) > errors * values.random)[kept])

    assert beyond() < 0.05
    changed = THRESHOLDS._replace(stratified=(0.1, 400.0))
    monkeypatch.setattr(_changing_field, "THRESHOLDS", changed)
    assert beyond() > 0.3
