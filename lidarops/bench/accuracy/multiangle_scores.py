"""Accuracy of the optical depths and extinctions of scans, method by method."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import product
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.bench.accuracy import multiangle_cases as cases
from lidarops.bench.accuracy.homogeneous import SIGMAS
from lidarops.bench.accuracy.multiangle_cases import Array, Scan, ScanEstimates, ScanSolver, Scene
from lidarops.bench.harness.benchmark import Effort
from lidarops.bench.harness.rows import MonteCarloFigure
from lidarops.bench.harness.timing import Machine, machine
from lidarops.retrieve.multiangle.optical_depth import MultiAngleFlags, MultiAngleResult

Mask = npt.NDArray[np.bool_]

PUBLISHED_ANGLES: Final = (10.0, 15.0, 20.0, 30.0, 45.0, 60.0)
"""degree, the largest zenith angle."""
PUBLISHED_SHARES: Final = (0.2, 0.25, 0.3)
PUBLISHED_BEAMS: Final = (6, 4)
CENTRAL: Final = (6, 0.25)
"""Beams and largest error of backscatter of the experiment that is shown at all angles."""
TWO_ANGLE_ALONE: Final = "two_angle, 10 %"
NOTHING: Final = "answer 0"
PRIORS: Final = (0.0, 0.5, 1.0, 1.5)
CORRELATIONS: Final = (0.0, 0.5, 0.9, 0.99, 1.0)
OUTLIERS: Final = (0.0, 0.05, 0.1)
ANY: Final = "any air"
CALM: Final = "calm air"
LOW: Final = 2000.0
"""m, altitude up to which the error with outliers is scored separately."""
FALSE: Final = 4.0
"""Stated standard errors beyond which a value is false."""
_NEEDLESS: Final = 2.5
_CLOSE: Final = 0.5
_SCENE_PROFILES: Final = 8


@dataclass(frozen=True, slots=True)
class StudySize:
    """Numbers of simulated blocks, profiles and scenes."""

    blocks: int
    """Blocks of each scene, at least 2, independent except for the truth."""
    profiles: int
    """Profiles of a block."""
    slow: int
    """Profiles of a block for the peers."""
    published: int
    """Profiles of a block of the published experiment, which has at most 5 blocks."""
    random: int
    """Random scenes; a quarter of that number of calm scenes."""


QUICK: Final = StudySize(blocks=6, profiles=24, slow=1, published=100, random=150)
FULL: Final = StudySize(blocks=16, profiles=64, slow=2, published=250, random=3000)


@dataclass(frozen=True, slots=True)
class ScanScore:
    """Errors of one method in one scene, at the altitudes that kano_hamilton reaches."""

    method: str
    profiles: int
    nanoseconds: float
    """CPU time a profile."""
    solved: float
    """Share of these altitudes with a value of the method."""
    rmse: MonteCarloFigure
    """Of optical depth."""
    bias: MonteCarloFigure
    """Mean error of optical depth."""
    top_bias: MonteCarloFigure | None
    """Mean error at the highest altitude that all profiles reach; None if the method has no value
    there."""
    coverage: tuple[MonteCarloFigure, MonteCarloFigure] | None
    """Share of optical depths within 1 and 1.96 stated standard errors; None if the method states
    none."""
    extinction_rmse: MonteCarloFigure
    """m-1, of differences of optical depths, published or not."""
    extinction_coverage: tuple[MonteCarloFigure, MonteCarloFigure] | None
    """Of published values."""
    data_share: float | None
    """Median."""


@dataclass(frozen=True, slots=True)
class SceneScore:
    """Scores of the methods in one scene."""

    label: str
    profiles: int
    altitudes: int
    scores: tuple[ScanScore, ...]
    """Only of methods that have a value."""


@dataclass(frozen=True, slots=True)
class PublishedCloudScore:
    """Errors of one method in the published experiment, at the centres of 8 layers of a cloud."""

    method: str
    largest_angle: float
    """degree."""
    beams: int
    share: float
    """Largest error of backscatter over backscatter."""
    profiles: int
    rmse: MonteCarloFigure
    top_bias: MonteCarloFigure
    """Mean error at the highest altitude."""
    extinction_rmse: MonteCarloFigure
    """m-1."""
    negative: float
    """Share of optical depths below zero."""
    monotone: float
    """Share of profiles that nowhere decrease."""
    close: MonteCarloFigure
    """Share of profiles with a root mean square error below 0.5."""
    data_share: float | None
    """Median of the values."""
    freedom: float | None
    """Median degrees of freedom of an altitude."""


@dataclass(frozen=True, slots=True)
class PriorScore:
    """The published method with a prior that is a multiple of the truth."""

    factor: float
    alone: float
    """Root mean square error of the prior."""
    rmse: MonteCarloFigure
    data_share: float


@dataclass(frozen=True, slots=True)
class CorrelationScore:
    """Errors of one method where the scatter of neighbouring layers is correlated."""

    method: str
    correlation: float
    rmse: MonteCarloFigure
    close: MonteCarloFigure


@dataclass(frozen=True, slots=True)
class OutlierScore:
    """Errors of one method with outlying samples, in clear air."""

    method: str
    outliers: float
    low_rmse: MonteCarloFigure
    """Of optical depth, below 2 km."""
    rmse: MonteCarloFigure
    coverage: tuple[MonteCarloFigure, MonteCarloFigure]
    flagged: float
    """Share of values with the flag of outliers."""
    ran: float
    """Share of blocks for which the robust passes ran."""


@dataclass(frozen=True, slots=True)
class FlagShare:
    """Values with one flag."""

    flag: str
    values: float
    """Share of all values."""
    false: MonteCarloFigure | None
    """Share of these that are false; None where there are none."""


@dataclass(frozen=True, slots=True)
class SafetyScore:
    """Share of values off by more than 4 stated errors, in random scenes."""

    air: str
    """How the scatter was drawn."""
    method: str
    quantity: str
    scenes: int
    profiles: int
    values: int
    random_only: MonteCarloFigure
    """Share of values off by more than 4 random standard errors."""
    false: MonteCarloFigure
    """Share of values off by more than 4 of random error and gradient bound together."""
    false_ok: MonteCarloFigure
    """The same of the values without a flag that doubts the uncertainty."""
    false_ok_profiles: MonteCarloFigure
    """Share of profiles with such a value."""
    within: MonteCarloFigure
    """Share of unflagged values within 1.96 of random error and gradient bound together."""
    flagged: float
    """Share of values with such a flag."""
    needless: float
    """Share of values with such a flag, but within 2.5 of these errors."""
    flags: tuple[FlagShare, ...]


@dataclass(frozen=True, slots=True)
class MultiAngle:
    """The accuracy benchmark of scans."""

    date: str
    machine: Machine
    scenes: tuple[SceneScore, ...]
    published: tuple[PublishedCloudScore, ...]
    priors: tuple[PriorScore, ...]
    correlations: tuple[CorrelationScore, ...]
    outliers: tuple[OutlierScore, ...]
    safety: tuple[SafetyScore, ...]


def measure_multiangle(effort: Effort, *, size: StudySize | None = None) -> MultiAngle:
    """Score optical depth and extinction of simulated scans for every method and the peers.

    Parameters
    ----------
    effort : Effort
    size : StudySize, optional
        Numbers of blocks, profiles and scenes.
    """
    size = size or (QUICK if effort.quick else FULL)
    compared = []
    for number, scene in enumerate(cases.scan_scenes()):
        compared.append(_compare(scene, size, number))
        effort.progress(1)
    published = tuple(_published(size))
    effort.progress(1)
    priors, correlations = tuple(_priors(size)), tuple(_correlations(size))
    effort.progress(1)
    outliers = tuple(score for share in OUTLIERS for score in _outliers(share, size))
    effort.progress(1)
    safety = tuple(_safety(size))
    effort.progress(1)
    return MultiAngle(
        effort.date, machine(), tuple(compared), published, priors, correlations, outliers, safety
    )


# Statistics of blocks -------------------------------------------------------------------------

BlockMeans = dict[str, float]
"""Means over one block, by name; NaN where there is nothing to average."""


def _mean(values: Mask | Array) -> float:
    finite = np.asarray(values, dtype=np.float64)[np.isfinite(values)]
    return float(finite.mean()) if finite.size else float("nan")


def over_blocks(means: Sequence[float]) -> MonteCarloFigure:
    """Return the mean of independent blocks with its Monte Carlo error."""
    finite = np.array(means)[np.isfinite(means)]
    error = float(finite.std(ddof=1) / np.sqrt(finite.size)) if finite.size > 1 else 0.0
    return MonteCarloFigure(float(finite.mean()), error)


def root(square: MonteCarloFigure) -> MonteCarloFigure:
    """Return the square root of a mean of squares."""
    value = float(np.sqrt(square.value))
    return MonteCarloFigure(value, square.error / (2.0 * value) if value > 0 else 0.0)


def ratio(events: Array, trials: Array) -> MonteCarloFigure:
    """Return a share with the Monte Carlo error of independent clusters.

    Parameters
    ----------
    events, trials : (cluster,) float
        Counts.
    """
    total = float(trials.sum())
    if total == 0.0:
        return MonteCarloFigure(0.0, 0.0)
    value = float(events.sum()) / total
    error = float(np.sqrt(np.sum((events - value * trials) ** 2))) / total
    # Without any event the error would be zero; one event is assumed then.
    return MonteCarloFigure(value, max(error, 1.0 / total))


def _has_any(blocks: Sequence[BlockMeans], name: str) -> bool:
    return any(np.isfinite(means[name]) for means in blocks)


def _coverage(
    blocks: Sequence[BlockMeans], name: str
) -> tuple[MonteCarloFigure, MonteCarloFigure] | None:
    if not _has_any(blocks, f"{name}0"):
        return None
    low, high = (over_blocks([means[f"{name}{k}"] for means in blocks]) for k in range(2))
    return low, high


def _share_within(error: Array, stated: Array | None, sigmas: float) -> float:
    if stated is None:
        return float("nan")
    known = np.isfinite(error) & np.isfinite(stated)
    return _mean((np.abs(error) <= sigmas * stated)[known])


def _differences(depth: Array, altitude: Array) -> Array:
    return np.asarray(np.diff(depth, axis=1, prepend=0.0) / np.diff(altitude, prepend=0.0))


# All methods in four scenes -------------------------------------------------------------------


def _compare(scene: Scene, size: StudySize, number: int) -> SceneScore:
    scans = [scene.draw(size.profiles, number, block) for block in range(size.blocks)]
    within = [
        np.isfinite(cases.retrieve(scan, cases.KANO_HAMILTON).optical_depth) for scan in scans
    ]
    ours = [_score(name, solver, scans, within) for name, solver in cases.scan_methods().items()]
    few = [scan.first(size.slow) for scan in scans]
    others = [_score(name, solver, few, within) for name, solver in cases.scan_peers().items()]
    profiles = size.blocks * size.profiles
    scores = tuple(score for score in (*ours, *others) if score is not None)
    return SceneScore(scene.label, profiles, scene.altitude.size, scores)


def _score(
    name: str, solver: ScanSolver, scans: Sequence[Scan], within: Sequence[Mask]
) -> ScanScore | None:
    solver(scans[0].first(1))
    blocks, times, shares = [], [], []
    for scan, reached in zip(scans, within, strict=True):
        begin = time.process_time()
        estimates = solver(scan)
        times.append((time.process_time() - begin) / len(scan.signal))
        mask = reached[: len(scan.signal)]
        blocks.append(_block_means(estimates, scan.scene, mask))
        if estimates.data_share is not None:
            shares.append(estimates.data_share[mask])
    if not _has_any(blocks, "extinction_square"):
        return None
    share = float(np.nanmedian(np.concatenate(shares))) if shares else None
    return ScanScore(
        method=name,
        profiles=sum(len(scan.signal) for scan in scans),
        nanoseconds=1e9 * float(np.median(times)),
        solved=over_blocks([means["solved"] for means in blocks]).value,
        rmse=root(over_blocks([means["square"] for means in blocks])),
        bias=over_blocks([means["error"] for means in blocks]),
        top_bias=over_blocks([means["top"] for means in blocks])
        if _has_any(blocks, "top")
        else None,
        coverage=_coverage(blocks, "within"),
        extinction_rmse=root(over_blocks([means["extinction_square"] for means in blocks])),
        extinction_coverage=_coverage(blocks, "extinction_within"),
        data_share=share,
    )


def _block_means(estimates: ScanEstimates, scene: Scene, mask: Mask) -> BlockMeans:
    """Return means over the altitudes of one block within the mask."""
    error = np.where(mask, estimates.optical_depth - scene.optical_depth, np.nan)
    slope = _differences(estimates.optical_depth, scene.altitude) - scene.extinction
    top = max(int(mask.all(axis=0).sum()) - 1, 0)
    published = estimates.extinction
    wrong = np.full(mask.shape, np.nan)
    if published is not None:
        wrong = np.where(mask, published - scene.extinction, np.nan)
    means = {
        "solved": _mean(np.isfinite(error)[mask]),
        "square": _mean(error**2),
        "error": _mean(error),
        "top": _mean(error[:, top]),
        "extinction_square": _mean(np.where(mask, slope, np.nan) ** 2),
    }
    for k, sigmas in enumerate(SIGMAS):
        means[f"within{k}"] = _share_within(error, estimates.standard_error, sigmas)
        means[f"extinction_within{k}"] = _share_within(
            wrong, estimates.extinction_standard_error, sigmas
        )
    return means


# The published experiment ---------------------------------------------------------------------


def _published(size: StudySize) -> Iterator[PublishedCloudScore]:
    every = set(product((15.0, 30.0), PUBLISHED_BEAMS, PUBLISHED_SHARES))
    every |= {(angle, *CENTRAL) for angle in PUBLISHED_ANGLES}
    for number, (angle, beams, share) in enumerate(sorted(every)):
        scene = cases.published_cloud(angle, beams, cases.uniform_deviation(share))
        scans = [
            cases.uniform_scatter(share, size.published, scene, number, block, 1)
            for block in range(_published_blocks(size))
        ]
        gaussian = cases.published_cloud(angle, beams, 0.1)
        noisy = [
            gaussian.draw(size.published, number, block, 2)
            for block in range(_published_blocks(size))
        ]
        yield _published_score(NOTHING, _nothing, scans, share)
        yield _published_score(TWO_ANGLE_ALONE, cases.scan_methods()[cases.TWO_ANGLE], noisy, share)
        for name, solver in cases.scan_methods().items():
            yield _published_score(name, solver, scans, share)


def _published_blocks(size: StudySize) -> int:
    return min(5, size.blocks)


def _nothing(scan: Scan) -> ScanEstimates:
    return ScanEstimates(np.zeros((len(scan.signal), scan.scene.altitude.size)))


def _published_score(
    name: str, solver: ScanSolver, scans: Sequence[Scan], share: float
) -> PublishedCloudScore:
    scene = scans[0].scene
    blocks = [solver(scan) for scan in scans]
    depth = np.concatenate([estimates.optical_depth for estimates in blocks])
    means = [
        _block_means(estimates, scene, np.ones(estimates.optical_depth.shape, np.bool_))
        for estimates in blocks
    ]
    return PublishedCloudScore(
        method=name,
        largest_angle=float(scene.zenith_angle.max()),
        beams=scene.zenith_angle.size,
        share=share,
        profiles=len(depth),
        rmse=root(over_blocks([block["square"] for block in means])),
        top_bias=over_blocks([block["top"] for block in means]),
        extinction_rmse=root(over_blocks([block["extinction_square"] for block in means])),
        negative=float(np.mean(depth < 0.0)),
        monotone=float(np.mean(np.all(np.diff(depth, axis=1, prepend=0.0) >= 0.0, axis=1))),
        close=over_blocks([_close(estimates.optical_depth, scene) for estimates in blocks]),
        data_share=_median([estimates.data_share for estimates in blocks]),
        freedom=_median([estimates.freedom for estimates in blocks], over=scene.altitude.size),
    )


def _median(arrays: Sequence[Array | None], over: int = 1) -> float | None:
    known = [array.ravel() for array in arrays if array is not None]
    return float(np.nanmedian(np.concatenate(known))) / over if known else None


def _close(depth: Array, scene: Scene) -> float:
    rms = np.sqrt(np.mean((depth - scene.optical_depth) ** 2, axis=1))
    return float(np.mean(rms < _CLOSE))


def _priors(size: StudySize) -> Iterator[PriorScore]:
    share = CENTRAL[1]
    scene = cases.published_cloud(15.0, CENTRAL[0], cases.uniform_deviation(share))
    truth = scene.optical_depth
    blocks = range(_published_blocks(size))
    scans = [cases.uniform_scatter(share, size.published, scene, block, 3) for block in blocks]
    for factor in PRIORS:
        results = [cases.with_prior(scan, factor * truth) for scan in scans]
        errors = [_mean((result.optical_depth - truth) ** 2) for result in results]
        data = _median([result.data_share for result in results]) or 0.0
        alone = abs(factor - 1.0) * float(np.sqrt(np.mean(truth**2)))
        yield PriorScore(factor, alone, root(over_blocks(errors)), data)


def _correlations(size: StudySize) -> Iterator[CorrelationScore]:
    scene = cases.published_cloud(15.0, CENTRAL[0], cases.uniform_deviation(CENTRAL[1]))
    for number, correlation in enumerate(CORRELATIONS):
        scans = []
        for block in range(_published_blocks(size)):
            rng = np.random.default_rng((number, block, 4))
            shape = (size.published, scene.path.size, scene.altitude.size)
            air = scene.inhomogeneity * cases.correlated(rng, shape, correlation)
            scans.append(scene.observe(air, rng))
        for name in (cases.KANO_HAMILTON, "mld 0, discrepancy", cases.MLD_PRIOR, cases.JOINT):
            depths = [cases.scan_methods()[name](scan).optical_depth for scan in scans]
            squares = [_mean((depth - scene.optical_depth) ** 2) for depth in depths]
            close = over_blocks([_close(depth, scene) for depth in depths])
            yield CorrelationScore(name, correlation, root(over_blocks(squares)), close)


# Outliers -------------------------------------------------------------------------------------


def _outliers(share: float, size: StudySize) -> Iterator[OutlierScore]:
    scene = cases.clear(3000.0, outliers=share)
    scans = [scene.draw(size.profiles, round(100 * share), k, 5) for k in range(size.blocks)]
    low = scene.altitude < LOW
    for method, robust in product((cases.KANO_HAMILTON, cases.JOINT), (False, True)):
        results = [cases.retrieve(scan, method, robust=robust) for scan in scans]
        errors = [result.optical_depth - scene.optical_depth for result in results]
        stated = [result.optical_depth_standard_error for result in results]
        pairs = list(zip(errors, stated, strict=True))
        inside = [over_blocks([_share_within(e, s, n) for e, s in pairs]) for n in SIGMAS]
        yield OutlierScore(
            method=f"{method}, {'robust' if robust else 'plain'}",
            outliers=share,
            low_rmse=root(over_blocks([_mean(error[:, low] ** 2) for error in errors])),
            rmse=root(over_blocks([_mean(error**2) for error in errors])),
            coverage=(inside[0], inside[1]),
            flagged=over_blocks([_mean(result.flags.outlier) for result in results]).value,
            ran=float(np.mean([_robust_passes_ran(result) for result in results])),
        )


def _robust_passes_ran(result: MultiAngleResult) -> bool:
    return any(step.ran and step.step == "robust_passes" for step in result.steps)


# Random scenes --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _SceneCounts:
    """Counts of one quantity of one random scene."""

    counts: Mapping[str, float]
    by_flag: Mapping[str, tuple[float, float]]
    """Number of values with the flag, and of false ones among these."""


def _safety(size: StudySize) -> Iterator[SafetyScore]:
    groups: dict[tuple[str, str, str], list[_SceneCounts]] = {}
    for calm, count in ((False, size.random), (True, -(-size.random // 4))):
        for seed in range(count):
            scene = cases.random_scene(seed, _SCENE_PROFILES, calm=calm)
            scan = scene.draw(_SCENE_PROFILES, seed, 6)
            for method in (cases.KANO_HAMILTON, cases.JOINT):
                result = cases.retrieve(scan, method)
                for quantity, counts in _count_errors(result, scene).items():
                    kind = (CALM if calm else ANY, method, quantity)
                    groups.setdefault(kind, []).append(counts)
    yield from (_safety_score(kind, scenes) for kind, scenes in groups.items())


def _count_errors(result: MultiAngleResult, scene: Scene) -> dict[str, _SceneCounts]:
    return {
        "optical depth": _counts(
            result.optical_depth - scene.optical_depth,
            result.optical_depth_standard_error,
            result.optical_depth_gradient_error,
            result.flags,
        ),
        "extinction": _counts(
            result.extinction - scene.extinction,
            result.extinction_standard_error,
            result.extinction_gradient_error,
            result.flags,
        ),
    }


def _counts(error: Array, random: Array, bound: Array, flags: MultiAngleFlags) -> _SceneCounts:
    size, doubted, stated = np.abs(error), flags.doubtful(), np.hypot(random, bound)
    valued = np.isfinite(error)
    # A value without a stated error counts as false.
    false = valued & ~(size <= FALSE * stated)
    unflagged = valued & ~doubted
    masks = {
        "values": valued,
        "random_only": valued & ~(size <= FALSE * random),
        "false": false,
        "unflagged": unflagged,
        "false_ok": false & unflagged,
        "within": unflagged & (size <= SIGMAS[1] * stated),
        "needless": valued & doubted & (size <= _NEEDLESS * stated),
    }
    counts = {name: float(mask.sum()) for name, mask in masks.items()}
    counts["profiles"] = float(valued.any(axis=1).sum())
    counts["false_ok_profiles"] = float((false & unflagged).any(axis=1).sum())
    by_flag = {}
    for field in fields(flags):
        raised = valued & getattr(flags, field.name)
        by_flag[field.name] = (float(raised.sum()), float((raised & false).sum()))
    return _SceneCounts(counts, by_flag)


def _safety_score(kind: tuple[str, str, str], scenes: Sequence[_SceneCounts]) -> SafetyScore:
    counts = {name: np.array([scene.counts[name] for scene in scenes]) for name in scenes[0].counts}
    values = counts["values"]
    return SafetyScore(
        *kind,
        scenes=len(scenes),
        profiles=int(counts["profiles"].sum()),
        values=int(values.sum()),
        random_only=ratio(counts["random_only"], values),
        false=ratio(counts["false"], values),
        false_ok=ratio(counts["false_ok"], counts["unflagged"]),
        false_ok_profiles=ratio(counts["false_ok_profiles"], counts["profiles"]),
        within=ratio(counts["within"], counts["unflagged"]),
        flagged=ratio(values - counts["unflagged"], values).value,
        needless=ratio(counts["needless"], values).value,
        flags=tuple(_flag_share(name, scenes, values) for name in scenes[0].by_flag),
    )


def _flag_share(name: str, scenes: Sequence[_SceneCounts], values: Array) -> FlagShare:
    raised, false = np.array([scene.by_flag[name] for scene in scenes]).T
    share = ratio(false, raised) if raised.sum() else None
    return FlagShare(name, ratio(raised, values).value, share)
