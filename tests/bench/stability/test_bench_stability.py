"""False values in random scenes: the draws, the counts, the page and the command."""

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
from lidarops.bench.harness.benchmark import Effort
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
    ScoredValues,
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
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

HOLDS = Failure("none", satisfied=True)
HIDDEN = Failure("hidden", unseen="it has the shape of the answer")
BAD = int(Quality.NOT_HOMOGENEOUS)
CARE = int(Quality.OUTLIER)


def scored(failure, error, bits=0, **more):
    error = np.asarray(error, dtype=np.float64)
    stated = {"random": np.ones(error.shape), "systematic": 0.0} | more
    bits = np.broadcast_to(np.int32(bits), error.shape)
    return ScoredValues(failure, "x", error, bits=bits, own=(), **stated)


def counted(*chunks, needless=0.05):
    tally = Tally()
    for chunk in chunks:
        tally.add(chunk, chunk.error.size)
    return {rate.failure: rate for rate in tally.rates("made", needless)}


def test_a_value_is_false_beyond_four_errors_and_not_before():
    rate = counted(scored(HOLDS, [3.9, -3.9, 4.1, np.nan]))["none"]
    assert (rate.scenes, rate.values) == (4, 3)
    assert rate.false_random.value == pytest.approx(1 / 3)


@pytest.mark.parametrize(
    ("false", "verdict"),
    [(1, Verdict.MET), (10, Verdict.MET), (11, Verdict.UNDECIDED), (20, Verdict.MISSED)],
)
def test_a_target_is_missed_by_more_than_two_monte_carlo_errors(false, verdict):
    errors = np.zeros((20, 500))
    errors[:false, 0] = 9.0
    rate = counted(*(scored(HOLDS, row) for row in errors))["none"]
    assert rate.false_random.value == pytest.approx(false / 10_000)
    assert rate.verdict is verdict


def test_false_values_of_few_clusters_leave_the_target_undecided():
    errors = np.zeros((30, 500))
    errors[:3] = 9.0
    chunks = [scored(HOLDS, row, solvable=np.ones(500, bool)) for row in errors]
    rate = counted(*chunks)["none"]
    assert rate.false_random.value == pytest.approx(0.1)
    assert (rate.verdict, rate.needless_verdict) == (Verdict.UNDECIDED, Verdict.MET)
    assert stability_report._targets([rate]) == "Undecided: none (x)."
    assert stability_report.goal(rate) == "0.1 % undecided; needless 5 % met"


def test_rejected_values_are_not_false_and_may_be_needless():
    bits = [BAD, BAD, CARE, 0]
    rate = counted(scored(HOLDS, [9.0, 1.0, 9.0, 0.0], bits, solvable=np.ones(4, bool)))["none"]
    assert rate.kept.value == 0.5
    assert rate.false.value == 0.5
    assert rate.false_bare.value == 0.0
    assert rate.fine_of_rejected.value == 0.5
    assert rate.needless.value == 0.5


def test_systematic_errors_and_uncertain_values_are_counted_separately():
    chunk = scored(HIDDEN, [6.0, 9.0], systematic=2.0, uncertain=np.array([False, True]))
    rate = counted(chunk)["hidden"]
    assert rate.false_random.value == 1.0
    assert rate.false.value == 0.5
    assert rate.false_undoubted.value == 0.0
    assert rate.limited_share == rate.false_undoubted
    assert rate.needless is None


def test_undetectable_false_values_are_counted_separately():
    hidden = np.array([True, True, False, False])
    bits = [0, BAD, 0, 0]
    rate = counted(scored(Failure("bent"), [9.0, 9.0, 9.0, 0.0], bits, hidden=hidden))["bent"]
    assert rate.false_undoubted.value == pytest.approx(2 / 3)
    assert rate.false_hidden.value == pytest.approx(1 / 3)
    assert rate.false_of_seen.value == pytest.approx(1 / 2)
    assert rate.limited_share is rate.false_seen
    assert rate.false_seen.value == pytest.approx(1 / 3)
    rates = counted(scored(Failure("bent"), [9.0], hidden=np.array([True])), scored(HOLDS, [0.0]))
    assert rates["none"].false_hidden is rates["none"].false_of_seen is None
    assert rates[ALL].false_hidden.value == 0.5
    assert rates[ALL].false_seen.value == 0.0


