"""Records of one detector by photon counting and analog, of light that varies between profiles."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from benchmarks.harness.figure import Array, Random, Scores, Target
from benchmarks.stability.random_scenes import shares
from lidarops.retrieve.signal.dead_time import ProfileGroup, estimate_dead_time

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
_RECORDS: Final = {"linear analog record": 0.0, "analog record nonlinear by 1 %": NONLINEAR}
_ERRORS: Final = 2.0
"""Stated errors beyond which a dead time is false."""
_MOST: Final = Target(2.5e-2)
"""Largest share of false ones; normal errors would leave 4.6 % of them."""


def draw_scene(rng: Random, scene: str, dead_time: float, bend: float = 0.0) -> list[ProfileGroup]:
    """Return four groups of 32 profiles of a scene; the dead time is in s."""
    light = SCENES[scene]
    return [
        draw_group(rng, dead_time, [light(rng, k) for k in range(32)], [600] * 32, bend=bend)
        for _ in range(4)
    ]


def _is_false(seed: int, scene: str, bend: float) -> bool:
    """Return whether the estimate of a random dead time of 2 to 12 ns is missing or false."""
    rng = np.random.default_rng((91, seed, list(SCENES).index(scene)))
    truth = math.exp(rng.uniform(math.log(2e-9), math.log(1.2e-8)))
    bend *= rng.choice([-1.0, 1.0])
    found = estimate_dead_time(draw_scene(rng, scene, truth, bend), LAG)
    return found is None or abs(found.dead_time - truth) > _ERRORS * found.standard_error


def dead_time_scores(number: int) -> Scores:
    """Return the shares of dead times that are more than 2 stated errors off, by record and scene.

    Of `number` dead times each.
    """
    parts = [
        (record, scene, float(_is_false(seed, scene, bend)), 1)
        for record, bend in _RECORDS.items()
        for scene in SCENES
        for seed in range(number)
    ]
    return shares(parts, lambda *_: _MOST)
