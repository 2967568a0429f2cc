"""Rates of false values without a flag in random scenes.

A random scene satisfies or violates the model of a retrieval in a known way. A value is false if
it differs from the truth by more than 4 stated standard errors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from lidarops.bench.harness.rows import MonteCarloFigure
from lidarops.bench.stability.stiff_cases import Array
from lidarops.flags import FlagBit, Quality, rejecting

Mask = npt.NDArray[np.bool_]

FALSE: Final = 4.0
"""Stated standard errors beyond which a value is false."""
FINE: Final = 2.5
"""Stated standard errors within which a value needed no flag."""
VISIBLE: Final = 5.0
"""Least misfit, in standard deviations of the noise, at which the data reveal a violation. The
misfit is what the model cannot absorb. The best test that knows the shape of the violation but
not its sign uses the size of one number with that mean and unit variance. With one false alarm in
2500, as in our tests, it misses half of the violations of 3.5 and 7 percent of those of 5 (5
percent if the sign is known as well). A test that does not know the shape misses more."""
ALL: Final = "all together"
"""Class of all scenes of a retrieval."""
_COUNTS: Final = (
    "values",
    "kept",
    "plain",
    "bare",
    "false random",
    "false",
    "false plain",
    "plain hidden",
    "false hidden",
    "false bare",
    "rejected",
    "fine rejected",
    "solvable",
    "solvable rejected",
)


class Verdict(StrEnum):
    """Comparison of a share with its upper limit, the target."""

    MET = "met"
    UNDECIDED = "undecided"
    """Above the target by less than 2 Monte Carlo errors."""
    MISSED = "MISSED"


@dataclass(frozen=True, slots=True)
class Failure:
    """One way in which scenes violate a model, or none."""

    name: str
    satisfied: bool = False
    """Whether the model holds, so that random errors alone must cover the truth."""
    unseen: str = ""
    """Reason why the data cannot reveal the violation; empty where they can."""


@dataclass(frozen=True, slots=True)
class ScoredValues:
    """Values of a chunk of scenes of one class, with truth and flags; arrays of equal shape."""

    failure: Failure
    quantity: str
    error: Array
    """NaN where there is no value."""
    random: Array
    """Stated standard error."""
    systematic: Any
    """Stated systematic error; 0 where none is stated."""
    bits: npt.NDArray[np.int32]
    own: Iterable[FlagBit]
    """The retrieval's own bits, beside `lidarops.flags.Quality`."""
    uncertain: Mask | None = None
    """Where flags of the retrieval mark the stated error as uncertain; None: where rejected."""
    solvable: Mask | None = None
    """Where a flag is needless; None where unknown."""
    hidden: Mask | None = None
    """Where the misfit of the violation is below `VISIBLE`; None where unknown."""


@dataclass(frozen=True, slots=True)
class FalseValueRate:
    """Shares of kept, false and flagged values in the scenes of one class."""

    retrieval: str
    failure: str
    quantity: str
    scenes: int
    values: int
    kept: MonteCarloFigure
    """Share of the values that no bit rejects."""
    false_random: MonteCarloFigure
    """Share of kept values that differ by more than 4 stated random errors."""
    false: MonteCarloFigure
    """Share of kept values that differ by more than 4 combined random and systematic errors."""
    false_undoubted: MonteCarloFigure
    """The same share of kept values that no flag marks as uncertain."""
    false_hidden: MonteCarloFigure | None
    """Part of `false_undoubted` with violations that no test can reliably detect; None where that
    is unknown."""
    false_seen: MonteCarloFigure
    """`false_undoubted` minus `false_hidden`."""
    false_of_seen: MonteCarloFigure | None
    """`false_seen` as a share of the values whose violation is detectable but not flagged; None
    where that is unknown, or there are none."""
    false_bare: MonteCarloFigure | None
    """The same share of the values without any bit; None where there are none."""
    fine_of_rejected: MonteCarloFigure
    """Share of the rejected values that differ by less than 2.5 stated errors."""
    needless: MonteCarloFigure | None
    """Share of the determinable values that are flagged or withheld; None where the model does
    not hold, so that a flag is right, or where it is unknown what can be determined."""
    satisfied: bool
    """Whether the model holds."""
    target: float
    """Upper limit of `limited_share`."""
    needless_target: float | None
    unseen: str

    @property
    def limited_share(self) -> MonteCarloFigure:
        """The share that the target limits: by random errors alone where the model holds."""
        return self.false_random if self.satisfied else self.false_seen

    @property
    def verdict(self) -> Verdict:
        """Comparison of the false values with their target."""
        return _compare(self.limited_share, self.target)

    @property
    def needless_verdict(self) -> Verdict | None:
        """Comparison of the needless flags with their target; None without one."""
        if self.needless is None or self.needless_target is None:
            return None
        return _compare(self.needless, self.needless_target)


def _compare(share: MonteCarloFigure, target: float) -> Verdict:
    if share.value <= target:
        return Verdict.MET
    above = share.value - 2.0 * share.error > target
    return Verdict.MISSED if above else Verdict.UNDECIDED


