"""Benchmark of archives: stand-ins are up to date, and tables add up."""

from __future__ import annotations

import pytest

from benchmarks.harness.results import Effort
from benchmarks.harness.timing import in_fresh_process
from benchmarks.throughput import archives, stand_in_archives
from benchmarks.throughput.archives import ArchiveCost, Pass, ProcessCost
from benchmarks.throughput.campaigns import CampaignSize
from benchmarks.throughput.stand_in_archives import StandIns
from lidarops.catalog.store import Store
from lidarops.errors import CampaignError
from lidarops.records import Status
from lidarops.run import archive as pipeline

pytestmark = pytest.mark.slow

SMALL = StandIns(instruments=2, days=2)


def test_nothing_is_stale_in_an_archive_of_stand_ins(tmp_path):
    campaign = stand_in_archives.write_stand_ins(SMALL, tmp_path / "campaign.yaml")
    summary = pipeline.update_catalog(campaign)
    assert (summary.files, summary.unchanged) == (SMALL.files, SMALL.files) == (1152, 1152)
    with Store(campaign.catalog_url, campaign.name) as store:
        assert store.count(status=Status.GOOD) == SMALL.files
        with store.all_products() as products:
            kinds = [product.kind for product in products]
    assert kinds == ["signal"] * SMALL.instruments * SMALL.days
    result = pipeline.bring_up_to_date(campaign)
    assert (result.record, result.orphans) == (None, ())


def test_a_changed_stand_in_is_detected(tmp_path):
    campaign = stand_in_archives.write_stand_ins(SMALL, tmp_path / "campaign.yaml")
    pipeline.bring_up_to_date(campaign)
    archives._check_nothing_stale(tmp_path / "campaign.yaml")
    next((tmp_path / "raw" / "d00001" / "i01").iterdir()).write_bytes(b"more")
    assert pipeline.update_catalog(campaign).refused == 1
    with pytest.raises(CampaignError, match="not up to date"):
        archives._check_nothing_stale(tmp_path / "campaign.yaml")


@pytest.fixture(scope="module")
def measured_archives():
    steps = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(archives, "in_fresh_process", lambda call, *args: call(*args))
        result = archives.measure_archives(
            Effort(date="2024-01-01", progress=steps.append),
            sizes=[CampaignSize(scenes=n, profiles=15, bins=100, retrieved=False) for n in (1, 2)],
            stand_ins=SMALL,
        )
    assert steps == [1, 1, 1]
    return result


def test_every_pass_is_measured(measured_archives):
    (chapter,) = measured_archives.chapters
    files = {
        results.title.split(":")[0]: {case for case, _ in results.scores}
        for results in chapter.results
    }
    read, rows = {"15", "30"}, {f"{SMALL.files} rows"}
    assert files == {
        Pass.FIRST: read,
        Pass.PROCESS: read,
        Pass.SETTLE: rows,
        Pass.AGAIN: read | rows,
        Pass.STALE: read | rows,
        Pass.NOTHING: read | rows,
    }


def test_an_operation_can_be_measured_in_its_own_process(tmp_path):
    for name in ("small", "large"):
        (tmp_path / name).mkdir()
        stand_in_archives.write_stand_ins(StandIns(1, 1), tmp_path / name / "campaign.yaml")
    files = (tmp_path / "small" / "campaign.yaml", tmp_path / "large" / "campaign.yaml")
    spent = in_fresh_process(archives._cost, Pass.SETTLE, *files)
    assert spent.cpu > 0.0
    assert 1e7 < spent.peak < 1e10


def test_growth_is_that_of_the_cost_per_file():
    def measured(files, cpu, *, read=True):
        return ArchiveCost(files, read, {Pass.AGAIN: ProcessCost(cpu, 2.0 * cpu, 3e8)})

    small, large = measured(1000, 0.02), measured(100_000, 2.2)
    rows = measured(1_000_000, 10.0, read=False)
    study = archives.archives_study("2024-01-01", (small, large, rows))
    assert [*study.results[3].table.itertuples(index=False, name=None)] == [
        ("1000", "0.02", "0.04", "20 µs", "-", "300"),
        ("100000", "2.2", "4.4", "22 µs", "1.1", "300"),
        ("1000000 rows", "10", "20", "10 µs", "-", "300"),
    ]
