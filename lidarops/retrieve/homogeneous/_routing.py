"""Routing of the profiles of a homogeneous path: which solver takes which profile."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from lidarops.flags import Quality
from lidarops.retrieve.homogeneous import _compressed, _methods
from lidarops.retrieve.homogeneous._fit_quality import common_limits
from lidarops.retrieve.homogeneous._functional_tables import Tables, make_tables
from lidarops.retrieve.homogeneous._problem import Array, PathProblem, PathSolution
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

_UNIFORM: Final = 4.0 * np.finfo(np.float64).eps
"""Deviation from even spacing by rounding, over the last range."""


def solve_by_compression(problem: PathProblem) -> PathSolution:
    """Solve by 11 functionals of each profile; profiles with gaps by Newton steps."""
    if not _is_regular(problem):
        return _methods.solve_by_direct_fit(problem)
    tables = _tables(problem)
    if tables is None:
        return _methods.solve_by_masked_fit(problem)
    count, bins = problem.power.shape
    out = np.empty((len(_compressed.RESULTS), count))
    quality, state = np.empty(count, np.int32), np.empty(count, np.int64)
    _compressed.solve_compressed(
        problem.power,
        _compressed.weight_roots(tables, _weights(problem), problem.power),
        tables.envelope.astype(problem.power.dtype),
        tables,
        _compressed.Mode(problem.known_variance, problem.rounding),
        common_limits(bins, _compressed.CURVATURES - 2, known_variance=problem.known_variance),
        out,
        quality,
        state,
    )
    solution = PathSolution(
        **dict(zip(_compressed.RESULTS, out, strict=True)),
        mean_range=np.where(quality & int(Quality.NO_SIGNAL), math.nan, tables.mean_range),
        valid_bins=np.full(count, bins, np.int32),
        quality=quality,
    )
    routed = np.flatnonzero(state == _compressed.ROUTED)
    if routed.size == 0:
        return solution
    return solution.updated(
        routed, _methods.solve_by_masked_fit(problem.select(routed, problem.power[routed]))
    )


def _is_regular(problem: PathProblem) -> bool:
    """Return whether the range is uniform, and the section neither short nor thin."""
    range_ = problem.range
    if range_.size < THRESHOLDS.fewest_compressed_bins:
        return False
    if range_[-1] - range_[0] < THRESHOLDS.thinnest * range_[0]:
        return False
    even = np.linspace(range_[0], range_[-1], range_.size)
    return bool(np.max(np.abs(range_ - even)) <= _UNIFORM * range_[-1])


def _tables(problem: PathProblem) -> Tables | None:
    """Return the tables, or None where they do not apply."""
    if not problem.common_noise or problem.range.size > THRESHOLDS.most_compressed_bins:
        return None
    weights = _weights(problem)
    if not np.all((weights > 0.0) & (weights < _compressed.HUGE)):
        return None
    tables = make_tables(problem.range, weights, problem.bounds)
    return tables if tables.monotonic else None


def _weights(problem: PathProblem) -> Array:
    with np.errstate(divide="ignore"):
        weights: Array = 1.0 / problem.noise[0] if problem.known_variance else problem.noise[0]
    return weights
