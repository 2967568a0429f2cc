"""Stiff and extreme cases of the elastic inversion and of its reference window."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache, partial
from typing import Any, Final

import numpy as np
from scipy import special

from benchmarks.scenes import elastic_skies
from lidarops.errors import RetrievalInputError
from lidarops.retrieve.air import reference_window
from lidarops.retrieve.clouds import layers
from lidarops.retrieve.elastic.flags import ElasticQuality
from support.inversions import invert_elastic
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

_case = partial(StiffCase, retrieval=Retrieval.ELASTIC)
_LOST: Final = ElasticQuality.UNSTABLE_INVERSION | ElasticQuality.NO_REFERENCE
_CANDIDATES: Final = reference_window.candidate_windows(4000.0, 12000.0, 1000.0, 250.0)
_SCALE: Final = 2e-5
"""m-1 sr-1, of the particles below 1.75 km."""


@cache
def sky() -> elastic_skies.SimulatedSky:
    """Return the simulated sky (cached)."""
    return elastic_skies.simulated_sky()


def elastic_arguments(draws: int = 1, *, level: float = 1.0, noise: bool = True) -> dict[str, Any]:
    """Return arguments of `solve_elastic` for 400 m to 12 km, with background subtracted."""
    air = sky()
    bins = (air.range > 400.0) & (air.range < 12e3)
    if noise:
        counts = air.counts(level, draws, 31)
        power, variance = counts - level, elastic_skies.count_variance(counts)
    else:
        power = np.broadcast_to(air.signal, (draws, air.range.size))
        variance = 1e-12 * power**2
    return {
        "power": power[:, bins],
        "range": air.range[bins],
        "molecular_backscatter": air.air.backscatter(air.range, elastic_skies.WAVELENGTH)[bins],
        "molecular_extinction": air.air.extinction(air.range, elastic_skies.WAVELENGTH)[bins],
        "lidar_ratio": elastic_skies.LIDAR_RATIO,
        "reference": (7000.0, 8000.0),
        "variance": variance[:, bins],
    }


def truth() -> Array:
    """Return the backscatter of the particles in the bins of `elastic_arguments`."""
    air = sky()
    return np.asarray(air.backscatter[(air.range > 400.0) & (air.range < 12e3)])


def solve_elastic(compared: tuple[float, float] = (500.0, 6000.0), **arguments: Any) -> Answer:
    """Return the inverted backscatter of particles between two ranges."""
    result = invert_elastic(**arguments)
    r = np.asarray(arguments["range"])
    inside = (r >= compared[0]) & (r <= compared[1])
    bits = np.where(result.valid, np.int32(0), np.int32(ElasticQuality.UNSTABLE_INVERSION))
    no_reference = np.where(result.calibrated, np.int32(0), np.int32(ElasticQuality.NO_REFERENCE))
    bits = np.bitwise_or(bits, no_reference[..., np.newaxis])
    return Answer(
        {
            "backscatter": result.backscatter[..., inside],
            "backscatter_standard_error": result.backscatter_standard_error[..., inside],
            "mean backscatter": np.mean(result.backscatter[..., inside], axis=-1),
        },
        np.broadcast_to(bits, result.backscatter.shape)[..., inside],
    )


def _inside(low: float = 500.0, high: float = 6000.0) -> Array:
    r = elastic_arguments(noise=False)["range"]
    return np.asarray(truth()[(r >= low) & (r <= high)])


def _changed(**changes: Any) -> dict[str, Any]:
    return elastic_arguments(50) | changes


def _constant(value: float) -> dict[str, Any]:
    return _changed(power=np.full((2, elastic_arguments()["range"].size), value), variance=1.0)


def _scaled(factor: float) -> dict[str, Any]:
    arguments = elastic_arguments(50)
    return arguments | {
        "power": arguments["power"] * factor,
        "variance": arguments["variance"] * factor**2,
    }


def _gapped(width: float, centre: float = 3000.0) -> dict[str, Any]:
    arguments = elastic_arguments(50)
    gap = np.abs(arguments["range"] - centre) < 0.5 * width
    return arguments | {"power": np.where(gap, np.nan, arguments["power"])}


def _thick(depth: float) -> dict[str, Any]:
    """Return arguments with a cloud of this optical depth at 3 km, below the reference window."""
    arguments = elastic_arguments(noise=False)
    r = arguments["range"]
    cloud = np.exp(-0.5 * ((r - 3000.0) / 100.0) ** 2) / (100.0 * np.sqrt(2.0 * np.pi))
    optical_depth = depth * special.ndtr((r - 3000.0) / 100.0)
    added = depth * cloud / elastic_skies.LIDAR_RATIO
    factor = (truth() + arguments["molecular_backscatter"] + added) / (
        truth() + arguments["molecular_backscatter"]
    )
    power = arguments["power"] * factor * np.exp(-2.0 * optical_depth)
    noise = np.full_like(power, (1e-9 * power.max()) ** 2)
    rng = np.random.default_rng(32)
    noisy = power + np.sqrt(noise) * rng.standard_normal((50, r.size))
    return arguments | {"power": noisy, "variance": np.broadcast_to(noise, noisy.shape),
                    "lidar_ratio_standard_error": 1.0}  # fmt: skip


def _behind(depth: float, low: float, high: float) -> Array:
    r = elastic_arguments(noise=False)["range"]
    cloud = np.exp(-0.5 * ((r - 3000.0) / 100.0) ** 2) / (100.0 * np.sqrt(2.0 * np.pi))
    particles = truth() + depth * cloud / elastic_skies.LIDAR_RATIO
    return np.asarray(particles[(r >= low) & (r <= high)])


def _descending() -> dict[str, Any]:
    turned = ("power", "range", "variance", "molecular_backscatter", "molecular_extinction")
    arguments = dict(elastic_arguments(5))
    return arguments | {name: np.asarray(arguments[name])[..., ::-1] for name in turned}


def _coverage(**arguments: Any) -> Answer:
    """Return the share of the bins whose 95 % interval holds the truth."""
    answer = solve_elastic(**arguments)
    deviation = np.abs(answer.value("backscatter") - _inside())
    stated = answer.value("backscatter_standard_error")
    return Answer({"coverage": np.mean(deviation <= 1.96 * stated)}, answer.quality)


def _inversion() -> tuple[StiffCase, ...]:
    covered = Covered("backscatter", _inside, most=1e-3)
    # In 50 profiles of 367 bins, some values differ by more than 4 standard errors by chance.
    tight = Covered("backscatter", _inside, valued=0.99, most=1e-3)
    return (
        _case("no noise", build=lambda: elastic_arguments(noise=False), solve=solve_elastic,
              expected=(Near("backscatter", _inside, 1e-4 * _SCALE, relative=False), Accepted())),
        _case("noise of counts, background 1", build=lambda: elastic_arguments(50), solve=_coverage,
              expected=(Between("coverage", 0.93, 0.97),)),
        _case("background 1e7 counts", build=lambda: elastic_arguments(50, level=1e7),
              solve=solve_elastic, expected=(replace(covered, valued=0.1),)),
        *(
            _case(f"signals times {factor:g}", build=partial(_scaled, factor), solve=solve_elastic,
                  expected=(tight,))
            for factor in (1e-30, 1e30, 1e-140, 1e140)
        ),
        _case("all NaN", build=lambda: _constant(np.nan), solve=solve_elastic,
              expected=(Flagged(_LOST), Missing("backscatter"))),
        _case("zeros", build=lambda: _constant(0.0), solve=solve_elastic,
              expected=(Flagged(_LOST), Missing("backscatter"))),
        _case("inverted signal", build=lambda: _changed(power=-elastic_arguments(50)["power"]),
              solve=solve_elastic, expected=(Flagged(_LOST), Missing("backscatter"))),
        _case("gap of 100 m", build=partial(_gapped, 100.0), solve=solve_elastic,
              expected=(covered,)),
        _case("gap of 500 m: no value below", build=partial(_gapped, 500.0),
              solve=partial(solve_elastic, (500.0, 2700.0)),
              expected=(Flagged(_LOST), Missing("backscatter"))),
        _case("no bin in the reference window",
              build=lambda: _gapped(1100.0, 7500.0), solve=solve_elastic,
              expected=(Flagged(_LOST), Missing("backscatter"))),
        _case("reference window without signal", solve=solve_elastic,
              build=lambda: elastic_arguments(50, level=1e7) | {"reference": (11000.0, 11500.0)},
              expected=(covered,)),
        _case("cloud of optical depth 10 below the reference", build=partial(_thick, 10.0),
              solve=partial(solve_elastic, (500.0, 2500.0)),
              expected=(Covered("backscatter", partial(_behind, 10.0, 500.0, 2500.0),
                               most=1e-3),)),
        _case("lidar ratio 1e-6 sr", build=lambda: _changed(lidar_ratio=1e-6), solve=solve_elastic,
              expected=(Accepted(),)),
        _case("lidar ratio 1e4 sr", build=lambda: _changed(lidar_ratio=1e4), solve=solve_elastic,
              expected=(Accepted(),)),
        _case("wrong lidar ratio (60 for 39 sr), its error stated", solve=solve_elastic,
              build=lambda: _changed(lidar_ratio=60.0, lidar_ratio_standard_error=21.0),
              expected=(Covered("backscatter", _inside, most=1e-3, valued=0.5),)),
        _case("error of 10 % of the reference, stated", solve=solve_elastic,
              build=lambda: _changed(reference_relative_error=0.1),
              expected=(tight,)),
        _case("descending ranges", build=_descending, solve=solve_elastic,
              expected=(Refused(RetrievalInputError, "range"),)),
        _case("one bin", solve=partial(solve_elastic, (0.0, 1e9)),
              build=lambda: {"power": [[1.0]], "range": [500.0], "molecular_backscatter": 1e-6,
                             "molecular_extinction": 1e-5, "lidar_ratio": 40.0,
                             "reference": (400.0, 600.0), "variance": 1e-6},
              expected=(Covered("backscatter", 0.0),)),
        _case("denormal signals", build=lambda: _scaled(1.0) | {
                  "power": elastic_arguments(2)["power"] * 1e-318, "variance": None},
              solve=solve_elastic, expected=(Flagged(_LOST, 0.5),)),
    )  # fmt: skip


def _refused(name: str, field: str | None, **changes: Any) -> StiffCase:
    return _case(name, build=lambda: elastic_arguments() | changes, solve=solve_elastic,
                 expected=(Refused(RetrievalInputError, field),))  # fmt: skip


def _refusals() -> tuple[StiffCase, ...]:
    return (
        _refused("lidar ratio of zero", "lidar_ratio", lidar_ratio=0.0),
        _refused("lidar ratio NaN", "lidar_ratio", lidar_ratio=np.nan),
        _refused("reference in km", "reference", reference=(7.0, 8.0)),
        _refused("reference upside down", "reference", reference=(8000.0, 7000.0)),
        _refused("molecular backscatter in km-1", "molecular_backscatter",
                 molecular_backscatter=1e-3),
        _refused("negative molecular extinction", "molecular_extinction",
                 molecular_extinction=-1e-5),
        _refused("negative variance", "variance", variance=-1.0),
        _refused("negative error of the lidar ratio", "lidar_ratio_standard_error",
                 lidar_ratio_standard_error=-1.0),
        _refused("negative error of the background", "background_standard_error",
                 background_standard_error=-1.0),
        _refused("negative error of the reference", "reference_relative_error",
                 reference_relative_error=-1.0),
        _refused("negative error of the air", "molecular_relative_error",
                 molecular_relative_error=-1.0),
        _refused("error of the lidar ratio NaN", "lidar_ratio_standard_error",
                 lidar_ratio_standard_error=np.nan),
    )  # fmt: skip


# The reference window -------------------------------------------------------------------------


def _choose_window(power: Array, variance: Array, air: elastic_skies.SimulatedSky) -> Answer:
    clouds = layers.find_layers(power, air.range, variance, molecular_attenuated=air.shape)
    window = reference_window.choose_reference(
        power, air.range, variance, molecular_attenuated=air.shape,
        candidates=_CANDIDATES, exclude=clouds,
    )  # fmt: skip
    bits = np.where(window.chosen, np.int32(0), np.int32(ElasticQuality.NO_REFERENCE))
    return Answer({"bottom": window.bottom, "top": window.top}, bits)


def _window(level: float, *, haze: float = 0.0) -> Mapping[str, Any]:
    air = sky()
    counts = air.counts(level, 50, 33)
    power = np.where(air.inverted, counts - level, np.nan)
    # Haze with a scale height of 3 km at all heights.
    power = power * (1.0 + haze * np.exp(-air.range / 3000.0))
    return {"power": power, "variance": elastic_skies.count_variance(counts), "air": air}


def _windows() -> tuple[StiffCase, ...]:
    return (
        _case("reference, clear above 6 km", build=lambda: _window(10.0), solve=_choose_window,
              expected=(Between("bottom", 5700.0, 12000.0), Accepted(0.9))),
        _case("reference, haze at all heights", build=lambda: _window(10.0, haze=20.0),
              solve=_choose_window, expected=(Flagged(ElasticQuality.NO_REFERENCE, 0.9),)),
        _case("reference, background 1e13 counts", build=lambda: _window(1e13),
              solve=_choose_window, expected=(Flagged(ElasticQuality.NO_REFERENCE, 0.9),)),
        _case("reference, all NaN", solve=_choose_window,
              build=lambda: dict(_window(1.0)) | {"power": np.full((2, sky().range.size), np.nan),
                                                  "variance": np.ones(sky().range.size)},
              expected=(Flagged(ElasticQuality.NO_REFERENCE),)),
    )  # fmt: skip


def stiff_elastic_cases() -> tuple[StiffCase, ...]:
    """Return all cases of the elastic retrieval."""
    return (*_inversion(), *_refusals(), *_windows())
