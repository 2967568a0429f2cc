"""Whether a figure with its Monte Carlo error meets a target."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final, Self

from benchmarks.harness.figure import Figure, Unit, share_text

ERRORS: Final = 2.0
"""Monte Carlo errors that a verdict allows for."""


class Verdict(StrEnum):
    """Comparison of a figure with its target."""

    MET = "met"
    """Within the target by at least 2 Monte Carlo errors."""
    UNDECIDED = "undecided"
    """A limit of the target is less than 2 Monte Carlo errors away."""
    MISSED = "MISSED"
    """Outside the target by more than 2 Monte Carlo errors."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """A target, and whether a figure meets it."""

    limits: str
    """In words, with the unit."""
    verdict: Verdict

    @classmethod
    def read(cls, text: str) -> Self:
        """Return the judgement that a committed result states."""
        limits, _, verdict = text.rpartition(" ")
        return cls(limits, Verdict(verdict))

    def __str__(self) -> str:
        return f"{self.limits} {self.verdict}"

    @property
    def met(self) -> bool:
        """Whether the target is met for sure."""
        return self.verdict is Verdict.MET


Score = dict[str, Any]
"""Figures, judgements, numbers and texts of one method in one case; None where it has none."""
Scores = dict[tuple[str, str], Score]
"""Scores by case and method."""


@dataclass(frozen=True, slots=True)
class Target:
    """Limits of a figure."""

    most: float
    least: float = -math.inf
    own: bool = False
    """Whether the limits were chosen here, after measuring, and not required."""

    def verdict(self, figure: Figure) -> Verdict:
        """Return whether a figure is within the limits, outside, or too uncertain to tell."""
        low = figure.value - ERRORS * figure.error
        high = figure.value + ERRORS * figure.error
        if self.least <= low and high <= self.most:
            return Verdict.MET
        if high < self.least or low > self.most:
            return Verdict.MISSED
        return Verdict.UNDECIDED

    def judged(self, figure: Figure) -> Judgement:
        """Return the target and the verdict."""
        shares = figure.unit is Unit.SHARE
        limits = share_text(self.most) if shares else f"{self.most:g}"
        if math.isfinite(self.least):
            limits = f"{100.0 * self.least if shares else self.least:g} to {limits}"
        return Judgement(f"{'own target ' if self.own else ''}{limits}", self.verdict(figure))
