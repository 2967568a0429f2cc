"""Compiled conversion of counts to signals with known noise, one profile at a time.

Smoothing along range sums over a window that grows with range. Differences of one running sum
would lose precision in the far range, because the light falls by six orders of magnitude along a
profile. The running sums therefore restart every `BLOCK` bins, and a window is the tail of its
first block, the whole blocks within, and the head of its last block. No window is shorter than a
block, so these three do not overlap. Only the sums of whole blocks are differences, with their
rounding errors compensated. The error of an average is below ``(BLOCK + 3) 2^-53`` of the mean of
absolute values within the window, plus ``(bins / BLOCK)^2 2^-106`` of the sum of absolute values
of the profile over the number of bins of the window.

The order of every sum is fixed within its profile, so the bits of a result depend on the profile
alone.
"""

# ruff: noqa: FBT001 - compiled functions take no keyword-only arguments
from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from lidarops.flags import Quality
from lidarops.retrieve.common.arrays import Array, Flags, Integers
from lidarops.retrieve.common.compiled_code import compiled

Indices = npt.NDArray[np.uint32]

BLOCK: Final = 16
"""Bins between two restarts of the running sums; windows have at least one bin more."""

_LOWEST: Final = np.iinfo(np.int32).min
_HIGHEST: Final = np.iinfo(np.int32).max
_MISSING: Final = int(Quality.INPUT_MISSING)
_SATURATED: Final = int(Quality.SATURATED)
_PILE_UP: Final = int(Quality.PILE_UP)


class Windows(NamedTuple):
    """The smoothing window of each bin."""

    first: Indices
    past: Indices
    """One past the last bin; for the last bin of the profile, the end of its block."""
    bins: Array
    """Number of values in the window of a profile without gaps."""


class _Sums(NamedTuple):
    """Running sums over the bins of one profile, filled up with zeros to whole blocks."""

    values: Array
    head: Array
    """Sum from the start of the block to before the bin."""
    tail: Array
    """Sum from the bin to the end of the block."""
    high: Array
    """Sum over the blocks before this one."""
    low: Array
    """Rounding error of `high`."""
    finite: Integers
    """1 where `values` is valid."""
    counts: Integers
    """Number of photons, or of finite values, before the bin."""
    bins: Array
    """Number of finite values in the window, where the profile has gaps."""


class SignalScratch(NamedTuple):
    """Work arrays for one profile, small enough for the processor cache."""

    sums: _Sums
    mean: Array
    local: Array


