"""Accuracy of the optical depths and extinctions of scans, method by method."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from benchmarks.accuracy import multiangle_cases as cases
from benchmarks.accuracy.comparison import (
    BIAS,
    COVERAGE,
    RMSE,
    WITHIN_1,
    comparison,
    score_errors,
    time_profiles,
)
from benchmarks.accuracy.multiangle_cases import Scan, ScanEstimates, ScanSolver, Scene
from benchmarks.accuracy.multiangle_peers import SLOW, scan_peers
from benchmarks.harness.figure import Array, Figure, cpu_time, root_by_block, share
from benchmarks.harness.results import Effort, Study, Work

DEPTH: Final = "RMSE where kano_hamilton has a value"
SLOPE: Final = "RMSE of extinction (km⁻¹)"
_NOTE: Final = (
    "Clear air: 12 beams from 0 to 75°, 201 altitudes from 150 m to 6.15 km, scatter of "
    "backscatter along the horizontal 3 %, signal over noise as stated at the zenith in 1 km. "
    "Cloud: 6 beams from 0 to 30°, 40 altitudes, optical depth 4.4, scatter 14.7 %. All profiles "
    "of a block are solved at once. Our methods estimate the scatter. The peers know it, solve "
    "each altitude on its own but for the spline, and use each sample that exceeds 3 times its "
    "noise: this selects bright samples and biases straight lines in clear air; our methods and "
    "the spline select with the mean of a window. RMSE: at the altitudes that all methods but the "
    "slow ones solve; the other figures: where kano_hamilton has a value."
)


@dataclass(frozen=True, slots=True)
class StudySize:
    """Numbers of simulated blocks and profiles."""

    blocks: int
    """Blocks of each scene, at least 2, independent except for the truth."""
    profiles: int
    """Profiles of a block."""
    slow: int
    """Profiles of a block for the peers."""


QUICK: Final = StudySize(blocks=6, profiles=200, slow=1)
FULL: Final = StudySize(blocks=16, profiles=200, slow=2)


def measure_multiangle(effort: Effort, *, size: StudySize | None = None) -> Study:
    """Score optical depth and extinction of simulated scans for every method and the peers.

    Parameters
    ----------
    effort : Effort
    size : StudySize, optional
        Numbers of blocks and profiles.
    """
    works: list[Work] = []
    for number, scene in enumerate(cases.scan_scenes()):
        works += compare(scene, size or (QUICK if effort.quick else FULL), number)
        effort.progress(1)
    return comparison("scans over zenith angle", works, _NOTE)


def compare(scene: Scene, size: StudySize, number: int) -> Iterator[Work]:
    """Yield the errors of the methods that have a value where kano_hamilton has one."""
    scans = [scene.draw(size.profiles, number, block) for block in range(size.blocks)]
    few = [scan.first(size.slow) for scan in scans]
    solved = {
        name: _solve(solver, few if name in SLOW else scans)
        for name, solver in {**cases.scan_methods(), **scan_peers()}.items()
    }
    valued = {name: np.isfinite(each.optical_depth) for name, (each, _) in solved.items()}
    common = np.all([each for name, each in valued.items() if name not in SLOW and each.any()], 0)
    steps = np.diff(scene.altitude, prepend=0.0)
    for name, (estimates, spent) in solved.items():
        block = len(estimates.optical_depth) // size.blocks
        # Of the slow methods, the first profiles of each block.
        some = (np.arange(len(common)) % size.profiles) < block
        at, everywhere = valued[cases.KANO_HAMILTON][some], common[some] & valued[name]
        error = estimates.optical_depth - scene.optical_depth
        slope = np.diff(estimates.optical_depth, axis=1, prepend=0.0) / steps - scene.extinction
        stated = estimates.standard_error
        errors = score_errors(_filled(error), _filled(stated), at & valued[name], block)
        rmse = root_by_block(_filled(error), everywhere, block)
        of_slope = root_by_block(1e3 * _filled(slope), at & np.isfinite(slope), block)
        if rmse is None or of_slope is None:
            continue
        more = {"solved": share(float(valued[name][at].mean())), DEPTH: errors[RMSE],
                BIAS: errors[BIAS], WITHIN_1: None if stated is None else errors[WITHIN_1],
                SLOPE: of_slope}  # fmt: skip
        yield Work(
            scene.label, "optical depth", name, rmse,
            None if stated is None else errors[COVERAGE], spent,
            ours=name not in scan_peers(), more=more,
        )  # fmt: skip


def _filled(values: Array | None) -> Array:
    """Return values with 0 where there is none."""
    return np.zeros(1) if values is None else np.nan_to_num(values)


def _solve(solver: ScanSolver, scans: list[Scan]) -> tuple[ScanEstimates, Figure]:
    """Return the estimates of all blocks, and the median CPU time of a profile."""
    solver(scans[0].first(1))
    timed = [time_profiles(partial(solver, scan), len(scan.signal)) for scan in scans]
    depth = np.concatenate([estimates.optical_depth for _, estimates in timed])
    stated = [e.standard_error for _, e in timed if e.standard_error is not None]
    middle = float(np.median([spent.value for spent, _ in timed]))
    return ScanEstimates(depth, np.concatenate(stated) if stated else None), cpu_time(middle)
