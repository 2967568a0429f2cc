"""Signals of the beams of a network: validated, averaged over blocks and condensed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.network import _condensed_signals, _fit_layout
from lidarops.retrieve.network._condensed_signals import CondensedSignals
from lidarops.retrieve.network._fit_layout import FitLayout
from lidarops.retrieve.network.geometry import Network
from lidarops.retrieve.network.thresholds import THRESHOLDS

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Booleans = npt.NDArray[np.bool_]

_MEDIAN_OVER_MEAN: Final = np.pi / 2.0
"""Variance of a median over the variance of a mean."""


@dataclass(frozen=True, slots=True, eq=False)
class BeamSignals:
    """Condensed signals of the beams: the input of all methods."""

    layout: FitLayout
    exponent: Array
    """(beam,)."""
    data: CondensedSignals
    """Signals of the profiles."""
    block: Indices
    """(profile,) block numbers."""
    weak: Booleans
    """(profile, passage) True where the signal of the block, or of a profile far noisier than
    most of the block, is too weak to be used."""
    leading: tuple[int, ...]
    """Shape of the axes before beam and range."""


def prepare_signals(
    power: npt.ArrayLike,
    range_: npt.ArrayLike,
    network: Network,
    *,
    variance: npt.ArrayLike,
    overlap: npt.ArrayLike | None,
    full_overlap_range: npt.ArrayLike | None,
    exponent: npt.ArrayLike,
    blocks: npt.ArrayLike | None,
    bins: int,
) -> BeamSignals:
    """Validate and condense signals. Arguments are those of `extinction_field.retrieve_network`."""
    ranges, descending = _grids(range_, network.beams)
    signal, leading = _signal(power, ranges, descending=descending)
    nearest, overlap_function = _overlap(overlap, full_overlap_range, ranges, descending=descending)
    if not (isinstance(bins, int | np.integer) and 3 <= bins <= 99):
        raise RetrievalInputError(f"is {bins}", field="bins", remedy="choose 3 to 99")
    exponents = _exponents(exponent, network.beams)
    layout = _fit_layout.lay_out_fits(network, ranges, overlap_function, nearest, int(bins))
    block = _blocks(blocks, leading)
    rows, row = _variances(variance, signal.shape, descending=descending)
    count = int(block.max(initial=-1)) + 1
    members = [np.flatnonzero(block == number) for number in range(count)]
    mean, mean_rows, single, averaged = _median_signals(signal, rows, row, members, layout)
    data = _condensed_signals.condense(signal, rows, row, exponents, layout, screened=True)
    # A median is robust against single bins, and its variance is only an estimate.
    means = _condensed_signals.condense(
        mean, mean_rows, np.arange(count), exponents, layout, screened=False
    )
    bin_variance, negative = _relative_noise(mean, single, averaged, layout)
    weak = ~(bin_variance <= THRESHOLDS.largest_bin_error**2) & (
        (means.usable == 1) | _faded(means, negative, layout)
    )
    means.usable[weak] = 0
    # Missing signals already have a reason.
    too_noisy = _noisy_passages(signal, rows, row, single[block], layout)
    too_noisy &= data.usable == 1
    data.usable[(means.usable == 0)[block] | too_noisy] = 0
    return BeamSignals(layout, exponents, data, block, weak[block] | too_noisy, leading)


def _grids(values: npt.ArrayLike, beams: int) -> tuple[Array, bool]:
    """Return (beam, bin) ascending ranges, and whether they were descending."""
    array = inputs.real_array(values, "range").astype(np.float64)
    if array.ndim == 1:
        grid = inputs.range_grid(array)
        return np.tile(grid.values, (beams, 1)), grid.descending
    if array.ndim != 2 or array.shape[0] != beams:
        raise RetrievalInputError(
            f"has the shape {array.shape}",
            field="range",
            remedy=f"give (range,) or ({beams}, range), one row per beam",
        )
    for row in array:
        known = np.isfinite(row)
        if not known.any() or not known[: int(known.sum())].all():
            raise RetrievalInputError(
                "is not finite before the last bin of a beam",
                field="range",
                remedy="give the bins of each beam first, and NaN only after the last bin",
            )
        if inputs.range_grid(row[known]).descending:
            raise RetrievalInputError("descends", field="range", remedy="reverse range and power")
    return np.ascontiguousarray(array), False


def _signal(
    power: npt.ArrayLike, grid: Array, *, descending: bool
) -> tuple[Array, tuple[int, ...]]:
    """Return (profile, beam, bin) power over ascending ranges, and the shape of its other axes."""
    array = inputs.real_array(power, "power").astype(np.float64, copy=False)
    if array.ndim < 2 or array.shape[-2:] != grid.shape:
        raise RetrievalInputError(
            f"has the shape {array.shape}",
            field="power",
            remedy=f"its last two axes are beam and range, here {grid.shape}",
        )
    leading = array.shape[:-2]
    profiles = array[..., ::-1] if descending else array
    count = int(np.prod(leading, dtype=np.int64))
    profiles = np.ascontiguousarray(profiles.reshape(count, *grid.shape))
    return np.where(np.isnan(grid), np.nan, profiles), leading


def _overlap(
    overlap: npt.ArrayLike | None, nearest: npt.ArrayLike | None, grid: Array, *, descending: bool
) -> tuple[Array, Array | None]:
    """Return the nearest usable range of each beam, and the overlap function if there is one."""
    if overlap is None and nearest is None:
        raise RetrievalInputError(
            "is not given, and full_overlap_range is not either",
            field="overlap",
            remedy="give one of them: an error of 1 percent in the overlap at the first crossing"
            " changes extinction there by 5 percent",
        )
    limits = inputs.real_array(0.0 if nearest is None else nearest, "full_overlap_range")
    if limits.shape not in {(), (grid.shape[0],)} or not np.all(limits >= 0):
        raise RetrievalInputError(
            "is negative, NaN or of a wrong shape",
            field="full_overlap_range",
            remedy="give one range in m, or one per beam",
        )
    first = np.broadcast_to(limits, grid.shape[:1]).astype(np.float64)
    if overlap is None:
        return first, None
    array = inputs.real_array(overlap, "overlap").astype(np.float64)
    if array.shape not in {grid.shape, grid.shape[1:]}:
        raise RetrievalInputError(
            f"has the shape {array.shape}", field="overlap", remedy=f"give {grid.shape}"
        )
    if np.any(array < 0) or np.any(array > 1.5):
        raise RetrievalInputError(
            "is not between 0 and 1.5", field="overlap", remedy="give 1 for full overlap"
        )
    return first, np.broadcast_to(array[..., ::-1] if descending else array, grid.shape)


def _exponents(exponent: npt.ArrayLike, beams: int) -> Array:
    array = inputs.real_array(exponent, "exponent").astype(np.float64)
    if array.shape not in {(), (beams,)} or not np.all((array >= 0.1) & (array <= 10.0)):
        raise RetrievalInputError(
            "is not from 0.1 to 10, or of a wrong shape",
            field="exponent",
            remedy=f"give m of backscatter ~ extinction^(1/m): one, or one per beam ({beams})",
        )
    return np.broadcast_to(array, (beams,)).copy()


def _blocks(blocks: npt.ArrayLike | None, leading: tuple[int, ...]) -> Indices:
    """Return (profile,) block numbers."""
    count = int(np.prod(leading, dtype=np.int64))
    if blocks is None:
        return np.zeros(count, dtype=np.intp)
    labels = np.asarray(blocks)
    if labels.shape != leading or labels.dtype.kind not in "iuUS":
        raise RetrievalInputError(
            f"has the shape {labels.shape} of {labels.dtype}",
            field="blocks",
            remedy=f"give one whole number or name per profile, {leading}",
        )
    _, inverse = np.unique(labels.reshape(count), return_inverse=True)
    return inverse.reshape(count).astype(np.intp)


def _variances(
    variance: npt.ArrayLike, shape: tuple[int, ...], *, descending: bool
) -> tuple[Array, Indices]:
    array = inputs.real_array(variance, "variance").astype(np.float64, copy=False)
    if np.any(array < 0):
        raise RetrievalInputError(
            "is negative", field="variance", remedy="give squares of the power's unit"
        )
    if descending and array.ndim > 0:
        array = array[..., ::-1]
    shared = all(length == 1 for length in array.shape[:-2])
    try:
        if shared:
            rows = np.broadcast_to(array.reshape(array.shape[-2:]), shape[1:])[np.newaxis]
        else:
            rows = array.reshape(-1, *array.shape[-2:])
            rows = np.broadcast_to(rows, (shape[0], *shape[1:]))
    except ValueError:
        raise RetrievalInputError(
            f"has the shape {array.shape}",
            field="variance",
            remedy=f"give (..., beam, range), here (..., {shape[1]}, {shape[2]})",
        ) from None
    row = np.zeros(shape[0], dtype=np.intp) if shared else np.arange(shape[0])
    return np.ascontiguousarray(rows), row


def _moving_sum(values: Array, width: int) -> Array:
    """Return sums over a window that shrinks at the ends."""
    size = values.shape[-1]
    sums = np.concatenate([np.zeros((*values.shape[:-1], 1)), np.cumsum(values, axis=-1)], axis=-1)
    centre = np.arange(size)
    start = np.maximum(centre - width // 2, 0)
    stop = np.minimum(centre + width // 2 + 1, size)
    return np.asarray(sums[..., stop] - sums[..., start])


def _median_signals(
    signal: Array, rows: Array, row: Indices, members: list[Indices], layout: FitLayout
) -> tuple[Array, Array, Array, Indices]:  # fmt: skip
    """Return median signals of blocks, their variances, variances of one profile, and numbers.

    A median, because a single outlying bin must not spoil a block. A profile with a gap on a beam
    is left out: laser energy changes from profile to profile, and the gap would make a step. A
    few noisy profiles do not harm a median and do not count in its variance.
    """
    shape = (len(members), *signal.shape[1:])
    mean, spread, single = np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, np.nan)
    averaged = np.zeros(len(members), dtype=np.intp)
    first, bins = layout.first_passage, layout.weights.shape[1]
    for beam in range(shape[1]):
        if first[beam] == first[beam + 1]:
            continue
        low, high = layout.window[first[beam]], layout.window[first[beam + 1] - 1] + bins
        complete = np.asarray(np.isfinite(signal[:, beam, low:high]).all(axis=1))
        for number, profiles in enumerate(members):
            used = profiles[complete[profiles]]
            if used.size == 0:
                continue
            mean[number, beam] = np.median(signal[used, beam], axis=0)
            single[number, beam, low:high] = _typical_variance(
                rows[row[used], beam, low:high],
                signal[used, beam, low:high],
                mean[number, beam, low:high],
            )
            spread[number, beam] = _MEDIAN_OVER_MEAN * single[number, beam] / used.size
            averaged[number] = min(averaged[number], used.size) if averaged[number] else used.size
    return mean, spread, single, averaged


def _typical_variance(variances: Array, signal: Array, median: Array) -> Array:
    """Return (bin,) means of the variances that are not far larger than most.

    Parameters
    ----------
    variances, signal : (profile, bin) float64
    median : (bin,) float64
        Median signal.
    """
    width = min(THRESHOLDS.energy_bins, median.size)
    known = np.isfinite(variances)
    typical = np.median(np.where(known, variances, np.inf), axis=0)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        energy_ratio = (_moving_sum(signal, width) / _moving_sum(median, width)) ** 2
        allowed = THRESHOLDS.noisy_profile * np.fmin(
            np.fmax(energy_ratio, 1.0), THRESHOLDS.noisy_profile
        )
        counted = variances <= allowed * typical
        # With few counts, the median of the variances may be zero.
        counted = known & (counted | (typical == 0.0))
        return np.asarray(np.where(counted, variances, 0.0).sum(axis=0) / counted.sum(axis=0))


def _noisy_passages(
    signal: Array, rows: Array, row: Indices, single: Array, layout: FitLayout
) -> Booleans:
    """Return (profile, passage) where a profile far noisier than its block is too weak.

    It is compared with its own level, because a higher laser energy also raises the noise.
    """
    out = np.zeros((signal.shape[0], layout.passages.beam.size), dtype=np.bool_)
    if rows.shape[0] == 1:
        return out
    bins = layout.weights.shape[1]
    for c in range(out.shape[1]):
        beam, window = layout.passages.beam[c], slice(layout.window[c], layout.window[c] + bins)
        with np.errstate(invalid="ignore", over="ignore"):
            spread = rows[row, beam, window].sum(axis=1) / bins
            typical = single[:, beam, window].sum(axis=1) / bins
            level = np.maximum(signal[:, beam, window].sum(axis=1) / bins, 0.0)
            noisier = (typical > 0.0) & ~(spread <= THRESHOLDS.noisy_profile * typical)
            out[:, c] = noisier & ~(spread <= THRESHOLDS.largest_bin_error**2 * level**2)
    return out


def _faded(
    means: CondensedSignals, significantly_negative: Booleans, layout: FitLayout
) -> Booleans:
    """Return (block, passage) where noise alone made an existing signal not positive.

    Such a signal counts as weak. A beam without any signal, or with a signal significantly below
    zero, is faulty and is reported as not positive.
    """
    beam, first = layout.passages.beam, layout.first_passage[layout.passages.beam]
    negative = (means.status == _condensed_signals.NOT_POSITIVE)[:, beam]
    return np.asarray(
        negative & (means.usable == 0) & (means.usable[:, first] == 1) & ~significantly_negative
    )


def _relative_noise(
    mean: Array, single: Array, averaged: Indices, layout: FitLayout
) -> tuple[Array, Booleans]:
    """Return (block, passage) relative variance of a bin of one profile around a crossing.

    Also return where the mean signal is significantly below zero.
    """
    total, bins = layout.passages.beam.size, layout.weights.shape[1]
    out, negative = (
        np.zeros((mean.shape[0], total)),
        np.zeros((mean.shape[0], total), dtype=np.bool_),
    )
    number = np.maximum(averaged, 1) * bins / _MEDIAN_OVER_MEAN
    for c in range(total):
        beam, window = layout.passages.beam[c], slice(layout.window[c], layout.window[c] + bins)
        # The square of an outlying bin may overflow.
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            level = mean[:, beam, window].sum(axis=1) / bins
            spread = single[:, beam, window].sum(axis=1) / bins
            out[:, c] = np.where(level > 0, spread / level**2, np.inf)
            negative[:, c] = ~(level >= -THRESHOLDS.negative * np.sqrt(spread / number))
    return out, negative
