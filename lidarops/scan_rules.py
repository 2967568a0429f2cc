"""Rules of scans: what of the multi-angle retrieval runs, from where the beams point.

What a retrieval decides from the data is left to it, where beams can show it at all; its product
tells in the attribute ``steps`` how that came out.
"""

from __future__ import annotations

import math
from typing import Final

from lidarops.plan_rules import ChannelCase, Decisions, Rule, StepName, no_scan
from lidarops.product_settings import MultiAngleSettings

APART: Final = 0.25
"""degree, beyond which beams have two directions."""
REDUNDANT: Final = 4
"""Directions that tell which of them is an outlier."""
_HALF_TURN: Final = 180.0
_SIMPLE: Final = frozenset({"kano_hamilton", "two_angle"})
"""Methods that take every altitude by itself."""
_BLIND: Final = frozenset({"two_angle", "mld", "mld_prior"})
"""Methods that see no horizontal gradient."""
_JOINT: Final = frozenset({"auto", "joint"})


def _scanned(case: ChannelCase) -> MultiAngleSettings | None:
    """Return the settings of the multi-angle product, where there is one."""
    return None if no_scan(case) else case.multiangle


def directions(case: ChannelCase) -> list[tuple[float, float | None]]:
    """Return the zenith angles and azimuths of a scan that differ, degree."""
    told = {
        (
            granule.zenith_angle,
            granule.azimuth if case.facts.azimuth is None else case.facts.azimuth,
        )
        for granule in case.scene.granules
        if granule.zenith_angle is not None
    }
    kept: list[tuple[float, float | None]] = []
    for zenith, azimuth in sorted(told, key=lambda pair: (pair[0], pair[1] or 0.0)):
        if not any(_alike(zenith, azimuth, *other) for other in kept):
            kept.append((zenith, azimuth))
    return kept


def _alike(zenith: float, azimuth: float | None, other: float, side: float | None) -> bool:
    if abs(zenith - other) > APART:
        return False
    if azimuth is None or side is None:
        return azimuth is side
    turn = abs((azimuth - side + _HALF_TURN) % (2 * _HALF_TURN) - _HALF_TURN)
    # Near the zenith all azimuths are one.
    return turn * math.sin(math.radians(zenith)) <= APART


def free_turn(case: ChannelCase) -> float:
    """Return the largest angle around the zenith that is free of beams, degree; NaN if unknown."""
    slanted = [pair for pair in directions(case) if abs(pair[0]) > APART]
    sides = [azimuth if zenith > 0 else (azimuth or 0.0) + _HALF_TURN
             for zenith, azimuth in slanted]  # fmt: skip
    if any(side is None for side in sides):
        return math.nan
    ordered = sorted(side % (2 * _HALF_TURN) for side in sides if side is not None)
    if not ordered:
        return 2 * _HALF_TURN
    following = [*ordered[1:], ordered[0] + 2 * _HALF_TURN]
    return max(after - before for before, after in zip(ordered, following, strict=True))


def _gradient(case: ChannelCase) -> Decisions:
    if case.multiangle is None or no_scan(case):
        return
    largest = case.multiangle.largest_gradient
    if largest > 0:
        reason = "backscatter may change along the horizontal: retrieved or allowed for"
        yield case.step(StepName.GRADIENT, reason, number=largest)
    else:
        reason = "the campaign says that no horizontal gradient is to be allowed for"
        yield case.without(StepName.GRADIENT, reason, number=0.0)


def _multiangle(case: ChannelCase) -> Decisions:
    settings = case.multiangle
    if settings is None:
        yield case.without(StepName.MULTIANGLE, "the campaign does not ask for it")
        return
    reason = no_scan(case)
    if reason:
        yield case.without(StepName.MULTIANGLE, reason)
        return
    yield case.step(
        StepName.MULTIANGLE,
        "the campaign asks for it, and the beam scans",
        highest=settings.highest,
        step=settings.step,
        method=settings.method,
        largest_gradient=settings.largest_gradient,
        layers=[list(layer) for layer in settings.layers],
        background_range=[0.9 * case.last, case.last],
    )


