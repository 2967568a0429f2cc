"""Skies above a vertical lidar with known truth, and how background and particles are retrieved.

The simulated set follows the EARLINET elastic intercomparison (boeckmann2004): 532 nm, no
aerosol above 6 km, 1005 bins of 15 m, means of 1000 shots with Poisson noise over a constant
background. The files of the intercomparison are read if given. Random skies satisfy or violate the
model of the inversion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from benchmarks.harness.figure import Array, Mask, Random, log_uniform
from benchmarks.harness.rates import Failure, ScoredValues
from lidarops.constants import LICEL_RANGE_PER_MICROSECOND
from lidarops.errors import CampaignError
from lidarops.flags import Quality, rejecting
from lidarops.netcdf.variables import ErrorKind
from lidarops.products.elastic.variables import sources
from lidarops.raw import licel
from lidarops.retrieve.air import MolecularProfile
from lidarops.retrieve.background import cubic_and_tail, known_shape
from lidarops.retrieve.clouds.labeled import Reference
from lidarops.retrieve.elastic import labeled
from lidarops.retrieve.elastic.flags import ElasticQuality
from lidarops.retrieve.elastic.labeled import constant_ratio
from lidarops.retrieve.signal.labeled import DEAD_TIME_ERROR
from lidarops.settings import ReferenceSettings
from lidarops.simulate.signal import backscatter_signal, bin_centres

WAVELENGTH: Final = 532e-9
LIDAR_RATIO: Final = 39.0
SHOTS: Final = 1000.0
BRIGHTEST: Final = 1.9093e7
"""Counts in the brightest bin, as in the intercomparison."""
_BIN_WIDTH: Final = 15.0
RANGE: Final = bin_centres(1005, _BIN_WIDTH)
_CELLS: Final = 9
"""Cells of a bin, over which the optical depth is summed."""
CLEAN_FROM: Final = 6000.0
"""m; no particles above."""
OVERLAP: Final = 400.0
"""m; the inversion uses the signal above."""
GIVEN_WINDOW: Final = (7000.0, 8000.0)
"""m; reference window that is given, not chosen."""
REFERENCE: Final = Reference(4000.0, 12000.0, 1000.0, scattering_ratio=1.0, relative_error=0.0)
"""Where the window may lie; the air there is clean."""
_GIVEN: Final = replace(REFERENCE, lowest=GIVEN_WINDOW[0], highest=GIVEN_WINDOW[1])
PER_COUNT: Final = LICEL_RANGE_PER_MICROSECOND / _BIN_WIDTH
"""MHz of a count in a bin of each shot."""

_SEED: Final = 20040101
_CHANNEL: Final = "analog_532o"
_RAMP: Final = 15.0
"""Bins of incomplete overlap, from which the signal rises to the brightest bin."""
_FIRST_TRUE_BIN: Final = 60
"""First usable bin of the published files; nearer bins hold a ramp."""


@dataclass(frozen=True, slots=True)
class SimulatedSky:
    """One set of air, particles and noise-free signal."""

    air: MolecularProfile
    range: Array
    """m."""
    shape: Array
    """Shape of the molecular signal, m-3 sr-1."""
    signal: Array
    """Counts per shot, without noise and background."""
    backscatter: Array
    """m-1 sr-1, true backscatter of the particles."""

    @property
    def compared(self) -> Mask:
        """Bins whose backscatter is compared with the truth."""
        return (self.range >= 500.0) & (self.range <= CLEAN_FROM)

    @property
    def inverted(self) -> Mask:
        """Bins that the inversion uses."""
        return self.range > OVERLAP

    def counts(self, level: float, draws: int, *seed: int) -> Array:
        """Return noisy profiles, mean counts of `SHOTS` shots; equal seeds give equal noise.

        (draw, range), of a signal above a background of `level` counts per shot.
        """
        rng = np.random.default_rng([_SEED, *seed])
        mean = np.broadcast_to(SHOTS * (self.signal + level), (draws, self.range.size))
        return np.asarray(rng.poisson(mean) / SHOTS)


def _sky(air: MolecularProfile, signal: Array, backscatter: Array) -> SimulatedSky:
    molecules = air.backscatter(RANGE, WAVELENGTH), air.extinction(RANGE, WAVELENGTH)
    shape = known_shape.molecular_shape(*molecules, RANGE)
    return SimulatedSky(air, RANGE, shape, signal / signal.max() * BRIGHTEST, backscatter)


def particles(height: npt.ArrayLike) -> Array:
    """Return the backscatter of the particles of the simulated set, m-1 sr-1.

    As turbid as the intercomparison (optical depth 1.4): a mixed layer with a soft top at
    1.75 km, a tenuous layer from 3.9 to 5.7 km, no particles above 6 km.
    """
    z = np.asarray(height, dtype=np.float64)
    mixed = 2e-5 / (1.0 + np.exp((z - 1750.0) / 120.0))
    phase = np.clip((z - 4800.0) / 900.0, -1.0, 1.0)
    aloft = 4e-7 * np.cos(0.5 * np.pi * phase) ** 2
    return np.asarray(np.where(z < CLEAN_FROM, mixed + aloft, 0.0))


def clean_signal(
    extinction: Callable[[Array], Array], backscatter: Callable[[Array], Array]
) -> Array:
    """Return the signal of a short pulse in the bins of `RANGE`, in any unit.

    The optical depth is summed over cells of a ninth of a bin, not by the trapezoids of the
    inversion. The error of these is therefore part of the measured error.

    Parameters
    ----------
    extinction, backscatter : callable
        Return m-1 and m-1 sr-1 at ranges in m.
    """
    cells = bin_centres(_CELLS * RANGE.size, _BIN_WIDTH / _CELLS)
    signal = backscatter_signal(
        cells, extinction=extinction(cells), backscatter=backscatter(cells), system_constant=1.0
    )
    return signal[_CELLS // 2 :: _CELLS]


@cache
def simulated_sky() -> SimulatedSky:
    """Return the simulated set."""
    air = MolecularProfile.us_standard()
    signal = clean_signal(
        lambda z: LIDAR_RATIO * particles(z) + air.extinction(z, WAVELENGTH),
        lambda z: particles(z) + air.backscatter(z, WAVELENGTH),
    )
    signal *= np.minimum((np.arange(RANGE.size) + 1.0) / _RAMP, 1.0) ** 3
    return _sky(air, signal, particles(RANGE))


# Background -----------------------------------------------------------------------------------


class Backgrounds(NamedTuple):
    """Backgrounds in counts, one per profile."""

    background: Array
    standard_error: Array
    rejected: Mask
    """Whether a quality bit rejects the value."""


BackgroundMethod = Callable[[Array, SimulatedSky], Backgrounds]
"""Returns backgrounds, given counts (profile, range) and their simulated sky."""

KNOWN_SHAPE: Final = "known_shape"
KNOWN_CLEAN_RANGE: Final = "known_shape, from 6 km"
TAIL_MEAN: Final = "tail_mean"


def background_methods() -> dict[str, BackgroundMethod]:
    """Return the methods of the background by name."""
    return {
        KNOWN_SHAPE: _known_shape,
        KNOWN_CLEAN_RANGE: partial(_known_shape, start=CLEAN_FROM),
        TAIL_MEAN: lambda counts, sky: _backgrounds(cubic_and_tail.tail_mean(counts, sky.range)),
    }


def _known_shape(counts: Array, sky: SimulatedSky, start: float | None = None) -> Backgrounds:
    return _backgrounds(
        known_shape.fit_known_shape(counts, sky.range, sky.shape, exposure=SHOTS, start=start)
    )


def _backgrounds(result: Any) -> Backgrounds:
    rejected = (result.quality & rejecting(Quality)) != 0
    return Backgrounds(result.background, result.background_standard_error, rejected)


def least_error(sky: SimulatedSky, level: float) -> float:
    r"""Return the Cramér-Rao bound of the background's standard error from 6 km on, in counts.

    .. math:: \left[ (J^T V^{-1} J)^{-1} \right]_{00}^{1/2}, \quad J = [1, \varphi], \quad
        V = \mathrm{diag}(s + b) / N

    with the shape :math:`\varphi` of air and N shots (kay1993).
    """
    far = sky.range >= CLEAN_FROM
    shape = sky.shape[far] / sky.shape[far][0]
    slopes = np.stack([np.ones_like(shape), shape], axis=1)
    fisher = slopes.T @ (slopes * (SHOTS / (sky.signal[far] + level))[:, np.newaxis])
    return float(np.sqrt(np.linalg.inv(fisher)[0, 0]))


def count_weight(counts: Array) -> Array:
    """Return inverse variances of mean counts, (range,), from the mean of the profiles."""
    return np.asarray(SHOTS / np.maximum(counts.mean(axis=0), 1.0 / SHOTS))


# Inversion ------------------------------------------------------------------------------------


def count_variance(counts: Array) -> Array:
    """Return the variance of mean counts, estimated from the counts."""
    # A bin without counts is treated as one count.
    return np.maximum(counts, 1.0 / SHOTS) / SHOTS


def _mean_profiles(counts: Array, sky: SimulatedSky, noise: Array | None) -> xr.Dataset:
    """Return counts of a photon channel as the mean profiles that products are retrieved from."""
    missing = np.where(np.isnan(counts), np.int32(Quality.INPUT_MISSING), np.int32(0))
    partial = np.where(sky.inverted, np.int32(0), np.int32(Quality.INCOMPLETE_OVERLAP))
    variance = count_variance(counts) if noise is None else noise
    bins, of_profile = ("time", "range"), np.ones(len(counts), dtype=np.int64)
    return xr.Dataset(
        {
            "power": (bins, PER_COUNT * counts, {DEAD_TIME_ERROR: 0.0}),
            "variance": (bins, PER_COUNT**2 * variance),
            "quality": (bins, missing | partial),
            "shots": ("time", int(SHOTS) * of_profile),
            "profiles": ("time", of_profile),
        },
        coords={"time": np.arange(len(counts)), "range": sky.range, "zenith_angle": 0.0},
    )


def invert(
    counts: Array, sky: SimulatedSky, *, noise: Array | None = None, **changes: Any
) -> xr.Dataset:
    """Return the product of counts, with the lidar ratio and the air of the simulation.

    Parameters
    ----------
    counts : (profile, range) float
        Of a shot; NaN for missing bins.
    sky : SimulatedSky
    noise : (profile, range) float, optional
        Variance of the counts; estimated from them if not given.
    **changes
        Of the arguments of `lidarops.retrieve.elastic.labeled.invert_elastic`.

    Returns
    -------
    xr.Dataset
        With backgrounds in MHz: `PER_COUNT` of a count.
    """
    arguments: dict[str, Any] = {
        "molecules": sky.air,
        "wavelength": WAVELENGTH,
        "station_altitude": 0.0,
        "lidar_ratio": constant_ratio(LIDAR_RATIO, 0.0),
        "molecular_relative_error": 0.0,
        "reference": REFERENCE,
        "overlap_is_stated": True,
    }
    return labeled.invert_elastic(_mean_profiles(counts, sky, noise), **arguments | changes)


CHOSEN: Final = "window chosen"
"""As products are made."""
GIVEN: Final = "window given"
CHAINS: Final[dict[str, dict[str, Any]]] = {
    CHOSEN: {},
    GIVEN: {"reference": _GIVEN},
    "tail_mean, given": {"reference": _GIVEN, "known_shape": False},
}
"""Arguments of `invert` by name."""


# Published files ------------------------------------------------------------------------------


class Published(NamedTuple):
    """One file of the intercomparison."""

    level: float
    """Nominal background in counts per shot."""
    counts: Array
    """(1, range), counts per shot."""
    background: float
    """Truth, by a fit of the noise-free file to this one, because its scale is known only to
    1e-5."""
    background_error: float
    """Standard error of that truth, counts."""


def read_published_profiles(folder: Path) -> tuple[SimulatedSky, list[Published]]:
    """Return the files of the EARLINET elastic intercomparison at 532 nm.

    Parameters
    ----------
    folder : Path
        Holds ``noise_free.licel``, ``molecular_profile_hPa.csv`` (hPa, K, m) and
        ``background_1e*.licel``.

    Returns
    -------
    SimulatedSky
        The backscatter is that of the noise-free signal with the reference window `GIVEN_WINDOW`.
    list of Published
        In order of the background.

    Raises
    ------
    CampaignError
        If the folder holds no such files.
    """
    levels = {
        float(file.stem.removeprefix("background_")): file
        for file in folder.glob("background_1e*.licel")
    }
    if not levels:
        raise CampaignError(
            "holds no files background_1e*.licel", file=folder, field="data",
            remedy="give the folder of the intercomparison, or leave it out",
        )  # fmt: skip
    table = folder / "molecular_profile_hPa.csv"
    pressure, temperature, height = np.loadtxt(table, delimiter=",", unpack=True)
    air = MolecularProfile.from_profile(height, pressure, temperature, pressure_unit="hPa")
    sky = _sky(air, _raw_counts(folder / "noise_free.licel"), np.full(RANGE.size, np.nan))
    inverted = invert(sky.signal[np.newaxis], sky, **CHAINS[GIVEN])
    sky = replace(sky, backscatter=inverted["aerosol_backscatter"].to_numpy()[0])
    published = []
    for level, file in sorted(levels.items()):
        counts = _raw_counts(file) * (BRIGHTEST + level) / (2.0**31 - 1.0)
        truth = known_shape.fit_known_shape(
            counts, sky.range, sky.signal, variance=(sky.signal + level) / SHOTS,
            start=sky.range[_FIRST_TRUE_BIN],
        )  # fmt: skip
        values = (float(truth.background), float(truth.background_standard_error))
        published.append(Published(level, counts[np.newaxis], *values))
    return sky, published


def _raw_counts(file: Path) -> Array:
    return licel.read_counts(file, [_CHANNEL])[1][_CHANNEL].astype(np.float64)


# Random skies ---------------------------------------------------------------------------------

_RATIO_ERROR: Final = 0.2
"""Stated relative standard error of the lidar ratio."""
_AIR_ERROR: Final = 0.02
"""Stated relative standard error of the air density."""
_OF_PRODUCTS: Final = Reference(**dict(ReferenceSettings()))
"""That of products."""
_ASSUMED: Final[dict[str, Any]] = {
    "lidar_ratio": constant_ratio(LIDAR_RATIO, _RATIO_ERROR * LIDAR_RATIO),
    "molecular_relative_error": _AIR_ERROR,
    "reference": _OF_PRODUCTS,
}
_CLOUD_RATIO: Final = 20.0
"""sr, lidar ratio of clouds."""


@dataclass(frozen=True, slots=True)
class RandomSky:
    """True sky and instrument; the retrieval knows none of it. Arrays are (range,)."""

    particles: Array
    """m-1 sr-1."""
    lidar_ratio: float = LIDAR_RATIO
    """sr."""
    density: float = 1.0
    """Density of the air over the assumed one."""
    background: float = 0.0
    """Counts of a baseline that falls slowly with range."""
    cloud: float = 0.0
    """Optical depth of a cloud at 9 km."""
    overlap: float = 0.0
    """m, scale of an overlap that the retrieval does not know."""
    gaps: float = 0.0
    """Share of missing bins."""
    outlying: float = 0.0
    """Share of isolated outlying bins."""


def _random_sky(rng: Random) -> RandomSky:
    """Return a sky with haze in a mixed layer and a layer aloft, none above 6 km."""
    top, amount = rng.uniform(500.0, 3000.0), log_uniform(rng, 1e-7, 1e-5)
    mixed = amount / (1.0 + np.exp((RANGE - top) / rng.uniform(50.0, 200.0)))
    middle, half = rng.uniform(3500.0, 5000.0), rng.uniform(200.0, 900.0)
    aloft = rng.uniform(0.0, 1.0) * amount * np.exp(-0.5 * ((RANGE - middle) / (0.3 * half)) ** 2)
    return RandomSky(np.where(RANGE < CLEAN_FROM, mixed + aloft, 0.0))


_Change = Callable[[RandomSky, Random], RandomSky]


def _hazy(least: float) -> _Change:
    """Return the change that adds haze of `least` to 100 times as much, m-1 sr-1 at the ground."""

    def change(sky: RandomSky, rng: Random) -> RandomSky:
        haze = log_uniform(rng, least, 100.0 * least)
        return replace(sky, particles=sky.particles + haze * np.exp(-RANGE / 5000.0))

    return change


def _clean(sky: RandomSky, _: Random) -> RandomSky:
    """Return the sky without particles at the heights of possible reference windows."""
    lowest = _OF_PRODUCTS.lowest
    # Smoothly, as in air: 1e-7 of them are left there.
    left = 1.0 / (1.0 + np.exp((RANGE - lowest + 1000.0) / 60.0))
    return replace(sky, particles=np.where(lowest > RANGE, left * sky.particles, 0.0))


def _off(rng: Random, error: float) -> float:
    """Return a factor that deviates by this standard error, at most by 3 of them."""
    return 1.0 + error * float(np.clip(rng.normal(), -3.0, 3.0))


FAILURES: Final[tuple[tuple[Failure, _Change], ...]] = (
    (Failure("none", satisfied=True), _clean),
    (Failure("gaps", satisfied=True),
     lambda sky, rng: replace(_clean(sky, rng), gaps=rng.uniform(0.0, 0.2))),
    (Failure("lidar ratio off as stated"),
     lambda sky, rng: replace(sky, lidar_ratio=sky.lidar_ratio * _off(rng, _RATIO_ERROR))),
    (Failure("lidar ratio off by a factor of 2"),
     lambda sky, rng: replace(sky, lidar_ratio=sky.lidar_ratio * float(rng.choice([0.5, 2.0])))),
    (Failure("density of the air off as stated"),
     lambda sky, rng: replace(sky, density=_off(rng, _AIR_ERROR))),
    (Failure("haze at all heights"), _hazy(1e-9)),
    (Failure("slow baseline"), lambda sky, rng: replace(sky, background=rng.uniform(0.0, 3.0))),
    (Failure("cloud in the far range"),
     lambda sky, rng: replace(sky, cloud=log_uniform(rng, 0.01, 3.0))),
    (Failure("overlap error"), lambda sky, rng: replace(sky, overlap=rng.uniform(50.0, 300.0))),
    (Failure("more haze than stated"), _hazy(1e-8)),
    (Failure("outliers"), lambda sky, rng: replace(sky, outlying=rng.uniform(0.0, 0.02))),
    (Failure("particles in the reference window"), lambda sky, _: sky),
)  # fmt: skip


def _random_signal(sky: RandomSky) -> Array:
    """Return the noise-free signal, 1 in the brightest bin that the inversion uses."""
    air = MolecularProfile.us_standard()

    def haze(z: Array) -> Array:
        return np.interp(z, RANGE, sky.particles)

    def cirrus(z: Array) -> Array:
        return sky.cloud * np.exp(-0.5 * ((z - 9000.0) / 150.0) ** 2) / (150.0 * 2.5066282746)

    def extinction(z: Array) -> Array:
        molecules = sky.density * air.extinction(z, WAVELENGTH)
        return molecules + sky.lidar_ratio * haze(z) + cirrus(z)

    def backscatter(z: Array) -> Array:
        molecules = sky.density * air.backscatter(z, WAVELENGTH)
        return np.asarray(haze(z) + cirrus(z) / _CLOUD_RATIO + molecules)

    signal = clean_signal(extinction, backscatter)
    if sky.overlap:
        signal = signal * (1.0 - np.exp(-((RANGE / sky.overlap) ** 2)))
    return np.asarray(signal / signal[RANGE > OVERLAP].max())


def score_elastic(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Yield the scored values of profiles of one random sky, class by class."""
    base = simulated_sky()
    for number, (failure, change) in enumerate(FAILURES):
        rng = np.random.default_rng((74, cluster, number))
        sky = change(_random_sky(rng), rng)
        brightest, level = log_uniform(rng, 1e4, 1e8), log_uniform(rng, 1.0, 1e5)
        signal = brightest * np.minimum(_random_signal(sky), 1.0)
        mean = SHOTS * (signal + level + sky.background * np.exp(-RANGE / 8000.0))
        counts = rng.poisson(np.broadcast_to(mean, (profiles, mean.size))) / SHOTS
        if sky.gaps:
            counts = np.where(rng.random(counts.shape) < sky.gaps, np.nan, counts)
        noise = count_variance(counts)
        if sky.outlying:
            counts = counts + np.sqrt(noise) * _deviations(rng, counts.shape, sky.outlying)
        yield _scored(failure, sky, invert(counts, base, noise=noise, **_ASSUMED))


def _deviations(rng: Random, shape: tuple[int, ...], share: float) -> Array:
    """Return the deviations of bins in standard deviations of the noise: 0, or 3 to 1000."""
    size = log_uniform(rng, 3.0, 1e3, shape) * rng.choice([-1.0, 1.0], shape)
    return np.where(rng.random(shape) < share, size, 0.0)


def _scored(failure: Failure, sky: RandomSky, product: xr.Dataset) -> ScoredValues:
    inside = simulated_sky().compared

    def values(name: str) -> Any:
        return product[name].to_numpy()[:, inside]

    def error(kind: ErrorKind) -> Array:
        parts = [values(f"aerosol_backscatter_error_{cause}") for cause in sources(kind)]
        return np.asarray(np.sqrt(sum(part**2 for part in parts)))

    bits = values("quality_flag")
    # As products average them: what is independent between profiles is random.
    return ScoredValues(
        failure, "backscatter", values("aerosol_backscatter") - sky.particles[inside],
        error(ErrorKind.RANDOM), error(ErrorKind.SYSTEMATIC), bits, ElasticQuality,
        uncertain=(bits & int(ElasticQuality.CLOUD)) != 0,
    )  # fmt: skip
