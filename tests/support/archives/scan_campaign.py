"""The campaign of a simulated scanning lidar under a boundary layer and dust."""

from __future__ import annotations

from typing import Any

ALTITUDE = 180.0
TREE: dict[str, Any] = {
    "name": "scans",
    "title": "Scans over a boundary layer and dust",
    "archive": "raw",
    "output": "out",
    "stations": {
        "plain": {"name": "Plain", "latitude": 50.5, "longitude": 14.3, "altitude": ALTITUDE}
    },
    "instruments": {
        "scanner": {
            "station": "plain",
            "files": "plain/m*",
            "facts": [
                {"full_overlap_range": 300, "channels": {"photon_532o": {"dead_time": 3e-9}}}
            ],
            "products": {"multiangle": {"channels": ["photon_532o"], "highest": 5000}},
        }
    },
    "scenes": {"window": "6h"},
    "simulation": {
        "seed": 20250314,
        "start": "2025-03-14T00:00:00Z",
        "duration": 8580,
        "atmosphere": {
            "boundary_layer": {
                "extinction": 1.5e-4,
                "height": {"minimum": 600, "maximum": 1500, "hour_of_maximum": 14},
                "aerosol": {"lidar_ratio": 50, "angstrom_exponent": 1.2},
            },
            "layers": [
                {
                    "name": "dust",
                    "extinction": 6e-5,
                    "height": 2800,
                    "depth": 250,
                    "aerosol": {"lidar_ratio": 45, "angstrom_exponent": 0.3},
                    "start": "2025-03-13T00:00:00Z",
                    "stop": "2025-03-16T00:00:00Z",
                }
            ],
        },
        "instruments": {
            "scanner": {
                "scan": {
                    "zenith_angles": [0, 30, 45, 60, 70, 75],
                    "azimuth": 90,
                    "two_sided": True,
                },
                "acquisition": {
                    "interval": 39,
                    "shots": 700,
                    "repetition_rate": 20,
                    "bins": 2000,
                },
                "laser": {"jitter": 0.002},
                "detectors": [
                    {
                        "wavelength": 532,
                        "signal_rate": 20,
                        "background": {"night": 0.02, "day": 5},
                        "photon": {},
                    }
                ],
            }
        },
    },
}
