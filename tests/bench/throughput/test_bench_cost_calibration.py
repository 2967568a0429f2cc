"""Cost calibration: the fit, and that its estimates hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.archives import mixed_campaign

from lidarops.bench import registry
from lidarops.bench.harness.benchmark import Effort
from lidarops.bench.harness.timing import machine
from lidarops.bench.throughput import cost_calibration as calibration
from lidarops.bench.throughput.cost_calibration import Observation, fit_costs
from lidarops.errors import CampaignError
from lidarops.plan import cost_estimate
from lidarops.plan.cost_estimate import Costs, Term, default_costs
from lidarops.records import RunRecord
from lidarops.run import archive
from lidarops.simulate.campaign import simulate_campaign

DEFAULTS = default_costs()
OBSERVABLE = [term for term, cost in DEFAULTS.items() if cost]
"""Some kinds of product load no code."""


def observed(truth: Costs, count: int = 60, noise: float = 0.0) -> list[Observation]:
    """Return scenes of random amounts with the costs of a machine."""
    rng = np.random.default_rng(2)
    observations = []
    for _ in range(count):
        terms = {term: float(rng.uniform(0, 1) / DEFAULTS[term]) for term in OBSERVABLE}
        seconds = truth.of(terms) * float(np.exp(noise * rng.standard_normal()))
        observations.append(Observation("", (), terms, seconds, 0.0))
    return observations


def test_known_costs_are_recovered():
    rng = np.random.default_rng(1)
    truth = Costs({term: cost * float(rng.uniform(0.5, 2)) for term, cost in DEFAULTS.items()})
    costs = fit_costs(observed(truth, count=1500))
    assert [costs[term] for term in OBSERVABLE] == pytest.approx(
        [truth.seconds[term] for term in OBSERVABLE], rel=0.1
    )
    model = Costs(fit_costs(observed(truth, count=600, noise=0.2)))
    for observation in observed(truth):
        assert model.of(observation.amounts) == pytest.approx(observation.seconds, rel=0.25)


def test_no_cost_is_negative_and_unobserved_ones_keep_their_default():
    scenes = [Observation("", (), {Term.SCENE: 1.0, Term.FILE: 9.0 * k}, 0.3, 0.0) for k in (1, 9)]
    costs = fit_costs(scenes)
    assert min(costs.values()) >= 0
    assert costs["visibility"] == pytest.approx(DEFAULTS["visibility"])


@pytest.mark.parametrize(("whole", "cost"), [(102.4, 4.5), (90.0, 4.5), (110.0, 9.0)])
def test_a_run_costs_at_least_as_much_as_an_idle_one(
    whole: float, cost: float, monkeypatch: pytest.MonkeyPatch
):
    """This holds for any noise of the full run, from which scenes and report are subtracted."""
    idle = iter([4.4, 30.0, 4.5])

    def run_time(_: object, *words: str) -> float:
        return whole if "--force" in words else next(idle)

    monkeypatch.setattr(calibration, "_run_time", run_time)
    monkeypatch.setattr(calibration.archive, "assess", lambda *_, **__: [])
    monkeypatch.setattr(cost_estimate.Tally, "total", 101.0)
    assert calibration._run_cost(None, Costs(DEFAULTS)) == pytest.approx(cost)


@pytest.mark.parametrize(("ratio", "warned"), [(1.4, False), (1.6, True), (1 / 1.6, True)])
def test_poor_estimates_of_the_calibration_scenes_give_a_warning(
    ratio: float, warned: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    scenes = tuple(Observation("", (), {}, 2.0, 2.0 * factor) for factor in (1.0, ratio))
    result = calibration.Calibration("", machine(), DEFAULTS, scenes, "")
    monkeypatch.setattr(calibration, "calibrate", lambda _: result)
    page = registry.run_benchmark("throughput", "costs", [], Effort()).report
    assert ("calibrate again" in caplog.text) == warned
    assert ("calibrate again" in page.parts[0].text) == warned


@pytest.mark.parametrize("case", ["archive", "campaigns", "costs"])
def test_throughputs_have_no_accuracy(case: str):
    with pytest.raises(CampaignError, match=f"'{case}' has no accuracy"):
        registry.run_benchmark("accuracy", case, [], Effort())


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_next_run_uses_the_calibration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The page of the calibration reports the accuracy of the estimates."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    campaign = mixed_campaign.write(tmp_path, profiles=10)
    simulate_campaign(campaign)
    first = archive.reprocess(campaign)
    assert first is not None
    assert first.costs.startswith("not calibrated")
    calibration.calibrate(Effort(date="today"), rounds=1)
    assert cost_estimate.load_calibration().words == "calibrated on this machine on today"
    record = archive.reprocess(campaign, options=archive.Options(force=True))
    assert isinstance(record, RunRecord)
    assert record.costs == "calibrated on this machine on today"
    scenes = [scene for scene in record.scenes if scene.products]
    assert scenes
    assert all(scene.estimated_seconds > 0.0 and scene.cpu_seconds > 0.0 for scene in scenes)
