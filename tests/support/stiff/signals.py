"""Stiff and extreme cases of the signal chain: counts, background, averages, gluing, lag."""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.background import cubic_and_tail, known_shape
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from lidarops.retrieve.signal import averaging, counts_to_signal, gluing
from lidarops.simulate import counting
from support.lags import lag_of
from support.stiff.cases import (
    Accepted,
    Answer,
    Array,
    Between,
    Covered,
    Flagged,
    Missing,
    Near,
    Refused,
    Retrieval,
    StiffCase,
)

_case = partial(StiffCase, retrieval=Retrieval.SIGNAL)
RANGE: Final = 7.5 * (np.arange(2000, dtype=np.float64) + 0.5)
SHOTS: Final = 600
BIN_TIME: Final = 50e-9
"""s."""
DEAD_TIME: Final = 4e-9
"""s."""
_BITS: Final = 12
_TOP: Final = SHOTS * (2**_BITS - 1)
_FOLDED: Final = Quality.PILE_UP | Quality.SATURATED


def analog(counts: Any, **changes: Any) -> Answer:
    """Return counts as mV, with 500 mV at full scale."""
    arguments: dict[str, Any] = {
        "shots": np.full(np.shape(counts)[:-1], SHOTS),
        "range": RANGE[: np.shape(counts)[-1]],
        "adc_bits": _BITS,
        "input_range": np.full(np.shape(counts)[:-1], 0.5),
    }
    return _answer(counts_to_signal.analog_signal(counts, **arguments | changes))


def photon(counts: Any, **changes: Any) -> Answer:
    """Return counts as MHz."""
    arguments: dict[str, Any] = {
        "shots": np.full(np.shape(counts)[:-1], SHOTS),
        "range": RANGE[: np.shape(counts)[-1]],
        "bin_width": 7.5,
        "dead_time": DEAD_TIME,
        "dead_time_uncertainty": 0.0,
    }
    return _answer(counts_to_signal.photon_signal(counts, **arguments | changes))


def _answer(signal: counts_to_signal.Signal) -> Answer:
    error = np.sqrt(np.asarray(signal.variance, dtype=np.float64))
    values = {"power": signal.power, "power_standard_error": error, "variance": signal.variance}
    return Answer(values, np.asarray(signal.quality))


def _select_bins(answer: Answer, bins: slice) -> Answer:
    values = {name: answer.value(name)[..., bins] for name in answer.values}
    return Answer(values, answer.quality[..., bins])


def _analog_bins(bins: slice, counts: Any, **changes: Any) -> Answer:
    return _select_bins(analog(counts, **changes), bins)


def _steady(steps: float, noise: float, profiles: int = 4) -> dict[str, Any]:
    """Return sums of shots, each rounded by the digitiser."""
    rng = np.random.default_rng(11)
    shape = (SHOTS, profiles, 200)
    sums = np.rint(steps + noise * rng.standard_normal(shape)).sum(axis=0)
    return {"counts": sums.astype(np.int32)}


def _level(steps: float) -> float:
    return steps * 500.0 / 2**_BITS


def _single_extreme(value: int) -> dict[str, Any]:
    counts = _steady(100.0, 2.0)["counts"]
    counts[:, 50] = value
    return {"counts": counts}


def _rate_counts(rate: float, *, paralyzable: bool = False, profiles: int = 4) -> dict[str, Any]:
    mean, variance = counting.counter_moments(
        np.full(RANGE.size, rate), bin_time=BIN_TIME, dead_time=DEAD_TIME, paralyzable=paralyzable
    )
    rng = np.random.default_rng(12)
    noise = rng.standard_normal((profiles, RANGE.size)) * np.sqrt(SHOTS * variance)
    counts = np.maximum(np.rint(SHOTS * mean + noise), 0.0)
    return {"counts": counts.astype(np.int32)}


def _empty(shots: int = SHOTS) -> dict[str, Any]:
    counts = np.zeros((3, RANGE.size), dtype=np.int32)
    return {"counts": counts, "shots": np.full(3, shots)}


