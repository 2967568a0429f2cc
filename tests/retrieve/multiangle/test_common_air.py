"""Channels of one scan see the same air, but weigh its beams by their own noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.oracles.multiangle import clear_scene, correlated


@pytest.mark.parametrize(
    ("method", "profiles"), [("joint", 16), ("joint", 2), ("kano_hamilton", 2)]
)
def test_channels_differ_by_noise_and_the_smaller_part_of_the_air(method, profiles):
    scene = replace(clear_scene(3000.0), inhomogeneity=0.1, correlation=0.9)
    scores = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        shape = (profiles, scene.path.size, scene.altitude.size)
        air = scene.inhomogeneity * correlated(rng, shape, scene.correlation)
        bright, dark = (
            replace(scene, ratio=ratio).observe(air, rng).retrieve(method)
            for ratio in (3000.0, 300.0)
        )
        square = sum(result.optical_depth_standard_error**2 for result in (bright, dark))
        parts = (result.optical_depth_error_air for result in (bright, dark))
        error = np.sqrt(square - np.maximum(*parts) ** 2)
        scores.append((bright.optical_depth - dark.optical_depth) / error)
    assert 0.75 < np.sqrt(np.nanmean(np.square(scores))) < 1.05
