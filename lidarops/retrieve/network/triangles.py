r"""Triangles of three beams, with the multiplier of drabenko2021.

A cycle leads along three beams from a crossing to a second one, a third one and back. Its row j
starts at the signal alpha_j and ends at alpha'_j, with the integral J_j = 2 m (integral of a)
between them, negative towards the lidar:

    alpha_j / extinction_j - alpha'_j / extinction_(j+1) = J_j.

The sum of the rows, row j multiplied by ``multiplier ** (j - 1)``, gives the extinction of the
first crossing if the terms of the others are left out. With 1 they cancel; a smaller multiplier
limits the noise, and biases the value by `systematic_error`; 0 leaves the first beam alone.

A cycle starts away from a lidar, and in the direction in which homogeneous air attenuates. In the
other one, the denominator has a pole.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.network import _block_solution
from lidarops.retrieve.network._beam_signals import Block, Causes, Estimates
from lidarops.retrieve.network._condensed_signals import Beams, FitLayout, places

__all__ = ["CHOSEN", "MULTIPLIERS", "solve_triangles", "systematic_error"]

CHOSEN: Final[Literal["chosen"]] = "chosen"
"""Multiplier with the smallest sum of squared bias and variance in the block."""
MULTIPLIERS: Final[Array] = 1.0 - np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 61)])
"""Multipliers to choose from: 15 per decade of the difference from 1, which grows with the noise
(`test_the_chosen_multiplier_is_no_worse_than_any_fixed_one`)."""
_BEAMS: Final = 3


def systematic_error(optical_depth: npt.ArrayLike, multiplier: npt.ArrayLike) -> Array:
    r"""Return (true - estimate) / true of reciprocal extinction at the start of a cycle of beams.

    .. math::
        \frac{S_1 - \tilde S_1}{S_1} = \frac{\sum_{j<K} (\mu_j - \mu_{j+1})
        e^{-2 \sum_{l \le j} \tau_l}}{1 - \mu_K e^{-2 \sum_l \tau_l}}, \quad \mu_j = \lambda^{j-1}

    It holds in any field, because extinction at the crossings cancels. With K = 3, equation 17 of
    the paper.

    Parameters
    ----------
    optical_depth : (..., row) float
        Exponent m times optical depth of each row, negative where it leads towards its lidar.
    multiplier : (...) float
        0 to 1.

    Returns
    -------
    (...) float
        NaN beyond the pole.

    References
    ----------
    drabenko2021.
    """
    attenuation = np.exp(-2.0 * np.cumsum(np.asarray(optical_depth, dtype=np.float64), axis=-1))
    powers = _powers(np.asarray(multiplier, dtype=np.float64), attenuation.shape[-1])
    determinant = 1.0 - powers[..., -1] * attenuation[..., -1]
    neglected = ((powers[..., :-1] - powers[..., 1:]) * attenuation[..., :-1]).sum(axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(determinant > 0.0, neglected / determinant, np.nan))


@dataclass(frozen=True, slots=True, eq=False)
class Triangle:
    """A cycle of three beams that starts at a crossing."""

    first: Indices
    """(3,) passage at the beginning of each row."""
    last: Indices
    """(3,) passage at its end."""
    direction: Array
    """(3,) 1 away from the lidar, -1 towards it."""
    depth: Array
    """(3,) m, exponent times length, negative towards the lidar."""


def solve_triangles(block: Block, multiplier: float | Literal["chosen"]) -> Estimates:
    """Solve the triangle of each crossing, and return its values with their errors.

    Parameters
    ----------
    block : Block
    multiplier : float or "chosen"
        Chosen for each crossing.
    """
    out = Estimates.missing(len(block.reach), block.layout)
    out.multiplier_error[:], out.open[:] = np.nan, True
    condensed = _block_solution.condense_alone(block)
    beams = condensed.beams
    # Change of the logarithm of extinction with u and I, (profile, crossing, beam, 2 passage).
    carried = np.zeros((*out.extinction.shape, *beams.covariance.shape[1:3]))
    for crossing, triangle in find_triangles(block.layout, block.exponent).items():
        out.open[:, crossing] = False
        rows = _Rows.of(beams, block.layout, triangle)
        members = np.flatnonzero(rows.usable)
        if members.size:
            _solve(rows.take(members), triangle, multiplier, out, carried, (members, crossing))
    out.variance[:] *= out.extinction**2

    def respond(causes: Causes) -> Array:
        changes = _block_solution.bins_alone(block, condensed).changes(causes)
        return np.asarray(np.einsum("tcbp,tbpk->tck", carried, changes))

    return out.with_response(block, respond)


def find_triangles(layout: FitLayout, exponent: Array) -> dict[int, Triangle]:
    """Return, by crossing, the triangle that attenuates most in homogeneous air.

    Crossings from which no triangle leads away are missing.
    """
    best: dict[int, Triangle] = {}
    for triangle in _cycles(layout, exponent):
        crossing = int(layout.passages.crossing[triangle.first[0]])
        least = best[crossing].depth.sum() if crossing in best else 0.0
        if triangle.depth.sum() > least:
            best[crossing] = triangle
    return best


def _cycles(layout: FitLayout, exponent: Array) -> Iterator[Triangle]:
    """Yield the cycles of three beams whose first row leads away from its lidar."""
    passages = layout.passages
    beam, crossing = passages.beam, passages.crossing
    place = {
        key: number for number, key in enumerate(zip(beam.tolist(), crossing.tolist(), strict=True))
    }
    beams_at = [beam[crossing == number].tolist() for number in range(layout.crossings)]
    crossings_on = [set(crossing[beam == number].tolist()) for number in range(exponent.size)]
    for (own, start), number in place.items():
        for far in range(number + 1, int(layout.first_passage[own + 1])):
            second = int(crossing[far])
            for middle, closing in itertools.product(beams_at[second], beams_at[start]):
                if len({own, middle, closing}) < _BEAMS:
                    continue
                for third in sorted(crossings_on[middle] & crossings_on[closing]):
                    if third not in (start, second):
                        first = [number, place[middle, second], place[closing, third]]
                        last = [far, place[middle, third], place[closing, start]]
                        run = passages.range[last] - passages.range[first]
                        depth = run * exponent[beam[first]]
                        yield Triangle(np.array(first), np.array(last), np.sign(run), depth)


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Signals of the three rows of a triangle."""

    start: Array
    """(profile, row)."""
    end: Array
    integral: Array
    covariance: Array
    """(profile, row, 3, 3) of ln start, ln end and the integral of each row."""
    usable: Booleans
    """(profile,)."""
    beam: Indices
    """(row,) of the block."""
    taken: Array
    """(row, 3, 2 passage) which of u and I, with sign, are ln start, ln end and the integral."""

    @classmethod
    def of(cls, beams: Beams, layout: FitLayout, triangle: Triangle) -> _Rows:
        """Return the rows of all profiles."""
        beam, place = places(layout)
        most = beams.value.shape[2]
        taken = np.zeros((_BEAMS, 3, 2 * most))
        own, first, last = beam[triangle.first], place[triangle.first], place[triangle.last]
        for row in range(_BEAMS):
            between = slice(most + min(first[row], last[row]), most + max(first[row], last[row]))
            taken[row, 0, first[row]] = taken[row, 1, last[row]] = 1.0
            taken[row, 2, between] = triangle.direction[row]
        signal = np.concatenate([beams.value, beams.integral], axis=2)[:, own, :, np.newaxis]
        start, end, integral = np.moveaxis((taken @ signal)[..., 0], 2, 0)
        covariance = taken @ beams.covariance[:, own] @ taken.swapaxes(1, 2)
        usable = np.asarray((beams.reach[:, own] > np.maximum(first, last)).all(axis=1))
        return cls(np.exp(start), np.exp(end), integral, covariance, usable, own, taken)

    def take(self, profiles: Indices) -> _Rows:
        """Return the selected profiles."""
        names = ("start", "end", "integral", "covariance", "usable")
        return replace(self, **{name: getattr(self, name)[profiles] for name in names})

    def solve(self, multiplier: Array) -> tuple[Array, Array, Array]:
        """Return reciprocal extinction, the variance of its logarithm, and its derivatives.

        The (profile, row, 3) derivatives are those of the logarithm by ln start, ln end and the
        integral.
        """
        reciprocal, *derivatives = _sum_rows(self.start, self.end, self.integral, multiplier)
        by_integral, by_ratio = (each / reciprocal[:, np.newaxis] for each in derivatives)
        derivative = np.stack(
            [-by_ratio - by_integral * self.integral, by_ratio, by_integral], axis=-1
        )
        variance = np.einsum("nri,nrij,nrj->n", derivative, self.covariance, derivative)
        return reciprocal, variance, derivative


