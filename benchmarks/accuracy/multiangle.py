"""Accuracy of the optical depths and extinctions of scans, method by method."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from benchmarks.accuracy import multiangle_cases as cases
from benchmarks.accuracy.multiangle_cases import Scan, ScanEstimates, ScanSolver, Scene
from benchmarks.accuracy.multiangle_peers import SLOW, scan_peers
from benchmarks.harness.figure import Array, Figure, Mask, cpu_time, share
from benchmarks.harness.results import Chapter, Effort, Results, Study, Work
from benchmarks.harness.statistics import SIGMAS, over_blocks, root
from benchmarks.harness.timing import CPU_TIME
from benchmarks.harness.verdicts import Scores

_DEPTH: Final = "RMSE of optical depth"
_COMMON: Final = "RMSE where all have a value"
_EXTINCTION: Final = "RMSE of extinction (km⁻¹)"
_WITHIN: Final = ("within 1", "within 1.96")


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
    size = size or (QUICK if effort.quick else FULL)
    compared: Scores = {}
    for number, scene in enumerate(cases.scan_scenes()):
        compared |= _compare(scene, size, number)
        effort.progress(1)
    chapters = [
        Chapter(
            "Error against CPU time",
            "Clear air: 12 beams from 0 to 75°, 201 altitudes from 150 m to 6.15 km, scatter of "
            "backscatter along the horizontal 3 %, signal over noise as stated at the zenith in "
            "1 km. Cloud: 6 beams from 0 to 30°, 40 altitudes, optical depth 4.4, scatter 14.7 %. "
            "All profiles of a block are solved at once. Our methods estimate the scatter. The "
            "peers know it, solve each altitude on its own but for the spline, and use each sample "
            "that exceeds 3 times its noise: this selects bright samples and biases straight lines "
            "in clear air; our methods and the spline select with the mean of a window.",
            [
                Results(
                    "Methods and peers in four scenes",
                    compared,
                    "Where all have a value: at the altitudes that all methods but the slow ones "
                    "solve. In brackets: Monte Carlo standard error of the last digits, from "
                    "independent blocks.",
                    case="scene",
                )
            ],
        ),
    ]
    return Study(
        "Scans: error of optical depth and extinction against CPU time",
        effort.date,
        chapters,
        list(_works(compared)),
    )


# Statistics of blocks -------------------------------------------------------------------------

BlockMeans = dict[str, float]
"""Means over one block, by name; NaN where there is nothing to average."""


def _mean(values: Mask | Array) -> float:
    finite = np.asarray(values, dtype=np.float64)[np.isfinite(values)]
    return float(finite.mean()) if finite.size else float("nan")


def _figure(blocks: Sequence[BlockMeans], name: str) -> Figure | None:
    """Return the mean of the blocks, the root of a mean square; None where no block has one."""
    figure = over_blocks([means[name] for means in blocks])
    if not np.isfinite(figure.value):
        return None
    return root(figure) if name.endswith("square") else figure


def _share(blocks: Sequence[BlockMeans], name: str) -> Figure | None:
    value = _figure(blocks, name)
    return None if value is None else share(value)


def _share_within(error: Array, stated: Array | None, sigmas: float) -> float:
    if stated is None:
        return float("nan")
    known = np.isfinite(error) & np.isfinite(stated)
    return _mean((np.abs(error) <= sigmas * stated)[known])


def _block_means(estimates: ScanEstimates, scene: Scene, mask: Mask) -> BlockMeans:
    """Return means over the altitudes of one block within the mask."""
    error = np.where(mask, estimates.optical_depth - scene.optical_depth, np.nan)
    steps = np.diff(scene.altitude, prepend=0.0)
    slope = np.diff(estimates.optical_depth, axis=1, prepend=0.0) / steps - scene.extinction
    means = {
        "solved": _mean(np.isfinite(error)[mask]),
        "square": _mean(error**2),
        "error": _mean(error),
        "extinction square": _mean((1e3 * np.where(mask, slope, np.nan)) ** 2),
    }
    for name, sigmas in zip(_WITHIN, SIGMAS, strict=True):
        means[name] = _share_within(error, estimates.standard_error, sigmas)
    return means


# All methods in four scenes -------------------------------------------------------------------


def _compare(scene: Scene, size: StudySize, number: int) -> Scores:
    """Return the scores of the methods that have a value, where kano_hamilton has one."""
    scans = [scene.draw(size.profiles, number, block) for block in range(size.blocks)]
    few = [scan.first(size.slow) for scan in scans]
    solved = {
        name: _solve(solver, few if name in SLOW else scans)
        for name, solver in {**cases.scan_methods(), **scan_peers()}.items()
    }
    has_value = {
        name: [np.isfinite(each.optical_depth) for each in blocks]
        for name, (blocks, _) in solved.items()
    }
    complete = [
        masks for name, masks in has_value.items()
        if name not in SLOW and any(mask.any() for mask in masks)
    ]  # fmt: skip
    common = [np.all(masks, axis=0) for masks in zip(*complete, strict=True)]
    scores: Scores = {}
    for name, (blocks, nanoseconds) in solved.items():
        means = []
        for estimates, of_line, of_all in zip(
            blocks, has_value[cases.KANO_HAMILTON], common, strict=True
        ):
            within, everywhere = (
                mask[: len(estimates.optical_depth)] for mask in (of_line, of_all)
            )
            of_common = _block_means(estimates, scene, everywhere)["square"]
            means.append(_block_means(estimates, scene, within) | {"common square": of_common})
        if (slope := _figure(means, "extinction square")) is not None:
            scores[scene.label, name] = {
                "profiles": sum(len(each.optical_depth) for each in blocks),
                CPU_TIME: cpu_time(nanoseconds),
                "solved": share(over_blocks([each["solved"] for each in means]).value),
                _DEPTH: _figure(means, "square"),
                _COMMON: _figure(means, "common square"),
                "mean error": _figure(means, "error"),
                **{within: _share(means, within) for within in _WITHIN},
                _EXTINCTION: slope,
            }
    return scores


def _solve(solver: ScanSolver, scans: Sequence[Scan]) -> tuple[list[ScanEstimates], float]:
    """Return the estimates of each block, and the median CPU time of a profile, ns."""
    solver(scans[0].first(1))
    blocks, times = [], []
    for scan in scans:
        begin = time.process_time()
        blocks.append(solver(scan))
        times.append((time.process_time() - begin) / len(scan.signal))
    return blocks, 1e9 * float(np.median(times))


def _works(scores: Scores) -> Iterator[Work]:
    for (scene, method), score in scores.items():
        error, coverage, spent = score[_COMMON], score[_WITHIN[1]], score[CPU_TIME]
        if isinstance(error, Figure) and isinstance(spent, Figure):
            stated = coverage if isinstance(coverage, Figure) else None
            ours = method not in scan_peers()
            yield Work(scene, "optical depth", method, error, stated, spent, ours=ours)
