"""Ablation of the guards of networks: ``python -m benchmarks.studies.network_guards [NETWORKS]``.

Besides random networks: blocks in which noise rises, steep fields, and outliers in curved air, each
of which has rows of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np

from benchmarks.harness.figure import Random, log_uniform
from benchmarks.harness.rates import Failure, ScoredValues
from benchmarks.scenes import lidar_networks
from benchmarks.scenes.lidar_networks import Air
from benchmarks.studies.ablation import (
    Guard,
    requested_number,
    with_thresholds,
    without,
    write_guards,
)
from lidarops.retrieve.network import (
    _beam_signals,
    _block_solution,
    _changing_field,
    outlying_bins,
)

NETWORKS: Final = 20
PROFILES: Final = 50
"""Profiles of a random network: one block."""
GUARDS: Final = (
    Guard("stratified air", off=with_thresholds(_changing_field, stratified=(0.1, 400.0))),
    Guard("changes in time", off=with_thresholds(_changing_field, least_change=1e30)),
    Guard("running means", off=with_thresholds(_block_solution, linear_change=1e30)),
    Guard("profiles that disagree", off=with_thresholds(_block_solution, least_neighbourly=0.0)),
    Guard("default overlap error", off=with_thresholds(_block_solution, default_overlap_error=0.0)),
    Guard("curvature errors", off=with_thresholds(_block_solution, profile_noise=1e30)),
    Guard("outlying bins", off=without((outlying_bins, "search", lambda *_: None))),
    Guard("weak signals", off=with_thresholds(_beam_signals, largest_bin_error=1e6)),
    Guard("noisy profiles", off=with_thresholds(_beam_signals, noisy_profile=1e30)),
)


def score(cluster: int) -> Iterator[ScoredValues]:
    """Yield the values of a random network by class, then those of the other scenes."""
    yield from lidar_networks.score_networks(cluster, PROFILES)
    rising, steep, curved = (np.random.default_rng((seed, cluster)) for seed in (74, 75, 76))
    # By a factor of 5, as at dawn.
    dawn = np.where(np.arange(PROFILES) < rising.integers(10, 40), 1.0, 5.0)[:, None, None]
    yield from _scored("noise that rises", rising, lidar_networks.layered, 3e-3, factor=dawn)
    yield from _scored("steep field", steep, _steep, 1e-3)
    air = lidar_networks.plume if cluster % 2 else lidar_networks.thin_layer
    outlying = float(curved.uniform(0.005, 0.04))
    yield from _scored("outliers in curved air", curved, air, 1e-3, outlying=outlying)


def _steep(rng: Random) -> Air:
    """Return air with a scale height of 80 to 300 m."""
    value, scale = log_uniform(rng, 3e-4, 5e-3), log_uniform(rng, 80.0, 300.0)
    return Air("steep", lambda _: lambda __, up: value * np.exp(-(up - 500.0) / scale))


def _scored(
    name: str, rng: Random, draw_air: lidar_networks.DrawAir, least: float, *, factor: Any = 1.0,
    outlying: float = 0.0,
) -> Iterator[ScoredValues]:  # fmt: skip
    """Yield the values of a block with this least noise, times a factor, and outlying bins."""
    clean = lidar_networks.random_signals(rng, draw_air)
    if clean is None:
        return
    noise = log_uniform(rng, least, 0.1)
    power, variance = clean.draw(noise, PROFILES, int(rng.integers(2**31)), additive=noise / 3.0)
    mean = clean.power[np.arange(PROFILES) % len(clean.power)]
    power, variance = mean + factor * (power - mean), factor**2 * variance
    hit = rng.random(power.shape) < outlying
    power = power + hit * rng.uniform(5.0, 100.0, power.shape) * np.sqrt(variance)
    result = lidar_networks.solve(power, variance, clean)
    values = lidar_networks.scored(Failure(name), result, clean.truth(PROFILES), 0.0)
    yield replace(values, quantity=name)


if __name__ == "__main__":
    write_guards("network.md", score, requested_number(__doc__, NETWORKS), GUARDS)
