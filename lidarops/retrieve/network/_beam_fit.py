r"""Least squares of the beams of a network: ln extinction at the crossings, and beam constants.

With the constant k of a beam, w_p = exp(k) + I_p + I_(p+1) + ... is the signal over extinction at
its passage p, so that ln extinction there is y_p = u_p - ln w_p. The equations are logarithmic,
because noise of the values is then additive. In rows that are linear in 1 / extinction, noise
multiplies the unknowns and biases long chains of rows.

Each pass linearises y in the constant, with g = exp(k) / w and the inverse W of the covariance of
y. M = W - W g g' W / (g' W g) is the information of a beam with its constant eliminated. The
crossings x follow from (sum A' M A + P) x = sum A' M y, where A selects the crossings of a beam
and P is the precision of the prior; then k changes by g' W (y - A x) / (g' W g).
"""

from __future__ import annotations

import itertools
from typing import Final, NamedTuple

import numpy as np

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.network import _matrices
from lidarops.retrieve.network._condensed_signals import CondensedSignals, FitLayout
from lidarops.retrieve.network.thresholds import THRESHOLDS

_PASSES: Final = 24
_ROUNDING: Final = 1e-9


class Beams(NamedTuple):
    """Condensed signals of beams with the same number of passages each; the last ones are empty."""

    value: Array
    """(profile, beam, passage) u."""
    integral: Array
    """(profile, beam, passage) I, 0 behind the last passage."""
    covariance: Array
    """(profile, beam, 2 passage, 2 passage) of u, then of I."""
    reach: Indices
    """(profile, beam) number of usable passages; 0 where there is only one."""
    crossing: Indices
    """(beam, passage) number of the crossing, of those that are measured; 0 where empty."""
    crossings: int
    """Number of measured crossings."""


def places(layout: FitLayout) -> tuple[Indices, Indices]:
    """Return beam and place on the beam of each passage, with beams that have passages only."""
    counts = np.diff(layout.first_passage)
    beam = np.repeat(np.arange(np.sum(counts > 0)), counts[counts > 0])
    place = np.arange(beam.size) - layout.first_passage[:-1][layout.passages.beam]
    return beam, place


def arrange(data: CondensedSignals, layout: FitLayout, reach: Indices) -> Beams:
    """Return condensed signals in arrays of the same size for each beam.

    `reach` is the (profile, beam) number of usable passages.
    """
    beam, place = places(layout)
    shape = reach.shape[1], int(place.max(initial=0)) + 1
    profiles, most = len(reach), shape[1]
    value, integral = np.zeros((profiles, *shape)), np.zeros((profiles, *shape))
    covariance = np.zeros((profiles, shape[0], 2 * most, 2 * most))
    offsets = layout.offset[np.append(np.flatnonzero(np.diff(layout.first_passage)), -1)]
    sound = np.ones(reach.shape, dtype=np.bool_)
    for b, (first, last) in enumerate(itertools.pairwise(offsets)):
        count = int(np.sum(beam == b))
        into = np.r_[:count, most : most + count - 1]
        square = data.covariance[:, first:last].reshape(profiles, 2 * count - 1, -1)
        # A beam without noise, or of unknown noise, has no weight.
        used = np.arange(2 * count - 1) % count < reach[:, b, np.newaxis]
        variances = np.diagonal(square, axis1=1, axis2=2)
        known = np.isfinite(variances) & ((variances > 0.0) | (np.arange(2 * count - 1) >= count))
        sound[:, b] = (known | ~used).all(axis=1)
        covariance[np.ix_(range(profiles), [b], into, into)] = np.where(
            sound[:, b, np.newaxis, np.newaxis], square, 0.0
        )[:, np.newaxis]
    reach = np.where(sound & (reach > 1), reach, 0)
    value[:, beam, place] = np.where(place < reach[:, beam], data.log_value, 0.0)
    integral[:, beam, place] = np.where(place < reach[:, beam] - 1, data.integral, 0.0)
    crossing = np.zeros(shape, dtype=np.intp)
    crossing[beam, place] = (np.cumsum(layout.measured) - 1)[layout.passages.crossing]
    return Beams(value, integral, covariance, reach, crossing, int(np.sum(layout.measured)))


class Linear(NamedTuple):
    """Beams linearised about constants."""

    value: Array
    """(profile, beam, passage) y, ln extinction."""
    turn: Array
    """(profile, beam, passage, 2 passage) derivatives of y by u and I."""
    information: Array
    """(profile, beam, passage, passage) M."""
    gain: Array
    """(profile, beam, passage) W g / (g' W g), derivative of the constant by y."""
    slope: Array
    """(profile, beam) derivative g of ln w by the constant at the first passage."""

    def normal(self, beams: Beams) -> tuple[Array, Array]:
        """Return normal matrix sum A' M A, and right side sum A' M y, of each profile."""
        return normal_matrix(self.information, beams), normal_side(
            self.information, self.value, beams
        )


