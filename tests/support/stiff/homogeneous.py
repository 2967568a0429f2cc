"""Stiff and extreme cases of the homogeneous path and of its cubic."""

from __future__ import annotations

import tracemalloc
from dataclasses import dataclass, replace
from decimal import Decimal, localcontext
from functools import partial
from typing import Any, Final

import numpy as np

from benchmarks.scenes.homogeneous_paths import Scenario
from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.background import cubic_and_tail
from lidarops.retrieve.homogeneous import path_fit
from lidarops.retrieve.homogeneous.flags import HomogeneousQuality
from support.mean_counts import mean_profile_variance
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
    Rejected,
    Retrieval,
    StiffCase,
    Unflagged,
)

_case = partial(StiffCase, retrieval=Retrieval.HOMOGENEOUS)
_DIGITS: Final = 60
_NEWTON: Final = 400
"""Most Newton steps to the exact root, from a start far above it."""
_WRONG: Final = HomogeneousQuality.POOR_FIT | Quality.NOT_HOMOGENEOUS


@dataclass(frozen=True, slots=True)
class Path:
    """A homogeneous section, its signal at the first bin in the unit of the noise."""

    start: float = 2500.0
    """m."""
    length: float = 8000.0
    """m."""
    bins: int = 225
    extinction: float = 3e-5
    """m-1."""
    signal: float = 1000.0
    background: float = 370.0

    @property
    def range(self) -> Array:
        """(bin,) m."""
        return np.linspace(self.start, self.start + self.length, self.bins)

    @property
    def power(self) -> Array:
        """(bin,) without noise."""
        r = self.range
        fall = np.exp(-2.0 * self.extinction * (r - r[0]))
        return np.asarray(self.background + self.signal * (r[0] / r) ** 2 * fall)

    @property
    def scenario(self) -> Scenario:
        """The path as a scenario of `benchmarks.scenes.homogeneous_paths`."""
        return Scenario(self.start, self.length, self.extinction, self.signal, self.background)

    def noisy(self, profiles: int = 200, seed: int = 1) -> Array:
        """(profile, bin) with unit noise."""
        noise = np.random.default_rng(seed).standard_normal((profiles, self.bins))
        return np.asarray(self.power + noise)

    def arguments(self, **changed: Any) -> dict[str, Any]:
        """Return arguments of `solve_path` for profiles with noise of unit variance."""
        return {"power": self.noisy(), "range": self.range, "variance": 1.0, **changed}


CLEAR: Final = Path()


# Solvers ------------------------------------------------------------------------------------


def solve_path(**arguments: Any) -> Answer:
    """Return all values of a fit."""
    fit = path_fit.fit_homogeneous_path(**arguments)
    names = ("background", "amplitude", "extinction")
    values = {name: getattr(fit, name) for name in names}
    values |= {f"{name}_standard_error": getattr(fit, f"{name}_standard_error") for name in names}
    return Answer(values | {"reduced_chi2": fit.reduced_chi2}, np.asarray(fit.quality))


def cubic(**arguments: Any) -> Answer:
    """Return the background by the cubic."""
    estimate = cubic_and_tail.cubic(**arguments)
    values = {
        "background": estimate.background,
        "background_standard_error": estimate.background_standard_error,
    }
    return Answer(values, np.asarray(estimate.quality))


def scattered(path: Path, **arguments: Any) -> Answer:
    """Return errors over the Cramér-Rao bound, of all profiles, rejected or not."""
    answer = solve_path(**arguments)
    error = answer.value("extinction") - path.extinction
    bound = path.scenario.least_errors()["extinction"]
    within = np.abs(error) <= 1.96 * answer.value("extinction_standard_error")
    values = {
        "RMSE over bound": np.sqrt(np.mean(error**2)) / bound,
        "bias over bound": np.mean(error) / bound,
        "share beyond 10 bounds": np.mean(~(np.abs(error) <= 10.0 * bound)),
        "coverage": np.mean(within),
    }
    return Answer(values, answer.quality)


