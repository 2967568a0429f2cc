"""Optical depth and extinction from scans: one atmosphere seen along paths of different lengths."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.multiangle import _methods, slant_paths
from lidarops.retrieve.multiangle._methods import (
    BlockSettings,
    MultiAngleFlags,
    MultiAngleResult,
    StepRecord,
)
from lidarops.retrieve.multiangle.flags import REJECTING, MultiAngleQuality

LARGEST_GRADIENT: Final = 5e-5
"""m-1, default horizontal gradient of ln backscatter covered by the gradient errors."""

__all__ = [
    "LARGEST_GRADIENT",
    "MultiAngleFlags",
    "MultiAngleMethod",
    "MultiAngleResult",
    "StepRecord",
    "layer_bounds",
    "retrieve_optical_depth",
]


class MultiAngleMethod(StrEnum):
    """Method of retrieving optical depths."""

    AUTO = "auto"
    """`TWO_ANGLE` for two beams, else `JOINT`; `KANO_HAMILTON` where all standard errors of `JOINT`
    would be too small."""
    TWO_ANGLE = "two_angle"
    """Only the shortest and the longest path."""
    KANO_HAMILTON = "kano_hamilton"
    """Weighted regression on the slant path, each altitude on its own."""
    JOINT = "joint"
    """`KANO_HAMILTON`, then one smooth profile through all altitudes."""
    MLD = "mld"
    """Regularised derivative along the slant path, formula 3 of `gobrusenko1989`."""
    MLD_PRIOR = "mld_prior"
    """`MLD` applied to the difference from the altitude below, its formula 4."""


REGULARISED: Final = frozenset({MultiAngleMethod.MLD, MultiAngleMethod.MLD_PRIOR})
"""Methods with a penalty, which accept `regularisation`."""


def retrieve_optical_depth(
    signal: npt.ArrayLike,
    zenith_angle: npt.ArrayLike,
    altitude: npt.ArrayLike,
    *,
    variance: npt.ArrayLike,
    azimuth: npt.ArrayLike | None = None,
    method: str = "auto",
    station_altitude: float = 0.0,
    inhomogeneity: float | None = None,
    largest_gradient: float = LARGEST_GRADIENT,
    robust: bool = True,
    layers: Sequence[tuple[float, float]] = (),
    regularisation: float | None = None,
    dead_time_change: npt.ArrayLike | None = None,
) -> MultiAngleResult:
    """Retrieve optical depth and extinction from signals at several zenith angles.

    All profiles are one block: inhomogeneity, correlation and smoothness are common to them. Model,
    estimators and thresholds are in ``docs/algorithms/multiangle.md``.

    Parameters
    ----------
    signal : (..., angle, altitude) float
        Range-corrected, without background, in any unit, of altitude cells (see
        `lidarops.retrieve.multiangle._cell_means`), from full overlap upwards; NaN where missing.
    zenith_angle : (angle,) float
        degree, -90 to 90; a beam with a negative angle points opposite to its azimuth.
    altitude : (altitude,) float
        m, ascending, above `station_altitude`; uniform for "joint".
    variance : (..., angle, altitude) float
        Variance of the noise alone, in the square of the unit of the signal, broadcast against it.
        For counts, give that of a smoothed rate (`lidarops.retrieve.signal.counts_to_signal`):
        variances from single counts make intervals too narrow.
    azimuth : (angle,) float, optional
        degree; the same for all angles if not given.
    method : {"auto", "two_angle", "kano_hamilton", "joint", "mld", "mld_prior"}
        See `MultiAngleMethod`.
    station_altitude : float
        m, altitude of the lidar, where the optical depth is zero.
    inhomogeneity : float, optional
        Standard deviation of the logarithms on top of the noise; estimated if not given.
    largest_gradient : float
        m-1, horizontal gradient of ln backscatter covered by `optical_depth_gradient_error` and
        `extinction_gradient_error`, unless the residuals show a larger one.
    robust : bool
        Whether to test for outliers.
    layers : sequence of (float, float)
        m, bottom and top of layers whose optical depth is requested; moved to the nearest of the
        altitudes and the station, by at most half the distance to the next one.
    regularisation : float, optional
        Strength of the penalty of "mld" and "mld_prior", dimensionless, for slant paths scaled to a
        span of 1; by default the largest with residuals not larger than the noise, at each
        altitude.
    dead_time_change : (..., angle, altitude) float, optional
        Change of the signal with one standard error of the dead time, in all beams together, which
        looks like a horizontal gradient near the lidar; NaN where there is no signal.

    Returns
    -------
    MultiAngleResult

    Raises
    ------
    RetrievalInputError
        For invalid arguments.

    References
    ----------
    kano1968, hamilton1969, gobrusenko1989, dersimonian1986, siegel1982.
    """
    chosen = inputs.choice(method, MultiAngleMethod, "method")
    height = slant_paths.altitude_grid(altitude, station_altitude)
    scan = slant_paths.make_scan(zenith_angle, height, azimuth)
    rows, noise, leading = _cube(signal, variance, scan.path.shape)
    settings = BlockSettings(
        chosen.value,
        height,
        scan,
        float(station_altitude),
        _positive(inhomogeneity, "inhomogeneity"),
        _positive(largest_gradient, "largest_gradient") or 0.0,
        robust,
        _layers(layers, np.append(height, 0.0) + station_altitude),
        _regularisation(regularisation, chosen),
    )
    change: Array | None = None
    if dead_time_change is not None:
        change = np.nan_to_num(
            inputs.real_array(dead_time_change, "dead_time_change").astype(np.float64)
        )
        if change.shape != leading + scan.path.shape:
            raise RetrievalInputError(
                f"has the shape {change.shape}",
                field="dead_time_change",
                remedy="give that of the signal",
            )
        change = change.reshape(rows.shape)
    result = _methods.solve_cycles(rows, noise, change, settings)
    observed = np.asarray((np.isfinite(rows) & np.isfinite(noise)).any(axis=1))
    result.quality[:] = _quality(result, observed)
    return result.with_leading_axes(leading)


def layer_bounds(
    layers: Sequence[tuple[float, float]], altitude: npt.ArrayLike, *, station_altitude: float
) -> Array:
    """Return the bounds of layers as `retrieve_optical_depth` moves them.

    Parameters
    ----------
    layers : sequence of (float, float)
        m, bottom and top.
    altitude : (altitude,) float
        m, ascending, above `station_altitude`.
    station_altitude : float
        m.

    Returns
    -------
    (layer, 2) float
        m, moved to the nearest of the altitudes and the station.

    Raises
    ------
    RetrievalInputError
        For layers that contain no altitude of the grid, or extend beyond it.
    """
    height = slant_paths.altitude_grid(altitude, station_altitude)
    levels = np.append(height, 0.0) + station_altitude
    return levels[np.array(_layers(layers, levels), dtype=np.int64).reshape(-1, 2)]


def _cube(
    signal: npt.ArrayLike, variance: npt.ArrayLike, shape: tuple[int, ...]
) -> tuple[Array, Array, tuple[int, ...]]:
    """Return signal and variance as (profile, angle, altitude), and the leading axes.

    Compiled functions have one version, for writable float64 in C order.
    """
    array = inputs.real_array(signal, "signal")
    if array.ndim < 2 or array.shape[-2:] != shape:
        raise RetrievalInputError(
            f"has the shape {array.shape}, with {shape[0]} angles and {shape[1]} altitudes",
            field="signal",
            remedy="give (..., angle, altitude)",
        )
    leading = array.shape[:-2]
    count = int(np.prod(leading, dtype=np.int64))
    noise = inputs.real_array(variance, "variance")
    if np.any(noise < 0):
        raise RetrievalInputError(
            "is negative", field="variance", remedy="give squares of the signal's unit"
        )
    spread = inputs.broadcast(noise, array.shape, "variance")
    cubes = (np.require(cube, np.float64, ["C", "W"]) for cube in (array, spread))
    rows, variances = (np.asarray(cube).reshape(count, *shape) for cube in cubes)
    return rows, variances, leading


def _layers(layers: Sequence[tuple[float, float]], levels: Array) -> tuple[tuple[int, int], ...]:
    """Return the altitudes nearest to the bounds of layers, -1 for the station."""
    try:
        bounds = np.asarray(layers, dtype=np.float64)
    except (TypeError, ValueError):
        bounds = np.empty(0)
    if len(layers) and (bounds.shape != (len(layers), 2) or not np.all(np.isfinite(bounds))):
        raise RetrievalInputError(
            f"is {layers!r}", field="layers", remedy="give pairs (bottom, top) in m"
        )
    indices = []
    order = np.sort(levels)
    for bottom, top in bounds:
        low, high = (int(np.argmin(np.abs(levels - level))) for level in (bottom, top))
        slack = 0.5 * np.max(np.diff(order), initial=0.0)
        if max(abs(levels[low] - bottom), abs(levels[high] - top)) > slack or (
            levels[low] >= levels[high]
        ):
            raise RetrievalInputError(
                f"[{bottom:g}, {top:g}] m contains no altitude of the grid, or extends beyond it",
                field="layers",
                remedy=f"give bounds from {order[0]:g} to {order[-1]:g} m, bottom first",
            )
        indices.append((-1 if low == levels.size - 1 else low, high))
    return tuple(indices)


def _positive(value: float | None, name: str) -> float | None:
    if value is not None and not (np.isfinite(value) and value >= 0):
        raise RetrievalInputError(f"is {value}", field=name, remedy="give zero or more")
    return value


def _regularisation(strength: float | None, method: MultiAngleMethod) -> float | None:
    if strength is not None and method not in REGULARISED:
        raise RetrievalInputError(
            f"is not accepted by the method {str(method)!r}",
            field="regularisation",
            remedy=f"leave it out, or choose {' or '.join(sorted(REGULARISED))}",
        )
    return _positive(strength, "regularisation")


def _quality(profiles: MultiAngleResult, observed: Booleans) -> npt.NDArray[np.int32]:
    """Return the common quality bits; each missing optical depth has a rejecting bit.

    Parameters
    ----------
    profiles : MultiAngleResult
    observed : (profile, altitude) bool
        Whether any angle has a signal and its variance.
    """
    quality = np.zeros(profiles.optical_depth.shape, dtype=np.int32)
    quality[~observed.any(axis=1)] |= np.int32(Quality.INPUT_MISSING)
    lost = profiles.flags.extrapolated & ~profiles.flags.no_data
    quality[lost] |= np.int32(Quality.LOW_SIGNAL)
    quality[profiles.flags.outlier] |= np.int32(Quality.OUTLIER)
    unexplained = np.isnan(profiles.optical_depth) & (quality & REJECTING == 0)
    quality[unexplained & ~observed] |= np.int32(Quality.INPUT_MISSING)
    quality[unexplained & observed] |= np.int32(MultiAngleQuality.NO_LEVERAGE)
    return quality