def _analog_cases() -> tuple[StiffCase, ...]:
    all_bins = slice(None)
    noisy = partial(_steady, 100.3, 2.0)
    return (
        _case("analog, noise of 2 steps", build=noisy, solve=analog,
              expected=(Accepted(), Covered("power", _level(100.3), errors=5.0))),
        *(
            _case(f"B d analog, noise of {noise:g} steps at {steps:g}: rounding error remains",
                  build=partial(_steady, steps, noise), solve=analog,
                  expected=(Covered("power", _level(steps), valued=1.0),))
            for steps, noise in ((100.3, 0.0), (100.3, 0.05), (100.45, 0.05), (100.4, 0.1),
                                 (100.25, 0.2), (100.25, 0.3), (100.25, 0.4))
        ),
        _case("B e analog without shots", build=lambda: _empty(0), solve=analog,
              expected=(Flagged(Quality.INPUT_MISSING), Missing("power"))),
        _case("analog, zeros only", build=_empty, solve=analog,
              expected=(Flagged(Quality.INPUT_MISSING), Missing("power"))),
        _case("B f one bin at the largest integer", build=partial(_single_extreme, 2**31 - 1),
              solve=partial(_analog_bins, slice(50, 51)),
              expected=(Flagged(Quality.INPUT_MISSING | Quality.SATURATED), Missing("power"))),
        _case("B f its neighbours", build=partial(_single_extreme, 2**31 - 1),
              solve=partial(_analog_bins, slice(51, 200)),
              expected=(Accepted(), Covered("power", _level(100.0), errors=5.0))),
        _case("one bin at full scale", build=partial(_single_extreme, _TOP),
              solve=partial(_analog_bins, slice(50, 51)),
              expected=(Flagged(Quality.SATURATED), Missing("power"))),
        _case("one bin above full scale", build=partial(_single_extreme, _TOP + 5),
              solve=partial(_analog_bins, slice(50, 51)),
              expected=(Flagged(Quality.SATURATED), Missing("power"))),
        _case("profile above full scale",
              build=lambda: {"counts": np.full((2, 200), 2 * _TOP, np.int32)}, solve=analog,
              expected=(Flagged(Quality.SATURATED), Missing("power"))),
        _case("some shots clipped: 2 steps below full scale, noise of 5",
              build=lambda: {"counts": np.minimum(_steady(4093.0, 5.0)["counts"], _TOP)},
              solve=analog, expected=(Flagged(Quality.SATURATED),)),
        _case("analog without an input range",
              build=lambda: noisy() | {"input_range": np.full(4, np.nan)}, solve=analog,
              expected=(Flagged(Quality.INPUT_MISSING), Missing("power"))),
        _case("analog, one bin", build=lambda: {"counts": np.full((2, 1), 9000, np.int32)},
              solve=analog, expected=(Near("power", _level(15.0), 1e-12),)),
        _case("dark signal missing in one bin", solve=partial(_analog_bins, slice(3, 4)),
              build=lambda: noisy() | {"dark": np.where(np.arange(200) == 3, np.nan, 1.0)},
              expected=(Flagged(Quality.INPUT_MISSING), Missing("power"))),
        _case("counts as floats with fractions", build=lambda: {"counts": np.full((2, 200), 0.5)},
              solve=analog, expected=(Refused(RetrievalInputError, "counts"),)),
        _case("boolean counts",
              build=lambda: {"counts": np.ones((2, 200), dtype=np.bool_)},
              solve=analog, expected=(Refused(RetrievalInputError, "counts"),)),
        _case("counts of 64 bits beyond 32",
              build=lambda: {"counts": np.full((2, 200), 2**40)}, solve=analog,
              expected=(Refused(RetrievalInputError, "counts"),)),
        _case("negative noise variance", build=lambda: noisy() | {"noise_variance": -1.0},
              solve=analog, expected=(Refused(RetrievalInputError, "noise_variance"),)),
        _case("a variance of the dark signal of 1e300", solve=partial(_analog_bins, all_bins),
              build=lambda: noisy() | {"dark": np.zeros(200), "noise_variance": 1.0,
                                       "dark_variance": np.full(200, 1e300)},
              expected=(Between("power_standard_error", 1e149, np.inf),)),
    )  # fmt: skip


