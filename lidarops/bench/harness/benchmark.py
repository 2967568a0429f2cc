"""Arguments and output of all benchmarks."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Final

from lidarops.bench.harness.timing import Machine
from lidarops.reports.benchmark_page import BenchmarkReport

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
    """Lists and dicts, or a dataclass."""
    report: BenchmarkReport

    def json(self) -> str:
        """Return the result as JSON."""
        return json.dumps(self.result, indent=1, allow_nan=False, default=asdict)


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


def facts(date: str, machine: Machine) -> tuple[tuple[str, str], ...]:
    """Return date, machine and software of a benchmark run."""
    packages = ", ".join(f"{name} {version}" for name, version in machine.packages.items())
    known = (("Date", date), ("Processor", machine.processor), ("Python", machine.python))
    return tuple(fact for fact in (*known, ("Packages", packages)) if fact[1])
