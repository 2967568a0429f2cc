"""Mean profiles of elastic signals in xarray: their background, clouds and reference window.

In this order: outlying bins, background, clouds of the mean and of its parts, the overlap where a
rise may be that of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.flags import WITHHELD, Quality
from lidarops.retrieve.air import reference_window as _reference
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.air.reference_window import THRESHOLDS as WINDOW_THRESHOLDS
from lidarops.retrieve.background import cubic_and_tail, estimate
from lidarops.retrieve.background import known_shape as _known_shape
from lidarops.retrieve.background.thresholds import THRESHOLDS as BACKGROUND
from lidarops.retrieve.clouds import layers as _layers
from lidarops.retrieve.clouds import outlying_bins as _outlying_bins
from lidarops.retrieve.clouds.thresholds import THRESHOLDS
from lidarops.retrieve.common.arrays import Array, Booleans
from lidarops.retrieve.common.thresholds import THRESHOLDS as COMMON
from lidarops.retrieve.signal.labeled import (
    ActualNoise,
    actual_noise,
    background_before,
    baseline_error,
    counts_per_power,
)
from lidarops.settings import quantity

_CARRIED: Final = WITHHELD | int(Quality.PILE_UP | Quality.SINGLE_RECORD)
_OUTLIER: Final = np.int32(Quality.OUTLIER)
PARTLY_CLOUDY: Final = 1
CLOUDY: Final = 2
UNKNOWN: Final = 3
"""States of a bin (`Clouds.state`)."""
_PARTS: Final = ("part_power", "part_variance")
_INCOMPLETE_OVERLAP: Final = np.int32(Quality.INCOMPLETE_OVERLAP)


@dataclass(frozen=True, slots=True)
class Reference:
    """Search range of the reference window, and the scattering ratio assumed in it."""

    lowest: Annotated[float, quantity(unit="m", description="along the beam")]
    highest: Annotated[float, quantity(unit="m", description="along the beam")]
    width: Annotated[float, quantity(unit="m", description="along the beam")]
    scattering_ratio: float
    relative_error: float
    """Relative standard error of the scattering ratio."""


@dataclass(frozen=True, slots=True)
class Air:
    """Molecular optical properties along the beam, (range,)."""

    backscatter: Array
    """m-1 sr-1."""
    extinction: Array
    """m-1."""
    shape: Array
    """Attenuated backscatter over the square of range, m-3 sr-1."""


@dataclass(frozen=True, slots=True)
class MeanSignal:
    """Profiles without background, the background and its standard error."""

    power: Array
    background: Array
    background_standard_error: Array
    uncertain: Booleans


@dataclass(frozen=True, slots=True)
class Clouds:
    """Clouds of means, (time, range)."""

    mask: Booleans
    """Clouds of the mean, or of all profiles in it."""
    fraction: Array
    """Share of the profiles with a cloud; NaN where only the mean shows it, or is examined, and
    where noise would hide one."""
    unknown: Booleans
    """Bins in which neither the mean nor a part of it can show a cloud, or noise would hide it."""

    @property
    def state(self) -> npt.NDArray[np.int8]:
        """0 clear, `PARTLY_CLOUDY`, `CLOUDY`, `UNKNOWN`."""
        return np.where(self.unknown, np.int8(UNKNOWN), self.mask + self.any.astype(np.int8))

    @property
    def partly(self) -> Booleans:
        """Bins that are cloudy in some of the profiles, but not in the mean."""
        return np.asarray((self.fraction > 0.0) & ~self.mask)

    @property
    def any(self) -> Booleans:
        """Bins that are cloudy in some profiles or the mean."""
        return np.asarray(self.mask | self.partly)


def air_along(
    molecules: MolecularProfile, altitude: Array, distance: Array, wavelength: float
) -> Air:
    """Return clean air at altitudes in m and at distances from the lidar in m, (range,)."""
    extinction = molecules.extinction(altitude, wavelength)
    backscatter = molecules.backscatter(altitude, wavelength)
    shape = _known_shape.molecular_shape(backscatter, extinction, distance)
    return Air(backscatter, extinction, shape)


class MeanProfiles:
    """Mean profiles whose outlying bins are replaced.

    Parameters
    ----------
    averages : xr.Dataset
        As for `lidarops.retrieve.elastic.labeled.invert_elastic`.
    distance : (range,) float
        m, of the bins of the averages, all positive.
    air : Air
    overlap : (range,) float, optional
        NaN where it is not known.
    contrast : float
        Least contrast of a cloud (`lidarops.retrieve.signal.averaging.cloud_contrast`).
    noise : ActualNoise, optional
        Of the averages, where it is known already.
    """

    def __init__(
        self,
        averages: xr.Dataset,
        distance: Array,
        air: Air,
        overlap: Array | None,
        contrast: float,
        noise: ActualNoise | None = None,
    ) -> None:
        self.distance, self.air, self.contrast = distance, air, contrast
        self.overlap = np.ones(distance.size) if overlap is None else overlap
        partial = np.where(np.isnan(self.overlap), int(Quality.INCOMPLETE_OVERLAP), 0)
        quality = averages["quality"].to_numpy() & np.int32(_CARRIED)
        self.quality = quality | partial.astype(np.int32)
        self.raw, self.sky = averages["power"].to_numpy(), background_before(averages)
        noise = noise or actual_noise(averages)
        length = noise.correlation_length
        self.noise, self.correlation_length = noise.variance, length
        shots = averages["shots"].to_numpy()
        counts = counts_per_power(averages, shots)
        self.exposure = None if counts is None else counts / (noise.excess * length)
        of_glued = counts_per_power(averages, shots, glued=True)
        self.quantum: npt.ArrayLike = 0.0 if of_glued is None else 1.0 / of_glued
        """Power of a single count in a bin of each mean, (time,); 0 of analog records."""
        self._bridge_outliers()
        self.variance = self.noise / self.overlap**2
        baseline = baseline_error(averages)
        of_baseline = 0.0 if baseline is None else baseline.transpose("time", "range").to_numpy()
        self.baseline_error = np.asarray(of_baseline / self.overlap)
        self.partly = np.zeros(self.raw.shape, dtype=np.bool_)
        """Bins in clouds of some profiles of a mean."""
        self.unknown_overlap = np.zeros(self.raw.shape, dtype=np.bool_)
        """Bins in which the overlap may be incomplete."""

    def _bridge_outliers(self) -> None:
        """Replace outlying bins before the background and the window depend on them."""
        rough = cubic_and_tail.tail_mean(self.raw, self.distance, variance=self.noise).background
        usable = np.where((self.quality & WITHHELD) != 0, np.nan, self.raw)
        bridged = _outlying_bins.bridge_outliers(
            usable, self.distance, self.noise, background=np.nan_to_num(rough, nan=0.0)
        )
        self.raw = np.where(bridged.outlying, bridged.power, self.raw)
        self.noise = np.where(bridged.outlying, bridged.variance, self.noise)
        self.quality = self.quality | np.where(bridged.outlying, _OUTLIER, np.int32(0))

    def reject_overlap(self, partial: Booleans) -> None:
        """Flag bins in which the overlap is incomplete."""
        self.quality = self.quality | np.where(partial, _INCOMPLETE_OVERLAP, np.int32(0))

    def ratio_to_air(self, power: Array) -> tuple[Array, Array]:
        """Return the ratio of a signal to air and its error, in means over the bins before each."""
        step = float(np.median(np.diff(self.distance)))
        size = max(round(THRESHOLDS.window_lengths[0] / step), 1)
        known = np.isfinite(power)

        def summed(values: Array) -> Array:
            total = np.cumsum(np.where(known, values, 0.0), axis=-1)
            total[:, size:] -= total[:, :-size].copy()
            return total

        air = summed(self.air.shape)
        air[air <= 0.0] = np.nan
        return summed(power) / air, np.sqrt(summed(self.variance)) / air

    @property
    def cloud(self) -> dict[str, Any]:
        """What a cloud differs from, and by how much."""
        return {
            "molecular_attenuated": self.air.shape,
            "contrast": self.contrast,
            "quantum": self.quantum,
        }

    def find_clouds(self, power: Array) -> Booleans:
        """Return the bins in clouds of a signal without background."""
        return _layers.find_layers(power, self.distance, self.variance, **self.cloud)


def signal_and_clouds(
    means: MeanProfiles,
    averages: xr.Dataset,
    reference: Reference,
    *,
    known_shape: bool,
    overlap_is_stated: bool,
) -> tuple[MeanSignal, Clouds]:
    """Return signals without background, and their clouds, with incomplete overlap flagged."""
    signal, layers, doubtful = _signal_beyond_overlap(
        means, reference, known_shape=known_shape, overlap_is_stated=overlap_is_stated
    )
    fraction = np.where(doubtful, np.nan, _cloud_fraction(averages, means))
    means.partly = (fraction > 0.0) & ~layers
    if means.partly.any():
        signal, layers = _signal_beyond_clouds(means, known_shape=known_shape)
    mask = (layers | (fraction == 1.0)) & ~doubtful
    unknown = (doubtful | ~np.isfinite(signal.power)) & ~mask & np.isnan(fraction)
    clouds = Clouds(mask, fraction, unknown)
    visible = _layers.find_visible_air(
        signal.power, means.distance, means.variance, cloudy=clouds.any, **means.cloud
    )
    unknown |= np.isfinite(signal.power) & ~visible & ~clouds.any
    fraction = np.where((mask | unknown) & (fraction == 0.0), np.nan, fraction)
    return signal, Clouds(mask, fraction, unknown)


def _cloud_fraction(averages: xr.Dataset, means: MeanProfiles) -> Array:
    """Return the share of the profiles of each mean that lie in parts with a cloud, (time, range).

    Only profiles in parts with data count; NaN where there are none, and beyond the last whole
    cell. The false-alarm rate is that of a mean.
    """
    fraction = np.full(means.raw.shape, np.nan)
    if "part_power" not in averages:
        return fraction
    profiles = averages["part_profiles"].to_numpy()
    bins, inside, examined_cells = _cells_in(averages, means.distance)
    cells = examined_cells.stop - examined_cells.start

    def mean_of_bins(values: Array) -> Array:
        in_cells = values[..., inside].reshape(*values.shape[:-1], cells, bins)
        return np.asarray(in_cells.mean(axis=-1))

    withheld = mean_of_bins(((means.quality & WITHHELD) != 0).astype(float)) > 0.5
    # The overlap is in the air instead of the signal, of which a count is one quantum everywhere.
    seen_air = mean_of_bins(means.overlap * means.air.shape)
    power, variance = (averages[name].to_numpy()[..., examined_cells] for name in _PARTS)
    withheld |= np.isnan(seen_air)
    power = np.where(withheld[:, np.newaxis], np.nan, power)
    there = profiles > 0
    found = _layers.find_layers(
        power[there],
        mean_of_bins(means.distance),
        variance[there],
        molecular_attenuated=np.nan_to_num(seen_air),
        contrast=means.contrast,
        false_alarm=COMMON.false_alarm / profiles.shape[1],
        quantum=averages["part_quantum"].to_numpy()[there],
    )
    cloudy = np.zeros((*profiles.shape, cells), dtype=np.bool_)
    cloudy[there] = found
    # A cloud may span cells without data.
    examined = np.isfinite(power) | cloudy
    with_cloud, of_all = (
        (parts * profiles[..., np.newaxis]).sum(axis=1) for parts in (cloudy, examined)
    )
    share = np.where(of_all > 0, with_cloud / np.maximum(of_all, 1), np.nan)
    fraction[:, inside] = np.repeat(share, bins, axis=-1)
    return fraction


def _cells_in(averages: xr.Dataset, distance: Array) -> tuple[int, slice, slice]:
    """Return the bins of a cell of the parts, the bins of whole cells at a distance, and these."""
    described = averages["part_power"].attrs
    bins, step = int(described["bins"]), float(np.median(np.diff(distance)))
    lead = round((described["first_range"] - distance[0]) / step)
    first = max(-(lead // bins), 0)
    lead += first * bins
    cells = min(averages.sizes["cell"] - first, (distance.size - lead) // bins)
    return bins, slice(lead, lead + cells * bins), slice(first, first + cells)


def cloud_heights(
    mask: Booleans, distance: Array, station_altitude: float, climb: float
) -> dict[str, tuple[str, Array]]:
    """Return where the lowest cloud begins and the highest one ends, as variables; NaN for none."""
    cloudy = mask.any(axis=-1)
    base = np.where(cloudy, distance[np.argmax(mask, axis=-1)], np.nan)
    last = mask.shape[-1] - 1 - np.argmax(mask[:, ::-1], axis=-1)
    top = np.where(cloudy, distance[last], np.nan)
    return {
        "cloud_base_range": ("time", base),
        "cloud_base_altitude": ("time", station_altitude + climb * base),
        "cloud_top_altitude": ("time", station_altitude + climb * top),
    }


def window_variables(
    window: _reference.ReferenceWindow, reference: Reference, station_altitude: float, climb: float
) -> dict[str, Any]:
    """Return the variables of the reference windows, and of what is assumed in them."""
    limit = window.detection_limit
    rejections = np.bitwise_or.reduce(window.rejections, axis=-1).astype(np.int32)
    return {
        "reference_bottom": ("time", window.bottom),
        "reference_top": ("time", window.top),
        "reference_detection_limit": ("time", np.where(np.isinf(limit), np.nan, limit)),
        "reference_rejections": ("time", rejections),
        "reference_bottom_altitude": ("time", station_altitude + climb * window.bottom),
        "reference_top_altitude": ("time", station_altitude + climb * window.top),
        "reference_scattering_ratio": reference.scattering_ratio,
        "reference_scattering_ratio_standard_error": (
            reference.scattering_ratio * reference.relative_error
        ),
    }


def _signal_beyond_overlap(
    means: MeanProfiles, reference: Reference, *, known_shape: bool, overlap_is_stated: bool
) -> tuple[MeanSignal, Booleans, Booleans]:
    """Return signals without background, their layers, and those that may be the overlap's."""
    signal, clouds = _signal_beyond_clouds(means, known_shape=known_shape)
    near = clouds & _begin_before(clouds, means.distance < reference.lowest)
    nowhere = np.zeros_like(near)
    if not near.any():
        return signal, clouds, nowhere
    window = reference_window(signal, means, reference, clouds & ~near)
    ratio, error = means.ratio_to_air(signal.power)
    partial = _less_than_air(ratio, error, near, window, means.distance)
    if partial.any():
        means.reject_overlap(partial)
        clouds = _signal_beyond_clouds(means, known_shape=known_shape)[1]
        nearer, farther = _overlap_bins(ratio, partial, clouds, window, means)
        means.reject_overlap(nearer)
        means.unknown_overlap |= farther
        signal, clouds = _signal_beyond_clouds(means, known_shape=known_shape)
    if overlap_is_stated:
        return signal, clouds, nowhere
    # Without clean air to compare with, a rise may as well be that of the overlap.
    doubtful = near & ~window.chosen[:, np.newaxis]
    means.unknown_overlap |= doubtful
    return signal, clouds & ~doubtful, doubtful


