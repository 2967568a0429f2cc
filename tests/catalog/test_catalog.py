"""Scanning an archive: incremental, never aborted, nothing lost."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import fsspec
import pytest
import sqlalchemy as sa
from support import factories
from support.archives import raw_archives

from lidarops.campaign.model import Campaign
from lidarops.catalog import raw_files
from lidarops.catalog import scan as scan_module
from lidarops.catalog.database import GRANULE, LAYOUT
from lidarops.catalog.raw_files import GranuleRow, row_of
from lidarops.catalog.scan import ScanSummary, scan_archive
from lidarops.catalog.store import Store
from lidarops.errors import CatalogError
from lidarops.records import Role, Status
from lidarops.system import processes


@pytest.fixture
def campaign(tmp_path: Path) -> Campaign:
    """A campaign over an empty archive."""
    (tmp_path / "raw").mkdir()
    return factories.campaign().model_copy(
        update={"archive": str(tmp_path / "raw"), "output": str(tmp_path / "out")}
    )


@pytest.fixture
def store(campaign: Campaign) -> Iterator[Store]:
    """The catalog of that campaign."""
    opened = Store(campaign.catalog_url, campaign.name)
    yield opened
    opened.close()


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """List that collects the names of files whose headers are parsed."""
    names: list[str] = []
    parse = raw_files.parse_raw_header

    def counting(buffer: bytes, *, file: str, size: int) -> object:
        names.append(file)
        return parse(buffer, file=file, size=size)

    monkeypatch.setattr(raw_files, "parse_raw_header", counting)
    return names


def _fill(campaign: Campaign, count: int = 5) -> Path:
    root = Path(campaign.archive)
    for k in range(count):
        raw_archives.write(root / "coast" / f"h{k}", raw_archives.content(k))
    raw_archives.write(root / "dark" / "d0", raw_archives.content(-30))
    raw_archives.write(root / "coast" / "notes.txt", b"not claimed by any pattern")
    return root


def test_granules_say_what_the_headers_say(campaign: Campaign, store: Store) -> None:
    _fill(campaign)
    assert scan_archive(campaign, store) == ScanSummary(6, 6, 0, 0, 0, 0)
    granules = store.granules()
    assert [granule.role for granule in granules].count(Role.DARK) == 1
    first = next(granule for granule in granules if granule.path == "coast/h0")
    assert first.start == factories.DAY
    assert first.zenith_angle == 90
    assert (first.latitude, first.longitude) == (46.4, 30.7)
    assert [channel.name for channel in first.layout] == ["analog_532o", "photon_532o"]
    assert [channel.bins for channel in first.layout] == [64, 64]


def test_only_what_changed_is_opened(campaign: Campaign, store: Store, opened: list[str]) -> None:
    root = _fill(campaign)
    scan_archive(campaign, store)
    opened.clear()
    assert scan_archive(campaign, store) == ScanSummary(6, 0, 0, 6, 0, 0)
    assert opened == []
    raw_archives.write(root / "coast" / "h1", raw_archives.content(1, seed=9))
    os.utime(root / "coast" / "h1", ns=(1, 1))
    raw_archives.write(root / "coast" / "h9", raw_archives.content(9))
    (root / "coast" / "h2").unlink()
    assert scan_archive(campaign, store) == ScanSummary(6, 1, 1, 4, 1, 0)
    assert sorted(opened) == ["coast/h1", "coast/h9"]
    assert "coast/h2" not in {granule.path for granule in store.granules()}


@pytest.mark.parametrize("others", [False, True], ids=["empty", "wrong"])
def test_an_archive_without_any_of_its_files_is_refused_and_the_catalog_stays(
    campaign: Campaign, store: Store, tmp_path: Path, *, others: bool
) -> None:
    root = _fill(campaign)
    scan_archive(campaign, store)
    known = store.granules()
    root.rename(tmp_path / "away")
    root.mkdir()
    if others:
        raw_archives.write(root / "elsewhere" / "h0", raw_archives.content(0))
    with pytest.raises(CatalogError, match="knows 6; the catalog stays unchanged") as caught:
        scan_archive(campaign, store)
    assert not caught.value.wrong_use
    assert store.granules() == known
    with Store(campaign.catalog_url, "other") as shared:
        other = campaign.model_copy(update={"name": "other"})
        summary = scan_archive(other, shared)
        assert summary.files == summary.added == 0
        assert {idle.pattern for idle in summary.idle_patterns} == {"coast/h*", "dark/*"}


def test_a_changed_fact_of_the_campaign_rescans(campaign: Campaign, store: Store) -> None:
    _fill(campaign)
    scan_archive(campaign, store)
    changed = factories.campaign(facts=[{"zenith_angle": 85.0}])
    changed = changed.model_copy(update={"archive": campaign.archive, "output": campaign.output})
    assert scan_archive(changed, store).changed == 6
    assert {granule.zenith_angle for granule in store.granules()} == {85.0}


def test_damaged_files_are_refused_with_a_reason(campaign: Campaign, store: Store) -> None:
    root = _fill(campaign)
    good = raw_archives.content(7)
    damaged = {
        "h-truncated": good[:-100],
        "h-empty": b"",
        "h-garbage": bytes(range(256)) * 8,
        "h-text": b"Operator log: clouds after midnight\n" * 20,
        "h-position": good.replace(b" 046.4", b" 146.4").replace(b"0046.4", b"0146.4"),
    }
    for name, data in damaged.items():
        raw_archives.write(root / "coast" / name, data)
    summary = scan_archive(campaign, store)
    assert summary.refused == len(damaged)
    refused = {granule.path: granule.reason for granule in store.granules(status=Status.REFUSED)}
    assert set(refused) == {f"coast/{name}" for name in damaged}
    assert all(refused.values())
    assert "bytes" in refused["coast/h-truncated"]
    assert len(store.granules(status=Status.GOOD)) == 6


def test_files_of_no_known_format_are_opened_once(
    campaign: Campaign, store: Store, opened: list[str]
) -> None:
    root = _fill(campaign)
    for number in range(5):
        raw_archives.write(root / "coast" / f"h-log{number}", b"Operator log: clouds\n")
    assert scan_archive(campaign, store).refused == 5
    assert len(opened) == 11
    assert scan_archive(campaign, store).refused == 5
    assert len(opened) == 11


def test_an_unreadable_file_does_not_abort(campaign: Campaign, store: Store) -> None:
    root = _fill(campaign)
    (root / "coast" / "h-link").symlink_to("nowhere")
    (root / "coast" / "h-loop").symlink_to("h-loop")
    os.mkfifo(root / "coast" / "h-pipe")
    assert scan_archive(campaign, store) == ScanSummary(9, 9, 0, 0, 0, 3)
    assert len(store.granules(status=Status.GOOD)) == 6


def test_a_file_of_the_future_is_refused_until_it_is_past(
    campaign: Campaign, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = _fill(campaign)
    ahead = datetime.now(UTC).replace(microsecond=0) + timedelta(days=10) - factories.DAY
    late = raw_archives.content(ahead / timedelta(minutes=1))
    raw_archives.write(root / "coast" / "h2630110.000000", late)
    assert scan_archive(campaign, store).refused == 1
    (granule,) = store.refused()
    assert granule.path == "coast/h2630110.000000"
    assert granule.reason.startswith("starts in the future")
    assert f"today is {datetime.now(UTC):%Y-%m-%d}, its name 2026-03-01 10:00 (" in granule.reason
    # By a wrong clock of this machine, too: it is tried again.
    monkeypatch.setattr(raw_files, "_CLOCKS_DIFFER", timedelta(days=20))
    assert scan_archive(campaign, store).refused == 0


def test_a_file_of_two_instruments_is_refused(campaign: Campaign, store: Store) -> None:
    _fill(campaign)
    both = {**campaign.instruments, "other": campaign.instruments["lidar"]}
    scan_archive(campaign.model_copy(update={"instruments": both}), store)
    refused = store.granules(status=Status.REFUSED)
    assert len(refused) == 6
    assert "lidar and other" in refused[0].reason


def test_swapped_coordinates_are_noted(campaign: Campaign, store: Store) -> None:
    root = Path(campaign.archive)
    raw_archives.write(root / "coast" / "h0", raw_archives.content(0, position=(30.7, 46.4)))
    scan_archive(campaign, store)
    assert "swapped" in store.granules()[0].contradictions[-1]
    changed = {
        "lidar": campaign.instruments["lidar"].model_copy(
            update={"header_position": "latitude_first"}
        )
    }
    scan_archive(campaign.model_copy(update={"instruments": changed}), store)
    assert store.granules()[0].contradictions == ()
    assert store.granules()[0].latitude == 46.4


@pytest.mark.parametrize(
    ("stated", "changes", "note"),
    [
        ({"zenith_angle": 30.0}, {"zenith_angle": 0}, "zenith_angle 0 degree of the campaign over"),
        ({"zenith_angle": -15.0}, {"zenith_angle": 0}, "header: the pointing -15 degree may be"),
        ({"zenith_angle": 15.0}, {"header_pointing": "elevation"}, "angle of the header is taken"),
        ({"azimuth": 2.0}, {"azimuth": 350}, "azimuth 350 degree of the campaign overrides 2 of"),
        ({"position": (40.0, 9.0)}, {"header_position": "ignore"}, "overrides 9, 40 of the header"),
        ({"altitude": 500.0}, {"header_position": "ignore"}, "overrides the altitude 500 m"),
        ({"zenith_angle": 30.0, "azimuth": 0.5}, {"zenith_angle": 29.5, "azimuth": 359.8}, ""),
        ({}, {"header_position": "ignore"}, ""),
    ],
)
def test_what_the_campaign_states_otherwise_than_a_header_is_noted(
    campaign: Campaign, store: Store, stated: dict[str, Any], changes: dict[str, Any], note: str
) -> None:
    raw_archives.write(Path(campaign.archive) / "coast/h0", raw_archives.content(**stated))
    facts = {name: value for name, value in changes.items() if name in {"zenith_angle", "azimuth"}}
    others = {name: value for name, value in changes.items() if name not in facts}
    changed = factories.campaign(facts=[facts], **others)
    scan_archive(changed.model_copy(update={"archive": campaign.archive}), store)
    (granule,) = store.granules(status=Status.GOOD)
    assert note in " ".join(granule.notes)
    assert bool(granule.notes) == bool(note)


def test_an_archive_behind_a_url(campaign: Campaign, store: Store) -> None:
    memory = fsspec.filesystem("memory")
    memory.pipe("/lidar-archive/coast/h0", raw_archives.content(0))
    memory.pipe("/lidar-archive/coast/h1", raw_archives.content(1)[:-50])
    remote = campaign.model_copy(update={"archive": "memory://lidar-archive"})
    try:
        summary = scan_archive(remote, store)
        assert (summary.files, summary.added, summary.refused) == (2, 2, 1)
        assert [idle.key for idle in summary.idle_patterns] == ["dark_files"]
        assert scan_archive(remote, store).unchanged == 2
        assert [granule.path for granule in store.granules()] == ["coast/h0", "coast/h1"]
    finally:
        memory.rm("/lidar-archive", recursive=True)


def test_an_absent_archive_is_named(campaign: Campaign, store: Store) -> None:
    with pytest.raises(CatalogError, match="LIDAROPS_ARCHIVE"):
        scan_archive(campaign.model_copy(update={"archive": "/nowhere"}), store)


def test_a_broken_database_is_named(tmp_path: Path) -> None:
    path = raw_archives.write(tmp_path / "catalog.sqlite", b"this is no database" * 100)
    with pytest.raises(CatalogError, match=r"catalog\.sqlite"):
        Store(f"sqlite:///{path}", "test")
    with pytest.raises(CatalogError, match="--out"):
        Store(f"sqlite:///{path}/below/a-file.sqlite", "test")


def test_granules_round_trip(store: Store) -> None:
    granules = [
        factories.granule(0),
        factories.granule(1, status=Status.REFUSED, reason="odd", start=None, layout=()),
        factories.granule(
            2, notes=("a", "b"), contradictions=("c",), azimuth=12.5, sha256="0" * 64
        ),
    ]
    store.replace([row_of(granule, store.campaign, "key") for granule in granules])
    assert sorted(store.granules(), key=lambda g: g.path) == granules
    store.replace([row_of(replace(granules[0], size=7), store.campaign, "key")])
    assert len(store.granules()) == 3


def test_notes_of_files_are_listed_with_contradictions_first_then_by_their_number(
    store: Store,
) -> None:
    granules = [factories.granule(number, notes=("often",)) for number in range(3)]
    granules += [factories.granule(number, notes=("seldom",)) for number in range(3, 5)]
    granules.append(factories.granule(5, contradictions=("wrong place",)))
    store.replace([row_of(granule, store.campaign, "key") for granule in granules])
    found = store.file_notes({granules[0].instrument})
    assert [(note.text, note.files, note.contradicts) for note in found] == [
        ("wrong place", 1, True),
        ("often", 3, False),
        ("seldom", 2, False),
    ]


def test_notes_that_differ_by_numbers_only_become_one(store: Store) -> None:
    def note(angle: float) -> str:
        return f"zenith_angle 0 degree of the campaign overrides {angle:g} of the header"

    scan = [factories.granule(number, notes=(note(number - 2.5),)) for number in range(40)]
    few = [factories.granule(40 + number, notes=(f"{number} shots",)) for number in range(2)]
    store.replace([row_of(granule, store.campaign, "key") for granule in (*scan, *few)])
    notes = store.file_notes({scan[0].instrument})
    assert [note.files for note in notes] == [40, 1, 1]
    assert notes[0].text.startswith("zenith_angle 0 degree of the campaign overrides")
    assert notes[0].text.endswith("39 other values in other files")


def test_campaigns_share_a_database(campaign: Campaign, store: Store) -> None:
    store.replace([row_of(factories.granule(0), store.campaign, "key")])
    other = Store(campaign.catalog_url, "other")
    assert other.granules() == []
    other.close()


def test_a_name_that_is_no_text_is_refused_and_the_rest_goes_on(
    campaign: Campaign, store: Store
) -> None:
    root = _fill(campaign)
    odd = os.fsencode(root / "coast") + b"/h\xff"
    try:
        with open(odd, "wb") as file:  # noqa: PTH123 - a Path holds no bytes
            file.write(raw_archives.content(9))
    except OSError:
        pytest.skip("the file system takes no such name")
    assert scan_archive(campaign, store) == ScanSummary(7, 7, 0, 0, 0, 1)
    (refused,) = store.granules(status=Status.REFUSED)
    assert refused.path == "coast/h\\udcff"
    assert "not UTF-8" in refused.reason
    assert scan_archive(campaign, store) == ScanSummary(7, 0, 0, 7, 0, 1)


@pytest.mark.usefixtures("server")
class TestManyFiles:
    """The catalog does not depend on the process that reads the headers."""

    @pytest.fixture(autouse=True)
    def few_are_many(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(scan_module, "_WORTH_PROCESSES", 4)
        monkeypatch.setattr(scan_module, "_TOGETHER", 2)
        monkeypatch.setattr(scan_module, "_BATCH", 7)

    def test_are_entered_alike_by_more_processes(self, campaign: Campaign, tmp_path: Path) -> None:
        root = _fill(campaign, 20)
        (root / "coast" / "h3").write_bytes(b"nonsense")
        (root / "coast" / "h4").unlink()
        (root / "coast" / "h4").symlink_to("nowhere")
        (root / os.fsdecode(b"coast/h\xff")).write_bytes(raw_archives.content(40))
        url = f"sqlite:///{tmp_path}"
        with (
            Store(f"{url}/one.sqlite", campaign.name) as one,
            Store(f"{url}/two.sqlite", campaign.name) as two,
        ):
            first = scan_archive(campaign, one)
            assert scan_archive(campaign, two, workers=2) == first
            assert (first.files, first.refused) == (22, 3)
            assert _rows(two) == _rows(one)
            digests = {each.path: f"{k:064x}" for k, each in enumerate(one.granules())}
            moved = one.granules(status=Status.GOOD)[0].path
            digests[moved] = hashlib.sha256((root / moved).read_bytes()).hexdigest()
            for store in (one, two):
                store.store_digests(digests)
            (root / moved).rename(root / "coast" / "hz")
            (root / "coast" / "h7").unlink()
            for k in range(8, 16):
                raw_archives.write(root / "coast" / f"h{k}", raw_archives.content(k + 100))
            (root / "coast" / "h9").write_bytes(b"nonsense")
            second = scan_archive(campaign, one)
            assert scan_archive(campaign, two, workers=2) == second
            assert (second.changed, second.moved, second.vanished) == (8, 1, 1)
            assert _rows(two) == _rows(one)

    def test_refuse_a_file_that_crashes_its_process_until_it_changes(
        self, campaign: Campaign, store: Store, monkeypatch, caplog
    ) -> None:
        _fill(campaign, 20)
        monkeypatch.setattr(scan_module, "read_row", _deadly)
        assert scan_archive(campaign, store, workers=2).refused == 1
        (refused,) = store.granules(status=Status.REFUSED)
        assert refused.path == "coast/h13"
        assert refused.reason == "cannot be read: reading it crashed the process"
        assert "a process was lost" in caplog.text
        # It would end this process.
        assert scan_archive(campaign, store).refused == 1
        monkeypatch.undo()
        raw_archives.write(Path(campaign.archive) / refused.path, raw_archives.content(99))
        assert scan_archive(campaign, store).refused == 0
        assert len(store.granules(status=Status.GOOD)) == 21

    def test_leave_no_process_if_nothing_may_be_written(
        self, campaign: Campaign, store: Store
    ) -> None:
        _fill(campaign, 20)
        with pytest.raises(InterruptedError):
            scan_archive(campaign, store, workers=2, before_write=_forbid)
        assert not multiprocessing.active_children()
        assert store.count() == 0

    def test_of_which_few_are_new_start_no_process(
        self, campaign: Campaign, store: Store, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        root = _fill(campaign, 20)
        scan_archive(campaign, store)
        monkeypatch.setattr(processes, "ProcessPoolExecutor", None)
        for k in range(20, 23):
            raw_archives.write(root / "coast" / f"h{k}", raw_archives.content(k))
        assert scan_archive(campaign, store, workers=2).added == 3


def _rows(store: Store) -> list[tuple[object, ...]]:
    with store.transaction() as connection:
        return [
            tuple(row)
            for table in (GRANULE, LAYOUT)
            for row in connection.execute(sa.select(table).order_by(*table.primary_key))
        ]


@pytest.mark.parametrize("damage", ["no database", "a page overwritten"])
def test_a_damaged_catalog_says_that_a_new_one_can_be_made(damage: str, campaign: Campaign) -> None:
    file = Path(campaign.output) / "catalog.sqlite"
    with Store(campaign.catalog_url, campaign.name):
        pass
    content = file.read_bytes()
    broken = b"?" * 8192 if damage == "no database" else content[:100] + b"?" * 8192
    file.write_bytes(broken + content[len(broken) :])
    with (
        pytest.raises(CatalogError, match="move it away; lidarops then makes a new one"),
        Store(campaign.catalog_url, campaign.name) as damaged,
    ):
        damaged.granules()


def _deadly(read: raw_files.Headers, due: raw_files.UnreadFile) -> GranuleRow:
    """End the process at a file."""
    if due.file.path == "coast/h13":
        os._exit(9)
    return raw_files.read_row(read, due)


def _forbid() -> None:
    raise InterruptedError
