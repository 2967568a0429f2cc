"""The vertical solution of one block of profiles, and its standard errors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.multiangle.thresholds import THRESHOLDS
from lidarops.retrieve.multiangle.vertical import (
    _banded,
    _calibration,
    _correlation,
    _outliers,
    _smoothing_choice,
)
from lidarops.retrieve.multiangle.vertical import gaps as _gaps
from lidarops.retrieve.multiangle.vertical._correlation import ResidualMoments

Array = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Estimates:
    """Estimates of single altitudes of the profiles of a block that have data."""

    optical_depth: Array
    """(profile, altitude), 0 where there is no estimate."""
    information: Array
    """(profile, altitude), 0 where there is no estimate."""
    altitude: Array
    """(altitude,) m above the lidar."""
    moments: ResidualMoments | None
    """None where the noise is uncorrelated and exactly known."""


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
class _Block:
    """Estimates with the properties common to them."""

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
    """Solution of a block."""

    information: Array
    bands: Array
    saturated: bool
    """Whether the best weight of smoothness is the largest that is allowed."""
    pairs: Pairs
    depth: Array
    variance: Array
    extinction: Array
    """Optical depth of the layer from the altitude below."""
    extinction_variance: Array
    own: Array
    """Weight of each estimate in its own optical depth."""


@dataclass(frozen=True, slots=True)
class VerticalSolution:
    """Solution of the profiles of a block that have data, with the systems that were solved."""

    block: _Block
    fit: _Fit
    within: Booleans
    """(profile, altitude): within the reach."""
    calibration: _calibration.Calibration | None
    """None if the block is too small to be calibrated."""
    inflation: Array
    """(altitude,): factor on the variance because the noise is estimated from few residuals."""

    @property
    def downweighted(self) -> Booleans:
        """Where an estimate has less than half of its weight."""
        return self.fit.information < THRESHOLDS.majority * self.block.information

    def errors(self, step: Array) -> tuple[Array, Array]:
        """Return the calibrated variances of optical depths and of extinctions."""
        rows = np.arange(step.size)
        depth = self.fit.variance * self._ratio(rows, np.full(step.size, -1))
        return depth, self.fit.extinction_variance * self._ratio(rows, rows - 1) / step**2

    def respond(self, rows: Array) -> Array:
        """Apply the smoother of each profile to its row."""
        right = _banded.multiply_rows(
            self.fit.bands, np.where(self.fit.information > 0.0, rows, 0.0)
        )
        solved = self._solve(right)[0]
        return self.fit.pairs.total(solved, len(rows))

    def layer_variance(self, lower: int, upper: int) -> Array:
        """Return the calibrated variance of the optical depth between two altitudes, (profile,)."""
        right = np.zeros(self.block.estimates.shape)
        right[:, upper] = 1.0
        if lower >= 0:
            right[:, lower] = -1.0
        inverse = self._solve(right)[0]
        solved = self._solve(_banded.multiply_rows(self.fit.bands, self.block.estimates))[0]
        posterior, value = (
            rows[:, upper] - (rows[:, lower] if lower >= 0 else 0.0) for rows in (inverse, solved)
        )
        variance = _mixed(
            value[:, np.newaxis], posterior[:, np.newaxis], self.fit.pairs, len(right)
        )[1]
        variance *= self._ratio(np.array([upper]), np.array([lower]))
        return variance[:, 0]

    def _solve(self, right: Array) -> Array:
        return _solve_pairs(right, self.fit.bands, self.block.stiffness, self.fit.pairs)

    def _ratio(self, upper: Integers, lower: Integers) -> Array:
        """Return the factor on the posterior variance of differences of optical depths.

        The shape is (profile, difference), or (difference,) if common to all profiles.
        """
        below = np.where(lower >= 0, self.inflation[np.maximum(lower, 0)], 1.0)
        few: Array = np.maximum(self.inflation[upper], below)
        if self.calibration is None:
            return few
        bias = self.calibration.bias
        change = bias[:, upper] - np.where(lower >= 0, bias[:, np.maximum(lower, 0)], 0.0)
        factor: Array = few * _calibration.variance_ratio(self.calibration, upper, lower, change)
        return factor


def solve_vertical(estimates: Estimates, *, robust: bool) -> VerticalSolution:
    """Solve a block (see `smooth_profile.smooth_optical_depth`); every profile has an estimate."""
    block = _block(estimates)
    freedom = None if estimates.moments is None else estimates.moments.degrees_of_freedom
    most = np.inf if freedom is None else float(freedom.max())
    fit = _solve_block(block, robust=robust and most >= THRESHOLDS.fewest_beams - 2.0)
    within = within_reach(estimates.information)
    calibrated = len(within) >= THRESHOLDS.fewest_to_choose
    return VerticalSolution(
        block,
        fit,
        within,
        _calibrate(block, fit, within) if calibrated else None,
        _inflation(freedom, block.correlation, estimates.altitude.size),
    )


def within_reach(information: Array) -> Booleans:
    """Return which altitudes are not above the highest estimate of their profile."""
    used = information > 0.0
    reached: Booleans = np.cumsum(used[:, ::-1], axis=1)[:, ::-1] > 0
    return reached


def _block(estimates: Estimates) -> _Block:
    depth, information, moments = estimates.optical_depth, estimates.information, estimates.moments
    used = information > 0.0
    limit = THRESHOLDS.largest_information * float(np.median(information[used]))
    highest = int(np.flatnonzero(used.any(axis=0))[-1])
    correlation, amplitude, share = 0.0, 1.0, np.zeros_like(depth)
    gaps = np.zeros(0, dtype=np.int64)
    if moments is not None:
        correlation, amplitude = _correlation.fit_correlation(
            moments.lag_products, moments.lag_norms
        )
        share = np.clip(moments.inhomogeneity_share * amplitude, 0.0, 1.0)
        gaps = np.flatnonzero(moments.gaps)
    return _Block(
        depth,
        np.minimum(information, limit),
        share,
        correlation,
        _banded.penalty(estimates.altitude),
        float(estimates.altitude[highest]),
        gaps,
    )


def _solve_block(block: _Block, *, robust: bool) -> _Fit:
    if not robust:
        return _fit(block, block.information)
    screened = _outliers.screen_outliers(block.estimates, block.information)
    fit = _fit(block, _outliers.reduce_information(block.information, screened))
    reduced = _outliers.downweight_outliers(
        block.estimates, block.information, block.share, fit.depth, fit.variance
    )
    return fit if reduced is None else _fit(block, reduced)


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
        choice.saturated,
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
    return float(min(known.mean(), THRESHOLDS.usual_information * np.median(known)))


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
    total = np.convolve(freedom.sum(axis=0), np.ones(THRESHOLDS.pooled), mode="full")
    start = THRESHOLDS.pooled // 2
    square = correlation * correlation
    known = total[start : start + altitudes] * (1.0 - square) / (1.0 + square)
    known = np.maximum(known, THRESHOLDS.fewest_freedom)
    factor: Array = known / (known - 2.0)
    return factor
