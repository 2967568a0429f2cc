"""Ablation of the guards of scans over zenith angle: ``python tests/studies/scan_guards.py``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Final
from unittest import mock

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from studies.ablation import Guard, measure, table

from lidarops.bench.stability import random_scans
from lidarops.flags import Quality
from lidarops.retrieve.multiangle import (
    _block,
    _methods,
    _path_variation,
    robust_weights,
)
from lidarops.retrieve.multiangle.flags import MultiAngleQuality
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS
from lidarops.retrieve.multiangle.vertical import _block as _vertical
from lidarops.retrieve.multiangle.vertical import (
    _calibration,
    _correlation,
    _outliers,
    _smoothing_choice,
    gaps,
    smooth_profile,
)

CLUSTERS: Final = 50
PROFILES: Final = 8

Patch = tuple[Any, str, Any]


@contextmanager
def replaced(*patches: Patch) -> Iterator[None]:
    """Replace functions or numbers of modules."""
    with ExitStack() as stack:
        for place, name, value in patches:
            stack.enter_context(mock.patch.object(place, name, value))
        yield


def _off(*patches: Patch) -> Callable[[], Any]:
    return lambda: replaced(*patches)


def _at(*places: Any, **changes: float) -> Callable[[], Any]:
    """Replace thresholds that modules read."""
    changed = replace(THRESHOLDS, **changes)
    return _off(*((place, "THRESHOLDS", changed) for place in places))


def _ones(beams: Any, _: Any) -> Any:
    return np.ones((beams.noise.shape[0], beams.noise.shape[2]))


def _nothing(*_: Any) -> None:
    return None


def _never(*_: Any) -> bool:
    return False


SCREEN: Final = (_outliers, "screen_outliers", lambda _, information: information.copy())
BISQUARE: Final = (_outliers, "downweight_outliers", _nothing)
GUARDS: Final = (
    *(
        Guard(bit.name or "", int(bit))
        for bit in (
            Quality.LOW_SIGNAL,
            Quality.OUTLIER,
            MultiAngleQuality.LOW_LEVERAGE,
            MultiAngleQuality.NO_RESIDUAL,
            MultiAngleQuality.PRIOR_DOMINATED,
            MultiAngleQuality.UNDERSMOOTHED,
            MultiAngleQuality.HIGH_CORRELATION,
            MultiAngleQuality.HORIZONTAL_GRADIENT,
            MultiAngleQuality.INTERPOLATED,
        )
    ),
    Guard("path variation", off=_off((_path_variation, "path_variation_from", _nothing))),
    Guard("harmless gradients", off=_at(_methods, harmless_gradient=0.0)),
    Guard("noisy samples in the test of gradients", off=_at(_block, gradient_noise=np.inf)),
    Guard("outlying beams", off=_off((_block, "_has_outliers", _never))),
    Guard(
        "outlying beams: moments", off=_off((robust_weights, "clean_moments", lambda _: (1.0, 1.0)))
    ),
    Guard(
        "outlying beams: residual scale",
        off=_off((_block, "residual_scale", _ones)),
    ),
    Guard("outlying beams: best pair", off=_off((robust_weights, "pair_residuals", _nothing))),
    Guard("kept information", off=_off((_block, "kept_information", _ones))),
    Guard("least guess of the inhomogeneity", off=_at(_block, least_guess=0.0)),
    Guard(
        "few residuals: inflation", off=_off((_vertical, "_inflation", lambda *a: np.ones(a[2])))
    ),
    Guard(
        "gaps", off=_off((gaps, "profiles_with_gaps", lambda used, *_: np.zeros(len(used), bool)))
    ),
    Guard("outlying estimates: screen", off=_off(SCREEN)),
    Guard("outlying estimates: bisquare", off=_off(BISQUARE)),
    Guard("outlying estimates: both", off=_off(SCREEN, BISQUARE)),
    Guard("negligible profiles", off=_at(smooth_profile, negligible_information=0.0)),
    Guard("largest information", off=_at(_vertical, largest_information=1e300)),
    Guard("usual information", off=_at(_vertical, usual_information=np.inf)),
    Guard("Cp beside the likelihood", off=_at(_smoothing_choice, rougher=np.inf)),
    Guard("calibration", off=_off((_vertical, "_calibrate", _nothing))),
    Guard(
        "calibration: scale of profiles",
        off=_off((_calibration, "relative_squares", lambda depth, *_: np.ones(len(depth)))),
    ),
    Guard("calibration: least scale", off=_at(_calibration, least_scale=0.0)),
    Guard("calibration: largest deviation", off=_at(_calibration, largest_deviation=1e9)),
    Guard("calibration: common altitudes", off=_off((_calibration, "_common", lambda c: c >= 1))),
    Guard("correlation", off=_off((_correlation, "fit_correlation", lambda *_: (0.0, 1.0)))),
    Guard(
        "correlation: amplitude",
        off=_at(_correlation, least_amplitude=1.0, largest_amplitude=1.0),
    ),
    Guard("correlation: none below", off=_at(_correlation, none_below=0.0)),
    Guard("correlation: simple below", off=_at(_correlation, simple_below=0.05)),
    Guard(
        "data share",
        off=_at(_methods, smooth_profile, least_share=-np.inf, largest_share=np.inf),
    ),
)


def main() -> None:
    """Print the table."""
    clusters = range(int(sys.argv[1]) if len(sys.argv) > 1 else CLUSTERS)
    counts = measure(lambda k: random_scans.score_scans(k, PROFILES), clusters, GUARDS)
    sys.stdout.write("\n".join(table(counts)) + "\n")


if __name__ == "__main__":
    main()
