"""Accuracy of backgrounds and elastic inversions, by the level of the background."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from benchmarks.accuracy import elastic_cases
from benchmarks.accuracy.elastic_cases import BackgroundEstimates, SimulatedSky
from benchmarks.accuracy.elastic_peers import LINEAR, klett_numpy, linear_backgrounds
from benchmarks.harness.figure import Array, Figure, Mask, cpu_time, share
from benchmarks.harness.results import Chapter, Effort, Results, Study, Work
from benchmarks.harness.statistics import SIGMAS, mean, root, share_inside
from benchmarks.harness.timing import CPU_TIME, READ, affordable, time_methods
from benchmarks.harness.verdicts import Score, Scores
from lidarops.retrieve.elastic.inversion import ElasticResult

DRAWS: Final = 5000
QUICK_DRAWS: Final = 1000
SLOW_SHARE: Final = 5
"""One in this many profiles is processed by `homogeneous`, which is slow."""
BLOCK: Final = 200
"""Profiles simulated and solved together."""
ALL_STEPS: Final = "all steps"
TIMED_LEVEL: Final = 1e4
"""Background of the timed profiles, counts per shot."""
_BATCH: Final = 400
_COMPARED: Final = (1e2, 1e5)
"""Backgrounds shown on the page of all retrievals, counts per shot."""
_CARRIED: Final = "chosen, error carried"
"""Chain of all steps."""
_WITHIN: Final = ("within 1", "within 1.96")


def background_methods() -> dict[str, elastic_cases.BackgroundMethod]:
    """Return the methods of the background and their peer by name."""
    return {**elastic_cases.background_methods(), LINEAR: linear_backgrounds}


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
        backgrounds |= {(_decade(level), name): score for name, score in of_background.items()}
        inversions |= {(_decade(level), name): score for name, score in of_inversion.items()}
        effort.progress(1)
    costs = elastic_costs("", min(count, _BATCH), 3 if effort.quick else 5)
    times = {name: score[CPU_TIME] for (_, name), score in costs.items()}
    return Study(
        "Elastic inversion: error against the level of the background",
        effort.date,
        [
            Chapter(
                "Simulated profiles",
                "Simulated like the EARLINET elastic intercomparison: 532 nm, aerosol below 6 km "
                "(optical depth 1.4), 1005 bins of 15 m, means of 1000 shots with Poisson noise; "
                f"{count:,} profiles per level, one in {SLOW_SHARE} of them for homogeneous. "
                "known_shape selects its window, or knows that the air is clean above 6 km; "
                "tail_mean averages the last tenth of the bins. homogeneous and cubic assume a "
                "homogeneous path, and get the range above 6 km. The reference window of the "
                "inversion is given, 7 to 8 km, or chosen; error carried: what noise may hide in "
                "it is stated as error of the reference.",
                [
                    Results(
                        "Background, counts per shot",
                        backgrounds,
                        "Mean and root mean square of the error over the stated one, and share of "
                        "profiles within 1 and 1.96 stated errors. Bound: Cramér-Rao, above 6 km. "
                        "Rejected profiles are excluded.",
                        case="background",
                    ),
                    Results(
                        "Backscatter from 0.5 to 6 km, percent of its mean",
                        inversions,
                        "Solved: share of bins with a value. Mean error and scatter of a profile; "
                        "RMSE and stated standard error of a bin.",
                        case="background",
                    ),
                ],
            ),
            *published,
        ],
        list(_works(backgrounds, inversions, times)),
    )


def _level(
    sky: SimulatedSky, level: float, draws: int, seed: int
) -> tuple[dict[str, Score], dict[str, Score]]:
    """Return the scores of the backgrounds and of the inversions at one level, by method."""
    estimates: dict[str, list[BackgroundEstimates]] = {}
    errors: dict[str, list[Array]] = {}
    for k, first in enumerate(range(0, draws, BLOCK)):
        counts = sky.counts(level, min(BLOCK, draws - first), seed, k)
        solved = {
            name: method(counts, sky)
            for name, method in background_methods().items()
            if first < draws / SLOW_SHARE or name != elastic_cases.HOMOGENEOUS
        }
        for name, estimate in solved.items():
            estimates.setdefault(name, []).append(estimate)
        for name, chain in elastic_cases.chains().items():
            inverted = elastic_cases.invert(counts, sky, solved[chain.method], chain)
            errors.setdefault(name, []).append(_errors(inverted, sky))
    backgrounds: dict[str, Score] = {}
    for name, blocks in estimates.items():
        error, stated, rejected = (
            np.concatenate([getattr(block, field) for block in blocks])
            for field in ("background", "standard_error", "rejected")
        )
        backgrounds[name] = {
            **background_score(error - level, stated, rejected),
            "bound": elastic_cases.least_error(sky, level),
            "rejected": share(float(rejected.mean())),
        }
    inversions = {
        name: inversion_score(np.concatenate(chunks, axis=1), _scale(sky))
        for name, chunks in errors.items()
    }
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


def inversion_score(errors: Array, scale: float) -> Score:
    """Return the errors of backscatter; None where fewer than two of many profiles have a value.

    Parameters
    ----------
    errors : (error or standard error, profile, compared bin) float
        m-1 sr-1; NaN where withheld.
    scale : float
        Mean of the truth, m-1 sr-1.
    """
    names = ("solved", "mean error", "scatter", "RMSE", "stated", *_WITHIN)
    error, stated = errors
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


def _works(backgrounds: Scores, inversions: Scores, times: dict[str, Any]) -> Iterator[Work]:
    for level in _COMPARED:
        scores = {name: score for (case, name), score in backgrounds.items()
                  if case == _decade(level)}  # fmt: skip
        scores |= {ALL_STEPS: inversions[_decade(level), _CARRIED]}
        whole, background = "backscatter 0.5 to 6 km, relative", "background, counts"
        for method, score in scores.items():
            error, coverage, spent = score["RMSE"], score[_WITHIN[1]], times.get(method)
            if isinstance(error, Figure) and isinstance(coverage, Figure) and spent:
                yield Work(
                    f"background of {level:.0f} counts",
                    whole if method == ALL_STEPS else background,
                    method,
                    Figure(error.value, error.error),
                    coverage,
                    cpu_time(spent.value),
                    ours=method not in {elastic_cases.TAIL_MEAN, LINEAR},
                    informed=method == elastic_cases.KNOWN_CLEAN_RANGE,
                )


def _decade(level: float) -> str:
    return f"1e{round(math.log10(level))}"


def _files(sky: SimulatedSky, files: list[elastic_cases.Published]) -> Chapter:
    backgrounds: Scores = {}
    inversions: Scores = {}
    for file in files:
        case = _decade(file.level)
        estimates = {name: find(file.counts, sky) for name, find in background_methods().items()}
        for name, estimate in estimates.items():
            error = float(estimate.background[0]) - file.background
            backgrounds[case, name] = {
                "error": error,
                "error / stated": error / float(estimate.standard_error[0]),
                "error of the truth": file.background_error,
            }
        for name, chain in elastic_cases.chains().items():
            inverted = elastic_cases.invert(file.counts, sky, estimates[chain.method], chain)
            inversions[case, name] = inversion_score(_errors(inverted, sky), _scale(sky))
    return Chapter(
        "Files of the intercomparison",
        "The published files at 532 nm, one per level, lidar ratio 39 sr. The true background "
        "is the fit of the noise-free signal to the same file, the true backscatter the inversion "
        "of the noise-free signal with the reference from 7 to 8 km. From 2.5 to 5.5 km particles "
        "scatter 0.2 % of what air does, which no test of shape detects in noise. A window chosen "
        "there is biased by that amount.",
        [
            Results(
                "Background of published files, counts per shot", backgrounds, case="background"
            ),
            Results(
                "Backscatter of published files, percent of its mean",
                inversions,
                "From 0.5 to 6 km, one profile per row, so without scatter.",
                case="background",
            ),
        ],
    )


# CPU time -------------------------------------------------------------------------------------


def elastic_costs(case: str, batch: int, repeats: int) -> Scores:
    """Return the CPU time of each step and peer, the read first.

    Parameters
    ----------
    case : str
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
    return time_methods(case, calls, repeats, peers=peers)


_Step = Callable[[int], object]
"""Runs a step for a number of profiles."""


def _steps(counts: Any) -> tuple[dict[str, _Step], dict[str, _Step]]:
    """Return the steps of lidarops with the read, and the peers."""
    sky = elastic_cases.simulated_sky()
    methods = background_methods()
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

    names = (
        elastic_cases.TAIL_MEAN,
        elastic_cases.KNOWN_SHAPE,
        elastic_cases.KNOWN_CLEAN_RANGE,
    )
    ours: dict[str, _Step] = {
        READ: lambda few: np.max(counts[:few]),
        **{name: background(name) for name in names},
        "layers.screen": lambda few: elastic_cases.find_clouds(power[:few], noise[:few], sky),
        "reference.choose": lambda few: elastic_cases.choose_window(power[:few], noise[:few], sky),
        "elastic.solve": solve_particles,
        ALL_STEPS: everything,
    }
    peers: dict[str, _Step] = {
        LINEAR: background(LINEAR),
        "Klett, numpy": lambda few: klett_numpy(whole[:few], sky),
    }
    return ours, peers
