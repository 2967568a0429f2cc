"""How often profiles without light of the laser are missed, and others are flagged as such."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
import numpy.typing as npt

from benchmarks.harness.figure import Array, Mask, Random, Scores, Target
from benchmarks.stability.random_scenes import Part, shares
from lidarops.retrieve.signal.light import excess_over_far, light_of, lightless

RANGE: Final = 7.5 * (np.arange(2000) + 0.5)
SHAPE: Final = np.minimum(RANGE / 300.0, 1.0) ** 2 * (300.0 / RANGE) ** 2
"""Of light along range without attenuation, 1 at 300 m."""
_MOST: Final = Target(1e-2)
"""Largest share of profiles without light that are missed, and of others that are flagged."""
_OFFSET: Final = 6000.0
"""Counts of a digitizer without light."""
_VARIES: Final = "light that varies tenfold"
_CLOUDS: Final = "clouds"
_WEAK: Final = "weak light"
_WEAK_VARIES: Final = "weak light that varies tenfold"
_LASERS: Final = "two lasers"
_OFF: Final = "a recorder that is off in a tenth"
_DARK: Final = "no light at all"
_RARE: Final = "light in less than a tenth"
_CLASSES: Final = (
    "steady light", _VARIES, _CLOUDS, _WEAK, _WEAK_VARIES, _LASERS, _OFF, _DARK, _RARE,
)  # fmt: skip
_MISSED: Final = "without light, missed"
_UNTOLD: Final = frozenset({_WEAK, _WEAK_VARIES, _RARE})
"""Classes of which the documentation states that profiles without light are missed."""


def draw_counts(rng: Random, light: Array, *, analog: bool, level: float) -> npt.NDArray[np.int64]:
    """Return counts of light: photons above a sky of `level`, or of a digitizer of that noise."""
    if analog:
        return np.rint(_OFFSET + light + level * rng.standard_normal(light.shape)).astype(np.int64)
    return rng.poisson(level + light)


def _light(rng: Random, profiles: int, condition: str) -> Array:
    """Return the light of profiles along range, about 1 at 300 m."""
    light: Array = np.tile(SHAPE * np.exp(-RANGE / rng.uniform(2e3, 2e4)), (profiles, 1))
    if condition in {_VARIES, _WEAK_VARIES}:
        light *= 10.0 ** rng.uniform(0.0, 1.0, (profiles, 1))
    if condition == _CLOUDS:
        base = rng.uniform(300.0, 6e3, (profiles, 1))
        beyond = base < RANGE
        light *= np.where(beyond, 30.0 * np.exp(-(RANGE - base) / 50.0), 1.0)
    return light


def _lit_share(rng: Random, condition: str) -> float:
    """Return the share of profiles with light."""
    if condition == _DARK:
        return 0.0
    return float(rng.uniform(0.01, 0.09) if condition == _RARE else rng.uniform(0.15, 0.95))


def _channels(rng: Random, dark: Mask, condition: str) -> Iterator[npt.NDArray[np.int64]]:
    """Yield the counts of the channels of a laser: bright ones, and one of a thousandth of it."""
    weak = condition in {_WEAK, _WEAK_VARIES}
    weakest = 10.0 ** (rng.uniform(2.5, 3.5) if weak else rng.uniform(4.0, 5.0))
    light = weakest * _light(rng, dark.size, condition)
    light[dark] = 0.0
    for bright in range(2 if condition == _OFF else 1):
        analog = bool(rng.integers(2))
        level = 10.0 ** (rng.uniform(1.0, 2.0) if analog else rng.uniform(-2.0, 2.0))
        counts = draw_counts(rng, light, analog=analog, level=level)
        if condition == _OFF and not bright:
            counts[rng.random(dark.size) < 0.1] = 0
        yield counts
    yield draw_counts(rng, 1e-3 * light, analog=False, level=0.1)


def scores_of_scene(cluster: int, condition: str) -> Iterator[Part]:
    """Yield what was told wrongly, how often, and among how many profiles, of a random scene.

    Any channel of a laser may be wrong. A tenth of the profiles are gaps.
    """
    rng = np.random.default_rng((84, cluster, _CLASSES.index(condition)))
    profiles = int(rng.integers(60, 120))
    gap = rng.random(profiles) < 0.1
    found, lasers, unlit = {}, {}, {}
    for laser in ("1", "2") if condition == _LASERS else ("1",):
        lit = np.ceil(profiles * _lit_share(rng, condition))
        unlit[laser] = rng.permutation(profiles) >= lit
        for number, counts in enumerate(_channels(rng, unlit[laser], condition)):
            name = f"{laser}{number}"
            counts[gap] = 0
            found[name], lasers[name] = light_of(*excess_over_far(counts), ~gap), laser
    told = lightless(found, lasers)
    for laser, dark in unlit.items():
        of_laser = np.array([told[name] for name in found if lasers[name] == laser])
        cases = {_MISSED: dark & ~gap, "with light, flagged": ~dark & ~gap, "gaps, flagged": gap}
        for case, those in cases.items():
            wrong = ~of_laser.all(axis=0) if case == _MISSED else of_laser.any(axis=0)
            yield case, condition, float((wrong & those).sum()), int(those.sum())


def light_scores(clusters: int) -> Scores:
    """Return the shares of profiles whose light is told wrongly, by condition."""
    parts = [
        part
        for condition in _CLASSES
        for cluster in range(clusters)
        for part in scores_of_scene(cluster, condition)
    ]
    return shares(parts, lambda case, name: None if case == _MISSED and name in _UNTOLD else _MOST)
