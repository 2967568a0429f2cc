"""Report page of the accuracy of backgrounds and elastic inversions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from lidarops.bench.accuracy import elastic_cases
from lidarops.bench.accuracy.elastic import SLOW_SHARE, Elastic
from lidarops.bench.harness.benchmark import study_page
from lidarops.bench.harness.rows import (
    Quantity,
    Row,
    Unit,
    chart,
    cost_part,
    panel,
    rows_of,
    step_rows,
    table,
)
from lidarops.bench.harness.timing import StepCost
from lidarops.figures.charts import Chart
from lidarops.reports.benchmark_page import BenchmarkReport, Part

_LEVEL: Final = "background (counts per shot)"
_DRAWN: Final = (
    elastic_cases.KNOWN_SHAPE,
    elastic_cases.KNOWN_CLEAN_RANGE,
    elastic_cases.TAIL_MEAN,
)
_WITHIN: Final = (
    Quantity("within 1", "coverage.0", Unit.SHARE),
    Quantity("within 1.96", "coverage.1", Unit.SHARE),
)
_BACKGROUND: Final = (
    Quantity("mean error", "bias"),
    Quantity("RMSE", "rmse"),
    Quantity("stated", "stated"),
    Quantity("mean / stated", "deviation"),
    Quantity("RMS / stated", "spread"),
    *_WITHIN,
)
_INVERSION: Final = (
    Quantity("solved", "solved", Unit.SHARE),
    Quantity("mean error", "bias", Unit.SHARE),
    Quantity("scatter", "scatter", Unit.SHARE),
    Quantity("RMSE", "rmse", Unit.SHARE),
    Quantity("stated", "stated", Unit.SHARE),
    *_WITHIN,
)
_CLOSED: Final = (
    Quantity("its error (counts)", "background"),
    Quantity("mean error", "bias", Unit.SHARE),
    Quantity("largest error", "largest", Unit.SHARE),
)
_OF_FILE: Final = (
    Quantity("error", "background"),
    Quantity("error / stated", "deviation"),
    Quantity("error of the truth", "truth_error"),
)
_CAPTION: Final = (
    "Root mean square error, with bars of 2 Monte Carlo standard errors, and stated standard error "
    "(hollow). Where they agree, errors are as stated."
)


def elastic_accuracy_report(accuracy: Elastic) -> BenchmarkReport:
    """Return the page of the accuracy benchmark."""
    parts = [_backgrounds(accuracy), _inversions(accuracy), _without_noise(accuracy)]
    if accuracy.published:
        parts.append(_files(accuracy))
    return study_page(
        "Elastic inversion: error against the level of the background",
        accuracy,
        *parts,
        elastic_cost_part(accuracy.costs),
    )


def _backgrounds(accuracy: Elastic) -> Part:
    rows = {
        name: [
            row
            for level in accuracy.levels
            for row in (
                *rows_of(_decade(level.level), name, level.backgrounds.get(name), _BACKGROUND),
                Row(_decade(level.level), name, "bound", level.least_error),
                Row(_decade(level.level), name, "rejected", level.rejected[name], unit=Unit.SHARE),
            )
        ]
        for name in elastic_cases.background_methods()
    }
    tables = {
        name: table(
            f"Background by {name}, counts per shot",
            group,
            "In brackets: Monte Carlo standard error of the last digits. Stated: median standard "
            "error. Mean and root mean square of the error over the stated one, and share of "
            "profiles within 1 and 1.96 stated errors: 68.3 and 95 % if errors are as stated. "
            "Bound: Cramér-Rao, above 6 km. Rejected profiles are excluded.",
            case="background",
        )
        for name, group in rows.items()
    }
    return Part(
        title="Background",
        text="Simulated like the EARLINET elastic intercomparison: 532 nm, aerosol below 6 km "
        "(optical depth 1.4), 1005 bins of 15 m, means of 1000 shots with Poisson noise; "
        f"{accuracy.levels[0].profiles:,} profiles per level, one in {SLOW_SHARE} of them for "
        "homogeneous. known_shape selects its window, or knows that the air is clean above 6 km. "
        "tail_mean averages the last tenth of the bins, including the signal there. The methods "
        "homogeneous and cubic are not in the figure, because they assume a homogeneous path. "
        "Above 6 km the decreasing air density looks like extinction, which biases their "
        "background by about one count for any noise, and the additional unknown increases its "
        "scatter (folded tables, above 6 km).",
        charts=(
            _level_chart(
                "background",
                "Error of the background against its level (counts per shot)",
                {name: rows[name] for name in _DRAWN},
            ),
        ),
        tables=tuple(tables[name] for name in _DRAWN),
        details=tuple(tables[name] for name in tables if name not in _DRAWN),
    )


def _inversions(accuracy: Elastic) -> Part:
    rows = {
        name: [
            row
            for level in accuracy.levels
            for row in rows_of(_decade(level.level), name, level.inversions.get(name), _INVERSION)
        ]
        for name in elastic_cases.chains()
    }
    return Part(
        title="Backscatter",
        text="Backscatter of particles from 0.5 to 6 km, in percent of its mean there, with the "
        "true lidar ratio. The reference window is given, 7 to 8 km, or chosen from windows of "
        "1 km between 4 and 12 km, some of which hold a tenuous layer of up to 0.4 per Mm and sr. "
        "Error carried: 1.5 standard errors of the window are stated as error of the reference, "
        "for particles hidden by noise. Bins without value are excluded: where few bins are "
        "solved, noise has selected them.",
        charts=(
            _level_chart("backscatter", "Error of backscatter, 0.5 to 6 km, by background", rows),
        ),
        tables=tuple(
            table(
                f"Backscatter by {name}, percent of its mean",
                group,
                "Solved: share of bins with a value. Mean error and scatter of a profile; RMSE and "
                "stated standard error of a bin. Share of bins within 1 and 1.96 stated standard "
                "errors.",
                case="background",
            )
            for name, group in rows.items()
        ),
    )


def _level_chart(name: str, title: str, rows: dict[str, list[Row]]) -> Chart:
    panels = tuple(
        panel(method, group, ("RMSE", "stated"), x=_LEVEL, joined=True, hollow={"stated"})
        for method, group in rows.items()
    )
    return chart(name, title, _CAPTION, panels)


def _without_noise(accuracy: Elastic) -> Part:
    rows = [
        row
        for loop in accuracy.closed
        for row in rows_of("none" if loop.level is None else _decade(loop.level), "", loop, _CLOSED)
    ]
    return Part(
        title="Without noise",
        text="Errors of the method itself: the signal is integrated by Gauss quadrature, the "
        "inversion and the molecular shape by trapezoids over bins of 15 m.",
        tables=(
            table(
                "Closed loop without noise",
                rows,
                "Of backscatter from 0.5 to 6 km, over its mean there.",
                case="background",
            ),
        ),
    )


def _files(accuracy: Elastic) -> Part:
    backgrounds, inversions = [], []
    for score in accuracy.published:
        if score.method in elastic_cases.background_methods():
            backgrounds += rows_of(_decade(score.level), score.method, score, _OF_FILE)
        if score.method in elastic_cases.chains():
            inversions += rows_of(_decade(score.level), score.method, score.inversion, _INVERSION)
    return Part(
        title="Files of the intercomparison",
        text="The published files at 532 nm, one per level, lidar ratio 39 sr. The true background "
        "is the fit of the noise-free signal to the same file, the true backscatter the inversion "
        "of the noise-free signal with the reference from 7 to 8 km. From 2.5 to 5.5 km particles "
        "scatter 0.2 % of what air does, which no test of shape detects in noise. A window chosen "
        "there is biased by that amount.",
        tables=(
            table("Background of published files, counts per shot", backgrounds, case="background"),
            table(
                "Backscatter of published files, percent of its mean",
                inversions,
                "From 0.5 to 6 km, one profile per row, so without scatter.",
                case="background",
            ),
        ),
    )


def elastic_cost_part(costs: Sequence[StepCost]) -> Part:
    """Return the chapter on the CPU time of the steps, beside plain peers."""
    return cost_part(
        "elastic-time",
        f"Profiles of {elastic_cases.RANGE.size} bins, float64, one thread, least CPU time of "
        "interleaved repeats. Steps of lidarops compute all errors and flags; all steps: "
        "background, clouds, reference window and inversion with its error budget. The peers give "
        "values without errors: a weighted numpy.linalg.lstsq and a Klett inversion for each "
        "profile, in numpy and in plain Python.",
        step_rows(costs),
    )


def _decade(level: float) -> str:
    return f"1e{round(math.log10(level))}"
