"""False values of random scenes: what is drawn, what is counted, the page and the command."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from lidarops.bench.accuracy import elastic_cases
from lidarops.bench.accuracy.homogeneous_cases import Scenario, difficulty
from lidarops.bench.harness import results
from lidarops.bench.harness.terms import Effort
from lidarops.bench.stability import (
    random_elastic,
    random_homogeneous,
    random_signals,
    stability_report,
    study,
)
from lidarops.bench.stability.random_scenes import (
    ALL,
    VISIBLE,
    Failure,
    Judged,
    Tally,
    Verdict,
    clustered_share,
    collect,
)
from lidarops.bench.stability.stiff_cases import CaseOutcome, Retrieval
from lidarops.cli import app
from lidarops.flags import Quality
from lidarops.reports.benchmark_page import build_benchmark_page
from lidarops.retrieve.homogeneous import path_fit
from lidarops.retrieve.homogeneous._fit_quality import FALSE_ALARM

HOLDS = Failure("none", satisfied=True)
HIDDEN = Failure("hidden", unseen="it has the shape of the answer")
BAD = int(Quality.POOR_FIT)
CARE = int(Quality.OUTLIER)


def judged(failure, error, bits=0, **more):
    error = np.asarray(error, dtype=np.float64)
    given = {"random": np.ones(error.shape), "systematic": 0.0} | more
    bits = np.broadcast_to(np.int32(bits), error.shape)
    return Judged(failure, "x", error, given.pop("random"), given.pop("systematic"), bits, **given)


def counted(*chunks, needless=0.05):
    tally = Tally()
    for chunk in chunks:
        tally.add(chunk, chunk.error.size)
    return {rate.failure: rate for rate in tally.rates("made", needless)}


def test_a_value_is_false_beyond_four_errors_and_not_before():
    rate = counted(judged(HOLDS, [3.9, -3.9, 4.1, np.nan]))["none"]
    assert (rate.scenes, rate.values) == (4, 3)
    assert rate.false_random.value == pytest.approx(1 / 3)


@pytest.mark.parametrize(
    ("false", "verdict"),
    [(1, Verdict.MET), (10, Verdict.MET), (11, Verdict.UNTOLD), (20, Verdict.MISSED)],
)
def test_a_target_is_missed_by_more_than_two_monte_carlo_errors(false, verdict):
    errors = np.zeros((20, 500))
    errors[:false, 0] = 9.0
    rate = counted(*(judged(HOLDS, row) for row in errors))["none"]
    assert rate.false_random.value == pytest.approx(false / 10_000)
    assert rate.verdict is verdict


def test_one_cluster_of_false_values_does_not_pass_for_a_target_that_is_met():
    errors = np.zeros((30, 500))
    errors[:3] = 9.0
    chunks = [judged(HOLDS, row, solvable=np.ones(500, bool)) for row in errors]
    rate = counted(*chunks)["none"]
    assert rate.false_random.value == pytest.approx(0.1)
    assert (rate.verdict, rate.needless_verdict) == (Verdict.UNTOLD, Verdict.MET)
    assert stability_report._told([rate]) == "Not told by so few: none (x)."
    assert stability_report._row(rate)[13] == "0.1 % not told by so few; needless 5 % met"


def test_what_is_rejected_is_not_false_and_may_be_needless():
    bits = [BAD, BAD, CARE, 0]
    rate = counted(judged(HOLDS, [9.0, 1.0, 9.0, 0.0], bits, solvable=np.ones(4, bool)))["none"]
    assert rate.kept.value == 0.5
    assert rate.false.value == 0.5
    assert rate.false_bare.value == 0.0
    assert rate.fine_of_rejected.value == 0.5
    assert rate.needless.value == 0.5


def test_systematic_errors_and_doubts_count_apart():
    chunk = judged(HIDDEN, [6.0, 9.0], systematic=2.0, doubted=np.array([False, True]))
    rate = counted(chunk)["hidden"]
    assert rate.false_random.value == 1.0
    assert rate.false.value == 0.5
    assert rate.false_undoubted.value == 0.0
    assert rate.judged == rate.false_undoubted
    assert rate.needless is None


def test_what_no_test_can_see_is_false_but_told_apart():
    hidden = np.array([True, True, False, False])
    bits = [0, BAD, 0, 0]
    rate = counted(judged(Failure("bent"), [9.0, 9.0, 9.0, 0.0], bits, hidden=hidden))["bent"]
    assert rate.false_undoubted.value == pytest.approx(2 / 3)
    assert rate.false_hidden.value == pytest.approx(1 / 3)
    assert rate.false_of_seen.value == pytest.approx(1 / 2)
    assert rate.judged is rate.false_seen
    assert rate.false_seen.value == pytest.approx(1 / 3)
    rates = counted(judged(Failure("bent"), [9.0], hidden=np.array([True])), judged(HOLDS, [0.0]))
    assert rates["none"].false_hidden is rates["none"].false_of_seen is None
    assert rates[ALL].false_hidden.value == 0.5
    assert rates[ALL].false_seen.value == 0.0


def test_what_can_be_seen_is_what_three_tangents_leave_over():
    r = np.linspace(2000.0, 9000.0, 300)
    x = (r - r[0]) / np.ptp(r)
    for extinction, amount in ((2e-5, 0.02), (3e-4, 0.05)):
        shape = 1e3 * (r[0] / r) ** 2 * np.exp(-2.0 * extinction * (r - r[0]))
        tangents = np.linalg.qr(np.stack([np.ones_like(r), shape, shape * x], axis=1))[0]
        departure = amount * (x - 0.5) ** 2 * shape
        left = np.linalg.norm(departure - tangents @ (tangents.T @ departure))
        found = random_homogeneous.visible_misfit(r, (shape + departure)[np.newaxis])
        assert found == pytest.approx(left, rel=0.02)


def test_the_best_test_misses_few_of_what_can_be_seen_and_ours_not_many_more():
    limit = stats.norm.isf(0.5 * FALSE_ALARM)
    assert 0.05 < stats.norm.sf(VISIBLE - limit) < 0.08
    assert stats.norm.sf(3.5 - limit) == pytest.approx(0.5, abs=0.02)
    r = np.linspace(2000.0, 9000.0, 300)
    x = (r - r[0]) / np.ptp(r)
    shape = 1e3 * (r[0] / r) ** 2 * np.exp(-6e-5 * (r - r[0]))
    unit = random_homogeneous.visible_misfit(r, (shape * (1.0 + 0.02 * x**2))[np.newaxis])
    power = shape * (1.0 + 0.02 * VISIBLE / unit * x**2)
    noise = np.random.default_rng(5).standard_normal((2000, r.size))
    found = path_fit.fit_homogeneous_path(power + noise, r, variance=1.0)
    missed = np.mean((found.quality & int(Quality.NOT_HOMOGENEOUS)) == 0)
    assert 0.05 < missed < 0.3


def test_a_value_without_a_stated_error_is_false():
    rate = counted(judged(HOLDS, [0.0, 0.0], random=np.array([np.nan, 1.0])))["none"]
    assert rate.false_random.value == 0.5


def test_all_classes_together_hold_every_scene():
    rates = counted(judged(HOLDS, [0.0] * 3), judged(HIDDEN, [9.0]))
    assert rates[ALL].scenes == 4
    assert rates[ALL].false.value == 0.25


def test_monte_carlo_error_is_that_of_clusters():
    whole = np.full(100, 50.0)
    together = clustered_share(np.repeat([0.0, 50.0], 50), whole)
    apart = clustered_share(np.full(100, 25.0) + np.tile([-1.0, 1.0], 50), whole)
    assert together.value == apart.value == 0.5
    assert together.error == pytest.approx(0.05)
    assert apart.error < 0.01
    assert clustered_share(np.zeros(100), whole).error == pytest.approx(1 / 5000)


def test_difficulty_of_random_paths_is_that_of_the_information_matrix():
    paths, _ = random_homogeneous.random_paths(3, 8)
    found = random_homogeneous.least_relative_error(paths)
    r = paths.range
    for k in range(8):
        same = Scenario(
            float(r[0]), float(r[-1] - r[0]), float(paths.extinction[k, 0]),
            float(paths.signal[k, 0]), bins=r.size,
        )  # fmt: skip
        assert found[k] == pytest.approx(difficulty(same), rel=1e-5)


@pytest.mark.parametrize("draws", study.DRAWS, ids=lambda one: one.retrieval.value)
def test_the_same_numbers_give_the_same_scenes(draws):
    profiles = min(draws.profiles, 20)

    def rates():
        tally = collect(lambda cluster: draws.judged(cluster, profiles), 2, lambda _: None)
        return list(tally.rates(draws.retrieval.value, draws.needless))

    first = rates()
    assert first == rates()
    assert {one.failure for one in first} > {ALL}
    assert any(one.satisfied for one in first)
    assert sum(one.values for one in first if one.failure == ALL) > 0


def test_where_the_model_holds_homogeneous_paths_are_not_false():
    draws = next(one for one in study.DRAWS if one.retrieval is Retrieval.HOMOGENEOUS)
    tally = collect(lambda cluster: draws.judged(cluster, 300), 6, lambda _: None)
    rates = {(r.failure, r.quantity): r for r in tally.rates("homogeneous", 1e-3)}
    held = rates["none", "extinction"]
    assert held.verdict is not Verdict.MISSED
    assert 0.2 < held.kept.value < 0.8
    bent = rates["plume", "extinction"]
    assert bent.kept.value < 0.5 * held.kept.value
    assert bent.false.value > held.false.value


@pytest.fixture(scope="module")
def found():
    """Return the benchmark of some cases and few scenes."""
    cases = tuple(case for case in study.all_cases() if "visibility" in case.name)
    draws = tuple(
        replace(one, quick=1, profiles=8) for one in study.DRAWS
        if one.retrieval in {Retrieval.HOMOGENEOUS, Retrieval.SIGNAL}
    )  # fmt: skip
    steps = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "all_cases", lambda: cases)
        effort = Effort(quick=True, date="2024-01-01", progress=steps.append)
        measured = study.measure_stability(effort, draws)
    assert steps == [1] * (len(cases) + len(draws))
    return measured


def test_page_names_cases_and_what_cannot_be_seen(found, tmp_path):
    page = build_benchmark_page(
        stability_report.stability_report(found, "result.json"), tmp_path
    ).read_text()
    assert "visibility of extinction" in page
    assert "no: an exponential of range has the shape of extinction itself" in page
    assert "False values: homogeneous" in page
    assert not found.failed


def test_figures_survive_the_file(found, tmp_path):
    path = results.save(found, tmp_path / "result.json")
    assert results.load(stability_report.Stability, path) == found


@pytest.mark.parametrize(
    ("passed", "finding", "failed"),
    [(True, "", False), (False, "", True), (False, "known", False), (True, "known", True)],
)
def test_a_case_fails_where_it_goes_otherwise_than_known(found, passed, finding, failed):
    outcome = CaseOutcome("one", "made", "a value", "another", passed, finding)
    one = replace(found, outcomes=(outcome,))
    assert one.failed is failed
    assert stability_report.verdict(outcome)
    rows = stability_report.stability_report(one).parts[0].tables[1].rows
    assert bool(rows) is (not passed or bool(finding))


def test_command_prints_json_and_writes_the_page(found, monkeypatch, tmp_path):
    monkeypatch.setattr(study, "measure_stability", lambda effort: replace(found, date=effort.date))
    folder = tmp_path / "out"
    made = CliRunner().invoke(
        app, ["bench", "stability", "--quick", "--json", "--out", str(folder)]
    )
    assert made.exit_code == 0, made.output
    assert len(json.loads(made.stdout)["outcomes"]) == len(found.outcomes)
    assert (folder / "index.html").is_file()


def test_command_fails_where_a_case_does(found, monkeypatch):
    outcome = CaseOutcome("one", "made", "a value", "another", passed=False, finding="")
    monkeypatch.setattr(study, "measure_stability", lambda _: replace(found, outcomes=(outcome,)))
    made = CliRunner().invoke(app, ["bench", "stability"])
    assert made.exit_code == 1
    assert "FAILED" in made.stdout


def test_command_names_every_benchmark_where_one_is_unknown():
    refused = CliRunner().invoke(app, ["bench", "luck"], env={"COLUMNS": "300"})
    assert refused.exit_code == 2
    assert "accuracy or throughput or stability" in refused.output


@pytest.mark.parametrize("option", [["--case", "homogeneous"], ["--repeats", "3"], ["file"]])
def test_command_refuses_what_stability_does_not_take(option):
    made = CliRunner().invoke(app, ["bench", "stability", *option])
    assert made.exit_code == 2
    assert "leave it out" in made.output


# What an elastic signal shows ---------------------------------------------------------------


def elastic_scene(change=1.0, level=1e6):
    """Return what is visible of a clean sky whose signal without noise is changed."""
    base = elastic_cases.simulated_sky()
    mean = np.broadcast_to(base.signal * change + 10.0, base.range.shape)
    noise = (base.signal + 10.0) / level
    rng = np.random.default_rng(6)
    draws = base.signal + 10.0 + np.sqrt(noise) * rng.standard_normal((5, mean.size))
    found = random_elastic._process(draws, np.broadcast_to(noise, draws.shape), base)
    return base, noise, found, random_elastic.visible_departure(mean, noise, base, found)


def test_a_sky_as_the_inversion_has_it_shows_nothing():
    _, _, found, seen = elastic_scene()
    assert found.window.chosen.all()
    assert np.all(seen < 1.0)


def test_what_has_another_shape_in_the_reference_window_is_seen_by_its_norm():
    base = elastic_cases.simulated_sky()
    wave = 1e-3 * (-1.0) ** np.arange(base.range.size)
    _, noise, found, seen = elastic_scene(1.0 + wave * (base.range > 6000.0))
    part = (base.range >= found.window.bottom[0]) & (base.range <= found.window.top[0])
    norm = np.linalg.norm((wave * base.signal / np.sqrt(noise))[part])
    assert norm > 2.0 * VISIBLE
    assert norm < seen[0] < 2.0 * norm


def test_less_than_air_is_seen_and_more_than_air_is_haze():
    base = elastic_cases.simulated_sky()
    part = (base.range > 3000.0) & (base.range < 3600.0)
    assert np.all(elastic_scene(1.0 - 0.5 * part, 1e4)[-1] > VISIBLE)
    haze = 0.5 * part * (base.backscatter + base.molecular_backscatter)
    depth = elastic_cases.LIDAR_RATIO * np.cumsum(haze) * 15.0
    assert np.all(elastic_scene((1.0 + 0.5 * part) * np.exp(-2.0 * depth), 1e4)[-1] < VISIBLE)


def test_a_lidar_ratio_that_is_off_is_never_seen_by_more_than_is_declared():
    """The declared error takes it up: by twice, that is 5 of its standard errors."""
    base = elastic_cases.simulated_sky()
    other = 2.0 * elastic_cases.LIDAR_RATIO
    more = (other - elastic_cases.LIDAR_RATIO) * np.cumsum(base.backscatter) * 15.0
    seen = elastic_scene(np.exp(-2.0 * more))[-1]
    assert np.all(seen < 1.2 * VISIBLE)


def test_haze_in_the_shape_of_the_background_is_told_apart_where_it_is_hidden():
    found = [
        random_signals._known_shape(np.random.default_rng((75, cluster)), 5, haze=3.0)
        for cluster in range(150)
    ]
    _, error, random, hidden, bits = (np.array(column) for column in zip(*found, strict=True))
    told = (bits & int(Quality.NOT_HOMOGENEOUS)) != 0
    assert 0.5 < hidden.mean() < 1.0
    assert np.any(np.abs(error[hidden]) > 4.0 * random[hidden])
    assert told[~hidden].mean() > 0.5
    assert told[hidden].mean() < 0.1


def test_single_wild_bins_cost_few_elastic_values():
    """Without bridging, the tests of background and window reject two of three."""

    def wild(cluster):
        for judged, scenes in random_elastic.judge_elastic(cluster, 60):
            if judged.failure.name == "outliers":
                yield judged, scenes

    (rate,) = (
        one
        for one in collect(wild, 8, lambda _: None).rates("elastic", None)
        if one.failure == "outliers"
    )
    assert rate.judged.value < rate.target
    assert rate.kept.value > 0.5
