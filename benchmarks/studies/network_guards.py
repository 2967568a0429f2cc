"""Ablation of the guards of networks: what changes when each of them is switched off.

Every variant solves the same random networks (`benchmarks.stability.random_networks`), blocks
in which noise rises, and simulated campaigns from raw files to products. In the root of a
checkout::

    python -m benchmarks.studies.network_guards solve OUT [--only VARIANT ...] [--classes NAME ...]
    python -m benchmarks.studies.network_guards table OUT MARKER

``table`` writes a table into ``docs/algorithms/network.md``, between two marks of that name: shares
with all guards, then the differences without one of them, in percent, each with its Monte Carlo
error from the scatter between networks.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import xarray as xr

# Its campaigns are those of tests.
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

from support.archives import network_campaigns

from benchmarks.accuracy.network_cases import Air, signals
from benchmarks.stability import random_networks
from benchmarks.studies.ablation import write_table
from lidarops.flags import Quality, rejecting
from lidarops.retrieve.network import (
    _beam_signals,
    _block_errors,
    _empirical_prior,
    extinction_field,
    labeled,
    outlying_bins,
)
from lidarops.retrieve.network.flags import NetworkQuality
from lidarops.retrieve.network.thresholds import THRESHOLDS
from lidarops.run.archive import Options, Selection, reprocess

PROFILES = 50
"""Profiles of a random network: one block."""
FALSE, FINE, COVERED = 4.0, 2.5, 1.96
"""Stated errors beyond which a value is false, within which it needs no flag, and within which
95 percent of the values should be."""
REJECTING = rejecting((*Quality, *NetworkQuality))
CAMPAIGNS, RISING = "campaigns", "noise that rises"
STEEP, CURVED = "steep field", "outliers in curved air"
CHOSEN: list[str] = []
ALL = "all guards"
OWN = {
    "outlying bins": "outliers",
    "noisy profiles": RISING,
    "curvature errors": "layer of a few bins",
    "prior: weakest where untestable": STEEP,
}
"""Class of scenes that a guard is for."""
PAGE = Path(__file__).resolve().parents[2] / "docs/algorithms/network.md"

Patch = tuple[Any, str, Any]


def _no(*_: Any) -> bool:
    return False


def _without_prior(problem: Any) -> Any:
    mean = problem.mean().solve(_empirical_prior.NO_PRIOR)
    free = problem.solve(_empirical_prior.NO_PRIOR)
    return _empirical_prior.BlockSolution(free, mean, mean, contradicted=False)


VARIANTS: dict[str, list[Patch]] = {
    ALL: [],
    "prior": [
        (extinction_field, "solve_block", _without_prior),
    ],
    "prior: contradicted by profiles": [(_empirical_prior, "_contradicted", _no)],
    "prior: contradicted by the mean": [(_empirical_prior, "_improbable", _no)],
    "prior: weakest where untestable": [
        (_empirical_prior, "_can_test_prior", lambda *_: True),
    ],
    "noise bias": [(_block_errors, "noise_bias_variance", lambda *_: 0.0)],
    "curved fields": [(_block_errors, "bent_fields", lambda at: np.zeros((1, len(at))))],
    "at least typical": [(_block_errors, "at_least_typical", lambda _, variance, *__: variance)],
    "curvature errors": [(_block_errors, "curvature_variance", lambda *_: 0.0)],
    "outlying bins": [(outlying_bins, "search", lambda *_: None)],
    "weak signals": [(_beam_signals, "THRESHOLDS", THRESHOLDS._replace(largest_bin_error=1e6))],
    "noisy profiles": [(_beam_signals, "THRESHOLDS", THRESHOLDS._replace(noisy_profile=1e30))],
}
"""Names of guards, each with what replaces it. A variant of several names switches off all."""


# Random networks ------------------------------------------------------------------------------


def _count(error: Any, stated: Any, flagged: Any, truth: Any) -> dict[str, float]:
    """Return sums over all near crossings of all profiles."""
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.abs(error) / stated
        kept = np.isfinite(error) & ~flagged
        relative = np.clip(np.abs(error) / truth, 0.0, 3.0)
    return {
        "values": float(error.size),
        "kept": float(kept.sum()),
        "false": float((kept & ~(size <= FALSE)).sum()),
        "covered": float((kept & (size <= COVERED)).sum()),
        "needless": float((np.isfinite(error) & flagged & (size <= FINE)).sum()),
        "square": float((relative[kept] ** 2).sum()),
        "stated": float((np.minimum(stated / truth, 3.0)[kept]).sum()),
    }


def _rising_noise(cluster: int) -> dict[str, float] | None:
    """Return the counts of a block in which noise rises by a factor of 5, as at dawn."""
    rng = np.random.default_rng((74, cluster))
    factor = np.where(np.arange(PROFILES) < rng.integers(10, 40), 1.0, 5.0)[:, None, None]
    return _own_counts(rng, random_networks.layered, (3e-3, 0.1), factor=factor)


def _steep_field(cluster: int) -> dict[str, float] | None:
    """Return the counts of a block in a field with a scale height of 80 to 300 m."""

    def steep(rng: Any) -> Air:
        value = float(np.exp(rng.uniform(np.log(3e-4), np.log(5e-3))))
        scale = float(np.exp(rng.uniform(np.log(80.0), np.log(300.0))))
        return Air("steep", lambda _: lambda __, up: value * np.exp(-(up - 500.0) / scale))

    return _own_counts(np.random.default_rng((75, cluster)), steep, (1e-3, 0.1))


def _curved_outliers(cluster: int) -> dict[str, float] | None:
    """Return the counts of a block with 0.5 to 4 percent of outlying bins in plumes and layers."""
    rng = np.random.default_rng((76, cluster))
    air = random_networks.plume if cluster % 2 else random_networks._thin_layer
    return _own_counts(rng, air, (1e-3, 0.1), outlying=float(rng.uniform(0.005, 0.04)))


def _own_counts(
    rng: Any, air: Any, noises: tuple[float, float], *, factor: Any = 1.0, outlying: float = 0.0
) -> dict[str, float] | None:
    net = random_networks.random_network(rng).network()
    if net.crossings < 2 or np.bincount(net.passages.beam).min() < 2:
        return None
    clean = signals(net, air(rng))
    noise = float(np.exp(rng.uniform(*np.log(noises))))
    power, variance = clean.draw(noise, PROFILES, int(rng.integers(2**31)), additive=noise / 3.0)
    mean = clean.power[np.arange(PROFILES) % len(clean.power)]
    power, variance = mean + factor * (power - mean), factor**2 * variance
    hit = rng.random(power.shape) < outlying
    power = power + hit * rng.uniform(5.0, 100.0, power.shape) * np.sqrt(variance)
    result = extinction_field.retrieve_network(
        power, clean.range, net, variance=variance, full_overlap_range=100.0
    )
    truth, near = clean.truth(PROFILES), net.near_crossing
    return _count(
        (result.extinction - truth)[:, near], result.extinction_standard_error[:, near],
        result.flagged[:, near], truth[:, near],
    )  # fmt: skip


OWN_SCENES = {
    RISING: _rising_noise, STEEP: _steep_field, CURVED: _curved_outliers
}  # fmt: skip


def _random_counts(clusters: range) -> Iterator[tuple[str, int, dict[str, float]]]:
    """Yield class, number of the network and counts of the random networks."""
    retrieve = extinction_field.retrieve_network
    results: list[Any] = []

    def record(*arguments: Any, **settings: Any) -> Any:
        results.append(retrieve(*arguments, **settings))
        return results[-1]

    for cluster in clusters:
        results.clear()
        with mock.patch.object(extinction_field, "retrieve_network", record):
            for scored, _ in random_networks.score_networks(cluster, PROFILES):
                near = results[-1].near_crossing
                error = scored.error[:, near]
                truth = results[-1].extinction[:, near] - error
                yield (
                    scored.failure.name, cluster,
                    _count(
                        error, np.asarray(scored.random)[:, near],
                        np.asarray(scored.bits)[:, near] != 0,
                        np.where(np.isfinite(truth), truth, 1.0),
                    ),
                )  # fmt: skip
        for name, count in OWN_SCENES.items():
            if not CHOSEN or name in CHOSEN:
                counts = count(cluster)
                if counts is not None:
                    yield name, cluster, counts


# Campaigns ------------------------------------------------------------------------------------


def _campaign_inputs(folder: Path) -> Iterator[tuple[Any, Any]]:
    """Yield arguments of the retrieval, and the truth, of campaigns from raw files."""
    airs = (network_campaigns.HOMOGENEOUS, network_campaigns.GRADIENT, network_campaigns.PLUME)
    for number, (air, six_beams, rate) in enumerate(
        (air, six_beams, rate) for rate in (4.0, 0.5) for air in airs for six_beams in (False, True)
    ):
        campaign, truth = network_campaigns.written(
            folder / str(number), network_campaigns.tree(air, six_beams=six_beams, rate=rate)
        )
        calls: list[tuple[tuple[Any, ...], xr.Dataset]] = []

        def record(
            *arguments: Any,
            retrieve: Callable[..., xr.Dataset] = labeled.retrieve_network,
            calls: list[tuple[tuple[Any, ...], xr.Dataset]] = calls,
        ) -> xr.Dataset:
            calls.append((arguments, retrieve(*arguments)))
            return calls[-1][1]

        with mock.patch.object(labeled, "retrieve_network", record):
            reprocess(
                campaign, selection=Selection(kinds=("visibility",)), options=Options(force=True)
            )
        for arguments, product in calls:
            names = [beam.instrument for beam in arguments[0]]
            yield arguments, network_campaigns.truth_at(product, truth, names)


def _campaign_counts(inputs: list[Any]) -> Iterator[tuple[str, int, dict[str, float]]]:
    for number, (arguments, truth) in enumerate(inputs):
        product = labeled.retrieve_network(*arguments)
        stated = np.hypot(
            product["total_extinction_standard_error"].to_numpy(),
            product["total_extinction_systematic_error"].to_numpy(),
        )
        flagged = (product["quality_flag"].to_numpy() & REJECTING) != 0
        away = product["total_extinction"].to_numpy() - truth
        yield CAMPAIGNS, number, _count(away, stated, flagged, truth)


def _of(classes: list[str]) -> Callable[..., Any]:
    """Return the solution of scenes that leaves out other classes."""
    solve_damaged = random_networks._solve_damaged
    chosen = [scene[1:] for scene in random_networks.FAILURES if scene[0].name in classes]

    def solve_some(rng: Any, draw_air: Any, damage: Any, profiles: int) -> Any:
        if classes and (draw_air, damage) not in chosen:
            return None
        return solve_damaged(rng, draw_air, damage, profiles)

    return solve_some


# Commands -------------------------------------------------------------------------------------


def solve(out: Path, names: list[str], clusters: int, classes: list[str]) -> None:
    """Write the counts of each variant to a file; of all classes and campaigns, or some classes."""
    out.mkdir(parents=True, exist_ok=True)
    CHOSEN[:] = classes
    inputs = []
    if not classes:
        with tempfile.TemporaryDirectory() as folder:
            inputs = list(_campaign_inputs(Path(folder)))
    for name in names:
        with ExitStack() as patches:
            patches.enter_context(
                mock.patch.object(random_networks, "_solve_damaged", _of(classes))
            )
            for owner, attribute, replacement in VARIANTS[name]:
                patches.enter_context(mock.patch.object(owner, attribute, replacement))
            counts = [*_random_counts(range(clusters)), *_campaign_counts(inputs)]
        (out / f"{name}.json").write_text(json.dumps(counts))


SHARES: dict[str, tuple[str, str]] = {
    "false": ("false", "kept"),
    "covered": ("covered", "kept"),
    "needless flags": ("needless", "values"),
    "values": ("kept", "values"),
}
"""Column -> numerator and denominator."""


def table(out: Path, marker: str) -> None:
    """Write the table of all variants in a folder into the page."""
    heads = ("guard switched off", "class", "networks", *SHARES)
    rows = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    reference = _read(out / f"{ALL}.json")
    names = [ALL, *sorted(path.stem for path in out.glob("*.json") if path.stem != ALL)]
    for name in names:
        changed = _read(out / f"{name}.json")
        classes = [None, OWN[name]] if name in OWN else [None]
        for of_class in (
            classes if name != ALL else [None, *dict.fromkeys(OWN.values()), CURVED, CAMPAIGNS]
        ):
            kept, all_kept = (
                {key: entry for key, entry in counts.items() if of_class in {None, key[0]}}
                for counts in (changed, reference)
            )
            # A table of one class only needs no row of all.
            if kept and (of_class or len({key[0] for key in kept}) > 1):
                rows.append(_row(name, of_class or "all", kept, all_kept))
    write_table(PAGE, marker, rows)


def _read(path: Path) -> dict[tuple[str, int], dict[str, float]]:
    return {(name, k): counts for name, k, counts in json.loads(path.read_text())}


def _sums(counts: Any, numerator: str, denominator: str) -> tuple[Any, Any]:
    """Return the sums of each network."""
    clusters = sorted({(name == CAMPAIGNS, k) for name, k in counts})
    above, below = dict.fromkeys(clusters, 0.0), dict.fromkeys(clusters, 0.0)
    for (name, k), entry in counts.items():
        above[name == CAMPAIGNS, k] += entry[numerator]
        below[name == CAMPAIGNS, k] += entry[denominator]
    return np.array(list(above.values())), np.array(list(below.values()))


def _share(counts: Any, numerator: str, denominator: str) -> tuple[float, float]:
    above, below = _sums(counts, numerator, denominator)
    share = above.sum() / below.sum()
    return share, np.sqrt(np.sum((above - share * below) ** 2)) / below.sum()


def _difference(changed: Any, reference: Any, *pair: str) -> tuple[float, float]:
    """Return the difference of shares, and its error from the differences of networks."""
    terms, shares = [], []
    for counts in (changed, reference):
        above, below = _sums(counts, *pair)
        shares.append(above.sum() / below.sum())
        terms.append((above - shares[-1] * below) / below.sum())
    return shares[0] - shares[1], float(np.sqrt(np.sum((terms[0] - terms[1]) ** 2)))


def _row(name: str, of_class: str, changed: Any, reference: Any) -> str:
    """Return shares of all guards, or differences from them."""
    cells = []
    for pair in SHARES.values():
        figures = (
            _share(reference, *pair) if name == ALL else _difference(changed, reference, *pair)
        )
        sign = "" if name == ALL else "+"
        cells.append(f"{100 * figures[0]:{sign}.2f} ± {100 * figures[1]:.2f}")
    campaigns = {key[0] for key in changed} == {CAMPAIGNS}
    networks = len({key[1] for key in changed if campaigns or key[0] != CAMPAIGNS})
    return f"| {name} | {of_class} | {networks} | {' | '.join(cells)} |"


def main() -> None:
    """Run a command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("command", choices=("solve", "table"))
    parser.add_argument("out", type=Path)
    parser.add_argument("marker", nargs="?", default="ablation")
    parser.add_argument("--only", nargs="+", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--classes", nargs="+", default=[])
    parser.add_argument("--clusters", type=int, default=40)
    arguments = parser.parse_args()
    if arguments.command == "table":
        table(arguments.out, arguments.marker)
    else:
        solve(arguments.out, arguments.only, arguments.clusters, arguments.classes)


if __name__ == "__main__":
    main()