def _signal_beyond_clouds(means: MeanProfiles, *, known_shape: bool) -> tuple[MeanSignal, Booleans]:
    """Return signals without background, and their clouds."""
    signal = _subtract_background(means, np.ones_like(means.raw, bool), known_shape=known_shape)
    clouds = means.find_clouds(signal.power)
    cloudy = clouds | means.partly
    if not known_shape or not cloudy.any():
        return signal, clouds
    # Only beyond the cloud does the signal have the shape of air: fit the background there.
    hidden = with_margin(cloudy, means.distance)
    beyond = ~np.logical_or.accumulate(hidden[:, ::-1], axis=-1)[:, ::-1]
    enough = beyond.sum(axis=-1) >= BACKGROUND.tail_share * means.distance.size
    refitted = cloudy.any(axis=-1) & enough
    signal = _subtract_background(means, beyond | ~refitted[:, np.newaxis], known_shape=True)
    return signal, means.find_clouds(signal.power)


def with_margin(mask: Booleans, distance: Array) -> Booleans:
    """Return the bins of layers, (..., range), and those in which their thin edges may be."""
    bins = round(THRESHOLDS.cloud_margin / float(np.median(np.diff(distance))))
    out, some = np.zeros_like(mask), mask.any(axis=-1)
    near = np.cumsum(np.pad(mask[some], ((0, 0), (bins + 1, bins))), axis=-1)
    out[some] = near[:, 2 * bins + 1 :] > near[:, : mask.shape[-1]]
    return out


