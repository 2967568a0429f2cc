"""Ablation of the guards of the homogeneous path: ``python -m benchmarks.studies.path_guards``."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np

from benchmarks.scenes import homogeneous_paths
from benchmarks.studies.ablation import Guard, replaced, requested_number, without, write_guards
from lidarops.flags import Quality
from lidarops.retrieve.homogeneous import _fit_quality, path_fit
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS

CLUSTERS: Final = 150
PROFILES: Final = 60
_LIMITS: Final = _fit_quality._limits
_FIT: Final = path_fit.fit_homogeneous_path


def _no_widening(*arguments: Any, **options: Any) -> Any:
    limits = _LIMITS(*arguments, **options)
    return limits._replace(widening=np.ones_like(limits.widening))


def _no_bend(power: Any, range_: Any, **options: Any) -> Any:
    """Return a fit without the part of the model errors by a signal that bends."""
    fit = _FIT(power, range_, **options)
    slope = THRESHOLDS.model_error * (np.abs(fit.extinction) + 1.0 / np.mean(range_))
    none = np.zeros_like(fit.background)
    return replace(fit, extinction_model_error=slope, background_model_error=none)


GUARDS: Final = (
    Guard("NEGATIVE_AMPLITUDE", int(Quality.NEGATIVE_AMPLITUDE)),
    Guard("LOW_SIGNAL", int(Quality.LOW_SIGNAL)),
    Guard("POORLY_DETERMINED", int(HomogeneousQuality.POORLY_DETERMINED)),
    Guard("both of these", int(Quality.LOW_SIGNAL | HomogeneousQuality.POORLY_DETERMINED)),
    Guard("AT_BOUND", int(HomogeneousQuality.AT_BOUND)),
    Guard("POOR_FIT", int(HomogeneousQuality.POOR_FIT)),
    Guard("NOT_HOMOGENEOUS", int(Quality.NOT_HOMOGENEOUS)),
    Guard("OUTLIER", int(Quality.OUTLIER)),
    Guard("widening of estimated noise", off=without((_fit_quality, "_limits", _no_widening))),
    Guard("bend in the model error", off=without((path_fit, "fit_homogeneous_path", _no_bend))),
)
SHORT: Final = (Guard("TOO_FEW_BINS", int(Quality.TOO_FEW_BINS)),)
"""Guard of sections of fewer than 8 bins, all of which it withholds."""
TABLES: Final = {"guards": ((8, 800), GUARDS), "guards of 4 to 7 bins": ((4, 7), SHORT)}
"""Mark of the table in the page -> numbers of bins and guards."""

if __name__ == "__main__":
    clusters = requested_number(__doc__, CLUSTERS)
    for mark, (bins, guards) in TABLES.items():
        with replaced((homogeneous_paths, "RANDOM_BINS", bins)):
            score = partial(homogeneous_paths.score_homogeneous, profiles=PROFILES)
            write_guards("homogeneous.md", score, clusters, guards, mark)
