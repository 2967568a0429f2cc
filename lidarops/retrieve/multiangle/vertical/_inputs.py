"""Validation of the inputs of the vertical solution, and their form for the kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.retrieve.common.inputs import real_array
from lidarops.retrieve.multiangle.vertical._correlation import LAGS, ResidualMoments

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

LARGEST_DEPTH: Final = 1e6
"""Optical depth beyond which an estimate counts as missing."""
_INFORMATION: Final = (1e-16, 1e16)
"""Information below which an estimate counts as missing, and its upper limit."""
_UNIFORM: Final = 1e-3
"""Largest relative deviation of a step from the mean step; allows for rounded altitudes."""


@dataclass(frozen=True, slots=True)
class VerticalProblem:
    """Valid estimates of single altitudes."""

    optical_depth: Array
    """(profile, altitude), 0 where there is no estimate."""
    information: Array
    """(profile, altitude), 0 where there is no estimate."""
    altitude: Array
    """(altitude,) m."""
    station_altitude: float
    """m."""


def matrix(values: npt.ArrayLike, name: str, shape: tuple[int, ...]) -> Array:
    """Return a contiguous float64 array of `shape`, broadcast along profiles.

    Raises
    ------
    RetrievalInputError
        For a shape that does not broadcast to it.
    """
    array = real_array(values, name).astype(np.float64, copy=False)
    try:
        return np.ascontiguousarray(np.broadcast_to(array, shape))
    except ValueError:
        raise RetrievalInputError(
            f"has the shape {array.shape}, not {shape}",
            field=name,
            remedy="give (profile, altitude), as for the optical depth",
        ) from None


def beams(*arrays: npt.ArrayLike) -> tuple[Array, Array, Array]:
    """Return residual, weight and leverage as contiguous (profile, beam, altitude) float64.

    Raises
    ------
    RetrievalInputError
        For arrays that do not have three axes and the same shape.
    """
    first, second, third = (
        np.ascontiguousarray(real_array(values, name), dtype=np.float64)
        for values, name in zip(arrays, ("residual", "weight", "leverage"), strict=True)
    )
    for array, name in ((first, "residual"), (second, "weight"), (third, "leverage")):
        if array.ndim != 3 or array.shape != first.shape:
            raise RetrievalInputError(
                f"has the shape {array.shape}",
                field=name,
                remedy="give (profile, beam, altitude), the same for residual, weight and leverage",
            )
    return first, second, third


def vertical_problem(
    optical_depth: npt.ArrayLike,
    information: npt.ArrayLike,
    altitude: npt.ArrayLike,
    station_altitude: float,
) -> VerticalProblem:
    """Validate the input of `smooth_profile.smooth_optical_depth` and drop invalid estimates.

    Raises
    ------
    RetrievalInputError
        For inconsistent shapes, negative information or an invalid altitude axis.
    """
    depth = np.array(real_array(optical_depth, "optical_depth"), dtype=np.float64)
    if depth.ndim != 2:
        raise RetrievalInputError(
            f"has the shape {depth.shape}",
            field="optical_depth",
            remedy="give (profile, altitude)",
        )
    grid, station = _grid(altitude, station_altitude)
    if depth.shape[1] != grid.size:
        raise RetrievalInputError(
            f"has {depth.shape[1]} altitudes, but altitude has {grid.size}",
            field="optical_depth",
            remedy="the last axis of optical_depth is altitude",
        )
    weight = matrix(information, "information", depth.shape).copy()
    if np.any(weight < 0.0):
        raise RetrievalInputError(
            "is negative", field="information", remedy="give reciprocal variances"
        )
    weight[~np.isfinite(weight) | (weight < _INFORMATION[0])] = 0.0
    weight[~np.isfinite(depth) | (np.abs(depth) > LARGEST_DEPTH)] = 0.0
    depth[weight == 0.0] = 0.0
    return VerticalProblem(depth, np.minimum(weight, _INFORMATION[1]), grid, station)


def _grid(altitude: npt.ArrayLike, station_altitude: float) -> tuple[Array, float]:
    grid = np.ascontiguousarray(real_array(altitude, "altitude"), dtype=np.float64)
    if grid.ndim != 1 or grid.size == 0 or not np.all(np.isfinite(grid)):
        raise RetrievalInputError(
            "is not a finite axis", field="altitude", remedy="give a list of values in m"
        )
    station = finite(station_altitude, "station_altitude")
    if not grid[0] > station:
        raise RetrievalInputError(
            f"starts at {grid[0]:g} m, not above the lidar at {station:g} m",
            field="altitude",
            remedy="remove the altitudes at and below the lidar",
        )
    steps = np.diff(grid)
    mean = (grid[-1] - grid[0]) / max(steps.size, 1)
    if np.any(steps <= 0.0) or np.any(np.abs(steps - mean) > _UNIFORM * mean):
        raise RetrievalInputError(
            "is not uniform and ascending",
            field="altitude",
            remedy="interpolate the signals to a uniform grid",
        )
    return grid, station


def finite(value: float, name: str, *, least: float = -np.inf) -> float:
    """Return a finite number of at least `least`.

    Raises
    ------
    RetrievalInputError
        For any other value.
    """
    number = real_array(value, name).astype(np.float64)
    if number.ndim != 0 or not np.isfinite(number) or number < least:
        raise RetrievalInputError(
            f"is {value!r}", field=name, remedy=f"give one finite number of at least {least:g}"
        )
    return float(number)


def labels(block: npt.ArrayLike | None, profiles: int) -> npt.NDArray[Any]:
    """Return the label of the block of every profile.

    Raises
    ------
    RetrievalInputError
        For labels that are not one whole number per profile.
    """
    array = np.zeros(profiles, dtype=np.int64) if block is None else np.asarray(block)
    if array.shape != (profiles,) or (array.dtype.kind not in "iu" and array.size):
        raise RetrievalInputError(
            f"has the shape {array.shape} of {array.dtype}",
            field="block",
            remedy=f"give one whole number for each of the {profiles} profiles",
        )
    return array


def validated_moments(moments: ResidualMoments, problem: VerticalProblem) -> ResidualMoments:
    """Return residual moments after validation of their shapes.

    Raises
    ------
    RetrievalInputError
        For moments of other profiles or altitudes.
    """
    profiles = problem.optical_depth.shape[0]
    shapes: dict[str, tuple[int, ...]] = {
        "lag_products": (profiles, LAGS),
        "lag_norms": (profiles, LAGS),
        "inhomogeneity_share": problem.optical_depth.shape,
        "degrees_of_freedom": problem.optical_depth.shape,
        "gaps": (profiles,),
    }
    for name, shape in shapes.items():
        if getattr(moments, name).shape != shape:
            raise RetrievalInputError(
                f"has the shape {getattr(moments, name).shape}, not {shape}",
                field=f"residuals.{name}",
                remedy="call residual_moments with the same profiles",
            )
    return moments


def layer(altitude: Array, station_altitude: float, bottom: float, top: float) -> tuple[int, int]:
    """Return the indices of the altitudes nearest to the bounds of a layer, -1 the station.

    Raises
    ------
    RetrievalInputError
        For a bound outside the grid, or bounds not in order.
    """
    levels = np.concatenate([[station_altitude], altitude])
    half = 0.5 * (altitude[1] - altitude[0] if altitude.size > 1 else 0.0)
    indices = []
    for value, name in ((bottom, "bottom"), (top, "top")):
        level = finite(value, name)
        nearest = int(np.argmin(np.abs(levels - level)))
        if abs(levels[nearest] - level) > half * (1.0 + _UNIFORM):
            raise RetrievalInputError(
                f"is {level:g} m, which is at no altitude of the grid",
                field=name,
                remedy=f"give the station or {altitude[0]:g} to {altitude[-1]:g} m",
            )
        indices.append(nearest - 1)
    if indices[0] >= indices[1]:
        raise RetrievalInputError(
            f"the layer from {bottom:g} to {top:g} m contains no altitude",
            field="top",
            remedy="give a top at least one spacing above the bottom",
        )
    return indices[0], indices[1]
