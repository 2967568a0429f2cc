"""Extinction and visibility from the signals of several lidars whose beams cross.

Where two beams cross, both lidars see the same extinction, whatever their constants and the
lidar ratio. Along a beam, a = (P R^2 / overlap)^m is proportional to extinction times
exp(-2 m optical depth), if backscatter ~ extinction^(1/m) there. Between a near crossing n and a
far one v therefore

    a_n / extinction_n - a_v / extinction_v = 2 m (integral of a from n to v).

No calibration is needed: the constant of a lidar multiplies the whole row. The overlap does not
cancel.

In thin air or high noise, a gradient over the whole network looks like attenuation, and no test
can separate them. The standard error is then mostly what the prior allows and what the rest of
the block shows (`lidarops.retrieve.network._block_errors`). Where the beams leave fewer equations
than unknowns, values are flagged if the beams contradict the prior; a field so steep that few
beams cannot show it goes undetected. ``docs/algorithms/network.md`` has the rates.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
from scipy import special

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.air import visibility as air_visibility
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Booleans, Flags, Indices
from lidarops.retrieve.network import _beam_signals, _block_errors
from lidarops.retrieve.network._beam_signals import BeamSignals, Estimates
from lidarops.retrieve.network._condensed_signals import MISSING, NOT_POSITIVE, OUTLYING
from lidarops.retrieve.network._empirical_prior import NO_PRIOR, Problem, solve_block
from lidarops.retrieve.network.flags import NetworkQuality
from lidarops.retrieve.network.geometry import Network
from lidarops.retrieve.network.thresholds import THRESHOLDS
from lidarops.retrieve.network.triangles import CHOSEN, solve_triangles

_HARMLESS: Final = NetworkQuality.LOW_LEVERAGE | Quality.OUTLIER
"""Bits of beams that were left out or bridged, which do not reject a value."""


class FieldPrior(StrEnum):
    """Prior knowledge of the field that the network method uses."""

    BLOCK = "block"
    """What the profiles of a block share: how much ln extinction deviates from a linear field."""
    NONE = "none"


@dataclass(frozen=True, slots=True, eq=False)
class NetworkResult:
    """Extinction at the crossings of a network. Leading axes are those of the power."""

    extinction: Array
    """(..., crossing) m-1; NaN without a value, and at crossings that are far on all beams."""
    extinction_standard_error: Array
    """m-1. From noise, from the error of a straight-line fit where the signal is curved, from a
    field that deviates by twice the prior's standard deviation, or by four times the strongest
    prior where the beams leave a crossing open, as far as the mean of a block allows, and from the
    bias that noise gives all profiles of a block."""
    quality: Flags
    """(..., crossing) quality bits, by beams of the crossing or the whole network."""
    no_solution: Booleans
    """(..., crossing) True where there is no positive solution."""
    near_crossing: Booleans
    """(crossing,) True where extinction is reported."""
    reduced_chi_square: Array
    """(...) of the beams alone, without the prior; NaN without degrees of freedom."""
    degrees_of_freedom: Array
    """(...)."""
    prior_deviation: Array
    """(...) standard deviation of ln extinction about a linear field; inf without prior."""
    multiplier: Array
    """(..., crossing) of the rows of triangles; NaN where all beams are solved together."""
    multiplier_error: Array
    """(..., crossing) m-1, systematic: what the multiplier adds to extinction in homogeneous air;
    0 where all beams are solved together."""

    def raised(self, bits: int) -> Booleans:
        """Return where any of the bits is raised."""
        return np.asarray((self.quality & np.int32(bits)) != 0)

    @property
    def flagged(self) -> Booleans:
        """Where there is no solution, or a bit that a value does not stay valid with."""
        return self.no_solution | self.raised(~_HARMLESS)


def retrieve_network(
    power: npt.ArrayLike,
    range: npt.ArrayLike,  # noqa: A002 - the field's word
    network: Network,
    *,
    variance: npt.ArrayLike,
    overlap: npt.ArrayLike | None = None,
    full_overlap_range: npt.ArrayLike | None = None,
    exponent: npt.ArrayLike = 1.0,
    blocks: npt.ArrayLike | None = None,
    prior: str = "block",
    multiplier: npt.ArrayLike | Literal["chosen"] | None = None,
    bins: int = THRESHOLDS.fit_bins,
) -> NetworkResult:
    """Retrieve extinction and visibility where the beams of several lidars cross.

    Average signals before the retrieval, not results afterwards: noise biases single results.

    Parameters
    ----------
    power : (..., beam, range) float
        Background-subtracted, in any unit. Each lidar has its own constant, which may change
        from profile to profile.
    range : (range,) or (beam, range) float
        m, ascending; NaN after the last bin of a beam.
    network : Network
        From `lidarops.retrieve.network.geometry`, with the same beams as `power`.
    variance : (..., beam, range) float
        Noise variance in the square of the power's unit, broadcast against `power`; bins are
        independent.
    overlap : (beam, range) or (range,) float, optional
        Overlap function; power is divided by it. Bins with an overlap below 0.5 are not used.
    full_overlap_range : float or (beam,) float, optional
        m; nearer bins are not used. Either this or `overlap` is required.
    exponent : float or (beam,) float
        m of backscatter ~ extinction^(1/m) along a beam.
    blocks : (...) int, optional
        Numbers of the blocks of profiles that share a prior; by default, all. Results of a block
        depend on its own profiles only.
    prior : {"block", "none"}
        "none" solves each profile alone; undetermined crossings are NaN.
    multiplier : float or (..., crossing) float or "chosen", optional
        Lambda of the paper, 0 to 1: each crossing is solved by one triangle of beams
        (`lidarops.retrieve.network.triangles`), without prior, instead of all beams together.
        "chosen" is the one with the smallest expected error in the block.
    bins : int
        Number of bins of the fit that gives the signal at a crossing.

    Returns
    -------
    NetworkResult

    Raises
    ------
    RetrievalInputError
        For invalid arguments.

    References
    ----------
    drabenko2021.
    """
    field_prior = inputs.choice(prior, FieldPrior, "prior")
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
    if multiplier is None:
        return _flag_result(beams, _solve_network(beams, network.crossing, field_prior))
    return _flag_result(beams, solve_triangles(beams, _multipliers(multiplier, beams)))


def _solve_network(beams: BeamSignals, position: Array, prior: FieldPrior) -> Estimates:
    """Solve each block, and return its values with all their errors."""
    layout, out = beams.layout, Estimates.missing(beams)
    number = np.cumsum(layout.measured) - 1
    crossing = number[layout.passages.crossing].astype(np.intp)
    for block in np.unique(beams.block) if crossing.size else ():
        rows = np.flatnonzero(beams.block == block)
        data = beams.data.take(rows)
        problem = Problem(data, layout, crossing, beams.exponent, position[layout.measured])
        if prior is FieldPrior.NONE:
            solution = problem.solve(NO_PRIOR)
            variance = solution.variance
        else:
            solved = solve_block(problem)
            solution = solved.profiles
            variance = solution.variance - solution.prior_share
            variance = variance + _block_errors.field_variance(solved, problem.position)
            variance = variance + _block_errors.noise_bias_variance(solved)
            out.prior_contradicted[rows] = solved.contradicted
        curvature = _block_errors.curvature_variance(data, solution.carried)
        here = np.ix_(rows, np.flatnonzero(layout.measured))
        with np.errstate(over="ignore", under="ignore"):
            extinction = np.exp(solution.logarithm)
            variance = extinction**2 * variance
            if prior is FieldPrior.BLOCK:
                variance = _block_errors.at_least_typical(extinction, variance, data.usable)
            out.extinction[here] = extinction
            out.variance[here] = variance + extinction**2 * curvature
            out.prior_true_variance[here] = extinction**2 * solution.variance
        out.settled[rows], out.left_out[rows] = solution.settled, solution.left_out
        out.chi_square[rows, 0] = solution.chi_square
        out.chi_square[rows, 1] = solution.total_chi_square
        out.degrees_of_freedom[rows, 0] = solution.degrees_of_freedom
        out.degrees_of_freedom[rows, 1] = solution.total_degrees_of_freedom
        out.deviation[rows] = solution.prior.strength * solution.prior.deviation
    return out


def _multipliers(multiplier: npt.ArrayLike | str, beams: BeamSignals) -> Array | None:
    """Return (profile, crossing) multipliers, None where they are to be chosen."""
    if isinstance(multiplier, str) and multiplier == CHOSEN:
        return None
    array = inputs.real_array(multiplier, "multiplier").astype(np.float64)
    shape = (*beams.leading, beams.layout.crossings)
    # NaN where a result that is given back has no value.
    if array.shape not in {(), shape} or not np.all((array >= 0) & (array <= 1) | np.isnan(array)):
        raise RetrievalInputError(
            "is not from 0 to 1, or of a wrong shape",
            field="multiplier",
            remedy=f"give one number, or {shape}, or {CHOSEN!r}",
        )
    return np.broadcast_to(array, shape).reshape(beams.block.size, -1)


def _flag_result(beams: BeamSignals, estimate: Estimates) -> NetworkResult:
    """Return extinction at the near crossings, with flags."""
    shape, passages = estimate.extinction.shape, beams.layout.passages
    near = beams.layout.near_crossing
    with np.errstate(invalid="ignore"):
        finite = np.isfinite(estimate.variance)
        finite &= np.abs(estimate.extinction) < air_visibility.LARGEST_EXTINCTION
        finite &= estimate.extinction > 0
        uncertain = estimate.variance > estimate.extinction**2
    # The stated doubt in the prior is no noise that makes values unreliable.
    doubted = _poorly_determined(estimate.extinction, estimate.prior_true_variance, beams.block)
    doubted |= estimate.prior_contradicted[:, np.newaxis]
    poor = np.any(_improbable(estimate.chi_square, estimate.degrees_of_freedom), axis=1)
    converged = estimate.settled | ~np.isfinite(estimate.chi_square[:, 1])
    too_weak = beams.weak | (estimate.left_out[:, passages.beam] & beams.data.usable)
    quality = np.zeros(shape, dtype=np.int32)
    for bit, where in (
        (NetworkQuality.POORLY_DETERMINED, (doubted & finite) | uncertain),
        (Quality.LOW_SIGNAL, _lost_signal(beams, NOT_POSITIVE)),
        (Quality.INPUT_MISSING, _lost_signal(beams, MISSING)),
        (NetworkQuality.LOW_LEVERAGE, _by_crossing(beams, too_weak)),
        (Quality.OUTLIER, _by_crossing(beams, beams.data.bridged[:, passages.beam])),
        # Where so many bins deviate that the beam is left out, the stated noise is wrong.
        (NetworkQuality.POOR_FIT, _lost_signal(beams, OUTLYING)),
        (NetworkQuality.POOR_FIT, (poor | ~converged)[:, np.newaxis]),
        (Quality.INPUT_MISSING, ~beams.layout.measured | estimate.open),
    ):
        quality |= np.where(where, np.int32(bit), np.int32(0))
    crossings = (*beams.leading, shape[1])
    freedom, chi_square = estimate.degrees_of_freedom[:, 0], estimate.chi_square[:, 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        reduced = np.where(freedom > 0, chi_square / freedom, np.nan)
    return NetworkResult(
        np.where(finite & near, estimate.extinction, np.nan).reshape(crossings),
        np.sqrt(np.where(finite & near, estimate.variance, np.nan)).reshape(crossings),
        quality.reshape(crossings),
        ~finite.reshape(crossings),
        near,
        reduced.reshape(beams.leading),
        freedom.reshape(beams.leading),
        estimate.deviation.reshape(beams.leading),
        np.where(near, estimate.multiplier, np.nan).reshape(crossings),
        np.where(finite & near, estimate.multiplier_error, np.nan).reshape(crossings),
    )


def _poorly_determined(extinction: Array, variance: Array, block: Indices) -> Booleans:
    """Return where an error exceeds a third of the value, in the profile or its typical block.

    With noise amplified beyond that, values and the errors computed from them are meaningless,
    so all profiles of such a block are doubted.

    Parameters
    ----------
    extinction, variance : (profile, crossing) float
        m-1 and m-2; NaN where there is none.
    block : (profile,) int
    """
    with np.errstate(invalid="ignore"):
        doubted = np.asarray(variance > (THRESHOLDS.largest_relative_error * extinction) ** 2)
    for number in np.unique(block):
        profiles = np.flatnonzero(block == number)
        known = np.isfinite(variance[profiles])
        for crossing in np.flatnonzero(known.any(axis=0)):
            rows = profiles[known[:, crossing]]
            error = np.sqrt(np.median(variance[rows, crossing]))
            typical = np.median(extinction[rows, crossing])
            doubted[profiles, crossing] |= error > THRESHOLDS.largest_relative_error * typical
    return doubted


def _improbable(chi_square: Array, freedom: Array) -> Booleans:
    """Return where a chi-square this large has a probability below `least_probability`."""
    known = np.isfinite(chi_square) & (freedom > 0)
    probability = special.gammaincc(
        np.where(known, freedom, 1.0) / 2.0, np.where(known, np.maximum(chi_square, 0.0), 0.0) / 2.0
    )
    return np.asarray(known & (probability < THRESHOLDS.least_probability))


def _lost_signal(beams: BeamSignals, reason: int) -> Booleans:
    """Return where a beam of a crossing lost its signal for the given reason."""
    status = beams.data.status[:, beams.layout.passages.beam]
    return _by_crossing(beams, (status == reason) & ~beams.data.usable & ~beams.weak)


def _by_crossing(beams: BeamSignals, passages: Booleans) -> Booleans:
    """Return (profile, crossing) whether any passage of the crossing is True."""
    out = np.zeros((passages.shape[0], beams.layout.crossings), dtype=np.bool_)
    for c, crossing in enumerate(beams.layout.passages.crossing):
        out[:, crossing] |= passages[:, c]
    return out
