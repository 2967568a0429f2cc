"""Atmospheres, simulated scans and least squares to test multi-angle retrievals against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarops.retrieve.multiangle import _block, slant_paths
from support.scan_arguments import retrieve_optical_depth

PER_KM = 1e-3
PATHS = np.linspace(1.0, 1 / np.cos(np.radians(75.0)), 12)
ANGLES = np.degrees(np.arccos(1 / PATHS))
"""Twelve beams from the zenith to 75 degrees, evenly spaced in slant path."""


def clear(bins=201):
    """Return altitudes (m), extinction (m-1) and relative backscatter of a clear atmosphere."""
    height = 150.0 + 30.0 * np.arange(bins)
    air = 0.0116 * PER_KM * np.exp(-height / 8000)
    haze = 0.07 * np.exp(-height / 1200) + 0.05 * np.exp(-0.5 * ((height - 3000) / 150) ** 2)
    backscatter = air / 8.4 + haze * PER_KM / 50
    return height, air + haze * PER_KM, backscatter / np.interp(1000.0, height, backscatter)


def cloud(bins=40):
    """Return altitudes above its base (m), extinction (m-1) and backscatter of a cloud."""
    height = 10.0 * np.arange(1, bins + 1)
    layers = np.array([5.0, 10.0, 15.0, 20.0, 15.0, 10.0, 8.0, 5.0]) * PER_KM
    extinction = np.interp(height - 5.0, 25.0 + 50.0 * np.arange(8), layers)
    return height, extinction, np.ones(bins)


def depth(height, extinction):
    """Return optical depths up to each altitude."""
    return np.cumsum(extinction * np.diff(height, prepend=0.0))


def correlated(rng, shape, correlation):
    """Return unit normal numbers, correlated along the last axis."""
    out = rng.normal(size=shape)
    for k in range(1, shape[-1] if correlation else 0):
        out[..., k] = correlation * out[..., k - 1] + np.sqrt(1 - correlation**2) * out[..., k]
    return out


def signals(
    rng,
    profiles,
    angles,
    atmosphere,
    *,
    ratio=np.inf,
    inhomogeneity=0.0,
    correlation=0.0,
    outliers=0.0,
    gradient=0.0,
):
    """Return range-corrected signals, their variance and the optical depth.

    `ratio` is the signal over noise at the zenith in 1 km, `gradient` in m-1.
    """
    height, extinction, backscatter = atmosphere
    path = 1 / np.cos(np.radians(angles))[:, np.newaxis]
    tau = depth(height, extinction)
    mean = np.log(backscatter) - 2 * path * tau
    shape = (profiles, len(angles), height.size)
    logarithm = mean + inhomogeneity * correlated(rng, shape, correlation)
    logarithm += gradient * height * np.tan(np.radians(angles))[:, np.newaxis]
    logarithm += rng.uniform(0.3, 1.0, shape) * (rng.random(shape) < outliers)
    noise = np.interp(1000.0, height, np.exp(mean[0])) / ratio * (path * height / 1000.0) ** 2
    signal = np.exp(logarithm) + noise * rng.normal(size=shape)
    return signal, np.broadcast_to(noise**2, shape), tau


def least_squares(columns, y, variance):
    """Return coefficients and covariance of weighted least squares by numpy."""
    root = 1 / np.sqrt(variance)
    design = np.stack(columns, axis=-1) * root[:, np.newaxis]
    solution = np.linalg.lstsq(design, y * root, rcond=None)[0]
    return solution, np.linalg.inv(design.T @ design)


def coverage(error, standard_error):
    """Return percents of finite errors within 1 and 1.96 standard errors."""
    ratio = np.abs(error / standard_error)
    ratio = ratio[np.isfinite(ratio)]
    return 100 * np.mean(ratio < 1), 100 * np.mean(ratio < 1.96)


def rms(values):
    """Return the root mean square of the finite values."""
    return float(np.sqrt(np.nanmean(np.square(values))))


# Scans of any air -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ScanScene:
    """An atmosphere that is horizontally homogeneous except for scatter, and a scan of it."""

    zenith_angle: np.ndarray
    """(angle,) degree."""
    altitude: np.ndarray
    """(altitude,) m above the lidar, or above the base of a cloud."""
    extinction: np.ndarray
    """(altitude,) or (profile, altitude) m-1, mean of the layer that ends at the altitude."""
    backscatter: np.ndarray
    """As `extinction`, in any unit."""
    ratio: float
    """Signal over noise at the zenith in 1 km, or at the top of a cloud."""
    inhomogeneity: float
    """Standard deviation of ln backscatter along the horizontal."""
    correlation: float = 0.0
    """Of the same, at neighbouring altitudes."""
    outliers: float = 0.0
    """Share of samples that are brighter by 0.3 to 1 in the logarithm."""
    gradient: float = 0.0
    """m-1, of ln backscatter along the scan."""
    variation: float = 0.0
    """Scatter of ln extinction over that of ln backscatter."""

    @property
    def path(self):
        """(angle,) slant over vertical paths."""
        return 1.0 / np.cos(np.radians(self.zenith_angle))

    @property
    def layers(self):
        """Optical depth of the layers that end at the altitudes."""
        return self.extinction * np.diff(self.altitude, prepend=0.0)

    @property
    def optical_depth(self):
        """Optical depth from the lidar to the altitudes."""
        return np.cumsum(self.layers, axis=-1)

    def draw(self, profiles, *seed):
        """Simulate scans; the same seeds give the same scans."""
        rng = np.random.default_rng(seed)
        shape = (profiles, self.path.size, self.altitude.size)
        return self.observe(self.inhomogeneity * correlated(rng, shape, self.correlation), rng)

    def observe(self, air, rng):
        """Simulate scans of air whose scatter of ln backscatter is given."""
        x = self.path[:, np.newaxis]
        depth = np.atleast_2d(self.optical_depth)[:, np.newaxis, :]
        mean = np.log(np.atleast_2d(self.backscatter))[:, np.newaxis, :] - 2.0 * x * depth
        logarithm = mean + air
        if self.gradient:
            away = self.altitude * np.tan(np.radians(self.zenith_angle))[:, np.newaxis]
            logarithm = logarithm + self.gradient * away
        if self.variation:
            layers = np.atleast_2d(self.layers)[:, np.newaxis, :]
            logarithm = logarithm - 2.0 * x * self.variation * np.cumsum(layers * air, axis=-1)
        if self.outliers:
            hit = rng.random(air.shape) < self.outliers
            logarithm = logarithm + hit * rng.uniform(0.3, 1.0, air.shape)
        at = min(int(np.searchsorted(self.altitude, 1000.0)), self.altitude.size - 1)
        dim = np.exp(mean[:, :1, at : at + 1]) / self.ratio / self.altitude[at] ** 2
        noise = dim * (x * self.altitude) ** 2
        signal = np.exp(logarithm) + noise * rng.normal(size=air.shape)
        return Scan(self, signal, np.broadcast_to(noise**2, air.shape))


@dataclass(frozen=True, slots=True)
class Scan:
    """Simulated range-corrected signals of a scene, (profile, angle, altitude)."""

    scene: ScanScene
    signal: np.ndarray
    variance: np.ndarray

    def retrieve(self, method="joint", **options):
        """Return the multi-angle retrieval of all profiles as one block."""
        return retrieve_optical_depth(
            self.signal,
            self.scene.zenith_angle,
            self.scene.altitude,
            variance=self.variance,
            method=method,
            **options,
        )

    def regress(self):
        """Return the block of beams and its regression."""
        geometry = slant_paths.make_scan(self.scene.zenith_angle, self.scene.altitude)
        beams = _block.make_beam_block(self.signal, self.variance, geometry)
        return beams, _block.regress(beams, None)


def hazy_air(height, aerosol, layer):
    """Return extinction and backscatter of air, haze (0.07 km-1 at the ground) and a layer."""
    air = 0.0116 * PER_KM * np.exp(-height / 8000.0)
    aloft = 0.05 * PER_KM * np.exp(-0.5 * ((height - layer) / 150.0) ** 2)
    haze = aerosol * (0.07 * PER_KM * np.exp(-height / 1200.0) + aloft)
    return air + haze, air / 8.4 + haze / 50.0


def clear_scene(ratio, *, outliers=0.0, bins=201):
    """Return 12 beams to 75 degrees through clear air, with altitudes of 30 m from 150 m."""
    height = 150.0 + 30.0 * np.arange(bins)
    air = hazy_air(height, np.ones(1), np.full(1, 3000.0))
    return ScanScene(ANGLES, height, *air, ratio, 0.03, outliers=outliers)


def cloud_scene(correlation=0.0, *, largest=30.0):
    """Return 6 beams through a cloud of optical depth 4.4 in 40 altitudes, without noise."""
    extinction = np.repeat(np.array([5.0, 10.0, 15.0, 20.0, 15.0, 10.0, 8.0, 5.0]) * PER_KM, 5)
    height = 10.0 * np.arange(1, extinction.size + 1)
    angles = np.linspace(0.0, largest, 6)
    return ScanScene(angles, height, extinction, np.ones(40), 1e7, 0.147, correlation)


def random_scene(seed, profiles):
    """Return a scene that violates assumptions, with another truth for each profile.

    3 to 20 beams to 15-75 degrees, clear air or a cloud, scatter up to 40 % with a correlation of
    0-0.95, SNR 10 to 1e5; half with up to 10 % outliers, three in five with a gradient of up to
    10 % per km, one in seven with extinction that varies along the paths.
    """
    rng = np.random.default_rng((7, seed))
    angles = np.linspace(0.0, rng.uniform(15.0, 75.0), int(rng.integers(3, 21)))
    amount = np.exp(rng.normal(0.0, 0.7, (profiles, 1)))
    if rng.random() < 0.5:
        height = 150.0 + 60.0 * np.arange(100)
        air = hazy_air(height, amount, rng.uniform(1500.0, 4500.0, (profiles, 1)))
    else:
        cloud = cloud_scene()
        height, extinction = cloud.altitude, 0.5 * amount * cloud.extinction
        air = extinction, np.ones(extinction.shape)
    return ScanScene(
        angles,
        height,
        *air,
        ratio=10.0 ** rng.uniform(1.0, 5.0),
        inhomogeneity=rng.uniform(0.0, 0.4),
        correlation=rng.uniform(0.0, 0.95),
        outliers=rng.uniform(0.0, 0.1) * (rng.random() < 0.5),
        gradient=rng.uniform(-1e-4, 1e-4) * (rng.random() < 0.6),
        variation=rng.uniform(0.3, 1.0) * (rng.random() < 0.15),
    )
