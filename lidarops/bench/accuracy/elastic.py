"""Accuracy of backgrounds and elastic inversions, by the level of the background."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from lidarops.bench.accuracy import elastic_cases
from lidarops.bench.accuracy.elastic_cases import (
    Array,
    BackgroundEstimates,
    Inverted,
    SimulatedSky,
)
from lidarops.bench.accuracy.elastic_costs import cost_part, elastic_costs
from lidarops.bench.accuracy.homogeneous import (
    BackgroundScore,
    InversionScore,
    MonteCarloFigure,
    background_score,
    inversion_score,
)
from lidarops.bench.harness.benchmark import facts
from lidarops.bench.harness.timing import Machine, StepCost, machine
from lidarops.figures.charts import Chart, Panel, Series
from lidarops.figures.wording import percent
from lidarops.reports.benchmark_page import BenchmarkReport, Part, Table

DRAWS: Final = 5000
QUICK_DRAWS: Final = 1000
SLOW_SHARE: Final = 5
"""One in this many profiles is processed by `homogeneous`, which is slow. Its Monte Carlo error is
2 percent, 5 in a quick run."""
BLOCK: Final = 200
"""Profiles simulated and solved together."""
CLOSED_LEVELS: Final = (1.0, 1e4, 1e8)
_BATCH: Final = 400
_REPEATS: Final = 5
_QUICK_REPEATS: Final = 3


@dataclass(frozen=True, slots=True)
class Level:
    """Scores at one level of the background."""

    level: float
    """Counts per shot."""
    profiles: int
    least_error: float
    """Cramér-Rao bound of the background's standard error from 6 km on, counts."""
    backgrounds: Mapping[str, BackgroundScore]
    """By method; without those that reject all but one profile."""
    rejected: Mapping[str, float]
    """Share of rejected profiles, by method."""
    inversions: Mapping[str, InversionScore]
    """By chain; without those with values in less than two profiles."""


@dataclass(frozen=True, slots=True)
class ClosedLoop:
    """Errors without noise."""

    level: float | None
    """Counts per shot; None if the background is known to be 0."""
    background: float
    """Error, counts."""
    bias: float
    """Mean error of backscatter from 0.5 to 6 km over its mean there."""
    largest: float
    """Largest error of a bin over the same mean."""


@dataclass(frozen=True, slots=True)
class PublishedProfileScore:
    """Score of one method or chain on one published file."""

    method: str
    level: float
    background: float
    """Error, counts."""
    deviation: float
    """The same over stated standard errors."""
    truth_error: float
    """Standard error of the truth, counts."""
    inversion: InversionScore | None
    """None for a method without chain, or a chain without value."""


@dataclass(frozen=True, slots=True)
class Elastic:
    """Result of the accuracy benchmark of the elastic retrieval."""

    date: str
    machine: Machine
    levels: tuple[Level, ...]
    closed: tuple[ClosedLoop, ...]
    costs: tuple[StepCost, ...]
    published: tuple[PublishedProfileScore, ...]
    """Empty if no folder was given."""


def measure_elastic_accuracy(
    *,
    quick: bool = False,
    date: str = "",
    draws: int | None = None,
    data: Path | None = None,
    progress: Callable[[int], object] = lambda _: None,
) -> Elastic:
    """Retrieve background and particles of simulated profiles at each level of the background.

    Parameters
    ----------
    quick : bool
        Fewer profiles.
    date : str
        Date stated in the result.
    draws : int, optional
        Profiles per level, at least 2.
    data : Path, optional
        Folder of the published files (`elastic_cases.read_published_profiles`).
    progress : callable
        Called with 1 after each level.

    Raises
    ------
    CampaignError, RawFormatError
        If the published files cannot be read.
    """
    published = _published(data) if data is not None else ()
    count = draws or (QUICK_DRAWS if quick else DRAWS)
    levels = []
    for seed, level in enumerate(elastic_cases.LEVELS):
        levels.append(_level(elastic_cases.simulated_sky(), level, count, seed))
        progress(1)
    return Elastic(
        date,
        machine(),
        tuple(levels),
        tuple(_closed(elastic_cases.simulated_sky(), level) for level in (None, *CLOSED_LEVELS)),
        tuple(elastic_costs(min(count, _BATCH), _QUICK_REPEATS if quick else _REPEATS)),
        published,
    )


