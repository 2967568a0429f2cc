"""Scans over zenith angle of known air, chosen and random ones, and their optical depths.

Random scans violate the assumptions of the retrieval in a known way, or not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from benchmarks.harness.figure import Array, Random, correlated, log_uniform
from benchmarks.harness.rates import Failure, ScoredValues, held_first
from lidarops.retrieve.multiangle import optical_depth
from lidarops.retrieve.multiangle.flags import MultiAngleQuality
from lidarops.retrieve.multiangle.optical_depth import MultiAngleResult

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
        """Simulate scans; the same seeds give the same scans."""
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


def clear(ratio: float, *, bins: int = 201) -> Scene:
    """Return clear air and 12 beams to 75 degrees, evenly spaced in slant path, up to 6.15 km.

    Parameters
    ----------
    ratio : float
        Signal over noise at the zenith in 1 km.
    bins : int
        Number of altitudes, 30 m apart.
    """
    height = 150.0 + 30.0 * np.arange(bins, dtype=np.float64)
    extinction, backscatter = _hazy_air(height, np.ones(1), np.full(1, 3000.0))
    path = np.linspace(1.0, 1.0 / np.cos(np.radians(75.0)), 12)
    label = f"clear air, SNR {ratio:g}"
    angles = np.degrees(np.arccos(1.0 / path))
    return Scene(label, angles, height, extinction, backscatter, ratio, 0.03)


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


def random_scene(seed: int, profiles: int) -> Scene:
    """Return a scene that violates the assumptions, with another truth for each profile.

    3 to 20 beams to 15-75 degrees, clear air or a cloud, scatter up to 40 % with a correlation of
    0-0.95, SNR 10 to 1e5; half with up to 10 % outliers, three in five with a gradient of up to
    10 % per km, one in seven with extinction that varies along the paths.
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
        inhomogeneity=rng.uniform(0.0, 0.4),
        correlation=rng.uniform(0.0, 0.95),
        outliers=rng.uniform(0.0, 0.1) * (rng.random() < 0.5),
        gradient=rng.uniform(-1e-4, 1e-4) * (rng.random() < 0.6),
        variation=rng.uniform(0.3, 1.0) * (rng.random() < 0.15),
    )


def retrieve(scan: Scan, method: str = "auto") -> MultiAngleResult:
    """Solve all profiles of a scan as one block."""
    return optical_depth.retrieve_optical_depth(
        scan.signal,
        scan.scene.zenith_angle,
        scan.scene.altitude,
        variance=scan.variance,
        settings=optical_depth.OpticalDepthSettings(method=method),
    )


# Random scans ---------------------------------------------------------------------------------

_UNCERTAIN: Final = MultiAngleQuality.NO_RESIDUAL | MultiAngleQuality.POOR_STRATIFICATION
"""Bits of values whose stated uncertainty may be too small."""
_LAYER_WIDTH: Final = (2.0, 4.0)
"""Standard deviation of a layer in altitude steps: 5 to 9 of them are its width at half maximum."""
_LAYER_CELLS: Final = (3, 11)
"""Least and most altitude steps of a layer with edges."""


def _level(scene: Scene, _: Random) -> Scene:
    return replace(scene, outliers=0.0, gradient=0.0, variation=0.0)


def _calm(scene: Scene, rng: Random) -> Scene:
    """Return level air with little scatter, which makes stated errors small."""
    return replace(_level(scene, rng), inhomogeneity=log_uniform(rng, 5e-3, 0.4))


def _layer(scene: Scene, rng: Random, shape: Callable[[Random, Array], Array]) -> Scene:
    """Return calm clear air with a layer, of a shape by altitude steps from its centre."""
    height = 150.0 + 60.0 * np.arange(60, dtype=np.float64)
    air, haze = 1e-5 * np.exp(-height / 8000.0), np.exp(-height / rng.uniform(600.0, 3000.0))
    centre = rng.uniform(height[3], height[-4], (len(scene.extinction), 1))
    excess = rng.uniform(0.3, 3.0) * shape(rng, (height - centre) / 60.0)
    particles = log_uniform(rng, 2e-5, 4e-4) * (haze + excess)
    return replace(
        _calm(scene, rng), altitude=height, extinction=air + particles,
        backscatter=air / 8.4 + particles / 50.0,
    )  # fmt: skip


