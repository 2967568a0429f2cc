"""Geometry of a network: crossings of the beams from the stations and pointings of the lidars.

Beams are straight lines: refraction bends a beam by less than 1 m in 10 km of horizontal air.
Heights are above the ellipsoid. A height error common to all stations (the geoid) shifts all
crossings alike.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Booleans, Indices
from lidarops.retrieve.network.settings import NetworkAssumptions
from lidarops.retrieve.network.thresholds import THRESHOLDS

SEMI_MAJOR_AXIS: Final = 6_378_137.0
"""m, WGS84 (`wgs84`)."""
FLATTENING: Final = 1.0 / 298.257223563
"""1, WGS84 (`wgs84`)."""
_ECCENTRICITY_SQUARED: Final = FLATTENING * (2.0 - FLATTENING)
_BOWRING_PASSES: Final = 6
"""Passes of Bowring's iteration. Below 100 km, 3 passes are exact to rounding."""


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
    tolerance: float = NetworkAssumptions.tolerance,
    nearest: float | Sequence[float] = 0.0,
    farthest: float | Sequence[float] = np.inf,
    smallest_angle: float = NetworkAssumptions.smallest_angle,
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
        tuple(per_beam(nearest, len(beams), "nearest").tolist()),
        tuple(per_beam(farthest, len(beams), "farthest").tolist()),
        float(smallest_angle),
    )


def network_of_lines(
    origin: npt.ArrayLike,
    direction: npt.ArrayLike,
    *,
    tolerance: float = NetworkAssumptions.tolerance,
    nearest: float | Sequence[float] = 0.0,
    farthest: float | Sequence[float] = np.inf,
    smallest_angle: float = NetworkAssumptions.smallest_angle,
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
    limits = per_beam(nearest, len(start), "nearest"), per_beam(farthest, len(start), "farthest")
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
    limits = np.array(nearest), np.array(farthest)
    network = _find_crossings(origin, direction, tolerance, limits, smallest_angle)
    axes = local_axes(beams[0].latitude, beams[0].longitude)
    first = to_earth_centred(beams[0].latitude, beams[0].longitude, beams[0].altitude)
    return _freeze(replace(network, geodetic=to_geodetic(first + network.crossing @ axes)))


def _find_crossings(
    origin: Array,
    direction: Array,
    tolerance: float,
    limits: tuple[Array, Array],
    smallest_angle: float,
) -> Network:
    if not 0 < tolerance < np.inf:
        raise RetrievalInputError(f"is {tolerance} m", field="tolerance")
    if not 0 < smallest_angle < 90:
        raise RetrievalInputError(f"is {smallest_angle} degree", field="smallest_angle")
    if len(origin) > THRESHOLDS.most_beams:
        raise RetrievalInputError(
            f"are {len(origin)}, more than {THRESHOLDS.most_beams}",
            field="beams",
            remedy="split the network",
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
    return _freeze(Network(origin, direction, crossing[order], passages, near))


def _beam_groups(
    origin: Array,
    direction: Array,
    tolerance: float,
    limits: tuple[Array, Array],
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
    limits: tuple[Array, Array],
    smallest_angle: float,
) -> list[tuple[float, int, int]]:
    """Return (nearer of both ranges, beam, beam) of each pair of beams that meet."""
    nearest, farthest = np.maximum(limits[0], tolerance), limits[1]
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


def per_beam(
    values: npt.ArrayLike, beams: int, name: str, low: float = 0.0, high: float = np.inf
) -> Array:
    """Return one value per beam, which lie within limits.

    Raises
    ------
    RetrievalInputError
        Where they do not, or are neither one nor as many as the beams.
    """
    array = inputs.real_array(values, name).astype(np.float64)
    if array.shape not in {(), (beams,)} or not np.all((array >= low) & (array <= high)):
        raise RetrievalInputError(
            f"is not from {low:g} to {high:g}, or of a wrong shape",
            field=name,
            remedy=f"give one value, or one per beam ({beams})",
        )
    return np.broadcast_to(array, (beams,)).copy()


def _freeze(net: Network) -> Network:
    passages = net.passages
    for array in (
        net.origin, net.direction, net.crossing, net.near_crossing, net.geodetic,
        passages.beam, passages.crossing, passages.range,
    ):  # fmt: skip
        if array is not None:
            array.setflags(write=False)
    return net
