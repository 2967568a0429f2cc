"""Random networks of lidars, with air and lidars that violate the assumptions."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from benchmarks.accuracy.network_cases import BLOCK, Air, LidarLine, Signals, signals
from benchmarks.harness.figure import Array, Random
from benchmarks.stability.random_scenes import Failure, ScoredValues, held_first
from lidarops.errors import LidarOpsError
from lidarops.products.visibility import VisibilityProductSettings
from lidarops.retrieve.network import extinction_field, labeled
from lidarops.retrieve.network.flags import NetworkQuality

_FULL_OVERLAP: Final = 100.0
_DOUBTED: Final = np.int32(NetworkQuality.POORLY_DETERMINED)
"""Quality bit that stands for any flag of the retrieval that doubts a value."""


@dataclass(frozen=True, slots=True)
class _Measurement:
    """Input of the retrieval."""

    power: Array
    variance: Array
    exponent: float = 1.0


DrawAir = Callable[[Random], Air]
Damage = Callable[[_Measurement, Signals, Random], _Measurement]


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


def homogeneous(rng: Random) -> Air:
    """Return air of one random extinction."""
    value = float(np.exp(rng.uniform(np.log(1e-5), np.log(6e-2))))
    return Air("homogeneous", lambda _: lambda __, up: np.full_like(up, value))


def layered(rng: Random) -> Air:
    """Return air whose extinction falls or grows with height."""
    value = float(np.exp(rng.uniform(np.log(1e-5), np.log(1e-2))))
    scale = float(rng.uniform(300.0, 3000.0) * rng.choice([-1.0, 1.0]))
    return Air("layered", lambda _: lambda __, up: value * np.exp(-up / scale))


def plume(rng: Random, *, drift: float = 0.0) -> Air:
    """Return air with a plume, which drifts by `drift` m in a block."""
    value = float(np.exp(rng.uniform(np.log(1e-4), np.log(5e-3))))
    excess, width = rng.uniform(0.3, 3.0), rng.uniform(50.0, 300.0)
    centre = rng.uniform([-300.0, 300.0], [300.0, 900.0])

    def at(profile: int) -> Callable[[Array, Array], Array]:
        east_centre = centre[0] + drift * (profile / BLOCK - 0.5)

        def field(east: Array, up: Array) -> Array:
            square_distance = ((east - east_centre) ** 2 + (up - centre[1]) ** 2) / (2.0 * width**2)
            return np.asarray(value * (1.0 + excess * np.exp(-square_distance)))

        return field

    return Air("plume", at, moving=drift != 0.0)


def _thin_layer(rng: Random) -> Air:
    """Return a layer of a few bins, in which the signal is curved within a fit."""
    value = float(np.exp(rng.uniform(np.log(1e-4), np.log(5e-3))))
    excess, depth = rng.uniform(0.3, 3.0), rng.uniform(10.0, 60.0)
    height = rng.uniform(300.0, 900.0)

    def field(_: Array, up: Array) -> Array:
        return np.asarray(value * (1.0 + excess * np.exp(-((up - height) ** 2) / (2.0 * depth**2))))

    return Air("thin layer", lambda _: field)


def _drifting_plume(rng: Random) -> Air:
    return plume(rng, drift=300.0)


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


def _undamaged(measurement: _Measurement, _: Signals, __: Random) -> _Measurement:
    return measurement


def _with_little_noise(measurement: _Measurement, clean: Signals, rng: Random) -> _Measurement:
    """Draw again with the noise of long averages, which does not hide curved signals."""
    noise = float(np.exp(rng.uniform(np.log(1e-3), np.log(3e-2))))
    return _Measurement(
        *clean.draw(noise, len(measurement.power), int(rng.integers(2**31)), additive=0.0)
    )


def _with_overlap(measurement: _Measurement, clean: Signals, rng: Random) -> _Measurement:
    loss = rng.uniform(0.0, 0.2, (clean.network.beams, 1))
    scale = rng.uniform(50.0, 300.0)
    return _Measurement(
        measurement.power * (1.0 - loss * np.exp(-(clean.range - _FULL_OVERLAP) / scale)),
        measurement.variance,
    )


def _with_outliers(measurement: _Measurement, _: Signals, rng: Random) -> _Measurement:
    outlying = rng.random(measurement.power.shape) < 0.01
    size = rng.uniform(5.0, 100.0, measurement.power.shape) * np.sqrt(measurement.variance)
    return _Measurement(measurement.power + outlying * size, measurement.variance)


def _with_gaps(measurement: _Measurement, _: Signals, rng: Random) -> _Measurement:
    missing = rng.random(measurement.power.shape) < rng.uniform(0.0, 0.2)
    return _Measurement(np.where(missing, np.nan, measurement.power), measurement.variance)


def _with_exponent(measurement: _Measurement, _: Signals, rng: Random) -> _Measurement:
    return _Measurement(measurement.power, measurement.variance, float(rng.uniform(0.8, 1.25)))


def _with_offset(measurement: _Measurement, _: Signals, rng: Random) -> _Measurement:
    """Add a background of a fraction of the noise of the far bins."""
    offset = rng.normal(0.0, rng.uniform(0.0, 0.5), (*measurement.power.shape[:2], 1))
    return _Measurement(
        measurement.power + offset * np.sqrt(measurement.variance[..., -1:]), measurement.variance
    )


def _with_a_bad_profile(measurement: _Measurement, clean: Signals, rng: Random) -> _Measurement:
    """Change one beam of one profile by 1.3 to 5 times behind some range, or by a cloud there."""
    power, net = measurement.power.copy(), clean.network
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
    return _Measurement(power, measurement.variance)


FAILURES: Final[tuple[tuple[Failure, DrawAir, Damage], ...]] = (
    (Failure("none, homogeneous", satisfied=True), homogeneous, _undamaged),
    (Failure("none, layered", satisfied=True), layered, _undamaged),
    (Failure("none, plume", satisfied=True), plume, _undamaged),
    (Failure("plume that drifts within a block"), _drifting_plume, _undamaged),
    (Failure("gaps", satisfied=True), layered, _with_gaps),
    (Failure("outliers"), layered, _with_outliers),
    (Failure("overlap error"), layered, _with_overlap),
    (Failure("wrong exponent"), layered, _with_exponent),
    (Failure("background left in the signals"), layered, _with_offset),
    (Failure("layer of a few bins"), _thin_layer, _with_little_noise),
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
        if draw_air is _thin_layer and cluster % 2 == 1:
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
) -> tuple[extinction_field.NetworkResult, Array] | None:
    """Return the result and the truth; None where the beams do not meet."""
    noise = float(np.exp(rng.uniform(np.log(1e-3), np.log(0.3))))
    net = random_network(rng).network()
    if net.crossings < 2 or not np.all(np.diff(np.bincount(net.passages.beam)) == 0):
        return None
    clean = signals(net, draw_air(rng))
    power, variance = clean.draw(noise, profiles, int(rng.integers(2**31)))
    measurement = damage(_Measurement(power, variance), clean, rng)
    try:
        result = extinction_field.retrieve_network(
            measurement.power, clean.range, net, variance=measurement.variance,
            exponent=measurement.exponent, full_overlap_range=_FULL_OVERLAP,
            blocks=np.arange(profiles) // BLOCK,
        )  # fmt: skip
    except LidarOpsError:
        # Beams without two crossings in range raise an error.
        return None
    return result, clean.truth(profiles)


# Short blocks, and lidar ratios -------------------------------------------------------------------

_LONG_WAVES: Final = (300.0, 3000.0)
"""m; lengths of the waves of the lidar ratio."""
_DEFAULT: Final = VisibilityProductSettings.model_fields["lidar_ratio_relative_error"].default
_VARIED: Final = {
    0.07: {"the default declared": _DEFAULT},
    0.1: {"the default declared": _DEFAULT, "10 % declared": 0.1},
}
"""What is declared, by the rms variation of the lidar ratio within a network and words."""


def _drawn(rng: Random, draw_air: DrawAir) -> tuple[Signals, float] | None:
    """Return clean signals of a random network, and the noise; None where beams do not meet."""
    noise = float(np.exp(rng.uniform(np.log(1e-3), np.log(0.3))))
    net = random_network(rng).network()
    if net.crossings < 2 or np.bincount(net.passages.beam).min() < 2:
        return None
    return signals(net, draw_air(rng)), noise


def score_short_blocks(
    cluster: int, profiles: int, *, draw_air: DrawAir, name: str, length: int
) -> Iterator[ScoredValues]:
    """Yield results of networks that are solved in blocks of a few profiles; a class of that name.

    `length` is the number of profiles of a block.
    """
    rng = np.random.default_rng((81, cluster))
    drawn = _drawn(rng, draw_air)
    if drawn is None:
        return
    clean, noise = drawn
    power, variance = clean.draw(noise, profiles, int(rng.integers(2**31)))
    result = extinction_field.retrieve_network(
        power, clean.range, clean.network, variance=variance, full_overlap_range=_FULL_OVERLAP,
        blocks=np.arange(profiles) // length,
    )  # fmt: skip
    yield scored(Failure(name, satisfied=True), result, clean.truth(profiles), 0.0)


def scored(
    failure: Failure, result: extinction_field.NetworkResult, truth: Array, systematic: Any
) -> ScoredValues:
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
    drawn = _drawn(rng, plume)
    if drawn is None:
        return
    clean, noise = drawn
    net = clean.network
    wave = 2.0 * np.pi / np.exp(rng.uniform(np.log(_LONG_WAVES[0]), np.log(_LONG_WAVES[1]), 2))
    at = net.origin[:, :, np.newaxis] + net.direction[:, :, np.newaxis] * clean.range
    phase = wave[0] * at[:, 0] + wave[1] * at[:, 2] + rng.uniform(0.0, 2.0 * np.pi)
    seed = int(rng.integers(2**31))
    for varied, declared in _VARIED.items():
        ratio = np.exp(varied * np.sqrt(2.0) * np.sin(phase))
        power, variance = replace(clean, power=clean.power / ratio).draw(noise, profiles, seed)
        result = extinction_field.retrieve_network(
            power, clean.range, net, variance=variance, full_overlap_range=_FULL_OVERLAP
        )
        for words, error in declared.items():
            name = f"lidar ratio varies by {100.0 * varied:g} %, {words}"
            # As products state it.
            systematic = labeled.lidar_ratio_error(result, net, clean.range, error)
            failure = Failure(name)
            yield scored(failure, result, clean.truth(profiles), systematic)
