"""The elastic retrieval of mean profiles in xarray.

In this order: outlying bins, background, clouds of the mean and of its parts, reference window,
inversion, quality flags.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.flags import Quality
from lidarops.retrieve.air import reference_window as _reference
from lidarops.retrieve.air.molecular import HIGHEST, MolecularProfile
from lidarops.retrieve.air.thresholds import THRESHOLDS as WINDOW_THRESHOLDS
from lidarops.retrieve.background import cubic_and_tail, estimate
from lidarops.retrieve.background import known_shape as _known_shape
from lidarops.retrieve.elastic import inversion as _elastic
from lidarops.retrieve.elastic import layers as _layers
from lidarops.retrieve.elastic import outlying_bins as _outlying_bins
from lidarops.retrieve.elastic.flags import ElasticQuality
from lidarops.retrieve.elastic.thresholds import THRESHOLDS
from lidarops.retrieve.signal.labeled import actual_noise, counts_per_power, dead_time_error
from lidarops.retrieve.signal.screening import cloud_contrast

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]
RatioAt = Callable[[Array], tuple[Array, Array]]
"""Altitudes in m -> lidar ratio and its standard error, sr."""

_CARRIED: Final = int(
    Quality.INPUT_MISSING
    | Quality.SATURATED
    | Quality.PILE_UP
    | Quality.INCOMPLETE_OVERLAP
    | Quality.NO_GLUING
)
_WITHHELD: Final = int(
    Quality.INPUT_MISSING | Quality.SATURATED | Quality.INCOMPLETE_OVERLAP | Quality.NO_GLUING
)
_OUTLIER: Final = np.int32(Quality.OUTLIER)
_PARTS: Final = ("part_power", "part_variance")
_INCOMPLETE_OVERLAP: Final = np.int32(Quality.INCOMPLETE_OVERLAP)
_UNKNOWN_OVERLAP: Final = np.int32(ElasticQuality.UNKNOWN_OVERLAP)


@dataclass(frozen=True, slots=True)
class Reference:
    """Search range of the reference window, and the scattering ratio assumed in it."""

    lowest: float
    """m along the beam."""
    highest: float
    """m along the beam."""
    width: float
    """m along the beam."""
    scattering_ratio: float
    relative_error: float
    """Relative standard error of the scattering ratio."""


@dataclass(frozen=True, slots=True)
class _Air:
    """Molecular optical properties along the beam, (range,)."""

    backscatter: Array
    """m-1 sr-1."""
    extinction: Array
    """m-1."""
    shape: Array
    """Attenuated backscatter over the square of range, m-3 sr-1."""


@dataclass(frozen=True, slots=True)
class _Signal:
    """Profiles without background, the background and its standard error."""

    power: Array
    background: Array
    background_standard_error: Array
    uncertain: Mask


@dataclass(frozen=True, slots=True)
class _Clouds:
    """Clouds of means, (time, range)."""

    mask: Mask
    """Clouds of the mean, or of all profiles in it."""
    fraction: Array
    """Share of the profiles with a cloud; NaN where only the mean shows it, or is examined."""
    unknown: Mask
    """Bins in which neither the mean nor a part of it can show a cloud."""

    @property
    def state(self) -> npt.NDArray[np.int8]:
        """0 clear, 1 partly cloudy, 2 cloudy, 3 unknown."""
        return np.where(self.unknown, np.int8(3), self.mask + self.any.astype(np.int8))

    @property
    def partly(self) -> Mask:
        """Bins that are cloudy in some of the profiles, but not in the mean."""
        return np.asarray((self.fraction > 0.0) & ~self.mask)

    @property
    def any(self) -> Mask:
        """Bins that are cloudy in some profiles or the mean."""
        return np.asarray(self.mask | self.partly)


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
        their parts, from `lidarops.retrieve.signal.labeled_screening.ScreenedAverage`, clouds are
        sought in these too, else in the mean only. For the error of the
        dead time, see `lidarops.retrieve.signal.labeled.dead_time_error`.
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
    air = _air(molecules, station_altitude + climb * distance, distance, wavelength)
    ratio, ratio_error = lidar_ratio(station_altitude + climb * distance)
    quality = averages["quality"].to_numpy() & np.int32(_CARRIED)
    means = _Means(averages, distance, air, quality, overlap, cloud_contrast(wavelength))
    signal, clouds = _signal_and_clouds(
        means, averages, reference, known_shape=known_shape, overlap_is_stated=overlap_is_stated
    )
    window = _window(signal, means, reference, clouds.any)
    solution = _elastic.invert_elastic(
        signal.power,
        distance,
        molecular_backscatter=air.backscatter,
        molecular_extinction=air.extinction,
        lidar_ratio=ratio,
        reference=window.edges,
        reference_scattering_ratio=reference.scattering_ratio,
        variance=means.variance,
        background_standard_error=signal.background_standard_error,
        lidar_ratio_standard_error=ratio_error,
        reference_relative_error=_reference_error(window, reference),
        molecular_relative_error=molecular_relative_error,
        dead_time_error=_dead_time_error(averages, means, signal),
        noise_correlation_length=means.correlation_length,
    )
    quality = means.quality
    heights = _cloud_heights(clouds.any, distance)
    quality |= _solution_flags(solution, window, signal, quality)
    cloudy = _with_beyond(clouds.mask, distance, window)
    for mask, bit in (
        (cloudy, ElasticQuality.CLOUD),
        (_with_beyond(clouds.partly, distance, window) & ~cloudy, ElasticQuality.PARTLY_CLOUDY),
        (_with_beyond(_negative(solution), distance, window), ElasticQuality.NEGATIVE_BACKSCATTER),
    ):
        quality |= mask.astype(np.int32) * np.int32(bit)
    profiles = {
        name: np.where(solution.valid, values, np.nan)
        for name, values in _profile_variables(solution).items()
    }
    return xr.Dataset(
        {
            **{name: (("time", "range"), values) for name, values in profiles.items()},
            "molecular_backscatter": ("range", air.backscatter),
            "molecular_extinction": ("range", air.extinction),
            "lidar_ratio": ("range", ratio),
            "lidar_ratio_standard_error": ("range", ratio_error),
            "vertical_resolution": float(np.median(np.diff(distance))),
            "reference_bottom": ("time", window.bottom),
            "reference_top": ("time", window.top),
            "reference_bottom_altitude": ("time", station_altitude + climb * window.bottom),
            "reference_top_altitude": ("time", station_altitude + climb * window.top),
            "reference_scattering_ratio": reference.scattering_ratio,
            "reference_scattering_ratio_standard_error": (
                reference.scattering_ratio * reference.relative_error
            ),
            "reference_detection_limit": (
                "time",
                np.where(np.isinf(window.detection_limit), np.nan, window.detection_limit),
            ),
            "reference_rejections": (
                "time",
                np.bitwise_or.reduce(window.rejections, axis=-1).astype(np.int32),
            ),
            "cloud_mask": (("time", "range"), clouds.state),
            "cloud_fraction": (("time", "range"), clouds.fraction),
            "cloud_base_range": ("time", heights[0]),
            "cloud_base_altitude": ("time", station_altitude + climb * heights[0]),
            "cloud_top_altitude": ("time", station_altitude + climb * heights[1]),
            "background": ("time", signal.background),
            "background_standard_error": ("time", signal.background_standard_error),
            "quality_flag": (("time", "range"), quality),
            "profiles": averages["profiles"],
            "profiles_left_out": averages.get("profiles_left_out", 0 * averages["profiles"]),
            "shots": averages["shots"],
        },
        coords={name: averages[name] for name in averages.coords},
    )


def _air(molecules: MolecularProfile, altitude: Array, distance: Array, wavelength: float) -> _Air:
    extinction = molecules.extinction(altitude, wavelength)
    backscatter = molecules.backscatter(altitude, wavelength)
    shape = _known_shape.molecular_shape(backscatter, extinction, distance)
    return _Air(backscatter, extinction, shape)


class _Means:
    """Mean profiles with their background, outlying bins replaced."""

    def __init__(
        self,
        averages: xr.Dataset,
        distance: Array,
        air: _Air,
        quality: Flags,
        overlap: Array | None,
        contrast: float,
    ) -> None:
        self.distance, self.air, self.contrast = distance, air, contrast
        self.overlap = np.ones(distance.size) if overlap is None else overlap
        partial = np.where(np.isnan(self.overlap), int(Quality.INCOMPLETE_OVERLAP), 0)
        self.quality = quality | partial.astype(np.int32)
        self.raw = averages["power"].to_numpy()
        noise = actual_noise(averages)
        length = noise.correlation_length
        self.noise, self.correlation_length = noise.variance, length
        counts = counts_per_power(averages, averages["shots"].to_numpy())
        self.exposure = None if counts is None else counts / (noise.excess * length)
        self.quantum = _quantum(averages)
        self._bridge_outliers()
        self.variance = self.noise / self.overlap**2
        self.partly = np.zeros(self.raw.shape, dtype=np.bool_)
        """Bins in clouds of some profiles of a mean; see `_with_parts`."""

    def _bridge_outliers(self) -> None:
        """Replace outlying bins before the background and the window depend on them."""
        rough = cubic_and_tail.tail_mean(self.raw, self.distance, variance=self.noise).background
        usable = np.where((self.quality & _WITHHELD) != 0, np.nan, self.raw)
        bridged = _outlying_bins.bridge_outliers(
            usable, self.distance, self.noise, background=np.nan_to_num(rough, nan=0.0)
        )
        self.raw = np.where(bridged.outlying, bridged.power, self.raw)
        self.noise = np.where(bridged.outlying, bridged.variance, self.noise)
        self.quality = self.quality | np.where(bridged.outlying, _OUTLIER, np.int32(0))

    def minus(self, background: Array) -> Array:
        """Return the signal without background, corrected for overlap."""
        power = (self.raw - background[:, np.newaxis]) / self.overlap
        return np.where((self.quality & _WITHHELD) != 0, np.nan, power)

    def ratio_to_air(self, power: Array) -> tuple[Array, Array]:
        """Return the ratio of a signal to air and its error, in means over the bins before each."""
        step = float(np.median(np.diff(self.distance)))
        size = max(round(THRESHOLDS.overlap_length / step), 1)
        known = np.isfinite(power)

        def summed(values: Array) -> Array:
            total = np.cumsum(np.where(known, values, 0.0), axis=-1)
            total[:, size:] -= total[:, :-size].copy()
            return total

        air = summed(self.air.shape)
        air[air <= 0.0] = np.nan
        return summed(power) / air, np.sqrt(summed(self.variance)) / air

    def find_clouds(self, power: Array) -> _layers.Layers:
        """Return the clouds of a signal without background."""
        return _layers.find_layers(
            power,
            self.distance,
            self.variance,
            molecular_attenuated=self.air.shape,
            contrast=self.contrast,
            quantum=self.quantum,
        )


def _quantum(averages: xr.Dataset) -> npt.ArrayLike:
    """Return the power of a single count in a bin of each mean, (time,); 0 of analog records."""
    counts = counts_per_power(averages, averages["shots"].to_numpy(), glued=True)
    return 0.0 if counts is None else 1.0 / counts


def _signal_and_clouds(
    means: _Means,
    averages: xr.Dataset,
    reference: Reference,
    *,
    known_shape: bool,
    overlap_is_stated: bool,
) -> tuple[_Signal, _Clouds]:
    """Return signals without background, and their clouds, with incomplete overlap flagged."""
    signal, layers, doubtful = _signal_beyond_overlap(
        means, reference, known_shape=known_shape, overlap_is_stated=overlap_is_stated
    )
    fraction = np.where(doubtful, np.nan, _cloud_fraction(averages, means))
    means.partly = (fraction > 0.0) & ~layers.mask
    if means.partly.any():
        signal, layers = _signal_beyond_clouds(means, known_shape=known_shape)
    mask = (layers.mask | (fraction == 1.0)) & ~doubtful
    unknown = (doubtful | ~np.isfinite(signal.power)) & ~mask & np.isnan(fraction)
    return signal, _Clouds(mask, np.where(mask & (fraction == 0.0), np.nan, fraction), unknown)


def _cloud_fraction(averages: xr.Dataset, means: _Means) -> Array:
    """Return the share of the profiles of each mean that lie in parts with a cloud, (time, range).

    Only profiles in parts with data count; NaN where there are none, and beyond the last whole
    cell. The false-alarm rate is that of a mean.
    """
    fraction = np.full(means.raw.shape, np.nan)
    if "part_power" not in averages:
        return fraction
    bins = int(averages["part_power"].attrs["bins"])
    profiles = averages["part_profiles"].to_numpy()
    cells = min(averages.sizes["cell"], means.distance.size // bins)

    def mean_of_bins(values: Array) -> Array:
        in_cells = values[..., : cells * bins].reshape(*values.shape[:-1], cells, bins)
        return np.asarray(in_cells.mean(axis=-1))

    withheld = mean_of_bins(((means.quality & _WITHHELD) != 0).astype(float)) > 0.5
    # The overlap is in the air instead of the signal, of which a count is one quantum everywhere.
    seen_air = mean_of_bins(means.overlap * means.air.shape)
    power, variance = (averages[name].to_numpy()[..., :cells] for name in _PARTS)
    withheld |= np.isnan(seen_air)
    power = np.where(withheld[:, np.newaxis], np.nan, power)
    there = profiles > 0
    found = _layers.find_layers(
        power[there],
        mean_of_bins(means.distance),
        variance[there],
        molecular_attenuated=np.nan_to_num(seen_air),
        contrast=means.contrast,
        false_alarm=THRESHOLDS.cloud_false_alarm / profiles.shape[1],
        quantum=averages["part_quantum"].to_numpy()[there],
    )
    cloudy = np.zeros((*profiles.shape, cells), dtype=np.bool_)
    cloudy[there] = found.mask
    # A cloud may span cells without data.
    examined = np.isfinite(power) | cloudy
    with_cloud, of_all = (
        (parts * profiles[..., np.newaxis]).sum(axis=1) for parts in (cloudy, examined)
    )
    share = np.where(of_all > 0, with_cloud / np.maximum(of_all, 1), np.nan)
    fraction[:, : cells * bins] = np.repeat(share, bins, axis=-1)
    return fraction


def _cloud_heights(mask: Mask, distance: Array) -> tuple[Array, Array]:
    """Return the ranges at which the lowest cloud begins and the highest one ends; NaN for none."""
    cloudy = mask.any(axis=-1)
    base = distance[np.argmax(mask, axis=-1)]
    top = distance[mask.shape[-1] - 1 - np.argmax(mask[:, ::-1], axis=-1)]
    return np.where(cloudy, base, np.nan), np.where(cloudy, top, np.nan)


def _signal_beyond_overlap(
    means: _Means, reference: Reference, *, known_shape: bool, overlap_is_stated: bool
) -> tuple[_Signal, _layers.Layers, Mask]:
    """Return signals without background, their layers, and those that may be the overlap's."""
    signal, clouds = _signal_beyond_clouds(means, known_shape=known_shape)
    near = clouds.mask & _begin_before(clouds.mask, means.distance < reference.lowest)
    nowhere = np.zeros_like(near)
    if not near.any():
        return signal, clouds, nowhere
    window = _window(signal, means, reference, clouds.mask & ~near)
    ratio, error = means.ratio_to_air(signal.power)
    partial = _less_than_air(ratio, error, near, window, means.distance)
    if partial.any():
        means.quality = means.quality | np.where(partial, _INCOMPLETE_OVERLAP, np.int32(0))
        clouds = _signal_beyond_clouds(means, known_shape=known_shape)[1]
        means.quality = means.quality | _overlap_bits(ratio, partial, clouds.mask, window, means)
        signal, clouds = _signal_beyond_clouds(means, known_shape=known_shape)
    if overlap_is_stated:
        return signal, clouds, nowhere
    # Without clean air to compare with, a rise may as well be that of the overlap.
    doubtful = near & ~window.chosen[:, np.newaxis]
    means.quality = means.quality | np.where(doubtful, _UNKNOWN_OVERLAP, np.int32(0))
    return signal, _layers.Layers.of(clouds.mask & ~doubtful, means.distance), doubtful


