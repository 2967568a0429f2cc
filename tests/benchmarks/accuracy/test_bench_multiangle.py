"""Benchmark of scans: simulation, peers, statistics and pages."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline
from support.scan_arguments import retrieve_optical_depth

from benchmarks.accuracy import multiangle
from benchmarks.harness.figure import Figure, clustered_share, mean_by_block, root_by_block
from benchmarks.harness.results import Effort
from benchmarks.scenes import scans

pytestmark = pytest.mark.slow

SHORT = scans.clear(3000.0, bins=25)


@pytest.fixture(scope="module")
def study():
    """Return the accuracy benchmark with few profiles."""
    steps = []
    scenes = (SHORT, scans.cloud())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scans, "scan_scenes", lambda: scenes)
        result = multiangle.measure_multiangle(Effort(progress=steps.append), blocks=3, profiles=8)
    assert steps == [1] * len(scenes)
    return result


def without_noise(scene):
    return replace(scene, ratio=math.inf, inhomogeneity=0.0, correlation=0.0)


# Simulation -----------------------------------------------------------------------------------


def test_without_noise_signals_obey_the_lidar_equation():
    scene = without_noise(SHORT)
    scan = scene.draw(2, 1)
    assert not scan.variance.any()
    assert np.array_equal(scan.signal[0], scan.signal[1])
    path = 1.0 / np.cos(np.radians(scene.zenith_angle))
    expected = scene.backscatter * np.exp(-2.0 * np.outer(path, scene.optical_depth))
    assert scan.signal[0] == pytest.approx(expected, rel=1e-12)


def test_noise_and_scatter_are_as_stated_and_repeat():
    scene = replace(SHORT, inhomogeneity=0.0)
    scan = scene.draw(3000, 2)
    clean = without_noise(scene).draw(1, 2).signal
    assert np.array_equal(scan.signal, scene.draw(3000, 2).signal)
    assert not np.array_equal(scan.signal, scene.draw(3000, 3).signal)
    deviation = (scan.signal - clean) / np.sqrt(scan.variance)
    assert deviation.std(axis=0) == pytest.approx(1.0, abs=0.08)
    zenith = clean[0, 0] / np.sqrt(scan.variance[0, 0])
    # Constant noise grows with the square of range after range correction.
    assert np.interp(1000.0, scene.altitude, zenith) == pytest.approx(3000.0, rel=0.02)
    air = scans.cloud(0.8)
    logarithm = np.log(air.draw(4000, 4).signal / without_noise(air).draw(1, 4).signal)
    assert logarithm.std() == pytest.approx(scans.CLOUD_SCATTER, rel=0.01)
    lag_one = np.mean(logarithm[..., 1:] * logarithm[..., :-1]) / logarithm.var()
    assert lag_one == pytest.approx(0.8, abs=0.01)


def test_gradient_variation_and_outliers_enter_the_logarithm():
    scene = without_noise(SHORT)
    base = np.log(scene.draw(1, 1).signal)
    leaning = np.log(replace(scene, gradient=1e-5).draw(1, 1).signal) - base
    away = np.outer(np.tan(np.radians(scene.zenith_angle)), scene.altitude)
    assert leaning[0] == pytest.approx(1e-5 * away, abs=1e-12)
    hit = np.log(replace(scene, outliers=0.1).draw(400, 1).signal) - base
    assert np.mean(hit > 1e-6) == pytest.approx(0.1, abs=0.005)
    assert hit[hit > 1e-6].min() >= 0.3
    assert hit.max() <= 1.0
    scattered = replace(scans.cloud(), variation=1.0)
    spread = np.log(scattered.draw(2000, 1).signal).std(axis=0)
    alone = np.log(scans.cloud().draw(2000, 1).signal).std(axis=0)
    # The effect of variable extinction accumulates along the path.
    assert np.all(spread[:, -1] > 1.5 * alone[:, -1])


def test_random_scenes_cover_the_documented_ranges():
    scenes = [scans.random_scene(seed, 2) for seed in range(200)]
    assert {scene.path.size for scene in scenes} == set(range(3, 21))
    assert min(scene.zenith_angle.max() for scene in scenes) < 20.0
    assert 70.0 < max(scene.zenith_angle.max() for scene in scenes) <= 75.0
    for name, share in (("outliers", 0.5), ("gradient", 0.6), ("variation", 0.15)):
        raised = np.mean([getattr(scene, name) != 0.0 for scene in scenes])
        assert raised == pytest.approx(share, abs=0.12)
    scatters = np.array([scene.inhomogeneity for scene in scenes])
    assert np.median(scatters) == pytest.approx(0.2, abs=0.03)
    assert scatters.max() <= 0.4
    same = scans.random_scene(3, 2)
    assert np.array_equal(same.extinction, scenes[3].extinction)
    assert not np.array_equal(same.extinction[0], same.extinction[1])


# Methods and peers ----------------------------------------------------------------------------


@pytest.mark.parametrize("scene", [SHORT, scans.cloud()], ids=lambda scene: scene.label)
def test_straight_lines_agree_without_noise(scene):
    scan = without_noise(scene).draw(1, 1)
    ours = scans.retrieve(scan, "kano_hamilton").optical_depth
    assert np.abs(multiangle.lines(scan)[0] - ours).max() < 1e-9
    assert ours[0] == pytest.approx(scene.optical_depth, abs=1e-9)


def test_the_line_and_its_error_equal_ours_for_known_weights():
    scene = scans.cloud()
    scan = scene.draw(3, 5)
    depth, error = multiangle.lines(scan)
    ours = retrieve_optical_depth(
        scan.signal,
        scene.zenith_angle,
        scene.altitude,
        variance=scan.variance,
        method="kano_hamilton",
        inhomogeneity=scene.inhomogeneity,
    )
    assert np.abs(depth - ours.optical_depth).max() < 1e-6
    assert error == pytest.approx(ours.optical_depth_standard_error, rel=1e-6)


def test_peers_leave_out_samples_in_noise():
    scene = replace(SHORT, ratio=5.0)
    scan = scene.draw(2, 7)
    line, _ = multiangle.lines(scan)
    solvable = (scan.signal > 3.0 * np.sqrt(scan.variance)).sum(axis=1) >= 3
    assert np.array_equal(np.isfinite(line), solvable)
    assert 0 < solvable.sum() < solvable.size


def test_the_common_spline_is_as_good_as_a_spline_for_each_profile():
    scene = scans.clear(3000.0, bins=101)
    scan = scene.draw(30, 8)
    line, error = multiangle.lines(scan)
    kilometres, weight = 1e-3 * scene.altitude, 1.0 / error**2
    alone = [
        make_smoothing_spline(kilometres, depth, w=of_depth / of_depth.mean())(kilometres)
        for depth, of_depth in zip(line, weight, strict=True)
    ]
    together, _ = multiangle.spline(scan)
    rmse, rmse_alone = (
        np.sqrt(np.mean((depth - scene.optical_depth) ** 2)) for depth in (together, alone)
    )
    assert rmse < rmse_alone


def test_methods_are_compared_where_all_have_a_value():
    scene = scans.clear(300.0, bins=150)
    works = {work.method: work for work in multiangle.compare(scene, 2, 12, 1)}
    joint, spline = works["joint"], works[multiangle.SPLINE]
    assert spline.more["solved"].value < joint.more["solved"].value
    assert joint.error.value < joint.more[multiangle.DEPTH].value
    assert spline.error.value == pytest.approx(spline.more[multiangle.DEPTH].value, rel=0.1)


# Statistics -----------------------------------------------------------------------------------


def test_errors_come_from_independent_blocks():
    values, kept = np.array([1.0, 2.0, math.nan, 6.0]), np.array([True, True, False, True])
    figure = mean_by_block(np.nan_to_num(values), kept, 1)
    assert figure.value == pytest.approx(3.0)
    square = root_by_block(np.array([1.0, 3.0]), np.ones(2, bool), 1)
    assert (square.value, square.error) == pytest.approx((math.sqrt(5.0), 4.0 / math.sqrt(20.0)))
    assert root_by_block(np.zeros(2), np.ones(2, bool), 1) == Figure(0.0, 0.0)
    assert root_by_block(np.zeros(2), np.zeros(2, bool), 1) is None
    part = clustered_share(np.array([10.0, 0.0, 30.0]), np.array([100.0, 100.0, 200.0]))
    assert part.value == pytest.approx(0.1)
    assert part.error == pytest.approx(math.sqrt(0 + 100 + 100) / 400)
    none = clustered_share(np.zeros(2), np.full(2, 50.0))
    assert none.value == 0.0
    # Of a share at the limit, no event is seen in 5 percent of the cases.
    assert (1.0 - 2.0 * none.error) ** 100 == pytest.approx(0.05, rel=0.1)
    empty = clustered_share(np.zeros(2), np.zeros(2))
    assert (empty.value, empty.error) == (0.0, 0.0)


# Results --------------------------------------------------------------------------------------


def test_every_method_is_scored_in_every_scene(study):
    names = [*multiangle.scan_methods(), *multiangle.PEERS]
    for scene in (SHORT.label, scans.cloud().label):
        works = {work.method: work for work in study.works if work.setting == scene}
        assert list(works) == names

        def value(method, quantity, works=works):
            return works[method].more[quantity].value

        lines, spline = (
            value(f"straight lines, {name}", multiangle.DEPTH) for name in ("numpy", "GCV spline")
        )
        # In the clear scene a spline through all altitudes is the best one.
        assert spline < (1.0 if scene == SHORT.label else 0.95) * lines
        line = value("kano_hamilton", multiangle.DEPTH)
        assert value("kano_hamilton", "solved") == 1.0
        assert value("joint", multiangle.DEPTH) < 0.6 * line
        assert value("joint", multiangle.SLOPE) < 0.2 * value("kano_hamilton", multiangle.SLOPE)
        assert works["kano_hamilton"].coverage.value == pytest.approx(0.95, abs=0.06)
        bias = works["kano_hamilton"].more["mean error"]
        assert abs(bias.value) < 5.0 * bias.error + 1e-3
        assert works[multiangle.SPLINE].coverage is None
        assert works[multiangle.SPLINE].more["within 1"] is None
        assert value("two_angle", multiangle.DEPTH) > line
        assert value("mld", "mean error") < 0.0
        assert all(work.time.value > 0 for work in works.values())
