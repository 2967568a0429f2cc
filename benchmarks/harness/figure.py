"""Measured numbers with their Monte Carlo errors: their text, targets, statistics, and times."""

from __future__ import annotations

import math
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Final, Self, TypeVar

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Random = np.random.Generator
CPU_TIME: Final = "CPU time"
"""Quantity against which errors are drawn."""
TWO_SIDED: Final = 1.959963984540054
"""Standard deviations that hold 95 percent of a normal distribution."""
SIGMAS: Final = (1.0, TWO_SIDED)
"""Standard errors within which truths are counted."""
ERRORS: Final = 2.0
"""Monte Carlo errors that a verdict allows for."""
_ROUNDING: Final = 1e-12
"""Relative error of sums of equal values, which is no Monte Carlo error."""
_LIMIT_WITHOUT_EVENTS: Final = -math.log(0.05)
"""Expected events of which none are seen in 5 percent of all cases."""
_Result = TypeVar("_Result")


class Unit(StrEnum):
    """Unit of a value, which selects how it is written."""

    NUMBER = ""
    SHARE = "1"
    """0 to 1, written in percent."""
    TIME = "ns"
    """Written in a suitable unit and drawn in microseconds."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A number with its Monte Carlo standard error, which is 0 without one."""

    value: float
    error: float = 0.0
    unit: Unit = Unit.NUMBER

    def times(self, factor: float) -> Figure:
        """Return the figure in another unit of the same kind."""
        return replace(self, value=factor * self.value, error=factor * self.error)


def share(value: Figure | float) -> Figure:
    """Return a figure that is written in percent."""
    return replace(value if isinstance(value, Figure) else Figure(value), unit=Unit.SHARE)


def cpu_time(nanoseconds: float) -> Figure:
    """Return the figure of a time."""
    return Figure(nanoseconds, unit=Unit.TIME)


def with_error(value: float, error: float) -> str:
    """Return a value with its error in units of the last digit."""
    if not error > _ROUNDING * abs(value):
        return f"{value:,.0f}" if abs(value) >= 1e3 else f"{value:.3g}"
    digits = max(-math.floor(math.log10(error)), 0)
    # Zero has no sign.
    shown = round(value, digits) + 0.0
    return f"{shown:.{digits}f}({error * 10**digits:.0f})"


def share_text(share: float) -> str:
    """Return a share that was chosen, not measured, in percent."""
    return f"{100.0 * share:g} %"


def format_time(nanoseconds: float) -> str:
    """Return a time in s, ms, µs or ns."""
    for unit, size in (("s", 1e9), ("ms", 1e6), ("µs", 1e3)):
        if nanoseconds >= size:
            return f"{nanoseconds / size:.3g} {unit}"
    return f"{nanoseconds:.3g} ns"


# Targets --------------------------------------------------------------------------------------


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
class Work:
    """Error and run time of one method in one setting, for the comparison of methods."""

    setting: str
    quantity: str
    """With its unit."""
    method: str
    error: Figure
    """Root mean square."""
    coverage: Figure | None
    """Share of truths in the stated 95 percent interval; None if the method states none."""
    time: Figure
    """CPU time per profile."""
    ours: bool = True
    """Whether a method of lidarops; else a peer."""
    informed: bool = False
    """Whether the method knows more than the profile."""
    more: Score = field(default_factory=dict)
    """Further figures of the method."""


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


# Statistics -----------------------------------------------------------------------------------


def clustered_share(events: Array, trials: Array, effect: float = 1.0) -> Figure:
    """Return a share of counts in independent clusters.

    Parameters
    ----------
    events, trials : (cluster,) float
        Counts.
    effect : float
        Design effect of values of the same clusters (`design_effect`). So many values count as one
        where there are too few events to show how they scatter.
    """
    total = float(trials.sum())
    if total == 0.0:
        return share(0.0)
    value = float(events.sum()) / total
    # Without events, 2 errors are the 95 percent limit of the share: 3 over the number of values.
    least = 0.5 * _LIMIT_WITHOUT_EVENTS * effect / total
    return share(Figure(value, max(_scatter(events, trials), min(least, 0.5))))


