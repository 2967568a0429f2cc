"""Simulated scans at several angles, and methods to retrieve their optical depth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.optimize import lsq_linear

from benchmarks.harness.figure import Array
from lidarops.retrieve.multiangle.optical_depth import (
    MultiAngleResult,
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
_STRENGTHS: Final = np.logspace(-6.0, 4.0, 25)
_SPLINE_STRENGTHS: Final = np.geomspace(1e-4, 1e9, 60)
"""In the weights of the data, for altitudes one apart."""
_LEAST_SNR: Final = 3.0
_FEWEST_BEAMS: Final = 3
_FEWEST_KNOTS: Final = 5
_RUN: Final = 9
"""Altitudes of the running mean by which the spline peer selects samples."""
_LEAST_SCATTER: Final = 1e-20

AUTO: Final = "auto"
TWO_ANGLE: Final = "two_angle"
KANO_HAMILTON: Final = "kano_hamilton"
JOINT: Final = "joint"
MLD: Final = "mld"
MLD_PRIOR: Final = "mld_prior"
LINES: Final = "straight lines, numpy"
SPLINE: Final = "straight lines, GCV spline"
TIKHONOV: Final = "Tikhonov, L-curve"
BOUNDED: Final = "scipy lsq_linear"


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
        air = self.inhomogeneity * correlated(rng, shape, self.correlation)
        return self.observe(air, rng)

    def observe(self, air: Array, rng: np.random.Generator) -> Scan:
        """Simulate scans of air with a given scatter.

        Parameters
        ----------
        air : (profile, angle, altitude) float
            Added to the logarithm of backscatter.
        rng : numpy.random.Generator
        """
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
    extinction: Array | None = None
    """m-1, as published by the method; None if it gives optical depth only."""
    extinction_standard_error: Array | None = None
    data_share: Array | None = None
    freedom: Array | None = None
    """(profile,)"""


ScanSolver = Callable[[Scan], ScanEstimates]
"""A method to retrieve optical depth, ours or a peer."""


def correlated(rng: np.random.Generator, shape: tuple[int, ...], correlation: float) -> Array:
    """Return unit normal numbers, correlated along the last axis."""
    out = rng.normal(size=shape)
    rest = np.sqrt(1.0 - correlation**2)
    for k in range(1, shape[-1] if correlation else 0):
        out[..., k] = correlation * out[..., k - 1] + rest * out[..., k]
    return out


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


def published_cloud(largest: float, beams: int, scatter: float) -> Scene:
    """Return the cloud of the published experiment, with altitudes at the centres of its 8 layers.

    Parameters
    ----------
    largest : float
        degree; angles are evenly spaced from 0.
    beams : int
    scatter : float
        Standard deviation of the logarithm of backscatter.
    """
    height = _LAYER * (0.5 + np.arange(len(LAYERS), dtype=np.float64))
    layers = np.array(LAYERS)
    depth = _LAYER * (np.cumsum(layers) - 0.5 * layers)
    extinction = np.diff(depth, prepend=0.0) / np.diff(height, prepend=0.0)
    label = f"{largest:g}°, {beams} beams"
    angles = np.linspace(0.0, largest, beams)
    return Scene(label, angles, height, extinction, np.ones(height.size), NOISELESS, scatter)


def uniform_scatter(share: float, profiles: int, scene: Scene, *seed: int) -> Scan:
    """Return scans with uniformly distributed errors of backscatter, as published.

    Parameters
    ----------
    share : float
        Largest relative error; 0.25 for errors from -25 to 25 %.
    profiles : int
    scene : Scene
    *seed : int
    """
    rng = np.random.default_rng(seed)
    shape = (profiles, scene.path.size, scene.altitude.size)
    return scene.observe(np.log1p(rng.uniform(-share, share, shape)), rng)


def uniform_deviation(share: float) -> float:
    """Return the standard deviation of ln(1 + U(-share, share))."""
    low, high = 1.0 - share, 1.0 + share
    first, second = (u * np.log(u) - u for u in (low, high))
    mean = (second - first) / (2.0 * share)
    squares = (u * (np.log(u) ** 2 - 2.0 * np.log(u) + 2.0) for u in (high, low))
    return float(np.sqrt((next(squares) - next(squares)) / (2.0 * share) - mean**2))


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
    """Solve all profiles of a scan as one block, with options of `retrieve_optical_depth`."""
    return retrieve_optical_depth(
        scan.signal,
        scan.scene.zenith_angle,
        scan.scene.altitude,
        variance=scan.variance,
        method=method,
        **options,
    )


def estimate(scan: Scan, method: str, **options: Any) -> ScanEstimates:
    """Return the values of `retrieve` that are compared."""
    result = retrieve(scan, method, **options)
    return ScanEstimates(
        optical_depth=result.optical_depth,
        standard_error=result.optical_depth_standard_error,
        extinction=result.extinction,
        extinction_standard_error=result.extinction_standard_error,
        data_share=result.data_share,
        freedom=result.effective_degrees_of_freedom,
    )


def with_prior(scan: Scan, prior: Array) -> Array:
    """Return optical depth by "mld" from the difference of the scan from a prior (altitude,)."""
    known = np.exp(2.0 * scan.scene.path[:, np.newaxis] * prior)
    rest = replace(scan, signal=scan.signal * known, variance=scan.variance * known**2)
    return estimate(rest, MLD).optical_depth + prior


# Peers ----------------------------------------------------------------------------------------


def scan_peers() -> Mapping[str, ScanSolver]:
    """Return methods written directly with numpy and scipy.

    They know the true scatter, and use samples of more than 3 times their noise, the spline those
    of which a running mean is. All but the spline solve each altitude on its own.
    """
    return {LINES: lines, SPLINE: spline, TIKHONOV: tikhonov, BOUNDED: bounded}


SLOW: Final = frozenset({TIKHONOV, BOUNDED})
"""Peers that loop over altitudes."""
_Line = tuple[Array, Array, Array]
"""Slant path, logarithm and weight (the reciprocal standard error) of each beam."""


def lines(scan: Scan) -> ScanEstimates:
    """Fit straight lines to all altitudes at once: Kano-Hamilton in closed form."""
    return _fit_lines(scan, scan.signal)


def _fit_lines(scan: Scan, level: Array) -> ScanEstimates:
    """Fit straight lines to logarithms at a level of the signal, which also selects samples."""
    x = scan.scene.path[:, np.newaxis]
    used = level > _LEAST_SNR * np.sqrt(scan.variance)
    with np.errstate(divide="ignore", invalid="ignore"):
        scatter = scan.variance / level**2 + scan.scene.inhomogeneity**2
        # Without scatter and noise, all beams have the same weight.
        weight = np.where(used, 1.0 / np.maximum(scatter, _LEAST_SCATTER), 0.0)
        positive = np.where(used, level, 1.0)
        y = np.where(used, np.log(positive) + (scan.signal - level) / positive, 0.0)
        total = weight.sum(axis=1, keepdims=True)
        away = x - (weight * x).sum(axis=1, keepdims=True) / total
        information = (weight * away**2).sum(axis=1)
        depth = -0.5 * (weight * away * y).sum(axis=1) / information
        error = 0.5 / np.sqrt(information)
    solvable = used.sum(axis=1) >= _FEWEST_BEAMS
    return ScanEstimates(np.where(solvable, depth, np.nan), np.where(solvable, error, np.nan))


def spline(scan: Scan) -> ScanEstimates:
    """Smooth optical depths by a discrete spline, its strength by generalised cross validation.

    All profiles share one singular value decomposition and one strength, for the altitudes that all
    of them reach and the medians of their errors. A running mean of the signal selects samples, so
    that noise does not: bright samples alone would bias the lines.
    """
    level = uniform_filter1d(scan.signal, _RUN, axis=-1, mode="nearest")
    unsmoothed = _fit_lines(scan, level)
    smooth = np.full(unsmoothed.optical_depth.shape, np.nan)
    known = np.isfinite(unsmoothed.optical_depth).all(axis=0)
    if known.sum() >= _FEWEST_KNOTS:
        error = np.median(np.asarray(unsmoothed.standard_error)[:, known], axis=0)
        smooth[:, known] = _cross_validated(unsmoothed.optical_depth[:, known], error)
    return ScanEstimates(smooth)


def _cross_validated(depth: Array, error: Array) -> Array:
    """Return profiles at even altitudes, smoothed by second differences weighted by the errors."""
    count = error.size
    error = error / error.mean()
    roughness = np.diff(np.eye(count), 2, axis=0) * error
    _, singular, modes = np.linalg.svd(roughness, full_matrices=True)
    penalty = np.append(singular**2, np.zeros(count - singular.size))
    kept = 1.0 / (1.0 + _SPLINE_STRENGTHS[:, np.newaxis] * penalty)
    data = (depth / error) @ modes.T
    misfit = (1.0 - kept) ** 2 @ np.sum(data**2, axis=0)
    best = np.argmin(misfit / (count - kept.sum(axis=1)) ** 2)
    return np.asarray((data * kept[best]) @ modes * error)


def bounded(scan: Scan) -> ScanEstimates:
    """Fit straight lines with the optical depth constrained to be non-negative."""

    def fit(x: Array, y: Array, root: Array) -> float:
        design = np.stack([root, -2.0 * x * root], axis=1)
        least = ([-np.inf, 0.0], [np.inf, np.inf])
        return float(lsq_linear(design, y * root, bounds=least).x[1])

    return _solve_lines(scan, fit)


def tikhonov(scan: Scan, strengths: Array = _STRENGTHS) -> ScanEstimates:
    """Differentiate along the slant path, with the strength at the corner of the L-curve.

    Parameters
    ----------
    scan : Scan
    strengths : (strength,) float
        Ascending; one strength is taken as it is.
    """

    def fit(x: Array, y: Array, root: Array) -> float:
        order = np.argsort(x)
        x, y, root = x[order], y[order], root[order]
        width = np.diff(x) / (x[-1] - x[0])
        matrix = np.where(np.arange(width.size) < np.arange(x.size)[:, np.newaxis], width, 0.0)
        square = root**2 / np.sum(root**2)
        matrix = root[:, np.newaxis] * (matrix - square @ matrix) / np.sqrt(width)
        left, values, right = np.linalg.svd(matrix, full_matrices=False)
        data = left.T @ (root * (y - square @ y))
        kept = values**2 / (values**2 + strengths[:, np.newaxis])
        size = np.sqrt(np.sum((kept * data / values) ** 2, axis=1))
        misfit = np.sqrt(np.sum(((1.0 - kept) * data) ** 2, axis=1))
        slope = right.T @ (kept[_corner(misfit, size)] * data / values)
        return float(-0.5 * np.sum(np.sqrt(width) * slope) / (x[-1] - x[0]))

    return _solve_lines(scan, fit)


def _corner(misfit: Array, size: Array) -> int:
    """Return the index of the largest curvature of the L-curve."""
    if misfit.size == 1:
        return 0
    tiny = np.finfo(np.float64).tiny
    x, y = np.log(np.maximum(misfit, tiny)), np.log(np.maximum(size, tiny))
    dx, dy = np.gradient(x), np.gradient(y)
    speed = np.maximum(np.hypot(dx, dy), tiny)
    bend = (dx * np.gradient(dy) - dy * np.gradient(dx)) / speed**3
    return int(np.argmax(np.where(np.isfinite(bend), bend, -np.inf)))


def _solve_lines(scan: Scan, fit: Callable[[Array, Array, Array], float]) -> ScanEstimates:
    profiles, _, bins = scan.signal.shape
    depth = np.full((profiles, bins), np.nan)
    for t in range(profiles):
        for k in range(bins):
            line = _line(scan, t, k)
            if line[0].size >= _FEWEST_BEAMS:
                depth[t, k] = fit(*line)
    return ScanEstimates(depth)


def _line(scan: Scan, t: int, k: int) -> _Line:
    signal, variance = scan.signal[t, :, k], scan.variance[t, :, k]
    used = signal > _LEAST_SNR * np.sqrt(variance)
    signal, variance = signal[used], variance[used]
    scatter = variance / signal**2 + scan.scene.inhomogeneity**2
    # Without scatter and noise, all beams have the same weight.
    root = 1.0 / np.sqrt(scatter) if np.all(scatter > 0.0) else np.ones(signal.size)
    return scan.scene.path[used], np.log(signal), root
