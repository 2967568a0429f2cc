"""Accuracy of backgrounds and elastic inversions, by the level of the background."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from benchmarks.accuracy import elastic_cases
from benchmarks.accuracy.elastic_cases import BackgroundEstimates, SimulatedSky
from benchmarks.harness.benchmark import Effort
from benchmarks.harness.charts import chart, panel
from benchmarks.harness.costs import batch_label, cost_chapter, time_methods
from benchmarks.harness.drawing import Chart
from benchmarks.harness.figure import Array, Figure, Mask, cpu_time, share
from benchmarks.harness.rows import CPU_TIME, Row, Score, Scores, rows_of_scores
from benchmarks.harness.statistics import SIGMAS, mean, root, share_inside
from benchmarks.harness.study import Chapter, Results, Study, Work
from benchmarks.harness.timing import READ, affordable
from lidarops.retrieve.elastic.inversion import ElasticResult

DRAWS: Final = 5000
QUICK_DRAWS: Final = 1000
SLOW_SHARE: Final = 5
"""One in this many profiles is processed by `homogeneous`, which is slow."""
BLOCK: Final = 200
"""Profiles simulated and solved together."""
CLOSED_LEVELS: Final = (1.0, 1e4, 1e8)
ALL_STEPS: Final = "all steps"
TIMED_LEVEL: Final = 1e4
"""Background of the timed profiles, counts per shot."""
_BATCH: Final = 400
_REPEATS: Final = 5
_QUICK_REPEATS: Final = 3
_COMPARED: Final = (1e2, 1e5)
"""Backgrounds shown on the page of all retrievals, counts per shot."""
_CARRIED: Final = "chosen, error carried"
"""Chain of all steps."""
_WITHIN: Final = ("within 1", "within 1.96")


def measure_elastic_accuracy(
    effort: Effort, *, draws: int | None = None, data: Path | None = None
) -> Study:
    """Retrieve background and particles of simulated profiles at each level of the background.

    Parameters
    ----------
    effort : Effort
    draws : int, optional
        Profiles per level, at least 2.
    data : Path, optional
        Folder of the published files (`elastic_cases.read_published_profiles`).

    Raises
    ------
    CampaignError, RawFormatError
        If the published files cannot be read.
    """
    published = [] if data is None else [_files(*elastic_cases.read_published_profiles(data))]
    count = draws or (QUICK_DRAWS if effort.quick else DRAWS)
    sky = elastic_cases.simulated_sky()
    backgrounds: Scores = {}
    inversions: Scores = {}
    for seed, level in enumerate(elastic_cases.LEVELS):
        of_background, of_inversion = _level(sky, level, count, seed)
        backgrounds |= of_background
        inversions |= of_inversion
        effort.progress(1)
    repeats = _QUICK_REPEATS if effort.quick else _REPEATS
    costs = elastic_costs(min(count, _BATCH), repeats)
    closed = {
        ("none" if b is None else _decade(b), ""): _closed(sky, b) for b in (None, *CLOSED_LEVELS)
    }
    return Study(
        "Elastic inversion: error against the level of the background",
        effort.date,
        [
            _backgrounds(backgrounds, count),
            _inversions(inversions),
            _without_noise(closed),
            *published,
            elastic_cost_chapter(costs),
        ],
        _works(backgrounds, inversions, costs),
    )


def _level(sky: SimulatedSky, level: float, draws: int, seed: int) -> tuple[Scores, Scores]:
    """Return the scores of the backgrounds and of the inversions at one level."""
    estimates: dict[str, list[BackgroundEstimates]] = {}
    errors: dict[str, list[Array]] = {}
    for k, first in enumerate(range(0, draws, BLOCK)):
        counts = sky.counts(level, min(BLOCK, draws - first), seed, k)
        solved = {
            name: method(counts, sky)
            for name, method in elastic_cases.background_methods().items()
            if first < draws / SLOW_SHARE or name != elastic_cases.HOMOGENEOUS
        }
        for name, estimate in solved.items():
            estimates.setdefault(name, []).append(estimate)
        for name, chain in elastic_cases.chains().items():
            inverted = elastic_cases.invert(counts, sky, solved[chain.method], chain)
            errors.setdefault(name, []).append(_errors(inverted, sky))
    backgrounds: Scores = {}
    inversions: Scores = {}
    for name, blocks in estimates.items():
        error, stated, rejected = (
            np.concatenate([getattr(block, field) for block in blocks])
            for field in ("background", "standard_error", "rejected")
        )
        backgrounds[_decade(level), name] = {
            **background_score(error - level, stated, rejected),
            "bound": elastic_cases.least_error(sky, level),
            "rejected": share(float(rejected.mean())),
        }
    for name, chunks in errors.items():
        error, stated = np.concatenate(chunks, axis=1)
        inversions[_decade(level), name] = inversion_score(error, stated, _scale(sky))
    return backgrounds, inversions


def _errors(solved: ElasticResult, sky: SimulatedSky) -> Array:
    """Return (error or standard error, profile, compared bin)."""
    near = sky.compared
    error = solved.backscatter[:, near] - sky.backscatter[near]
    return np.stack([error, solved.backscatter_standard_error[:, near]])


def _scale(sky: SimulatedSky) -> float:
    return float(sky.backscatter[sky.compared].mean())


def background_score(error: Array, stated: Array, rejected: Mask) -> Score:
    """Return the errors of backgrounds; None where fewer than two are usable.

    Parameters
    ----------
    error, stated : (profile,) float
        Counts.
    rejected : (profile,) bool
    """
    names = ("mean error", "RMSE", "stated", "mean / stated", "RMS / stated", *_WITHIN)
    kept = ~rejected & np.isfinite(error) & (stated > 0)
    if kept.sum() < 2:
        return dict.fromkeys(names)
    error, stated = error[kept], stated[kept]
    deviation = error / stated
    values: tuple[Figure | float, ...] = (
        mean(error),
        root(mean(error**2)),
        float(np.median(stated)),
        mean(deviation),
        root(mean(deviation**2)),
        *(share_inside(np.abs(deviation) <= sigmas) for sigmas in SIGMAS),
    )
    return dict(zip(names, values, strict=True))


def inversion_score(error: Array, stated: Array, scale: float) -> Score:
    """Return the errors of backscatter; None where fewer than two of many profiles have a value.

    Parameters
    ----------
    error, stated : (profile, compared bin) float
        m-1 sr-1; NaN where withheld.
    scale : float
        Mean of the truth, m-1 sr-1.
    """
    names = ("solved", "mean error", "scatter", "RMSE", "stated", *_WITHIN)
    valid = np.isfinite(error) & np.isfinite(stated)
    kept = np.any(valid, axis=1)
    if kept.sum() < min(2, kept.size) or not np.any(kept):
        return dict.fromkeys(names)
    error, stated, valid = error[kept], stated[kept], valid[kept]
    bins = valid.sum(axis=1)

    def over_bins(values: npt.NDArray[np.generic]) -> Array:
        return np.asarray(np.where(valid, values, 0.0).sum(axis=1) / bins)

    biases = over_bins(error) / scale
    values: tuple[Figure | float, ...] = (
        float(bins.sum() / (kept.size * error.shape[1])),
        mean(biases),
        float(biases.std()),
        root(mean(over_bins((error / scale) ** 2))),
        float(np.sqrt(over_bins((stated / scale) ** 2).mean())),
        *(mean(over_bins(np.abs(error) <= sigmas * stated)) for sigmas in SIGMAS),
    )
    return dict(zip(names, map(share, values), strict=True))


def _works(backgrounds: Scores, inversions: Scores, costs: Sequence[Row]) -> list[Work]:
    times = {row.method: row.value for row in costs if row.quantity == CPU_TIME}
    works = []
    for level in _COMPARED:
        scores = {
            name: score for (case, name), score in backgrounds.items() if case == _decade(level)
        }
        scores |= {ALL_STEPS: inversions[_decade(level), _CARRIED]}
        for method, score in scores.items():
            error, coverage, spent = score["RMSE"], score[_WITHIN[1]], times.get(method)
            if not isinstance(error, Figure) or not isinstance(coverage, Figure):
                continue
            if isinstance(spent, float):
                works.append(
                    Work(
                        f"background of {level:.0f} counts",
                        "backscatter 0.5 to 6 km, relative"
                        if method == ALL_STEPS
                        else "background, counts",
                        method,
                        Figure(error.value, error.error),
                        coverage,
                        cpu_time(spent),
                        ours=method not in {elastic_cases.TAIL_MEAN, elastic_cases.LINEAR},
                        informed=method == elastic_cases.KNOWN_CLEAN_RANGE,
                    )
                )
    return works


# Chapters -------------------------------------------------------------------------------------

_LEVEL: Final = "background (counts per shot)"
_DRAWN: Final = (
    elastic_cases.KNOWN_SHAPE,
    elastic_cases.KNOWN_CLEAN_RANGE,
    elastic_cases.TAIL_MEAN,
)


def _decade(level: float) -> str:
    return f"1e{round(math.log10(level))}"


def _by_method(scores: Scores) -> dict[str, list[Row]]:
    groups: dict[str, list[Row]] = {}
    for row in rows_of_scores(scores):
        groups.setdefault(row.method, []).append(row)
    return groups


def _backgrounds(scores: Scores, profiles: int) -> Chapter:
    groups = _by_method(scores)
    return Chapter(
        "Background",
        "Simulated like the EARLINET elastic intercomparison: 532 nm, aerosol below 6 km "
        "(optical depth 1.4), 1005 bins of 15 m, means of 1000 shots with Poisson noise; "
        f"{profiles:,} profiles per level, one in {SLOW_SHARE} of them for "
        "homogeneous. known_shape selects its window, or knows that the air is clean above 6 km. "
        "tail_mean averages the last tenth of the bins, including the signal there. The methods "
        "homogeneous and cubic are not in the figure, because they assume a homogeneous path. "
        "Above 6 km the decreasing air density looks like extinction, which biases their "
        "background by about one count for any noise, and the additional unknown increases its "
        "scatter (folded tables, above 6 km).",
        [
            Results(
                f"Background by {name}, counts per shot",
                group,
                "In brackets: Monte Carlo standard error of the last digits. Stated: median "
                "standard error. Mean and root mean square of the error over the stated one, and "
                "share of profiles within 1 and 1.96 stated errors: 68.3 and 95 % if errors are as "
                "stated. Bound: Cramér-Rao, above 6 km. Rejected profiles are excluded.",
                case="background",
                folded=name not in _DRAWN,
            )
            for name, group in groups.items()
        ],
        [
            _level_chart(
                "background",
                "Error of the background against its level (counts per shot)",
                {name: groups[name] for name in _DRAWN},
            )
        ],
    )


def _inversions(scores: Scores) -> Chapter:
    groups = _by_method(scores)
    return Chapter(
        "Backscatter",
        "Backscatter of particles from 0.5 to 6 km, in percent of its mean there, with the "
        "true lidar ratio. The reference window is given, 7 to 8 km, or chosen from windows of "
        "1 km between 4 and 12 km, some of which hold a tenuous layer of up to 0.4 per Mm and sr. "
        "Error carried: what noise may hide in the window is stated as error of the reference, "
        "for particles hidden by noise. Bins without value are excluded: where few bins are "
        "solved, noise has selected them.",
        [
            Results(
                f"Backscatter by {name}, percent of its mean",
                group,
                "Solved: share of bins with a value. Mean error and scatter of a profile; RMSE and "
                "stated standard error of a bin. Share of bins within 1 and 1.96 stated standard "
                "errors.",
                case="background",
            )
            for name, group in groups.items()
        ],
        [_level_chart("backscatter", "Error of backscatter, 0.5 to 6 km, by background", groups)],
    )


def _level_chart(name: str, title: str, groups: dict[str, list[Row]]) -> Chart:
    return chart(
        name,
        title,
        "Root mean square error, with bars of 2 Monte Carlo standard errors, and stated standard "
        "error (hollow). Where they agree, errors are as stated.",
        [
            panel(method, group, ("RMSE", "stated"), x=_LEVEL, joined=True, hollow={"stated"})
            for method, group in groups.items()
        ],
    )


# Without noise, and published files -----------------------------------------------------------


def _closed(sky: SimulatedSky, level: float | None) -> Score:
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
    return {
        "its error (counts)": float(estimates.background[0]) - (level or 0.0),
        "mean error": share(float(error.mean())),
        "largest error": share(float(np.abs(error).max())),
    }


def _without_noise(scores: Scores) -> Chapter:
    return Chapter(
        "Without noise",
        "Errors of the method itself: the signal is summed over ninths of a bin, the "
        "inversion and the molecular shape by trapezoids over bins of 15 m.",
        [
            Results(
                "Closed loop without noise",
                rows_of_scores(scores),
                "Of backscatter from 0.5 to 6 km, over its mean there.",
                case="background",
            )
        ],
    )


def _files(sky: SimulatedSky, files: Sequence[elastic_cases.Published]) -> Chapter:
    backgrounds: Scores = {}
    inversions: Scores = {}
    for file in files:
        estimates = {
            name: method(file.counts, sky)
            for name, method in elastic_cases.background_methods().items()
        }
        for name, estimate in estimates.items():
            error = float(estimate.background[0]) - file.background
            backgrounds[_decade(file.level), name] = {
                "error": error,
                "error / stated": error / float(estimate.standard_error[0]),
                "error of the truth": file.background_error,
            }
        for name, chain in elastic_cases.chains().items():
            inverted = elastic_cases.invert(file.counts, sky, estimates[chain.method], chain)
            errors = _errors(inverted, sky)
            score = inversion_score(errors[0], errors[1], _scale(sky))
            inversions[_decade(file.level), name] = score
    return Chapter(
        "Files of the intercomparison",
        "The published files at 532 nm, one per level, lidar ratio 39 sr. The true background "
        "is the fit of the noise-free signal to the same file, the true backscatter the inversion "
        "of the noise-free signal with the reference from 7 to 8 km. From 2.5 to 5.5 km particles "
        "scatter 0.2 % of what air does, which no test of shape detects in noise. A window chosen "
        "there is biased by that amount.",
        [
            Results(
                "Background of published files, counts per shot",
                rows_of_scores(backgrounds),
                case="background",
            ),
            Results(
                "Backscatter of published files, percent of its mean",
                rows_of_scores(inversions),
                "From 0.5 to 6 km, one profile per row, so without scatter.",
                case="background",
            ),
        ],
    )


# CPU time -------------------------------------------------------------------------------------


def elastic_costs(batch: int, repeats: int) -> list[Row]:
    """Return the CPU time of each step and peer, the read first.

    Parameters
    ----------
    batch : int
        Profiles per call; slow peers get fewer.
    repeats : int
        Timed rounds.
    """
    counts = elastic_cases.simulated_sky().counts(TIMED_LEVEL, batch)
    ours, peers = _steps(counts)
    calls = {}
    for name, step in (ours | peers).items():
        size = batch if name == READ else affordable(step, batch)
        calls[name] = (partial(step, size), size)
    return time_methods(batch_label(batch), calls, repeats, peers=peers)


_Step = Callable[[int], object]
"""Runs a step for a number of profiles."""


def _steps(counts: Any) -> tuple[dict[str, _Step], dict[str, _Step]]:
    """Return the steps of lidarops with the read, and the peers."""
    sky = elastic_cases.simulated_sky()
    methods = elastic_cases.background_methods()
    estimate = methods[elastic_cases.KNOWN_SHAPE](counts, sky)
    power = elastic_cases.subtract_background(counts, sky, estimate)
    noise = elastic_cases.count_variance(counts)
    # The peers allow no gaps: they get the bins of incomplete overlap too.
    whole = counts - estimate.background[:, np.newaxis]
    chain = elastic_cases.Chain(elastic_cases.KNOWN_SHAPE, choose=True)

    def background(name: str) -> _Step:
        return lambda few: methods[name](counts[:few], sky)

    def solve_particles(few: int) -> object:
        return elastic_cases.invert_particles(
            power[:few],
            sky,
            elastic_cases.GIVEN_WINDOW,
            noise=noise[:few],
            background_error=estimate.standard_error[:few],
        )

    def everything(few: int) -> object:
        first = counts[:few]
        return elastic_cases.invert(first, sky, methods[chain.method](first, sky), chain)

    ours: dict[str, _Step] = {
        READ: lambda few: np.max(counts[:few]),
        **{
            name: background(name)
            for name in (
                elastic_cases.TAIL_MEAN,
                elastic_cases.KNOWN_SHAPE,
                elastic_cases.KNOWN_CLEAN_RANGE,
            )
        },
        "layers.screen": lambda few: elastic_cases.find_clouds(power[:few], noise[:few], sky),
        "reference.choose": lambda few: elastic_cases.choose_window(power[:few], noise[:few], sky),
        "elastic.solve": solve_particles,
        ALL_STEPS: everything,
    }
    peers: dict[str, _Step] = {
        elastic_cases.LINEAR: background(elastic_cases.LINEAR),
        "Klett, numpy": lambda few: elastic_cases.klett_numpy(whole[:few], sky),
    }
    return ours, peers


def elastic_cost_chapter(costs: Sequence[Row]) -> Chapter:
    """Return the chapter on the CPU time of the steps, beside plain peers."""
    return cost_chapter(
        "elastic-time",
        f"Profiles of {elastic_cases.RANGE.size} bins, float64, one thread, least CPU time of "
        "interleaved repeats. Steps of lidarops compute all errors and flags; all steps: "
        "background, clouds, reference window and inversion with its error budget. The peer "
        f"{elastic_cases.LINEAR} gives values and errors without flags, the Klett inversion in "
        "numpy for each profile values alone.",
        costs,
    )
