"""Accuracy of the optical depths and extinctions of scans, method by method."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Final

import numpy as np
from scipy.ndimage import uniform_filter1d

from benchmarks.accuracy import comparison
from benchmarks.harness.figure import Array, Figure, Work, cpu_time, root_by_block, share
from benchmarks.harness.results import Effort, Study
from benchmarks.scenes import scans as scenes
from benchmarks.scenes.scans import Scan, Scene

KANO_HAMILTON: Final = "kano_hamilton"
DEPTH: Final = f"RMSE where {KANO_HAMILTON} has a value"
SLOPE: Final = "RMSE of extinction (km⁻¹)"
_NOTE: Final = (
    "Clear air: 12 beams from 0 to 75°, 201 altitudes from 150 m to 6.15 km, scatter of "
    "backscatter along the horizontal 3 %, signal over noise as stated at the zenith in 1 km. "
    "Cloud: 6 beams from 0 to 30°, 40 altitudes, optical depth 4.4, scatter 14.7 %. All profiles "
    "of a block are solved at once. Our methods estimate the scatter. The peers know it, and use "
    "each sample that exceeds 3 times its noise: this selects bright samples and biases straight "
    "lines in clear air; our methods and the spline select with the mean of a window. RMSE: at the "
    "altitudes that all methods solve; the other figures: where kano_hamilton has a value."
)
ScanSolver = Callable[[Scan], tuple[Array, Array | None]]
"""Returns (profile, altitude) optical depths, NaN without value, and standard errors if any."""
PROFILES: Final = 200
"""Profiles of a block."""
BLOCKS: Final = 16
QUICK_BLOCKS: Final = 6
"""Blocks of each scene, at least 2, independent except for the truth."""


def scan_methods() -> Mapping[str, ScanSolver]:
    """Return the methods of lidarops that are compared, by name."""
    names = ("two_angle", KANO_HAMILTON, "mld", "mld_prior", "joint")
    return {name: partial(_retrieved, method=name) for name in names}


def _retrieved(scan: Scan, method: str) -> tuple[Array, Array]:
    result = scenes.retrieve(scan, method)
    return result.optical_depth, result.optical_depth_standard_error


def measure_multiangle(
    effort: Effort, *, blocks: int | None = None, profiles: int = PROFILES
) -> Study:
    """Score optical depth and extinction of simulated scans for every method and the peers.

    Parameters
    ----------
    effort : Effort
    blocks, profiles : int, optional
        Numbers of blocks of each scene, and of profiles of a block.
    """
    blocks = blocks or (QUICK_BLOCKS if effort.quick else BLOCKS)
    works: list[Work] = []
    for number, scene in enumerate(scenes.scan_scenes()):
        works += compare(scene, blocks, profiles, number)
        effort.progress(1)
    return comparison.study("scans over zenith angle", works, _NOTE)


def compare(scene: Scene, blocks: int, profiles: int, number: int) -> Iterator[Work]:
    """Yield the errors of the methods that have a value where kano_hamilton has one."""
    scans = [scene.draw(profiles, number, block) for block in range(blocks)]
    solvers = {**scan_methods(), **PEERS}
    solved = {name: _solve(solver, scans) for name, solver in solvers.items()}
    valued = {name: np.isfinite(depth) for name, (depth, _, _) in solved.items()}
    common = np.all([each for each in valued.values() if each.any()], axis=0)
    at = valued[KANO_HAMILTON]
    steps = np.diff(scene.altitude, prepend=0.0)
    for name, (depth, stated, spent) in solved.items():
        error = np.nan_to_num(depth - scene.optical_depth)
        slope = np.diff(depth, axis=1, prepend=0.0) / steps - scene.extinction
        claimed = np.zeros(1) if stated is None else np.nan_to_num(stated)
        errors = comparison.score_errors(error, claimed, at & valued[name], profiles)
        rmse = root_by_block(error, common & valued[name], profiles)
        of_slope = root_by_block(1e3 * np.nan_to_num(slope), at & np.isfinite(slope), profiles)
        if rmse is None or of_slope is None:
            continue
        more = {"solved": share(float(valued[name][at].mean())), DEPTH: errors[comparison.RMSE],
                comparison.BIAS: errors[comparison.BIAS],
                comparison.WITHIN_1: None if stated is None else errors[comparison.WITHIN_1],
                SLOPE: of_slope}  # fmt: skip
        yield Work(
            scene.label, "optical depth", name, rmse,
            None if stated is None else errors[comparison.COVERAGE], spent, ours=name not in PEERS,
            more=more,
        )  # fmt: skip


def _solve(solver: ScanSolver, scans: list[Scan]) -> tuple[Array, Array | None, Figure]:
    """Return the estimates of all blocks, and the median CPU time of a profile."""
    solver(scans[0].first(1))
    timed = [comparison.time_profiles(partial(solver, scan), len(scan.signal)) for scan in scans]
    depth = np.concatenate([depth for _, (depth, _) in timed])
    stated = [stated for _, (_, stated) in timed if stated is not None]
    middle = float(np.median([spent.value for spent, _ in timed]))
    return depth, np.concatenate(stated) if stated else None, cpu_time(middle)


# Peers ------------------------------------------------------------------------------------------
#
# Straight lines through logarithms by numpy. Both know the true scatter, and use samples of more
# than 3 times their noise; the spline, those of which a running mean is: noise selects bright
# samples otherwise, which biases the lines.

_SPLINE_STRENGTHS: Final = np.geomspace(1e-4, 1e9, 60)
"""In the weights of the data, for altitudes one apart."""
_LEAST_SNR: Final = 3.0
_FEWEST_BEAMS: Final = 3
_FEWEST_KNOTS: Final = 5
_RUN: Final = 9
"""Altitudes of the running mean by which the spline peer selects samples."""
_LEAST_SCATTER: Final = 1e-20
SPLINE: Final = "straight lines, GCV spline"


def lines(scan: Scan) -> tuple[Array, Array]:
    """Return optical depths and standard errors of Kano-Hamilton in closed form.

    (profile, altitude) each, of straight lines fitted to all altitudes at once.
    """
    return _fit_lines(scan, scan.signal)


def _fit_lines(scan: Scan, level: Array) -> tuple[Array, Array]:
    """Fit straight lines to logarithms at a level of the signal, which also selects samples."""
    x = scan.scene.path[:, np.newaxis]
    used = level > _LEAST_SNR * np.sqrt(scan.variance)
    with np.errstate(divide="ignore", invalid="ignore"):
        scatter = scan.variance / level**2 + scan.scene.inhomogeneity**2
        # Without scatter and noise, all beams have the same weight.
        weight = np.where(used, 1.0 / np.maximum(scatter, _LEAST_SCATTER), 0.0)
        positive = np.where(used, level, 1.0)
        y = np.where(used, np.log(positive) + (scan.signal - level) / positive, 0.0)
        total = weight.sum(axis=1, keepdims=True)
        away = x - (weight * x).sum(axis=1, keepdims=True) / total
        information = (weight * away**2).sum(axis=1)
        depth = -0.5 * (weight * away * y).sum(axis=1) / information
        error = 0.5 / np.sqrt(information)
    solvable = used.sum(axis=1) >= _FEWEST_BEAMS
    return np.where(solvable, depth, np.nan), np.where(solvable, error, np.nan)


def spline(scan: Scan) -> tuple[Array, None]:
    """Smooth optical depths by a discrete spline, its strength by generalised cross validation.

    All profiles share one singular value decomposition and one strength, for the altitudes that all
    of them reach and the medians of their errors. It states no errors.
    """
    level = uniform_filter1d(scan.signal, _RUN, axis=-1, mode="nearest")
    depth, error = _fit_lines(scan, level)
    smooth = np.full(depth.shape, np.nan)
    known = np.isfinite(depth).all(axis=0)
    if known.sum() >= _FEWEST_KNOTS:
        smooth[:, known] = _cross_validated(depth[:, known], np.median(error[:, known], axis=0))
    return smooth, None


def _cross_validated(depth: Array, error: Array) -> Array:
    """Return profiles at even altitudes, smoothed by second differences weighted by the errors."""
    count = error.size
    error = error / error.mean()
    roughness = np.diff(np.eye(count), 2, axis=0) * error
    _, singular, modes = np.linalg.svd(roughness, full_matrices=True)
    penalty = np.append(singular**2, np.zeros(count - singular.size))
    kept = 1.0 / (1.0 + _SPLINE_STRENGTHS[:, np.newaxis] * penalty)
    data = (depth / error) @ modes.T
    misfit = (1.0 - kept) ** 2 @ np.sum(data**2, axis=0)
    best = np.argmin(misfit / (count - kept.sum(axis=1)) ** 2)
    return np.asarray((data * kept[best]) @ modes * error)


PEERS: Final = {"straight lines, numpy": lines, SPLINE: spline}
"""Peers by name."""
