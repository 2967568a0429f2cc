"""Rules of scans: what of the multi-angle retrieval runs, from where the beams point.

What a retrieval decides from the data is left to it, where beams can show it at all; its product
tells in the attribute ``steps`` how that came out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.campaign.product_settings import MultiAngleSettings
from lidarops.errors import RetrievalInputError
from lidarops.plan.signal_rules import ChannelCase, Decisions, Rule, StepName, no_scan
from lidarops.retrieve.multiangle import scan_cycles, slant_paths
from lidarops.retrieve.multiangle.robust_weights import FEWEST_BEAMS

Array = npt.NDArray[np.float64]

_HALF_TURN: Final = 180.0
_SIMPLE: Final = frozenset({"kano_hamilton", "two_angle"})
"""Methods that take every altitude by itself."""
_BLIND: Final = frozenset({"two_angle", "mld", "mld_prior"})
"""Methods that see no horizontal gradient."""
_JOINT: Final = frozenset({"auto", "joint"})


def _scanned(case: ChannelCase) -> MultiAngleSettings | None:
    """Return the settings of the multi-angle product, where there is one."""
    return None if no_scan(case) else case.multiangle


def altitude_steps(step: float, highest: float) -> Array:
    """Return the altitudes of a multi-angle product, m above the station."""
    return np.arange(step, highest + 1e-6, step)


@dataclass(frozen=True, slots=True)
class Beams:
    """The directions of a scan that the retrieval uses."""

    count: int
    sides_known: bool
    """Whether an azimuth is told."""
    free: float
    """degree, the largest angle around the zenith that is free of them."""
    surround: bool
    """Whether no half turn is free, so that a horizontal gradient can be retrieved."""


def beams(case: ChannelCase, settings: MultiAngleSettings) -> Beams:
    """Return the beams that the retrieval will find in the files of a scan."""
    side = case.facts.azimuth
    pointings = tuple(
        (_number(granule.zenith_angle), _number(granule.azimuth if side is None else side))
        for granule in case.scene.granules
    )
    return _beams(pointings, settings.step, settings.highest)


def _number(angle: float | None) -> float:
    return math.nan if angle is None else angle


# The rules of a channel ask one after the other, and its channels look the same way.
@lru_cache(maxsize=1)
def _beams(pointings: tuple[tuple[float, float], ...], step: float, highest: float) -> Beams:
    zenith_angle, azimuth = np.array(pointings).T
    sides_known = bool(np.isfinite(azimuth).any())
    try:
        found = scan_cycles.directions(zenith_angle, azimuth)
    except RetrievalInputError:
        # The retrieval tells what is wrong with them.
        return Beams(0, sides_known, 2 * _HALF_TURN, surround=False)
    altitude = altitude_steps(step, highest)
    up = slant_paths.rising_beams(found.zenith_angle, altitude)
    if up.size == 0:
        return Beams(0, sides_known, 2 * _HALF_TURN, surround=False)
    leaning = slant_paths.make_scan(found.zenith_angle[up], altitude, found.azimuth[up]).leaning
    free = math.degrees(slant_paths.widest_azimuth_gap(leaning))
    return Beams(up.size, sides_known, free, slant_paths.surrounds_zenith(leaning))


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
    found = beams(case, settings)
    if settings.method in _BLIND:
        reason = f"method {settings.method} fits no horizontal gradient"
        yield case.without(StepName.GRADIENT_REGRESSOR, reason)
    elif not found.sides_known:
        reason = "headers do not tell azimuths: beams are taken to lead to one side"
        yield case.without(StepName.GRADIENT_REGRESSOR, reason)
    elif not found.surround:
        reason = f"{found.free:g} degree around the zenith are free of beams, more than a half turn"
        yield case.without(StepName.GRADIENT_REGRESSOR, reason, number=found.free)
    else:
        reason = "beams lead to all sides: decided from the data, at altitudes where their light is"
        yield case.step(StepName.GRADIENT_REGRESSOR, reason, number=found.free)


def _robust(case: ChannelCase) -> Decisions:
    settings = _scanned(case)
    if settings is None:
        return
    count = float(beams(case, settings).count)
    if count < FEWEST_BEAMS:
        reason = f"fewer than {FEWEST_BEAMS} directions do not tell which of them is an outlier"
        yield case.without(StepName.ROBUST, reason, number=count)
    else:
        reason = "decided from the data: where a residual is too large for chance"
        yield case.step(StepName.ROBUST, reason, number=count)


def _vertical(case: ChannelCase) -> Decisions:
    settings = _scanned(case)
    if settings is None:
        return
    count = beams(case, settings).count
    bins = float(round(settings.highest / settings.step))
    if settings.method in _SIMPLE:
        reason = f"method {settings.method} takes every altitude by itself"
        yield case.without(StepName.VERTICAL, reason)
    elif settings.method == "auto" and count <= 2:
        reason = "two directions are one difference an altitude, which is taken as it is"
        yield case.without(StepName.VERTICAL, reason, number=float(count))
    else:
        reason = "decided from the data: as smooth as noise makes single altitudes uncertain"
        yield case.step(StepName.VERTICAL, reason, number=bins)


def _correlation(case: ChannelCase) -> Decisions:
    settings = _scanned(case)
    if settings is None:
        return
    spare = float(beams(case, settings).count - 2)
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