# Exact root ---------------------------------------------------------------------------------


def exact_root(power: Array, range_: Array, lag: int) -> float:
    """Return the largest root of the cubic of bobrovsky2024 in 60 digits.

    By Newton's method from above: beyond its last turning point, the derivative of a quartic with
    a positive leading coefficient is convex.
    """
    with localcontext() as context:
        context.prec = _DIGITS
        p, r = [Decimal(float(x)) for x in power], [Decimal(float(x)) for x in range_]
        cube = square = linear = constant = Decimal(0)
        for k in range(len(p) - 2 * lag):
            p0, p1, p2 = p[k], p[k + lag], p[k + 2 * lag]
            u, v = (r[k] * r[k + 2 * lag]) ** 2, r[k + lag] ** 4
            a, b, c = v - u, u * (p0 + p2) - 2 * v * p1, v * p1 * p1 - u * p0 * p2
            cube += 4 * a * a
            square += 6 * a * b
            linear += 2 * (2 * a * c + b * b)
            constant += 2 * b * c
        bound = 1 + max(abs(square), abs(linear), abs(constant)) / cube
        x = min(bound, 10 * max(abs(value) for value in p))
        for _ in range(_NEWTON):
            slope = (3 * cube * x + 2 * square) * x + linear
            if slope == 0:
                break
            step = (((cube * x + square) * x + linear) * x + constant) / slope
            x -= step
            if abs(step) <= abs(x) * Decimal(10) ** (5 - _DIGITS):
                break
        return float(x)


# Cases of the study -------------------------------------------------------------------------

_THIN: Final = Path(start=10500.0, length=100.0, background=7e5)
_DEEP: Final = Path(background=1e11)
_STRONG: Final = Path(extinction=5e-3, signal=1e4)
_WEAK: Final = Path(start=10500.0, extinction=1e-4, signal=15.0)
_SHORT: Final = Path(length=1000.0, background=25e3)
_SHIFTED: Final = Path(start=10500.0, length=2500.0, background=1e5)
_FINE: Final = Path(bins=4096, background=25e3)
_STEEP: Final = Path(length=1700.0, extinction=1e-5, signal=1e5)


def _exact(path: Path, **options: Any) -> dict[str, Any]:
    return {"power": path.power, "range": path.range, **options}


def _single(path: Path, **options: Any) -> dict[str, Any]:
    return {"power": path.power.astype(np.float32), "range": path.range, **options}


def _rooted(path: Path, lag: int, kind: type[np.floating[Any]] = np.float64) -> float:
    return exact_root(path.power.astype(kind), path.range, lag)


def _saturated(*, masked: bool) -> dict[str, Any]:
    power = CLEAR.noisy()
    top = CLEAR.background + 0.6 * CLEAR.signal
    return CLEAR.arguments(power=np.where(power > top, np.nan if masked else top, power))


def _overlapped(scale: float) -> dict[str, Any]:
    overlap = 1.0 - np.exp(-((CLEAR.range / scale) ** 2))
    noise = CLEAR.noisy() - CLEAR.power
    power = CLEAR.background + (CLEAR.power - CLEAR.background) * overlap + noise
    return CLEAR.arguments(power=power)


def _counted(shots: int, base: float, signal: float, profiles: int) -> dict[str, Any]:
    path = Path(signal=signal, background=base)
    rng = np.random.default_rng(2)
    power = rng.poisson(shots * path.power, (profiles, path.bins)) / shots
    noise = mean_profile_variance(power, shots)
    return {
        "power": power,
        "range": path.range,
        "variance": noise,
    }


def _irregular_range() -> Array:
    return np.sort(np.random.default_rng(3).uniform(2500.0, 10500.0, 225))


def _irregular_arguments(**options: Any) -> dict[str, Any]:
    r = _irregular_range()
    model = CLEAR.background + CLEAR.signal * (2500.0 / r) ** 2 * np.exp(-6e-5 * (r - 2500.0))
    noise = np.random.default_rng(4).standard_normal((200, r.size))
    return {"power": model + noise, "range": r, "variance": 1.0, **options}


