"""The benchmark of networks of lidars: what is simulated, scored, compared and told."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from lidarops.bench.accuracy import network as multiposition
from lidarops.bench.accuracy import network_cases as known
from lidarops.bench.accuracy import network_scores as scores
from lidarops.bench.accuracy.homogeneous import MonteCarloFigure
from lidarops.bench.accuracy.network_report import (
    bracketed,
    network_accuracy_report,
    network_throughput_report,
)
from lidarops.bench.harness import results
from lidarops.bench.harness.terms import Effort, Kind
from lidarops.reports.benchmark_page import build_benchmark_page
from lidarops.retrieve.network import geometry
from lidarops.retrieve.network.cycles import solve_cycle, systematic_error

PROFILES = 3 * known.BLOCK


@pytest.fixture(scope="module")
def found():
    return multiposition.measure_network(
        date="2024-01-01", profiles=PROFILES, repeats=1, peer_profiles=10
    )


@pytest.fixture(scope="module")
def timed():
    return multiposition.measure_network_throughput(quick=True, date="2024-01-01", repeats=1)


@pytest.fixture(scope="module")
def case(found):
    each = {(one.place, one.air, one.noise): one for one in found.cases}
    return lambda place, air, noise: each[place.name, air, noise].scores


# What is simulated ----------------------------------------------------------------------------


def test_the_triangle_is_that_of_the_paper():
    net = known.TRIANGLE.network()
    assert (net.beams, net.crossings) == (3, 3)
    # Beams 1 and 3 cross above lidar 3, beams 1 and 2 and beams 2 and 3 where lines do.
    expected = {
        (0.0, 300.0 * math.sqrt(3.0)),
        (-100.0, 400.0 * math.sqrt(3.0)),
        (0.0, 500.0 * math.sqrt(3.0)),
    }
    crossings = {(round(x, 6) + 0.0, round(up, 6)) for x, _, up in net.crossing}
    assert crossings == {(x, round(up, 6)) for x, up in expected}
    assert net.near_crossing.tolist() == [True, True, False]
    six = known.THREE_BY_TWO.network()
    assert (six.beams, six.crossings, six.passages.beam.size) == (6, 8, 16)


@pytest.mark.parametrize("air", known.AIRS, ids=lambda air: air.name)
def test_signals_obey_the_lidar_equation(air):
    """Against adaptive quadrature of the optical depth along a beam."""
    net = known.TRIANGLE.network()
    seen = known.signals(net, air)
    for number, extinction in list(enumerate(air.fields()))[:: max(len(air.fields()) - 1, 1)]:
        for beam in range(net.beams):
            origin, direction = net.origin[beam], net.direction[beam]

            def along(r, origin=origin, direction=direction, extinction=extinction):
                x, up = (np.array([origin[a] + r * direction[a]]) for a in (0, 2))
                return float(extinction(x, up)[0])

            for bin in (0, seen.range.size // 2, seen.range.size - 1):
                r = float(seen.range[bin])
                depth = quad(along, 0.0, r, epsrel=1e-11, limit=200)[0]
                expected = along(r) * math.exp(-2.0 * depth) / r**2
                assert seen.power[number, beam, bin] == pytest.approx(expected, rel=1e-8)
    assert seen.extinction.shape == (len(air.fields()), net.crossings)


def test_airs_are_as_told():
    crossings = {air.name: known.signals(known.TRIANGLE.network(), air) for air in known.AIRS}
    assert np.all(crossings["homogeneous"].extinction == 2e-3)
    assert np.all(crossings[known.THIN].extinction == 2e-4)
    gradient = crossings["gradient"].extinction[0]
    height = crossings["gradient"].network.crossing[:, 2]
    np.testing.assert_allclose(np.diff(np.log(gradient)), -np.diff(height) / 1010.0)
    drift = crossings["drifting plume"].extinction
    assert len(drift) == known.BLOCK
    assert drift[:, 0].max() > 1.3 * drift[:, 0].min()
    seen = crossings["drifting plume"]
    np.testing.assert_array_equal(seen.truth(120)[50:100], drift)
    assert np.array_equal(seen.truth(120)[119], drift[19])


def test_noise_is_as_told_and_repeats():
    seen = known.signals(known.TRIANGLE.network(), known.AIRS[1])
    power, variance = seen.draw(0.05, 2000, 3)
    assert np.array_equal(power, seen.draw(0.05, 2000, 3)[0])
    assert not np.array_equal(power[:5], seen.draw(0.05, 5, 4)[0])
    deviation = (power - seen.power) / np.sqrt(variance)
    assert deviation.mean() == pytest.approx(0.0, abs=4.0 / math.sqrt(deviation.size))
    assert deviation.var() == pytest.approx(1.0, abs=5.0 * math.sqrt(2.0 / deviation.size))
    for beam in range(3):
        first = float(np.interp(seen.network.on_beam(beam)[1][0], seen.range, seen.power[0, beam]))
        expected = (0.05 * seen.power[0, beam]) ** 2 + (0.01 * first) ** 2
        np.testing.assert_allclose(variance[0, beam], expected, rtol=1e-12)


def test_a_cycle_is_asked_of_one_cycle_only():
    names = [way.name for way in known.network_solvers(known.TRIANGLE)]
    assert len(set(names)) == len(names) == 10
    assert set(known.network_solvers(known.THREE_BY_TWO)) < set(
        known.network_solvers(known.TRIANGLE)
    )


# Figure 2 -------------------------------------------------------------------------------------


def _signed_lengths(first_lidar, elevation, apart=500.0, beam1=120.0, beam3=90.0):
    """Equation (19) of the paper, corrected: along the beams, with their signs, in m."""
    a1, a2, a3 = (math.radians(angle) for angle in (beam1, elevation, beam3))
    far = first_lidar + apart
    return (
        far * math.sin(a2) / math.sin(a1 - a2) - first_lidar * math.sin(a3) / math.sin(a1 - a3),
        apart * math.sin(a3) / math.sin(a3 - a2) - far * math.sin(a1) / math.sin(a1 - a2),
        apart * math.sin(a2) / math.sin(a3 - a2) - first_lidar * math.sin(a1) / math.sin(a1 - a3),
    )


@pytest.mark.parametrize(
    "point", multiposition.figure(), ids=lambda p: f"{p.first_lidar}-{p.elevation}"
)
def test_the_figure_is_that_of_its_formula(point):
    lengths = _signed_lengths(point.first_lidar, point.elevation)
    depths = 2e-3 * np.array(lengths) * [1.0, 1.0, -1.0]

    def formula(tau, lam=0.8):
        """(18) of the paper, for three beams."""
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
    point = {(p.first_lidar, p.elevation): p for p in multiposition.figure()}
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
    rows = known.random_rows(40, beams)
    ours = solve_cycle(rows.start, rows.end, rows.integral).value
    np.testing.assert_allclose(known.solve_by_lu(rows), ours, rtol=1e-13)
    np.testing.assert_allclose(known.solve_by_lu_one_by_one(rows), ours, rtol=1e-13)
    assert np.array_equal(rows.last(5).end, rows.end[35:])
    assert np.array_equal(rows.first(5).variance, rows.variance[:5])


@pytest.mark.parametrize("place", known.PLACES, ids=lambda place: place.name)
def test_a_plain_fit_finds_the_same_network(place):
    seen = known.signals(place.network(), known.AIRS[1])
    clean = known.network_by_scipy(seen.power, 1e-10 * seen.power**2, seen)[0]
    # What trapezoids of 5 m leave.
    np.testing.assert_allclose(clean, seen.extinction[0], rtol=0.01)
    power, variance = seen.draw(0.01, 6, 1)
    ours, near = known.FREE(power, variance, seen), seen.network.near_crossing
    apart = (known.network_by_scipy(power, variance, seen) - ours.extinction)[:, near]
    assert np.abs(apart / ours.extinction_standard_error[:, near]).max() < 2.0


# Scores ---------------------------------------------------------------------------------------


def test_means_have_the_error_that_blocks_scatter_by():
    random = np.random.default_rng(1)
    blocks, block = 400, known.BLOCK
    shared = np.repeat(random.standard_normal(blocks), block)
    values = 2.0 + shared + 0.1 * random.standard_normal(shared.size)
    found = scores.mean_by_block(values, np.ones(values.size, dtype=bool))
    assert found.value == pytest.approx(values.mean())
    # Profiles of a block are no independent measurements: 1 / sqrt(profiles) were 7 times less.
    assert found.error == pytest.approx(1.0 / math.sqrt(blocks), rel=0.12)
    kept = np.arange(values.size) % 3 == 0
    part = scores.mean_by_block(values, kept)
    assert part.value == pytest.approx(values[kept].mean())
    assert scores.mean_by_block(values, np.zeros(values.size, dtype=bool)) is None
    everything = scores.share_by_block(np.ones(100, dtype=bool), np.ones(100, dtype=bool))
    assert everything.value == 1.0
    assert 0.005 < everything.error < 0.01


def test_scores_of_known_errors():
    extinction = np.array([[0.2, np.nan], [-0.1, 0.4], [3.0, 0.0]])
    errors = scores.Errors(
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
    assert [one.value for one in score.visibility_bias] == pytest.approx([-0.8 / 3, -0.15])
    assert score.visibility_rmse[1].value == pytest.approx(0.3 / math.sqrt(2.0))
    assert (score.chi_square, score.microseconds, score.reads) == (1.5, 12.0, 3.0)
    nothing = scores.score(replace(errors, flagged=np.ones((3, 2), dtype=bool)), 1.0, 1.0)
    assert nothing.within is None
    assert nothing.unflagged_rmse is None


# What it finds --------------------------------------------------------------------------------


def test_every_case_is_scored_in_every_way(found):
    assert len(found.cases) == len(known.PLACES) * len(known.AIRS) * len(known.NOISES)
    for one in found.cases:
        place = next(place for place in known.PLACES if place.name == one.place)
        assert list(one.scores) == [way.name for way in known.network_solvers(place)]
        assert one.profiles == PROFILES
        for score in one.scores.values():
            assert 0.0 <= score.solved <= 1.0
            assert len(score.visibility_rmse) == place.network().near_crossing.sum()
            assert score.reads > 1.0


def test_the_network_is_as_accurate_as_it_must_be(case):
    """S_1 of the triangle and the median crossing of 3 x 2 beams, within 8 percent."""
    network = known.NETWORK.name
    for air, noise in (("homogeneous", 0.1), ("plume", 0.05), ("gradient", 0.05)):
        assert case(known.TRIANGLE, air, noise)[network].visibility_rmse[0].value <= 0.08
        exact = case(known.TRIANGLE, air, noise)[known.EXACT.name]
        assert exact.visibility_rmse[0].value > 0.12
    for air in ("homogeneous", "gradient", "plume"):
        six = case(known.THREE_BY_TWO, air, 0.05)[network]
        assert np.median([rmse.value for rmse in six.visibility_rmse]) <= 0.08
        assert 0.7 < six.chi_square < 1.3


def test_unflagged_values_of_the_network_are_as_stated(case):
    for place in known.PLACES:
        for air in known.AIRS[:4]:
            for noise in known.NOISES:
                score = case(place, air.name, noise)[known.NETWORK.name]
                assert score.within[2].value >= 0.98
                assert score.flagged.value < 0.1


def test_multipliers_are_off_by_what_the_formula_says(case):
    seen = known.signals(known.TRIANGLE.network(), known.AIRS[0])
    walk = geometry.build_cycle(seen.network)
    depths = 2e-3 * (walk.end_range - walk.start_range)
    for way in known.network_solvers(known.TRIANGLE):
        bias = case(known.TRIANGLE, "homogeneous", 0.02)[way.name].visibility_bias[0]
        if way.method is known.Method.MULTIPLIER and way.multiplier is not None:
            expected = -float(systematic_error(depths, way.multiplier))
            assert bias.value == pytest.approx(expected, abs=5.0 * bias.error + 0.005)
            assert abs(bias.value) > 10.0 * bias.error
        if way in (known.UNBIASED, known.SLOPE, known.KLETT):
            assert abs(bias.value) < 4.5 * bias.error + 2e-3


def test_ways_that_want_homogeneous_air_are_flagged_elsewhere(case):
    for way in (known.SLOPE, known.KLETT, known.UNBIASED):
        for air in ("gradient", "plume"):
            assert case(known.TRIANGLE, air, 0.02)[way.name].flagged.value > 0.99
        assert case(known.TRIANGLE, "homogeneous", 0.02)[way.name].flagged.value < 0.01


def test_a_contrast_changes_values_and_errors_alike(found):
    assert {one.noise for one in found.sights} == set(known.NOISES)
    for noise in known.NOISES:
        mor, koschmieder, paper = (one for one in found.sights if one.noise == noise)
        assert mor.constant == pytest.approx(math.log(20.0))
        assert koschmieder.constant == pytest.approx(3.912, abs=1e-4)
        assert paper.constant == pytest.approx(3.0)
        for other in (koschmieder, paper):
            scale = other.constant / mor.constant
            assert other.visibility == pytest.approx(scale * mor.visibility)
            assert other.rmse.value == pytest.approx(scale * mor.rmse.value)
            assert other.within_interval == mor.within_interval
        # Errors are stated for fields that deviate by twice what the prior has: typical ones
        # lie within them more often than 68 percent, and never less.
        inside = mor.within_interval
        assert 0.683 - 4.0 * inside.error - 0.05 < inside.value < 0.99


def test_the_plain_fit_is_met_at_a_fraction_of_its_time(found):
    assert len(found.comparisons) == 8
    for one in found.comparisons:
        assert one.profiles == 10
        assert one.apart < 1.0
        assert one.peer == pytest.approx(one.ours, rel=0.5)


def test_times_are_multiples_of_the_read(found, timed):
    for rates in (found.cycles, timed.cycles, timed.profiles):
        for beams in {rate.beams for rate in rates}:
            group = {rate.way: rate for rate in rates if rate.beams == beams}
            read = group[scores.READ]
            assert (read.reads, read.ours) == (1.0, False)
            for rate in group.values():
                assert rate.reads == pytest.approx(rate.nanoseconds / read.nanoseconds)
            assert any(rate.ours for rate in group.values())
    assert {rate.beams for rate in timed.cycles} == {3, 12}
    assert {rate.beams for rate in timed.profiles} == {3, 6}
    assert timed.gain > 0.0


# Pages and the command ------------------------------------------------------------------------


def test_pages_hold_tables_and_figures(found, timed, tmp_path):
    for name, report in (
        ("accuracy", network_accuracy_report(found, "result.json")),
        ("throughput", network_throughput_report(timed, "result.json")),
    ):
        folder = tmp_path / name
        text = build_benchmark_page(report, folder).read_text()
        assert "2024-01-01" in text
        for part in report.parts:
            for chart in part.charts:
                assert (folder / f"{chart.name}.png").read_bytes().startswith(b"\x89PNG")
            for table in (*part.tables, *part.details):
                assert table.rows
                assert all(len(row) == len(table.columns) for row in table.rows)
    titles = [part.title for part in network_accuracy_report(found).parts]
    assert "Figure 2 of the paper, and the right signs" in titles


def test_results_survive_json(found, timed, tmp_path):
    for result in (found, timed):
        path = results.save(result, tmp_path / "result.json")
        assert results.load(type(result), path) == result


@pytest.mark.parametrize(
    ("value", "error", "told"),
    [(4.17487, 0.00021, "4.1749(2)"), (-22.4, 1.6, "-22(2)"), (-40.0, 0.0, "-40")],
)
def test_errors_stand_in_the_last_digits(value, error, told):
    assert bracketed(MonteCarloFigure(value, error)) == told


def test_the_entry_measures_what_is_asked(monkeypatch, found, timed):
    asked = {}

    def measure(**arguments):
        asked.update(arguments)
        return found

    monkeypatch.setattr(multiposition, "measure_network", measure)
    monkeypatch.setattr(multiposition, "measure_network_throughput", lambda **_: timed)
    right = multiposition.run_network(Kind.ACCURACY, effort=Effort(quick=True, date="2024-01-01"))
    assert (asked["quick"], asked["date"]) == (True, "2024-01-01")
    assert right.result is found
    assert right.report.data == "result.json"
    fast = multiposition.run_network(Kind.THROUGHPUT, effort=Effort())
    assert fast.result is timed
    assert [part.title for part in fast.report.parts] == ["Cycles per second", "Whole profiles"]
