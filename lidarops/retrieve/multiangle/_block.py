"""One block of a scan: logarithms, the inhomogeneity of its air, and the fit at each height."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numba
import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle import _sample_mask, robust_weights
from lidarops.retrieve.multiangle.slant_paths import Scan, surrounds_zenith
from lidarops.retrieve.multiangle.vertical import gaps as _gaps

Array = npt.NDArray[np.float64]

WINDOW: Final = 15
"""Bins over which the inhomogeneity is pooled."""
_FIRST_GUESS: Final = 0.03**2
_LEAST_GUESS: Final = 0.01
_FEWEST_FREEDOM: Final = 4.1
OUTLYING: Final = 4.5
"""Least of the standard errors beyond which a residual calls for the robust passes."""
FALSE_ALARM: Final = 0.01
"""Probability that normal residuals, as many as there are, call for them by chance."""
GRADIENT_WINDOW: Final = 1000.0
"""m, over which the residuals are searched for a gradient."""
GRADIENT_LIMIT: Final = 4.0
"""Standard errors."""
_GRADIENT_NOISE: Final = 0.02
"""Variance of a logarithm (a signal of 7 times its noise) above which its skew, in the mean over
many profiles, looks like a gradient."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True, slots=True)
class BeamBlock:
    """Logarithms of one block of profiles, and where its beams lead."""

    logarithm: Array
    """(profile, angle, altitude); 0 where there is no sample."""
    noise: Array
    """Their variances; inf where there is no sample."""
    path: Array
    """(angle, altitude), finite."""
    distance: Array
    """(2, angle, altitude), finite: horizontal distance over altitude, eastward and northward."""
    alive: npt.NDArray[np.intp]
    """(profile, altitude): beams that are not yet lost in noise."""
    sides: bool
    """Whether beams lead to all sides."""
    needed: int
    """Beams that a height needs to be within the reach."""
    gaps: npt.NDArray[np.bool_]
    """(profile,): whether samples are missing between others."""


@dataclass(frozen=True, slots=True)
class Regression:
    """What the fit at each height gave."""

    table: Array
    """(profile, column, altitude), columns of `lidarops.retrieve.multiangle._kano_hamilton`."""
    inhomogeneity: Array
    """(altitude,): variance of the logarithms on top of the noise."""
    freedom: Array
    """(altitude,): residual degrees of freedom from which it comes; 0 where none."""
    keep: Array
    """(profile, angle or 0, altitude): factors of the weights."""
    robust: bool
    residual: Array
    """(profile, angle, altitude): of the logarithms; NaN where there is no sample or fit."""
    leverage: Array

    def column(self, number: int) -> Array:
        """Return one column as (profile, altitude)."""
        return self.table[:, number]


def make_beam_block(signal: npt.NDArray[np.floating], variance: Array, scan: Scan) -> BeamBlock:
    """Take logarithms of one block.

    Parameters
    ----------
    signal, variance : (profile, angle, altitude) float
    scan : Scan
    """
    logarithm = np.empty(signal.shape)
    noise = np.empty(signal.shape)
    ends = np.empty(signal.shape[:2], dtype=np.int32)
    _sample_mask.take_logarithms(signal, variance, scan.usable, logarithm, noise, ends)
    bins = np.arange(signal.shape[-1])
    alive = (ends[:, :, np.newaxis] > bins).sum(axis=1)
    return BeamBlock(
        logarithm,
        noise,
        np.nan_to_num(scan.path, nan=1.0),
        np.nan_to_num(np.stack([scan.east, scan.north])),
        alive,
        surrounds_zenith(scan.leaning),
        min(3, max(int(scan.usable.sum()), 2)),
        _gaps.between(noise < np.inf, signal, variance),
    )


def regress(beams: BeamBlock, *, inhomogeneity: float | None, robust: bool) -> Regression:
    """Fit every height of one block.

    Parameters
    ----------
    beams : Beams
    inhomogeneity : float, optional
        Standard deviation of the logarithms on top of the noise; estimated from the residuals
        where not given.
    robust : bool
        Whether to weight outliers down, in a block that has some.
    """
    keep = np.ones((beams.noise.shape[0], 0, beams.noise.shape[2]))
    plain = _fit(beams, keep, inhomogeneity, (1.0, 1.0))
    if not robust or not _has_outliers(beams, plain):
        return plain
    return _fit_robustly(beams, inhomogeneity)


