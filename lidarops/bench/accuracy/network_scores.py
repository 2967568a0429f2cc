"""Results of the benchmark of networks of lidars, and the scores of errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.bench.accuracy.homogeneous import SIGMAS
from lidarops.bench.accuracy.network_cases import BLOCK, Array, FigurePoint
from lidarops.bench.harness.rows import MonteCarloFigure
from lidarops.bench.harness.timing import Machine
from lidarops.retrieve.network.extinction_field import NetworkResult

Booleans = npt.NDArray[np.bool_]

CLIPPED: Final = 3.0
"""Limit of relative errors: a quotient of noise has no variance."""
WITHIN: Final = (*SIGMAS, 3.0)
"""Numbers of standard errors."""


@dataclass(frozen=True, slots=True)
class NetworkScore:
    """Errors of one solver at the near crossings, relative to the truth; None without values.

    Monte Carlo errors come from the scatter between blocks, because profiles of a block share
    their mean field.
    """

    solved: float
    """Share of values that are not withheld."""
    flagged: MonteCarloFigure
    """Share of values with any flag."""
    bias: MonteCarloFigure | None
    """Mean error of extinction."""
    rmse: MonteCarloFigure | None
    """Root mean square error of extinction."""
    unflagged_rmse: MonteCarloFigure | None
    within: tuple[MonteCarloFigure, MonteCarloFigure, MonteCarloFigure] | None
    """Share of unflagged values within 1, 1.96 and 3 stated standard errors."""
    visibility_bias: tuple[MonteCarloFigure | None, ...]
    """Mean error of visibility at each near crossing, the nearest first."""
    visibility_rmse: tuple[MonteCarloFigure | None, ...]
    chi_square: float | None
    """Mean reduced chi-square of networks."""
    microseconds: float
    """CPU time of a profile: the shortest of the chunks."""
    reads: float
    """The same as a multiple of the read of the same array in the same run."""


@dataclass(frozen=True, slots=True)
class NetworkScenario:
    """One network in one air with one noise."""

    place: str
    air: str
    noise: float
    profiles: int
    scores: Mapping[str, NetworkScore]
    """Scores by the name of the solver."""


@dataclass(frozen=True, slots=True)
class VisibilityScore:
    """Errors of unflagged visibility by one definition, from extinction of the network."""

    noise: float
    contrast: float
    constant: float
    """Visibility times extinction."""
    visibility: float
    """m, mean true visibility."""
    bias: MonteCarloFigure
    """m."""
    rmse: MonteCarloFigure
    """m."""
    within_error: MonteCarloFigure
    """Share of true values within one linear standard error."""
    within_interval: MonteCarloFigure
    """Share of true values between the lower and the upper visibility."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """The network method without prior and `scipy.optimize.least_squares` on the same profiles."""

    place: str
    air: str
    profiles: int
    ours: float
    """Root mean square error of extinction at the near crossings, relative, clipped."""
    peer: float
    apart: float
    """Root mean square difference over the stated standard errors of the network method."""
    ours_microseconds: float
    peer_microseconds: float


@dataclass(frozen=True, slots=True)
class SolverRate:
    """CPU time of one solver for cycles, or for profiles of a network."""

    method: str
    beams: int
    size: int
    """Cycles or profiles in a call."""
    nanoseconds: float
    """Per cycle or profile: the shortest of the repeats."""
    reads: float
    """The same as a multiple of the read of the same arrays in the same run."""
    ours: bool


@dataclass(frozen=True, slots=True)
class NetworkAccuracy:
    """Result of the accuracy benchmark of networks of lidars."""

    date: str
    machine: Machine
    cases: tuple[NetworkScenario, ...]
    figure: tuple[FigurePoint, ...]
    """Figure 2 of drabenko2021."""
    sights: tuple[VisibilityScore, ...]
    comparisons: tuple[Comparison, ...]
    cycles: tuple[SolverRate, ...]


# Scores ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class CrossingErrors:
    """(profile, near crossing) errors of one solver; NaN where values are withheld."""

    extinction: Array
    """Relative, clipped."""
    visibility: Array
    """Relative, clipped."""
    deviation: Array
    """Error of extinction over the stated standard error."""
    flagged: Booleans
    chi_square: Array
    """(profile,)."""


def crossing_errors(result: NetworkResult, truth: Array, near: Booleans) -> CrossingErrors:
    """Return the errors of a result.

    Parameters
    ----------
    result : NetworkResult
    truth : (profile, crossing) float
        Extinction, m-1.
    near : (crossing,) bool
    """
    extinction, truth = result.extinction[:, near], truth[:, near]
    stated = result.extinction_standard_error[:, near]
    return CrossingErrors(
        np.clip(extinction / truth - 1.0, -CLIPPED, CLIPPED),
        np.clip(truth / extinction - 1.0, -CLIPPED, CLIPPED),
        (extinction - truth) / stated,
        result.flags.flagged[:, near],
        result.reduced_chi_square,
    )


def join_errors(chunks: Sequence[CrossingErrors]) -> CrossingErrors:
    """Return the errors of all profiles."""
    return CrossingErrors(
        np.concatenate([chunk.extinction for chunk in chunks]),
        np.concatenate([chunk.visibility for chunk in chunks]),
        np.concatenate([chunk.deviation for chunk in chunks]),
        np.concatenate([chunk.flagged for chunk in chunks]),
        np.concatenate([chunk.chi_square for chunk in chunks]),
    )


def mean_by_block(values: npt.NDArray[np.generic], kept: Booleans) -> MonteCarloFigure | None:
    """Return the mean of kept values, with its error from the scatter between blocks.

    Parameters
    ----------
    values : (profile, ...) float or bool
    kept : (profile, ...) bool

    Returns
    -------
    MonteCarloFigure or None
        None where nothing is kept. The mean is a ratio of sums over blocks, and so is its error.
    """
    blocks = -(-len(values) // BLOCK)
    edges = np.arange(blocks) * BLOCK
    totals = np.add.reduceat(_rows(np.where(kept, values, 0.0)), edges)
    counts = np.add.reduceat(_rows(kept.astype(np.float64)), edges)
    count = counts.sum()
    if count == 0:
        return None
    mean = totals.sum() / count
    scatter = np.sum((totals - mean * counts) ** 2) * blocks / max(blocks - 1, 1)
    return MonteCarloFigure(float(mean), float(np.sqrt(scatter) / count))


def _rows(values: npt.NDArray[np.float64]) -> Array:
    return np.asarray(values.reshape(len(values), -1).sum(axis=1))


def share_by_block(inside: Booleans, kept: Booleans) -> MonteCarloFigure | None:
    """Return the share of kept values that are inside, with an error above 0."""
    share = mean_by_block(inside, kept)
    if share is None:
        return None
    profiles = int(np.count_nonzero(_rows(kept.astype(np.float64))))
    # Half a profile keeps the error above zero where all or none are inside.
    probability = (share.value * profiles + 0.5) / (profiles + 1)
    return MonteCarloFigure(
        share.value, max(share.error, math.sqrt(probability * (1 - probability) / profiles))
    )


def root_by_block(errors: Array, kept: Booleans) -> MonteCarloFigure | None:
    """Return the root mean square of kept errors, with its error from the scatter of blocks."""
    square = mean_by_block(errors**2, kept)
    if square is None:
        return None
    value = math.sqrt(square.value)
    return MonteCarloFigure(value, square.error / (2.0 * value) if value > 0 else 0.0)


def score(errors: CrossingErrors, microseconds: float, reads: float) -> NetworkScore:
    """Return the score of one solver in one case."""
    solved = np.isfinite(errors.extinction) & np.isfinite(errors.deviation)
    trusted = solved & ~errors.flagged
    all_values = np.ones_like(solved)
    flagged = share_by_block(errors.flagged, all_values)
    first, second, third = (
        share_by_block(np.abs(errors.deviation) <= sigmas, trusted) for sigmas in WITHIN
    )
    columns = range(solved.shape[1])
    fitted = errors.chi_square[np.isfinite(errors.chi_square)]
    return NetworkScore(
        solved=float(solved.mean()),
        flagged=flagged if flagged is not None else MonteCarloFigure(0.0, 0.0),
        bias=mean_by_block(errors.extinction, solved),
        rmse=root_by_block(errors.extinction, solved),
        unflagged_rmse=root_by_block(errors.extinction, trusted),
        within=None if first is None or second is None or third is None else (first, second, third),
        visibility_bias=tuple(
            mean_by_block(errors.visibility[:, crossing], solved[:, crossing])
            for crossing in columns
        ),
        visibility_rmse=tuple(
            root_by_block(errors.visibility[:, crossing], solved[:, crossing])
            for crossing in columns
        ),
        chi_square=float(fitted.mean()) if fitted.size else None,
        microseconds=microseconds,
        reads=reads,
    )