def _less_than_air(
    ratio: Array, error: Array, near: Booleans, window: _reference.ReferenceWindow, distance: Array
) -> Booleans:
    """Return the bins up to the last one before the window with less light than its air gives.

    Empty where no layer of `near` begins beyond such a bin: other causes lessen the signal, too.
    """
    level, level_error, bottom = (
        values[:, np.newaxis]
        for values in (window.scale, window.scale_standard_error, window.bottom)
    )
    less = level - ratio > COMMON.contradicted * np.hypot(error, level_error)
    less &= distance < bottom
    nearer = np.logical_or.accumulate(less, axis=-1)
    rises = np.any(_begins(near) & nearer, axis=-1, keepdims=True)
    return np.asarray(rises & np.logical_or.accumulate(less[:, ::-1], axis=-1)[:, ::-1])


def _overlap_bins(
    ratio: Array,
    partial: Booleans,
    clouds: Booleans,
    window: _reference.ReferenceWindow,
    means: MeanProfiles,
) -> tuple[Booleans, Booleans]:
    """Return the bins of profiles with a partial overlap in which it is so, and may be so.

    It is incomplete up to the largest ratio to air below the first cloud, and may be so farther
    away, where particles decrease.
    """
    before = means.distance < np.nan_to_num(window.bottom)[:, np.newaxis]
    clear = before & ~np.logical_or.accumulate(clouds, axis=-1)
    highest = np.where(clear, np.nan_to_num(ratio, nan=-np.inf), -np.inf).argmax(axis=-1)
    nearer = np.arange(ratio.shape[-1]) < highest[:, np.newaxis]
    concerned = before & partial.any(axis=-1, keepdims=True)
    return concerned & nearer, concerned & ~nearer


