"""Arguments and output of all benchmarks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Protocol

from lidarops.bench.harness.timing import Machine
from lidarops.reports.benchmark_page import BenchmarkReport, Part

RESULT: Final = "result.json"
"""Name of the JSON file with the results, beside the page."""
CAMPAIGN_FILE: Final = "campaign.yaml"
"""Name of the campaign file in the folder of each simulated campaign."""


class BenchmarkKind(StrEnum):
    """Quantity that a benchmark measures."""

    ACCURACY = "accuracy"
    THROUGHPUT = "throughput"


@dataclass(frozen=True, slots=True)
class BenchmarkOutput:
    """Result and report page of a benchmark."""

    result: object
    """A frozen dataclass, or a list of them."""
    report: BenchmarkReport


@dataclass(frozen=True, slots=True)
class Effort:
    """Size of a run, its stated date, and the progress callback."""

    quick: bool = False
    repeats: int | None = None
    """Repeats of each timing; None for the default of the benchmark."""
    date: str = ""
    """Date stated in the result."""
    progress: Callable[[int], object] = lambda _: None
    """Called with 1 after each scenario or setting."""


class Study(Protocol):
    """Result of a study, which states when and on which machine it was made."""

    @property
    def date(self) -> str:
        """Date of the run."""

    @property
    def machine(self) -> Machine:
        """Machine and software of the run."""


def study_page(title: str, study: Study, *parts: Part) -> BenchmarkReport:
    """Return the page of a study, with these chapters."""
    return BenchmarkReport(title, facts(study.date, study.machine), parts, RESULT)


def facts(date: str, machine: Machine) -> tuple[tuple[str, str], ...]:
    """Return date, machine and software of a benchmark run."""
    packages = ", ".join(f"{name} {version}" for name, version in machine.packages.items())
    known = (("Date", date), ("Processor", machine.processor), ("Python", machine.python))
    return tuple(fact for fact in (*known, ("Packages", packages)) if fact[1])
