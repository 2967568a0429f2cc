"""Coordinates of a product in time and space, of the air along a beam too, and their extents."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC
from typing import Any, Final, NamedTuple

import numpy as np
import xarray as xr

from lidarops.errors import ProductError
from lidarops.netcdf.context import Context, duration, iso
from lidarops.netcdf.encoding import Values, check_range, taken, whole_numbers
from lidarops.netcdf.variables import BOUNDS_DIM, SOUNDED, Layout, Row, attributes, deployment

NEAR_VERTICAL: Final = 10.0
"""degree. A beam within this angle of the vertical gives profiles in the sense of CF chapter 9."""

_SAME_STEP: Final = 1e-6
"""Relative difference up to which vertical steps are equal."""
_LEVEL: Final = 1e-6
"""m; vertical step of a level beam: cos(90 degrees) is 6e-17, and 1e-3 degree more gives 1e-4 m."""
_EPOCH: Final = np.datetime64("1970-01-01T00:00:00", "ns")
_NAMES_IN: Final = (
    ("coordinates", "altitude", "range"),
    ("cell_methods", "range:", "altitude:"),
)
"""Attribute, and the name in it that another one takes the place of along altitude."""
EQUATOR: Final = 6_378_137.0
"""m, semi-major axis of WGS 84."""
_FLATTENING: Final = 1.0 / 298.257223563
_ECCENTRICITY: Final = _FLATTENING * (2.0 - _FLATTENING)
"""Square of the first eccentricity."""


@dataclass(frozen=True, slots=True)
class Coordinate:
    """A coordinate as stored, with its cell bounds if it has any."""

    row: Row
    dims: tuple[str, ...]
    values: Values
    bounds: Values | None = None
    moving: Callable[[slice], Values] | None = None
    """Where the beam moves: what gives the values of some profiles. Of these, `values` has only
    shape and type."""


class Located(NamedTuple):
    """The coordinates of a product, and what follows from them."""

    variables: dict[str, xr.Variable]
    """In the order of the file, with cell bounds."""
    moving: dict[str, Callable[[slice], Values]]
    """See `Coordinate.moving`."""
    extents: dict[str, Any]
    """Global attributes on the extents in space and time."""
    vertical: bool
    """Whether the beam is fixed and near the vertical, as CF profiles require."""


def locate_product(source: xr.Dataset, layout: Layout, context: Context) -> Located:
    """Return the coordinates of a product in the order of its layout, and what follows from them.

    Raises
    ------
    ProductError
        If a coordinate is missing, not finite, not rising, or outside its cell bounds.
    """
    time, moments, bounds = _time(source, layout.rows["time"])
    station = context.station
    place = _PLACES.get(layout.sampled, _beam_place)
    by_name, vertical = place(source, layout, station.altitude)
    by_name["time"] = time
    bins = {} if vertical.profiles else _air_positions(by_name, layout, context)
    fixed = {
        "latitude": station.latitude,
        "longitude": station.longitude,
        "station_altitude": station.altitude,
        # Rounded, because metres times 1e9 is not exactly 532.
        "wavelength": round(context.wavelength * 1e9, 6),
    }
    for name, value in fixed.items():
        if name not in by_name and name in layout.rows and np.isfinite(value):
            row = layout.rows[name]
            row = deployment(row) if f"bin_{name}" in bins else row
            by_name[name] = Coordinate(row, (), np.asarray(value, np.float64))
    by_name |= bins
    variables, moving = {}, {}
    for coordinate in (by_name[row.name] for row in layout.coordinates if row.name in by_name):
        row, dims = coordinate.row, coordinate.dims
        check_range(row, coordinate.values)
        attrs = attributes(row, mode=context.mode)
        variables[row.name] = xr.Variable(dims, coordinate.values, attrs)
        if coordinate.moving is not None:
            moving[row.name] = coordinate.moving
        if row.bounds and coordinate.bounds is not None:
            variables[row.bounds] = xr.Variable((*dims, BOUNDS_DIM), coordinate.bounds)
    horizontal = [
        bins[f"bin_{name}"].values if bins else by_name[name].values
        for name in ("latitude", "longitude")
    ]
    of_network = layout.sampled == "crossing"
    spread = "irregular: crossings of beams" if of_network else "along the beam"
    extents = _extents(horizontal, spread, vertical, moments, bounds)
    return Located(variables, moving, extents, vertical.profiles)


def auxiliary_names(row: Row, coordinates: Mapping[str, xr.Variable]) -> tuple[str, ...]:
    """Return the names of the auxiliary coordinates of a variable, among those of its file."""
    # CDO 2.1 cannot read a position that changes along a beam, nor a variable of three dimensions
    # with a scalar position, nor one over beams beside another with a scalar position.
    excluded = tuple(position.name for position in SOUNDED)
    if len(row.dims) > 2 or row.dims == ("time", "beam"):
        excluded += ("latitude", "longitude")
    return tuple(
        name
        for name, coordinate in coordinates.items()
        if coordinate.dims != (name,)
        and set(coordinate.dims) <= set(row.dims)
        and name not in excluded
    )


def on_altitude(variables: Mapping[str, xr.Variable]) -> dict[str, xr.Variable]:
    """Return the variables of a product as they are written: of a vertical lidar along altitude.

    ``altitude`` is then the dimension and its coordinate, so that any tool selects values by it,
    and ``range`` an auxiliary coordinate. What reads products takes them back to ``range``
    (`lidarops.netcdf.stored.StoredProduct`).

    Parameters
    ----------
    variables : mapping of str to xr.Variable
        All of the product; coordinates that do not change with time are in memory.

    Returns
    -------
    dict of str to xr.Variable
        Those of a beam that moves, or is more than `NEAR_VERTICAL` off the zenith, as they are.
    """
    zenith, altitude = (variables.get(name) for name in ("zenith_angle", "altitude"))
    written = dict(variables)
    if zenith is None or altitude is None or altitude.dims != ("range",):
        return written
    if zenith.values > NEAR_VERTICAL or (np.diff(altitude.values) <= 0.0).any():
        return written
    for name, variable in variables.items():
        if "range" in variable.dims:
            dims = ["altitude" if dim == "range" else dim for dim in variable.dims]
            attrs = dict(variable.attrs)
            for key, old, new in _NAMES_IN:
                if key in attrs:
                    words = (new if word == old else word for word in attrs[key].split())
                    attrs[key] = " ".join(words)
            written[name] = xr.Variable(dims, variable.data, attrs)
    return written


class _Vertical(NamedTuple):
    """Vertical coverage of a product."""

    altitude: Values
    """m, as stored; the lowest, the highest and any others."""
    step: float | None
    """m, between neighbouring values; None where it varies."""
    profiles: bool
    """Whether the beam is fixed and near the vertical, as CF profiles require."""


_Place = tuple[dict[str, Coordinate], _Vertical]


def _beam_place(source: xr.Dataset, layout: Layout, station: float) -> _Place:
    """Return the coordinates of a kind whose values lie along the beam."""
    names = _names_along(layout)
    by_name = {name: _along(source, layout.rows[name]) for name in names}
    zenith = _beam(source, layout.rows["zenith_angle"])
    altitude, vertical = _altitude(layout.rows["altitude"], by_name[names[-1]], zenith, station)
    by_name |= {"altitude": altitude, "zenith_angle": zenith}
    if "azimuth" in source:
        by_name["azimuth"] = _beam(source, layout.rows["azimuth"])
    return by_name, vertical


def _air_positions(
    by_name: Mapping[str, Coordinate], layout: Layout, context: Context
) -> dict[str, Coordinate]:
    """Return latitude and longitude of the air along a fixed slant beam of known azimuth."""
    if "bin_latitude" not in layout.rows or "azimuth" not in by_name:
        return {}
    # No tool reads positions that also change over time: CDO reads garbage.
    if by_name["zenith_angle"].dims or by_name["azimuth"].dims:
        return {}
    station = context.station
    along = by_name[_names_along(layout)[-1]]
    zenith, azimuth = (by_name[name].values for name in ("zenith_angle", "azimuth"))
    angle = np.deg2rad(zenith)
    ahead, up = along.values * np.sin(angle), along.values * np.cos(angle)
    positions = beam_positions(
        station.latitude, station.longitude, station.altitude, ahead, azimuth, up
    )
    rows = (layout.rows[name] for name in ("bin_latitude", "bin_longitude"))
    return {
        row.name: Coordinate(row, row.dims, values.astype(row.dtype))
        for row, values in zip(rows, positions, strict=True)
    }


def _scan_place(source: xr.Dataset, layout: Layout, station: float) -> _Place:
    """Return the coordinates of a kind whose values lie at altitudes of a scan."""
    names = ["beam", "beam_zenith_angle"]
    # Layers, planes and the baseline are optional, and so are their coordinates.
    optional = ("beam_azimuth", "layer_altitude", "plane", "plane_azimuth", "baseline_range")
    names += [name for name in optional if name in source]
    by_name = {name: _along(source, layout.rows[name]) for name in names}
    row = layout.rows["altitude"]
    values = _along(source, replace(row, bounds=None)).values
    if values[0] <= station:
        raise ProductError(
            f"begins at {values[0]:g} m, but the station is at {station:g} m", field=row.name
        )
    tops = np.append(station, values)
    by_name["altitude"] = _with_bounds(row, values, np.stack([tops[:-1], tops[1:]], axis=-1))
    return by_name, _Vertical(values, _common_step(values, np.ones(1)), profiles=False)


def _network_place(source: xr.Dataset, layout: Layout, _station: float) -> _Place:
    """Return the coordinates of a kind whose values lie at crossings of beams."""
    angles = ("latitude", "longitude", "altitude", "zenith_angle", "azimuth")
    beams = (f"beam_{name}" for name in angles)
    names = ("crossing_id", "latitude", "longitude", "altitude", "beam", *beams)
    by_name = {name: _along(source, layout.rows[name]) for name in names}
    altitude = by_name["altitude"].values
    # Crossings are not ordered by altitude, so there is no vertical step.
    return by_name, _Vertical(altitude, None, profiles=False)


_PLACES: Final = {"altitude": _scan_place, "crossing": _network_place}
"""Dimension besides time -> function that returns the coordinates; else `_beam_place`."""


def _names_along(layout: Layout) -> list[str]:
    """Return the coordinates along the beam, of which the last holds metres."""
    along = (row for row in layout.coordinates if row.dims == (layout.sampled,))
    return [row.name for row in along if not row.follows_beam]


def _time(source: xr.Dataset, row: Row) -> tuple[Coordinate, Values, Values]:
    """Return the coordinate, and the times and their bounds (datetime64[ns])."""
    times = []
    for name, dims in ((row.name, row.dims), (f"{row.bounds}", (*row.dims, BOUNDS_DIM))):
        values = taken(source, name, dims)
        if values.dtype.kind != "M":
            raise ProductError(f"has data of type {values.dtype}, not datetime64", field=name)
        times.append(values.astype("datetime64[ns]"))
    moments, bounds = times
    if np.isnat(moments).any() or np.isnat(bounds).any():
        raise ProductError("holds missing times", field=row.name)
    if (np.diff(moments) <= np.timedelta64(0)).any():
        raise ProductError(
            "does not rise strictly",
            field=row.name,
            remedy="sort the profiles by time, and keep one of those at the same time",
        )
    seconds = ((values - _EPOCH) / np.timedelta64(1, "s") for values in times)
    return _with_bounds(row, *seconds), moments, bounds


def _along(source: xr.Dataset, row: Row) -> Coordinate:
    values = taken(source, row.name, row.dims)
    values = whole_numbers(row, values) if row.dtype.startswith("i") else _finite(row.name, values)
    # Sections may overlap, so their midpoints may come in any order.
    if row.dims == (row.name,) and (np.diff(values) <= 0).any():
        raise ProductError("does not rise strictly", field=row.name)
    if row.bounds is None:
        return Coordinate(row, row.dims, values)
    if row.bounds in source:
        bounds = _finite(row.bounds, taken(source, row.bounds, (*row.dims, BOUNDS_DIM)))
    elif row.dims == (row.name,):
        bounds = _midpoints(row, values)
    else:
        # Sections may overlap or leave gaps: their ends do not follow from their midpoints.
        raise ProductError("is missing", field=row.bounds)
    return _with_bounds(row, values, bounds)


def _finite(name: str, values: Values) -> Values:
    if values.dtype.kind == "M" or not np.isfinite(values).all():
        raise ProductError("holds values that are not finite numbers", field=name)
    return values.astype(np.float64)


def _midpoints(row: Row, values: Values) -> Values:
    if values.size < 2:
        raise ProductError(
            "is missing, and cannot be derived from a single value",
            field=row.bounds,
            remedy="give the cell bounds",
        )
    inner = (values[1:] + values[:-1]) / 2
    first, last = 2 * values[0] - inner[0], 2 * values[-1] - inner[-1]
    edges = np.concatenate([[first], inner, [last]])
    return np.stack([edges[:-1], edges[1:]], axis=-1)


def _with_bounds(row: Row, values: Values, bounds: Values) -> Coordinate:
    if bounds.shape[-1] != 2:
        raise ProductError(f"has {bounds.shape[-1]} bounds a cell, not 2", field=row.bounds)
    if ((bounds[..., 0] > values) | (values > bounds[..., 1])).any():
        raise ProductError(f"does not enclose {row.name}", field=row.bounds)
    return Coordinate(row, row.dims, values, bounds)


def _beam(source: xr.Dataset, row: Row) -> Coordinate:
    """Return an angle of the beam: one number for a fixed beam, else over time."""
    dims = ("time",) if row.name in source and source[row.name].dims else ()
    values = _finite(row.name, taken(source, row.name, dims))
    if (values == values.flat[0]).all():
        return Coordinate(row, (), values.flat[0][...])
    return Coordinate(row, ("time",), values)


def _altitude(
    row: Row, along: Coordinate, zenith: Coordinate, station: float
) -> tuple[Coordinate, _Vertical]:
    """Return the altitude along a beam, and its vertical coverage."""
    ranges, rise = along.values, np.asarray(np.cos(np.deg2rad(zenith.values)))
    # Rounding keeps the order, so the extremes lie at those of both factors.
    ends = np.multiply.outer([rise.min(), rise.max()], [ranges.min(), ranges.max()])
    extremes = (station + ends).astype(row.dtype)
    step = _common_step(ranges, rise)
    if zenith.dims:
        # Cell bounds that also change with time would have to be polygons (CF, section 7.1).
        row = replace(row, bounds=None)

        def moving(profiles: slice) -> Values:
            altitude: Values = station + rise[profiles, np.newaxis] * ranges
            return altitude.astype(row.dtype)

        declared = np.broadcast_to(np.zeros((), row.dtype), (*rise.shape, *ranges.shape))
        altitude = Coordinate(row, (*zenith.dims, *row.dims), declared, moving=moving)
        return altitude, _Vertical(extremes, step, profiles=False)
    bounds = None
    if row.bounds and along.bounds is not None:
        bounds = (station + rise * along.bounds).astype(row.dtype)
    else:
        row = replace(row, bounds=None)
    tilt = min(zenith.values.flat[0], 180.0 - zenith.values.flat[0])
    altitude = Coordinate(row, row.dims, (station + rise * ranges).astype(row.dtype), bounds)
    return altitude, _Vertical(extremes, step, profiles=bool(tilt <= NEAR_VERTICAL))


def _common_step(altitude: Values, rise: Values) -> float | None:
    """Return the distance of neighbouring altitudes of all profiles, m.

    0 where the altitude does not change; None where the distance varies.

    Parameters
    ----------
    altitude : ndarray
        Altitudes of a beam to the zenith, m.
    rise : ndarray
        Altitude of each profile over these.
    """
    steps, scales = np.abs(np.diff(altitude)), np.abs(rise)
    if steps.size == 0:
        return None
    smallest, largest = scales.min() * steps.min(), scales.max() * steps.max()
    if largest <= _LEVEL:
        return 0.0
    return None if largest - smallest > _SAME_STEP * largest else float(scales.flat[0] * steps[0])


def _extents(
    positions: Sequence[Values], spread: str, vertical: _Vertical, moments: Values, bounds: Values
) -> dict[str, Any]:
    """Return the attributes on extents, of the area also as WKT: a point, or a rectangle."""
    (south, north), (west, east) = ((float(p.min()), float(p.max())) for p in positions)
    area = f"POINT ({south!r} {west!r})"
    if (south, west) != (north, east):
        corners = ((south, west), (south, east), (north, east), (north, west), (south, west))
        area = f"POLYGON (({', '.join(f'{lat!r} {lon!r}' for lat, lon in corners)}))"
    else:
        spread = "not applicable: single position"
    # ACDD wants the resolution in every file.
    resolution = f"{vertical.step:.6g} m" if vertical.step else "none: the beam is level"
    ends = bounds[:, 0].min(), bounds[:, 1].max()
    start, stop = (end.astype("datetime64[us]").item().replace(tzinfo=UTC) for end in ends)
    intervals = np.diff(moments) if moments.size > 1 else bounds[:, 1] - bounds[:, 0]
    return {
        # Latitude first: the order of axes that EPSG:4326 defines.
        "geospatial_bounds": area,
        "geospatial_bounds_crs": "EPSG:4326",
        "geospatial_bounds_vertical_crs": "EPSG:5714",
        "geospatial_lat_min": south,
        "geospatial_lat_max": north,
        "geospatial_lat_units": "degrees_north",
        "geospatial_lat_resolution": spread,
        "geospatial_lon_min": west,
        "geospatial_lon_max": east,
        "geospatial_lon_units": "degrees_east",
        "geospatial_lon_resolution": spread,
        "geospatial_vertical_min": float(vertical.altitude.min()),
        "geospatial_vertical_max": float(vertical.altitude.max()),
        "geospatial_vertical_units": "m",
        "geospatial_vertical_positive": "up",
        "geospatial_vertical_resolution": "not constant" if vertical.step is None else resolution,
        "time_coverage_start": iso(start),
        "time_coverage_end": iso(stop),
        "time_coverage_duration": duration((stop - start).total_seconds()),
        "time_coverage_resolution": duration(float(np.median(intervals / np.timedelta64(1, "s")))),
    }


def beam_positions(
    latitude: float, longitude: float, altitude: float, ahead: Values, azimuth: Values, up: Values
) -> tuple[Values, Values]:
    r"""Return latitude and longitude of points on a straight beam.

    .. math:: x = x_0 + E (s \sin a,\; s \cos a,\; u)^T

    in Cartesian coordinates of the Earth, with the matrix E of the directions east, north and up
    at the station, horizontal distance s and height u of the point, and azimuth a; then converted
    to geodetic latitude by Bowring's formula, with an error below 1 mm.

    Parameters
    ----------
    latitude, longitude : float
        Position of the station, degree.
    altitude : float
        Altitude of the station, m; the geoid is taken as the ellipsoid.
    ahead : ndarray
        Horizontal distance from the station, in its tangent plane, m.
    azimuth : ndarray
        degree, clockwise from north; broadcast against `ahead`.
    up : ndarray
        Distance above the tangent plane of the station, m; broadcast against `ahead`.

    Returns
    -------
    latitude, longitude : ndarray
        degree; longitude from -180 to 180.
    """
    lat, lon, direction = np.deg2rad(latitude), np.deg2rad(longitude), np.deg2rad(azimuth)
    east, north = ahead * np.sin(direction), ahead * np.cos(direction)
    curvature = EQUATOR / np.sqrt(1.0 - _ECCENTRICITY * np.sin(lat) ** 2)
    # Relative to the meridian of the station, so that the longitude difference is small.
    outward = (curvature + altitude) * np.cos(lat) - north * np.sin(lat) + up * np.cos(lat)
    axis = (
        (curvature * (1.0 - _ECCENTRICITY) + altitude) * np.sin(lat)
        + north * np.cos(lat)
        + up * np.sin(lat)
    )
    across = np.hypot(outward, east)
    polar = EQUATOR * (1.0 - _FLATTENING)
    reduced = np.arctan2(axis * EQUATOR, across * polar)
    second = _ECCENTRICITY / (1.0 - _ECCENTRICITY)
    geodetic = np.arctan2(
        axis + second * polar * np.sin(reduced) ** 3,
        across - _ECCENTRICITY * EQUATOR * np.cos(reduced) ** 3,
    )
    turned = np.rad2deg(lon + np.arctan2(east, outward))
    return np.rad2deg(geodetic), (turned + 180.0) % 360.0 - 180.0