def test_visible_misfit_is_the_remainder_of_three_tangents():
    r = np.linspace(2000.0, 9000.0, 300)
    x = (r - r[0]) / np.ptp(r)
    for extinction, amount in ((2e-5, 0.02), (3e-4, 0.05)):
        shape = 1e3 * (r[0] / r) ** 2 * np.exp(-2.0 * extinction * (r - r[0]))
        tangents = np.linalg.qr(np.stack([np.ones_like(r), shape, shape * x], axis=1))[0]
        departure = amount * (x - 0.5) ** 2 * shape
        remainder = np.linalg.norm(departure - tangents @ (tangents.T @ departure))
        misfit = random_homogeneous.visible_misfit(r, (shape + departure)[np.newaxis])
        assert misfit == pytest.approx(remainder, rel=0.02)


def test_our_test_misses_few_more_detectable_violations_than_the_best_one():
    limit = stats.norm.isf(0.5 * THRESHOLDS.false_alarm)
    assert 0.05 < stats.norm.sf(VISIBLE - limit) < 0.08
    assert stats.norm.sf(3.5 - limit) == pytest.approx(0.5, abs=0.02)
    r = np.linspace(2000.0, 9000.0, 300)
    x = (r - r[0]) / np.ptp(r)
    shape = 1e3 * (r[0] / r) ** 2 * np.exp(-6e-5 * (r - r[0]))
    unit = random_homogeneous.visible_misfit(r, (shape * (1.0 + 0.02 * x**2))[np.newaxis])
    power = shape * (1.0 + 0.02 * VISIBLE / unit * x**2)
    noise = np.random.default_rng(5).standard_normal((2000, r.size))
    fit = path_fit.fit_homogeneous_path(power + noise, r, variance=1.0)
    missed = np.mean((fit.quality & int(Quality.NOT_HOMOGENEOUS)) == 0)
    assert 0.05 < missed < 0.3


def test_a_value_without_a_stated_error_is_false():
    rate = counted(scored(HOLDS, [0.0, 0.0], random=np.array([np.nan, 1.0])))["none"]
    assert rate.false_random.value == 0.5


def test_all_classes_together_hold_every_scene():
    rates = counted(scored(HOLDS, [0.0] * 3), scored(HIDDEN, [9.0]))
    assert rates[ALL].scenes == 4
    assert rates[ALL].false.value == 0.25


def test_monte_carlo_error_is_that_of_clusters():
    counts = np.full(100, 50.0)
    clustered = clustered_share(np.repeat([0.0, 50.0], 50), counts)
    independent = clustered_share(np.full(100, 25.0) + np.tile([-1.0, 1.0], 50), counts)
    assert clustered.value == independent.value == 0.5
    assert clustered.error == pytest.approx(0.05)
    assert independent.error < 0.01
    assert clustered_share(np.zeros(100), counts).error == pytest.approx(1 / 5000)


def test_difficulty_of_random_paths_is_that_of_the_information_matrix():
    paths, _ = random_homogeneous.random_paths(3, 8)
    relative_error = random_homogeneous.least_relative_error(paths)
    r = paths.range
    for k in range(8):
        same = Scenario(
            float(r[0]), float(r[-1] - r[0]), float(paths.extinction[k, 0]),
            float(paths.signal[k, 0]), bins=r.size,
        )  # fmt: skip
        assert relative_error[k] == pytest.approx(difficulty(same), rel=1e-5)


@pytest.mark.parametrize("draws", study.DRAWS, ids=lambda rate: rate.retrieval.value)
def test_the_same_numbers_give_the_same_scenes(draws):
    profiles = min(draws.profiles, 20)

    def rates():
        tally = collect(lambda cluster: draws.score(cluster, profiles), 2, lambda _: None)
        return list(tally.rates(draws.retrieval.value, draws.needless))

    first = rates()
    assert first == rates()
    assert {rate.failure for rate in first} > {ALL}
    assert any(rate.satisfied for rate in first)
    assert sum(rate.values for rate in first if rate.failure == ALL) > 0


