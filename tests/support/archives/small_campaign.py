"""Settings of a small simulated campaign, as a dict."""

from __future__ import annotations

from typing import Any

FAST, SLOW = 2.0e-9, 6.0e-9

TREE: dict[str, Any] = {
    "name": "small",
    "title": "Small simulated campaign",
    "archive": "set by the fixture",
    "output": "set by the fixture",
    "stations": {
        "coast": {"name": "Coast", "latitude": 54.4, "longitude": 10.2, "altitude": 15},
        "hill": {"name": "Hill", "latitude": 47.8, "longitude": 11.0, "altitude": 900},
    },
    "instruments": {
        "coast-lidar": {
            "station": "coast",
            "files": "coast/h*",
            "dark_files": "coast/dark/d*",
            "facts": [
                {
                    "valid_to": "2024-12-31T23:58:00Z",
                    "zenith_angle": 90,
                    "azimuth": 315,
                    "full_overlap_range": 300,
                    "channels": {"photon_532o": {"dead_time": SLOW}},
                },
                {
                    "valid_from": "2024-12-31T23:58:00Z",
                    "zenith_angle": 90,
                    "azimuth": 315,
                    "full_overlap_range": 300,
                    "channels": {"photon_532o": {"dead_time": FAST}},
                },
            ],
        },
        "hill-lidar": {
            "station": "hill",
            "files": "hill/v*",
            "facts": [
                {"full_overlap_range": 300, "channels": {"photon_532o": {"dead_time": 4e-9}}}
            ],
        },
    },
    "simulation": {
        "seed": 7,
        "start": "2024-12-31T23:50:00Z",
        "duration": 1200,
        "instruments": {
            "coast-lidar": {
                "atmosphere": {"homogeneous": {"extinction": {"minimum": 2e-4, "maximum": 2e-4}}},
                "acquisition": {
                    "interval": 60,
                    "shots": 600,
                    "repetition_rate": 10,
                    "bins": 600,
                    "dark_files": 3,
                },
                "detectors": [
                    {
                        "wavelength": 532,
                        "signal_rate": 6.0,
                        "background": {"night": 2.0, "day": 2.0},
                        "photon": {},
                        "analog": {
                            "gain": 0.05,
                            "noise": 0.2,
                            "dark_offset": 3.0,
                            "adc_range": 100,
                        },
                    }
                ],
            },
            "hill-lidar": {
                "atmosphere": {"boundary_layer": {}},
                "acquisition": {"interval": 300, "bins": 800},
                "detectors": [
                    {
                        "wavelength": 1064,
                        "signal_rate": 30,
                        "background": {"night": 0.02, "day": 3},
                        "analog": {"gain": 0.05, "noise": 0.2, "dark_offset": 3.0},
                    },
                    {
                        "wavelength": 532,
                        "signal_rate": 20,
                        "background": {"night": 0.02, "day": 8},
                        "photon": {},
                    },
                ],
            },
        },
    },
}
