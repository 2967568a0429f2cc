"""Each fault of a file in each place of a scene, in a folder and behind HTTP and S3.

What can be made is made, what is missing is stated in product, report and exit status, and the
next run after the repair gives the bytes of the undamaged archive.
"""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import timedelta
from http import HTTPStatus
from pathlib import Path
from typing import Any

import pytest
import xarray as xr
from support import damage, factories
from support.archives.small_archive import DAY, OVERLAP, Archive
from support.damage import Damage
from support.servers.stand_ins import SCHEMES, StandIn, served

from lidarops.netcdf.comparison import compare_products
from lidarops.netcdf.context import UNUSED_INPUTS
from lidarops.records import Grade
from lidarops.reports.findings import finding_rows
from lidarops.run import archive
from lidarops.run.archive import Result, bring_up_to_date, refused_files

pytestmark = pytest.mark.slow

RAW = ("first", "middle", "last", "dark")
PLACES = (*RAW, "ancillary", "product")
CHANNEL = "analog_532o"
KINDS = 2
"""Products of a scene, which all use dark and ancillary file."""
Change = Callable[[Path, random.Random], object]
"""Changes a file in place."""


def content(how: Damage) -> Change:
    """Return the change of a file whose content is damaged."""
    return lambda file, rng: file.write_bytes(how(file.read_bytes(), rng))


def deny(file: Path, _rng: random.Random) -> None:
    """Put a link to itself in the place of a file, which not even root can read."""
    file.unlink()
    file.symlink_to(file)


def flip_digit(whole: bytes, rng: random.Random) -> bytes:
    """Change a digit of the times in a raw file, or a character of the first line of another."""
    dates = whole.find(b"/2026 ") + 1
    at = dates + rng.randrange(4) if dates else rng.randrange(min(len(whole), 13))
    return whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :]


@dataclass(frozen=True)
class Fault:
    """What happens to a file before a run, and after the run has listed the archive."""

    before: Change | None = None
    during: Change | None = None
    hidden: bool = False
    """Whether a listing may not show it: only a run that reads the file meets it."""