def carry(covariance: Array, information: Array, beams: Beams) -> Array:
    """Return (profile, crossing, beam, passage) derivatives C A' M of the solution by y."""
    taken = covariance[:, :, beams.crossing].swapaxes(1, 2)
    return _matrices.product(taken, information).swapaxes(1, 2)


def normal_matrix(information: Array, beams: Beams) -> Array:
    """Return (profile, crossing, crossing) sum A' M A."""
    out = np.zeros((len(information), beams.crossings, beams.crossings))
    _matrices.gather_squares(information, beams.crossing, out)
    return out


def normal_side(information: Array, value: Array, beams: Beams) -> Array:
    """Return (profile, crossing) sum A' M y."""
    return gathered(_matrices.product(information, value[..., np.newaxis]), beams)[..., 0]


def gathered(values: Array, beams: Beams) -> Array:
    """Return (profile, crossing, case) sums of (profile, beam, passage, case) values."""
    out = np.zeros((len(values), beams.crossings, values.shape[3]))
    place = beams.crossing.ravel()
    _matrices.gather(np.ascontiguousarray(values.reshape(len(values), place.size, -1)), place, out)
    return out


def changed_sides(linear: Linear, beams: Beams, change: Array) -> Array:
    """Return (profile, crossing, case) changes of the right sides.

    `change` is the (case, beam, 2 passage) change of u and I in all profiles.
    """
    turned = _matrices.product(linear.turn, change.transpose(1, 2, 0))
    return gathered(_matrices.product(linear.information, turned), beams)


def linearise(beams: Beams, constants: Array, reach: Indices | None = None) -> Linear:
    """Linearise beams about constants.

    Parameters
    ----------
    beams : Beams
    constants : (profile, beam) float64
        ln w at the last passage of each beam.
    reach : (profile, beam) intp, optional
        Number of passages in use, at most those of the beams.
    """
    reach = beams.reach if reach is None else reach
    shape = np.broadcast_shapes(beams.value.shape, (*reach.shape, 1))
    most = shape[2]
    end = np.exp(constants)[..., np.newaxis]
    weight = end + np.cumsum(beams.integral[..., ::-1], axis=2)[..., ::-1]
    weight = np.broadcast_to(weight, shape)
    inside = np.broadcast_to(np.arange(most) < reach[..., np.newaxis], shape)
    # The integral behind the last passage in use is part of the constant.
    steps = np.arange(most - 1) < reach[..., np.newaxis] - 1
    turn = np.zeros((*shape, 2 * most))
    turn[..., :most] = np.eye(most)
    upper = np.triu(np.ones((most, most)))[:, : most - 1]
    turn[..., most:-1] = -upper * steps[..., np.newaxis, :] / weight[..., np.newaxis]
    turn *= inside[..., np.newaxis]
    covariance = _matrices.product(_matrices.product(turn, beams.covariance), turn.swapaxes(-1, -2))
    scale = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    scale = np.where(inside & (scale > 0.0), scale, 1.0)
    correlation = covariance / scale[..., np.newaxis] / scale[..., np.newaxis, :]
    unused = np.where(inside, THRESHOLDS.smallest_pivot, 1.0)
    correlation = correlation + unused[..., np.newaxis] * np.eye(most)
    inverse = _matrices.inverse(correlation) / scale[..., np.newaxis] / scale[..., np.newaxis, :]
    inverse *= inside[..., np.newaxis] & inside[..., np.newaxis, :]
    last = np.take_along_axis(weight, np.maximum(reach - 1, 0)[..., np.newaxis], axis=2)
    lever = np.where(inside, last / weight, 0.0)
    gain = _matrices.product(inverse, lever[..., np.newaxis])[..., 0]
    known = (gain * lever).sum(axis=2)
    empty = reach < 2
    known = np.where(empty, 1.0, known)
    information = (
        inverse
        - gain[..., np.newaxis] * gain[..., np.newaxis, :] / known[..., np.newaxis, np.newaxis]
    )
    information[np.broadcast_to(empty, shape[:2])] = 0.0
    value = np.where(inside, beams.value - np.log(weight), 0.0)
    gain = np.where(empty[..., np.newaxis], 0.0, gain / known[..., np.newaxis])
    return Linear(value, turn, information, gain, lever[..., 0])


def optical_lengths(layout: FitLayout, exponent: Array) -> Array:
    """Return (beam, passage) exponent times the distance from the first passage, in m."""
    beam, place = places(layout)
    ranges, number = layout.passages.range, layout.passages.beam
    out = np.zeros((int(beam.max(initial=-1)) + 1, int(place.max(initial=0)) + 1))
    out[beam, place] = (ranges - ranges[layout.first_passage[number]]) * exponent[number]
    return out


