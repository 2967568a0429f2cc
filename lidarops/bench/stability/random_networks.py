"""Random networks of lidars, and air and lidars that are not as assumed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from lidarops.bench.accuracy.network_cases import BLOCK, Air, Place, Signals, signals
from lidarops.bench.stability.random_scenes import Failure, Judged
from lidarops.bench.stability.stiff_cases import Array
from lidarops.errors import LidarOpsError
from lidarops.flags import Quality
from lidarops.retrieve.network import extinction_field

Random = np.random.Generator

_FULL_OVERLAP: Final = 100.0
_DOUBTED: Final = np.int32(Quality.UNSTABLE_INVERSION)
"""Stands for any of the retrieval's own flags that doubt a value."""


@dataclass(frozen=True, slots=True)
class Told:
    """What the retrieval is given."""

    power: Array
    variance: Array
    exponent: float = 1.0


def random_network(rng: Random) -> Place:
    """Return 3 or 4 lidars on a line with 1 or 2 beams each, which meet above it."""
    count = int(rng.integers(3, 5))
    east = np.linspace(-600.0, 600.0, count) + rng.uniform(-150.0, 150.0, count)
    target = rng.uniform([-300.0, 300.0], [300.0, 900.0], (2, 2))
    beams = int(rng.integers(1, 3))
    elevations = tuple(
        tuple(
            float(np.degrees(np.arctan2(height + rng.uniform(-150.0, 150.0), x - lidar)))
            for x, height in target[:beams]
        )
        for lidar in east
    )
    return Place("random", tuple(float(x) for x in east), elevations, farthest=2500.0)


def _homogeneous(rng: Random) -> Air:
    value = float(np.exp(rng.uniform(np.log(1e-5), np.log(6e-2))))
    return Air("homogeneous", lambda _: lambda __, up: np.full_like(up, value))


def _layered(rng: Random) -> Air:
    value = float(np.exp(rng.uniform(np.log(1e-5), np.log(1e-2))))
    scale = float(rng.uniform(300.0, 3000.0) * rng.choice([-1.0, 1.0]))
    return Air("layered", lambda _: lambda __, up: value * np.exp(-up / scale))


def _plume(rng: Random, *, drift: float = 0.0) -> Air:
    value = float(np.exp(rng.uniform(np.log(1e-4), np.log(5e-3))))
    more, wide = rng.uniform(0.3, 3.0), rng.uniform(50.0, 300.0)
    where = rng.uniform([-300.0, 300.0], [300.0, 900.0])

    def at(profile: int) -> Callable[[Array, Array], Array]:
        middle = where[0] + drift * (profile / BLOCK - 0.5)

        def field(east: Array, up: Array) -> Array:
            apart = ((east - middle) ** 2 + (up - where[1]) ** 2) / (2.0 * wide**2)
            return np.asarray(value * (1.0 + more * np.exp(-apart)))

        return field

    return Air("plume", at, moving=drift != 0.0)


def _thin(rng: Random) -> Air:
    """Return a layer through which a beam is in a few bins, so that its signal bends in a fit."""
    value = float(np.exp(rng.uniform(np.log(1e-4), np.log(5e-3))))
    more, deep = rng.uniform(0.3, 3.0), rng.uniform(10.0, 60.0)
    middle = rng.uniform(300.0, 900.0)

    def field(_: Array, up: Array) -> Array:
        return np.asarray(value * (1.0 + more * np.exp(-((up - middle) ** 2) / (2.0 * deep**2))))

    return Air("thin layer", lambda _: field)


def _drifting(rng: Random) -> Air:
    return _plume(rng, drift=300.0)


def _as_seen(told: Told, _: Signals, __: Random) -> Told:
    return told


def _quiet(told: Told, seen: Signals, rng: Random) -> Told:
    """Draw anew with the noise of long averages, in which a bend of a signal is not lost."""
    noise = float(np.exp(rng.uniform(np.log(1e-3), np.log(3e-2))))
    return Told(*seen.draw(noise, len(told.power), int(rng.integers(2**31)), additive=0.0))


