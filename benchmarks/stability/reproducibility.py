"""How far values depend on the order of profiles and on the machine."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Final

import numpy as np

from benchmarks.accuracy import multiangle_cases
from benchmarks.harness.figure import Array, Scores
from benchmarks.scenes import lidar_networks
from benchmarks.scenes.lidar_networks import signals
from lidarops.retrieve.network import extinction_field

CHANGE: Final = "largest change, in stated errors"
_KERNELS: Final = ("Haswell", "Prescott")
_PROFILES: Final = 8
_NETWORK_PROFILES: Final = 4


def profile_order(cluster: int) -> Iterator[tuple[str, float]]:
    """Yield the change of values when the profiles of a block are exchanged."""
    scene = multiangle_cases.random_scene(cluster, _PROFILES)
    scan = scene.draw(_PROFILES, cluster, 85)
    order = np.random.default_rng((85, cluster)).permutation(_PROFILES)
    shuffled = multiangle_cases.Scan(scene, scan.signal[order], scan.variance[order])
    first, second = (multiangle_cases.retrieve(s, "auto") for s in (scan, shuffled))
    change = np.abs(first.optical_depth[order] - second.optical_depth)
    yield "scan, order of profiles", _largest(change / second.optical_depth_standard_error)
    rng = np.random.default_rng((73, cluster))
    net = lidar_networks.random_network(rng).network()
    if net.crossings < 2 or np.bincount(net.passages.beam).min() < 2:
        return
    clean = signals(net, lidar_networks.layered(rng))
    power, variance = clean.draw(0.03, _PROFILES, cluster)
    one, two = (
        extinction_field.retrieve_network(
            power[o], clean.range, net, variance=variance[o], full_overlap_range=100.0
        )
        for o in (np.arange(_PROFILES), order)
    )
    change = np.abs(one.extinction[order] - two.extinction)
    yield "network, order of profiles", _largest(change / two.extinction_standard_error)


def _largest(values: Array) -> float:
    return float(np.max(values[np.isfinite(values)], initial=0.0))


def network_values(clusters: int) -> Array:
    """Return errors of extinction of networks and their stated ones, NaN where flagged."""
    values = []
    for cluster in range(clusters):
        for scored in lidar_networks.score_networks(cluster, _NETWORK_PROFILES):
            kept = np.where(scored.bits == 0, scored.error, np.nan)
            columns = (kept, np.broadcast_to(scored.random, kept.shape))
            values.append(np.stack([column.ravel() for column in columns]))
    return np.concatenate(values, axis=1)


def kernel_change(clusters: int) -> float:
    """Return the change of values between two kernels of linear algebra."""
    code = (
        f"import sys, numpy; from {network_values.__module__} import network_values;"
        f"numpy.save(sys.stdout.buffer, network_values({clusters}))"
    )
    results = []
    for kernel in _KERNELS:
        printed = subprocess.run(  # noqa: S603 - a kernel is chosen when numpy is imported
            [sys.executable, "-c", code],
            env={**os.environ, "OPENBLAS_CORETYPE": kernel, "OPENBLAS_NUM_THREADS": "1"},
            check=True, capture_output=True,
        ).stdout  # fmt: skip
        results.append(np.load(io.BytesIO(printed)))
    return _largest(np.abs(results[0][0] - results[1][0]) / results[0][1])


def measure_reproducibility(clusters: int, networks: int) -> Scores:
    """Return the largest changes by the order of profiles and by the machine."""
    changes: dict[str, float] = {}
    for cluster in range(clusters):
        for name, change in profile_order(cluster):
            changes[name] = max(change, changes.get(name, 0.0))
    changes["network, kernel of linear algebra"] = kernel_change(networks)
    return {("", name): {CHANGE: change} for name, change in changes.items()}
