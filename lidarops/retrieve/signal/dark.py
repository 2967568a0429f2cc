"""Dark signals of analog channels at the times of profiles, from files with the telescope shut."""

from __future__ import annotations

from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Indices, Integers
from lidarops.retrieve.signal.thresholds import THRESHOLDS

_SECOND_DIFFERENCE_VARIANCE: Final = 6.0
"""Variance of a second difference of white noise over that of the noise."""


_DRIFT_PARTS: Final = 16
"""Parts of the range over which dark files are averaged for `DarkSignals.drift`."""


class _DarkMethod(StrEnum):
    """How the dark signal of a profile follows from the dark sessions."""

    NEAREST = "nearest"
    """The session nearest in time."""
    INTERPOLATED = "interpolated"
    """Linear in time between the sessions before and after; before the first and after the last
    session, that session."""


class DarkSignals:
    r"""Dark signals of an analog channel at any time, from its dark files.

    Consecutive dark files within `Thresholds.session_gap` form a session, with mean
    :math:`\bar D_s` at its mean time. Between two sessions,

    .. math:: D(t) = (1 - u) \bar D_1 + u \bar D_2, \quad u = \frac{t - t_1}{t_2 - t_1}, \qquad
              v = (1 - u)^2 v_1 + u^2 v_2

    The files are not kept.

    Parameters
    ----------
    dark_signals : (dark, range) float
        mV; NaN is skipped.
    dark_times : (dark,) datetime64
        Middle of each dark file, in any order.
    method : {"nearest", "interpolated"}

    Raises
    ------
    RetrievalInputError
        For no dark file, an unknown time, or shapes that do not match.
    """

    def __init__(
        self, dark_signals: npt.ArrayLike, dark_times: npt.ArrayLike, *, method: str = "nearest"
    ) -> None:
        self._method = inputs.choice(method, _DarkMethod, "method")
        signals = _signals(dark_signals)
        self._times = np.asarray(dark_times)
        dark_seconds = self._seconds(self._times, "dark_times")
        if len(signals) != dark_seconds.size:
            raise RetrievalInputError(
                f"have the shape {signals.shape} for {dark_seconds.size} times",
                field="dark_signals",
                remedy="the first axis is that of dark_times",
            )
        self._sessions = _sessions(dark_seconds)
        self._means, self._variances = _means(signals, self._sessions)
        self.drift = _drift(signals)
        """Standard deviation of the shape of dark files, in their unit: that of means over 16ths of
        the range, without the level of the file. NaN for one file."""

    def _seconds(self, times: npt.ArrayLike, name: str) -> Array:
        """Return times as s since the first dark file."""
        # Division makes NaT a NaN; a cast to float would make it a number.
        since = np.asarray(times).astype("M8[ns]") - self._times[:1].astype("M8[ns]")
        seconds = np.asarray(since / np.timedelta64(1, "s"))
        if not np.all(np.isfinite(seconds)):
            raise RetrievalInputError(
                "are not all known", field=name, remedy="leave those profiles out"
            )
        return seconds

    def at(self, times: npt.ArrayLike) -> tuple[Array, Array]:
        """Return the dark signal of each profile and the variance of its noise, (time, range).

        In the unit of the dark signals and its square; NaN where no file is finite. The variance is
        the scatter of the files of a session about their mean, after removing the level of each
        file, averaged over 65 neighbouring bins. A session of one file gets the scatter of files in
        other sessions; without any, that between neighbouring bins in the far half of the range.
        It is independent from bin to bin; profiles with the same dark files share that noise, which
        does not average down over them.

        Parameters
        ----------
        times : (time,) datetime64
            Middle of each profile.
        """
        seconds, dark_seconds = (
            self._seconds(part, name)
            for part, name in ((times, "times"), (self._times, "dark_times"))
        )
        shares = _shares(dark_seconds, self._sessions, seconds, self._method)
        return _weighted_sum(shares, self._means), _weighted_sum(shares**2, self._variances)

    def variance(self, times: npt.ArrayLike) -> Array:
        """Return the variance of the dark signal at times, (time, range)."""
        return self.at(times)[1]


def _signals(values: npt.ArrayLike) -> Array:
    signals = inputs.real_array(values, "dark_signals").astype(np.float64)
    if signals.ndim != 2 or signals.size == 0:
        raise RetrievalInputError(
            f"have the shape {signals.shape}",
            field="dark_signals",
            remedy="give (dark, range) with at least one dark file, or leave the dark out",
        )
    signals[~np.isfinite(signals)] = np.nan
    return signals


def _sessions(dark_seconds: Array) -> list[Indices]:
    """Return the indices of the dark files of each session, in time order."""
    order = np.argsort(dark_seconds, kind="stable")
    breaks = np.flatnonzero(np.diff(dark_seconds[order]) > THRESHOLDS.session_gap) + 1
    return [np.sort(files) for files in np.split(order, breaks)]


