"""What a large archive costs a file: scans and runs of 10^3 to 10^5 files, and of 10^6 rows."""

from __future__ import annotations

import multiprocessing
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final

from lidarops.bench.accuracy.homogeneous_report import facts
from lidarops.bench.harness.terms import CAMPAIGN_FILE, RESULT, Effort, Finding, Kind
from lidarops.bench.harness.timing import Machine, machine
from lidarops.bench.throughput import stand_in_archives
from lidarops.bench.throughput.campaigns import CampaignSize, simulate_campaign
from lidarops.bench.throughput.stand_in_archives import StandIns
from lidarops.campaign.model import load_campaign
from lidarops.catalog.store import Store
from lidarops.errors import CampaignError
from lidarops.figures import wording
from lidarops.figures.charts import Chart, Panel, Series
from lidarops.reports.benchmark_page import BenchmarkReport, Part, Table
from lidarops.run import archive
from lidarops.run.staleness import Judge

_NOTHING: Final = "-"
_MICRO: Final = 1e6
_OF_SCENE: Final = 480
_BINS: Final = 200
_STATUS: Final = Path("/proc/self/status")


class Pass(StrEnum):
    """What is done with an archive, in this order."""

    FIRST = "first scan"
    PROCESS = "signals"
    SETTLE = "look at everything"
    AGAIN = "scan, all known"
    STALE = "what is stale"
    NOTHING = "run, nothing to do"


_ABOUT: Final[Mapping[Pass, str]] = {
    Pass.FIRST: "headers of all files into the catalog",
    Pass.PROCESS: "from files to products and ledger",
    Pass.SETTLE: "a first run where all products are there: every scene is cut and judged",
    Pass.AGAIN: "files listed and compared with the catalog",
    Pass.STALE: "days that may hold something stale, from catalog and ledger",
    Pass.NOTHING: "both, and nothing written",
}
_OF_FILES: Final = (Pass.FIRST, Pass.PROCESS, Pass.AGAIN, Pass.STALE, Pass.NOTHING)
_OF_ROWS: Final = (Pass.SETTLE, Pass.AGAIN, Pass.STALE, Pass.NOTHING)


@dataclass(frozen=True, slots=True)
class ProcessCost:
    """By a process that did nothing else, once what it needs was imported and compiled."""

    cpu: float
    """s."""
    wall: float
    """s."""
    peak: float
    """Most memory of the process, bytes."""


@dataclass(frozen=True, slots=True)
class ArchiveCost:
    """One archive."""

    files: int
    read: bool
    """Whether its files can be read; else they are empty and stand for others."""
    spent: Mapping[Pass, ProcessCost]


@dataclass(frozen=True, slots=True)
class Archives:
    """The throughput benchmark of archives."""

    date: str
    machine: Machine
    measured: tuple[ArchiveCost, ...]


SIZES: Final = tuple(CampaignSize(n, _OF_SCENE, _BINS, retrieved=False) for n in (2, 20, 200))
STAND_INS: Final = StandIns(instruments=12, days=290)
_QUICK: Final = tuple(CampaignSize(n, _OF_SCENE, _BINS, retrieved=False) for n in (1, 4))
_QUICK_STAND_INS: Final = StandIns(instruments=4, days=10)
_TO_WARM: Final = CampaignSize(1, 30, _BINS, retrieved=False)


def run_archives(kind: Kind, *, effort: Effort) -> Finding:
    """Run the benchmark of archives.

    Raises
    ------
    CampaignError
        Where its accuracy is asked for.
    """
    if kind is not Kind.THROUGHPUT:
        raise CampaignError("an archive has no accuracy benchmark", remedy="choose throughput")
    found = measure_archives(
        _QUICK if effort.quick else SIZES,
        _QUICK_STAND_INS if effort.quick else STAND_INS,
        date=effort.date,
        progress=effort.progress,
    )
    return Finding(found, archives_report(found, RESULT))


def measure_archives(
    sizes: Sequence[CampaignSize],
    standing: StandIns,
    *,
    date: str = "",
    progress: Callable[[int], object] = lambda _: None,
) -> Archives:
    """Simulate archives in temporary folders, and time what is done with them.

    Parameters
    ----------
    sizes : sequence of Size
        Of archives whose files are read.
    standing : StandIns
        An archive of which only the catalog is told.
    date : str
        When it is run, as it is to be stated.
    progress : callable
        Is given 1 after each archive.
    """
    measured = []
    for size in sizes:
        with _folders() as (small, large):
            simulate_campaign(_TO_WARM, small)
            simulate_campaign(size, large)
            measured.append(_measured(size.files, _OF_FILES, (small, large), read=True))
        progress(1)
    with _folders() as (small, large):
        stand_in_archives.enter(StandIns(instruments=1, days=1), small / CAMPAIGN_FILE)
        stand_in_archives.enter(standing, large / CAMPAIGN_FILE)
        measured.append(_measured(standing.files, _OF_ROWS, (small, large), read=False))
    progress(1)
    return Archives(date, machine(), tuple(measured))


