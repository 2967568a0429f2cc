"""One block of a scan: logarithms, inhomogeneity of the air, and the fit at each altitude."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import ndtri, stdtrit

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle import _sample_mask, robust_weights
from lidarops.retrieve.multiangle.slant_paths import Scan, surrounds_zenith
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_UNKNOWNS: Final = 3
"""Constant, optical depth and a gradient."""
_LEAST_REST: Final = 1e-3
"""Least share of an error that a fit leaves in a residual."""
_DEPENDENT: Final = 1e-8
"""Squared length of a column outside those before it, over its own, up to which it depends on
them."""


@dataclass(frozen=True, slots=True)
class BeamBlock:
    """Logarithms of one block of profiles, and the geometry of its beams."""

    logarithm: Array
    """(profile, angle, altitude); 0 where there is no sample."""
    noise: Array
    """Their variances; inf where there is no sample."""
    design: Array
    """(3, angle, altitude), finite: horizontal distance over altitude, eastward and northward, and
    slant path."""
    alive: Indices
    """(profile, altitude): number of beams not yet lost in noise."""
    sides: bool
    """Whether beams point to all sides."""
    needed: int
    """Beams that an altitude needs to be within the reach."""
    gaps: Booleans
    """(profile,): whether samples are missing between others."""
    dead_time_change: Array | None = None
    """(profile, angle, altitude): of the signal, with one standard error of the dead time."""

    @property
    def path(self) -> Array:
        """Slant path, (angle, altitude)."""
        return np.asarray(self.design[2])


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


def make_beam_block(
    signal: Array, variance: Array, scan: Scan, dead_time_change: Array | None = None
) -> BeamBlock:
    """Return logarithms and geometry of one block.

    Parameters
    ----------
    signal, variance : (profile, angle, altitude) float
    scan : Scan
    dead_time_change : (profile, angle, altitude) float, optional
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
        np.stack(
            [np.nan_to_num(scan.east), np.nan_to_num(scan.north), np.nan_to_num(scan.path, nan=1.0)]
        ),
        alive,
        surrounds_zenith(scan.tilted_azimuths),
        min(3, max(int(scan.usable.sum()), 2)),
        _sample_mask.profiles_with_gaps(noise < np.inf, signal, variance),
        dead_time_change,
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


def visible_gradient(beams: BeamBlock, fit: Regression, altitude: Array) -> float:
    """Return the largest horizontal gradient of ln backscatter that residuals of a block show, m-1.

    It is the largest that is shown at any altitude of the block, by all profiles within 500 m of
    it, beyond what an error of the dead time explains; 0 if none is shown. It holds at all
    altitudes: an optical depth is that of the air below, too.

    Parameters
    ----------
    beams : BeamBlock
    fit : Regression
    altitude : (altitude,) float
        m.
    """
    if not beams.noise.size:
        return 0.0
    # Selection and logarithms bias noisy samples, which together would look like a gradient. The
    # profiles decide together, lest a sample be selected by the noise around it.
    middle = np.count_nonzero(beams.noise < np.inf, axis=0, keepdims=True) // 2
    typical = np.take_along_axis(np.sort(beams.noise, axis=0), middle, axis=0)
    clear = np.isfinite(fit.residual) & (typical < THRESHOLDS.gradient_noise)
    weights = np.where(clear, weights_of(beams, fit), 0.0)
    weights *= ((fit.column(kh.SIDES) == 0.0) & (fit.column(kh.FREEDOM) > 0))[:, np.newaxis]
    plain = orthogonal_columns(weights, (np.ones(altitude.size), beams.path))
    square = 0.0
    for distance in _along_axes(beams.design[:2]):
        left, length = orthogonal_columns(weights, (distance,), plain)[-1]
        lever = np.where(np.isfinite(length), weights * left * altitude, 0.0)
        square += _shown(beams, fit, lever, left, altitude) ** 2
    return float(np.sqrt(square))


