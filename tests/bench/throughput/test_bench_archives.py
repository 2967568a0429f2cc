"""Benchmark of archives: nothing is stale in what stands for files, and tables that add up."""

from __future__ import annotations

import json

import pytest

from lidarops.bench import registry
from lidarops.bench.harness.terms import Effort, Kind
from lidarops.bench.harness.timing import machine
from lidarops.bench.throughput import archives, stand_in_archives
from lidarops.bench.throughput.archives import ArchiveCost, Pass, ProcessCost
from lidarops.bench.throughput.campaigns import CampaignSize
from lidarops.bench.throughput.stand_in_archives import StandIns
from lidarops.catalog.store import Store
from lidarops.errors import CampaignError
from lidarops.records import ProductKind, Status
from lidarops.run import archive as pipeline

SMALL = StandIns(instruments=2, days=2)


def test_nothing_is_stale_in_an_archive_of_stand_ins(tmp_path):
    campaign = stand_in_archives.enter(SMALL, tmp_path / "campaign.yaml")
    summary = pipeline.update_catalog(campaign)
    assert (summary.files, summary.unchanged) == (SMALL.files, SMALL.files) == (1152, 1152)
    with Store(campaign.catalog_url, campaign.name) as store:
        assert store.count(status=Status.GOOD) == SMALL.files
        with store.all_made() as made:
            kinds = [each.kind for each in made]
    assert kinds == [ProductKind.SIGNAL.value] * SMALL.instruments * SMALL.days
    found = pipeline.bring_up_to_date(campaign)
    assert (found.record, found.fresh, found.orphans) == (None, 4, ())


def test_a_stand_in_that_changes_is_found(tmp_path):
    campaign = stand_in_archives.enter(SMALL, tmp_path / "campaign.yaml")
    pipeline.bring_up_to_date(campaign)
    archives._stale(tmp_path / "campaign.yaml")
    next((tmp_path / "raw" / "d00001" / "i01").iterdir()).write_bytes(b"more")
    assert pipeline.update_catalog(campaign).refused == 1
    with pytest.raises(CampaignError, match="does not stay"):
        archives._stale(tmp_path / "campaign.yaml")


@pytest.fixture(scope="module")
def found():
    told = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(archives, "_alone", archives._spent)
        result = archives.measure_archives(
            [CampaignSize(scenes=n, profiles=15, bins=100, retrieved=False) for n in (1, 2)],
            SMALL,
            date="2024-01-01",
            progress=told.append,
        )
    assert told == [1, 1, 1]
    return result


def test_every_pass_is_measured(found):
    assert [(each.files, each.read) for each in found.measured] == [
        (15, True),
        (30, True),
        (SMALL.files, False),
    ]
    read = {Pass.FIRST, Pass.PROCESS, Pass.AGAIN, Pass.STALE, Pass.NOTHING}
    assert [set(each.spent) for each in found.measured] == [
        read,
        read,
        {Pass.SETTLE, Pass.AGAIN, Pass.STALE, Pass.NOTHING},
    ]


def test_a_pass_can_be_measured_in_a_process_of_its_own(tmp_path):
    for name in ("small", "large"):
        (tmp_path / name).mkdir()
        stand_in_archives.enter(StandIns(1, 1), tmp_path / name / "campaign.yaml")
    files = (tmp_path / "small" / "campaign.yaml", tmp_path / "large" / "campaign.yaml")
    spent = archives._alone(Pass.SETTLE, *files)
    assert spent.cpu > 0.0
    assert 1e7 < spent.peak < 1e10


def test_growth_is_that_of_the_cost_of_a_file(tmp_path):
    def measured(files, cpu, *, read=True):
        return ArchiveCost(files, read, {Pass.AGAIN: ProcessCost(cpu, 2.0 * cpu, 3e8)})

    few, more = measured(1000, 0.02), measured(100_000, 2.2)
    assert archives.growth(few, more, Pass.AGAIN) == pytest.approx(1.1)
    rows = measured(1_000_000, 10.0, read=False)
    whole = archives.Archives("2024-01-01", machine(), (few, more, rows))
    report = archives.archives_report(whole, "result.json")
    assert report.parts[0].tables[3].rows == (
        ("1,000", "0.02", "0.04", "20", "-", "300 MB"),
        ("100,000", "2.2", "4.4", "22", "1.10", "300 MB"),
        ("1,000,000 rows", "10", "20", "10", "-", "300 MB"),
    )
    page = registry.write_benchmark(registry.Finding(whole, report), tmp_path)
    assert "archive.png" in page.read_text(encoding="utf-8")
    told = json.loads((tmp_path / "result.json").read_text())
    assert told["measured"][2]["spent"]["scan, all known"]["cpu"] == 10.0


def test_there_is_no_accuracy_of_an_archive():
    with pytest.raises(CampaignError, match="no accuracy"):
        archives.run_archives(Kind.ACCURACY, effort=Effort())
