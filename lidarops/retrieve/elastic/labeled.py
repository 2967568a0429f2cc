"""The elastic inversion over xarray: background, clouds, reference and inversion of means."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.flags import Quality
from lidarops.retrieve.air.molecular import (
    HIGHEST,
    MolecularProfile,
    molecular_lidar_ratio,
    rayleigh_cross_section,
)
from lidarops.retrieve.background import cubic_and_tail as _background
from lidarops.retrieve.background import known_shape as _known_shape
from lidarops.retrieve.elastic import inversion as _elastic
from lidarops.retrieve.elastic import layers as _layers
from lidarops.retrieve.elastic import outlying_bins as _lone_bins
from lidarops.retrieve.elastic import reference_window as _reference

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.int32]

CLOUD_MARGIN: Final = 300.0
"""m beyond the last bin of a cloud: its thin edge reaches farther than it appears."""
LEAST_SHARE: Final = 0.1
"""Of the bins, that must lie beyond a cloud for the background to be fitted there."""
UNSEEN: Final = 1.5
"""Standard errors of the window's mean that particles in it may add unseen: 3 in one of 20."""
STEPS_PER_WINDOW: Final = 4
"""Candidates that begin within the width of one."""

_CONTRAST_WAVELENGTH: Final = 532e-9
"""m, for which `lidarops.retrieve.elastic.layers.CLOUD_CONTRAST` is meant."""

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


@dataclass(frozen=True, slots=True)
class Reference:
    """Where to look for air without aerosol, and what is assumed of it."""

    lowest: float
    """m along the beam, as the others."""
    highest: float
    width: float
    scattering_ratio: float
    relative_error: float
    """Standard error of the scattering ratio over it."""


@dataclass(frozen=True, slots=True)
class _Air:
    """Molecules along the beam."""

    backscatter: Array
    """m-1 sr-1, over range, as the others."""
    extinction: Array
    """m-1."""
    shape: Array
    """Attenuated backscatter over the square of range, m-3 sr-1."""


@dataclass(frozen=True, slots=True)
class _Clear:
    """Profiles without background, and what is known of it."""

    power: Array
    background: Array
    background_standard_error: Array
    uncertain: npt.NDArray[np.bool_]


def invert_elastic(
    averages: xr.Dataset,
    *,
    molecules: MolecularProfile,
    wavelength: float,
    station_altitude: float,
    lidar_ratio: float,
    lidar_ratio_standard_error: float,
    molecular_relative_error: float,
    reference: Reference,
    known_shape: bool = True,
    overlap: Array | None = None,
) -> xr.Dataset:
    """Retrieve backscatter and extinction of aerosol from mean profiles.

    Parameters
    ----------
    averages : xr.Dataset
        ``power``, ``variance``, ``quality`` over (time, range) and ``shots``, ``profiles`` over
        time, with the scalar coordinate ``zenith_angle`` (degree), from
        `lidarops.retrieve.signal.labeled_averaging.clock_average`; in memory.
    molecules : MolecularProfile
    wavelength : float
        m.
    station_altitude : float
        m above mean sea level.
    lidar_ratio, lidar_ratio_standard_error : float
        sr, of the aerosol.
    molecular_relative_error : float
        Standard error of the density of the air over it.
    reference : Reference
    known_shape : bool
        Whether the background is fitted together with the shape of clean air to the far range
        (`lidarops.retrieve.background.known_shape`); else it is the mean of the last tenth of the bins.
    overlap : (range,) float, optional
        By which the signal is divided; NaN where it is not known.

    Returns
    -------
    xr.Dataset
        In memory: the variables of the ``elastic`` product. Values are NaN where a bit of
        ``quality_flag`` says why.

    Raises
    ------
    RetrievalInputError
        Where arguments cannot be right.
    """
    climb = float(np.cos(np.deg2rad(averages["zenith_angle"])))
    distance = averages["range"].to_numpy().astype(np.float64)
    # Ranges behind the lidar, which an offset may give, hold no light, and those above the
    # atmosphere no air.
    inside = (distance > 0) & (station_altitude + climb * distance < HIGHEST)
    averages, distance = averages.isel(range=inside), distance[inside]
    overlap = None if overlap is None else overlap[inside]
    air = _air(molecules, station_altitude + climb * distance, distance, wavelength)
    quality = averages["quality"].to_numpy() & np.int32(_CARRIED)
    prepared = _Prepared(averages, distance, air, quality, overlap, _cloud_contrast(wavelength))
    clear, clouds = _cleared(prepared, known_shape=known_shape)
    power, variance = clear.power, prepared.variance
    window = _window(power, distance, variance, air, reference, clouds.mask)
    if not known_shape:
        clear = _left_in_tail(clear, window, air)
    found = _elastic.invert_elastic(
        power,
        distance,
        molecular_backscatter=air.backscatter,
        molecular_extinction=air.extinction,
        lidar_ratio=lidar_ratio,
        reference=window.edges,
        reference_scattering_ratio=reference.scattering_ratio,
        variance=variance,
        background_standard_error=clear.background_standard_error,
        lidar_ratio_standard_error=lidar_ratio_standard_error,
        reference_relative_error=_reference_error(window, reference),
        molecular_relative_error=molecular_relative_error,
    )
    quality = prepared.quality
    quality |= _judged(found, window, clear, quality) | _clouded(distance, window, clouds)
    bins = {name: np.where(found.valid, v, np.nan) for name, v in _bins(found).items()}
    return xr.Dataset(
        {
            **{name: (("time", "range"), values) for name, values in bins.items()},
            "molecular_backscatter": ("range", air.backscatter),
            "molecular_extinction": ("range", air.extinction),
            "lidar_ratio": ((), np.float64(lidar_ratio)),
            "lidar_ratio_standard_error": ((), np.float64(lidar_ratio_standard_error)),
            "reference_bottom": ("time", window.bottom),
            "reference_top": ("time", window.top),
            "cloud_base_range": ("time", clouds.cloud_base_range),
            "background": ("time", clear.background),
            "background_standard_error": ("time", clear.background_standard_error),
            "quality_flag": (("time", "range"), quality),
            "profiles": averages["profiles"],
            "shots": averages["shots"],
        },
        coords={name: averages[name] for name in averages.coords},
    )


