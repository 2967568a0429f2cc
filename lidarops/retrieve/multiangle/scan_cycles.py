"""The cycles of a scan: which profiles belong together as one look at the same air."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common.inputs import real_array

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

TOLERANCE: Final = 0.25
"""degree, by which what the encoders tell of one direction may differ from the next."""
WIDEST: Final = 3.0
"""Tolerances over which the profiles of one direction may spread. Wider, they are a slow sweep,
and told apart by a smaller tolerance."""
LONGEST_PAUSE: Final = 3.0
"""Median intervals between profiles, beyond which a new cycle begins: more than two are lost."""
_LOST_DWELL: Final = 1.5
"""Longest dwells in a direction; a pause must be longer too, as one lost file may be."""
_FINEST: Final = 0.01
"""degree."""
_PLANES: Final = 1.0
"""degree, by which azimuths of one vertical plane may differ from the next."""
_UNKNOWN: Final = -1


@dataclass(frozen=True, slots=True)
class Directions:
    """The directions of a scan, and which of them each profile has.

    Ordered by vertical planes of rising azimuth (0 to 180 degree), from the horizon on the far
    side of each plane over the zenith to the horizon at its azimuth; the zenith belongs to the
    first plane.
    """

    index: Integers
    """(profile,) into the directions; -1 where the direction of a profile is not known."""
    zenith_angle: Array
    """(direction,) degree, 0 to 180: the mean over its profiles."""
    azimuth: Array
    """(direction,) degree, 0 to 360: the mean over its profiles; that of the first plane at the
    zenith, 0 where none is known."""


def directions(zenith_angle: npt.ArrayLike, azimuth: npt.ArrayLike | None = None) -> Directions:
    """Find the directions of a scan.

    Profiles that look to within 0.25 degree of each other have the same direction, and so do
    those that others between them join, as far as they spread by no more than 0.75 degree; where
    they spread further, the tolerance is halved until they do not, or 0.01 degree is reached.

    Parameters
    ----------
    zenith_angle : (profile,) float
        degree, 0 to 180; a negative angle leads opposite to its azimuth. NaN where not known.
    azimuth : (profile,) float, optional
        degree; NaN where not known, which is the same as none where no profile has it.

    Returns
    -------
    Directions

    Raises
    ------
    RetrievalInputError
        For angles that cannot be right, and negative ones without an azimuth.
    """
    zenith, heading = _angles(zenith_angle, azimuth)
    tilt = np.abs(zenith)
    upright = np.minimum(tilt, 180.0 - tilt) < 0.5 * TOLERANCE
    bearing = np.where(zenith < 0, heading + 180.0, heading) % 360.0
    known = np.flatnonzero(np.isfinite(zenith) & (np.isfinite(heading) | upright))
    index = np.full(zenith.size, _UNKNOWN, dtype=np.int64)
    if known.size == 0:
        return Directions(index, np.empty(0), np.empty(0))
    tilt, bearing = tilt[known], np.where(upright, 0.0, bearing)[known]
    label = _clusters(_unit_vectors(tilt, bearing))
    angle = np.bincount(label, weights=tilt) / np.bincount(label)
    vertical = np.minimum(angle, 180.0 - angle) < 0.5 * TOLERANCE
    towards = _mean_bearings(bearing, label)
    plane, side = _planes(towards, ~vertical)
    order = np.lexsort((towards, side * angle, plane))
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    index[known] = rank[label]
    first = towards[~vertical][np.argmin(plane[~vertical])] % 180.0 if not vertical.all() else 0.0
    return Directions(index, angle[order], np.where(vertical, first, towards)[order])


def cycles(
    zenith_angle: npt.ArrayLike, azimuth: npt.ArrayLike | None, time_bnds: npt.ArrayLike
) -> Integers:
    """Tell which cycle of a scan each profile belongs to.

    A cycle ends before the first direction that it holds already, and at a pause, from the end of
    a profile to the start of the next, of more than 3 median intervals between starts and 1.5 of
    the longest dwells in a direction. Profiles that follow each other in one direction are one
    visit and stay together, but at a turning point: where as many as two visits have follow each
    other between two visits of the same direction, the second half is the first visit of the way
    back. A sweep over the zenith to the other side is one cycle; a scan that goes back and forth
    has a cycle for each way, and a turning point that is visited once belongs to the way that
    leads to it. Cycles that lack directions, at the ends or where files are missing, stay as they
    are; where the first direction of a sweep is lost, the cycles after it begin with the second
    one.

    Parameters
    ----------
    zenith_angle, azimuth
        As for `directions`.
    time_bnds : (profile, 2) datetime64 or float
        Start and end of each profile; starts rising.

    Returns
    -------
    (profile,) int
        From 0, rising by 0 or 1; a profile of unknown direction has the number of the one before.

    Raises
    ------
    RetrievalInputError
        For angles that cannot be right, or times that do not rise.
    """
    index = directions(zenith_angle, azimuth).index
    part = _parts(_bounds(time_bnds, index.size), index)
    known = np.flatnonzero(index != _UNKNOWN)
    numbers = _numbered(index[known], part[known])
    first = np.searchsorted(known, np.arange(index.size), side="right") - 1
    return np.append(numbers, 0)[np.maximum(first, 0)] if known.size else np.zeros_like(index)


def _unit_vectors(tilt: Array, bearing: Array) -> Array:
    """Return where profiles look to, as (profile, 3)."""
    theta, phi = np.radians(tilt), np.radians(bearing)
    flat = np.sin(theta)
    return np.stack([flat * np.sin(phi), flat * np.cos(phi), np.cos(theta)], axis=-1)


def _clusters(vectors: Array) -> Integers:
    """Return the number of the direction of each profile, from 0."""
    step = math.radians(_FINEST)
    # Encoders repeat themselves: far fewer places than profiles.
    cells = np.unique(np.rint(vectors / step).astype(np.int64), axis=0, return_inverse=True)[1]
    cells = cells.reshape(-1)
    sums = np.stack([np.bincount(cells, weights=one) for one in vectors.T], axis=-1)
    places = np.asarray(sums / np.bincount(cells)[:, np.newaxis], dtype=np.float64)
    label = np.zeros(len(places), dtype=np.int64)
    tolerance, wide = TOLERANCE, np.ones(len(places), dtype=np.bool_)
    while wide.any():
        members = np.flatnonzero(wide)
        label[members] = label.max() + 1 + _linked(places[members], tolerance)
        tolerance *= 0.5
        spread = _spreads(places, label) > WIDEST * TOLERANCE
        wide = spread[label] & (tolerance >= _FINEST)
    return np.unique(label, return_inverse=True)[1].reshape(-1)[cells].astype(np.int64)


def _linked(places: Array, tolerance: float) -> Integers:
    """Return labels of places that links of at most the tolerance (degree) join."""
    reach = 2.0 * math.sin(0.5 * math.radians(tolerance))
    pairs = cKDTree(places).query_pairs(reach, output_type="ndarray")
    one = np.ones(len(pairs), dtype=np.int8)
    graph = coo_array((one, (pairs[:, 0], pairs[:, 1])), shape=(len(places), len(places)))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _spreads(places: Array, label: Integers) -> Array:
    """Return over how many degrees the places of each label spread: sides of their box."""
    order = np.argsort(label, kind="stable")
    first = np.flatnonzero(np.diff(label[order], prepend=-1))
    ordered = places[order]
    sides = np.maximum.reduceat(ordered, first) - np.minimum.reduceat(ordered, first)
    spread = np.zeros(int(label.max()) + 1)
    spread[label[order][first]] = np.degrees(np.linalg.norm(sides, axis=1))
    return spread


def _mean_bearings(bearing: Array, label: Integers) -> Array:
    """Return the mean bearing of each direction, 0 to 360 degree."""
    first = bearing[np.unique(label, return_index=True)[1]]
    off = (bearing - first[label] + 180.0) % 360.0 - 180.0
    return np.asarray((first + np.bincount(label, weights=off) / np.bincount(label)) % 360.0)


def _planes(bearing: Array, tilted: npt.NDArray[np.bool_]) -> tuple[Integers, Integers]:
    """Return the plane of each direction, and 1 on the side to its azimuth, -1 on the other.

    Directions that are not tilted are in the first plane.
    """
    plane, side = np.zeros(bearing.size, dtype=np.int64), np.ones(bearing.size, dtype=np.int64)
    members = np.flatnonzero(tilted)
    if members.size == 0:
        return plane, side
    start = -0.5 * _PLANES
    folded = np.sort((bearing[members] - start) % 180.0)
    wide = np.diff(np.append(folded, folded[0] + 180.0)) > _PLANES
    if wide.any() and not wide[-1]:
        # A plane just there would fall apart into the first and the last one.
        start += folded[np.flatnonzero(wide)[-1] + 1] - 180.0 - 0.5 * _PLANES
    turned = (bearing[members] - start) % 360.0
    side[members] = np.where(turned < 180.0, 1, -1)
    along = turned % 180.0
    order = np.argsort(along, kind="stable")
    plane[members[order]] = np.cumsum(np.diff(along[order], prepend=along[order][0]) > _PLANES)
    return plane, side


def _numbered(index: Integers, part: Integers) -> Integers:
    """Return cycles of profiles of known direction, whose parts no cycle crosses."""
    if index.size == 0:
        return np.empty(0, dtype=np.int64)
    begins = np.zeros(index.size, dtype=np.int64)
    seen: set[int] = set()
    last = part[0]
    for at in _visits(index, part):
        direction = int(index[at])
        if direction in seen or part[at] != last:
            begins[at] = 1
            seen.clear()
        seen.add(direction)
        last = part[at]
    return np.cumsum(begins)


def _visits(index: Integers, part: Integers) -> Integers:
    """Return the first profile of each visit of a direction."""
    fresh = np.append(True, (index[1:] != index[:-1]) | (part[1:] != part[:-1]))
    first = np.flatnonzero(fresh)
    lengths = np.diff(np.append(first, index.size))
    inner = np.arange(1, first.size - 1)
    before, after = first[inner - 1], first[inner + 1]
    turning = (
        (index[before] == index[after])
        & (part[before] == part[after])
        & (lengths[inner] >= 2.0 * np.median(lengths))
    )
    middle = first[inner[turning]] + lengths[inner[turning]] // 2
    return np.sort(np.concatenate([first, middle]))


def _bounds(time_bnds: npt.ArrayLike, profiles: int) -> Array:
    """Return starts and ends as (profile, 2), in seconds after the first start or any unit."""
    bounds = np.asarray(time_bnds)
    if bounds.dtype.kind not in "iufM" or bounds.shape != (profiles, 2):
        raise RetrievalInputError(
            f"has the shape {bounds.shape} and the type {bounds.dtype}",
            field="time_bnds",
            remedy=f"give start and end of each of {profiles} profiles",
        )
    if bounds.dtype.kind == "M":
        whole = bounds.astype("datetime64[ns]").astype(np.int64)
        known = ~np.isnat(bounds).any()
        bounds = 1e-9 * (whole - whole[:1, :1]) if known else np.full(bounds.shape, np.nan)
    bounds = bounds.astype(np.float64)
    if not (np.all(np.diff(bounds[:, 0]) > 0) and np.all(bounds[:, 1] >= bounds[:, 0])):
        raise RetrievalInputError(
            "do not rise", field="time_bnds", remedy="sort the profiles by time, start before end"
        )
    return bounds


def _parts(bounds: Array, index: Integers) -> Integers:
    """Tell which stretch between long pauses each profile lies in."""
    if len(bounds) < 2:
        return np.zeros(len(bounds), dtype=np.int64)
    lengths = bounds[:, 1] - bounds[:, 0]
    dwells = [float(np.median(lengths[index == one])) for one in np.unique(index)]
    longest = max(
        LONGEST_PAUSE * float(np.median(np.diff(bounds[:, 0]))), _LOST_DWELL * max(dwells)
    )
    pauses = bounds[1:, 0] - bounds[:-1, 1]
    return np.append(0, np.cumsum(pauses > longest)).astype(np.int64)


def _angles(zenith_angle: npt.ArrayLike, azimuth: npt.ArrayLike | None) -> tuple[Array, Array]:
    zenith = real_array(zenith_angle, "zenith_angle").astype(np.float64)
    if zenith.ndim != 1:
        raise RetrievalInputError(
            f"has the shape {zenith.shape}", field="zenith_angle", remedy="give one per profile"
        )
    heading = np.full(zenith.shape, np.nan)
    if azimuth is not None:
        heading = real_array(azimuth, "azimuth").astype(np.float64)
    if heading.shape != zenith.shape:
        raise RetrievalInputError(
            f"has the shape {heading.shape}, zenith_angle {zenith.shape}", field="azimuth"
        )
    for name, angles, limit in (("zenith_angle", zenith, 180.0), ("azimuth", heading, 360.0)):
        if np.any(np.abs(angles) > limit):
            raise RetrievalInputError(
                f"holds angles beyond {limit:g} degree", field=name, remedy="give degree"
            )
    if not np.any(np.isfinite(heading)):
        if np.any(zenith < -0.5 * TOLERANCE):
            raise RetrievalInputError(
                "is negative, and no azimuth tells where such angles lead",
                field="zenith_angle",
                remedy="state the azimuth of the instrument",
            )
        heading = np.zeros(zenith.shape)
    return zenith, heading
