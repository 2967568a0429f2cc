"""Background light of a lidar profile: the cubic of a homogeneous path, and the tail's mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve._arguments import Array, Profiles, is_uniform, profiles, spread

LAG_SHARE: Final = 1.0 / 3.0
"""Default lag over number of bins; from 0.25 to 0.42 the error of the background is flat."""

_Shared = dict[str, Any]


@dataclass(frozen=True, slots=True)
class BackgroundResult:
    """A background with its standard error; arrays over the leading axes of the power."""

    background: Array
    """In the unit of the power."""
    background_standard_error: Array
    quality: npt.NDArray[np.int32]
    """Bits of `lidarops.flags.Quality`."""


def cubic(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    *,
    lag: int | None = None,
    variance: npt.ArrayLike | None = None,
    statistics: Literal["gauss", "poisson"] = "gauss",
) -> BackgroundResult:
    r"""Estimate the background of a homogeneous path from a cubic equation.

    Three bins at equal distances ``s`` of a homogeneous path obey
    :math:`f_i(P^*) = a_i P^{*2} + b_i P^* + c_i = 0`. The minimum of :math:`\sum f_i^2` solves

    .. math:: x^3 + \frac{3 \sum ab}{2 \sum a^2} x^2
              + \frac{\sum (2ac + b^2)}{2 \sum a^2} x + \frac{\sum bc}{2 \sum a^2} = 0

    whose largest real root is the background (`bobrovsky2024`, whose eq. 8 lacks the outer
    square and whose eq. 13 misprints the second sum). The quadratic and the constant sum are
    freed of the bias that noise gives them, which for the paper's lag of one bin is larger than
    the signal. Closed form; use it as an independent check of
    `lidarops.retrieve.homogeneous.solve`, whose error is 1.3 to 2 times smaller.

    Parameters
    ----------
    power : (..., range) float
        At least 3 bins. A triple of bins that touches NaN is passed over.
    range : (range,) float
        m, uniform.
    lag : int, optional
        Bins from one bin of a triple to the next; a third of the bins where absent.
    variance : (..., range) float, optional
        Noise variance of the power; broadcasts. Where absent, it is estimated from third
        differences (``gauss``) or is the power itself (``poisson``).
    statistics : {"gauss", "poisson"}
        Law of the noise. ``poisson`` wants the power in counts.

    Returns
    -------
    BackgroundResult
        ``INPUT_MISSING`` where no triple is valid, ``NO_REAL_SOLUTION`` where no root is finite.

    Raises
    ------
    RetrievalInputError
        Where the range is not uniform, or arguments do not fit.

    References
    ----------
    bobrovsky2024
    """
    given = profiles(power, range)
    if not is_uniform(given.range):
        raise RetrievalInputError(
            "is not uniform, so that the cubic does not hold",
            field="range",
            remedy="use lidarops.retrieve.homogeneous.solve",
        )
    if statistics not in ("gauss", "poisson"):
        raise RetrievalInputError(
            f"{statistics!r} is not known", field="statistics", remedy="choose gauss or poisson"
        )
    bins = given.range.size
    step = max(1, round(LAG_SHARE * bins)) if lag is None else lag
    if not 1 <= step <= (bins - 1) // 2:
        raise RetrievalInputError(
            f"{step} bins leave no triple in {bins} bins",
            field="lag",
            remedy=f"choose 1 to {(bins - 1) // 2}",
        )
    noise = _noise(given, variance, poisson=statistics == "poisson")
    with np.errstate(all="ignore"):
        background, error = _solve(given, noise, step, poisson=statistics == "poisson")
    return _result(given, background, error)


def tail_mean(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    *,
    start: float | None = None,
    variance: npt.ArrayLike | None = None,
) -> BackgroundResult:
    r"""Average the far bins: the field's habit, biased by whatever signal is left there.

    .. math:: P^* = \frac{1}{n} \sum_{R_i \ge R_t} P_i, \qquad
              \mathrm{se}^2 = \frac{1}{n^2} \sum v_i

    Parameters
    ----------
    power : (..., range) float
        NaN is passed over.
    range : (range,) float
        m.
    start : float, optional
        m; nearest bin to average. The last tenth of the bins where absent.
    variance : (..., range) float, optional
        Noise variance; the scatter about the mean where absent.

    Returns
    -------
    BackgroundResult
        ``INPUT_MISSING`` where no bin is valid, ``TOO_FEW_BINS`` where fewer than 8 are.

    Raises
    ------
    RetrievalInputError
        Where no bin lies beyond `start`, or arguments do not fit.
    """
    given = profiles(power, range)
    first = given.range[-max(1, given.range.size // 10)] if start is None else start
    tail = given.range >= first
    if not tail.any():
        raise RetrievalInputError(
            f"no bin lies beyond {first:g} m",
            field="start",
            remedy=f"the last bin is at {given.range[-1]:g} m",
        )
    values = given.power[:, tail].astype(np.float64)
    valid = np.isfinite(values)
    count = valid.sum(axis=-1)
    with np.errstate(all="ignore"):
        mean = np.where(valid, values, 0.0).sum(axis=-1) / count
        if variance is None:
            square = np.where(valid, values - mean[:, np.newaxis], 0.0) ** 2
            error = np.sqrt(square.sum(axis=-1) / (count - 1) / count)
        else:
            noise = spread(variance, given, "variance")[:, tail]
            error = np.sqrt(np.where(valid, noise, 0.0).sum(axis=-1)) / count
    result = _result(given, mean, error)
    few = given.shaped((count > 0) & (count < 8))
    quality = result.quality | np.where(few, np.int32(Quality.TOO_FEW_BINS), np.int32(0))
    return BackgroundResult(result.background, result.background_standard_error, quality)


def _result(given: Profiles, background: Array, error: Array) -> BackgroundResult:
    present = np.isfinite(given.power).any(axis=-1)
    solved = np.isfinite(background)
    quality = np.where(
        solved, 0, np.where(present, int(Quality.NO_REAL_SOLUTION), int(Quality.INPUT_MISSING))
    )
    return BackgroundResult(
        given.shaped(np.where(solved, background, np.nan)),
        given.shaped(np.where(solved, error, np.nan)),
        given.shaped(quality.astype(np.int32)),
    )


def _noise(given: Profiles, variance: npt.ArrayLike | None, *, poisson: bool) -> Array:
    if variance is not None:
        return spread(variance, given, "variance")
    power = given.power.astype(np.float64)
    if poisson:
        return np.maximum(power, 0.0)
    if given.range.size < 5:
        return np.zeros_like(power)
    with np.errstate(all="ignore"):
        third = np.diff(power, 3, axis=-1) ** 2 / 20.0
        level = np.nanmean(np.where(np.isfinite(third), third, np.nan), axis=-1, keepdims=True)
    return np.broadcast_to(np.nan_to_num(level), power.shape)


def _solve(given: Profiles, noise: Array, lag: int, *, poisson: bool) -> tuple[Array, Array]:
    power = given.power.astype(np.float64)
    reference = _reference(power)
    shifted = power - reference
    scale = np.nanmax(
        np.abs(np.where(np.isfinite(shifted), shifted, np.nan)), axis=-1, keepdims=True
    )
    scale = np.where(scale > 0, scale, 1.0)
    p, v = shifted / scale, noise / scale**2
    p0, p1, p2 = p[:, : -2 * lag], p[:, lag:-lag], p[:, 2 * lag :]
    v0, v1, v2 = v[:, : -2 * lag], v[:, lag:-lag], v[:, 2 * lag :]
    r = given.range / given.range[-1]
    r0, r1, r2 = r[: -2 * lag], r[lag:-lag], r[2 * lag :]
    d1, d2 = r1 - r0, r2 - r1
    u, w = (r0 * r2) ** 2, r1**4
    # Written so that nothing cancels where the triple is short against its range.
    a = (d1 * d2 + r1 * (d1 - d2)) * (r1**2 + r0 * r2)
    b = u * (p0 - 2.0 * p1 + p2) - 2.0 * a * p1
    c = a * p1**2 - u * (p0 * p2 - p1**2)
    valid = np.isfinite(b) & np.isfinite(c)
    skew = v1 / scale if poisson else 0.0
    bias2 = 2.0 * a * w * v1 + u**2 * (v0 + v2) + 4.0 * w**2 * v1
    bias3 = (
        u * w * v1 * (p0 + p2)
        - u**2 * (v0 * p2 + v2 * p0)
        - 6.0 * w**2 * v1 * p1
        + 4.0 * w**2 * skew
    )
    half = 2.0 * _sum(a**2, valid)
    second = 3.0 * _sum(a * b, valid) / half
    first = _sum(2.0 * a * c + b**2 - bias2, valid) / half
    constant = _sum(b * c - bias3, valid) / half
    x = largest_root(second, first, constant)
    spread_ = _propagate(x, (a, b, c), (u, w), (p0, p1, p2), v, valid, lag)
    return (reference + scale * x[:, np.newaxis])[:, 0], scale[:, 0] * spread_


def _reference(power: Array) -> Array:
    """Return the last finite value of each profile, near which the background lies."""
    finite = np.isfinite(power)
    last = power.shape[-1] - 1 - np.argmax(finite[:, ::-1], axis=-1)
    return np.take_along_axis(power, last[:, np.newaxis], axis=-1)


def _sum(terms: Array, valid: npt.NDArray[np.bool_]) -> Array:
    total: Array = np.where(valid, terms, 0.0).sum(axis=-1)
    return np.where(valid.any(axis=-1), total, np.nan)


def largest_root(a: Array, b: Array, c: Array) -> Array:
    r"""Return the largest real root of :math:`x^3 + a x^2 + b x + c`.

    Trigonometric where there are three, by the larger of the two cube roots where there is one,
    then one Newton step on the cubic itself.

    Parameters
    ----------
    a, b, c : (...) float

    Returns
    -------
    (...) float
    """
    p = b - a * a / 3.0
    q = 2.0 * (a / 3.0) ** 3 - a * b / 3.0 + c
    discriminant = (p / 3.0) ** 3 + (q / 2.0) ** 2
    with np.errstate(all="ignore"):
        reach = 2.0 * np.sqrt(np.maximum(-p / 3.0, 0.0))
        angle = np.arccos(np.clip(3.0 * q / (p * reach), -1.0, 1.0))
        three = reach * np.cos(angle / 3.0)
        big = -np.copysign(np.cbrt(np.abs(q) / 2.0 + np.sqrt(np.maximum(discriminant, 0.0))), q)
        one = np.where(big == 0.0, 0.0, big - p / (3.0 * big))
        x = np.where(discriminant < 0.0, three, one) - a / 3.0
        slope = (3.0 * x + 2.0 * a) * x + b
        newton = x - (((x + a) * x + b) * x + c) / slope
    # At a double root there is no slope, and the closed form is all there is.
    return np.where(np.isfinite(newton), newton, x)


def _propagate(
    x: Array,
    abc: tuple[Array, Array, Array],
    uw: tuple[Array, Array],
    triples: tuple[Array, Array, Array],
    variance: Array,
    valid: npt.NDArray[np.bool_],
    lag: int,
) -> Array:
    """Return the standard error of the root, by the derivative of its equation to each bin."""
    a, b, c = abc
    u, w = uw
    p0, p1, p2 = triples
    x = x[:, np.newaxis]
    f, slope = (a * x + b) * x + c, 2.0 * a * x + b
    pull = np.zeros_like(variance)
    parts = (
        (slice(None, -2 * lag), u * (x - p2) * slope + f * u),
        (slice(lag, -lag), -2.0 * w * (x - p1) * slope - 2.0 * f * w),
        (slice(2 * lag, None), u * (x - p0) * slope + f * u),
    )
    for where, part in parts:
        pull[:, where] += np.where(valid, part, 0.0)
    stiffness = _sum(slope**2 + 2.0 * f * a, valid)
    error: Array = np.sqrt((pull**2 * np.nan_to_num(variance)).sum(axis=-1)) / np.abs(stiffness)
    return error