def _shown(beams: BeamBlock, fit: Regression, lever: Array, left: Array, altitude: Array) -> float:
    """Return the largest gradient along an axis that is beyond chance and the dead time, m-1.

    The error by chance follows from the scatter of the beams of all profiles about the gradient,
    whose altitudes may be correlated. An error of the dead time is common to all beams.

    Parameters
    ----------
    beams : BeamBlock
    fit : Regression
    lever : (profile, angle, altitude) float
        Weight of a residual in the sum that gives the gradient.
    left : (profile, angle, altitude) float
        Horizontal distance over altitude that constant and path do not explain.
    altitude : (altitude,) float
        m.
    """
    residual = np.nan_to_num(fit.residual)
    # A fit leaves beams of large leverage less than their error.
    whole = lever / np.sqrt(np.maximum(1.0 - np.nan_to_num(fit.leverage), _LEAST_REST))
    arm = left * altitude
    total, weight, product, part = (
        _around(values, altitude)
        for values in (lever * residual, lever * arm, whole * residual, whole * arm)
    )
    information = weight.sum(axis=1)
    known = np.where(information > 0.0, information, np.inf)
    gradient = total.sum(axis=1) / known
    own = np.minimum(weight / known[:, np.newaxis], 1.0 - _LEAST_REST)
    scatter = (((product - gradient[:, np.newaxis] * part) / (1.0 - own)) ** 2).sum(axis=1)
    shift = np.zeros(altitude.size)
    if beams.dead_time_change is not None:
        expected = np.exp(beams.logarithm - residual)
        change = np.where(lever != 0.0, beams.dead_time_change / expected, 0.0)
        shift = _around(lever * change, altitude).sum(axis=1)
    squares = (own**2).sum(axis=1)
    # Beams with little weight do not tell the scatter of those that decide.
    freedom = 1.0 / np.where(squares > 0.0, squares, np.inf) - _UNKNOWNS
    tested = freedom >= 1.0
    error = np.where(tested, np.sqrt(scatter) / known, np.inf)
    chance = 0.5 * THRESHOLDS.gradient_false_alarm / max(int(np.count_nonzero(tested)), 1)
    limit = stdtrit(np.maximum(freedom, 1.0), 1.0 - chance)
    explained = THRESHOLDS.gradient_dead_time * np.abs(shift) / known
    size = np.abs(gradient)
    return float(np.max(size, where=size - explained > limit * error, initial=0.0))


def _around(values: Array, altitude: Array) -> Array:
    """Return sums over the altitudes around each, (altitude, profile times angle)."""
    inside = np.abs(altitude[:, np.newaxis] - altitude) <= 0.5 * THRESHOLDS.gradient_window
    return np.asarray(inside @ values.reshape(-1, altitude.size).T)


def _along_axes(distances: Array) -> list[Array]:
    """Return horizontal distances along the axes of a scan, each (angle, altitude).

    Beams of one vertical plane have one axis.

    Parameters
    ----------
    distances : (2, angle, altitude) float
        To the east and north.
    """
    lengths, axes = np.linalg.eigh(np.einsum("iak,jak->ij", distances, distances))
    return [
        np.tensordot(axis, distances, axes=1)
        for length, axis in zip(lengths, axes.T, strict=True)
        if length > _DEPENDENT * lengths[-1]
    ]


def orthogonal_columns(
    weights: Array, columns: Iterable[Array], before: Sequence[tuple[Array, Array]] = ()
) -> list[tuple[Array, Array]]:
    """Return columns orthogonal to those before them, and their squared lengths.

    Parameters
    ----------
    weights : (profile, angle, altitude) float
    columns : iterable of (angle, altitude) or (altitude,) float
    before : sequence of (Array, Array)
        Columns returned earlier.

    Returns
    -------
    list of (profile, angle, altitude) float, (profile, 1, altitude) float
        Those before and the new ones. The squared length is infinite where a column depends on
        those before it.
    """
    basis = list(before)
    for column in columns:
        left = np.broadcast_to(column, weights.shape)
        weighted = weights * left
        least = _DEPENDENT * sum_over_beams(weighted, left)
        for other, square in basis:
            left = left - sum_over_beams(weighted, other) / square * other
        square = sum_over_beams(weights * left, left)
        basis.append((left, np.where(square > least, square, np.inf)))
    return basis


