"""The Raman retrieval of mean profiles in xarray.

In this order: common bins of the channels, background of each, cells, extinction, backscatter and
lidar ratio, clouds of the elastic signal, water vapour, overlap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import xarray as xr

from lidarops.flags import WITHHELD, Quality
from lidarops.retrieve.air.molecular import HIGHEST, MolecularProfile
from lidarops.retrieve.background import estimate
from lidarops.retrieve.clouds import labeled as _clouds
from lidarops.retrieve.common.arrays import Array, Booleans, Flags
from lidarops.retrieve.raman.backscatter import overlap_of
from lidarops.retrieve.raman.flags import CONCERNING, OF_MEANS, RamanQuality, concerning
from lidarops.retrieve.raman.retrieval import (
    RamanResult,
    mixing_ratio,
    particle_transmission,
    retrieve_raman,
)
from lidarops.retrieve.raman.scattering import nitrogen_line_share
from lidarops.retrieve.raman.settings import RamanSettings
from lidarops.retrieve.raman.signals import (
    AirColumn,
    Cells,
    ChannelSignal,
    cell_signals,
    largest_of_cells,
    make_cells,
    state_of_cells,
    touched,
)
from lidarops.retrieve.raman.thresholds import THRESHOLDS
from lidarops.retrieve.signal.averaging import cloud_contrast
from lidarops.retrieve.signal.labeled import (
    actual_noise,
    analog_alone,
    background_before,
    counts_per_power,
    systematic_changes,
    without_analog_background,
)

_WITHHELD: Final = WITHHELD & ~int(Quality.INCOMPLETE_OVERLAP)
_DOUBTED: Final = _WITHHELD | int(Quality.PILE_UP)
_MISSING: Final = np.int32(Quality.INPUT_MISSING)
_BITS_OF_ANY_BIN: Final = (
    _DOUBTED | int(Quality.INCOMPLETE_OVERLAP | Quality.SINGLE_RECORD)
) & ~int(_MISSING)
_PLANE: Final = ("time", "range")
_DIGITS_OF_A_BIN: Final = 6
"""Digits of the difference of ranges in bins, which are no more certain: 1e-6 bins are 10 um."""


@dataclass(frozen=True, slots=True)
class WaterVapour:
    """The channel of water vapour, and its calibration."""

    averages: xr.Dataset
    wavelength: float
    """m."""
    constant: float
    """kg kg-1 per ratio of the signals of water vapour and nitrogen."""
    constant_standard_error: float


_Bins = tuple[slice, float]
"""Bins of a channel for the ranges that all channels have in common, and the weight of the bin
beyond in the value at a common range; 0 where ranges agree."""


class _Channel:
    """Means of one channel, whose values are given at the ranges that all channels have."""

    def __init__(self, averages: xr.Dataset, bins: _Bins, distance: Array) -> None:
        inside, share = bins
        averages = averages.isel(range=inside)
        self._share, self._distance = share, distance
        if not share:
            averages = averages.assign_coords(range=("range", distance))
        self.averages = averages
        quality = averages["quality"].to_numpy().astype(np.int32)
        hidden = (quality & np.int32(_WITHHELD)) != 0
        self.quality = quality[:, :-1] | quality[:, 1:] if share else quality
        self._power = np.where(hidden, np.nan, averages["power"].to_numpy())
        self.noise = noise = actual_noise(averages)
        self._variance = noise.variance * noise.correlation_length[:, np.newaxis]
        counts = counts_per_power(averages, averages["shots"].to_numpy())
        scale = noise.excess * noise.correlation_length
        self._counts = None if counts is None else counts / scale

    @property
    def known(self) -> Booleans:
        """Whether there is a value at a common range, (profile, bin)."""
        return np.isfinite(self._at_common(self._power))

    def signal(self, shape: Array, *, known_shape: bool) -> tuple[ChannelSignal, Booleans]:
        """Return the signal without background, and whether the background is uncertain.

        `shape` is that of clean air at the common ranges.
        """
        r, own = self.averages["range"].to_numpy().astype(np.float64), shape
        if self._share:
            # Without the square of range, it is nearly a line over one bin.
            own = np.interp(r, self._distance, shape * self._distance**2) / r**2
        if before := background_before(self.averages):
            sky = before
        elif known_shape:
            sky = estimate.from_known_shape(
                self._power, r, self._variance, own, exposure=self._counts
            )
        else:
            sky = estimate.from_tail(self._power, r, self._variance)
        background = sky.background
        changes = systematic_changes(self.averages, xr.DataArray(background, dims="time"))
        errors = [
            np.nan_to_num(changes[cause].transpose("time", "range").to_numpy())
            if cause in changes
            else np.zeros((1, r.size))
            for cause in ("dead_time", "baseline")
        ]
        values = (self._power - background[:, np.newaxis], self._variance, *errors)
        if self._share:
            # Noise of neighbours is common to them then. That of a smooth fit is as without.
            factors = (own, shape), (own**2, shape**2), (own, shape), (own, shape)
            values = tuple(
                self._at_common(part / of_bins) * of_common
                for part, (of_bins, of_common) in zip(values, factors, strict=True)
            )
        power, variance, dead_time, baseline = values
        signal = ChannelSignal(
            power,
            variance,
            np.nan_to_num(background),
            sky.standard_error,
            dead_time,
            self._counts,
            baseline,
        )
        return signal, sky.uncertain

    def _at_common(self, values: Array) -> Array:
        """Return values of the bins at the common ranges, (..., bin), between bins by lines."""
        if not self._share:
            return values
        return (1.0 - self._share) * values[..., :-1] + self._share * values[..., 1:]


@dataclass(frozen=True, slots=True)
class _Beam:
    """What is known along the beam, at the ranges that all channels have."""

    molecules: MolecularProfile
    station_altitude: float
    """m above mean sea level."""
    climb: float
    """m of height per m along the beam."""
    air: AirColumn
    cells: Cells
    settings: RamanSettings

    @property
    def altitude(self) -> Array:
        """Altitudes of the ranges, m."""
        return np.asarray(self.station_altitude + self.climb * self.air.range)

    @property
    def reference(self) -> _clouds.Reference:
        """Limits of the reference window along the beam."""
        return _clouds.Reference(**dict(self.settings.reference.along(self.air.stretch)))


def retrieve(
    elastic: xr.Dataset,
    raman: xr.Dataset,
    *,
    molecules: MolecularProfile,
    station_altitude: float,
    wavelengths: tuple[float, float],
    settings: RamanSettings,
    water: WaterVapour | None = None,
    overlap: Array | None = None,
    overlap_is_stated: bool = True,
) -> xr.Dataset:
    """Return the variables of the ``raman`` product of mean profiles.

    Parameters
    ----------
    elastic, raman : xr.Dataset
        Means over the same times: ``power``, ``variance``, ``quality`` over (time, range) and
        ``shots``, ``profiles`` over time, with the scalar coordinate ``zenith_angle`` (degree),
        from `lidarops.retrieve.signal.labeled_averaging.ClockAverage`; in memory. Bins of both
        have equal widths; ranges are those of `elastic`, to which `raman` is interpolated.
    molecules : MolecularProfile
    station_altitude : float
        m above mean sea level.
    wavelengths : (float, float)
        m, of the laser and of the Raman line of nitrogen.
    settings : RamanSettings
    water : WaterVapour, optional
    overlap : (range,) float, optional
        Overlap function at the ranges of `elastic`, common to all channels; NaN where it is not
        known.
    overlap_is_stated : bool
        As for `lidarops.retrieve.elastic.labeled.invert_elastic`: what a rise of the signal says.

    Returns
    -------
    xr.Dataset
        In memory, over (time, range) of cells. Where a value is NaN, a bit of the flags of its
        quantity gives the reason: ``quality_flag`` of extinction, else ``<name>_quality_flag``.

    Raises
    ------
    RetrievalInputError
        For invalid arguments.
    """
    climb = float(np.cos(np.deg2rad(elastic["zenith_angle"])))
    others = [raman] if water is None else [raman, water.averages]
    distance, bins = _common_bins(elastic, others, climb, station_altitude)
    if water is not None:
        # The calibration constant is one of signals in MHz.
        scaled = ~(analog_alone(raman) | analog_alone(water.averages))
        others[1] = water.averages.assign(power=water.averages["power"].where(scaled))
    channels = [
        _Channel(averages, part, distance)
        for averages, part in zip((elastic, *others), bins, strict=True)
    ]
    seen = np.ones(distance.size) if overlap is None else overlap[bins[0][0]]
    air = _air(molecules, station_altitude, climb, distance, wavelengths, settings, seen)
    highest = min(settings.highest * air.stretch, float(distance[-1]))
    cells = make_cells(distance, highest, settings.cell)
    beam = _Beam(molecules, station_altitude, climb, air, cells, settings)
    shapes = (air.backscatter * air.elastic_shape, air.raman_shape)
    (of_elastic, elastic_uncertain), (of_raman, raman_uncertain) = (
        channel.signal(shape, known_shape=settings.known_shape)
        for channel, shape in zip(channels[:2], shapes, strict=True)
    )
    elastic_bits, raman_bits = (
        _quality(cells, channel, seen, uncertain)
        for channel, uncertain in zip(channels, (elastic_uncertain, raman_uncertain), strict=False)
    )
    raman_bits |= elastic_bits & np.int32(Quality.INCOMPLETE_OVERLAP)
    result = retrieve_raman(of_raman, of_elastic, air, cells, settings, quality=raman_bits)
    stated = seen if overlap_is_stated or overlap is not None else np.full_like(seen, np.nan)
    clouds, near, in_mean = _cloud_variables(
        channels[0], result, beam, overlap_is_stated=overlap_is_stated
    )
    found = result.quality | near
    variables = {
        **_variables(result, beam),
        **_overlap(result, beam, of_raman, stated),
        **_clouds.window_variables(result.reference, beam.reference, station_altitude, climb),
        **clouds,
        "background": ("time", of_elastic.background),
        "background_standard_error": ("time", of_elastic.background_standard_error),
        "profiles": elastic["profiles"],
        "profiles_left_out": elastic.get("profiles_left_out", 0 * elastic["profiles"]),
        "shots": elastic["shots"],
    }
    if water is not None:
        of_water, doubtful = _water(water, channels[2], of_raman, result, beam)
        found[doubtful] |= np.int32(RamanQuality.DOUBTFUL_WATER_VAPOUR)
        variables |= of_water
    for quantity in CONCERNING:
        if quantity in variables:
            # Those of the main quantity are the flags of the product.
            own = "" if quantity == "aerosol_extinction" else f"{quantity}_"
            of_mean = in_mean if quantity in OF_MEANS else np.zeros_like(in_mean)
            bits = concerning(quantity, found | of_mean, elastic_bits)
            variables[f"{own}quality_flag"] = (_PLANE, bits)
    coords = {name: elastic[name] for name in elastic.coords if "range" not in elastic[name].dims}
    product = xr.Dataset(variables, coords={**coords, "range": ("range", cells.range)})
    return without_analog_background(product, elastic)


def _common_bins(
    elastic: xr.Dataset, others: list[xr.Dataset], climb: float, altitude: float
) -> tuple[Array, list[_Bins]]:
    """Return the ranges that all channels have, those of `elastic`, and the bins of each there."""
    distance = elastic["range"].to_numpy().astype(np.float64)
    width = float(np.median(np.diff(distance)))
    grids = [one["range"].to_numpy().astype(np.float64) for one in others]
    # Ranges of equal bins differ by rounding.
    leads = [round((distance[0] - grid[0]) / width, _DIGITS_OF_A_BIN) for grid in grids]
    shifts = [math.floor(lead) for lead in leads]
    shares = [lead - shift for lead, shift in zip(leads, shifts, strict=True)]
    needed = [shift + (share > 0.0) for shift, share in zip(shifts, shares, strict=True)]
    # An offset may give negative ranges, without light; above the atmosphere there is no air.
    nearest = [int(np.argmax(grid > 0)) - s for grid, s in zip(grids, shifts, strict=True)]
    first = max(0, *nearest)
    stop = min(distance.size, *(g.size - n for g, n in zip(grids, needed, strict=True)))
    inside = (distance > 0) & (altitude + climb * distance < HIGHEST)
    first = max(first, int(np.argmax(inside)))
    stop = min(stop, distance.size - int(np.argmax(inside[::-1])))
    bins = [(slice(first, stop), 0.0)]
    for shift, last, share in zip(shifts, needed, shares, strict=True):
        bins.append((slice(first + shift, stop + last), share))
    return distance[first:stop], bins


def _depth(
    molecules: MolecularProfile, altitude: Array, distance: Array, wavelength: float
) -> Array:
    """Return the optical depth of air from the lidar, by trapezoids."""
    extinction = molecules.extinction(altitude, wavelength)
    gained = 0.5 * (extinction[1:] + extinction[:-1]) * np.diff(distance)
    return np.asarray(extinction[0] * distance[0] + np.concatenate([[0.0], np.cumsum(gained)]))


def _air(
    molecules: MolecularProfile,
    station_altitude: float,
    climb: float,
    distance: Array,
    wavelengths: tuple[float, float],
    settings: RamanSettings,
    overlap: Array,
) -> AirColumn:
    laser, raman = wavelengths
    altitude, stretch = station_altitude + climb * distance, 1.0 / climb
    # Nitrogen is a share of dry air.
    density = molecules.dry_density(altitude)
    if settings.filter_width is not None:
        temperature = molecules.at(altitude)[1]
        density = density * nitrogen_line_share(temperature, laser, raman, settings.filter_width)
    slope_error = settings.molecular_slope_error
    if slope_error is None:
        of_source = THRESHOLDS.standard_slope_error, THRESHOLDS.sounding_slope_error
        slope_error = of_source[0] if molecules.standard else of_source[1]
    return AirColumn(
        distance,
        molecules.backscatter(altitude, laser),
        _depth(molecules, altitude, distance, laser),
        _depth(molecules, altitude, distance, raman),
        density,
        overlap,
        laser,
        raman,
        stretch,
        slope_error / stretch,
    )


def _quality(cells: Cells, channel: _Channel, overlap: Array, uncertain: Booleans) -> Flags:
    """Return the bits of cells: those of any bin, and INPUT_MISSING where all bins lack data."""
    parts = cells.split(channel.quality & np.int32(_BITS_OF_ANY_BIN))
    bits: Flags = np.bitwise_or.reduce(parts, axis=-1).astype(np.int32)
    bits[~cells.split(channel.known).any(axis=-1)] |= _MISSING
    unknown = np.isnan(cells.split(overlap)).any(axis=-1)
    bits[:, unknown] |= np.int32(Quality.INCOMPLETE_OVERLAP)
    bits[uncertain] |= np.int32(Quality.BACKGROUND_UNCERTAIN)
    return bits


def _variables(result: RamanResult, beam: _Beam) -> dict[str, Any]:
    profiles = {
        "aerosol_extinction": result.extinction,
        "aerosol_extinction_standard_error": result.extinction_standard_error,
        "aerosol_extinction_smoothing_error": result.extinction_smoothing_error,
        "aerosol_backscatter": result.backscatter,
        "aerosol_backscatter_standard_error": result.backscatter_standard_error,
        "lidar_ratio": result.lidar_ratio,
        "lidar_ratio_standard_error": result.lidar_ratio_standard_error,
        "lidar_ratio_error_random": result.lidar_ratio_random,
        "lidar_ratio_error_systematic": result.lidar_ratio_systematic,
        "vertical_resolution": result.vertical_resolution,
    }
    for cause, error in result.extinction_budget.items():
        profiles[f"aerosol_extinction_error_{cause}"] = error
    for cause, error in result.backscatter_budget.items():
        profiles[f"aerosol_backscatter_error_{cause}"] = error
    return {
        **{name: (_PLANE, values) for name, values in profiles.items()},
        "molecular_backscatter": ("range", beam.cells.mean(beam.air.backscatter)),
    }


def _cloud_variables(
    elastic: _Channel, result: RamanResult, beam: _Beam, *, overlap_is_stated: bool
) -> tuple[dict[str, Any], Flags, Flags]:
    """Return the clouds of the elastic signal, and their bits: near a cell, and in its mean."""
    cells, distance = beam.cells, beam.air.range
    laser = beam.air.wavelength
    means = _clouds.MeanProfiles(
        elastic.averages,
        distance,
        _clouds.air_along(beam.molecules, beam.altitude, distance, laser),
        beam.air.overlap,
        cloud_contrast(laser),
        elastic.noise,
    )
    _, clouds = _clouds.signal_and_clouds(
        means,
        elastic.averages,
        beam.reference,
        known_shape=beam.settings.known_shape,
        overlap_is_stated=overlap_is_stated,
    )
    state = state_of_cells(clouds.state, cells, _clouds.UNKNOWN)
    fraction = largest_of_cells(clouds.fraction, cells)
    # A cloud of most profiles is one of their mean as well.
    partly = (state == _clouds.PARTLY_CLOUDY) | ((fraction > 0.0) & (fraction < 1.0))
    near, in_mean = np.zeros((2, *result.quality.shape), np.int32)
    for mask, bit in (
        (partly, RamanQuality.PARTLY_CLOUDY),
        (state == _clouds.CLOUDY, RamanQuality.CLOUD),
    ):
        near[_clouds.with_margin(mask, cells.range)] |= np.int32(bit)
        in_mean[touched(mask, result.vertical_resolution, cells.step)] |= np.int32(bit)
    # Up to the last cell, beyond which no value has their bit.
    n = cells.stop
    heights = _clouds.cloud_heights(
        clouds.any[:, :n], distance[:n], beam.station_altitude, beam.climb
    )
    variables = {
        "cloud_mask": (_PLANE, state),
        "cloud_fraction": (_PLANE, fraction),
        **heights,
    }
    return variables, near, in_mean


def _overlap(
    result: RamanResult, beam: _Beam, raman: ChannelSignal, stated: Array
) -> dict[str, Any]:
    """Return the overlap of each profile: that of the campaign where it is stated.

    Below, it is measured by a signal that is not corrected for overlap.
    """
    air, cells, settings = beam.air, beam.cells, beam.settings
    of_cells = cells.mean(stated)
    error_of_cells = settings.overlap_relative_error * (1.0 - of_cells)
    unity = replace(air, overlap=np.ones(air.overlap.size))
    value, error = np.full((2, *result.quality.shape), np.nan)
    signals = cell_signals(raman, unity.raman_shape, cells)
    for row, (signal, bits) in enumerate(zip(signals, result.quality, strict=True)):
        partial = (bits & np.int32(Quality.INCOMPLETE_OVERLAP)) != 0
        measured, spread = overlap_of(
            signal.value,
            signal.variance,
            result.raman_depth[row],
            result.backscatter[row],
            (result.lidar_ratio[row], result.lidar_ratio_standard_error[row]),
            partial,
            cells.step,
            air.particle_ratio(settings.angstrom_exponent),
        )
        value[row] = np.where(partial, measured, of_cells)
        error[row] = np.where(partial, spread, error_of_cells)
    return {"overlap": (_PLANE, value), "overlap_standard_error": (_PLANE, error)}


def _water(
    water: WaterVapour,
    channel: _Channel,
    nitrogen: ChannelSignal,
    result: RamanResult,
    beam: _Beam,
) -> tuple[dict[str, Any], Booleans]:
    """Return the mixing ratio of water vapour with its errors, and the cells that are doubtful."""
    air, cells, settings = beam.air, beam.cells, beam.settings
    density = beam.molecules.dry_density(beam.altitude)
    depth = _depth(beam.molecules, beam.altitude, air.range, water.wavelength)
    # The share of the lines of nitrogen that the filter passes is not that of water vapour.
    shape = replace(air, raman_depth=depth, density=density)
    vapour, uncertain = channel.signal(shape.raman_shape, known_shape=settings.known_shape)
    share = air.density / density
    errors = (
        water.constant_standard_error / water.constant,
        settings.molecular_relative_error * cells.mean(air.raman_depth - depth),
        # That of water vapour is not known: assumed to change by as much.
        cells.mean(share / share[0] - 1.0),
    )
    partial = (result.quality & np.int32(Quality.INCOMPLETE_OVERLAP)) != 0
    lines = air.wavelength, air.raman_wavelength, water.wavelength
    particles = particle_transmission(settings, *lines)
    value, random, systematic = np.full((3, *result.quality.shape), np.nan)
    signals = (
        cell_signals(nitrogen, air.raman_shape, cells),
        cell_signals(vapour, shape.raman_shape, cells),
    )
    for row, (of_nitrogen, of_water) in enumerate(zip(*signals, strict=True)):
        found = mixing_ratio(
            of_water,
            of_nitrogen,
            (result.raman_depth[row], result.raman_depth_error[row]),
            partial[row],
            constant=water.constant,
            particles=particles,
            relative_errors=errors,
        )
        value[row], random[row], systematic[row] = found.value, found.random, found.systematic
    names = ("", "_standard_error", "_error_random", "_error_systematic")
    arrays = (value, np.hypot(random, systematic), random, systematic)
    doubted = cells.split((channel.quality & np.int32(_DOUBTED)) != 0).any(axis=-1)
    doubtful = np.isnan(value) | doubted | uncertain[:, np.newaxis]
    return {
        f"water_vapour_mixing_ratio{name}": (_PLANE, array)
        for name, array in zip(names, arrays, strict=True)
    }, doubtful
