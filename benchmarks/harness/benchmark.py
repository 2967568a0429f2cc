"""Arguments of all benchmarks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

CAMPAIGN_FILE: Final = "campaign.yaml"
"""Name of the campaign file in the folder of each simulated campaign."""


class BenchmarkKind(StrEnum):
    """Quantity that a benchmark measures."""

    ACCURACY = "accuracy"
    THROUGHPUT = "throughput"
    STABILITY = "stability"


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
