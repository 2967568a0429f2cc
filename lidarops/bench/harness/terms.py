"""What is asked of a benchmark, and what it gives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from lidarops.reports import benchmark_page

RESULT: Final = "result.json"
"""Name of the figures beside the page."""
CAMPAIGN_FILE: Final = "campaign.yaml"
"""Name of the file of a campaign that a benchmark simulates, in a folder of its own."""


class Kind(StrEnum):
    """What is asked of it."""

    ACCURACY = "accuracy"
    THROUGHPUT = "throughput"


@dataclass(frozen=True, slots=True)
class Finding:
    """What a benchmark found."""

    result: object
    """A frozen dataclass, or a list of them."""
    report: benchmark_page.BenchmarkReport


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
