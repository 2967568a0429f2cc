"""The elastic inversion over xarray: background, clouds, reference and inversion of means."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.flags import Quality
from lidarops.retrieve import background as _background
from lidarops.retrieve import elastic as _elastic
from lidarops.retrieve import known_shape as _known_shape
from lidarops.retrieve import layers as _layers
from lidarops.retrieve import reference as _reference
from lidarops.retrieve.molecular import (
    MolecularProfile,
    molecular_lidar_ratio,
    rayleigh_cross_section,
)

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.int32]

STEPS_PER_WINDOW: Final = 4
"""Candidates that begin within the width of one."""

_CONTRAST_WAVELENGTH: Final = 532e-9
"""m, for which `lidarops.retrieve.layers.CLOUD_CONTRAST` is meant."""

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


def elastic(
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
        `lidarops.retrieve.labeled_average.clock_average`; in memory.
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
        (`lidarops.retrieve.known_shape`); else it is the mean of the last tenth of the bins.
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
    # Ranges behind the lidar, which an offset may give, hold no light.
    averages = averages.isel(range=averages["range"].to_numpy() > 0)
    if overlap is not None:
        overlap = overlap[overlap.size - averages.sizes["range"] :]
    distance = averages["range"].to_numpy().astype(np.float64)
    climb = float(np.cos(np.deg2rad(averages["zenith_angle"])))
    air = _air(molecules, station_altitude + climb * distance, distance, wavelength)
    quality = averages["quality"].to_numpy() & np.int32(_CARRIED)
    clear = _without_background(averages, distance, air, known_shape=known_shape)
    variance = averages["variance"].to_numpy()
    power = clear.power
    if overlap is not None:
        power, variance = power / overlap, variance / overlap**2
        quality |= np.where(np.isnan(overlap), np.int32(Quality.INCOMPLETE_OVERLAP), np.int32(0))
    power = np.where((quality & _WITHHELD) != 0, np.nan, power)
    clouds = _layers.screen(
        power,
        distance,
        variance,
        molecular_attenuated=air.shape,
        contrast=_cloud_contrast(wavelength),
    )
    window = _window(power, distance, variance, air, reference, clouds.mask)
    found = _elastic.solve(
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
        reference_relative_error=reference.relative_error,
        molecular_relative_error=molecular_relative_error,
    )
    quality |= _judged(found, window, clear) | _clouded(distance, window, clouds)
    gates = {name: np.where(found.valid, v, np.nan) for name, v in _gates(found).items()}
    return xr.Dataset(
        {
            **{name: (("time", "range"), values) for name, values in gates.items()},
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


def _without_background(
    averages: xr.Dataset, distance: Array, air: _Air, *, known_shape: bool
) -> _Clear:
    power, variance = averages["power"].to_numpy(), averages["variance"].to_numpy()
    tail = _background.tail_mean(power, distance, variance=variance)
    background, error = tail.background, tail.background_standard_error
    uncertain = np.zeros(background.shape, dtype=bool)
    if known_shape:
        fit = _known_shape.solve(power, distance, air.shape, variance=variance)
        usable = ~fit.singular & np.isfinite(fit.background)
        background = np.where(usable, fit.background, background)
        error = np.where(usable, fit.background_standard_error, error)
        uncertain = ~usable | fit.poor_fit
    return _Clear(power - background[:, np.newaxis], background, error, uncertain)


def _window(
    power: Array,
    distance: Array,
    variance: Array,
    air: _Air,
    reference: Reference,
    clouds: npt.NDArray[np.bool_],
) -> _reference.ReferenceWindow:
    candidates = _reference.candidate_windows(
        reference.lowest,
        min(reference.highest, float(distance[-1])),
        reference.width,
        reference.width / STEPS_PER_WINDOW,
    )
    return _reference.choose(
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
    found: _elastic.ElasticResult, window: _reference.ReferenceWindow, clear: _Clear
) -> Flags:
    """Return what speaks against each value."""
    bits = np.zeros(found.valid.shape, dtype=np.int32)
    bits[~window.chosen] |= np.int32(Quality.NO_REFERENCE)
    bits[clear.uncertain] |= np.int32(Quality.BACKGROUND_UNCERTAIN)
    bits[window.chosen[:, np.newaxis] & ~found.valid] |= np.int32(Quality.UNSTABLE_INVERSION)
    return bits


def _clouded(distance: Array, window: _reference.ReferenceWindow, clouds: _layers.Layers) -> Flags:
    """Return CLOUD for what lies in a cloud, or beyond one as seen from the reference window.

    The inversion starts in the window, and what it meets behind a cloud rests on the lidar ratio
    of aerosol in the cloud.
    """
    base = clouds.cloud_base_range[:, np.newaxis]
    above = window.bottom[:, np.newaxis] > base
    beyond = np.where(above, distance < window.bottom[:, np.newaxis], distance >= base)
    hit = clouds.mask | (clouds.cloudy[:, np.newaxis] & beyond)
    return hit.astype(np.int32) * np.int32(Quality.CLOUD)


def _gates(found: _elastic.ElasticResult) -> dict[str, Array]:
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