def _signal_beyond_clouds(means: _Means, *, known_shape: bool) -> tuple[_Signal, _layers.Layers]:
    """Return signals without background, and their clouds."""
    signal = _subtract_background(means, np.ones_like(means.raw, bool), known_shape=known_shape)
    clouds = means.find_clouds(signal.power)
    cloudy = clouds.mask | means.partly
    if not known_shape or not cloudy.any():
        return signal, clouds
    # Only beyond the cloud does the signal have the shape of air: fit the background there.
    step = float(np.median(np.diff(means.distance)))
    hidden = np.zeros_like(cloudy)
    margin = min(round(THRESHOLDS.cloud_margin / step), hidden.shape[1])
    hidden[:, margin:] = cloudy[:, : hidden.shape[1] - margin]
    hidden |= cloudy
    beyond = ~np.logical_or.accumulate(hidden[:, ::-1], axis=-1)[:, ::-1]
    enough = beyond.sum(axis=-1) >= THRESHOLDS.least_share_beyond * means.distance.size
    refitted = cloudy.any(axis=-1) & enough
    signal = _subtract_background(means, beyond | ~refitted[:, np.newaxis], known_shape=True)
    return signal, means.find_clouds(signal.power)


def _less_than_air(
    ratio: Array, error: Array, near: Mask, window: _reference.ReferenceWindow, distance: Array
) -> Mask:
    """Return the bins up to the last one before the window with less light than its air gives.

    Empty where no layer of `near` begins beyond such a bin: other causes lessen the signal, too.
    """
    level, level_error, bottom = (
        values[:, np.newaxis]
        for values in (window.scale, window.scale_standard_error, window.bottom)
    )
    less = level - ratio > THRESHOLDS.negative * np.hypot(error, level_error)
    less &= distance < bottom
    nearer = np.logical_or.accumulate(less, axis=-1)
    rises = np.any(_begins(near) & nearer, axis=-1, keepdims=True)
    return np.asarray(rises & np.logical_or.accumulate(less[:, ::-1], axis=-1)[:, ::-1])


