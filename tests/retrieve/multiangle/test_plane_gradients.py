"""Gradient errors of vertical planes, from the scatter between them."""

from __future__ import annotations

import numpy as np
import pytest

from lidarops.retrieve.multiangle._horizontal_variation import gradient_scale


def test_three_planes_of_one_cycle_show_the_gradient_error_roughly():
    rng = np.random.default_rng(1)
    depth = np.repeat(rng.normal(0.0, 0.05, (4000, 3, 1, 1)), 20, axis=3)
    noise, gradient = np.zeros((3, 1, 20)), np.full((3, 1, 20), 0.05)
    scale = np.array([gradient_scale(scene, noise, gradient)[10] for scene in depth])
    assert np.mean(scale**2) == pytest.approx(1.0, abs=0.05)
    assert (scale < 0.5).mean() == pytest.approx(0.22, abs=0.02)
