"""False values in random scenes: the draws, the counts, the page and the command."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from benchmarks.__main__ import app
from benchmarks.harness.figure import CPU_TIME, Verdict, clustered_share, cpu_seconds, design_effect
from benchmarks.harness.rates import (
    BROKEN,
    HELD,
    VIOLATED,
    VISIBLE,
    Failure,
    ScoredValues,
    collect,
    held_first,
    rates,
)
from benchmarks.harness.results import Effort
from benchmarks.scenes import (
    elastic_skies,
    homogeneous_paths,
    lidar_networks,
    raman_skies,
    recorded_signals,
    scans,
)
from benchmarks.scenes.homogeneous_paths import Scenario
from benchmarks.stability import study
from lidarops.flags import Quality
from lidarops.retrieve.homogeneous import path_fit
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS
from lidarops.retrieve.signal.dead_time import DeadTimeEstimate

pytestmark = pytest.mark.slow

HOLDS = Failure("none", satisfied=True)
HIDDEN = Failure("hidden")
BAD = int(Quality.NOT_HOMOGENEOUS)
CARE = int(Quality.OUTLIER)


def scored(failure, error, bits=0, **more):
    error = np.asarray(error, dtype=np.float64)
    stated = {"random": np.ones(error.shape), "systematic": 0.0} | more
    bits = np.broadcast_to(np.int32(bits), error.shape)
    return ScoredValues(failure, "x", error, bits=bits, own=(), **stated)


def counted(*chunks, needless=0.05):
    scores = rates(collect(lambda number: [chunks[number]], len(chunks)), needless)
    return {failure: score for (_, failure), score in scores.items()}


def test_a_value_is_false_beyond_four_errors_and_not_before():
    score = counted(scored(HOLDS, [3.9, -3.9, 4.1, np.nan]))["none"]
    assert score["values"] == 3
    assert score["false, random error"].value == pytest.approx(1 / 3)


@pytest.mark.parametrize(
    ("false", "verdict"),
    [
        (0, Verdict.MET), (4, Verdict.MET), (7, Verdict.UNDECIDED), (12, Verdict.UNDECIDED),
        (20, Verdict.MISSED),
    ],
)  # fmt: skip
def test_a_target_is_met_or_missed_by_more_than_two_monte_carlo_errors(false, verdict):
    errors = np.zeros((20, 500))
    errors[:false, 0] = 9.0
    score = counted(*(scored(HOLDS, row) for row in errors))["none"]
    assert score["false, random error"].value == pytest.approx(false / 10_000)
    assert str(score["target"]) == f"0.1 % {verdict}"


def test_false_values_of_few_clusters_leave_the_target_undecided():
    errors = np.zeros((30, 500))
    errors[:3] = 9.0
    chunks = [scored(HOLDS, row, solvable=np.ones(500, bool)) for row in errors]
    score = counted(*chunks)["none"]
    assert score["false, random error"].value == pytest.approx(0.1)
    assert str(score["target"]) == "0.1 % undecided"
    assert str(score["needless target"]) == "own target 5 % undecided"


def test_intervals_of_each_class_have_targets_and_those_of_all_classes_have_none():
    rng = np.random.default_rng(3)
    errors = [rng.standard_normal(2000) for _ in range(30)]
    scores = counted(*(scored(HOLDS, row) for row in errors))
    assert str(scores["none"]["95 % target"]) == "94 to 97 % met"
    assert str(scores["none"]["68 % target"]) == "66 to 72 % met"
    assert scores["none"]["stated / median error"] == pytest.approx(1.48, rel=0.02)
    assert scores[HELD]["95 % target"] is None
    wide = counted(*(scored(HOLDS, 0.6 * row) for row in errors))["none"]
    assert str(wide["95 % target"]) == "94 to 97 % MISSED"
    assert str(wide["68 % target"]) == "66 to 72 % MISSED"
    assert list(map(str, study.unmet_targets("paths", {("x", "none"): wide}))) == [
        "paths: none (x), 95 % target 94 to 97 % MISSED",
        "paths: none (x), 68 % target 66 to 72 % MISSED",
    ]


def test_values_that_share_an_error_meet_a_target_only_in_many_clusters():
    """No false value of 40 clusters whose values are nearly the same is no proof."""
    rng = np.random.default_rng(4)

    def verdict(clusters):
        shared = np.clip(rng.standard_normal((clusters, 1)), -3.0, 3.0)
        rows = np.repeat(shared, 500, axis=1)
        return counted(*(scored(HOLDS, row) for row in rows))["none"]["target"]

    assert str(verdict(40)) == "0.1 % undecided"
    assert str(verdict(4000)) == "0.1 % met"


def test_rejected_values_are_not_false_and_may_be_needless():
    bits = [BAD, BAD, CARE, 0]
    score = counted(scored(HOLDS, [9.0, 1.0, 9.0, 0.0], bits, solvable=np.ones(4, bool)))["none"]
    assert score["not rejected"].value == 0.5
    assert score["without any flag"].value == 0.0
    assert score["needlessly flagged"].value == 0.5


def test_systematic_errors_and_uncertain_values_are_counted_separately():
    chunk = scored(HIDDEN, [6.0, 9.0], systematic=2.0, uncertain=np.array([False, True]))
    score = counted(chunk)["hidden"]
    assert score["false, random error"].value == 1.0
    assert score["and not uncertain"].value == 0.0
    assert str(score["target"]) == "0.5 % undecided"
    assert score["needlessly flagged"] is None


def test_undetectable_false_values_are_counted_separately():
    misfit = np.array([3.0, 3.0, 9.0, 9.0])
    bits = [0, BAD, 0, 0]
    score = counted(scored(Failure("bent"), [9.0, 9.0, 9.0, 0.0], bits, misfit=misfit))["bent"]
    assert score["and not uncertain"].value == pytest.approx(2 / 3)
    assert score["of these undetectable"].value == pytest.approx(1 / 3)
    assert score["and below 3.5"].value == pytest.approx(1 / 3)
    # What no test can see counts too.
    assert score["target"].limits == "0.5 %"
    assert not score["target"].met
    scores = counted(scored(Failure("bent"), [9.0], misfit=np.array([4.0])), scored(HOLDS, [0.0]))
    assert scores["none"]["of these undetectable"] is None
    assert scores[BROKEN]["of these undetectable"].value == 1.0


def test_visible_misfit_is_the_remainder_of_three_tangents():
    r = np.linspace(2000.0, 9000.0, 300)
    x = (r - r[0]) / np.ptp(r)
    for extinction, amount in ((2e-5, 0.02), (3e-4, 0.05)):
        shape = 1e3 * (r[0] / r) ** 2 * np.exp(-2.0 * extinction * (r - r[0]))
        tangents = np.linalg.qr(np.stack([np.ones_like(r), shape, shape * x], axis=1))[0]
        departure = amount * (x - 0.5) ** 2 * shape
        remainder = np.linalg.norm(departure - tangents @ (tangents.T @ departure))
        misfit = homogeneous_paths.visible_misfit(r, (shape + departure)[np.newaxis])
        assert misfit == pytest.approx(remainder, rel=0.02)


def test_our_test_misses_few_more_detectable_violations_than_the_best_one():
    limit = stats.norm.isf(0.5 * THRESHOLDS.false_alarm)
    assert 0.05 < stats.norm.sf(VISIBLE - limit) < 0.08
    assert stats.norm.sf(3.5 - limit) == pytest.approx(0.5, abs=0.02)
    r = np.linspace(2000.0, 9000.0, 300)
    x = (r - r[0]) / np.ptp(r)
    shape = 1e3 * (r[0] / r) ** 2 * np.exp(-6e-5 * (r - r[0]))
    unit = homogeneous_paths.visible_misfit(r, (shape * (1.0 + 0.02 * x**2))[np.newaxis])
    power = shape * (1.0 + 0.02 * VISIBLE / unit * x**2)
    noise = np.random.default_rng(5).standard_normal((2000, r.size))
    fit = path_fit.fit_homogeneous_path(power + noise, r, variance=1.0)
    missed = np.mean((fit.quality & int(Quality.NOT_HOMOGENEOUS)) == 0)
    assert 0.05 < missed < 0.3


def test_a_value_without_a_stated_error_is_false():
    score = counted(scored(HOLDS, [0.0, 0.0], random=np.array([np.nan, 1.0])))["none"]
    assert score["false, random error"].value == 0.5


def test_all_scenes_that_hold_and_all_that_do_not_are_counted_together():
    others = [scored(Failure(name), [0.0]) for name in "ab"]
    scores = counted(scored(HOLDS, [0.0] * 3), scored(HIDDEN, [9.0]), *others)
    assert (scores[HELD]["values"], scores[BROKEN]["values"]) == (3, 3)
    assert scores[HELD]["false, random error"].value == 0.0
    assert scores[BROKEN]["and not uncertain"].value == pytest.approx(1 / 3)


def test_monte_carlo_error_is_that_of_clusters():
    counts = np.full(100, 50.0)
    clustered = clustered_share(np.repeat([0.0, 50.0], 50), counts)
    independent = clustered_share(np.full(100, 25.0) + np.tile([-1.0, 1.0], 50), counts)
    assert clustered.value == independent.value == 0.5
    assert clustered.error == pytest.approx(0.05)
    assert independent.error < 0.01
    # Of independent values without event, the 95 percent limit is 3 over their number.
    assert 2.0 * clustered_share(np.zeros(100), counts).error == pytest.approx(3.0 / 5000, rel=2e-3)
    assert 2.0 * clustered_share(np.zeros(100), counts, 10.0).error == pytest.approx(
        30.0 / 5000, rel=2e-3
    )


def test_design_effect_is_the_size_of_clusters_whose_values_are_the_same():
    counts = np.full(100, 50.0)
    assert design_effect(np.repeat([0.0, 50.0], 50), counts) == pytest.approx(50.0)
    assert design_effect(np.full(100, 25.0), counts) == 1.0
    assert design_effect(np.zeros(100), counts) == 1.0


def test_difficulty_of_random_paths_is_that_of_the_information_matrix():
    paths, _ = homogeneous_paths.random_paths(3, 8)
    relative_error = homogeneous_paths.least_relative_error(paths)
    r = paths.range
    for k in range(8):
        same = Scenario(
            float(r[0]), float(r[-1] - r[0]), float(paths.extinction[k, 0]),
            float(paths.signal[k, 0]), bins=r.size,
        )  # fmt: skip
        scale = paths.extinction[k, 0] + 1.0 / r.mean()
        at_most = 0.5 / (r[1] - r[0])
        expected = same.difficulty() * scale / min(scale, at_most)
        assert relative_error[k] == pytest.approx(expected, rel=1e-5)


def test_a_signal_that_dies_within_a_bin_is_not_solvable():
    """Its extinction is known only as far as the transmission of one bin is."""
    paths, _ = homogeneous_paths.random_paths(3, 1)
    paths = replace(
        paths, range=np.arange(100.0, 1600.0, 37.5), extinction=np.full((1, 1), 0.1),
        signal=np.full((1, 1), 1e4),
    )  # fmt: skip
    least = homogeneous_paths.least_relative_error(paths)[0]
    assert least > THRESHOLDS.largest_relative_error


@pytest.mark.parametrize("draws", study.DRAWS, ids=lambda rate: rate.name)
def test_the_same_numbers_give_the_same_scenes(draws, repository):
    profiles = min(draws.profiles, 20)

    def scores():
        counted = collect(lambda cluster: draws.score(cluster, profiles), 2)
        return rates(counted, draws.needless, pooled=draws.pooled)

    first = scores()
    assert first == scores()
    assert sum(score["values"] for score in first.values()) > 0
    assert draws.pooled == any(failure in {HELD, BROKEN} for _, failure in first)
    published = json.loads((repository / "docs/results/stability.json").read_text())["tables"]
    rows = published[draws.title]
    assert {(quantity, failure) for quantity, failure, *_ in rows} == set(first)


def test_scans_where_the_model_holds_are_of_calm_air_and_of_a_layer_too():
    counted = collect(lambda _: scans.score_short_scans(0, 4, length=2), 1)
    # The blocks of one geometry are one cluster.
    assert [*counted[["class", "quantity"]].itertuples(index=False, name=None)] == [
        (f"{words}blocks of 2", quantity)
        for words in ("", "calm air, ", "layer of a few altitudes, ", "layer with edges, ")
        for quantity in ("optical depth", "extinction")
    ]


@pytest.mark.parametrize("retrieval", ["multi-angle", "network"])
def test_classes_where_the_model_holds_come_first(retrieval):
    """Their numbers, of which the seeds are made, stay."""
    classes = {"multi-angle": scans.FAILURES, "network": lidar_networks.FAILURES}
    numbered = held_first(classes[retrieval])
    holds = [failure.satisfied for _, (failure, *_) in numbered]
    assert holds == sorted(holds, reverse=True)
    assert all(classes[retrieval][number] is drawn for number, drawn in numbered)


def test_tests_reject_more_paths_with_a_plume_than_paths_where_the_model_holds():
    draws = next(draw for draw in study.DRAWS if draw.name == "homogeneous")
    scores = rates(collect(lambda cluster: draws.score(cluster, 300), 6), 1e-3)
    held = scores["extinction", "none"]
    assert 0.2 < held["not rejected"].value < 0.8
    bent = scores["extinction", "plume"]
    assert bent["not rejected"].value < 0.5 * held["not rejected"].value
    assert bent["and not uncertain"].value > held["and not uncertain"].value


@pytest.fixture(scope="module")
def stability():
    """Return the result for few scenes."""
    draws = tuple(
        replace(draw, quick=1, profiles=8) for draw in study.DRAWS
        if draw.name in {"homogeneous", "signal chain"}
    )  # fmt: skip
    steps = []
    effort = Effort(quick=True, progress=steps.append)
    measured = study.measure_stability(effort, draws)
    assert steps == [1] * len(draws)
    return measured


def test_command_writes_json(stability, monkeypatch, tmp_path):
    monkeypatch.setitem(study.CASES, "all", lambda _: stability)
    folder = tmp_path / "out"
    result = CliRunner().invoke(app, ["stability", "--quick", "--out", str(folder)])
    assert result.exit_code == bool(stability.missed), result.output
    content = json.loads((folder / "result.json").read_text())
    assert content["tables"] == json.loads(stability.json())["tables"]


def test_command_fails_where_a_target_is_missed(stability, monkeypatch):
    failed = replace(stability, missed=["plume (extinction), target 0.5 % MISSED"])
    monkeypatch.setitem(study.CASES, "all", lambda _: failed)
    result = CliRunner().invoke(app, ["stability", "--quick"])
    assert result.exit_code == 1
    assert "missed: plume (extinction)" in result.stderr


def test_command_runs_one_part_without_a_limit_of_time(tmp_path):
    words = ["stability", "--quick", "--case", "short sections", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code in {0, 1}, result.output
    tables = json.loads((tmp_path / "result.json").read_text())["tables"]
    (draws,) = (draws for draws in study.DRAWS if draws.name == "short sections")
    assert list(tables) == [draws.title, study.COST]
    assert {row["method"] for row in tables[study.COST]} == {"short sections"}


def test_command_names_the_cases_of_the_benchmark():
    result = CliRunner().invoke(app, ["stability", "--case", "luck"], env={"COLUMNS": "300"})
    assert result.exit_code == 2
    for case in ("homogeneous", "signal", "elastic", "multiangle", "network", "raman"):
        assert f" or {case}" in result.output


def test_missed_targets_are_those_of_the_tables():
    errors = np.zeros((20, 500))
    errors[:, :5] = 9.0
    scores = counted(*(scored(HIDDEN, row) for row in errors))
    scores = {("x", failure): score for failure, score in scores.items()}
    missed = [f"paths: {name} (x), target 0.5 % MISSED" for name in ("hidden", BROKEN)]
    assert list(map(str, study.unmet_targets("paths", scores))) == missed


def test_values_do_not_depend_on_the_order_of_the_profiles_of_a_block():
    """By more than a millionth of the stated errors, of scans and of networks."""
    order = np.random.default_rng(85).permutation(8)
    for cluster in range(12):
        scan = scans.random_scene(cluster, 8).draw(8, cluster, 85)
        shuffled = scans.Scan(scan.scene, scan.signal[order], scan.variance[order])
        one, two = (scans.retrieve(each) for each in (scan, shuffled))
        change = np.abs(one.optical_depth[order] - two.optical_depth)
        assert np.nanmax(change / two.optical_depth_standard_error, initial=0.0) < 1e-6
        rng = np.random.default_rng((73, cluster))
        clean = lidar_networks.random_signals(rng, lidar_networks.layered)
        if clean is None:
            continue
        power, variance = clean.draw(0.03, 8, cluster)
        one, two = (
            lidar_networks.solve(power[some], variance[some], clean)
            for some in (np.arange(8), order)
        )
        change = np.abs(one.extinction[order] - two.extinction)
        assert np.nanmax(change / two.extinction_standard_error, initial=0.0) < 1e-6


@pytest.mark.parametrize("told", [False, True])
def test_profiles_without_light_are_counted_where_they_are_missed(monkeypatch, told):
    right = recorded_signals.light_scores(5)
    assert [score["target"] is None for score in right.values()].count(True) == 3
    assert {score["share"].value for score in right.values() if score["target"]} == {0.0}

    def all_alike(found, _):
        return {name: np.full_like(one.measured, told) for name, one in found.items()}

    monkeypatch.setattr(recorded_signals, "lightless", all_alike)
    for (case, _), score in recorded_signals.light_scores(2).items():
        assert score["share"].value == float(told == ("flagged" in case)), case


def test_values_doubted_for_another_quantity_are_counted(monkeypatch):
    """Lidar ratios are missing in most of these skies."""

    def doubted():
        scores = rates(collect(lambda k: raman_skies.score_raman(k, 4), 6), 0.05)
        return scores["extinction", "none"]["needlessly flagged"].value

    assert doubted() == 0.0
    monkeypatch.setattr(raman_skies, "concerning", lambda _, found, __: found)
    assert doubted() > 0.5


def test_dead_times_that_are_missing_or_far_are_counted(monkeypatch):
    right = recorded_signals.dead_time_scores(1)
    assert len(right) == 2 * len(recorded_signals.SCENES)
    assert {score["share"].value for score in right.values()} == {0.0}
    for found in (None, DeadTimeEstimate(1e-9, 1e-13, 0.5)):
        monkeypatch.setattr(recorded_signals, "estimate_dead_time", lambda *_, one=found: one)
        wrong = recorded_signals.dead_time_scores(1)
        assert {score["share"].value for score in wrong.values()} == {1.0}


def test_the_cost_of_all_parts_is_a_target():
    whole = study.cost_scores({"a": 400.0, "b": 800.0})["", study.WHOLE]
    assert str(whole["target"]) == "20 min met"
    scores = study.cost_scores({"a": 400.0, "b": 900.0})
    assert scores["", "a"]["CPU time"].value == 400e9
    assert list(map(str, study.unmet_targets("cost", scores))) == [
        "cost: all parts, target 20 min MISSED"
    ]


def test_each_part_states_its_cost(stability):
    rows = stability.figures(study.COST)
    parts = {name: row.value for (_, name, quantity), row in rows.items() if quantity == CPU_TIME}
    assert {"homogeneous", "signal chain", "flags", study.WHOLE} <= set(parts)
    total = sum(value for name, value in parts.items() if name != study.WHOLE)
    assert parts[study.WHOLE] == pytest.approx(total)


def test_cpu_time_includes_that_of_child_processes():
    begin = cpu_seconds()
    subprocess.run([sys.executable, "-c", "sum(range(10**7))"], check=True)
    assert cpu_seconds() - begin > 0.05


def test_command_names_every_benchmark_where_one_is_unknown():
    refused = CliRunner().invoke(app, ["luck"], env={"COLUMNS": "300"})
    assert refused.exit_code == 2
    assert "accuracy or throughput or stability" in refused.output


def test_command_refuses_a_url_as_folder():
    result = CliRunner().invoke(app, ["luck", "--out", "s3://bucket/out"])
    assert result.exit_code == 2
    assert "is a URL" in " ".join(result.stderr.split())


def test_command_refuses_an_option_of_other_benchmarks():
    result = CliRunner().invoke(app, ["stability", "--data", "folder"])
    assert result.exit_code == 2
    assert "leave it out" in result.output


def test_haze_in_the_shape_of_the_background_is_flagged_where_it_is_not_hidden():
    scenes = [
        recorded_signals._known_shape(np.random.default_rng((75, cluster)), 5, haze=3.0)
        for cluster in range(150)
    ]
    error, random, misfit, bits = (
        np.array([scene[name] for scene in scenes])
        for name in ("error", "random", "misfit", "bits")
    )
    flagged = (bits & int(Quality.NOT_HOMOGENEOUS)) != 0
    hidden = misfit < VISIBLE
    assert 0.5 < hidden.mean() < 1.0
    assert np.any(np.abs(error[hidden]) > 4.0 * random[hidden])
    assert flagged[~hidden].mean() > 0.5
    assert flagged[hidden].mean() < 0.1


def test_outlying_bins_cost_few_elastic_values():
    """Without bridging, the tests of background and window reject two of three."""

    def scenes_with_outliers(cluster):
        for values in elastic_skies.score_elastic(cluster, 60):
            if values.failure.name == "outliers":
                yield values

    scores = rates(collect(scenes_with_outliers, 8), None)
    score = scores["backscatter", "outliers"]
    assert score["and not uncertain"].value < VIOLATED
    assert score["not rejected"].value > 0.5