def design_effect(events: Array, trials: Array) -> float:
    """Return the number of values in clusters that tell as much as one independent value.

    At least 1; it is the variance of the share over that of independent values.
    """
    total = float(trials.sum())
    value = float(events.sum()) / total if total else 0.0
    independent = value * (1.0 - value) / total if total else 0.0
    return max(_scatter(events, trials) ** 2 / independent, 1.0) if independent else 1.0


def _scatter(events: Array, trials: Array) -> float:
    """Return the error of a share from the scatter of its clusters."""
    total = float(trials.sum())
    value = float(events.sum()) / total
    return float(np.sqrt(np.sum((events - value * trials) ** 2))) / total


def mean_by_block(values: npt.NDArray[np.generic], kept: Mask, block: int) -> Figure | None:
    """Return the mean of kept values, with its error from the scatter between blocks.

    Parameters
    ----------
    values : (profile, ...) float or bool
    kept : (profile, ...) bool
    block : int
        Profiles of a block.

    Returns
    -------
    Figure or None
        None where nothing is kept. The mean is a ratio of sums over blocks, and so is its error.
    """
    edges = np.arange(0, len(values), block)
    parts = np.where(kept, values, 0.0), kept.astype(np.float64)
    totals, counts = (np.add.reduceat(_sums(part), edges) for part in parts)
    if not counts.any():
        return None
    scatter = _scatter(totals, counts) * math.sqrt(edges.size / max(edges.size - 1, 1))
    return Figure(float(totals.sum() / counts.sum()), scatter)


def share_by_block(inside: Mask, kept: Mask, block: int) -> Figure | None:
    """Return the share of kept values that are inside, with an error above 0."""
    value = mean_by_block(inside, kept, block)
    if value is None:
        return None
    profiles = int(np.count_nonzero(_sums(kept.astype(np.float64))))
    # Half a profile keeps the error above zero where all or none are inside.
    probability = (value.value * profiles + 0.5) / (profiles + 1)
    least = math.sqrt(probability * (1 - probability) / profiles)
    return share(Figure(value.value, max(value.error, least)))


def root_by_block(errors: Array, kept: Mask, block: int) -> Figure | None:
    """Return the root mean square of kept errors, with its error from the scatter of blocks."""
    square = mean_by_block(errors**2, kept, block)
    if square is None:
        return None
    value = math.sqrt(square.value)
    return Figure(value, square.error / (2.0 * value) if value > 0 else 0.0)


def _sums(values: Array) -> Array:
    return np.asarray(values.reshape(len(values), -1).sum(axis=1))


def log_uniform(rng: Random, low: float, high: float, size: tuple[int, ...] | None = None) -> Any:
    """Return random numbers, or one, whose logarithm is uniform."""
    values = np.exp(rng.uniform(np.log(low), np.log(high), size))
    return float(values) if size is None else np.asarray(values)


def correlated(rng: Random, shape: tuple[int, ...], correlation: float) -> Array:
    """Return unit normal numbers, correlated along the last axis."""
    out = rng.normal(size=shape)
    rest = np.sqrt(1.0 - correlation**2)
    for k in range(1, shape[-1] if correlation else 0):
        out[..., k] = correlation * out[..., k - 1] + rest * out[..., k]
    return out


# Times ----------------------------------------------------------------------------------------


def timed(call: Callable[[], _Result]) -> tuple[float, _Result]:
    """Return the CPU time of a call in seconds, and its result."""
    begin = time.process_time()
    result = call()
    # A coarse clock may not advance during a fast call.
    return max(time.process_time() - begin, 1e-9), result


def cpu_seconds() -> float:
    """Return the CPU time of this process so far, with that of its children that have ended."""
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)