def half(whole: bytes, _rng: random.Random) -> bytes:
    """Return what a recorder has written so far."""
    return whole[: len(whole) // 2]


FAULTS = {
    "truncated": Fault(content(damage.truncate)),
    "empty": Fault(content(lambda _whole, _rng: b"")),
    "zeroed page": Fault(content(lambda whole, _rng: bytes(512) + whole[512:])),
    "zeroed tail": Fault(content(lambda whole, rng: half(whole, rng).ljust(len(whole), b"\0"))),
    "flipped line ends": Fault(content(damage.flip_line_end)),
    "flipped header digit": Fault(content(flip_digit)),
    "unreadable": Fault(deny, hidden=True),
    "vanished": Fault(lambda file, _rng: file.unlink()),
    "replaced during the run": Fault(during=content(half), hidden=True),
    "growing": Fault(content(half), content(lambda whole, _rng: whole + whole[:99])),
}
RAW_ONLY = ("flipped line ends",)
CASES = tuple(
    (fault, place) for fault in FAULTS for place in PLACES if place in RAW or fault not in RAW_ONLY
)
"""One for each day of the archive."""


class Matrix:
    """A processed archive with a scene for each case, and what damages and repairs it."""

    def __init__(self, folder: Path, scheme: str, stand_in: StandIn | None) -> None:
        self._files = Archive(folder, days=0)
        self._denied = stand_in.statuses if stand_in else {}
        self._is_remote = stand_in is not None
        self._rng = random.Random(scheme)
        (folder / "raw/rich/d0").unlink()
        tree = self._files.tree
        tree["instruments"].pop("poor")
        tree["vanished_share"] = 0.5
        if stand_in is not None:
            tree["archive"] = stand_in.url(scheme)
        tree["instruments"]["rich"] |= {
            "facts": [self._facts(day) for day in range(len(CASES))],
            "products": {
                "signal": {"channels": [CHANNEL]},
                "homogeneous": {"channels": [CHANNEL], "sections": [[750, 840]]},
            },
        }
        for day in range(len(CASES)):
            for number, place in enumerate(RAW):
                minute = day * DAY + (630 if place == "dark" else 600 + number)
                self._files.raw(self.name(day, place), minute, seed=4 * day + number)
        self.campaign = self._files.write()

    def _facts(self, day: int) -> dict[str, Any]:
        """Write the ancillary file of a day, and return what the campaign says of the day."""
        (self._files.folder / f"overlap{day:03}.csv").write_text(OVERLAP)
        first = factories.DAY + timedelta(days=day)
        return {
            "zenith_angle": 0,
            "overlap_profile": f"overlap{day:03}.csv",
            "valid_from": f"{first:%Y-%m-%d}T00:00:00Z",
            "valid_to": f"{first + timedelta(days=1):%Y-%m-%d}T00:00:00Z",
        }

    @staticmethod
    def name(day: int, place: str) -> str:
        """Return the path of a raw file below the archive."""
        return f"rich/d{day:03}" if place == "dark" else f"rich/h{day:03}{RAW.index(place)}"

    def products(self, day: int) -> list[Path]:
        first = factories.DAY + timedelta(days=day)
        return sorted(self.campaign.products_root.rglob(f"*_{first:%Y%m%d}T*.nc"))

    def file(self, day: int) -> Path:
        """Return the file that the case of a day damages."""
        place = CASES[day][1]
        if place == "ancillary":
            return self._files.folder / f"overlap{day:03}.csv"
        return (
            self.products(day)[0]
            if place == "product"
            else self._files.folder / "raw" / self.name(day, place)
        )

    def change(self, day: int, change: Change | None) -> None:
        """Change the file of a day; a server denies a raw file that cannot be read."""
        if change is deny and self._is_remote and CASES[day][1] in RAW:
            self._denied[self.name(day, CASES[day][1])] = HTTPStatus.FORBIDDEN
        elif change is not None:
            change(self.file(day), self._rng)

    def damage(self) -> dict[Path, bytes]:
        """Damage the file of each day before the next run; return what the files held."""
        held = {self.file(day): self.file(day).read_bytes() for day in range(len(CASES))}
        for day, (fault, _) in enumerate(CASES):
            if FAULTS[fault].hidden:
                # So that the run has something to make of the file.
                self.products(day)[-1].unlink()
            self.change(day, FAULTS[fault].before)
        return held

    def damage_meanwhile(self, patch: pytest.MonkeyPatch) -> None:
        """Let files change after the next runs have listed the archive."""
        scan = archive.scan_archive

        def scanned(*arguments: Any, **options: Any) -> Any:
            summary = scan(*arguments, **options)
            for day, (fault, _) in enumerate(CASES):
                self.change(day, FAULTS[fault].during)
            return summary

        patch.setattr(archive, "scan_archive", scanned)

    def repair(self, held: dict[Path, bytes]) -> None:
        """Give all files back what they held."""
        self._denied.clear()
        for file, whole in held.items():
            file.unlink(missing_ok=True)
            file.write_bytes(whole)

    def check(self, day: int, told: str) -> None:
        """Assert that products and run state what the case of a day costs, and nothing else."""
        fault, place = CASES[day]
        stated = [_stated(product) for product in self.products(day)]
        if place == "ancillary":
            assert f"overlap{day:03}.csv: " in told
            # The one that was removed cannot be made; the others stay as they are.
            assert len(stated) == KINDS - FAULTS[fault].hidden
            return
        assert len(stated) == KINDS
        if place != "product":
            name = self.name(day, place)
            assert [text.count(f"{name}: ") for text in stated] == [1] * KINDS, (
                fault,
                place,
                stated,
                told,
            )
            assert f"{name}: " in told or fault == "vanished"
            if fault == "vanished":
                assert "have vanished" in told


def _stated(product: Path) -> str:
    with xr.open_dataset(product) as opened:
        return str(opened.attrs.get(UNUSED_INPUTS, ""))


def _told(matrix: Matrix, result: Result) -> str:
    """Return what a run tells of files that it refused, lost or cannot use."""
    refused = (f"{granule.path}: {granule.reason}" for granule in refused_files(result))
    rows = (f"{row.subject}: {row.problem}" for row in finding_rows(result.findings))
    failures = (f"{scene}: {error}" for scene, error in result.failures.items())
    return "\n".join((*refused, *rows, *failures))


@pytest.mark.parametrize("scheme", ["folder", *SCHEMES])
def test_faults_cost_what_they_damage_and_leave_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scheme: str
) -> None:
    (tmp_path / "raw").mkdir()
    with nullcontext() if scheme == "folder" else served(tmp_path / "raw") as stand_in:
        matrix = Matrix(tmp_path, scheme, stand_in)
        campaign = matrix.campaign
        assert not bring_up_to_date(campaign).has_failures
        whole = shutil.copytree(campaign.products_root, tmp_path / "whole")
        names = sorted(path.relative_to(whole) for path in whole.rglob("*.nc"))
        assert len(names) == KINDS * len(CASES)
        held = matrix.damage()
        with monkeypatch.context() as patch:
            matrix.damage_meanwhile(patch)
            result = bring_up_to_date(campaign)
        assert result.has_failures
        told = _told(matrix, result)
        for day in range(len(CASES)):
            matrix.check(day, told)
        matrix.repair(held)
        assert not bring_up_to_date(campaign).has_failures
        assert bring_up_to_date(campaign).record is None
    for name in names:
        difference = compare_products(whole / name, campaign.products_root / name)
        assert difference.grade is Grade.NONE, name
