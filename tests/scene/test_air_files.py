"""Soundings of a year: a file makes exactly the nights stale whose air it enters."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from support import quick
from support.archives import raw_archives, sounding_texts
from support.archives.small_archive import DAY, Archive
from typer.testing import CliRunner

from lidarops.cli import app
from lidarops.records import RunRecord
from lidarops.run import executor
from lidarops.run.archive import reprocess

FIRST = datetime(2025, 3, 1, tzinfo=UTC)
"""365 days before the first file of other tests, so that none is of the future."""


@pytest.fixture(autouse=True)
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the processing of scenes by `quick.attempt`; other tests prove the retrievals."""
    monkeypatch.setattr(executor, "attempt", quick.attempt)


class Nights(Archive):
    """A lidar with a file at 10:00 of each day, and a sounding at 12:00."""

    def __init__(self, folder: Path, *, days: int) -> None:
        super().__init__(folder, days=0)
        rich = self.tree["instruments"]["rich"]
        rich["facts"] = [{"zenith_angle": 0, "full_overlap_range": 0}]
        rich["products"].pop("homogeneous")
        del rich["dark_files"], self.tree["instruments"]["poor"]
        self.tree["atmosphere"] = {
            "coast": [
                {"files": "soundings/s*.txt", "greatest_age": "36h"},
                {"files": "model/*.gdas1", "greatest_age": "3h"},
            ]
        }
        for day in range(days):
            self.raw(f"rich/h{day}", (day - 365) * DAY + 600, seed=day)
            self.sounding(day)
        (folder / "model").mkdir(exist_ok=True)
        self.model(0)

    def sounding(self, day: int, *, shift: float = 0.0, hour: int = 12) -> Path:
        """Write the sounding of a day."""
        time = FIRST + timedelta(days=day, hours=hour)
        text = sounding_texts.wyoming(time, shift)
        return raw_archives.write(
            self.folder / f"soundings/s{day:03d}_{hour:02d}.txt", text.encode()
        )

    def model(self, day: int) -> Path:
        """Write a profile of a model near the file of a day."""
        text = sounding_texts.gdas1(FIRST + timedelta(days=day, hours=9))
        return raw_archives.write(self.folder / f"model/m{day:03d}.gdas1", text.encode())


def days_of(record: RunRecord | None) -> set[int]:
    return {
        (scene.start - FIRST).days for scene in (record.scenes if record else ()) if scene.products
    }


def check_changes(archive: Nights, days: int) -> None:
    """Add, change and remove soundings; each makes the nights stale whose air it enters."""
    assert days_of(reprocess(archive.write())) == set(range(days))
    assert reprocess(archive.write()) is None
    # At 6:00 it is nearer to 10:00 than the sounding of noon of the day before.
    added = archive.sounding(5, hour=6)
    assert days_of(reprocess(archive.write())) == {5}
    assert reprocess(archive.write()) is None
    # The sounding of noon of day 7 is the one after day 7, and the one before day 8.
    archive.sounding(7, shift=3.0)
    assert days_of(reprocess(archive.write())) == {7, 8}
    added.unlink()
    assert days_of(reprocess(archive.write())) == {5}
    (archive.folder / "soundings/s001_12.txt").unlink()
    assert days_of(reprocess(archive.write())) == {1, 2}
    # A profile of the second source enters no night: the first one holds.
    archive.model(3)
    assert reprocess(archive.write()) is None
    # Nor does what was kept of the files, where it is damaged.
    (archive.folder / "out/atmosphere.json").write_text("{")
    assert reprocess(archive.write()) is None
    # Nor does another limit that changes no choice.
    archive.tree["atmosphere"]["coast"][0]["greatest_age"] = "37h"
    assert reprocess(archive.write()) is None


def test_a_sounding_makes_the_nights_stale_that_it_enters(tmp_path: Path) -> None:
    check_changes(Nights(tmp_path, days=10), 10)


@pytest.mark.slow
def test_a_year_of_nights_with_a_sounding_each(tmp_path: Path) -> None:
    archive = Nights(tmp_path, days=365)
    assert len(archive.tree["atmosphere"]["coast"]) == 2
    check_changes(archive, 365)


def test_plan_lists_nights_without_source_and_files_that_cannot_be_read(tmp_path: Path) -> None:
    archive = Nights(tmp_path, days=6)
    for day in (2, 3, 4):
        (archive.folder / f"soundings/s{day:03d}_12.txt").unlink()
    (archive.folder / "soundings/s900.txt").write_text("no sounding\n")
    (archive.folder / "model/m000.gdas1").unlink()
    good = archive.sounding(0).read_text()
    archive.sounding(0).write_text(good + good.replace("01 Mar", "01 M?r"))
    archive.write()
    CliRunner().invoke(app, ["catalog", str(archive.file)])
    shown = CliRunner().invoke(app, ["plan", str(archive.file), "--json"])
    document = json.loads(shown.output)
    without = {
        scene["scene"]
        for scene in document["scenes"]
        for step in scene["steps"]
        if "no source of the atmosphere holds" in step.get("warning", "")
    }
    # 36 h before noon of day 5, and after noon of day 1.
    assert without == {"rich_20250304T000000"}
    words = CliRunner().invoke(app, ["plan", str(archive.file)]).output
    assert "no source of the atmosphere" in words
    assert "(1 of 6 scenes: 2025-03-04)" in " ".join(words.split())
    problems = {one["path"]: one["problem"] for one in document["unusable_files"]}
    damaged = "soundings/s000_12.txt"
    assert problems.keys() == {"soundings/s900.txt", "model/*.gdas1", damaged}
    assert problems[damaged].startswith("sounding 2: states no time; it begins with 'Observations")
    assert problems[damaged].endswith("the rest of the file is used")
    assert "pressure: is missing" in problems["soundings/s900.txt"]
    assert problems["model/*.gdas1"] == "matches no file"
    assert shown.exit_code == 1
