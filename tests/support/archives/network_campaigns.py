"""Simulated campaigns of networks of lidars, and the truth at their crossings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import yaml

from lidarops.campaign.model import Campaign, load_campaign
from lidarops.simulate.campaign import simulate_campaign

HAZE = {"lidar_ratio": 55}
HOMOGENEOUS: dict[str, Any] = {
    "homogeneous": {
        "extinction": {"minimum": 4e-4, "maximum": 4e-4, "hour_of_maximum": 12},
        "aerosol": HAZE,
        "molecules_constant": True,
    }
}
GRADIENT: dict[str, Any] = {
    "gradients": [{"extinction": 4e-4, "azimuth": 270, "scale": 8000, "aerosol": HAZE}]
}
PLUME: dict[str, Any] = {
    **GRADIENT,
    "plumes": [
        {
            "extinction": 5e-4,
            "east": -2000,
            "north": 1500,
            "horizontal_depth": 800,
            "vertical_depth": 800,
            "wind_east": 2.0,
            "aerosol": HAZE,
        }
    ],
}

_STATIONS = {
    "west": {"latitude": 47.25, "longitude": 11.3, "altitude": 600},
    "east": {"latitude": 47.25, "longitude": 11.353, "altitude": 600},
    "north": {"latitude": 47.2811, "longitude": 11.3265, "altitude": 600},
}
_TRIANGLE = {"west": ([90], 70), "east": ([90], 310), "north": ([90], 190)}
# In the vertical plane through all three, each with two beams.
_PLANE = {
    "west": {"latitude": 47.25, "longitude": 11.3, "altitude": 600},
    "east": {"latitude": 47.25, "longitude": 11.353, "altitude": 600},
    "middle": {"latitude": 47.25, "longitude": 11.3265, "altitude": 600},
}
_SIX_BEAMS = {"west": ([60, 75], 90), "east": ([60, 75], 270), "middle": ([35, 60], 90)}


def tree(
    air: dict[str, Any], *, six_beams: bool = False, rate: float = 4.0, **simulation: Any
) -> dict[str, Any]:
    """Return the campaign file of three lidars in a given air.

    Parameters
    ----------
    air : dict
    six_beams : bool
        Whether each lidar has two beams in one vertical plane, else one beam at the horizon.
    rate : float
        MHz, strength of the signals.
    **simulation
        Settings of it.
    """
    stations, pointings = (_PLANE, _SIX_BEAMS) if six_beams else (_STATIONS, _TRIANGLE)
    names = list(stations)
    return {
        "name": "net",
        "title": "Three lidars",
        "archive": "raw",
        "output": "out",
        "stations": {name: {"name": name, **place} for name, place in stations.items()},
        "instruments": {
            f"{name}-lidar": {
                "station": name,
                "files": f"{name}/{name[0]}*",
                "facts": [
                    {
                        "full_overlap_range": 150,
                        "channels": {"photon_532o": {"dead_time": 3e-9}},
                    }
                ],
            }
            for name in names
        },
        "networks": {
            "valley": {
                "name": "Valley",
                "instruments": [f"{name}-lidar" for name in names],
                "visibility": {"channel": "photon_532o", "average": "5min"},
            }
        },
        "simulation": {
            "seed": 7,
            "start": "2025-06-01T20:00:00Z",
            "duration": 3600,
            "origin": "west",
            "atmosphere": air,
            "truth": {"cells": 512},
            "instruments": {
                f"{name}-lidar": {
                    "scan": {"zenith_angles": pointings[name][0], "azimuth": pointings[name][1]},
                    "acquisition": {
                        "interval": 60,
                        "shots": 1000,
                        "repetition_rate": 20,
                        "bins": 2000,
                    },
                    "detectors": [
                        {
                            "wavelength": 532,
                            "signal_rate": rate,
                            "background": {"night": 0.05, "day": 4},
                            "photon": {},
                        }
                    ],
                }
                for name in names
            },
            **simulation,
        },
    }


def written(folder: Path, settings: dict[str, Any]) -> tuple[Campaign, xr.Dataset]:
    """Return a campaign that is simulated in a folder, and its truth."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "net.yaml"
    path.write_text(yaml.safe_dump(settings), encoding="utf-8")
    campaign = load_campaign(path)
    return campaign, simulate_campaign(campaign).truth


def truth_at(product: xr.Dataset, truth: xr.Dataset, instruments: list[str]) -> np.ndarray:
    """Return the true extinction (time, crossing) of a product, m-1, averaged like the product.

    Parameters
    ----------
    product, truth : xr.Dataset
    instruments : list of str
        Of each beam.
    """
    bounds = product["time_bnds"].values
    if np.isfinite(truth["total_extinction"].values).all():
        # Homogeneous: one number a file.
        return np.full(product["total_extinction"].shape, float(truth["total_extinction"].mean()))
    found = np.full((product.sizes["beam"], *product["total_extinction"].shape), np.nan)
    for beam, name in enumerate(instruments):
        suffix = name.replace("-", "_")
        granule = truth[f"profile_granule_{suffix}"].values
        when = truth["time"].values[granule]
        zenith = truth["zenith_angle"].values[granule]
        mine = np.abs(zenith - float(product["beam_zenith_angle"][beam])) < 0.2
        field = truth[f"profile_total_extinction_{suffix}"].values[:, 0]
        middle = truth[f"range_{suffix}"].values
        for crossing, distance in enumerate(product["beam_range"].values[beam]):
            if not np.isfinite(distance):
                continue
            there = np.array([np.interp(distance, middle, row) for row in field])
            for n, (start, stop) in enumerate(bounds):
                inside = mine & (when >= start) & (when <= stop)
                found[beam, n, crossing] = there[inside].mean()
    return np.nanmean(found, axis=0)
