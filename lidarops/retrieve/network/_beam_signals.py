"""Signals of the beams of a network: validated, averaged over blocks and condensed."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.network import _condensed_signals, _fit_layout
from lidarops.retrieve.network._condensed_signals import CondensedSignals
from lidarops.retrieve.network._fit_layout import FitLayout
from lidarops.retrieve.network.geometry import Network
from lidarops.retrieve.network.noise import noise_groups

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Booleans = npt.NDArray[np.bool_]

LARGEST_BIN_ERROR: Final = 0.3
"""Largest relative standard error of a bin at a crossing that is used, from the mean of a block.
Beyond it, signals that are positive by chance would be selected, and the logarithm would turn
noise into bias."""
_MEDIAN_OVER_MEAN: Final = np.pi / 2.0
"""Variance of a median over the variance of a mean."""
_NEGATIVE_SIGMAS: Final = 4.0
"""Standard errors below zero at which a mean signal is significantly negative."""
NOISY_PROFILE: Final = 10.0
"""Ratio to the median variance beyond which a profile does not count for its block. Where its
signal is stronger, and its noise therefore larger, up to this factor more is allowed."""
_SMOOTHED_BINS: Final = 31
"""Bins over which estimated noise is averaged."""
_OUTLYING_SQUARE: Final = 60.0
"""Ratio to the median square around it beyond which a bin is outlying: 6 standard errors, as for
bridged bins (`lidarops.retrieve.network.noise.outlying_bins`)."""
_MEDIAN_PROFILES: Final = 8
"""Smallest number of profiles, if available, for the median around a bin."""
_INDEPENDENT_BINS: Final = 3
"""Bins to the next second difference that shares no bin. A third of all differences carries as
much information as all of them."""
_FEWEST_SQUARES: Final = 7
"""Smallest number of second differences for the typical value of a profile and beam: most of
fewer may be outlying."""
_SUMMED_BINS: Final = 4
"""Bins per sum. The variance of sums shows whether neighbouring bins are correlated."""
_SAMPLED_SUMS: Final = 400
"""Approximate number of sums of a beam that are sampled, if available."""
_FEWEST_SUMS: Final = 300
"""Smallest number of sums that can show a correlation."""
_SAMPLING_FACTOR: Final = 4
"""Factor by which more sums are sampled where too few of them are known."""
_CORRELATED_RATIO: Final = 1.5
"""Ratio to the variance of independent bins that sums may reach by chance."""
_SCREENED_BIN_ERROR: Final = 0.045
"""Relative standard error of a bin up to which the search for outlying bins always works."""


@dataclass(frozen=True, slots=True, eq=False)
class BeamSignals:
    """Condensed signals of the beams: the input of all methods."""

    layout: FitLayout
    exponent: Array
    """(beam,)."""
    data: CondensedSignals
    """Signals of the profiles."""
    mean: CondensedSignals
    """Median signals of the blocks."""
    block: Indices
    """(profile,) block numbers, after blocks were split by noise (`noise.noise_groups`)."""
    averaged: Indices
    """(block,) number of profiles in the medians."""
    noise: Array
    """(block,) relative standard error of a bin of a single profile: root mean square over the
    bins around the crossings that are used."""
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
    variance: npt.ArrayLike | None,
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
    block, count = _blocks(blocks, leading)
    relative = variance is None
    if variance is None:
        members = [np.flatnonzero(block == number) for number in range(count)]
        rows, row = _estimate_variances(signal, members, block)
    else:
        rows, row = _variances(variance, signal.shape, descending=descending)
        windows = (layout.passages.beam, layout.window, layout.weights.shape[1])
        block = noise_groups.split_by_noise(signal, rows, row, block, windows, LARGEST_BIN_ERROR)
        count = int(block.max(initial=-1)) + 1
        members = [np.flatnonzero(block == number) for number in range(count)]
    mean, mean_rows, single, averaged = _median_signals(signal, rows, row, members, layout)
    data = _condensed_signals.condense(
        signal, rows, row, exponents, layout, relative=relative, screened=True
    )
    # A median is robust against single bins, and its variance is only an estimate.
    means = _condensed_signals.condense(
        mean, mean_rows, np.arange(count), exponents, layout, relative=relative, screened=False
    )
    bin_variance, negative = _relative_noise(mean, single, averaged, layout, relative=relative)
    weak = ~(bin_variance <= LARGEST_BIN_ERROR**2) & (
        (means.usable == 1) | _faded(means, negative, layout)
    )
    with np.errstate(invalid="ignore"):
        usable_variance = np.where(weak | (means.usable == 0), np.nan, bin_variance)
    means.usable[weak] = 0
    # Missing signals already have a reason.
    too_noisy = _noisy_passages(signal, rows, row, single[block], layout, relative=relative)
    too_noisy &= data.usable == 1
    data.usable[(means.usable == 0)[block] | too_noisy] = 0
    return BeamSignals(
        layout, exponents, data, means, block, averaged, np.sqrt(_row_means(usable_variance)),
        weak[block] | too_noisy, leading,
    )  # fmt: skip


def _row_means(values: Array) -> Array:
    """Return (row,) means of the finite values."""
    finite = np.isfinite(values)
    total = np.where(finite, values, 0.0).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(total / finite.sum(axis=1))


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


def _blocks(blocks: npt.ArrayLike | None, leading: tuple[int, ...]) -> tuple[Indices, int]:
    """Return (profile,) block numbers and the number of blocks."""
    count = int(np.prod(leading, dtype=np.int64))
    if blocks is None:
        return np.zeros(count, dtype=np.intp), min(count, 1)
    labels = np.asarray(blocks)
    if labels.shape != leading or labels.dtype.kind not in "iuUS":
        raise RetrievalInputError(
            f"has the shape {labels.shape} of {labels.dtype}",
            field="blocks",
            remedy=f"give one whole number or name per profile, {leading}",
        )
    names, inverse = np.unique(labels.reshape(count), return_inverse=True)
    return inverse.reshape(count).astype(np.intp), int(names.size)


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


def _estimate_variances(
    signal: Array, members: list[Indices], block: Indices
) -> tuple[Array, Indices]:
    """Return relative variances from second differences along range, and the row of each profile.

    Bins are assumed independent. Where neighbours are correlated, second differences give too
    small a variance, and the variance of sums of bins is used; a few profiles cannot show this.
    There is one row per block, and one per profile that is far noisier than its block or has
    outlying bins that are not bridged: pooled with the block, its own error would be too small
    and the errors of the others too large.

    Returns
    -------
    rows : (row, beam, bin) float64
    row : (profile,) intp
    """
    block_rows = np.full((len(members), *signal.shape[1:]), np.nan)
    if signal.shape[-1] < 3:
        return block_rows, block
    with np.errstate(invalid="ignore", divide="ignore"):
        logs = np.log(np.where(signal > 0, signal, np.nan))
    squares = (logs[..., :-2] - 2.0 * logs[..., 1:-1] + logs[..., 2:]) ** 2 / 6.0
    row, profile_rows = block.copy(), []
    for number, profiles in enumerate(members):
        block_squares = squares[profiles]
        known = np.isfinite(block_squares)
        level = _median_levels(block_squares, known)
        noisy = _much_noisier(level)
        not_noisy = known & ~noisy[..., np.newaxis] if noisy.any() else known
        not_outlying = _not_outlying(
            block_squares, known, _typical_squares(block_squares, not_noisy, level)
        )
        factor = _correlation_factor(logs[profiles, :, 1:-1], not_outlying, level)[:, np.newaxis]
        block_rows[number] = _smoothed_mean(block_squares, not_outlying & not_noisy)
        for n in np.flatnonzero(noisy.any(axis=1)):
            believable = known[n] & (
                block_squares[n]
                <= _OUTLYING_SQUARE * _typical_squares(block_squares[[n]], known[[n]], level[[n]])
            )
            not_outlying[n, noisy[n]] = believable[noisy[n]]
        single = np.flatnonzero((noisy | (known & ~not_outlying).any(axis=2)).any(axis=1))
        # Outlying bins that are not searched for are noise of their own profile.
        outlying = known[single] & ~not_outlying[single]
        own_variance = np.broadcast_to(
            block_rows[number], (single.size, *block_rows[number].shape)
        ).copy()
        for k in np.flatnonzero(noisy[single].any(axis=1)):
            noisy_beams = noisy[single[k]]
            own_variance[k, noisy_beams] = _smoothed_mean(
                block_squares[single[[k]]], not_outlying[single[[k]]]
            )[noisy_beams]
        outlier_variance = _moving_mean(
            np.where(outlying, block_squares[single], 0.0), known[single]
        )
        outlier_variance = np.where(
            (own_variance > _SCREENED_BIN_ERROR**2) & (outlier_variance > 0.0),
            outlier_variance,
            0.0,
        )
        for k in np.flatnonzero(noisy[single].any(axis=1) | outlier_variance.any(axis=(1, 2))):
            profile_rows.append((own_variance[k] + outlier_variance[k]) * factor)
            row[profiles[single[k]]] = len(members) + len(profile_rows) - 1
        block_rows[number] *= factor
    return np.concatenate([block_rows, np.array(profile_rows)]) if profile_rows else block_rows, row


def _correlation_factor(logs: Array, not_outlying: Booleans, level: Array) -> Array:
    """Return (beam,) variance of sums of bins over the variance from second differences of bins.

    It is taken from differences of successive profiles, because constant air would count as
    correlated noise, in units of the noise of both profiles: otherwise medians of bins and of
    sums would differ by chance where the noise varies. 1 where the ratio can be chance, or too
    few sums are known.

    Parameters
    ----------
    logs : (profile, beam, bin) float64
    not_outlying : (profile, beam, bin) bool
        Whether a bin is known and not outlying.
    level : (profile, beam) float64
        Proportional to the variance. Where it is not finite or 0, the median of the others.
    """
    factor = np.ones(logs.shape[1])
    size = logs.shape[-1] // (3 * _SUMMED_BINS)
    total = (len(logs) - 1) * size
    if total < _FEWEST_SUMS:
        return factor
    level = np.where(np.isfinite(level) & (level > 0.0), level, np.nan)
    typical_level = _beam_medians(level)
    level = np.where(np.isnan(level), np.where(typical_level > 0.0, typical_level, 1.0), level)
    # A sample of the profiles is enough, except for beams with too few known sums.
    stride, beams = max(total // _SAMPLED_SUMS, 1), np.arange(factor.size)
    while beams.size:
        pairs = np.arange(0, len(logs) - 1, stride)
        first, second = np.ix_(pairs, beams), np.ix_(pairs + 1, beams)
        used = slice(0, size * 3 * _SUMMED_BINS)
        steps = logs[..., used][second] - logs[..., used][first]
        steps /= np.sqrt(level[first] + level[second])[..., np.newaxis]
        steps[~(not_outlying[..., used][first] & not_outlying[..., used][second])] = np.nan
        groups = steps.reshape(*steps.shape[:2], size, 3, _SUMMED_BINS)
        sums = _second_squares(groups.sum(axis=4)) / _SUMMED_BINS
        bins = _second_squares(groups[..., :3])
        bin_variance, sum_variance = (
            _beam_medians(bins, _FEWEST_SUMS),
            _beam_medians(sums, _FEWEST_SUMS),
        )
        correlated = (bin_variance > 0.0) & (sum_variance > _CORRELATED_RATIO * bin_variance)
        factor[beams[correlated]] = sum_variance[correlated] / bin_variance[correlated]
        if stride == 1:
            break
        stride, beams = max(stride // _SAMPLING_FACTOR, 1), beams[sum_variance == 0.0]
    return factor


def _second_squares(values: Array) -> Array:
    """Return squares of the second differences of three values."""
    return np.asarray((values[..., 0] - 2.0 * values[..., 1] + values[..., 2]) ** 2)


def _median_levels(squares: Array, known: Booleans) -> Array:
    """Return (profile, beam) medians along range, robust against single outlying bins."""
    # Unknown squares must not lower the median.
    independent = np.where(
        known[..., ::_INDEPENDENT_BINS], squares[..., ::_INDEPENDENT_BINS], np.inf
    )
    return np.asarray(np.median(independent, axis=2))


def _much_noisier(level: Array) -> Booleans:
    """Return (profile, beam) where noise is far above that of most profiles."""
    typical = np.median(level, axis=0)
    return np.asarray(np.isfinite(level) & (level > NOISY_PROFILE * typical) & (typical > 0.0))


def _not_outlying(squares: Array, known: Booleans, typical: Array) -> Booleans:
    """Return (profile, beam, bin) what is known, and not outlying by (beam, bin) typical squares.

    Where many profiles are noisier than the rest, each is also compared with its own typical
    noise before its bins count as outlying.
    """
    limit = _OUTLYING_SQUARE * typical
    accepted = known & (squares <= limit)
    profile, beam = np.nonzero((known & ~accepted).any(axis=2))
    if profile.size:
        sampled = known[profile, beam, ::_INDEPENDENT_BINS]
        ratio = np.where(
            sampled,
            squares[profile, beam, ::_INDEPENDENT_BINS] / typical[beam, ::_INDEPENDENT_BINS],
            np.inf,
        )
        number = sampled.sum(axis=1)
        middle = np.maximum(number - 1, 0) // 2
        excess = np.sort(ratio, axis=1)[np.arange(number.size), middle]
        excess = np.where(number >= _FEWEST_SQUARES, np.maximum(excess, 1.0), 1.0)[:, np.newaxis]
        accepted[profile, beam] = known[profile, beam] & (
            squares[profile, beam] <= limit[beam] * excess
        )
    return accepted


def _smoothed_mean(squares: Array, known: Booleans) -> Array:
    """Return (beam, bin) means over profiles and neighbouring bins; two more bins than squares."""
    return _moving_mean(np.where(known, squares, 0.0).sum(axis=0), known.sum(axis=0))


def _moving_mean(total: Array, number: Indices | Booleans) -> Array:
    """Return means over neighbouring bins from sums of `number` squares; two more bins."""
    width = min(_SMOOTHED_BINS, total.shape[-1])
    with np.errstate(invalid="ignore", divide="ignore"):
        smooth = _moving_sum(total, width) / _moving_sum(number.astype(np.float64), width)
    return np.concatenate([smooth[..., :1], smooth, smooth[..., -1:]], axis=-1)


def _typical_squares(squares: Array, known: Booleans, level: Array) -> Array:
    """Return (beam, bin) medians over profiles and some tens of bins; inf where they are 0.

    These medians decide which bins are outlying, so that one bin of one profile is not taken for
    noise of all. Some hundred squares are enough for a median, so only some profiles are used:
    quiet and noisy ones alike, sorted by their (profile, beam) level.
    """
    stride = len(squares) // _MEDIAN_PROFILES
    if stride > 1:
        # Levels of photon counts may be equal.
        total = np.where(known, squares, 0.0).sum(axis=2)
        sampled = np.lexsort((total, level), axis=0)[stride // 2 :: stride]
        beams = np.arange(squares.shape[1])
        squares, known = squares[sampled, beams], known[sampled, beams]
    out = np.full(squares.shape[1:], np.inf)
    sections = max(squares.shape[-1] // _SMOOTHED_BINS, 1)
    edges = np.linspace(0, squares.shape[-1], sections + 1).astype(int)
    for low, high in pairwise(edges):
        section = np.where(known[..., low:high], squares[..., low:high], np.nan)
        median = _beam_medians(section)
        out[:, low:high] = np.where(median > 0.0, median, np.inf)[:, np.newaxis]
    return out


def _beam_medians(values: Array, least: int = 1) -> Array:
    """Return (beam,) medians of the known values; 0 where fewer than `least` are known.

    Parameters
    ----------
    values : (profile, beam, ...) float64
    least : int
    """
    rows = np.moveaxis(values, 1, 0).reshape(values.shape[1], -1)
    known = np.isfinite(rows)
    if known.all() and rows.shape[1] >= least:
        return np.asarray(np.median(rows, axis=1))
    finite = [row[good] for row, good in zip(rows, known, strict=True)]
    return np.array([np.median(row) if row.size >= least else 0.0 for row in finite])


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
    width = min(_SMOOTHED_BINS, median.size)
    known = np.isfinite(variances)
    typical = np.median(np.where(known, variances, np.inf), axis=0)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        energy_ratio = (_moving_sum(signal, width) / _moving_sum(median, width)) ** 2
        allowed = NOISY_PROFILE * np.fmin(np.fmax(energy_ratio, 1.0), NOISY_PROFILE)
        counted = variances <= allowed * typical
        # With few counts, the median of the variances may be zero.
        counted = known & (counted | (typical == 0.0))
        return np.asarray(np.where(counted, variances, 0.0).sum(axis=0) / counted.sum(axis=0))


def _noisy_passages(
    signal: Array, rows: Array, row: Indices, single: Array, layout: FitLayout, *, relative: bool
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
            noisier = (typical > 0.0) & ~(spread <= NOISY_PROFILE * typical)
            scale = 1.0 if relative else level**2
            out[:, c] = noisier & ~(spread <= LARGEST_BIN_ERROR**2 * scale)
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
    mean: Array, single: Array, averaged: Indices, layout: FitLayout, *, relative: bool
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
            out[:, c] = spread if relative else np.where(level > 0, spread / level**2, np.inf)
            if not relative:
                negative[:, c] = ~(level >= -_NEGATIVE_SIGMAS * np.sqrt(spread / number))
    return out, negative