@contextmanager
def _folders() -> Iterator[tuple[Path, Path]]:
    """Give folders for an archive to warm up with and for another, which are gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="lidarops-") as folder:
        small, large = Path(folder) / "small", Path(folder) / "large"
        small.mkdir()
        large.mkdir()
        yield small, large


def _measured(
    files: int, ways: Sequence[Pass], folders: tuple[Path, Path], *, read: bool
) -> ArchiveCost:
    small, large = (folder / CAMPAIGN_FILE for folder in folders)
    return ArchiveCost(files, read, {each: _alone(each, small, large) for each in ways})


def _alone(each: Pass, small: Path, large: Path) -> ProcessCost:
    """Do it in a process of its own, whose memory holds nothing else."""
    apart = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=apart) as one:
        return one.submit(_spent, each, small, large).result()


def _spent(each: Pass, small: Path, large: Path) -> ProcessCost:
    do = _WAYS[each]
    do(small)
    cpu, wall = time.process_time(), time.perf_counter()
    do(large)
    return ProcessCost(time.process_time() - cpu, time.perf_counter() - wall, _peak())


def _peak() -> float:
    # What resource tells begins with the memory of the process that this one was started by.
    if _STATUS.exists():
        told = next(line for line in _STATUS.read_text().splitlines() if line.startswith("VmHWM"))
        return 1024.0 * float(told.split()[1])
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(most) if sys.platform == "darwin" else 1024.0 * most


def _scan(file: Path) -> None:
    archive.update_catalog(load_campaign(file))


def _process(file: Path) -> None:
    if archive.reprocess(load_campaign(file)) is None:
        raise CampaignError("the simulated archive gives nothing to do", file=file)


def _stale(file: Path) -> None:
    campaign = load_campaign(file)
    with Store(campaign.catalog_url, campaign.name) as store:
        signatures, verdicts = Judge(campaign, store).signatures(), store.verdicts()
    if any(verdicts.get(day, ("",))[0] != now.whole for day, now in signatures.items()):
        raise CampaignError("the simulated archive does not stay as it is", file=file)


def _rest(file: Path) -> None:
    if archive.reprocess(load_campaign(file)) is not None:
        raise CampaignError("the simulated archive does not stay as it is", file=file)


_WAYS: Final[Mapping[Pass, Callable[[Path], None]]] = {
    Pass.FIRST: _scan,
    Pass.PROCESS: _process,
    Pass.SETTLE: _rest,
    Pass.AGAIN: _scan,
    Pass.STALE: _stale,
    Pass.NOTHING: _rest,
}


# Page -----------------------------------------------------------------------------------------


def growth(first: ArchiveCost, last: ArchiveCost, each: Pass) -> float:
    """Return what a file takes of the last archive over what one of the first takes."""
    return (last.spent[each].cpu / last.files) / (first.spent[each].cpu / first.files)


def archives_report(found: Archives, data: str = "") -> BenchmarkReport:
    """Return the page of the benchmark."""
    real = [each for each in found.measured if each.read]
    part = Part(
        title="Cost of a file, and how it grows with the archive",
        text="Simulated archives of one lidar on a local disk, in one process, which has done the "
        "same with a small archive before: what is imported and compiled once is not counted. "
        "TMPDIR tells on which disk.",
        charts=(_chart(real),),
        tables=tuple(_table(found.measured, each) for each in Pass),
    )
    return BenchmarkReport(
        title="Archives: cost of a file",
        facts=facts(found.date, found.machine),
        parts=(part,),
        data=data,
    )


def _chart(real: Sequence[ArchiveCost]) -> Chart:
    series = tuple(
        Series(
            each.value,
            tuple(float(one.files) for one in real),
            tuple(_MICRO * one.spent[each].cpu / one.files for one in real),
            joined=True,
        )
        for each in Pass
        if all(each in one.spent for one in real)
    )
    return Chart(
        name="archive",
        title="CPU time of a file",
        caption="A level line is a cost that does not grow with the archive.",
        panels=(Panel("", "files", "CPU time of a file (\N{MICRO SIGN}s)", series),),
    )


def _table(measured: Sequence[ArchiveCost], each: Pass) -> Table:
    mine = [one for one in measured if each in one.spent]
    rows = []
    for one in mine:
        spent = one.spent[each]
        first = next(other for other in mine if other.read is one.read)
        rows.append(
            (
                f"{one.files:,}" + ("" if one.read else " rows"),
                f"{spent.cpu:.3g}",
                f"{spent.wall:.3g}",
                f"{_MICRO * spent.cpu / one.files:.3g}",
                _NOTHING if one is first else f"{growth(first, one, each):.2f}",
                wording.size(spent.peak),
            )
        )
    return Table(
        title=f"{each.value}: {_ABOUT[each]}",
        columns=("files", "CPU s", "wall s", "us a file", "times the first", "most memory"),
        rows=tuple(rows),
        note="Rows: empty files stand for those of the catalog, and are not read.",
    )
