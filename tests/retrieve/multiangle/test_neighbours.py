"""Whether neighbouring beams scatter alike: false alarms, and patches that must be seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lidarops.bench.accuracy import multiangle_cases as cases
from lidarops.retrieve.multiangle import _block, slant_paths
from lidarops.retrieve.multiangle._neighbours import neighbours_alike


def alike(scan: cases.Scan) -> bool:
    grid = slant_paths.make_scan(scan.scene.zenith_angle, scan.scene.altitude)
    beams = _block.make_beam_block(scan.signal, scan.variance, grid)
    return neighbours_alike(beams, _block.regress(beams, inhomogeneity=None, robust=True))


def patches(scene: cases.Scene, profiles: int, width: float, seed: int) -> cases.Scan:
    """Scans of air that is alike over a width (m), another one for each profile."""
    rng = np.random.default_rng(seed)
    away = scene.altitude * np.tan(np.radians(scene.zenith_angle))[:, np.newaxis]
    air = np.empty((profiles, *away.shape))
    for k in range(away.shape[1]):
        apart = np.abs(away[:, k] - away[:, k, np.newaxis])
        root = np.linalg.cholesky(np.exp(-apart / width) + 1e-12 * np.eye(len(apart)))
        air[:, :, k] = rng.normal(size=(profiles, len(apart))) @ root.T
    return scene.seen(scene.inhomogeneity * air, rng)


def test_independent_beams_are_no_patches():
    """In scenes with gradients, outliers, weak light and varying extinction."""
    told = [alike(cases.random_scene(seed, 8).draw(8, seed, 6)) for seed in range(400)]
    assert np.mean(told) <= 0.01


@pytest.mark.parametrize("profiles", [8, 24])
def test_patches_wider_than_beams_are_apart_are_flagged(profiles):
    scene = replace(
        cases.clear(3000.0, bins=60),
        zenith_angle=np.array([-70.0, -60, -45, -30, -15, 0, 15, 30, 45, 60, 70]),
    )
    for seed in range(4):
        assert alike(patches(scene, profiles, 1000.0, seed))
        assert not alike(patches(scene, profiles, 1.0, seed))
    found = cases.retrieve(patches(scene, profiles, 1000.0, 9), cases.JOINT)
    assert found.flags.poor_stratification.all()
    assert np.isfinite(found.optical_depth).any()
    assert np.isnan(found.extinction).all()


def test_few_profiles_tell_nothing():
    assert not alike(patches(cases.clear(3000.0, bins=60), 3, 1000.0, 1))
