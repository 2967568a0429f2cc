"""Retrievals of scans with all their arguments on one level, as tests vary them one by one."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import xarray as xr

from lidarops.retrieve.multiangle import optical_depth
from lidarops.retrieve.multiangle.labeled_altitudes import AltitudeCycles, BeamAir
from lidarops.retrieve.multiangle.optical_depth import MultiAngleResult, OpticalDepthSettings

_SETTINGS = {item.name for item in fields(OpticalDepthSettings)}


def retrieve_optical_depth(*beams: Any, **arguments: Any) -> MultiAngleResult:
    """Return the retrieval; settings are among the arguments."""
    given = {name: arguments.pop(name) for name in _SETTINGS & arguments.keys()}
    settings = OpticalDepthSettings(**given)
    return optical_depth.retrieve_optical_depth(*beams, **arguments, settings=settings)


def altitude_cycles(distance: Any, **arguments: Any) -> AltitudeCycles:
    """Return cycles without profiles; pointing, times and shots are among the arguments."""
    scan = {name: ("time", arguments.pop(name)) for name in ("zenith_angle", "azimuth", "shots")}
    if scan["azimuth"][1] is None:
        del scan["azimuth"]
    bounds = ("time", "nv"), arguments.pop("time_bnds")
    wavelength = arguments.pop("wavelength", np.nan)
    molecules = arguments.pop("molecules", None)
    air = None if molecules is None else BeamAir(molecules, wavelength, {})
    return AltitudeCycles(
        distance, scan=xr.Dataset(scan | {"time_bnds": bounds}), air=air, **arguments
    )
