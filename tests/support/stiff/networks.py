"""Stiff and extreme cases of networks of lidars and of visibility."""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np

from benchmarks.scenes.lidar_networks import (
    AIRS,
    FULL_OVERLAP,
    THREE_BY_TWO,
    TRIANGLE,
    Air,
    LidarLine,
    Signals,
    signals,
)
from lidarops.errors import RetrievalInputError
from lidarops.retrieve.air import visibility
from lidarops.retrieve.network import extinction_field
from lidarops.retrieve.network.extinction_field import NetworkResult
from lidarops.retrieve.network.flags import NetworkQuality
from support.stiff.cases import (
    Answer,
    Between,
    Covered,
    Missing,
    Near,
    Refused,
    Rejected,
    Retrieval,
    StiffCase,
)

_case = partial(StiffCase, retrieval=Retrieval.NETWORK)
FLAGGED: Final = NetworkQuality.POORLY_DETERMINED
"""Quality bit that stands for any flag of the retrieval that doubts a value."""
_PROFILES: Final = 200


def _answer(result: NetworkResult) -> Answer:
    """Return the values, with a quality bit where any flag doubts them."""
    bits = np.where(result.flagged, np.int32(FLAGGED), np.int32(0))
    return Answer(
        {
            "extinction": result.extinction,
            "extinction_standard_error": result.extinction_standard_error,
        },
        bits,
    )


def _solve_network(near: bool = True, **arguments: Any) -> Answer:
    """Solve a network; return the near crossings, or all."""
    result = extinction_field.retrieve_network(**arguments)
    answer = _answer(result)
    if not near:
        return answer
    values = {name: answer.value(name)[..., result.near_crossing] for name in answer.values}
    return Answer(values, answer.quality[..., result.near_crossing])


def homogeneous(extinction: float) -> Air:
    """Return homogeneous air."""
    return Air("homogeneous", lambda _: lambda __, up: np.full_like(up, extinction))


def network_arguments(
    lidars: LidarLine = TRIANGLE,
    air: Air = AIRS[0],
    noise: float = 0.01,
    *,
    additive: float = 0.0,
    **more: Any,
) -> dict[str, Any]:
    """Return arguments of `_solve_network` for profiles with relative noise."""
    clean = signals(lidars.network(), air)
    power, variance = clean.draw(noise, _PROFILES, 51, additive=additive)
    arguments: dict[str, Any] = {
        "power": power, "range": clean.range, "network": clean.network, "variance": variance,
        "full_overlap_range": FULL_OVERLAP,
    }  # fmt: skip
    return arguments | more


def _triangle_with_elevation(elevation: float) -> LidarLine:
    """Return the triangle with another elevation of its second beam."""
    return LidarLine("", (300.0, -500.0, 0.0), ((120.0,), (elevation,), (90.0,)))


def _bad_beam(value: float) -> dict[str, Any]:
    arguments = network_arguments()
    power = arguments["power"].copy()
    power[:, 0, :] = value
    return arguments | {"power": power}


def _bad_bin(value: float) -> dict[str, Any]:
    arguments = network_arguments()
    power = arguments["power"].copy()
    crossing_bin = int(
        np.argmin(np.abs(arguments["range"] - arguments["network"].on_beam(0)[1][0]))
    )
    power[:, 0, crossing_bin] = value
    return arguments | {"power": power}


def _scaled(factor: float) -> Answer:
    arguments = network_arguments(noise=0.05)
    bright = arguments | {
        "power": arguments["power"] * factor, "variance": arguments["variance"] * factor**2
    }  # fmt: skip
    bright_answer, answer = _solve_network(**bright), _solve_network(**arguments)
    change = np.nanmax(np.abs(bright_answer.value("extinction") / answer.value("extinction") - 1.0))
    same_flags = np.array_equal(bright_answer.quality, answer.quality)
    return Answer({"change": change, "same flags": float(same_flags)})


def _gains() -> Answer:
    arguments = network_arguments(noise=0.05)
    gain = np.array([1e-6, 1.0, 1e9])[:, np.newaxis]
    scaled = arguments | {
        "power": arguments["power"] * gain,
        "variance": arguments["variance"] * gain**2,
    }
    change = (
        _solve_network(**scaled).value("extinction")
        / _solve_network(**arguments).value("extinction")
        - 1.0
    )
    return Answer({"change": np.nanmax(np.abs(change))})


def _two_lidars() -> dict[str, Any]:
    clean: Signals = signals(LidarLine("", (0.0, 500.0), ((60.0,), (120.0,))).network(), AIRS[0])
    power, variance = clean.draw(0.02, 10, 52)
    return {"power": power, "range": clean.range, "network": clean.network, "variance": variance,
            "full_overlap_range": FULL_OVERLAP, "prior": "none"}  # fmt: skip


