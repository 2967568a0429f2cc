"""Geometry of a network: crossings of the beams from the stations and pointings of the lidars.

Beams are straight lines: refraction bends a beam by less than 1 m in 10 km of horizontal air.
Heights are above the ellipsoid. A height error common to all stations (the geoid) shifts all
crossings alike.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Booleans = npt.NDArray[np.bool_]

SEMI_MAJOR_AXIS: Final = 6_378_137.0
"""m, WGS84 (`wgs84`)."""
FLATTENING: Final = 1.0 / 298.257223563
"""1, WGS84 (`wgs84`)."""
_ECCENTRICITY_SQUARED: Final = FLATTENING * (2.0 - FLATTENING)
_BOWRING_PASSES: Final = 6
"""Passes of Bowring's iteration. Below 100 km, 3 passes are exact to rounding."""

DEFAULT_TOLERANCE: Final = 15.0
"""m, two bins of 7.5 m."""
SMALLEST_CROSSING_ANGLE: Final = 2.0
"""degree. At smaller angles, a pointing error of 0.1 degree moves the crossing by more than 5
percent of its range."""
MOST_BEAMS: Final = 512


@dataclass(frozen=True, slots=True)
class Beam:
    """One line of sight of one lidar."""

    latitude: float
    """degree, WGS84."""
    longitude: float
    """degree."""
    altitude: float
    """m."""
    azimuth: float
    """degree from north towards east, at the station."""
    elevation: float
    """degree above the horizon of the station."""


@dataclass(frozen=True, slots=True)
class Passages:
    """Passages of beams through crossings: one entry per beam and crossing, beam by beam."""

    beam: Indices
    crossing: Indices
    range: Array
    """m, from the lidar to the point of the beam next to the crossing."""


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """Beams and the crossings in which they meet. Arrays are read-only."""

    origin: Array
    """(beam, 3) positions of the lidars in the local frame, m: east, north, up."""
    direction: Array
    """(beam, 3) unit vectors."""
    crossing: Array
    """(crossing, 3) positions, m, ordered by their nearest range."""
    miss_distance: Array
    """(crossing,) m, largest distance of the crossing from a beam that passes through it."""
    crossing_angle: Array
    """(crossing,) degree, largest angle between beams that meet there, reduced to 0-90."""
    passages: Passages
    near_crossing: Booleans
    """(crossing,) True where a beam continues from the crossing to a farther one: attenuation
    behind the crossing then determines its extinction. Elsewhere, noise is amplified."""
    geodetic: Array | None = field(default=None)
    """(crossing, 3) latitude and longitude in degree, altitude in m; None for a local frame."""

    @property
    def beams(self) -> int:
        """Number of beams."""
        return int(self.origin.shape[0])

    @property
    def crossings(self) -> int:
        """Number of crossings."""
        return int(self.crossing.shape[0])

    def on_beam(self, beam: int) -> tuple[Indices, Array]:
        """Return the crossings on a beam and their ranges, the nearest first."""
        on_this_beam = self.passages.beam == beam
        return self.passages.crossing[on_this_beam], self.passages.range[on_this_beam]


@dataclass(frozen=True, slots=True, eq=False)
class Cycle:
    """A closed path over beams: row j follows beam j from crossing j to crossing j + 1."""

    beam: Indices
    crossing: Indices
    start_range: Array
    """(row,) m, range on the beam of the crossing where the row starts."""
    end_range: Array
    """(row,) m, range on the beam of the crossing where the row ends."""

    @property
    def sign(self) -> Array:
        """(row,) +1 where the row leads away from its lidar, -1 where it leads towards it."""
        return np.where(self.end_range > self.start_range, 1.0, -1.0)

    @property
    def far_start(self) -> bool:
        """Whether the first crossing is the far one of the two on the first beam."""
        return bool(self.sign[0] < 0)


# Geodesy ------------------------------------------------------------------------------------


def to_earth_centred(
    latitude: npt.ArrayLike, longitude: npt.ArrayLike, altitude: npt.ArrayLike
) -> Array:
    """Return (..., 3) earth-centred, earth-fixed coordinates (m) of WGS84 positions.

    Parameters
    ----------
    latitude, longitude : (...) float
        degree.
    altitude : (...) float
        m above the ellipsoid.

    References
    ----------
    wgs84.
    """
    phi, lam = np.radians(latitude), np.radians(longitude)
    height = np.asarray(altitude, dtype=np.float64)
    normal = SEMI_MAJOR_AXIS / np.sqrt(1.0 - _ECCENTRICITY_SQUARED * np.sin(phi) ** 2)
    across = (normal + height) * np.cos(phi)
    along = (normal * (1.0 - _ECCENTRICITY_SQUARED) + height) * np.sin(phi)
    return np.stack(np.broadcast_arrays(across * np.cos(lam), across * np.sin(lam), along), axis=-1)


