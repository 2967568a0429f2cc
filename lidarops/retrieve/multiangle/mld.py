r"""Methods "mld" and "mld_prior": regularised derivative of the logarithm along the slant path.

The method of `gobrusenko1989`. The slope :math:`\varphi` of :math:`\ln S` over the slant path x is
taken as constant between neighbouring beams, :math:`y_l - c = \int_{x_0}^{x_l} \varphi\,dx`, and
kept small by the penalty :math:`\alpha \int \varphi^2 dx` (paths scaled to a span of 1). Its mean
over the path gives :math:`\tau = -\bar\varphi / 2`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import Array
from lidarops.retrieve.multiangle._block import BeamBlock

STRENGTHS: Final[Array] = 10.0 ** np.linspace(-6.0, 6.0, 97)
"""Strengths of the penalty to choose from; dimensionless, for paths scaled to a span of 1."""
_SAME_NODE: Final = 1e-4
"""Distance of scaled slant paths up to which beams share a node."""
_ESTIMATES: Final = 6


@dataclass(frozen=True, slots=True)
class MldEstimates:
    """Optical depths with errors and diagnostics, (profile, altitude); NaN where there is none."""

    optical_depth: Array
    variance: Array
    data_share: Array
    """Part of the optical depth that comes from the data. The penalty pulls the rest to the prior:
    0, or the optical depth at the altitude below."""
    freedom: Array
    """Degrees of freedom."""
    strength: Array
    """Strength of the penalty."""
    prior: Array
    """Optical depth to which the penalty pulls."""
    slopes: Array
    """(axis, profile, altitude): change of optical depth per unit of a gradient over altitude along
    the axes of the scan."""


@dataclass(frozen=True, slots=True)
class Operator:
    """Linear operator from the logarithms of one set of beams to optical depth."""

    coordinates: Array
    """(component, beam): turns logarithms into uncorrelated coordinates b."""
    penalty: Array
    """(component,): the penalty keeps the share f = 1 / (1 + strength * penalty) of b."""
    gain: Array
    """(component,): optical depth = sum of gain * f * b."""


def make_operator(path: Array) -> Operator:
    """Return the operator for beams of equal weight.

    Parameters
    ----------
    path : (beam,) float
        Slant over vertical paths, in any order, at least two different ones.
    """
    order = np.argsort(path, kind="stable")
    low, span = path[order[0]], path[order[-1]] - path[order[0]]
    position = (path - low) / span
    node = np.empty(path.size, dtype=np.intp)
    node[order] = np.cumsum(np.diff(position[order], prepend=0.0) > _SAME_NODE)
    nodes = np.array([position[node == i].mean() for i in range(node.max() + 1)])
    # The roots of the widths turn the penalty into the square of the unknowns.
    root = np.sqrt(np.diff(nodes))
    matrix = np.where(np.arange(root.size) < node[:, np.newaxis], root, 0.0)
    left, values, right = np.linalg.svd(matrix - matrix.mean(axis=0), full_matrices=False)
    gain = -0.5 / span * (right @ root) / values
    return Operator(np.ascontiguousarray(left.T), values**-2.0, gain)


def solve_mld(
    beams: BeamBlock, inhomogeneity: Array, *, from_below: bool, strength: float | None = None
) -> MldEstimates:
    """Solve every altitude with the beams that have a sample there.

    Parameters
    ----------
    beams : BeamBlock
    inhomogeneity : (altitude,) float
        Variance of the logarithms on top of the noise.
    from_below : bool
        Whether the prior is the optical depth at the altitude below, instead of 0.
    strength : float, optional
        Of the penalty, dimensionless; chosen from `STRENGTHS` at each altitude if not given.
    """
    strengths = STRENGTHS if strength is None else np.array([strength])
    profiles, _, altitudes = beams.noise.shape
    out = np.full((profiles, altitudes, _ESTIMATES + len(beams.axes)), np.nan)
    prior = np.zeros((profiles, 2))
    operators: dict[bytes, Operator] = {}
    for k in range(altitudes):
        patterns, which = np.unique(beams.noise[:, :, k] < np.inf, axis=0, return_inverse=True)
        for number, pattern in enumerate(patterns):
            path = beams.path[pattern, k]
            if path.size < 2 or np.ptp(path) < 1e-9:
                continue
            key = path.tobytes()
            if key not in operators:
                operators[key] = make_operator(path)
            members = np.flatnonzero(which.reshape(-1) == number)
            rows = np.ix_(members, pattern)
            out[members, k] = _solve_altitude(
                beams.logarithm[:, :, k][rows],
                beams.noise[:, :, k][rows] + inhomogeneity[k],
                path,
                beams.axes[:, pattern, k],
                operators[key],
                prior[members],
                strengths,
            )
        if from_below:
            solved = np.isfinite(out[:, k, 0])
            prior[solved] = out[solved, k, :2]
    depth, variance, share, freedom, used, pulled, *slopes = np.moveaxis(out, -1, 0)
    return MldEstimates(depth, variance, share, freedom, used, pulled, np.stack(slopes))


def _solve_altitude(
    y: Array,
    variance: Array,
    path: Array,
    distance: Array,
    operator: Operator,
    prior: Array,
    strengths: Array,
) -> Array:
    """Return the estimates of profiles that share one set of beams at one altitude.

    The strength is the largest with residuals not larger than the noise, or else the smallest.

    Parameters
    ----------
    y, variance : (profile, beam) float
    path : (beam,) float
    distance : (axis, beam) float
    operator : Operator
    prior : (profile, 2) float
        Optical depth and its variance.
    strengths : (strength,) float
        To choose from, rising.

    Returns
    -------
    (profile, 6 + axis) float
        Optical depth, variance, data share, degrees of freedom, strength, prior and slopes.
    """
    left = y + 2.0 * path * prior[:, :1]
    left -= left.mean(axis=1, keepdims=True)
    scaled = left / np.sqrt(variance.mean(axis=1, keepdims=True))
    b = np.einsum("ci,ti->tc", operator.coordinates, scaled)
    rest = np.maximum((scaled**2).sum(axis=1) - (b**2).sum(axis=1), 0.0)
    kept = 1.0 / (1.0 + strengths[:, np.newaxis] * operator.penalty)
    rss = rest[:, np.newaxis] + np.einsum("tc,sc->ts", b**2, (1.0 - kept) ** 2)
    # The residuals grow with the strength.
    chosen = np.maximum((rss <= path.size - 1.0).sum(axis=1) - 1, 0)
    t = np.einsum("tc,ci->ti", operator.gain * kept[chosen], operator.coordinates)
    share = -2.0 * np.einsum("ti,i->t", t, path)
    return np.stack(
        [
            prior[:, 0] + (t * left).sum(axis=1),
            (t**2 * variance).sum(axis=1) + (1.0 - share) ** 2 * prior[:, 1],
            share,
            kept.sum(axis=1)[chosen],
            strengths[chosen],
            prior[:, 0],
            *np.einsum("ti,di->dt", t, distance),
        ],
        axis=1,
    )
