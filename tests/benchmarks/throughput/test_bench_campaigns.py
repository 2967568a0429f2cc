"""Benchmark of campaigns: archives of the requested sizes, and numbers that add up."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks.harness.results import Effort
from benchmarks.throughput import campaigns
from benchmarks.throughput.campaigns import STAGES, CampaignSize
from lidarops.run.archive import reprocess

pytestmark = pytest.mark.slow

SMALL = CampaignSize(scenes=2, profiles=15, bins=500)


@pytest.fixture(scope="module")
def study():
    steps = []
    result = campaigns.measure_campaigns(
        Effort(date="2024-01-01", progress=steps.append),
        along={"scenes": (replace(SMALL, scenes=1), SMALL)},
    )
    assert steps == [1, 1, 1]
    return result


def test_every_stage_has_a_time(study):
    (results,) = study.results
    times = {stage: score["CPU time (s)"] for (_, stage), score in results.scores.items()}
    assert set(times) == set(STAGES)
    assert min(times.values()) > 0


def test_campaigns_have_the_requested_size(tmp_path):
    campaign = campaigns.write_campaign(SMALL, tmp_path)
    record = reprocess(campaign)
    assert [scene.error for scene in record.scenes] == [""] * SMALL.scenes
    assert [scene.granules for scene in record.scenes] == [SMALL.profiles] * SMALL.scenes
    kinds = {product.kind for scene in record.scenes for product in scene.products}
    assert kinds == {"signal", "homogeneous"}
    assert reprocess(campaign) is None


def test_slopes_are_those_of_the_times():
    costs = [
        (CampaignSize(scenes=n), {stage: 0.01 * n**power for power, stage in enumerate(STAGES)})
        for n in (2, 4, 8)
    ]
    for power in range(4):
        times = [0.01 * n**power for n in (2, 4, 8)]
        assert campaigns.slope((2, 4, 8), times) == pytest.approx((power, 0.0), abs=1e-6)
    scores = campaigns.growth("scenes", costs).scores
    shares = [score["share"].value for score in scores.values() if score["share"] is not None]
    assert sum(shares) == pytest.approx(1.0)
    assert [score["slope"] for score in scores.values()] == [f"{k}.00 ± 0.00" for k in range(8)]
