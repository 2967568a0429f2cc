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

from benchmarks.__main__ import BENCHMARKS, app, measure
from benchmarks.accuracy import homogeneous
from benchmarks.accuracy.homogeneous import PEERS
from benchmarks.harness.figure import CPU_TIME
from benchmarks.harness.results import Effort, Study
from benchmarks.scenes.homogeneous_paths import (
    QUANTITIES,
    TAIL_MEAN,
    Estimates,
    Scenario,
    methods,
    scenarios,
)
from benchmarks.throughput import retrievals
from benchmarks.throughput.retrievals import READ, least_times
from lidarops.errors import CampaignError

pytestmark = pytest.mark.slow

(PROJECTION,) = PEERS
PATH = Scenario(2500.0, 8000.0, 3e-5, 1000.0)
PATHS = [PATH, Scenario(10500.0, 1700.0, 1e-4, 1e4), Scenario(2500.0, 8000.0, 5e-3, 1e4)]


@pytest.fixture(scope="module")
def accuracy() -> Study:
    return homogeneous.measure_homogeneous(Effort(quick=True), profiles=200)


@pytest.fixture(scope="module")
def timed() -> Study:
    return retrievals.measure_solvers(Effort(), profiles=40, repeats=1)


def _bound_by_mpmath(path: Scenario) -> dict[str, float]:
    """Invert the Fisher matrix of (P*, B, extinction) directly, in 60 digits."""
    with mpmath.workdps(60):
        sigma = mpmath.mpf(path.extinction)
        start = mpmath.mpf(path.start)
        amplitude = path.signal * start**2 * mpmath.exp(2 * sigma * start)
        fisher = mpmath.zeros(3)
        for distance in map(mpmath.mpf, path.range.tolist()):
            shape = mpmath.exp(-2 * sigma * distance) / distance**2
            slopes = mpmath.matrix([1, shape, -2 * distance * amplitude * shape])
            fisher += slopes * slopes.T
        covariance = fisher**-1
        order = {"background": 0, "extinction": 2}
        return {name: float(mpmath.sqrt(covariance[k, k])) for name, k in order.items()}


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.label)
def test_the_bound_is_the_inverse_fisher_matrix(path):
    expected = _bound_by_mpmath(path)
    for name, value in path.least_errors().items():
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
    bound = PATH.least_errors()
    assert bound["background"] == pytest.approx(math.sqrt(covariance[0, 0]), rel=1e-5)
    assert bound["extinction"] == pytest.approx(math.sqrt(covariance[2, 2]), rel=1e-5)


def background_bias(path: Scenario) -> float:
    r"""Return the bias of the background common to all least-squares solutions.

    To second order, with the inverse Fisher matrix C and the second derivatives H of the model
    (box1971), :math:`-\tfrac12 C \sum_i J_i \mathrm{tr}(C H_i)`.
    """
    middle = path.range.mean()
    away = path.range - middle
    shape = (middle / path.range) ** 2 * np.exp(-2 * path.extinction * away)
    at_middle = math.exp(-2 * path.extinction * (middle - path.start))
    height = path.signal * (path.start / middle) ** 2 * at_middle
    slopes = np.stack([np.ones_like(shape), shape, -2 * height * away * shape], axis=1)
    scale = np.linalg.norm(slopes, axis=0)
    covariance = np.linalg.inv((slopes / scale).T @ (slopes / scale)) / np.outer(scale, scale)
    bend = -4 * covariance[1, 2] * away * shape + 4 * covariance[2, 2] * height * away**2 * shape
    return float(-0.5 * (covariance @ (slopes.T @ bend))[0])


def test_the_bias_is_that_of_least_squares_to_second_order():
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
    assert max(path.difficulty() for path in paths) <= 0.1
    assert max(path.difficulty() for path in paths) > 0.05
    assert len(scenarios(quick=True)) == 8
    assert set(scenarios(quick=True)) < set(paths)


def test_profiles_are_the_model_and_unit_noise_and_repeat():
    power = PATH.powers(3000, 5)
    assert np.array_equal(power, PATH.powers(3000, 5))
    assert not np.array_equal(power, PATH.powers(3000, 6))
    assert PATH.mean[0] == pytest.approx(PATH.background + PATH.signal)
    at = PATH.range[100]
    fall = (PATH.start / at) ** 2 * math.exp(-2 * PATH.extinction * (at - PATH.start))
    model = PATH.background + PATH.signal * fall
    assert PATH.mean[100] == pytest.approx(model, rel=1e-12)
    assert (power - PATH.mean).std() == pytest.approx(1.0, abs=5e-3)


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.label)
def test_every_peer_agrees_with_the_direct_fit(path):
    power = path.powers(20)
    direct = methods()["direct"](power, path)
    bound = path.least_errors()
    for name, solver in PEERS.items():
        peer = solver(power, path)
        for quantity in QUANTITIES:
            distance = np.abs(peer.values[quantity] - direct.values[quantity]) / bound[quantity]
            assert distance.max() < 1e-3, (name, quantity)
            ratio = peer.standard_errors[quantity] / direct.standard_errors[quantity]
            assert np.abs(ratio - 1).max() < 1e-3, (name, quantity)


