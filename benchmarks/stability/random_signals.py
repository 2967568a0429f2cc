"""Random raw counts, and recorders that violate the model of the signal chain."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final

import numpy as np

from benchmarks.accuracy import elastic_cases
from benchmarks.harness.figure import Array, Random
from benchmarks.stability.random_scenes import Failure, ScoredValues, held_first
from lidarops.flags import Quality
from lidarops.retrieve.background import cubic_and_tail, estimate, known_shape
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.signal import counts_to_signal
from lidarops.simulate import counting

_BINS: Final = 400
_BIN_WIDTH: Final = 7.5
_RANGE: Final = _BIN_WIDTH * (np.arange(700, dtype=np.float64) + 0.5)
_BIN_TIME: Final = 50e-9
_DEAD_TIME: Final = 4e-9
_BITS: Final = 12
_STEP: Final = 500.0 / 2**_BITS
"""mV."""
_PER_MEGAHERTZ_SQUARED: Final = 1e6
"""Rates are in MHz and dead times in s."""
_MEAN_OF: Final = slice(100, 300)
"""Bins whose mean is scored: single bins hold too few counts for Gaussian errors."""


Errors = dict[str, Any]
"""Errors of the values of some profiles: the fields of `ScoredValues` that depend on them."""


def _logarithmic(rng: Random, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _mean(signal: counts_to_signal.Signal, truth: float, quantity: str) -> Errors:
    """Return the error of the mean of the usable bins, with the bits of all bins."""
    power = signal.power[:, _MEAN_OF]
    valid = np.isfinite(power)
    count = valid.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.where(valid, power, 0.0).sum(axis=1) / count - truth
        variance = np.where(valid, signal.variance[:, _MEAN_OF], 0.0).sum(axis=1) / count**2
    bits = np.bitwise_or.reduce(signal.quality[:, _MEAN_OF], axis=1)
    return Errors(quantity=quantity, error=error, random=np.sqrt(variance), bits=bits)


def _bin(signal: counts_to_signal.Signal, truth: float, quantity: str) -> Errors:
    """Return the error of the middle bin of each profile."""
    k = _BINS // 2
    error = np.asarray(signal.power[:, k] - truth, dtype=np.float64)
    stated = np.sqrt(np.asarray(signal.variance[:, k], dtype=np.float64))
    bits = signal.quality[:, k]
    return Errors(quantity=f"{quantity} of a bin", error=error, random=stated, bits=bits)


def _counts(rng: Random, rate: float, dead_time: float, shots: int, profiles: int, *,
            paralyzable: bool = False) -> Any:  # fmt: skip
    mean, variance = counting.counter_moments(
        np.full(_BINS, rate), bin_time=_BIN_TIME, dead_time=dead_time, paralyzable=paralyzable
    )
    if rate * dead_time * 1e6 < 1e-3:
        return rng.poisson(shots * mean, (profiles, _BINS)).astype(np.int32)
    noise = rng.standard_normal((profiles, _BINS)) * np.sqrt(shots * variance)
    return np.maximum(np.rint(shots * mean + noise), 0.0).astype(np.int32)


def _photon(
    rng: Random, profiles: int, *, dead_time_error: float = 0.0, paralyzable: bool = False
) -> Errors:
    rate, shots = _logarithmic(rng, 1e-2, 300.0), int(_logarithmic(rng, 50.0, 1e4))
    dead_time = _DEAD_TIME * (1.0 + dead_time_error * rng.normal())
    counts = _counts(rng, rate, dead_time, shots, profiles, paralyzable=paralyzable)
    signal = counts_to_signal.photon_signal(
        counts, np.full(profiles, shots), _RANGE[:_BINS], bin_width=_BIN_WIDTH,
        dead_time=_DEAD_TIME,
    )  # fmt: skip
    errors = _mean(signal, rate, "count rate")
    # As products state it (`signal_dead_time_error`), from the rate that was found.
    change = (errors["error"] + rate) ** 2 * _PER_MEGAHERTZ_SQUARED
    systematic = change * counts_to_signal.dead_time_standard_error(_DEAD_TIME)
    return errors | {"systematic": systematic}


def _analog(
    rng: Random,
    profiles: int,
    *,
    noises: tuple[float, float],
    levels: tuple[float, float],
    select: Callable[[counts_to_signal.Signal, float, str], Errors] = _mean,
) -> Errors:
    shots = int(_logarithmic(rng, 20.0, 300.0))
    level, noise = _logarithmic(rng, *levels), _logarithmic(rng, *noises)
    total = np.zeros((profiles, _BINS))
    for _ in range(shots):
        sampled = np.rint(level + noise * rng.standard_normal(total.shape, dtype=np.float32))
        total += np.clip(sampled, 0.0, 2**_BITS - 1)
    signal = counts_to_signal.analog_signal(
        total.astype(np.int32), np.full(profiles, shots), _RANGE[:_BINS], adc_bits=_BITS,
        input_range=np.full(profiles, 0.5),
    )  # fmt: skip
    return select(signal, level * _STEP, "voltage")


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


def _known_shape(rng: Random, profiles: int, *, haze: float = 0.0) -> Errors:
    sky, clean, counts, variance, level = _far(rng, profiles)
    added = haze * rng.uniform(0.2, 1.0) * np.exp(-sky.range / 3000.0)
    shape = sky.shape * (1.0 + added)
    fit = known_shape.fit_known_shape(counts, sky.range, shape, variance=variance)
    bits = fit.quality | np.where(
        fit.singular, np.int32(HomogeneousQuality.POORLY_DETERMINED), np.int32(0)
    )
    misfit = None
    if haze:
        # Misfit of the wrong shape in the chosen window, without noise.
        rows = np.broadcast_to(clean, counts.shape)
        noise_free_fit = known_shape.fit_known_shape(
            rows, sky.range, shape, variance=variance, start=fit.start, stop=fit.stop
        )
        misfit = np.sqrt(noise_free_fit.chi2)
    return Errors(quantity="background, known shape", error=fit.background - level,
                  random=fit.background_standard_error, bits=bits, misfit=misfit)  # fmt: skip


def _tail(rng: Random, profiles: int) -> Errors:
    sky, _, counts, variance, level = _far(rng, profiles)
    result = estimate.from_tail(counts, sky.range, np.broadcast_to(variance, counts.shape))
    return Errors(quantity="background, mean of the tail", error=result.background - level,
                  random=result.standard_error, bits=result.quality)  # fmt: skip


def _cubic(rng: Random, profiles: int) -> Errors:
    from_range = _RANGE[300:700]
    extinction, amount = _logarithmic(rng, 1e-6, 3e-3), _logarithmic(rng, 1e-1, 1e5)
    level = _logarithmic(rng, 1.0, 1e6)
    fall = np.exp(-2.0 * extinction * (from_range - from_range[0]))
    model = level + amount * (from_range[0] / from_range) ** 2 * fall
    power = model + rng.standard_normal((profiles, from_range.size))
    result = cubic_and_tail.cubic(power, from_range, variance=1.0)
    return Errors(quantity="background, cubic", error=result.background - level,
                  random=result.background_standard_error, bits=result.quality)  # fmt: skip


FAILURES: Final[tuple[tuple[Failure, Callable[[Random, int], Errors]], ...]] = (
    (Failure("none, photon counting", satisfied=True), _photon),
    (Failure("dead time off by 10 %"), partial(_photon, dead_time_error=0.1)),
    (Failure("paralyzable counter"), partial(_photon, paralyzable=True)),
    (
        Failure("none, analog", satisfied=True),
        partial(_analog, noises=(0.5, 30.0), levels=(100.0, 3500.0)),
    ),
    (
        Failure("analog noise below half a step"),
        partial(_analog, noises=(0.02, 0.5), levels=(100.0, 3500.0)),
    ),
    (
        Failure("analog near full scale"),
        partial(_analog, noises=(0.5, 30.0), levels=(3900.0, 4200.0)),
    ),
    (Failure("none, known shape", satisfied=True), _known_shape),
    (Failure("shape of hazy air"), partial(_known_shape, haze=3.0)),
    (Failure("mean of a tail with signal in it"), _tail),
    (Failure("none, cubic", satisfied=True), _cubic),
    (
        Failure("analog noise below half a step, a single bin"),
        partial(_analog, noises=(0.02, 0.5), levels=(100.0, 3500.0), select=_bin),
    ),
)


def score_signals(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Yield the scored values of random counts, class by class."""
    for number, (failure, process) in held_first(FAILURES):
        rng = np.random.default_rng((75, cluster, number))
        errors: Errors = {"systematic": 0.0, **process(rng, profiles)}
        clean = failure.satisfied and process is not _cubic
        uncertain = (errors["bits"] & np.int32(Quality.BACKGROUND_UNCERTAIN)) != 0
        solvable = np.isfinite(errors["error"]) if clean else None
        yield ScoredValues(
            failure, own=HomogeneousQuality, uncertain=uncertain, solvable=solvable, **errors
        )


