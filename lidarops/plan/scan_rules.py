"""Rules for scans: which steps of the multi-angle retrieval run, from the pointing of the beams.

A step that the retrieval decides from the data is planned where the beams permit it. The attribute
``lidarops_steps`` of the product states what was decided.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from lidarops.errors import RetrievalInputError
from lidarops.plan.rules import NOT_REQUESTED, REQUESTED, ChannelCase, Decisions, Rule, StepName
from lidarops.plan.signal_rules import no_scan
from lidarops.products.multiangle.settings import MultiAngleSettings
from lidarops.retrieve.multiangle import scan_cycles, slant_paths
from lidarops.retrieve.multiangle.robust_weights import FEWEST_BEAMS

Array = npt.NDArray[np.float64]

_HALF_TURN: Final = 180.0
_SIMPLE: Final = frozenset({"kano_hamilton", "two_angle"})
"""Methods that treat each altitude independently."""
_BLIND: Final = frozenset({"two_angle", "mld", "mld_prior"})
"""Methods that cannot fit a horizontal gradient."""
_JOINT: Final = frozenset({"auto", "joint"})


def _scanned(case: ChannelCase) -> MultiAngleSettings | None:
    """Return the settings of the multi-angle product; None where it is not made."""
    return None if no_scan(case) else case.multiangle


def altitude_steps(step: float, highest: float) -> Array:
    """Return the altitudes of a multi-angle product, m above the station."""
    return np.arange(step, highest + 1e-6, step)


@dataclass(frozen=True, slots=True)
class Beams:
    """The beam directions of a scan that the retrieval uses."""

    count: int
    sides_known: bool
    """Whether any azimuth is known."""
    free: float
    """degree, the largest azimuth sector without beams."""
    surround: bool
    """Whether no half turn is free of beams, so that a horizontal gradient can be estimated."""


def beams(case: ChannelCase, settings: MultiAngleSettings) -> Beams:
    """Return the beam directions that the retrieval will use from the files of a scan."""
    side = case.facts.azimuth
    pointings = tuple(
        (_number(granule.zenith_angle), _number(granule.azimuth if side is None else side))
        for granule in case.scene.granules
    )
    return _beams(pointings, settings.step, settings.highest)


def _number(angle: float | None) -> float:
    return math.nan if angle is None else angle


# All rules of a scene need the same beams.
@lru_cache(maxsize=1)
def _beams(pointings: tuple[tuple[float, float], ...], step: float, highest: float) -> Beams:
    zenith_angle, azimuth = np.array(pointings).T
    sides_known = bool(np.isfinite(azimuth).any())
    try:
        directions = scan_cycles.directions(zenith_angle, azimuth)
    except RetrievalInputError:
        # The retrieval raises the same error with its message.
        return Beams(0, sides_known, 2 * _HALF_TURN, surround=False)
    altitude = altitude_steps(step, highest)
    up = slant_paths.rising_beams(directions.zenith_angle, altitude)
    if up.size == 0:
        return Beams(0, sides_known, 2 * _HALF_TURN, surround=False)
    scan = slant_paths.make_scan(directions.zenith_angle[up], altitude, directions.azimuth[up])
    tilted = scan.tilted_azimuths
    free = math.degrees(slant_paths.widest_azimuth_gap(tilted))
    return Beams(up.size, sides_known, free, slant_paths.surrounds_zenith(tilted))


def _gradient(case: ChannelCase) -> Decisions:
    if case.multiangle is None or no_scan(case):
        return
    largest = case.multiangle.largest_gradient
    if largest > 0:
        reason = "backscatter may vary horizontally: retrieved, or part of the error"
        yield case.step(StepName.GRADIENT, reason, number=largest)
    else:
        reason = "largest_gradient of the campaign is 0"
        yield case.without(StepName.GRADIENT, reason, number=0.0)


def _multiangle(case: ChannelCase) -> Decisions:
    settings = case.multiangle
    if settings is None:
        yield case.without(StepName.MULTIANGLE, NOT_REQUESTED)
        return
    reason = no_scan(case)
    if reason:
        yield case.without(StepName.MULTIANGLE, reason)
        return
    yield case.step(
        StepName.MULTIANGLE,
        f"{REQUESTED}, and the beam scans",
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
    directions = beams(case, settings)
    if settings.method in _BLIND:
        reason = f"method {settings.method} fits no horizontal gradient"
        yield case.without(StepName.GRADIENT_REGRESSOR, reason)
    elif not directions.sides_known:
        reason = "headers give no azimuths: all beams are assumed to point to one side"
        yield case.without(StepName.GRADIENT_REGRESSOR, reason)
    elif not directions.surround:
        sector = f"an azimuth sector of {directions.free:g} degree"
        reason = f"{sector}, more than a half turn, has no beams"
        yield case.without(StepName.GRADIENT_REGRESSOR, reason, number=directions.free)
    else:
        reason = (
            "beams point to all sides, so a horizontal gradient can be estimated; decided from the"
            " data, at altitudes with signal"
        )
        yield case.step(StepName.GRADIENT_REGRESSOR, reason, number=directions.free)


def _robust(case: ChannelCase) -> Decisions:
    settings = _scanned(case)
    if settings is None:
        return
    count = float(beams(case, settings).count)
    if count < FEWEST_BEAMS:
        reason = f"fewer than {FEWEST_BEAMS} beam directions cannot identify an outlier"
        yield case.without(StepName.ROBUST, reason, number=count)
    else:
        reason = "decided from the data: used where a residual is too large to be chance"
        yield case.step(StepName.ROBUST, reason, number=count)


def _vertical(case: ChannelCase) -> Decisions:
    settings = _scanned(case)
    if settings is None:
        return
    count = beams(case, settings).count
    bins = float(round(settings.highest / settings.step))
    if settings.method in _SIMPLE:
        reason = f"method {settings.method} treats each altitude independently"
        yield case.without(StepName.VERTICAL, reason)
    elif settings.method == "auto" and count <= 2:
        reason = "two beam directions give one difference at each altitude, used without smoothing"
        yield case.without(StepName.VERTICAL, reason, number=float(count))
    else:
        reason = "decided from the data: the smoothing increases with the noise of single altitudes"
        yield case.step(StepName.VERTICAL, reason, number=bins)


def _correlation(case: ChannelCase) -> Decisions:
    settings = _scanned(case)
    if settings is None:
        return
    spare = float(beams(case, settings).count - 2)
    if settings.method not in _JOINT:
        reason = f"method {settings.method} assumes independent errors at different altitudes"
        yield case.without(StepName.CORRELATION, reason)
    elif spare <= 0:
        reason = "no beam direction is redundant: residuals show no correlation along altitude"
        yield case.without(StepName.CORRELATION, reason, number=spare)
    else:
        reason = "decided from the data: AR(1) along altitude, from residuals of redundant beams"
        yield case.step(StepName.CORRELATION, reason, number=spare)


def _layers(case: ChannelCase) -> Decisions:
    settings = _scanned(case)
    if settings is None:
        return
    number = float(len(settings.layers))
    if settings.layers:
        reason = "the campaign requests the optical depth of layers"
        yield case.step(StepName.LAYERS, reason, number=number)
    else:
        reason = "the campaign requests no layers"
        yield case.without(StepName.LAYERS, reason, number=number)


SCANS: Final = (
    Rule("gradient", StepName.GRADIENT, "May the air vary horizontally?", _gradient),
    Rule(
        "gradient_regressor",
        StepName.GRADIENT_REGRESSOR,
        "Do beams point to all sides, so that a gradient can be fitted?",
        _regressor,
    ),
    Rule("robust", StepName.ROBUST, "Are there enough beams to identify an outlier?", _robust),
    Rule("vertical", StepName.VERTICAL, "Is the profile regularised along altitude?", _vertical),
    Rule("correlation", StepName.CORRELATION, "Can residuals show AR(1) noise?", _correlation),
    Rule("layers", StepName.LAYERS, "Are layers requested?", _layers),
    Rule("multiangle", StepName.MULTIANGLE, "Does the beam scan over zenith angle?", _multiangle),
)
"""Rules for the multi-angle product of a channel."""