def to_geodetic(position: npt.ArrayLike) -> Array:
    """Return (..., 3) latitude, longitude (degree) and altitude (m) of earth-centred positions.

    Parameters
    ----------
    position : (..., 3) float
        m.

    References
    ----------
    bowring1976.
    """
    x, y, z = np.moveaxis(np.asarray(position, dtype=np.float64), -1, 0)
    across = np.hypot(x, y)
    axis_ratio = 1.0 - FLATTENING
    second = _ECCENTRICITY_SQUARED / axis_ratio**2
    reduced = np.arctan2(z, across * axis_ratio)
    phi = reduced
    for _ in range(_BOWRING_PASSES):
        phi = np.arctan2(
            z + second * SEMI_MAJOR_AXIS * axis_ratio * np.sin(reduced) ** 3,
            across - _ECCENTRICITY_SQUARED * SEMI_MAJOR_AXIS * np.cos(reduced) ** 3,
        )
        reduced = np.arctan2(axis_ratio * np.sin(phi), np.cos(phi))
    normal = SEMI_MAJOR_AXIS / np.sqrt(1.0 - _ECCENTRICITY_SQUARED * np.sin(phi) ** 2)
    # Stable at every latitude, unlike across / cos(phi).
    altitude = across * np.cos(phi) + z * np.sin(phi) - SEMI_MAJOR_AXIS**2 / normal
    return np.stack([np.degrees(phi), np.degrees(np.arctan2(y, x)), altitude], axis=-1)


def local_axes(latitude: npt.ArrayLike, longitude: npt.ArrayLike) -> Array:
    """Return (..., 3, 3) unit vectors east, north and up in earth-centred coordinates."""
    phi, lam = np.broadcast_arrays(np.radians(latitude), np.radians(longitude))
    zero = np.zeros(phi.shape)
    east = np.stack([-np.sin(lam), np.cos(lam), zero], axis=-1)
    north = np.stack([-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)], axis=-1)
    up = np.stack([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)], axis=-1)
    return np.stack([east, north, up], axis=-2)


def locate(beams: Sequence[Beam]) -> tuple[Array, Array]:
    """Return (beam, 3) positions (m) and unit directions in the frame of the first station.

    Each direction is rotated from the horizon of its own station to that of the first one. Over
    10 km these differ by 0.09 degree, or 16 m.

    Parameters
    ----------
    beams : sequence of Beam

    Returns
    -------
    origin, direction : (beam, 3) float64
        East, north, up.
    """
    values = inputs.real_array(
        [(b.latitude, b.longitude, b.altitude, b.azimuth, b.elevation) for b in beams], "beams"
    ).astype(np.float64)
    _check_beams(values)
    latitude, longitude, altitude, azimuth, elevation = values.T
    centred = to_earth_centred(latitude, longitude, altitude)
    axes = local_axes(latitude, longitude)
    azimuth, elevation = np.radians(azimuth), np.radians(elevation)
    horizontal = np.cos(elevation)
    station_direction = np.stack(
        [horizontal * np.sin(azimuth), horizontal * np.cos(azimuth), np.sin(elevation)], axis=-1
    )
    direction = np.einsum("rij,ri->rj", axes, station_direction)
    return (centred - centred[0]) @ axes[0].T, direction @ axes[0].T


# Crossings -----------------------------------------------------------------------------------


def build_network(
    beams: Sequence[Beam],
    *,
    tolerance: float = DEFAULT_TOLERANCE,
    nearest: float | Sequence[float] = 0.0,
    farthest: float | Sequence[float] = np.inf,
    smallest_angle: float = SMALLEST_CROSSING_ANGLE,
) -> Network:
    """Find the crossings where beams of stations meet. Results are cached by the arguments.

    Parameters
    ----------
    beams : sequence of Beam
    tolerance : float
        m; beams meet where they pass each other within this distance. Passages of several beams
        within it form one crossing. No crossing is nearer to a lidar than this.
    nearest, farthest : float or one per beam
        m, limits of the usable ranges of a beam: full overlap, and the end of its signal.
    smallest_angle : float
        degree; beams at smaller angles do not meet.

    Returns
    -------
    Network
        In the local frame of the first beam's station.

    Raises
    ------
    RetrievalInputError
        For positions or pointings out of bounds, and invalid settings.
    """
    return _network_of_beams(
        tuple(beams),
        float(tolerance),
        _per_beam(nearest, len(beams), "nearest"),
        _per_beam(farthest, len(beams), "farthest"),
        float(smallest_angle),
    )


