"""One block of a scan: logarithms, inhomogeneity of the air, and the fit at each altitude."""

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
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS
from lidarops.retrieve.multiangle.vertical import gaps as _gaps

Array = npt.NDArray[np.float64]

WINDOW: Final = THRESHOLDS.pooled

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True, slots=True)
class BeamBlock:
    """Logarithms of one block of profiles, and the geometry of its beams."""

    logarithm: Array
    """(profile, angle, altitude); 0 where there is no sample."""
    noise: Array
    """Their variances; inf where there is no sample."""
    path: Array
    """(angle, altitude), finite."""
    distance: Array
    """(2, angle, altitude), finite: horizontal distance over altitude, eastward and northward."""
    alive: npt.NDArray[np.intp]
    """(profile, altitude): number of beams not yet lost in noise."""
    sides: bool
    """Whether beams point to all sides."""
    needed: int
    """Beams that an altitude needs to be within the reach."""
    gaps: npt.NDArray[np.bool_]
    """(profile,): whether samples are missing between others."""


@dataclass(frozen=True, slots=True)
class Regression:
    """Result of the fit at each altitude."""

    table: Array
    """(profile, column, altitude), columns of `lidarops.retrieve.multiangle._kano_hamilton`."""
    inhomogeneity: Array
    """(altitude,): variance of the logarithms on top of the noise."""
    freedom: Array
    """(altitude,): residual degrees of freedom of `inhomogeneity`; 0 where none."""
    keep: Array
    """(profile, angle or 0, altitude): factors of the weights."""
    robust: bool
    """Whether the robust passes ran."""
    residual: Array
    """(profile, angle, altitude): of the logarithms; NaN where there is no sample or fit."""
    leverage: Array
    """(profile, angle, altitude): diagonal of the hat matrix."""

    def column(self, number: int) -> Array:
        """Return one column as (profile, altitude)."""
        return self.table[:, number]


def make_beam_block(signal: npt.NDArray[np.floating], variance: Array, scan: Scan) -> BeamBlock:
    """Return logarithms and geometry of one block.

    Parameters
    ----------
    signal, variance : (profile, angle, altitude) float
    scan : Scan
    """
    logarithm = np.empty(signal.shape)
    noise = np.empty(signal.shape)
    ends = np.empty(signal.shape[:2], dtype=np.int32)
    _sample_mask.take_logarithms(signal, variance, scan.usable, logarithm, noise, ends)
    altitudes = np.arange(signal.shape[-1])
    alive = (ends[:, :, np.newaxis] > altitudes).sum(axis=1)
    return BeamBlock(
        logarithm,
        noise,
        np.nan_to_num(scan.path, nan=1.0),
        np.nan_to_num(np.stack([scan.east, scan.north])),
        alive,
        surrounds_zenith(scan.tilted_azimuths),
        min(3, max(int(scan.usable.sum()), 2)),
        _gaps.profiles_with_gaps(noise < np.inf, signal, variance),
    )


def regress(beams: BeamBlock, *, inhomogeneity: float | None, robust: bool) -> Regression:
    """Fit every altitude of one block.

    Parameters
    ----------
    beams : BeamBlock
    inhomogeneity : float, optional
        Standard deviation of the logarithms on top of the noise; estimated from the residuals
        if not given.
    robust : bool
        Whether to give outliers less weight, if the block has any.
    """
    keep = np.ones((beams.noise.shape[0], 0, beams.noise.shape[2]))
    plain = _fit(beams, keep, inhomogeneity, (1.0, 1.0))
    if not robust or not _has_outliers(beams, plain):
        return plain
    return _fit_robustly(beams, inhomogeneity)