def test_where_the_model_holds_homogeneous_paths_are_not_false():
    draws = next(draw for draw in study.DRAWS if draw.retrieval is Retrieval.HOMOGENEOUS)
    tally = collect(lambda cluster: draws.score(cluster, 300), 6, lambda _: None)
    rates = {(r.failure, r.quantity): r for r in tally.rates("homogeneous", 1e-3)}
    held = rates["none", "extinction"]
    assert held.verdict is not Verdict.MISSED
    assert 0.2 < held.kept.value < 0.8
    bent = rates["plume", "extinction"]
    assert bent.kept.value < 0.5 * held.kept.value
    assert bent.false.value > held.false.value


@pytest.fixture(scope="module")
def stability():
    """Return the result for some cases and few scenes."""
    cases = tuple(case for case in study.all_cases() if "visibility" in case.name)
    draws = tuple(
        replace(draw, quick=1, profiles=8) for draw in study.DRAWS
        if draw.retrieval in {Retrieval.HOMOGENEOUS, Retrieval.SIGNAL}
    )  # fmt: skip
    steps = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "all_cases", lambda: cases)
        effort = Effort(quick=True, date="2024-01-01", progress=steps.append)
        measured = study.measure_stability(effort, draws)
    assert steps == [1] * (len(cases) + len(draws))
    return measured


def test_page_names_cases_and_undetectable_violations(stability, tmp_path):
    page = build_benchmark_page(stability_report.stability_report(stability), tmp_path).read_text()
    assert "visibility of extinction" in page
    assert "no: an exponential of range has the shape of extinction itself" in page
    assert "False values: homogeneous" in page
    assert not stability.failed


def test_figures_survive_the_file(stability, tmp_path):
    path = results.save(stability, tmp_path / "result.json")
    assert results.load(stability_report.Stability, path) == stability


@pytest.mark.parametrize(
    ("passed", "finding", "failed"),
    [(True, "", False), (False, "", True), (False, "known", False), (True, "known", True)],
)
def test_an_unexpected_outcome_of_a_case_is_a_failure(stability, passed, finding, failed):
    outcome = CaseOutcome("one", "made", "a value", "another", passed, finding)
    changed = replace(stability, outcomes=(outcome,))
    assert changed.failed is failed
    assert stability_report.verdict(outcome)
    rows = stability_report.stability_report(changed).parts[0].tables[1].rows
    assert bool(rows) is (not passed or bool(finding))


def test_command_prints_json_and_writes_the_page(stability, monkeypatch, tmp_path):
    monkeypatch.setattr(
        study, "measure_stability", lambda effort: replace(stability, date=effort.date)
    )
    folder = tmp_path / "out"
    result = CliRunner().invoke(
        app, ["bench", "stability", "--quick", "--json", "--out", str(folder)]
    )
    assert result.exit_code == 0, result.output
    assert len(json.loads(result.stdout)["outcomes"]) == len(stability.outcomes)
    assert (folder / "index.html").is_file()


def test_command_fails_where_a_case_does(stability, monkeypatch):
    outcome = CaseOutcome("one", "made", "a value", "another", passed=False, finding="")
    failing = replace(stability, outcomes=(outcome,))
    monkeypatch.setattr(study, "measure_stability", lambda _: failing)
    result = CliRunner().invoke(app, ["bench", "stability"])
    assert result.exit_code == 1
    assert "FAILED" in result.stdout


def test_command_names_every_benchmark_where_one_is_unknown():
    refused = CliRunner().invoke(app, ["bench", "luck"], env={"COLUMNS": "300"})
    assert refused.exit_code == 2
    assert "accuracy or throughput or stability" in refused.output


@pytest.mark.parametrize("option", [["--case", "homogeneous"], ["--repeats", "3"], ["file"]])
def test_command_refuses_options_of_other_benchmarks(option):
    result = CliRunner().invoke(app, ["bench", "stability", *option])
    assert result.exit_code == 2
    assert "leave it out" in result.output


