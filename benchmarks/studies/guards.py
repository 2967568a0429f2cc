"""Rates of false and lost values with each guard of a retrieval switched off in turn.

``python -m benchmarks.studies.guards RETRIEVAL`` writes the table into the page of the retrieval; a
number of clusters may follow. All variants see the same random scenes, those of ``benchmarks
stability``, so that the error of a difference is that of pairs: a jackknife over clusters, which
share a geometry.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Final, NamedTuple
from unittest import mock

import numpy as np
import pandas as pd

from benchmarks.harness import rates
from benchmarks.harness.figure import Array, Random, log_uniform
from benchmarks.harness.rates import Failure, ScoredValues
from benchmarks.scenes import elastic_skies, homogeneous_paths, lidar_networks, scans
from benchmarks.scenes.lidar_networks import Air
from lidarops.flags import FlagBit, Quality
from lidarops.retrieve.air import reference_window
from lidarops.retrieve.air.reference_window import Rejection
from lidarops.retrieve.clouds import layers
from lidarops.retrieve.clouds import outlying_bins as outliers_of_skies
from lidarops.retrieve.elastic import inversion
from lidarops.retrieve.elastic.flags import ElasticQuality
from lidarops.retrieve.homogeneous import _fit_quality, path_fit
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS
from lidarops.retrieve.multiangle import _calibration, _smoothing, optical_depth, smooth_profile
from lidarops.retrieve.multiangle.flags import MultiAngleQuality
from lidarops.retrieve.network import _beam_signals, _block_solution, _changing_field, outlying_bins

PAGES: Final = Path(__file__).resolve().parents[2] / "docs/algorithms"
"""Of the tables."""
BASE: Final = "all guards"
RATES: Final[dict[str, tuple[str, str, tuple[bool, ...]]]] = {
    "false, model holds": ("false plain", "plain", (True,)),
    "false, model violated": ("false plain", "plain", (False,)),
    "false, no bit": ("false bare", "bare", (True, False)),
    "covered, model holds": ("plain covered", "plain", (True,)),
    "covered, model violated": ("plain covered", "plain", (False,)),
    "needless": ("solvable rejected", "solvable", (True,)),
    "lost, model holds": ("lost", "scored", (True,)),
    "lost, model violated": ("lost", "scored", (False,)),
}
"""Rate -> numerator, denominator, and whether the model holds. `false`: beyond 4 stated errors
though not rejected, or though no bit is raised, whether it rejects or not. `covered`: within 1.96
stated errors.
`needless`: flagged or withheld though determinable. `lost`: flagged or withheld."""

Context = Callable[[], AbstractContextManager[object]]
ScoreCluster = Callable[[int], Iterable[ScoredValues]]
Patch = tuple[Any, str, Any]
"""Owner, name of its attribute, and what stands there instead."""


@dataclass(frozen=True)
class Guard:
    """One guard, and how it is switched off."""

    name: str
    bits: int = 0
    """Bits of which the values are freed."""
    off: Context | None = None
    """Context without the guard, in which the scenes are retrieved anew."""


@contextmanager
def replaced(*patches: Patch) -> Iterator[None]:
    """Replace attributes of modules."""
    with ExitStack() as stack:
        for owner, name, value in patches:
            stack.enter_context(mock.patch.object(owner, name, value))
        yield


def without(name: str, *patches: Patch) -> Guard:
    """Return the guard that these replacements switch off."""
    return Guard(name, off=lambda: replaced(*patches))


def with_thresholds(name: str, module: Any, table: str = "THRESHOLDS", **changes: Any) -> Guard:
    """Return the guard that other values of thresholds that a module reads switch off."""
    return without(name, (module, table, getattr(module, table)._replace(**changes)))


def measure(score: ScoreCluster, clusters: Sequence[int], guards: Sequence[Guard]) -> pd.DataFrame:
    """Return counts by guard, quantity, class and cluster."""
    contexts: list[tuple[Context, list[Guard]]] = [
        (nullcontext, [Guard(BASE), *(guard for guard in guards if guard.off is None)]),
        *((guard.off, [guard]) for guard in guards if guard.off is not None),
    ]
    rows: list[dict[str, Any]] = []
    for context, variants in contexts:
        # Outside the loop over clusters: some contexts compile.
        with context():
            for cluster in clusters:
                for values in score(cluster):
                    rows += [
                        rates.counts(_without_bits(values, guard.bits))
                        | {"guard": guard.name, "cluster": cluster}
                        for guard in variants
                    ]
    counted = pd.DataFrame(rows).drop(columns="sizes")
    return counted.groupby(["guard", *rates.KEYS], sort=False).sum()


def _without_bits(values: ScoredValues, bits: int) -> ScoredValues:
    freed = (np.asarray(values.bits) & bits) != 0
    uncertain = None if values.uncertain is None else values.uncertain & ~freed
    return replace(values, bits=values.bits & ~np.int32(bits), uncertain=uncertain)


def table(counts: pd.DataFrame) -> Iterator[str]:
    """Yield the lines of a Markdown table: rates with all guards, then changes without each."""
    yield "| guard off | value | " + " | ".join(RATES) + " | moves |"
    yield "| --- | --- |" + " --- |" * (len(RATES) + 1)
    places = ["guard", "quantity", "cluster"]
    every = counts.groupby(places, sort=False).sum()
    sides: dict[tuple[Any, ...], pd.DataFrame] = {}
    for holds in {rate[2] for rate in RATES.values()}:
        side = counts[counts.index.isin(holds, level="satisfied")].groupby(places, sort=False).sum()
        side = side.reindex(every.index, fill_value=0.0)
        sides |= {(holds, *key): own for key, own in side.groupby(places[:2], sort=False)}
    names = [every.index.unique(level) for level in places[:2]]
    for guard, quantity in product(*names):
        if ((True,), guard, quantity) not in sides:
            continue
        cells, moves = [], []
        for name, (events, trials, holds) in RATES.items():
            (value, left), (of_base, base_left) = (
                _jackknife(*sides[holds, of, quantity][[events, trials]].to_numpy().T)
                for of in (guard, BASE)
            )
            if guard != BASE:
                value, left = value - of_base, left - base_left
            scatter = np.sum((left - left.mean()) ** 2)
            error = np.sqrt((left.size - 1) / left.size * scatter)
            if guard != BASE and abs(value) > 2.0 * error:
                moves.append(name)
            sign = "" if guard == BASE else "+"
            cells.append(f"{100 * value:{sign}.4f} ± {100 * error:.4f}")
        yield f"| {guard} | {quantity} | " + " | ".join(cells) + f" | {', '.join(moves)} |"


def _jackknife(events: Array, trials: Array) -> tuple[float, Array]:
    """Return a rate, and the rates without each of the clusters."""
    others = (events.sum() - events) / np.maximum(trials.sum() - trials, 1.0)
    return float(events.sum() / max(trials.sum(), 1.0)), others


def write_guards(
    page: str, score: ScoreCluster, clusters: int, guards: Sequence[Guard], mark: str = "guards"
) -> None:
    """Write the table of guards into a page, between two marks of that name."""
    file = PAGES / page
    before, begin, rest = file.read_text(encoding="utf-8").partition(f"<!-- {mark} -->\n")
    _, end, after = rest.partition(f"<!-- end of {mark} -->")
    if not (begin and end):
        raise ValueError(f"{file} has no marks of the name {mark!r}")
    lines = (f"{line}\n" for line in table(measure(score, range(clusters), guards)))
    file.write_text("".join((before, begin, *lines, end, after)), "utf-8")


def _bits(*flags: FlagBit) -> list[Guard]:
    return [Guard(flag.name or "", int(flag)) for flag in flags]


# Homogeneous paths ----------------------------------------------------------------------------

_LIMITS: Final = _fit_quality._limits
_FIT: Final = path_fit.fit_homogeneous_path


def _no_widening(*arguments: Any, **options: Any) -> Any:
    limits = _LIMITS(*arguments, **options)
    return limits._replace(widening=np.ones_like(limits.widening))


def _no_bend(power: Any, range_: Any, **options: Any) -> Any:
    """Return a fit without the part of the model errors by a signal that bends."""
    fit = _FIT(power, range_, **options)
    slope = THRESHOLDS.model_error * (np.abs(fit.extinction) + 1.0 / np.mean(range_))
    none = np.zeros_like(fit.background)
    return replace(fit, extinction_model_error=slope, background_model_error=none)


_UNSURE: Final = int(Quality.LOW_SIGNAL | HomogeneousQuality.POORLY_DETERMINED)
_OF_PATHS: Final = (
    *_bits(Quality.NEGATIVE_AMPLITUDE, Quality.LOW_SIGNAL, HomogeneousQuality.POORLY_DETERMINED),
    Guard("both of these", _UNSURE),
    *_bits(HomogeneousQuality.AT_BOUND, HomogeneousQuality.POOR_FIT, Quality.NOT_HOMOGENEOUS),
    *_bits(Quality.OUTLIER),
    without("widening of estimated noise", (_fit_quality, "_limits", _no_widening)),
    without("bend in the model error", (path_fit, "fit_homogeneous_path", _no_bend)),
)


def _score_paths(cluster: int, *, bins: tuple[int, int]) -> Iterator[ScoredValues]:
    with replaced((homogeneous_paths, "RANDOM_BINS", bins)):
        yield from homogeneous_paths.score_homogeneous(cluster, 60)


# Elastic inversion ----------------------------------------------------------------------------

_FIND: Final = layers.find_layers


def _same(power: Any, range_: Any, variance: Any, **_: Any) -> Any:
    noise = np.broadcast_to(variance, np.shape(power))
    return outliers_of_skies.BridgedProfiles(power, noise, np.zeros(np.shape(power), np.bool_))


def _no_layers(*arguments: Any, **options: Any) -> Any:
    return np.zeros_like(_FIND(*arguments, **options))


@contextmanager
def _without_rejection(bit: Rejection) -> Iterator[None]:
    """Skip one test of the reference windows."""
    tests, pick = reference_window._rejections, reference_window._pick

    def fewer_tests(*arguments: Any) -> Any:
        return tests(*arguments) & ~np.int32(bit)

    def any_passing(statistics: Any, rejections: Any, level_error: Any, noise: Any) -> Any:
        kept = rejections.copy()
        index, *_ = pick(statistics, kept, level_error, noise)
        none = np.zeros(index.size)
        precision = np.where(rejections == 0, statistics[..., reference_window.SCALE_ERROR], np.inf)
        return np.where(index >= 0, np.argmin(precision, axis=-1), -1), none, none

    changes = [(reference_window, "_rejections", fewer_tests)]
    if bit is Rejection.MORE_PARTICLES:
        changes.append((reference_window, "_pick", any_passing))
    with replaced(*changes):
        yield


_NO_ERROR: Final = property(lambda window: np.zeros_like(window.scale))
_OF_SKIES: Final = (
    *_bits(ElasticQuality.CLOUD, ElasticQuality.NEGATIVE_BACKSCATTER),
    without("cloud detection", (layers, "find_layers", _no_layers)),
    *(
        Guard(f"window: {bit.name}", off=partial(_without_rejection, bit))
        for bit in Rejection
        if bit is not Rejection.EXCLUDED
    ),
    without("error by undetected particles",
            (reference_window.ReferenceWindow, "undetected_particles", _NO_ERROR)),
    with_thresholds("least certainty", inversion, "COMMON", first_order=0.0),
    with_thresholds("skewed errors", inversion, skewed=0.0),
    with_thresholds("longest gap", inversion, longest_gap=np.inf),
    without("bridging of outliers", (outliers_of_skies, "bridge_outliers", _same)),
)  # fmt: skip


# Scans ----------------------------------------------------------------------------------------

_CHOOSE: Final = _smoothing.choose_smoothing
_OF_SCANS: Final = (
    *_bits(MultiAngleQuality.NO_RESIDUAL, MultiAngleQuality.INTERPOLATED),
    without("gradients that residuals show", (optical_depth, "visible_gradient", lambda *_: 0.0)),
    without("path variation", (optical_depth, "path_variation_from", lambda *_: None)),
    without("few residuals: inflation",
            (smooth_profile, "inflation", lambda noise: np.ones(noise.freedom.size))),
    without("Cp beside the likelihood",
            (_smoothing, "choose_smoothing", lambda scores, *, one: _CHOOSE(
                scores._replace(risk=np.zeros_like(scores.risk)), one=one))),
    without("calibration",
            (smooth_profile, "Calibration", lambda sandwich, inflation, _, scale:
                _calibration.Calibration(sandwich, inflation, None, scale))),
    without("calibration: scale of profiles",
            (smooth_profile, "relative_squares", lambda depth, *_: np.ones(len(depth)))),
    with_thresholds("calibration: least scale", _calibration, least_scale=0.0),
    without("correlation", (optical_depth, "correlation_of_air", lambda *_: 0.0)),
)  # fmt: skip


# Networks -------------------------------------------------------------------------------------

_BLOCK: Final = 50
"""Profiles of a random network."""
_OF_NETWORKS: Final = (
    with_thresholds("stratified air", _changing_field, stratified=(0.1, 400.0)),
    with_thresholds("changes in time", _changing_field, "COMMON", significant=1e15),
    with_thresholds("running means", _block_solution, linear_change=1e30),
    with_thresholds("profiles that disagree", _block_solution, least_neighbourly=0.0),
    with_thresholds("default overlap error", _block_solution, default_overlap_error=0.0),
    with_thresholds("curvature errors", _block_solution, "COMMON", significant=1e15),
    without("outlying bins", (outlying_bins, "search", lambda *_: None)),
    with_thresholds("weak signals", _beam_signals, largest_bin_error=1e6),
    with_thresholds("noisy profiles", _beam_signals, noisy_profile=1e30),
)


def _score_networks(cluster: int) -> Iterator[ScoredValues]:
    """Yield the values of a random network by class, then those of the other scenes.

    Blocks in which noise rises, steep fields, and outliers in curved air: each has its own rows.
    """
    yield from lidar_networks.score_networks(cluster, _BLOCK)
    rising, steep, curved = (np.random.default_rng((seed, cluster)) for seed in (74, 75, 76))
    # By a factor of 5, as at dawn.
    dawn = np.where(np.arange(_BLOCK) < rising.integers(10, 40), 1.0, 5.0)[:, None, None]
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
    power, variance = clean.draw(noise, _BLOCK, int(rng.integers(2**31)), additive=noise / 3.0)
    mean = clean.power[np.arange(_BLOCK) % len(clean.power)]
    power, variance = mean + factor * (power - mean), factor**2 * variance
    hit = rng.random(power.shape) < outlying
    power = power + hit * rng.uniform(5.0, 100.0, power.shape) * np.sqrt(variance)
    result = lidar_networks.solve(power, variance, clean)
    values = lidar_networks.scored(Failure(name), result, clean.truth(_BLOCK), 0.0)
    yield replace(values, quantity=name)


class Study(NamedTuple):
    """One table."""

    mark: str
    """Its mark in the page of the retrieval."""
    score: ScoreCluster
    clusters: int
    guards: tuple[Guard, ...]


STUDIES: Final = {
    "elastic": [
        Study("guards", partial(elastic_skies.score_elastic, profiles=10), 60, _OF_SKIES)
    ],
    "homogeneous": [
        Study("guards", partial(_score_paths, bins=(8, 800)), 150, _OF_PATHS),
        # Of which it withholds all.
        Study("guards of 4 to 7 bins", partial(_score_paths, bins=(4, 7)), 150,
              tuple(_bits(Quality.TOO_FEW_BINS))),
    ],
    "multiangle": [Study("guards", partial(scans.score_scans, profiles=8), 50, _OF_SCANS)],
    "network": [Study("guards", _score_networks, 20, _OF_NETWORKS)],
}  # fmt: skip
"""Tables by the name of the page."""

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("retrieval", choices=STUDIES)
    parser.add_argument("clusters", nargs="?", type=int)
    given = parser.parse_args()
    for study in STUDIES[given.retrieval]:
        clusters = given.clusters or study.clusters
        write_guards(f"{given.retrieval}.md", study.score, clusters, study.guards, study.mark)
