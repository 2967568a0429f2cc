"""Time of the kernels and methods for scans, compared with reading their inputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from lidarops.bench.accuracy import multiangle_cases as cases
from lidarops.bench.accuracy.multiangle_cases import Scan
from lidarops.bench.harness.benchmark import Effort
from lidarops.bench.harness.timing import READ, Machine, StepCost, least_times, machine
from lidarops.retrieve.multiangle import _block, slant_paths
from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle.vertical import smooth_profile

BEAMS: Final = "make_beams"
"""Logarithms, their variances and the reach of the beams."""
REGRESS: Final = "regress"
"""Weighted fit of all altitudes with estimated scatter, without the robust passes."""
SMOOTH: Final = "vertical.smooth"
INPUTS: Final = "read (np.max), signal and variance"
_BATCHES: Final = (1, 64, 512)
_QUICK_BATCHES: Final = (1, 64)
_REPEATS: Final = 5
_QUICK_REPEATS: Final = 3
_PEER_PROFILES: Final = 1
"""Profiles of one call of a peer."""


@dataclass(frozen=True, slots=True)
class MultiAngleThroughput:
    """The throughput benchmark of scans."""

    date: str
    machine: Machine
    angles: int
    altitudes: int
    costs: tuple[StepCost, ...]


def measure_scan_kernels(
    effort: Effort, *, batches: Sequence[int] | None = None
) -> MultiAngleThroughput:
    """Time kernels, methods and peers on clear air, beside reading the inputs.

    Parameters
    ----------
    effort : Effort
    batches : sequence of int, optional
        Profiles per call.
    """
    scene = cases.clear(3000.0)
    costs: list[StepCost] = []
    for batch in batches or (_QUICK_BATCHES if effort.quick else _BATCHES):
        rounds = effort.repeats or (_QUICK_REPEATS if effort.quick else _REPEATS)
        costs += _costs(scene.draw(batch, batch, 8), rounds)
        effort.progress(1)
    angles, altitudes = scene.path.size, scene.altitude.size
    return MultiAngleThroughput(effort.date, machine(), angles, altitudes, tuple(costs))


def _costs(scan: Scan, repeats: int) -> Iterator[StepCost]:
    batch = len(scan.signal)
    # Callers pass an array, not a view of one row.
    scan = Scan(scan.scene, scan.signal, np.ascontiguousarray(scan.variance))
    few = min(batch, _PEER_PROFILES)
    ours = _kernels(scan)
    ours |= {name: partial(solver, scan) for name, solver in cases.scan_methods().items()}
    ours |= {
        f"{method}, plain": partial(cases.retrieve, scan, method, robust=False)
        for method in (cases.KANO_HAMILTON, cases.JOINT)
    }
    others = {name: partial(solver, scan.first(few)) for name, solver in cases.scan_peers().items()}
    reads: dict[str, Callable[[], object]] = {
        READ: lambda: np.max(scan.signal),
        INPUTS: lambda: (np.max(scan.signal), np.max(scan.variance)),
    }
    times = least_times({**reads, **ours, **others}, repeats)
    read = times[READ] / batch
    for name, seconds in times.items():
        profiles = few if name in others else batch
        per_profile = seconds / profiles
        yield StepCost(name, batch, profiles, 1e9 * per_profile, per_profile / read, name in ours)


def _kernels(scan: Scan) -> dict[str, Callable[[], object]]:
    scene = scan.scene
    geometry = slant_paths.make_scan(scene.zenith_angle, scene.altitude, None)
    beams = _block.make_beam_block(scan.signal, scan.variance, geometry)
    fit = _block.regress(beams, inhomogeneity=None, robust=False)
    share = fit.column(kh.SHARE) * fit.inhomogeneity
    residuals = smooth_profile.residual_moments(
        fit.residual,
        np.where(np.isfinite(fit.residual), _block.weights_of(beams, fit), 0.0),
        np.nan_to_num(fit.leverage, nan=1.0),
        fit.inhomogeneity,
        np.nan_to_num(share),
        beams.gaps,
    )
    smooth = partial(
        smooth_profile.smooth_optical_depth,
        fit.column(kh.TAU),
        fit.column(kh.INFORMATION),
        scene.altitude,
        residuals=residuals,
    )
    return {
        BEAMS: lambda: _block.make_beam_block(scan.signal, scan.variance, geometry),
        REGRESS: lambda: _block.regress(beams, inhomogeneity=None, robust=False),
        SMOOTH: smooth,
    }