def _level(sky: SimulatedSky, level: float, draws: int, seed: int) -> Level:
    sizes, slow_draws = enumerate(_sizes(draws)), draws / SLOW_SHARE
    blocks = [
        _block(sky, level, size, (seed, k), with_slow=k * BLOCK < slow_draws) for k, size in sizes
    ]
    estimates = {
        name: _join([block[0][name] for block in blocks if name in block[0]])
        for name in elastic_cases.background_methods()
    }
    errors = {
        name: np.concatenate([block[1][name] for block in blocks], axis=1)
        for name in elastic_cases.chains()
    }
    scores = {
        name: background_score(result.background - level, result.standard_error, result.rejected)
        for name, result in estimates.items()
    }
    inversions = {
        name: inversion_score(result[0], result[1], _scale(sky)) for name, result in errors.items()
    }
    return Level(
        level=level,
        profiles=draws,
        least_error=elastic_cases.least_error(sky, level),
        backgrounds={name: score for name, score in scores.items() if score is not None},
        rejected={name: float(result.rejected.mean()) for name, result in estimates.items()},
        inversions={name: score for name, score in inversions.items() if score is not None},
    )


def _sizes(draws: int) -> list[int]:
    full_blocks, rest = divmod(draws, BLOCK)
    return [BLOCK] * full_blocks + [rest] * (rest > 0)


def _block(
    sky: SimulatedSky, level: float, draws: int, seed: tuple[int, int], *, with_slow: bool
) -> tuple[dict[str, BackgroundEstimates], dict[str, Array]]:
    """Return backgrounds by method, and errors and standard errors of backscatter by chain."""
    counts = sky.counts(level, draws, *seed)
    estimates = {
        name: method(counts, sky)
        for name, method in elastic_cases.background_methods().items()
        if with_slow or name != elastic_cases.HOMOGENEOUS
    }
    errors = {}
    for name, chain in elastic_cases.chains().items():
        errors[name] = _errors(
            elastic_cases.invert(counts, sky, estimates[chain.method], chain), sky
        )
    return estimates, errors


def _errors(solved: Inverted, sky: SimulatedSky) -> Array:
    """Return (error or standard error, profile, compared bin)."""
    near = sky.compared
    return np.stack(
        [solved.backscatter[:, near] - sky.backscatter[near], solved.standard_error[:, near]]
    )


def _scale(sky: SimulatedSky) -> float:
    return float(sky.backscatter[sky.compared].mean())


def _join(blocks: list[BackgroundEstimates]) -> BackgroundEstimates:
    return BackgroundEstimates(
        np.concatenate([estimates.background for estimates in blocks]),
        np.concatenate([estimates.standard_error for estimates in blocks]),
        np.concatenate([estimates.rejected for estimates in blocks]),
    )


# Without noise, and published files -----------------------------------------------------------


def _closed(sky: SimulatedSky, level: float | None) -> ClosedLoop:
    counts = (sky.signal + (level or 0.0))[np.newaxis]
    no_background = BackgroundEstimates(np.zeros(1), np.zeros(1), np.zeros(1, dtype=np.bool_))
    # With a known clean range only numerical errors remain, none of the choice of a window.
    estimates = (
        no_background
        if level is None
        else elastic_cases.background_methods()[elastic_cases.KNOWN_CLEAN_RANGE](counts, sky)
    )
    solved = elastic_cases.invert_particles(
        elastic_cases.subtract_background(counts, sky, estimates), sky, elastic_cases.GIVEN_WINDOW
    )
    near = sky.compared
    error = (solved.backscatter[0] - sky.backscatter)[near] / _scale(sky)
    return ClosedLoop(
        level,
        float(estimates.background[0]) - (level or 0.0),
        float(error.mean()),
        float(np.abs(error).max()),
    )


