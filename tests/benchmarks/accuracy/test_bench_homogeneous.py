"""The benchmark of the homogeneous path: bounds, peers, results and pages."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import product

import mpmath
import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks import registry
from benchmarks.__main__ import app
from benchmarks.accuracy import homogeneous
from benchmarks.accuracy.homogeneous_cases import (
    QUANTITIES,
    Estimates,
    Scenario,
    background_bias,
    difficulty,
    least_errors,
    methods,
    scenarios,
)
from benchmarks.accuracy.homogeneous_peers import JIT, iterative_peers
from benchmarks.harness.results import Effort, Study
from benchmarks.harness.timing import CPU_TIME, READ, least_times
from benchmarks.throughput import retrievals
from lidarops.errors import CampaignError, RawFormatError

pytestmark = pytest.mark.slow

PATH = Scenario(2500.0, 8000.0, 3e-5, 1000.0)
PATHS = [PATH, Scenario(10500.0, 1700.0, 1e-4, 1e4), Scenario(2500.0, 8000.0, 5e-3, 1e4)]


@pytest.fixture(scope="module")
def accuracy() -> Study:
    return homogeneous.measure_homogeneous(Effort(quick=True, date="2024-01-01"), profiles=200)


@pytest.fixture(scope="module")
def timed() -> Study:
    return retrievals.measure_solvers(Effort(repeats=1, date="2024-01-01"), profiles=40)


def _bound_by_mpmath(path: Scenario) -> dict[str, float]:
    """Invert the Fisher matrix of (P*, B, extinction) directly, in 60 digits."""
    with mpmath.workdps(60):
        sigma, amplitude = mpmath.mpf(path.extinction), mpmath.mpf(path.amplitude)
        fisher = mpmath.zeros(3)
        for distance in map(mpmath.mpf, path.range.tolist()):
            shape = mpmath.exp(-2 * sigma * distance) / distance**2
            slopes = mpmath.matrix([1, shape, -2 * distance * amplitude * shape])
            fisher += slopes * slopes.T
        covariance = fisher**-1
        order = {"background": 0, "amplitude": 1, "extinction": 2}
        error = {name: mpmath.sqrt(covariance[k, k]) for name, k in order.items()}
        error["log_amplitude"] = error.pop("amplitude") / amplitude
        return {name: float(value) for name, value in error.items()}


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.label)
def test_the_bound_is_the_inverse_fisher_matrix(path):
    expected = _bound_by_mpmath(path)
    for name, value in least_errors(path).items():
        assert value == pytest.approx(expected[name], rel=1e-9)


def test_the_bound_follows_from_finite_differences_of_the_signal():
    steps = {"background": 1e-2, "signal": 1e-2, "extinction": 1e-10}
    slopes = np.stack(
        [
            (
                replace(PATH, **{name: getattr(PATH, name) + step}).mean
                - replace(PATH, **{name: getattr(PATH, name) - step}).mean
            )
            / (2 * step)
            for name, step in steps.items()
        ],
        axis=1,
    )
    scale = np.linalg.norm(slopes, axis=0)
    covariance = np.linalg.inv((slopes / scale).T @ (slopes / scale)) / np.outer(scale, scale)
    bound = least_errors(PATH)
    assert bound["background"] == pytest.approx(math.sqrt(covariance[0, 0]), rel=1e-5)
    assert bound["extinction"] == pytest.approx(math.sqrt(covariance[2, 2]), rel=1e-5)


def test_the_second_order_bias_is_that_of_least_squares():
    path = Scenario(2500.0, 4000.0, 3e-5, 40.0)
    count = 40_000
    solution = methods()["direct"](path.powers(count, 3), path)
    error = solution.values["background"] - path.background
    expected = background_bias(path)
    spread = error.std() / math.sqrt(count)
    assert abs(expected) > 8 * spread
    # The expectation neglects terms of fourth order in the noise.
    assert error.mean() == pytest.approx(expected, abs=4 * spread + 0.1 * abs(expected))


def test_scenarios_span_the_solvable_paths():
    paths = scenarios()
    assert len(paths) >= 40
    assert len(set(paths)) == len(paths)
    assert {path.start for path in paths} == {2500.0, 10500.0}
    assert max(difficulty(path) for path in paths) <= 0.1
    assert max(difficulty(path) for path in paths) > 0.05
    assert len(scenarios(quick=True)) == 8
    assert set(scenarios(quick=True)) < set(paths)


def test_profiles_are_the_model_and_unit_noise_and_repeat():
    power = PATH.powers(3000, 5)
    assert np.array_equal(power, PATH.powers(3000, 5))
    assert not np.array_equal(power, PATH.powers(3000, 6))
    assert PATH.mean[0] == pytest.approx(PATH.background + PATH.signal)
    at = PATH.range[100]
    model = PATH.background + PATH.amplitude / at**2 * math.exp(-2 * PATH.extinction * at)
    assert PATH.mean[100] == pytest.approx(model, rel=1e-12)
    assert (power - PATH.mean).std() == pytest.approx(1.0, abs=5e-3)


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.label)
def test_every_peer_agrees_with_the_direct_fit(path):
    power = path.powers(20)
    direct = methods()["direct"](power, path)
    bound = least_errors(path)
    for name, solver in iterative_peers().items():
        peer = solver(power, path)
        for quantity in QUANTITIES:
            distance = np.abs(peer.values[quantity] - direct.values[quantity]) / bound[quantity]
            assert distance.max() < 1e-3, (name, quantity)
            ratio = peer.standard_errors[quantity] / direct.standard_errors[quantity]
            assert np.abs(ratio - 1).max() < 1e-3, (name, quantity)


def test_the_compiled_fit_rejects_profiles_that_cannot_converge():
    power = PATH.powers(3)
    power[1] = np.nan
    solved = iterative_peers()[JIT](power, PATH)
    alone = iterative_peers()[JIT](power[:1], PATH)
    assert solved.rejected.tolist() == [False, True, False]
    # They start from the mean of other profiles.
    assert solved.values["extinction"][0] == pytest.approx(alone.values["extinction"][0], rel=1e-6)


def test_peers_start_from_the_data_alone():
    power = PATH.powers(20)
    elsewhere = replace(PATH, extinction=1e-3, background=0.0, signal=1.0)
    for name, solver in iterative_peers().items():
        known, unknown = (solver(power, path).values for path in (PATH, elsewhere))
        assert np.array_equal(known["extinction"], unknown["extinction"]), name


def test_scores_of_known_errors():
    bound = least_errors(PATH)
    error = np.array([3.0, -1.0, 1.0, 5.0, np.nan])

    def solver(power, scenario):
        return Estimates(
            values={name: scenario.truth[name] + error * bound[name] for name in QUANTITIES},
            standard_errors={
                "extinction": np.full(5, bound["extinction"]),
                "background": np.full(5, 2 * bound["background"]),
                "log_amplitude": np.zeros(5),
            },
            flagged=np.array([True, False, False, True, True]),
            rejected=np.array([False, False, False, True, True]),
        )

    power = np.empty((5, PATH.bins))
    score = homogeneous.score_path(solver, PATH, power)
    assert score["extinction: RMSE"].value == pytest.approx(math.sqrt(11 / 3), rel=1e-6)
    assert score["extinction: bias"].value == pytest.approx(1.0, rel=1e-6)
    assert score["extinction: bias"].error == pytest.approx(math.sqrt(8 / 3 / 3), rel=1e-6)
    assert score["extinction: 95 %"].value == pytest.approx(2 / 3)
    assert score["background: 95 %"].value == pytest.approx(1.0)
    assert "log_amplitude: RMSE" not in score, "a given value has no score"
    assert (score["flagged"].value, score["rejected"].value) == (0.6, 0.4)


def test_least_squares_reaches_the_bound(accuracy):
    summary = accuracy.figures("All paths")
    for quantity, method in product(("extinction", "background"), ("direct", JIT)):
        worst = summary[quantity, method, "worst"]
        assert abs(worst.value - 1) < 5 * worst.error + 0.02
        assert summary[quantity, method, "95 %"].value > 0.85
    assert {method for _, method, _ in summary} == set(methods()) | set(iterative_peers())
    assert summary["extinction", "direct", "solved"].value == "all"
    assert summary["extinction", "known_extinction", "solved"].value == "0"


def test_lag_1_is_biased_as_published_and_least_squares_is_not():
    scores = homogeneous.published_offsets(1500)
    for length, expected in {1: 10.2, 4: 2.7, 6: 1.4, 8: 0.8}.items():
        score = scores[f"2.5 + {length} km", "1"]
        assert score["lag 1"].value == pytest.approx(expected, abs=0.3)
    for (section, averaged), score in scores.items():
        assert score["lag 1"].value > 50 * score["lag 1"].error
        if averaged != "1" and section in {f"2.5 + {length} km" for length in (2, 4, 6, 8)}:
            rest = score["direct"].value - score["expected"]
            assert abs(rest) < 4 * score["direct"].error
            assert score["direct"].error < 0.02 * score["lag 1"].value


def test_speeds_are_multiples_of_the_read_of_their_setting(timed):
    settings = [results.title for results in timed.chapters[0].results]
    assert len(settings) == 8
    for setting in settings:
        rows = timed.figures(setting)
        assert rows[setting, READ, "reads"].value == 1.0
        read = rows[setting, READ, CPU_TIME].value
        methods_timed = {method for _, method, _ in rows}
        assert methods_timed >= {"direct", "cubic"} - ({"cubic"} if "missing" in setting else set())
        for method in methods_timed:
            time = rows[setting, method, CPU_TIME].value
            assert rows[setting, method, "reads"].value == pytest.approx(time / read)


def test_calls_alternate_and_the_least_time_counts(monkeypatch):
    clock = iter([0.0, 5.0, 0.0, 7.0, 0.0, 4.0, 0.0, 9.0])
    calls: list[str] = []
    monkeypatch.setattr("time.process_time", lambda: next(clock))
    functions = {name: (lambda name=name: calls.append(name)) for name in "ab"}
    assert least_times(functions, 2) == {"a": 4.0, "b": 7.0}
    assert calls == ["a", "b"] * 3


@pytest.mark.parametrize(
    ("quantity", "case", "files", "error", "message"),
    [
        ("luck", None, [], CampaignError, "throughput"),
        ("accuracy", "weather", [], CampaignError, "network or raman or reader"),
        ("accuracy", "reader", ["file"], CampaignError, "no accuracy"),
        ("accuracy", "archive", [], CampaignError, "'archive' has no accuracy"),
        ("accuracy", "campaigns", [], CampaignError, "'campaigns' has no accuracy"),
        ("throughput", "homogeneous", ["file"], CampaignError, "takes no files"),
        ("throughput", "reader", [], RawFormatError, "at least one file"),
    ],
)
def test_wrong_use_is_refused(quantity, case, files, error, message):
    with pytest.raises(error, match=message):
        registry.run_benchmark(quantity, case, files, Effort())


def test_the_command_prints_writes_and_dates(monkeypatch, accuracy, tmp_path):
    passed = []

    def measure(effort):
        passed.append(effort)
        return accuracy

    monkeypatch.setattr(homogeneous, "measure_homogeneous", measure)
    words = ["accuracy", "--case", "homogeneous", "--quick", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert passed[0].quick
    assert len(passed[0].date) == len("2024-01-01")
    assert "direct" in result.stdout
    assert "index.html" in result.stdout.replace("\n", "")
    printed = CliRunner().invoke(app, [*words, "--json"])
    assert json.loads(printed.stdout) == json.loads((tmp_path / "result.json").read_text())
