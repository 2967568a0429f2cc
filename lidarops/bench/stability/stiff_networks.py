"""Stiff and extreme cases of several lidars that look into the same air, and of visibility."""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np

from lidarops.bench.accuracy.network_cases import (
    AIRS,
    FULL_OVERLAP,
    THREE_BY_TWO,
    TRIANGLE,
    Air,
    Place,
    Signals,
    signals,
)
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
from lidarops.retrieve.air import visibility
from lidarops.retrieve.network import cycles, extinction_field, geometry
from lidarops.retrieve.network.extinction_field import MultiPositionResult

_case = partial(StiffCase, retrieval=Retrieval.MULTIPOSITION)
_ANY: Final = Quality(REJECTING)
FLAGGED: Final = Quality.UNSTABLE_INVERSION
"""Stands for any of the retrieval's own flags that doubt a value."""
_PROFILES: Final = 200


def answered(found: MultiPositionResult) -> Answer:
    """Return the values, with one bit where any flag doubts them."""
    bits = np.where(found.flags.flagged, np.int32(FLAGGED), np.int32(0))
    return Answer(
        {
            "extinction": found.extinction,
            "extinction_standard_error": found.extinction_standard_error,
            "visibility": found.visibility.visibility,
        },
        bits,
    )


def solve_network(near: bool = True, **arguments: Any) -> Answer:  # noqa: FBT001, FBT002
    """Solve, and return the crossings that are near ones, or all."""
    found = extinction_field.retrieve_network(**arguments)
    answer = answered(found)
    if not near:
        return answer
    values = {name: answer.value(name)[..., found.near_crossing] for name in answer.values}
    return Answer(values, answer.quality[..., found.near_crossing])


def start_crossing(walk: geometry.Cycle, **arguments: Any) -> Answer:
    """Solve a cycle, and return the crossing at which it starts."""
    answer = answered(extinction_field.retrieve_network(cycle=walk, **arguments))
    first = int(walk.crossing[0])
    values = {name: answer.value(name)[..., first] for name in answer.values}
    return Answer(values, answer.quality[..., first])


def homogeneous(extinction: float) -> Air:
    """Return air that is the same everywhere."""
    return Air("homogeneous", lambda _: lambda __, up: np.full_like(up, extinction))


def network_arguments(
    place: Place = TRIANGLE,
    air: Air = AIRS[0],
    noise: float = 0.01,
    *,
    additive: float = 0.0,
    **more: Any,
) -> dict[str, Any]:
    """Return arguments of `solve_network` for profiles with relative noise."""
    seen = signals(place.network(), air)
    power, variance = seen.draw(noise, _PROFILES, 51, additive=additive)
    given: dict[str, Any] = {
        "power": power, "range": seen.range, "network": seen.network, "variance": variance,
        "full_overlap_range": FULL_OVERLAP,
    }  # fmt: skip
    return given | more


def triangle_with_elevation(elevation: float) -> Place:
    """Return the triangle with another elevation of its second beam."""
    return Place("", (300.0, -500.0, 0.0), ((120.0,), (elevation,), (90.0,)))


def _started(elevation: float, noise: float, **more: Any) -> dict[str, Any]:
    """Return a cycle that starts at the crossing of beams 1 and 2, whichever is nearer."""
    given = network_arguments(
        triangle_with_elevation(elevation), noise=noise, method="cycle", **more
    )
    net = given["network"]
    first = next(
        crossing for crossing in range(net.crossings)
        if all(crossing in net.on_beam(beam)[0] for beam in (0, 2))
    )  # fmt: skip
    return given | {"walk": geometry.build_cycle(net, start=first)}


def _bad(value: float) -> dict[str, Any]:
    given = network_arguments()
    power = given["power"].copy()
    power[:, 0, :] = value
    return given | {"power": power}


def _one_bin(value: float) -> dict[str, Any]:
    given = network_arguments()
    power = given["power"].copy()
    at = int(np.argmin(np.abs(given["range"] - given["network"].on_beam(0)[1][0])))
    power[:, 0, at] = value
    return given | {"power": power}


