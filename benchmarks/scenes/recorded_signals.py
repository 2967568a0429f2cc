"""Random records of counts with known truth: signals, profiles without light, and dead times.

Recorders violate the model of the signal chain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from benchmarks.harness.figure import Array, Mask, Random, Scores, Target, log_uniform
from benchmarks.harness.rates import Failure, Part, ScoredValues, held_first, shares
from benchmarks.scenes import elastic_skies
from lidarops.flags import Quality
from lidarops.retrieve.background import cubic_and_tail, estimate, known_shape
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.signal import counts_to_signal
from lidarops.retrieve.signal.dead_time import ProfileGroup, estimate_dead_time
from lidarops.retrieve.signal.light import excess_over_far, light_of, lightless
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
_MIDDLE: Final = slice(200, 201)
_QUIET: Final = (0.02, 0.5)
"""Noise, in steps of the digitizer."""


Errors = dict[str, Any]
"""Errors of the values of some profiles: the fields of `ScoredValues` that depend on them."""


def _mean(
    signal: counts_to_signal.Signal, truth: float, quantity: str, bins: slice = _MEAN_OF
) -> Errors:
    """Return the error of the mean of the usable bins, with the bits of all bins."""
    power = signal.power[:, bins]
    valid = np.isfinite(power)
    count = valid.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.where(valid, power, 0.0).sum(axis=1) / count - truth
        variance = np.where(valid, signal.variance[:, bins], 0.0).sum(axis=1) / count**2
    bits = np.bitwise_or.reduce(signal.quality[:, bins], axis=1)
    return Errors(quantity=quantity, error=error, random=np.sqrt(variance), bits=bits)


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
    rate, shots = log_uniform(rng, 1e-2, 300.0), int(log_uniform(rng, 50.0, 1e4))
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
    rng: Random, profiles: int, *, noises: tuple[float, float] = (0.5, 30.0),
    levels: tuple[float, float] = (100.0, 3500.0), bins: slice = _MEAN_OF,
) -> Errors:  # fmt: skip
    shots = int(log_uniform(rng, 20.0, 300.0))
    level, noise = log_uniform(rng, *levels), log_uniform(rng, *noises)
    quantity = "voltage" if bins is _MEAN_OF else "voltage of a bin"
    return _mean(_digitized(rng, level, noise, shots, profiles), level * _STEP, quantity, bins)


def _digitized(
    rng: Random, level: Array | float, noise: float, shots: int, profiles: int
) -> counts_to_signal.Signal:
    """Return the signal of a level with noise, both in steps of the digitizer."""
    total = np.zeros((profiles, _BINS))
    for _ in range(shots):
        sampled = np.rint(level + noise * rng.standard_normal(total.shape, dtype=np.float32))
        total += np.clip(sampled, 0.0, 2**_BITS - 1)
    return counts_to_signal.analog_signal(
        total.astype(np.int32), np.full(profiles, shots), _RANGE[:_BINS], adc_bits=_BITS,
        input_range=np.full(profiles, 0.5),
    )  # fmt: skip


def _far(
    rng: Random, profiles: int
) -> tuple[elastic_skies.SimulatedSky, Array, Array, Array, float]:
    """Return the far range of profiles above a background: mean, counts and their variance."""
    sky = elastic_skies.simulated_sky()
    level = log_uniform(rng, 1.0, 1e8)
    scale = log_uniform(rng, 1e-3, 10.0)
    mean = elastic_skies.SHOTS * (scale * sky.signal + level)
    counts = rng.poisson(np.broadcast_to(mean, (profiles, mean.size))) / elastic_skies.SHOTS
    variance = np.maximum(counts.mean(axis=0), 1e-3) / elastic_skies.SHOTS
    clean = np.asarray(mean / elastic_skies.SHOTS)
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
    extinction, amount = log_uniform(rng, 1e-6, 3e-3), log_uniform(rng, 1e-1, 1e5)
    level = log_uniform(rng, 1.0, 1e6)
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
    (Failure("none, analog", satisfied=True), _analog),
    (Failure("analog noise below half a step"), partial(_analog, noises=_QUIET)),
    (Failure("analog near full scale"), partial(_analog, levels=(3900.0, 4200.0))),
    (Failure("none, known shape", satisfied=True), _known_shape),
    (Failure("shape of hazy air"), partial(_known_shape, haze=3.0)),
    (Failure("mean of a tail with signal in it"), _tail),
    (Failure("none, cubic", satisfied=True), _cubic),
    (Failure("analog noise below half a step, a single bin"),
     partial(_analog, noises=_QUIET, bins=_MIDDLE)),
)  # fmt: skip


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
        shots = int(log_uniform(rng, 20.0, 300.0))
        distance = _RANGE[:_BINS]
        fall = (300.0 / np.maximum(distance, 300.0)) ** 2
        level = float(rng.uniform(20.0, 60.0)) + float(rng.uniform(500.0, 3500.0)) * fall
        signal = _digitized(rng, level, noise, shots, profiles)
        error = np.asarray(signal.power - level * _STEP, dtype=np.float64)
        stated = np.sqrt(np.asarray(signal.variance, dtype=np.float64))
        steep = (distance > 320.0) & (distance < 1200.0)
        for place, bins in (("steep", steep), ("flat", distance > 1500.0)):
            failure = Failure(f"noise of {noise:g} steps, {place} bins", satisfied=True)
            yield ScoredValues(
                failure, "voltage of a bin", error[:, bins], stated[:, bins], 0.0,
                np.asarray(signal.quality)[:, bins], HomogeneousQuality,
            )  # fmt: skip


# Profiles without light of the laser ----------------------------------------------------------

RANGE: Final = 7.5 * (np.arange(2000) + 0.5)
SHAPE: Final = np.minimum(RANGE / 300.0, 1.0) ** 2 * (300.0 / RANGE) ** 2
"""Of light along range without attenuation, 1 at 300 m."""
_MOST_WRONG: Final = Target(1e-2)
"""Largest share of profiles without light that are missed, and of others that are flagged."""
_OFFSET: Final = 6000.0
"""Counts of a digitizer without light."""
_VARIES: Final = "light that varies tenfold"
_CLOUDS: Final = "clouds"
_WEAK: Final = "weak light"
_WEAK_VARIES: Final = "weak light that varies tenfold"
_LASERS: Final = "two lasers"
_OFF: Final = "a recorder that is off in a tenth"
_DARK: Final = "no light at all"
_RARE: Final = "light in less than a tenth"
_CLASSES: Final = (
    "steady light", _VARIES, _CLOUDS, _WEAK, _WEAK_VARIES, _LASERS, _OFF, _DARK, _RARE,
)  # fmt: skip
_MISSED: Final = "without light, missed"
_UNTOLD: Final = frozenset({_WEAK, _WEAK_VARIES, _RARE})
"""Classes of which the documentation states that profiles without light are missed."""


def draw_counts(rng: Random, light: Array, *, analog: bool, level: float) -> npt.NDArray[np.int64]:
    """Return counts of light: photons above a sky of `level`, or of a digitizer of that noise."""
    if analog:
        return np.rint(_OFFSET + light + level * rng.standard_normal(light.shape)).astype(np.int64)
    return rng.poisson(level + light)


def _light(rng: Random, profiles: int, condition: str) -> Array:
    """Return the light of profiles along range, about 1 at 300 m."""
    light: Array = np.tile(SHAPE * np.exp(-RANGE / rng.uniform(2e3, 2e4)), (profiles, 1))
    if condition in {_VARIES, _WEAK_VARIES}:
        light *= 10.0 ** rng.uniform(0.0, 1.0, (profiles, 1))
    if condition == _CLOUDS:
        base = rng.uniform(300.0, 6e3, (profiles, 1))
        beyond = base < RANGE
        light *= np.where(beyond, 30.0 * np.exp(-(RANGE - base) / 50.0), 1.0)
    return light


def _lit_share(rng: Random, condition: str) -> float:
    """Return the share of profiles with light."""
    if condition == _DARK:
        return 0.0
    return float(rng.uniform(0.01, 0.09) if condition == _RARE else rng.uniform(0.15, 0.95))


def _channels(rng: Random, dark: Mask, condition: str) -> Iterator[npt.NDArray[np.int64]]:
    """Yield the counts of the channels of a laser: bright ones, and one of a thousandth of it."""
    weak = condition in {_WEAK, _WEAK_VARIES}
    weakest = 10.0 ** (rng.uniform(2.5, 3.5) if weak else rng.uniform(4.0, 5.0))
    light = weakest * _light(rng, dark.size, condition)
    light[dark] = 0.0
    for bright in range(2 if condition == _OFF else 1):
        analog = bool(rng.integers(2))
        level = 10.0 ** (rng.uniform(1.0, 2.0) if analog else rng.uniform(-2.0, 2.0))
        counts = draw_counts(rng, light, analog=analog, level=level)
        if condition == _OFF and not bright:
            counts[rng.random(dark.size) < 0.1] = 0
        yield counts
    yield draw_counts(rng, 1e-3 * light, analog=False, level=0.1)


def scores_of_scene(cluster: int, condition: str) -> Iterator[Part]:
    """Yield what was told wrongly, how often, and among how many profiles, of a random scene.

    Any channel of a laser may be wrong. A tenth of the profiles are gaps.
    """
    rng = np.random.default_rng((84, cluster, _CLASSES.index(condition)))
    profiles = int(rng.integers(60, 120))
    gap = rng.random(profiles) < 0.1
    found, lasers, unlit = {}, {}, {}
    for laser in ("1", "2") if condition == _LASERS else ("1",):
        lit = np.ceil(profiles * _lit_share(rng, condition))
        unlit[laser] = rng.permutation(profiles) >= lit
        for number, counts in enumerate(_channels(rng, unlit[laser], condition)):
            name = f"{laser}{number}"
            counts[gap] = 0
            found[name], lasers[name] = light_of(*excess_over_far(counts), ~gap), laser
    told = lightless(found, lasers)
    for laser, dark in unlit.items():
        of_laser = np.array([told[name] for name in found if lasers[name] == laser])
        cases = {_MISSED: dark & ~gap, "with light, flagged": ~dark & ~gap, "gaps, flagged": gap}
        for case, those in cases.items():
            wrong = ~of_laser.all(axis=0) if case == _MISSED else of_laser.any(axis=0)
            yield case, condition, float((wrong & those).sum()), int(those.sum())


def light_scores(clusters: int) -> Scores:
    """Return the shares of profiles whose light is told wrongly, by condition."""
    parts = [
        part
        for condition in _CLASSES
        for cluster in range(clusters)
        for part in scores_of_scene(cluster, condition)
    ]
    return shares(
        parts, lambda case, name: None if case == _MISSED and name in _UNTOLD else _MOST_WRONG
    )


# Dead times, of records by photon counting and analog -----------------------------------------

DISTANCE: Final = 7.5 * (np.arange(4000) + 0.5)
LIGHT: Final = 400.0 * (300.0 / DISTANCE) ** 2 * np.exp(-2e-4 * DISTANCE)
"""MHz."""
LAG: Final = 10
SLOPE: Final = 60.0
"""MHz mV-1."""


def draw_group(
    rng: Random,
    dead_time: float,
    lights: Sequence[Array],
    shots: Sequence[int],
    sky: float = 0.5,
    *,
    paralysable: bool = False,
    baseline: float = 0.0,
    bend: float = 0.0,
) -> ProfileGroup:
    """Return a group of profiles, whose largest analog signal is too large by a share `bend`."""
    true = np.where(DISTANCE > 150.0, np.stack(lights), 0.0) + sky
    load = dead_time * 1e6 * true
    rate = true * np.exp(-load) if paralysable else true / (1.0 + load)
    exposure = np.array(shots) * 0.05
    mean_counts = rate * exposure[:, np.newaxis]
    # The dead time makes counts more regular than Poisson.
    regular = 1.0 if paralysable else 1.0 / (1.0 + load)
    counts = mean_counts + regular * (rng.poisson(mean_counts) - mean_counts)
    noise = 2e-3 * np.sqrt(600.0 / exposure.sum() * 0.05)
    mean = exposure / exposure.sum() @ true
    clear = np.interp(np.arange(DISTANCE.size) - LAG, np.arange(DISTANCE.size), mean) / SLOPE
    clear *= 1.0 + bend * clear / clear.max()
    clear += baseline * np.exp(-DISTANCE / 3000.0)
    analog = 4.8 + clear + rng.normal(0.0, noise, DISTANCE.size)
    return ProfileGroup(counts, exposure, analog, np.full(analog.shape, noise**2))


def _rising_layers(rng: Random, number: int) -> Array:
    """Return the light of a profile through a layer that rises, of any strength."""
    height, strength = 300.0 + 100.0 * number, rng.uniform(0.0, 3.0)
    return np.asarray(LIGHT * (1.0 + strength * np.exp(-(((DISTANCE - height) / 150.0) ** 2))))


def _slant_path(_rng: Random, number: int) -> Array:
    slant = 1.0 / math.cos(math.radians(2.5 * number))
    return np.asarray(LIGHT * np.exp(2e-4 * DISTANCE * (1.0 - slant)))


SCENES: Final[dict[str, Callable[[Random, int], Array]]] = {
    "like profiles": lambda _rng, _number: LIGHT,
    "a laser that varies": lambda rng, _number: LIGHT * max(rng.normal(1.0, 0.4), 0.05),
    "a laser that fails in half of the profiles": lambda _rng, number: (
        LIGHT * (1.0 if number % 2 else 0.03)
    ),
    "air that varies": _rising_layers,
    "a scan": _slant_path,
}
"""Name -> function that returns the light of a profile, given its number of 32."""

NONLINEAR: Final = 0.01
"""Share by which the largest analog signal may be too large, as the stated error assumes."""
_RECORDS: Final = {"linear analog record": 0.0, "analog record nonlinear by 1 %": NONLINEAR}
_ERRORS: Final = 2.0
"""Stated errors beyond which a dead time is false."""
_MOST_FALSE: Final = Target(1e-2)
"""Largest share of false ones; normal errors would leave 4.6 % of them."""


def draw_scene(rng: Random, scene: str, dead_time: float, bend: float = 0.0) -> list[ProfileGroup]:
    """Return four groups of 32 profiles of a scene; the dead time is in s."""
    light = SCENES[scene]
    return [
        draw_group(rng, dead_time, [light(rng, k) for k in range(32)], [600] * 32, bend=bend)
        for _ in range(4)
    ]


def _is_false(seed: int, scene: str, bend: float) -> bool:
    """Return whether the estimate of a random dead time of 2 to 12 ns is missing or false."""
    rng = np.random.default_rng((91, seed, list(SCENES).index(scene)))
    truth = math.exp(rng.uniform(math.log(2e-9), math.log(1.2e-8)))
    bend *= rng.choice([-1.0, 1.0])
    found = estimate_dead_time(draw_scene(rng, scene, truth, bend), LAG)
    return found is None or abs(found.dead_time - truth) > _ERRORS * found.standard_error


def dead_time_scores(number: int) -> Scores:
    """Return the shares of dead times that are more than 2 stated errors off, by record and scene.

    Of `number` dead times each.
    """
    parts = [
        (record, scene, float(_is_false(seed, scene, bend)), 1)
        for record, bend in _RECORDS.items()
        for scene in SCENES
        for seed in range(number)
    ]
    return shares(parts, lambda *_: _MOST_FALSE)
