"""Signals of the beams of a network: validated and condensed, without those that noise hides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.network import _condensed_signals, _fit_layout
from lidarops.retrieve.network._condensed_signals import NOT_POSITIVE, CondensedSignals
from lidarops.retrieve.network._fit_layout import FitLayout
from lidarops.retrieve.network.geometry import Network
from lidarops.retrieve.network.thresholds import THRESHOLDS

_MEDIAN_OVER_MEAN: Final = np.pi / 2.0
"""Variance of a median over the variance of a mean."""


@dataclass(frozen=True, slots=True, eq=False)
class BeamSignals:
    """Condensed signals of the beams."""

    layout: FitLayout
    exponent: Array
    """(beam,)."""
    data: CondensedSignals
    """Signals of the profiles."""
    block: Indices
    """(profile,) block numbers."""
    weak: Booleans
    """(profile, passage) True where noise hides an existing signal, in the block or in a profile
    far noisier than most of it."""
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
    variances = _variances(variance, leading, signal.shape, descending=descending)
    data = _condensed_signals.condense(signal, variances, exponents, layout)
    with np.errstate(all="ignore"):
        weak, negative = _weak_passages(signal, variances, layout, block)
    # Missing signals already have a reason.
    weak &= data.usable | (data.status == NOT_POSITIVE)[:, layout.passages.beam]
    data.usable[weak | negative] = False
    return BeamSignals(layout, exponents, data, block, weak, leading)


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
    low, high = THRESHOLDS.exponents
    if array.shape not in {(), (beams,)} or not np.all((array >= low) & (array <= high)):
        raise RetrievalInputError(
            f"is not from {low:g} to {high:g}, or of a wrong shape",
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
    variance: npt.ArrayLike, leading: tuple[int, ...], shape: tuple[int, ...], *, descending: bool
) -> Array:
    array = inputs.real_array(variance, "variance").astype(np.float64, copy=False)
    if np.any(array < 0):
        raise RetrievalInputError(
            "is negative", field="variance", remedy="give squares of the power's unit"
        )
    if descending and array.ndim > 0:
        array = array[..., ::-1]
    try:
        full = np.broadcast_to(array, (*leading, *shape[1:]))
    except ValueError:
        raise RetrievalInputError(
            f"has the shape {array.shape}",
            field="variance",
            remedy=f"give (..., beam, range), here (..., {shape[1]}, {shape[2]})",
        ) from None
    return full.reshape(shape)


def _weak_passages(
    power: Array, variance: Array, layout: FitLayout, block: Indices
) -> tuple[Booleans, Booleans]:
    """Return (profile, passage) where noise hides the signal, and where the signal is negative.

    A block decides together: profiles whose signal is positive by chance would be selected. So
    does a profile far noisier than its block. It is compared with its own level, because a higher
    laser energy also raises the noise.
    """
    bins = layout.weights.shape[1]
    level, spread = np.empty((2, len(power), layout.passages.beam.size))
    for c, (beam, first) in enumerate(zip(layout.passages.beam, layout.window, strict=True)):
        level[:, c] = power[:, beam, first : first + bins].sum(axis=1) / bins
        spread[:, c] = variance[:, beam, first : first + bins].sum(axis=1) / bins
    weak, negative = np.zeros(level.shape, np.bool_), np.zeros(level.shape, np.bool_)
    limit = THRESHOLDS.largest_bin_error**2
    for number in np.unique(block):
        rows = np.flatnonzero(block == number)
        for c in range(level.shape[1]):
            known = rows[np.isfinite(level[rows, c]) & np.isfinite(spread[rows, c])]
            if known.size == 0:
                continue
            spreads = spread[known, c]
            # Where noise rises, more than half of the profiles may be noisy.
            counted = spreads <= THRESHOLDS.noisy_profile * np.median(spreads)
            typical = np.median(level[known, c]), np.mean(spreads[counted])
            error = np.sqrt(_MEDIAN_OVER_MEAN * typical[1] / (known.size * bins))
            negative[rows, c] = typical[0] < -THRESHOLDS.negative * error
            noisy = spread[rows, c] > THRESHOLDS.noisy_profile * typical[1]
            noisy &= spread[rows, c] > limit * np.maximum(level[rows, c], 0.0) ** 2
            weak[rows, c] = noisy | (typical[1] > limit * max(typical[0], 0.0) ** 2)
    return weak & ~negative, negative
