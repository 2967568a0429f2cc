"""Accuracy of backgrounds and elastic inversions, by the level of the background."""

from __future__ import annotations

from collections.abc import Mapping
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
from lidarops.bench.accuracy.elastic_costs import elastic_costs
from lidarops.bench.accuracy.homogeneous import (
    BackgroundScore,
    InversionScore,
    background_score,
    inversion_score,
)
from lidarops.bench.harness.benchmark import Effort
from lidarops.bench.harness.timing import Machine, StepCost, machine

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
    effort: Effort, *, draws: int | None = None, data: Path | None = None
) -> Elastic:
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
    published = _published(data) if data is not None else ()
    count = draws or (QUICK_DRAWS if effort.quick else DRAWS)
    levels = []
    for seed, level in enumerate(elastic_cases.LEVELS):
        levels.append(_level(elastic_cases.simulated_sky(), level, count, seed))
        effort.progress(1)
    return Elastic(
        effort.date,
        machine(),
        tuple(levels),
        tuple(_closed(elastic_cases.simulated_sky(), level) for level in (None, *CLOSED_LEVELS)),
        tuple(elastic_costs(min(count, _BATCH), _QUICK_REPEATS if effort.quick else _REPEATS)),
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