def test_the_compiled_fit_rejects_profiles_that_cannot_converge():
    power = PATH.powers(3)
    power[1] = np.nan
    solved = PEERS[PROJECTION](power, PATH)
    alone = PEERS[PROJECTION](power[:1], PATH)
    assert solved.rejected.tolist() == [False, True, False]
    # They start from the mean of other profiles.
    assert solved.values["extinction"][0] == pytest.approx(alone.values["extinction"][0], rel=1e-3)


def test_peers_start_from_the_data_alone():
    power = PATH.powers(20)
    elsewhere = replace(PATH, extinction=1e-3, background=0.0, signal=1.0)
    for name, solver in PEERS.items():
        known, unknown = (solver(power, path).values for path in (PATH, elsewhere))
        assert np.array_equal(known["extinction"], unknown["extinction"]), name


def test_scores_of_known_errors():
    bound = PATH.least_errors()
    error = np.array([3.0, -1.0, 1.0, 5.0, np.nan])

    def solver(power, scenario):
        return Estimates(
            values={name: getattr(scenario, name) + error * bound[name] for name in QUANTITIES},
            standard_errors={
                "extinction": np.full(5, bound["extinction"]),
                "background": np.zeros(5),
            },
            flagged=np.array([True, False, False, True, True]),
            rejected=np.array([False, False, False, True, True]),
        )

    power = np.empty((5, PATH.bins))
    score = homogeneous.score_path(solver, PATH, power)
    assert score["extinction: RMSE"].value == pytest.approx(math.sqrt(11 / 3), rel=1e-6)
    bias = score["extinction: mean error"]
    assert bias.value == pytest.approx(1.0, rel=1e-6)
    # The scatter of the sums of five profiles, two of which have no value.
    assert bias.error == pytest.approx(math.sqrt(8 * 5 / 4) / 3, rel=1e-6)
    assert score["extinction: 95 %"].value == pytest.approx(2 / 3)
    assert "background: RMSE" not in score, "a given value has no score"
    assert (score["flagged"].value, score["rejected"].value) == (0.6, 0.4)


def test_least_squares_reaches_the_bound():
    solvers = {"direct": methods()["direct"], PROJECTION: PEERS[PROJECTION]}
    for seed, path in enumerate(scenarios(quick=True)):
        power = path.powers(200, seed)
        for (method, solver), quantity in product(solvers.items(), QUANTITIES):
            score = homogeneous.score_path(solver, path, power)
            error = score[f"{quantity}: RMSE"]
            assert abs(error.value - 1) < 5 * error.error + 0.02, (method, path)
            assert score[f"{quantity}: 95 %"].value > 0.85


@pytest.mark.parametrize(
    ("quantity", "given"), [("extinction", "known_extinction"), ("background", "known_background")]
)
def test_every_method_that_solves_a_quantity_is_compared(accuracy, quantity, given):
    names = {work.method for work in accuracy.works if work.quantity.startswith(quantity)}
    assert names - {TAIL_MEAN} == (set(methods()) | set(PEERS)) - {given, TAIL_MEAN}


def test_speeds_are_multiples_of_the_read_of_their_setting(timed):
    settings = [results.title for results in timed.results]
    assert len(settings) == 4
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
    # The first round, which compiles, does not count.
    clock = iter([0.0, 1.0, 0.0, 1.0, 0.0, 5.0, 0.0, 7.0, 0.0, 4.0, 0.0, 9.0])
    calls: list[str] = []
    monkeypatch.setattr("time.process_time", lambda: next(clock))
    functions = {name: (lambda name=name: calls.append(name)) for name in "ab"}
    assert least_times(functions, 2) == {"a": 4.0, "b": 7.0}
    assert calls == ["a", "b"] * 3


@pytest.mark.parametrize(
    ("quantity", "case", "message"),
    [
        ("luck", None, "throughput"),
        ("accuracy", "weather", "multiangle or network"),
        ("accuracy", "memory", "'memory' of accuracy"),
        ("throughput", "weather", "homogeneous or memory"),
    ],
)
def test_wrong_use_is_refused(quantity, case, message):
    with pytest.raises(CampaignError, match=message):
        measure(quantity, case, Effort())


def test_the_command_prints_writes_and_dates(monkeypatch, accuracy, tmp_path):
    passed = []

    def stand_in(effort):
        passed.append(effort)
        return accuracy

    monkeypatch.setitem(BENCHMARKS["accuracy"], "homogeneous", stand_in)
    words = ["accuracy", "--case", "homogeneous", "--quick", "--out", str(tmp_path)]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert passed[0].quick
    assert "direct" in result.stdout
    assert "result.json" in result.stdout.replace("\n", "")
    content = json.loads((tmp_path / "result.json").read_text())
    assert len(content["date"]) == len("2024-01-01")