def _scaled(factor: float) -> Answer:
    given = network_arguments(noise=0.05)
    bright = given | {
        "power": given["power"] * factor, "variance": given["variance"] * factor**2
    }  # fmt: skip
    one, other = solve_network(**bright), solve_network(**given)
    change = np.nanmax(np.abs(one.value("extinction") / other.value("extinction") - 1.0))
    alike = np.array_equal(one.quality, other.quality)
    return Answer({"change": change, "same flags": float(alike)})


def _gains() -> Answer:
    given = network_arguments(noise=0.05)
    gain = np.array([1e-6, 1.0, 1e9])[:, np.newaxis]
    other = given | {"power": given["power"] * gain, "variance": given["variance"] * gain**2}
    change = (
        solve_network(**other).value("extinction") / solve_network(**given).value("extinction")
        - 1.0
    )
    return Answer({"change": np.nanmax(np.abs(change))})


def _exponent(method: str) -> dict[str, Any]:
    given = network_arguments(noise=0.01)
    # With backscatter ~ extinction^(1/m), homogeneous signals are the same but for a constant.
    return given | {"exponent": 2.0, "method": method}


def _two_lidars() -> dict[str, Any]:
    seen: Signals = signals(Place("", (0.0, 500.0), ((60.0,), (120.0,))).network(), AIRS[0])
    power, variance = seen.draw(0.02, 10, 52)
    return {"power": power, "range": seen.range, "network": seen.network, "variance": variance,
            "full_overlap_range": FULL_OVERLAP, "prior": "none"}  # fmt: skip


def _networks() -> tuple[StiffCase, ...]:
    honest = Honest("extinction", 2e-3, most=5e-3)
    return (
        _case("A a beams through one point: nothing is determined", solve=start_crossing,
              build=lambda: _started(46.1024, 0.01), expected=(Raised(_ANY),)),
        _case("A b nearly so, noise 1 %", solve=start_crossing,
              build=lambda: _started(47.0, 0.01),
              expected=(Raised(_ANY, 0.9), Honest("extinction", 2e-3, most=5e-3))),
        _case("A c below the crossing: the start is the far crossing", solve=start_crossing,
              build=lambda: _started(30.0, 0.01), expected=(Raised(_ANY),)),
        _case("A c the same, all crossings at once", solve=solve_network,
              build=lambda: network_arguments(triangle_with_elevation(30.0)), expected=(honest,)),
        _case("A d visibility of 150 km, noise 0.5 %, exact cycle",
              build=lambda: network_arguments(air=homogeneous(2e-5), noise=0.005, method="cycle"),
              solve=solve_network, expected=(Raised(_ANY, 0.99),)),
        _case("A d the same, network",
              build=lambda: network_arguments(air=homogeneous(2e-5), noise=0.005), solve=solve_network,
              expected=(Honest("extinction", 2e-5, most=5e-3),)),
        _case("A e extinction of 20 per km, exact cycle",
              build=lambda: network_arguments(air=homogeneous(0.02), method="cycle"), solve=solve_network,
              expected=(Honest("extinction", 0.02, most=5e-3),)),
        _case("A e the same, network", build=lambda: network_arguments(air=homogeneous(0.02)),
              solve=solve_network, expected=(Honest("extinction", 0.02, most=5e-3),)),
        _case("A f extinction of 60 per km without noise",
              build=lambda: network_arguments(air=homogeneous(0.06), noise=1e-9, method="slope"),
              solve=solve_network, expected=(Near("extinction", 0.06, 1e-6),)),
        _case("homogeneous triangle without noise, exact cycle",
              build=lambda: network_arguments(noise=1e-12, method="cycle"), solve=solve_network,
              expected=(Near("extinction", 2e-3, 1e-9), Stands())),
        _case("homogeneous triangle without noise, network", build=lambda: network_arguments(noise=1e-9),
              solve=solve_network, expected=(Near("extinction", 2e-3, 1e-6),)),
        *(
            _case(f"A g exponent m = 2, {method}", build=partial(_exponent, method),
                  solve=solve_network, expected=(honest,))
            for method in ("cycle", "network", "unbiased")
        ),
        *(
            _case(f"A h a beam of {value:g}", build=partial(_bad, value), solve=solve_network,
                  expected=(Raised(_ANY),))
            for value in (np.nan, 0.0, -1.0, np.inf)
        ),
        *(
            _case(f"A h one bin of {value:g}", build=partial(_one_bin, value), solve=solve_network,
                  expected=(honest,))
            for value in (np.nan, 0.0, -1e9, np.inf, 1e300)
        ),
        _case("A i one crossing of two beams, without prior", build=_two_lidars,
              solve=partial(solve_network, near=False),
              expected=(Missing("extinction"), Raised(_ANY))),
        _case("A j multiplier beyond the pole", solve=start_crossing,
              build=lambda: _started(25.0, 0.01) | {"method": "multiplier", "multiplier": 0.9},
              expected=(Raised(_ANY),)),
        *(
            _case(f"signals times {factor:g}", build=partial(dict, factor=factor),
                  solve=_scaled, expected=(Near("change", 0.0, 1e-9, relative=False),
                                           Near("same flags", 1.0, 0.0)))
            for factor in (1e-30, 1e30, 1e-140, 1e140)
        ),
        _case("lidars that differ by 1e15 in brightness", build=dict, solve=_gains,
              expected=(Near("change", 0.0, 1e-9, relative=False),)),
        *(
            _case(f"noise of {100.0 * noise:g} %, {where.name}", solve=solve_network,
                  build=partial(network_arguments, where, noise=noise, additive=0.01),
                  expected=(honest,))
            for noise in (0.02, 0.1, 1.0) for where in (TRIANGLE, THREE_BY_TWO)
        ),
        _case("one profile", solve=solve_network,
              build=lambda: network_arguments() | {n: network_arguments()[n][0] for n in ("power", "variance")},
              expected=(honest,)),
        _case("no noise stated", build=lambda: network_arguments() | {"variance": 0.0}, solve=solve_network,
              expected=(Raised(_ANY),)),
    )  # fmt: skip


