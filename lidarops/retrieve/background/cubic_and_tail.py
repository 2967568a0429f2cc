"""Find the background of a profile by the cubic of a homogeneous path, or by its tail mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import special

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.background import _cubic_kernel
from lidarops.retrieve.background.thresholds import THRESHOLDS
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Flags, Floats, frozen
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON

_UNIFORM: Final = 2.0**-22
"""Largest deviation from a uniform grid, over the last range: rounding of float32 ranges."""

_QUALITY_OF_STATUS: Final = {
    _cubic_kernel.MISSING: Quality.INPUT_MISSING,
    _cubic_kernel.CONSTANT: Quality.NO_SIGNAL,
    _cubic_kernel.UNSOLVED: Quality.NO_REAL_SOLUTION,
}


@dataclass(frozen=True, slots=True)
class BackgroundResult:
    """Background of every profile, with the leading axes of the power."""

    background: Array
    """In the unit of the power; NaN where there is none."""
    background_standard_error: Array
    quality: Flags
    """Bits of `lidarops.flags.Quality`; 0 where no test failed."""


def default_lag(bins: int) -> int:
    """Return the lag with the least scatter of the cubic, 0.4 of the bins."""
    return max(min(round(THRESHOLDS.lag_share * bins), (bins - 1) // 2), 1)


def cubic(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    *,
    lag: int | None = None,
    variance: npt.ArrayLike | None = None,
) -> BackgroundResult:
    r"""Return the background of a homogeneous path, without iteration.

    On a homogeneous path, three bins at a distance of `lag` obey
    :math:`(P_0 - P^*) R_0^2 (P_2 - P^*) R_2^2 = (P_1 - P^*)^2 R_1^4`. The sum of the squared
    differences over all triples,

    .. math:: S(x) = \sum_i (a_i x^2 + b_i x + c_i)^2,

    has its minimum at the largest real root of the cubic :math:`S'(x) = 0`, which is evaluated
    without cancellation. The expectation of the noise in the coefficients is subtracted first;
    otherwise a short lag biases the background high.

    The scatter is larger than that of `lidarops.retrieve.homogeneous.path_fit`. The signal at the
    start of the section must exceed the noise.

    Parameters
    ----------
    power : (..., range) float
        Any unit; a section that begins beyond full overlap.
    range : (range,) float
        m, uniform.
    lag : int, optional
        Distance of the bins of a triple, `default_lag` where not given.
    variance : (..., range) float, optional
        Noise variance in the square of the power's unit, broadcast against `power`. Where not
        given, one variance for the profile is estimated from differences along range.

    Returns
    -------
    BackgroundResult
        The standard error follows from the implicit derivative of the root with respect to the
        power of each bin. INPUT_MISSING: a bin is not finite, or its variance is 0 while others
        are not. TOO_FEW_BINS: below 8 bins (NaN below 3). NO_SIGNAL: the profile is constant.
        LOW_SIGNAL: noise may have moved the minimum to another root, or, without a given
        variance and with few bins or a short lag, signal curvature mistaken for noise may have.
        NO_REAL_SOLUTION: the root is no minimum.

    Raises
    ------
    RetrievalInputError
        For invalid arguments, including a range that is not uniform.

    References
    ----------
    bobrovsky2024 (equation 8 without the outer square, 13 with a misprinted coefficient).
    """
    grid = inputs.range_grid(range)
    rows, leading = inputs.profiles(power, grid)
    noise = inputs.noise_rows(variance, "variance", grid, leading, negative=False)
    known = variance is not None
    result, _ = solve_cubic(rows, grid, lag, noise, known_variance=known)
    return inputs.with_leading_axes(result, leading)


def solve_cubic(
    power: Floats,
    range_: Array,
    lag: int | None,
    variance: Array,
    *,
    known_variance: bool,
    want_gradients: bool = False,
) -> tuple[BackgroundResult, Array]:
    """Return the result of `cubic` and its gradients, for arrays checked by `common.inputs`.

    Parameters
    ----------
    power, variance : (profile, bin) float
        The variance may be one row; it is relative where not known.
    range_ : (bin,) float
        m, ascending.
    lag : int, optional
    known_variance : bool
    want_gradients : bool
        Whether to return the derivatives of the backgrounds with respect to the power.

    Returns
    -------
    BackgroundResult
        (profile,).
    gradients : (profile, bin) float
        One row without meaning where `want_gradients` is False.
    """
    _require_uniform(range_)
    count, bins = power.shape
    out = np.full((count, _cubic_kernel.COLUMNS), np.nan)
    gradients = np.zeros((count if want_gradients else 1, bins))
    if bins >= 3:
        triples = _cubic_kernel.make_triples(range_, _checked_lag(lag, bins))
        rows = frozen(power.astype(np.float64, copy=False))
        _cubic_kernel.solve_cubic_profiles(
            rows, frozen(variance), known_variance, triples, gradients, out
        )
    status = out[:, _cubic_kernel.STATUS]
    quality = np.zeros(count, dtype=np.int32)
    for code, bit in _QUALITY_OF_STATUS.items():
        quality[status == code] |= np.int32(bit)
    moved = (out[:, _cubic_kernel.CONTRAST] < THRESHOLDS.lowest_contrast) | (
        out[:, _cubic_kernel.CURVATURE_SHIFT] > THRESHOLDS.largest_shift
    )
    quality[moved] |= np.int32(Quality.LOW_SIGNAL)
    if bins < COMMON.fewest_bins:
        quality[status != _cubic_kernel.MISSING] |= np.int32(Quality.TOO_FEW_BINS)
    unsolved = status == _cubic_kernel.UNSOLVED
    background = np.where(unsolved, np.nan, out[:, _cubic_kernel.BACKGROUND])
    error = np.sqrt(np.where(unsolved, np.nan, out[:, _cubic_kernel.VARIANCE]))
    return BackgroundResult(background, error, quality), gradients


def tail_mean(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    *,
    start: float | None = None,
    variance: npt.ArrayLike | None = None,
) -> BackgroundResult:
    """Return the mean of the far end of a profile as its background, the usual practice.

    Signal that remains there biases the background high.

    Parameters
    ----------
    power : (..., range) float
        Any unit; bins that are not finite are skipped.
    range : (range,) float
        m.
    start : float, optional
        m; bins from here on are averaged, the last tenth of the bins where not given.
    variance : (..., range) float, optional
        Noise variance in the square of the power's unit, broadcast against `power`. Bins are
        skipped where it is not finite, or 0 while that of others is not. Where not given, it is
        estimated from the scatter of the averaged bins.

    Returns
    -------
    BackgroundResult
        INPUT_MISSING where no averaged bin is finite, TOO_FEW_BINS where fewer than 8 are, or
        fewer than half. The background is NaN below half: bins that are left out because of their
        value, as saturated ones are, leave a mean that is too low (`selection_bias`).

    Raises
    ------
    RetrievalInputError
        For invalid arguments, including a start beyond the range.
    """
    grid = inputs.range_grid(range)
    rows, leading = inputs.profiles(power, grid)
    noise = inputs.noise_rows(variance, "variance", grid, leading, negative=False)
    first = first_of_tail(grid, start)
    values = np.ascontiguousarray(rows[:, first:], dtype=np.float64)
    noise = np.broadcast_to(noise[:, first:], values.shape)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        valid = np.isfinite(values) & np.isfinite(noise)
        # A variance of 0 among others is not usable; of all bins it means that there is no noise.
        valid &= (noise > 0) | ~np.any(noise > 0, axis=-1, keepdims=True)
        bins = valid.sum(axis=-1)
        mean = np.where(valid, values, 0.0).sum(axis=-1) / bins
        if variance is None:
            scatter = np.where(valid, values - mean[:, np.newaxis], 0.0) ** 2
            error = np.sqrt(scatter.sum(axis=-1) / (bins - 1) / bins)
        else:
            error = np.sqrt(np.where(valid, noise, 0.0).sum(axis=-1)) / bins
    few = bins < COMMON.least_share * values.shape[-1]
    scarce = few | (bins < COMMON.fewest_bins)
    quality = np.where(scarce, np.int32(Quality.TOO_FEW_BINS), np.int32(0))
    quality[bins == 0] = np.int32(Quality.INPUT_MISSING)
    mean[few] = np.nan
    error[few | (bins < 2 if variance is None else bins < 1)] = np.nan
    return inputs.with_leading_axes(BackgroundResult(mean, error, quality), leading)


def selection_bias(share: npt.ArrayLike) -> Array:
    r"""Return the most by which a mean is off where bins were left out because of their value.

    With noise of standard deviation :math:`\sigma`, the mean of the share :math:`q` of lowest
    values is too low by

    .. math:: \frac{\varphi(z)}{q} \sigma, \qquad \Phi(z) = q,

    with the normal density :math:`\varphi` and distribution :math:`\Phi`. The number of bins does
    not reduce it.

    Parameters
    ----------
    share : (...) float
        Share of the bins that is left, 0 to 1.

    Returns
    -------
    (...) float
        In standard deviations of a bin; NaN where no bin is left.
    """
    left = np.asarray(share, dtype=np.float64)
    density = np.exp(-0.5 * special.ndtri(left) ** 2) / np.sqrt(2.0 * np.pi)
    with np.errstate(invalid="ignore"):
        return np.asarray(density / left)


def first_of_tail(range_: Array, start: float | None = None) -> int:
    """Return the first bin of the tail, by default of the last tenth of the bins."""
    if start is None:
        return int(range_.size - max(int(THRESHOLDS.tail_share * range_.size), 1))
    if not np.isfinite(start) or start > range_[-1]:
        raise RetrievalInputError(
            f"is {start} m, but the range ends at {range_[-1]:g} m", field="start"
        )
    return int(np.searchsorted(range_, start, side="left"))


def _checked_lag(lag: int | None, bins: int) -> int:
    if lag is None:
        return default_lag(bins)
    if not 1 <= lag <= (bins - 1) // 2:
        raise RetrievalInputError(
            f"is {lag} with {bins} bins",
            field="lag",
            remedy=f"choose a whole number from 1 to {(bins - 1) // 2}",
        )
    return lag


def _require_uniform(range_: Array) -> None:
    grid = np.linspace(range_[0], range_[-1], range_.size)
    if np.max(np.abs(range_ - grid)) > _UNIFORM * range_[-1]:
        raise RetrievalInputError(
            "is not uniform, which the cubic requires",
            field="range",
            remedy="use the method 'direct' of lidarops.retrieve.homogeneous.fit_homogeneous_path",
        )
