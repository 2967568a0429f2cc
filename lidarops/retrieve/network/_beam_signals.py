"""Signals of the beams of a network: validated and condensed, without those that noise hides."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Booleans, Codes, Indices, median
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.network import _condensed_signals
from lidarops.retrieve.network._changing_field import change_roots, field_precision
from lidarops.retrieve.network._condensed_signals import (
    NOT_POSITIVE,
    CleanBeam,
    FitLayout,
    places,
)
from lidarops.retrieve.network.geometry import Network, per_beam
from lidarops.retrieve.network.settings import EXPONENTS
from lidarops.retrieve.network.thresholds import THRESHOLDS

_MEDIAN_OVER_MEAN: Final = np.pi / 2.0
"""Variance of a median over the variance of a mean."""


class SignalChange(NamedTuple):
    """A small change of the signals of a beam."""

    power: Array | None = None
    """(profile, bin) what is added, in the unit of the power."""
    relative: Array | None = None
    """(bin,) relative change of the power."""
    exponent: float = 0.0
    """Relative change of the exponent."""

    def take(self, profiles: Indices) -> SignalChange:
        """Return the selected profiles."""
        return self._replace(power=None if self.power is None else self.power[profiles])

    def of_power(self, bins: slice, power: Array) -> Array:
        """Return (profile or 1, bin) relative changes of a (profile, bin) power."""
        added = np.zeros((1, 1)) if self.power is None else self.power[:, bins] / power
        return added if self.relative is None else added + self.relative[bins]


Causes = Sequence[Mapping[int, SignalChange]]
"""Changes by the number of the beam, each of which has one cause."""
Response = Callable[[Causes], Array]
"""From causes to (profile, crossing, cause) changes of ln extinction."""


class Block(NamedTuple):
    """Clean signals of the profiles of a block."""

    beams: list[CleanBeam]
    """Those with passages."""
    layout: FitLayout
    reach: Indices
    """(profile, beam) number of usable passages."""
    exponent: Array
    """(beam,) of all beams."""
    prior: Array
    """(crossing, crossing) precision of the mean field, at measured crossings."""
    roots: Array
    """(length, crossing, crossing) of changes; `_changing_field.change_roots`."""

    def near_ends(self) -> Causes:
        """Return relative changes of 1 at the first passage of a beam, and 0 at its last one."""
        at, first = self.layout.passages.range, self.layout.first_passage
        causes = []
        for k in (beam.number for beam in self.beams):
            ends = at[[first[k], first[k + 1] - 1]]
            relative = np.interp(self.layout.range[k], ends, [1.0, 0.0])
            causes.append({k: SignalChange(relative=relative)})
        return causes


@dataclass(frozen=True, eq=False)
class BeamSignals:
    """Clean signals of the beams."""

    layout: FitLayout
    exponent: Array
    """(beam,)."""
    beams: list[CleanBeam]
    """Those with passages."""
    usable: Booleans
    """(profile, passage)."""
    status: Codes
    """(profile, passage) why a beam ends before its last passage."""
    bridged: Booleans
    """(profile, passage) True where the beam has outlying bins."""
    block: Indices
    """(profile,) block numbers."""
    weak: Booleans
    """(profile, passage) True where noise hides an existing signal, in the block or in a profile
    far noisier than most of it."""
    leading: tuple[int, ...]
    """Shape of the axes before beam and range."""
    together: bool
    """Whether the profiles of a block are one field."""

    def blocks(self, position: Array) -> Iterator[tuple[Indices, Block]]:
        """Yield the numbers of the profiles of each block, and their signals.

        `position` is the (crossing, 3) one in m.
        """
        ends = [(a, b) for a, b in itertools.pairwise(self.layout.first_passage) if b > a]
        if not ends:
            return
        measured = position[self.layout.measured]
        prior, roots = field_precision(measured), change_roots(measured)
        for number in np.unique(self.block):
            rows = np.flatnonzero(self.block == number)
            reach = [
                np.logical_and.accumulate(self.usable[rows, a:b], axis=1).sum(axis=1)
                for a, b in ends
            ]
            beams = [each.take(rows) for each in self.beams]
            counts = np.stack(reach, axis=1).astype(np.intp)
            yield rows, Block(beams, self.layout, counts, self.exponent, prior, roots)


def _no_response(causes: Causes) -> Array:
    return np.zeros((1, 1, len(causes)))


@dataclass(frozen=True, slots=True, eq=False)
class Estimates:
    """What the profiles and blocks give, before flags are set; NaN where there is none."""

    extinction: Array
    """(profile, crossing) m-1."""
    variance: Array
    """(profile, crossing) m-2."""
    settled: Booleans
    """(profile,)."""
    left_out: Booleans
    """(profile, passage) True where the covariance of a beam is singular or missing."""
    chi_square: Array
    """(profile, 2) of the beams alone, and about the field of the block."""
    degrees_of_freedom: Array
    """(profile, 2) of these."""
    overlap: Array
    """(profile, crossing) change of ln extinction by overlap errors of 1 at the near ends."""
    overlap_error: Array
    """(profile, crossing) m-1, part of the error by the default error of the overlap."""
    multiplier: Array
    """(profile, crossing)."""
    multiplier_error: Array
    """(profile, crossing) m-1."""
    open: Booleans
    """(profile, crossing) True where no triangle leads away, with a multiplier."""
    respond: Response = _no_response

    @classmethod
    def missing(cls, profiles: int, layout: FitLayout) -> Estimates:
        """Return estimates without values, of all beams together; solvers fill the arrays."""
        shape = (profiles, layout.crossings)
        return cls(
            np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(profiles, dtype=np.bool_),
            np.zeros((profiles, layout.passages.beam.size), dtype=np.bool_),
            np.full((profiles, 2), np.nan), np.full((profiles, 2), np.nan),
            np.zeros(shape), np.zeros(shape), np.full(shape, np.nan), np.zeros(shape),
            np.zeros(shape, dtype=np.bool_),
        )  # fmt: skip

    def leave_out(self, block: Block, reach: Indices) -> None:
        """State which beams have no weight, though they have usable passages."""
        beam, _ = places(block.layout)
        self.left_out[:] = ((reach == 0) & (block.reach > 1))[:, beam]

    def with_response(self, block: Block, respond: Response) -> Estimates:
        """Return the estimates with how they follow changes of the signals."""
        overlap = np.sqrt((respond(block.near_ends()) ** 2).sum(axis=2))
        return replace(self, respond=respond, overlap=overlap)


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
    together: bool,
) -> BeamSignals:
    """Validate and clean signals.

    Arguments are those of `extinction_field.retrieve_network`, and whether the profiles of a block
    are solved together.
    """
    ranges = _ranges(range_, network.beams)
    signal = inputs.real_array(power, "power").astype(np.float64, copy=False)
    if signal.ndim < 2 or signal.shape[-2:] != ranges.shape:
        raise RetrievalInputError(
            f"has the shape {signal.shape}",
            field="power",
            remedy=f"its last two axes are beam and range, here {ranges.shape}",
        )
    leading = signal.shape[:-2]
    variances = inputs.real_array(variance, "variance").astype(np.float64, copy=False)
    if np.any(variances < 0):
        raise RetrievalInputError(
            "is negative", field="variance", remedy="give squares of the power's unit"
        )
    variances = inputs.broadcast(variances, signal.shape, "variance")
    signal, variances = (
        np.ascontiguousarray(values.reshape(-1, *ranges.shape)) for values in (signal, variances)
    )
    block = _blocks(blocks, leading)
    nearest, overlap_function = _overlap(overlap, full_overlap_range, ranges)
    exponents = per_beam(exponent, network.beams, "exponent", *EXPONENTS)
    bins = THRESHOLDS.fit_bins
    layout = _condensed_signals.lay_out_fits(network, ranges, overlap_function, nearest, bins)
    signal = np.where(np.isnan(ranges), np.nan, signal)
    beams = _condensed_signals.clean(signal, variances, exponents, layout, together=together)
    with np.errstate(all="ignore"):
        weak, negative = _weak_passages(signal, variances, layout, block, together=together)
    shape = weak.shape
    status, usable = np.zeros(shape, dtype=np.uint8), np.zeros(shape, dtype=np.bool_)
    bridged = np.zeros(shape, dtype=np.bool_)
    for row in beams:
        on_beam = slice(layout.first_passage[row.number], layout.first_passage[row.number + 1])
        status[:, on_beam], bridged[:, on_beam] = row.status[:, None], row.bridged[:, None]
        usable[:, on_beam] = layout.window[on_beam] + bins <= row.stops[:, None]
    # Missing signals already have a reason.
    weak &= usable | (status == NOT_POSITIVE)
    usable &= ~(weak | negative)
    return BeamSignals(
        layout, exponents, beams, usable, status, bridged, block, weak, leading, together
    )


def _ranges(values: npt.ArrayLike, beams: int) -> Array:
    """Return (beam, bin) ascending ranges; NaN after the last bin of a beam."""
    array = inputs.real_array(values, "range").astype(np.float64)
    if array.ndim == 1:
        array = np.tile(array, (beams, 1))
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
        inputs.range_grid(row[known])
    return np.ascontiguousarray(array)


def _overlap(
    overlap: npt.ArrayLike | None, nearest: npt.ArrayLike | None, ranges: Array
) -> tuple[Array, Array | None]:
    """Return the nearest usable range of each beam, and the overlap function if there is one."""
    if overlap is None and nearest is None:
        raise RetrievalInputError(
            "is not given, and full_overlap_range is not either",
            field="overlap",
            remedy="give one of them: an error of 1 percent in the overlap at the first crossing"
            " changes extinction there by 5 percent",
        )
    limits = 0.0 if nearest is None else nearest
    first = per_beam(limits, len(ranges), "full_overlap_range")
    if overlap is None:
        return first, None
    array = inputs.real_array(overlap, "overlap").astype(np.float64)
    if np.any(array < 0) or np.any(array > 1.5):
        raise RetrievalInputError(
            "is not between 0 and 1.5", field="overlap", remedy="give 1 for full overlap"
        )
    return first, inputs.broadcast(array, ranges.shape, "overlap")


def _blocks(blocks: npt.ArrayLike | None, leading: tuple[int, ...]) -> Indices:
    """Return (profile,) block numbers."""
    labels = np.zeros(leading, dtype=np.intp) if blocks is None else np.asarray(blocks)
    if labels.shape != leading or labels.dtype.kind not in "iu":
        raise RetrievalInputError(
            f"has the shape {labels.shape} of {labels.dtype}",
            field="blocks",
            remedy=f"give one whole number per profile, {leading}",
        )
    return np.unique(labels.ravel(), return_inverse=True)[1].astype(np.intp)


def _weak_passages(
    power: Array, variance: Array, layout: FitLayout, block: Indices, *, together: bool
) -> tuple[Booleans, Booleans]:
    """Return (profile, passage) where noise hides the signal, and where the signal is negative.

    A block decides together: profiles whose signal is positive by chance would be selected. So
    does a profile far noisier than its block. It is compared with its own level, because a higher
    laser energy also raises the noise.
    """
    bins = layout.weights.shape[1]
    beam = layout.passages.beam[:, np.newaxis]
    at = layout.window[:, np.newaxis] + np.arange(bins)
    level, spread = (values[:, beam, at].mean(axis=2) for values in (power, variance))
    weak, negative = np.zeros(level.shape, np.bool_), np.zeros(level.shape, np.bool_)
    limit = THRESHOLDS.largest_bin_error**2
    for number in np.unique(block):
        rows = np.flatnonzero(block == number)
        levels, spreads = level[rows], spread[rows]
        known = np.isfinite(levels) & np.isfinite(spreads)
        typical, middle = (median(values, known) for values in (levels, spreads))
        # Where noise rises, more than half of the profiles may be noisy.
        counted = known & (spreads <= THRESHOLDS.noisy_profile * middle)
        mean = np.where(counted, spreads, 0.0).sum(axis=0) / counted.sum(axis=0)
        profiles = known.sum(axis=0)
        error = np.sqrt(_MEDIAN_OVER_MEAN * mean / (profiles * bins))
        negative[rows] = typical < -COMMON.contradicted * error
        noisy = spreads > THRESHOLDS.noisy_profile * mean
        noisy &= spreads > limit * np.maximum(levels, 0.0) ** 2
        averaged = profiles if together else 1.0
        weak[rows] = noisy | (mean / averaged > limit * np.maximum(typical, 0.0) ** 2)
    return weak & ~negative, negative