def _means(signals: Array, sessions: list[Indices]) -> tuple[Array, Array]:
    """Return mean and variance of the mean of each session, (session, range)."""
    means, counts, squares, freedoms = [], [], [], []
    for files in sessions:
        # A copy, changed in place: there may be many files.
        residual = signals[files]
        finite = np.isfinite(residual)
        residual[~finite] = 0.0
        count = finite.sum(axis=-2)
        mean = _ratio(residual.sum(axis=-2), count)
        residual -= mean
        residual[~finite] = 0.0
        # The level drifts from file to file, which is no noise of the single bin.
        residual -= _ratio(residual.sum(axis=-1, keepdims=True), finite.sum(axis=-1, keepdims=True))
        residual[~finite] = 0.0
        means.append(mean)
        counts.append(count)
        squares.append(np.square(residual, out=residual).sum(axis=-2))
        freedoms.append(np.maximum(count - 1, 0))
    all_squares = np.stack([*squares, sum(squares)], axis=-2)
    all_freedoms = np.stack([*freedoms, sum(freedoms)], axis=-2).astype(np.float64)
    scatter = _ratio(_window_sum(all_squares), _window_sum(all_freedoms))
    session_scatter, pooled = scatter[:-1], scatter[-1:]
    file_variance = np.where(np.isfinite(session_scatter), session_scatter, pooled)
    file_variance = np.where(np.isfinite(file_variance), file_variance, _far_variance(signals))
    variance = _ratio(file_variance, np.stack(counts, axis=-2))
    stacked = np.stack(means, axis=-2)
    return stacked, np.where(np.isfinite(stacked), variance, np.nan)


def _drift(signals: Array) -> float:
    """Return the standard deviation over files of means over parts of the range."""
    if len(signals) < 2 or signals.shape[-1] < _DRIFT_PARTS:
        return float("nan")
    edges = np.linspace(0, signals.shape[-1], _DRIFT_PARTS, endpoint=False).astype(np.intp)
    finite = np.isfinite(signals)
    total = np.add.reduceat(np.where(finite, signals, 0.0), edges, axis=-1)
    parts = _ratio(total, np.add.reduceat(finite, edges, axis=-1))
    parts -= parts[:, -1:]
    parts = parts[:, np.isfinite(parts).all(axis=0)][:, :-1]
    return float(np.sqrt(np.var(parts, axis=0, ddof=1).mean())) if parts.size else float("nan")


def _far_variance(signals: Array) -> Array:
    """Return the noise variance from second differences of the far bins, (1, 1)."""
    far = signals[:, signals.shape[-1] // 2 :]
    second = np.diff(far, n=2, axis=-1) ** 2 / _SECOND_DIFFERENCE_VARIANCE
    finite = np.isfinite(second)
    total = np.where(finite, second, 0.0).sum(axis=(-2, -1), keepdims=True)
    return _ratio(total, finite.sum(axis=(-2, -1), keepdims=True))


def _ratio(total: Array, count: Integers | Array) -> Array:
    """Return the ratio, NaN where the count is not positive."""
    counted = np.where(count > 0, count, np.nan)
    return np.asarray(total / counted, dtype=np.float64)


def _window_sum(values: Array) -> Array:
    """Return sums over windows of `Thresholds.variance_window` bins, fewer towards the ends."""
    index = np.arange(values.shape[-1])
    half = np.minimum(np.minimum(index, index[::-1]), THRESHOLDS.variance_window // 2)
    sums = np.zeros((*values.shape[:-1], values.shape[-1] + 1))
    np.cumsum(values, axis=-1, out=sums[..., 1:])
    total: Array = sums[..., index + half + 1] - sums[..., index - half]
    return total


def _shares(
    dark_seconds: Array, sessions: list[Indices], seconds: Array, method: _DarkMethod
) -> Array:
    """Return the weight of each session at each time, (time, session)."""
    middles = np.array([dark_seconds[files].mean() for files in sessions])
    shares = np.zeros((seconds.size, middles.size))
    rows = np.arange(seconds.size)
    if method is _DarkMethod.NEAREST:
        distances = np.stack(
            [np.abs(dark_seconds[files] - seconds[:, np.newaxis]).min(axis=1) for files in sessions]
        )
        shares[rows, np.argmin(distances, axis=0)] = 1.0
        return shares
    after = np.clip(np.searchsorted(middles, seconds), 1, max(middles.size - 1, 1))
    before = after - 1
    after = np.minimum(after, middles.size - 1)
    span = middles[after] - middles[before]
    with np.errstate(invalid="ignore", divide="ignore"):
        fraction = np.clip(np.where(span > 0, (seconds - middles[before]) / span, 0.0), 0.0, 1.0)
    shares[rows, before] = 1.0 - fraction
    shares[rows, after] += fraction
    return shares


def _weighted_sum(shares: Array, values: Array) -> Array:
    """Return the weighted sums of the sessions, (time, range)."""
    total = np.zeros((len(shares), values.shape[1]))
    for session in range(shares.shape[1]):
        share = shares[:, session]
        used = share > 0
        total[used] += share[used, np.newaxis] * values[session]
    return total
