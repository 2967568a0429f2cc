"""How right backgrounds and elastic inversions are, by the level of the background."""

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
from lidarops.bench.accuracy.homogeneous import (
    BackgroundScore,
    InversionScore,
    MonteCarloFigure,
    background_score,
    inversion_score,
)
from lidarops.bench.accuracy.homogeneous_report import (
    cost_part,
    elastic_throughput_report,
    facts,
)
from lidarops.bench.harness.terms import RESULT, Effort, Finding, Kind
from lidarops.bench.harness.timing import Machine, machine
from lidarops.bench.throughput.retrievals import StepCost, elastic_costs, measure_elastic
from lidarops.figures.charts import Chart, Panel, Series
from lidarops.figures.wording import percent
from lidarops.reports.benchmark_page import BenchmarkReport, Part, Table

DRAWS: Final = 5000
QUICK_DRAWS: Final = 1000
FEW: Final = 5
"""One in so many profiles is enough for `homogeneous`, which is slow: 2 percent of its error, 5 in
the quick run."""
BLOCK: Final = 200
"""Profiles that are simulated and solved at once."""
CLOSED_LEVELS: Final = (1.0, 1e4, 1e8)
_BATCH: Final = 400
_REPEATS: Final = 5
_QUICK_REPEATS: Final = 3


@dataclass(frozen=True, slots=True)
class Level:
    """What was found at one level of the background."""

    level: float
    """Counts a shot."""
    profiles: int
    least_error: float
    """Cramér-Rao bound of the background's standard error from 6 km on, counts."""
    backgrounds: Mapping[str, BackgroundScore]
    """By way; without those that reject all but one profile."""
    rejected: Mapping[str, float]
    """Share of profiles, by way."""
    inversions: Mapping[str, InversionScore]
    """By chain; without those that have values in less than two profiles."""


@dataclass(frozen=True, slots=True)
class ClosedLoop:
    """What is left where there is no noise."""

    level: float | None
    """Counts a shot; none where the background is known to be 0."""
    background: float
    """Error, counts."""
    bias: float
    """Mean error of backscatter from 0.5 to 6 km over its mean there."""
    largest: float
    """Largest error of a bin over the same mean."""


@dataclass(frozen=True, slots=True)
class PublishedProfileScore:
    """One way or chain on one published file."""

    way: str
    level: float
    background: float
    """Error, counts."""
    deviation: float
    """The same over stated standard errors."""
    truth_error: float
    """Standard error of the truth, counts."""
    inversion: InversionScore | None
    """None where no chain follows, or it has no value."""


@dataclass(frozen=True, slots=True)
class Elastic:
    """The accuracy benchmark of the elastic retrieval."""

    date: str
    machine: Machine
    levels: tuple[Level, ...]
    closed: tuple[ClosedLoop, ...]
    costs: tuple[StepCost, ...]
    published: tuple[PublishedProfileScore, ...]
    """Empty where no folder was given."""


