"""Closed forms for cycles of beams: exact, or with a multiplier that trades noise for bias."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.network import _cycle_kernels

Array = npt.NDArray[np.float64]
Booleans = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class CycleResult:
    """Solutions of cycles. Leading axes are those of the rows."""

    value: Array
    """(...) reciprocal extinction at the start crossing, in the unit of integral / signal."""
    variance: Array
    """(...) variance of `value`; NaN where no variances are given."""
    sensitivities: Array
    """(..., row, 3) derivatives of `value` by the logarithms of start, end and integral."""
    attenuation: Array
    """(...) product of the ratios end / start around the cycle; singular at 1."""
    ill_conditioned: Booleans
    far_start: Booleans
    not_positive: Booleans
    not_finite: Booleans
    uncertain: Booleans
    signal_not_positive: Booleans
    pole: Booleans

    @property
    def flagged(self) -> Booleans:
        """Union of all flags."""
        return (
            self.ill_conditioned | self.far_start | self.not_positive | self.not_finite
            | self.uncertain | self.signal_not_positive | self.pole
        )  # fmt: skip


def solve_cycle(
    start: npt.ArrayLike,
    end: npt.ArrayLike,
    integral: npt.ArrayLike,
    *,
    relative_variance: npt.ArrayLike | None = None,
    multiplier: npt.ArrayLike = 1.0,
    unbiased: bool = False,
) -> CycleResult:
    r"""Solve cycles of beams in closed form, for any number k of beams.

    Row j joins crossing j and j + 1, the last row returns to the first crossing:
    :math:`a_j S_j - a'_j S_{j+1} = b_j`. With c = b / a, q = a' / a, Q the product of the q, and
    the multipliers :math:`\mu_j = \lambda^{j-1}`,

    .. math:: S_1 = \frac{\sum_j \mu_j Q_{j-1} c_j}{1 - \mu_k Q_k}

    is exact for a multiplier of 1. For smaller multipliers, neglected terms make S too small by
    `systematic_error`. The unbiased estimate assigns them to S_1, so that nothing is neglected
    in homogeneous air: the determinant is :math:`1 - \mu_k Q_k - \sum (\mu_j - \mu_{j+1}) Q_j`.

    Parameters
    ----------
    start, end : (..., row) float
        Signals (power R^2 / overlap)^m at the first and at the second crossing of each row.
    integral : (..., row) float
        m, 2 m times the integral between them; negative where the row leads towards its lidar.
    relative_variance : (..., row, 3) float, optional
        Relative variances of start, end and integral, which are independent.
    multiplier : (...) float
        0 to 1.
    unbiased : bool

    Returns
    -------
    CycleResult
        No value beyond the pole: where the multiplier is below 1 and :math:`\mu_k Q_k \ge 1`.

    Raises
    ------
    RetrievalInputError
        For shapes that do not match, and multipliers outside 0 to 1.

    References
    ----------
    drabenko2021 (with corrected signs), yegorov2008.
    """
    shape, (starts, ends, integrals) = _rows(start, end, integral)
    count, k = starts.shape
    multipliers = _multipliers(multiplier, shape[:-1])
    value, determinant, gradient = np.empty(count), np.empty(count), np.empty((count, k, 3))
    codes = np.empty(count, dtype=np.uint8)
    _cycle_kernels.solve_with_sensitivities(
        starts, ends, integrals, multipliers, unbiased, value, determinant, gradient, codes
    )
    with np.errstate(all="ignore"):
        attenuation = np.asarray(np.cumprod(ends / starts, axis=1)[:, -1], dtype=np.float64)
        variances = _relative_variances(relative_variance, shape)
        variance = np.cumsum((gradient**2 * variances).reshape(count, -1), axis=1)[:, -1]
        spread = np.cumsum(variances[:, :, 0] + variances[:, :, 1], axis=1)[:, -1]
        weak = ~(np.abs(np.log(attenuation)) >= 3.0 * np.sqrt(spread))
        if relative_variance is None:
            weak = ~(attenuation > 0) | (attenuation == 1.0)
        flags = (
            weak,
            integrals[:, 0] < 0,
            ~(value > 0),
            ~np.isfinite(value),
            variance > value**2,
            ~((starts > 0) & (ends > 0) & np.isfinite(starts) & np.isfinite(ends)).all(axis=1),
            codes == _cycle_kernels.POLE,
        )
    return CycleResult(
        value.reshape(shape[:-1]),
        variance.reshape(shape[:-1]),
        gradient.reshape(*shape, 3),
        attenuation.reshape(shape[:-1]),
        *(np.asarray(flag).reshape(shape[:-1]) for flag in flags),
    )


def values_and_variances(
    start: npt.ArrayLike,
    end: npt.ArrayLike,
    integral: npt.ArrayLike,
    relative_variance: npt.ArrayLike,
    *,
    multiplier: npt.ArrayLike = 1.0,
    unbiased: bool = False,
) -> tuple[Array, Array]:
    """Return (...) values and variances of `solve_cycle`, without sensitivities and flags.

    Parameters
    ----------
    start, end, integral : (..., row) float
    relative_variance : (..., row, 3) float
        One array (row, 3) for all cycles is the fastest.
    multiplier : (...) float
    unbiased : bool
    """
    shape, (starts, ends, integrals) = _rows(start, end, integral)
    variances = _relative_variances(relative_variance, shape)
    value, variance = np.empty(len(starts)), np.empty(len(starts))
    codes = np.empty(len(starts), dtype=np.uint8)
    multipliers = _multipliers(multiplier, shape[:-1])
    _cycle_kernels.solve_with_variance(
        starts, ends, integrals, variances, multipliers, unbiased, value, variance, codes
    )
    return value.reshape(shape[:-1]), variance.reshape(shape[:-1])


def systematic_error(optical_depth: npt.ArrayLike, multiplier: npt.ArrayLike) -> Array:
    r"""Return (true - estimate) / true of reciprocal extinction at the start of a cycle.

    .. math::
        \frac{S_1 - \tilde S_1}{S_1} = \frac{\sum_{j<k} (\mu_j - \mu_{j+1})
        e^{-2 \sum_{l \le j} s_l m_l \tau_l}}{1 - \mu_k e^{-2 \sum_l s_l m_l \tau_l}}

    It holds in any field, because extinction at the crossings cancels. NaN beyond the pole.

    Parameters
    ----------
    optical_depth : (..., row) float
        Exponent m times optical depth of each row, negative where it leads towards its lidar.
    multiplier : (...) float
        0 to 1.

    References
    ----------
    drabenko2021 (equation 17).
    """
    depths = inputs.real_array(optical_depth, "optical_depth").astype(np.float64)
    if depths.ndim == 0 or depths.shape[-1] < 2:
        raise RetrievalInputError(f"has the shape {depths.shape}", field="optical_depth")
    factor = inputs.real_array(multiplier, "multiplier").astype(np.float64)
    if not np.all((factor >= 0) & (factor <= 1)):
        raise RetrievalInputError("is not between 0 and 1", field="multiplier")
    leading = _common_shape([depths[..., 0], factor], "optical_depth and multiplier")
    return _relative_bias(
        np.broadcast_to(depths, (*leading, depths.shape[-1])), np.broadcast_to(factor, leading)
    )


def _rows(
    start: npt.ArrayLike, end: npt.ArrayLike, integral: npt.ArrayLike
) -> tuple[tuple[int, ...], list[Array]]:
    """Return the common shape of the rows, and contiguous (cycle, row) arrays."""
    arrays = [
        inputs.real_array(v, n).astype(np.float64, copy=False)
        for v, n in ((start, "start"), (end, "end"), (integral, "integral"))
    ]
    shape = _common_shape(arrays, "start, end and integral")
    if not shape or shape[-1] < 2:
        raise RetrievalInputError(
            f"has the shape {shape}", field="start", remedy="give 2 or more rows on the last axis"
        )
    count = int(np.prod(shape[:-1], dtype=np.int64))
    return shape, [
        np.ascontiguousarray(np.broadcast_to(v, shape).reshape(count, shape[-1])) for v in arrays
    ]


def _multipliers(multiplier: npt.ArrayLike, leading: tuple[int, ...]) -> Array:
    array = inputs.real_array(multiplier, "multiplier").astype(np.float64)
    if not np.all((array >= 0) & (array <= 1)):
        raise RetrievalInputError("is not between 0 and 1", field="multiplier")
    if array.size == 1:
        return array.reshape(1)
    try:
        return np.broadcast_to(array, leading).reshape(-1).copy()
    except ValueError:
        raise RetrievalInputError(
            f"has the shape {array.shape}, not {leading}", field="multiplier"
        ) from None


def _relative_variances(values: npt.ArrayLike | None, shape: tuple[int, ...]) -> Array:
    count = int(np.prod(shape[:-1], dtype=np.int64))
    if values is None:
        return np.full((1, shape[-1], 3), np.nan)
    array = inputs.real_array(values, "relative_variance").astype(np.float64)
    if np.any(array < 0):
        raise RetrievalInputError("is negative", field="relative_variance")
    if array.shape == (shape[-1], 3):
        return np.ascontiguousarray(array[np.newaxis])
    try:
        full = np.broadcast_to(array, (*shape, 3)).reshape(count, shape[-1], 3)
        return np.ascontiguousarray(full)
    except ValueError:
        raise RetrievalInputError(
            f"has the shape {array.shape}, not {(*shape, 3)}", field="relative_variance"
        ) from None


def _common_shape(arrays: list[Array], names: str) -> tuple[int, ...]:
    try:
        return np.broadcast_shapes(*(array.shape for array in arrays))
    except ValueError:
        raise RetrievalInputError(
            f"have the shapes {[array.shape for array in arrays]}", field=names
        ) from None


def _relative_bias(depths: Array, multiplier: Array) -> Array:
    """Return (true - estimate) / true of the reciprocal extinction at the start crossing.

    Parameters
    ----------
    depths : (..., row) float64
        Exponent times optical depth of each row, negative where it runs towards its lidar.
    multiplier : (...) float64
    """
    k = depths.shape[-1]
    attenuation = np.exp(-2.0 * np.cumsum(depths, axis=-1))
    powers = multiplier[..., np.newaxis] ** np.arange(k)
    steps = powers[..., :-1] * (1.0 - multiplier[..., np.newaxis])
    neglected = np.cumsum(steps * attenuation[..., :-1], axis=-1)[..., -1]
    determinant = 1.0 - powers[..., -1] * attenuation[..., -1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(determinant > 0, neglected / determinant, np.nan))
