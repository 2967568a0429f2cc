"""The vertical solution, block by block; blocks are independent of each other."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.multiangle.vertical import (
    _banded,
    _calibration,
    _correlation,
    _inputs,
    _outliers,
    _smoothing_choice,
)
from lidarops.retrieve.multiangle.vertical import (
    gaps as _gaps,
)
from lidarops.retrieve.multiangle.vertical._correlation import ResidualMoments

Array = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int64]

WINDOW: Final = 15
"""Altitudes over which the variance of the inhomogeneity is pooled."""
_LARGEST_INFORMATION: Final = 1e6
"""Limit of information, in medians of the block."""
_USUAL_INFORMATION: Final = 100.0
"""Limit of the mean information, in medians of the block."""
_NEGLIGIBLE: Final = 1e-4
"""Information of a profile, in medians of the block, below which it is treated as empty."""
_LEAST_FREEDOM_TO_REJECT: Final = 2.0
"""Degrees of freedom of 4 beams: with fewer, an outlying estimate cannot be identified."""
_FEWEST_FREEDOM: Final = 4.1
"""Least degrees of freedom n in Student's variance n / (n - 2), which diverges at 2. No study is
recorded that set it."""
_DOWNWEIGHTED_BELOW: Final = 0.5
"""Share of its weight below which an estimate is reported as an outlier."""


@dataclass(frozen=True, slots=True)
class Pairs:
    """Systems to solve: profiles with weights of smoothness, and their shares in the average."""

    profile: Integers
    """(pair,): row of the profile."""
    smoothing: Array
    """(pair,): weight of smoothness."""
    share: Array
    """(pair,): share in the average, 1 in total for each profile."""

    def total(self, values: Array, profiles: int) -> Array:
        """Sum (pair, altitude) rows into (profile, altitude), each with its share."""
        out = np.zeros((profiles, values.shape[1]))
        _banded.add_rows(values, self.profile, self.share, out)
        return out


@dataclass(frozen=True, slots=True)
class BlockNoise:
    """Correction of the standard errors of one block."""

    profile: Integers
    """(member,): its profiles that have data."""
    calibration: _calibration.Calibration | None
    """None if the block is too small to be calibrated."""
    inflation: Array
    """(altitude,): factor on the variance because the noise is estimated from few residuals."""

    def ratio(self, upper: Integers, lower: Integers) -> Array:
        """Return the factor on the posterior variance of differences of optical depths.

        The shape is (member, difference), or (difference,) if common to all members.
        """
        below = np.where(lower >= 0, self.inflation[np.maximum(lower, 0)], 1.0)
        few: Array = np.maximum(self.inflation[upper], below)
        if self.calibration is None:
            return few
        bias = self.calibration.bias
        change = bias[:, upper] - np.where(lower >= 0, bias[:, np.maximum(lower, 0)], 0.0)
        factor: Array = few * _calibration.variance_ratio(self.calibration, upper, lower, change)
        return factor


@dataclass(frozen=True, slots=True)
class VerticalSystem:
    """The systems that were solved, to be applied to other right-hand sides.

    See `respond` and `layer_optical_depth` in
    `lidarops.retrieve.multiangle.vertical.smooth_profile`.
    """

    altitude: Array
    """(altitude,) m."""
    station_altitude: float
    """m."""
    estimates: Array
    """(profile, altitude): optical depths of single altitudes, 0 where there is none."""
    information: Array
    """(profile, altitude): weights of the estimates, 0 where there is none."""
    within_reach: Booleans
    """(profile, altitude)."""
    bands: Array
    """(3, profile, altitude): precision of the estimates."""
    stiffness: Array
    """(3, altitude): bands of the penalty on roughness."""
    pairs: Pairs
    blocks: tuple[BlockNoise, ...]

    def respond(self, rows: Array) -> Array:
        """Apply the smoother of each profile to its row; NaN beyond the reach."""
        used = self.information > 0.0
        invalid = np.any(used & ~np.isfinite(rows), axis=1)
        clean = np.where(used & ~invalid[:, np.newaxis], rows, 0.0)
        right = _banded.multiply_rows(self.bands, clean)
        solved = _solve_pairs(right, self.bands, self.stiffness, self.pairs)
        smooth = self.pairs.total(solved[0], rows.shape[0])
        return np.where(self.within_reach & ~invalid[:, np.newaxis], smooth, np.nan)

    def layer_variance(self, lower: int, upper: int) -> Array:
        """Return the calibrated variance of the optical depth between two altitudes, (profile,)."""
        profiles, altitudes = self.information.shape
        right = np.zeros((profiles, altitudes))
        right[:, upper] = 1.0
        if lower >= 0:
            right[:, lower] = -1.0
        inverse = _solve_pairs(right, self.bands, self.stiffness, self.pairs)[0]
        right = _banded.multiply_rows(self.bands, self.estimates)
        solved = _solve_pairs(right, self.bands, self.stiffness, self.pairs)[0]
        posterior, value = (
            rows[:, upper] - (rows[:, lower] if lower >= 0 else 0.0) for rows in (inverse, solved)
        )
        variance = _mixed(value[:, np.newaxis], posterior[:, np.newaxis], self.pairs, profiles)[1]
        for block in self.blocks:
            variance[block.profile] *= block.ratio(np.array([upper]), np.array([lower]))
        return np.where(self.within_reach[:, upper], variance[:, 0], np.nan)


@dataclass(frozen=True, slots=True)
class VerticalSolution:
    """The solution of all blocks; fields are as in `smooth_profile.VerticalResult`."""

    optical_depth: Array
    optical_depth_variance: Array
    extinction: Array
    extinction_variance: Array
    weight_in_own: Array
    """(profile, altitude): diagonal of the smoother."""
    downweighted: Booleans
    effective_degrees_of_freedom: Array
    correlation: Array
    smoothing: Array
    saturated: Booleans
    no_residual: Booleans
    system: VerticalSystem


@dataclass(frozen=True, slots=True)
class _Block:
    """Profiles of a block that have data, with the properties common to them."""

    estimates: Array
    information: Array
    share: Array
    correlation: float
    stiffness: Array
    extent: float
    """m, from the lidar to the highest estimate."""
    gaps: Integers
    """Rows where neighbouring altitudes come from different beams."""


@dataclass(frozen=True, slots=True)
class _Fit:
    """Solution of one block; rows are its members."""

    information: Array
    bands: Array
    choice: _smoothing_choice.SmoothingChoice
    pairs: Pairs
    depth: Array
    variance: Array
    extinction: Array
    """Optical depth of the layer from the altitude below."""
    extinction_variance: Array
    own: Array
    """Weight of each estimate in its own optical depth."""


def _solve_pairs(right: Array, bands: Array, stiffness: Array, pairs: Pairs) -> Array:
    out = np.empty((4, pairs.profile.size, right.shape[1]))
    _banded.solve_banded(bands, right, stiffness, pairs.profile, pairs.smoothing, out)
    return out


def _mixed(value: Array, variance: Array, pairs: Pairs, profiles: int) -> tuple[Array, Array]:
    """Return mean and variance of the mixture of the pairs of each profile."""
    mean = pairs.total(value, profiles)
    spread = variance + (value - mean[pairs.profile]) ** 2
    return mean, pairs.total(spread, profiles)


def _own_weights(bands: Array, inverse: Array) -> Array:
    """Return the diagonal of the smoother of each system."""
    own: Array = bands[0] * inverse[0]
    for step in (1, 2):
        both = (bands[step] * inverse[step])[:, :-step]
        own[:, :-step] += both
        own[:, step:] += both
    return own


def _usual_information(information: Array) -> float:
    """Return the mean information, limited to a multiple of the median."""
    known = information[information > 0.0]
    return float(min(known.mean(), _USUAL_INFORMATION * np.median(known)))


def _informative(problem: _inputs.VerticalProblem, member: Integers) -> Integers:
    """Return the members whose information is not negligible in their block."""
    height = problem.altitude - problem.station_altitude
    total = (problem.information[member] * height**2).sum(axis=1)
    informative: Integers = member[total >= _NEGLIGIBLE * np.median(total)]
    return informative


def _fit(block: _Block, information: Array) -> _Fit:
    """Choose the smoothness of a block and solve."""
    profiles = information.shape[0]
    # An estimate with less weight has more noise of its own, not more of the correlated noise.
    share = block.share * _ratio(information, block.information)
    bands = _precision(block, information, share)
    unit = _usual_information(information) * block.extent**3
    choice = _smoothing_choice.choose_smoothing(
        _smoothing_choice.score_smoothing(bands, block.estimates, block.stiffness, unit)
    )
    candidates = choice.smoothing.size
    pairs = Pairs(
        np.repeat(np.arange(profiles), candidates),
        np.tile(choice.smoothing * unit, profiles),
        np.tile(choice.share, profiles),
    )
    right = _banded.multiply_rows(bands, block.estimates)
    solved, diagonal, beside, second = _solve_pairs(right, bands, block.stiffness, pairs)
    gained = np.diff(solved, axis=1, prepend=0.0)
    uncertain = diagonal.copy()
    uncertain[:, 1:] += diagonal[:, :-1] - 2.0 * beside[:, :-1]
    own = _own_weights(bands[:, pairs.profile], np.array([diagonal, beside, second]))
    depth, variance = _mixed(solved, diagonal, pairs, profiles)
    extinction, extinction_variance = _mixed(gained, uncertain, pairs, profiles)
    return _Fit(
        information,
        bands,
        choice,
        pairs,
        depth,
        variance,
        extinction,
        extinction_variance,
        pairs.total(own, profiles),
    )


def _precision(block: _Block, information: Array, share: Array) -> Array:
    bands = _correlation.correlated_precision(information, share, block.correlation)
    rows = block.gaps
    if rows.size and block.correlation > 0.0:
        bands[:, rows] = _gaps.gap_precision(information[rows], share[rows], block.correlation)
    return bands


def _ratio(reduced: Array, whole: Array) -> Array:
    """Return reduced over whole information, at most 1; 1 where there is none."""
    # The bisquare raises the information of good estimates slightly above the whole; a correlated
    # share above 1 would leave a negative variance.
    return np.minimum(np.where(whole > 0.0, reduced / np.where(whole > 0.0, whole, 1.0), 1.0), 1.0)


def _calibrate(block: _Block, fit: _Fit, within: Booleans) -> _calibration.Calibration:
    share = block.share * _ratio(fit.information, block.information)
    information, share = _calibration.typical_profile(fit.information, share)
    smoothing = float(fit.pairs.smoothing[0])
    pilot = replace(fit.pairs, smoothing=fit.pairs.smoothing * _calibration.PILOT)
    right = _banded.multiply_rows(fit.bands, block.estimates)
    rough = _solve_pairs(right, fit.bands, block.stiffness, pilot)[0]
    right = _banded.multiply_rows(fit.bands, rough)
    smooth = _solve_pairs(right, fit.bands, block.stiffness, fit.pairs)[0]
    bands = _correlation.correlated_precision(
        information[np.newaxis], share[np.newaxis], block.correlation
    )
    return _calibration.Calibration(
        np.ascontiguousarray(bands[:, 0]),
        information,
        share,
        block.correlation,
        block.stiffness,
        smoothing,
        np.where(within, rough - smooth, np.nan),
        _calibration.relative_squares(fit.depth, fit.variance, within),
    )


def _inflation(freedom: Array | None, correlation: float, altitudes: int) -> Array:
    """Return the factor on variances because noise is estimated from a window of residuals."""
    if freedom is None:
        return np.ones(altitudes)
    total = np.convolve(freedom.sum(axis=0), np.ones(WINDOW), mode="full")
    start = WINDOW // 2
    square = correlation * correlation
    known = total[start : start + altitudes] * (1.0 - square) / (1.0 + square)
    known = np.maximum(known, _FEWEST_FREEDOM)
    factor: Array = known / (known - 2.0)
    return factor


def _within_reach(information: Array) -> Booleans:
    """Return which altitudes are not above the highest estimate of their profile."""
    used = information > 0.0
    reached: Booleans = np.cumsum(used[:, ::-1], axis=1)[:, ::-1] > 0
    return reached


def _block(
    problem: _inputs.VerticalProblem,
    member: Integers,
    moments: ResidualMoments | None,
    stiffness: Array,
) -> _Block:
    estimates, information = problem.optical_depth[member], problem.information[member]
    used = information > 0.0
    limit = _LARGEST_INFORMATION * float(np.median(information[used]))
    highest = int(np.flatnonzero(used.any(axis=0))[-1])
    correlation, amplitude, share = 0.0, 1.0, np.zeros_like(estimates)
    gaps = np.zeros(0, dtype=np.int64)
    if moments is not None:
        correlation, amplitude = _correlation.fit_correlation(
            moments.lag_products[member], moments.lag_norms[member]
        )
        share = np.clip(moments.inhomogeneity_share[member] * amplitude, 0.0, 1.0)
        gaps = np.flatnonzero(moments.gaps[member])
    return _Block(
        estimates,
        np.minimum(information, limit),
        share,
        correlation,
        stiffness,
        float(problem.altitude[highest]) - problem.station_altitude,
        gaps,
    )


def _members(labels: npt.NDArray[np.int64], has_data: Booleans) -> list[Integers]:
    """Return, for each block, its profiles that have data, in ascending order."""
    order = np.argsort(labels, kind="stable")
    bounds = np.flatnonzero(np.diff(labels[order])) + 1
    members = [group[has_data[group]] for group in np.split(order, bounds)]
    return [member for member in members if member.size]


def _solve_block(block: _Block, *, robust: bool) -> _Fit:
    if not robust:
        return _fit(block, block.information)
    screened = _outliers.screen_outliers(block.estimates, block.information)
    fit = _fit(block, _outliers.reduce_information(block.information, screened))
    reduced = _outliers.downweight_outliers(
        block.estimates, block.information, block.share, fit.depth, fit.variance
    )
    return fit if reduced is None else _fit(block, reduced)


@dataclass(frozen=True, slots=True)
class _SolvedBlock:
    """One block with its solution."""

    member: Integers
    block: _Block
    fit: _Fit
    noise: BlockNoise
    no_residual: bool

    def rows(self, step: Array) -> dict[str, Array]:
        """Return the (member, altitude) arrays of the solution, with their errors calibrated."""
        rows = np.arange(step.size)
        fit, from_station = self.fit, np.full(step.size, -1)
        return {
            "optical_depth": fit.depth,
            "optical_depth_variance": fit.variance * self.noise.ratio(rows, from_station),
            "extinction": fit.extinction / step,
            "extinction_variance": fit.extinction_variance
            * self.noise.ratio(rows, rows - 1)
            / step**2,
            "weight_in_own": fit.own,
        }

    def scalars(self) -> dict[str, Any]:
        """Return the (member,) arrays of the solution."""
        return {
            "effective_degrees_of_freedom": self.fit.own.sum(axis=1),
            "correlation": self.block.correlation,
            "smoothing": self.fit.choice.mean_smoothing,
        }


def _solve_and_calibrate(
    problem: _inputs.VerticalProblem,
    member: Integers,
    moments: ResidualMoments | None,
    within: Booleans,
    *,
    robust: bool,
) -> _SolvedBlock:
    stiffness = _banded.penalty(problem.altitude, problem.station_altitude)
    block = _block(problem, member, moments, stiffness)
    freedom = None if moments is None else moments.degrees_of_freedom[member]
    most = np.inf if freedom is None else float(freedom.max())
    fit = _solve_block(block, robust=robust and most >= _LEAST_FREEDOM_TO_REJECT)
    calibrated = member.size >= _smoothing_choice.FEWEST_TO_CHOOSE
    noise = BlockNoise(
        member,
        _calibrate(block, fit, within) if calibrated else None,
        _inflation(freedom, block.correlation, problem.altitude.size),
    )
    return _SolvedBlock(member, block, fit, noise, most <= 0.0)


def solve_vertical_blocks(
    problem: _inputs.VerticalProblem,
    labels: npt.NDArray[np.int64],
    moments: ResidualMoments | None,
    *,
    robust: bool,
) -> VerticalSolution:
    """Solve all blocks (see `smooth_profile.smooth_optical_depth`)."""
    shape = problem.optical_depth.shape
    step = np.diff(problem.altitude, prepend=problem.station_altitude)
    within = _within_reach(problem.information)
    rows = {name: np.full(shape, np.nan) for name in _ROWS}
    scalars = {name: np.full(shape[0], np.nan) for name in _SCALARS}
    information, bands = np.zeros(shape), np.zeros((3, *shape))
    downweighted = np.zeros(shape, dtype=np.bool_)
    saturated, no_residual = np.zeros((2, shape[0]), dtype=np.bool_)
    pairs, blocks = [_NO_PAIRS], []
    for candidates in _members(labels, within[:, 0]):
        member = _informative(problem, candidates)
        within[np.setdiff1d(candidates, member)] = False
        solved = _solve_and_calibrate(problem, member, moments, within[member], robust=robust)
        fit = solved.fit
        for name, values in solved.rows(step).items():
            rows[name][member] = np.where(within[member], values, np.nan)
        for name, value in solved.scalars().items():
            scalars[name][member] = value
        information[member], bands[:, member] = fit.information, fit.bands
        downweighted[member] = fit.information < solved.block.information * _DOWNWEIGHTED_BELOW
        saturated[member], no_residual[member] = fit.choice.saturated, solved.no_residual
        pairs.append(replace(fit.pairs, profile=member[fit.pairs.profile]))
        blocks.append(solved.noise)
    system = VerticalSystem(
        problem.altitude,
        problem.station_altitude,
        problem.optical_depth,
        information,
        within,
        bands,
        _banded.penalty(problem.altitude, problem.station_altitude),
        _joined(pairs),
        tuple(blocks),
    )
    return VerticalSolution(
        **rows,
        **scalars,
        downweighted=downweighted,
        saturated=saturated,
        no_residual=no_residual,
        system=system,
    )


def _joined(pairs: list[Pairs]) -> Pairs:
    return Pairs(
        *(np.concatenate([getattr(pair, field.name) for pair in pairs]) for field in fields(Pairs))
    )


_ROWS: Final = (
    "optical_depth",
    "optical_depth_variance",
    "extinction",
    "extinction_variance",
    "weight_in_own",
)
_SCALARS: Final = ("effective_degrees_of_freedom", "correlation", "smoothing")
_NO_PAIRS: Final = Pairs(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0))
