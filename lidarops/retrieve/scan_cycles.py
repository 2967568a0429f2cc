"""The cycles of a scan: which profiles belong together as one look at the same air."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve._inputs import real_array

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

RESOLUTION: Final = 0.05
"""degree, to which directions are told apart."""
LONGEST_GAP: Final = 3.0
"""Median intervals between profiles, beyond which a new cycle begins."""
_TURN: Final = round(360.0 / RESOLUTION)
_HALF_TURN: Final = _TURN // 2
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
    """(direction,) degree, 0 to 360, to the resolution; that of the first plane at the zenith, 0
    where none is known."""


def directions(zenith_angle: npt.ArrayLike, azimuth: npt.ArrayLike | None = None) -> Directions:
    """Find the directions of a scan, told apart to 0.05 degree.

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
    keys = _keys(zenith, heading)
    index = np.full(zenith.size, _UNKNOWN, dtype=np.int64)
    known = np.flatnonzero(keys[:, 0] >= 0)
    if known.size == 0:
        return Directions(index, np.empty(0), np.empty(0))
    found, inverse = np.unique(keys[known], axis=0, return_inverse=True)
    plane, side = found[:, 1] % _HALF_TURN, np.where(found[:, 1] < _HALF_TURN, 1, -1)
    vertical = found[:, 0] == 0
    first = plane[~vertical].min(initial=_HALF_TURN)
    plane[vertical] = first % _HALF_TURN
    order = np.lexsort((side * found[:, 0], plane))
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    index[known] = rank[inverse.ravel()]
    sums = np.bincount(index[known], weights=np.abs(zenith[known]))
    bearing = np.where(vertical, plane, found[:, 1])[order] * RESOLUTION
    return Directions(index, sums / np.bincount(index[known]), bearing)


def cycles(
    zenith_angle: npt.ArrayLike, azimuth: npt.ArrayLike | None, times: npt.ArrayLike
) -> Integers:
    """Tell which cycle of a scan each profile belongs to.

    A cycle ends before the first direction that it holds already, and at a gap of more than 3
    median intervals between profiles. A sweep over the zenith to the other side is one cycle;
    a scan that goes back and forth has a cycle for each way, and a turning point that is measured
    once belongs to the way that leads to it. Where most directions are measured several times in
    a row, those profiles are one visit and stay together. Cycles that lack directions, at the
    ends or where files are missing, stay as they are; where the first direction of a sweep is
    lost, the cycles after it begin with the second one.

    Parameters
    ----------
    zenith_angle, azimuth
        As for `directions`.
    times : (profile,) datetime64 or float
        Rising.

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
    part = _parts(times, index.size)
    known = np.flatnonzero(index != _UNKNOWN)
    numbers = _numbered(index[known], part[known])
    first = np.searchsorted(known, np.arange(index.size), side="right") - 1
    return np.append(numbers, 0)[np.maximum(first, 0)] if known.size else np.zeros_like(index)


def _numbered(index: Integers, part: Integers) -> Integers:
    """Do the same for profiles of known direction, whose parts no cycle crosses."""
    if index.size == 0:
        return np.empty(0, dtype=np.int64)
    fresh = np.append(True, (index[1:] != index[:-1]) | (part[1:] != part[:-1]))
    lengths = np.diff(np.append(np.flatnonzero(fresh), index.size))
    if np.median(lengths) < 2:
        fresh[:] = True
    begins = np.zeros(index.size, dtype=np.int64)
    seen: set[int] = set()
    last = part[0]
    for at in np.flatnonzero(fresh):
        direction = int(index[at])
        if direction in seen or part[at] != last:
            begins[at] = 1
            seen.clear()
        seen.add(direction)
        last = part[at]
    return np.cumsum(begins)


def _parts(times: npt.ArrayLike, profiles: int) -> Integers:
    """Tell which stretch between long gaps each profile lies in."""
    moments = np.asarray(times)
    if moments.dtype.kind == "M":
        moments = moments.astype("datetime64[ns]").astype(np.int64)
    if moments.dtype.kind not in "iuf" or moments.shape != (profiles,):
        raise RetrievalInputError(
            f"has the shape {moments.shape} and the type {moments.dtype}",
            field="times",
            remedy=f"give one time for each of {profiles} profiles",
        )
    steps = np.diff(moments)
    if not np.all(steps > 0):
        raise RetrievalInputError("do not rise", field="times", remedy="sort the profiles by time")
    long = steps > LONGEST_GAP * np.median(steps) if steps.size else steps > 0
    return np.append(0, np.cumsum(long)).astype(np.int64)[:profiles]


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
        if np.any(zenith < -0.5 * RESOLUTION):
            raise RetrievalInputError(
                "is negative, and no azimuth tells where such angles lead",
                field="zenith_angle",
                remedy="state the azimuth of the instrument",
            )
        heading = np.zeros(zenith.shape)
    return zenith, heading


def _keys(zenith: Array, heading: Array) -> Integers:
    """Return zenith angle and azimuth in whole steps; -1 where either is not known."""
    steps = np.rint(np.nan_to_num(np.abs(zenith)) / RESOLUTION).astype(np.int64)
    bearing = np.where(zenith < 0, heading + 180.0, heading)
    around = np.rint(np.nan_to_num(bearing) / RESOLUTION).astype(np.int64) % _TURN
    vertical = (steps == 0) | (steps == _HALF_TURN)
    around[vertical] = 0
    lost = ~np.isfinite(zenith) | (~np.isfinite(heading) & ~vertical)
    keys = np.stack([steps, around], axis=-1)
    keys[lost] = _UNKNOWN
    return keys
