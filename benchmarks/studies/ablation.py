"""Rates of false and lost values with each guard of a retrieval switched off in turn.

All variants see the same random scenes, those of ``benchmarks stability``, so that the error
of a difference is that of pairs: a jackknife over clusters, which share a geometry.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.stability.random_scenes import FALSE, ScoredValues
from lidarops.flags import Quality, rejecting

BASE: Final = "all guards"
COVERED: Final = 1.96
"""Stated errors within which 95 percent of the values should be."""
RATES: Final = {
    "false, model holds": ("false where satisfied", "usable where satisfied"),
    "false, model violated": ("false where violated", "usable where violated"),
    "false, no bit": ("false without bit", "without bit"),
    "covered, model holds": ("covered where satisfied", "usable where satisfied"),
    "covered, model violated": ("covered where violated", "usable where violated"),
    "needless": ("solvable and flagged", "solvable"),
    "lost, model holds": ("lost where satisfied", "scored where satisfied"),
    "lost, model violated": ("lost where violated", "scored where violated"),
}
"""Rate -> numerator and denominator. `false`: beyond 4 stated errors though not rejected,
or though no bit is raised, whether it rejects or not. `covered`: within 1.96 stated errors.
`needless`: flagged or withheld though determinable. `lost`: flagged or withheld."""

Counts = dict[str, float]
Scores = Iterable[tuple[ScoredValues, int]]


@dataclass(frozen=True)
class Guard:
    """One guard, and how it is switched off."""

    name: str
    bits: int = 0
    """Bits of which the values are freed."""
    off: Callable[[], AbstractContextManager[object]] | None = None
    """Context without the guard, in which the scenes are retrieved anew."""


def measure(
    score: Callable[[int], Scores], clusters: Sequence[int], guards: Sequence[Guard]
) -> dict[tuple[str, str], list[Counts]]:
    """Return counts by (guard, quantity), one entry for each cluster."""
    counts: dict[tuple[str, str], list[Counts]] = {}
    contexts: list[tuple[Callable[[], AbstractContextManager[object]], list[Guard]]]
    contexts = [(nullcontext, [Guard(BASE), *(g for g in guards if g.off is None)])]
    contexts += [(guard.off, [guard]) for guard in guards if guard.off is not None]
    for context, variants in contexts:
        # Outside the loop over clusters: some contexts compile.
        with context():
            for cluster in clusters:
                scored = list(score(cluster))
                for variant in variants:
                    for quantity, total in _totals(scored, variant.bits).items():
                        counts.setdefault((variant.name, quantity), []).append(total)
    return counts


def _totals(scored: Scores, bits: int) -> dict[str, Counts]:
    totals: dict[str, Counts] = {}
    for values, _ in scored:
        total = totals.setdefault(values.quantity, {})
        for name, number in _count(_freed(values, bits)).items():
            total[name] = total.get(name, 0.0) + number
    return totals


def _freed(values: ScoredValues, bits: int) -> ScoredValues:
    freed = (np.asarray(values.bits) & bits) != 0
    uncertain = None if values.uncertain is None else values.uncertain & ~freed
    return replace(values, bits=values.bits & ~np.int32(bits), uncertain=uncertain)


def _count(values: ScoredValues) -> Counts:
    shape = values.error.shape
    valued = np.isfinite(values.error)
    bits = np.broadcast_to(values.bits, shape)
    usable = valued & ((bits & rejecting((*Quality, *values.own))) == 0)
    if values.uncertain is not None:
        usable &= ~values.uncertain
    stated = np.hypot(np.broadcast_to(values.random, shape), values.systematic)
    false = usable & ~(np.abs(values.error) <= FALSE * stated)
    covered = np.abs(values.error) <= COVERED * stated
    holds = values.failure.satisfied
    kind = "satisfied" if holds else "violated"
    counts = {
        f"false where {kind}": np.count_nonzero(false),
        f"usable where {kind}": np.count_nonzero(usable),
        f"covered where {kind}": np.count_nonzero(usable & covered),
        "without bit": np.count_nonzero(usable & (bits == 0)),
        "false without bit": np.count_nonzero(false & (bits == 0)),
        f"lost where {kind}": np.count_nonzero(~usable),
        f"scored where {kind}": usable.size,
    }
    if holds and values.solvable is not None:
        counts["solvable"] = np.count_nonzero(values.solvable)
        counts["solvable and flagged"] = np.count_nonzero(values.solvable & ~usable)
    return {name: float(number) for name, number in counts.items()}


def table(counts: Mapping[tuple[str, str], list[Counts]]) -> Iterator[str]:
    """Yield the lines of a Markdown table: rates with all guards, then changes without each."""
    yield "| guard off | value | " + " | ".join(RATES) + " | moves |"
    yield "| --- | --- |" + " --- |" * (len(RATES) + 1)
    for (guard, quantity), own in counts.items():
        base = counts[BASE, quantity]
        cells, moves = [], []
        for name, (part, whole) in RATES.items():
            value, error = _change(own, base, part, whole)
            if guard != BASE and abs(value) > 2.0 * error:
                moves.append(name)
            sign = "" if guard == BASE else "+"
            cells.append(f"{100 * value:{sign}.4f} ± {100 * error:.4f}")
        yield f"| {guard} | {quantity} | " + " | ".join(cells) + f" | {', '.join(moves)} |"


def _change(own: list[Counts], base: list[Counts], part: str, whole: str) -> tuple[float, float]:
    """Return the rate, or its change where `own` is not `base`, with the jackknife error."""

    def rates(counts: list[Counts]) -> tuple[float, np.ndarray]:
        numbers = np.array([[c.get(name, 0.0) for c in counts] for name in (part, whole)])
        total = numbers.sum(axis=1, keepdims=True)
        left = total - numbers
        return float(total[0, 0] / max(total[1, 0], 1.0)), left[0] / np.maximum(left[1], 1.0)

    value, without = rates(own)
    if own is not base:
        base_value, base_without = rates(base)
        value, without = value - base_value, without - base_without
    count = without.size
    return value, float(np.sqrt((count - 1) / count * np.sum((without - without.mean()) ** 2)))


def write_table(page: Path, mark: str, lines: Iterable[str]) -> None:
    """Write the lines of a table into a page, between two marks of that name."""
    text = page.read_text(encoding="utf-8")
    before, begin, rest = text.partition(f"<!-- {mark} -->\n")
    _, end, after = rest.partition(f"<!-- end of {mark} -->")
    if not (begin and end):
        raise ValueError(f"{page} has no marks of the name {mark!r}")
    page.write_text("".join((before, begin, *(f"{line}\n" for line in lines), end, after)), "utf-8")


def cluster_count(description: str | None, default: int) -> int:
    """Return the number of clusters that the command line of a study requests."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("clusters", nargs="?", type=int, default=default)
    return int(parser.parse_args().clusters)