def measure_elastic_accuracy(
    *,
    quick: bool = False,
    date: str = "",
    draws: int | None = None,
    data: Path | None = None,
    progress: Callable[[int], object] = lambda _: None,
) -> Elastic:
    """Find background and particles of simulated profiles at each level of the background.

    Parameters
    ----------
    quick : bool
        Fewer profiles.
    date : str
        When it is run, as it is to be stated.
    draws : int, optional
        Profiles of each level, at least 2.
    data : Path, optional
        Folder of the published files; see `lidarops.bench.accuracy.elastic_cases.published_profiles`.
    progress : callable
        Is given 1 after each level.

    Raises
    ------
    CampaignError, RawFormatError
        Where the published files cannot be read.
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
    sizes, few = enumerate(_sizes(draws)), draws / FEW
    blocks = [_block(sky, level, size, (seed, k), every=k * BLOCK < few) for k, size in sizes]
    found = {
        name: _join([block[0][name] for block in blocks if name in block[0]])
        for name in elastic_cases.background_methods()
    }
    errors = {
        name: np.concatenate([block[1][name] for block in blocks], axis=1)
        for name in elastic_cases.chains()
    }
    scores = {
        name: background_score(each.background - level, each.standard_error, each.rejected)
        for name, each in found.items()
    }
    inversions = {
        name: inversion_score(each[0], each[1], _scale(sky)) for name, each in errors.items()
    }
    return Level(
        level=level,
        profiles=draws,
        least_error=elastic_cases.least_error(sky, level),
        backgrounds={name: score for name, score in scores.items() if score is not None},
        rejected={name: float(each.rejected.mean()) for name, each in found.items()},
        inversions={name: score for name, score in inversions.items() if score is not None},
    )


def _sizes(draws: int) -> list[int]:
    whole, rest = divmod(draws, BLOCK)
    return [BLOCK] * whole + [rest] * (rest > 0)


def _block(
    sky: SimulatedSky, level: float, draws: int, seed: tuple[int, int], *, every: bool
) -> tuple[dict[str, BackgroundEstimates], dict[str, Array]]:
    """Return backgrounds by way, and errors and standard errors of backscatter by chain."""
    counts = sky.counts(level, draws, *seed)
    found = {
        name: way(counts, sky)
        for name, way in elastic_cases.background_methods().items()
        if every or name != elastic_cases.HOMOGENEOUS
    }
    errors = {}
    for name, chain in elastic_cases.chains().items():
        errors[name] = _errors(elastic_cases.invert(counts, sky, found[chain.way], chain), sky)
    return found, errors


def _errors(solved: Inverted, sky: SimulatedSky) -> Array:
    """Return (error or standard error, profile, compared bin)."""
    near = sky.compared
    return np.stack(
        [solved.backscatter[:, near] - sky.backscatter[near], solved.standard_error[:, near]]
    )


def _scale(sky: SimulatedSky) -> float:
    return float(sky.backscatter[sky.compared].mean())


def _join(parts: list[BackgroundEstimates]) -> BackgroundEstimates:
    return BackgroundEstimates(
        np.concatenate([part.background for part in parts]),
        np.concatenate([part.standard_error for part in parts]),
        np.concatenate([part.rejected for part in parts]),
    )


# Without noise, and published files -----------------------------------------------------------


def _closed(sky: SimulatedSky, level: float | None) -> ClosedLoop:
    counts = (sky.signal + (level or 0.0))[np.newaxis]
    known = BackgroundEstimates(np.zeros(1), np.zeros(1), np.zeros(1, dtype=np.bool_))
    # A window that is told, so that what is left is numerics and no choice.
    found = (
        known
        if level is None
        else elastic_cases.background_methods()[elastic_cases.TOLD](counts, sky)
    )
    solved = elastic_cases.particles_of(
        elastic_cases.cleared(counts, sky, found), sky, elastic_cases.GIVEN
    )
    near = sky.compared
    error = (solved.backscatter[0] - sky.backscatter)[near] / _scale(sky)
    return ClosedLoop(
        level,
        float(found.background[0]) - (level or 0.0),
        float(error.mean()),
        float(np.abs(error).max()),
    )


def _published(folder: Path) -> tuple[PublishedProfileScore, ...]:
    sky, files = elastic_cases.published_profiles(folder)
    return tuple(score for file in files for score in _file_scores(file, sky))


def _file_scores(file: elastic_cases.Published, sky: SimulatedSky) -> list[PublishedProfileScore]:
    found = {
        name: way(file.counts, sky) for name, way in elastic_cases.background_methods().items()
    }
    solved = {}
    for name, chain in elastic_cases.chains().items():
        inverted = elastic_cases.invert(file.counts, sky, found[chain.way], chain)
        error, stated = _errors(inverted, sky)
        solved[name] = inversion_score(error, stated, _scale(sky))
    rows = {name: (name, None) for name in found} | {
        name: (chain.way, solved[name]) for name, chain in elastic_cases.chains().items()
    }
    scores = []
    for name, (way, inversion) in rows.items():
        off = float(found[way].background[0]) - file.background
        scores.append(
            PublishedProfileScore(
                way=name,
                level=file.level,
                background=off,
                deviation=off / float(found[way].standard_error[0]),
                truth_error=file.background_error,
                inversion=inversion,
            )
        )
    return scores


# Pages ----------------------------------------------------------------------------------------

_DRAWN: Final = (elastic_cases.KNOWN_SHAPE, elastic_cases.TOLD, elastic_cases.TAIL_MEAN)
_NONE: Final = "-"


def run_elastic(kind: Kind, *, data: Path | None, effort: Effort) -> Finding:
    """Run a benchmark of the elastic retrieval.

    Parameters
    ----------
    kind : Kind
    data : Path, optional
        Folder of the published files, for the accuracy.
    effort : Effort

    Raises
    ------
    CampaignError
        Where the folder holds no such files.
    RawFormatError
        Where a published file cannot be read.
    """
    if kind is Kind.ACCURACY:
        found = measure_elastic_accuracy(
            quick=effort.quick, date=effort.date, data=data, progress=effort.progress
        )
        return Finding(found, elastic_accuracy_report(found, RESULT))
    timed = measure_elastic(
        quick=effort.quick, date=effort.date, repeats=effort.repeats, progress=effort.progress
    )
    return Finding(timed, elastic_throughput_report(timed, RESULT))


def elastic_accuracy_report(found: Elastic, data: str = "") -> BenchmarkReport:
    """Return the page of the accuracy benchmark."""
    parts = [_backgrounds(found), _inversions(found), _without_noise(found.closed)]
    if found.published:
        parts.append(_files(found.published))
    return BenchmarkReport(
        title="Elastic inversion: error against the level of the background",
        facts=facts(found.date, found.machine),
        parts=(*parts, cost_part(found.costs, elastic_cases.RANGE.size)),
        data=data,
    )


def _backgrounds(found: Elastic) -> Part:
    names = list(elastic_cases.background_methods())
    return Part(
        title="Background",
        text="Simulated as the EARLINET elastic intercomparison is: 532 nm, aerosol below 6 km "
        "(optical depth 1.4), 1005 bins of 15 m, means of 1000 shots with Poisson noise; "
        f"{found.levels[0].profiles:,} profiles a level, one in {FEW} of "
        "them for homogeneous. known_shape finds its window by itself "
        "or is told that air is clean from 6 km on; tail_mean averages the last tenth of the "
        "bins, and the signal there with them. The methods homogeneous and cubic are "
        "left out of the figure, as they are for paths along which nothing changes: from 6 km "
        "up, the thinning air passes for extinction, which puts their background off by a count "
        "or so however little noise there is, and one unknown more makes it scatter (folded "
        "tables, from 6 km on).",
        charts=(_background_chart(found),),
        tables=tuple(_background_table(found, name) for name in _DRAWN),
        details=tuple(_background_table(found, name) for name in names if name not in _DRAWN),
    )


def _background_chart(found: Elastic) -> Chart:
    scores = {
        name: [(at.level, at.backgrounds[name]) for at in found.levels if name in at.backgrounds]
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
        panels=_panels(drawn, "error of background (counts a shot)"),
    )


_CAPTION: Final = (
    "Root mean square error, and size of the mean error where it exceeds 2 Monte Carlo standard "
    "errors, the bars. Shaded: up to the stated standard error, on whose edge the full marks lie "
    "where errors are as stated."
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
            x_label="background (counts a shot)",
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
    told = [p for p in points if p.significant and abs(p.bias.value) > floor]
    sizes = [abs(p.bias.value) for p in told]
    bars = [2.0 * p.bias.error for p in told]
    return Series(
        "size of the mean error",
        tuple(p.level for p in told),
        tuple(sizes),
        tuple(max(size - bar, floor) for size, bar in zip(sizes, bars, strict=True)),
        tuple(size + bar for size, bar in zip(sizes, bars, strict=True)),
        hollow=True,
    )


def _background_table(found: Elastic, name: str) -> Table:
    rows = []
    for at in found.levels:
        score = at.backgrounds.get(name)
        cells = [_NONE] * 7 if score is None else _background_cells(score)
        rejected = percent(at.rejected[name])
        rows.append((_decade(at.level), *cells, f"{at.least_error:.3g}", rejected))
    return Table(
        title=f"Background by {name}, counts a shot",
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
        "error; mean and root mean square of the error over it, and share of profiles within 1 "
        "and 1.96 of it: 68.3 and 95 % where errors are as stated. Bound: Cramér-Rao, from 6 km "
        "on. Rejected profiles do not count.",
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


def _inversions(found: Elastic) -> Part:
    return Part(
        title="Backscatter",
        text="Backscatter of particles from 0.5 to 6 km, in percent of its mean there, with the "
        "true lidar ratio. The reference window is given, 7 to 8 km, or chosen out of windows "
        "of 1 km from 4 to 12 km, some of which hold a tenuous layer of up to 0.4 per Mm and sr; "
        "error carried: with 1.5 standard errors of the window stated as error of the "
        "reference, for particles that the noise hides. Bins that the inversion withholds do "
        "not count: where few are solved, those that are have been selected by their noise.",
        charts=(_inversion_chart(found),),
        tables=tuple(_inversion_table(found, name) for name in elastic_cases.chains()),
    )


def _inversion_chart(found: Elastic) -> Chart:
    scores = {
        name: [(at.level, at.inversions[name]) for at in found.levels if name in at.inversions]
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
        caption=f"{_CAPTION} Bins that have a value only.",
        panels=_panels(drawn, "error of backscatter (% of its mean)"),
    )


def _percents(figure: MonteCarloFigure) -> MonteCarloFigure:
    return MonteCarloFigure(100.0 * figure.value, 100.0 * figure.error)


def _inversion_table(found: Elastic, name: str) -> Table:
    rows = [(_decade(at.level), *_inversion_cells(at.inversions.get(name))) for at in found.levels]
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
    alone = score.profiles == 1
    bias = _percents(score.bias)
    return (
        percent(score.solved),
        f"{bias.value:+.3g}" if alone else _signed(bias),
        _NONE if alone else f"{100.0 * score.scatter:.3g}",
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
        text="What the method itself leaves: the signal is integrated by Gauss quadrature, the "
        "inversion and the shape of air by trapezoids over bins of 15 m.",
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
            _decade(one.level),
            one.way,
            f"{one.background:+.3g}",
            f"{one.deviation:+.2f}",
            f"{one.truth_error:.2g}",
        )
        for one in published
        if one.way in elastic_cases.background_methods()
    )
    inversions = tuple(
        (_decade(one.level), one.way, *_inversion_cells(one.inversion))
        for one in published
        if one.way in elastic_cases.chains()
    )
    return Part(
        title="Files of the intercomparison",
        text="The published files at 532 nm, one a level, lidar ratio 39 sr. The truth of a "
        "background is the fit of the noise-free signal to the same file, that of backscatter "
        "the inversion of the noise-free signal with the reference from 7 to 8 km. From 2.5 to "
        "5.5 km the set holds particles of 0.2 % of the air, which no test of shape finds in "
        "noise: a window chosen there is off by them.",
        tables=(
            Table(
                title="Background of published files, counts a shot",
                columns=("background", "way", "error", "error / stated", "truth known to"),
                rows=backgrounds,
            ),
            Table(
                title="Backscatter of published files, percent of its mean",
                columns=("background", "way", *_INVERSION_COLUMNS),
                rows=inversions,
                note="From 0.5 to 6 km, one profile a row: it has no scatter.",
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
