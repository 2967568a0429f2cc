"""Signals of the beams of a network: checked, averaged over blocks and condensed."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.network import _condensed_signals
from lidarops.retrieve.network._condensed_signals import Condensed, Layout
from lidarops.retrieve.network.geometry import Network
from lidarops.retrieve.network.noise import noise_groups

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Booleans = npt.NDArray[np.bool_]

LOUDEST_BIN: Final = 0.3
"""Relative standard error of a bin, of the mean of a block, beyond which a crossing is not used:
what is positive by chance would be selected, and the logarithm turns noise into bias."""
_OF_MEDIAN: Final = np.pi / 2.0
"""Variance of a median over that of a mean."""
_BELOW: Final = 4.0
"""Standard errors by which a mean signal is then less than zero."""
LOUDER: Final = 10.0
"""Times the median variance, from which on a profile is not counted for one of its block; up
to that many times more where its signal is stronger, whose noise is then larger too."""
_SMOOTHED: Final = 31
"""Bins over which an estimated noise is averaged."""
_WILD: Final = 60.0
"""Times the median square of what is about it, from which on a bin is not of noise: it lies off
by 6 standard errors, as what is bridged does (`lidarops.retrieve.network.noise.outlying_bins`)."""
_ASKED: Final = 8
"""Profiles for a median of what is about a bin, at least, where there are as many."""
_APART: Final = 3
"""Bins to the next second difference that shares none: a third of all, which tells as much."""
_FEW: Final = 7
"""Of them, at least, for what is usual of a profile and beam: fewer may mostly be wild."""
_SUMMED: Final = 4
"""Bins of which sums tell whether neighbours are correlated."""
_ASKED_SUMS: Final = 400
"""Sums of a beam that are asked whether they are, about, where there are as many."""
_SUMS: Final = 300
"""Sums that are enough to tell so."""
_MORE: Final = 4
"""Times as many are asked where too few of them are known."""
_CORRELATED: Final = 1.5
"""Times the variance of independent bins, up to which sums may have more by chance."""
_SCREENED: Final = 0.045
"""Relative standard error of a bin, up to which wild bins are surely looked for there."""


@dataclass(frozen=True, slots=True, eq=False)
class BeamSignals:
    """All that the methods need to know of the signals."""

    layout: Layout
    exponent: Array
    """(beam,)."""
    data: Condensed
    """Of the profiles."""
    mean: Condensed
    """Of the median signals of the blocks."""
    block: Indices
    """(profile,) numbered anew where noise parts a block (`_noise_groups`)."""
    averaged: Indices
    """(block,) profiles in the means."""
    noise: Array
    """(block,) relative standard error of a bin of a single profile, root mean square over the
    bins about the crossings that are used."""
    weak: Booleans
    """(profile, passage) True where the signal of the block, or of a profile that is far louder
    than most of it, is too weak to be used."""
    leading: tuple[int, ...]


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
    """Check and condense signals; arguments are those of `multiposition.solve`."""
    grid, turn = _grids(range_, network.beams)
    signal, leading = _signal(power, grid, turn=turn)
    nearest, shape = _overlap(overlap, full_overlap_range, grid, turn=turn)
    if not (isinstance(bins, int | np.integer) and 3 <= bins <= 99):
        raise RetrievalInputError(f"is {bins}", field="bins", remedy="choose 3 to 99")
    powers = _exponents(exponent, network.beams)
    layout = _condensed_signals.lay_out(network, grid, shape, nearest, int(bins))
    block, count = _blocks(blocks, leading)
    relative = variance is None
    if variance is None:
        members = [np.flatnonzero(block == b) for b in range(count)]
        rows, row = _estimated(signal, members, block)
    else:
        rows, row = _variances(variance, signal.shape, turn=turn)
        about = (layout.passages.beam, layout.window, layout.weights.shape[1])
        block = noise_groups.split_by_noise(signal, rows, row, block, about, LOUDEST_BIN)
        count = int(block.max(initial=-1)) + 1
        members = [np.flatnonzero(block == b) for b in range(count)]
    mean, mean_rows, single, averaged = _means(signal, rows, row, members, layout)
    data = _condensed_signals.condense(
        signal, rows, row, powers, layout, relative=relative, screened=True
    )
    # No single bin spoils a median, and its variance is but an estimate.
    means = _condensed_signals.condense(
        mean, mean_rows, np.arange(count), powers, layout, relative=relative, screened=False
    )
    loudness, below = _loudness(mean, single, averaged, layout, relative=relative)
    weak = ~(loudness <= LOUDEST_BIN**2) & ((means.usable == 1) | _faded(means, below, layout))
    with np.errstate(invalid="ignore"):
        heard = np.where(weak | (means.usable == 0), np.nan, loudness)
    means.usable[weak] = 0
    # What is missing has another reason.
    alone = _loud(signal, rows, row, single[block], layout, relative=relative)
    alone &= data.usable == 1
    data.usable[(means.usable == 0)[block] | alone] = 0
    return BeamSignals(
        layout, powers, data, means, block, averaged, np.sqrt(_row_means(heard)),
        weak[block] | alone, leading,
    )  # fmt: skip


def _row_means(values: Array) -> Array:
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
                remedy="give each beam's bins first, and NaN only behind the last of them",
            )
        if inputs.range_grid(row[known]).descending:
            raise RetrievalInputError("descends", field="range", remedy="turn it, and the power")
    return np.ascontiguousarray(array), False


def _signal(power: npt.ArrayLike, grid: Array, *, turn: bool) -> tuple[Array, tuple[int, ...]]:
    array = inputs.real_array(power, "power").astype(np.float64, copy=False)
    if array.ndim < 2 or array.shape[-2:] != grid.shape:
        raise RetrievalInputError(
            f"has the shape {array.shape}",
            field="power",
            remedy=f"its last two axes are beam and range, here {grid.shape}",
        )
    leading = array.shape[:-2]
    flat = array[..., ::-1] if turn else array
    count = int(np.prod(leading, dtype=np.int64))
    flat = np.ascontiguousarray(flat.reshape(count, *grid.shape))
    return np.where(np.isnan(grid), np.nan, flat), leading


def _overlap(
    overlap: npt.ArrayLike | None, nearest: npt.ArrayLike | None, grid: Array, *, turn: bool
) -> tuple[Array, Array | None]:
    """Return the nearest range of each beam and its overlap function, where there is one."""
    if overlap is None and nearest is None:
        raise RetrievalInputError(
            "is not given, nor full_overlap_range",
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
    return first, np.broadcast_to(array[..., ::-1] if turn else array, grid.shape)


def _exponents(exponent: npt.ArrayLike, beams: int) -> Array:
    array = inputs.real_array(exponent, "exponent").astype(np.float64)
    if array.shape not in {(), (beams,)} or not np.all((array >= 0.1) & (array <= 10.0)):
        raise RetrievalInputError(
            "is not from 0.1 to 10, or of a wrong shape",
            field="exponent",
            remedy=f"give m of backscatter ~ extinction^(1/m): one, or one per beam ({beams})",
        )
    return np.broadcast_to(array, (beams,)).copy()


def _blocks(
    blocks: npt.ArrayLike | None, leading: tuple[int, ...], field: str = "blocks"
) -> tuple[Indices, int]:
    count = int(np.prod(leading, dtype=np.int64))
    if blocks is None:
        return np.zeros(count, dtype=np.intp), min(count, 1)
    labels = np.asarray(blocks)
    if labels.shape != leading or labels.dtype.kind not in "iuUS":
        raise RetrievalInputError(
            f"has the shape {labels.shape} of {labels.dtype}",
            field=field,
            remedy=f"give one whole number or name per profile, {leading}",
        )
    found, inverse = np.unique(labels.reshape(count), return_inverse=True)
    return inverse.reshape(count).astype(np.intp), int(found.size)


def _variances(
    variance: npt.ArrayLike, shape: tuple[int, ...], *, turn: bool
) -> tuple[Array, Indices]:
    array = inputs.real_array(variance, "variance").astype(np.float64, copy=False)
    if np.any(array < 0):
        raise RetrievalInputError(
            "is negative", field="variance", remedy="give squares of the power's unit"
        )
    if turn and array.ndim > 0:
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


def _estimated(signal: Array, members: list[Indices], block: Indices) -> tuple[Array, Indices]:
    """Return relative variances, from second differences along range, and which go with a profile.

    Bins are taken for independent. Where neighbours are correlated, second differences tell too
    little of them, and variances are those that sums have; of a few profiles nothing tells so.
    One row for each block, and one for each profile that is far louder than its block: it would
    spoil the errors of all others, and state too little itself. So would one with wild bins that
    are not bridged.

    Returns
    -------
    rows : (row, beam, bin) float64
    row : (profile,) intp
    """
    out = np.full((len(members), *signal.shape[1:]), np.nan)
    if signal.shape[-1] < 3:
        return out, block
    with np.errstate(invalid="ignore", divide="ignore"):
        logs = np.log(np.where(signal > 0, signal, np.nan))
    squares = (logs[..., :-2] - 2.0 * logs[..., 1:-1] + logs[..., 2:]) ** 2 / 6.0
    row, own = block.copy(), []
    for b, mine in enumerate(members):
        here = squares[mine]
        known = np.isfinite(here)
        level = _levels(here, known)
        loud = _louder(level)
        most = known & ~loud[..., np.newaxis] if loud.any() else known
        plain = _plain(here, known, _usual_square(here, most, level))
        times = _excess(logs[mine, :, 1:-1], plain, level)[:, np.newaxis]
        out[b] = _smoothed(here, plain & most)
        for n in np.flatnonzero(loud.any(axis=1)):
            told = known[n] & (here[n] <= _WILD * _usual_square(here[[n]], known[[n]], level[[n]]))
            plain[n, loud[n]] = told[loud[n]]
        hit = np.flatnonzero((loud | (known & ~plain).any(axis=2)).any(axis=1))
        # Where nobody looks for wild bins they are noise, but of their profile alone.
        wild = known[hit] & ~plain[hit]
        alone = np.broadcast_to(out[b], (hit.size, *out[b].shape)).copy()
        for k in np.flatnonzero(loud[hit].any(axis=1)):
            which = loud[hit[k]]
            alone[k, which] = _smoothed(here[hit[[k]]], plain[hit[[k]]])[which]
        more = _moving_mean(np.where(wild, here[hit], 0.0), known[hit])
        more = np.where((alone > _SCREENED**2) & (more > 0.0), more, 0.0)
        for k in np.flatnonzero(loud[hit].any(axis=1) | more.any(axis=(1, 2))):
            own.append((alone[k] + more[k]) * times)
            row[mine[hit[k]]] = len(members) + len(own) - 1
        out[b] *= times
    return np.concatenate([out, np.array(own)]) if own else out, row


def _excess(logs: Array, plain: Booleans, level: Array) -> Array:
    """Return (beam,) the variance of sums of bins over that of second differences of bins.

    Of what one profile differs by from the next: air that stays there would count as correlated
    noise. In units of the noise of both: where that differs much from profile to profile, medians
    of bins and of sums would differ by chance. 1 where chance makes as much, or too little is
    known.

    Parameters
    ----------
    logs : (profile, beam, bin) float64
    plain : (profile, beam, bin) bool
        Whether a bin is known, and not wild.
    level : (profile, beam) float64
        What variances are proportional to; where it is not finite or 0, the median of the others.
    """
    out = np.ones(logs.shape[1])
    size = logs.shape[-1] // (3 * _SUMMED)
    total = (len(logs) - 1) * size
    if total < _SUMS:
        return out
    level = np.where(np.isfinite(level) & (level > 0.0), level, np.nan)
    others = _beam_medians(level)
    level = np.where(np.isnan(level), np.where(others > 0.0, others, 1.0), level)
    # Of long beams a part is enough, too, but for those of which too little of it is known.
    every, beams = max(total // _ASKED_SUMS, 1), np.arange(out.size)
    while beams.size:
        pairs = np.arange(0, len(logs) - 1, every)
        here, after = np.ix_(pairs, beams), np.ix_(pairs + 1, beams)
        used = slice(0, size * 3 * _SUMMED)
        steps = logs[..., used][after] - logs[..., used][here]
        steps /= np.sqrt(level[here] + level[after])[..., np.newaxis]
        steps[~(plain[..., used][here] & plain[..., used][after])] = np.nan
        parts = steps.reshape(*steps.shape[:2], size, 3, _SUMMED)
        sums = _second_squares(parts.sum(axis=4)) / _SUMMED
        bins = _second_squares(parts[..., :3])
        usual, whole = _beam_medians(bins, _SUMS), _beam_medians(sums, _SUMS)
        told = (usual > 0.0) & (whole > _CORRELATED * usual)
        out[beams[told]] = whole[told] / usual[told]
        if every == 1:
            break
        every, beams = max(every // _MORE, 1), beams[whole == 0.0]
    return out


def _second_squares(values: Array) -> Array:
    """Return squares of the second differences of three."""
    return np.asarray((values[..., 0] - 2.0 * values[..., 1] + values[..., 2]) ** 2)


def _levels(squares: Array, known: Booleans) -> Array:
    """Return (profile, beam) medians along range, which no single wild bin moves."""
    # What is unknown is none of the smallest.
    some = np.where(known[..., ::_APART], squares[..., ::_APART], np.inf)
    return np.asarray(np.median(some, axis=2))


def _louder(level: Array) -> Booleans:
    """Return (profile, beam) where noise is far above that of most profiles."""
    usual = np.median(level, axis=0)
    return np.asarray(np.isfinite(level) & (level > LOUDER * usual) & (usual > 0.0))


def _plain(squares: Array, known: Booleans, usual: Array) -> Booleans:
    """Return (profile, beam, bin) what is known, and not wild by the (beam, bin) usual squares.

    Where many profiles are noisier than the rest, none of them is louder than most: what is
    usual in each of them is asked before its noise is called wild.
    """
    limit = _WILD * usual
    out = known & (squares <= limit)
    profile, beam = np.nonzero((known & ~out).any(axis=2))
    if profile.size:
        some = known[profile, beam, ::_APART]
        ratio = np.where(some, squares[profile, beam, ::_APART] / usual[beam, ::_APART], np.inf)
        number = some.sum(axis=1)
        middle = np.maximum(number - 1, 0) // 2
        times = np.sort(ratio, axis=1)[np.arange(number.size), middle]
        times = np.where(number >= _FEW, np.maximum(times, 1.0), 1.0)[:, np.newaxis]
        out[profile, beam] = known[profile, beam] & (squares[profile, beam] <= limit[beam] * times)
    return out


def _smoothed(squares: Array, known: Booleans) -> Array:
    """Return (beam, bin) means over profiles and neighbouring bins; two more bins than squares."""
    return _moving_mean(np.where(known, squares, 0.0).sum(axis=0), known.sum(axis=0))


def _moving_mean(total: Array, number: Indices | Booleans) -> Array:
    """Return means over neighbouring bins, of sums of so many squares; two more bins."""
    width = min(_SMOOTHED, total.shape[-1])
    with np.errstate(invalid="ignore", divide="ignore"):
        smooth = _moving_sum(total, width) / _moving_sum(number.astype(np.float64), width)
    return np.concatenate([smooth[..., :1], smooth, smooth[..., -1:]], axis=-1)


def _usual_square(squares: Array, known: Booleans, level: Array) -> Array:
    """Return (beam, bin) medians of profiles and of some tens of bins; inf where they are 0.

    By them a wild bin is told: one of one profile would be taken for noise of all. Some hundred
    squares tell a median well enough, so that not all profiles are asked: by their (profile, beam)
    level quiet and noisy ones alike, in whichever order they come.
    """
    every = len(squares) // _ASKED
    if every > 1:
        # Levels of counts may be equal.
        total = np.where(known, squares, 0.0).sum(axis=2)
        some = np.lexsort((total, level), axis=0)[every // 2 :: every]
        beams = np.arange(squares.shape[1])
        squares, known = squares[some, beams], known[some, beams]
    out = np.full(squares.shape[1:], np.inf)
    parts = max(squares.shape[-1] // _SMOOTHED, 1)
    edges = np.linspace(0, squares.shape[-1], parts + 1).astype(int)
    for low, high in pairwise(edges):
        here = np.where(known[..., low:high], squares[..., low:high], np.nan)
        usual = _beam_medians(here)
        out[:, low:high] = np.where(usual > 0.0, usual, np.inf)[:, np.newaxis]
    return out


def _beam_medians(values: Array, least: int = 1) -> Array:
    """Return (beam,) medians of what is known; 0 where that is less than some number.

    Parameters
    ----------
    values : (profile, beam, ...) float64
    least : int
    """
    rows = np.moveaxis(values, 1, 0).reshape(values.shape[1], -1)
    known = np.isfinite(rows)
    if known.all() and rows.shape[1] >= least:
        return np.asarray(np.median(rows, axis=1))
    kept = [row[good] for row, good in zip(rows, known, strict=True)]
    return np.array([np.median(row) if row.size >= least else 0.0 for row in kept])


def _moving_sum(values: Array, width: int) -> Array:
    """Return sums over a window that shrinks at the ends."""
    size = values.shape[-1]
    sums = np.concatenate([np.zeros((*values.shape[:-1], 1)), np.cumsum(values, axis=-1)], axis=-1)
    centre = np.arange(size)
    start = np.maximum(centre - width // 2, 0)
    stop = np.minimum(centre + width // 2 + 1, size)
    return np.asarray(sums[..., stop] - sums[..., start])


def _means(
    signal: Array, rows: Array, row: Indices, members: list[Indices], layout: Layout
) -> tuple[Array, Array, Array, Indices]:  # fmt: skip
    """Take medians of the signals of blocks; return variances, those of one profile, and numbers.

    Medians, because a single wild bin must not spoil a block. The energy of a laser changes from
    profile to profile, so that one with a gap on a beam would put a step there: it is left out.
    A few loud profiles do a median no harm, and are not counted in what is its variance.
    """
    shape = (len(members), *signal.shape[1:])
    mean, spread, single = np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, np.nan)
    averaged = np.zeros(len(members), dtype=np.intp)
    first, bins = layout.first_passage, layout.weights.shape[1]
    for beam in range(shape[1]):
        if first[beam] == first[beam + 1]:
            continue
        low, high = layout.window[first[beam]], layout.window[first[beam + 1] - 1] + bins
        whole = np.asarray(np.isfinite(signal[:, beam, low:high]).all(axis=1))
        for b, mine in enumerate(members):
            used = mine[whole[mine]]
            if used.size == 0:
                continue
            mean[b, beam] = np.median(signal[used, beam], axis=0)
            single[b, beam, low:high] = _usual(
                rows[row[used], beam, low:high],
                signal[used, beam, low:high],
                mean[b, beam, low:high],
            )
            spread[b, beam] = _OF_MEDIAN * single[b, beam] / used.size
            averaged[b] = min(averaged[b], used.size) if averaged[b] else used.size
    return mean, spread, single, averaged


def _usual(variances: Array, signal: Array, median: Array) -> Array:
    """Return (bin,) means of variances, but of those that are far louder than most.

    Parameters
    ----------
    variances, signal : (profile, bin) float64
    median : (bin,) float64
        Of the signal.
    """
    width = min(_SMOOTHED, median.size)
    known = np.isfinite(variances)
    usual = np.median(np.where(known, variances, np.inf), axis=0)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        stronger = (_moving_sum(signal, width) / _moving_sum(median, width)) ** 2
        allowed = LOUDER * np.fmin(np.fmax(stronger, 1.0), LOUDER)
        quiet = variances <= allowed * usual
        # Of a few counts, the median of the variances may be zero.
        quiet = known & (quiet | (usual == 0.0))
        return np.asarray(np.where(quiet, variances, 0.0).sum(axis=0) / quiet.sum(axis=0))


def _loud(
    signal: Array, rows: Array, row: Indices, single: Array, layout: Layout, *, relative: bool
) -> Booleans:
    """Return (profile, passage) where one far louder than its block is too weak by itself.

    By its own level, as the energy of a laser may be what raises its noise.
    """
    out = np.zeros((signal.shape[0], layout.passages.beam.size), dtype=np.bool_)
    if rows.shape[0] == 1:
        return out
    bins = layout.weights.shape[1]
    for c in range(out.shape[1]):
        beam, bin = layout.passages.beam[c], slice(layout.window[c], layout.window[c] + bins)
        with np.errstate(invalid="ignore", over="ignore"):
            spread = rows[row, beam, bin].sum(axis=1) / bins
            usual = single[:, beam, bin].sum(axis=1) / bins
            level = np.maximum(signal[:, beam, bin].sum(axis=1) / bins, 0.0)
            louder = (usual > 0.0) & ~(spread <= LOUDER * usual)
            scale = 1.0 if relative else level**2
            out[:, c] = louder & ~(spread <= LOUDEST_BIN**2 * scale)
    return out


def _faded(means: Condensed, below: Booleans, layout: Layout) -> Booleans:
    """Return (block, passage) where noise alone made a signal that was there not positive.

    What is weaker than weak is no worse for the other beams. A beam that has no signal at all, or
    that is less than noise makes it, is out of order, and told.
    """
    beam, first = layout.passages.beam, layout.first_passage[layout.passages.beam]
    negative = (means.status == _condensed_signals.NOT_POSITIVE)[:, beam]
    return np.asarray(negative & (means.usable == 0) & (means.usable[:, first] == 1) & ~below)


def _loudness(
    mean: Array, single: Array, averaged: Indices, layout: Layout, *, relative: bool
) -> tuple[Array, Booleans]:
    """Return (block, passage) relative variances of a bin of one profile about a crossing.

    And where the mean signal is less than zero by more than its noise.
    """
    total, bins = layout.passages.beam.size, layout.weights.shape[1]
    out, below = np.zeros((mean.shape[0], total)), np.zeros((mean.shape[0], total), dtype=np.bool_)
    number = np.maximum(averaged, 1) * bins / _OF_MEDIAN
    for c in range(total):
        beam, bin = layout.passages.beam[c], slice(layout.window[c], layout.window[c] + bins)
        # A wild bin may be so large that its square is none.
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            level = mean[:, beam, bin].sum(axis=1) / bins
            spread = single[:, beam, bin].sum(axis=1) / bins
            out[:, c] = spread if relative else np.where(level > 0, spread / level**2, np.inf)
            if not relative:
                below[:, c] = ~(level >= -_BELOW * np.sqrt(spread / number))
    return out, below


def average_blocks(
    power: npt.ArrayLike, groups: npt.ArrayLike, variance: npt.ArrayLike | None
) -> tuple[Array, Array | None]:
    """Average signals of groups of profiles; see `multiposition.average`."""
    signal = inputs.real_array(power, "power").astype(np.float64, copy=False)
    if signal.ndim != 3:
        raise RetrievalInputError(
            f"has the shape {signal.shape}", field="power", remedy="give (profile, beam, range)"
        )
    group, count = _blocks(groups, signal.shape[:1], "groups")
    noise = None
    if variance is not None:
        rows, row = _variances(variance, signal.shape, turn=False)
        noise = rows[row]
    mean = np.full((count, *signal.shape[1:]), np.nan)
    spread = None if noise is None else mean.copy()
    known = np.isfinite(signal) if noise is None else np.isfinite(signal) & np.isfinite(noise)
    for g in range(count):
        mine = np.flatnonzero(group == g)
        present = known[mine].any(axis=0)
        whole = np.asarray((known[mine] | ~present).all(axis=2))
        for beam in range(signal.shape[1]):
            used = mine[whole[:, beam]]
            if used.size == 0:
                continue
            mean[g, beam] = signal[used, beam].sum(axis=0) / used.size
            if spread is not None and noise is not None:
                spread[g, beam] = noise[used, beam].sum(axis=0) / used.size**2
    return mean, spread
