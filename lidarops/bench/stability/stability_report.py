"""The report page of the stability benchmark."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from lidarops.bench.accuracy.homogeneous import MonteCarloFigure
from lidarops.bench.harness.benchmark import facts
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
_PASSED_FINDING: Final = "passed, though listed as a finding"


@dataclass(frozen=True, slots=True)
class PartCost:
    """CPU time of one part."""

    what: str
    seconds: float


@dataclass(frozen=True, slots=True)
class Stability:
    """Result of the stability benchmark."""

    date: str
    machine: Machine
    outcomes: tuple[CaseOutcome, ...]
    rates: tuple[FalseValueRate, ...]
    spent: tuple[PartCost, ...]

    @property
    def failed(self) -> bool:
        """Whether a case failed unexpectedly, or passed although a failure is known."""
        return any(outcome.passed == bool(outcome.finding) for outcome in self.outcomes)


def stability_report(stability: Stability, data: str = "") -> BenchmarkReport:
    """Return the report page."""
    return BenchmarkReport(
        title="Stability: stiff and extreme cases, and false values without a flag",
        facts=(
            *facts(stability.date, stability.machine),
            ("CPU time", ", ".join(f"{s.what} {duration(s.seconds)}" for s in stability.spent)),
        ),
        parts=(_cases(stability.outcomes), *_rates(stability.rates)),
        data=data,
    )


# Cases ----------------------------------------------------------------------------------------


def verdict(outcome: CaseOutcome) -> str:
    """Return the verdict on a case."""
    if outcome.finding:
        return _PASSED_FINDING if outcome.passed else _KNOWN
    return _PASSED if outcome.passed else _FAILED


def _cases(outcomes: tuple[CaseOutcome, ...]) -> Part:
    names = tuple(dict.fromkeys(outcome.retrieval for outcome in outcomes))
    passed = sum(outcome.passed for outcome in outcomes)
    return Part(
        title="Stiff and extreme cases",
        text=f"{counted(len(outcomes), 'case')}, {passed:,} passed. A case expects a value "
        "within a tolerance of a known one (in closed form, or to 60 digits), a flag, or an error "
        "that names the field. Any other exception, and a warning, counts as a crash.",
        tables=(_overview(outcomes, names), _unmet(outcomes)),
        details=tuple(_all_of(outcomes, name) for name in names),
    )


def _overview(outcomes: tuple[CaseOutcome, ...], names: tuple[str, ...]) -> Table:
    rows = []
    for name in names:
        words = [verdict(outcome) for outcome in outcomes if outcome.retrieval == name]
        shares = (str(words.count(word)) for word in (_PASSED, _KNOWN, _FAILED))
        rows.append((name, str(len(words)), *shares))
    return Table(
        title="Cases by retrieval",
        columns=("retrieval", "cases", "passed", "known findings", "failed"),
        rows=tuple(rows),
    )


def _unmet(outcomes: tuple[CaseOutcome, ...]) -> Table:
    return Table(
        title="Cases that fail, and known findings",
        columns=("case", "verdict", "expected", "got", "reason"),
        rows=tuple(
            (
                f"{outcome.retrieval}: {outcome.name}",
                verdict(outcome),
                outcome.expected,
                outcome.got,
                outcome.finding,
            )
            for outcome in outcomes
            if not outcome.passed or outcome.finding
        ),
    )


def _all_of(outcomes: tuple[CaseOutcome, ...], name: str) -> Table:
    return Table(
        title=f"All cases: {name}",
        columns=("case", "verdict", "expected", "got"),
        rows=tuple(
            (outcome.name, verdict(outcome), outcome.expected, outcome.got)
            for outcome in outcomes
            if outcome.retrieval == name
        ),
    )


# Rates ----------------------------------------------------------------------------------------


def _rates(rates: tuple[FalseValueRate, ...]) -> Iterator[Part]:
    for name in dict.fromkeys(rate.retrieval for rate in rates):
        own = [rate for rate in rates if rate.retrieval == name]
        first = own[0].quantity
        scenes = sum(rate.scenes for rate in own if (rate.quantity, rate.failure) == (first, ALL))
        yield Part(
            title=f"False values: {name}",
            text=f"{counted(scenes, 'random scene')}. A value is false if it differs from the "
            f"truth by more than {FALSE:g} stated standard errors. Targets for values that no "
            f"flag rejects: {_percent(SATISFIED)} where the model holds, by random errors alone; "
            f"{_percent(VIOLATED)} elsewhere, with the stated systematic errors, excluding "
            "values that flags mark as uncertain and violations that no test can reliably "
            f"detect. {_targets([rate for rate in own if rate.failure != ALL])}",
            tables=(_table(name, own),),
        )


def _targets(rates: list[FalseValueRate]) -> str:
    """Return which classes miss their targets, and for which that is undecided."""
    sentences = []
    for verdict, words in ((Verdict.MISSED, "Missed"), (Verdict.UNDECIDED, "Undecided")):
        names = [
            f"{rate.failure} ({rate.quantity})"
            for rate in rates
            if verdict in {rate.verdict, rate.needless_verdict}
        ]
        if names:
            sentences.append(f"{words}: {', '.join(names)}.")
    return " ".join(sentences) or "All targets are met."


def _table(name: str, rates: list[FalseValueRate]) -> Table:
    ordered = sorted(rates, key=lambda rate: (rate.quantity, rate.failure == ALL))
    return Table(
        title=f"Values that differ by more than {FALSE:g} stated errors: {name}",
        columns=(
            "class",
            "quantity",
            "scenes",
            "values",
            "not rejected",
            "false, random error",
            "false, with systematic",
            "and not uncertain",
            "of these undetectable",
            "share of the detectable",
            "without any flag",
            "rejected but accurate",
            "needlessly flagged",
            "target",
            "detectable in the data",
        ),
        rows=tuple(_row(rate) for rate in ordered),
        note="In brackets: Monte Carlo standard error in the last digits, from independently "
        "drawn geometries. Not rejected: no flag rejects the value. Not uncertain: no flag marks "
        "the stated error as uncertain. Undetectable: the misfit of the violation is below "
        f"{VISIBLE:g} standard deviations of the noise. Even the best test that knows the shape "
        "of the violation, but not its sign, misses 7 % or more of these at our rate of false "
        "alarms (half at 3.5 deviations). The target applies to the rest, as a share of all. "
        "Share of the detectable: false values among those whose violation is detectable but "
        "raised no flag. Target, undecided: the share exceeds it by less than 2 Monte Carlo "
        f"errors. Rejected but accurate: differs by less than {FINE:g} errors. Needlessly "
        "flagged: flagged although the value can be determined.",
    )


def _row(rate: FalseValueRate) -> tuple[str, ...]:
    return (
        rate.failure,
        rate.quantity,
        f"{rate.scenes:,}",
        f"{rate.values:,}",
        percent_with_error(rate.kept),
        percent_with_error(rate.false_random),
        percent_with_error(rate.false),
        percent_with_error(rate.false_undoubted),
        _NONE if rate.false_hidden is None else percent_with_error(rate.false_hidden),
        _NONE if rate.false_of_seen is None else percent_with_error(rate.false_of_seen),
        _NONE if rate.false_bare is None else percent_with_error(rate.false_bare),
        percent_with_error(rate.fine_of_rejected),
        _NONE if rate.needless is None else percent_with_error(rate.needless),
        _goal(rate),
        f"no: {rate.unseen}" if rate.unseen else "yes",
    )


def _goal(rate: FalseValueRate) -> str:
    goal = f"{_percent(rate.target)} {rate.verdict}"
    if rate.needless_verdict is None or rate.needless_target is None:
        return goal
    return f"{goal}; needless {_percent(rate.needless_target)} {rate.needless_verdict}"


def _percent(share: float) -> str:
    return f"{100.0 * share:g} %"


def percent_with_error(share: MonteCarloFigure) -> str:
    """Return a share in percent with its Monte Carlo error in the last digits."""
    value, error = 100.0 * share.value, 100.0 * share.error
    if error <= 0.0:
        return f"{value:.3g} %"
    digits = next((n for n in range(6) if error * 10**n >= 1.0), 6)
    return f"{value:.{digits}f}({error * 10**digits:.0f}) %"