def shows_gradient(
    beams: BeamBlock, fit: Regression, altitude: Array, correlation: float, slack: float
) -> npt.NDArray[np.bool_]:
    """Return at which altitudes the residuals of a block show a horizontal gradient.

    Parameters
    ----------
    beams : BeamBlock
    fit : Regression
    altitude : (altitude,) float
        m.
    correlation : float
        Of neighbouring altitudes.
    slack : float
        m-1, standard deviation of gradients that are small enough to ignore.

    Returns
    -------
    (altitude,) bool
    """
    ratio = fit.residual * np.where(np.isnan(fit.residual), 0.0, weights_of(beams, fit))
    ratio = np.nan_to_num(ratio)
    noisiest = np.where(beams.noise < np.inf, beams.noise, 0.0).max(axis=1)
    testable = (fit.column(kh.SIDES) == 0.0) & (noisiest < THRESHOLDS.gradient_noise)
    gradient = np.zeros(altitude.size, dtype=np.bool_)
    for d in beams.distance:
        product = np.einsum("tak,ak->tk", ratio, d)
        known = _unexplained(beams, fit, d)
        used = testable & (known > 0.0)
        total = np.where(used, product * altitude, 0.0).sum(axis=0)
        square = np.where(used, known * altitude**2, 0.0).sum(axis=0)
        inside = np.abs(altitude[:, np.newaxis] - altitude) <= 0.5 * THRESHOLDS.gradient_window
        weight = inside @ square
        spread = weight * (1.0 + correlation) / (1.0 - correlation) + (slack * weight) ** 2
        gradient |= np.abs(inside @ total) > THRESHOLDS.gradient_limit * np.sqrt(spread)
    return gradient


def _unexplained(beams: BeamBlock, fit: Regression, d: Array) -> Array:
    """Return the weighted squares of a distance not explained by path and constant.

    The shape is (profile, altitude).
    """
    weights = weights_of(beams, fit)
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
    weights = 1.0 / (beams.noise + fit.inhomogeneity)
    return weights * fit.keep if fit.keep.shape[1] > 0 else weights


def kept_information(beams: BeamBlock, fit: Regression) -> Array:
    """Return the information left by outliers and gaps over that of all beams, (profile, altitude).

    An altitude that lost a beam has the same noise in common with other altitudes, and more noise
    of its own.
    """
    noise = _without_gaps(beams.noise)
    if noise is beams.noise and not fit.robust:
        return np.ones((beams.noise.shape[0], beams.noise.shape[2]))
    kept = _squares_of_path(beams, weights_of(beams, fit))
    whole = _squares_of_path(beams, 1.0 / (noise + fit.inhomogeneity))
    return np.where(whole > 0.0, np.minimum(kept / np.where(whole > 0.0, whole, 1.0), 1.0), 1.0)


def _without_gaps(noise: Array) -> Array:
    """Return variances with gaps filled: the geometric mean of the samples below and above."""
    there = noise < np.inf
    if not np.any(there[..., 1:] & ~there[..., :-1]):
        return noise
    altitudes = np.arange(noise.shape[-1])
    below = np.maximum.accumulate(np.where(there, altitudes, -1), axis=-1)
    above = np.where(there, altitudes, altitudes.size)[..., ::-1]
    above = np.minimum.accumulate(above, axis=-1)[..., ::-1]
    ends = np.maximum(below, 0), np.minimum(above, altitudes.size - 1)
    first, last = (np.sqrt(np.take_along_axis(noise, end, axis=-1)) for end in ends)
    between = (below >= 0) & (above < altitudes.size)
    return np.where(there, noise, np.where(between, first * last, np.inf))


def _squares_of_path(beams: BeamBlock, weights: Array) -> Array:
    whole = weights.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = np.einsum("tak,ak->tk", weights, beams.path) / whole
        square = np.einsum("tak,ak->tk", weights, beams.path**2) - whole * centre**2
    squares: Array = np.nan_to_num(square)
    return squares


def residual_scale(beams: BeamBlock, fit: Regression) -> Array:
    """Return the scale that makes residuals of two altitudes as correlated as their errors.

    The shape is (profile, altitude). The bisquare makes residuals smaller; and if other beams are
    left out, other components of the errors remain in the residuals.
    """
    shape = (beams.noise.shape[0], beams.noise.shape[2])
    if not fit.robust:
        return np.ones(shape)
    of_chi2 = robust_weights.clean_moments(robust_weights.PASS_WIDTH)[0]
    count = np.count_nonzero(beams.noise < np.inf, axis=1) - 2.0 - fit.column(kh.SIDES)
    expected = fit.column(kh.EXPECTED)
    known = expected > 0.0
    ratio = np.where(known, count / np.where(known, expected, 1.0), 1.0)
    scale: Array = np.sqrt(np.maximum(ratio, 1.0) / of_chi2)
    return scale


