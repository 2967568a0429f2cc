"""Benchmark of campaigns: archives of the requested sizes, and numbers that add up."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from benchmarks.harness.benchmark import Effort
from benchmarks.harness.study import Study
from benchmarks.throughput import campaigns, orchestration
from benchmarks.throughput.campaigns import CampaignCost, CampaignSize, Stage
from lidarops.errors import SceneError
from lidarops.run.archive import reprocess

SMALL = CampaignSize(scenes=2, profiles=15, bins=500)


@pytest.fixture(scope="module")
def study():
    steps = []
    result = campaigns.measure_campaigns(
        Effort(date="2024-01-01", progress=steps.append),
        along={"scenes": (replace(SMALL, scenes=1), SMALL)},
        workers=(),
    )
    assert steps == [1, 1, 1]
    return result


def test_every_stage_has_a_time(study):
    (results,) = study.chapters[0].results
    times = {row.method: row.value for row in results.rows if row.quantity == "CPU time (s)"}
    assert set(times) == set(Stage)
    assert min(times.values()) > 0


@pytest.mark.parametrize("size", [SMALL, CampaignSize(scenes=1, profiles=30, bins=600, angles=5)])
def test_campaigns_have_the_requested_size(size, tmp_path):
    campaign = campaigns.simulate_campaign(size, tmp_path)
    record = reprocess(campaign)
    assert [scene.error for scene in record.scenes] == [""] * size.scenes
    assert [scene.granules for scene in record.scenes] == [size.profiles] * size.scenes
    kinds = {product.kind for scene in record.scenes for product in scene.products}
    assert kinds == {"signal", "multiangle" if size.angles else "homogeneous"}
    assert reprocess(campaign) is None


def test_slopes_are_those_of_the_times(tmp_path):
    costs = tuple(
        CampaignCost(
            CampaignSize(scenes=n), {stage: 0.01 * n**power for power, stage in enumerate(Stage)}
        )
        for n in (2, 4, 8)
    )
    for power in range(4):
        times = [0.01 * n**power for n in (2, 4, 8)]
        assert campaigns.slope((2, 4, 8), times) == pytest.approx((power, 0.0), abs=1e-6)
    chapters = [
        campaigns.stages_chapter({"scenes": costs}),
        campaigns.workers_chapter({1: 4.0, 2: 2.5}),
    ]
    stages, workers = (chapter.results[0].table for chapter in chapters)
    assert workers.rows[1][2] == "1.6"
    shares = [row[3] for row in stages.rows if row[3] != "-"]
    assert math.isclose(
        sum(float(share.split()[0].lstrip("<")) for share in shares), 100.0, abs_tol=0.4
    )
    page = Study("Campaigns", "2024-01-01", chapters).write(tmp_path)
    assert "growth.svg" in page.read_text(encoding="utf-8")


def test_overhead_is_a_line_over_the_plain_loop():
    serial = orchestration.RunMode("plain loop", (10.0, 110.0), (11.0, 120.0))
    flow = orchestration.RunMode("flow", (10.0 + 16.5, 110.0 + 21.5), (30.0, 140.0))
    assert orchestration.overhead(flow, serial) == pytest.approx((16.0, 0.05))
    chapter = orchestration.orchestration_chapter((serial, flow), (2, 22))
    assert chapter.results[0].table.rows[1] == ("flow", "132", "140", "16", "5 %", "10.3 %")


def test_a_whole_command_is_measured_with_its_processes(tmp_path):
    campaigns.simulate_campaign(CampaignSize(scenes=1, profiles=15, bins=500), tmp_path)
    (mode,) = orchestration.measure_orchestration(
        [tmp_path / "campaign.yaml"], names=("plain loop",)
    )
    assert mode.cpu[0] > 0.0
    assert list((tmp_path / "plain loop" / "products").rglob("*.nc"))
    (tmp_path / "campaign.yaml").write_text("name: 3")
    with pytest.raises(SceneError, match="failed"):
        orchestration.measure_orchestration([tmp_path / "campaign.yaml"], names=("plain loop",))
