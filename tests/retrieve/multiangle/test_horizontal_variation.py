"""Detection of extinction that varies along the paths: false alarms, and cases to detect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.cases import each
from support.oracles.multiangle import (
    Scan,
    clear_scene,
    cloud_scene,
    random_scene,
)
from support.scan_arguments import retrieve_optical_depth

from lidarops.retrieve.multiangle._horizontal_variation import path_variation_from
from lidarops.retrieve.multiangle.flags import MultiAngleQuality
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS


def varies(scan: Scan) -> bool:
    return path_variation_from(*scan.regress()) is not None


def test_false_alarms_are_fewer_than_one_in_a_hundred():
    """In scenes with gradients, outliers, weak light and any correlation along altitude."""
    alarms = [
        varies(replace(random_scene(seed, 8), variation=0.0).draw(8, seed, 6))
        for seed in range(300)
    ]
    assert np.mean(alarms) <= 0.01


@each("largest", [15.0, 30.0, 45.0])
@each("correlation", [0.5, 0.8])
def test_variation_in_a_cloud_is_detected(largest, correlation):
    scene = cloud_scene(correlation, largest=largest)
    variable = replace(scene, variation=1.0)
    assert all(varies(variable.draw(8, seed, 1)) for seed in range(8))
    assert all(varies(replace(scene, variation=0.5).draw(24, seed, 2)) for seed in range(4))
    assert not any(varies(scene.draw(8, seed, 1)) for seed in range(8))


def test_variation_is_detected_where_scatter_itself_grows_little():
    """Layers scatter independently: the differences of attenuation are small at each altitude, but
    large in the mean over altitudes, which the optical depth of a smooth profile follows."""
    scene = replace(cloud_scene(0.0, largest=45.0), variation=0.5)
    assert all(varies(scene.draw(24, seed, 5)) for seed in range(8))
    inhomogeneity = scene.draw(24, 0, 5).retrieve().inhomogeneity[0]
    lower, upper = inhomogeneity[:13].mean(), inhomogeneity[-13:].mean()
    assert (upper / lower) ** 2 < THRESHOLDS.growth


def test_variation_is_detected_in_most_random_clouds():
    """With 3 to 20 beams, outliers, gradients, and all scatters and correlations."""
    detections = []
    for seed in range(120):
        scene = random_scene(seed, 8)
        if scene.backscatter.std() == 0.0:
            strength = 0.3 + 0.7 * np.random.default_rng(seed).random()
            detections.append(varies(replace(scene, variation=strength).draw(8, seed, 6)))
    assert np.mean(detections) >= 0.75


def test_an_error_common_to_all_profiles_leaves_the_lower_altitudes_alone():
    """Such as a constant error of the background."""
    scene = clear_scene(1e5)
    scan = scene.draw(16, 1)
    slant = scene.path[:, np.newaxis] * scene.altitude
    dim = scan.signal.mean(axis=0)[-1, -1] / slant[-1, -1] ** 2
    offset = 0.3 * dim * np.random.default_rng(3).normal(size=(12, 1)) * slant**2
    result = replace(scan, signal=scan.signal + offset).retrieve()
    flagged = result.raised(MultiAngleQuality.POOR_STRATIFICATION)
    assert not flagged[:, :60].any()
    assert flagged[:, 70:].all()


def test_noise_that_is_larger_than_stated_aloft_is_no_variation():
    """As with an error of the background: the logarithm scatters 20 percent more than stated."""
    for seed in range(10):
        scene = replace(clear_scene(30.0, bins=100), inhomogeneity=0.002)
        scan = scene.draw(20, seed, 3)
        assert not varies(replace(scan, variance=scan.variance / 1.2**2))


def test_extinction_is_withheld_whatever_the_method():
    scan = replace(cloud_scene(0.8), variation=1.0).draw(16, 4)
    for method in ("two_angle", "kano_hamilton", "joint", "mld"):
        result = scan.retrieve(method)
        assert result.raised(MultiAngleQuality.POOR_STRATIFICATION).all()
        assert np.isfinite(result.optical_depth).any()
        assert np.isnan(result.extinction).all()
        assert np.isnan(result.extinction_standard_error).all()


@pytest.mark.parametrize("scatter", [0.0, 0.005])
def test_noise_is_no_variation_where_the_given_scatter_is_too_large(scatter):
    scene = replace(clear_scene(1e5, bins=60), inhomogeneity=scatter)
    noise = np.linspace(1e-3, 3e-2, 60)
    rng = np.random.default_rng(4)
    air = np.exp(scatter * rng.normal(size=(8, scene.zenith_angle.size, 60)))
    clean = np.exp(-2.0 * np.outer(scene.path, scene.optical_depth)) * air
    signal = clean * (1.0 + noise * rng.normal(size=clean.shape))
    result = retrieve_optical_depth(
        signal,
        scene.zenith_angle,
        scene.altitude,
        variance=(noise * clean) ** 2,
        inhomogeneity=0.05,
    )
    assert not result.raised(MultiAngleQuality.POOR_STRATIFICATION).any()
    assert np.isfinite(result.extinction).any()


def test_signals_without_any_scatter_are_no_variation():
    scene = clear_scene(1e5, bins=49)
    result = retrieve_optical_depth(
        np.ones((6, scene.zenith_angle.size, 49)),
        scene.zenith_angle,
        scene.altitude,
        variance=np.full((6, scene.zenith_angle.size, 49), 1e-6),
        inhomogeneity=0.05,
    )
    assert not result.raised(MultiAngleQuality.POOR_STRATIFICATION).any()
