"""Optical depth and extinction from scans: one atmosphere seen along paths of different lengths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.flags import WITHHELD, Quality
from lidarops.retrieve.common import inputs
from lidarops.retrieve.common.arrays import Array, Flags, Indices
from lidarops.retrieve.multiangle import _methods, slant_paths
from lidarops.retrieve.multiangle._methods import (
    LARGEST_GRADIENT,
    REGULARISED,
    BlockSettings,
    MultiAngleMethod,
    MultiAngleResult,
    OpticalDepthSettings,
    StepRecord,
)
from lidarops.retrieve.multiangle.flags import CARE, MultiAngleQuality

__all__ = [
    "LARGEST_GRADIENT",
    "REGULARISED",
    "MultiAngleMethod",
    "MultiAngleResult",
    "OpticalDepthSettings",
    "StepRecord",
    "layer_levels",
    "retrieve_optical_depth",
]

_DEFAULT: Final = OpticalDepthSettings()


def retrieve_optical_depth(
    signal: npt.ArrayLike,
    zenith_angle: npt.ArrayLike,
    altitude: npt.ArrayLike,
    *,
    variance: npt.ArrayLike,
    azimuth: npt.ArrayLike | None = None,
    settings: OpticalDepthSettings = _DEFAULT,
    dead_time_change: npt.ArrayLike | None = None,
    signal_quality: Flags | None = None,
) -> MultiAngleResult:
    """Retrieve optical depth and extinction from signals at several zenith angles.

    All profiles are one block: inhomogeneity, correlation and smoothness are common to them. Model,
    estimators and thresholds are in ``docs/algorithms/multiangle.md``.

    Parameters
    ----------
    signal : (profile, angle, altitude) float
        Range-corrected, without background, in any unit, of altitude cells (see
        `lidarops.retrieve.multiangle._cell_means`), from full overlap upwards; NaN where missing.
    zenith_angle : (angle,) float
        degree, -90 to 90; a beam with a negative angle points opposite to its azimuth.
    altitude : (altitude,) float
        m, ascending, above the station; uniform for "joint".
    variance : (profile, angle, altitude) float
        Variance of the noise alone, in the square of the unit of the signal, broadcast against it.
        For counts, give that of a smoothed rate (`lidarops.retrieve.signal.counts_to_signal`):
        variances from single counts make intervals too narrow.
    azimuth : (angle,) float, optional
        degree; the same for all angles if not given.
    settings : OpticalDepthSettings
    dead_time_change : (profile, angle, altitude) float, optional
        Change of the signal with one standard error of the dead time, in all beams together, which
        looks like a horizontal gradient near the lidar; NaN where there is no signal.
    signal_quality : (profile, altitude) int, optional
        Bits of the signals of all beams, which tell why values are missing; by default
        INPUT_MISSING where no beam has a signal and its variance.

    Raises
    ------
    RetrievalInputError
        For invalid arguments.

    References
    ----------
    kano1968, hamilton1969, gobrusenko1989, dersimonian1986.
    """
    method = inputs.choice(settings.method, MultiAngleMethod, "method")
    station = settings.station_altitude
    height = slant_paths.altitude_grid(altitude, station)
    scan = slant_paths.make_scan(zenith_angle, height, azimuth)
    rows = _cube(signal, "signal", scan.path.shape)
    noise = inputs.real_array(variance, "variance")
    if np.any(noise < 0):
        raise RetrievalInputError(
            "is negative", field="variance", remedy="give squares of the signal's unit"
        )
    noise = _cube(inputs.broadcast(noise, rows.shape, "variance"), "variance", rows.shape)
    _check(settings, method)
    block = BlockSettings(
        **{item.name: getattr(settings, item.name) for item in fields(settings)},
        height=height,
        scan=scan,
        levels=layer_levels(settings.layers, altitude, station_altitude=station)[0],
    )
    change = None
    if dead_time_change is not None:
        change = np.nan_to_num(_cube(dead_time_change, "dead_time_change", rows.shape))
    result = _methods.solve_cycles(rows, noise, change, block)
    _with_reasons(result, rows, noise, signal_quality)
    return result


def layer_levels(
    layers: Sequence[tuple[float, float]], altitude: npt.ArrayLike, *, station_altitude: float
) -> tuple[Indices, Array]:
    """Return the levels at bottom and top of layers, as `retrieve_optical_depth` moves them.

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
    levels : (layer, 2) int
        0 for the station, k + 1 for the altitude k.
    bounds : (layer, 2) float
        m, their altitudes.

    Raises
    ------
    RetrievalInputError
        For layers that contain no altitude of the grid, or extend beyond it.
    """
    height = slant_paths.altitude_grid(altitude, station_altitude)
    grid = np.append(height, 0.0) + station_altitude
    try:
        wanted = np.asarray(layers, dtype=np.float64).reshape(len(layers), 2)
    except (TypeError, ValueError):
        wanted = np.full((len(layers), 2), np.nan)
    if not np.all(np.isfinite(wanted)):
        raise RetrievalInputError(
            f"is {layers!r}", field="layers", remedy="give pairs (bottom, top) in m"
        )
    nearest = np.abs(grid - wanted[..., np.newaxis]).argmin(axis=-1)
    bounds = grid[nearest]
    off = np.abs(bounds - wanted).max(axis=1) > 0.5 * np.max(np.diff(np.sort(grid)))
    bad = np.flatnonzero(off | (bounds[:, 0] >= bounds[:, 1]))
    if bad.size:
        bottom, top = wanted[bad[0]]
        raise RetrievalInputError(
            f"[{bottom:g}, {top:g}] m contains no altitude of the grid, or extends beyond it",
            field="layers",
            remedy=f"give bounds from {grid.min():g} to {grid.max():g} m, bottom first",
        )
    return (nearest + 1) % grid.size, bounds


def _cube(values: npt.ArrayLike, name: str, shape: tuple[int, ...]) -> Array:
    """Return values as (profile, angle, altitude).

    Compiled functions have one version, for writable float64 in C order.
    """
    array = inputs.real_array(values, name)
    if array.ndim != 3 or array.shape[-len(shape) :] != shape:
        raise RetrievalInputError(
            f"has the shape {array.shape}, with {shape[-2]} angles and {shape[-1]} altitudes",
            field=name,
            remedy="give (profile, angle, altitude)",
        )
    return np.require(array, np.float64, ["C", "W"])


def _check(settings: OpticalDepthSettings, method: MultiAngleMethod) -> None:
    """Refuse numbers below zero, and a strength of the penalty for a method that has none."""
    if settings.regularisation is not None and method not in REGULARISED:
        raise RetrievalInputError(
            f"is not accepted by the method {str(method)!r}",
            field="regularisation",
            remedy=f"leave it out, or choose {' or '.join(sorted(REGULARISED))}",
        )
    for name in ("inhomogeneity", "largest_gradient", "regularisation"):
        value = getattr(settings, name)
        if value is not None and not (np.isfinite(value) and value >= 0):
            raise RetrievalInputError(f"is {value}", field=name, remedy="give zero or more")


def _with_reasons(
    result: MultiAngleResult, signal: Array, variance: Array, carried: Flags | None
) -> None:
    """Raise the bits of the signals and the reasons for missing values, in place."""
    samples = np.sum(np.isfinite(signal) & np.isfinite(variance), axis=1)
    if carried is None:
        carried = np.where(samples > 0, np.int32(0), np.int32(Quality.INPUT_MISSING))
    result.mark(Quality.INPUT_MISSING, ~np.any(samples, axis=1, keepdims=True))
    lost = ~np.isfinite(result.optical_depth) & (result.quality == 0)
    reasons = carried & np.int32(WITHHELD)
    reasons[(samples > 1) | (reasons == 0)] = np.int32(MultiAngleQuality.NO_LEVERAGE)
    passed = np.int32(CARE | Quality.NO_SIGNAL)
    result.quality[:] |= carried & passed | np.where(lost, reasons, np.int32(0))
