"""Cost per file of large archives: scans and runs of 10^3 to 10^5 files, and of 10^6 rows."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Final, NamedTuple

from benchmarks.harness.figure import cpu_time
from benchmarks.harness.results import Chapter, Effort, Results, Study
from benchmarks.harness.timing import CPU_TIME, in_fresh_process, peak_memory
from benchmarks.harness.verdicts import Score
from benchmarks.throughput import stand_in_archives
from benchmarks.throughput.campaigns import CAMPAIGN_FILE, CampaignSize, simulate_campaign
from benchmarks.throughput.stand_in_archives import StandIns
from lidarops.campaign.model import load_campaign
from lidarops.catalog.store import Store
from lidarops.errors import CampaignError
from lidarops.run import archive
from lidarops.run.staleness import Judge

_PER_FILE: Final = f"{CPU_TIME} per file"
_FILES_PER_SCENE: Final = 480
_BINS: Final = 200


class Pass(StrEnum):
    """Operations on an archive, in this order."""

    FIRST = "first scan"
    PROCESS = "signals"
    SETTLE = "look at everything"
    AGAIN = "scan, all known"
    STALE = "what is stale"
    NOTHING = "run, nothing to do"


class ProcessCost(NamedTuple):
    """Cost of an operation in its own process, without imports and compilation."""

    cpu: float
    """s."""
    wall: float
    """s."""
    peak: float
    """Peak memory of the process, bytes."""


class ArchiveCost(NamedTuple):
    """Costs of one archive."""

    files: int
    read: bool
    """Whether its files can be read; else they are empty stand-ins."""
    spent: Mapping[Pass, ProcessCost]


SIZES: Final = tuple(
    CampaignSize(n, _FILES_PER_SCENE, _BINS, retrieved=False) for n in (2, 20, 200)
)
STAND_INS: Final = StandIns(instruments=12, days=290)
_QUICK: Final = tuple(CampaignSize(n, _FILES_PER_SCENE, _BINS, retrieved=False) for n in (1, 4))
_QUICK_STAND_INS: Final = StandIns(instruments=4, days=10)
_TO_WARM: Final = CampaignSize(1, 30, _BINS, retrieved=False)


def measure_archives(
    effort: Effort,
    *,
    sizes: Sequence[CampaignSize] | None = None,
    stand_ins: StandIns | None = None,
) -> Study:
    """Simulate archives in temporary folders, and time the operations on them.

    Parameters
    ----------
    effort : Effort
    sizes : sequence of CampaignSize, optional
        Archives with real files.
    stand_ins : StandIns, optional
        Archive of stand-ins, which exists only in catalog and ledger.
    """
    sizes = sizes or (_QUICK if effort.quick else SIZES)
    stand_ins = stand_ins or (_QUICK_STAND_INS if effort.quick else STAND_INS)
    measured = []
    for size in sizes:
        with _folders() as (small, large):
            simulate_campaign(_TO_WARM, small)
            simulate_campaign(size, large)
            measured.append(_measure(size.files, (small, large), read=True))
        effort.progress(1)
    with _folders() as (small, large):
        stand_in_archives.write_stand_ins(StandIns(instruments=1, days=1), small / CAMPAIGN_FILE)
        stand_in_archives.write_stand_ins(stand_ins, large / CAMPAIGN_FILE)
        measured.append(_measure(stand_ins.files, (small, large), read=False))
    effort.progress(1)
    return archives_study(effort.date, measured)


@contextmanager
def _folders() -> Iterator[tuple[Path, Path]]:
    """Yield temporary folders for a warm-up archive and for the measured one."""
    with tempfile.TemporaryDirectory(prefix="lidarops-") as folder:
        small, large = Path(folder) / "small", Path(folder) / "large"
        small.mkdir()
        large.mkdir()
        yield small, large


def _measure(files: int, folders: tuple[Path, Path], *, read: bool) -> ArchiveCost:
    small, large = (folder / CAMPAIGN_FILE for folder in folders)
    archives = "files" if read else "rows"
    costs = {
        operation: in_fresh_process(_cost, operation, small, large)
        for operation, (_, of, _) in _PASSES.items()
        if archives in of
    }
    return ArchiveCost(files, read, costs)


def _cost(operation: Pass, small: Path, large: Path) -> ProcessCost:
    run, *_ = _PASSES[operation]
    run(small)
    cpu, wall = time.process_time(), time.perf_counter()
    run(large)
    return ProcessCost(time.process_time() - cpu, time.perf_counter() - wall, peak_memory())


def _scan(file: Path) -> None:
    archive.update_catalog(load_campaign(file))


def _process(file: Path) -> None:
    if archive.reprocess(load_campaign(file)) is None:
        raise CampaignError("the simulated archive has nothing to process", file=file)


def _check_nothing_stale(file: Path) -> None:
    campaign = load_campaign(file)
    with Store(campaign.catalog_url, campaign.name) as store:
        judge, verdicts = Judge(campaign, store), store.verdicts()
        days = judge.signatures().items()
    if not all(judge.is_settled(now, verdicts.get(day)) for day, now in days):
        raise CampaignError("the simulated archive is not up to date", file=file)


def _check_up_to_date(file: Path) -> None:
    if archive.reprocess(load_campaign(file)) is not None:
        raise CampaignError("the simulated archive is not up to date", file=file)


_PASSES: Final[Mapping[Pass, tuple[Callable[[Path], None], str, str]]] = {
    Pass.FIRST: (_scan, "files", "read the headers of all files into the catalog"),
    Pass.PROCESS: (_process, "files", "process files to products and ledger"),
    Pass.SETTLE: (
        _check_up_to_date,
        "rows",
        "first run with all products present: every scene is cut and checked",
    ),
    Pass.AGAIN: (_scan, "files, rows", "list the files and compare them with the catalog"),
    Pass.STALE: (
        _check_nothing_stale,
        "files, rows",
        "find days that may hold stale scenes, from catalog and ledger",
    ),
    Pass.NOTHING: (_check_up_to_date, "files, rows", "both, without anything to write"),
}
"""What is called, in archives of files that can be read or of stand-ins, and what it does."""


def archives_study(date: str, measured: Sequence[ArchiveCost]) -> Study:
    """Return the study of archives, each compared with the first of its sort."""
    chapter = Chapter(
        "Cost per file, and its growth with the archive",
        "Simulated archives of one lidar on a local disk, in one process. The process has "
        "done the same with a small archive before, so imports and compilation are not "
        "counted. TMPDIR selects the disk.",
        [
            Results(
                f"{operation.value}: {about}",
                {
                    (f"{cost.files}" + ("" if cost.read else " rows"), operation.value): _score(
                        measured, cost, operation
                    )
                    for cost in measured
                    if operation in cost.spent
                },
                "Rows: empty files stand in for those of the catalog, and are not read.",
                case="files",
            )
            for operation, (_, _, about) in _PASSES.items()
        ],
    )
    return Study("Archives: cost per file", date, [chapter])


def _score(measured: Sequence[ArchiveCost], cost: ArchiveCost, operation: Pass) -> Score:
    spent = cost.spent[operation]
    first = next(c for c in measured if operation in c.spent and c.read is cost.read)
    per_file = spent.cpu / cost.files
    of_first = first.spent[operation].cpu / first.files
    return {
        "CPU s": spent.cpu,
        "wall s": spent.wall,
        _PER_FILE: cpu_time(1e9 * per_file),
        "times the first": None if cost is first else per_file / of_first,
        "peak memory (MB)": spent.peak / 1e6,
    }
