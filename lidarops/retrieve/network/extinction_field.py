"""Extinction and visibility from several lidars that look into the same air.

Where two beams cross, both lidars see the same extinction, whatever their constants and the
lidar ratio are. Along a beam, a = (P R^2 / overlap)^m is proportional to extinction times
exp(-2 m optical depth), if backscatter goes as extinction^(1/m) there; so that between a near
crossing n and a far one v

    a_n / extinction_n - a_v / extinction_v = 2 m (integral of a from n to v).

Nothing in it needs calibration: a lidar's constant multiplies the whole row. The overlap does
not cancel: an error of 1, 3 and 10 percent at the first crossing changes extinction there by 5, 14
and 34 percent.

A gradient over the whole network looks like attenuation where air is thin or noise is high, and
no test tells it there: what the prior allows, and what the rest of the block tells of it
(`lidarops.retrieve.network._block_errors`), is then most of the standard error. In 800 random networks
0.01(1) percent of the values without a flag are off by more than 4 standard errors, 0.005(3) in
plumes that drift within a block (`lidarops bench stability`). What is left stands in single
crossings in dense plumes. More profiles in a block and more beams tell more.

A layer so thin that signals bend within the bins of a fit puts an error into the values there, of
which the block tells too (`lidarops.retrieve.network._curvature_errors`).

Scale heights are 300 m and more there. In steeper fields the far crossings may fade, and leave
fewer equations than unknowns: errors are then stated with a prior that holds ln extinction over
the crossings to 0.6, and values are flagged where the beams exclude the usual one. A field that is
steeper still, of which so few beams tell nothing, is missed.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import special

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.air import visibility as sight
from lidarops.retrieve.common import inputs
from lidarops.retrieve.network import (
    _beam_signals,
    _block_errors,
    _closed_forms,
    _curvature_errors,
    _empirical_prior,
    _joint_solution,
)
from lidarops.retrieve.network import geometry as beams_geometry
from lidarops.retrieve.network._condensed_signals import MISSING, NOT_POSITIVE, OUTLYING
from lidarops.retrieve.network.geometry import Cycle, Network

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Booleans = npt.NDArray[np.bool_]

DEFAULT_BINS: Final = 7
DEFAULT_UNBIASED_MULTIPLIER: Final = 0.25
"""Of the unbiased estimate: its noise is nearly least there, in fields of any kind."""
_LEAST_PROBABILITY: Final = 1e-4


class NetworkMethod(StrEnum):
    """How extinction is found. All but the network see one cycle, or one beam."""

    NETWORK = "network"
    """All beams and crossings at once, weighted by their full covariance."""
    CYCLE = "cycle"
    """The exact closed form of a cycle."""
    MULTIPLIER = "multiplier"
    """The closed form with a multiplier below 1: less noise, a known systematic error."""
    UNBIASED = "unbiased"
    """The same, with what is neglected put to the start crossing: no error in homogeneous air."""
    SLOPE = "slope"
    """Each beam for itself, as if homogeneous from crossing to crossing."""
    KLETT = "klett"
    """Each beam for itself, from the slope at the far end of a segment."""


_HOMOGENEOUS: Final = frozenset(
    {NetworkMethod.MULTIPLIER, NetworkMethod.UNBIASED, NetworkMethod.SLOPE, NetworkMethod.KLETT}
)


_HARMLESS: Final = frozenset({"weak_signal", "bridged"})
"""Flags that do not speak against a value."""


class FieldPrior(StrEnum):
    """What a network is told about the field beforehand."""

    BLOCK = "block"
    """The mean field of the block of profiles, and how much profiles deviate from it."""
    NONE = "none"


@dataclass(frozen=True, slots=True, eq=False)
class CrossingFlags:
    """What is wrong with a value: (..., crossing) booleans each."""

    ill_conditioned: Booleans
    """Attenuation around the cycle, what takes its place, or the value itself is less than 3
    standard errors: of the profile, or typically of its block. Or the beams are too few to tell
    the field, and tell that it is not as the prior has it."""
    far_start: Booleans
    """The start of the cycle is the far crossing of its beam."""
    not_positive: Booleans
    """The solution is negative."""
    not_finite: Booleans
    """There is no solution."""
    uncertain: Booleans
    """The standard error exceeds the value."""
    signal_not_positive: Booleans
    """A beam of the crossing has a bin before it that is zero or negative."""
    signal_missing: Booleans
    """A beam of the crossing has a bin before it of which power or variance is not finite."""
    weak_signal: Booleans
    """A beam of the crossing is too noisy there, or of a variance that cannot be (zero), and was left
    out; the others stand."""
    bridged: Booleans
    """A beam of the crossing has bins that lie far off their neighbours: these took the place of
    single ones. Several together, which may be air, were left as they are, and what they and the
    bins between two edges change is part of the standard error. The value stands."""
    outlying: Booleans
    """A beam of the crossing has so many such bins before it that it was left out."""
    pole: Booleans
    """The multiplier makes the determinant vanish or turn its sign: no value."""
    unsettled: Booleans
    """The last pass of the network still moved the solution."""
    poor_fit: Booleans
    """The beams disagree by more than their noise allows."""
    not_homogeneous: Booleans
    """The method takes the air for homogeneous, and the beams say that it is not."""
    not_measured: Booleans
    """Fewer than two beams have full overlap and range there."""

    @property
    def flagged(self) -> Booleans:
        """Union of all but `weak_signal` and `bridged`, which do a value that is left no harm."""
        union = np.zeros_like(self.far_start)
        for field in fields(self):
            if field.name not in _HARMLESS:
                union = union | getattr(self, field.name)
        return union


@dataclass(frozen=True, slots=True, eq=False)
class MultiPositionResult:
    """Extinction at the crossings of a network, with the leading axes of the power."""

    extinction: Array
    """(..., crossing) m-1; NaN at crossings that are near ones on no beam, and where there is none."""
    extinction_standard_error: Array
    """m-1, by noise, by what a line through a few bins has wrong where the signal bends, and by
    what a field may deviate from the prior: twice the prior's standard deviation is counted, eight
    times as much where beams are too few to test the prior, and a bend over the network where the
    mean of the block's beams allows it.
    Of a block in thin air, no less than is typical of it, and what noise moves all by."""
    visibility: sight.VisibilityResult
    """(..., crossing) m, at the wavelength of the lidars."""
    flags: CrossingFlags
    near_crossing: Booleans
    """(crossing,) True where extinction is reported."""
    reduced_chi_square: Array
    """(...) of the beams of the network, free of the prior; NaN for other methods, and where
    nothing is left over."""
    degrees_of_freedom: Array
    """(...)."""
    prior_deviation: Array
    """(...) of ln extinction about the mean field; inf without prior, NaN without network."""
    multiplier: Array
    """(...) of the cycle; NaN for other methods."""
    method: NetworkMethod


def average_signals(
    power: npt.ArrayLike, groups: npt.ArrayLike, *, variance: npt.ArrayLike | None = None
) -> tuple[Array, Array | None]:
    """Average the signals of groups of profiles, as should be done before they are solved.

    A lidar's energy changes from profile to profile: a beam with a gap would put a step into the
    mean, and is left out of it, as is one with a bin of unknown variance. Where no profile of a
    group has a bin, the mean has none.

    Parameters
    ----------
    power : (profile, beam, range) float
    groups : (profile,) int or str
        Labels; groups come in their sorted order.
    variance : (profile, beam, range) float, optional

    Returns
    -------
    power : (group, beam, range) float64
    variance : (group, beam, range) float64, or None where none is given
        Of the mean.

    Raises
    ------
    RetrievalInputError
        For shapes that do not fit.
    """
    return _beam_signals.average_blocks(power, groups, variance)


def retrieve_network(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    network: Network,
    *,
    method: str = "network",
    variance: npt.ArrayLike | None = None,
    overlap: npt.ArrayLike | None = None,
    full_overlap_range: npt.ArrayLike | None = None,
    exponent: npt.ArrayLike = 1.0,
    blocks: npt.ArrayLike | None = None,
    prior: str = "block",
    cycle: Cycle | None = None,
    start: int | None = None,
    multiplier: float | None = None,
    bins: int = DEFAULT_BINS,
    contrast: float = sight.MOR_CONTRAST,
) -> MultiPositionResult:
    """Find extinction and visibility where the beams of several lidars meet.

    Average signals before (`average_signals`), not results afterwards: noise makes these biased.

    Parameters
    ----------
    power : (..., beam, range) float
        Any unit, free of background. Each lidar has its own constant, which may change from
        profile to profile.
    range : (range,) or (beam, range) float
        m.
    network : Network
        Of `lidarops.retrieve.network.geometry`, with as many beams.
    method : {"network", "cycle", "multiplier", "unbiased", "slope", "klett"}
    variance : (..., beam, range) float, optional
        Noise variance in the square of the power's unit, broadcast against `power`; bins are
        independent. Where not given, second differences along range tell it, block by block, and
        sums of bins that these are correlated, where there are profiles enough.
    overlap : (beam, range) or (range,) float, optional
        Overlap function, by which power is divided; bins below 0.5 are not used.
    full_overlap_range : float or (beam,) float, optional
        m; nearer bins are not used. One of the two is required.
    exponent : float or (beam,) float
        m of backscatter ~ extinction^(1/m) along a beam.
    blocks : (...) int or str, optional
        Labels of the profiles that are pooled, for the mean field and the multiplier; one block
        where not given. A block's results depend on its own profiles only. Where many of them are
        far noisier than many others, it is parted into the quiet and the noisy ones.
    prior : {"block", "none"}
        For the network. "none" solves each profile for itself; crossings that are not
        determined are NaN.
    cycle : Cycle, optional
        For "cycle", "multiplier" and "unbiased"; that of `geometry.cycle` where not given.
    start : int, optional
        Crossing of the cycle to solve for alone, with the cycle turned to it; all near crossings
        in turn where not given.
    multiplier : float, optional
        For "multiplier" (the best of each block where not given) and "unbiased" (0.25).
    bins : int
        Of the fit that gives the signal at a crossing.
    contrast : float
        Threshold of visibility.

    Returns
    -------
    MultiPositionResult

    Raises
    ------
    RetrievalInputError
        For arguments that cannot be right.

    References
    ----------
    drabenko2021, yegorov2008.
    """
    chosen = inputs.choice(method, NetworkMethod, "method")
    told = inputs.choice(prior, FieldPrior, "prior")
    _check_settings(chosen, multiplier, cycle, start)
    sight.koschmieder_constant(contrast)
    if network.crossings == 0:
        raise RetrievalInputError(
            "has no crossings: its beams do not meet",
            field="network",
            remedy="point the lidars at common volumes, or widen the tolerance of the geometry",
        )
    beams = _beam_signals.prepare_signals(
        power, range, network, variance=variance, overlap=overlap,
        full_overlap_range=full_overlap_range, exponent=exponent, blocks=blocks, bins=bins,
    )  # fmt: skip
    if chosen is NetworkMethod.NETWORK:
        estimate, fit = _solve_network(beams, network.crossing, told)
    else:
        walk = None
        if chosen not in {NetworkMethod.SLOPE, NetworkMethod.KLETT}:
            walk = cycle if cycle is not None else beams_geometry.build_cycle(network, start=start)
        estimate, fit = _solve_closed(beams, chosen, walk, multiplier, start), None
    return _judged(beams, estimate, fit, chosen, contrast)


def _solve_network(
    beams: _beam_signals.BeamSignals, position: Array, prior: FieldPrior
) -> tuple[_closed_forms.CrossingEstimate, _empirical_prior.PriorSolution]:
    layout = beams.layout
    numbers = np.cumsum(layout.measured) - 1
    crossing = numbers[layout.passages.crossing].astype(np.intp)
    position = position[layout.measured]
    if prior is FieldPrior.NONE or crossing.size == 0:
        fit = _empirical_prior.solve_without_prior(
            beams.data, layout, crossing, beams.exponent, position
        )
    else:
        fit = _empirical_prior.solve_blocks(
            beams.data, layout, crossing, beams.exponent, position, beams.block
        )
    shape = (beams.block.size, layout.crossings)
    extinction, variance = np.full(shape, np.nan), np.full(shape, np.nan)
    believed = np.full(shape, np.nan)
    with np.errstate(over="ignore", under="ignore"):
        extinction[:, layout.measured] = np.exp(fit.logarithm)
        variance[:, layout.measured] = np.exp(2.0 * fit.logarithm) * fit.variance
        believed[:, layout.measured] = np.exp(2.0 * fit.logarithm) * fit.believed
    if prior is FieldPrior.BLOCK:
        seen = beams.data.usable == 1
        variance = _block_errors.at_least_typical(extinction, variance, beams.block, seen)
    with np.errstate(over="ignore", under="ignore"):
        bent = _by_bends(beams, fit, crossing, position)
        variance[:, layout.measured] += extinction[:, layout.measured] ** 2 * bent
    none = np.zeros(shape, dtype=np.bool_)
    # Doubt in the prior, which is stated, is no noise that makes a value lie anywhere.
    shaky = _closed_forms.shaky(extinction, believed, beams.block) | fit.doubtful[:, np.newaxis]
    estimate = _closed_forms.CrossingEstimate(
        extinction, variance, shaky, none, np.zeros(shape[1], dtype=np.bool_),
        np.full(shape[0], np.nan),
    )  # fmt: skip
    return estimate, fit


def _by_bends(
    beams: _beam_signals.BeamSignals,
    fit: _empirical_prior.PriorSolution,
    crossing: Indices,
    position: Array,
) -> Array:
    """Return (profile, crossing) variances of ln extinction by what bends of signals put into values.

    What the profiles of a block share tells the bends; see `lidarops.retrieve.network._curvature_errors`.
    """
    out = np.zeros_like(fit.logarithm)
    geometry = (beams.layout.first_passage, beams.layout.offset, crossing)
    for b in np.unique(beams.block):
        mine = np.flatnonzero(beams.block == b)
        precision, flat = _empirical_prior.prior_of(position, fit, mine[0])
        data, moved = beams.data.take(mine), np.zeros((mine.size, position.shape[0], 4))
        _curvature_errors.carry_errors(
            data.log_value, data.integral, data.usable, data.covariance, geometry, precision, flat,
            fit.logarithm[mine], _curvature_errors.usual(data.departure, data.usable), data.departure,
            moved,
        )  # fmt: skip
        out[mine] = _curvature_errors.variance(moved)
    return out


def _solve_closed(
    beams: _beam_signals.BeamSignals,
    method: NetworkMethod,
    cycle: Cycle | None,
    multiplier: float | None,
    start: int | None,
) -> _closed_forms.CrossingEstimate:
    if cycle is None:
        return _closed_forms.by_single_beams(beams, far_end=method is NetworkMethod.KLETT)
    if method is NetworkMethod.CYCLE:
        multiplier = 1.0
    elif method is NetworkMethod.UNBIASED and multiplier is None:
        multiplier = DEFAULT_UNBIASED_MULTIPLIER
    return _closed_forms.by_cycle(
        beams,
        cycle,
        multiplier,
        unbiased=method is NetworkMethod.UNBIASED,
        only_start=start is not None,
    )


def _judged(
    beams: _beam_signals.BeamSignals,
    estimate: _closed_forms.CrossingEstimate,
    fit: _empirical_prior.PriorSolution | None,
    method: NetworkMethod,
    contrast: float,
) -> MultiPositionResult:
    """Report extinction at near crossings, and flag it."""
    shape = estimate.extinction.shape
    near = beams.layout.near_crossing | estimate.far_start
    with np.errstate(invalid="ignore"):
        finite = np.isfinite(estimate.variance)
        finite &= np.abs(estimate.extinction) < sight.LARGEST_EXTINCTION
        positive = finite & (estimate.extinction > 0)
        uncertain = estimate.variance > estimate.extinction**2
    extinction = np.where(positive & near, estimate.extinction, np.nan)
    error = np.sqrt(np.where(positive & near, estimate.variance, np.nan))
    none = np.zeros(shape[0], dtype=np.bool_)
    chi_square, freedom = np.full(shape[0], np.nan), np.full(shape[0], np.nan)
    deviation, unsettled, poor = np.full(shape[0], np.nan), none, none
    weak = beams.weak
    if fit is not None:
        freedom, deviation = fit.degrees_of_freedom, fit.deviation
        with np.errstate(invalid="ignore", divide="ignore"):
            chi_square = np.where(freedom > 0, fit.chi_square / freedom, np.nan)
        poor = _improbable(fit.chi_square, freedom)
        poor |= _improbable(fit.prior_chi_square, fit.prior_degrees_of_freedom)
        unsettled = fit.status == _joint_solution.UNSETTLED
        dropped = fit.left_out[:, beams.layout.passages.beam] == 1
        weak = weak | (dropped & (beams.data.usable == 1))
    flags = CrossingFlags(
        ill_conditioned=estimate.weak_attenuation & finite,
        far_start=np.broadcast_to(estimate.far_start, shape),
        not_positive=finite & ~positive,
        not_finite=~finite,
        uncertain=uncertain,
        signal_not_positive=_lost(beams, NOT_POSITIVE),
        signal_missing=_lost(beams, MISSING),
        weak_signal=_by_crossing(beams, weak),
        bridged=_by_crossing(beams, beams.data.bridged[:, beams.layout.passages.beam] == 1),
        outlying=_lost(beams, OUTLYING),
        pole=estimate.pole,
        unsettled=np.broadcast_to(unsettled[:, np.newaxis], shape),
        poor_fit=np.broadcast_to(poor[..., np.newaxis], shape),
        not_homogeneous=(
            _closed_forms.inhomogeneous(beams, estimate)
            if method in _HOMOGENEOUS
            else np.zeros(shape, dtype=np.bool_)
        ),
        not_measured=np.broadcast_to(~beams.layout.measured, shape),
    )
    leading = beams.leading
    shaped = CrossingFlags(
        **{
            f.name: getattr(flags, f.name).reshape(*leading, shape[1]).copy()
            for f in fields(CrossingFlags)
        }
    )
    values = extinction.reshape(*leading, shape[1])
    errors = error.reshape(*leading, shape[1])
    return MultiPositionResult(
        values, errors,
        sight.visibility_from_extinction(values, errors, contrast=contrast),
        shaped, near, chi_square.reshape(leading), freedom.reshape(leading),
        deviation.reshape(leading), estimate.multiplier.reshape(leading), method,
    )  # fmt: skip


def _improbable(chi_square: Array, freedom: Array) -> Booleans:
    """Return where chance gives so large a chi-square once in ten thousand, or less."""
    known = np.isfinite(chi_square) & (freedom > 0)
    chance = special.gammaincc(
        np.where(known, freedom, 1.0) / 2.0, np.where(known, np.maximum(chi_square, 0.0), 0.0) / 2.0
    )
    return np.asarray(known & (chance < _LEAST_PROBABILITY))


def _lost(beams: _beam_signals.BeamSignals, reason: int) -> Booleans:
    """Return where a beam of a crossing has lost it for a reason."""
    status = beams.data.status[:, beams.layout.passages.beam]
    beyond = (beams.data.usable == 0) & ~beams.weak
    return _by_crossing(beams, (status == reason) & beyond)


def _by_crossing(beams: _beam_signals.BeamSignals, passages: Booleans) -> Booleans:
    out = np.zeros((passages.shape[0], beams.layout.crossings), dtype=np.bool_)
    for c, crossing in enumerate(beams.layout.passages.crossing):
        out[:, crossing] |= passages[:, c]
    return out


# Checks -------------------------------------------------------------------------------------


def _check_settings(
    method: NetworkMethod, multiplier: float | None, cycle: Cycle | None, start: int | None
) -> None:
    cyclic = method in {NetworkMethod.CYCLE, NetworkMethod.MULTIPLIER, NetworkMethod.UNBIASED}
    if multiplier is not None:
        if method not in {NetworkMethod.MULTIPLIER, NetworkMethod.UNBIASED}:
            raise RetrievalInputError(
                f"is not used by the method '{method}'",
                field="multiplier",
                remedy="choose 'multiplier' or 'unbiased'",
            )
        if not 0.0 <= multiplier <= 1.0:
            raise RetrievalInputError(f"is {multiplier}, not from 0 to 1", field="multiplier")
    for value, name in ((cycle, "cycle"), (start, "start")):
        if value is not None and not cyclic:
            raise RetrievalInputError(f"is not used by the method '{method}'", field=name)
    if cycle is not None and start is not None and start != int(cycle.crossing[0]):
        raise RetrievalInputError(
            f"is {start}, but the cycle starts at {int(cycle.crossing[0])}",
            field="start",
            remedy="give it to geometry.cycle",
        )
