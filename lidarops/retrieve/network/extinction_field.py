"""Extinction and visibility from the signals of several lidars whose beams cross.

Where two beams cross, both lidars see the same extinction, whatever their constants and the
lidar ratio. Along a beam, a = (P R^2 / overlap)^m is proportional to extinction times
exp(-2 m optical depth), if backscatter ~ extinction^(1/m) there. Between a near crossing n and a
far one v therefore

    a_n / extinction_n - a_v / extinction_v = 2 m (integral of a from n to v).

No calibration is needed: the constant of a lidar multiplies the whole row. The overlap does not
cancel: an error of 1, 3 and 10 percent at the first crossing changes extinction there by 5, 14
and 34 percent.

In thin air or high noise, a gradient over the whole network looks like attenuation, and no test
can separate them. The standard error is then mostly what the prior allows and what the rest of
the block shows (`lidarops.retrieve.network._block_errors`). In 800 random networks, 0.01(1)
percent of the unflagged values differed from the truth by more than 4 standard errors, and
0.005(3) percent in plumes that drift within a block (`lidarops bench stability`). The remaining
ones are single crossings in dense plumes. More profiles per block and more beams reduce them.

In a layer so thin that the signal is curved within the bins of a fit, the fitted values are
biased. The block shows this error too (`lidarops.retrieve.network._curvature_errors`).

Scale heights in these networks are 300 m or more. In steeper fields the signals at far crossings
may be too weak, which leaves fewer equations than unknowns. Errors are then stated with a prior
of 0.6 for ln extinction over the crossings, and values are flagged where the beams contradict
the usual prior. A still steeper field goes undetected where so few beams cannot show it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import special

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.air import visibility as air_visibility
from lidarops.retrieve.common import inputs
from lidarops.retrieve.network import (
    _beam_signals,
    _block_errors,
    _closed_forms,
    _curvature_errors,
    _empirical_prior,
    _joint_solution,
)
from lidarops.retrieve.network._condensed_signals import MISSING, NOT_POSITIVE, OUTLYING
from lidarops.retrieve.network.geometry import Cycle, Network, build_cycle

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Booleans = npt.NDArray[np.bool_]

DEFAULT_BINS: Final = 7
"""Bins of the fit that gives the signal at a crossing."""
DEFAULT_UNBIASED_MULTIPLIER: Final = 0.25
"""Multiplier of the unbiased estimate. Its noise is close to the minimum there, in all kinds of
fields."""
_LEAST_PROBABILITY: Final = 1e-4
"""Probability of a chi-square below which a fit is flagged as poor."""


class NetworkMethod(StrEnum):
    """How extinction is retrieved. All methods but the network use one cycle or one beam."""

    NETWORK = "network"
    """All beams and crossings together, weighted by their full covariance."""
    CYCLE = "cycle"
    """The exact closed form of a cycle."""
    MULTIPLIER = "multiplier"
    """The closed form with a multiplier below 1: less noise, a known systematic error."""
    UNBIASED = "unbiased"
    """The same, with the neglected terms assigned to the start crossing: no systematic error in
    homogeneous air."""
    SLOPE = "slope"
    """Each beam alone, taken as homogeneous from crossing to crossing."""
    KLETT = "klett"
    """Each beam alone, from the slope at the far end of a segment."""


_HOMOGENEOUS: Final = frozenset(
    {NetworkMethod.MULTIPLIER, NetworkMethod.UNBIASED, NetworkMethod.SLOPE, NetworkMethod.KLETT}
)
"""Methods that assume homogeneous air."""

_HARMLESS: Final = frozenset({"weak_signal", "bridged"})
"""Flags that do not reject a value."""


class FieldPrior(StrEnum):
    """Prior knowledge of the field that the network method uses."""

    BLOCK = "block"
    """The mean field of the block of profiles, and how much profiles deviate from it."""
    NONE = "none"


@dataclass(frozen=True, slots=True, eq=False)
class CrossingFlags:
    """Reasons to doubt a value: one (..., crossing) array of booleans each."""

    ill_conditioned: Booleans
    """The attenuation around the cycle (or its substitute) or the value itself is less than 3
    standard errors, in the profile or typically in its block. Or the beams are too few to
    determine the field, and contradict the prior."""
    far_start: Booleans
    """The cycle starts at the far crossing of its first beam."""
    not_positive: Booleans
    """The solution is negative."""
    not_finite: Booleans
    """There is no solution."""
    uncertain: Booleans
    """The standard error exceeds the value."""
    signal_not_positive: Booleans
    """A beam of the crossing has a bin before the crossing that is zero or negative."""
    signal_missing: Booleans
    """A beam of the crossing has a bin before it with a power or variance that is not finite."""
    weak_signal: Booleans
    """A beam of the crossing is too noisy there, or its variance is invalid (zero), so it was left
    out. The value from the other beams is valid."""
    bridged: Booleans
    """A beam of the crossing has outlying bins. Single ones were interpolated from their
    neighbours. Several adjacent ones, which may be air, were left in place; the change that
    they and the bins between two edges make is part of the standard error. The value is
    valid."""
    outlying: Booleans
    """A beam of the crossing has so many outlying bins before it that it was left out."""
    pole: Booleans
    """The multiplier makes the determinant zero or changes its sign: no value."""
    unsettled: Booleans
    """The network solution did not converge."""
    poor_fit: Booleans
    """The beams disagree by more than their noise."""
    not_homogeneous: Booleans
    """The method assumes homogeneous air, and the beams show that it is not."""
    not_measured: Booleans
    """Fewer than two beams have full overlap and a signal there."""

    @property
    def flagged(self) -> Booleans:
        """Union of all flags except `weak_signal` and `bridged`, which leave a value valid."""
        union = np.zeros_like(self.far_start)
        for field in fields(self):
            if field.name not in _HARMLESS:
                union = union | getattr(self, field.name)
        return union


@dataclass(frozen=True, slots=True, eq=False)
class NetworkResult:
    """Extinction at the crossings of a network. Leading axes are those of the power."""

    extinction: Array
    """(..., crossing) m-1; NaN without a value, and at crossings that are far on all beams."""
    extinction_standard_error: Array
    """m-1. From noise, from the error of a straight-line fit where the signal is curved, and from
    deviations of the field from the prior: twice the prior's standard deviation is assumed, eight
    times where the beams are too few to test the prior, and a curvature of the field over the
    network where the mean of the block's beams allows it. In thin air it is at least the typical
    error of the block, and includes the bias that noise gives all its profiles."""
    visibility: air_visibility.VisibilityResult
    """(..., crossing) m, at the wavelength of the lidars."""
    flags: CrossingFlags
    near_crossing: Booleans
    """(crossing,) True where extinction is reported."""
    reduced_chi_square: Array
    """(...) of the beams alone, without the prior; NaN for other methods, and without degrees of
    freedom."""
    degrees_of_freedom: Array
    """(...)."""
    prior_deviation: Array
    """(...) standard deviation of ln extinction about the mean field; inf without prior, NaN for
    other methods."""
    multiplier: Array
    """(...) of the cycle; NaN for other methods."""
    method: NetworkMethod


def retrieve_network(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    network: Network,
    *,
    variance: npt.ArrayLike,
    method: str = "network",
    overlap: npt.ArrayLike | None = None,
    full_overlap_range: npt.ArrayLike | None = None,
    exponent: npt.ArrayLike = 1.0,
    blocks: npt.ArrayLike | None = None,
    prior: str = "block",
    cycle: Cycle | None = None,
    start: int | None = None,
    multiplier: float | None = None,
    bins: int = DEFAULT_BINS,
    contrast: float = air_visibility.MOR_CONTRAST,
) -> NetworkResult:
    """Retrieve extinction and visibility where the beams of several lidars cross.

    Average signals before the retrieval, not results afterwards: noise biases single results.

    Parameters
    ----------
    power : (..., beam, range) float
        Background-subtracted, in any unit. Each lidar has its own constant, which may change
        from profile to profile.
    range : (range,) or (beam, range) float
        m.
    network : Network
        From `lidarops.retrieve.network.geometry`, with the same beams as `power`.
    variance : (..., beam, range) float
        Noise variance in the square of the power's unit, broadcast against `power`; bins are
        independent.
    method : {"network", "cycle", "multiplier", "unbiased", "slope", "klett"}
    overlap : (beam, range) or (range,) float, optional
        Overlap function; power is divided by it. Bins with an overlap below 0.5 are not used.
    full_overlap_range : float or (beam,) float, optional
        m; nearer bins are not used. Either this or `overlap` is required.
    exponent : float or (beam,) float
        m of backscatter ~ extinction^(1/m) along a beam.
    blocks : (...) int or str, optional
        Labels of the profiles that share a mean field and a multiplier; by default, all. Results
        of a block depend on its own profiles only. A block in which many profiles are far noisier
        than many others is split into the quiet and the noisy ones.
    prior : {"block", "none"}
        For the network. "none" solves each profile alone; undetermined crossings are NaN.
    cycle : Cycle, optional
        For "cycle", "multiplier" and "unbiased"; by default from `geometry.build_cycle`.
    start : int, optional
        The only crossing to solve for: the cycle is rotated to start there. By default, all near
        crossings in turn.
    multiplier : float, optional
        For "multiplier" (default: the best one of each block) and "unbiased" (default: 0.25).
    bins : int
        Number of bins of the fit that gives the signal at a crossing.
    contrast : float
        Threshold of visibility.

    Returns
    -------
    NetworkResult

    Raises
    ------
    RetrievalInputError
        For invalid arguments.

    References
    ----------
    drabenko2021, yegorov2008.
    """
    network_method = inputs.choice(method, NetworkMethod, "method")
    field_prior = inputs.choice(prior, FieldPrior, "prior")
    _check_settings(network_method, multiplier, cycle, start)
    air_visibility.koschmieder_constant(contrast)
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
    if network_method is NetworkMethod.NETWORK:
        estimate, prior_fit = _solve_network(beams, network.crossing, field_prior)
    else:
        walk = None
        if network_method not in {NetworkMethod.SLOPE, NetworkMethod.KLETT}:
            walk = cycle if cycle is not None else build_cycle(network, start=start)
        estimate, prior_fit = _solve_closed(beams, network_method, walk, multiplier, start), None
    return _flag_result(beams, estimate, prior_fit, network_method, contrast)


def _solve_network(
    beams: _beam_signals.BeamSignals, position: Array, prior: FieldPrior
) -> tuple[_closed_forms.CrossingEstimate, _empirical_prior.PriorSolution]:
    layout = beams.layout
    measured_index = np.cumsum(layout.measured) - 1
    crossing = measured_index[layout.passages.crossing].astype(np.intp)
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
    prior_true_variance = np.full(shape, np.nan)
    with np.errstate(over="ignore", under="ignore"):
        extinction[:, layout.measured] = np.exp(fit.logarithm)
        variance[:, layout.measured] = np.exp(2.0 * fit.logarithm) * fit.variance
        prior_true_variance[:, layout.measured] = (
            np.exp(2.0 * fit.logarithm) * fit.prior_true_variance
        )
    if prior is FieldPrior.BLOCK:
        usable = beams.data.usable == 1
        variance = _block_errors.at_least_typical(extinction, variance, beams.block, usable)
    with np.errstate(over="ignore", under="ignore"):
        curvature = _curvature_variance(beams, fit, crossing, position)
        variance[:, layout.measured] += extinction[:, layout.measured] ** 2 * curvature
    no_flag = np.zeros(shape, dtype=np.bool_)
    # The stated doubt in the prior is no noise that makes values unreliable.
    poorly_determined = (
        _closed_forms.poorly_determined(extinction, prior_true_variance, beams.block)
        | fit.prior_contradicted[:, np.newaxis]
    )
    estimate = _closed_forms.CrossingEstimate(
        extinction, variance, poorly_determined, no_flag, np.zeros(shape[1], dtype=np.bool_),
        np.full(shape[0], np.nan),
    )  # fmt: skip
    return estimate, fit


def _curvature_variance(
    beams: _beam_signals.BeamSignals,
    fit: _empirical_prior.PriorSolution,
    crossing: Indices,
    position: Array,
) -> Array:
    """Return (profile, crossing) variances of ln extinction from curved signals.

    The block shows the curvature; see `lidarops.retrieve.network._curvature_errors`.
    """
    variance = np.zeros_like(fit.logarithm)
    geometry = (beams.layout.first_passage, beams.layout.offset, crossing)
    for number in np.unique(beams.block):
        profiles = np.flatnonzero(beams.block == number)
        precision, without_prior = _empirical_prior.prior_of(position, fit, profiles[0])
        data, shifts = beams.data.take(profiles), np.zeros((profiles.size, position.shape[0], 4))
        _curvature_errors.carry_errors(
            data.log_value, data.integral, data.usable, data.covariance, geometry, precision,
            without_prior, fit.logarithm[profiles],
            _curvature_errors.block_medians(data.curvature_error, data.usable),
            data.curvature_error, shifts,
        )  # fmt: skip
        variance[profiles] = _curvature_errors.curvature_variance(shifts)
    return variance


def _solve_closed(
    beams: _beam_signals.BeamSignals,
    method: NetworkMethod,
    cycle: Cycle | None,
    multiplier: float | None,
    start: int | None,
) -> _closed_forms.CrossingEstimate:
    if cycle is None:
        return _closed_forms.solve_single_beams(beams, far_end=method is NetworkMethod.KLETT)
    if method is NetworkMethod.CYCLE:
        multiplier = 1.0
    elif method is NetworkMethod.UNBIASED and multiplier is None:
        multiplier = DEFAULT_UNBIASED_MULTIPLIER
    return _closed_forms.solve_cycle_crossings(
        beams,
        cycle,
        multiplier,
        unbiased=method is NetworkMethod.UNBIASED,
        only_start=start is not None,
    )


def _flag_result(
    beams: _beam_signals.BeamSignals,
    estimate: _closed_forms.CrossingEstimate,
    fit: _empirical_prior.PriorSolution | None,
    method: NetworkMethod,
    contrast: float,
) -> NetworkResult:
    """Return extinction at the near crossings, with flags."""
    shape = estimate.extinction.shape
    near = beams.layout.near_crossing | estimate.far_start
    with np.errstate(invalid="ignore"):
        finite = np.isfinite(estimate.variance)
        finite &= np.abs(estimate.extinction) < air_visibility.LARGEST_EXTINCTION
        positive = finite & (estimate.extinction > 0)
        uncertain = estimate.variance > estimate.extinction**2
    extinction = np.where(positive & near, estimate.extinction, np.nan)
    error = np.sqrt(np.where(positive & near, estimate.variance, np.nan))
    no_flag = np.zeros(shape[0], dtype=np.bool_)
    chi_square, freedom = np.full(shape[0], np.nan), np.full(shape[0], np.nan)
    deviation, not_converged, poor = np.full(shape[0], np.nan), no_flag, no_flag
    too_weak = beams.weak
    if fit is not None:
        freedom, deviation = fit.degrees_of_freedom, fit.deviation
        with np.errstate(invalid="ignore", divide="ignore"):
            chi_square = np.where(freedom > 0, fit.chi_square / freedom, np.nan)
        poor = _improbable(fit.chi_square, freedom)
        poor |= _improbable(fit.prior_chi_square, fit.prior_degrees_of_freedom)
        not_converged = fit.status == _joint_solution.UNSETTLED
        dropped = fit.left_out[:, beams.layout.passages.beam] == 1
        too_weak = too_weak | (dropped & (beams.data.usable == 1))
    flags = CrossingFlags(
        ill_conditioned=estimate.weak_attenuation & finite,
        far_start=np.broadcast_to(estimate.far_start, shape),
        not_positive=finite & ~positive,
        not_finite=~finite,
        uncertain=uncertain,
        signal_not_positive=_lost_signal(beams, NOT_POSITIVE),
        signal_missing=_lost_signal(beams, MISSING),
        weak_signal=_by_crossing(beams, too_weak),
        bridged=_by_crossing(beams, beams.data.bridged[:, beams.layout.passages.beam] == 1),
        outlying=_lost_signal(beams, OUTLYING),
        pole=estimate.pole,
        unsettled=np.broadcast_to(not_converged[:, np.newaxis], shape),
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
    return NetworkResult(
        values, errors,
        air_visibility.visibility_from_extinction(values, errors, contrast=contrast),
        shaped, near, chi_square.reshape(leading), freedom.reshape(leading),
        deviation.reshape(leading), estimate.multiplier.reshape(leading), method,
    )  # fmt: skip


def _improbable(chi_square: Array, freedom: Array) -> Booleans:
    """Return where a chi-square this large has a probability below `_LEAST_PROBABILITY`."""
    known = np.isfinite(chi_square) & (freedom > 0)
    probability = special.gammaincc(
        np.where(known, freedom, 1.0) / 2.0, np.where(known, np.maximum(chi_square, 0.0), 0.0) / 2.0
    )
    return np.asarray(known & (probability < _LEAST_PROBABILITY))


def _lost_signal(beams: _beam_signals.BeamSignals, reason: int) -> Booleans:
    """Return where a beam of a crossing lost its signal for the given reason."""
    status = beams.data.status[:, beams.layout.passages.beam]
    lost = (beams.data.usable == 0) & ~beams.weak
    return _by_crossing(beams, (status == reason) & lost)


def _by_crossing(beams: _beam_signals.BeamSignals, passages: Booleans) -> Booleans:
    """Return (profile, crossing) whether any passage of the crossing is True."""
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
            remedy="give it to geometry.build_cycle",
        )