def _network_cases() -> tuple[StiffCase, ...]:
    honest = Covered("extinction", 2e-3, most=5e-3)
    return (
        _case("A c start at the far crossing, all crossings together", solve=_solve_network,
              build=lambda: network_arguments(_triangle_with_elevation(30.0)), expected=(honest,)),
        _case("A d visibility of 150 km, noise 0.5 %, network",
              build=lambda: network_arguments(air=homogeneous(2e-5), noise=0.005),
              solve=_solve_network, expected=(Covered("extinction", 2e-5, most=5e-3),)),
        _case("A e extinction of 20 per km, network",
              build=lambda: network_arguments(air=homogeneous(0.02)),
              solve=_solve_network, expected=(Covered("extinction", 0.02, most=5e-3),)),
        _case("homogeneous triangle without noise, network",
              build=lambda: network_arguments(noise=1e-9), solve=_solve_network,
              expected=(Near("extinction", 2e-3, 1e-6),)),
        _case("A g exponent m = 2",
              build=lambda: network_arguments(noise=0.01) | {"exponent": 2.0},
              solve=_solve_network, expected=(honest,)),
        *(
            _case(f"A h a beam of {value:g}", build=partial(_bad_beam, value), solve=_solve_network,
                  expected=(Rejected(),))
            for value in (np.nan, -1.0, np.inf)
        ),
        _case("A h a beam of 0", build=partial(_bad_beam, 0.0), solve=_solve_network,
              expected=(honest,)),
        *(
            _case(f"A h one bin of {value:g}", build=partial(_bad_bin, value), solve=_solve_network,
                  expected=(honest,))
            for value in (np.nan, 0.0, -1e9, np.inf, 1e300)
        ),
        _case("A i one crossing of two beams, without prior", build=_two_lidars,
              solve=partial(_solve_network, near=False),
              expected=(Missing("extinction"), Rejected())),
        *(
            _case(f"signals times {factor:g}", build=partial(dict, factor=factor),
                  solve=_scaled, expected=(Near("change", 0.0, 1e-9, relative=False),
                                           Near("same flags", 1.0, 0.0)))
            for factor in (1e-30, 1e30, 1e-140, 1e140)
        ),
        _case("lidars that differ by 1e15 in brightness", build=dict, solve=_gains,
              expected=(Near("change", 0.0, 1e-9, relative=False),)),
        *(
            _case(f"noise of {100.0 * noise:g} %, {lidars.name}", solve=_solve_network,
                  build=partial(network_arguments, lidars, noise=noise, additive=0.01),
                  expected=(honest,))
            for noise in (0.02, 0.1, 1.0) for lidars in (TRIANGLE, THREE_BY_TWO)
        ),
        _case("one profile", solve=_solve_network,
              build=lambda: network_arguments()
              | {name: network_arguments()[name][0] for name in ("power", "variance")},
              expected=(honest,)),
        _case("no noise stated", build=lambda: network_arguments() | {"variance": 0.0},
              solve=_solve_network, expected=(Rejected(),)),
    )  # fmt: skip


# Visibility -----------------------------------------------------------------------------------


def _visibility_answer(**arguments: Any) -> Answer:
    result = visibility.visibility_from_extinction(**arguments)
    return Answer({"visibility": result.visibility, "lower": result.visibility_lower,
                   "upper": result.visibility_upper})  # fmt: skip


def _visibility_cases() -> tuple[StiffCase, ...]:
    constant = float(np.log(20.0))
    return (
        *(
            _case(f"visibility of extinction {extinction:g} per m",
                  build=partial(dict, extinction=extinction), solve=_visibility_answer,
                  expected=(Near("visibility", constant / extinction, 1e-14),))
            for extinction in (1e-300, 1e-8, 1e-3, 9.9)
        ),
        *(
            _case(f"no visibility of extinction {extinction:g}",
                  build=partial(dict, extinction=extinction), solve=_visibility_answer,
                  expected=(Missing("visibility"),))
            for extinction in (0.0, -1e-3, np.nan, np.inf, -np.inf)
        ),
        _case("visibility of an extinction within its error of zero",
              build=lambda: {"extinction": 1e-5, "standard_error": 2e-5}, solve=_visibility_answer,
              expected=(Between("upper", np.inf, np.inf),
                        Near("lower", constant / 3e-5, 1e-12))),
        _case("extinction in km-1", build=lambda: {"extinction": 20.0}, solve=_visibility_answer,
              expected=(Refused(RetrievalInputError, "extinction"),)),
        _case("contrast of 5 percent as 5", build=lambda: {"extinction": 1e-3, "contrast": 5.0},
              solve=_visibility_answer, expected=(Refused(RetrievalInputError, "contrast"),)),
        _case("negative error of extinction",
              build=lambda: {"extinction": 1e-3, "standard_error": -1.0}, solve=_visibility_answer,
              expected=(Refused(RetrievalInputError, "standard_error"),)),
    )  # fmt: skip


def _refused(name: str, field: str | None, **more: Any) -> StiffCase:
    return _case(name, build=lambda: network_arguments() | more, solve=_solve_network,
                 expected=(Refused(RetrievalInputError, field),))  # fmt: skip


def _refused_cases() -> tuple[StiffCase, ...]:
    return (
        _refused("range in km", "range", range=network_arguments()["range"] / 1e3),
        _refused("a beam is missing", None, power=network_arguments()["power"][:, :2]),
        _refused("negative variance", "variance", variance=-1.0),
        _refused("neither overlap nor range of full overlap", None, full_overlap_range=None),
        _refused("exponent of zero", "exponent", exponent=0.0),
        _refused("unknown prior", "prior", prior="magic"),
    )  # fmt: skip


def stiff_network_cases() -> tuple[StiffCase, ...]:
    """Return all stiff cases of networks and visibility."""
    return (*_network_cases(), *_visibility_cases(), *_refused_cases())
