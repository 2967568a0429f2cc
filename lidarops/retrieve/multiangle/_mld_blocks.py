"""Method "mld" for all altitudes of a block, each with the beams that have a sample there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lidarops.retrieve.multiangle import mld
from lidarops.retrieve.multiangle._block import BeamBlock

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MldEstimates:
    """Optical depths with errors and diagnostics, (profile, altitude); NaN where there is none."""

    optical_depth: Array
    standard_error: Array
    data_share: Array
    freedom: Array
    """Degrees of freedom."""
    slopes: Array
    """(2, profile, altitude): change of optical depth per unit of a gradient over altitude, to the
    east and north."""


def solve_mld_blocks(
    beams: BeamBlock,
    inhomogeneity: Array,
    regularisation: mld.Regularisation,
    prior: Array | None,
    *,
    from_below: bool = False,
) -> MldEstimates:
    """Solve every altitude with the beams that have a sample there.

    Parameters
    ----------
    beams : BeamBlock
    inhomogeneity : (altitude,) float
        Variance of the logarithms on top of the noise.
    regularisation : Regularisation
    prior : (profile, altitude) float, optional
        Optical depths that are subtracted first.
    from_below : bool
        Whether the prior is the result at the altitude below.
    """
    profiles, _, altitudes = beams.noise.shape
    out = np.full((profiles, altitudes, _ESTIMATES), np.nan)
    known = np.zeros((profiles, altitudes)) if prior is None else prior
    below = np.zeros((profiles, 2))
    operators: dict[bytes, mld.Operator] = {}
    for k in range(altitudes):
        on = np.ascontiguousarray(beams.noise[:, :, k] < np.inf)
        patterns, which = _patterns(on)
        for number, pattern in enumerate(patterns):
            path = beams.path[pattern, k]
            if path.size < 2 or np.ptp(path) < 1e-9:
                continue
            key = path.tobytes()
            if key not in operators:
                operators[key] = mld.make_operator(path, regularisation)
            members = np.flatnonzero(which == number)
            rows = np.ix_(members, np.flatnonzero(pattern))
            out[members, k] = _solve_altitude(
                beams.logarithm[:, :, k][rows],
                beams.noise[:, :, k][rows] + inhomogeneity[k],
                path,
                beams.distance[:, pattern, k],
                operators[key],
                regularisation,
                (below if from_below else np.stack([known[:, k], np.zeros(profiles)], axis=1))[
                    members
                ],
            )
        if from_below:
            solved = np.isfinite(out[:, k, 0])
            below[solved] = out[solved, k, :2]
    return MldEstimates(
        out[..., 0],
        np.sqrt(out[..., 1]),
        out[..., 2],
        out[..., 3],
        np.stack([out[..., 4], out[..., 5]]),
    )


def _patterns(on: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.intp]]:
    """Return the different sets of beams, and which of them each profile has."""
    if np.array_equal(on, np.broadcast_to(on[:1], on.shape)):
        # The usual case; sorting costs more than solving a single profile.
        return on[:1], np.zeros(len(on), dtype=np.intp)
    patterns, which = np.unique(on, axis=0, return_inverse=True)
    return patterns, which.reshape(-1)


_ESTIMATES = 6


def _solve_altitude(
    y: Array,
    variance: Array,
    path: Array,
    distance: Array,
    operator: mld.Operator,
    regularisation: mld.Regularisation,
    prior: Array,
) -> Array:
    """Return the estimates of profiles that share one set of beams at one altitude.

    Parameters
    ----------
    y, variance : (profile, beam) float
    path : (beam,) float
    distance : (2, beam) float
    operator : Operator
    regularisation : Regularisation
    prior : (profile, 2) float
        Optical depth and its variance.

    Returns
    -------
    (profile, 6) float
        Optical depth, variance, data share, degrees of freedom and slopes.
    """
    left = y + 2.0 * path * prior[:, :1]
    left -= left.mean(axis=1, keepdims=True)
    scaled = left / np.sqrt(variance.mean(axis=1, keepdims=True))
    b = np.einsum("ci,ti->tc", operator.coordinates, scaled)
    rest = np.maximum((scaled**2).sum(axis=1) - (b**2).sum(axis=1), 0.0)
    kept = 1.0 / (1.0 + regularisation.strengths[:, np.newaxis] * operator.penalty)
    rss = rest[:, np.newaxis] + np.einsum("tc,sc->ts", b**2, (1.0 - kept) ** 2)
    freedom = kept.sum(axis=1)
    chosen = regularisation.choose(rss, freedom, path.size)
    t = np.einsum("tc,ci->ti", operator.gain * kept[chosen], operator.coordinates)
    share = -2.0 * np.einsum("ti,i->t", t, path)
    return np.stack(
        [
            prior[:, 0] + (t * left).sum(axis=1),
            (t**2 * variance).sum(axis=1) + (1.0 - share) ** 2 * prior[:, 1],
            share,
            freedom[chosen],
            *np.einsum("ti,di->dt", t, distance),
        ],
        axis=1,
    )