def sum_over_beams(first: Array, second: Array) -> Array:
    """Return the sums over beams of products, (profile, 1, altitude)."""
    return np.asarray(np.einsum("tak,tak->tk", first, second))[:, np.newaxis]


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
    of_chi2 = robust_weights.clean_moments(THRESHOLDS.pass_width)[0]
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
        table = _table(beams, keep, variance, nothing, nothing)
        variance, freedom = _dersimonian_laird(table, variance, moments[0])
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
    kh.fit_levels(
        beams.logarithm, beams.noise, keep, variance, beams.design, beams.sides, table,
        residual, leverage,
    )  # fmt: skip
    return table


def _dersimonian_laird(table: Array, before: Array, of_chi2: float) -> tuple[Array, Array]:
    """Return the variance of the inhomogeneity, formula 4 of the page, and its degrees of freedom.

    Pooled over the block and a window of altitudes (`dersimonian1986`).
    """
    freedom = windowed(table[:, kh.FREEDOM].sum(axis=0))
    trace = table[:, kh.TRACE].sum(axis=0)
    excess = (table[:, kh.CHI2] / of_chi2 - table[:, kh.EXPECTED]).sum(axis=0)
    whole, total = windowed(trace), windowed(before * trace + excess)
    known = whole > 0.0
    if not np.any(known):
        return np.zeros_like(before), freedom
    variance = np.maximum(total[known] / whole[known], 0.0)
    altitudes = np.arange(before.size)
    return np.interp(altitudes, altitudes[known], variance), freedom


def windowed(values: Array) -> Array:
    """Return sums over the window around each altitude, cut at the ends of the grid."""
    half = THRESHOLDS.pooled // 2
    padded = np.pad(values, half)
    return np.asarray(sliding_window_view(padded, 2 * half + 1).sum(axis=1))


def pooled_freedom(fit: Regression) -> Array:
    """Return the residual degrees of freedom in the window around each altitude, (altitude,)."""
    return windowed(fit.column(kh.FREEDOM).sum(axis=0))


def student_factor(freedom: Array) -> Array:
    """Return the factor by which few degrees of freedom widen a standard error."""
    nu = np.maximum(freedom, THRESHOLDS.fewest_freedom)
    return np.where(freedom > 0, np.sqrt(nu / (nu - 2.0)), 1.0)


def _has_outliers(beams: BeamBlock, fit: Regression) -> bool:
    if np.max(np.count_nonzero(beams.noise < np.inf, axis=1), initial=0) < THRESHOLDS.fewest_beams:
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
    y, noise, path = beams.logarithm, beams.noise, beams.path
    residual, leverage = np.empty(noise.shape), np.zeros(noise.shape)
    robust_weights.start_residuals(y, noise, path, residual)
    if inhomogeneity is None:
        variance, samples = robust_weights.median_variance(residual, noise)
        variance = windowed(variance * samples) / np.maximum(windowed(samples), 1.0)
    else:
        variance = np.full(noise.shape[2], inhomogeneity**2)
    robust_weights.pair_residuals(y, noise, path, variance, residual)
    for width in (THRESHOLDS.start_width, THRESHOLDS.pass_width, THRESHOLDS.pass_width):
        keep = robust_weights.bisquare(residual, leverage, noise, variance, width)
        fit = _fit(beams, keep, inhomogeneity, robust_weights.clean_moments(width))
        residual, leverage, variance = fit.residual, fit.leverage, fit.inhomogeneity
    return fit


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
