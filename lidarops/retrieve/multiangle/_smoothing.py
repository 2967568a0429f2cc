"""Smooth profiles: penalised solutions of pentadiagonal systems, and the choice of their weight.

A system is the precision of the estimates of one profile plus a multiple of the penalty. Sixteen
systems are solved in one sweep, with variances; the result of one does not depend on the others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array, Integers
from lidarops.retrieve.common.compiled_code import compiled
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

LANES: Final = 16
"""Systems solved at a time, one in each lane of the vector registers."""
PAD: Final = 2
"""Rows of zeros at either end, in place of values outside the grid."""
_LOGARITHM_EVERY: Final = 4
"""Pivots multiplied before a logarithm is taken; four of any allowed size do not overflow."""
_PER_DECADE: Final = 6
_GRID: Final = 10.0 ** (np.arange(11 * _PER_DECADE + 1) / _PER_DECADE - 10.0)
"""Dimensionless weights of smoothness; a larger one would cost the solution its digits."""
_SCORED: Final = 32
"""Most profiles of a block on which the weight is chosen: every n-th."""
_NEGLIGIBLE: Final = 1e-6
"""Relative likelihood below which a weight is left out of the average: less than the 12 bits of a
stored value."""


def penalty(altitude: Array) -> Array:
    r"""Return :math:`\int (d\alpha/dz)^2 dz` as the bands of a quadratic form in optical depth.

    Extinction is the optical depth gained between neighbouring altitudes over their distance;
    the first one is gained from the lidar, where the optical depth is zero.

    Parameters
    ----------
    altitude : (altitude,) float
        m above the lidar, ascending.

    Returns
    -------
    (3, altitude) float64
        m-3: diagonal, first and second off-diagonal.
    """
    step = np.diff(altitude, prepend=0.0)
    root = np.sqrt(2.0 / (step[:-1] + step[1:]))
    # Each row acts on the optical depths below, at and above an altitude; that of the lidar is 0.
    below, above = root / step[:-1], root / step[1:]
    at = -root * (1.0 / step[:-1] + 1.0 / step[1:])
    bands = np.zeros((3, altitude.size))
    bands[0, 1:] += above**2
    bands[0, :-1] += at**2
    bands[0, :-2] += below[1:] ** 2
    bands[1, :-1] += at * above
    bands[1, :-2] += (below * at)[1:]
    bands[2, :-2] += (below * above)[1:]
    return bands


def multiply_rows(bands: Array, rows: Array) -> Array:
    """Multiply (profile, altitude) rows, each by its own symmetric matrix of bands.

    Parameters
    ----------
    bands : (2, profile or 1, altitude) float64
    rows : (profile, altitude) float64
    """
    out: Array = bands[0] * rows
    beside = bands[1][:, :-1]
    out[:, 1:] += beside * rows[:, :-1]
    out[:, :-1] += beside * rows[:, 1:]
    return out


@compiled
def _load(rows: Array, profile: Integers, first: int, work: Array) -> None:
    """Transpose the rows of 16 systems into lanes; the last system fills unused lanes."""
    chosen = np.empty(LANES, dtype=np.int64)
    for j in range(LANES):
        chosen[j] = profile[min(first + j, profile.size - 1)]
    for k in range(rows.shape[1]):
        lanes = work[k + PAD]
        for j in range(LANES):
            lanes[j] = rows[chosen[j], k]


@compiled
def _store(work: Array, first: int, out: Array) -> None:
    used = min(LANES, out.shape[0] - first)
    rows = out[first : first + used]
    for k in range(out.shape[1]):
        lanes = work[k + PAD]
        for j in range(used):
            rows[j, k] = lanes[j]


@compiled
def _sweep_down(o: Array, b: Array, k: Array, lam: Array, f: Array) -> None:
    """Factor the systems as L D L' and substitute forward.

    Parameters
    ----------
    o : (2, row, lane) float64
        Bands of the precision.
    b : (row, lane) float64
        Right-hand sides.
    k : (3, altitude) float64
        Bands of the penalty.
    lam : (lane,) float64
        Weights of the penalty.
    f : (4, row, lane) float64
        Output: the reciprocal pivots, the two off-diagonals of L, and the forward solution.
    """
    edge, far, farther = np.zeros(LANES), np.zeros(LANES), np.zeros(LANES)
    for i in range(PAD, b.shape[0] - PAD):
        o0, o1, right = o[0, i], o[1, i], b[i]
        k0, k1, k2 = k[0, i - PAD], k[1, i - PAD], k[2, i - PAD]
        near_l, far_l = f[1, i - 1], f[2, i - 2]
        near_y, far_y = f[3, i - 1], f[3, i - 2]
        d, l1, l2, y = f[0, i], f[1, i], f[2, i], f[3, i]
        for j in range(LANES):
            pivot = o0[j] + lam[j] * k0 - near_l[j] * edge[j] - far_l[j] * farther[j]
            across = o1[j] + lam[j] * k1 - near_l[j] * far[j]
            beyond = lam[j] * k2
            inverse = 1.0 / pivot
            d[j] = inverse
            l1[j] = across * inverse
            l2[j] = beyond * inverse
            y[j] = right[j] - near_l[j] * near_y[j] - far_l[j] * far_y[j]
            edge[j] = across
            farther[j] = far[j]
            far[j] = beyond


@compiled
def _sweep_up(f: Array, c: Array) -> None:
    """Substitute back, and invert within the bands (Takahashi's recursion, `takahashi1973`).

    Parameters
    ----------
    f : (4, row, lane) float64
        From `_sweep_down`; the last row becomes the solution.
    c : (3, row, lane) float64
        Output: the diagonal and the off-diagonals of the inverse.
    """
    for i in range(f.shape[1] - PAD - 1, PAD - 1, -1):
        d, l1, l2, x = f[0, i], f[1, i], f[2, i], f[3, i]
        x1, x2 = f[3, i + 1], f[3, i + 2]
        c0, c1, c2 = c[0, i], c[1, i], c[2, i]
        next0, next1, last0 = c[0, i + 1], c[1, i + 1], c[0, i + 2]
        for j in range(LANES):
            a, b = l1[j], l2[j]
            second = -a * next1[j] - b * last0[j]
            first = -a * next0[j] - b * next1[j]
            x[j] = x[j] * d[j] - a * x1[j] - b * x2[j]
            c2[j] = second
            c1[j] = first
            c0[j] = d[j] - a * first - b * second


@compiled
def _substitute(f: Array) -> None:
    """Substitute back only; the last row of `f` becomes the solution."""
    for i in range(f.shape[1] - PAD - 1, PAD - 1, -1):
        d, l1, l2, x, x1, x2 = f[0, i], f[1, i], f[2, i], f[3, i], f[3, i + 1], f[3, i + 2]
        for j in range(LANES):
            x[j] = x[j] * d[j] - l1[j] * x1[j] - l2[j] * x2[j]


@compiled
def _work(altitudes: int) -> tuple[Array, Array, Array, Array]:
    rows = altitudes + 2 * PAD
    return (
        np.zeros((2, rows, LANES)),
        np.zeros((rows, LANES)),
        np.zeros((4, rows, LANES)),
        np.zeros((3, rows, LANES)),
    )


@compiled
def solve_banded(
    bands: Array, right: Array, stiffness: Array, profile: Integers, lam: Array, out: Array
) -> None:
    r"""Solve :math:`(\Omega + \lambda K) x = b`, and invert within the bands.

    Parameters
    ----------
    bands : (2, profile, altitude) float64
        Precision of each profile.
    right : (profile, altitude) float64
    stiffness : (3, altitude) float64
        Bands of the penalty.
    profile : (system,) int64
        Profile of each system.
    lam : (system,) float64
        Weight of the penalty.
    out : (1 or 3, system, altitude) float64
        Output: the solution, then the diagonal and the first off-diagonal of the inverse.
    """
    o, b, f, c = _work(right.shape[1])
    lams = np.ones(LANES)
    for first in range(0, profile.size, LANES):
        _load_system(bands, right, profile, lam, first, o, b, lams)
        _sweep_down(o, b, stiffness, lams, f)
        if out.shape[0] == 1:
            _substitute(f)
        else:
            _sweep_up(f, c)
            _store(c[0], first, out[1])
            _store(c[1], first, out[2])
        _store(f[3], first, out[0])


@compiled
def _load_system(
    bands: Array, right: Array, profile: Integers, lam: Array, first: int,
    o: Array, b: Array, lams: Array,
) -> None:  # fmt: skip
    for band in range(2):
        _load(bands[band], profile, first, o[band])
    _load(right, profile, first, b)
    for j in range(LANES):
        lams[j] = lam[min(first + j, lam.size - 1)]


@compiled
def _misfits(o: Array, b: Array, t: Array, f: Array, c: Array, total: Array) -> None:
    """Fill the (4, lane) sums over altitudes of `banded_scores`, 16 systems at a time."""
    total[:] = 0.0
    product = np.ones(LANES)
    likely, rss, free = total[0], total[1], total[2]
    for i in range(PAD, b.shape[0] - PAD):
        o0, o1, right = o[0, i], o[1, i], b[i]
        t0, t1, x0, x1 = t[i], t[i + 1], f[3, i], f[3, i + 1]
        c0, c1, d = c[0, i], c[1, i], f[0, i]
        for j in range(LANES):
            e0, e1 = t0[j] - x0[j], t1[j] - x1[j]
            likely[j] += right[j] * e0
            rss[j] += o0[j] * e0 * e0 + 2.0 * o1[j] * e0 * e1
            free[j] += o0[j] * c0[j] + 2.0 * o1[j] * c1[j]
            product[j] *= d[j]
        if (i - PAD) % _LOGARITHM_EVERY == 0:
            for j in range(LANES):
                total[3, j] -= math.log(product[j])
                product[j] = 1.0
    for j in range(LANES):
        total[3, j] -= math.log(product[j])


@compiled
def banded_scores(
    bands: Array,
    right: Array,
    estimates: Array,
    stiffness: Array,
    profile: Integers,
    lam: Array,
) -> Array:
    r"""Return the quantities of each solution from which :math:`\lambda` is chosen.

    Parameters
    ----------
    bands, right, stiffness, profile, lam
        As for `solve_banded`, with right-hand sides :math:`\Omega t`.
    estimates : (profile, altitude) float64
        :math:`t`, 0 where there is none.

    Returns
    -------
    (4, system) float64
        :math:`t'\Omega(t - x)`, :math:`(t - x)'\Omega(t - x)`, the effective degrees of freedom
        :math:`tr C \Omega` and :math:`\ln|\Omega + \lambda K|`.
    """
    o, b, f, c = _work(right.shape[1])
    t, lams, total = np.zeros_like(b), np.ones(LANES), np.zeros((4, LANES))
    out = np.empty((4, profile.size))
    for first in range(0, profile.size, LANES):
        _load_system(bands, right, profile, lam, first, o, b, lams)
        _load(estimates, profile, first, t)
        _sweep_down(o, b, stiffness, lams, f)
        _sweep_up(f, c)
        _misfits(o, b, t, f, c, total)
        for j in range(min(LANES, profile.size - first)):
            out[:, first + j] = total[:, j]
    return out


# Choice of the weight by restricted likelihood and Mallows' Cp on a fixed grid -------------------


@dataclass(frozen=True, slots=True)
class Smoothing:
    """Weights of smoothness with which each profile of a block is solved."""

    weight: Array
    """(candidate,): one weight, or several to be averaged over."""
    share: Array
    """(candidate,): share of each in the average, 1 in total."""

    def times(self, factor: float) -> Smoothing:
        """Return weights multiplied by a factor."""
        return replace(self, weight=self.weight * factor)

    def solve(
        self, right: Array, bands: Array, stiffness: Array, *, inverse: bool = False
    ) -> Array:
        """Return solutions, (1, profile * candidate, altitude), or (3, ...) with the inverse."""
        profiles, count = len(right), self.share.size
        out = np.empty((3 if inverse else 1, profiles * count, right.shape[1]))
        row, weight = np.repeat(np.arange(profiles), count), np.tile(self.weight, profiles)
        solve_banded(bands, right, stiffness, row, weight, out)
        return out

    def mean(self, values: Array) -> Array:
        """Average (profile * candidate, altitude) rows into (profile, altitude)."""
        apart = values.reshape(-1, self.share.size, values.shape[1])
        return np.asarray(np.einsum("tck,c->tk", apart, self.share))

    def mixed(self, value: Array, variance: Array) -> tuple[Array, Array]:
        """Return mean and variance of the mixture of the solutions of each profile."""
        mean = self.mean(value)
        away = value - np.repeat(mean, self.share.size, axis=0)
        return mean, self.mean(variance + away**2)


@dataclass(frozen=True, slots=True)
class Scores:
    """The criteria for some weights, summed over the scored profiles of a block."""

    weight: Array
    """(smoothing,): rising."""
    likelihood: Array
    """(smoothing,): minus twice the restricted log-likelihood, up to a constant."""
    risk: Array
    """(smoothing,): Mallows' Cp, up to a constant."""
    freedom: Array
    """(smoothing,): mean effective degrees of freedom of a profile."""


def score_smoothing(bands: Array, estimates: Array, stiffness: Array, weight: Array) -> Scores:
    """Score weights for the profiles of one block, formula 2 of the page.

    A long block is scored on every n-th profile.

    Parameters
    ----------
    bands : (2, profile, altitude) float64
    estimates : (profile, altitude) float64
        0 where there is none.
    stiffness : (3, altitude) float64
    weight : (smoothing,) float64
    """
    profiles, altitudes = estimates.shape
    scored = np.arange(0, profiles, -(-profiles // _SCORED))
    right = multiply_rows(bands, estimates)
    profile = np.repeat(scored, weight.size)
    lam = np.tile(weight, scored.size)
    raw = banded_scores(bands, right, estimates, stiffness, profile, lam)
    fit, misfit, freedom, logarithm = raw.reshape(4, scored.size, weight.size)
    likelihood = (fit + logarithm - (altitudes - 1) * np.log(weight)).sum(axis=0)
    # Where a pivot lost all its digits, the weight is too large.
    likelihood = np.where(np.isfinite(likelihood), likelihood, np.inf)
    risk = misfit + 2.0 * freedom
    return Scores(weight, likelihood, risk.sum(axis=0), freedom.mean(axis=0))


def weights_up_to(largest: float, unit: float, *, one: bool = True) -> Array:
    """Return the weights to choose from: those of a grid in `unit`, and the largest one.

    Without a limit, smooth extinction below would deny the top of a layer above, where the data are
    too noisy to show it. An average, without `one`, is over the grid alone: the limit beside its
    last weight would count twice (`test_bench_false_values`).
    """
    grid = _GRID * unit
    if one and largest <= grid[-1]:
        return np.append(grid[grid < largest], largest)
    return grid[: max(int(np.searchsorted(grid, largest, side="right")), 1)]


def choose_smoothing(scores: Scores, *, one: bool) -> Smoothing:
    """Choose the weight of a block, or without `one` the weights to average over.

    Profiles of a block have similar shapes, but the likelihood treats them as independent; in
    clouds it then smooths too much. Cp uses the known noise, but is erratic. It is used only if it
    gives 1.2 times the degrees of freedom, and lowers the weight by at most a factor of 10.
    """
    admitted = (scores.freedom >= THRESHOLDS.least_smooth_freedom) & np.isfinite(scores.likelihood)
    last = int(np.flatnonzero(admitted)[-1]) if admitted.any() else 0
    likelihood = scores.likelihood[: last + 1]
    if not one:
        share = np.exp(-0.5 * (likelihood - likelihood.min()))
        kept = np.flatnonzero(share > _NEGLIGIBLE)
        return Smoothing(scores.weight[kept], share[kept] / share[kept].sum())
    likely = int(np.argmin(likelihood))
    risky = max(int(np.argmin(scores.risk[: last + 1])), likely - _PER_DECADE)
    rougher = scores.freedom[risky] > THRESHOLDS.rougher * scores.freedom[likely]
    return Smoothing(scores.weight[[risky if rougher else likely]], np.ones(1))
