"""Stiff and extreme cases of the optical depth from scans."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from typing import Any, Final

import numpy as np

from lidarops.bench.accuracy import multiangle_cases
from lidarops.bench.accuracy.multiangle_cases import Scene
from lidarops.bench.stability.stiff_cases import (
    REJECTING,
    Answer,
    Array,
    Between,
    Honest,
    Missing,
    Near,
    Raised,
    Refused,
    Retrieval,
    Stands,
    StiffCase,
)
from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.multiangle import optical_depth

_case = partial(StiffCase, retrieval=Retrieval.MULTIANGLE)
_ANY: Final = Quality(REJECTING)
BITS: Final = {
    "no_data": Quality.NO_LEVERAGE,
    "extrapolated": Quality.EXTRAPOLATED,
    "interpolated": Quality.INTERPOLATED,
    "no_residual": Quality.NO_RESIDUAL,
    "low_leverage": Quality.LOW_LEVERAGE,
    "one_sided": Quality.ONE_SIDED,
    "gradient": Quality.HORIZONTAL_GRADIENT,
    "poor_stratification": Quality.POOR_STRATIFICATION,
    "prior_dominated": Quality.PRIOR_DOMINATED,
    "saturated": Quality.PRIOR_DOMINATED,
    "undersmoothed": Quality.UNDERSMOOTHED,
    "high_correlation": Quality.HIGH_CORRELATION,
    "outlier": Quality.OUTLIER,
}
"""As the products spell the flags."""


def solve_scan(part: slice = slice(None), **arguments: Any) -> Answer:
    """Solve, and return altitudes of every profile; the gradient error is part of the stated."""
    found = optical_depth.retrieve_optical_depth(**arguments)
    bits = np.asarray(found.quality).copy()
    for name, bit in BITS.items():
        bits |= np.where(getattr(found.flags, name), np.int32(bit), np.int32(0))
    values = {
        "optical_depth": found.optical_depth,
        "optical_depth_standard_error": np.hypot(
            found.optical_depth_standard_error, found.optical_depth_gradient_error
        ),
        "optical_depth_random_error": found.optical_depth_standard_error,
        "extinction": found.extinction,
        "extinction_standard_error": np.hypot(
            found.extinction_standard_error, found.extinction_gradient_error
        ),
    }
    cut = {name: value[..., part] for name, value in values.items()}
    top = np.asarray(found.optical_depth_standard_error)[..., -1]
    return Answer(cut | {"random error at the top": top}, bits[..., part])


@cache
def _drawn(scene_of: Any, profiles: int, *seed: int) -> tuple[Scene, Array, Array]:
    scene = scene_of()
    scan = scene.draw(profiles, *seed)
    return scene, scan.signal, scan.variance


def _clear() -> Scene:
    return multiangle_cases.clear(3000.0)


def _short() -> Scene:
    return multiangle_cases.clear(3000.0, bins=60)


def scan_arguments(
    scene_of: Any = _short, profiles: int = 16, *seed: int, **more: Any
) -> dict[str, Any]:
    """Return arguments of `solve_scan` for scans of a scene."""
    scene, signal, variance = _drawn(scene_of, profiles, *(seed or (41,)))
    given = {
        "signal": signal,
        "variance": variance,
        "zenith_angle": scene.zenith_angle,
        "altitude": scene.altitude,
        "method": "joint",
    }
    return given | more


def _truth(scene_of: Any = _short) -> Array:
    return np.asarray(scene_of().optical_depth)


def _angles(*angles: float, extinction: float = 1e-4, scatter: float = 0.03) -> Scene:
    """Return 200 altitudes of constant extinction, seen at some angles."""
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
    # All below the base is one layer of the scene.
    layers[0] *= 10.0 / height[0]
    return Scene("", np.linspace(0.0, 30.0, 6), height, layers, np.ones(60), 1e4, 0.03)


def _null_space() -> Scene:
    still = _angles(*np.linspace(0.0, 60.0, 12), extinction=8e-5, scatter=1e-3)
    return replace(still, ratio=1e6)


def _weak() -> Scene:
    return replace(_short(), ratio=10.0)


def _five() -> Scene:
    return _angles(0.0, 0.01, 7.0, 7.0, 15.0)


def _blocks_of_constant() -> Answer:
    found = [
        optical_depth.retrieve_optical_depth(
            **scan_arguments(_null_space, 16, seed, largest_gradient=0.0)
        )
        for seed in range(20)
    ]
    return Answer({
        "optical depth at the top": np.stack([one.optical_depth[:, -1] for one in found]),
        "share saturated": np.mean([one.flags.saturated.all() for one in found]),
    })  # fmt: skip


def _varying() -> Scene:
    return replace(multiangle_cases.cloud(0.8, largest=15.0), variation=1.0)


def _holes(**more: Any) -> dict[str, Any]:
    given = scan_arguments()
    signal = given["signal"].copy()
    signal[np.random.default_rng(42).random(signal.shape) < 0.3] = np.nan
    signal[..., 20:26] = np.nan
    signal[:, ::2, 40:] = np.nan
    return given | {"signal": signal} | more


def _one_bad(value: float) -> dict[str, Any]:
    given = scan_arguments()
    signal = given["signal"].copy()
    signal[3] = value
    return given | {"signal": signal}


def _bin(value: float) -> dict[str, Any]:
    given = scan_arguments()
    signal = given["signal"].copy()
    signal[3, 2, 30] = value
    return given | {"signal": signal}


def _others_alike(**given: Any) -> Answer:
    """Return the largest change of the other profiles, in their standard errors."""
    rest = np.delete(np.arange(16), 3)
    one, clean = solve_scan(**given), solve_scan(**scan_arguments())
    change = (one.value("optical_depth") - clean.value("optical_depth"))[rest]
    stated = clean.value("optical_depth_standard_error")[rest]
    return Answer({"change": np.nanmax(np.abs(change / stated))})


def _infinite_beam() -> Answer:
    """Compare a scan with two beams along the horizon with the same without them."""
    given = scan_arguments()
    base, angle = given["signal"], given["zenith_angle"]
    flat = np.repeat(base[:, -1:], 2, axis=1)
    more = given | {
        "signal": np.concatenate([base, flat], axis=1),
        "variance": np.concatenate([given["variance"], flat], axis=1),
        "zenith_angle": np.append(angle, [89.0, 90.0]),
    }
    one, other = solve_scan(**more), solve_scan(**given)
    return _compared(one, other)


def _compared(one: Answer, other: Answer) -> Answer:
    names = ("optical_depth", "optical_depth_random_error", "extinction")
    change = [np.nanmax(np.abs(one.value(n) / other.value(n) - 1.0), initial=0.0) for n in names]
    holes = all(np.array_equal(np.isnan(one.value(n)), np.isnan(other.value(n))) for n in names)
    alike = np.array_equal(one.quality, other.quality)
    return Answer({"change": max(change), "same flags": float(alike and holes)}, one.quality)


def _scaled(factor: float) -> Answer:
    given = scan_arguments()
    bright = given | {
        "signal": given["signal"] * factor, "variance": given["variance"] * factor**2
    }  # fmt: skip
    return _compared(solve_scan(**bright), solve_scan(**given))


def _permuted() -> Answer:
    given = scan_arguments()
    order = np.random.default_rng(43).permutation(given["zenith_angle"].size)
    turned = given | {
        "signal": given["signal"][:, order], "variance": given["variance"][:, order],
        "zenith_angle": given["zenith_angle"][order],
    }  # fmt: skip
    return _compared(solve_scan(**turned), solve_scan(**given))


def _floor() -> Answer:
    given = scan_arguments()
    floor = (1e-6 * given["signal"]) ** 2
    one = solve_scan(**given | {"variance": np.zeros_like(floor)})
    return _compared(one, solve_scan(**given | {"variance": floor}))


def _subset(method: str) -> Answer:
    """Compare beams that are all NaN with the same scan without them."""
    given = scan_arguments(method=method)
    signal = given["signal"].copy()
    signal[:, [3, 7]] = np.nan
    keep = np.delete(np.arange(signal.shape[1]), [3, 7])
    less = given | {
        "signal": given["signal"][:, keep], "variance": given["variance"][:, keep],
        "zenith_angle": given["zenith_angle"][keep],
    }  # fmt: skip
    return _compared(solve_scan(**given | {"signal": signal}), solve_scan(**less))


def _exact(span: float, scale: float) -> Answer:
    """Return the error of a profile without noise times its span, logarithms near -20."""
    path = np.linspace(1.0, 1.0 + span, 6)
    height = np.array([1000.0, 2000.0, 3000.0])
    depth = np.array([0.1, 0.2, 0.3])
    signal = scale * np.exp(-2.0 * path[:, np.newaxis] * depth)
    found = optical_depth.retrieve_optical_depth(
        signal, np.degrees(np.arccos(1.0 / path)), height, variance=1e-12 * signal**2,
        method="kano_hamilton",
    )  # fmt: skip
    return Answer({"error times span": np.abs(found.optical_depth - depth) * span})


def _listed() -> tuple[StiffCase, ...]:
    inside = slice(0, 100)
    alike = (Near("change", 0.0, 1e-9, relative=False), Near("same flags", 1.0, 0.0))
    honest = Honest("optical_depth", _truth, most=1e-3)
    return (
        _case("a one beam", build=lambda: scan_arguments(_one), solve=solve_scan,
              expected=(Raised(Quality.NO_LEVERAGE), Missing("optical_depth"))),
        _case("b all beams alike", build=lambda: scan_arguments(_alike), solve=solve_scan,
              expected=(Raised(Quality.NO_LEVERAGE), Missing("optical_depth"))),
        _case("slant paths from 1 to 1.035", build=lambda: scan_arguments(_narrow), solve=solve_scan,
              expected=(Raised(Quality.LOW_LEVERAGE),
                        Honest("optical_depth", partial(_truth, _narrow), most=1e-3))),
        _case("c slant paths from 1 to 1.001", build=lambda: scan_arguments(_narrowest), solve=solve_scan,
              expected=(Raised(Quality.LOW_LEVERAGE | Quality.NO_LEVERAGE),
                        Honest("optical_depth", partial(_truth, _narrowest), most=1e-3))),
        _case("c the same, altitude by altitude: a standard error of 14",
              build=lambda: scan_arguments(_narrowest, method="kano_hamilton"), solve=solve_scan,
              expected=(Raised(Quality.LOW_LEVERAGE),
                        Between("random error at the top", 7.0, 28.0))),
        _case("d beams along the horizon are left out", build=dict, solve=_infinite_beam,
              expected=alike),
        *(
            _case(f"e one profile {value:g}", build=partial(_one_bad, value),
                  solve=_others_alike, expected=(Near("change", 0.0, 0.5, relative=False),))
            for value in (np.inf, np.nan, 0.0)
        ),
        *(
            _case(f"e one bin {value:g}", build=partial(_bin, value),
                  solve=_others_alike, expected=(Near("change", 0.0, 0.5, relative=False),))
            for value in (1e300, -1e300, np.inf)
        ),
        _case("e the profile with a bin of 1e300", build=lambda: _bin(1e300), solve=solve_scan,
              expected=(honest,)),
        _case("f all signals negative", solve=solve_scan,
              build=lambda: scan_arguments() | {"signal": -scan_arguments()["signal"]},
              expected=(Missing("optical_depth"), Missing("extinction"), Raised(_ANY))),
        _case("all NaN", solve=solve_scan,
              build=lambda: scan_arguments() | {"signal": np.full_like(scan_arguments()["signal"], np.nan)},
              expected=(Missing("optical_depth"), Raised(Quality.INPUT_MISSING))),
        _case("g 30 % missing, a hole of 6 altitudes, half the beams lost aloft", build=_holes,
              solve=solve_scan, expected=(Honest("optical_depth", _truth, valued=0.9, most=1e-3),)),
        *(
            _case(f"g beams that are missing are as if not there, {method}",
                  build=partial(dict, method=method), solve=_subset, expected=alike)
            for method in ("kano_hamilton", "joint")
        ),
        _case("h optical depth 20 in 600 m", build=lambda: scan_arguments(_thick, 100), solve=solve_scan,
              expected=(Honest("optical_depth", partial(_truth, _thick), most=5e-3),)),
        _case("h and nothing beyond its reach", build=lambda: scan_arguments(_thick, 100),
              solve=partial(solve_scan, slice(30, 60)),
              expected=(Missing("optical_depth"), Raised(Quality.EXTRAPOLATED))),
        _case("i constant extinction: smoothness costs nothing, and most blocks say so",
              build=dict, solve=_blocks_of_constant,
              expected=(Near("optical depth at the top", 0.24, 0.01),
                        Between("share saturated", 0.75, 1.0))),
        _case("j signal over noise 10 at the zenith", build=lambda: scan_arguments(_weak, 64),
              solve=solve_scan, expected=(Honest("optical_depth", partial(_truth, _weak), most=1e-3),)),
        *(
            _case(f"k {bins} altitudes", build=partial(_cut, bins), solve=solve_scan,
                  expected=(Honest("optical_depth", partial(_lowest, bins), most=1e-3),))
            for bins in (1, 3)
        ),
        _case("k, p one profile", build=lambda: scan_arguments(_short, 1), solve=solve_scan,
              expected=(Honest("optical_depth", _truth, valued=0.5, most=1e-3),)),
        *(
            _case(f"l signals times {factor:g}", build=partial(dict, factor=factor),
                  solve=_scaled, expected=alike)
            for factor in (1e-30, 1e30, 1e-140, 1e140)
        ),
        _case("beams in another order", build=dict, solve=_permuted, expected=alike),
        _case("m no noise stated counts as 1e-6 of the signal", build=dict, solve=_floor,
              expected=alike),
        _case("n beams at 0, 0.01, 7, 7 and 15 degrees", build=lambda: scan_arguments(_five),
              solve=solve_scan,
              expected=(Honest("optical_depth", partial(_truth, _five), most=1e-3),)),
        *(
            _case(f"n the same, {method}", build=partial(scan_arguments, _five, method=method),
                  solve=solve_scan, expected=(Stands(0.5),))
            for method in ("mld", "two_angle", "kano_hamilton", "auto")
        ),
        _case("o cloud at 15 degrees, extinction varies: withheld",
              build=lambda: scan_arguments(_varying, 64), solve=partial(solve_scan, inside),
              expected=(Missing("extinction"),
                        Raised(Quality.POOR_STRATIFICATION | Quality.EXTRAPOLATED))),
        *(
            _case(f"without noise, span {span:g}, signals times {scale:g}",
                  build=partial(dict, span=span, scale=scale), solve=_exact,
                  expected=(Near("error times span", 0.0, 1e-12, relative=False),))
            for span in (1.0, 0.0353, 0.001) for scale in (1.0, float(np.exp(-20.0)))
        ),
    )  # fmt: skip


def _one() -> Scene:
    return _angles(30.0)


def _alike() -> Scene:
    return _angles(30.0, 30.0, 30.0)


def _cut(bins: int) -> dict[str, Any]:
    given = scan_arguments()
    return given | {
        "signal": given["signal"][..., :bins], "variance": given["variance"][..., :bins],
        "altitude": given["altitude"][:bins],
    }  # fmt: skip


def _lowest(bins: int) -> Array:
    return _truth()[:bins]


def _refusals() -> tuple[StiffCase, ...]:
    def wrong(name: str, field: str | None, **more: Any) -> StiffCase:
        return _case(name, build=lambda: scan_arguments() | more, solve=solve_scan,
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
        wrong("block labels as floats", "block", block=np.zeros(16)),
        wrong("unknown method", "method", method="magic"),
        wrong("altitudes that are not uniform, joined", "altitude",
              altitude=height + np.where(height > 1000.0, 5.0, 0.0)),
    )  # fmt: skip


def stiff_scan_cases() -> tuple[StiffCase, ...]:
    """Return all of them."""
    return (*_listed(), *_refusals())