@dataclass(slots=True)
class Tally:
    """Counts by class and cluster; scenes of one cluster share their geometry."""

    counts: dict[tuple[str, str], list[dict[str, float]]] = field(default_factory=dict)
    scenes: dict[tuple[str, str], int] = field(default_factory=dict)
    failures: dict[str, Failure] = field(default_factory=dict)
    measured: set[tuple[str, str]] = field(default_factory=set)
    """Classes and quantities for which it is known which violations are detectable."""

    def add(self, values: ScoredValues, scenes: int) -> None:
        """Count the values of a chunk."""
        self.failures[values.failure.name] = values.failure
        for name in (values.failure.name, ALL):
            key = (name, values.quantity)
            self.counts.setdefault(key, []).append(_count(values))
            self.scenes[key] = self.scenes.get(key, 0) + scenes
            if values.hidden is not None:
                self.measured.add(key)

    def rates(self, retrieval: str, needless: float | None) -> Iterator[FalseValueRate]:
        """Yield the rates of each class and quantity.

        Parameters
        ----------
        retrieval : str
        needless : float, optional
            Largest share of needless flags where the model holds.
        """
        for (name, quantity), chunks in self.counts.items():
            column = {count: np.array([chunk[count] for chunk in chunks]) for count in _COUNTS}
            failure = self.failures.get(name, Failure(name))
            yield FalseValueRate(
                retrieval=retrieval,
                failure=name,
                quantity=quantity,
                scenes=self.scenes[name, quantity],
                values=int(column["values"].sum()),
                kept=clustered_share(column["kept"], column["values"]),
                false_random=clustered_share(column["false random"], column["kept"]),
                false=clustered_share(column["false"], column["kept"]),
                false_undoubted=clustered_share(column["false plain"], column["plain"]),
                false_hidden=clustered_share(column["false hidden"], column["plain"])
                if (name, quantity) in self.measured
                else None,
                false_seen=clustered_share(
                    column["false plain"] - column["false hidden"], column["plain"]
                ),
                false_of_seen=clustered_share(
                    column["false plain"] - column["false hidden"],
                    column["plain"] - column["plain hidden"],
                )
                if (name, quantity) in self.measured
                and (column["plain"] > column["plain hidden"]).any()
                else None,
                false_bare=clustered_share(column["false bare"], column["bare"])
                if column["bare"].any()
                else None,
                fine_of_rejected=clustered_share(column["fine rejected"], column["rejected"]),
                needless=clustered_share(column["solvable rejected"], column["solvable"])
                if failure.satisfied and column["solvable"].any()
                else None,
                satisfied=failure.satisfied,
                target=SATISFIED if failure.satisfied else VIOLATED,
                needless_target=needless if failure.satisfied else None,
                unseen=failure.unseen,
            )


SATISFIED: Final = 1e-3
"""Largest share of false values where the model holds."""
VIOLATED: Final = 5e-3
"""Largest share where it does not."""

Generator = Callable[[int], Iterator[tuple[ScoredValues, int]]]
"""Yields the values of the scenes of a cluster, given its number, and the number of scenes."""


def collect(generator: Generator, clusters: int, progress: Callable[[int], object]) -> Tally:
    """Count the values of that many clusters; the same numbers give the same scenes."""
    tally = Tally()
    for cluster in range(clusters):
        for values, scenes in generator(cluster):
            tally.add(values, scenes)
        progress(1)
    return tally


def clustered_share(count: Array, total_count: Array) -> MonteCarloFigure:
    """Return a share with the Monte Carlo error of independent clusters."""
    total = float(total_count.sum())
    if total == 0.0:
        return MonteCarloFigure(0.0, 0.0)
    value = float(count.sum()) / total
    error = float(np.sqrt(np.sum((count - value * total_count) ** 2))) / total
    # With a count of 0, the error is that of one count.
    return MonteCarloFigure(value, max(error, 1.0 / total))


def _count(values: ScoredValues) -> dict[str, float]:
    shape = values.error.shape
    size = np.abs(values.error)
    valued = np.isfinite(size)
    bits = np.broadcast_to(values.bits, shape)
    rejected = (bits & rejecting((*Quality, *values.own))) != 0
    uncertain = rejected if values.uncertain is None else values.uncertain | rejected
    solvable = np.zeros_like(valued) if values.solvable is None else values.solvable
    hidden = np.zeros_like(valued) if values.hidden is None else values.hidden
    random = np.broadcast_to(values.random, shape)
    stated = np.hypot(random, values.systematic)
    # A value without a stated error is false.
    false_random, false = ~(size <= FALSE * random), ~(size <= FALSE * stated)
    kept = valued & ~rejected
    plain, bare = kept & ~uncertain, kept & (bits == 0)
    masks = {
        "values": valued,
        "kept": kept,
        "plain": plain,
        "bare": bare,
        "false random": kept & false_random,
        "false": kept & false,
        "false plain": plain & false,
        "plain hidden": plain & hidden,
        "false hidden": plain & false & hidden,
        "false bare": bare & false,
        "rejected": valued & rejected,
        "fine rejected": valued & rejected & (size <= FINE * stated),
        "solvable": solvable,
        "solvable rejected": solvable & ~plain,
    }
    return {name: float(np.count_nonzero(mask)) for name, mask in masks.items()}
