"""Raw files that vanish: products stay until the loss is acknowledged or the files are back."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from support import damage
from support.archives.small_archive import Archive, made
from support.servers.stand_ins import SCHEMES, StandIn, served
from typer.testing import CliRunner

from lidarops.catalog.scan import ScanSummary, scan_archive
from lidarops.cli import app
from lidarops.run import archive as run_archive
from lidarops.run.archive import bring_up_to_date, reprocess

pytestmark = pytest.mark.usefixtures("quickly")

THIRD = [f"{lidar}/h{day}1" for lidar in ("rich", "poor") for day in range(4)]


def _remove(archive: Archive, names: Sequence[str]) -> dict[Path, bytes]:
    """Remove raw files; return their content."""
    paths = [archive.folder / "raw" / name for name in names]
    content = {path: path.read_bytes() for path in paths}
    for path in paths:
        path.unlink()
    return content


def _run(archive: Archive, *options: str, command: str = "reprocess") -> tuple[int, dict[str, Any]]:
    """Run a command; return its exit code and what it prints as JSON."""
    archive.write()
    done = CliRunner().invoke(app, [command, str(archive.file), "--json", *options])
    return done.exit_code, json.loads(done.stdout)


def test_files_that_vanish_one_by_one_are_lost_together(archive: Archive) -> None:
    _remove(archive, ["poor/h10"])
    code, summary = _run(archive)
    assert (code, len(summary["products"])) == (0, 2)
    assert _run(archive)[1]["run"] is None
    before = archive.contents("out/products")
    _remove(archive, ["poor/h11"])
    code, summary = _run(archive)
    assert (code, summary["products"]) == (1, [])
    assert archive.contents("out/products") == before


def test_a_third_of_the_files_gone_worsens_no_product_until_it_is_acknowledged(
    archive: Archive,
) -> None:
    before = archive.contents("out/products")
    content = _remove(archive, THIRD)
    for options in ((), ("--force",), ("--remove-orphans",)):
        code, summary = _run(archive, *options)
        assert (code, summary["products"]) == (1, [])
        assert {lost["instrument"]: lost["kept"] for lost in summary["lost_files"]} == {
            "rich": 16,
            "poor": 8,
        }
        assert summary["kept_products"].keys() == before.keys()
        assert archive.contents("out/products") == before
    shown = CliRunner().invoke(app, ["reprocess", str(archive.file)])
    words = " ".join(shown.stdout.replace("│", " ").split())
    assert "vanished" in words
    assert "acknowledged" in words
    archive.tree["acknowledged"] = [{"what": "*/h?1", "reason": "taken out as too noisy"}]
    code, summary = _run(archive)
    assert (code, len(summary["products"]), summary["lost_files"]) == (0, len(before), [])
    assert archive.contents("out/products").keys() == before.keys()
    assert archive.contents("out/products") != before
    for path, data in content.items():
        path.write_bytes(data)
    del archive.tree["acknowledged"]
    code, summary = _run(archive)
    assert (code, len(summary["products"])) == (0, len(before))
    assert archive.contents("out/products") == before
    assert _run(archive)[1]["run"] is None


def test_a_damaged_file_that_is_acknowledged_fails_no_run_and_a_new_one_does(
    archive: Archive,
) -> None:
    damaged = archive.folder / "raw" / "poor" / "h98"
    damaged.write_bytes(b"")
    assert _run(archive)[0] == 1
    archive.tree["acknowledged"] = [{"what": "poor/h98", "reason": "the disk was full"}]
    for command in ("reprocess", "catalog", "plan", "reprocess"):
        code, summary = _run(archive, command=command)
        assert code == 0, command
        reasons = summary["refused_files"]
        (reason,) = [one["reason"] for one in reasons] if command == "catalog" else reasons.values()
        assert reason.startswith("acknowledged (the disk was full): ")
        assert not summary.get("idle_facts")
    code, summary = _run(archive, "--force")
    assert (code, bool(summary["products"])) == (0, True)
    (archive.folder / "raw" / "poor" / "h99").write_bytes(b"")
    code, summary = _run(archive)
    assert code == 1
    assert [path for path, why in summary["refused_files"].items() if "acknow" not in why] == [
        "poor/h99"
    ]


def test_files_that_come_back_leave_products_as_they_were(archive: Archive) -> None:
    before = archive.contents("out/products")
    content = _remove(archive, THIRD)
    assert bring_up_to_date(archive.write()).has_failures
    for path, data in content.items():
        path.write_bytes(data)
    result = bring_up_to_date(archive.write())
    assert (result.record, result.has_failures, result.orphans) == (None, False, ())
    assert archive.contents("out/products") == before


def test_products_without_lost_files_are_made_while_others_are_kept(archive: Archive) -> None:
    _remove(archive, ["poor/h10", "poor/h12"])
    archive.raw("rich/h29", 2 * 1440 + 630, seed=77)
    result = bring_up_to_date(archive.write())
    assert {name[:6] for name in made(result.record)} == {"rich 3"}
    assert [(lost.instrument, lost.files, lost.kept) for lost in result.findings.lost_files] == [
        ("poor", 2, 2)
    ]
    assert result.record is not None
    assert result.record.failed


def test_one_lost_file_is_named_and_its_products_are_made_again(archive: Archive) -> None:
    _remove(archive, ["poor/h11"])
    result = bring_up_to_date(archive.write())
    assert len(made(result.record)) == 2
    (lost,) = result.findings.lost_files
    assert (lost.names, lost.kept, result.has_failures) == (("poor/h11",), 0, False)
    assert result.record is not None
    assert result.record.findings.lost_files == (lost,)


def test_the_share_is_a_setting(archive: Archive) -> None:
    _remove(archive, THIRD)
    archive.tree["vanished_share"] = 0.4
    assert len(made(reprocess(archive.write()))) == 24


def _unreadable(path: Path) -> None:
    path.unlink()
    path.symlink_to("nowhere")


def _emptied(path: Path) -> None:
    path.write_bytes(b"")


@pytest.mark.parametrize("fault", [_unreadable, _emptied])
def test_files_that_cannot_be_read_or_became_empty_count_as_lost(
    archive: Archive, fault: Callable[[Path], object]
) -> None:
    before = archive.contents("out/products")
    for name in THIRD:
        fault(archive.folder / "raw" / name)
    result = bring_up_to_date(archive.write())
    assert result.record is None
    assert sum(lost.files for lost in result.findings.lost_files) == len(THIRD)
    assert archive.contents("out/products") == before


def test_one_file_that_became_empty_is_named_as_lost(archive: Archive) -> None:
    _emptied(archive.folder / "raw/poor/h11")
    result = bring_up_to_date(archive.write())
    assert len(made(result.record)) == 2
    (lost,) = result.findings.lost_files
    assert (lost.names, lost.kept) == (("poor/h11",), 0)


@pytest.mark.parametrize("fault", [Path.unlink, _emptied])
def test_files_that_are_lost_after_the_scan_worsen_no_product(
    archive: Archive, monkeypatch: pytest.MonkeyPatch, fault: Callable[[Path], object]
) -> None:
    before = archive.contents("out/products")
    paths = [archive.folder / "raw" / name for name in THIRD]
    content = {path: path.read_bytes() for path in paths}

    def scan(*arguments: Any, **options: Any) -> ScanSummary:
        summary = scan_archive(*arguments, **options)
        for path in paths:
            fault(path)
        return summary

    with monkeypatch.context() as patch:
        patch.setattr(run_archive, "scan_archive", scan)
        code, summary = _run(archive, "--force")
    assert (code, len(summary["refused_files"])) == (1, len(THIRD))
    assert summary["kept_products"].keys() == before.keys()
    assert archive.contents("out/products") == before
    for path in paths:
        path.unlink(missing_ok=True)
    assert _run(archive)[0] == 1
    assert archive.contents("out/products") == before
    for path, data in content.items():
        path.write_bytes(data)
    assert _run(archive)[0] == 0
    assert archive.contents("out/products") == before


@pytest.fixture
def fortnight(tmp_path: Path) -> Archive:
    """An archive of 14 days of signals, brought up to date."""
    folder = tmp_path / "fortnight"
    folder.mkdir()
    archive = Archive(folder, days=14)
    archive.tree["instruments"]["rich"]["products"] = {"signal": {}}
    reprocess(archive.write())
    return archive


def test_products_that_lost_all_their_few_files_are_not_removed(fortnight: Archive) -> None:
    before = fortnight.contents("out/products")
    _remove(fortnight, [f"rich/h1{k}" for k in range(3)])
    for _ in range(2):
        code, summary = _run(fortnight, "--remove-orphans")
        (lost,) = summary["lost_files"]
        assert (code, summary["removed"], lost["kept"]) == (1, 0, 2)
        assert fortnight.contents("out/products") == before


def test_a_few_files_of_the_archive_are_many_of_their_products(fortnight: Archive) -> None:
    before = fortnight.contents("out/products")
    _remove(fortnight, [f"rich/h{day}1" for day in range(1, 3)])
    code, summary = _run(fortnight)
    (lost,) = summary["lost_files"]
    # Two days of three files, and the dark file.
    assert (code, lost["files"], lost["of"], lost["kept"]) == (1, 2, 7, 4)
    assert fortnight.contents("out/products") == before


def test_products_stay_that_would_be_left_without_any_dark_file(fortnight: Archive) -> None:
    fortnight.raw("rich/d1", 12 * 1440 + 700, seed=98)
    reprocess(fortnight.write())
    before = fortnight.contents("out/products")
    _remove(fortnight, ["rich/d0"])
    for options in ((), ("--force", "--remove-orphans")):
        code, summary = _run(fortnight, *options)
        (lost,) = summary["lost_files"]
        assert code == 1
        assert len(summary["kept_products"]) == lost["kept"] > 0
        after = fortnight.contents("out/products")
        assert {name: after[name] for name in summary["kept_products"]} == {
            name: before[name] for name in summary["kept_products"]
        }
    fortnight.tree["acknowledged"] = [{"what": "rich/d0", "reason": "saturated"}]
    code, summary = _run(fortnight)
    assert (code, summary["kept_products"]) == (0, {})


def test_files_that_are_damaged_and_then_lost_stay_stated(archive: Archive) -> None:
    for name in THIRD:
        path = archive.folder / "raw" / name
        path.write_bytes(damage.flip_line_end(path.read_bytes(), random.Random(name)))
    assert len(_run(archive)[1]["products"]) == 24
    stated = archive.contents("out/products")
    _remove(archive, THIRD)
    for _ in range(2):
        code, summary = _run(archive)
        assert (code, summary["products"]) == (1, [])
        assert sum(lost["files"] for lost in summary["lost_files"]) == len(THIRD)
        assert archive.contents("out/products") == stated
    archive.tree["acknowledged"] = [{"what": "*/h?1", "reason": "damaged"}]
    code, summary = _run(archive)
    assert (code, len(summary["products"])) == (0, 24)
    assert _run(archive)[1]["run"] is None


def test_files_that_move_or_are_no_longer_claimed_are_not_lost(archive: Archive) -> None:
    raw = archive.folder / "raw"
    (raw / "rich/h01").rename(raw / "rich/h0moved")
    archive.tree["instruments"]["poor"]["files"] = ["poor/h?0", "poor/h?2"]
    result = bring_up_to_date(archive.write())
    assert result.findings.lost_files == ()
    assert {name.split()[0] for name in made(result.record)} == {"poor"}


def test_products_of_files_that_are_moved_away_on_purpose_stay_without_a_finding(
    archive: Archive,
) -> None:
    before = archive.contents("out/products")
    shutil.rmtree(archive.folder / "raw/poor")
    archive.tree["instruments"]["poor"]["files"] = "poor/**"
    (archive.folder / "raw/poor").mkdir()
    archive.raw("poor/h90", 9 * 1440, seed=1)
    assert _run(archive)[0] == 1
    archive.tree["acknowledged"] = [{"what": "poor/h[0-3]?", "reason": "kept for a year"}]
    for options in ((), ("--remove-orphans",), ()):
        code, summary = _run(archive, *options)
        assert (code, summary["lost_files"], summary["orphans"]) == (0, [], {})
        assert summary["unused_facts"] == []
        assert before.items() <= archive.contents("out/products").items()
    del archive.tree["acknowledged"]
    assert _run(archive)[0] == 1


@pytest.mark.parametrize(
    ("entry", "words"),
    [({"what": "rich/x*"}, "matches no raw file"), ({"until": "2020-01-01"}, "has expired")],
)
def test_an_entry_without_effect_is_a_finding(
    archive: Archive, entry: dict[str, str], words: str
) -> None:
    _remove(archive, THIRD)
    archive.tree["acknowledged"] = [{"what": "*/h?1", "reason": "noise"} | entry]
    code, summary = _run(archive)
    assert (code, summary["products"]) == (1, [])
    (note,) = summary["unused_facts"]
    assert note["reason"].startswith(words)


@pytest.mark.parametrize(
    ("entry", "key"), [({"reason": " "}, "reason"), ({"what": "/a"}, "what"), ({"when": 1}, "when")]
)
def test_an_entry_is_checked(archive: Archive, entry: dict[str, Any], key: str) -> None:
    archive.tree["acknowledged"] = [{"what": "*/h?1", "reason": "noise"} | entry]
    archive.file.write_text(json.dumps(archive.tree, indent=1))
    done = CliRunner().invoke(app, ["reprocess", str(archive.file)])
    assert done.exit_code == 2
    assert f"acknowledged.0.{key}" in done.stderr.replace("[", ".").replace("]", "")
    assert "line" in done.stderr


def test_another_campaign_of_the_same_catalog_is_not_concerned(
    archive: Archive, tmp_path: Path
) -> None:
    shutil.copytree(archive.folder / "raw", tmp_path / "raw")
    archive.tree["catalog"] = f"sqlite:///{archive.folder}/out/catalog.sqlite"
    own = archive.write()
    other = own.model_copy(
        update={
            "name": "other",
            "archive": str(tmp_path / "raw"),
            "output": str(tmp_path / "out"),
        }
    )
    assert len(made(reprocess(other))) == 24
    _remove(archive, THIRD)
    assert bring_up_to_date(own).has_failures
    result = bring_up_to_date(other)
    assert (result.record, result.has_failures, result.findings.lost_files) == (None, False, ())


def test_a_frozen_product_stays_frozen_when_its_lost_files_are_acknowledged(
    archive: Archive,
) -> None:
    _remove(archive, THIRD)
    archive.tree["periods"] = [{"since": "2026-03-01", "until": "2026-03-02", "frozen": True}]
    assert bring_up_to_date(archive.write()).frozen == {}
    archive.tree["acknowledged"] = [{"what": ["*/h?1"], "reason": "noise"}]
    result = bring_up_to_date(archive.write())
    assert len(result.frozen) == 6
    assert len(made(result.record)) == 18


def test_plan_tells_what_is_kept(archive: Archive) -> None:
    _remove(archive, THIRD)
    code, document = _run(archive, command="plan")
    assert code == 1
    assert sum(len(scene["kept"]) for scene in document["scenes"]) == 24
    assert not any(scene["stale"] for scene in document["scenes"])


@pytest.fixture
def server(archive: Archive) -> Iterator[StandIn]:
    """The raw files of the archive on a server, in pages of ten."""
    with served(archive.folder / "raw") as stand_in:
        stand_in.page = 10
        yield stand_in


@pytest.mark.parametrize("scheme", SCHEMES)
def test_listings_that_are_cut_anywhere_worsen_no_product(
    archive: Archive, server: StandIn, scheme: str
) -> None:
    archive.tree["archive"] = server.url(scheme)
    bring_up_to_date(archive.write())
    before = archive.contents("out/products")
    draw = random.Random(5)
    for _ in range(3):
        share = draw.random()
        server.damaged = lambda page, share=share: page[: int(share * len(page))]
        done = CliRunner().invoke(app, ["reprocess", str(archive.file)])
        assert done.exit_code == 3
        assert archive.contents("out/products") == before
    server.damaged = bytes
    assert reprocess(archive.write()) is None


def test_a_listing_of_s3_that_ends_after_its_first_page_worsens_no_product(
    archive: Archive, server: StandIn
) -> None:
    archive.tree["archive"] = server.url("s3")
    bring_up_to_date(archive.write())
    before = archive.contents("out/products")
    server.ends_after = 1
    for _ in range(2):
        code, summary = _run(archive)
        assert (code, summary["products"]) == (1, [])
        assert archive.contents("out/products") == before
    server.ends_after = 1000
    assert reprocess(archive.write()) is None
