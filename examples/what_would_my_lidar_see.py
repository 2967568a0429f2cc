"""What would my lidar see? Signals by night and by day, and their range.

    python examples/what_would_my_lidar_see.py figure.png

Change the laser, the telescope and the air below, and run it again. The lidar is simulated as a
campaign of two files, one at midnight and one at noon. The files are read like those of a real
instrument, and the signals are compared with the truth.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import matplotlib as mpl
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lidarops import open_archive
from lidarops.campaign.model import Campaign
from lidarops.simulate.campaign import SimulatedCampaign, simulate_campaign

Array = NDArray[np.float64]

FULL_OVERLAP = 400.0  # m
DEAD_TIME = 4e-9  # s

# %% The lidar: a laser of 20 mJ at 50 Hz, a telescope of 20 cm, files of one minute.
LIDAR = {
    "acquisition": {"interval": 43_200, "shots": 3000, "repetition_rate": 50, "bins": 4000},
    "pulse": {"shape": "gaussian", "width": 8e-9},
    "detectors": [
        {
            "wavelength": 532,
            "optics": {"energy": 20e-3, "area": 0.0314, "efficiency": 0.001},
            "background": {"night": 0.02, "day": 6.0},
            "photon": {},
            "analog": {"gain": 0.05, "noise": 0.3, "dark_offset": 3.0, "adc_range": 100},
        }
    ],
}

# %% The air: haze, a layer of dust, a thin cirrus.
ATMOSPHERE = {
    "boundary_layer": {
        "extinction": 1.2e-4,
        "height": {"minimum": 900, "maximum": 1700, "hour_of_maximum": 14},
    },
    "layers": [
        {
            "name": "dust",
            "extinction": 6e-5,
            "height": 3500,
            "depth": 300,
            "aerosol": {"lidar_ratio": 45, "angstrom_exponent": 0.3},
            "start": "2025-06-20",
            "stop": "2025-06-23",
        },
        {
            "name": "cirrus",
            "extinction": 1e-4,
            "height": 10_000,
            "depth": 250,
            "aerosol": {"lidar_ratio": 25, "angstrom_exponent": 0},
            "start": "2025-06-20",
            "stop": "2025-06-23",
        },
    ],
}


def campaign(archive: Path) -> Campaign:
    """Return the campaign of two files, at midnight and at noon."""
    facts = {
        "zenith_angle": 0,
        "full_overlap_range": FULL_OVERLAP,
        "channels": {"photon_532o": {"dead_time": DEAD_TIME}},
    }
    return Campaign.model_validate(
        {
            "name": "my-lidar",
            "title": "What would my lidar see",
            "archive": str(archive),
            "output": str(archive),
            "stations": {"home": {"name": "Home", "latitude": 50, "longitude": 0}},
            "instruments": {"lidar": {"station": "home", "files": "m*", "facts": [facts]}},
            "simulation": {
                "seed": 1,
                "start": "2025-06-21T00:00:00Z",
                "duration": 43_200 + 60,
                "atmosphere": ATMOSPHERE,
                "truth": {"cells": 2048},
                "instruments": {"lidar": LIDAR},
            },
        }
    )


# %% Truth and measurement: attenuated backscatter, and the rate of photons.
def true_attenuated_backscatter(result: SimulatedCampaign, row: int) -> tuple[Array, Array]:
    """Return the true attenuated backscatter, m-1 sr-1, and its range cells, m."""
    profile = result.truth.isel(profile_lidar=row, wavelength_lidar=0)
    depth = profile["profile_path_optical_depth_lidar"].values
    cell = np.diff(depth, prepend=0.0)
    attenuated = profile["profile_total_backscatter_lidar"].values * np.exp(
        -2.0 * (depth - cell / 2)
    )
    return attenuated, result.truth["range_lidar"].values


def photon_rate(signals: xr.Dataset, row: int) -> tuple[Array, Array]:
    """Return the photon rate without dead time and background, MHz, and its standard error."""
    counted = signals["photon_532o"].values[row].astype(float)
    live = 1.0 - counted * DEAD_TIME * 1e6
    exposure = float(signals["photon_532o_shots"][row]) * 0.05  # bins of 50 ns, microseconds
    error = np.sqrt(counted / exposure) / live**2
    corrected = counted / live
    return corrected - corrected[-500:].mean(), error


def draw(result: SimulatedCampaign, signals: xr.Dataset, figure: Path) -> None:
    """Draw the range-corrected signals with the truth, and their relative errors."""
    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415 - the backend must be set before

    drawing, (left, right) = plt.subplots(1, 2, figsize=(9, 6), sharey=True, layout="constrained")
    distance = signals["range"].values
    usable = distance > FULL_OVERLAP
    for row, (name, colour) in enumerate({"midnight": "#1b4f9c", "noon": "#d1720f"}.items()):
        signal, error = photon_rate(signals, row)
        truth, cells = true_attenuated_backscatter(result, row)
        constant = np.median(
            (signal * distance**2)[usable][:100] / np.interp(distance[usable][:100], cells, truth)
        )
        left.plot(signal * distance**2 / constant, distance / 1e3, lw=0.4, color=colour, alpha=0.6)
        left.plot(truth, cells / 1e3, lw=1.2, color="black", ls="-" if row else "--")
        true_signal = np.interp(distance, cells, truth) * constant / distance**2
        relative = error / true_signal
        right.plot(relative[usable], distance[usable] / 1e3, lw=0.8, color=colour, label=name)
    left.set(xscale="log", xlim=(3e-8, 1e-5), ylim=(0, 15), ylabel="height (km)")
    left.set_xlabel("attenuated backscatter (m$^{-1}$ sr$^{-1}$), truth in black")
    right.set(xscale="log", xlim=(1e-3, 10))
    right.set_xlabel("standard error of one 7.5 m bin in one minute (1)")
    right.axvline(0.1, color="grey", lw=0.8, ls=":")
    right.legend(frameon=False)
    drawing.savefig(figure, dpi=150)


def main(figure: str) -> None:
    """Simulate two files, read them and draw the figure."""
    with tempfile.TemporaryDirectory() as folder:
        result = simulate_campaign(campaign(Path(folder)))
        draw(result, open_archive(folder).load(), Path(figure))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