def _raised(first: int, bins: int, by: float) -> dict[str, Any]:
    power = CLEAR.noisy()
    power[:, first : first + bins] += by
    return CLEAR.arguments(power=power)


def _study() -> tuple[StiffCase, ...]:
    return (
        _case("S1 cubic, 100 m at 10.5 km, background 700 signals, lag n / 3",
              build=lambda: _exact(_THIN, lag=75), solve=cubic,
              expected=(Near("background", 7e5, 1e-9 * 1000.0, relative=False),)),
        _case("S1 cubic, the same, lag 1, against 60 digits",
              build=lambda: _exact(_THIN, lag=1, variance=0.0), solve=cubic,
              expected=(Near("background", partial(_rooted, _THIN, 1), 1e-8 * 1000.0,
                             relative=False),)),
        _case("S1 cubic, the same, lag 1, against the truth", build=lambda: _exact(_THIN, lag=1),
              solve=cubic, expected=(Covered("background", 7e5),)),
        _case("S1 cubic, the same of float32 powers", build=lambda: _single(_THIN), solve=cubic,
              expected=(Rejected(),)),
        _case("S1 least squares, the same of float32 powers", build=lambda: _single(_THIN),
              solve=solve_path, expected=(Covered("background", 7e5), Covered("extinction", 3e-5))),
        _case("S2 background of 1e8 signals, float32", build=lambda: _single(_DEEP),
              solve=solve_path,
              expected=(Flagged(Quality.NO_SIGNAL), Near("background", 1e11, 1e-7))),
        _case("S2 cubic, the same, float64, lag 1, against 60 digits",
              build=lambda: _exact(_DEEP, lag=1, variance=0.0), solve=cubic,
              expected=(Near("background", partial(_rooted, _DEEP, 1), 3.2e-7 * 1000.0,
                             relative=False),)),
        _case("S2 cubic, the same, against the truth", build=lambda: _exact(_DEEP, lag=1),
              solve=cubic, expected=(Covered("background", 1e11), Rejected())),
        _case("S3 extinction 1e-8 per km", build=lambda: _exact(Path(extinction=1e-11)),
              solve=solve_path,
              expected=(Near("background", 370.0, 1e-13 * 1000.0, relative=False),
                        Near("extinction", 1e-11, 1e-12, relative=False), Accepted())),
        _case("S4 optical depth 40, signal 1e4",
              build=lambda: _STRONG.arguments(power=_STRONG.noisy(4000)),
              solve=partial(scattered, _STRONG),
              expected=(Between("RMSE over bound", 0.95, 1.06), Accepted(0.99))),
        _case("S4 cubic, the same", solve=solve_path,
              build=lambda: _STRONG.arguments(power=_STRONG.noisy(4000), method="cubic"),
              expected=(Covered("extinction", 5e-3),)),
        _case("S5 cubic, 1 km at 2.5 km: three real roots", solve=cubic,
              build=lambda: _exact(_SHORT, lag=1, variance=0.0),
              expected=(Near("background", partial(_rooted, _SHORT, 1), 1e-12 * 1000.0,
                             relative=False),)),
        _case("S6 signal 15 at 10.5 km: no second minimum",
              build=lambda: _WEAK.arguments(power=_WEAK.noisy(4000)),
              solve=partial(scattered, _WEAK),
              expected=(Near("share beyond 10 bounds", 0.0, 0.0, relative=False),
                        Between("RMSE over bound", 0.95, 1.06))),
        _case("S7 extinction in m-1", build=lambda: _exact(CLEAR), solve=solve_path,
              expected=(Near("extinction", 3e-5, 1e-9), Accepted())),
        _case("S8 background 100 signals, 2.5 km at 10.5 km",
              build=partial(_exact, _SHIFTED), solve=solve_path,
              expected=(Near("extinction", 3e-5, 1e-9),)),
        _case("S9 cubic, 4096 bins of float32, lag 1365", build=lambda: _single(_FINE, lag=1365),
              solve=cubic,
              expected=(Near("background", partial(_rooted, _FINE, 1365, np.float32),
                             1e-8 * 1000.0, relative=False),)),
        _case("S11 counts, background 10, signal 1e5, 51 shots",
              build=lambda: _counted(51, 10.0, 1e5, 4000), solve=solve_path,
              expected=(Covered("extinction", 3e-5, valued=0.99),)),
        _case("S12 counts of a single shot, background 10, signal 20",
              build=lambda: _counted(1, 10.0, 20.0, 2000), solve=solve_path,
              expected=(Rejected(0.99),)),
        _case("S13 saturated at 60 %", build=lambda: _saturated(masked=False), solve=solve_path,
              expected=(Flagged(_WRONG),)),
        _case("S13 the same, masked", build=lambda: _saturated(masked=True), solve=solve_path,
              expected=(Covered("extinction", 3e-5, valued=0.99),)),
        _case("S14 overlap of scale 1 km: a bias that no test detects", solve=solve_path,
              build=lambda: _overlapped(1000.0),
              expected=(Covered("extinction", 3e-5, errors=6.0, valued=0.9),)),
        _case("S14 overlap of scale 2 km", build=lambda: _overlapped(2000.0), solve=solve_path,
              expected=(Flagged(_WRONG),)),
        _case("S15 signal 1e5, 1.7 km",
              build=lambda: _STEEP.arguments(power=_STEEP.noisy(4000)),
              solve=partial(scattered, _STEEP),
              expected=(Between("RMSE over bound", 0.95, 1.05), Between("coverage", 0.93, 0.97))),
        _case("S16 inverted signal",
              build=lambda: CLEAR.arguments(power=740.0 - CLEAR.noisy()), solve=solve_path,
              expected=(Flagged(Quality.NEGATIVE_AMPLITUDE),)),
        _case("S17 ranges that are not uniform", build=_irregular_arguments, solve=solve_path,
              expected=(Covered("extinction", 3e-5, valued=0.99),)),
        _case("S17 the same, cubic", build=lambda: _irregular_arguments(method="cubic"),
              solve=solve_path, expected=(Refused(RetrievalInputError, "range"),)),
        _case("S18 cloud of 200 on 4 bins", build=lambda: _raised(100, 4, 200.0),
              solve=solve_path, expected=(Between("reduced_chi2", 100.0, np.inf), Flagged(_WRONG))),
        _case("one bin 8 standard deviations off", build=lambda: _raised(100, 1, 8.0),
              solve=solve_path, expected=(Flagged(Quality.OUTLIER, 0.95),
                                     Covered("extinction", 3e-5, valued=0.5))),
    )  # fmt: skip


