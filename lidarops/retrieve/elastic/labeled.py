"""The elastic retrieval of mean profiles in xarray.

In this order: outlying bins, background and clouds (`lidarops.retrieve.clouds`), reference window,
inversion, quality flags.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import xarray as xr
from scipy import ndimage

from lidarops.constants import HIGHEST_CLOUD
from lidarops.flags import WITHHELD, Quality
from lidarops.retrieve.air import reference_window as _reference
from lidarops.retrieve.air.molecular import HIGHEST, MolecularProfile
from lidarops.retrieve.clouds.labeled import (
    Clouds,
    MeanProfiles,
    MeanSignal,
    Reference,
    air_along,
    cloud_heights,
    reference_window,
    signal_and_clouds,
    window_variables,
    with_margin,
)
from lidarops.retrieve.common.arrays import Array, Booleans, Flags
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.elastic import inversion as _elastic
from lidarops.retrieve.elastic.flags import ElasticQuality
from lidarops.retrieve.elastic.inversion import THRESHOLDS
from lidarops.retrieve.signal.averaging import cloud_contrast
from lidarops.retrieve.signal.labeled import systematic_changes, without_analog_background

RatioAt = Callable[[Array], tuple[Array, Array]]
"""Altitudes in m -> lidar ratio and its standard error, sr."""


def constant_ratio(ratio: float, standard_error: float) -> RatioAt:
    """Return the function of a lidar ratio and standard error, sr, that are equal everywhere."""

    def at(altitude: Array) -> tuple[Array, Array]:
        return np.full(altitude.shape, ratio), np.full(altitude.shape, standard_error)

    return at


def invert_elastic(
    averages: xr.Dataset,
    *,
    molecules: MolecularProfile,
    wavelength: float,
    station_altitude: float,
    lidar_ratio: RatioAt,
    molecular_relative_error: float,
    reference: Reference,
    overlap_is_stated: bool,
    known_shape: bool = True,
    overlap: Array | None = None,
) -> xr.Dataset:
    """Return aerosol backscatter and extinction of mean profiles.

    Parameters
    ----------
    averages : xr.Dataset
        ``power``, ``variance``, ``quality`` over (time, range) and ``shots``, ``profiles`` over
        time, with the scalar coordinate ``zenith_angle`` (degree), from
        `lidarops.retrieve.signal.labeled_averaging.ClockAverage`; in memory. With the signals of
        their parts, of a screened average, clouds are sought in these too, else in the mean only.
        For the errors of
        dead time and baseline, see `lidarops.retrieve.signal.labeled.systematic_changes`.
    molecules : MolecularProfile
    wavelength : float
        m.
    station_altitude : float
        m above mean sea level.
    lidar_ratio : callable
        Returns the lidar ratio of the aerosol and its standard error in sr at altitudes in m above
        mean sea level; see `constant_ratio`.
    molecular_relative_error : float
        Relative standard error of the air density.
    reference : Reference
    overlap_is_stated : bool
        If false, a layer that begins before the search range of the reference window is a cloud
        only where clean air beyond shows that the overlap is full below it.
    known_shape : bool
        If true, fit the background together with the shape of clean air to the far range
        (`lidarops.retrieve.background.known_shape`); else use the mean of the last tenth of the
        bins.
    overlap : (range,) float, optional
        Overlap function, by which the signal is divided; NaN where it is not known.

    Returns
    -------
    xr.Dataset
        In memory: the variables of the ``elastic`` product. Where a value is NaN, a bit of
        ``quality_flag`` gives the reason.

    Raises
    ------
    RetrievalInputError
        For invalid arguments.
    """
    climb = float(np.cos(np.deg2rad(averages["zenith_angle"])))
    distance = averages["range"].to_numpy().astype(np.float64)
    # An offset may give negative ranges, without light; above the atmosphere there is no air.
    inside = (distance > 0) & (station_altitude + climb * distance < HIGHEST)
    averages, distance = averages.isel(range=inside), distance[inside]
    overlap = None if overlap is None else overlap[inside]
    air = air_along(molecules, station_altitude + climb * distance, distance, wavelength)
    ratio = _elastic.LidarRatio(*lidar_ratio(station_altitude + climb * distance))
    means = MeanProfiles(averages, distance, air, overlap, cloud_contrast(wavelength))
    signal, clouds = signal_and_clouds(
        means, averages, reference, known_shape=known_shape, overlap_is_stated=overlap_is_stated
    )
    # Beyond, no value can be used, and noise passes for clouds.
    highest = max(reference.highest, (HIGHEST_CLOUD - station_altitude) / climb)
    used = slice(int(np.searchsorted(distance, highest, side="right")))
    window = reference_window(signal, means, reference, clouds.any)
    solution = _elastic.invert_elastic(
        signal.power,
        distance,
        air=_elastic.Air(air.backscatter, air.extinction, molecular_relative_error),
        lidar_ratio=ratio,
        reference=_elastic.Reference(
            (window.bottom, window.top),
            reference.scattering_ratio,
            window.relative_error(reference.relative_error),
        ),
        variance=means.variance,
        background_standard_error=signal.background_standard_error,
        **_systematic_errors(averages, means, signal),
        noise_correlation_length=means.correlation_length,
    )
    quality = means.quality | _flags(solution, window, signal, means, clouds)
    product = xr.Dataset(
        {
            **{
                name: (("time", "range"), values)
                for name, values in _profile_variables(solution).items()
            },
            "molecular_backscatter": ("range", air.backscatter),
            "molecular_extinction": ("range", air.extinction),
            "lidar_ratio": ("range", ratio.value),
            "lidar_ratio_standard_error": ("range", ratio.standard_error),
            "vertical_resolution": float(np.median(np.diff(distance))),
            **window_variables(window, reference, station_altitude, climb),
            "cloud_mask": (("time", "range"), clouds.state),
            "cloud_fraction": (("time", "range"), clouds.fraction),
            **cloud_heights(clouds.any[:, used], distance[used], station_altitude, climb),
            "background": ("time", signal.background),
            "background_standard_error": ("time", signal.background_standard_error),
            "quality_flag": (("time", "range"), quality),
            "profiles": averages["profiles"],
            "profiles_left_out": averages.get("profiles_left_out", 0 * averages["profiles"]),
            "shots": averages["shots"],
        },
        coords={name: averages[name] for name in averages.coords},
    )
    return without_analog_background(product.isel(range=used), averages)


def _systematic_errors(
    averages: xr.Dataset, means: MeanProfiles, signal: MeanSignal
) -> dict[str, Any]:
    """Return the changes of the signal with one standard error of dead time and baseline."""
    bridged = averages.assign(power=averages["power"].copy(data=means.raw))
    changes = systematic_changes(bridged, xr.DataArray(signal.background, dims="time"))
    errors = {}
    for cause, change in changes.items():
        array = change.transpose("time", "range").to_numpy() / means.overlap
        errors[f"{cause}_error"] = np.nan_to_num(array, posinf=0.0, neginf=0.0)
    return errors


def _flags(
    solution: _elastic.ElasticResult,
    window: _reference.ReferenceWindow,
    signal: MeanSignal,
    means: MeanProfiles,
    clouds: Clouds,
) -> Flags:
    """Return the bits of the inversion, its reference and background, clouds and overlap."""
    # The inversion starts in the window. Beyond a cloud it depends on the lidar ratio of aerosol
    # that was assumed in the cloud.
    near = means.distance < np.nan_to_num(window.bottom, nan=0.0)[:, np.newaxis]

    def with_beyond(mask: Booleans) -> Booleans:
        """Return the bins of a mask, and those beyond one as seen from the reference window."""
        out, rows = np.zeros_like(mask), np.flatnonzero(mask.any(axis=-1))
        mask, before = mask[rows], near[rows]
        above = np.logical_or.accumulate(mask & ~before, axis=-1)
        below = np.logical_or.accumulate((mask & before)[:, ::-1], axis=-1)[:, ::-1]
        out[rows] = above | below
        return out

    chosen = window.chosen[:, np.newaxis]
    cloudy = with_beyond(with_margin(clouds.mask, means.distance))
    partly = with_beyond(with_margin(clouds.partly, means.distance))
    bits = np.zeros(solution.valid.shape, dtype=np.int32)
    for mask, bit in (
        (~chosen, ElasticQuality.NO_REFERENCE),
        (signal.uncertain[:, np.newaxis], Quality.BACKGROUND_UNCERTAIN),
        (
            chosen & ~solution.valid & ((means.quality & WITHHELD) == 0),
            ElasticQuality.UNSTABLE_INVERSION,
        ),
        (cloudy, ElasticQuality.CLOUD),
        (partly & ~cloudy, ElasticQuality.PARTLY_CLOUDY),
        (with_beyond(_negative(solution)), ElasticQuality.NEGATIVE_BACKSCATTER),
        (means.unknown_overlap, ElasticQuality.UNKNOWN_OVERLAP),
    ):
        bits |= np.where(mask, np.int32(bit), np.int32(0))
    return bits


def _negative(solution: _elastic.ElasticResult) -> Booleans:
    """Return where runs of bins have a backscatter that lies below zero by more than its error."""
    # Neither is known where there is no value.
    low = solution.backscatter < -COMMON.contradicted * solution.backscatter_standard_error
    rows = np.flatnonzero(low.sum(axis=-1) >= THRESHOLDS.negative_bins)
    out = np.zeros_like(low)
    out[rows] = ndimage.binary_opening(low[rows], np.ones((1, THRESHOLDS.negative_bins)))
    return out


def _profile_variables(solution: _elastic.ElasticResult) -> dict[str, Array]:
    """Return the variables of bins, NaN where there is no value."""

    def valid(values: Array) -> Array:
        return np.where(solution.valid, values, np.nan)

    # The others have no value there.
    shifts = {cause: valid(solution.budget[cause]) for cause in ("dead_time", "baseline")}
    budget = solution.budget | shifts
    return {
        "aerosol_backscatter": solution.backscatter,
        "aerosol_backscatter_standard_error": solution.backscatter_standard_error,
        **{f"aerosol_backscatter_error_{cause}": error for cause, error in budget.items()},
        "aerosol_extinction": solution.extinction,
        "aerosol_extinction_standard_error": solution.extinction_standard_error,
        "scattering_ratio": solution.scattering_ratio,
        "scattering_ratio_standard_error": solution.scattering_ratio_standard_error,
        "attenuated_backscatter": valid(solution.attenuated_backscatter),
        "attenuated_backscatter_standard_error": valid(
            solution.attenuated_backscatter_standard_error
        ),
    }