def _overlap_bits(
    ratio: Array, partial: Mask, clouds: Mask, window: _reference.ReferenceWindow, means: _Means
) -> Flags:
    """Return the bits of overlap of profiles in which it is partial.

    It is incomplete up to the largest ratio to air below the first cloud, and may be so farther
    away, where particles decrease.
    """
    before = means.distance < np.nan_to_num(window.bottom)[:, np.newaxis]
    clear = before & ~np.logical_or.accumulate(clouds, axis=-1)
    highest = np.where(clear, np.nan_to_num(ratio, nan=-np.inf), -np.inf).argmax(axis=-1)
    nearer = np.arange(ratio.shape[-1]) < highest[:, np.newaxis]
    bits = np.where(nearer, _INCOMPLETE_OVERLAP, _UNKNOWN_OVERLAP)
    return np.where(before & partial.any(axis=-1, keepdims=True), bits, 0).astype(np.int32)


def _begin_before(mask: Mask, near: Mask) -> Mask:
    """Return whether the last run of a mask that began up to a bin began near."""
    begin = np.where(_begins(mask), np.arange(near.size), 0)
    return np.asarray(near[np.maximum.accumulate(begin, axis=-1)])


def _begins(mask: Mask) -> Mask:
    """Return the first bins of the runs of a mask."""
    return np.asarray(np.diff(mask.astype(np.int8), axis=-1, prepend=0) == 1)