# Unsolvable cases, and invariances ----------------------------------------------------------


def _flat(value: float) -> dict[str, Any]:
    return {"power": np.full((3, 225), value), "range": CLEAR.range}


def _few(bins: int, **options: Any) -> dict[str, Any]:
    path = replace(CLEAR, bins=bins)
    return {"power": path.noisy(20), "range": path.range, "variance": 1.0, **options}


def _holed(first: int, bins: int, value: float = np.nan) -> dict[str, Any]:
    power = CLEAR.noisy()
    power[:, first : first + bins] = value
    return CLEAR.arguments(power=power)


def _sparse() -> dict[str, Any]:
    power = CLEAR.noisy()
    power[np.random.default_rng(5).random(power.shape) < 0.3] = np.nan
    return CLEAR.arguments(power=power)


def _noise_alone() -> dict[str, Any]:
    noise = np.random.default_rng(6).standard_normal((50_000, 225))
    return CLEAR.arguments(power=noise)


def _mixed() -> dict[str, Any]:
    power = CLEAR.noisy(6)
    power[1], power[3, ::2], power[4] = np.nan, np.inf, 0.0
    return CLEAR.arguments(power=power)


def _one_by_one() -> Answer:
    together = path_fit.fit_homogeneous_path(**_mixed())
    separate = [
        path_fit.fit_homogeneous_path(**_mixed() | {"power": row}) for row in _mixed()["power"]
    ]
    same = all(
        np.array_equal(
            getattr(together, name), [getattr(fit, name) for fit in separate], equal_nan=True
        )
        for name in ("background", "amplitude", "extinction", "quality", "reduced_chi2")
    )
    return Answer({"same bits": float(same)})