def _solve(
    rows: _Rows,
    triangle: Triangle,
    requested: float | Literal["chosen"],
    out: Estimates,
    carried: Array,
    place: tuple[Indices, int],
) -> None:
    """Solve the triangle of one crossing, in place; the variance is that of the logarithm."""
    with np.errstate(all="ignore"):
        # The extinction of homogeneous air that the first beam shows.
        level = float(np.median((rows.start[:, 0] - rows.end[:, 0]) / rows.integral[:, 0]))
        depth = triangle.depth * level
        number = _choose(rows, depth, level) if requested == CHOSEN else float(requested)
        multiplier = np.full(len(rows.usable), number)
        reciprocal, variance, derivative = rows.solve(multiplier)
        solved = (reciprocal > 0.0) & np.isfinite(variance)
        extinction = np.where(solved, 1.0 / reciprocal, np.nan)
        error = np.abs(systematic_error(np.broadcast_to(depth, rows.start.shape), multiplier))
    out.extinction[place] = extinction
    out.variance[place] = np.where(solved, variance, np.nan)
    out.multiplier[place] = multiplier
    # Where the block shows no attenuation, the error is unknown unless the rows cancel.
    out.multiplier_error[place] = np.where(multiplier == 1.0, 0.0, error) * extinction
    members, crossing = place
    by_signal = -np.where(solved[:, np.newaxis, np.newaxis], derivative, 0.0)
    for row, beam in enumerate(rows.beam):
        carried[members, crossing, beam] += by_signal[:, row] @ rows.taken[row]