def gradient_found(
    beams: BeamBlock, fit: Regression, altitude: Array, correlation: float, slack: float
) -> npt.NDArray[np.bool_]:
    """Tell at which altitudes the residuals of a block show a horizontal gradient.

    Parameters
    ----------
    beams : Beams
    fit : Regression
    altitude : (altitude,) float
        m.
    correlation : float
        Of neighbouring heights.
    slack : float
        m-1, standard deviation of gradients that are of no concern.

    Returns
    -------
    (altitude,) bool
    """
    ratio = fit.residual * np.where(np.isnan(fit.residual), 0.0, _weights(beams, fit))
    ratio = np.nan_to_num(ratio)
    loudest = np.where(beams.noise < np.inf, beams.noise, 0.0).max(axis=1)
    on = (fit.column(kh.SIDES) == 0.0) & (loudest < _GRADIENT_NOISE)
    found = np.zeros(altitude.size, dtype=np.bool_)
    for d in beams.distance:
        shown = np.einsum("tak,ak->tk", ratio, d)
        known = _unexplained(beams, fit, d)
        tells = on & (known > 0.0)
        total = np.where(tells, shown * altitude, 0.0).sum(axis=0)
        square = np.where(tells, known * altitude**2, 0.0).sum(axis=0)
        inside = np.abs(altitude[:, np.newaxis] - altitude) <= 0.5 * GRADIENT_WINDOW
        weight = inside @ square
        spread = weight * (1.0 + correlation) / (1.0 - correlation) + (slack * weight) ** 2
        found |= np.abs(inside @ total) > GRADIENT_LIMIT * np.sqrt(spread)
    return found


def _unexplained(beams: BeamBlock, fit: Regression, d: Array) -> Array:
    """Return the weighted squares of a distance that path and constant leave, (profile, bin)."""
    weights = _weights(beams, fit)
    whole = weights.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        centre_d = np.einsum("tak,ak->tk", weights, d) / whole
        centre_x = np.einsum("tak,ak->tk", weights, beams.path) / whole
        off_d = d - centre_d[:, np.newaxis]
        off_x = beams.path - centre_x[:, np.newaxis]
        cross = (weights * off_d * off_x).sum(axis=1)
        square = (weights * off_x**2).sum(axis=1)
        left = (weights * off_d**2).sum(axis=1) - cross**2 / square
    return np.where(fit.column(kh.FREEDOM) > 0, np.nan_to_num(left), 0.0)


def weights_of(beams: BeamBlock, fit: Regression) -> Array:
    """Return the weights of the fit as (profile, angle, altitude)."""
    return _weights(beams, fit)


def kept_information(beams: BeamBlock, fit: Regression) -> Array:
    """Return the information that outliers and gaps leave of that of all beams, (profile, altitude).

    An altitude that lost a beam has all the noise that it shares with others, and more of its own.
    """
    noise = _without_gaps(beams.noise)
    if noise is beams.noise and not fit.robust:
        return np.ones((beams.noise.shape[0], beams.noise.shape[2]))
    kept = _squares_of_path(beams, _weights(beams, fit))
    whole = _squares_of_path(beams, 1.0 / (noise + fit.inhomogeneity))
    return np.where(whole > 0.0, np.minimum(kept / np.where(whole > 0.0, whole, 1.0), 1.0), 1.0)


def _without_gaps(noise: Array) -> Array:
    """Return variances of samples that are missing between others, too, as these have them."""
    there = noise < np.inf
    if not np.any(there[..., 1:] & ~there[..., :-1]):
        return noise
    bins = np.arange(noise.shape[-1])
    below = np.maximum.accumulate(np.where(there, bins, -1), axis=-1)
    above = np.where(there, bins, bins.size)[..., ::-1]
    above = np.minimum.accumulate(above, axis=-1)[..., ::-1]
    ends = np.maximum(below, 0), np.minimum(above, bins.size - 1)
    first, last = (np.sqrt(np.take_along_axis(noise, end, axis=-1)) for end in ends)
    between = (below >= 0) & (above < bins.size)
    return np.where(there, noise, np.where(between, first * last, np.inf))