def _scaled(factor: float) -> dict[str, Any]:
    return CLEAR.arguments(power=CLEAR.noisy() * factor, variance=factor**2)


def _long(bins: int, method: str) -> dict[str, Any]:
    path = replace(CLEAR, bins=bins)
    return {"power": path.noisy(1, seed=7), "range": path.range, "variance": 1.0, "method": method}


def _memory(**arguments: Any) -> Answer:
    """Return the peak memory of a solution."""
    tracemalloc.start()
    solve_path(**arguments)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return Answer({"MB": peak / 1e6})


# 1e-6 of a value is 1e-4 of its standard error here: the tolerance between methods.
_SAME: Final = (Near("change", 0.0, 1e-6, relative=False), Near("same flags", 1.0, 0.0))


def _unsolvable() -> tuple[StiffCase, ...]:
    no_value = (Missing("extinction"), Missing("extinction_standard_error"))
    return (
        *(
            _case(f"S10 constant {value:g}", build=partial(_flat, value), solve=solve_path,
                  expected=(Flagged(Quality.NO_SIGNAL),
                            Near("background", value, 0.0, relative=False),
                            Near("amplitude", 0.0, 0.0, relative=False), Missing("extinction")))
            for value in (0.0, 370.0, -2.0, 1e30, 1e-310)
        ),
        _case("S10 all NaN", build=lambda: _flat(np.nan), solve=solve_path,
              expected=(Flagged(Quality.INPUT_MISSING), Missing("background"), *no_value)),
        _case("all infinite", build=lambda: _flat(np.inf), solve=solve_path,
              expected=(Flagged(Quality.INPUT_MISSING), Missing("background"), *no_value)),
        _case("S10 7 bins", build=lambda: _few(7), solve=solve_path,
              expected=(Flagged(Quality.TOO_FEW_BINS),)),
        _case("7 of 225 bins valid", build=lambda: _holed(7, 218), solve=solve_path,
              expected=(Flagged(Quality.TOO_FEW_BINS),)),
        _case("S10 3 bins", build=lambda: _few(3), solve=solve_path,
              expected=(Flagged(Quality.TOO_FEW_BINS), *no_value)),
        _case("S10 cubic, 3 bins", build=lambda: {"power": replace(CLEAR, bins=3).power,
                                                  "range": replace(CLEAR, bins=3).range},
              solve=cubic, expected=(Flagged(Quality.TOO_FEW_BINS),)),
        _case("one bin", build=lambda: {"power": [[370.0]], "range": [2500.0]}, solve=solve_path,
              expected=(Flagged(Quality.TOO_FEW_BINS | Quality.NO_SIGNAL), *no_value)),
        _case("no profile", build=lambda: {"power": np.empty((0, 225)), "range": CLEAR.range},
              solve=solve_path, expected=(Unflagged(),)),
        _case("pure noise, 50 000 profiles", build=_noise_alone, solve=solve_path,
              expected=(Rejected(1.0 - 1e-4),)),
        _case("gap of 60 bins", build=lambda: _holed(80, 60), solve=solve_path,
              expected=(Covered("extinction", 3e-5, valued=0.99),)),
        _case("30 % of the bins missing", build=_sparse, solve=solve_path,
              expected=(Covered("extinction", 3e-5, valued=0.99),)),
        _case("first 20 bins infinite", build=lambda: _holed(0, 20, np.inf), solve=solve_path,
              expected=(Covered("extinction", 3e-5, valued=0.99),)),
        _case("background below zero", solve=solve_path,
              build=lambda: CLEAR.arguments(power=CLEAR.noisy() - 372.0),
              expected=(Covered("extinction", 3e-5, valued=0.99),)),
        _case("profiles missing, infinite and zero among good ones", build=dict,
              solve=_one_by_one, expected=(Near("same bits", 1.0, 0.0),)),
        _case("no noise at all, stated so", build=lambda: _exact(CLEAR, variance=0.0),
              solve=solve_path, expected=(Covered("extinction", 3e-5), Rejected())),
        _case("infinite variance in all bins", build=lambda: CLEAR.arguments(variance=np.inf),
              solve=solve_path, expected=(Rejected(), *no_value)),
        _case("a variance of 1e300", build=lambda: CLEAR.arguments(variance=1e300),
              solve=solve_path, expected=(Rejected(),)),
        _case("200 000 bins, direct", build=partial(_long, 200_000, "direct"), solve=solve_path,
              expected=(Covered("extinction", 3e-5, valued=1.0),)),
        _case("a million bins", build=partial(_long, 1_000_000, "direct"), solve=solve_path,
              expected=(Covered("extinction", 3e-5, valued=1.0),)),
        *(
            _case(f"memory of {bins} bins, {most} MB at most", solve=_memory,
                  build=partial(_long, bins, "direct"),
                  expected=(Between("MB", 0.0, float(most)),))
            for bins, most in ((4096, 100), (1_000_000, 1000))
        ),
        _case("8 bins", build=lambda: _few(8), solve=solve_path,
              expected=(Covered("extinction", 3e-5),)),
        *(
            _case(f"signals times {factor:g}", build=partial(_scaled, factor), solve=_rescaled,
                  expected=_SAME)
            for factor in (1e-30, 1e30, 1e-140, 1e140)
        ),
        _case("denormal signals", build=lambda: {**_scaled(1.0), "power": CLEAR.noisy() * 1e-312,
                                                 "variance": None},
              solve=solve_path, expected=(Covered("extinction", 3e-5),)),
    )  # fmt: skip