def _photon_cases() -> tuple[StiffCase, ...]:
    return (
        *(
            _case(f"photon counting, {rate:g} MHz", build=partial(_rate_counts, rate),
                  solve=photon, expected=(Accepted(), Covered("power", rate, errors=5.5)))
            for rate in (1.0, 20.0, 100.0)
        ),
        _case("200 MHz: dead nearly half of the time",
              build=partial(_rate_counts, 200.0), solve=photon,
              expected=(Flagged(_FOLDED), Covered("power", 200.0, errors=5.5))),
        _case("120 MHz, dead time known to 20 %", solve=photon,
              build=lambda: _rate_counts(120.0) | {"dead_time_uncertainty": 0.2},
              expected=(Flagged(Quality.SATURATED), Missing("power"))),
        _case("600 MHz: dead more than half of the time", build=partial(_rate_counts, 600.0),
              solve=photon, expected=(Flagged(Quality.SATURATED), Missing("power"))),
        _case("B c 600 MHz, paralyzable, folded back",
              build=partial(_rate_counts, 600.0, paralyzable=True), solve=photon,
              expected=(Flagged(_FOLDED),)),
        _case("unknown dead time, 100 MHz", solve=photon,
              build=lambda: _rate_counts(100.0) | {"dead_time": None},
              expected=(Flagged(_FOLDED),)),
        _case("B e photon counting without shots", build=lambda: _empty(0), solve=photon,
              expected=(Flagged(Quality.INPUT_MISSING), Missing("power"))),
        _case("photon counting, zeros only", build=_empty, solve=photon,
              expected=(Flagged(Quality.INPUT_MISSING), Missing("power"))),
        _case("one count in a profile: every bin has an error", solve=photon,
              build=lambda: {"counts": np.eye(1, RANGE.size, 700, dtype=np.int32)},
              expected=(Between("power_standard_error", 1e-6, 1.0),)),
        _case("the largest integer in all bins", solve=photon,
              build=lambda: {"counts": np.full((1, 200), 2**31 - 1, np.int32)},
              expected=(Flagged(Quality.INPUT_MISSING | Quality.SATURATED), Missing("power"))),
        _case("boolean photon counts", solve=photon,
              build=lambda: {"counts": np.ones((2, 200), dtype=np.bool_)},
              expected=(Refused(RetrievalInputError, "counts"),)),
        _case("negative dead time", build=lambda: _rate_counts(1.0) | {"dead_time": -1e-9},
              solve=photon, expected=(Refused(RetrievalInputError, "dead_time"),)),
        _case("bin width of zero", build=lambda: _rate_counts(1.0) | {"bin_width": 0.0},
              solve=photon, expected=(Refused(RetrievalInputError, "bin_width"),)),
    )  # fmt: skip


# Background, averages, gluing, lag ------------------------------------------------------------


def tail(**arguments: Any) -> Answer:
    """Return the mean of the far bins as background."""
    result = cubic_and_tail.tail_mean(**arguments)
    values = {
        "background": result.background,
        "background_standard_error": result.background_standard_error,
    }
    return Answer(values, np.asarray(result.quality))


def shaped(**arguments: Any) -> Answer:
    """Return background and amplitude, fitted with a known shape."""
    result = known_shape.fit_known_shape(**arguments)
    names = ("background", "amplitude")
    values = {name: getattr(result, name) for name in names}
    errors = [f"{name}_standard_error" for name in names]
    values |= {name: getattr(result, name) for name in errors}
    bits = np.asarray(result.quality)
    singular = np.where(
        result.singular, np.int32(HomogeneousQuality.POORLY_DETERMINED), np.int32(0)
    )
    return Answer(values, bits | singular)


_FAR: Final = 7.5 * (np.arange(400, 2000, dtype=np.float64) + 0.5)


def _molecules(distance: Array = _FAR) -> Array:
    air = np.exp(-distance / 8000.0)
    return np.asarray(known_shape.molecular_shape(1.4e-6 * air, 1.2e-5 * air, distance))


def _shaped(
    level: float, scale: float = 1.0, *, noise: float = 1.0, **changes: Any
) -> dict[str, Any]:
    shape = _molecules()
    model = level + 100.0 * shape / shape[0]
    draws = np.random.default_rng(13).standard_normal((50, shape.size))
    return {"power": scale * (model + noise * draws), "range": _FAR, "shape": shape,
            "variance": (scale * noise) ** 2, **changes}  # fmt: skip


def _mean(profiles: Array, variance: float = 1.0) -> Answer:
    sums = averaging.RunningMean((1, profiles.shape[1]))
    sums.add(profiles, variance, groups=np.zeros(len(profiles), np.intp))
    means = sums.averages()
    return Answer({"mean": means.values, "mean_standard_error": np.sqrt(means.variance)})


def _glue(**arguments: Any) -> Answer:
    glued = gluing.glue(**arguments)
    not_glued = np.where(glued.no_window | glued.poor_fit, np.int32(Quality.NO_GLUING), np.int32(0))
    values = {"slope": glued.slope, "slope_standard_error": glued.slope_standard_error}
    return Answer(values | {"power": glued.power}, np.asarray(not_glued))


def _channels(strength: float, gain: float = 0.5, profiles: int = 30) -> dict[str, Any]:
    distance = RANGE[40:]
    rate = strength * (distance[0] / distance) ** 2
    rng = np.random.default_rng(14)
    counted = rate / (SHOTS * BIN_TIME * 1e6)
    shape = (profiles, rate.size)
    return {
        "analog": gain * rate + 0.02 * rng.standard_normal(shape),
        "photon_counting": rate + np.sqrt(counted) * rng.standard_normal(shape),
        "range": distance,
        "analog_variance": np.full(shape, 4e-4),
        "photon_variance": np.broadcast_to(counted, shape),
    }


