"""Rates of false and lost values with each guard of a retrieval switched off in turn.

All variants see the same random scenes, those of ``benchmarks stability``, so that the error
of a difference is that of pairs: a jackknife over clusters, which share a geometry.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Final
from unittest import mock

import numpy as np
import pandas as pd

from benchmarks.harness import rates
from benchmarks.harness.figure import Array
from benchmarks.harness.rates import ScoredValues

PAGES: Final = Path(__file__).resolve().parents[2] / "docs/algorithms"
"""Of the tables."""
BASE: Final = "all guards"
RATES: Final[dict[str, tuple[str, str, tuple[bool, ...]]]] = {
    "false, model holds": ("false plain", "plain", (True,)),
    "false, model violated": ("false plain", "plain", (False,)),
    "false, no bit": ("false bare", "bare", (True, False)),
    "covered, model holds": ("plain covered", "plain", (True,)),
    "covered, model violated": ("plain covered", "plain", (False,)),
    "needless": ("solvable rejected", "solvable", (True,)),
    "lost, model holds": ("lost", "scored", (True,)),
    "lost, model violated": ("lost", "scored", (False,)),
}
"""Rate -> numerator, denominator, and whether the model holds. `false`: beyond 4 stated errors
though not rejected, or though no bit is raised, whether it rejects or not. `covered`: within 1.96
stated errors.
`needless`: flagged or withheld though determinable. `lost`: flagged or withheld."""

Context = Callable[[], AbstractContextManager[object]]
ScoreCluster = Callable[[int], Iterable[ScoredValues]]
Patch = tuple[Any, str, Any]
"""Owner, name of its attribute, and what stands there instead."""


@dataclass(frozen=True)
class Guard:
    """One guard, and how it is switched off."""

    name: str
    bits: int = 0
    """Bits of which the values are freed."""
    off: Context | None = None
    """Context without the guard, in which the scenes are retrieved anew."""


@contextmanager
def replaced(*patches: Patch) -> Iterator[None]:
    """Replace attributes of modules."""
    with ExitStack() as stack:
        for owner, name, value in patches:
            stack.enter_context(mock.patch.object(owner, name, value))
        yield


def without(*patches: Patch) -> Context:
    """Return the context with these replacements."""
    return lambda: replaced(*patches)


def with_thresholds(module: Any, **changes: Any) -> Context:
    """Return the context in which the thresholds that a module reads have other values."""
    return without((module, "THRESHOLDS", module.THRESHOLDS._replace(**changes)))


def measure(score: ScoreCluster, clusters: Sequence[int], guards: Sequence[Guard]) -> pd.DataFrame:
    """Return counts by guard, quantity, class and cluster."""
    contexts: list[tuple[Context, list[Guard]]] = [
        (nullcontext, [Guard(BASE), *(guard for guard in guards if guard.off is None)]),
        *((guard.off, [guard]) for guard in guards if guard.off is not None),
    ]
    rows: list[dict[str, Any]] = []
    for context, variants in contexts:
        # Outside the loop over clusters: some contexts compile.
        with context():
            for cluster in clusters:
                for values in score(cluster):
                    rows += [
                        rates.counts(_without_bits(values, guard.bits))
                        | {"guard": guard.name, "cluster": cluster}
                        for guard in variants
                    ]
    counted = pd.DataFrame(rows).drop(columns="sizes")
    return counted.groupby(["guard", *rates.KEYS], sort=False).sum()


def _without_bits(values: ScoredValues, bits: int) -> ScoredValues:
    freed = (np.asarray(values.bits) & bits) != 0
    uncertain = None if values.uncertain is None else values.uncertain & ~freed
    return replace(values, bits=values.bits & ~np.int32(bits), uncertain=uncertain)


def table(counts: pd.DataFrame) -> Iterator[str]:
    """Yield the lines of a Markdown table: rates with all guards, then changes without each."""
    yield "| guard off | value | " + " | ".join(RATES) + " | moves |"
    yield "| --- | --- |" + " --- |" * (len(RATES) + 1)
    places = ["guard", "quantity", "cluster"]
    every = counts.groupby(places, sort=False).sum()
    sides: dict[tuple[Any, ...], pd.DataFrame] = {}
    for holds in {rate[2] for rate in RATES.values()}:
        side = counts[counts.index.isin(holds, level="satisfied")].groupby(places, sort=False).sum()
        side = side.reindex(every.index, fill_value=0.0)
        sides |= {(holds, *key): own for key, own in side.groupby(places[:2], sort=False)}
    names = [every.index.unique(level) for level in places[:2]]
    for guard, quantity in product(*names):
        if ((True,), guard, quantity) not in sides:
            continue
        cells, moves = [], []
        for name, (events, trials, holds) in RATES.items():
            (value, left), (of_base, base_left) = (
                _jackknife(*sides[holds, of, quantity][[events, trials]].to_numpy().T)
                for of in (guard, BASE)
            )
            if guard != BASE:
                value, left = value - of_base, left - base_left
            scatter = np.sum((left - left.mean()) ** 2)
            error = np.sqrt((left.size - 1) / left.size * scatter)
            if guard != BASE and abs(value) > 2.0 * error:
                moves.append(name)
            sign = "" if guard == BASE else "+"
            cells.append(f"{100 * value:{sign}.4f} ± {100 * error:.4f}")
        yield f"| {guard} | {quantity} | " + " | ".join(cells) + f" | {', '.join(moves)} |"


def _jackknife(events: Array, trials: Array) -> tuple[float, Array]:
    """Return a rate, and the rates without each of the clusters."""
    others = (events.sum() - events) / np.maximum(trials.sum() - trials, 1.0)
    return float(events.sum() / max(trials.sum(), 1.0)), others


def write_guards(
    page: str, score: ScoreCluster, clusters: int, guards: Sequence[Guard], mark: str = "guards"
) -> None:
    """Write the table of guards into a page, between two marks of that name."""
    file = PAGES / page
    before, begin, rest = file.read_text(encoding="utf-8").partition(f"<!-- {mark} -->\n")
    _, end, after = rest.partition(f"<!-- end of {mark} -->")
    if not (begin and end):
        raise ValueError(f"{file} has no marks of the name {mark!r}")
    lines = (f"{line}\n" for line in table(measure(score, range(clusters), guards)))
    file.write_text("".join((before, begin, *lines, end, after)), "utf-8")


def requested_number(description: str | None, default: int) -> int:
    """Return the number of clusters that the command line of a study requests."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("number", nargs="?", type=int, default=default)
    return int(parser.parse_args().number)
