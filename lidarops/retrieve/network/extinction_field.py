"""Extinction and visibility from the signals of several lidars whose beams cross.

Where two beams cross, both lidars see the same extinction, whatever their constants and the
lidar ratio. Along a beam, a = (P R^2 / overlap)^m is proportional to extinction times
exp(-2 m optical depth), if backscatter ~ extinction^(1/m) there. Between a near crossing n and a
far one v therefore

    a_n / extinction_n - a_v / extinction_v = 2 m (integral of a from n to v).

No calibration is needed: the constant of a lidar multiplies the whole row. The overlap does not
cancel.

The profiles of a block are one field that changes slowly
(`lidarops.retrieve.network._block_solution`). In thin air or high noise, a gradient over the whole
network looks like attenuation, and no test can separate them: the standard error is then mostly
what the prior allows.
``docs/algorithms/network.md`` has the rates of false values.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import StrEnum
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
from scipy import special

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.air import visibility as air_visibility
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Booleans, Flags
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.network import _beam_signals
from lidarops.retrieve.network._beam_signals import BeamSignals, Causes, Estimates, Response
from lidarops.retrieve.network._block_solution import solve_alone, solve_block
from lidarops.retrieve.network._condensed_signals import MISSING, NOT_POSITIVE, OUTLYING
from lidarops.retrieve.network.flags import NetworkQuality
from lidarops.retrieve.network.geometry import Network
from lidarops.retrieve.network.triangles import CHOSEN, solve_triangles

_HARMLESS: Final = NetworkQuality.LOW_LEVERAGE | Quality.OUTLIER
"""Bits of beams that were left out or bridged, which do not reject a value."""


class FieldPrior(StrEnum):
    """Prior knowledge of the field that the network method uses."""

    BLOCK = "block"
    """The profiles of a block are one field that changes slowly."""
    NONE = "none"


@dataclass(frozen=True, slots=True, eq=False)
class NetworkResult:
    """Extinction at the crossings of a network. Leading axes are those of the power."""

    extinction: Array
    """(..., crossing) m-1; NaN without a value, and at crossings that are far on all beams."""
    extinction_standard_error: Array
    """m-1. From noise and prior, widened by the misfit of the mean of a block, from the error of
    fits where the signal is curved, and from an error of the overlap."""
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
    overlap_error: Array
    """(..., crossing) m-1, part of the standard error by `default_overlap_error` of the beams."""
    overlap_response: Array
    """(..., crossing) relative change of extinction by relative errors of 1 of the overlap at the
    near ends of beams, which fall to 0 at their far ends."""
    multiplier: Array
    """(..., crossing) of the rows of triangles; NaN where all beams are solved together."""
    multiplier_error: Array
    """(..., crossing) m-1, systematic: what the multiplier adds to extinction in homogeneous air;
    0 where all beams are solved together."""
    respond: Response
    """From small changes of signals to linear changes of extinction, (profile, crossing, cause) in
    m-1. Weights, priors and flags stay, so that no value is lost near a threshold."""

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
    multiplier: float | Literal["chosen"] | None = None,
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
        Numbers of the blocks of profiles, in order of time, that are one field; by default, all.
        Results of a block depend on its own profiles only. Profiles of a block are equally spaced
        in time: give missing ones as NaN.
    prior : {"block", "none"}
        "none" solves each profile alone; undetermined crossings are NaN.
    multiplier : float or "chosen", optional
        Lambda of the paper, 0 to 1: each crossing is solved by one triangle of beams
        (`lidarops.retrieve.network.triangles`), without prior, instead of all beams together.
        "chosen" is the one with the smallest expected error in the block.

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
    chosen = isinstance(multiplier, str) and multiplier == CHOSEN
    number = isinstance(multiplier, int | float) and 0 <= multiplier <= 1
    if not (multiplier is None or number or chosen):
        raise RetrievalInputError(
            "is not from 0 to 1", field="multiplier", remedy=f"give one number, or {CHOSEN!r}"
        )
    together = multiplier is None and field_prior is FieldPrior.BLOCK
    beams = _beam_signals.prepare_signals(
        power, range, network, variance=variance, overlap=overlap,
        full_overlap_range=full_overlap_range, exponent=exponent, blocks=blocks, together=together,
    )  # fmt: skip
    with np.errstate(all="ignore"):
        estimate = _solve_blocks(beams, network.crossing, multiplier)
    return _flag_result(beams, estimate)


def _solve_blocks(
    beams: BeamSignals, position: Array, multiplier: float | Literal["chosen"] | None
) -> Estimates:
    """Solve each block, and return the values of all."""
    out = Estimates.missing(beams.block.size, beams.layout)
    responses = []
    for rows, block in beams.blocks(position):
        if multiplier is not None:
            part = solve_triangles(block, multiplier)
        else:
            part = solve_block(block) if beams.together else solve_alone(block)
        responses.append((rows, part.respond))
        for field in fields(Estimates):
            if field.name != "respond":
                getattr(out, field.name)[rows] = getattr(part, field.name)

    def respond(causes: Causes) -> Array:
        change = np.zeros((*out.extinction.shape, len(causes)))
        for rows, each in responses:
            of_block = [{k: one.take(rows) for k, one in cause.items()} for cause in causes]
            change[rows] = each(of_block)
        return change * out.extinction[..., np.newaxis]

    return replace(out, respond=respond)


def _flag_result(beams: BeamSignals, estimate: Estimates) -> NetworkResult:
    """Return extinction at the near crossings, with flags."""
    shape = estimate.extinction.shape
    near = beams.layout.near_crossing
    with np.errstate(invalid="ignore", over="ignore"):
        # Rounding of a singular system may make a variance negative.
        finite = np.isfinite(np.sqrt(estimate.variance))
        finite &= np.abs(estimate.extinction) < air_visibility.LARGEST_EXTINCTION
        finite &= estimate.extinction > 0
        # Amplified noise hides the error of a profile alone.
        limit = 1.0 if beams.together else 1.0 / COMMON.significant
        uncertain = estimate.variance > (limit * estimate.extinction) ** 2
    chi_square, freedom = estimate.chi_square, estimate.degrees_of_freedom
    poor = _improbable(chi_square, freedom).any(axis=1)
    converged = estimate.settled | ~np.isfinite(estimate.chi_square[:, 1])
    too_weak = beams.weak | (estimate.left_out & beams.usable)
    quality = np.zeros(shape, dtype=np.int32)
    for bit, where in (
        (NetworkQuality.POORLY_DETERMINED, uncertain),
        (Quality.LOW_SIGNAL, _lost_signal(beams, NOT_POSITIVE)),
        (Quality.INPUT_MISSING, _lost_signal(beams, MISSING)),
        (NetworkQuality.LOW_LEVERAGE, _by_crossing(beams, too_weak)),
        (Quality.OUTLIER, _by_crossing(beams, beams.bridged)),
        # Where so many bins deviate that the beam is left out, the stated noise is wrong.
        (NetworkQuality.POOR_FIT, _lost_signal(beams, OUTLYING)),
        (NetworkQuality.POOR_FIT, (poor | ~converged)[:, np.newaxis]),
        (Quality.INPUT_MISSING, estimate.open | ~beams.layout.measured),
    ):
        quality |= np.where(where, np.int32(bit), np.int32(0))
    crossings = (*beams.leading, shape[1])
    freedom, chi_square = freedom[:, 0], chi_square[:, 0]
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
        np.where(finite & near, estimate.overlap_error, np.nan).reshape(crossings),
        estimate.overlap.reshape(crossings),
        np.where(near, estimate.multiplier, np.nan).reshape(crossings),
        np.where(finite & near, estimate.multiplier_error, np.nan).reshape(crossings),
        estimate.respond,
    )


def _improbable(chi_square: Array, freedom: Array) -> Booleans:
    """Return where a chi-square this large has a probability below `misfit_false_alarm`."""
    known = np.isfinite(chi_square) & (freedom > 0)
    probability = special.gammaincc(
        np.where(known, freedom, 1.0) / 2.0, np.where(known, np.maximum(chi_square, 0.0), 0.0) / 2.0
    )
    return np.asarray(known & (probability < COMMON.misfit_false_alarm))


def _lost_signal(beams: BeamSignals, reason: int) -> Booleans:
    """Return where a beam of a crossing lost its signal for the given reason."""
    return _by_crossing(beams, (beams.status == reason) & ~beams.usable & ~beams.weak)


def _by_crossing(beams: BeamSignals, passages: Booleans) -> Booleans:
    """Return (profile, crossing) whether any passage of the crossing is True."""
    out = np.zeros((passages.shape[0], beams.layout.crossings), dtype=np.bool_)
    for c, crossing in enumerate(beams.layout.passages.crossing):
        out[:, crossing] |= passages[:, c]
    return out
