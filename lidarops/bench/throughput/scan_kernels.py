"""Time of the kernels and methods for scans, compared with reading their inputs."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final

import numpy as np

from lidarops.bench.accuracy import multiangle_cases as cases
from lidarops.bench.accuracy.multiangle_cases import Scan
from lidarops.bench.harness.costs import time_methods
from lidarops.bench.harness.rows import Row
from lidarops.bench.harness.timing import READ
from lidarops.retrieve.multiangle import _block, slant_paths
from lidarops.retrieve.multiangle import _kano_hamilton as kh
from lidarops.retrieve.multiangle.vertical import smooth_profile

BEAMS: Final = "make_beams"
"""Logarithms, their variances and the reach of the beams."""
REGRESS: Final = "regress"
"""Weighted fit of all altitudes with estimated scatter, without the robust passes."""
SMOOTH: Final = "vertical.smooth"
INPUTS: Final = "read (np.max), signal and variance"
_PEER_PROFILES: Final = 1
"""Profiles of one call of a peer."""


def scan_costs(case: str, scan: Scan, repeats: int) -> list[Row]:
    """Return the CPU time of kernels, methods and peers, the read first."""
    batch = len(scan.signal)
    # Callers pass an array, not a view of one row.
    scan = Scan(scan.scene, scan.signal, np.ascontiguousarray(scan.variance))
    few = min(batch, _PEER_PROFILES)
    reads: dict[str, Callable[[], object]] = {
        READ: lambda: np.max(scan.signal),
        INPUTS: lambda: (np.max(scan.signal), np.max(scan.variance)),
    }
    ours = _kernels(scan)
    ours |= {name: partial(solver, scan) for name, solver in cases.scan_methods().items()}
    ours |= {
        f"{method}, plain": partial(cases.retrieve, scan, method, robust=False)
        for method in (cases.KANO_HAMILTON, cases.JOINT)
    }
    peers = {name: partial(solver, scan.first(few)) for name, solver in cases.scan_peers().items()}
    calls = {name: (call, batch) for name, call in (reads | ours).items()}
    calls |= {name: (call, few) for name, call in peers.items()}
    return time_methods(case, calls, repeats, peers={INPUTS, *peers})


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