def _squares_of_path(beams: BeamBlock, weights: Array) -> Array:
    whole = weights.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = np.einsum("tak,ak->tk", weights, beams.path) / whole
        square = np.einsum("tak,ak->tk", weights, beams.path**2) - whole * centre**2
    squares: Array = np.nan_to_num(square)
    return squares


def common_scale(beams: BeamBlock, fit: Regression) -> Array:
    """Return what makes residuals of two altitudes as alike as their errors, (profile, altitude).

    The bisquare makes residuals small; and with other beams left out, other parts of the errors
    are left in the residuals.
    """
    shape = (beams.noise.shape[0], beams.noise.shape[2])
    if not fit.robust:
        return np.ones(shape)
    of_chi2 = robust_weights.clean_moments(robust_weights.PASS_WIDTH)[0]
    count = np.count_nonzero(beams.noise < np.inf, axis=1) - 2.0 - fit.column(kh.SIDES)
    expected = fit.column(kh.EXPECTED)
    told = expected > 0.0
    ratio = np.where(told, count / np.where(told, expected, 1.0), 1.0)
    scale: Array = np.sqrt(np.maximum(ratio, 1.0) / of_chi2)
    return scale


def _weights(beams: BeamBlock, fit: Regression) -> Array:
    weights = 1.0 / (beams.noise + fit.inhomogeneity)
    return weights * fit.keep if fit.keep.shape[1] > 0 else weights


def _fit(
    beams: BeamBlock, keep: Array, inhomogeneity: float | None, moments: tuple[float, float]
) -> Regression:
    """Estimate the inhomogeneity from a first guess and once again from that; fit with it."""
    if inhomogeneity is not None:
        return _fit_known(beams, keep, np.full(keep.shape[2], inhomogeneity**2), moments[1])
    table = np.empty((beams.noise.shape[0], kh.COLUMNS, beams.noise.shape[2]))
    variance = np.full(keep.shape[2], _FIRST_GUESS)
    for _ in range(2):
        # A guess of zero would give one altitude all the weight of its window.
        guess = np.maximum(variance, _LEAST_GUESS * variance.max())
        _run(beams, keep, guess, table)
        variance, freedom = _dersimonian_laird(table, guess, moments[0])
    return replace(_fit_known(beams, keep, variance, moments[1]), freedom=freedom)


def _fit_known(beams: BeamBlock, keep: Array, variance: Array, of_information: float) -> Regression:
    table = np.empty((beams.noise.shape[0], kh.COLUMNS, beams.noise.shape[2]))
    residual, leverage = np.empty(beams.noise.shape), np.empty(beams.noise.shape)
    y, x, d = beams.logarithm, beams.path, beams.distance
    noise = beams.noise
    if beams.sides:
        kh.fit_bins(y, noise, keep, variance, x, d, beams.sides, table, residual, leverage)
    else:
        kh.fit_details(y, noise, keep, variance, x, d, table, residual, leverage)
    table[:, kh.INFORMATION] *= of_information
    freedom = np.zeros_like(variance)
    return Regression(table, variance, freedom, keep, keep.shape[1] > 0, residual, leverage)


def _run(beams: BeamBlock, keep: Array, variance: Array, table: Array) -> None:
    y, noise, x, d = beams.logarithm, beams.noise, beams.path, beams.distance
    if beams.sides:
        nothing = np.empty((0, *noise.shape[1:]))
        kh.fit_bins(y, noise, keep, variance, x, d, beams.sides, table, nothing, nothing)
    else:
        kh.fit_kano_hamilton(y, noise, keep, variance, x, table)


def _dersimonian_laird(table: Array, before: Array, of_chi2: float) -> tuple[Array, Array]:
    r"""Return the variance of the inhomogeneity, and the degrees of freedom behind it.

    .. math:: s^2 = \max\left(0,
              \frac{\sum [s_0^2 \sum w (1 - h) + Q - E(Q)]}{\sum \sum w (1 - h)}\right),

    pooled over the block and a window of bins (`dersimonian1986`).
    """
    freedom = _windowed(table[:, kh.FREEDOM].sum(axis=0))
    trace = table[:, kh.TRACE].sum(axis=0)
    excess = (table[:, kh.CHI2] / of_chi2 - table[:, kh.EXPECTED]).sum(axis=0)
    whole, total = _windowed(trace), _windowed(before * trace + excess)
    known = whole > 0.0
    if not np.any(known):
        return np.zeros_like(before), freedom
    variance = np.maximum(total[known] / whole[known], 0.0)
    bins = np.arange(before.size)
    return np.interp(bins, bins[known], variance), freedom