def _published(folder: Path) -> tuple[PublishedProfileScore, ...]:
    sky, files = elastic_cases.read_published_profiles(folder)
    return tuple(score for file in files for score in _file_scores(file, sky))


def _file_scores(file: elastic_cases.Published, sky: SimulatedSky) -> list[PublishedProfileScore]:
    estimates = {
        name: method(file.counts, sky)
        for name, method in elastic_cases.background_methods().items()
    }
    solved = {}
    for name, chain in elastic_cases.chains().items():
        inverted = elastic_cases.invert(file.counts, sky, estimates[chain.method], chain)
        error, stated = _errors(inverted, sky)
        solved[name] = inversion_score(error, stated, _scale(sky))
    rows = {name: (name, None) for name in estimates} | {
        name: (chain.method, solved[name]) for name, chain in elastic_cases.chains().items()
    }
    scores = []
    for name, (method, inversion) in rows.items():
        error_of_background = float(estimates[method].background[0]) - file.background
        scores.append(
            PublishedProfileScore(
                method=name,
                level=file.level,
                background=error_of_background,
                deviation=error_of_background / float(estimates[method].standard_error[0]),
                truth_error=file.background_error,
                inversion=inversion,
            )
        )
    return scores


# Pages ----------------------------------------------------------------------------------------

_DRAWN: Final = (
    elastic_cases.KNOWN_SHAPE,
    elastic_cases.KNOWN_CLEAN_RANGE,
    elastic_cases.TAIL_MEAN,
)
_NONE: Final = "-"


def elastic_accuracy_report(accuracy: Elastic, data: str = "") -> BenchmarkReport:
    """Return the page of the accuracy benchmark."""
    chapters = [_backgrounds(accuracy), _inversions(accuracy), _without_noise(accuracy.closed)]
    if accuracy.published:
        chapters.append(_files(accuracy.published))
    return BenchmarkReport(
        title="Elastic inversion: error against the level of the background",
        facts=facts(accuracy.date, accuracy.machine),
        parts=(*chapters, cost_part(accuracy.costs, elastic_cases.RANGE.size)),
        data=data,
    )


def _backgrounds(accuracy: Elastic) -> Part:
    names = list(elastic_cases.background_methods())
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
        charts=(_background_chart(accuracy),),
        tables=tuple(_background_table(accuracy, name) for name in _DRAWN),
        details=tuple(_background_table(accuracy, name) for name in names if name not in _DRAWN),
    )


def _background_chart(accuracy: Elastic) -> Chart:
    scores = {
        name: [
            (level.level, level.backgrounds[name])
            for level in accuracy.levels
            if name in level.backgrounds
        ]
        for name in _DRAWN
    }
    drawn = {
        name: [_Drawn(level, score.rmse.value, score.bias, score.stated) for level, score in pairs]
        for name, pairs in scores.items()
    }
    return Chart(
        name="background",
        title="Error of the background against its level",
        caption=_CAPTION,
        panels=_panels(drawn, "error of background (counts per shot)"),
    )


_CAPTION: Final = (
    "Root mean square error, and size of the mean error where it exceeds 2 Monte Carlo standard "
    "errors (bars). Shaded: up to the stated standard error. Full marks on its edge mean that "
    "errors are as stated."
)


@dataclass(frozen=True, slots=True)
class _Drawn:
    """One level of one panel."""

    level: float
    rmse: float
    bias: MonteCarloFigure
    stated: float

    @property
    def significant(self) -> bool:
        return abs(self.bias.value) > 2.0 * self.bias.error


def _panels(drawn: Mapping[str, Sequence[_Drawn]], y_label: str) -> tuple[Panel, ...]:
    heights = [height for points in drawn.values() for p in points for height in (p.rmse, p.stated)]
    floor = 0.2 * min(heights, default=1.0)
    return tuple(
        Panel(
            title=name,
            x_label="background (counts per shot)",
            y_label="" if number else y_label,
            series=(_rmse_series(points, floor), _bias_series(points, floor)),
        )
        for number, (name, points) in enumerate(drawn.items())
    )