# Cycles in closed form ------------------------------------------------------------------------


def _against_lu(beams: int) -> Answer:
    rng = np.random.default_rng(beams)
    start = rng.uniform(1.0, 2.0, (500, beams))
    end, integral = start * rng.uniform(0.6, 0.9, start.shape), rng.uniform(0.1, 0.3, start.shape)
    matrix = np.zeros((500, beams, beams), dtype=np.longdouble)
    here = np.arange(beams)
    matrix[:, here, here] = start
    matrix[:, here, (here + 1) % beams] -= end
    exact = np.linalg.solve(matrix.astype(np.float64), integral[..., np.newaxis])[:, 0, 0]
    found = cycles.solve_cycle(start, end, integral).value
    return Answer({"change": np.max(np.abs(found / exact - 1.0))})


def _cycle(**arguments: Any) -> Answer:
    found = cycles.solve_cycle(**arguments)
    bits = np.where(found.flagged, np.int32(FLAGGED), np.int32(0))
    return Answer({"value": found.value}, np.atleast_1d(bits))


def _rows(**more: Any) -> dict[str, Any]:
    given = {"start": [1.0, 1.2, 0.9], "end": [0.8, 1.1, 0.7], "integral": [0.2, 0.1, 0.2],
             "relative_variance": np.full((3, 3), 1e-6)}  # fmt: skip
    return given | more