@_compiled
def _windowed(values: Array) -> Array:
    """Return sums over the window around each bin, as far as there are bins."""
    half = WINDOW // 2
    total = np.zeros(values.size)
    for k in range(values.size):
        for j in range(max(k - half, 0), min(k + half + 1, values.size)):
            total[k] += values[j]
    return total


def pooled_freedom(fit: Regression) -> Array:
    """Return the residual degrees of freedom of the block around each bin, (altitude,)."""
    return _windowed(fit.column(kh.FREEDOM).sum(axis=0))


def student_factor(freedom: Array) -> Array:
    """Return by how much few degrees of freedom widen a standard error."""
    nu = np.maximum(freedom, _FEWEST_FREEDOM)
    return np.where(freedom > 0, np.sqrt(nu / (nu - 2.0)), 1.0)


def _has_outliers(beams: BeamBlock, fit: Regression) -> bool:
    if (
        np.max(np.count_nonzero(beams.noise < np.inf, axis=1), initial=0)
        < robust_weights.FEWEST_BEAMS
    ):
        return False
    largest, count = robust_weights.largest_residual(
        fit.residual, fit.leverage, beams.noise, fit.inhomogeneity
    )
    return largest > outlying(count)


def outlying(count: int) -> float:
    """Return the standard errors beyond which one of so many residuals is no chance."""
    return max(OUTLYING, -float(ndtri(0.5 * FALSE_ALARM / max(count, 1))))


def _fit_robustly(beams: BeamBlock, inhomogeneity: float | None) -> Regression:
    residual = np.empty(beams.noise.shape)
    robust_weights.start_residuals(beams.logarithm, beams.noise, beams.path, residual)
    scale = _start_scale(beams, residual) if inhomogeneity is None else inhomogeneity**2
    keep = np.empty(beams.noise.shape)
    variance = np.broadcast_to(np.asarray(scale), beams.noise.shape[2:]).astype(np.float64)
    robust_weights.pair_residuals(beams.logarithm, beams.noise, beams.path, variance, residual)
    width = robust_weights.START_WIDTH
    leverage = np.zeros(beams.noise.shape)
    for _ in range(3):
        robust_weights.fill_robust_weights(residual, leverage, beams.noise, variance, width, keep)
        fit = _fit(beams, keep, inhomogeneity, robust_weights.clean_moments(width))
        residual, leverage, variance = fit.residual, fit.leverage, fit.inhomogeneity
        width = robust_weights.PASS_WIDTH
    return fit


def _start_scale(beams: BeamBlock, residual: Array) -> Array:
    """Return the variance of the inhomogeneity as medians tell it, averaged over the window."""
    variance, samples = np.empty(residual.shape[2]), np.empty(residual.shape[2])
    robust_weights.median_variance(residual, beams.noise, variance, samples)
    total = _windowed(samples)
    return np.where(total > 0, _windowed(variance * samples) / np.maximum(total, 1.0), 0.0)


def end_beams(beams: BeamBlock) -> BeamBlock:
    """Return the beams with the shortest and the longest path of every altitude alone."""
    on = beams.noise < np.inf
    shortest = np.where(on, beams.path, np.inf)
    longest = np.where(on, beams.path, -np.inf)
    number = np.arange(beams.path.shape[0])[:, np.newaxis]
    ends = (number == shortest.argmin(axis=1)[:, np.newaxis]) | (
        number == longest.argmax(axis=1)[:, np.newaxis]
    )
    noise = np.where(on & ends, beams.noise, np.inf)
    return replace(beams, noise=noise, sides=False, needed=2)


def refit(beams: BeamBlock, inhomogeneity: Array, freedom: Array) -> Regression:
    """Fit with an inhomogeneity that is known from elsewhere, with so many degrees of freedom."""
    keep = np.ones((beams.noise.shape[0], 0, beams.noise.shape[2]))
    fit = _fit_known(beams, keep, inhomogeneity, 1.0)
    return replace(fit, freedom=freedom)
