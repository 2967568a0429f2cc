"""Rates of false, covered and needlessly flagged values in conditions of their own.

In the root of a checkout::

    python tests/studies/intervals.py [--only NAME ...]

writes ``docs/results/intervals.json``: each figure with its Monte Carlo error, from independently
drawn geometries. Figures that are not named keep their values.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
import types
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, NamedTuple
from unittest import mock

import numpy as np

from lidarops.bench.accuracy import multiangle_cases
from lidarops.bench.accuracy.network_cases import signals
from lidarops.bench.harness.statistics import clustered_share
from lidarops.bench.stability import random_homogeneous, random_networks
from lidarops.bench.stability.random_scenes import COVERED, FALSE
from lidarops.flags import Quality, rejecting
from lidarops.retrieve.homogeneous import _compressed, path_fit
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.network import extinction_field, labeled
from lidarops.retrieve.signal import counts_to_signal
from lidarops.retrieve.signal.noise_correlation import estimate_noise_correlation

RESULT: Final = Path(__file__).resolve().parents[2] / "docs/results/intervals.json"
REJECTED: Final = np.int32(rejecting((*Quality, *HomogeneousQuality)))
DECIDED: Final = {
    "LOW_SIGNAL": np.int32(Quality.LOW_SIGNAL),
    "NEGATIVE_AMPLITUDE": np.int32(Quality.NEGATIVE_AMPLITUDE),
}
NEAR_THE_CUT: Final = 0.10
"""Relative error of extinction, below the limit of 0.15 of POORLY_DETERMINED."""


class Part(NamedTuple):
    """Events among trials in one cluster."""

    figure: str
    events: float
    trials: float


Parts = Iterator[Part]


def _errors(name: str, error: Any, stated: Any, kept: Any) -> Parts:
    """Yield the false and the covered values among those that are kept."""
    size = np.abs(error[kept]) / stated[kept]
    yield Part(f"{name}: false", float(np.count_nonzero(~(size <= FALSE))), size.size)
    yield Part(f"{name}: covered", float(np.count_nonzero(size <= COVERED)), size.size)


# Networks -------------------------------------------------------------------------------------


def network_blocks(cluster: int, *, profiles: int, air: str) -> Parts:
    """Yield the errors of a network that is solved in short blocks."""
    rng = np.random.default_rng((81, cluster))
    noise = float(np.exp(rng.uniform(np.log(1e-3), np.log(0.3))))
    net = random_networks._random_network(rng).network()
    if net.crossings < 2 or np.bincount(net.passages.beam).min() < 2:
        return
    clean = signals(net, getattr(random_networks, f"_{air}")(rng))
    power, variance = clean.draw(noise, 6, int(rng.integers(2**31)))
    result = extinction_field.retrieve_network(
        power, clean.range, net, variance=variance, full_overlap_range=100.0,
        blocks=np.arange(6) // profiles,
    )  # fmt: skip
    error = result.extinction - clean.truth(6)
    kept = np.isfinite(error) & ~result.flags.flagged & result.near_crossing
    name = f"network, {air}, blocks of {profiles}"
    yield from _errors(name, error, result.extinction_standard_error, kept)


def varying_lidar_ratio(cluster: int, *, amount: float) -> Parts:
    """Yield the errors of a network in air whose lidar ratio varies by an rms amount."""
    rng = np.random.default_rng((86, cluster))
    noise = float(np.exp(rng.uniform(np.log(1e-3), np.log(0.3))))
    net = random_networks._random_network(rng).network()
    if net.crossings < 2 or np.bincount(net.passages.beam).min() < 2:
        return
    clean = signals(net, random_networks._plume(rng))
    wave = 2.0 * np.pi / np.exp(rng.uniform(np.log(300.0), np.log(3000.0), 2))
    # A wave of random length and direction across the plane of the beams.
    at = net.origin[:, :, np.newaxis] + net.direction[:, :, np.newaxis] * clean.range
    phase = wave[0] * at[:, 0] + wave[1] * at[:, 2] + rng.uniform(0.0, 2.0 * np.pi)
    ratio = np.exp(amount * np.sqrt(2.0) * np.sin(phase))
    power, variance = replace(clean, power=clean.power / ratio).draw(
        noise, 6, int(rng.integers(2**31))
    )
    solver = _solver(net, clean.range, power, variance)
    result = solver.solve(power)
    error = result.extinction - clean.truth(6)
    kept = np.isfinite(error) & ~result.flags.flagged & result.near_crossing
    of_ratio = labeled._lidar_ratio_error(solver, result, 1.0)
    for words, declared in (
        ("not declared", 0.0), ("2 % declared, the default", 0.02), ("declared", amount)
    ):  # fmt: skip
        stated = np.hypot(result.extinction_standard_error, declared * of_ratio)
        name = f"network, lidar ratio varies by {100 * amount:g} %, {words}"
        yield from _errors(name, error, stated, kept)


def _solver(net: Any, distance: Any, power: Any, variance: Any) -> labeled._Solver:
    """Return the solver of products, for its systematic errors."""
    signals = SimpleNamespace(
        power=power, variance=variance, overlap=None,
        range=np.broadcast_to(distance, (net.beams, distance.size)),
    )  # fmt: skip
    beams = [
        SimpleNamespace(exponent=1.0, instrument=beam, nearest=100.0) for beam in range(net.beams)
    ]
    settings = SimpleNamespace(prior="block", multiplier=None, block_intervals=len(power))
    intervals = np.arange(len(power))
    return labeled._Solver(beams, net, settings, signals, intervals)  # type: ignore[arg-type]


# Homogeneous paths ----------------------------------------------------------------------------


def _fitted(paths: Any, noise: Any, **options: Any) -> tuple[Any, Any]:
    """Return the fit of paths with unit noise, and whether its values are kept."""
    fit = path_fit.fit_homogeneous_path(
        paths.background + paths.clean + noise, paths.range, **{"variance": 1.0, **options}
    )
    return fit, np.isfinite(fit.extinction) & ((fit.quality & REJECTED) == 0)


def correlated_noise(cluster: int, *, correlation: float) -> Parts:
    """Yield the errors with noise of stated variance whose bins are correlated."""
    paths, rng = random_homogeneous.random_paths(cluster, 60)
    shape = (60, paths.range.size)
    noise = multiangle_cases.correlated(rng, shape, correlation)
    length = (1.0 + correlation) / (1.0 - correlation)
    # As products measure it, in the far half of profiles of a recorder with the same noise.
    recorded = multiangle_cases.correlated(rng, (60, 4000), correlation)
    measured = estimate_noise_correlation(recorded, np.ones_like(recorded)).length
    for name, options in (
        ("length unknown", {}),
        ("length stated", {"noise_correlation_length": length}),
        ("length estimated", {"noise_correlation_length": measured}),
    ):
        fit, kept = _fitted(paths, noise, **options)
        error = fit.extinction - paths.extinction[:, 0]
        label = f"AR(1) {correlation:g}, {name}"
        yield from _errors(label, error, fit.extinction_standard_error, kept)


def near_the_cut(cluster: int) -> Parts:
    """Yield the errors of backgrounds near the limit of POORLY_DETERMINED."""
    paths, rng = random_homogeneous.random_paths(cluster, 1000)
    with np.errstate(under="ignore"):
        fit, kept = _fitted(paths, rng.standard_normal((1000, paths.range.size)))
    scale = fit.extinction + 1.0 / float(paths.range.mean())
    with np.errstate(invalid="ignore", divide="ignore"):
        kept &= fit.extinction_standard_error / scale > NEAR_THE_CUT
    error = fit.background - paths.background[:, 0]
    yield from _errors("background near the cut", error, fit.background_standard_error, kept)


def short_sections(cluster: int) -> Parts:
    """Yield the errors of extinction of sections of 8 to 32 bins."""
    paths, rng = random_homogeneous.random_paths(cluster, 300)
    bins = int(rng.integers(8, 33))
    paths = replace(paths, range=paths.range[0] + 37.5 * np.arange(bins))
    noise = rng.standard_normal((300, bins))
    for name, variance in (("stated", 1.0), ("estimated", None)):
        with np.errstate(under="ignore"):
            fit, kept = _fitted(paths, noise, variance=variance)
        error = fit.extinction - paths.extinction[:, 0]
        label = f"8 to 32 bins, noise {name}"
        yield from _errors(label, error, fit.extinction_standard_error, kept)


def dying_signal(cluster: int) -> Parts:
    """Yield the errors where the signal falls by a factor of 10 to 1e6 from bin to bin."""
    paths, rng = random_homogeneous.random_paths(cluster, 300)
    extinction = np.log(10.0) * rng.uniform(1.0, 6.0, (300, 1)) / 75.0
    paths = replace(paths, range=100.0 + 37.5 * np.arange(40), extinction=extinction)
    with np.errstate(under="ignore"):
        fit, kept = _fitted(paths, rng.standard_normal((300, 40)))
    yield Part("signal that dies within a bin: accepted", float(np.count_nonzero(kept)), 300)
    error = fit.extinction - extinction[:, 0]
    name = "signal that dies within a bin"
    yield from _errors(name, error, fit.extinction_standard_error, kept)


def few_counts(cluster: int, *, counts: float) -> Parts:
    """Yield how many profiles of few photon counts are flagged although the model holds."""
    rng = np.random.default_rng((82, cluster))
    distance = 2500.0 + 37.5 * np.arange(225)
    signal = float(np.exp(rng.uniform(np.log(3.0), np.log(100.0))))
    fall = (distance[0] / distance) ** 2 * np.exp(-2e-4 * (distance - distance[0]))
    mean = counts * (1.0 + signal * fall)
    drawn = rng.poisson(mean, (100, mean.size)).astype(float)
    for name, exposure in (("normal limits", None), ("Poisson limits", 1.0)):
        fit = path_fit.fit_homogeneous_path(drawn, distance, variance=mean, exposure=exposure)
        for bit in (Quality.OUTLIER, HomogeneousQuality.POOR_FIT):
            flagged = np.count_nonzero(fit.quality & np.int32(bit))
            yield Part(f"{counts:g} counts a bin, {name}: {bit.name}", flagged, 100)


def deciding_bits(cluster: int) -> Parts:
    """Yield how often a bit alone rejects a value, and how many of these are false."""
    for values, _ in random_homogeneous.score_homogeneous(cluster, 200):
        yield from _alone("fitted", values.quantity, values.error, np.hypot(
            values.random, values.systematic), values.bits)  # fmt: skip
    paths, rng = random_homogeneous.random_paths(cluster, 200)
    noise = rng.standard_normal((200, paths.range.size))
    given = {
        "known_extinction": {"extinction": np.minimum(
            paths.extinction[:, 0], 100.0 / (paths.range[-1] - paths.range[0]))},
        "known_background": {"background": paths.background[:, 0]},
    }  # fmt: skip
    for method, options in given.items():
        with np.errstate(under="ignore"):
            fit, _ = _fitted(paths, noise, method=method, **options)
        truth = paths.extinction[:, 0]
        error, stated = fit.extinction - truth, fit.extinction_standard_error
        if method == "known_extinction":
            error, stated = fit.background - paths.background[:, 0], fit.background_standard_error
        yield from _alone(method, "value", error, stated, fit.quality)


def _alone(method: str, quantity: str, error: Any, stated: Any, bits: Any) -> Parts:
    valued = np.isfinite(error)
    for name, bit in DECIDED.items():
        alone = valued & ((bits & REJECTED) == bit)
        yield Part(f"{method} {quantity}: {name} alone", alone.sum(), valued.sum())


# Digitisers -----------------------------------------------------------------------------------


def quiet_digitiser(cluster: int, *, noise: float) -> Parts:
    """Yield the errors of single bins in a steep near range with noise of a fraction of a step."""
    rng = np.random.default_rng((83, cluster))
    shots = int(np.exp(rng.uniform(np.log(20.0), np.log(300.0))))
    distance = 7.5 * (np.arange(400) + 0.5)
    fall = (300.0 / np.maximum(distance, 300.0)) ** 2
    level = float(rng.uniform(20.0, 60.0)) + float(rng.uniform(500.0, 3500.0)) * fall
    total = np.zeros((5, distance.size))
    for _ in range(shots):
        total += np.rint(level + noise * rng.standard_normal(total.shape, dtype=np.float32))
    signal = counts_to_signal.analog_signal(
        total.astype(np.int32), np.full(5, shots), distance, adc_bits=12,
        input_range=np.full(5, 0.5),
    )  # fmt: skip
    error = np.asarray(signal.power - level * 500.0 / 2**12, dtype=float)
    stated = np.sqrt(np.asarray(signal.variance, dtype=float))
    steep = np.broadcast_to((distance > 320.0) & (distance < 1200.0), error.shape)
    far = np.broadcast_to(distance > 1500.0, error.shape)
    for name, bins in (("steep", steep), ("flat", far)):
        yield from _errors(f"digitiser, noise {noise:g} steps, {name} bins", error, stated, bins)


# Scans ----------------------------------------------------------------------------------------


def single_counts(cluster: int) -> Parts:
    """Yield the errors of scans of photon counts, whose variance is stated in two ways."""
    rng = np.random.default_rng((84, cluster))
    angles = np.degrees(np.arccos(1.0 / np.linspace(1.0, 3.0, 9)))
    altitude = 150.0 + 30.0 * np.arange(60)
    depth = np.cumsum(np.full(altitude.size, 30.0 * float(rng.uniform(2e-5, 2e-4))))
    depth += depth[0] * 4.0
    distance = altitude / np.cos(np.radians(angles))[:, np.newaxis]
    path = distance / altitude
    bright = float(np.exp(rng.uniform(np.log(3e6), np.log(3e8))))
    air = 0.02 * rng.standard_normal((8, *distance.shape))
    mean = bright / distance**2 * np.exp(-2.0 * path * depth + air)
    counts = rng.poisson(mean).astype(float)
    # Rates smoothed over 10 % of range, as `photon_signal` has them.
    smooth = np.apply_along_axis(_smoothed, -1, counts, altitude)
    for name, variance in (("single counts", counts), ("smoothed counts", smooth)):
        result = multiangle_cases.retrieve_optical_depth(
            counts * distance**2, angles, altitude, variance=variance * distance**4
        )
        error = result.optical_depth - depth
        kept = np.isfinite(error) & ~result.flags.doubtful()
        kept &= (result.quality & np.int32(rejecting(Quality))) == 0
        yield from _errors(
            f"scan, variance from {name}", error, result.optical_depth_standard_error, kept
        )


def _smoothed(counts: Any, altitude: Any) -> Any:
    low = np.searchsorted(altitude, 0.9 * altitude)
    high = np.searchsorted(altitude, 1.1 * altitude, side="right")
    sums = np.concatenate([[0.0], np.cumsum(counts)])
    return np.maximum(sums[high] - sums[low], 1.0) / (high - low)


# Order, machine and time ----------------------------------------------------------------------


def profile_order(cluster: int) -> Iterator[tuple[str, float]]:
    """Yield the change of values when the profiles of a block are exchanged, in stated errors."""
    scene = multiangle_cases.random_scene(cluster, 8)
    scan = scene.draw(8, cluster, 85)
    order = np.random.default_rng((85, cluster)).permutation(8)
    shuffled = multiangle_cases.Scan(scene, scan.signal[order], scan.variance[order])
    first, second = (multiangle_cases.retrieve(s, "auto") for s in (scan, shuffled))
    change = np.abs(first.optical_depth[order] - second.optical_depth)
    yield "scan, order of profiles", _largest(change / second.optical_depth_standard_error)
    rng = np.random.default_rng((73, cluster))
    net = random_networks._random_network(rng).network()
    if net.crossings < 2 or np.bincount(net.passages.beam).min() < 2:
        return
    clean = signals(net, random_networks._layered(rng))
    power, variance = clean.draw(0.03, 8, cluster)
    one, two = (
        extinction_field.retrieve_network(
            power[o], clean.range, net, variance=variance[o], full_overlap_range=100.0
        )
        for o in (np.arange(8), order)
    )
    change = np.abs(one.extinction[order] - two.extinction)
    yield "network, order of profiles", _largest(change / two.extinction_standard_error)


def _largest(values: Any) -> float:
    return float(np.max(values[np.isfinite(values)], initial=0.0))


def kernel_values(clusters: int) -> list[list[float]]:
    """Return extinctions of networks and their errors, without those that are flagged."""
    values: list[list[float]] = []
    for cluster in range(clusters):
        for scored, _ in random_networks.score_networks(cluster, 4):
            kept = np.where(scored.bits == 0, scored.error, np.nan)
            columns = (kept, np.broadcast_to(scored.random, kept.shape))
            values += np.stack([column.ravel() for column in columns], axis=1).tolist()
    return values


def _kernels(clusters: int) -> dict[str, float]:
    results = []
    for kernel in ("Haswell", "Prescott"):
        text = subprocess.run(
            [sys.executable, __file__, "--kernel-values", str(clusters)],
            env={**os.environ, "OPENBLAS_CORETYPE": kernel, "OPENBLAS_NUM_THREADS": "1"},
            check=True, capture_output=True, text=True,
        ).stdout  # fmt: skip
        results.append(np.array(json.loads(text)))
    change = np.abs(results[0][:, 0] - results[1][:, 0]) / results[0][:, 1]
    return {"network, kernel of linear algebra": _largest(change)}


def second_pass(repeats: int) -> dict[str, float]:
    """Return the share of the time of the compressed solver for its residuals."""
    source = Path(_compressed.__file__).read_text(encoding="utf-8")
    call = "    _take_residuals(block, s, not mode.known_variance)\n"
    assert call in source, "the call of the second pass"
    module = types.ModuleType("compressed_variant")
    sys.modules[module.__name__] = module
    text = source.replace(call, "").replace("cache=True", "cache=False")
    exec(compile(text, "<variant>", "exec"), module.__dict__)
    return {"second pass": _ratio(module, repeats)}


def _ratio(module: Any, repeats: int) -> float:
    distance = 2500.0 + 37.5 * np.arange(225)
    fall = 1e9 / distance**2 * np.exp(-6e-5 * distance)
    rng = np.random.default_rng(0)
    power = (300.0 + fall + rng.standard_normal((4000, 225))).astype(np.float32)
    times: dict[str, list[float]] = {"all": [], "without": []}
    whole = _compressed.solve_compressed
    for _ in range(repeats):
        for name, solve in (
            ("all", whole), ("without", module.solve_compressed)
        ):  # fmt: skip
            with mock.patch.object(_compressed, "solve_compressed", solve):
                begin = time.process_time()
                path_fit.fit_homogeneous_path(power, distance, variance=1.0)
                times[name].append(time.process_time() - begin)
    return 1.0 - min(times["without"][1:]) / min(times["all"][1:])


# Commands -------------------------------------------------------------------------------------

RATES: Final[dict[str, tuple[int, tuple[Callable[[int], Parts], ...]]]] = {
    "networks of single profiles": (
        1500,
        (partial(network_blocks, profiles=1, air="plume"),),
    ),
    "short blocks of networks": (
        200,
        tuple(
            partial(network_blocks, profiles=n, air=air)
            for air, n in (("plume", 2), ("plume", 3), ("homogeneous", 1))
        ),
    ),
    "single profiles in layered air": (
        800,
        (partial(network_blocks, profiles=1, air="layered"),),
    ),
    "varying lidar ratio": (150, (partial(varying_lidar_ratio, amount=0.1),)),
    "correlated noise": (150, tuple(partial(correlated_noise, correlation=r) for r in (0.6, 0.9))),
    "near the cut": (400, (near_the_cut,)),
    "short sections": (150, (short_sections,)),
    "dying signal": (60, (dying_signal,)),
    "few counts": (60, tuple(partial(few_counts, counts=n) for n in (1.0, 0.3, 0.1, 0.02))),
    "deciding bits": (60, (deciding_bits,)),
    "digitisers": (60, tuple(partial(quiet_digitiser, noise=n) for n in (0.05, 0.1, 0.2))),
    "single counts": (120, (single_counts,)),
}
"""Group of figures: number of clusters, and what is drawn."""


def rates(group: str) -> dict[str, Any]:
    """Return the shares of a group, with their Monte Carlo errors and numbers of trials."""
    clusters, draws = RATES[group]
    counts: dict[str, list[tuple[float, float]]] = {}
    for draw in draws:
        for cluster in range(clusters):
            for part in draw(cluster):
                counts.setdefault(part.figure, []).append((part.events, part.trials))
    figures = {}
    for name, pairs in counts.items():
        events, trials = (np.array(column, dtype=float) for column in zip(*pairs, strict=True))
        share = clustered_share(events, trials)
        figures[name] = {
            "value": float(f"{share.value:.4g}"),
            "error": float(f"{share.error:.2g}"),
            "values": int(trials.sum()),
        }
    return figures


def largest_changes(clusters: int) -> dict[str, Any]:
    """Return the largest changes by the order of profiles."""
    changes: dict[str, float] = {}
    for cluster in range(clusters):
        for name, change in profile_order(cluster):
            changes[name] = max(change, changes.get(name, 0.0))
    return _plain(changes)


def _plain(numbers: dict[str, float]) -> dict[str, Any]:
    return {name: {"value": float(f"{value:.2g}")} for name, value in numbers.items()}


GROUPS: Final[dict[str, Callable[[], dict[str, Any]]]] = {
    **{group: partial(rates, group) for group in RATES},
    "order": lambda: largest_changes(60),
    "kernels": lambda: _plain(_kernels(20)),
    "second pass": lambda: _plain(second_pass(30)),
}


def main() -> None:
    """Measure some groups of figures, or all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", default=list(GROUPS), choices=list(GROUPS))
    parser.add_argument("--kernel-values", type=int, default=0, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.kernel_values:
        sys.stdout.write(json.dumps(kernel_values(arguments.kernel_values)))
        return
    for group in arguments.only:
        begin = time.process_time()
        figures = GROUPS[group]()
        results = json.loads(RESULT.read_text(encoding="utf-8")) if RESULT.exists() else {}
        results[group] = {
            "CPU seconds": round(time.process_time() - begin, 1),
            "figures": figures,
        }
        ordered = {name: results[name] for name in GROUPS if name in results}
        RESULT.write_text(json.dumps(ordered, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
