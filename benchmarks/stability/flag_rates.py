"""How often flags reject what is right, and which of them decide."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from benchmarks.harness.figure import Scores, Target, log_uniform
from benchmarks.harness.rates import Part, shares
from benchmarks.scenes.homogeneous_paths import random_paths
from lidarops.flags import Quality, rejecting
from lidarops.retrieve.homogeneous import path_fit
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality

_REJECTED: Final = np.int32(rejecting((*Quality, *HomogeneousQuality)))
_DECIDED: Final = (Quality.LOW_SIGNAL, Quality.NEGATIVE_AMPLITUDE)
_NEEDLESS: Final = Target(1e-3, own=True)
"""Largest share of profiles of few photon counts that are flagged although the model holds."""
_FEW: Final = (1.0, 0.3, 0.1, 0.02)
"""Photon counts of a bin."""
_COUNTED: Final = 100
"""Profiles of a cluster of few photon counts."""
_DECIDING: Final = 200
"""Profiles of a cluster in which single bits decide."""


def few_counts(cluster: int, *, counts: float) -> Iterator[Part]:
    """Yield how many profiles of few photon counts are flagged although the model holds."""
    rng = np.random.default_rng((82, cluster))
    distance = 2500.0 + 37.5 * np.arange(225)
    signal = log_uniform(rng, 3.0, 100.0)
    fall = (distance[0] / distance) ** 2 * np.exp(-2e-4 * (distance - distance[0]))
    mean = counts * (1.0 + signal * fall)
    drawn = rng.poisson(mean, (_COUNTED, mean.size)).astype(float)
    for limits, exposure in (("normal limits", None), ("Poisson limits, as in products", 1.0)):
        fit = path_fit.fit_homogeneous_path(
            drawn, distance, variance=mean, noise=path_fit.Noise(exposure=exposure)
        )
        for bit in (Quality.OUTLIER, HomogeneousQuality.POOR_FIT):
            flagged = float(np.count_nonzero(fit.quality & np.int32(bit)))
            yield f"{bit.name}, {limits}", f"{counts:g} counts a bin", flagged, _COUNTED


def deciding_bits(cluster: int) -> Iterator[Part]:
    """Yield how often a bit alone rejects a value of each method."""
    paths, rng = random_paths(cluster, _DECIDING)
    with np.errstate(under="ignore"):
        power = paths.background + paths.clean
    power = power + rng.standard_normal((_DECIDING, paths.range.size))
    known = np.minimum(paths.extinction[:, 0], 100.0 / (paths.range[-1] - paths.range[0]))
    methods: dict[str, dict[str, Any]] = {
        "direct": {},
        "known_extinction": {"method": "known_extinction", "extinction": known},
        "known_background": {"method": "known_background", "background": paths.background[:, 0]},
    }
    for method, options in methods.items():
        with np.errstate(under="ignore"):
            fit = path_fit.fit_homogeneous_path(power, paths.range, variance=1.0, **options)
        value = fit.background if method == "known_extinction" else fit.extinction
        valued = np.isfinite(value)
        for bit in _DECIDED:
            alone = valued & ((fit.quality & _REJECTED) == np.int32(bit))
            events = float(np.count_nonzero(alone))
            yield f"{bit.name} alone", method, events, int(np.count_nonzero(valued))


def flag_rates(clusters: int) -> Scores:
    """Return the shares of flagged profiles, by flag and condition."""
    parts = [p for c in _FEW for cluster in range(clusters) for p in few_counts(cluster, counts=c)]
    parts += [part for cluster in range(clusters) for part in deciding_bits(cluster)]
    return shares(parts, lambda case, _: _NEEDLESS if "Poisson" in case else None)
