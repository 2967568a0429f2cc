"""Benchmark of networks of lidars: simulation, scores, comparisons and reports."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from lidarops.bench import registry
from lidarops.bench.accuracy import network as network_benchmark
from lidarops.bench.accuracy import network_cases
from lidarops.bench.accuracy import network_scores as scores
from lidarops.bench.accuracy.network_report import network_accuracy_report
from lidarops.bench.harness import results
from lidarops.bench.harness.benchmark import Effort
from lidarops.bench.harness.timing import READ
from lidarops.bench.throughput import networks, retrieval_reports
from lidarops.reports.benchmark_page import build_benchmark_page
from lidarops.retrieve.network import geometry
from lidarops.retrieve.network.cycles import solve_cycle, systematic_error

PROFILES = 3 * network_cases.BLOCK


@pytest.fixture(scope="module")
def accuracy():
    return network_benchmark.measure_network(
        Effort(date="2024-01-01", repeats=1), profiles=PROFILES, peer_profiles=10
    )


@pytest.fixture(scope="module")
def throughput_result():
    return networks.measure_network_throughput(Effort(quick=True, date="2024-01-01", repeats=1))


@pytest.fixture(scope="module")
def case(accuracy):
    scenarios = {
        (scenario.place, scenario.air, scenario.noise): scenario for scenario in accuracy.cases
    }
    return lambda lidars, air, noise: scenarios[lidars.name, air, noise].scores


# Simulation ------------------------------------------------------------------------------------


def test_the_triangle_is_the_one_of_the_paper():
    network = network_cases.TRIANGLE.network()
    assert (network.beams, network.crossings) == (3, 3)
    # Beams 1 and 3 cross above lidar 3; the other crossings follow from the lines.
    expected = {
        (0.0, 300.0 * math.sqrt(3.0)),
        (-100.0, 400.0 * math.sqrt(3.0)),
        (0.0, 500.0 * math.sqrt(3.0)),
    }
    crossings = {(round(x, 6) + 0.0, round(up, 6)) for x, _, up in network.crossing}
    assert crossings == {(x, round(up, 6)) for x, up in expected}
    assert network.near_crossing.tolist() == [True, True, False]
    six_beams = network_cases.THREE_BY_TWO.network()
    assert (six_beams.beams, six_beams.crossings, six_beams.passages.beam.size) == (6, 8, 16)


@pytest.mark.parametrize("air", network_cases.AIRS, ids=lambda air: air.name)
def test_signals_obey_the_lidar_equation(air):
    """Compare with adaptive quadrature of the optical depth along a beam."""
    network = network_cases.TRIANGLE.network()
    signals = network_cases.signals(network, air)
    for number, extinction in list(enumerate(air.fields()))[:: max(len(air.fields()) - 1, 1)]:
        for beam in range(network.beams):
            origin, direction = network.origin[beam], network.direction[beam]

            def along(r, origin=origin, direction=direction, extinction=extinction):
                x, up = (np.array([origin[a] + r * direction[a]]) for a in (0, 2))
                return float(extinction(x, up)[0])

            for index in (0, signals.range.size // 2, signals.range.size - 1):
                r = float(signals.range[index])
                depth = quad(along, 0.0, r, epsrel=1e-11, limit=200)[0]
                expected = along(r) * math.exp(-2.0 * depth) / r**2
                assert signals.power[number, beam, index] == pytest.approx(expected, rel=1e-8)
    assert signals.extinction.shape == (len(air.fields()), network.crossings)


def test_fields_of_extinction_are_as_described():
    signals_of = {
        air.name: network_cases.signals(network_cases.TRIANGLE.network(), air)
        for air in network_cases.AIRS
    }
    assert np.all(signals_of["homogeneous"].extinction == 2e-3)
    assert np.all(signals_of[network_cases.THIN].extinction == 2e-4)
    gradient = signals_of["gradient"].extinction[0]
    height = signals_of["gradient"].network.crossing[:, 2]
    np.testing.assert_allclose(np.diff(np.log(gradient)), -np.diff(height) / 1010.0)
    drift = signals_of["drifting plume"].extinction
    assert len(drift) == network_cases.BLOCK
    assert drift[:, 0].max() > 1.3 * drift[:, 0].min()
    signals = signals_of["drifting plume"]
    np.testing.assert_array_equal(signals.truth(120)[50:100], drift)
    assert np.array_equal(signals.truth(120)[119], drift[19])


def test_noise_is_as_stated_and_reproducible():
    signals = network_cases.signals(network_cases.TRIANGLE.network(), network_cases.AIRS[1])
    power, variance = signals.draw(0.05, 2000, 3)
    assert np.array_equal(power, signals.draw(0.05, 2000, 3)[0])
    assert not np.array_equal(power[:5], signals.draw(0.05, 5, 4)[0])
    deviation = (power - signals.power) / np.sqrt(variance)
    assert deviation.mean() == pytest.approx(0.0, abs=4.0 / math.sqrt(deviation.size))
    assert deviation.var() == pytest.approx(1.0, abs=5.0 * math.sqrt(2.0 / deviation.size))
    for beam in range(3):
        first = float(
            np.interp(signals.network.on_beam(beam)[1][0], signals.range, signals.power[0, beam])
        )
        expected = (0.05 * signals.power[0, beam]) ** 2 + (0.01 * first) ** 2
        np.testing.assert_allclose(variance[0, beam], expected, rtol=1e-12)


def test_solvers_of_cycles_need_a_single_cycle():
    names = [solver.name for solver in network_cases.network_solvers(network_cases.TRIANGLE)]
    assert len(set(names)) == len(names) == 10
    assert set(network_cases.network_solvers(network_cases.THREE_BY_TWO)) < set(
        network_cases.network_solvers(network_cases.TRIANGLE)
    )


# Figure 2 -------------------------------------------------------------------------------------


def _signed_lengths(first_lidar, elevation, apart=500.0, beam1=120.0, beam3=90.0):
    """Return signed lengths along the beams in m: equation (19) of the paper, corrected."""
    a1, a2, a3 = (math.radians(angle) for angle in (beam1, elevation, beam3))
    far = first_lidar + apart
    return (
        far * math.sin(a2) / math.sin(a1 - a2) - first_lidar * math.sin(a3) / math.sin(a1 - a3),
        apart * math.sin(a3) / math.sin(a3 - a2) - far * math.sin(a1) / math.sin(a1 - a2),
        apart * math.sin(a2) / math.sin(a3 - a2) - first_lidar * math.sin(a1) / math.sin(a1 - a3),
    )


@pytest.mark.parametrize(
    "point", network_benchmark.figure_points(), ids=lambda p: f"{p.first_lidar}-{p.elevation}"
)
def test_the_figure_follows_its_formula(point):
    lengths = _signed_lengths(point.first_lidar, point.elevation)
    depths = 2e-3 * np.array(lengths) * [1.0, 1.0, -1.0]

    def formula(tau, lam=0.8):
        """Return equation (18) of the paper for three beams."""
        q1, q2, q3 = np.exp(-2.0 * np.cumsum(tau))
        below = 1.0 - lam**2 * q3
        return ((1.0 - lam) * q1 + lam * (1.0 - lam) * q2) / below

    printed = formula(np.abs(depths) * [1.0, 1.0, -1.0])
    assert point.printed == pytest.approx(printed, rel=1e-9)
    signed = formula(depths)
    if signed > 0:
        assert point.signed == pytest.approx(signed, rel=1e-6)
    else:
        assert point.signed is None
    above = depths.sum() > 0
    near = signed if above else formula(np.abs(depths)[[1, 0, 2]] * [1.0, 1.0, -1.0])
    assert point.near == pytest.approx(near, rel=1e-9)
    assert point.simulated == pytest.approx(near, abs=1e-9)
    assert 0.0 < point.near < 1.0


def test_the_figure_has_the_values_of_the_study():
    point = {(p.first_lidar, p.elevation): p for p in network_benchmark.figure_points()}
    study = {
        200.0: (0.220, 0.462, 0.976, 0.447, 0.209, 0.091, 0.037),
        300.0: (0.082, 0.170, 0.370, 0.897, 0.417, 0.150, 0.050),
        400.0: (0.034, 0.071, 0.154, 0.370, 0.903, 0.255, 0.068),
    }
    for first, values in study.items():
        printed = [point[first, elevation].printed for elevation in range(15, 80, 10)]
        assert printed == pytest.approx(values, abs=6e-4)
    near = [point[300.0, elevation].near for elevation in range(15, 80, 10)]
    assert near == pytest.approx((0.148, 0.240, 0.427, 0.905, 0.417, 0.150, 0.050), abs=6e-4)
    assert point[300.0, 45.0].signed == pytest.approx(1.12, abs=5e-3)
    assert point[300.0, 35.0].signed == pytest.approx(3.66, abs=5e-3)
    assert point[300.0, 25.0].signed is None


# Peers ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("beams", [3, 12])
def test_linear_algebra_finds_the_same_cycles(beams):
    rows = network_cases.random_rows(40, beams)
    ours = solve_cycle(rows.start, rows.end, rows.integral).value
    np.testing.assert_allclose(network_cases.solve_by_lu(rows), ours, rtol=1e-13)
    np.testing.assert_allclose(network_cases.solve_by_lu_one_by_one(rows), ours, rtol=1e-13)
    assert np.array_equal(rows.last(5).end, rows.end[35:])
    assert np.array_equal(rows.first(5).variance, rows.variance[:5])


@pytest.mark.parametrize("place", network_cases.LIDAR_LINES, ids=lambda place: place.name)
def test_a_plain_fit_finds_the_same_network(place):
    signals = network_cases.signals(place.network(), network_cases.AIRS[1])
    clean = network_cases.network_by_scipy(signals.power, 1e-10 * signals.power**2, signals)[0]
    # Error of trapezoids of 5 m.
    np.testing.assert_allclose(clean, signals.extinction[0], rtol=0.01)
    power, variance = signals.draw(0.01, 6, 1)
    ours, near = (
        network_cases.NETWORK_WITHOUT_PRIOR(power, variance, signals),
        signals.network.near_crossing,
    )
    difference = (network_cases.network_by_scipy(power, variance, signals) - ours.extinction)[
        :, near
    ]
    assert np.abs(difference / ours.extinction_standard_error[:, near]).max() < 2.0


# Scores ---------------------------------------------------------------------------------------


def test_errors_of_means_come_from_the_scatter_of_blocks():
    random = np.random.default_rng(1)
    blocks, block = 400, network_cases.BLOCK
    shared = np.repeat(random.standard_normal(blocks), block)
    values = 2.0 + shared + 0.1 * random.standard_normal(shared.size)
    mean = scores.mean_by_block(values, np.ones(values.size, dtype=bool))
    assert mean.value == pytest.approx(values.mean())
    # Profiles of a block are not independent: 1 / sqrt(profiles) would be 7 times smaller.
    assert mean.error == pytest.approx(1.0 / math.sqrt(blocks), rel=0.12)
    kept = np.arange(values.size) % 3 == 0
    third = scores.mean_by_block(values, kept)
    assert third.value == pytest.approx(values[kept].mean())
    assert scores.mean_by_block(values, np.zeros(values.size, dtype=bool)) is None
    share = scores.share_by_block(np.ones(100, dtype=bool), np.ones(100, dtype=bool))
    assert share.value == 1.0
    assert 0.005 < share.error < 0.01


def test_scores_of_known_errors():
    extinction = np.array([[0.2, np.nan], [-0.1, 0.4], [3.0, 0.0]])
    errors = scores.CrossingErrors(
        extinction=extinction,
        visibility=np.array([[-0.2, np.nan], [0.1, -0.3], [-0.7, 0.0]]),
        deviation=np.array([[1.5, np.nan], [-0.5, 2.5], [9.0, 0.0]]),
        flagged=np.array([[False, True], [False, False], [True, False]]),
        chi_square=np.array([1.0, np.nan, 2.0]),
    )
    score = scores.score(errors, 12.0, 3.0)
    assert score.solved == pytest.approx(5 / 6)
    assert score.flagged.value == pytest.approx(2 / 6)
    assert score.bias.value == pytest.approx(3.5 / 5)
    assert score.rmse.value == pytest.approx(math.sqrt((0.04 + 0.01 + 0.16 + 9.0) / 5))
    assert score.unflagged_rmse.value == pytest.approx(math.sqrt((0.04 + 0.01 + 0.16) / 4))
    assert [inside.value for inside in score.within] == [0.5, 0.75, 1.0]
    assert [bias.value for bias in score.visibility_bias] == pytest.approx([-0.8 / 3, -0.15])
    assert score.visibility_rmse[1].value == pytest.approx(0.3 / math.sqrt(2.0))
    assert (score.chi_square, score.microseconds, score.reads) == (1.5, 12.0, 3.0)
    all_flagged = scores.score(replace(errors, flagged=np.ones((3, 2), dtype=bool)), 1.0, 1.0)
    assert all_flagged.within is None
    assert all_flagged.unflagged_rmse is None


# Results --------------------------------------------------------------------------------------


def test_every_case_is_scored_with_every_solver(accuracy):
    assert len(accuracy.cases) == len(network_cases.LIDAR_LINES) * len(network_cases.AIRS) * len(
        network_cases.NOISES
    )
    for scenario in accuracy.cases:
        lidars = next(
            lidars for lidars in network_cases.LIDAR_LINES if lidars.name == scenario.place
        )
        assert list(scenario.scores) == [
            solver.name for solver in network_cases.network_solvers(lidars)
        ]
        assert scenario.profiles == PROFILES
        for score in scenario.scores.values():
            assert 0.0 <= score.solved <= 1.0
            assert len(score.visibility_rmse) == lidars.network().near_crossing.sum()
            assert score.reads > 1.0


def test_the_network_reaches_the_required_accuracy(case):
    """The first crossing of the triangle and the median one of 3 x 2 beams: within 8 percent."""
    network = network_cases.NETWORK.name
    for air, noise in (("homogeneous", 0.1), ("plume", 0.05), ("gradient", 0.05)):
        assert case(network_cases.TRIANGLE, air, noise)[network].visibility_rmse[0].value <= 0.08
        exact = case(network_cases.TRIANGLE, air, noise)[network_cases.EXACT.name]
        assert exact.visibility_rmse[0].value > 0.12
    for air in ("homogeneous", "gradient", "plume"):
        scores = case(network_cases.THREE_BY_TWO, air, 0.05)[network]
        assert np.median([rmse.value for rmse in scores.visibility_rmse]) <= 0.08
        assert 0.7 < scores.chi_square < 1.3


def test_unflagged_values_of_the_network_are_as_stated(case):
    for lidars in network_cases.LIDAR_LINES:
        for air in network_cases.AIRS[:4]:
            for noise in network_cases.NOISES:
                score = case(lidars, air.name, noise)[network_cases.NETWORK.name]
                assert score.within[2].value >= 0.98
                assert score.flagged.value < 0.1


def test_multipliers_have_the_bias_of_the_formula(case):
    signals = network_cases.signals(network_cases.TRIANGLE.network(), network_cases.AIRS[0])
    cycle = geometry.build_cycle(signals.network)
    depths = 2e-3 * (cycle.end_range - cycle.start_range)
    for solver in network_cases.network_solvers(network_cases.TRIANGLE):
        bias = case(network_cases.TRIANGLE, "homogeneous", 0.02)[solver.name].visibility_bias[0]
        if (
            solver.method is network_cases.NetworkMethod.MULTIPLIER
            and solver.multiplier is not None
        ):
            expected = -float(systematic_error(depths, solver.multiplier))
            assert bias.value == pytest.approx(expected, abs=5.0 * bias.error + 0.005)
            assert abs(bias.value) > 10.0 * bias.error
        if solver in (network_cases.UNBIASED, network_cases.SLOPE, network_cases.KLETT):
            assert abs(bias.value) < 4.5 * bias.error + 2e-3


def test_solvers_for_homogeneous_air_are_flagged_in_other_air(case):
    for solver in (network_cases.SLOPE, network_cases.KLETT, network_cases.UNBIASED):
        for air in ("gradient", "plume"):
            assert case(network_cases.TRIANGLE, air, 0.02)[solver.name].flagged.value > 0.99
        assert case(network_cases.TRIANGLE, "homogeneous", 0.02)[solver.name].flagged.value < 0.01


def test_a_contrast_changes_values_and_errors_alike(accuracy):
    assert {score.noise for score in accuracy.sights} == set(network_cases.NOISES)
    for noise in network_cases.NOISES:
        mor, koschmieder, paper = (score for score in accuracy.sights if score.noise == noise)
        assert mor.constant == pytest.approx(math.log(20.0))
        assert koschmieder.constant == pytest.approx(3.912, abs=1e-4)
        assert paper.constant == pytest.approx(3.0)
        for other in (koschmieder, paper):
            scale = other.constant / mor.constant
            assert other.visibility == pytest.approx(scale * mor.visibility)
            assert other.rmse.value == pytest.approx(scale * mor.rmse.value)
            assert other.within_interval == mor.within_interval
        # Stated errors allow twice the deviation of the prior, so more than 68 percent of the
        # values are within them.
        inside = mor.within_interval
        assert 0.683 - 4.0 * inside.error - 0.05 < inside.value < 0.99


def test_the_network_agrees_with_a_plain_fit(accuracy):
    assert len(accuracy.comparisons) == 8
    for comparison in accuracy.comparisons:
        assert comparison.profiles == 10
        assert comparison.apart < 1.0
        assert comparison.peer == pytest.approx(comparison.ours, rel=0.5)


def test_times_are_multiples_of_the_read(accuracy, throughput_result):
    for rates in (accuracy.cycles, throughput_result.cycles, throughput_result.profiles):
        for beams in {rate.beams for rate in rates}:
            group = {rate.method: rate for rate in rates if rate.beams == beams}
            read = group[READ]
            assert (read.reads, read.ours) == (1.0, False)
            for rate in group.values():
                assert rate.reads == pytest.approx(rate.nanoseconds / read.nanoseconds)
            assert any(rate.ours for rate in group.values())
    assert {rate.beams for rate in throughput_result.cycles} == {3, 12}
    assert {rate.beams for rate in throughput_result.profiles} == {3, 6}
    assert throughput_result.gain > 0.0


# Pages and the command ------------------------------------------------------------------------


def test_pages_hold_tables_and_figures(accuracy, throughput_result, tmp_path):
    for name, report in (
        ("accuracy", network_accuracy_report(accuracy)),
        ("throughput", retrieval_reports.network_throughput_report(throughput_result)),
    ):
        folder = tmp_path / name
        text = build_benchmark_page(report, folder).read_text()
        assert "2024-01-01" in text
        for chapter in report.parts:
            for chart in chapter.charts:
                assert (folder / f"{chart.name}.svg").read_bytes().startswith(b"<svg")
            for table in (*chapter.tables, *chapter.details):
                assert table.rows
                assert all(len(row) == len(table.columns) for row in table.rows)
    titles = [chapter.title for chapter in network_accuracy_report(accuracy).parts]
    assert "Figure 2 of the paper, and the correct signs" in titles


def test_results_survive_json(accuracy, throughput_result, tmp_path):
    for result in (accuracy, throughput_result):
        path = results.save(result, tmp_path / "result.json")
        assert results.load(type(result), path) == result


def test_the_command_runs_the_requested_benchmark(monkeypatch, accuracy, throughput_result):
    received = []

    def measure(effort):
        received.append(effort)
        return accuracy

    monkeypatch.setattr(network_benchmark, "measure_network", measure)
    monkeypatch.setattr(networks, "measure_network_throughput", lambda _: throughput_result)
    effort = Effort(quick=True, date="2024-01-01")
    output = registry.run_benchmark("accuracy", "network", [], effort)
    assert received == [effort]
    assert output.result is accuracy
    assert output.report.data == "result.json"
    throughput = registry.run_benchmark("throughput", "network", [], Effort())
    assert throughput.result is throughput_result
    assert [chapter.title for chapter in throughput.report.parts] == [
        "Cycles per second",
        "Whole profiles",
    ]