def network_of_lines(
    origin: npt.ArrayLike,
    direction: npt.ArrayLike,
    *,
    tolerance: float = DEFAULT_TOLERANCE,
    nearest: float | Sequence[float] = 0.0,
    farthest: float | Sequence[float] = np.inf,
    smallest_angle: float = SMALLEST_CROSSING_ANGLE,
) -> Network:
    """Find the crossings of beams given in a local frame; otherwise as `build_network`.

    Parameters
    ----------
    origin, direction : (beam, 3) float
        Positions in m, and vectors of any length.
    """
    start = np.array(origin, dtype=np.float64)
    along = np.array(direction, dtype=np.float64)
    if start.ndim != 2 or start.shape[1:] != (3,) or start.shape != along.shape:
        raise RetrievalInputError(
            f"has the shape {along.shape}, origin {start.shape}",
            field="direction",
            remedy="give (beam, 3) for both",
        )
    length = np.linalg.norm(along, axis=1, keepdims=True)
    if not (np.isfinite(start).all() and np.isfinite(length).all() and (length > 0).all()):
        raise RetrievalInputError("is not finite, or zero", field="direction")
    limits = (
        _per_beam(nearest, len(start), "nearest"),
        _per_beam(farthest, len(start), "farthest"),
    )
    return _find_crossings(start, along / length, tolerance, limits, smallest_angle)


@lru_cache(maxsize=64)
def _network_of_beams(
    beams: tuple[Beam, ...],
    tolerance: float,
    nearest: tuple[float, ...],
    farthest: tuple[float, ...],
    smallest_angle: float,
) -> Network:
    if not beams:
        raise RetrievalInputError("are none", field="beams")
    origin, direction = locate(beams)
    network = _find_crossings(origin, direction, tolerance, (nearest, farthest), smallest_angle)
    axes = local_axes(beams[0].latitude, beams[0].longitude)
    first = to_earth_centred(beams[0].latitude, beams[0].longitude, beams[0].altitude)
    geodetic = to_geodetic(first + network.crossing @ axes)
    return _freeze(
        Network(
            network.origin, network.direction, network.crossing, network.miss_distance,
            network.crossing_angle, network.passages, network.near_crossing, geodetic,
        )
    )  # fmt: skip


def _find_crossings(
    origin: Array,
    direction: Array,
    tolerance: float,
    limits: tuple[tuple[float, ...], tuple[float, ...]],
    smallest_angle: float,
) -> Network:
    if not 0 < tolerance < np.inf:
        raise RetrievalInputError(f"is {tolerance} m", field="tolerance")
    if not 0 < smallest_angle < 90:
        raise RetrievalInputError(f"is {smallest_angle} degree", field="smallest_angle")
    if len(origin) > MOST_BEAMS:
        raise RetrievalInputError(
            f"are {len(origin)}, more than {MOST_BEAMS}", field="beams", remedy="split the network"
        )
    groups = _beam_groups(origin, direction, tolerance, limits, smallest_angle)
    points = [_closest_point(origin, direction, group) for group in groups]
    crossing = np.array(points).reshape(-1, 3)
    ranges = [
        [float(direction[b] @ (point - origin[b])) for b in group]
        for group, point in zip(groups, points, strict=True)
    ]
    order = sorted(range(len(groups)), key=lambda c: (min(ranges[c]), groups[c]))
    entries = sorted(
        (beam, along, number)
        for number, c in enumerate(order)
        for beam, along in zip(groups[c], ranges[c], strict=True)
    )
    passages = Passages(
        np.array([e[0] for e in entries], dtype=np.intp),
        np.array([e[2] for e in entries], dtype=np.intp),
        np.array([e[1] for e in entries], dtype=np.float64),
    )
    near = np.zeros(len(groups), dtype=np.bool_)
    goes_on = passages.beam[:-1] == passages.beam[1:]
    near[passages.crossing[:-1][goes_on]] = True
    return _freeze(
        Network(
            origin,
            direction,
            crossing[order],
            np.array([_miss_distance(origin, direction, groups[c], points[c]) for c in order]),
            np.array([_widest_angle(direction, groups[c]) for c in order]),
            passages,
            near,
        )
    )


