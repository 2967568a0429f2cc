"""What the vertical solution accepts, and the one shape in which its kernels get it."""

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
_INFORMATION: Final = (1e-16, 1e16)
_UNIFORM: Final = 1e-3
"""Largest deviation of a step from the mean step, as a share: what rounded altitudes need."""


@dataclass(frozen=True, slots=True)
class VerticalProblem:
    """Estimates of single heights, cleaned."""

    optical_depth: Array
    """(profile, height), 0 where there is no estimate."""
    information: Array
    """(profile, height), 0 where there is no estimate."""
    altitude: Array
    """(height,) m."""
    station_altitude: float
    """m."""


def matrix(values: npt.ArrayLike, name: str, shape: tuple[int, ...]) -> Array:
    """Return contiguous float64 of `shape`, broadcast along profiles.

    Raises
    ------
    RetrievalInputError
        Where it does not fit.
    """
    array = real_array(values, name).astype(np.float64, copy=False)
    try:
        return np.ascontiguousarray(np.broadcast_to(array, shape))
    except ValueError:
        raise RetrievalInputError(
            f"has the shape {array.shape}, not {shape}",
            field=name,
            remedy="give (profile, height), as the optical depth has",
        ) from None


def beams(*arrays: npt.ArrayLike) -> tuple[Array, Array, Array]:
    """Return residual, weight and leverage as contiguous (profile, beam, height) float64.

    Raises
    ------
    RetrievalInputError
        Where they are not of one shape with three axes.
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
                remedy="give (profile, beam, height), the same for residual, weight and leverage",
            )
    return first, second, third


def vertical_problem(
    optical_depth: npt.ArrayLike,
    information: npt.ArrayLike,
    altitude: npt.ArrayLike,
    station_altitude: float,
) -> VerticalProblem:
    """Check and clean the input of `lidarops.retrieve.multiangle.vertical.smooth_profile.smooth_optical_depth`.

    Raises
    ------
    RetrievalInputError
        For shapes that do not fit, and for an altitude that is not one.
    """
    depth = np.array(real_array(optical_depth, "optical_depth"), dtype=np.float64)
    if depth.ndim != 2:
        raise RetrievalInputError(
            f"has the shape {depth.shape}",
            field="optical_depth",
            remedy="give (profile, height)",
        )
    grid, station = _grid(altitude, station_altitude)
    if depth.shape[1] != grid.size:
        raise RetrievalInputError(
            f"has {depth.shape[1]} heights, but altitude has {grid.size}",
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
            "is not a finite axis", field="altitude", remedy="give one value in m per height"
        )
    station = finite(station_altitude, "station_altitude")
    if not grid[0] > station:
        raise RetrievalInputError(
            f"starts at {grid[0]:g} m, not above the lidar at {station:g} m",
            field="altitude",
            remedy="cut the heights at and below the lidar",
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
    """Return a finite number that is not below `least`.

    Raises
    ------
    RetrievalInputError
        For any other.
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
        Where they are not one whole number for each profile.
    """
    array = np.zeros(profiles, dtype=np.int64) if block is None else np.asarray(block)
    if array.shape != (profiles,) or (array.dtype.kind not in "iu" and array.size):
        raise RetrievalInputError(
            f"has the shape {array.shape} of {array.dtype}",
            field="block",
            remedy=f"give one whole number for each of the {profiles} profiles",
        )
    return array


def moments(given: ResidualMoments, problem_: VerticalProblem) -> ResidualMoments:
    """Return residual moments with their shapes checked.

    Raises
    ------
    RetrievalInputError
        Where they are of other profiles or heights.
    """
    profiles = problem_.optical_depth.shape[0]
    shapes: dict[str, tuple[int, ...]] = {
        "lag_products": (profiles, LAGS),
        "lag_norms": (profiles, LAGS),
        "inhomogeneity_share": problem_.optical_depth.shape,
        "degrees_of_freedom": problem_.optical_depth.shape,
        "gaps": (profiles,),
    }
    for name, shape in shapes.items():
        if getattr(given, name).shape != shape:
            raise RetrievalInputError(
                f"has the shape {getattr(given, name).shape}, not {shape}",
                field=f"residuals.{name}",
                remedy="make it by residual_moments from the same profiles",
            )
    return given


def layer(altitude: Array, station_altitude: float, bottom: float, top: float) -> tuple[int, int]:
    """Return the indices of the altitudes nearest to the bounds of a layer, -1 the station.

    Raises
    ------
    RetrievalInputError
        Where a bound is outside the grid, or they are not in order.
    """
    levels = np.concatenate([[station_altitude], altitude])
    half = 0.5 * (altitude[1] - altitude[0] if altitude.size > 1 else 0.0)
    found = []
    for value, name in ((bottom, "bottom"), (top, "top")):
        level = finite(value, name)
        nearest = int(np.argmin(np.abs(levels - level)))
        if abs(levels[nearest] - level) > half * (1.0 + _UNIFORM):
            raise RetrievalInputError(
                f"is {level:g} m, which is at no altitude of the grid",
                field=name,
                remedy=f"give the station or {altitude[0]:g} to {altitude[-1]:g} m",
            )
        found.append(nearest - 1)
    if found[0] >= found[1]:
        raise RetrievalInputError(
            f"the layer from {bottom:g} to {top:g} m holds no height",
            field="top",
            remedy="give a top at least one spacing above the bottom",
        )
    return found[0], found[1]