def _fit(
    beams: BeamBlock, keep: Array, inhomogeneity: float | None, moments: tuple[float, float]
) -> Regression:
    """Estimate the inhomogeneity in two steps from a first guess, and fit with it."""
    if inhomogeneity is not None:
        return _fit_known(beams, keep, np.full(keep.shape[2], inhomogeneity**2), moments[1])
    variance, nothing = (
        np.full(keep.shape[2], THRESHOLDS.first_guess),
        np.empty((0, *beams.noise.shape[1:])),
    )
    for _ in range(2):
        # With a guess of zero, one altitude would have all the weight of its window.
        guess = np.maximum(variance, THRESHOLDS.least_guess * variance.max())
        table = _table(beams, keep, guess, nothing, nothing)
        variance, freedom = _dersimonian_laird(table, guess, moments[0])
    return replace(_fit_known(beams, keep, variance, moments[1]), freedom=freedom)


def _fit_known(beams: BeamBlock, keep: Array, variance: Array, of_information: float) -> Regression:
    residual, leverage = np.empty(beams.noise.shape), np.empty(beams.noise.shape)
    table = _table(beams, keep, variance, residual, leverage)
    table[:, kh.INFORMATION] *= of_information
    freedom = np.zeros_like(variance)
    return Regression(table, variance, freedom, keep, keep.shape[1] > 0, residual, leverage)


def _table(
    beams: BeamBlock, keep: Array, variance: Array, residual: Array, leverage: Array
) -> Array:
    """Return the fit of every altitude; residuals and leverages are filled if they have rows."""
    table = np.empty((beams.noise.shape[0], kh.COLUMNS, beams.noise.shape[2]))
    y, noise, x, d = beams.logarithm, beams.noise, beams.path, beams.distance
    kh.fit_levels(y, noise, keep, variance, x, d, beams.sides, table, residual, leverage)
    return table


def _dersimonian_laird(table: Array, before: Array, of_chi2: float) -> tuple[Array, Array]:
    r"""Return the variance of the inhomogeneity, and its degrees of freedom.

    .. math:: s^2 = \max\left(0,
              \frac{\sum [s_0^2 \sum w (1 - h) + Q - E(Q)]}{\sum \sum w (1 - h)}\right),

    pooled over the block and a window of altitudes (`dersimonian1986`).
    """
    freedom = _windowed(table[:, kh.FREEDOM].sum(axis=0))
    trace = table[:, kh.TRACE].sum(axis=0)
    excess = (table[:, kh.CHI2] / of_chi2 - table[:, kh.EXPECTED]).sum(axis=0)
    whole, total = _windowed(trace), _windowed(before * trace + excess)
    known = whole > 0.0
    if not np.any(known):
        return np.zeros_like(before), freedom
    variance = np.maximum(total[known] / whole[known], 0.0)
    altitudes = np.arange(before.size)
    return np.interp(altitudes, altitudes[known], variance), freedom


@_compiled
def _windowed(values: Array) -> Array:
    """Return sums over the window around each altitude, cut at the ends of the grid."""
    half = WINDOW // 2
    total = np.zeros(values.size)
    for k in range(values.size):
        for j in range(max(k - half, 0), min(k + half + 1, values.size)):
            total[k] += values[j]
    return total


def pooled_freedom(fit: Regression) -> Array:
    """Return the residual degrees of freedom in the window around each altitude, (altitude,)."""
    return _windowed(fit.column(kh.FREEDOM).sum(axis=0))


def student_factor(freedom: Array) -> Array:
    """Return the factor by which few degrees of freedom widen a standard error."""
    nu = np.maximum(freedom, THRESHOLDS.fewest_freedom)
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
    return largest > outlier_limit(count)


def outlier_limit(count: int) -> float:
    """Return the limit, in standard errors, that chance exceeds in 1 percent of blocks."""
    return max(
        THRESHOLDS.outlying_residual, -float(ndtri(0.5 * THRESHOLDS.false_alarm / max(count, 1)))
    )


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
    """Return the variance of the inhomogeneity from medians, averaged over the window."""
    variance, samples = np.empty(residual.shape[2]), np.empty(residual.shape[2])
    robust_weights.median_variance(residual, beams.noise, variance, samples)
    total = _windowed(samples)
    return np.where(total > 0, _windowed(variance * samples) / np.maximum(total, 1.0), 0.0)


def end_beams(beams: BeamBlock) -> BeamBlock:
    """Return only the beams with the shortest and the longest path at every altitude."""
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
    """Fit with a given inhomogeneity and its degrees of freedom."""
    keep = np.ones((beams.noise.shape[0], 0, beams.noise.shape[2]))
    fit = _fit_known(beams, keep, inhomogeneity, 1.0)
    return replace(fit, freedom=freedom)
