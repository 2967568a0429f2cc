"""Look at some profiles of a scene, to leave out the sections in which they show no signal.

Sections that are left out are missing in the product, with the quality bit that the retrieval
would set.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr

from lidarops.flags import Quality
from lidarops.records import Granule, LeftOut, PlannedStep
from lidarops.retrieve.background.detectable_light import (
    LightDetection,
    detect_light,
    spaced_indices,
)
from lidarops.retrieve.homogeneous import labeled
from lidarops.retrieve.homogeneous.thresholds import THRESHOLDS
from lidarops.retrieve.signal.labeled import CORRELATION_LENGTH
from lidarops.steps.step import Look

if TYPE_CHECKING:
    from lidarops.products.homogeneous.steps import PathSettings

LOOKED_AT: Final = 16
"""Number of profiles of a scene that are sampled first."""
GAP: Final = timedelta(minutes=10)
"""Longest time between sampled profiles where the first sample shows no signal."""
OmittedBit = Literal["SATURATED", "LOW_SIGNAL"]
"""Name of the quality bit of a section that is left out."""
REFINEMENTS: Final[Mapping[str, OmittedBit]] = {
    "section_saturated": "SATURATED",
    "section_dark": "LOW_SIGNAL",
}
"""Rule that leaves a section out -> its quality bit."""

LEVEL: Final = THRESHOLDS.level * (1.0 + 1e-6)
"""m, largest climb along a section. Headers and campaign files round angles differently."""

Section = tuple[float, float]


def climb(zenith_angle: float, near: float, far: float) -> float:
    """Return the change of height of a beam along a section, m."""
    return (far - near) * abs(math.cos(math.radians(zenith_angle)))


def omitted_sections(
    planned: PlannedStep, settings: PathSettings, look: Look, most: int
) -> dict[Section, LeftOut]:
    """Return the sections in which there is nothing to retrieve, and why.

    Beams that climb too much along a section do not count: what they see is other air.

    Parameters
    ----------
    planned : PlannedStep
        The step ``homogeneous``.
    settings : PathSettings
        Its settings. Sections that they leave out already are not looked at again.
    look : Look
    most : int
        Number of profiles that are sampled first.

    Returns
    -------
    dict
        Independent of chunks and workers.
    """
    by_beams: dict[tuple[Granule, ...], list[Section]] = {}
    for section in settings.sections:
        if section not in settings.omitted:
            by_beams.setdefault(_level_granules(look.scene.granules, *section), []).append(section)
    omitted: dict[Section, LeftOut] = {}
    for granules, sections in by_beams.items():
        omitted |= _omitted(planned, sections, granules, look, most)
    return omitted


def _level_granules(granules: Sequence[Granule], near: float, far: float) -> tuple[Granule, ...]:
    """Return the granules of level beams; all where the headers show none."""
    level = tuple(
        granule
        for granule in granules
        if granule.zenith_angle is not None and climb(granule.zenith_angle, near, far) <= LEVEL
    )
    return level or tuple(granules)


def _omitted(
    planned: PlannedStep,
    sections: Sequence[Section],
    granules: Sequence[Granule],
    look: Look,
    most: int,
) -> dict[Section, LeftOut]:
    """Return the sections without anything to retrieve, of the beams that are level there."""
    places = spaced_indices(len(granules), most)
    first = _looks(look.profiles(planned.channel, [granules[k] for k in places]), sections)
    doubtful = [
        section
        for section, seen in first.items()
        if seen.profiles and (seen.significance < THRESHOLDS.dark or not seen.unsaturated)
    ]
    if not doubtful:
        return {}
    rest = [granules[k] for k in _second_places(granules, places)]
    second = _looks(look.profiles(planned.channel, rest), doubtful) if rest else {}
    omitted = {}
    for section in doubtful:
        both = _merged_looks(first[section], second.get(section))
        omission = _SectionLook(planned, section, first[section], both).omission()
        if omission is not None:
            omitted[section] = omission
    return omitted


def empty_sections(
    shots: xr.DataArray, unit: str, omitted: Mapping[Section, Quality]
) -> xr.Dataset:
    """Return sections without values but with their quality bits, for profiles with `shots`."""
    empty = labeled.empty_fit(shots, unit=unit, sections=list(omitted))
    bits = np.array([int(bit) for bit in omitted.values()], dtype=np.int32)
    missing = np.where(shots.to_numpy() > 0, np.int32(0), np.int32(Quality.INPUT_MISSING))
    flags = bits | missing[:, np.newaxis]
    return empty.assign(quality_flag=empty["quality_flag"].copy(data=flags))


@dataclass(frozen=True, slots=True)
class _SectionLook:
    """What sampled profiles show in one section."""

    planned: PlannedStep
    section: Section
    first: LightDetection
    all: LightDetection
    """Of both samples together, where there was a second one; else `first`."""

    def omission(self) -> LeftOut | None:
        """Return the section as left out, or None where it is retrieved."""
        minutes = f"{GAP.total_seconds() / 60:g} min"
        if self.first.unsaturated == self.all.unsaturated == 0:
            reason = f"all {self.all.profiles} profiles, at most {minutes} apart, are saturated"
            return self._without("section_saturated", reason, 0.0)
        if (
            self.first.significance < THRESHOLDS.dark
            and self.all.significance < THRESHOLDS.still_dark
        ):
            most = max(self.first.significance, self.all.significance)
            reason = (
                f"no signal in {self.all.profiles} profiles at most {minutes} apart: at most"
                f" {most:.1f} standard errors (limit {THRESHOLDS.still_dark:g})"
            )
            return self._without("section_dark", reason, most)
        return None

    def _without(self, rule: str, reason: str, number: float) -> LeftOut:
        near, far = self.section
        return LeftOut(
            self.planned.name,
            self.planned.channel,
            f"section {near:g}-{far:g} m: {reason}",
            rule=rule,
            number=number,
            product=self.planned.product,
        )


def _second_places(granules: Sequence[Granule], places: npt.NDArray[np.int64]) -> list[int]:
    """Return the indices of further granules, so that samples are at most `GAP` apart."""
    sampled = {int(place) for place in places}
    more = []
    last: datetime | None = None
    for place, granule in enumerate(granules):
        following = granules[place + 1].start if place + 1 < len(granules) else None
        if place in sampled:
            last = granule.start
        elif last is None or following is None or following - last > GAP:
            more.append(place)
            last = granule.start
    return more


def _merged_looks(first: LightDetection, second: LightDetection | None) -> LightDetection:
    if second is None:
        return first
    return LightDetection(
        first.profiles + second.profiles,
        max(first.significance, second.significance),
        first.unsaturated + second.unsaturated,
    )


def _looks(
    samples: Iterable[xr.Dataset], sections: Sequence[Section]
) -> dict[Section, LightDetection]:
    looks: dict[Section, LightDetection] = {}
    for profiles in samples:
        power, quality, distance = (
            profiles[name].to_numpy() for name in ("power", "quality", "range")
        )
        # Significance is that of means over many bins.
        variance = (profiles["variance"] * profiles[CORRELATION_LENGTH]).to_numpy()
        for near, far in sections:
            light = detect_light(power, variance, quality, distance, near, far)
            looks[near, far] = _merged_looks(light, looks.get((near, far)))
    return looks