def _beam_groups(
    origin: Array,
    direction: Array,
    tolerance: float,
    limits: tuple[tuple[float, ...], tuple[float, ...]],
    smallest_angle: float,
) -> list[tuple[int, ...]]:
    """Return the beams of each crossing: meeting pairs, merged where several meet at one place."""
    groups: list[tuple[int, ...]] = []
    for _, i, j in sorted(_meeting_pairs(origin, direction, tolerance, limits, smallest_angle)):
        point = _closest_point(origin, direction, (i, j))
        for index, group in enumerate(groups):
            merged = tuple(sorted({*group, i, j}))
            centre = _closest_point(origin, direction, group)
            if np.linalg.norm(centre - point) > 2.0 * tolerance:
                continue
            merged_centre = _closest_point(origin, direction, merged)
            if _miss_distance(origin, direction, merged, merged_centre) <= tolerance:
                groups[index] = merged
                break
        else:
            groups.append((i, j))
    return groups


def _meeting_pairs(
    origin: Array,
    direction: Array,
    tolerance: float,
    limits: tuple[tuple[float, ...], tuple[float, ...]],
    smallest_angle: float,
) -> list[tuple[float, int, int]]:
    """Return (nearer of both ranges, beam, beam) of each pair of beams that meet."""
    nearest = np.maximum(limits[0], tolerance)
    farthest = np.asarray(limits[1])
    pairs = []
    for i, j in itertools.combinations(range(len(origin)), 2):
        cosine = float(direction[i] @ direction[j])
        sine_squared = float(np.sum(np.cross(direction[i], direction[j]) ** 2))
        if sine_squared < np.sin(np.radians(smallest_angle)) ** 2:
            continue
        baseline = origin[j] - origin[i]
        on_i, on_j = float(direction[i] @ baseline), float(direction[j] @ baseline)
        range_i = (on_i - cosine * on_j) / sine_squared
        range_j = (cosine * on_i - on_j) / sine_squared
        miss = baseline + range_j * direction[j] - range_i * direction[i]
        inside = nearest[i] < range_i <= farthest[i] and nearest[j] < range_j <= farthest[j]
        if inside and float(miss @ miss) <= tolerance**2:
            pairs.append((min(range_i, range_j), i, j))
    return pairs


def _closest_point(origin: Array, direction: Array, beams: tuple[int, ...]) -> Array:
    """Return the point with the least sum of squared distances from beams."""
    matrix, side = np.zeros((3, 3)), np.zeros(3)
    for b in beams:
        projection = np.eye(3) - np.outer(direction[b], direction[b])
        matrix += projection
        # Relative to the first beam, to keep digits far from the origin of the frame.
        side += projection @ (origin[b] - origin[beams[0]])
    return np.asarray(np.linalg.solve(matrix, side) + origin[beams[0]])


def _miss_distance(origin: Array, direction: Array, beams: tuple[int, ...], point: Array) -> float:
    return max(float(np.linalg.norm(np.cross(direction[b], point - origin[b]))) for b in beams)


def _widest_angle(direction: Array, beams: tuple[int, ...]) -> float:
    return max(
        float(
            np.degrees(
                np.arctan2(
                    np.linalg.norm(np.cross(direction[i], direction[j])),
                    abs(direction[i] @ direction[j]),
                )
            )
        )
        for i, j in itertools.combinations(beams, 2)
    )


# Cycles -------------------------------------------------------------------------------------


def build_cycle(
    net: Network, beams: Sequence[int] | None = None, *, start: int | None = None
) -> Cycle:
    """Return the cycle of beams that meet pairwise, followed in the direction of attenuation.

    The cycle leads away from the lidars over a larger distance than towards them, so that the
    determinant of a homogeneous field is between 0 and 1. It starts at a crossing where both
    beams lead away from their lidars, if there is one: from a far start, every multiplier
    except 1 gives a useless estimate.

    Parameters
    ----------
    net : Network
    beams : sequence of int, optional
        Beams in their order around the cycle. By default, all beams of a network that is a
        single cycle.
    start : int, optional
        The crossing to solve for. By default, the most suitable one.

    Returns
    -------
    Cycle

    Raises
    ------
    RetrievalInputError
        If the beams form no cycle, or the start is not on it.
    """
    order = _single_cycle(net) if beams is None else [int(b) for b in beams]
    if len(order) < 3 or len(set(order)) != len(order) or not set(order) <= set(range(net.beams)):
        raise RetrievalInputError(
            f"are {order}", field="beams", remedy="give at least 3 different beams of the network"
        )
    k = len(order)
    shared = [_shared_crossing(net, order[j - 1], order[j]) for j in range(k)]
    if len(set(shared)) != k:
        raise RetrievalInputError(f"{order} meet in one place", field="beams")
    lengths = [
        _range_on_beam(net, order[j], shared[(j + 1) % k])
        - _range_on_beam(net, order[j], shared[j])
        for j in range(k)
    ]
    if sum(lengths) < 0:
        # Backwards, row j follows the same beam from its last crossing to its first.
        order, shared = order[::-1], [shared[(j + 1) % k] for j in range(k)][::-1]
        lengths = [-length for length in lengths[::-1]]
    first = _start_row(lengths, shared, start)
    order, shared = order[first:] + order[:first], shared[first:] + shared[:first]
    return Cycle(
        np.array(order, dtype=np.intp),
        np.array(shared, dtype=np.intp),
        np.array([_range_on_beam(net, order[j], shared[j]) for j in range(k)]),
        np.array([_range_on_beam(net, order[j], shared[(j + 1) % k]) for j in range(k)]),
    )


