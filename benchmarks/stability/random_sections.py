"""Homogeneous paths with correlated noise, few bins, or hardly determined values."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np

from benchmarks.accuracy.multiangle_cases import correlated
from benchmarks.harness.figure import Array
from benchmarks.stability.random_homogeneous import Paths, random_paths
from benchmarks.stability.random_scenes import Failure, ScoredValues
from lidarops.retrieve.homogeneous import path_fit
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.signal.noise_correlation import estimate_noise_correlation

_CORRELATIONS: Final = (0.6, 0.9)
"""Between neighbouring bins."""
_RECORDED: Final = 4000
"""Bins in the far half of a recorder's profiles, in which products measure the correlation."""
_NEAR_THE_CUT: Final = 0.10
"""Relative error of extinction, below the limit of 0.15 of POORLY_DETERMINED."""
_BINS: Final = ((8, 10), (11, 15), (16, 23), (24, 32))
"""Least and most bins of short sections."""
_STEP: Final = 37.5
"""m."""
_FALLS: Final = (1.0, 6.0)
"""Decades by which a signal falls from bin to bin."""
_UNKNOWN: Final = (
    "noise whose bins are correlated looks like less noise: without the length of the correlation,"
    " the stated errors are too small"
)


def _fitted(paths: Paths, noise: Array, **options: Any) -> Any:
    """Return the fit of paths with unit noise."""
    with np.errstate(under="ignore"):
        power = paths.background + paths.clean + noise
        return path_fit.fit_homogeneous_path(power, paths.range, **{"variance": 1.0, **options})


def _scored(failure: Failure, quantity: str, paths: Paths, fit: Any) -> ScoredValues:
    error = getattr(fit, quantity) - getattr(paths, quantity)[:, 0]
    return ScoredValues(
        failure, quantity, error,
        getattr(fit, f"{quantity}_standard_error"), getattr(fit, f"{quantity}_model_error"),
        np.asarray(fit.quality), HomogeneousQuality,
    )  # fmt: skip


def score_correlated_noise(cluster: int, profiles: int) -> Iterator[tuple[ScoredValues, int]]:
    """Yield extinctions with noise that is correlated between bins."""
    for correlation in _CORRELATIONS:
        paths, rng = random_paths(cluster, profiles)
        noise = correlated(rng, (profiles, paths.range.size), correlation)
        recorded = correlated(rng, (profiles, _RECORDED), correlation)
        estimated = estimate_noise_correlation(recorded, np.ones_like(recorded)).length
        length = (1.0 + correlation) / (1.0 - correlation)
        for words, options in (
            ("not stated", {}),
            ("stated", {"noise_correlation_length": length}),
            ("estimated, as in products", {"noise_correlation_length": estimated}),
        ):
            failure = Failure(
                f"AR(1) {correlation:g}, correlation {words}", satisfied=bool(options),
                unseen="" if options else _UNKNOWN,
            )  # fmt: skip
            yield _scored(failure, "extinction", paths, _fitted(paths, noise, **options)), profiles


def score_near_the_cut(cluster: int, profiles: int) -> Iterator[tuple[ScoredValues, int]]:
    """Yield backgrounds of paths whose extinction is nearly too uncertain to be accepted."""
    paths, rng = random_paths(cluster, profiles)
    fit = _fitted(paths, rng.standard_normal((profiles, paths.range.size)))
    scale = fit.extinction + 1.0 / float(paths.range.mean())
    with np.errstate(invalid="ignore", divide="ignore"):
        near = fit.extinction_standard_error / scale > _NEAR_THE_CUT
    values = _scored(
        Failure("near the limit of POORLY_DETERMINED", satisfied=True), "background", paths, fit
    )
    yield replace(values, error=np.where(near, values.error, np.nan)), profiles


def score_short_sections(cluster: int, profiles: int) -> Iterator[tuple[ScoredValues, int]]:
    """Yield extinctions and backgrounds of sections of 8 to 32 bins."""
    for least, most in _BINS:
        paths, rng = random_paths(cluster, profiles)
        bins = int(rng.integers(least, most + 1))
        paths = replace(paths, range=paths.range[0] + _STEP * np.arange(bins, dtype=np.float64))
        noise = rng.standard_normal((profiles, bins))
        for words, variance in (("stated", 1.0), ("estimated", None)):
            failure = Failure(f"{least} to {most} bins, noise {words}", satisfied=True)
            fit = _fitted(paths, noise, variance=variance)
            yield _scored(failure, "extinction", paths, fit), profiles
            yield _scored(failure, "background", paths, fit), profiles


def score_dying_signals(cluster: int, profiles: int) -> Iterator[tuple[ScoredValues, int]]:
    """Yield extinctions where the signal falls by a factor of 10 to 1e6 from bin to bin."""
    paths, rng = random_paths(cluster, profiles)
    decades = rng.uniform(*_FALLS, (profiles, 1))
    paths = replace(
        paths, range=100.0 + _STEP * np.arange(40, dtype=np.float64),
        extinction=np.log(10.0) * decades / (2.0 * _STEP),
    )  # fmt: skip
    fit = _fitted(paths, rng.standard_normal((profiles, 40)))
    yield (
        _scored(Failure("signal that dies within a bin", satisfied=True), "extinction", paths, fit),
        profiles,
    )