def _air(molecules: MolecularProfile, altitude: Array, distance: Array, wavelength: float) -> _Air:
    extinction = molecules.number_density(altitude) * rayleigh_cross_section(wavelength)
    backscatter = extinction / molecular_lidar_ratio(wavelength)
    shape = _known_shape.molecular_shape(backscatter, extinction, distance)
    return _Air(backscatter, extinction, shape)


class _Prepared:
    """Mean profiles as they are before the background is known."""

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
        self.raw, self.noise = averages["power"].to_numpy(), averages["variance"].to_numpy()
        self._bridge_lone_bins()
        self.variance = self.noise / self.overlap**2

    def _bridge_lone_bins(self) -> None:
        """Replace bins that lie off on their own before backgrounds and windows rest on them."""
        rough = _background.tail_mean(self.raw, self.distance, variance=self.noise).background
        used = np.where((self.quality & _WITHHELD) != 0, np.nan, self.raw)
        bridged = _lone_bins.bridge_outliers(
            used, self.distance, self.noise, background=np.nan_to_num(rough, nan=0.0)
        )
        self.raw = np.where(bridged.found, bridged.power, self.raw)
        self.noise = np.where(bridged.found, bridged.variance, self.noise)
        self.quality = self.quality | np.where(bridged.found, _OUTLIER, np.int32(0))

    def without(self, background: Array) -> Array:
        """Return the signal without background, as with full overlap."""
        power = (self.raw - background[:, np.newaxis]) / self.overlap
        return np.where((self.quality & _WITHHELD) != 0, np.nan, power)

    def screened(self, power: Array) -> _layers.Layers:
        """Return the clouds of a signal without background."""
        return _layers.find_layers(
            power,
            self.distance,
            self.variance,
            molecular_attenuated=self.air.shape,
            contrast=self.contrast,
        )


def _cleared(prepared: _Prepared, *, known_shape: bool) -> tuple[_Clear, _layers.Layers]:
    """Return signals without background, and their clouds."""
    clear = _without_background(prepared, np.ones_like(prepared.raw, bool), known_shape=known_shape)
    clouds = prepared.screened(clear.power)
    if not known_shape or not clouds.cloudy.any():
        return clear, clouds
    # What lies beyond a cloud has the shape of air again, but not what holds the cloud.
    step = float(np.median(np.diff(prepared.distance)))
    hidden = np.zeros_like(clouds.mask)
    margin = min(round(CLOUD_MARGIN / step), hidden.shape[1])
    hidden[:, margin:] = clouds.mask[:, : hidden.shape[1] - margin]
    hidden |= clouds.mask
    beyond = ~np.logical_or.accumulate(hidden[:, ::-1], axis=-1)[:, ::-1]
    enough = beyond.sum(axis=-1) >= LEAST_SHARE * prepared.distance.size
    again = clouds.cloudy & enough
    clear = _without_background(prepared, beyond | ~again[:, np.newaxis], known_shape=True)
    return clear, prepared.screened(clear.power)


