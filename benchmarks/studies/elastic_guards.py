"""Ablation of guards of the elastic inversion: ``python -m benchmarks.studies.elastic_guards``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, Final

import numpy as np

from benchmarks.scenes import elastic_skies
from benchmarks.studies.ablation import (
    Guard,
    replaced,
    requested_number,
    with_thresholds,
    without,
    write_guards,
)
from lidarops.retrieve.air import reference_window
from lidarops.retrieve.air.reference_window import Rejection
from lidarops.retrieve.clouds import layers, outlying_bins
from lidarops.retrieve.elastic import inversion
from lidarops.retrieve.elastic.flags import ElasticQuality

CLUSTERS: Final = 60
PROFILES: Final = 10


def _same(power: Any, range_: Any, variance: Any, **_: Any) -> Any:
    noise = np.broadcast_to(variance, np.shape(power))
    return outlying_bins.BridgedProfiles(power, noise, np.zeros(np.shape(power), np.bool_))


_FIND: Final = layers.find_layers


def _no_layers(*arguments: Any, **options: Any) -> Any:
    return np.zeros_like(_FIND(*arguments, **options))


def _no_error(window: reference_window.ReferenceWindow) -> Any:
    return np.zeros_like(window.scale)


@contextmanager
def without_rejection(bit: Rejection) -> Iterator[None]:
    """Skip one test of the reference windows."""
    tests, pick = reference_window._rejections, reference_window._pick

    def fewer_tests(*arguments: Any) -> Any:
        return tests(*arguments) & ~np.int32(bit)

    def any_passing(statistics: Any, rejections: Any, level_error: Any, noise: Any) -> Any:
        kept = rejections.copy()
        index, *_ = pick(statistics, kept, level_error, noise)
        none = np.zeros(index.size)
        precision = np.where(rejections == 0, statistics[..., reference_window.SCALE_ERROR], np.inf)
        return np.where(index >= 0, np.argmin(precision, axis=-1), -1), none, none

    changes = [(reference_window, "_rejections", fewer_tests)]
    if bit is Rejection.MORE_PARTICLES:
        changes.append((reference_window, "_pick", any_passing))
    with replaced(*changes):
        yield


GUARDS: Final = (
    Guard("CLOUD", int(ElasticQuality.CLOUD)),
    Guard("NEGATIVE_BACKSCATTER", int(ElasticQuality.NEGATIVE_BACKSCATTER)),
    Guard("cloud detection", off=without((layers, "find_layers", _no_layers))),
    *(
        Guard(f"window: {bit.name}", off=partial(without_rejection, bit))
        for bit in Rejection
        if bit is not Rejection.EXCLUDED
    ),
    Guard(
        "error by undetected particles",
        off=without(
            (reference_window.ReferenceWindow, "undetected_particles", property(_no_error))
        ),
    ),
    Guard("least certainty", off=with_thresholds(inversion, least_certainty=0.0)),
    Guard("skewed errors", off=with_thresholds(inversion, skewed=0.0)),
    Guard("longest gap", off=with_thresholds(inversion, longest_gap=np.inf)),
    Guard("bridging of outliers", off=without((outlying_bins, "bridge_outliers", _same))),
)

if __name__ == "__main__":
    score = partial(elastic_skies.score_elastic, profiles=PROFILES)
    write_guards("elastic.md", score, requested_number(__doc__, CLUSTERS), GUARDS)