def _regressor(case: ChannelCase) -> Decisions:
    settings = _scanned(case)
    if settings is None:
        return
    free = free_turn(case)
    if settings.method in _BLIND:
        reason = f"method {settings.method} fits no horizontal gradient"
        yield case.without(StepName.GRADIENT_REGRESSOR, reason)
    elif math.isnan(free):
        reason = "headers do not tell all azimuths: beams are taken to lead to one side"
        yield case.without(StepName.GRADIENT_REGRESSOR, reason)
    elif free > _HALF_TURN + APART:
        reason = f"{free:g} degree around the zenith are free of beams, more than a half turn"
        yield case.without(StepName.GRADIENT_REGRESSOR, reason, number=free)
    else:
        reason = "beams lead to all sides: decided from the data, at altitudes where their light is"
        yield case.step(StepName.GRADIENT_REGRESSOR, reason, number=free)


def _robust(case: ChannelCase) -> Decisions:
    if _scanned(case) is None:
        return
    count = float(len(directions(case)))
    if count < REDUNDANT:
        reason = f"fewer than {REDUNDANT} directions do not tell which of them is an outlier"
        yield case.without(StepName.ROBUST, reason, number=count)
    else:
        reason = "decided from the data: where a residual is too large for chance"
        yield case.step(StepName.ROBUST, reason, number=count)


def _vertical(case: ChannelCase) -> Decisions:
    settings = _scanned(case)
    if settings is None:
        return
    count = len(directions(case))
    gates = float(round(settings.highest / settings.step))
    if settings.method in _SIMPLE:
        reason = f"method {settings.method} takes every altitude by itself"
        yield case.without(StepName.VERTICAL, reason)
    elif settings.method == "auto" and count <= 2:
        reason = "two directions are one difference an altitude, which is taken as it is"
        yield case.without(StepName.VERTICAL, reason, number=float(count))
    else:
        reason = "decided from the data: as smooth as noise makes single altitudes uncertain"
        yield case.step(StepName.VERTICAL, reason, number=gates)


def _correlation(case: ChannelCase) -> Decisions:
    settings = _scanned(case)
    if settings is None:
        return
    spare = float(len(directions(case)) - 2)
    if settings.method not in _JOINT:
        reason = f"method {settings.method} takes the errors of altitudes as independent"
        yield case.without(StepName.CORRELATION, reason)
    elif spare <= 0:
        reason = "no direction is redundant, so that residuals tell no correlation along altitude"
        yield case.without(StepName.CORRELATION, reason, number=spare)
    else:
        reason = "decided from the data: AR(1) along altitude, from residuals of spare directions"
        yield case.step(StepName.CORRELATION, reason, number=spare)


def _layers(case: ChannelCase) -> Decisions:
    settings = _scanned(case)
    if settings is None:
        return
    number = float(len(settings.layers))
    if settings.layers:
        reason = "the campaign asks for the optical depth of layers: variables of them"
        yield case.step(StepName.LAYERS, reason, number=number)
    else:
        reason = "the campaign names no layers: no variable of them"
        yield case.without(StepName.LAYERS, reason, number=number)


SCANS: Final = (
    Rule("gradient", StepName.GRADIENT, "May the air differ along the horizontal?", _gradient),
    Rule(
        "gradient_regressor",
        StepName.GRADIENT_REGRESSOR,
        "Do beams lead to all sides, so that a gradient can be fitted?",
        _regressor,
    ),
    Rule("robust", StepName.ROBUST, "Are there directions enough to tell an outlier?", _robust),
    Rule("vertical", StepName.VERTICAL, "Is the profile regularised along altitude?", _vertical),
    Rule("correlation", StepName.CORRELATION, "Can residuals tell AR(1) noise?", _correlation),
    Rule("layers", StepName.LAYERS, "Are variables of layers wanted?", _layers),
    Rule("multiangle", StepName.MULTIANGLE, "Does the beam scan over zenith angle?", _multiangle),
)
"""Of the multi-angle product of a channel."""
