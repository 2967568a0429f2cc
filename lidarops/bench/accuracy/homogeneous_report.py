"""Report page of the accuracy on homogeneous paths."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from lidarops.bench.accuracy.homogeneous import Accuracy, Offset, outcomes_of
from lidarops.bench.accuracy.homogeneous_cases import QUANTITIES
from lidarops.bench.harness.benchmark import study_page
from lidarops.bench.harness.rows import (
    CPU_TIME,
    Quantity,
    Row,
    Unit,
    chart,
    error_against_time,
    figure_row,
    panel,
    rows_of,
    table,
)
from lidarops.reports.benchmark_page import BenchmarkReport, Part
from lidarops.retrieve.homogeneous.path_fit import HomogeneousMethod

_HELPED: Final = frozenset(
    {
        HomogeneousMethod.LINEARIZED,
        HomogeneousMethod.KNOWN_BACKGROUND,
        HomogeneousMethod.KNOWN_EXTINCTION,
    }
)
"""Methods that are given more than the profile."""
_PUBLISHED: Final = {1e3: 10.6, 4e3: 6.5, 6e3: 1.5, 8e3: 1.2}
"""bobrovsky2024, table 1, less an assumed truth of 37.00, over an assumed noise of 0.1."""
_RMSE: Final = "RMSE over bound"
_DISTANCE: Final = "distance over bound"
_DIFFICULTY: Final = "difficulty"
_LENGTH: Final = "length of the section (km)"
_OF_PATH: Final = (
    *(
        Quantity(f"{quantity.replace('_', ' ')}: {name}", f"scores.{quantity}.{path}", unit)
        for quantity in QUANTITIES
        for name, path, unit in (
            ("RMSE", "rmse", Unit.NUMBER),
            ("bias", "bias", Unit.NUMBER),
            ("95 %", "coverage", Unit.SHARE),
        )
    ),
    Quantity("flagged", "flagged", Unit.SHARE),
    Quantity("rejected", "rejected", Unit.SHARE),
    Quantity(CPU_TIME, "nanoseconds", Unit.TIME),
)
_OF_OFFSET: Final = (
    Quantity("lag 1", "lag_1"),
    Quantity("compressed", "compressed"),
    Quantity("scatter", "scatter"),
    Quantity("expected", "expected"),
    Quantity("flagged", "flagged", Unit.SHARE),
)


def homogeneous_accuracy_report(result: Accuracy) -> BenchmarkReport:
    """Return the page of the accuracy benchmark."""
    return study_page(
        "Homogeneous path: error against the Cramér-Rao bound",
        result,
        _overview(result),
        _offsets(result),
    )


def _overview(result: Accuracy) -> Part:
    summary, paths = list(_summary(result)), list(_paths(result))
    complete = {row.method for row in summary if row.quantity == "solved" and row.value == "all"}
    hollow = {row.method for row in summary if row.method not in complete} | _HELPED
    drawn = [row for row in paths if row.method in {"compressed", "direct", "cubic"}]
    first = result.cases[0].outcomes
    return Part(
        title="Error against time",
        text=f"{len(result.cases)} paths of 225 bins through white noise, from 2.5 or 10.5 km over "
        "1.7 or 8 km, extinction 0.01 to 5 per km, signal 15 to 100 000 times the noise, "
        f"background 370; {first[0].profiles:,} profiles each, fewer for scipy. The bound is the "
        "inverse Fisher matrix of background, amplitude and extinction. The amplitude is the "
        "signal extrapolated to range zero; its logarithm is compared. Profiles that a method "
        "rejects do not count for its error. The iterative peers start from the true background "
        "and amplitude and 0.8 of the true extinction. Distance: largest difference from the "
        "solution of the direct method. Difficulty: least standard error of extinction over "
        "extinction + 1 / mean range.",
        charts=(
            error_against_time("work-precision", summary, _RMSE, hollow=hollow, level=1.0),
            error_against_time("convergence", summary, _DISTANCE, hollow=hollow, gain=1.0),
            chart(
                "difficulty",
                "Error against difficulty",
                "RMSE over the Cramér-Rao bound of each path, with bars of 2 Monte Carlo standard "
                "errors.",
                tuple(
                    panel(
                        quantity.name.split(":")[0],
                        drawn,
                        quantity.name,
                        x=_DIFFICULTY,
                        hollow={HomogeneousMethod.DIRECT},
                        level=1.0,
                    )
                    for quantity in _OF_PATH
                    if quantity.name.endswith("RMSE")
                ),
            ),
        ),
        tables=(
            table(
                "All paths",
                summary,
                "Median over the paths of RMSE and of the distance, over the bound; RMSE and bias "
                "of the worst path; least and largest coverage of the 95 percent interval; mean "
                "shares of flagged and rejected profiles. In brackets the Monte Carlo standard "
                "error in the last digits; the worst of many paths exceeds the typical one by two "
                "or three of these errors.",
                case="error of",
            ),
        ),
        details=tuple(
            table(
                f"{outcome.method}, path by path",
                [row for row in paths if row.method == outcome.method],
                f"{outcome.profiles:,} profiles per path. RMSE and bias over the bound.",
                case="path",
            )
            for outcome in first
        ),
    )


def _summary(result: Accuracy) -> Iterator[Row]:
    for quantity in QUANTITIES:
        case = quantity.replace("_", " ")
        for method in (outcome.method for outcome in result.cases[0].outcomes):
            outcomes = [outcome for _, outcome in outcomes_of(result, method)]
            scores = [o.scores[quantity] for o in outcomes if quantity in o.scores]
            distances = [o.distances[quantity] for o in outcomes if o.distances.get(quantity)]
            every = len(scores) == len(outcomes)
            yield Row(case, method, "solved", "all" if every else f"{len(scores):,}")
            if scores:
                errors = sorted((score.rmse for score in scores), key=lambda m: m.value)
                coverage = sorted((score.coverage for score in scores), key=lambda m: m.value)
                bias = max((score.bias for score in scores), key=lambda m: abs(m.value))
                yield figure_row(case, method, Quantity(_RMSE, ""), errors[len(errors) // 2])
                yield figure_row(case, method, Quantity("worst", ""), errors[-1])
                yield figure_row(case, method, Quantity("bias", ""), bias)
                yield figure_row(case, method, Quantity("95 %", "", Unit.SHARE), coverage[0])
                yield figure_row(case, method, Quantity("to", "", Unit.SHARE), coverage[-1])
            if distances:
                yield Row(case, method, _DISTANCE, float(np.median(distances)))
            for name in ("flagged", "rejected"):
                share = float(np.mean([getattr(outcome, name) for outcome in outcomes]))
                yield Row(case, method, name, share, unit=Unit.SHARE)
            spent = float(np.median([outcome.nanoseconds for outcome in outcomes]))
            yield Row(case, method, CPU_TIME, spent, unit=Unit.TIME)


def _paths(result: Accuracy) -> Iterator[Row]:
    for case in result.cases:
        for outcome in case.outcomes:
            label = case.scenario.label
            yield Row(label, outcome.method, _DIFFICULTY, case.difficulty)
            yield from rows_of(label, outcome.method, outcome, _OF_PATH)


def _offsets(result: Accuracy) -> Part:
    rows = [row for offset in result.offsets for row in _offset_rows(offset)]
    kinds = {
        "single profiles": [o for o in result.offsets if o.averaged == 1],
        "means of profiles": [o for o in result.offsets if o.averaged > 1],
    }
    return Part(
        title="Background of the published cubic",
        text="Tables 1 and 2 of bobrovsky2024 give a background that decreases with the length of "
        "the section. This is due to noise: with a lag of one bin and no correction for the "
        "noise, the cubic counts part of the signal as background, however many profiles are "
        "averaged. The tables do not state the signal; 17 times the noise at 2.5 km, 15 m bins "
        "and 0.03 per km are assumed. The remaining error of the compressed method is the bias "
        "of all least-squares solutions to second order in the noise; averaging removes it.",
        charts=(
            chart(
                "offsets",
                "Mean error of the background, sections from 2.5 km",
                "In units of the noise of a profile, of all profiles, flagged or not. Published: "
                "table 1 less an assumed truth of 37.00, over an assumed noise of 0.10; its entry "
                "at 4 km is not reproduced.",
                tuple(
                    panel(
                        title,
                        [row for o in offsets if o.start < 5e3 for row in _offset_rows(o)],
                        ("lag 1", "compressed", "published"),
                        x=_LENGTH,
                        joined=True,
                        hollow={"published"},
                        logarithmic=(False, False),
                        level=0.0,
                    )
                    for title, offsets in kinds.items()
                ),
            ),
        ),
        tables=(
            table(
                "Mean error of the background, in units of the noise of one profile",
                rows,
                "Mean error and, in brackets, its standard error: of the cubic with a lag of one "
                "bin, and of the compressed method with its scatter. Expected: second-order bias "
                "of least squares, not meaningful where it exceeds the scatter.",
                case="section",
                method="mean of",
            ),
        ),
    )


def _offset_rows(offset: Offset) -> Iterator[Row]:
    case, method = f"{offset.start / 1e3:g} + {offset.length / 1e3:g} km", f"{offset.averaged}"
    yield Row(case, method, _LENGTH, offset.length / 1e3)
    yield from rows_of(case, method, offset, _OF_OFFSET)
    if offset.start < 5e3:
        yield Row(case, method, "published", _PUBLISHED.get(offset.length))