def _subtract_background(means: _Means, usable: Mask, *, known_shape: bool) -> _Signal:
    noise, r = means.noise * means.correlation_length[:, np.newaxis], means.distance
    # The mean of a bin that was saturated in some profiles is that of the others.
    raw = np.where((means.quality & np.int32(Quality.SATURATED)) != 0, np.nan, means.raw)
    if not known_shape:
        sky = estimate.from_tail(raw, r, noise)
    else:
        sky = estimate.from_known_shape(
            raw, r, noise, means.air.shape, mask=usable, exposure=means.exposure
        )
    return _Signal(means.minus(sky.background), sky.background, sky.standard_error, sky.uncertain)


def _dead_time_error(averages: xr.Dataset, means: _Means, signal: _Signal) -> Array:
    """Return the change of the signal with one standard error of the dead time."""
    bridged = averages.assign(power=averages["power"].copy(data=means.raw))
    change = dead_time_error(bridged, xr.DataArray(signal.background, dims="time"))
    if change is None:
        return np.zeros(1)
    array = change.transpose("time", "range").to_numpy() / means.overlap
    return np.nan_to_num(array, posinf=0.0, neginf=0.0)


def _reference_error(window: _reference.ReferenceWindow, reference: Reference) -> Array:
    """Return the relative error of the scattering ratio: assumed, and by undetected particles."""
    return np.hypot(reference.relative_error, np.nan_to_num(window.undetected_particles))