def _closed() -> tuple[StiffCase, ...]:
    flat = {"start": [1.0, 1.0, 1.0], "end": [1.0, 1.0, 1.0]}
    return (
        *(
            _case(f"closed form against LU, {beams} beams", build=partial(dict, beams=beams),
                  solve=_against_lu, expected=(Near("change", 0.0, 1e-13, relative=False),))
            for beams in (3, 5, 12, 40)
        ),
        _case("cycle without attenuation", build=lambda: _rows(**flat), solve=_cycle,
              expected=(Raised(FLAGGED),)),
        *(
            _case(f"cycle with a signal of {value:g}",
                  build=partial(_rows, start=[value, 1.2, 0.9]), solve=_cycle,
                  expected=(Raised(FLAGGED),))
            for value in (np.nan, 0.0, -1.0, np.inf)
        ),
        _case("A j closed form beyond its pole", solve=_cycle,
              build=lambda: _rows(start=[1.0, 1.0, 1.0], end=[1.5, 1.5, 1.5], multiplier=0.9),
              expected=(Raised(FLAGGED), Missing("value"))),
        _case("cycle in denormal signals", solve=_cycle,
              build=lambda: _rows(start=np.array([1.0, 1.2, 0.9]) * 1e-300,
                                  end=np.array([0.8, 1.1, 0.7]) * 1e-300,
                                  integral=np.array([0.2, 0.1, 0.2]) * 1e-300),
              expected=(Near("value", _value_of_rows, 1e-12), Stands())),
        _case("multiplier above 1", build=lambda: _rows(multiplier=1.1), solve=_cycle,
              expected=(Refused(RetrievalInputError, "multiplier"),)),
        _case("negative variances of a cycle", solve=_cycle,
              build=lambda: _rows(relative_variance=-np.ones((3, 3))),
              expected=(Refused(RetrievalInputError, "relative_variance"),)),
    )  # fmt: skip


def _value_of_rows() -> Array:
    return np.asarray(cycles.solve_cycle(**_rows()).value)


# Visibility -----------------------------------------------------------------------------------


def _seen(**arguments: Any) -> Answer:
    found = visibility.visibility_from_extinction(**arguments)
    return Answer({"visibility": found.visibility, "lower": found.visibility_lower,
                   "upper": found.visibility_upper})  # fmt: skip


def _sights() -> tuple[StiffCase, ...]:
    constant = float(np.log(20.0))
    return (
        *(
            _case(f"visibility of extinction {extinction:g} per m",
                  build=partial(dict, extinction=extinction), solve=_seen,
                  expected=(Near("visibility", constant / extinction, 1e-14),))
            for extinction in (1e-300, 1e-8, 1e-3, 9.9)
        ),
        *(
            _case(f"no visibility of extinction {extinction:g}",
                  build=partial(dict, extinction=extinction), solve=_seen,
                  expected=(Missing("visibility"),))
            for extinction in (0.0, -1e-3, np.nan, np.inf, -np.inf)
        ),
        _case("visibility of an extinction within its error of zero",
              build=lambda: {"extinction": 1e-5, "standard_error": 2e-5}, solve=_seen,
              expected=(Between("upper", np.inf, np.inf),
                        Near("lower", constant / 3e-5, 1e-12))),
        _case("extinction in km-1", build=lambda: {"extinction": 20.0}, solve=_seen,
              expected=(Refused(RetrievalInputError, "extinction"),)),
        _case("contrast of 5 percent as 5", build=lambda: {"extinction": 1e-3, "contrast": 5.0},
              solve=_seen, expected=(Refused(RetrievalInputError, "contrast"),)),
        _case("negative error of extinction",
              build=lambda: {"extinction": 1e-3, "standard_error": -1.0}, solve=_seen,
              expected=(Refused(RetrievalInputError, "standard_error"),)),
    )  # fmt: skip


def _refused(name: str, field: str | None, **more: Any) -> StiffCase:
    return _case(name, build=lambda: network_arguments() | more, solve=solve_network,
                 expected=(Refused(RetrievalInputError, field),))  # fmt: skip


def _refusals() -> tuple[StiffCase, ...]:
    return (
        _refused("range in km", "range", range=network_arguments()["range"] / 1e3),
        _refused("one beam too few", None, power=network_arguments()["power"][:, :2]),
        _refused("negative variance", "variance", variance=-1.0),
        _refused("neither overlap nor its range", None, full_overlap_range=None),
        _refused("multiplier of a network", "multiplier", multiplier=0.5),
        _refused("exponent of zero", "exponent", exponent=0.0),
        _refused("no bin in the fit", "bins", bins=0),
        _refused("unknown method", "method", method="magic"),
    )  # fmt: skip


def stiff_network_cases() -> tuple[StiffCase, ...]:
    """Return all of them."""
    return (*_networks(), *_closed(), *_sights(), *_refusals())
