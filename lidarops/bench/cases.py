"""The benchmarks by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final, TypeVar

from lidarops.bench import accuracy, results, speed, story, throughput
from lidarops.bench.timing import machine
from lidarops.errors import CampaignError
from lidarops.reports import benchmark

RESULT: Final = "result.json"
"""Name of the figures beside the page."""
_REPEATS: Final = 7

_Names = TypeVar("_Names", bound=StrEnum)


class Case(StrEnum):
    """What is measured."""

    HOMOGENEOUS = "homogeneous"
    READER = "reader"


class Kind(StrEnum):
    """What is asked of it."""

    ACCURACY = "accuracy"
    THROUGHPUT = "throughput"


@dataclass(frozen=True, slots=True)
class Finding:
    """What a benchmark found."""

    result: object
    """A frozen dataclass, or a list of them."""
    report: benchmark.Report


@dataclass(frozen=True, slots=True)
class Effort:
    """How much is measured, and what is told of it."""

    quick: bool = False
    repeats: int | None = None
    """Of each timing; the benchmark's own where not given."""
    date: str = ""
    """When it is run, as it is to be stated."""
    progress: Callable[[int], object] = lambda _: None
    """Is given 1 after each scenario or setting."""


def run(what: str, case: str | None, files: Sequence[Path], effort: Effort) -> Finding:
    """Run a benchmark.

    Parameters
    ----------
    what : {"accuracy", "throughput"}
    case : {"homogeneous", "reader"} or None
        None is "reader" where files are given, else "homogeneous".
    files : sequence of Path
        Raw files of one layout, for "reader" and no other.
    effort : Effort

    Raises
    ------
    CampaignError
        Where there is no such benchmark, or the case takes no files.
    RawFormatError
        Where "reader" gets no file, or one that cannot be read.
    """
    kind = _member(Kind, what, "benchmark")
    chosen = _member(Case, case or (Case.READER if files else Case.HOMOGENEOUS), "case")
    if chosen is Case.READER and kind is Kind.ACCURACY:
        raise CampaignError("the reader has no accuracy benchmark", remedy="choose throughput")
    if chosen is Case.HOMOGENEOUS and files:
        raise CampaignError("the case 'homogeneous' takes no files", remedy="leave them out")
    if chosen is Case.READER:
        read = throughput.reader(files, repeats=effort.repeats or _REPEATS)
        return Finding(read, story.reader_report(read, effort.date, machine(), RESULT))
    if kind is Kind.ACCURACY:
        found = accuracy.measure(quick=effort.quick, date=effort.date, progress=effort.progress)
        return Finding(found, story.accuracy_report(found, RESULT))
    timed = speed.measure(
        quick=effort.quick, date=effort.date, repeats=effort.repeats, progress=effort.progress
    )
    return Finding(timed, story.throughput_report(timed, RESULT))


def write(finding: Finding, folder: Path) -> Path:
    """Write the figures as JSON and the page of a benchmark; return the page.

    Raises
    ------
    CatalogError
        Where the folder cannot be written.
    """
    results.save(finding.result, folder / RESULT)
    return benchmark.build(finding.report, folder)


def _member(names: type[_Names], value: str, what: str) -> _Names:
    try:
        return names(value)
    except ValueError:
        choices = " or ".join(names)
        raise CampaignError(f"no {what} {value!r}", remedy=f"choose: {choices}") from None