_ROUNDED: Final = (0.05, 0.1, 0.2)
"""Noise in steps of the digitizer."""


def score_digitizers(cluster: int, profiles: int) -> Iterator[ScoredValues]:
    """Yield single bins of a signal that falls steeply, with noise of a fraction of a step."""
    for noise in _ROUNDED:
        rng = np.random.default_rng((83, cluster))
        shots = int(_logarithmic(rng, 20.0, 300.0))
        distance = _RANGE[:_BINS]
        fall = (300.0 / np.maximum(distance, 300.0)) ** 2
        level = float(rng.uniform(20.0, 60.0)) + float(rng.uniform(500.0, 3500.0)) * fall
        total = np.zeros((profiles, _BINS))
        for _ in range(shots):
            total += np.rint(level + noise * rng.standard_normal(total.shape, dtype=np.float32))
        signal = counts_to_signal.analog_signal(
            total.astype(np.int32), np.full(profiles, shots), distance, adc_bits=_BITS,
            input_range=np.full(profiles, 0.5),
        )  # fmt: skip
        error = np.asarray(signal.power - level * _STEP, dtype=np.float64)
        stated = np.sqrt(np.asarray(signal.variance, dtype=np.float64))
        steep = (distance > 320.0) & (distance < 1200.0)
        for place, bins in (("steep", steep), ("flat", distance > 1500.0)):
            failure = Failure(f"noise of {noise:g} steps, {place} bins", satisfied=True)
            yield ScoredValues(
                failure, "voltage of a bin", error[:, bins], stated[:, bins], 0.0,
                np.asarray(signal.quality)[:, bins], HomogeneousQuality,
            )  # fmt: skip
