"""Extinction and visibility from several lidars that look into the same air.

Where two rays cross, both lidars see the same extinction, whatever their constants and the
lidar ratio are. Along a ray, a = (P R^2 / overlap)^m is proportional to extinction times
exp(-2 m optical depth), if backscatter goes as extinction^(1/m) there; so that between a near
vertex n and a far one v

    a_n / extinction_n - a_v / extinction_v = 2 m (integral of a from n to v).

Nothing in it needs calibration: a lidar's constant multiplies the whole row. The overlap does
not cancel: an error of 1, 3 and 10 percent at the first vertex changes extinction there by 5, 14
and 34 percent.

A gradient over the whole network looks like attenuation where air is thin or noise is high, and
no test tells it there: what the prior allows, and what the rest of the block tells of it
(`lidarops.retrieve.network._block_errors`), is then most of the standard error. In 800 random networks
0.01(1) percent of the values without a flag are off by more than 4 standard errors, 0.005(3) in
plumes that drift within a block (`lidarops bench stability`). What is left stands in single
vertices in dense plumes. More profiles in a block and more rays tell more.

A layer so thin that signals bend within the gates of a fit puts an error into the values there, of
which the block tells too (`lidarops.retrieve.network._curvature_errors`).

Scale heights are 300 m and more there. In steeper fields the far vertices may fade, and leave
fewer equations than unknowns: errors are then stated with a prior that holds ln extinction over
the vertices to 0.6, and values are flagged where the rays exclude the usual one. A field that is
steeper still, of which so few rays tell nothing, is missed.
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
from lidarops.retrieve.network import geometry as rays_geometry
from lidarops.retrieve.network._condensed_signals import MISSING, NOT_POSITIVE, OUTLYING
from lidarops.retrieve.network.geometry import Cycle, Network

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Booleans = npt.NDArray[np.bool_]

DEFAULT_GATES: Final = 7
DEFAULT_UNBIASED_MULTIPLIER: Final = 0.25
"""Of the unbiased estimate: its noise is nearly least there, in fields of any kind."""
_LEAST_PROBABILITY: Final = 1e-4


class NetworkMethod(StrEnum):
    """How extinction is found. All but the network see one cycle, or one ray."""

    NETWORK = "network"
    """All rays and vertices at once, weighted by their full covariance."""
    CYCLE = "cycle"
    """The exact closed form of a cycle."""
    MULTIPLIER = "multiplier"
    """The closed form with a multiplier below 1: less noise, a known systematic error."""
    UNBIASED = "unbiased"
    """The same, with what is neglected put to the start vertex: no error in homogeneous air."""
    SLOPE = "slope"
    """Each ray for itself, as if homogeneous from vertex to vertex."""
    KLETT = "klett"
    """Each ray for itself, from the slope at the far end of a segment."""


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
class VertexFlags:
    """What is wrong with a value: (..., vertex) booleans each."""

    ill_conditioned: Booleans
    """Attenuation around the cycle, what takes its place, or the value itself is less than 3
    standard errors: of the profile, or typically of its block. Or the rays are too few to tell
    the field, and tell that it is not as the prior has it."""
    far_start: Booleans
    """The start of the cycle is the far vertex of its ray."""
    not_positive: Booleans
    """The solution is negative."""
    not_finite: Booleans
    """There is no solution."""
    uncertain: Booleans
    """The standard error exceeds the value."""
    signal_not_positive: Booleans
    """A ray of the vertex has a gate before it that is zero or negative."""
    signal_missing: Booleans
    """A ray of the vertex has a gate before it of which power or variance is not finite."""
    weak_signal: Booleans
    """A ray of the vertex is too noisy there, or of a variance that cannot be (zero), and was left
    out; the others stand."""
    bridged: Booleans
    """A ray of the vertex has gates that lie far off their neighbours: these took the place of
    single ones. Several together, which may be air, were left as they are, and what they and the
    gates between two edges change is part of the standard error. The value stands."""
    outlying: Booleans
    """A ray of the vertex has so many such gates before it that it was left out."""
    pole: Booleans
    """The multiplier makes the determinant vanish or turn its sign: no value."""
    unsettled: Booleans
    """The last pass of the network still moved the solution."""
    poor_fit: Booleans
    """The rays disagree by more than their noise allows."""
    not_homogeneous: Booleans
    """The method takes the air for homogeneous, and the rays say that it is not."""
    not_measured: Booleans
    """Fewer than two rays have full overlap and range there."""

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
    """Extinction at the vertices of a network, with the leading axes of the power."""

    extinction: Array
    """(..., vertex) m-1; NaN at vertices that are near ones on no ray, and where there is none."""
    extinction_standard_error: Array
    """m-1, by noise, by what a line through a few gates has wrong where the signal bends, and by
    what a field may deviate from the prior: twice the prior's standard deviation is counted, eight
    times as much where rays are too few to test the prior, and a bend over the network where the
    mean of the block's rays allows it.
    Of a block in thin air, no less than is typical of it, and what noise moves all by."""
    visibility: sight.VisibilityResult
    """(..., vertex) m, at the wavelength of the lidars."""
    flags: VertexFlags
    near_vertex: Booleans
    """(vertex,) True where extinction is reported."""
    reduced_chi_square: Array
    """(...) of the rays of the network, free of the prior; NaN for other methods, and where
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

    A lidar's energy changes from profile to profile: a ray with a gap would put a step into the
    mean, and is left out of it, as is one with a gate of unknown variance. Where no profile of a
    group has a gate, the mean has none.

    Parameters
    ----------
    power : (profile, ray, range) float
    groups : (profile,) int or str
        Labels; groups come in their sorted order.
    variance : (profile, ray, range) float, optional

    Returns
    -------
    power : (group, ray, range) float64
    variance : (group, ray, range) float64, or None where none is given
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
    gates: int = DEFAULT_GATES,
    contrast: float = sight.MOR_CONTRAST,
) -> MultiPositionResult:
    """Find extinction and visibility where the rays of several lidars meet.

    Average signals before (`average_signals`), not results afterwards: noise makes these biased.

    Parameters
    ----------
    power : (..., ray, range) float
        Any unit, free of background. Each lidar has its own constant, which may change from
        profile to profile.
    range : (range,) or (ray, range) float
        m.
    network : Network
        Of `lidarops.retrieve.network.geometry`, with as many rays.
    method : {"network", "cycle", "multiplier", "unbiased", "slope", "klett"}
    variance : (..., ray, range) float, optional
        Noise variance in the square of the power's unit, broadcast against `power`; gates are
        independent. Where not given, second differences along range tell it, block by block, and
        sums of gates that these are correlated, where there are profiles enough.
    overlap : (ray, range) or (range,) float, optional
        Overlap function, by which power is divided; gates below 0.5 are not used.
    full_overlap_range : float or (ray,) float, optional
        m; nearer gates are not used. One of the two is required.
    exponent : float or (ray,) float
        m of backscatter ~ extinction^(1/m) along a ray.
    blocks : (...) int or str, optional
        Labels of the profiles that are pooled, for the mean field and the multiplier; one block
        where not given. A block's results depend on its own profiles only. Where many of them are
        far noisier than many others, it is parted into the quiet and the noisy ones.
    prior : {"block", "none"}
        For the network. "none" solves each profile for itself; vertices that are not
        determined are NaN.
    cycle : Cycle, optional
        For "cycle", "multiplier" and "unbiased"; that of `geometry.cycle` where not given.
    start : int, optional
        Vertex of the cycle to solve for alone, with the cycle turned to it; all near vertices
        in turn where not given.
    multiplier : float, optional
        For "multiplier" (the best of each block where not given) and "unbiased" (0.25).
    gates : int
        Of the fit that gives the signal at a vertex.
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
    if network.vertices == 0:
        raise RetrievalInputError(
            "has no vertices: its rays do not meet",
            field="network",
            remedy="point the lidars at common volumes, or widen the tolerance of the geometry",
        )
    rays = _beam_signals.prepare_signals(
        power, range, network, variance=variance, overlap=overlap,
        full_overlap_range=full_overlap_range, exponent=exponent, blocks=blocks, gates=gates,
    )  # fmt: skip
    if chosen is NetworkMethod.NETWORK:
        estimate, fit = _solve_network(rays, network.vertex, told)
    else:
        walk = None
        if chosen not in {NetworkMethod.SLOPE, NetworkMethod.KLETT}:
            walk = cycle if cycle is not None else rays_geometry.build_cycle(network, start=start)
        estimate, fit = _solve_closed(rays, chosen, walk, multiplier, start), None
    return _judged(rays, estimate, fit, chosen, contrast)


def _solve_network(
    rays: _beam_signals.BeamSignals, position: Array, prior: FieldPrior
) -> tuple[_closed_forms.CrossingEstimate, _empirical_prior.PriorSolution]:
    layout = rays.layout
    numbers = np.cumsum(layout.measured) - 1
    vertex = numbers[layout.crossings.vertex].astype(np.intp)
    position = position[layout.measured]
    if prior is FieldPrior.NONE or vertex.size == 0:
        fit = _empirical_prior.solve_without_prior(
            rays.data, layout, vertex, rays.exponent, position
        )
    else:
        fit = _empirical_prior.solve_blocks(
            rays.data, layout, vertex, rays.exponent, position, rays.block
        )
    shape = (rays.block.size, layout.vertices)
    extinction, variance = np.full(shape, np.nan), np.full(shape, np.nan)
    believed = np.full(shape, np.nan)
    with np.errstate(over="ignore", under="ignore"):
        extinction[:, layout.measured] = np.exp(fit.logarithm)
        variance[:, layout.measured] = np.exp(2.0 * fit.logarithm) * fit.variance
        believed[:, layout.measured] = np.exp(2.0 * fit.logarithm) * fit.believed
    if prior is FieldPrior.BLOCK:
        seen = rays.data.usable == 1
        variance = _block_errors.at_least_typical(extinction, variance, rays.block, seen)
    with np.errstate(over="ignore", under="ignore"):
        bent = _by_bends(rays, fit, vertex, position)
        variance[:, layout.measured] += extinction[:, layout.measured] ** 2 * bent
    none = np.zeros(shape, dtype=np.bool_)
    # Doubt in the prior, which is stated, is no noise that makes a value lie anywhere.
    shaky = _closed_forms.shaky(extinction, believed, rays.block) | fit.doubtful[:, np.newaxis]
    estimate = _closed_forms.CrossingEstimate(
        extinction, variance, shaky, none, np.zeros(shape[1], dtype=np.bool_),
        np.full(shape[0], np.nan),
    )  # fmt: skip
    return estimate, fit


def _by_bends(
    rays: _beam_signals.BeamSignals,
    fit: _empirical_prior.PriorSolution,
    vertex: Indices,
    position: Array,
) -> Array:
    """Return (profile, vertex) variances of ln extinction by what bends of signals put into values.

    What the profiles of a block share tells the bends; see `lidarops.retrieve.network._curvature_errors`.
    """
    out = np.zeros_like(fit.logarithm)
    geometry = (rays.layout.first_crossing, rays.layout.offset, vertex)
    for b in np.unique(rays.block):
        mine = np.flatnonzero(rays.block == b)
        precision, flat = _empirical_prior.prior_of(position, fit, mine[0])
        data, moved = rays.data.take(mine), np.zeros((mine.size, position.shape[0], 4))
        _curvature_errors.carry_errors(
            data.log_value, data.integral, data.usable, data.covariance, geometry, precision, flat,
            fit.logarithm[mine], _curvature_errors.usual(data.departure, data.usable), data.departure,
            moved,
        )  # fmt: skip
        out[mine] = _curvature_errors.variance(moved)
    return out


def _solve_closed(
    rays: _beam_signals.BeamSignals,
    method: NetworkMethod,
    cycle: Cycle | None,
    multiplier: float | None,
    start: int | None,
) -> _closed_forms.CrossingEstimate:
    if cycle is None:
        return _closed_forms.by_single_rays(rays, far_end=method is NetworkMethod.KLETT)
    if method is NetworkMethod.CYCLE:
        multiplier = 1.0
    elif method is NetworkMethod.UNBIASED and multiplier is None:
        multiplier = DEFAULT_UNBIASED_MULTIPLIER
    return _closed_forms.by_cycle(
        rays,
        cycle,
        multiplier,
        unbiased=method is NetworkMethod.UNBIASED,
        only_start=start is not None,
    )


def _judged(
    rays: _beam_signals.BeamSignals,
    estimate: _closed_forms.CrossingEstimate,
    fit: _empirical_prior.PriorSolution | None,
    method: NetworkMethod,
    contrast: float,
) -> MultiPositionResult:
    """Report extinction at near vertices, and flag it."""
    shape = estimate.extinction.shape
    near = rays.layout.near_vertex | estimate.far_start
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
    weak = rays.weak
    if fit is not None:
        freedom, deviation = fit.degrees_of_freedom, fit.deviation
        with np.errstate(invalid="ignore", divide="ignore"):
            chi_square = np.where(freedom > 0, fit.chi_square / freedom, np.nan)
        poor = _improbable(fit.chi_square, freedom)
        poor |= _improbable(fit.prior_chi_square, fit.prior_degrees_of_freedom)
        unsettled = fit.status == _joint_solution.UNSETTLED
        dropped = fit.left_out[:, rays.layout.crossings.ray] == 1
        weak = weak | (dropped & (rays.data.usable == 1))
    flags = VertexFlags(
        ill_conditioned=estimate.weak_attenuation & finite,
        far_start=np.broadcast_to(estimate.far_start, shape),
        not_positive=finite & ~positive,
        not_finite=~finite,
        uncertain=uncertain,
        signal_not_positive=_lost(rays, NOT_POSITIVE),
        signal_missing=_lost(rays, MISSING),
        weak_signal=_by_vertex(rays, weak),
        bridged=_by_vertex(rays, rays.data.bridged[:, rays.layout.crossings.ray] == 1),
        outlying=_lost(rays, OUTLYING),
        pole=estimate.pole,
        unsettled=np.broadcast_to(unsettled[:, np.newaxis], shape),
        poor_fit=np.broadcast_to(poor[..., np.newaxis], shape),
        not_homogeneous=(
            _closed_forms.inhomogeneous(rays, estimate)
            if method in _HOMOGENEOUS
            else np.zeros(shape, dtype=np.bool_)
        ),
        not_measured=np.broadcast_to(~rays.layout.measured, shape),
    )
    leading = rays.leading
    shaped = VertexFlags(
        **{
            f.name: getattr(flags, f.name).reshape(*leading, shape[1]).copy()
            for f in fields(VertexFlags)
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


def _lost(rays: _beam_signals.BeamSignals, reason: int) -> Booleans:
    """Return where a ray of a vertex has lost it for a reason."""
    status = rays.data.status[:, rays.layout.crossings.ray]
    beyond = (rays.data.usable == 0) & ~rays.weak
    return _by_vertex(rays, (status == reason) & beyond)


def _by_vertex(rays: _beam_signals.BeamSignals, crossings: Booleans) -> Booleans:
    out = np.zeros((crossings.shape[0], rays.layout.vertices), dtype=np.bool_)
    for c, vertex in enumerate(rays.layout.crossings.vertex):
        out[:, vertex] |= crossings[:, c]
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
    if cycle is not None and start is not None and start != int(cycle.vertex[0]):
        raise RetrievalInputError(
            f"is {start}, but the cycle starts at {int(cycle.vertex[0])}",
            field="start",
            remedy="give it to geometry.cycle",
        )