def _rescaled(power: Array, range: Array, variance: float) -> Answer:  # noqa: A002
    factor = np.sqrt(variance)
    scaled = path_fit.fit_homogeneous_path(power, range, variance=variance)
    unscaled = path_fit.fit_homogeneous_path(power / factor, range, variance=1.0)
    change = max(
        float(np.max(np.abs(scaled.extinction / unscaled.extinction - 1.0))),
        float(np.max(np.abs(scaled.background / factor / unscaled.background - 1.0))),
    )
    alike = float(np.array_equal(scaled.quality, unscaled.quality))
    return Answer({"change": change, "same flags": alike}, np.asarray(scaled.quality))


def _refusals() -> tuple[StiffCase, ...]:
    def wrong(name: str, field: str, **changed: Any) -> StiffCase:
        arguments = {"power": CLEAR.power, "range": CLEAR.range, **changed}
        return _case(name, build=lambda: arguments, solve=solve_path,
                     expected=(Refused(RetrievalInputError, field),))  # fmt: skip

    r = CLEAR.range
    return (
        wrong("range in km", "range", range=r / 1e3),
        wrong("range with a NaN", "range", range=np.where(r == r[5], np.nan, r)),
        wrong("range with one value twice", "range", range=np.where(r == r[5], r[4], r)),
        wrong("range from zero", "range", range=r - r[0]),
        wrong("range of another length", "power", range=r[:-1]),
        wrong("range of two dimensions", "range", range=r[np.newaxis]),
        wrong("negative variance", "variance", variance=-1.0),
        wrong("variance of another shape", "variance", variance=np.ones(7)),
        wrong("unknown method", "method", method="magic"),
        wrong("extinction in km-1 as prior", "extinction", extinction=0.3, method="linearized"),
    )  # fmt: skip


def stiff_homogeneous_cases() -> tuple[StiffCase, ...]:
    """Return all stiff cases of the homogeneous path."""
    return (*_study(), *_unsolvable(), *_refusals())
