"""Costs of a machine: what is fitted, and that estimates hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support import mixed_campaign

from lidarops.bench.harness.terms import Effort, Kind
from lidarops.bench.harness.timing import machine
from lidarops.bench.throughput import cost_calibration as calibration
from lidarops.bench.throughput.cost_calibration import Observation, fitted
from lidarops.errors import CampaignError
from lidarops.plan import cost_estimate
from lidarops.plan.cost_estimate import DEFAULTS, Costs, Term
from lidarops.records import RunRecord
from lidarops.run import archive
from lidarops.simulate.campaign import simulate_campaign


def observed(truth: Costs, count: int = 60, noise: float = 0.0) -> list[Observation]:
    """Return scenes of random amounts that cost what a machine says."""
    rng = np.random.default_rng(2)
    found = []
    for _ in range(count):
        terms = {term: float(rng.uniform(0, 1) / DEFAULTS[term]) for term in Term}
        seconds = truth.of(terms) * float(np.exp(noise * rng.standard_normal()))
        found.append(Observation("", (), terms, seconds, 0.0))
    return found


def test_costs_are_found_again():
    rng = np.random.default_rng(1)
    truth = Costs({term: cost * float(rng.uniform(0.5, 2)) for term, cost in DEFAULTS.items()})
    found = fitted(observed(truth, count=1500))
    assert [found[term] for term in Term] == pytest.approx(
        [truth.seconds[term] for term in Term], rel=0.1
    )
    model = Costs(fitted(observed(truth, count=600, noise=0.2)))
    for each in observed(truth):
        assert model.of(each.amounts) == pytest.approx(each.seconds, rel=0.25)


def test_no_cost_is_negative_and_what_is_not_seen_stays():
    scenes = [Observation("", (), {Term.SCENE: 1.0, Term.FILE: 9.0 * k}, 0.3, 0.0) for k in (1, 9)]
    found = fitted(scenes)
    assert min(found.values()) >= 0
    assert found[Term.VISIBILITY] == pytest.approx(DEFAULTS[Term.VISIBILITY])


@pytest.mark.parametrize(("whole", "cost"), [(102.4, 4.5), (90.0, 4.5), (110.0, 9.0)])
def test_a_run_costs_no_less_than_one_with_nothing_to_do(
    whole: float, cost: float, monkeypatch: pytest.MonkeyPatch
):
    """Whatever the noise of the one that does all, of which scenes and report are subtracted."""
    idle = iter([4.4, 30.0, 4.5])

    def of_run(_: object, *words: str) -> float:
        return whole if "--force" in words else next(idle)

    monkeypatch.setattr(calibration, "_of_run", of_run)
    monkeypatch.setattr(calibration.archive, "assess", lambda *_, **__: [])
    monkeypatch.setattr(cost_estimate.Tally, "total", 101.0)
    assert calibration._beside(None, Costs(DEFAULTS)) == pytest.approx(cost)


@pytest.mark.parametrize(("ratio", "doubted"), [(1.4, False), (1.6, True), (1 / 1.6, True)])
def test_costs_that_miss_what_they_were_found_from_are_told(
    ratio: float, doubted: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    scenes = tuple(Observation("", (), {}, 2.0, 2.0 * each) for each in (1.0, ratio))
    found = calibration.Calibration("", machine(), DEFAULTS, scenes, "")
    monkeypatch.setattr(calibration, "calibrate", lambda **_: found)
    page = calibration.run_cost_calibration(Kind.THROUGHPUT, effort=Effort()).report
    assert ("calibrate again" in caplog.text) == doubted
    assert ("calibrate again" in page.parts[0].text) == doubted


def test_costs_have_no_accuracy():
    with pytest.raises(CampaignError, match="throughput"):
        calibration.run_cost_calibration(Kind.ACCURACY, effort=Effort())


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_calibration_serves_the_next_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """How close estimates come is told by the page of the calibration, not here."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    campaign = mixed_campaign.write(tmp_path, profiles=10)
    simulate_campaign(campaign)
    first = archive.reprocess(campaign)
    assert first is not None
    assert first.costs.startswith("not calibrated")
    calibration.calibrate(date="today", rounds=1)
    assert cost_estimate.load_calibration().words == "calibrated on this machine on today"
    record = archive.reprocess(campaign, options=archive.Options(force=True))
    assert isinstance(record, RunRecord)
    assert record.costs == "calibrated on this machine on today"
    made = [scene for scene in record.scenes if scene.products]
    assert made
    assert all(scene.estimated_seconds > 0.0 and scene.cpu_seconds > 0.0 for scene in made)
