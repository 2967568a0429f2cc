"""How often random scenes are answered wrongly without a flag: counts and shares."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from lidarops.bench.accuracy.homogeneous import MonteCarloFigure
from lidarops.bench.stability.stiff_cases import REJECTING, Array

Mask = npt.NDArray[np.bool_]

FALSE: Final = 4.0
"""Stated standard errors beyond which a value is false."""
FINE: Final = 2.5
"""Stated standard errors within which a value needed no flag."""
VISIBLE: Final = 5.0
"""Least size of what a model cannot take up of a violation, in standard deviations of the noise,
for the data to tell it. The best test that knows the very shape of the violation, but not its
sign, goes by the size of one number of that mean and unit variance: with a false alarm in 2500, as
our tests have it, it misses half of the violations of 3.5 and 7 percent of those of 5 (told the
sign too, 5 percent); one that does not know the shape misses more."""
ALL: Final = "all together"
"""Class that holds every scene of a retrieval."""
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
    """How a share stands to a target that it is not to exceed."""

    MET = "met"
    UNTOLD = "not told by so few"
    """Above it, by less than 2 Monte Carlo errors."""
    MISSED = "MISSED"


@dataclass(frozen=True, slots=True)
class Failure:
    """One way in which scenes violate a model, or none."""

    name: str
    satisfied: bool = False
    """Whether the model holds, so that random errors alone have to cover."""
    unseen: str = ""
    """Why the data cannot tell it; empty where they can."""


@dataclass(frozen=True, slots=True)
class Judged:
    """Values of one chunk of scenes of one class, all of one shape."""

    failure: Failure
    quantity: str
    error: Array
    """NaN where there is no value."""
    random: Array
    """Stated standard error."""
    systematic: Any
    """Stated systematic error; 0 where none is declared."""
    bits: npt.NDArray[np.int32]
    doubted: Mask | None = None
    """Where the retrieval's own flags doubt the stated error; where it is rejected, if None."""
    solvable: Mask | None = None
    """Where a flag is needless; not known where None."""
    hidden: Mask | None = None
    """Where the violation is less than `VISIBLE`; not known where None."""


@dataclass(frozen=True, slots=True)
class FalseValueRate:
    """What came of the scenes of one class."""

    retrieval: str
    failure: str
    quantity: str
    scenes: int
    values: int
    kept: MonteCarloFigure
    """Share of the values that no bit rejects."""
    false_random: MonteCarloFigure
    """Of these, off by more than 4 stated standard errors."""
    false: MonteCarloFigure
    """Of these, off by more than 4 of random and systematic error together."""
    false_undoubted: MonteCarloFigure
    """The same of the values that the retrieval's own flags do not doubt either."""
    false_hidden: MonteCarloFigure | None
    """Of `false_undoubted`, the part of violations that no test can be relied on to see; None
    where that is not known."""
    false_seen: MonteCarloFigure
    """The rest of it."""
    false_of_seen: MonteCarloFigure | None
    """That rest as a share of the values alone whose violation could be seen and was not; None
    where that is not known, or there are none."""
    false_bare: MonteCarloFigure | None
    """The same of the values without any bit; None where there are none."""
    fine_of_rejected: MonteCarloFigure
    """Share of the rejected values that are off by less than 2.5."""
    needless: MonteCarloFigure | None
    """Share flagged or withheld of the values that could be determined; None where the model does
    not hold, so that a flag is right, or where nothing is known to be solvable."""
    satisfied: bool
    """Whether the model holds."""
    target: float
    """For what `judged` returns."""
    needless_target: float | None
    unseen: str

    @property
    def judged(self) -> MonteCarloFigure:
        """What has to stay below the target: by random errors alone where the model holds."""
        return self.false_random if self.satisfied else self.false_seen

    @property
    def verdict(self) -> Verdict:
        """How the false values stand to their target."""
        return _held(self.judged, self.target)

    @property
    def needless_verdict(self) -> Verdict | None:
        """How the needless flags stand to theirs; None where they have none."""
        if self.needless is None or self.needless_target is None:
            return None
        return _held(self.needless, self.needless_target)


def _held(found: MonteCarloFigure, target: float) -> Verdict:
    if found.value <= target:
        return Verdict.MET
    above = found.value - 2.0 * found.error > target
    return Verdict.MISSED if above else Verdict.UNTOLD


@dataclass(slots=True)
class Tally:
    """Counts of classes, cluster by cluster: scenes of one cluster share their geometry."""

    counts: dict[tuple[str, str], list[dict[str, float]]] = field(default_factory=dict)
    scenes: dict[tuple[str, str], int] = field(default_factory=dict)
    failures: dict[str, Failure] = field(default_factory=dict)
    measured: set[tuple[str, str]] = field(default_factory=set)
    """Classes and quantities of which it is known what can be seen."""

    def add(self, judged: Judged, scenes: int) -> None:
        """Count the values of a chunk."""
        self.failures[judged.failure.name] = judged.failure
        for name in (judged.failure.name, ALL):
            key = (name, judged.quantity)
            self.counts.setdefault(key, []).append(_counted(judged))
            self.scenes[key] = self.scenes.get(key, 0) + scenes
            if judged.hidden is not None:
                self.measured.add(key)

    def rates(self, retrieval: str, needless: float | None) -> Iterator[FalseValueRate]:
        """Give one rate for each class and quantity.

        Parameters
        ----------
        retrieval : str
        needless : float, optional
            Largest share of needless flags where the model holds.
        """
        for (name, quantity), chunks in self.counts.items():
            column = {one: np.array([chunk[one] for chunk in chunks]) for one in _COUNTS}
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

Generator = Callable[[int], Iterator[tuple[Judged, int]]]
"""From the number of a cluster to what its scenes gave, and how many scenes these were."""


def collect(generator: Generator, clusters: int, progress: Callable[[int], object]) -> Tally:
    """Count the scenes of so many clusters; the same numbers give the same scenes."""
    tally = Tally()
    for cluster in range(clusters):
        for judged, scenes in generator(cluster):
            tally.add(judged, scenes)
        progress(1)
    return tally


def clustered_share(part: Array, whole: Array) -> MonteCarloFigure:
    """Return a share with the Monte Carlo error of independent clusters."""
    total = float(whole.sum())
    if total == 0.0:
        return MonteCarloFigure(0.0, 0.0)
    value = float(part.sum()) / total
    error = float(np.sqrt(np.sum((part - value * whole) ** 2))) / total
    # Where none is found, one more keeps the error from being zero.
    return MonteCarloFigure(value, max(error, 1.0 / total))


def _counted(judged: Judged) -> dict[str, float]:
    shape = judged.error.shape
    size = np.abs(judged.error)
    valued = np.isfinite(size)
    bits = np.broadcast_to(judged.bits, shape)
    rejected = (bits & REJECTING) != 0
    doubted = rejected if judged.doubted is None else judged.doubted | rejected
    solvable = np.zeros_like(valued) if judged.solvable is None else judged.solvable
    hidden = np.zeros_like(valued) if judged.hidden is None else judged.hidden
    random = np.broadcast_to(judged.random, shape)
    stated = np.hypot(random, judged.systematic)
    # A value without a stated error is false whatever it is.
    wild, false = ~(size <= FALSE * random), ~(size <= FALSE * stated)
    kept = valued & ~rejected
    plain, bare = kept & ~doubted, kept & (bits == 0)
    masks = {
        "values": valued,
        "kept": kept,
        "plain": plain,
        "bare": bare,
        "false random": kept & wild,
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
