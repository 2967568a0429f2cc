"""Networks of lidars in known air, chosen and random ones, and solvers for its extinction.

Random networks have air and lidars that satisfy or violate the assumptions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np

from benchmarks.harness.figure import Array, Random, log_uniform
from benchmarks.harness.rates import Failure, ScoredValues, held_first
from lidarops.errors import LidarOpsError
from lidarops.products.visibility import VisibilityProductSettings
from lidarops.retrieve.network import extinction_field, geometry, labeled
from lidarops.retrieve.network.extinction_field import FieldPrior, NetworkResult
from lidarops.retrieve.network.flags import NetworkQuality
from lidarops.simulate.signal import backscatter_signal

STEP: Final = 5.0
"""m, of the range bins."""
FULL_OVERLAP: Final = 100.0
"""m."""
NOISES: Final = (0.02, 0.05, 0.1)
"""Relative standard deviation of a bin."""
PEER_NOISE: Final = NOISES[1]
"""Noise of the profiles that peers solve too."""
ADDITIVE: Final = 0.01
"""Additional standard deviation of every bin, over the power at the first crossing of the beam."""
BLOCK: Final = 50
"""Profiles that share a prior."""
_FIRST_BIN: Final = 100.3
"""m, range of the first bin."""
_BEYOND: Final = 60.0
"""m, length of a signal after the last crossing."""
_CELLS: Final = 5
"""Cells of a bin, over which the optical depth is summed."""


# Networks -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class LidarLine:
    """Lidars on a line with beams in one vertical plane."""

    name: str
    east: tuple[float, ...]
    """m, of each lidar."""
    elevations: tuple[tuple[float, ...], ...]
    """degree, of the beams of each lidar, from the eastern horizon over the zenith."""
    farthest: float = np.inf
    """m, largest range of the signals."""

    def network(self) -> geometry.Network:
        """Return beams and crossings."""
        pairs = [(x, a) for x, fan in zip(self.east, self.elevations, strict=True) for a in fan]
        angle = np.radians([a for _, a in pairs])
        return geometry.network_of_lines(
            [[x, 0.0, 0.0] for x, _ in pairs],
            np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], axis=1),
            tolerance=1e-3,
            farthest=self.farthest,
        )


TRIANGLE: Final = LidarLine("triangle", (300.0, -500.0, 0.0), ((120.0,), (60.0,), (90.0,)))
"""The triangle of the paper (drabenko2021): lidars 1, 2 and 3."""
THREE_BY_TWO: Final = LidarLine(
    "3 x 2 beams",
    (-500.0, 0.0, 400.0),
    ((50.0, 68.0), (78.0, 103.0), (112.0, 130.0)),
    farthest=1000.0,
)
LIDAR_LINES: Final = (TRIANGLE, THREE_BY_TWO)


# Air ------------------------------------------------------------------------------------------

Extinction = Callable[[Array, Array], Array]
"""Function from east and up in m to extinction in m-1."""


@dataclass(frozen=True, slots=True)
class Air:
    """A field of extinction that may move from profile to profile."""

    name: str
    at: Callable[[int], Extinction]
    """Field of a profile of the block."""
    moving: bool = False

    def fields(self) -> list[Extinction]:
        """Return the fields of the profiles of a block; one field if it does not move."""
        return [self.at(profile) for profile in range(BLOCK if self.moving else 1)]


def _homogeneous(extinction: float) -> Extinction:
    return lambda _, up: np.full_like(up, extinction)


def _gradient(_: Array, up: Array) -> Array:
    return np.asarray(2e-3 * np.exp(-(up - 600.0) / 1010.0))


def _plume(east: float) -> Extinction:
    def plume(x: Array, up: Array) -> Array:
        square_distance = ((x - east) ** 2 + (up - 650.0) ** 2) / (2.0 * 110.0**2)
        return np.asarray(1.5e-3 + 2e-3 * np.exp(-square_distance))

    return plume


THIN: Final = Air("homogeneous, 0.2 per km", lambda _: _homogeneous(2e-4))
"""Air of which noise hides the attenuation."""
AIRS: Final = (
    Air("homogeneous", lambda _: _homogeneous(2e-3)),
    Air("gradient", lambda _: _gradient),
    Air("plume", lambda _: _plume(-40.0)),
    Air("drifting plume", lambda profile: _plume(-200.0 + 300.0 * profile / BLOCK), moving=True),
    THIN,
)
"""The gradient is 2 per km at 600 m with a scale height of 1 km. The plume has 3.5 per km in air
of 1.5 per km, and drifts by 300 m in a block."""


# Signals --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Signals:
    """Signals of the lidars of a network without noise."""

    network: geometry.Network
    range: Array
    """m."""
    power: Array
    """(field, beam, range) for lidar constants of 1."""
    extinction: Array
    """(field, crossing) m-1, the truth."""

    def draw(
        self, noise: float, profiles: int, *seed: int, additive: float = ADDITIVE
    ) -> tuple[Array, Array]:
        """Return (profile, beam, range) noisy power and its variance, reproducible by the seed."""
        fields = np.arange(profiles) % len(self.power)
        deviation = np.hypot(noise * self.power, additive * self._first[..., np.newaxis])[fields]
        random = np.random.default_rng(seed)
        power = self.power[fields] + deviation * random.standard_normal(deviation.shape)
        return power, deviation**2

    def truth(self, profiles: int) -> Array:
        """Return (profile, crossing) extinction, m-1."""
        return self.extinction[np.arange(profiles) % len(self.extinction)]

    @property
    def _first(self) -> Array:
        """(field, beam) power at the first crossing of each beam."""
        power = np.empty(self.power.shape[:2])
        for beam in range(self.network.beams):
            first_range = self.network.on_beam(beam)[1][0]
            power[:, beam] = [
                np.interp(first_range, self.range, field[beam]) for field in self.power
            ]
        return power


def signals(net: geometry.Network, air: Air, first_bin: float = _FIRST_BIN) -> Signals:
    """Return signals, with optical depth summed over cells of a fifth of a bin."""
    bins = np.arange(first_bin, float(net.passages.range.max()) + _BEYOND, STEP)
    fields = air.fields()
    return Signals(
        net,
        bins,
        np.stack([_power(net, bins, field) for field in fields]),
        np.stack([field(net.crossing[:, 0], net.crossing[:, 2]) for field in fields]),
    )


def _power(net: geometry.Network, bins: Array, extinction: Extinction) -> Array:
    cell = STEP / _CELLS
    before = int(bins[0] // cell)
    cells = bins[0] + cell * np.arange(-before, _CELLS * (bins.size - 1) + 1)
    power = np.empty((net.beams, bins.size))
    for beam in range(net.beams):
        origin, direction = net.origin[beam], net.direction[beam]
        east, up = (origin[axis] + direction[axis] * cells for axis in (0, 2))
        scattering = extinction(east, up)
        power[beam] = backscatter_signal(
            cells, extinction=scattering, backscatter=scattering, system_constant=1.0
        )[before::_CELLS]
    return power


# Solvers --------------------------------------------------------------------------------------


def solve(
    power: Array, variance: Array, clean: Signals, length: int = BLOCK, **options: Any
) -> NetworkResult:
    """Solve profiles (profile, beam, range) in blocks of a length, with further arguments."""
    return extinction_field.retrieve_network(
        power, clean.range, clean.network, variance=variance, full_overlap_range=FULL_OVERLAP,
        blocks=np.arange(len(power)) // length, **options,
    )  # fmt: skip


NO_PRIOR: Final = "network, no prior"
NETWORK: Final = "network"
SOLVERS: Final = {
    NO_PRIOR: partial(solve, prior=FieldPrior.NONE.value),
    NETWORK: partial(solve, prior=FieldPrior.BLOCK.value),
}
"""The retrieval with its priors, by name."""


# Random networks ------------------------------------------------------------------------------

_DOUBTED: Final = np.int32(NetworkQuality.POORLY_DETERMINED)
"""Quality bit that stands for any flag of the retrieval that doubts a value."""


DrawAir = Callable[[Random], Air]
Damage = Callable[[Array, Array, Signals, Random], dict[str, Any]]
"""Returns changed arguments of `solve`, given power, variance, clean signals and numbers."""


def random_network(rng: Random) -> LidarLine:
    """Return 3 or 4 lidars on a line with 1 or 2 beams each that meet above it."""
    lidar_count = int(rng.integers(3, 5))
    east = np.linspace(-600.0, 600.0, lidar_count) + rng.uniform(-150.0, 150.0, lidar_count)
    target = rng.uniform([-300.0, 300.0], [300.0, 900.0], (2, 2))
    beam_count = int(rng.integers(1, 3))
    elevations = tuple(
        tuple(
            float(np.degrees(np.arctan2(height + rng.uniform(-150.0, 150.0), x - lidar)))
            for x, height in target[:beam_count]
        )
        for lidar in east
    )
    return LidarLine("random", tuple(float(x) for x in east), elevations, farthest=2500.0)


def random_signals(rng: Random, draw_air: DrawAir) -> Signals | None:
    """Return clean signals of a random network; None where its beams do not meet."""
    net = random_network(rng).network()
    if net.crossings < 2 or np.bincount(net.passages.beam).min() < 2:
        return None
    return signals(net, draw_air(rng))


def homogeneous(rng: Random) -> Air:
    """Return air of one random extinction."""
    value = log_uniform(rng, 1e-5, 6e-2)
    return Air("homogeneous", lambda _: _homogeneous(value))


def layered(rng: Random) -> Air:
    """Return air whose extinction falls or grows with height."""
    value = log_uniform(rng, 1e-5, 1e-2)
    scale = float(rng.uniform(300.0, 3000.0) * rng.choice([-1.0, 1.0]))
    return Air("layered", lambda _: lambda __, up: value * np.exp(-up / scale))


def plume(rng: Random, *, drift: float = 0.0) -> Air:
    """Return air with a plume, which drifts by `drift` m in a block."""
    value = log_uniform(rng, 1e-4, 5e-3)
    excess, width = rng.uniform(0.3, 3.0), rng.uniform(50.0, 300.0)
    centre = rng.uniform([-300.0, 300.0], [300.0, 900.0])

    def at(profile: int) -> Callable[[Array, Array], Array]:
        east_centre = centre[0] + drift * (profile / BLOCK - 0.5)

        def field(east: Array, up: Array) -> Array:
            square_distance = ((east - east_centre) ** 2 + (up - centre[1]) ** 2) / (2.0 * width**2)
            return np.asarray(value * (1.0 + excess * np.exp(-square_distance)))

        return field

    return Air("plume", at, moving=drift != 0.0)


def thin_layer(rng: Random) -> Air:
    """Return a layer of a few bins, in which the signal is curved within a fit."""
    value = log_uniform(rng, 1e-4, 5e-3)
    excess, depth = rng.uniform(0.3, 3.0), rng.uniform(10.0, 60.0)
    height = rng.uniform(300.0, 900.0)

    def field(_: Array, up: Array) -> Array:
        return np.asarray(value * (1.0 + excess * np.exp(-((up - height) ** 2) / (2.0 * depth**2))))

    return Air("thin layer", lambda _: field)


_FACTORS: Final = (2.0, 10.0)
"""By which extinction changes within a block, as in fog that comes or goes."""


def changing(rng: Random) -> Air:
    """Return air whose extinction changes everywhere: steadily, in a wave, or as a front passes."""
    base = (homogeneous if rng.random() < 0.5 else layered)(rng).at(0)
    size = rng.uniform(*np.log(_FACTORS)) * rng.choice([-1.0, 1.0])
    start, duration, course = rng.uniform(0.2, 0.8), rng.uniform(0.02, 0.2), rng.integers(3)

    def gain(profile: int) -> float:
        time = profile / BLOCK
        front = 1.0 / (1.0 + np.exp((start - time) / duration))
        return float(np.exp(size * (time, 0.5 * np.sin(2.0 * np.pi * time), front)[course]))

    return Air(
        "changing", lambda profile: lambda east, up: gain(profile) * base(east, up), moving=True
    )


def _undamaged(_: Array, __: Array, ___: Signals, ____: Random) -> dict[str, Any]:
    return {}


def _with_little_noise(power: Array, _: Array, clean: Signals, rng: Random) -> dict[str, Any]:
    """Draw again with the noise of long averages, which does not hide curved signals."""
    noise, seed = log_uniform(rng, 1e-3, 3e-2), int(rng.integers(2**31))
    power, variance = clean.draw(noise, len(power), seed, additive=0.0)
    return {"power": power, "variance": variance}


def _with_overlap(power: Array, _: Array, clean: Signals, rng: Random) -> dict[str, Any]:
    loss = rng.uniform(0.0, 0.2, (clean.network.beams, 1))
    scale = rng.uniform(50.0, 300.0)
    return {"power": power * (1.0 - loss * np.exp(-(clean.range - FULL_OVERLAP) / scale))}


def _with_outliers(power: Array, variance: Array, _: Signals, rng: Random) -> dict[str, Any]:
    outlying = rng.random(power.shape) < 0.01
    return {"power": power + outlying * rng.uniform(5.0, 100.0, power.shape) * np.sqrt(variance)}


def _with_gaps(power: Array, _: Array, __: Signals, rng: Random) -> dict[str, Any]:
    missing = rng.random(power.shape) < rng.uniform(0.0, 0.2)
    return {"power": np.where(missing, np.nan, power)}


def _with_exponent(_: Array, __: Array, ___: Signals, rng: Random) -> dict[str, Any]:
    return {"exponent": float(rng.uniform(0.8, 1.25))}


def _with_offset(power: Array, variance: Array, _: Signals, rng: Random) -> dict[str, Any]:
    """Add a background of a fraction of the noise of the far bins."""
    offset = rng.normal(0.0, rng.uniform(0.0, 0.5), (*power.shape[:2], 1))
    return {"power": power + offset * np.sqrt(variance[..., -1:])}


def _with_a_bad_profile(power: Array, _: Array, clean: Signals, rng: Random) -> dict[str, Any]:
    """Change one beam of one profile by 1.3 to 5 times behind some range, or by a cloud there."""
    power, net = power.copy(), clean.network
    beam = int(rng.integers(net.beams))
    at = rng.uniform(*net.on_beam(beam)[1][[0, -1]])
    if rng.random() < 0.5:
        step = rng.uniform(*np.log((1.3, 5.0))) * rng.choice([-1.0, 1.0])
        shape = step / (1.0 + np.exp((at - clean.range) / rng.uniform(10.0, 60.0)))
    else:
        cloud = np.exp(-0.5 * ((clean.range - at) / rng.uniform(15.0, 60.0)) ** 2)
        depth = rng.uniform(0.1, 2.0) * np.cumsum(cloud) / cloud.sum()
        shape = np.log1p(rng.uniform(1.0, 20.0) * cloud) - 2.0 * depth
    power[rng.integers(len(power)), beam] *= np.exp(shape)
    return {"power": power}


FAILURES: Final[tuple[tuple[Failure, DrawAir, Damage], ...]] = (
    (Failure("none, homogeneous", satisfied=True), homogeneous, _undamaged),
    (Failure("none, layered", satisfied=True), layered, _undamaged),
    (Failure("none, plume", satisfied=True), plume, _undamaged),
    (Failure("plume that drifts within a block"), partial(plume, drift=300.0), _undamaged),
    (Failure("gaps", satisfied=True), layered, _with_gaps),
    (Failure("outliers"), layered, _with_outliers),
    (Failure("overlap error"), layered, _with_overlap),
    (Failure("wrong exponent"), layered, _with_exponent),
    (Failure("background left in the signals"), layered, _with_offset),
    (Failure("layer of a few bins"), thin_layer, _with_little_noise),
    (Failure("air that changes everywhere"), changing, _undamaged),
    (Failure("one bad profile"), plume, _with_a_bad_profile),
)


_DECIDABLE: Final = (homogeneous, layered)
"""Air of which some hundred networks decide the target where the model holds."""


def score_networks(
    cluster: int, profiles: int, *, of_all: float = math.inf
) -> Iterator[ScoredValues]:
    """Yield results of blocks of profiles of random networks, class by class.

    Parameters
    ----------
    cluster, profiles : int
    of_all : float
        Number of the cluster from which only undamaged homogeneous and layered air is drawn.
    """
    for index, (failure, draw_air, damage) in held_first(FAILURES):
        # Curvature has a similar effect in every layer: half of the clusters are enough.
        if draw_air is thin_layer and cluster % 2 == 1:
            continue
        if cluster >= of_all and not (damage is _undamaged and draw_air in _DECIDABLE):
            continue
        rng = np.random.default_rng((73, cluster, index))
        solved = _solve_damaged(rng, draw_air, damage, profiles)
        if solved is None:
            continue
        result, truth = solved
        values = scored(failure, result, truth, 0.0)
        # Values with a small standard error should not be flagged.
        with np.errstate(invalid="ignore"):
            small = np.asarray(values.random < 0.1 * truth[:, result.near_crossing])
        yield replace(values, solvable=np.isfinite(values.error) & small)


def _solve_damaged(
    rng: Random, draw_air: DrawAir, damage: Damage, profiles: int
) -> tuple[NetworkResult, Array] | None:
    """Return the result and the truth; None where the beams do not meet."""
    noise, clean = log_uniform(rng, 1e-3, 0.3), random_signals(rng, draw_air)
    if clean is None or np.ptp(np.bincount(clean.network.passages.beam)):
        return None
    power, variance = clean.draw(noise, profiles, int(rng.integers(2**31)))
    given: dict[str, Any] = {"power": power, "variance": variance, "clean": clean}
    given |= damage(power, variance, clean, rng)
    try:
        return solve(**given), clean.truth(profiles)
    except LidarOpsError:
        # Beams without two crossings in range raise an error.
        return None


# Short blocks, and lidar ratios -------------------------------------------------------------------

_LONG_WAVES: Final = (300.0, 3000.0)
"""m; lengths of the waves of the lidar ratio."""
_DEFAULT: Final = VisibilityProductSettings.model_fields["lidar_ratio_relative_error"].default
_VARIED: Final = {
    0.07: {"the default declared": _DEFAULT},
    0.1: {"the default declared": _DEFAULT, "10 % declared": 0.1},
}
"""What is declared, by the rms variation of the lidar ratio within a network and words."""


def score_short_blocks(
    cluster: int, profiles: int, *, draw_air: DrawAir, name: str, length: int
) -> Iterator[ScoredValues]:
    """Yield results of networks that are solved in blocks of a few profiles; a class of that name.

    `length` is the number of profiles of a block.
    """
    rng = np.random.default_rng((81, cluster))
    noise, clean = log_uniform(rng, 1e-3, 0.3), random_signals(rng, draw_air)
    if clean is None:
        return
    power, variance = clean.draw(noise, profiles, int(rng.integers(2**31)))
    result = solve(power, variance, clean, length)
    yield scored(Failure(name, satisfied=True), result, clean.truth(profiles), 0.0)


def scored(failure: Failure, result: NetworkResult, truth: Array, systematic: Any) -> ScoredValues:
    """Return the values at near crossings."""
    near = result.near_crossing
    bits = np.where(result.flagged, _DOUBTED, np.int32(0))
    return ScoredValues(
        failure, "extinction", (result.extinction - truth)[:, near],
        result.extinction_standard_error[:, near],
        np.broadcast_to(systematic, truth.shape)[:, near], bits[:, near], NetworkQuality,
    )  # fmt: skip


def score_lidar_ratios(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Yield results of networks whose lidar ratio varies along a wave of random direction."""
    rng = np.random.default_rng((86, cluster))
    noise, clean = log_uniform(rng, 1e-3, 0.3), random_signals(rng, plume)
    if clean is None:
        return
    net = clean.network
    wave = 2.0 * np.pi / log_uniform(rng, *_LONG_WAVES, (2,))
    at = net.origin[:, :, np.newaxis] + net.direction[:, :, np.newaxis] * clean.range
    phase = wave[0] * at[:, 0] + wave[1] * at[:, 2] + rng.uniform(0.0, 2.0 * np.pi)
    seed = int(rng.integers(2**31))
    for varied, declared in _VARIED.items():
        ratio = np.exp(varied * np.sqrt(2.0) * np.sin(phase))
        power, variance = replace(clean, power=clean.power / ratio).draw(noise, profiles, seed)
        result = solve(power, variance, clean)
        for words, error in declared.items():
            failure = Failure(f"lidar ratio varies by {100.0 * varied:g} %, {words}")
            # As products state it.
            systematic = labeled.lidar_ratio_error(result, net, clean.range, error)
            yield scored(failure, result, clean.truth(profiles), systematic)
