"""Accuracy of backgrounds and elastic inversions, beside peers and on published signals."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr

from benchmarks.accuracy import comparison
from benchmarks.harness.figure import Array, Figure, Mask, Score, Scores, Work, share
from benchmarks.harness.results import Effort, Results, Study
from benchmarks.scenes import elastic_skies
from benchmarks.scenes.elastic_skies import CLEAN_FROM, Backgrounds, SimulatedSky, count_weight
from lidarops.flags import Quality, rejecting
from lidarops.retrieve.elastic.flags import ElasticQuality

DRAWS: Final = 5000
QUICK_DRAWS: Final = 1000
BLOCK: Final = 200
"""Profiles simulated and solved together."""
LINEAR: Final = "least squares {1, shape}"
"""Peer; the range from 6 km is given, and the weights are those of the mean profile."""
_REJECTING: Final = rejecting((*Quality, *ElasticQuality))
_NOTE: Final = (
    "Simulated like the EARLINET elastic intercomparison: 532 nm, aerosol below 6 km (optical "
    "depth 1.4), 1005 bins of 15 m, means of 1000 shots with Poisson noise. known_shape selects "
    "its window, or knows that the air is clean above 6 km; tail_mean averages the last tenth of "
    "the bins. All steps: background by known_shape, clouds, a chosen reference window, whose "
    "error holds what noise may hide in it, and the inversion. Bound: Cramér-Rao, above 6 km."
)


def background_methods() -> dict[str, elastic_skies.BackgroundMethod]:
    """Return the methods of the background and their peer by name."""
    return {**elastic_skies.background_methods(), LINEAR: linear_backgrounds}


def measure_elastic_accuracy(effort: Effort, *, draws: int | None = None) -> Study:
    """Retrieve background and particles of simulated profiles at two levels of the background.

    Parameters
    ----------
    effort : Effort
        With the folder of the published files (`elastic_skies.read_published_profiles`).
    draws : int, optional
        Profiles per level, at least 2.

    Raises
    ------
    CampaignError
        If the folder holds no published files.
    """
    published = []
    if effort.data is not None:
        published = published_tables(*elastic_skies.read_published_profiles(effort.data))
    works: list[Work] = []
    for decade in (2, 5):
        works += measure_level(decade, draws or (QUICK_DRAWS if effort.quick else DRAWS))
        effort.progress(1)
    return comparison.study("elastic inversion", works, _NOTE, published)


def measure_level(decade: int, draws: int) -> Iterator[Work]:
    """Yield the errors of backgrounds, then those of backscatter, at one level of the background.

    Parameters
    ----------
    decade : int
        Power of 10 of the background, counts per shot; the seed, too.
    draws : int
        Number of profiles.
    """
    level, sky = 10.0**decade, elastic_skies.simulated_sky()
    counts = [
        sky.counts(level, min(BLOCK, draws - first), decade, k)
        for k, first in enumerate(range(0, draws, BLOCK))
    ]
    work = partial(Work, f"background of {level:.0f} counts")
    for name, method in background_methods().items():
        spent, parts = _solved(method, counts, sky)
        error, stated, rejected = map(np.concatenate, zip(*parts, strict=True))
        score = background_score(error - level, stated, rejected)
        if score:
            score |= {"bound": elastic_skies.least_error(sky, level)}
            ours = name not in {elastic_skies.TAIL_MEAN, LINEAR}
            informed = name == elastic_skies.KNOWN_CLEAN_RANGE
            rmse, covered = score.pop(comparison.RMSE), score.pop(comparison.COVERAGE)
            yield work("background, counts", name, rmse, covered, spent, ours, informed, score)
    spent, inverted = _solved(elastic_skies.invert, counts, sky)
    score = inversion_score(np.concatenate([_errors(one, sky) for one in inverted], 1), sky)
    if score:
        rmse = score.pop(comparison.RMSE)
        yield work("backscatter 0.5 to 6 km, relative", "all steps", Figure(rmse.value, rmse.error),
                   score.pop(comparison.COVERAGE), spent, more=score)  # fmt: skip


def linear_backgrounds(counts: Array, sky: SimulatedSky) -> Backgrounds:
    """Return backgrounds by linear least squares with a constant and the shape of air."""
    first = int(np.searchsorted(sky.range, CLEAN_FROM))
    shape = sky.shape[first:] / sky.shape[first]
    slopes = np.stack([np.ones_like(shape), shape], axis=1)
    weighted = slopes * count_weight(counts[:, first:])[:, np.newaxis]
    covariance = np.linalg.inv(weighted.T @ slopes)
    background = counts[:, first:] @ (weighted @ covariance[:, 0])
    error = np.full(len(counts), np.sqrt(covariance[0, 0]))
    return Backgrounds(background, error, np.zeros(len(counts), dtype=np.bool_))


def _solved(
    solve: Callable[[Array, SimulatedSky], Any], counts: list[Array], sky: SimulatedSky
) -> tuple[Figure, list[Any]]:
    """Return the CPU time of a profile, and the solutions of all blocks."""
    spent, first = comparison.time_profiles(
        partial(solve, counts[0], sky), len(counts[0]), comparison.ROUNDS
    )
    return spent, [first, *(solve(block, sky) for block in counts[1:])]


def _errors(solved: xr.Dataset, sky: SimulatedSky) -> Array:
    """Return (error or standard error, profile, compared bin), m-1 sr-1; NaN where rejected."""
    usable, near = (solved["quality_flag"] & _REJECTING) == 0, sky.compared
    names = ("aerosol_backscatter", "aerosol_backscatter_standard_error")
    backscatter, stated = (solved[name].where(usable).to_numpy()[:, near] for name in names)
    return np.stack([backscatter - sky.backscatter[near], stated])


def background_score(error: Array, stated: Array, rejected: Mask) -> Score:
    """Return the errors of backgrounds, counts; none where fewer than two are usable."""
    kept = ~rejected & np.isfinite(error) & (stated > 0)
    if kept.sum() < 2:
        return {}
    return comparison.score_errors(error, stated, kept) | {"stated": float(np.median(stated[kept]))}


def inversion_score(errors: Array, sky: SimulatedSky) -> Score:
    """Return the errors of backscatter over the mean of the truth; none without values.

    Parameters
    ----------
    errors : (error or standard error, profile, compared bin) float
        m-1 sr-1; NaN where withheld.
    sky : SimulatedSky
    """
    error, stated = errors / float(sky.backscatter[sky.compared].mean())
    kept = np.isfinite(error) & np.isfinite(stated)
    if kept.any(axis=1).sum() < min(2, len(kept)):
        return {}
    score: Score = {
        "solved": share(float(kept.mean())),
        "stated": share(float(np.sqrt(np.mean(stated[kept] ** 2)))),
    }
    scored = comparison.score_errors(np.where(kept, error, 0.0), stated, kept)
    return score | {name: share(figure) for name, figure in scored.items()}


def published_tables(sky: SimulatedSky, files: list[elastic_skies.Published]) -> list[Results]:
    """Return the errors of all methods and chains for the files of the intercomparison."""
    backgrounds: Scores = {}
    inversions: Scores = {}
    for file in files:
        case = f"1e{round(math.log10(file.level))}"
        for name, find in background_methods().items():
            estimate = find(file.counts, sky)
            error = float(estimate.background[0]) - file.background
            backgrounds[case, name] = {
                "error": error,
                "error / stated": error / float(estimate.standard_error[0]),
                "error of the truth": file.background_error,
            }
        for name, chain in elastic_skies.CHAINS.items():
            solved = elastic_skies.invert(file.counts, sky, **chain)
            score = inversion_score(_errors(solved, sky), sky)
            names = (
                "solved",
                comparison.BIAS,
                comparison.RMSE,
                "stated",
                comparison.WITHIN_1,
                comparison.COVERAGE,
            )
            # Of one profile, there is no scatter.
            inversions[case, name] = {
                name: share(score[name].value) if score else None for name in names
            }
    note = (
        "The published files at 532 nm, one per level, lidar ratio 39 sr. The true background is "
        "the fit of the noise-free signal to the same file, the true backscatter the inversion of "
        "the noise-free signal with the reference from 7 to 8 km. From 2.5 to 5.5 km particles "
        "scatter 0.2 % of what air does, which no test of shape detects in noise. A window chosen "
        "there is biased by that amount."
    )
    return [
        Results("Background of published files, counts per shot", backgrounds, note, "background"),
        Results(
            "Backscatter of published files, percent of its mean",
            inversions,
            "From 0.5 to 6 km, one profile per row. Solved: share of bins with a value.",
            "background",
        ),
    ]
