"""Ill-conditioned and extreme cases of the optical depth from scans."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np

from benchmarks.scenes import scans
from benchmarks.scenes.scans import Scene
from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.multiangle.flags import MultiAngleQuality
from support.scan_arguments import retrieve_optical_depth
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
)

_case = partial(StiffCase, retrieval=Retrieval.MULTIANGLE)


def _solve_scan(altitudes: slice = slice(None), **arguments: Any) -> Answer:
    """Return some altitudes of the solution; its standard errors include the gradient error."""
    result = retrieve_optical_depth(**arguments)
    values = {
        "optical_depth": result.optical_depth,
        "optical_depth_standard_error": np.hypot(
            result.optical_depth_standard_error, result.optical_depth_gradient_error
        ),
        "optical_depth_random_error": result.optical_depth_standard_error,
        "extinction": result.extinction,
        "extinction_standard_error": np.hypot(
            result.extinction_standard_error, result.extinction_gradient_error
        ),
    }
    selected = {name: value[..., altitudes] for name, value in values.items()}
    top = np.asarray(result.optical_depth_standard_error)[..., -1]
    return Answer(selected | {"random error at the top": top}, result.quality[:, altitudes])


@cache
def _drawn(scene_of: Any, profiles: int, *seed: int) -> tuple[Scene, Array, Array]:
    scene = scene_of()
    scan = scene.draw(profiles, *seed)
    return scene, scan.signal, scan.variance


def _clear() -> Scene:
    return scans.clear(3000.0)


def _short() -> Scene:
    return scans.clear(3000.0, bins=60)


def scan_arguments(
    scene_of: Any = _short, profiles: int = 16, *seed: int, **more: Any
) -> dict[str, Any]:
    """Return the arguments of `_solve_scan` for scans of a scene."""
    scene, signal, variance = _drawn(scene_of, profiles, *(seed or (41,)))
    arguments = {
        "signal": signal,
        "variance": variance,
        "zenith_angle": scene.zenith_angle,
        "altitude": scene.altitude,
        "method": "joint",
    }
    return arguments | more


def _truth(scene_of: Any = _short) -> Array:
    return np.asarray(scene_of().optical_depth)


def _angles(*angles: float, extinction: float = 1e-4, scatter: float = 0.03) -> Scene:
    """Return a scene of 200 altitudes of constant extinction and some angles."""
    height = 15.0 * np.arange(1, 201, dtype=np.float64)
    return Scene("", np.array(angles), height, np.full(200, extinction), np.ones(200), 3000.0,
                 scatter)  # fmt: skip


def _narrow() -> Scene:
    return _angles(*np.linspace(0.0, 15.0, 12))


def _narrowest() -> Scene:
    return _angles(*np.degrees(np.arccos(1.0 / np.linspace(1.0, 1.001, 12))))


def _thick() -> Scene:
    height = 1000.0 + 10.0 * np.arange(1, 61, dtype=np.float64)
    layers = np.full(60, 20.0 / 600.0)
    # The air below the base is one layer of the scene.
    layers[0] *= 10.0 / height[0]
    return Scene("", np.linspace(0.0, 30.0, 6), height, layers, np.ones(60), 1e4, 0.03)


def _null_space() -> Scene:
    calm = _angles(*np.linspace(0.0, 60.0, 12), extinction=8e-5, scatter=1e-3)
    return replace(calm, ratio=1e6)


def _weak() -> Scene:
    return replace(_short(), ratio=10.0)


def _close_beams() -> Scene:
    return _angles(0.0, 0.01, 7.0, 7.0, 15.0)


def _blocks_of_constant() -> Answer:
    results = [
        retrieve_optical_depth(**scan_arguments(_null_space, 16, seed, largest_gradient=0.0))
        for seed in range(20)
    ]
    return Answer({
        "optical depth at the top": np.stack([result.optical_depth[:, -1] for result in results]),
        "share doubted": np.mean([
            result.raised(MultiAngleQuality.PRIOR_DOMINATED).any() for result in results
        ]),
    })  # fmt: skip


def _varying() -> Scene:
    return replace(scans.cloud(0.8, largest=15.0), variation=1.0)


def _with_gaps(**more: Any) -> dict[str, Any]:
    arguments = scan_arguments()
    signal = arguments["signal"].copy()
    signal[np.random.default_rng(42).random(signal.shape) < 0.3] = np.nan
    signal[..., 20:26] = np.nan
    signal[:, ::2, 40:] = np.nan
    return arguments | {"signal": signal} | more


def _with_profile(value: float) -> dict[str, Any]:
    arguments = scan_arguments()
    signal = arguments["signal"].copy()
    signal[3] = value
    return arguments | {"signal": signal}


def _with_sample(value: float) -> dict[str, Any]:
    arguments = scan_arguments()
    signal = arguments["signal"].copy()
    signal[3, 2, 30] = value
    return arguments | {"signal": signal}


def _change_of_others(**arguments: Any) -> Answer:
    """Return the largest change of the other profiles, in their standard errors."""
    rest = np.delete(np.arange(16), 3)
    changed, clean = _solve_scan(**arguments), _solve_scan(**scan_arguments())
    change = (changed.value("optical_depth") - clean.value("optical_depth"))[rest]
    stated = clean.value("optical_depth_standard_error")[rest]
    return Answer({"change": np.nanmax(np.abs(change / stated))})


def _with_horizontal_beams() -> Answer:
    """Compare a scan with two beams along the horizon with the same scan without them."""
    arguments = scan_arguments()
    base, angle = arguments["signal"], arguments["zenith_angle"]
    flat = np.repeat(base[:, -1:], 2, axis=1)
    extended = arguments | {
        "signal": np.concatenate([base, flat], axis=1),
        "variance": np.concatenate([arguments["variance"], flat], axis=1),
        "zenith_angle": np.append(angle, [89.0, 90.0]),
    }
    return _compare(_solve_scan(**extended), _solve_scan(**arguments))


def _compare(first: Answer, other: Answer) -> Answer:
    names = ("optical_depth", "optical_depth_random_error", "extinction")
    change = [np.nanmax(np.abs(first.value(n) / other.value(n) - 1.0), initial=0.0) for n in names]
    same_gaps = all(
        np.array_equal(np.isnan(first.value(n)), np.isnan(other.value(n))) for n in names
    )
    same_flags = np.array_equal(first.quality, other.quality)
    return Answer(
        {"change": max(change), "same flags": float(same_flags and same_gaps)}, first.quality
    )


def _scale_signals(factor: float) -> Answer:
    arguments = scan_arguments()
    scaled = arguments | {
        "signal": arguments["signal"] * factor, "variance": arguments["variance"] * factor**2
    }  # fmt: skip
    return _compare(_solve_scan(**scaled), _solve_scan(**arguments))


def _permute_beams() -> Answer:
    arguments = scan_arguments()
    order = np.random.default_rng(43).permutation(arguments["zenith_angle"].size)
    permuted = arguments | {
        "signal": arguments["signal"][:, order], "variance": arguments["variance"][:, order],
        "zenith_angle": arguments["zenith_angle"][order],
    }  # fmt: skip
    return _compare(_solve_scan(**permuted), _solve_scan(**arguments))


def _without_stated_noise() -> Answer:
    arguments = scan_arguments()
    floor = (1e-6 * arguments["signal"]) ** 2
    noiseless = _solve_scan(**arguments | {"variance": np.zeros_like(floor)})
    return _compare(noiseless, _solve_scan(**arguments | {"variance": floor}))


def _without_empty_beams(method: str) -> Answer:
    """Compare a scan with beams that are all NaN with the same scan without them."""
    arguments = scan_arguments(method=method)
    signal = arguments["signal"].copy()
    signal[:, [3, 7]] = np.nan
    keep = np.delete(np.arange(signal.shape[1]), [3, 7])
    reduced = arguments | {
        "signal": arguments["signal"][:, keep], "variance": arguments["variance"][:, keep],
        "zenith_angle": arguments["zenith_angle"][keep],
    }  # fmt: skip
    return _compare(_solve_scan(**arguments | {"signal": signal}), _solve_scan(**reduced))


def _solve_without_noise(span: float, scale: float) -> Answer:
    """Return the error of a profile without noise, times the span of its slant paths."""
    path = np.linspace(1.0, 1.0 + span, 6)
    height = np.array([1000.0, 2000.0, 3000.0])
    depth = np.array([0.1, 0.2, 0.3])
    signal = scale * np.exp(-2.0 * path[np.newaxis, :, np.newaxis] * depth)
    result = retrieve_optical_depth(
        signal, np.degrees(np.arccos(1.0 / path)), height, variance=1e-12 * signal**2,
        method="kano_hamilton",
    )  # fmt: skip
    return Answer({"error times span": np.abs(result.optical_depth - depth) * span})


def _solved_cases() -> tuple[StiffCase, ...]:
    inside = slice(0, 100)
    same = (Near("change", 0.0, 1e-9, relative=False), Near("same flags", 1.0, 0.0))
    honest = Covered("optical_depth", _truth, most=1e-3)
    return (
        _case("a one beam", build=lambda: scan_arguments(_one_beam), solve=_solve_scan,
              expected=(Flagged(MultiAngleQuality.NO_LEVERAGE), Missing("optical_depth"))),
        _case("b all beams at one angle", build=lambda: scan_arguments(_equal_beams),
              solve=_solve_scan,
              expected=(Flagged(MultiAngleQuality.NO_LEVERAGE), Missing("optical_depth"))),
        _case("slant paths from 1 to 1.035", build=lambda: scan_arguments(_narrow),
              solve=_solve_scan,
              expected=(Covered("optical_depth", partial(_truth, _narrow), most=1e-3),)),
        _case("c slant paths from 1 to 1.001", build=lambda: scan_arguments(_narrowest),
              solve=_solve_scan,
              expected=(Covered("optical_depth", partial(_truth, _narrowest), most=1e-3),)),
        _case("c the same, altitude by altitude: a standard error of 14",
              build=lambda: scan_arguments(_narrowest, method="kano_hamilton"), solve=_solve_scan,
              expected=(Between("random error at the top", 7.0, 28.0),)),
        _case("d beams along the horizon are ignored", build=dict, solve=_with_horizontal_beams,
              expected=same),
        *(
            _case(f"e one profile {value:g}", build=partial(_with_profile, value),
                  solve=_change_of_others, expected=(Near("change", 0.0, 0.5, relative=False),))
            for value in (np.inf, np.nan, 0.0)
        ),
        *(
            _case(f"e one sample {value:g}", build=partial(_with_sample, value),
                  solve=_change_of_others, expected=(Near("change", 0.0, 0.5, relative=False),))
            for value in (1e300, -1e300, np.inf)
        ),
        _case("e the profile with a sample of 1e300", build=lambda: _with_sample(1e300),
              solve=_solve_scan, expected=(honest,)),
        _case("f all signals negative", solve=_solve_scan,
              build=lambda: scan_arguments() | {"signal": -scan_arguments()["signal"]},
              expected=(Missing("optical_depth"), Missing("extinction"), Rejected())),
        _case("all NaN", solve=_solve_scan,
              build=lambda: scan_arguments()
              | {"signal": np.full_like(scan_arguments()["signal"], np.nan)},
              expected=(Missing("optical_depth"), Flagged(Quality.INPUT_MISSING))),
        _case("g 30 % missing, a gap of 6 altitudes, half the beams lost aloft", build=_with_gaps,
              solve=_solve_scan,
              expected=(Covered("optical_depth", _truth, valued=0.9, most=1e-3),)),
        *(
            _case(f"g missing beams have no effect, {method}",
                  build=partial(dict, method=method), solve=_without_empty_beams, expected=same)
            for method in ("kano_hamilton", "joint")
        ),
        _case("h optical depth 20 in 600 m", build=lambda: scan_arguments(_thick, 100),
              solve=_solve_scan,
              expected=(Covered("optical_depth", partial(_truth, _thick), most=5e-3),)),
        _case("h and nothing beyond its reach", build=lambda: scan_arguments(_thick, 100),
              solve=partial(_solve_scan, slice(30, 60)),
              expected=(Missing("optical_depth"), Flagged(MultiAngleQuality.EXTRAPOLATED))),
        _case("i constant extinction: smoothing has no bias, and no block is doubted",
              build=dict, solve=_blocks_of_constant,
              expected=(Near("optical depth at the top", 0.24, 0.01),
                        Between("share doubted", 0.0, 0.1))),
        _case("j signal over noise 10 at the zenith", build=lambda: scan_arguments(_weak, 64),
              solve=_solve_scan,
              expected=(Covered("optical_depth", partial(_truth, _weak), most=1e-3),)),
        *(
            _case(f"k {bins} altitudes", build=partial(_first_altitudes, bins), solve=_solve_scan,
                  expected=(Covered("optical_depth", partial(_first_truth, bins), most=1e-3),))
            for bins in (1, 3)
        ),
        _case("k, p one profile", build=lambda: scan_arguments(_short, 1), solve=_solve_scan,
              expected=(Covered("optical_depth", _truth, valued=0.5, most=1e-3),)),
        *(
            _case(f"l signals times {factor:g}", build=partial(dict, factor=factor),
                  solve=_scale_signals, expected=same)
            for factor in (1e-30, 1e30, 1e-140, 1e140)
        ),
        _case("beams in another order", build=dict, solve=_permute_beams, expected=same),
        _case("m a variance of zero counts as noise of 1e-6 of the signal", build=dict,
              solve=_without_stated_noise, expected=same),
        _case("n beams at 0, 0.01, 7, 7 and 15 degrees", build=lambda: scan_arguments(_close_beams),
              solve=_solve_scan,
              expected=(Covered("optical_depth", partial(_truth, _close_beams), most=1e-3),)),
        *(
            _case(f"n the same, {method}",
                  build=partial(scan_arguments, _close_beams, method=method),
                  solve=_solve_scan, expected=(Accepted(0.5),))
            for method in ("mld", "two_angle", "kano_hamilton", "auto")
        ),
        _case("o cloud at 15 degrees, extinction varies: withheld",
              build=lambda: scan_arguments(_varying, 64), solve=partial(_solve_scan, inside),
              expected=(Missing("extinction"),
                        Flagged(MultiAngleQuality.POOR_STRATIFICATION
                                | MultiAngleQuality.EXTRAPOLATED))),
        *(
            _case(f"without noise, span {span:g}, signals times {scale:g}",
                  build=partial(dict, span=span, scale=scale), solve=_solve_without_noise,
                  expected=(Near("error times span", 0.0, 1e-12, relative=False),))
            for span in (1.0, 0.0353, 0.001) for scale in (1.0, float(np.exp(-20.0)))
        ),
    )  # fmt: skip


def _one_beam() -> Scene:
    return _angles(30.0)


def _equal_beams() -> Scene:
    return _angles(30.0, 30.0, 30.0)


def _first_altitudes(bins: int) -> dict[str, Any]:
    arguments = scan_arguments()
    return arguments | {
        "signal": arguments["signal"][..., :bins], "variance": arguments["variance"][..., :bins],
        "altitude": arguments["altitude"][:bins],
    }  # fmt: skip


def _first_truth(bins: int) -> Array:
    return _truth()[:bins]


def _refused_cases() -> tuple[StiffCase, ...]:
    def wrong(name: str, field: str | None, **more: Any) -> StiffCase:
        return _case(name, build=lambda: scan_arguments() | more, solve=_solve_scan,
                     expected=(Refused(RetrievalInputError, field),))  # fmt: skip

    height = _short().altitude
    return (
        wrong("descending altitudes", "altitude", altitude=height[::-1]),
        wrong("altitude with a NaN", "altitude",
              altitude=np.where(height == height[3], np.nan, height)),
        wrong("altitudes below the station", "altitude", station_altitude=1000.0),
        wrong("zenith angle of 200 degrees", "zenith_angle",
              zenith_angle=np.linspace(0.0, 200.0, 12)),
        wrong("one angle too few", None, zenith_angle=np.linspace(0.0, 70.0, 11)),
        wrong("negative variance", "variance", variance=-1.0),
        wrong("negative gradient", "largest_gradient", largest_gradient=-1.0),
        wrong("unknown method", "method", method="magic"),
        wrong("altitudes that are not uniform, joined", "altitude",
              altitude=height + np.where(height > 1000.0, 5.0, 0.0)),
    )  # fmt: skip


def stiff_scan_cases() -> tuple[StiffCase, ...]:
    """Return all cases."""
    return (*_solved_cases(), *_refused_cases())
