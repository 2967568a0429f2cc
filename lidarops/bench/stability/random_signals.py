"""Random raw counts, and recorders that are not as assumed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final

import numpy as np

from lidarops.bench.accuracy import elastic_cases
from lidarops.bench.stability.random_scenes import VISIBLE, Failure, Judged
from lidarops.bench.stability.stiff_cases import Array
from lidarops.bench.stability.stiff_signals import RANGE
from lidarops.flags import Quality
from lidarops.retrieve.background import cubic_and_tail, known_shape
from lidarops.retrieve.signal import counts_to_signal
from lidarops.simulate import counting

Random = np.random.Generator

_BINS: Final = 400
_BIN_WIDTH: Final = 7.5
_BIN_TIME: Final = 50e-9
_DEAD_TIME: Final = 4e-9
_BITS: Final = 12
_STEP: Final = 500.0 / 2**_BITS
"""mV."""
_MEAN_OF: Final = slice(100, 300)
"""Bins whose mean is judged: single ones hold too few counts for Gaussian errors."""

Found = tuple[str, Array, Array, Any, Any]
"""Quantity, error, its random standard error, whether the violation is hidden (None where that is
not known), bits."""


def _logarithmic(rng: Random, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _mean(found: counts_to_signal.Signal, truth: float, quantity: str) -> Found:
    """Return the error of the mean of the bins that are to be used, with a bit for the rest."""
    part = found.power[:, _MEAN_OF]
    good = np.isfinite(part)
    count = good.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.where(good, part, 0.0).sum(axis=1) / count - truth
        variance = np.where(good, found.variance[:, _MEAN_OF], 0.0).sum(axis=1) / count**2
    bits = np.bitwise_or.reduce(found.quality[:, _MEAN_OF], axis=1)
    return quantity, error, np.sqrt(variance), None, bits


def _bin(found: counts_to_signal.Signal, truth: float, quantity: str) -> Found:
    """Judge the middle bin of each profile."""
    k = _BINS // 2
    error = np.asarray(found.power[:, k] - truth, dtype=np.float64)
    stated = np.sqrt(np.asarray(found.variance[:, k], dtype=np.float64))
    return f"{quantity} of a bin", error, stated, None, found.quality[:, k]


def _counts(rng: Random, rate: float, dead_time: float, shots: int, profiles: int, *,
            paralyzable: bool = False) -> Any:  # fmt: skip
    mean, variance = counting.counter_moments(
        np.full(_BINS, rate), bin_time=_BIN_TIME, dead_time=dead_time, paralyzable=paralyzable
    )
    if rate * dead_time * 1e6 < 1e-3:
        return rng.poisson(shots * mean, (profiles, _BINS)).astype(np.int32)
    noise = rng.standard_normal((profiles, _BINS)) * np.sqrt(shots * variance)
    return np.maximum(np.rint(shots * mean + noise), 0.0).astype(np.int32)


def _photon(rng: Random, profiles: int, *, off: float = 0.0, paralyzable: bool = False) -> Found:
    rate, shots = _logarithmic(rng, 1e-2, 300.0), int(_logarithmic(rng, 50.0, 1e4))
    dead_time = _DEAD_TIME * (1.0 + off * rng.normal())
    counts = _counts(rng, rate, dead_time, shots, profiles, paralyzable=paralyzable)
    found = counts_to_signal.photon_signal(
        counts, np.full(profiles, shots), RANGE[:_BINS], bin_width=_BIN_WIDTH,
        dead_time=_DEAD_TIME,
    )  # fmt: skip
    return _mean(found, rate, "count rate")


def _analog(
    rng: Random,
    profiles: int,
    *,
    noises: tuple[float, float],
    levels: tuple[float, float],
    taken: Callable[[counts_to_signal.Signal, float, str], Found] = _mean,
) -> Found:
    shots = int(_logarithmic(rng, 20.0, 300.0))
    level, noise = _logarithmic(rng, *levels), _logarithmic(rng, *noises)
    total = np.zeros((profiles, _BINS))
    for _ in range(shots):
        sampled = np.rint(level + noise * rng.standard_normal(total.shape, dtype=np.float32))
        total += np.clip(sampled, 0.0, 2**_BITS - 1)
    found = counts_to_signal.analog_signal(
        total.astype(np.int32), np.full(profiles, shots), RANGE[:_BINS], adc_bits=_BITS,
        input_range=np.full(profiles, 0.5),
    )  # fmt: skip
    return taken(found, level * _STEP, "voltage")


def _far(
    rng: Random, profiles: int
) -> tuple[elastic_cases.SimulatedSky, Array, Array, Array, float]:
    """Return the far range of profiles above a background: mean, counts and their variance."""
    sky = elastic_cases.simulated_sky()
    level = _logarithmic(rng, 1.0, 1e8)
    scale = _logarithmic(rng, 1e-3, 10.0)
    mean = elastic_cases.SHOTS * (scale * sky.signal + level)
    counts = rng.poisson(np.broadcast_to(mean, (profiles, mean.size))) / elastic_cases.SHOTS
    variance = np.maximum(counts.mean(axis=0), 1e-3) / elastic_cases.SHOTS
    clean = np.asarray(mean / elastic_cases.SHOTS)
    return sky, clean, np.asarray(counts), np.asarray(variance), level


def _known_shape(rng: Random, profiles: int, *, haze: float = 0.0) -> Found:
    sky, clean, counts, variance, level = _far(rng, profiles)
    added = haze * rng.uniform(0.2, 1.0) * np.exp(-sky.range / 3000.0)
    shape = sky.shape * (1.0 + added)
    found = known_shape.fit_known_shape(counts, sky.range, shape, variance=variance)
    bits = found.quality | np.where(
        found.singular, np.int32(Quality.POORLY_DETERMINED), np.int32(0)
    )
    hidden = None
    if haze:
        # What the window that was chosen shows of the wrong shape without noise.
        rows = np.broadcast_to(clean, counts.shape)
        left = known_shape.fit_known_shape(
            rows, sky.range, shape, variance=variance, start=found.start, stop=found.stop
        )
        hidden = np.sqrt(left.chi2) < VISIBLE
    error = found.background - level
    return "background, known shape", error, found.background_standard_error, hidden, bits


def _tail(rng: Random, profiles: int) -> Found:
    sky, _, counts, variance, level = _far(rng, profiles)
    found = cubic_and_tail.tail_mean(counts, sky.range, variance=variance)
    error = found.background - level
    return (
        "background, mean of the tail",
        error,
        found.background_standard_error,
        None,
        found.quality,
    )


def _cubic(rng: Random, profiles: int) -> Found:
    from_range = RANGE[300:700]
    extinction, amount = _logarithmic(rng, 1e-6, 3e-3), _logarithmic(rng, 1e-1, 1e5)
    level = _logarithmic(rng, 1.0, 1e6)
    fall = np.exp(-2.0 * extinction * (from_range - from_range[0]))
    model = level + amount * (from_range[0] / from_range) ** 2 * fall
    power = model + rng.standard_normal((profiles, from_range.size))
    found = cubic_and_tail.cubic(power, from_range, variance=1.0)
    error = found.background - level
    return "background, cubic", error, found.background_standard_error, None, found.quality


_LEFT: Final = (
    "what is left of the signal in the tail is part of its mean, and the mean alone does not tell"
)
_NOT_DECLARED: Final = "a wrong dead time bends the scale and leaves no trace in one profile"
_ONE_VALUE: Final = "two rates give the same counts"
_WHOLE_STEPS: Final = (
    "where the noise is less than a step, all shots and bins round to the same side: the stated"
    " error of a bin covers it, but the mean of bins does not err less"
)
FAILURES: Final[tuple[tuple[Failure, Callable[[Random, int], Found]], ...]] = (
    (Failure("none, photon counting", satisfied=True), _photon),
    (Failure("dead time off by 10 %", unseen=_NOT_DECLARED), partial(_photon, off=0.1)),
    (Failure("paralyzable counter", unseen=_ONE_VALUE), partial(_photon, paralyzable=True)),
    (
        Failure("none, analog", satisfied=True),
        partial(_analog, noises=(0.5, 30.0), levels=(100.0, 3500.0)),
    ),
    (
        Failure("analog noise below half a step", unseen=_WHOLE_STEPS),
        partial(_analog, noises=(0.02, 0.5), levels=(100.0, 3500.0)),
    ),
    (
        Failure("analog near full scale"),
        partial(_analog, noises=(0.5, 30.0), levels=(3900.0, 4200.0)),
    ),
    (Failure("none, known shape", satisfied=True), _known_shape),
    (Failure("shape of hazy air"), partial(_known_shape, haze=3.0)),
    (Failure("mean of a tail with signal in it", unseen=_LEFT), _tail),
    (Failure("none, cubic", satisfied=True), _cubic),
    (
        Failure("analog noise below half a step, a single bin"),
        partial(_analog, noises=(0.02, 0.5), levels=(100.0, 3500.0), taken=_bin),
    ),
)


def judge_signals(cluster: int, profiles: int) -> Iterator[tuple[Judged, int]]:
    """Process random counts, class by class."""
    for number, (failure, process) in enumerate(FAILURES):
        rng = np.random.default_rng((75, cluster, number))
        quantity, error, random, hidden, bits = process(rng, profiles)
        could = np.isfinite(error) if failure.satisfied and "cubic" not in failure.name else None
        yield (
            Judged(
                failure, quantity, error, random, 0.0, np.asarray(bits), solvable=could,
                hidden=hidden,
            ),
            profiles,
        )  # fmt: skip
