"""Ablation of the guards of networks: ``python -m benchmarks.studies.network_guards [NETWORKS]``.

Every variant solves the same random networks (`benchmarks.scenes.lidar_networks`) and blocks
in which noise rises, in steep fields, and with outliers in curved air. The table in
``docs/algorithms/network.md`` states shares with all guards, then the differences without one of
them, in percent, each with its Monte Carlo error from the scatter between networks.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
import pandas as pd

from benchmarks.harness.figure import log_uniform
from benchmarks.harness.rates import Failure, ScoredValues
from benchmarks.scenes import lidar_networks
from benchmarks.scenes.lidar_networks import Air, signals
from benchmarks.studies.ablation import (
    BASE,
    PAGES,
    Guard,
    measure,
    requested_number,
    with_thresholds,
    without,
    write_table,
)
from lidarops.retrieve.network import (
    _beam_signals,
    _block_solution,
    _changing_field,
    extinction_field,
    outlying_bins,
)

NETWORKS: Final = 20
PROFILES: Final = 50
"""Profiles of a random network: one block."""
RISING, STEEP, CURVED = "noise that rises", "steep field", "outliers in curved air"
OWN: Final = {
    "outlying bins": "outliers",
    "noisy profiles": RISING,
    "curvature errors": "layer of a few bins",
    "stratified air": STEEP,
    "profiles that disagree": "one bad profile",
}
"""Class of scenes that a guard is for."""

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


# Random networks ------------------------------------------------------------------------------


def _rising_noise(cluster: int) -> ScoredValues | None:
    """Return the values of a block in which noise rises by a factor of 5, as at dawn."""
    rng = np.random.default_rng((74, cluster))
    factor = np.where(np.arange(PROFILES) < rng.integers(10, 40), 1.0, 5.0)[:, None, None]
    return _solved(RISING, rng, lidar_networks.layered, (3e-3, 0.1), factor=factor)


def _steep_field(cluster: int) -> ScoredValues | None:
    """Return the values of a block in a field with a scale height of 80 to 300 m."""

    def steep(rng: Any) -> Air:
        value = log_uniform(rng, 3e-4, 5e-3)
        scale = log_uniform(rng, 80.0, 300.0)
        return Air("steep", lambda _: lambda __, up: value * np.exp(-(up - 500.0) / scale))

    return _solved(STEEP, np.random.default_rng((75, cluster)), steep, (1e-3, 0.1))


def _curved_outliers(cluster: int) -> ScoredValues | None:
    """Return the values of a block with 0.5 to 4 percent of outlying bins in plumes and layers."""
    rng = np.random.default_rng((76, cluster))
    air = lidar_networks.plume if cluster % 2 else lidar_networks._thin_layer
    outlying = float(rng.uniform(0.005, 0.04))
    return _solved(CURVED, rng, air, (1e-3, 0.1), outlying=outlying)


def _solved(
    name: str, rng: Any, air: Any, noises: tuple[float, float], *, factor: Any = 1.0,
    outlying: float = 0.0,
) -> ScoredValues | None:  # fmt: skip
    net = lidar_networks.random_network(rng).network()
    if net.crossings < 2 or np.bincount(net.passages.beam).min() < 2:
        return None
    clean = signals(net, air(rng))
    noise = log_uniform(rng, *noises)
    power, variance = clean.draw(noise, PROFILES, int(rng.integers(2**31)), additive=noise / 3.0)
    mean = clean.power[np.arange(PROFILES) % len(clean.power)]
    power, variance = mean + factor * (power - mean), factor**2 * variance
    hit = rng.random(power.shape) < outlying
    power = power + hit * rng.uniform(5.0, 100.0, power.shape) * np.sqrt(variance)
    result = extinction_field.retrieve_network(
        power, clean.range, net, variance=variance, full_overlap_range=100.0
    )
    return lidar_networks.scored(Failure(name), result, clean.truth(PROFILES), 0.0)


SHARES: Final = {
    "false": ("false random", "kept"),
    "covered": ("covered", "kept"),
    "needless flags": ("fine rejected", "scored"),
    "values": ("kept", "scored"),
}
"""Column -> numerator and denominator."""


def score(cluster: int) -> Iterator[ScoredValues]:
    """Yield the values of a random network by class."""
    yield from lidar_networks.score_networks(cluster, PROFILES)
    for draw in (_rising_noise, _steep_field, _curved_outliers):
        values = draw(cluster)
        if values is not None:
            yield values


def table(counts: pd.DataFrame) -> Iterator[str]:
    """Yield the lines of the table of all variants."""
    heads = ("guard switched off", "class", "networks", *SHARES)
    yield f"| {' | '.join(heads)} |"
    yield "|---" * len(heads) + "|"
    names = counts.index.unique("guard")
    for name in [BASE, *sorted(names.drop(BASE))]:
        own = [OWN[name]] if name in OWN else []
        classes = [*dict.fromkeys(OWN.values()), CURVED] if name == BASE else own
        for of_class in ("all", *classes):
            changed, base = (
                each if of_class == "all" else each[each.index.isin([of_class], level="class")]
                for each in (counts.loc[name], counts.loc[BASE])
            )
            if len(changed):
                yield _row(name, of_class, changed, base)


def _row(name: str, of_class: str, changed: pd.DataFrame, base: pd.DataFrame) -> str:
    """Return shares of all guards, or differences from them with the errors of pairs."""
    cells = []
    sums = [part.groupby("cluster", sort=False).sum() for part in (changed, base)]
    for numerator, denominator in SHARES.values():
        shares, terms = [], []
        for part in sums:
            total = part[denominator].sum()
            shares.append(part[numerator].sum() / total)
            terms.append((part[numerator] - shares[-1] * part[denominator]) / total)
        of_all = name == BASE
        share = shares[1] if of_all else shares[0] - shares[1]
        scatter = np.sqrt(np.sum((terms[1] if of_all else terms[0] - terms[1]) ** 2))
        cells.append(f"{100 * share:{'' if of_all else '+'}.2f} ± {100 * scatter:.2f}")
    networks = changed.index.unique("cluster")
    return f"| {name} | {of_class} | {len(networks)} | {' | '.join(cells)} |"


if __name__ == "__main__":
    counts = measure(score, range(requested_number(__doc__, NETWORKS)), GUARDS)
    write_table(
        PAGES / "network.md", "ablation", table(counts.droplevel(["quantity", "satisfied"]))
    )