def _start_row(lengths: list[float], shared: list[int], start: int | None) -> int:
    if start is None:
        k = len(lengths)
        return max(range(k), key=lambda j: (lengths[j] > 0, lengths[j - 1] < 0, lengths[j], -j))
    if start not in shared:
        raise RetrievalInputError(
            f"{start} is not on the cycle", field="start", remedy=f"choose one of {shared}"
        )
    return shared.index(start)


def _single_cycle(net: Network) -> list[int]:
    crossings_on_beam = np.bincount(net.passages.beam, minlength=net.beams)
    beams_at_crossing = np.bincount(net.passages.crossing, minlength=net.crossings)
    if net.beams < 3 or np.any(crossings_on_beam != 2) or np.any(beams_at_crossing != 2):
        raise RetrievalInputError(
            "are not one cycle, with two crossings on every beam and two beams at every crossing",
            field="beams",
            remedy="give the beams of a cycle in their order, or use the method 'network'",
        )
    order, crossing = [0], int(net.on_beam(0)[0][0])
    while True:
        meeting_beams = net.passages.beam[net.passages.crossing == crossing]
        beam = int(meeting_beams[meeting_beams != order[-1]][0])
        if beam == order[0]:
            break
        order.append(beam)
        ends = net.on_beam(beam)[0]
        crossing = int(ends[ends != crossing][0])
    if len(order) != net.beams:
        raise RetrievalInputError(
            "form several cycles", field="beams", remedy="give the beams of one of them"
        )
    return order


def _shared_crossing(net: Network, first: int, second: int) -> int:
    shared = np.intersect1d(net.on_beam(first)[0], net.on_beam(second)[0])
    if shared.size != 1:
        raise RetrievalInputError(f"{first} and {second} do not meet", field="beams")
    return int(shared[0])


def _range_on_beam(net: Network, beam: int, crossing: int) -> float:
    crossings, ranges = net.on_beam(beam)
    return float(ranges[crossings == crossing][0])


# Checks -------------------------------------------------------------------------------------


def _check_beams(values: Array) -> None:
    bounds = {
        "latitude": (-90.0, 90.0),
        "longitude": (-360.0, 360.0),
        "altitude": (-1000.0, 100_000.0),
        "azimuth": (-360.0, 360.0),
        "elevation": (-90.0, 90.0),
    }
    for (name, (low, high)), column in zip(bounds.items(), values.T, strict=True):
        outside = ~((column >= low) & (column <= high))
        if outside.any():
            raise RetrievalInputError(
                f"of beam {int(np.argmax(outside))} is {column[outside][0]}",
                field=name,
                remedy=f"give a value from {low:g} to {high:g}",
            )


def _per_beam(value: float | Sequence[float], beams: int, name: str) -> tuple[float, ...]:
    values = np.asarray(value, dtype=np.float64)
    if values.ndim > 1 or (values.ndim == 1 and values.size != beams):
        raise RetrievalInputError(
            f"has the shape {values.shape}",
            field=name,
            remedy=f"give one, or one per beam ({beams})",
        )
    if np.any(np.isnan(values)) or np.any(values < 0):
        raise RetrievalInputError("is negative or NaN", field=name)
    return tuple(float(v) for v in np.broadcast_to(values, (beams,)))


def _freeze(net: Network) -> Network:
    passages = net.passages
    for array in (
        net.origin, net.direction, net.crossing, net.miss_distance, net.crossing_angle,
        net.near_crossing, net.geodetic, passages.beam, passages.crossing, passages.range,
    ):  # fmt: skip
        if array is not None:
            array.setflags(write=False)
    return net
