"""Whether extinction varies along the paths: false alarms, and what must be seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import erfc

from lidarops.bench.accuracy import multiangle_cases as cases
from lidarops.retrieve.multiangle import _block, slant_paths
from lidarops.retrieve.multiangle._path_variation import GROWTH, path_variation_from
from lidarops.retrieve.multiangle.optical_depth import retrieve_optical_depth


def varies(scan: cases.Scan) -> bool:
    grid = slant_paths.make_scan(scan.scene.zenith_angle, scan.scene.altitude)
    beams = _block.make_beam_block(scan.signal, scan.variance, grid)
    found = path_variation_from(beams, _block.regress(beams, inhomogeneity=None, robust=True))
    return found is not None


def test_false_alarms_are_fewer_than_one_in_a_hundred():
    """In scenes with gradients, outliers, weak light and all correlations along height."""
    told = [
        varies(replace(cases.random_scene(seed, 8), variation=0.0).draw(8, seed, 6))
        for seed in range(300)
    ]
    assert np.mean(told) <= 0.01


@pytest.mark.parametrize("largest", [15.0, 30.0, 45.0])
@pytest.mark.parametrize("correlation", [0.5, 0.8])
def test_variation_in_a_cloud_is_seen(largest, correlation):
    scene = cases.cloud(correlation, largest=largest)
    scattered = replace(scene, variation=1.0)
    assert all(varies(scattered.draw(8, seed, 1)) for seed in range(8))
    assert all(varies(replace(scene, variation=0.5).draw(24, seed, 2)) for seed in range(4))
    assert not any(varies(scene.draw(8, seed, 1)) for seed in range(8))


def test_variation_is_seen_where_scatter_itself_grows_little():
    """Where layers scatter independently: what beams have lost adds up to little, but to much in
    the mean over altitudes, which is what the optical depth of a smooth profile follows."""
    scene = replace(cases.cloud(0.0, largest=45.0), variation=0.5)
    assert all(varies(scene.draw(24, seed, 5)) for seed in range(8))
    found = cases.retrieve(scene.draw(24, 0, 5), cases.JOINT)
    lower, upper = found.inhomogeneity[0, :13].mean(), found.inhomogeneity[0, -13:].mean()
    assert (upper / lower) ** 2 < GROWTH


def test_variation_is_seen_in_most_random_clouds():
    """With 3 to 20 beams, outliers, gradients, and all scatters and correlations."""
    told = []
    for seed in range(120):
        scene = cases.random_scene(seed, 8)
        if scene.backscatter.std() == 0.0:
            strength = 0.3 + 0.7 * np.random.default_rng(seed).random()
            told.append(varies(replace(scene, variation=strength).draw(8, seed, 6)))
    assert np.mean(told) >= 0.75


def test_what_all_profiles_share_leaves_the_lower_altitudes_alone():
    """As of a background that is a little off, always by the same."""
    scene = cases.clear(1e5)
    scan = scene.draw(16, 1)
    slant = scene.path[:, np.newaxis] * scene.altitude
    dim = scan.signal.mean(axis=0)[-1, -1] / slant[-1, -1] ** 2
    offset = 0.3 * dim * np.random.default_rng(3).normal(size=(12, 1)) * slant**2
    found = cases.retrieve(replace(scan, signal=scan.signal + offset), cases.JOINT)
    doubted = found.flags.poor_stratification
    assert not doubted[:, :60].any()
    assert doubted[:, 70:].all()


def test_noise_that_is_larger_than_stated_aloft_is_no_variation():
    """As of a background that is a little off: 20 percent more in the logarithm's spread."""
    for seed in range(10):
        scene = replace(cases.clear(30.0, bins=100), inhomogeneity=0.002)
        scan = scene.draw(20, seed, 3)
        assert not varies(replace(scan, variance=scan.variance / 1.2**2))


def test_extinction_is_withheld_whatever_the_method():
    scan = replace(cases.cloud(0.8), variation=1.0).draw(16, 4)
    for method in ("two_angle", "kano_hamilton", "joint", "mld"):
        found = retrieve_optical_depth(
            scan.signal,
            scan.scene.zenith_angle,
            scan.scene.altitude,
            variance=scan.variance,
            method=method,
        )
        assert found.flags.poor_stratification.all()
        assert np.isfinite(found.optical_depth).any()
        assert np.isnan(found.extinction).all()
        assert np.isnan(found.extinction_standard_error).all()


def test_robust_passes_run_by_chance_in_few_clean_blocks_and_wherever_outliers_are():
    """By a probability of 1 percent, however many residuals a block holds."""
    assert _block.outlier_limit(100) == _block.OUTLYING
    counts = 10 ** np.arange(4, 9)
    limits = np.array([_block.outlier_limit(int(count)) for count in counts])
    np.testing.assert_allclose(counts * erfc(limits / np.sqrt(2.0)), 0.01, rtol=1e-6)

    def ran(scene: cases.Scene, profiles: int, seed: int) -> bool:
        found = cases.retrieve(scene.draw(profiles, seed), cases.KANO_HAMILTON)
        return any(step.ran for step in found.steps if step.step == "robust_passes")

    clean = [ran(cases.clear(ratio), 60, seed) for ratio in (3000.0, 300.0) for seed in range(8)]
    assert np.mean(clean) <= 0.1
    assert all(ran(cases.clear(3000.0, outliers=0.01), 8, seed) for seed in range(4))


@pytest.mark.parametrize("scatter", [0.0, 0.005])
def test_a_scatter_that_is_told_too_large_makes_no_noise_a_variation(scatter):
    scene = replace(cases.clear(1e5, bins=60), inhomogeneity=scatter)
    noise = np.linspace(1e-3, 3e-2, 60)
    rng = np.random.default_rng(4)
    air = np.exp(scatter * rng.normal(size=(8, scene.zenith_angle.size, 60)))
    clean = np.exp(-2.0 * np.outer(scene.path, scene.optical_depth)) * air
    signal = clean * (1.0 + noise * rng.normal(size=clean.shape))
    found = retrieve_optical_depth(
        signal,
        scene.zenith_angle,
        scene.altitude,
        variance=(noise * clean) ** 2,
        inhomogeneity=0.05,
    )
    assert not found.flags.poor_stratification.any()
    assert np.isfinite(found.extinction).any()


def test_signals_without_any_scatter_are_no_variation():
    scene = cases.clear(1e5, bins=49)
    found = retrieve_optical_depth(
        np.ones((6, scene.zenith_angle.size, 49)),
        scene.zenith_angle,
        scene.altitude,
        variance=np.full((6, scene.zenith_angle.size, 49), 1e-6),
        inhomogeneity=0.05,
    )
    assert not found.flags.poor_stratification.any()
