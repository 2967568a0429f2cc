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

from lidarops.bench.harness.rows import Array, Figure, Mask, Score, Scores, share_text
from lidarops.bench.harness.statistics import clustered_share
from lidarops.flags import FlagBit, Quality, rejecting

FALSE: Final = 4.0
"""Stated standard errors beyond which a value is false."""
FINE: Final = 2.5
"""Stated standard errors within which a value needed no flag."""
COVERED: Final = 1.96
"""Stated standard errors within which 95 percent of the values should be."""
VISIBLE: Final = 5.0
"""Least misfit, in standard deviations of the noise, at which the data reveal a violation. The
misfit is what the model cannot absorb. The best test that knows the shape of the violation but
not its sign uses the size of one number with that mean and unit variance. With one false alarm in
2500, as in our tests, it misses half of the violations of 3.5 and 7 percent of those of 5 (5
percent if the sign is known as well). A test that does not know the shape misses more."""
HELD: Final = "all where the model holds"
BROKEN: Final = "all violations"
"""Classes of all scenes of a retrieval."""
_COUNTS: Final = (
    "values",
    "covered",
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
        pooled = HELD if values.failure.satisfied else BROKEN
        self.failures[pooled] = Failure(pooled, values.failure.satisfied)
        counts = _count(values)
        for name in (values.failure.name, pooled):
            key = (name, values.quantity)
            self.counts.setdefault(key, []).append(counts)
            self.scenes[key] = self.scenes.get(key, 0) + scenes
            if values.hidden is not None:
                self.measured.add(key)

    def rates(self, needless: float | None) -> Scores:
        """Return the shares of kept, false and flagged values by quantity and class.

        Parameters
        ----------
        needless : float, optional
            Largest share of needless flags where the model holds.
        """
        names = sorted(self.counts, key=lambda key: (key[1], key[0] in {HELD, BROKEN}))
        return {(quantity, name): self._score(name, quantity, needless) for name, quantity in names}

    def _score(self, name: str, quantity: str, needless: float | None) -> Score:
        chunks = self.counts[name, quantity]
        column = {count: np.array([chunk[count] for chunk in chunks]) for count in _COUNTS}
        failure = self.failures[name]
        measured = (name, quantity) in self.measured
        plain, seen = column["plain"], column["false plain"] - column["false hidden"]
        visible = plain - column["plain hidden"]
        false_random = clustered_share(column["false random"], column["kept"])
        false_plain = clustered_share(column["false plain"], plain)
        flagged = None
        if failure.satisfied and column["solvable"].any():
            flagged = clustered_share(column["solvable rejected"], column["solvable"])
        # Where the model holds, random errors alone must cover the truth.
        if failure.satisfied:
            verdict = _goal(false_random, SATISFIED)
        else:
            verdict = _goal(false_plain, VIOLATED)
        if needless is not None and flagged is not None:
            verdict += f"; needless {_goal(flagged, needless)}"
        return {
            "scenes": self.scenes[name, quantity],
            "values": int(column["values"].sum()),
            "not rejected": clustered_share(column["kept"], column["values"]),
            "within 1.96": clustered_share(column["covered"], column["kept"]),
            "false, random error": false_random,
            "false, with systematic": clustered_share(column["false"], column["kept"]),
            "and not uncertain": false_plain,
            "target": verdict,
            "of these undetectable": clustered_share(column["false hidden"], plain)
            if measured
            else None,
            "share of the detectable": clustered_share(seen, visible)
            if measured and (visible > 0).any()
            else None,
            "without any flag": clustered_share(column["false bare"], column["bare"])
            if column["bare"].any()
            else None,
            "rejected but accurate": clustered_share(column["fine rejected"], column["rejected"]),
            "needlessly flagged": flagged,
            "detectable in the data": f"no: {failure.unseen}" if failure.unseen else "yes",
        }


def _goal(figure: Figure, target: float) -> str:
    return f"{share_text(target)} {_verdict(figure, target)}"


def _verdict(figure: Figure, target: float) -> Verdict:
    if figure.value <= target:
        return Verdict.MET
    return Verdict.UNDECIDED if figure.value - 2.0 * figure.error <= target else Verdict.MISSED


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
        "covered": kept & (size <= COVERED * random),
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