def _window(
    signal: _Signal, means: _Means, reference: Reference, clouds: Mask
) -> _reference.ReferenceWindow:
    highest = min(reference.highest, float(means.distance[-1]))
    width = min(reference.width, highest - reference.lowest)
    candidates = _reference.candidate_windows(
        reference.lowest, highest, width, reference.width / WINDOW_THRESHOLDS.steps_per_window
    )
    return _reference.choose_reference(
        signal.power,
        means.distance,
        means.variance * means.correlation_length[:, np.newaxis],
        molecular_attenuated=means.air.shape,
        candidates=candidates,
        background_standard_error=np.nan_to_num(signal.background_standard_error),
        exclude=clouds,
    )


def _solution_flags(
    solution: _elastic.ElasticResult,
    window: _reference.ReferenceWindow,
    signal: _Signal,
    quality: Flags,
) -> Flags:
    """Return the bits of reference, background and inversion."""
    bits = np.zeros(solution.valid.shape, dtype=np.int32)
    bits[~window.chosen] |= np.int32(ElasticQuality.NO_REFERENCE)
    bits[signal.uncertain] |= np.int32(Quality.BACKGROUND_UNCERTAIN)
    unsolved = window.chosen[:, np.newaxis] & ~solution.valid & ((quality & _WITHHELD) == 0)
    bits[unsolved] |= np.int32(ElasticQuality.UNSTABLE_INVERSION)
    return bits


