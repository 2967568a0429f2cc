"""How often profiles without light of the laser are missed, and others are flagged as such."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
import numpy.typing as npt
import pandas as pd

from benchmarks.harness.figure import Array
from benchmarks.harness.statistics import clustered_share
from benchmarks.harness.verdicts import Scores, Target
from benchmarks.stability.random_scenes import TARGET
from lidarops.retrieve.signal.light import excess_over_far, light_of, lightless

Random = np.random.Generator

SHARE: Final = "share"
_RANGE: Final = 7.5 * (np.arange(2000) + 0.5)
_MOST: Final = Target(1e-2)
"""Largest share of profiles without light that are missed, and of others that are flagged."""
_SHAPE: Final = np.minimum(_RANGE / 300.0, 1.0) ** 2 * (300.0 / _RANGE) ** 2
_OFFSET: Final = 6000.0
"""Counts of a digitizer without light."""
_VARIES: Final = "light that varies tenfold"
_CLOUDS: Final = "clouds"
_WEAK: Final = "weak light"
_CLASSES: Final = ("steady light", _VARIES, _CLOUDS, _WEAK)
_MISSED: Final = "without light, missed"
_FLAGGED: Final = "with light, flagged"


def _light(rng: Random, profiles: int, condition: str) -> Array:
    """Return the light of profiles along range, about 1 at 300 m."""
    shape = _SHAPE * np.exp(-_RANGE / rng.uniform(2e3, 2e4))
    light: Array = np.tile(shape, (profiles, 1))
    if condition == _VARIES:
        light *= 10.0 ** rng.uniform(0.0, 1.0, (profiles, 1))
    if condition == _CLOUDS:
        base = rng.uniform(300.0, 6e3, (profiles, 1))
        beyond = base < _RANGE
        light *= np.where(beyond, 30.0 * np.exp(-(_RANGE - base) / 50.0), 1.0)
    return light


def _counts(rng: Random, light: Array, *, analog: bool, level: float) -> npt.NDArray[np.int64]:
    if analog:
        return np.rint(_OFFSET + light + level * rng.standard_normal(light.shape)).astype(np.int64)
    return rng.poisson(level + light)


def scores_of_scene(cluster: int, condition: str) -> Iterator[tuple[str, float, int]]:
    """Yield what was told wrongly, how often, and among how many profiles, of a random scene.

    It holds a bright channel and one of the same laser with a thousandth of its light, of which
    either may be wrong. From a seventh to most of the profiles hold light; a tenth are gaps.
    """
    rng = np.random.default_rng((84, cluster, _CLASSES.index(condition)))
    analog = bool(rng.integers(2))
    profiles = int(rng.integers(20, 120))
    dark = rng.permutation(profiles) >= np.ceil(profiles * rng.uniform(0.15, 0.95))
    gap = rng.random(profiles) < 0.1
    level = 10.0 ** (rng.uniform(1.0, 2.0) if analog else rng.uniform(-2.0, 2.0))
    weakest = 10.0 ** (rng.uniform(2.5, 3.5) if condition == _WEAK else rng.uniform(4.0, 5.0))
    light = weakest * _light(rng, profiles, condition)
    light[dark] = 0.0
    channels = (
        _counts(rng, light, analog=analog, level=level),
        _counts(rng, 1e-3 * light, analog=False, level=0.1),
    )
    found = {
        str(number): light_of(*excess_over_far(np.where(gap[:, np.newaxis], 0, counts)), ~gap)
        for number, counts in enumerate(channels)
    }
    told = np.array(list(lightless(found, dict.fromkeys(found, "1")).values()))
    cases = {_MISSED: dark & ~gap, _FLAGGED: ~dark & ~gap, "gaps, flagged": gap}
    for case, those in cases.items():
        wrong = ~told.all(axis=0) if case == _MISSED else told.any(axis=0)
        yield case, float(np.count_nonzero(wrong & those)), int(np.count_nonzero(those))


def light_scores(clusters: int) -> Scores:
    """Return the shares of profiles whose light is told wrongly, by condition."""
    rows = pd.DataFrame(
        [
            (case, condition, events, trials)
            for condition in _CLASSES
            for cluster in range(clusters)
            for case, events, trials in scores_of_scene(cluster, condition)
        ],
        columns=["case", "condition", "events", "trials"],
    )
    scores: Scores = {}
    for (case, condition), group in rows.groupby(["case", "condition"], sort=False):
        share = clustered_share(*group[["events", "trials"]].to_numpy(dtype=float).T)
        scores[case, condition] = {
            "profiles": int(group["trials"].sum()),
            SHARE: share,
            # Channels of weak light tell nothing, which the documentation states.
            TARGET: None if (case, condition) == (_MISSED, _WEAK) else _MOST.judged(share),
        }
    return scores