def _with_overlap(told: Told, seen: Signals, rng: Random) -> Told:
    lost = rng.uniform(0.0, 0.2, (seen.network.beams, 1))
    scale = rng.uniform(50.0, 300.0)
    return Told(
        told.power * (1.0 - lost * np.exp(-(seen.range - _FULL_OVERLAP) / scale)), told.variance
    )


def _with_outliers(told: Told, _: Signals, rng: Random) -> Told:
    hit = rng.random(told.power.shape) < 0.01
    size = rng.uniform(5.0, 100.0, told.power.shape) * np.sqrt(told.variance)
    return Told(told.power + hit * size, told.variance)


def _with_gaps(told: Told, _: Signals, rng: Random) -> Told:
    lost = rng.random(told.power.shape) < rng.uniform(0.0, 0.2)
    return Told(np.where(lost, np.nan, told.power), told.variance)


def _with_exponent(told: Told, _: Signals, rng: Random) -> Told:
    return Told(told.power, told.variance, float(rng.uniform(0.8, 1.25)))


def _with_offset(told: Told, _: Signals, rng: Random) -> Told:
    """Leave a background of a part of the noise of the far bins."""
    left = rng.normal(0.0, rng.uniform(0.0, 0.5), (*told.power.shape[:2], 1))
    return Told(told.power + left * np.sqrt(told.variance[..., -1:]), told.variance)


_FIELD_OF: Final = "the exponent cannot be told from the field: the user declares it"
_NOT_CANCELLED: Final = "the overlap of a lidar does not cancel, and beams that agree may share it"
FAILURES: Final[tuple[tuple[Failure, Any, Any], ...]] = (
    (Failure("none, homogeneous", satisfied=True), _homogeneous, _as_seen),
    (Failure("none, layered", satisfied=True), _layered, _as_seen),
    (Failure("none, plume", satisfied=True), _plume, _as_seen),
    (Failure("plume that drifts within a block"), _drifting, _as_seen),
    (Failure("gaps"), _layered, _with_gaps),
    (Failure("outliers"), _layered, _with_outliers),
    (Failure("overlap error", unseen=_NOT_CANCELLED), _layered, _with_overlap),
    (Failure("wrong exponent", unseen=_FIELD_OF), _layered, _with_exponent),
    (Failure("background left in the signals"), _layered, _with_offset),
    (Failure("layer of a few bins"), _thin, _quiet),
)


def judge_networks(cluster: int, profiles: int) -> Iterator[tuple[Judged, int]]:
    """Solve blocks of profiles of random networks, class by class."""
    for number, (failure, air_of, damage) in enumerate(FAILURES):
        # What bends do is as large in every layer, and half as many tell it.
        if air_of is _thin and cluster % 2 == 1:
            continue
        rng = np.random.default_rng((73, cluster, number))
        found = _tried(rng, air_of, damage, profiles)
        if found is None:
            continue
        result, truth = found
        bits = np.where(result.flags.flagged, _DOUBTED, np.int32(0))
        error = np.where(result.near_crossing, result.extinction - truth, np.nan)
        stated = result.extinction_standard_error
        # A value is to be had where its standard error is small.
        with np.errstate(invalid="ignore"):
            could = np.isfinite(error) & (stated < 0.1 * truth)
        yield (
            Judged(failure, "extinction", error, stated, 0.0, bits, solvable=could),
            profiles,
        )


def _tried(
    rng: Random, air_of: Any, damage: Any, profiles: int
) -> tuple[extinction_field.MultiPositionResult, Array] | None:
    """Return what is found and the truth; None where the beams do not meet."""
    noise = float(np.exp(rng.uniform(np.log(1e-3), np.log(0.3))))
    net = random_network(rng).network()
    if net.crossings < 2 or not np.all(np.diff(np.bincount(net.passages.beam)) == 0):
        return None
    seen = signals(net, air_of(rng))
    power, variance = seen.draw(noise, profiles, int(rng.integers(2**31)))
    told = damage(Told(power, variance), seen, rng)
    try:
        found = extinction_field.retrieve_network(
            told.power, seen.range, net, variance=told.variance, exponent=told.exponent,
            full_overlap_range=_FULL_OVERLAP, blocks=np.arange(profiles) // BLOCK,
        )  # fmt: skip
    except LidarOpsError:
        # Beams without two crossings in reach are refused, not answered.
        return None
    return found, seen.truth(profiles)
