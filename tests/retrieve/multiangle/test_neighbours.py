"""Detection of neighbouring beams that scatter alike: false alarms, and patches to detect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.oracles.multiangle import Scan, ScanScene, clear_scene, random_scene

from lidarops.retrieve.multiangle._neighbours import neighbours_alike


def alike(scan: Scan) -> bool:
    return neighbours_alike(*scan.regress())


def patches(scene: ScanScene, profiles: int, width: float, seed: int) -> Scan:
    """Return scans of air that is correlated over a width (m), other air for each profile."""
    rng = np.random.default_rng(seed)
    away = scene.altitude * np.tan(np.radians(scene.zenith_angle))[:, np.newaxis]
    air = np.empty((profiles, *away.shape))
    for k in range(away.shape[1]):
        apart = np.abs(away[:, k] - away[:, k, np.newaxis])
        root = np.linalg.cholesky(np.exp(-apart / width) + 1e-12 * np.eye(len(apart)))
        air[:, :, k] = rng.normal(size=(profiles, len(apart))) @ root.T
    return scene.observe(scene.inhomogeneity * air, rng)


def test_independent_beams_are_no_patches():
    """In scenes with gradients, outliers, weak light and varying extinction."""
    alarms = [alike(random_scene(seed, 8).draw(8, seed, 6)) for seed in range(400)]
    assert np.mean(alarms) <= 0.01


@pytest.mark.parametrize("profiles", [8, 24])
def test_patches_wider_than_the_beam_distance_are_flagged(profiles):
    scene = replace(
        clear_scene(3000.0, bins=60),
        zenith_angle=np.array([-70.0, -60, -45, -30, -15, 0, 15, 30, 45, 60, 70]),
    )
    for seed in range(4):
        assert alike(patches(scene, profiles, 1000.0, seed))
        assert not alike(patches(scene, profiles, 1.0, seed))
    result = patches(scene, profiles, 1000.0, 9).retrieve()
    assert result.flags.poor_stratification.all()
    assert np.isfinite(result.optical_depth).any()
    assert np.isnan(result.extinction).all()


def test_few_profiles_are_not_tested():
    assert not alike(patches(clear_scene(3000.0, bins=60), 3, 1000.0, 1))