def _smooth(rng: Random, away: Array) -> Array:
    """Return a shape that several altitudes resolve."""
    return np.asarray(np.exp(-0.5 * (away / rng.uniform(*_LAYER_WIDTH)) ** 2))


def _with_edges(rng: Random, away: Array) -> Array:
    """Return a shape that begins and ends between two altitudes."""
    half = 0.5 * rng.integers(*_LAYER_CELLS, endpoint=True)
    return np.where((away >= -half) & (away < half), 1.0, 0.0)


def _gradient(scene: Scene, rng: Random, *, times: float = 1.0) -> Scene:
    slope = rng.uniform(0.2, 1.0) * optical_depth.LARGEST_GRADIENT * rng.choice([-1.0, 1.0])
    return replace(_level(scene, rng), gradient=times * float(slope))


def _two_sided(scene: Scene, rng: Random) -> Scene:
    largest = scene.zenith_angle[-1]
    angles = np.linspace(-largest, largest, scene.zenith_angle.size)
    return replace(_gradient(scene, rng, times=2.0), zenith_angle=angles)


def _variation(scene: Scene, rng: Random, *, two_sided: bool = False) -> Scene:
    scene = _two_sided(scene, rng) if two_sided else scene
    return replace(_level(scene, rng), variation=rng.uniform(0.3, 1.0))


def _with_gaps(scan: Scan, rng: Random) -> Scan:
    signal = scan.signal.copy()
    signal[rng.random(signal.shape) < rng.uniform(0.0, 0.4)] = np.nan
    first = rng.integers(0, signal.shape[-1])
    signal[..., first : first + rng.integers(0, 10)] = np.nan
    return replace(scan, signal=signal)


def _with_overlap(scan: Scan, rng: Random) -> Scan:
    distance = scan.scene.path[:, np.newaxis] * scan.scene.altitude
    overlap = 1.0 - rng.uniform(0.0, 0.2) * np.exp(-distance / rng.uniform(50.0, 1000.0))
    return replace(scan, signal=scan.signal * overlap)


def _with_background(scan: Scan, rng: Random) -> Scan:
    """Add to each beam a background error of a fraction of the noise of one altitude."""
    left = rng.normal(0.0, rng.uniform(0.0, 0.3), (*scan.signal.shape[:2], 1))
    return replace(scan, signal=scan.signal + left * np.sqrt(scan.variance))


_Change = Callable[[Scene, Random], Scene]
_Damage = Callable[[Scan, Random], Scan]

FAILURES: Final[tuple[tuple[Failure, _Change | None, _Damage | None], ...]] = (
    (Failure("none", satisfied=True), _level, None),
    (Failure("gaps", satisfied=True), _level, _with_gaps),
    (Failure("outliers"),
     lambda scene, rng: replace(_level(scene, rng), outliers=rng.uniform(0.01, 0.1)), None),
    (Failure("gradient within the declared one, one side"), _gradient, None),
    (Failure("gradient up to twice the declared one, one side"),
     partial(_gradient, times=2.0), None),
    (Failure("gradient up to twice the declared one, two sides"), _two_sided, None),
    (Failure("extinction that varies along the paths"), _variation, None),
    (Failure("the same, two sides"), partial(_variation, two_sided=True), None),
    (Failure("overlap error"), _level, _with_overlap),
    (Failure("background error of each beam"), _level, _with_background),
    (Failure("everything at once"), None, None),
    (Failure("calm air", satisfied=True), _calm, None),
    (Failure("layer of a few altitudes", satisfied=True), partial(_layer, shape=_smooth), None),
    (Failure("layer with edges", satisfied=True), partial(_layer, shape=_with_edges), None),
)  # fmt: skip


