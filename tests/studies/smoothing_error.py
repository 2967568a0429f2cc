"""How often extinctions of scans are covered, and false, with a smaller error by smoothing.

In the root of a checkout::

    python tests/studies/smoothing_error.py [--geometries 90]

prints the table of ``docs/algorithms/multiangle.md``.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from typing import Any, Final
from unittest import mock

import numpy as np

from lidarops.bench.accuracy import multiangle_cases
from lidarops.bench.stability import random_scans
from lidarops.bench.stability.random_scenes import COVERED, FALSE
from lidarops.retrieve.multiangle.vertical import smooth_profile

PROFILES: Final = 8
SHARES: Final = (1.0, 0.8, 0.65, 0.5)
"""Parts of the stated error by smoothing that are kept."""
CLASSES: Final = (0, 1, 2, 3, 6)


def matrix(bands: Any) -> Any:
    """Return the symmetric matrix of its diagonal and two off-diagonals."""
    count = bands.shape[-1]
    upper = sum(np.diag(bands[k][: count - k], k) for k in (1, 2))
    return np.diag(bands[0]) + upper + upper.T


def noise_of_extinction(block: Any, fit: Any, step: Any) -> Any:
    """Return the standard errors by noise alone, (profile, altitude)."""
    stiffness = matrix(block.stiffness)
    difference = np.eye(step.size) - np.eye(step.size, k=-1)
    errors = np.empty(fit.depth.shape)
    for row in range(len(errors)):
        precision = matrix(fit.bands[:, row])
        inverse = sum(
            share * np.linalg.inv(precision + smoothing * stiffness)
            for smoothing, share in zip(fit.candidates.smoothing, fit.candidates.share, strict=True)
        )
        gain = difference @ inverse
        errors[row] = np.sqrt(np.diag(gain @ precision @ gain.T)) / step
    return errors


def solve(scan: Any) -> tuple[Any, Any]:
    """Return the result of a scan, and its errors of extinction by noise alone."""
    kept: list[Any] = []
    plain = smooth_profile._result

    def result(block: Any, fit: Any, ratio: Any, within: Any, step: Any) -> Any:
        kept.append(noise_of_extinction(block, fit, step))
        return plain(block, fit, ratio, within, step)

    with mock.patch.object(smooth_profile, "_result", result):
        return multiangle_cases.retrieve(scan, multiangle_cases.AUTO), kept


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--geometries", type=int, default=90)
    counts: dict[tuple[str, float], Any] = defaultdict(lambda: np.zeros(3))
    share: dict[str, list[float]] = defaultdict(list)
    for cluster in range(parser.parse_args().geometries):
        for number in CLASSES:
            failure, change, damage = random_scans.FAILURES[number]
            rng = np.random.default_rng((72, cluster, number))
            scene = change(multiangle_cases.random_scene(cluster, PROFILES), rng)
            result, noises = solve(damage(scene.draw(PROFILES, cluster, number, 72), rng))
            if not noises or noises[-1].shape != result.extinction.shape:
                continue
            used = np.isfinite(result.extinction) & ~result.flags.doubtful()
            error = (result.extinction - np.asarray(scene.extinction))[used]
            stated = result.extinction_standard_error[used] ** 2
            noise = np.minimum(noises[-1][used] ** 2, stated)
            share[failure.name].extend(noise / stated)
            for part in SHARES:
                square = noise + part**2 * (stated - noise)
                size = np.abs(error) / np.sqrt(square + result.extinction_gradient_error[used] ** 2)
                counts[failure.name, part] += (
                    np.sum(size <= COVERED), np.sum(size > FALSE), size.size
                )  # fmt: skip
    for (name, part), (covered, false, values) in counts.items():
        sys.stdout.write(
            f"| {name} | {np.mean(share[name]):.0%} | {part:g} | {covered / values:.1%}"
            f" | {1e3 * false / values:.2f} | {values:.0f} |\n"
        )


if __name__ == "__main__":
    main()