def _without_background(
    prepared: _Prepared, usable: npt.NDArray[np.bool_], *, known_shape: bool
) -> _Clear:
    raw, noise, r = prepared.raw, prepared.noise, prepared.distance
    tail = _background.tail_mean(raw, r, variance=noise)
    background, error = tail.background, tail.background_standard_error
    uncertain = np.zeros(background.shape, dtype=bool)
    if known_shape:
        fit = _known_shape.fit_known_shape(raw, r, prepared.air.shape, variance=noise, mask=usable)
        found = ~fit.singular & np.isfinite(fit.background)
        background = np.where(found, fit.background, background)
        # Noise that neighbouring bins share is larger than their differences tell.
        excess = fit.chi2 / np.maximum(fit.degrees_of_freedom, 1)
        scale = np.sqrt(np.maximum(np.nan_to_num(excess, nan=1.0), 1.0))
        error = np.where(found, fit.background_standard_error * scale, error)
        uncertain = ~found | fit.poor_fit
    return _Clear(prepared.without(background), background, error, uncertain)


def _left_in_tail(clear: _Clear, window: _reference.ReferenceWindow, air: _Air) -> _Clear:
    """Doubt backgrounds of whose bins air alone makes more than their standard error."""
    shape = air.shape[-max(air.shape.size // 10, 1) :].mean()
    with np.errstate(invalid="ignore"):
        biased = window.scale * shape > clear.background_standard_error
    return replace(clear, uncertain=clear.uncertain | biased)


def _reference_error(window: _reference.ReferenceWindow, reference: Reference) -> Array:
    """Return the relative error of the scattering ratio: assumed, and of particles not seen."""
    with np.errstate(invalid="ignore", divide="ignore"):
        unseen = UNSEEN * window.scale_standard_error / window.scale
    return np.hypot(reference.relative_error, np.nan_to_num(unseen, nan=0.0))


def _window(
    power: Array,
    distance: Array,
    variance: Array,
    air: _Air,
    reference: Reference,
    clouds: npt.NDArray[np.bool_],
) -> _reference.ReferenceWindow:
    highest = min(reference.highest, float(distance[-1]))
    width = min(reference.width, highest - reference.lowest)
    candidates = _reference.candidate_windows(
        reference.lowest, highest, width, reference.width / STEPS_PER_WINDOW
    )
    return _reference.choose_reference(
        power,
        distance,
        variance,
        molecular_attenuated=air.shape,
        candidates=candidates,
        exclude=clouds,
    )


def _cloud_contrast(wavelength: float) -> float:
    """Return the contrast that is no aerosol: scaled as aerosol over air is, with lambda^3."""
    scaled = (wavelength / _CONTRAST_WAVELENGTH) ** 3
    return max(1.0 + (_layers.CLOUD_CONTRAST - 1.0) * scaled, 2.0)


def _judged(
    found: _elastic.ElasticResult,
    window: _reference.ReferenceWindow,
    clear: _Clear,
    quality: Flags,
) -> Flags:
    """Return what speaks against each value."""
    bits = np.zeros(found.valid.shape, dtype=np.int32)
    bits[~window.chosen] |= np.int32(Quality.NO_REFERENCE)
    bits[clear.uncertain] |= np.int32(Quality.BACKGROUND_UNCERTAIN)
    bits[found.outlying] |= np.int32(Quality.OUTLIER)
    lost = window.chosen[:, np.newaxis] & ~found.valid & ((quality & _WITHHELD) == 0)
    bits[lost] |= np.int32(Quality.UNSTABLE_INVERSION)
    return bits


def _clouded(distance: Array, window: _reference.ReferenceWindow, clouds: _layers.Layers) -> Flags:
    """Return CLOUD for what lies in a cloud, or beyond one as seen from the reference window.

    The inversion starts in the window, and what it meets behind a cloud rests on the lidar ratio
    of aerosol in the cloud.
    """
    bottom = np.nan_to_num(window.bottom, nan=0.0)[:, np.newaxis]
    near, far = distance < bottom, distance >= bottom
    above = np.logical_or.accumulate(clouds.mask & far, axis=-1)
    below = np.logical_or.accumulate((clouds.mask & near)[:, ::-1], axis=-1)[:, ::-1]
    return (above | below).astype(np.int32) * np.int32(Quality.CLOUD)


def _bins(found: _elastic.ElasticResult) -> dict[str, Array]:
    budget: Any = found.budget
    return {
        "backscatter": found.backscatter,
        "backscatter_standard_error": budget.total,
        **{
            f"backscatter_error_{cause}": getattr(budget, cause)
            for cause in ("noise", "background", "reference", "lidar_ratio", "molecular")
        },
        "extinction": found.extinction,
        "extinction_standard_error": found.extinction_budget.total,
        "scattering_ratio": found.scattering_ratio,
        "scattering_ratio_standard_error": found.scattering_ratio_budget.total,
        "attenuated_backscatter": found.attenuated_backscatter,
        "attenuated_backscatter_standard_error": found.attenuated_backscatter_standard_error,
    }