def score_scans(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Solve random scans of one geometry, class by class."""
    for number, (failure, change, damage) in held_first(FAILURES):
        rng = np.random.default_rng((72, cluster, number))
        scene = random_scene(cluster, profiles)
        scene = change(scene, rng) if change else scene
        scan = scene.draw(profiles, cluster, number, 72)
        result = retrieve(damage(scan, rng) if damage else scan)
        yield from _score_quantities(failure, scene, result)


def _score_quantities(
    failure: Failure, scene: Scene, result: MultiAngleResult
) -> Iterator[ScoredValues]:
    for quantity in ("optical depth", "extinction"):
        truth = getattr(scene, quantity.replace(" ", "_"))
        scored = _scored(failure, quantity, truth, result)
        yield replace(scored, solvable=np.isfinite(scored.error))


def _scored(
    failure: Failure, quantity: str, truth: Array, result: MultiAngleResult
) -> ScoredValues:
    name = quantity.replace(" ", "_")
    return ScoredValues(
        failure, quantity, getattr(result, name) - truth, getattr(result, f"{name}_standard_error"),
        getattr(result, f"{name}_gradient_error"), result.quality, MultiAngleQuality,
        uncertain=result.raised(_UNCERTAIN),
    )  # fmt: skip


def score_short_scans(cluster: int, profiles: int, *, length: int) -> Iterator[ScoredValues]:
    """Solve random scans where the model holds, in blocks of `length` profiles."""
    for words, change in (
        ("", _level),
        ("calm air, ", _calm),
        ("layer of a few altitudes, ", partial(_layer, shape=_smooth)),
        ("layer with edges, ", partial(_layer, shape=_with_edges)),
    ):
        rng = np.random.default_rng((72, cluster, 0))
        scene = change(random_scene(cluster, profiles), rng)
        scan = scene.draw(profiles, cluster, 0, 87)
        failure = Failure(f"{words}blocks of {length}", satisfied=True)
        # Blocks of one geometry are one cluster.
        for first in range(0, profiles, length):
            some = slice(first, first + length)
            part = replace(
                scene, extinction=scene.extinction[some], backscatter=scene.backscatter[some]
            )
            block = Scan(part, scan.signal[some], scan.variance[some])
            result = retrieve(block)
            yield from _score_quantities(failure, part, result)


def score_counted_scans(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Solve scans of photon counts, whose variance is stated in two ways."""
    rng = np.random.default_rng((84, cluster))
    angles = np.degrees(np.arccos(1.0 / np.linspace(1.0, 3.0, 9)))
    altitude = 150.0 + 30.0 * np.arange(60, dtype=np.float64)
    extinction = np.full(altitude.size, float(rng.uniform(2e-5, 2e-4)))
    depth = 30.0 * np.cumsum(extinction) + 120.0 * extinction
    distance = altitude / np.cos(np.radians(angles))[:, np.newaxis]
    bright = log_uniform(rng, 3e6, 3e8)
    air = 0.02 * rng.standard_normal((profiles, *distance.shape))
    mean = bright / distance**2 * np.exp(-2.0 * distance / altitude * depth + air)
    counts = rng.poisson(mean).astype(float)
    # Rates smoothed over 10 % of range, as `photon_signal` has them.
    smooth = _smoothed(counts, altitude)
    for name, holds, variance in (
        ("variance from single counts", False, counts),
        ("variance from smoothed counts, as in products", True, smooth),
    ):
        result = optical_depth.retrieve_optical_depth(
            counts * distance**2, angles, altitude, variance=variance * distance**4
        )
        yield _scored(Failure(name, satisfied=holds), "optical depth", depth, result)


def _smoothed(counts: Array, altitude: Array) -> Array:
    low = np.searchsorted(altitude, 0.9 * altitude)
    high = np.searchsorted(altitude, 1.1 * altitude, side="right")
    sums = np.cumsum(counts, axis=-1)
    sums = np.concatenate([np.zeros_like(sums[..., :1]), sums], axis=-1)
    return np.asarray(np.maximum(sums[..., high] - sums[..., low], 1.0) / (high - low))
