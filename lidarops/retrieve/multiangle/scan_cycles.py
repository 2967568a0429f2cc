"""Directions and cycles of a scan: which profiles see the same air along different paths."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common.arrays import Array, Booleans, Integers, widest_azimuth_gap
from lidarops.retrieve.common.inputs import real_array
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

_UNKNOWN: Final = -1


@dataclass(frozen=True, slots=True)
class Directions:
    """The directions of a scan, and the direction of each profile.

    Directions are ordered by vertical planes of rising azimuth (0 to 180 degree). Within a plane
    they run from the horizon opposite to its azimuth through the zenith to the horizon at its
    azimuth; the zenith belongs to the first plane.
    """

    index: Integers
    """(profile,) into the directions; -1 if the direction of a profile is unknown."""
    zenith_angle: Array
    """(direction,) degree, 0 to 180: mean over the profiles."""
    azimuth: Array
    """(direction,) degree, 0 to 360: mean over the profiles. The zenith has the azimuth of the
    first plane, 0 if none is known."""


def directions(zenith_angle: npt.ArrayLike, azimuth: npt.ArrayLike | None = None) -> Directions:
    """Return the directions of a scan.

    Profiles within 0.25 degree of each other have the same direction, and so have profiles linked
    by others between them, if the group spreads by no more than 0.75 degree. If it spreads further,
    the tolerance is halved until it does not, or until 0.01 degree is reached.

    Parameters
    ----------
    zenith_angle : (profile,) float
        degree, 0 to 180; a beam with a negative angle points opposite to its azimuth. NaN if
        unknown.
    azimuth : (profile,) float, optional
        degree; NaN if unknown. NaN for all profiles is the same as no azimuth.

    Raises
    ------
    RetrievalInputError
        For angles out of range, and negative angles without an azimuth.
    """
    zenith, heading = _angles(zenith_angle, azimuth)
    tilt = np.abs(zenith)
    upright = ~_tilted(tilt)
    bearing = np.where(zenith < 0, heading + 180.0, heading) % 360.0
    known = np.flatnonzero(np.isfinite(zenith) & (np.isfinite(heading) | upright))
    index = np.full(zenith.size, _UNKNOWN, dtype=np.int64)
    if known.size == 0:
        return Directions(index, np.empty(0), np.empty(0))
    tilt, bearing = tilt[known], np.where(upright, 0.0, bearing)[known]
    label = _clusters(_unit_vectors(tilt, bearing))
    angle = np.bincount(label, weights=tilt) / np.bincount(label)
    vertical = ~_tilted(angle)
    towards = _mean_bearings(bearing, label)
    plane, side = _planes(towards, ~vertical)
    order = np.lexsort((towards, side * angle, plane))
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    index[known] = rank[label]
    first = towards[~vertical][np.argmin(plane[~vertical])] % 180.0 if not vertical.all() else 0.0
    return Directions(index, angle[order], np.where(vertical, first, towards)[order])


def vertical_planes(zenith_angle: Array, azimuth: Array) -> list[Integers]:
    """Return the directions of each vertical plane of a scan, by rising azimuth.

    A direction along the vertical belongs to all planes.

    Parameters
    ----------
    zenith_angle, azimuth : (direction,) float
        degree, 0 to 180 and 0 to 360.

    Returns
    -------
    list of (direction,) int
        Rising indices of directions; empty where no direction is tilted.
    """
    tilted = _tilted(zenith_angle)
    plane = _planes(azimuth, tilted)[0]
    return [np.flatnonzero(~tilted | (plane == number)) for number in np.unique(plane[tilted])]


def cycles(
    zenith_angle: npt.ArrayLike, azimuth: npt.ArrayLike | None, time_bnds: npt.ArrayLike
) -> Integers:
    """Return the number of the cycle of each profile.

    A cycle ends before the first direction that it already contains. The vertical is part of every
    vertical plane, so that a volume returns to it with each azimuth: it ends a cycle only if all
    beams of the cycle and the next have one azimuth, or if a direction that followed it in the
    cycle follows it again. A cycle also ends at a pause (from
    the end of a profile to the start of the next) of more than 3 median intervals between starts,
    more than 1.5 times the longest dwell in a direction, and longer than the cycle up to it: a scan
    slews for less time than it measured before.

    Successive profiles in one direction are one visit and stay together, except at a turning
    point: a visit of at least twice the median length between two visits of the same direction is
    split, and its second half starts the way back. A sweep across the zenith to the other side is
    one cycle. A scan that goes back and forth has one cycle for each way; a turning point visited
    once belongs to the way that leads to it.

    Cycles that lack directions, at the ends or where files are missing, stay as they are. If the
    first direction of a sweep is lost, the cycles after it begin with the second direction.

    Parameters
    ----------
    zenith_angle, azimuth
        As for `directions`.
    time_bnds : (profile, 2) datetime64 or float
        Start and end of each profile; starts rising.

    Returns
    -------
    (profile,) int
        From 0, rising by 0 or 1; a profile of unknown direction has the number of the previous
        profile.

    Raises
    ------
    RetrievalInputError
        For angles out of range, or times that do not rise.
    """
    scan = directions(zenith_angle, azimuth)
    index = scan.index
    bounds = _bounds(time_bnds, index.size)
    stretch = _stretches(bounds, index)
    known = np.flatnonzero(index != _UNKNOWN)
    bearing = np.where(_tilted(scan.zenith_angle), scan.azimuth, np.nan)
    numbers = _cycle_numbers(index[known], stretch[known], bounds[known], bearing)
    previous = np.searchsorted(known, np.arange(index.size), side="right") - 1
    return np.append(numbers, 0)[np.maximum(previous, 0)] if known.size else np.zeros_like(index)


def _tilted(angle: Array) -> Booleans:
    """Return whether zenith angles (degree, 0 to 180) are not along the vertical."""
    return np.asarray(np.minimum(angle, 180.0 - angle) >= 0.5 * THRESHOLDS.same_direction)


def _unit_vectors(tilt: Array, bearing: Array) -> Array:
    """Return the directions of profiles as unit vectors (profile, 3)."""
    theta, phi = np.radians(tilt), np.radians(bearing)
    flat = np.sin(theta)
    return np.stack([flat * np.sin(phi), flat * np.cos(phi), np.cos(theta)], axis=-1)


def _clusters(vectors: Array) -> Integers:
    """Return the number of the direction of each profile, from 0."""
    step = math.radians(THRESHOLDS.finest_direction)
    # Encoder readings repeat: there are far fewer places than profiles.
    cells = np.unique(np.rint(vectors / step).astype(np.int64), axis=0, return_inverse=True)[1]
    cells = cells.reshape(-1)
    sums = np.stack([np.bincount(cells, weights=axis) for axis in vectors.T], axis=-1)
    places = np.asarray(sums / np.bincount(cells)[:, np.newaxis], dtype=np.float64)
    label = np.zeros(len(places), dtype=np.int64)
    tolerance, wide = THRESHOLDS.same_direction, np.ones(len(places), dtype=np.bool_)
    while wide.any():
        members = np.flatnonzero(wide)
        label[members] = label.max() + 1 + _linked(places[members], tolerance)
        tolerance *= 0.5
        spread = _spreads(places, label) > THRESHOLDS.widest_direction * THRESHOLDS.same_direction
        wide = spread[label] & (tolerance >= THRESHOLDS.finest_direction)
    return np.unique(label, return_inverse=True)[1].reshape(-1)[cells].astype(np.int64)


def _linked(places: Array, tolerance: float) -> Integers:
    """Return labels of groups of places linked by steps within the tolerance (degree)."""
    # Only scenes with angles need them, and every run imports this module.
    from scipy.sparse import coo_array  # noqa: PLC0415
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415
    from scipy.spatial import cKDTree  # noqa: PLC0415

    reach = 2.0 * math.sin(0.5 * math.radians(tolerance))
    pairs = cKDTree(places).query_pairs(reach, output_type="ndarray")
    links = np.ones(len(pairs), dtype=np.int8)
    graph = coo_array((links, (pairs[:, 0], pairs[:, 1])), shape=(len(places), len(places)))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _spreads(places: Array, label: Integers) -> Array:
    """Return the spread of the places of each label, degree: the diagonal of their box."""
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


def _planes(bearing: Array, tilted: Booleans) -> tuple[Integers, Integers]:
    """Return the vertical plane of each direction, and its side: 1 at the plane's azimuth, or -1.

    Directions that are not tilted are in the first plane.
    """
    plane, side = np.zeros(bearing.size, dtype=np.int64), np.ones(bearing.size, dtype=np.int64)
    members = np.flatnonzero(tilted)
    if members.size == 0:
        return plane, side
    start = -0.5 * THRESHOLDS.same_plane
    folded = np.sort((bearing[members] - start) % 180.0)
    wide = np.diff(np.append(folded, folded[0] + 180.0)) > THRESHOLDS.same_plane
    if wide.any() and not wide[-1]:
        # Otherwise a plane at the origin of azimuth would be split into the first and the last.
        start += folded[np.flatnonzero(wide)[-1] + 1] - 180.0 - 0.5 * THRESHOLDS.same_plane
    turned = (bearing[members] - start) % 360.0
    side[members] = np.where(turned < 180.0, 1, -1)
    along = turned % 180.0
    order = np.argsort(along, kind="stable")
    plane[members[order]] = np.cumsum(
        np.diff(along[order], prepend=along[order][0]) > THRESHOLDS.same_plane
    )
    return plane, side


def _cycle_numbers(index: Integers, stretch: Integers, bounds: Array, bearing: Array) -> Integers:
    """Return the cycles of profiles of known direction.

    `bearing` is that of each direction, degree; NaN along the vertical.
    """
    if index.size == 0:
        return np.empty(0, dtype=np.int64)
    begins = np.zeros(index.size, dtype=np.int64)
    # In order of their first visits.
    seen: dict[int, None] = {}
    first = 0
    visits = _visits(index, stretch)
    for number, profile in enumerate(visits):
        direction = int(index[profile])
        before = max(profile - 1, 0)
        stopped = bounds[before, 1]
        paused = stretch[profile] != stretch[before] and (
            bounds[profile, 0] - stopped > stopped - bounds[first, 0]
        )
        returns = direction in seen
        if returns and np.isnan(bearing[direction]):
            returns = _vertical_ends(list(seen), direction, index[visits[number + 1 :]], bearing)
        if returns or paused:
            begins[profile] = 1
            seen.clear()
            first = profile
        seen[direction] = None
    return np.cumsum(begins)


def _vertical_ends(seen: list[int], vertical: int, later: Integers, bearing: Array) -> bool:
    """Return whether a cycle ends before a vertical beam that it already contains.

    `seen` are the directions of the cycle in order, `later` those of the visits after the beam.
    """
    beams = bearing[[*seen, *later[:1]]]
    sector = 2.0 * np.pi - widest_azimuth_gap(np.radians(beams[np.isfinite(beams)]))
    if sector <= math.radians(THRESHOLDS.same_plane):
        return True
    following = itertools.takewhile(lambda direction: direction != vertical, later.tolist())
    return not set(seen[seen.index(vertical) + 1 :]).isdisjoint(following)


def _visits(index: Integers, stretch: Integers) -> Integers:
    """Return the first profile of each visit of a direction."""
    changes = np.append(True, (index[1:] != index[:-1]) | (stretch[1:] != stretch[:-1]))
    first = np.flatnonzero(changes)
    lengths = np.diff(np.append(first, index.size))
    inner = np.arange(1, first.size - 1)
    before, after = first[inner - 1], first[inner + 1]
    turning = (
        (index[before] == index[after])
        & (stretch[before] == stretch[after])
        & (lengths[inner] >= 2.0 * np.median(lengths))
    )
    middle = first[inner[turning]] + lengths[inner[turning]] // 2
    return np.sort(np.concatenate([first, middle]))


def _bounds(time_bnds: npt.ArrayLike, profiles: int) -> Array:
    """Return starts and ends as (profile, 2), in seconds after the first start or in any unit."""
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
            "are not ascending",
            field="time_bnds",
            remedy="sort the profiles by time, start before end",
        )
    return bounds


def _stretches(bounds: Array, index: Integers) -> Integers:
    """Return the number of the stretch between long pauses in which each profile lies."""
    if len(bounds) < 2:
        return np.zeros(len(bounds), dtype=np.int64)
    lengths = bounds[:, 1] - bounds[:, 0]
    dwells = [float(np.median(lengths[index == number])) for number in np.unique(index)]
    longest = max(
        THRESHOLDS.longest_pause * float(np.median(np.diff(bounds[:, 0]))),
        THRESHOLDS.lost_dwell * max(dwells),
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
                f"has angles beyond {limit:g} degree", field=name, remedy="give degree"
            )
    if not np.any(np.isfinite(heading)):
        if np.any(zenith < -0.5 * THRESHOLDS.same_direction):
            raise RetrievalInputError(
                "is negative, but no azimuth gives the direction",
                field="zenith_angle",
                remedy="state the azimuth of the instrument",
            )
        heading = np.zeros(zenith.shape)
    return zenith, heading
