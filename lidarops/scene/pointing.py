"""Where the beams of a scene point, from the headers of its files or the facts of the campaign."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from lidarops.retrieve.common.arrays import widest_azimuth_gap
from lidarops.scene.case import ChannelCase

STEEPEST: Final = 80.0
"""degree; largest zenith angle at which a beam reaches aerosol-free air."""
FIXED: Final = 0.05
"""degree; largest difference between the zenith angles of the files of a fixed beam."""
LEAST_SPREAD: Final = 5.0
"""degree; smallest span of zenith angles of a scan."""


def no_scan(case: ChannelCase) -> str:
    """Return why the files of a scene are not a scan; empty where they are."""
    if case.facts.zenith_angle is not None:
        angle = case.facts.zenith_angle
        return f"the campaign states a fixed beam at a zenith angle of {angle:g} degree"
    header_angles = [granule.zenith_angle for granule in case.scene.granules]
    angles = [angle for angle in header_angles if angle is not None]
    if len(angles) < len(header_angles):
        return "headers lack zenith angles"
    spread = max(angles) - min(angles)
    if spread < LEAST_SPREAD <= _azimuth_sector(case):
        elevation = 90.0 - 0.5 * (max(angles) + min(angles))
        return (
            f"a plan-position scan (PPI) at {elevation:.3g} degree above the horizon, over an"
            f" azimuth sector of {_azimuth_sector(case):.3g} degree: its slant paths do not differ"
        )
    if spread < LEAST_SPREAD:
        return f"zenith angles span only {spread:g} degree: the beam does not scan"
    return ""


def moves(case: ChannelCase) -> bool:
    """Return whether the files of a scene point to several directions, of any pattern."""
    if case.facts.zenith_angle is not None:
        return False
    granules = case.scene.granules
    zenith = [granule.zenith_angle for granule in granules if granule.zenith_angle is not None]
    if zenith and max(zenith) - min(zenith) > FIXED:
        return True
    return _azimuth_sector(case) > FIXED


def _azimuth_sector(case: ChannelCase) -> float:
    """Return the narrowest azimuth sector that holds all beams, degree."""
    if case.facts.azimuth is not None:
        return 0.0
    granules = case.scene.granules
    azimuth = [granule.azimuth for granule in granules if granule.azimuth is not None]
    # The sector of all beams may hold north.
    return 360.0 - math.degrees(widest_azimuth_gap(np.radians(azimuth)))


def fixed_zenith(case: ChannelCase) -> tuple[float, str]:
    """Return the zenith angle of a fixed beam in degree, or NaN and why there is none."""
    if case.facts.zenith_angle is not None:
        angles = [case.facts.zenith_angle]
    else:
        header_angles = [granule.zenith_angle for granule in case.scene.granules]
        if any(angle is None for angle in header_angles):
            return math.nan, "neither headers nor campaign give the zenith angle"
        angles = [angle for angle in header_angles if angle is not None]
    if max(angles) - min(angles) > FIXED:
        reason = f"the zenith angle of the beam changes from {min(angles):g} to {max(angles):g}"
        return math.nan, f"{reason} degree"
    if max(angles) > STEEPEST:
        reason = f"at a zenith angle of {max(angles):g} degree the beam does not reach"
        return math.nan, f"{reason} aerosol-free air"
    return max(angles), ""
