"""The dark signal of analog channels at the time of each profile, from files with a shut lid."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs

Array = npt.NDArray[np.float64]

SESSION_GAP: Final = 1800.0
"""s between dark files from which on they belong to different sessions."""
VARIANCE_WINDOW: Final = 65
"""Bins over which the scatter of repeats is averaged: that of 3 repeats alone is off by 100 %."""
FAR_SHARE: Final = 0.5
"""Share of the bins, from the far end, that tells the noise of a file without repeats."""
_KNOWN_ROUGHNESS: Final = 6.0


class DarkMethod(StrEnum):
    """Which dark files tell the dark signal of a profile."""

    NEAREST = "nearest"
    """The session nearest in time."""
    INTERPOLATED = "interpolated"
    """The sessions before and after, by time; the nearest one where there is only one side."""


@dataclass(frozen=True, slots=True)
class DarkProfile:
    """Dark signals, one for every time asked for."""

    dark: Array
    """(..., time, range), in the unit of the dark signals; NaN where no file is finite."""
    variance: Array
    """(..., time, range) of its noise, independent from bin to bin. Profiles with the same dark
    files share that noise: it does not average down over them."""
    level_variance: Array
    """(...) of the level of the single dark file, which wanders: an error that all bins share and
    that does not average down, but goes with the background where one is fitted. NaN where fewer
    than two files tell it."""
    weights: Array
    """(time, dark): what each dark file counts in each dark signal; a row sums to 1. A file that
    was not used has 0."""
    age: Array
    """(time,) s from each time to the nearest dark file that was used."""


def dark_profile(
    dark_signals: npt.ArrayLike,
    dark_times: npt.ArrayLike,
    times: npt.ArrayLike,
    *,
    method: str = "nearest",
    session_gap: float = SESSION_GAP,
    smoothing: int = 1,
) -> DarkProfile:
    r"""Find the dark signal of each profile from the dark files.

    Dark files that follow each other within `session_gap` are one session, whose mean
    :math:`\bar D_s` stands at its mean time. Between two sessions,

    .. math:: D(t) = (1 - u) \bar D_1 + u \bar D_2, \quad u = \frac{t - t_1}{t_2 - t_1}, \qquad
              v = (1 - u)^2 v_1 + u^2 v_2

    Parameters
    ----------
    dark_signals : (..., dark, range) float
        mV; NaN is passed over.
    dark_times : (dark,) float in s, or datetime64
        Middle of each dark file, in any order.
    times : (time,) float in s, or datetime64
        Middle of each profile.
    method : {"nearest", "interpolated"}
    session_gap : float
        s.
    smoothing : int
        Bins, odd, over which the dark signal is averaged along range, fewer towards the ends
        (a window always stays symmetric). It divides the variance by as much where the noise of
        the bins is independent, makes that of neighbours alike, and rounds off what is narrower
        in the dark signal; 1 for none.

    Returns
    -------
    DarkProfile
        The variance is that of the scatter of the files of a session about its mean, less the
        level of each file, over 65 neighbouring bins. A session of one file has the scatter of
        files in other sessions; where there is none, that of neighbouring bins over the far half
        of the range.

    Raises
    ------
    RetrievalInputError
        Where there is no dark file, a time is not known, or the arguments do not fit.
    """
    chosen = inputs.choice(method, DarkMethod, "method")
    signals = _signals(dark_signals)
    moments, wanted = _seconds(dark_times, times)
    if signals.shape[-2] != moments.size:
        raise RetrievalInputError(
            f"have the shape {signals.shape} for {moments.size} times",
            field="dark_signals",
            remedy="the axis before the last is that of dark_times",
        )
    _check_settings(session_gap, smoothing, signals.shape[-1])
    sessions = _sessions(moments, session_gap)
    means, variances = _means(signals, sessions)
    if smoothing > 1:
        means, variances = _smooth(means, variances, smoothing)
    shares = _shares(moments, sessions, wanted, chosen)
    return DarkProfile(
        _mixed(shares, means),
        _mixed(shares**2, variances),
        _level_variance(signals),
        _file_weights(shares, sessions),
        _age(shares, sessions, moments, wanted),
    )


def _signals(values: npt.ArrayLike) -> Array:
    signals = inputs.real_array(values, "dark_signals").astype(np.float64)
    if signals.ndim < 2 or signals.shape[-2] == 0 or signals.shape[-1] == 0:
        raise RetrievalInputError(
            f"have the shape {signals.shape}",
            field="dark_signals",
            remedy="give (..., dark, range) with at least one dark file, or leave the dark out",
        )
    signals[~np.isfinite(signals)] = np.nan
    return signals


def _seconds(dark_times: npt.ArrayLike, times: npt.ArrayLike) -> tuple[Array, Array]:
    """Return both as s since the first dark file."""
    both = []
    for name, values in (("dark_times", dark_times), ("times", times)):
        array = np.atleast_1d(np.asarray(values))
        if array.ndim != 1 or array.dtype.kind not in "iufM":
            raise RetrievalInputError(
                f"hold {array.dtype} of the shape {array.shape}",
                field=name,
                remedy="give one time for each profile, in s or as datetime64",
            )
        both.append(array)
    if (both[0].dtype.kind == "M") != (both[1].dtype.kind == "M"):
        raise RetrievalInputError(
            f"hold {both[0].dtype}, the times {both[1].dtype}",
            field="dark_times",
            remedy="give both as datetime64, or both in s",
        )
    if both[0].dtype.kind == "M":
        # NaT has no number: it must become NaN before it becomes a float.
        origin = both[0][:1].astype("M8[ns]")
        both = [(array.astype("M8[ns]") - origin) / np.timedelta64(1, "s") for array in both]
    moments, wanted = (array.astype(np.float64) for array in both)
    for name, array in (("dark_times", moments), ("times", wanted)):
        if not np.all(np.isfinite(array)):
            raise RetrievalInputError(
                "are not all known", field=name, remedy="leave those profiles out"
            )
    return moments, wanted


def _check_settings(session_gap: float, smoothing: int, bins: int) -> None:
    if not session_gap > 0:
        raise RetrievalInputError(f"is {session_gap}", field="session_gap", remedy="give s above 0")
    if smoothing != int(smoothing) or not 1 <= smoothing <= bins or smoothing % 2 == 0:
        raise RetrievalInputError(
            f"is {smoothing} with {bins} bins",
            field="smoothing",
            remedy="choose an odd number of bins",
        )


def _sessions(moments: Array, gap: float) -> list[npt.NDArray[np.intp]]:
    """Return the dark files of each session, in the order of time."""
    order = np.argsort(moments, kind="stable")
    breaks = np.flatnonzero(np.diff(moments[order]) > gap) + 1
    return [np.sort(part) for part in np.split(order, breaks)]


def _means(signals: Array, sessions: list[npt.NDArray[np.intp]]) -> tuple[Array, Array]:
    """Return mean and variance of the mean of every session, (..., session, range)."""
    means, counts, squares, freedoms = [], [], [], []
    for files in sessions:
        part = signals[..., files, :]
        finite = np.isfinite(part)
        count = finite.sum(axis=-2)
        mean = _over(np.where(finite, part, 0.0).sum(axis=-2), count)
        residual = np.where(finite, part - mean[..., np.newaxis, :], 0.0)
        # The level wanders from file to file: that is no noise of the single bin.
        level = _over(residual.sum(axis=-1, keepdims=True), finite.sum(axis=-1, keepdims=True))
        residual = np.where(finite, residual - level, 0.0)
        means.append(mean)
        counts.append(count)
        squares.append((residual**2).sum(axis=-2))
        freedoms.append(np.maximum(count - 1, 0))
    all_squares = np.stack([*squares, sum(squares)], axis=-2)
    all_freedoms = np.stack([*freedoms, sum(freedoms)], axis=-2).astype(np.float64)
    scatter = _over(
        _window_sum(all_squares, VARIANCE_WINDOW), _window_sum(all_freedoms, VARIANCE_WINDOW)
    )
    own, pooled = scatter[..., :-1, :], scatter[..., -1:, :]
    single = np.where(np.isfinite(own), own, pooled)
    single = np.where(np.isfinite(single), single, _roughness(signals))
    variance = _over(single, np.stack(counts, axis=-2))
    stacked = np.stack(means, axis=-2)
    return stacked, np.where(np.isfinite(stacked), variance, np.nan)


def _roughness(signals: Array) -> Array:
    """Return the variance of files by the second differences of their far bins, (..., 1, 1)."""
    far = signals[..., int(signals.shape[-1] * (1.0 - FAR_SHARE)) :]
    second = np.diff(far, n=2, axis=-1) ** 2 / _KNOWN_ROUGHNESS
    finite = np.isfinite(second)
    total = np.where(finite, second, 0.0).sum(axis=(-2, -1), keepdims=True)
    return _over(total, finite.sum(axis=(-2, -1), keepdims=True))


def _level_variance(signals: Array) -> Array:
    """Return the variance of the levels of the files about their mean, (...)."""
    finite = np.isfinite(signals)
    mean = _over(
        np.where(finite, signals, 0.0).sum(axis=-2, keepdims=True),
        finite.sum(axis=-2, keepdims=True),
    )
    levels = _over(np.where(finite, signals - mean, 0.0).sum(axis=-1), finite.sum(axis=-1))
    known = np.isfinite(levels)
    count = known.sum(axis=-1)
    levels = np.where(known, levels, 0.0)
    levels -= _over(levels.sum(axis=-1), count)[..., np.newaxis]
    return _over((np.where(known, levels, 0.0) ** 2).sum(axis=-1), count - 1)


def _over(total: Array, count: npt.NDArray[np.int64] | Array) -> Array:
    """Return the ratio, NaN where the count is not positive."""
    counted = np.where(count > 0, count, np.nan)
    return np.asarray(total / counted, dtype=np.float64)


def _window_sum(values: Array, window: int) -> Array:
    """Sum over windows of so many bins, symmetric and therefore shorter at the ends."""
    index = np.arange(values.shape[-1])
    half = np.minimum(np.minimum(index, index[::-1]), window // 2)
    sums = np.zeros((*values.shape[:-1], values.shape[-1] + 1))
    np.cumsum(values, axis=-1, out=sums[..., 1:])
    total: Array = sums[..., index + half + 1] - sums[..., index - half]
    return total


def _smooth(means: Array, variances: Array, window: int) -> tuple[Array, Array]:
    finite = np.isfinite(means) & np.isfinite(variances)
    count = _window_sum(finite.astype(np.float64), window)
    # Sums of deviations, so that the rounding of a cumulative sum is that of the noise.
    level = np.where(finite, means, 0.0).mean(axis=-1, keepdims=True)
    smooth = level + _over(_window_sum(np.where(finite, means - level, 0.0), window), count)
    variance = _over(_window_sum(np.where(finite, variances, 0.0), window), count**2)
    return np.where(finite, smooth, np.nan), np.where(finite, variance, np.nan)


def _shares(
    moments: Array, sessions: list[npt.NDArray[np.intp]], wanted: Array, method: DarkMethod
) -> Array:
    """Return what each session counts at each time, (time, session)."""
    middles = np.array([moments[files].mean() for files in sessions])
    shares = np.zeros((wanted.size, middles.size))
    rows = np.arange(wanted.size)
    if method is DarkMethod.NEAREST:
        distances = np.stack(
            [np.abs(moments[files] - wanted[:, np.newaxis]).min(axis=1) for files in sessions]
        )
        shares[rows, np.argmin(distances, axis=0)] = 1.0
        return shares
    after = np.clip(np.searchsorted(middles, wanted), 1, max(middles.size - 1, 1))
    before = after - 1
    after = np.minimum(after, middles.size - 1)
    span = middles[after] - middles[before]
    with np.errstate(invalid="ignore", divide="ignore"):
        part = np.clip(np.where(span > 0, (wanted - middles[before]) / span, 0.0), 0.0, 1.0)
    shares[rows, before] = 1.0 - part
    shares[rows, after] += part
    return shares


def _mixed(shares: Array, values: Array) -> Array:
    """Return the sums of sessions by their shares, (..., time, range), in the order of time."""
    total = np.zeros((*values.shape[:-2], len(shares), values.shape[-1]))
    for session in range(shares.shape[1]):
        share = shares[:, session]
        used = share > 0
        total[..., used, :] += share[used, np.newaxis] * values[..., session, np.newaxis, :]
    return total


def _file_weights(shares: Array, sessions: list[npt.NDArray[np.intp]]) -> Array:
    weights = np.zeros((len(shares), sum(files.size for files in sessions)))
    for session, files in enumerate(sessions):
        weights[:, files] = shares[:, session, np.newaxis] / files.size
    return weights


def _age(
    shares: Array, sessions: list[npt.NDArray[np.intp]], moments: Array, wanted: Array
) -> Array:
    age = np.full(wanted.size, np.inf)
    for session, files in enumerate(sessions):
        distance = np.abs(moments[files] - wanted[:, np.newaxis]).min(axis=1)
        age = np.where(shares[:, session] > 0, np.minimum(age, distance), age)
    return age
