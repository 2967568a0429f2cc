"""The report page of the stability benchmark."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from lidarops.bench.harness.benchmark import RESULT, facts
from lidarops.bench.harness.rows import Quantity, Row, Unit, rows_of, share_text, table
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
from lidarops.reports.benchmark_page import BenchmarkReport, Part

_PASSED: Final = "passed"
_KNOWN: Final = "known finding"
_FAILED: Final = "FAILED"
_PASSED_FINDING: Final = "passed, though listed as a finding"
_OF_RATE: Final = (
    Quantity("scenes", "scenes"),
    Quantity("values", "values"),
    *(
        Quantity(name, path, Unit.SHARE)
        for name, path in (
            ("not rejected", "kept"),
            ("false, random error", "false_random"),
            ("false, with systematic", "false"),
            ("and not uncertain", "false_undoubted"),
            ("of these undetectable", "false_hidden"),
            ("share of the detectable", "false_of_seen"),
            ("without any flag", "false_bare"),
            ("rejected but accurate", "fine_of_rejected"),
            ("needlessly flagged", "needless"),
        )
    ),
)


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


def stability_report(stability: Stability) -> BenchmarkReport:
    """Return the report page."""
    return BenchmarkReport(
        title="Stability: stiff and extreme cases, and false values without a flag",
        facts=(
            *facts(stability.date, stability.machine),
            ("CPU time", ", ".join(f"{s.what} {duration(s.seconds)}" for s in stability.spent)),
        ),
        parts=(_cases(stability.outcomes), *_rates(stability.rates)),
        data=RESULT,
    )


# Cases ----------------------------------------------------------------------------------------


def verdict(outcome: CaseOutcome) -> str:
    """Return the verdict on a case."""
    if outcome.finding:
        return _PASSED_FINDING if outcome.passed else _KNOWN
    return _PASSED if outcome.passed else _FAILED


def _cases(outcomes: tuple[CaseOutcome, ...]) -> Part:
    verdicts = {outcome: verdict(outcome) for outcome in outcomes}
    counts = [
        Row(name, "", word, sum(o.retrieval == name and verdicts[o] == word for o in outcomes))
        for name in dict.fromkeys(outcome.retrieval for outcome in outcomes)
        for word in (_PASSED, _KNOWN, _FAILED)
    ]
    rows = {
        outcome: [
            Row(outcome.retrieval, outcome.name, name, text)
            for name, text in (
                ("verdict", verdicts[outcome]),
                ("expected", outcome.expected),
                ("got", outcome.got),
                ("reason", outcome.finding),
            )
        ]
        for outcome in outcomes
    }
    unmet = [row for o in outcomes if not o.passed or o.finding for row in rows[o]]
    passed = sum(outcome.passed for outcome in outcomes)
    return Part(
        title="Stiff and extreme cases",
        text=f"{counted(len(outcomes), 'case')}, {passed:,} passed. A case expects a value "
        "within a tolerance of a known one (in closed form, or to 60 digits), a flag, or an error "
        "that names the field. Any other exception, and a warning, counts as a crash.",
        tables=(
            table("Cases by retrieval", counts, case="retrieval"),
            table("Cases that fail, and known findings", unmet, case="retrieval", method="case"),
        ),
        details=(
            table(
                "All cases",
                [row for group in rows.values() for row in group if row.quantity != "reason"],
                case="retrieval",
                method="case",
            ),
        ),
    )


# Rates ----------------------------------------------------------------------------------------


def _rates(rates: tuple[FalseValueRate, ...]) -> Iterator[Part]:
    for name in dict.fromkeys(rate.retrieval for rate in rates):
        own = [rate for rate in rates if rate.retrieval == name]
        first = own[0].quantity
        scenes = sum(rate.scenes for rate in own if (rate.quantity, rate.failure) == (first, ALL))
        ordered = sorted(own, key=lambda rate: (rate.quantity, rate.failure == ALL))
        yield Part(
            title=f"False values: {name}",
            text=f"{counted(scenes, 'random scene')}. A value is false if it differs from the "
            f"truth by more than {FALSE:g} stated standard errors. Targets for values that no "
            f"flag rejects: {share_text(SATISFIED)} where the model holds, by random errors alone; "
            f"{share_text(VIOLATED)} elsewhere, with the stated systematic errors, excluding "
            "values that flags mark as uncertain and violations that no test can reliably "
            f"detect. {_targets([rate for rate in own if rate.failure != ALL])}",
            tables=(
                table(
                    f"Values that differ by more than {FALSE:g} stated errors: {name}",
                    [row for rate in ordered for row in _rate_rows(rate)],
                    _NOTE,
                    case="quantity",
                    method="class",
                ),
            ),
        )


_NOTE: Final = (
    "In brackets: Monte Carlo standard error in the last digits, from independently drawn "
    "geometries. Not rejected: no flag rejects the value. Not uncertain: no flag marks the stated "
    "error as uncertain. Undetectable: the misfit of the violation is below "
    f"{VISIBLE:g} standard deviations of the noise. Even the best test that knows the shape of the "
    "violation, but not its sign, misses 7 % or more of these at our rate of false alarms (half at "
    "3.5 deviations). The target applies to the rest, as a share of all. Share of the detectable: "
    "false values among those whose violation is detectable but raised no flag. Target, undecided: "
    "the share exceeds it by less than 2 Monte Carlo errors. Rejected but accurate: differs by "
    f"less than {FINE:g} errors. Needlessly flagged: flagged although the value can be determined."
)


def _rate_rows(rate: FalseValueRate) -> Iterator[Row]:
    case, method = rate.quantity, rate.failure
    yield from rows_of(case, method, rate, _OF_RATE)
    yield Row(case, method, "target", goal(rate))
    yield Row(
        case, method, "detectable in the data", f"no: {rate.unseen}" if rate.unseen else "yes"
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


def goal(rate: FalseValueRate) -> str:
    """Return the targets of a rate with their verdicts."""
    target = f"{share_text(rate.target)} {rate.verdict}"
    if rate.needless_verdict is None or rate.needless_target is None:
        return target
    return f"{target}; needless {share_text(rate.needless_target)} {rate.needless_verdict}"
