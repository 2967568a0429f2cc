"""Simulated scans at several angles, and methods to retrieve their optical depth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np

from benchmarks.harness.figure import Array, correlated
from lidarops.retrieve.multiangle.optical_depth import (
    MultiAngleResult,
    OpticalDepthSettings,
    retrieve_optical_depth,
)

NOISELESS: Final = 1e7
"""Signal over noise at which only the scatter of the air matters."""
LAYERS: Final = (5e-3, 10e-3, 15e-3, 20e-3, 15e-3, 10e-3, 8e-3, 5e-3)
"""m-1, extinction of layers of 50 m from the base of a cloud upwards."""
CLOUD_SCATTER: Final = 0.147
"""Standard deviation of ln(1 + U(-0.25, 0.25))."""
_CLOUD_STEP: Final = 10.0
"""m, spacing of altitudes in a cloud."""
_LAYER: Final = 50.0
"""m, thickness of the layers of a cloud."""
_OUTLIERS: Final = (0.3, 1.0)
"""Smallest and largest deviation of an outlier in the logarithm."""

AUTO: Final = "auto"
TWO_ANGLE: Final = "two_angle"
KANO_HAMILTON: Final = "kano_hamilton"
JOINT: Final = "joint"
MLD: Final = "mld"
MLD_PRIOR: Final = "mld_prior"


@dataclass(frozen=True, slots=True)
class Scene:
    """An atmosphere that is horizontally homogeneous except for scatter, and a scan of it."""

    label: str
    zenith_angle: Array
    """(angle,) degree."""
    altitude: Array
    """(altitude,) m above the lidar, or the base of a cloud."""
    extinction: Array
    """(altitude,) or (profile, altitude) m-1, mean of the layer that ends at the altitude."""
    backscatter: Array
    """As `extinction`, in any unit."""
    ratio: float
    """Signal over noise at the zenith in 1 km, or at the top of a cloud."""
    inhomogeneity: float
    """Standard deviation of ln backscatter along the horizontal (scatter)."""
    correlation: float = 0.0
    """Correlation of the scatter at neighbouring altitudes."""
    outliers: float = 0.0
    """Share of samples that are brighter by 0.3 to 1 in the logarithm."""
    gradient: float = 0.0
    """m-1, of ln backscatter along the scan."""
    variation: float = 0.0
    """Scatter of ln extinction over that of ln backscatter."""

    @property
    def path(self) -> Array:
        """(angle,) slant over vertical paths."""
        return np.asarray(1.0 / np.cos(np.radians(self.zenith_angle)))

    @property
    def optical_depth(self) -> Array:
        """As `extinction`."""
        return np.cumsum(self._layers(), axis=-1)

    def draw(self, profiles: int, *seed: int) -> Scan:
        """Simulate scans; the same seeds give the same scans.

        Parameters
        ----------
        profiles : int
        *seed : int
        """
        rng = np.random.default_rng(seed)
        shape = (profiles, self.path.size, self.altitude.size)
        # Added to the logarithm of backscatter.
        air = self.inhomogeneity * correlated(rng, shape, self.correlation)
        x = self.path[:, np.newaxis]
        depth = np.atleast_2d(self.optical_depth)[:, np.newaxis, :]
        mean = np.log(np.atleast_2d(self.backscatter))[:, np.newaxis, :] - 2.0 * x * depth
        logarithm = mean + air
        if self.gradient:
            away = self.altitude * np.tan(np.radians(self.zenith_angle))[:, np.newaxis]
            logarithm = logarithm + self.gradient * away
        if self.variation:
            layers = np.atleast_2d(self._layers())[:, np.newaxis, :]
            logarithm = logarithm - 2.0 * x * self.variation * np.cumsum(layers * air, axis=-1)
        if self.outliers:
            hit = rng.random(air.shape) < self.outliers
            logarithm = logarithm + hit * rng.uniform(*_OUTLIERS, air.shape)
        noise = self._noise(mean) * (x * self.altitude) ** 2
        signal = np.exp(logarithm) + noise * rng.normal(size=air.shape)
        return Scan(self, signal, np.broadcast_to(noise**2, air.shape))

    def _layers(self) -> Array:
        return np.asarray(self.extinction * np.diff(self.altitude, prepend=0.0))

    def _noise(self, mean: Array) -> Array:
        """Return the noise of the signal, divided by the square of range."""
        at = min(int(np.searchsorted(self.altitude, 1000.0)), self.altitude.size - 1)
        brightness = np.exp(mean[:, :1, at : at + 1])
        return np.asarray(brightness / self.ratio / self.altitude[at] ** 2)


@dataclass(frozen=True, slots=True)
class Scan:
    """Simulated scans of one scene."""

    scene: Scene
    signal: Array
    """(profile, angle, altitude), range-corrected."""
    variance: Array
    """Variance of the noise of `signal`."""

    def first(self, profiles: int) -> Scan:
        """Return the first profiles."""
        return replace(self, signal=self.signal[:profiles], variance=self.variance[:profiles])


@dataclass(frozen=True, slots=True)
class ScanEstimates:
    """Result of a method, (profile, altitude); NaN where it has no value."""

    optical_depth: Array
    standard_error: Array | None = None
    """None if the method states none."""


ScanSolver = Callable[[Scan], ScanEstimates]
"""A method to retrieve optical depth, ours or a peer."""


# Scenes ---------------------------------------------------------------------------------------


def _hazy_air(height: Array, aerosol: Array, layer: Array) -> tuple[Array, Array]:
    """Return extinction (m-1) and backscatter (m-1 sr-1) of air, haze and a layer aloft.

    Parameters
    ----------
    height : (altitude,) float
        m.
    aerosol : (profile, 1) float
        1 for a haze of 0.07 km-1 at the ground.
    layer : (profile, 1) float
        m, height of the centre of the layer.
    """
    air = 0.0116e-3 * np.exp(-height / 8000.0)
    aloft = 0.05e-3 * np.exp(-0.5 * ((height - layer) / 150.0) ** 2)
    haze = aerosol * (0.07e-3 * np.exp(-height / 1200.0) + aloft)
    return air + haze, air / 8.4 + haze / 50.0


def clear(ratio: float, *, outliers: float = 0.0, bins: int = 201) -> Scene:
    """Return clear air and 12 beams to 75 degrees, evenly spaced in slant path, up to 6.15 km.

    Parameters
    ----------
    ratio : float
        Signal over noise at the zenith in 1 km.
    outliers : float
        Share of outlying samples.
    bins : int
        Number of altitudes, 30 m apart.
    """
    height = 150.0 + 30.0 * np.arange(bins, dtype=np.float64)
    extinction, backscatter = _hazy_air(height, np.ones(1), np.full(1, 3000.0))
    path = np.linspace(1.0, 1.0 / np.cos(np.radians(75.0)), 12)
    label = f"clear air, SNR {ratio:g}"
    angles = np.degrees(np.arccos(1.0 / path))
    return Scene(label, angles, height, extinction, backscatter, ratio, 0.03, outliers=outliers)


def cloud(correlation: float = 0.0, *, largest: float = 30.0) -> Scene:
    """Return a cloud with an optical depth of 4.4 in 40 altitudes, and 6 beams up to an angle."""
    extinction = np.repeat(LAYERS, round(_LAYER / _CLOUD_STEP))
    height = _CLOUD_STEP * np.arange(1, extinction.size + 1, dtype=np.float64)
    label = f"cloud, {largest:g}°, correlation {correlation:g}"
    angles = np.linspace(0.0, largest, 6)
    flat = np.ones(height.size)
    scatter = CLOUD_SCATTER
    return Scene(label, angles, height, extinction, flat, NOISELESS, scatter, correlation)


def scan_scenes() -> tuple[Scene, ...]:
    """Return the scenes in which all methods are compared."""
    return (clear(3000.0), clear(300.0), cloud(), cloud(0.8))


def random_scene(seed: int, profiles: int, *, calm: bool = False) -> Scene:
    """Return a scene that violates the assumptions, with another truth for each profile.

    3 to 20 beams to 15-75 degrees, clear air or a cloud, scatter up to 40 % with a correlation of
    0-0.95, SNR 10 to 1e5; half with up to 10 % outliers, three in five with a gradient of up to
    10 % per km, one in seven with extinction that varies along the paths.

    Parameters
    ----------
    seed : int
    profiles : int
    calm : bool
        Whether the scatter is drawn uniformly in its logarithm, from 0.5 %, instead of uniformly:
        little scatter makes stated errors small.
    """
    rng = np.random.default_rng((7, seed))
    angles = np.linspace(0.0, rng.uniform(15.0, 75.0), int(rng.integers(3, 21)))
    amount = np.exp(rng.normal(0.0, 0.7, (profiles, 1)))
    if rng.random() < 0.5:
        height = 150.0 + 60.0 * np.arange(100, dtype=np.float64)
        layer = rng.uniform(1500.0, 4500.0, (profiles, 1))
        extinction, backscatter = _hazy_air(height, amount, layer)
    else:
        base = cloud()
        height, extinction = base.altitude, 0.5 * amount * base.extinction
        backscatter = np.ones(extinction.shape)
    return Scene(
        label=f"random {seed}",
        zenith_angle=angles,
        altitude=height,
        extinction=extinction,
        backscatter=backscatter,
        ratio=10.0 ** rng.uniform(1.0, 5.0),
        inhomogeneity=float(
            np.exp(rng.uniform(np.log(0.005), np.log(0.4))) if calm else rng.uniform(0.0, 0.4)
        ),
        correlation=rng.uniform(0.0, 0.95),
        outliers=rng.uniform(0.0, 0.1) * (rng.random() < 0.5),
        gradient=rng.uniform(-1e-4, 1e-4) * (rng.random() < 0.6),
        variation=rng.uniform(0.3, 1.0) * (rng.random() < 0.15),
    )


# Our methods ----------------------------------------------------------------------------------


def scan_methods() -> Mapping[str, ScanSolver]:
    """Return the methods of lidarops that are compared, by name."""
    names = (TWO_ANGLE, KANO_HAMILTON, MLD, MLD_PRIOR, JOINT)
    return {name: partial(estimate, method=name) for name in names}


def retrieve(scan: Scan, method: str, **options: Any) -> MultiAngleResult:
    """Solve all profiles of a scan as one block, with further settings."""
    return retrieve_optical_depth(
        scan.signal,
        scan.scene.zenith_angle,
        scan.scene.altitude,
        variance=scan.variance,
        settings=OpticalDepthSettings(method=method, **options),
    )


def estimate(scan: Scan, method: str, **options: Any) -> ScanEstimates:
    """Return the values of `retrieve` that are compared."""
    result = retrieve(scan, method, **options)
    return ScanEstimates(
        optical_depth=result.optical_depth,
        standard_error=result.optical_depth_standard_error,
    )
