"""Ablation of the guards of scans: ``python -m benchmarks.studies.scan_guards``."""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np

from benchmarks.harness.figure import Array
from benchmarks.scenes import scans
from benchmarks.studies.ablation import (
    Guard,
    requested_number,
    with_thresholds,
    without,
    write_guards,
)
from lidarops.retrieve.multiangle import (
    _calibration,
    _smoothing,
    optical_depth,
    smooth_profile,
)
from lidarops.retrieve.multiangle._smoothing import Scores, choose_smoothing
from lidarops.retrieve.multiangle.flags import MultiAngleQuality

CLUSTERS: Final = 50
PROFILES: Final = 8


def _by_likelihood(scores: Scores, *, one: bool) -> tuple[Array, Array]:
    return choose_smoothing(scores._replace(risk=np.zeros_like(scores.risk)), one=one)


def _uncalibrated(
    sandwich: _calibration.Sandwich, inflation: Array, _: Any, scale: Array
) -> _calibration.Calibration:
    return _calibration.Calibration(sandwich, inflation, None, scale)


GUARDS: Final = (
    Guard("NO_RESIDUAL", int(MultiAngleQuality.NO_RESIDUAL)),
    Guard("INTERPOLATED", int(MultiAngleQuality.INTERPOLATED)),
    Guard(
        "gradients that residuals show",
        off=without((optical_depth, "visible_gradient", lambda *_: 0.0)),
    ),
    Guard("path variation", off=without((optical_depth, "path_variation_from", lambda *_: None))),
    Guard(
        "few residuals: inflation",
        off=without((smooth_profile, "inflation", lambda noise: np.ones(noise.freedom.size))),
    ),
    Guard(
        "Cp beside the likelihood",
        off=without((_smoothing, "choose_smoothing", _by_likelihood)),
    ),
    Guard("calibration", off=without((smooth_profile, "Calibration", _uncalibrated))),
    Guard(
        "calibration: scale of profiles",
        off=without((smooth_profile, "relative_squares", lambda depth, *_: np.ones(len(depth)))),
    ),
    Guard("calibration: least scale", off=with_thresholds(_calibration, least_scale=0.0)),
    Guard("correlation", off=without((optical_depth, "correlation_of_air", lambda *_: 0.0))),
)

if __name__ == "__main__":
    score = partial(scans.score_scans, profiles=PROFILES)
    write_guards("multiangle.md", score, requested_number(__doc__, CLUSTERS), GUARDS)
