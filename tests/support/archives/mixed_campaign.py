"""A simulated campaign of many kinds of scenes, for what a plan may leave out of them."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import yaml

from lidarops.campaign.model import Campaign, load_campaign

SECTIONS = [[450, 1500], [600, 2400], [900, 3000]]
_PHOTON: dict[str, Any] = {"photon": {}}
_ANALOG: dict[str, Any] = {"analog": {"gain": 0.05, "noise": 0.3, "dark_offset": 3.0}}
_BOTH = {**_PHOTON, **_ANALOG}
_AEROSOL = {"lidar_ratio": 50}
_COLUMN: dict[str, Any] = {
    "boundary_layer": {
        "extinction": 1.2e-4,
        "height": {"minimum": 1000, "maximum": 1900, "hour_of_maximum": 15},
        "aerosol": _AEROSOL,
    }
}
_CLOUD: dict[str, Any] = {
    "extinction": 2e-3,
    "height": 3000,
    "depth": 200,
    "aerosol": {"lidar_ratio": 20, "angstrom_exponent": 0},
    "start": "2025-06-01T00:00:00Z",
    "stop": "2025-06-03T00:00:00Z",
    "name": "cloud",
}


def _detector(outputs: dict[str, Any], rate: float, day: float = 5.0, **changes: Any) -> Any:
    return {
        "wavelength": 532,
        "signal_rate": rate,
        "background": {"night": 0.05, "day": day},
        **outputs,
        **changes,
    }


def _level(extinction: float, detector: dict[str, Any], **changes: Any) -> dict[str, Any]:
    course = {"minimum": extinction, "maximum": extinction, "hour_of_maximum": 12}
    return {
        "atmosphere": {"homogeneous": {"aerosol": _AEROSOL, "extinction": course}},
        "detectors": [detector],
        **changes,
    }


def _sections(*channels: str) -> dict[str, Any]:
    return {"homogeneous": {"channels": list(channels), "sections": SECTIONS}}


def _saturating() -> dict[str, Any]:
    analog = {**_ANALOG["analog"], "adc_range": 10, "gain": 1.0}
    return _level(2e-4, _detector({"analog": analog}, 500.0))


_KINDS: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    # Instrument -> station, its products, its simulation.
    "clear-night": ("west", _sections("photon_532o"), _level(2e-4, _detector(_BOTH, 5.0))),
    "clear-day": ("far", _sections("photon_532o"), _level(2e-4, _detector(_BOTH, 5.0, 20.0))),
    "haze": ("west", _sections("photon_532o"), _level(1e-3, _detector(_BOTH, 5.0))),
    "weak": ("west", _sections("photon_532o"), _level(1e-4, _detector(_PHOTON, 1e-5))),
    "weak-analog": ("far", _sections("analog_532o"), _level(1e-4, _detector(_BOTH, 1e-4))),
    "saturated": ("west", _sections("analog_532o"), _saturating()),
    "upward": (
        "west",
        _sections("photon_532o", "analog_532o"),
        {"atmosphere": _COLUMN, "detectors": [_detector(_BOTH, 20.0)]},
    ),
    "vertical": (
        "west",
        {**_sections("analog_532o"), "elastic": {"channels": ["photon_532o"]}},
        {"atmosphere": _COLUMN, "detectors": [_detector(_BOTH, 20.0)]},
    ),
    "cloudy": (
        "far",
        {
            **_sections("photon_532o", "analog_532o"),
            "elastic": {"channels": ["photon_532o"]},
        },
        {
            "atmosphere": {**_COLUMN, "layers": [_CLOUD]},
            "detectors": [_detector(_BOTH, 20.0)],
        },
    ),
    "scanner": (
        "west",
        {
            "multiangle": {"channels": ["photon_532o"], "highest": 3000},
            **_sections("analog_532o"),
        },
        {
            "atmosphere": _COLUMN,
            "scan": {"zenith_angles": [0, 30, 50, 60, 70, 75, 80], "azimuth": 90},
            "detectors": [_detector(_BOTH, 20.0)],
        },
    ),
}
_AIR = {
    "homogeneous": {
        "extinction": {"minimum": 4e-4, "maximum": 4e-4, "hour_of_maximum": 12},
        "aerosol": _AEROSOL,
        "molecules_constant": True,
    }
}
_POINTING = {"west": 70, "east": 310, "north": 190}
_DARK = ("saturated", "cloudy")
_UP = ("upward", "vertical", "cloudy")


def tree(*, profiles: int = 60, bins: int = 4000) -> dict[str, Any]:
    """Return the campaign file: one scene for each instrument, and one for the network."""
    instruments: dict[str, Any] = {}
    simulated: dict[str, Any] = {}
    shooting = {"interval": 60, "shots": 600, "repetition_rate": 20, "bins": bins}
    for name, (station, products, simulation) in _KINDS.items():
        facts: dict[str, Any] = {
            "full_overlap_range": 300,
            "channels": {"photon_532o": {"dead_time": 3e-9}},
        }
        if name != "scanner":
            facts |= {"zenith_angle": 0 if name in _UP else 90, "azimuth": 10}
        instruments[name] = {
            "station": station,
            "files": f"{name}/m*",
            "dark_files": f"{name}/dark/d*",
            "facts": [facts],
            "products": products,
        }
        dark = {"dark_files": 6} if name in _DARK else {}
        simulated[name] = {**simulation, "acquisition": {**shooting, **dark}}
    for name, azimuth in _POINTING.items():
        facts = {"full_overlap_range": 150, "channels": {"photon_532o": {"dead_time": 3e-9}}}
        instruments[f"{name}-lidar"] = {
            "station": name, "files": f"{name}-lidar/m*", "facts": [facts],
        }  # fmt: skip
        simulated[f"{name}-lidar"] = {
            "atmosphere": _AIR,
            "scan": {"zenith_angles": [90], "azimuth": azimuth},
            "acquisition": shooting,
            "detectors": [_detector(_PHOTON, 4.0)],
        }
    whole = {
        "name": "mixed",
        "title": "Scenes of many kinds",
        "archive": "raw",
        "output": "out",
        "stations": {
            "west": {"name": "W", "latitude": 47.25, "longitude": 11.3, "altitude": 600},
            "east": {"name": "E", "latitude": 47.25, "longitude": 11.353, "altitude": 600},
            "north": {"name": "N", "latitude": 47.2811, "longitude": 11.3265, "altitude": 600},
            # Where it is day when it is night at the others.
            "far": {"name": "F", "latitude": 47.25, "longitude": -150.0, "altitude": 600},
        },
        "instruments": instruments,
        "networks": {
            "valley": {
                "instruments": [f"{name}-lidar" for name in _POINTING],
                "visibility": {"channel": "photon_532o", "average": "10min"},
            }
        },
        "simulation": {
            "seed": 5,
            "start": "2025-06-01T22:00:00Z",
            "duration": 60 * profiles,
            "fast": True,
            "instruments": simulated,
        },
    }
    # Tests change what they are given.
    return copy.deepcopy(whole)


def write(folder: Path, **size: int) -> Campaign:
    """Write the campaign file and read it."""
    path = folder / "mixed.yaml"
    path.write_text(yaml.safe_dump(tree(**size)))
    return load_campaign(path)
