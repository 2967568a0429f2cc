"""Method "mld" for all altitudes of a block, each with the beams that have a sample there."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

from lidarops.retrieve.multiangle import mld
from lidarops.retrieve.multiangle._block import BeamBlock

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MldPrior:
    """Prior that is subtracted first: given optical depths, or the result at the altitude below."""

    optical_depth: Array | None
    """(profile, altitude); None for the result at the altitude below."""


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
    prior: MldPrior | None,
) -> MldEstimates:
    """Solve every altitude with the beams that have a sample there.

    Parameters
    ----------
    beams : BeamBlock
    inhomogeneity : (altitude,) float
        Variance of the logarithms on top of the noise.
    regularisation : Regularisation
    prior : MldPrior, optional
    """
    profiles, _, altitudes = beams.noise.shape
    out = np.full((profiles, altitudes, _ESTIMATES), np.nan)
    walk = prior is not None and prior.optical_depth is None
    known = np.zeros((profiles, altitudes))
    if prior is not None and prior.optical_depth is not None:
        known = prior.optical_depth
    # From below upwards, because the result at one altitude may be the prior of the next.
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
            _solve_altitude(
                beams.logarithm[:, :, k],
                beams.noise[:, :, k],
                members,
                np.flatnonzero(pattern),
                path,
                np.ascontiguousarray(beams.distance[:, pattern, k]),
                inhomogeneity[k],
                operators[key].coordinates,
                operators[key].penalty,
                operators[key].gain,
                regularisation.strengths,
                regularisation.rule,
                below if walk else np.stack([known[:, k], np.zeros(profiles)], axis=1),
                out[:, k],
            )
        if walk:
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

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@_compiled
def _solve_altitude(
    y: Array,
    noise: Array,
    members: npt.NDArray[np.intp],
    beams: npt.NDArray[np.intp],
    path: Array,
    distance: Array,
    inhomogeneity: float,
    coordinates: Array,
    penalty: Array,
    gain: Array,
    strengths: Array,
    rule: int,
    prior: Array,
    out: Array,
) -> None:
    """Solve the members of one altitude that share one set of beams.

    Parameters
    ----------
    y, noise : (profile, angle) float
    members : (member,) int
        Profiles.
    beams : (beam,) int
        Angles.
    path : (beam,) float
    distance : (2, beam) float
    inhomogeneity : float
    coordinates, penalty, gain
        Of the operator.
    strengths, rule
        Of the regularisation.
    prior : (profile, 2) float
        Optical depth and its variance.
    out : (profile, 6) float
        Output: optical depth, variance, data share, degrees of freedom and slopes.
    """
    count = beams.size
    left, variance, t = np.empty(count), np.empty(count), np.empty(count)
    b = np.empty(penalty.size)
    for p in members:
        middle = spread = 0.0
        for i in range(count):
            left[i] = y[p, beams[i]] + 2.0 * path[i] * prior[p, 0]
            variance[i] = noise[p, beams[i]] + inhomogeneity
            middle += left[i] / count
            spread += variance[i] / count
        unit = np.sqrt(spread)
        rest = 0.0
        for i in range(count):
            left[i] -= middle
            rest += left[i] * left[i] / spread
        for c in range(b.size):
            b[c] = 0.0
            for i in range(count):
                b[c] += coordinates[c, i] * left[i] / unit
            rest -= b[c] * b[c]
        strength = mld.choose_strength(b, max(rest, 0.0), penalty, strengths, count, rule)
        row = out[p]
        row[:] = 0.0
        t[:] = 0.0
        for c in range(b.size):
            kept = 1.0 / (1.0 + strength * penalty[c])
            row[3] += kept
            for i in range(count):
                t[i] += gain[c] * kept * coordinates[c, i]
        for i in range(count):
            row[0] += t[i] * left[i]
            row[1] += t[i] * t[i] * variance[i]
            row[2] -= 2.0 * t[i] * path[i]
            row[4] += t[i] * distance[0, i]
            row[5] += t[i] * distance[1, i]
        row[0] += prior[p, 0]
        row[1] += (1.0 - row[2]) ** 2 * prior[p, 1]
