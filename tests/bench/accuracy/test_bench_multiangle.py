"""Benchmark of scans: simulation, peers, statistics and pages."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.integrate import quad

from lidarops.bench import registry
from lidarops.bench.accuracy import multiangle_cases, multiangle_report, multiangle_scores
from lidarops.bench.accuracy.multiangle_scores import StudySize
from lidarops.bench.harness import results
from lidarops.bench.harness.benchmark import RESULT, Effort
from lidarops.bench.harness.rows import MonteCarloFigure
from lidarops.bench.harness.timing import READ
from lidarops.bench.throughput import retrieval_reports, scan_kernels
from lidarops.reports.benchmark_page import build_benchmark_page
from lidarops.retrieve.multiangle.optical_depth import (
    MultiAngleFlags,
    Regularisation,
    retrieve_optical_depth,
)

SMALL = StudySize(blocks=3, profiles=8, slow=1, published=60, random=6)
SHORT = multiangle_cases.clear(3000.0, bins=25)


@pytest.fixture(scope="module")
def study():
    """Return the accuracy benchmark with few profiles."""
    steps = []
    scenes = (SHORT, multiangle_cases.cloud())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(multiangle_cases, "scan_scenes", lambda: scenes)
        result = multiangle_scores.measure_multiangle(
            Effort(date="2024-01-01", progress=steps.append), size=SMALL
        )
    assert steps == [1] * (len(scenes) + 4)
    return result


@pytest.fixture(scope="module")
def timed():
    return scan_kernels.measure_scan_kernels(Effort(date="2024-01-01", repeats=1), batches=(1, 2))


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
    air = multiangle_cases.cloud(0.8)
    logarithm = np.log(air.draw(4000, 4).signal / without_noise(air).draw(1, 4).signal)
    assert logarithm.std() == pytest.approx(multiangle_cases.CLOUD_SCATTER, rel=0.01)
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
    scattered = replace(multiangle_cases.cloud(), variation=1.0)
    spread = np.log(scattered.draw(2000, 1).signal).std(axis=0)
    alone = np.log(multiangle_cases.cloud().draw(2000, 1).signal).std(axis=0)
    # The effect of variable extinction accumulates along the path.
    assert np.all(spread[:, -1] > 1.5 * alone[:, -1])


def test_the_published_cloud_has_its_altitudes_at_the_centres_of_layers():
    scene = multiangle_cases.published_cloud(15.0, 6, 0.1)
    expected = [0.125, 0.5, 1.125, 2.0, 2.875, 3.5, 3.95, 4.275]
    assert scene.optical_depth == pytest.approx(expected)
    assert scene.zenith_angle == pytest.approx([0.0, 3.0, 6.0, 9.0, 12.0, 15.0])


@pytest.mark.parametrize("share", [0.2, 0.25, 0.3])
def test_the_published_scatter_is_that_of_a_uniform_error(share):
    def moment(power):
        return quad(lambda u: math.log(u) ** power, 1.0 - share, 1.0 + share)[0] / (2.0 * share)

    expected = math.sqrt(moment(2) - moment(1) ** 2)
    assert multiangle_cases.uniform_deviation(share) == pytest.approx(expected, rel=1e-8)
    scene = multiangle_cases.published_cloud(30.0, 6, expected)
    scan = multiangle_cases.uniform_scatter(share, 3000, scene, 1)
    ratio = scan.signal / np.exp(-2.0 * np.outer(scene.path, scene.optical_depth))
    assert ratio.max() == pytest.approx(1.0 + share, rel=1e-3)
    assert np.log(ratio).std() == pytest.approx(expected, rel=0.01)


def test_random_scenes_cover_the_documented_ranges():
    scenes = [multiangle_cases.random_scene(seed, 2) for seed in range(200)]
    assert {scene.path.size for scene in scenes} == set(range(3, 21))
    assert min(scene.zenith_angle.max() for scene in scenes) < 20.0
    assert 70.0 < max(scene.zenith_angle.max() for scene in scenes) <= 75.0
    for name, share in (("outliers", 0.5), ("gradient", 0.6), ("variation", 0.15)):
        raised = np.mean([getattr(scene, name) != 0.0 for scene in scenes])
        assert raised == pytest.approx(share, abs=0.12)
    scatters = np.array([scene.inhomogeneity for scene in scenes])
    assert np.median(scatters) == pytest.approx(0.2, abs=0.03)
    calm = [multiangle_cases.random_scene(seed, 2, calm=True) for seed in range(200)]
    assert np.median([scene.inhomogeneity for scene in calm]) == pytest.approx(0.045, rel=0.4)
    assert max(scene.inhomogeneity for scene in scenes + calm) <= 0.4
    same = multiangle_cases.random_scene(3, 2)
    assert np.array_equal(same.extinction, scenes[3].extinction)
    assert not np.array_equal(same.extinction[0], same.extinction[1])


# Methods and peers ----------------------------------------------------------------------------


@pytest.mark.parametrize("scene", [SHORT, multiangle_cases.cloud()], ids=lambda scene: scene.label)
def test_straight_lines_agree_without_noise(scene):
    scan = without_noise(scene).draw(1, 1)
    ours = multiangle_cases.retrieve(scan, "kano_hamilton").optical_depth
    for peer in (multiangle_cases.lstsq, multiangle_cases.bounded):
        assert np.abs(peer(scan).optical_depth - ours).max() < 1e-9
    assert ours[0] == pytest.approx(scene.optical_depth, abs=1e-9)
    weak = multiangle_cases.tikhonov(scan, np.array([1e-14])).optical_depth
    assert np.abs(weak - ours).max() < 1e-9


def test_the_line_and_its_error_equal_ours_for_known_weights():
    scene = multiangle_cases.cloud()
    scan = scene.draw(3, 5)
    peer = multiangle_cases.lstsq(scan)
    ours = retrieve_optical_depth(
        scan.signal,
        scene.zenith_angle,
        scene.altitude,
        variance=scan.variance,
        method="kano_hamilton",
        inhomogeneity=scene.inhomogeneity,
        robust=False,
    )
    assert np.abs(peer.optical_depth - ours.optical_depth).max() < 1e-6
    assert peer.standard_error == pytest.approx(ours.optical_depth_standard_error, rel=1e-6)


def test_tikhonov_is_the_published_method_of_order_0():
    scene = multiangle_cases.cloud()
    scan = scene.draw(2, 6)
    strength = 0.05
    ours = retrieve_optical_depth(
        scan.signal,
        scene.zenith_angle,
        scene.altitude,
        variance=scan.variance,
        method="mld",
        robust=False,
        regularisation=Regularisation(0, "fixed", strength),
    )
    # The strength of the peer is in units of the scatter.
    peer = multiangle_cases.tikhonov(scan, np.array([strength / scene.inhomogeneity**2]))
    assert np.abs(peer.optical_depth - ours.optical_depth).max() < 1e-6


def test_the_corner_is_where_the_curve_bends():
    falling, level = np.linspace(0.0, -9.0, 10), np.full(8, -9.0)
    size = np.exp(np.append(falling, level + np.linspace(-0.01, -0.1, 8)))
    misfit = np.exp(np.append(np.linspace(-0.1, 0.0, 10), np.linspace(1.0, 8.0, 8)))
    assert multiangle_cases._corner(misfit, size) in {8, 9, 10}
    assert multiangle_cases._corner(misfit[:1], size[:1]) == 0


def test_peers_leave_out_samples_in_noise():
    scene = replace(SHORT, ratio=5.0)
    scan = scene.draw(2, 7)
    line = multiangle_cases.lstsq(scan)
    solvable = (scan.signal > 3.0 * np.sqrt(scan.variance)).sum(axis=1) >= 3
    assert np.array_equal(np.isfinite(line.optical_depth), solvable)
    assert 0 < solvable.sum() < solvable.size


# Statistics -----------------------------------------------------------------------------------


def test_errors_come_from_independent_blocks():
    figure = multiangle_scores.over_blocks([1.0, 2.0, math.nan, 6.0])
    assert figure.value == pytest.approx(3.0)
    assert figure.error == pytest.approx(np.std([1, 2, 6], ddof=1) / math.sqrt(3))
    square = multiangle_scores.root(MonteCarloFigure(4.0, 0.4))
    assert (square.value, square.error) == pytest.approx((2.0, 0.1))
    assert multiangle_scores.root(MonteCarloFigure(0.0, 0.0)) == MonteCarloFigure(0.0, 0.0)
    share = multiangle_scores.ratio(np.array([1.0, 0.0, 3.0]), np.array([10.0, 10.0, 20.0]))
    assert share.value == pytest.approx(0.1)
    assert share.error == pytest.approx(math.sqrt(0 + 1 + 1) / 40)
    assert multiangle_scores.ratio(np.zeros(2), np.full(2, 5.0)) == MonteCarloFigure(0.0, 0.1)
    assert multiangle_scores.ratio(np.zeros(2), np.zeros(2)) == MonteCarloFigure(0.0, 0.0)


def test_false_values_are_counted_with_and_without_flags():
    shape = (2, 4)
    flags = {field.name: np.zeros(shape, np.bool_) for field in fields(MultiAngleFlags)}
    flags["undersmoothed"][0, 1] = True
    flags["outlier"][1, 0] = True
    error = np.array([[0.5, 9.0, 5.0, np.nan], [-9.0, 0.1, 0.1, 0.1]])
    bound = np.array([[0.0, 0.0, 3.0, 0.0], [0.0, 0.0, 0.0, np.nan]])
    scene = multiangle_scores._counts(error, np.ones(shape), bound, MultiAngleFlags(**flags))
    # The last value has no stated error and counts as false.
    expected = {"values": 7, "random_only": 3, "false": 3, "unflagged": 6, "false_ok": 2}
    expected |= {"within": 4, "needless": 0, "profiles": 2, "false_ok_profiles": 1}
    assert scene.counts == expected
    assert scene.by_flag["undersmoothed"] == (1, 1)
    assert scene.by_flag["outlier"] == (1, 1)
    assert scene.by_flag["gradient"] == (0, 0)


# Results --------------------------------------------------------------------------------------


def test_every_method_is_scored_in_every_scene(study):
    names = [*multiangle_cases.scan_methods(), *multiangle_cases.scan_peers()]
    for scene in study.scenes:
        assert [score.method for score in scene.scores] == names
        assert scene.profiles == SMALL.blocks * SMALL.profiles
        by_method = {score.method: score for score in scene.scores}
        assert by_method["numpy lstsq"].profiles == SMALL.blocks * SMALL.slow
        line, joint = by_method["kano_hamilton"], by_method["joint"]
        assert line.solved == 1.0
        assert joint.rmse.value < 0.6 * line.rmse.value
        assert joint.extinction_rmse.value < 0.2 * line.extinction_rmse.value
        assert line.coverage[1].value == pytest.approx(0.95, abs=0.06)
        assert abs(line.bias.value) < 5.0 * line.bias.error + 1e-3
        assert by_method["scipy lsq_linear"].coverage is None
        assert by_method["numpy lstsq"].extinction_coverage is None
        assert by_method["two_angle"].rmse.value > line.rmse.value
        assert by_method["mld 0, discrepancy"].bias.value < 0.0
        assert by_method["mld 0, discrepancy"].data_share < line.data_share == 1.0
        assert all(score.nanoseconds > 0 for score in scene.scores)


def test_the_published_experiment_is_reproduced(study):
    def central(method, angle):
        (only,) = [
            score
            for score in study.published
            if (score.method, score.largest_angle, score.beams, score.share)
            == (method, angle, 6, 0.25)
        ]
        return only

    # Closed form: sigma / (2 sqrt Sxx), sigma / (sqrt 2 (x2 - x1)) for two.
    sigma = multiangle_cases.uniform_deviation(0.25)
    for angle in (15.0, 30.0):
        path = multiangle_cases.published_cloud(angle, 6, sigma).path
        line = sigma / (2.0 * math.sqrt(np.sum((path - path.mean()) ** 2)))
        assert central("kano_hamilton", angle).rmse.value == pytest.approx(line, rel=0.12)
        ends = 0.1 / (math.sqrt(2.0) * (path[-1] - path[0]))
        two_angle = central(multiangle_scores.TWO_ANGLE_ALONE, angle)
        assert two_angle.rmse.value == pytest.approx(ends, rel=0.12)
    mld = central("mld 0, discrepancy", 15.0)
    assert mld.rmse.value == pytest.approx(2.08, abs=0.25)
    assert mld.top_bias.value < -1.5
    assert mld.data_share < 0.4
    assert central(multiangle_scores.NOTHING, 15.0).rmse.value == pytest.approx(2.737, abs=0.001)
    settings = {(p.largest_angle, p.beams, p.share) for p in study.published}
    assert {(15.0, 4, 0.3), (30.0, 4, 0.2), (60.0, 6, 0.25)} <= settings


def test_the_prior_determines_the_error_at_15_degrees(study):
    by_factor = {score.factor: score for score in study.priors}
    assert by_factor[1.0].alone == 0.0
    assert by_factor[0.0].alone == pytest.approx(2.737, abs=0.001)
    assert by_factor[1.0].rmse.value < 0.6 * by_factor[0.0].rmse.value
    assert by_factor[1.5].rmse.value > 1.2 * by_factor[1.0].rmse.value
    equal = {score.method: score for score in study.correlations if score.correlation == 1.0}
    assert equal["joint"].rmse.value < 0.4 * equal["kano_hamilton"].rmse.value


def test_outliers_hurt_the_plain_method(study):
    by_method = {(score.method, score.outliers): score for score in study.outliers}
    assert len(by_method) == 4 * len(multiangle_scores.OUTLIERS)
    clean = by_method["kano_hamilton, plain", 0.0]
    assert by_method["kano_hamilton, plain", 0.1].low_rmse.value > 3.0 * clean.low_rmse.value
    assert by_method["kano_hamilton, robust", 0.1].low_rmse.value < 1.6 * clean.low_rmse.value
    assert by_method["joint, robust", 0.1].flagged > 0.2
    assert by_method["joint, robust", 0.1].ran == 1.0
    assert by_method["joint, plain", 0.1].ran == 0.0


def test_random_scenes_are_counted_completely(study):
    assert [(score.air, score.method, score.quantity) for score in study.safety] == [
        (air, method, quantity)
        for air in (multiangle_scores.ANY, multiangle_scores.CALM)
        for method in ("kano_hamilton", "joint")
        for quantity in ("optical depth", "extinction")
    ]
    for score in study.safety:
        count = -(-SMALL.random // (4 if score.air == multiangle_scores.CALM else 1))
        assert score.scenes == count
        assert score.profiles <= 8 * count
        assert score.false.value <= score.random_only.value
        assert score.needless <= score.flagged
        assert {share.flag for share in score.flags} == {f.name for f in fields(MultiAngleFlags)}
    values = [score.values for score in study.safety if score.quantity == "optical depth"]
    assert min(values) > 0


def test_times_are_multiples_of_the_read(timed):
    for batch in (1, 2):
        group = {cost.step: cost for cost in timed.costs if cost.batch == batch}
        assert group[READ].reads == 1.0
        assert not group[READ].ours
        ours = {"make_beams", "regress", "vertical.smooth", *multiangle_cases.scan_methods()}
        assert ours <= {name for name, cost in group.items() if cost.ours}
        assert not any(group[name].ours for name in multiangle_cases.scan_peers())
        for cost in group.values():
            assert cost.reads == pytest.approx(cost.nanoseconds / group[READ].nanoseconds)


# Pages ----------------------------------------------------------------------------------------


def test_pages_have_tables_and_figures(study, timed, tmp_path):
    reports = {
        "accuracy": multiangle_report.multiangle_accuracy_report(study),
        "throughput": retrieval_reports.multiangle_throughput_report(timed),
    }
    for name, report in reports.items():
        folder = tmp_path / name
        text = build_benchmark_page(report, folder).read_text()
        assert "2024-01-01" in text
        assert sum(len(chapter.charts) for chapter in report.parts) >= 1
        for chapter in report.parts:
            for chart in chapter.charts:
                assert (folder / f"{chart.name}.svg").read_bytes().startswith(b"<svg")
            for table in (*chapter.tables, *chapter.details):
                assert table.rows
                assert all(len(row) == len(table.columns) for row in table.rows)
    published = reports["accuracy"].parts[1]
    assert "this is not so" in published.text
    # 2 numbers of beams, 3 shares; priors and correlations.
    assert len(published.tables) + len(published.details) == 6 + 2


def test_results_survive_json(study, timed, tmp_path):
    for result in (study, timed):
        path = results.save(result, tmp_path / RESULT)
        assert results.load(type(result), path) == result


def test_both_kinds_run(monkeypatch, study, timed):
    calls = []

    def accuracy(effort):
        calls.append(effort)
        return study

    def throughput(effort):
        calls.append(effort)
        return timed

    monkeypatch.setattr(multiangle_scores, "measure_multiangle", accuracy)
    monkeypatch.setattr(scan_kernels, "measure_scan_kernels", throughput)
    effort = Effort(quick=True, repeats=2, date="2024-01-01")
    assert registry.run_benchmark("accuracy", "multiangle", [], effort).result is study
    assert registry.run_benchmark("throughput", "multiangle", [], effort).result is timed
    assert calls == [effort, effort]