def _rmse_series(points: Sequence[_Drawn], floor: float) -> Series:
    return Series(
        "root mean square error, stated error shaded",
        tuple(p.level for p in points),
        tuple(p.rmse for p in points),
        tuple(floor for _ in points),
        tuple(p.stated for p in points),
        joined=True,
        band=True,
    )


def _bias_series(points: Sequence[_Drawn], floor: float) -> Series:
    significant = [p for p in points if p.significant and abs(p.bias.value) > floor]
    sizes = [abs(p.bias.value) for p in significant]
    bars = [2.0 * p.bias.error for p in significant]
    return Series(
        "size of the mean error",
        tuple(p.level for p in significant),
        tuple(sizes),
        tuple(max(size - bar, floor) for size, bar in zip(sizes, bars, strict=True)),
        tuple(size + bar for size, bar in zip(sizes, bars, strict=True)),
        hollow=True,
    )


def _background_table(accuracy: Elastic, name: str) -> Table:
    rows = []
    for level in accuracy.levels:
        score = level.backgrounds.get(name)
        cells = [_NONE] * 7 if score is None else _background_cells(score)
        rejected = percent(level.rejected[name])
        rows.append((_decade(level.level), *cells, f"{level.least_error:.3g}", rejected))
    return Table(
        title=f"Background by {name}, counts per shot",
        columns=(
            "background",
            "mean error",
            "RMSE",
            "stated",
            "mean / stated",
            "RMS / stated",
            "within 1",
            "within 1.96",
            "bound",
            "rejected",
        ),
        rows=tuple(rows),
        note="In brackets: Monte Carlo standard error of the last digits. Stated: median standard "
        "error. Mean and root mean square of the error over the stated one, and share of profiles "
        "within 1 and 1.96 stated errors: 68.3 and 95 % if errors are as stated. Bound: "
        "Cramér-Rao, above 6 km. Rejected profiles are excluded.",
    )


def _background_cells(score: BackgroundScore) -> list[str]:
    return [
        _signed(score.bias),
        f"{score.rmse.value:.3g}",
        f"{score.stated:.3g}",
        f"{score.deviation.value:+.2f}",
        f"{score.spread.value:.2f}",
        *(percent(share_.value) for share_ in score.coverage),
    ]


def _inversions(accuracy: Elastic) -> Part:
    return Part(
        title="Backscatter",
        text="Backscatter of particles from 0.5 to 6 km, in percent of its mean there, with the "
        "true lidar ratio. The reference window is given, 7 to 8 km, or chosen from windows of "
        "1 km between 4 and 12 km, some of which hold a tenuous layer of up to 0.4 per Mm and sr. "
        "Error carried: 1.5 standard errors of the window are stated as error of the reference, "
        "for particles hidden by noise. Bins without value are excluded: where few bins are "
        "solved, noise has selected them.",
        charts=(_inversion_chart(accuracy),),
        tables=tuple(_inversion_table(accuracy, name) for name in elastic_cases.chains()),
    )


def _inversion_chart(accuracy: Elastic) -> Chart:
    scores = {
        name: [
            (level.level, level.inversions[name])
            for level in accuracy.levels
            if name in level.inversions
        ]
        for name in elastic_cases.chains()
    }
    drawn = {
        name: [
            _Drawn(level, 100.0 * score.rmse.value, _percents(score.bias), 100.0 * score.stated)
            for level, score in pairs
        ]
        for name, pairs in scores.items()
    }
    return Chart(
        name="backscatter",
        title="Error of backscatter, 0.5 to 6 km, against the level of the background",
        caption=f"{_CAPTION} Only bins with a value.",
        panels=_panels(drawn, "error of backscatter (% of its mean)"),
    )


def _percents(figure: MonteCarloFigure) -> MonteCarloFigure:
    return MonteCarloFigure(100.0 * figure.value, 100.0 * figure.error)


