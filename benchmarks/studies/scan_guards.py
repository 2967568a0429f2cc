"""Ablation of the guards of scans over zenith angle: ``python -m benchmarks.studies.scan_guards``.

It writes the table into the page of scans. With ``--only``, it prints these rows; with
``--thresholds``, those of every threshold halved and doubled.
"""

from __future__ import annotations

import argparse
import importlib
import pkgutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numba
import numpy as np
from numba.core.dispatcher import Dispatcher

import lidarops.retrieve.multiangle as retrieval
from benchmarks.stability import random_scans
from benchmarks.studies.ablation import (
    Context,
    Guard,
    Patch,
    measure,
    replaced,
    table,
    without,
    write_table,
)
from lidarops.flags import Quality
from lidarops.retrieve.multiangle import (
    _block,
    _calibration,
    _horizontal_variation,
    _smoothing,
    altitude_correlation,
    robust_weights,
    smooth_profile,
)
from lidarops.retrieve.multiangle.flags import MultiAngleQuality
from lidarops.retrieve.multiangle.thresholds import THRESHOLDS

CLUSTERS: Final = 50
PROFILES: Final = 8
PAGE: Final = Path(__file__).resolve().parents[2] / "docs/algorithms/multiangle.md"


def _at(*places: Any, **changes: Any) -> Context:
    """Replace thresholds that modules read."""
    changed = THRESHOLDS._replace(**changes)
    return without(*((place, "THRESHOLDS", changed) for place in places))


def _ones(beams: Any, _: Any) -> Any:
    return np.ones((beams.noise.shape[0], beams.noise.shape[2]))


def _nothing(*_: Any) -> None:
    return None


def _never(*_: Any) -> bool:
    return False


SCREEN: Final = (robust_weights, "screen_outliers", lambda _, information: information.copy())
BISQUARE: Final = (robust_weights, "downweight_outliers", _nothing)
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
            MultiAngleQuality.INTERPOLATED,
        )
    ),
    Guard("path variation", off=without((_horizontal_variation, "path_variation_from", _nothing))),
    Guard("gradients that residuals show", off=_at(_horizontal_variation, gradient_noise=0.0)),
    Guard("outlying beams", off=without((_block, "_has_outliers", _never))),
    Guard(
        "outlying beams: moments",
        off=without((robust_weights, "clean_moments", lambda _: (1.0, 1.0))),
    ),
    Guard(
        "outlying beams: residual scale",
        off=without((_block, "residual_scale", _ones)),
    ),
    Guard("outlying beams: best pair", off=without((robust_weights, "pair_residuals", _nothing))),
    Guard("kept information", off=without((_block, "kept_information", _ones))),
    Guard(
        "few residuals: inflation",
        off=without((smooth_profile, "_inflation", lambda *a: np.ones(a[2]))),
    ),
    Guard(
        "gaps",
        off=without((_block, "profiles_with_gaps", lambda used, *_: np.zeros(len(used), bool))),
    ),
    Guard("outlying estimates: screen", off=without(SCREEN)),
    Guard("outlying estimates: bisquare", off=without(BISQUARE)),
    Guard("outlying estimates: both", off=without(SCREEN, BISQUARE)),
    Guard("Cp beside the likelihood", off=_at(_smoothing, rougher=np.inf)),
    Guard("calibration", off=without((smooth_profile, "_calibrate", _nothing))),
    Guard(
        "calibration: scale of profiles",
        off=without((_calibration, "relative_squares", lambda depth, *_: np.ones(len(depth)))),
    ),
    Guard("calibration: least scale", off=_at(_calibration, least_scale=0.0)),
    Guard(
        "calibration: common altitudes", off=without((_calibration, "_common", lambda c: c >= 1))
    ),
    Guard(
        "correlation",
        off=without((altitude_correlation, "fit_correlation", lambda *_: (0.0, 1.0))),
    ),
    Guard(
        "correlation: amplitude",
        off=_at(altitude_correlation, least_amplitude=1.0, largest_amplitude=1.0),
    ),
)


def _modules() -> list[ModuleType]:
    names = pkgutil.walk_packages(retrieval.__path__, f"{retrieval.__name__}.")
    return [importlib.import_module(info.name) for info in names]


@contextmanager
def _changed(name: str, value: Any) -> Iterator[None]:
    """Change a threshold; modules that compile it in are compiled anew, without their caches."""
    changed = THRESHOLDS._replace(**{name: value})
    patches: list[Patch] = []
    for module in _modules():
        if hasattr(module, "THRESHOLDS"):
            patches.append((module, "THRESHOLDS", changed))
            for function in [f for f in vars(module).values() if isinstance(f, Dispatcher)]:
                again = numba.njit(nogil=True, error_model="numpy")(function.py_func)
                patches.append((module, function.py_func.__name__, again))
    with replaced(*patches):
        yield


def _thresholds() -> Iterator[Guard]:
    """Yield every threshold halved and doubled."""
    for name, value in THRESHOLDS._asdict().items():
        for factor in (0.5, 2.0):
            other = type(value)(factor * value)
            yield Guard(f"{name} = {other:g}", off=partial(_changed, name, other))


def main() -> None:
    """Write the table of the guards, or print a part of it or the table of the thresholds."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("clusters", nargs="?", type=int, default=CLUSTERS)
    arguments.add_argument("--thresholds", action="store_true", help="halve and double each")
    arguments.add_argument("--only", nargs="*", help="words in the names of the rows")
    given = arguments.parse_args()
    guards = [*_thresholds()] if given.thresholds else [*GUARDS]
    if given.only:
        guards = [guard for guard in guards if any(word in guard.name for word in given.only)]
    clusters = range(given.clusters)
    counts = measure(lambda k: random_scans.score_scans(k, PROFILES), clusters, guards)
    if given.thresholds or given.only:
        sys.stdout.write("\n".join(table(counts)) + "\n")
    else:
        write_table(PAGE, "guards", table(counts))


if __name__ == "__main__":
    main()
