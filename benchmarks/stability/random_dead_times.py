"""Records of one detector by photon counting and analog, of light that varies between profiles."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Final

import numpy as np

from benchmarks.harness.figure import Array
from benchmarks.stability.random_scenes import Failure, ScoredValues
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.signal.dead_time import ProfileGroup, estimate_dead_time
from lidarops.retrieve.signal.thresholds import THRESHOLDS

Random = np.random.Generator

DISTANCE: Final = 7.5 * (np.arange(4000) + 0.5)
LIGHT: Final = 400.0 * (300.0 / DISTANCE) ** 2 * np.exp(-2e-4 * DISTANCE)
"""MHz."""
LAG: Final = 10
SLOPE: Final = 60.0
"""MHz mV-1."""


def draw_group(
    rng: Random,
    dead_time: float,
    lights: Sequence[Array],
    shots: Sequence[int],
    sky: float = 0.5,
    *,
    paralysable: bool = False,
    baseline: float = 0.0,
    bend: float = 0.0,
) -> ProfileGroup:
    """Return a group of profiles, whose largest analog signal is too large by a share `bend`."""
    true = np.where(DISTANCE > 150.0, np.stack(lights), 0.0) + sky
    load = dead_time * 1e6 * true
    rate = true * np.exp(-load) if paralysable else true / (1.0 + load)
    exposure = np.array(shots) * 0.05
    mean_counts = rate * exposure[:, np.newaxis]
    # The dead time makes counts more regular than Poisson.
    regular = 1.0 if paralysable else 1.0 / (1.0 + load)
    counts = mean_counts + regular * (rng.poisson(mean_counts) - mean_counts)
    noise = 2e-3 * np.sqrt(600.0 / exposure.sum() * 0.05)
    mean = exposure / exposure.sum() @ true
    clear = np.interp(np.arange(DISTANCE.size) - LAG, np.arange(DISTANCE.size), mean) / SLOPE
    clear *= 1.0 + bend * clear / clear.max()
    clear += baseline * np.exp(-DISTANCE / 3000.0)
    analog = 4.8 + clear + rng.normal(0.0, noise, DISTANCE.size)
    return ProfileGroup(counts, exposure, analog, np.full(analog.shape, noise**2))


def _rising_layers(rng: Random, number: int) -> Array:
    """Return the light of a profile through a layer that rises, of any strength."""
    height, strength = 300.0 + 100.0 * number, rng.uniform(0.0, 3.0)
    return np.asarray(LIGHT * (1.0 + strength * np.exp(-(((DISTANCE - height) / 150.0) ** 2))))


def _slant_path(_rng: Random, number: int) -> Array:
    slant = 1.0 / math.cos(math.radians(2.5 * number))
    return np.asarray(LIGHT * np.exp(2e-4 * DISTANCE * (1.0 - slant)))


SCENES: Final[dict[str, Callable[[Random, int], Array]]] = {
    "like profiles": lambda _rng, _number: LIGHT,
    "a laser that varies": lambda rng, _number: LIGHT * max(rng.normal(1.0, 0.4), 0.05),
    "a laser that fails in half of the profiles": lambda _rng, number: (
        LIGHT * (1.0 if number % 2 else 0.03)
    ),
    "air that varies": _rising_layers,
    "a scan": _slant_path,
}
"""Name -> function that returns the light of a profile, given its number of 32."""

NONLINEAR: Final = 0.01
"""Share by which the largest analog signal may be too large, as the stated error assumes."""
_MOST: Final = 3.0 * NONLINEAR
"""Largest share in random scenes."""
_UNSEEN: Final = "a nonlinear analog record looks like a dead time"


def draw_scene(rng: Random, scene: str, dead_time: float, bend: float = 0.0) -> list[ProfileGroup]:
    """Return four groups of 32 profiles of a scene; the dead time is in s."""
    light = SCENES[scene]
    return [
        draw_group(rng, dead_time, [light(rng, k) for k in range(32)], [600] * 32, bend=bend)
        for _ in range(4)
    ]


def score_dead_times(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Yield estimated dead times of 2 to 12 ns, by scene, with a linear and a nonlinear record."""
    for number, scene in enumerate(SCENES):
        for nonlinear in (False, True):
            rng = np.random.default_rng((91, cluster, number))
            truths = np.exp(rng.uniform(math.log(2e-9), math.log(1.2e-8), profiles))
            bends = rng.uniform(-_MOST, _MOST, profiles) * nonlinear
            found = [
                estimate_dead_time(draw_scene(rng, scene, truth, bend), LAG)
                for truth, bend in zip(truths, bends, strict=True)
            ]
            values, stated, loads = (
                np.array([math.nan if one is None else getattr(one, name) for one in found])
                for name in ("dead_time", "standard_error", "highest_load")
            )
            bent = THRESHOLDS.analog_nonlinearity * (1.0 - loads) / loads * values
            failure = Failure(f"{scene}, analog record nonlinear by up to 3 %", unseen=_UNSEEN)
            yield ScoredValues(
                failure if nonlinear else Failure(scene, satisfied=True),
                "dead time",
                values - truths,
                np.sqrt(stated**2 - bent**2),
                bent,
                np.zeros(profiles, dtype=np.int32),
                HomogeneousQuality,
            )