def _inversion_table(accuracy: Elastic, name: str) -> Table:
    rows = [
        (_decade(level.level), *_inversion_cells(level.inversions.get(name)))
        for level in accuracy.levels
    ]
    return Table(
        title=f"Backscatter by {name}, percent of its mean",
        columns=("background", *_INVERSION_COLUMNS),
        rows=tuple(rows),
        note="Solved: share of bins with a value. Mean error and scatter of a profile; RMSE and "
        "stated standard error of a bin. Share of bins within 1 and 1.96 stated standard errors.",
    )


_INVERSION_COLUMNS: Final = (
    "solved",
    "mean error",
    "scatter",
    "RMSE",
    "stated",
    "within 1",
    "within 1.96",
)


def _inversion_cells(score: InversionScore | None) -> tuple[str, ...]:
    if score is None:
        return (_NONE,) * len(_INVERSION_COLUMNS)
    single = score.profiles == 1
    bias = _percents(score.bias)
    return (
        percent(score.solved),
        f"{bias.value:+.3g}" if single else _signed(bias),
        _NONE if single else f"{100.0 * score.scatter:.3g}",
        f"{100.0 * score.rmse.value:.3g}",
        f"{100.0 * score.stated:.3g}",
        *(percent(inside.value) for inside in score.coverage),
    )


def _without_noise(closed: tuple[ClosedLoop, ...]) -> Part:
    rows = tuple(
        (
            "none" if loop.level is None else _decade(loop.level),
            f"{loop.background:+.1e}",
            f"{100.0 * loop.bias:+.4f} %",
            f"{100.0 * loop.largest:.4f} %",
        )
        for loop in closed
    )
    return Part(
        title="Without noise",
        text="Errors of the method itself: the signal is integrated by Gauss quadrature, the "
        "inversion and the molecular shape by trapezoids over bins of 15 m.",
        tables=(
            Table(
                title="Closed loop without noise",
                columns=("background", "its error (counts)", "mean error", "largest error"),
                rows=rows,
                note="Of backscatter from 0.5 to 6 km, over its mean there.",
            ),
        ),
    )


def _files(published: tuple[PublishedProfileScore, ...]) -> Part:
    backgrounds = tuple(
        (
            _decade(score.level),
            score.method,
            f"{score.background:+.3g}",
            f"{score.deviation:+.2f}",
            f"{score.truth_error:.2g}",
        )
        for score in published
        if score.method in elastic_cases.background_methods()
    )
    inversions = tuple(
        (_decade(score.level), score.method, *_inversion_cells(score.inversion))
        for score in published
        if score.method in elastic_cases.chains()
    )
    return Part(
        title="Files of the intercomparison",
        text="The published files at 532 nm, one per level, lidar ratio 39 sr. The true background "
        "is the fit of the noise-free signal to the same file, the true backscatter the inversion "
        "of the noise-free signal with the reference from 7 to 8 km. From 2.5 to 5.5 km particles "
        "scatter 0.2 % of what air does, which no test of shape detects in noise. A window chosen "
        "there is biased by that amount.",
        tables=(
            Table(
                title="Background of published files, counts per shot",
                columns=("background", "method", "error", "error / stated", "error of the truth"),
                rows=backgrounds,
            ),
            Table(
                title="Backscatter of published files, percent of its mean",
                columns=("background", "method", *_INVERSION_COLUMNS),
                rows=inversions,
                note="From 0.5 to 6 km, one profile per row, so without scatter.",
            ),
        ),
    )


def _decade(level: float) -> str:
    return f"1e{round(math.log10(level))}"


def _signed(figure: MonteCarloFigure) -> str:
    """Return a figure with its error in the last digits."""
    if not figure.error > 0.0:
        return f"{figure.value:+.3g}"
    digits = max(-math.floor(math.log10(figure.error)), 0)
    return f"{figure.value:+.{digits}f}({figure.error * 10**digits:.0f})"