# Misfit of elastic signals ------------------------------------------------------------------


def elastic_scene(change=1.0, level=1e6):
    """Return the visible misfit of a clean sky whose signal without noise is changed."""
    base = elastic_cases.simulated_sky()
    mean = np.broadcast_to(base.signal * change + 10.0, base.range.shape)
    noise = (base.signal + 10.0) / level
    rng = np.random.default_rng(6)
    draws = base.signal + 10.0 + np.sqrt(noise) * rng.standard_normal((5, mean.size))
    processed = random_elastic._process(draws, np.broadcast_to(noise, draws.shape), base)
    return (
        base,
        noise,
        processed,
        random_elastic.visible_misfit_of_sky(mean, noise, base, processed),
    )


def test_a_sky_that_satisfies_the_model_has_no_misfit():
    _, _, processed, misfit = elastic_scene()
    assert processed.window.chosen.all()
    assert np.all(misfit < 1.0)


def test_misfit_of_another_shape_in_the_reference_window_is_its_norm():
    base = elastic_cases.simulated_sky()
    wave = 1e-3 * (-1.0) ** np.arange(base.range.size)
    _, noise, processed, misfit = elastic_scene(1.0 + wave * (base.range > 6000.0))
    window = (base.range >= processed.window.bottom[0]) & (base.range <= processed.window.top[0])
    norm = np.linalg.norm((wave * base.signal / np.sqrt(noise))[window])
    assert norm > 2.0 * VISIBLE
    assert norm < misfit[0] < 2.0 * norm


def test_less_signal_than_air_is_visible_and_more_is_haze():
    base = elastic_cases.simulated_sky()
    layer = (base.range > 3000.0) & (base.range < 3600.0)
    assert np.all(elastic_scene(1.0 - 0.5 * layer, 1e4)[-1] > VISIBLE)
    haze = 0.5 * layer * (base.backscatter + base.molecular_backscatter)
    depth = elastic_cases.LIDAR_RATIO * np.cumsum(haze) * 15.0
    assert np.all(elastic_scene((1.0 + 0.5 * layer) * np.exp(-2.0 * depth), 1e4)[-1] < VISIBLE)


def test_a_wrong_lidar_ratio_is_not_visible_beyond_its_stated_error():
    """Twice the lidar ratio is 5 of its stated standard errors, which absorb the misfit."""
    base = elastic_cases.simulated_sky()
    other = 2.0 * elastic_cases.LIDAR_RATIO
    more = (other - elastic_cases.LIDAR_RATIO) * np.cumsum(base.backscatter) * 15.0
    misfit = elastic_scene(np.exp(-2.0 * more))[-1]
    assert np.all(misfit < 1.2 * VISIBLE)


def test_haze_in_the_shape_of_the_background_is_flagged_where_it_is_not_hidden():
    scenes = [
        random_signals._known_shape(np.random.default_rng((75, cluster)), 5, haze=3.0)
        for cluster in range(150)
    ]
    _, error, random, hidden, bits = (np.array(column) for column in zip(*scenes, strict=True))
    flagged = (bits & int(Quality.NOT_HOMOGENEOUS)) != 0
    assert 0.5 < hidden.mean() < 1.0
    assert np.any(np.abs(error[hidden]) > 4.0 * random[hidden])
    assert flagged[~hidden].mean() > 0.5
    assert flagged[hidden].mean() < 0.1


def test_outlying_bins_cost_few_elastic_values():
    """Without bridging, the tests of background and window reject two of three."""

    def scenes_with_outliers(cluster):
        for values, scenes in random_elastic.score_elastic(cluster, 60):
            if values.failure.name == "outliers":
                yield values, scenes

    rates = collect(scenes_with_outliers, 8, lambda _: None).rates("elastic", None)
    (rate,) = (rate for rate in rates if rate.failure == "outliers")
    assert rate.limited_share.value < rate.target
    assert rate.kept.value > 0.5