def _begin_before(mask: Booleans, near: Booleans) -> Booleans:
    """Return whether the last run of a mask that began up to a bin began near."""
    begin = np.where(_begins(mask), np.arange(near.size), 0)
    return np.asarray(near[np.maximum.accumulate(begin, axis=-1)])


def _begins(mask: Booleans) -> Booleans:
    """Return the first bins of the runs of a mask."""
    return np.asarray(np.diff(mask.astype(np.int8), axis=-1, prepend=0) == 1)


def _subtract_background(means: MeanProfiles, usable: Booleans, *, known_shape: bool) -> MeanSignal:
    noise, r = means.noise * means.correlation_length[:, np.newaxis], means.distance
    # The mean of a bin that was saturated in some profiles is that of the others.
    raw = np.where((means.quality & np.int32(Quality.SATURATED)) != 0, np.nan, means.raw)
    if means.sky is not None:
        sky = means.sky
    elif not known_shape:
        sky = estimate.from_tail(raw, r, noise)
    else:
        sky = estimate.from_known_shape(
            raw, r, noise, means.air.shape, mask=usable, exposure=means.exposure
        )
    power = (means.raw - sky.background[:, np.newaxis]) / means.overlap
    power[(means.quality & WITHHELD) != 0] = np.nan
    return MeanSignal(power, sky.background, sky.standard_error, sky.uncertain)


def reference_window(
    signal: MeanSignal, means: MeanProfiles, reference: Reference, clouds: Booleans
) -> _reference.ReferenceWindow:
    """Return the window of clean air outside of clouds, (time, range), and of their margins."""
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
        baseline_standard_error=np.nan_to_num(means.baseline_error),
        exclude=with_margin(clouds, means.distance),
    )