def _choose(rows: _Rows, depth: Array, level: float) -> float:
    """Return the multiplier with the smallest sum of squared bias and variance, 1 if none has one.

    The variance is the median of the block, relative to the extinction that the first beam shows.
    """
    bias = systematic_error(np.broadcast_to(depth, (MULTIPLIERS.size, _BEAMS)), MULTIPLIERS)
    risk = np.full(MULTIPLIERS.size, np.inf)
    for number, multiplier in enumerate(MULTIPLIERS):
        reciprocal, variance, _ = rows.solve(np.full(len(rows.usable), multiplier))
        noise = float(np.median(variance * (reciprocal * level) ** 2))
        risk[number] = bias[number] ** 2 + noise
    risk = np.where(np.isfinite(risk), risk, np.inf)
    return float(MULTIPLIERS[np.argmin(risk)])


def _sum_rows(
    start: Array, end: Array, integral: Array, multiplier: Array
) -> tuple[Array, Array, Array]:
    r"""Return the reciprocal extinction (m) at the first crossing of a cycle, and its derivatives.

    These are (profile, row): by the integrals, and by the logarithm of end over start, at the same
    integral over start.

    .. math::
        \frac{1}{\hat\sigma_1} = \frac{\sum_j \mu_j Q_{j-1} J_j / \alpha_j}{1 - \mu_K Q_K},
        \quad Q_j = \prod_{l \le j} \alpha'_l / \alpha_l, \quad \mu_j = \lambda^{j-1}

    With K = 3 rows, equations 11 and 12 of `drabenko2021`.
    """
    powers = _powers(multiplier, start.shape[-1])
    product = np.cumprod(end / start, axis=-1)
    before = np.concatenate([np.ones_like(product[..., :1]), product[..., :-1]], axis=-1)
    terms = powers * before * integral / start
    closing = (powers * product)[..., -1:]
    determinant = 1.0 - closing
    reciprocal = terms.sum(axis=-1, keepdims=True) / determinant
    later = terms[..., ::-1].cumsum(axis=-1)[..., ::-1] - terms
    by_ratio = (later + reciprocal * closing) / determinant
    return reciprocal[..., 0], powers * before / start / determinant, by_ratio


def _powers(multiplier: Array, rows: int) -> Array:
    """Return (..., row) multipliers of the rows."""
    return np.asarray(multiplier[..., np.newaxis] ** np.arange(rows))