def _negative(solution: _elastic.ElasticResult) -> Mask:
    """Return where runs of bins have a backscatter that lies below zero by more than its error."""
    error: Array = solution.budget.total
    low = solution.valid & (solution.backscatter < -THRESHOLDS.negative * error)
    length = THRESHOLDS.negative_bins
    if low.shape[-1] < length:
        return np.zeros_like(low)
    runs = np.lib.stride_tricks.sliding_window_view(low, length, axis=-1).all(axis=-1)
    negative = np.zeros_like(low)
    for first in range(length):
        negative[:, first : first + runs.shape[-1]] |= runs
    return negative


def _with_beyond(mask: Mask, distance: Array, window: _reference.ReferenceWindow) -> Mask:
    """Return the bins of a mask, and those beyond one as seen from the reference window.

    The inversion starts in the window. Beyond a cloud it depends on the lidar ratio of aerosol
    that was assumed in the cloud.
    """
    bottom = np.nan_to_num(window.bottom, nan=0.0)[:, np.newaxis]
    near, far = distance < bottom, distance >= bottom
    above = np.logical_or.accumulate(mask & far, axis=-1)
    below = np.logical_or.accumulate((mask & near)[:, ::-1], axis=-1)[:, ::-1]
    return np.asarray(above | below)


def _profile_variables(solution: _elastic.ElasticResult) -> dict[str, Array]:
    budget: Any = solution.budget
    return {
        "aerosol_backscatter": solution.backscatter,
        "aerosol_backscatter_standard_error": budget.total,
        **{
            f"aerosol_backscatter_error_{cause}": getattr(budget, cause)
            for cause in (
                "noise",
                "background",
                "reference",
                "lidar_ratio",
                "molecular",
                "dead_time",
            )
        },
        "aerosol_extinction": solution.extinction,
        "aerosol_extinction_standard_error": solution.extinction_budget.total,
        "scattering_ratio": solution.scattering_ratio,
        "scattering_ratio_standard_error": solution.scattering_ratio_budget.total,
        "attenuated_backscatter": solution.attenuated_backscatter,
        "attenuated_backscatter_standard_error": solution.attenuated_backscatter_standard_error,
    }