def start_constants(beams: Beams, lengths: Array) -> Array:
    """Return (profile, beam) constants of homogeneous air.

    Along all beams of a profile, the fall of the signal over the integral is its extinction.
    `lengths` are the `optical_lengths`.
    """
    place = np.maximum(beams.reach - 1, 0)[..., np.newaxis]
    usable = beams.reach > 1
    end = np.take_along_axis(beams.value, place, axis=2)[..., 0]
    fall = np.where(usable, -np.expm1(np.minimum(end, THRESHOLDS.thickest_beam)), 0.0)
    total = beams.integral.sum(axis=2)
    length = np.take_along_axis(np.broadcast_to(lengths, beams.value.shape), place, axis=2)[..., 0]
    with np.errstate(all="ignore"):
        extinction = fall.sum(axis=1, keepdims=True) / total.sum(axis=1, keepdims=True)
        depths = 2.0 * extinction * length
        depths = np.fmin(np.fmax(depths, THRESHOLDS.thinnest_beam), THRESHOLDS.thickest_beam)
        constants = np.log(total / np.expm1(depths))
    return np.where(usable & np.isfinite(constants), constants, 0.0)


class Solution(NamedTuple):
    """Logarithms of extinction of profiles that are solved each alone."""

    logarithm: Array
    """(profile, crossing) of extinction in m-1."""
    covariance: Array
    """(profile, crossing, crossing)."""
    constants: Array
    """(profile, beam)."""
    linear: Linear
    settled: Booleans
    """(profile,) True where the last pass changed no logarithm of w."""


def fit_beams(beams: Beams, precision: Array, constants: Array) -> Solution:
    """Solve each profile by Gauss-Newton steps of its constants.

    Parameters
    ----------
    beams : Beams
    precision : (crossing, crossing) float64
        Of the prior of ln extinction.
    constants : (profile, beam) float64
        Where to start.
    """
    crossing = beams.crossing
    # Each crossing is drawn to the level of the profile a little, where nothing else determines it.
    level = THRESHOLDS.weak_precision
    precision = precision + level * np.eye(len(precision))
    inside = np.arange(beams.value.shape[2]) < beams.reach[..., np.newaxis]
    number = np.maximum(inside.sum(axis=(1, 2)), 1)
    step = np.full(constants.shape, np.inf)
    for _ in range(_PASSES):
        linear = linearise(beams, constants)
        normal, side = linear.normal(beams)
        mean = np.where(inside, linear.value, 0.0).sum(axis=(1, 2)) / number
        covariance = _matrices.inverse(normal + precision)
        pulled = side + level * mean[:, np.newaxis]
        x = _matrices.product(covariance, pulled[..., np.newaxis])[..., 0]
        # A profile that has settled does not depend on how long the others take.
        going = np.abs(step).max(axis=1, initial=0.0) >= THRESHOLDS.converged_step**3
        if not going.any():
            break
        new = (linear.gain * (linear.value - x[:, crossing])).sum(axis=2)
        new = np.clip(new, -THRESHOLDS.longest_step, THRESHOLDS.longest_step)
        step = np.where(going[:, np.newaxis], new, step)
        constants = constants + step * going[:, np.newaxis]
    moved = np.abs(step * linear.slope).max(axis=1, initial=0.0)
    return Solution(x, np.asarray(covariance), constants, linear, moved < THRESHOLDS.converged_step)


def compare(
    beams: Beams, linear: Linear, x: Array, reach: Indices | None = None
) -> tuple[Array, Array, Booleans]:
    """Return chi-squares, their degrees of freedom, and which crossings a profile sees.

    Returns
    -------
    (profile, 2) float64
        Chi-square of the beams alone, at their own best field, and about a field.
    (profile, 2) float64
    (profile, crossing) bool
    """
    reach = beams.reach if reach is None else reach
    inside = np.arange(beams.value.shape[2]) < reach[..., np.newaxis]
    seen = gathered(inside[..., np.newaxis].astype(np.float64), beams)[..., 0] > 0.0
    residual = np.where(inside, linear.value - x[:, beams.crossing], 0.0)
    weighted = _matrices.product(linear.information, residual[..., np.newaxis])[..., 0]
    about = (weighted * residual).sum(axis=(1, 2))
    alone = about - taken_up(
        normal_matrix(linear.information, beams),
        normal_side(linear.information, residual, beams),
    )
    spare = reach.sum(axis=1) - (reach > 0).sum(axis=1)
    freedom = np.stack([spare - seen.sum(axis=1), spare], axis=1).astype(np.float64)
    return np.stack([alone, about], axis=1), freedom, seen


def taken_up(normal: Array, side: Array) -> Array:
    """Return side' normal+ side, the part of chi-square that a change of the field takes up."""
    # Directions that no beam determines have no side: a little information there does not count.
    size = np.diagonal(normal, axis1=1, axis2=2).max(axis=1)[:, np.newaxis, np.newaxis]
    little = np.where(size > 0.0, _ROUNDING * size, 1.0) * np.eye(normal.shape[1])
    part = _matrices.product(_matrices.inverse(normal + little), side[..., np.newaxis])[..., 0]
    return np.asarray((part * side).sum(axis=1))
