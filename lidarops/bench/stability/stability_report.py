"""The page of the stiff and extreme cases and of the false values."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from lidarops.bench.accuracy.homogeneous import MonteCarloFigure
from lidarops.bench.accuracy.homogeneous_report import facts
from lidarops.bench.harness.timing import Machine
from lidarops.bench.stability.random_scenes import (
    ALL,
    FALSE,
    FINE,
    SATISFIED,
    VIOLATED,
    VISIBLE,
    FalseValueRate,
    Verdict,
)
from lidarops.bench.stability.stiff_cases import CaseOutcome
from lidarops.figures.wording import counted, duration
from lidarops.reports.benchmark_page import BenchmarkReport, Part, Table

_NONE: Final = "-"
_PASSED: Final = "passed"
_KNOWN: Final = "known finding"
_FAILED: Final = "FAILED"
_MENDED: Final = "passed, though listed as a finding"


@dataclass(frozen=True, slots=True)
class PartCost:
    """CPU time of one part."""

    what: str
    seconds: float


@dataclass(frozen=True, slots=True)
class Stability:
    """What the benchmark found."""

    date: str
    machine: Machine
    outcomes: tuple[CaseOutcome, ...]
    rates: tuple[FalseValueRate, ...]
    spent: tuple[PartCost, ...]

    @property
    def failed(self) -> bool:
        """Whether a case went otherwise than it is known to."""
        return any(one.passed == bool(one.finding) for one in self.outcomes)


def stability_report(found: Stability, data: str = "") -> BenchmarkReport:
    """Return the page."""
    return BenchmarkReport(
        title="Stability: stiff and extreme cases, and false values without a flag",
        facts=(
            *facts(found.date, found.machine),
            ("CPU time", ", ".join(f"{s.what} {duration(s.seconds)}" for s in found.spent)),
        ),
        parts=(_cases(found.outcomes), *_rates(found.rates)),
        data=data,
    )


# Cases ----------------------------------------------------------------------------------------


def verdict(outcome: CaseOutcome) -> str:
    """Return what a case came to, in a word."""
    if outcome.finding:
        return _MENDED if outcome.passed else _KNOWN
    return _PASSED if outcome.passed else _FAILED


def _cases(outcomes: tuple[CaseOutcome, ...]) -> Part:
    names = tuple(dict.fromkeys(one.retrieval for one in outcomes))
    passed = sum(one.passed for one in outcomes)
    return Part(
        title="Stiff and extreme cases",
        text=f"{counted(len(outcomes), 'case')}, {passed:,} passed. A case asks for a value "
        "within a tolerance of one that is known (in closed form, or to 60 digits), for a flag, "
        "or for an error that names the field. Anything else that leaves, a warning too, counts "
        "as a crash.",
        tables=(_overview(outcomes, names), _unmet(outcomes)),
        details=tuple(_all_of(outcomes, name) for name in names),
    )


def _overview(outcomes: tuple[CaseOutcome, ...], names: tuple[str, ...]) -> Table:
    rows = []
    for name in names:
        words = [verdict(one) for one in outcomes if one.retrieval == name]
        shares = (str(words.count(word)) for word in (_PASSED, _KNOWN, _FAILED))
        rows.append((name, str(len(words)), *shares))
    return Table(
        title="Cases by retrieval",
        columns=("retrieval", "cases", "passed", "known findings", "failed"),
        rows=tuple(rows),
    )


def _unmet(outcomes: tuple[CaseOutcome, ...]) -> Table:
    return Table(
        title="Cases that do not come out as they should",
        columns=("case", "verdict", "expected", "got", "why"),
        rows=tuple(
            (f"{one.retrieval}: {one.name}", verdict(one), one.expected, one.got, one.finding)
            for one in outcomes
            if not one.passed or one.finding
        ),
    )


def _all_of(outcomes: tuple[CaseOutcome, ...], name: str) -> Table:
    return Table(
        title=f"All cases: {name}",
        columns=("case", "verdict", "expected", "got"),
        rows=tuple(
            (one.name, verdict(one), one.expected, one.got)
            for one in outcomes
            if one.retrieval == name
        ),
    )


# Rates ----------------------------------------------------------------------------------------


def _rates(rates: tuple[FalseValueRate, ...]) -> Iterator[Part]:
    for name in dict.fromkeys(one.retrieval for one in rates):
        own = [one for one in rates if one.retrieval == name]
        scenes = sum(one.scenes for one in own if one.quantity == own[0].quantity
                     and one.failure == ALL)  # fmt: skip
        yield Part(
            title=f"False values: {name}",
            text=f"{counted(scenes, 'random scene')}. A value is false where it is off by more "
            f"than {FALSE:g} stated standard errors. Targets: {_percent(SATISFIED)} of what no "
            f"flag rejects where the model holds, by random errors alone; {_percent(VIOLATED)} "
            "elsewhere, with the declared systematic errors, without values that the "
            "retrieval's own flags doubt and without violations that, as measured, no test can be "
            f"relied on to see. {_told([one for one in own if one.failure != ALL])}",
            tables=(_table(name, own),),
        )


def _told(rates: list[FalseValueRate]) -> str:
    """Say which classes miss their targets, and of which so few scenes do not tell."""
    parts = []
    for verdict, words in ((Verdict.MISSED, "Missed"), (Verdict.UNTOLD, "Not told by so few")):
        names = [
            f"{one.failure} ({one.quantity})"
            for one in rates
            if verdict in {one.verdict, one.needless_verdict}
        ]
        if names:
            parts.append(f"{words}: {', '.join(names)}.")
    return " ".join(parts) or "All targets are met."


def _table(name: str, rates: list[FalseValueRate]) -> Table:
    ordered = sorted(rates, key=lambda one: (one.quantity, one.failure == ALL))
    return Table(
        title=f"Values off by more than {FALSE:g} stated errors: {name}",
        columns=(
            "class",
            "quantity",
            "scenes",
            "values",
            "not rejected",
            "false, random error",
            "false, with systematic",
            "and not doubted",
            "of these not to be seen",
            "share of what could be seen",
            "without any bit",
            "fine of the rejected",
            "needlessly flagged",
            "target",
            "seen in the data",
        ),
        rows=tuple(_row(one) for one in ordered),
        note="In brackets: Monte Carlo standard error in the last digits, of geometries drawn "
        "independently. Not rejected: no bit that says not to use the value. Not doubted: no "
        "flag of the retrieval that doubts the stated error. Not to be seen: what the model cannot "
        f"take up of the violation is less than {VISIBLE:g} standard deviations of the noise, so "
        "that even the best test that knows its very shape, though not its sign, misses 7 % "
        "or more of such at our rate of false alarms (of 3.5 deviations, half); the target is for "
        "the rest, as a share of all. Share of what could be seen: false ones among the few "
        "values alone whose violation could be seen and still raised no flag. "
        "Target: not told by so few where the share is above it by less than 2 Monte Carlo errors. "
        f"Fine of the rejected, and needlessly flagged: off by less than {FINE:g}, and "
        "flagged though the value could be determined.",
    )


def _row(one: FalseValueRate) -> tuple[str, ...]:
    return (
        one.failure,
        one.quantity,
        f"{one.scenes:,}",
        f"{one.values:,}",
        percent_with_error(one.kept),
        percent_with_error(one.false_random),
        percent_with_error(one.false),
        percent_with_error(one.false_undoubted),
        _NONE if one.false_hidden is None else percent_with_error(one.false_hidden),
        _NONE if one.false_of_seen is None else percent_with_error(one.false_of_seen),
        _NONE if one.false_bare is None else percent_with_error(one.false_bare),
        percent_with_error(one.fine_of_rejected),
        _NONE if one.needless is None else percent_with_error(one.needless),
        _goal(one),
        f"no: {one.unseen}" if one.unseen else "yes",
    )


def _goal(one: FalseValueRate) -> str:
    goal = f"{_percent(one.target)} {one.verdict}"
    if one.needless_verdict is None or one.needless_target is None:
        return goal
    return f"{goal}; needless {_percent(one.needless_target)} {one.needless_verdict}"


def _percent(share: float) -> str:
    return f"{100.0 * share:g} %"


def percent_with_error(share: MonteCarloFigure) -> str:
    """Return a share in percent with its Monte Carlo error in the last digits."""
    value, error = 100.0 * share.value, 100.0 * share.error
    if error <= 0.0:
        return f"{value:.3g} %"
    digits = next((n for n in range(6) if error * 10**n >= 1.0), 6)
    return f"{value:.{digits}f}({error * 10**digits:.0f}) %"