def scratch(bins: int) -> SignalScratch:
    """Return work arrays for profiles of that many bins."""
    blocks = -(-bins // BLOCK)
    padded = blocks * BLOCK
    sums = _Sums(
        np.zeros(padded),
        np.zeros(padded + 1),
        np.zeros(padded),
        np.zeros(blocks + 1),
        np.zeros(blocks + 1),
        np.zeros(padded, np.int64),
        np.zeros(padded + 1, np.int64),
        np.zeros(bins),
    )
    return SignalScratch(sums, np.zeros(bins), np.zeros(bins))


@compiled
def load_values(values: Array, s: _Sums) -> bool:
    """Load the finite values of a profile; return whether all are finite."""
    count = 0
    for i in range(values.size):
        finite = abs(values[i]) < math.inf
        s.values[i] = values[i] if finite else 0.0
        s.finite[i] = 1 if finite else 0
        count += s.finite[i]
    return bool(count == values.size)


@compiled
def _accumulate(s: _Sums) -> None:
    """Fill the running sums."""
    high = low = 0.0
    for block in range(s.high.size - 1):
        start = block * BLOCK
        end = start + BLOCK - 1
        total = reverse = 0.0
        for i in range(BLOCK):
            s.head[start + i] = total
            total += s.values[start + i]
            reverse += s.values[end - i]
            s.tail[end - i] = reverse
        s.high[block], s.low[block] = high, low
        # The exact rounding error of the addition (Knuth's two-sum).
        summed = high + total
        rounded = summed - high
        low += (high - (summed - rounded)) + (total - rounded)
        high = summed
    s.high[-1], s.low[-1] = high, low


@compiled
def _count_finite(s: _Sums) -> None:
    before = 0
    for i in range(s.finite.size):
        s.counts[i] = before
        before += s.finite[i]
    s.counts[-1] = before


@compiled
def _window_counts(counts: Integers, windows: Windows, out: Array) -> None:
    for i in range(out.size):
        out[i] = np.float64(counts[windows.past[i]] - counts[windows.first[i]])


@compiled
def _window_sum(s: _Sums, first: np.uint32, past: np.uint32) -> float:
    after, last = first // np.uint32(BLOCK) + np.uint32(1), past // np.uint32(BLOCK)
    whole_blocks = (s.high[last] - s.high[after]) + (s.low[last] - s.low[after])
    return float((s.tail[first] + s.head[past]) + whole_blocks)


@compiled
def write_averages(s: _Sums, windows: Windows, complete: bool, out: Array) -> None:
    """Write averages of the loaded values over windows."""
    _accumulate(s)
    if complete:
        for i in range(out.size):
            out[i] = _window_sum(s, windows.first[i], windows.past[i]) / windows.bins[i]
        return
    _count_finite(s)
    for i in range(out.size):
        first, past = windows.first[i], windows.past[i]
        out[i] = _window_sum(s, first, past) / np.float64(s.counts[past] - s.counts[first])


@compiled
def _bins(s: _Sums, windows: Windows, complete: bool) -> Array:
    """Return the number of finite values in each window."""
    if complete:
        return windows.bins
    _count_finite(s)
    _window_counts(s.counts, windows, s.bins)
    return s.bins


@compiled
def _voltage(
    counts: npt.NDArray[np.int32],
    missing: bool,
    step: float,
    full: float,
    dark: Array,
    overlap: Flags,
    power: Array,
    quality: Flags,
) -> None:
    for i in range(counts.size):
        count = counts[i]
        value = count * step - dark[i]
        extreme = (count == _LOWEST) | (count == -_HIGHEST) | (count == _HIGHEST)
        unusable = missing | extreme | (not abs(value) < math.inf)
        saturated = np.float64(count) >= full
        power[i] = math.nan if unusable | saturated else value
        quality[i] = overlap[i] | (_MISSING if unusable else 0) | (_SATURATED if saturated else 0)


@compiled
def voltage_profiles(
    counts: npt.NDArray[np.int32],
    shots: Array,
    step: Array,
    full: Array,
    dark: Array,
    overlap: Flags,
    power: Array,
    quality: Flags,
) -> None:
    """Convert summed ADC counts to voltage.

    Parameters
    ----------
    counts : (profile, bin) int32
    shots, step, full : (profile,) float64
        Number of shots; mV per count; count at full scale.
    dark : (profile or 1, bin) float64
        mV.
    overlap : (bin,) int32
        INCOMPLETE_OVERLAP or 0.
    power, quality : (profile, bin)
        Output.
    """
    for k in range(counts.shape[0]):
        # A recorder that is off counts nothing.
        missing = (not shots[k] > 0.0) | (not counts[k].any())
        profile_dark = dark[k % dark.shape[0]]
        _voltage(counts[k], missing, step[k], full[k], profile_dark, overlap, power[k], quality[k])


class Counter(NamedTuple):
    """Dead time of a photon counter, and the limits of its flags."""

    dead_time: float
    """Microseconds; with 0 nothing is corrected."""
    assumed_dead_time: float
    """Microseconds; dead time for the noise and the flags PILE_UP and SATURATED."""
    paralysis: float
    """Measured rate times dead time above which a bin is SATURATED."""
    pile_up: float
    """Relative correction above which a bin has PILE_UP."""
    largest_load: float
    """Mean measured rate times dead time above which a bin is SATURATED."""
    undecided: float
    """Standard deviations about `largest_load` within which the mean decides."""


@compiled
def _rate(
    counts: npt.NDArray[np.int32],
    missing: bool,
    exposure: float,
    counter: Counter,
    overlap: Flags,
    s: _Sums,
    power: Array,
    quality: Flags,
) -> bool:
    """Write power and quality of a profile, and load it; return whether it has no gaps."""
    valid_bins = 0
    for i in range(counts.size):
        count = counts[i]
        rate = count / exposure
        load = rate * counter.assumed_dead_time
        saturated = load > counter.paralysis
        piled = load / (1.0 - (counter.paralysis if saturated else load)) > counter.pile_up
        missing_bin = missing | (count < 0) | (count == _HIGHEST)
        invalid = missing_bin | saturated
        value = rate / (1.0 - rate * counter.dead_time)
        power[i] = math.nan if invalid else value
        s.values[i] = 0.0 if invalid else value
        s.finite[i] = 0 if invalid else 1
        valid_bins += s.finite[i]
        bits = overlap[i] | (_MISSING if missing_bin else 0) | (_SATURATED if saturated else 0)
        quality[i] = bits | (_PILE_UP if piled else 0)
    return bool(valid_bins == counts.size)


@compiled
def _photons(counts: npt.NDArray[np.int32], windows: Windows, s: _Sums, out: Array) -> None:
    """Count the photons of valid bins in each window, in exact integer sums."""
    before = 0
    for i in range(counts.size):
        s.counts[i] = before
        before += counts[i] * s.finite[i]
    for i in range(counts.size, s.counts.size):
        s.counts[i] = before
    _window_counts(s.counts, windows, out)


@compiled
def _photon_variance(
    exposure: float, counter: Counter, photons: Array, bins: Array, mean: Array, out: Array
) -> None:
    for i in range(out.size):
        # A window without counts has a rate below that of one count, not exactly zero.
        one_count = 1.0 / (exposure * bins[i])
        measured = photons[i] * one_count
        corrected = counter.dead_time > 0.0
        rate = mean[i] if corrected else measured
        expected = one_count if one_count > rate else rate
        live = 1.0 - measured * counter.assumed_dead_time
        out[i] = expected / exposure * (1.0 / live if corrected else live * live)


@compiled
def _reject_overloaded(
    counts: npt.NDArray[np.int32],
    exposure: float,
    counter: Counter,
    photons: Array,
    bins: Array,
    power: Array,
    quality: Flags,
) -> None:
    """Mark bins of too large a load, by the mean of the window where noise would decide."""
    load_of_count = counter.assumed_dead_time / exposure
    limit = counter.largest_load
    for i in range(counts.size):
        load = counts[i] * load_of_count
        mean = photons[i] / bins[i] * load_of_count
        margin = counter.undecided * math.sqrt(max(load * load_of_count, 0.0)) * (1.0 - load)
        overloaded = (load > limit + margin) | ((mean > limit) & (load > limit - margin))
        if overloaded & ((quality[i] & _MISSING) == 0):
            power[i] = math.nan
            quality[i] |= _SATURATED


@compiled
def photon_profiles(
    counts: npt.NDArray[np.int32],
    shots: Array,
    exposure: Array,
    counter: Counter,
    overlap: Flags,
    windows: Windows,
    s: SignalScratch,
    power: Array,
    variance: Array,
    quality: Flags,
) -> None:
    """Convert summed photon counts to a count rate, corrected for dead time, with its variance.

    Parameters
    ----------
    counts : (profile, bin) int32
    shots, exposure : (profile,) float64
        Number of shots; duration of a bin over all shots in microseconds.
    counter : Counter
    overlap : (bin,) int32
        INCOMPLETE_OVERLAP or 0.
    windows : Windows
    s : SignalScratch
    power, variance, quality : (profile, bin)
        Output.
    """
    for k in range(counts.shape[0]):
        # A recorder that is off counts nothing.
        missing = (not shots[k] > 0.0) | (not counts[k].any())
        complete = _rate(
            counts[k], missing, exposure[k], counter, overlap, s.sums, power[k], quality[k]
        )
        bins = _bins(s.sums, windows, complete)
        if counter.dead_time > 0.0:
            write_averages(s.sums, windows, complete, s.mean)
        _photons(counts[k], windows, s.sums, s.local)
        _photon_variance(exposure[k], counter, s.local, bins, s.mean, variance[k])
        if not missing:
            _reject_overloaded(counts[k], exposure[k], counter, s.local, bins, power[k], quality[k])
