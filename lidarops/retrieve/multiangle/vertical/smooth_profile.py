"""Combine optical depths of single altitudes into a profile with smooth extinction.

A scan gives the optical depth of each altitude independently
(`lidarops.retrieve.multiangle.optical_depth`). Altitudes are connected because extinction changes
gradually and the optical depth is zero at the lidar. The smoothest profile that fits the data is
the solution of one pentadiagonal system, computed exactly in one sweep.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS
from lidarops.retrieve.multiangle.vertical import _correlation
from lidarops.retrieve.multiangle.vertical._block import (
    Estimates,
    VerticalSolution,
    solve_vertical,
)
from lidarops.retrieve.multiangle.vertical._correlation import ResidualMoments

Array = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]
Integers = npt.NDArray[np.int64]
_Rows = TypeVar("_Rows", Array, Booleans)

LARGEST_DEPTH: Final = 1e6
"""Optical depth beyond which an estimate counts as missing."""
_INFORMATION: Final = (1e-16, 1e16)
"""Information below which an estimate counts as missing, and its upper limit."""
_UNIFORM: Final = 1e-3
"""Largest relative deviation of a step from the mean step; allows for rounded altitudes."""


@dataclass(frozen=True, slots=True)
class VerticalResult:
    """Smoothed profiles. Arrays are (profile, altitude) or (profile,); NaN where withheld."""

    optical_depth: Array
    """From the lidar to the altitude, NaN beyond the reach."""
    optical_depth_standard_error: Array
    """Random error and smoothing error."""
    extinction: Array
    """m-1, mean of the layer between the altitude and the next lower one (or the lidar)."""
    extinction_standard_error: Array
    """m-1."""
    data_share: Array
    """The solution smoothed once more, over the solution: 1 where smoothing changes nothing. NaN
    where the optical depth is not larger than its standard error."""
    effective_degrees_of_freedom: Array
    """(profile,): effective number of independent values in the profile."""
    correlation: float
    """Of the inhomogeneity at neighbouring altitudes."""
    interpolated: Booleans
    """(profile, altitude): no estimate there; interpolated from those around, or from the lidar."""
    downweighted: Booleans
    """(profile, altitude): the estimate is an outlier of its profile."""
    prior_dominated: Booleans
    """(profile, altitude): `saturated`, or `data_share` outside 0.9-1.1. Concerns extinction."""
    saturated: Booleans
    """(profile,): the best fit has the largest smoothness that is allowed."""
    undersmoothed: Booleans
    """(profile,): more than 10 degrees of freedom and more than 0.4 per altitude."""
    high_correlation: Booleans
    """(profile,): the correlation exceeds 0.85; standard errors may be too small."""
    solved: Integers
    """(member,): the profiles that have data."""
    solution: VerticalSolution
    """Of these profiles."""

    def respond(self, rows: Array) -> Array:
        """Return the solution for other estimates with the same weights, NaN beyond the reach.

        This is linear: the smoother of each profile is applied to its row.

        Parameters
        ----------
        rows : (profile, altitude) float
            Finite wherever there was an estimate.
        """
        responses = self.solution.respond(rows[self.solved])
        return self._scattered(np.where(self.solution.within, responses, np.nan))

    def layer(self, lower: int, upper: int) -> tuple[Array, Array]:
        """Return the optical depth between two altitudes, and its standard error, (profile,).

        The standard error is far smaller than that of a difference with independent errors.

        Parameters
        ----------
        lower, upper : int
            Indices of altitudes in ascending order, -1 for the lidar.
        """
        depth = self.optical_depth[:, upper].copy()
        if lower >= 0:
            depth -= self.optical_depth[:, lower]
        error = np.sqrt(self.solution.layer_variance(lower, upper))
        return depth, self._scattered(np.where(self.solution.within[:, upper], error, np.nan))

    def _scattered(self, rows: Array) -> Array:
        return _scattered(rows, self.solved, len(self.optical_depth))


def residual_moments(
    residual: Array,
    weight: Array,
    leverage: Array,
    inhomogeneity_variance: Array,
    inhomogeneity_share: Array,
    gaps: Booleans,
) -> ResidualMoments:
    r"""Return the sums over residuals of a fit over beams that `smooth_optical_depth` needs.

    Parameters
    ----------
    residual : (profile, beam, altitude) float
        Logarithm of the signal minus its fit.
    weight : (profile, beam, altitude) float
        :math:`w = 1 / (v + s^2)`; zero or NaN where a beam was not used.
    leverage : (profile, beam, altitude) float
        Diagonal of the hat matrix, :math:`h = w (1 / \sum w + (x - \bar x)^2 / S_{xx})`.
    inhomogeneity_variance : (altitude,) float
        :math:`s^2`.
    inhomogeneity_share : (profile, altitude) float
        :math:`f = s^2 \sum w^2 (x - \bar x)^2 / S_{xx}`, the share of :math:`s^2` in the
        variance of the optical depth.
    gaps : (profile,) bool
        Whether samples are missing between others, so that neighbouring altitudes come from
        different beams.
    """
    products, norms, freedom = _correlation.lag_sums(
        residual, weight, leverage, inhomogeneity_variance
    )
    share = np.clip(np.nan_to_num(inhomogeneity_share), 0.0, 1.0)
    return ResidualMoments(products, norms, share, freedom, gaps)


def smooth_optical_depth(
    optical_depth: Array,
    information: Array,
    altitude: Array,
    *,
    residuals: ResidualMoments | None = None,
    robust: bool = True,
) -> VerticalResult | None:
    r"""Return profiles with smooth extinction from optical depths of single altitudes.

    None where no profile has an estimate.

    Minimises

    .. math:: (\tau - t)' \Omega (\tau - t)
              + \lambda \int (d \alpha / d z)^2 dz, \quad \tau(z_0) = 0,

    with the estimates :math:`t`, their precision :math:`\Omega` (of an autoregressive process
    along altitude with the variance and the low-frequency power of the noise) and the extinction
    :math:`\alpha`. There is no iteration: the correlation comes from residuals 1 to 3 altitudes
    apart, :math:`\lambda` from a fixed grid, and the solution from one sweep.

    The correlation, :math:`\lambda` and the calibration of the standard errors are common to the
    profiles. With 8 profiles or more, :math:`\lambda` has the largest restricted likelihood or,
    where that smooths more than Mallows' :math:`C_p` allows, the least :math:`C_p`. The standard
    errors are calibrated at each altitude with the change of a rougher pilot solution by
    smoothing: its average over the profiles, for each profile in proportion to its optical depth,
    but at least 0.7 of the usual variance. With fewer profiles, solutions are averaged over
    :math:`\lambda`, weighted by their likelihood.

    Parameters
    ----------
    optical_depth : (profile, altitude) float
        Estimates of single altitudes; NaN where there is none.
    information : (profile, altitude) float
        Reciprocal variances; NaN or 0 where there is no estimate. An estimate that is not
        finite, or beyond 1e6, is treated as missing; information is limited to 1e6 times the
        median. A profile with less than 1e-4 of the typical information is treated as empty.
    altitude : (altitude,) float
        m above the lidar, ascending and uniform.
    residuals : ResidualMoments, optional
        If not given, the estimates are taken as uncorrelated, with exactly known variance.
    robust : bool
        Whether to give outlying estimates less weight: first those more than 6 standard errors
        from the median of 15 altitudes; then, if any is more than 4.5 standard errors from the
        solution, all by Tukey's bisquare at 6 standard errors. Not done if `residuals` come from
        fewer than 4 beams, nor in a profile where more than half would lose weight.

    Raises
    ------
    RetrievalInputError
        For altitudes that are not uniform.

    References
    ----------
    patterson1971 (likelihood), mallows1973 (Cp), wahba1983 (intervals), takahashi1973
    (variances), beaton1974 (bisquare).
    """
    _require_uniform(altitude)
    depth, weight = _valid(optical_depth, information)
    solved = _informative(weight, altitude)
    if solved.size == 0:
        return None
    moments = None if residuals is None else residuals.of(solved)
    estimates = Estimates(depth[solved], weight[solved], altitude, moments)
    solution = solve_vertical(estimates, robust=robust)
    return _result(solution, np.diff(altitude, prepend=0.0), solved, len(depth))


def _require_uniform(altitude: Array) -> None:
    steps = np.diff(altitude)
    mean = (altitude[-1] - altitude[0]) / max(steps.size, 1)
    if np.any(np.abs(steps - mean) > _UNIFORM * mean):
        raise RetrievalInputError(
            "is not uniform", field="altitude", remedy="interpolate the signals to a uniform grid"
        )


def _valid(optical_depth: Array, information: Array) -> tuple[Array, Array]:
    """Return estimates and their information, both 0 where there is no valid estimate."""
    valid = np.isfinite(information) & (information >= _INFORMATION[0])
    valid &= np.abs(optical_depth) <= LARGEST_DEPTH
    weight = np.where(valid, np.minimum(information, _INFORMATION[1]), 0.0)
    return np.where(valid, optical_depth, 0.0), weight


def _informative(information: Array, altitude: Array) -> Integers:
    """Return the profiles whose information is not negligible beside that of the others."""
    candidates = np.flatnonzero((information > 0.0).any(axis=1))
    total = (information[candidates] * altitude**2).sum(axis=1)
    return (
        candidates[total >= THRESHOLDS.negligible_information * np.median(total)]
        if total.size
        else candidates
    )


def _result(
    solution: VerticalSolution, step: Array, solved: Integers, profiles: int
) -> VerticalResult:
    """Return the public result; rows of other profiles are NaN or False."""
    fit, within, used = solution.fit, solution.within, solution.fit.information > 0.0
    variance, extinction_variance = solution.errors(step)
    error = np.sqrt(variance)
    response = solution.respond(fit.depth)
    certain = within & (np.abs(fit.depth) > error)
    share = np.where(certain, response / np.where(certain, fit.depth, 1.0), np.nan)
    smoothed = certain & ~((share >= THRESHOLDS.least_share) & (share <= THRESHOLDS.largest_share))
    freedom = fit.own.sum(axis=1)
    everywhere = np.ones(solved.size, np.bool_)

    def values(rows: Array) -> Array:
        return _scattered(np.where(within, rows, np.nan), solved, profiles)

    def flags(rows: Booleans) -> Booleans:
        return _scattered(rows, solved, profiles)

    return VerticalResult(
        optical_depth=values(fit.depth),
        optical_depth_standard_error=values(error),
        extinction=values(fit.extinction / step),
        extinction_standard_error=values(np.sqrt(extinction_variance)),
        data_share=values(share),
        effective_degrees_of_freedom=_scattered(freedom, solved, profiles),
        correlation=solution.block.correlation,
        interpolated=flags(within & ~used),
        downweighted=flags(solution.downweighted),
        prior_dominated=flags(within & (fit.saturated | smoothed)),
        saturated=flags(fit.saturated & everywhere),
        undersmoothed=flags(
            (freedom > THRESHOLDS.most_freedom) & (freedom > THRESHOLDS.roughest * used.sum(axis=1))
        ),
        high_correlation=flags(
            (solution.block.correlation > THRESHOLDS.highest_correlation) & everywhere
        ),
        solved=solved,
        solution=solution,
    )


def _scattered(rows: _Rows, solved: Integers, profiles: int) -> _Rows:
    """Return rows of the solved profiles among all profiles; NaN or False for others."""
    missing = np.nan if rows.dtype.kind == "f" else False
    out: _Rows = np.full((profiles, *rows.shape[1:]), missing)
    out[solved] = rows
    return out
