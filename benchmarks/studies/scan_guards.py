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
from lidarops.retrieve.multiangle import (
    _calibration,
    _horizontal_variation,
    _methods,
    _smoothing,
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


def _nothing(*_: Any) -> None:
    return None


GUARDS: Final = (
    *(
        Guard(bit.name or "", int(bit))
        for bit in (MultiAngleQuality.NO_RESIDUAL, MultiAngleQuality.INTERPOLATED)
    ),
    Guard("path variation", off=without((_horizontal_variation, "path_variation_from", _nothing))),
    Guard("gradients that residuals show", off=_at(_horizontal_variation, gradient_noise=0.0)),
    Guard(
        "few residuals: inflation",
        off=without((smooth_profile, "_inflation", lambda noise: np.ones(noise.freedom.size))),
    ),
    Guard("Cp beside the likelihood", off=_at(_smoothing, rougher=np.inf)),
    Guard("calibration", off=without((smooth_profile, "_calibrate", _nothing))),
    Guard(
        "calibration: scale of profiles",
        off=without((_calibration, "relative_squares", lambda depth, *_: np.ones(len(depth)))),
    ),
    Guard("calibration: least scale", off=_at(_calibration, least_scale=0.0)),
    Guard("correlation", off=without((_methods, "correlation_of_air", lambda *_: 0.0))),
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