def _lag(shift: int | None) -> Answer:
    rng = np.random.default_rng(15)
    common = rng.standard_normal((40, 1200))
    shifted = rng.standard_normal((40, 1200)) if shift is None else np.roll(common, shift, axis=-1)
    estimate = lag_of(shifted + 0.5 * rng.standard_normal(common.shape), common)
    quality = np.where(estimate.significant, np.int32(0), np.int32(Quality.NO_GLUING))
    values = {"lag": estimate.bins, "lag_standard_error": estimate.standard_error}
    return Answer(values, np.atleast_1d(quality).astype(np.int32))


def _rest() -> tuple[StiffCase, ...]:
    gapped = np.full((6, 50), np.nan)
    one_left = np.where(np.arange(6)[:, np.newaxis] == 2, 3.0, gapped)
    return (
        _case("mean of the tail, all NaN",
              build=lambda: {"power": np.full((2, 300), np.nan), "range": RANGE[:300]},
              solve=tail, expected=(Flagged(Quality.INPUT_MISSING), Missing("background"))),
        _case("mean of the tail, one bin",
              build=lambda: {"power": [[5.0]], "range": [200.0], "variance": 1.0}, solve=tail,
              expected=(Flagged(Quality.TOO_FEW_BINS), Near("background", 5.0, 0.0))),
        _case("mean of the tail of a background of 1e30", solve=tail,
              build=lambda: {"power": np.full((2, 300), 1e30), "range": RANGE[:300]},
              expected=(Near("background", 1e30, 1e-15),)),
        _case("mean of the tail of 1e300 with a variance of 1e300", solve=tail,
              build=lambda: {"power": np.full((2, 300), 1e300), "range": RANGE[:300],
                             "variance": 1e300},
              expected=(Near("background", 1e300, 1e-14),)),
        *(
            _case(f"known shape, background {level:g} times the noise",
                  build=partial(_shaped, level), solve=shaped,
                  expected=(Covered("background", level, valued=0.9),))
            for level in (0.0, 1.0, 1e5, 1e8)
        ),
        *(
            _case(f"known shape, signals times {scale:g}", build=partial(_shaped, 10.0, scale),
                  solve=shaped, expected=(Covered("background", 10.0 * scale, valued=0.9),))
            for scale in (1e-30, 1e30, 1e-150, 1e150)
        ),
        _case("known shape without noise", solve=shaped,
              build=lambda: _shaped(10.0, noise=0.0, variance=1e-12),
              expected=(Near("background", 10.0, 1e-9),)),
        _case("known shape, all NaN", build=lambda: _shaped(10.0, np.nan, variance=1.0),
              solve=shaped, expected=(Flagged(Quality.INPUT_MISSING), Missing("background"))),
        _case("known shape, constant profile", solve=shaped,
              build=lambda: _shaped(1.0) | {"power": np.full(_FAR.size, 7.0)},
              expected=(Flagged(Quality.NO_SIGNAL),)),
        _case("known shape in 10 far bins", solve=shaped,
              build=lambda: {"power": _shaped(1.0)["power"][:, -10:], "range": _FAR[-10:],
                             "shape": _molecules()[-10:], "variance": 1.0},
              expected=(Covered("background", 1.0),)),
        _case("mean of profiles, all NaN", build=lambda: {"profiles": gapped}, solve=_mean,
              expected=(Missing("mean"),)),
        _case("mean of profiles with one value", build=lambda: {"profiles": one_left},
              solve=_mean, expected=(Near("mean", 3.0, 0.0),
                                     Near("mean_standard_error", 1.0, 1e-15))),
        _case("mean of 1e6 profiles", solve=_mean,
              build=lambda: {"profiles": np.full((1_000_000, 1), 0.1), "variance": 1.0},
              expected=(Near("mean", 0.1, 1e-10), Near("mean_standard_error", 1e-3, 1e-12))),
        _case("gluing, 30 MHz at 300 m", build=partial(_channels, 30.0), solve=_glue,
              expected=(Covered("slope", 2.0, valued=0.9),)),
        _case("gluing, signals too weak", build=partial(_channels, 0.05), solve=_glue,
              expected=(Flagged(Quality.NO_GLUING), Missing("power"))),
        _case("gluing of an inverted analog channel", build=partial(_channels, 30.0, -0.5),
              solve=_glue, expected=(Flagged(Quality.NO_GLUING),)),
        _case("lag of 9 bins", build=lambda: {"shift": 9}, solve=_lag,
              expected=(Accepted(), Near("lag", 9.0, 0.2, relative=False))),
        _case("lag of channels with independent noise", build=lambda: {"shift": None}, solve=_lag,
              expected=(Flagged(Quality.NO_GLUING),)),
    )  # fmt: skip


def stiff_signal_cases() -> tuple[StiffCase, ...]:
    """Return all cases of the signal chain."""
    return (*_analog_cases(), *_photon_cases(), *_rest())
