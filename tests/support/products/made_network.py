"""Averaged signals of three lidars with beams that form a triangle, for tests."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr

from lidarops.flags import Quality
from lidarops.retrieve.air.visibility import VisibilityDefinition
from lidarops.retrieve.network import geometry
from lidarops.retrieve.network.labeled import BeamAverages, retrieve_network
from lidarops.retrieve.network.settings import NetworkAssumptions

STATIONS = ((47.25, 11.3, 600.0), (47.25, 11.353, 600.0), (47.2811, 11.3265, 600.0))
AZIMUTHS = (70.0, 310.0, 190.0)
RANGE = np.arange(2400) * 7.5 + 3.75
EXTINCTION = 4e-4
VISIBILITY = VisibilityDefinition(wavelength=532e-9)
START = np.datetime64("2025-06-01T20:00:00", "ns")


def network() -> geometry.Network:
    """Return the network of the three beams."""
    return geometry.build_network(
        [
            geometry.Beam(*station, azimuth=azimuth, elevation=0.0)
            for station, azimuth in zip(STATIONS, AZIMUTHS, strict=True)
        ],
        nearest=150.0,
        farthest=float(RANGE[-1]),
    )


def beam(
    number: int, *, intervals: int = 6, noise: float = 0.002, seed: int = 0, **changes: Any
) -> BeamAverages:
    """Return one beam in homogeneous air with a background of 0.1 MHz."""
    random = np.random.default_rng((seed, number))
    clean = 1e7 * (1.0 + number) * EXTINCTION * np.exp(-2 * EXTINCTION * RANGE) / RANGE**2
    spread = np.hypot(noise * clean, 1e-6)
    shape = (intervals, RANGE.size)
    pair = ("time", "range")
    starts = START + np.arange(intervals) * np.timedelta64(300, "s")
    averages = xr.Dataset(
        {
            "power": (pair, 0.1 + clean + spread * random.standard_normal(shape)),
            "variance": (pair, np.broadcast_to(spread**2, shape).copy()),
            "quality": (pair, np.zeros(shape, dtype=np.int32)),
            "noise_correlation_length": ("time", np.ones(intervals)),
            "shots": ("time", np.full(intervals, 3000, dtype=np.int32)),
        },
        coords={
            "range": RANGE,
            "time_bnds": (
                ("time", "nv"),
                np.stack([starts, starts + np.timedelta64(300, "s")], axis=-1),
            ),
        },
    )
    defaults: dict[str, Any] = {
        "averages": averages,
        "interval": np.arange(100, 100 + intervals),
        "instrument": f"lidar-{number}",
        "station": STATIONS[number],
        "background_range": (0.9 * RANGE[-1], RANGE[-1]),
        "nearest": 150.0,
        "overlap": None,
        "exponent": 1.0,
        "zenith_angle": 90.0,
        "azimuth": AZIMUTHS[number],
    }
    return BeamAverages(**(defaults | changes))


def solved(
    beams: list[BeamAverages],
    *,
    block_intervals: int = 72,
    visibility: VisibilityDefinition = VISIBILITY,
    **assumed: Any,
) -> xr.Dataset:
    """Return what is retrieved from averages of the beams."""
    return retrieve_network(
        beams,
        network(),
        NetworkAssumptions(**assumed),
        block_intervals=block_intervals,
        visibility=visibility,
    )


def product(intervals: int = 6, **settings: Any) -> xr.Dataset:
    """Return the product of all three beams."""
    beams = [beam(number, intervals=intervals) for number in range(3)]
    retrieved = solved(beams, **settings)
    return retrieved.assign(retrieval_method=0)


def without(averages: BeamAverages, rows: slice) -> BeamAverages:
    """Return the beam with the bins of some intervals flagged as missing."""
    bits = averages.averages["quality"].copy()
    bits[rows] = int(Quality.INPUT_MISSING)
    return replace(averages, averages=averages.averages.assign(quality=bits))
