"""The memory that a plan states for a Raman product is what means and retrieval take."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import xarray as xr

from lidarops.products.raman.retrieval import bytes_held
from lidarops.records import DetectionMode
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.raman import labeled
from lidarops.retrieve.raman.settings import RamanReference, RamanSettings
from lidarops.retrieve.signal.averaging import cloud_contrast
from lidarops.retrieve.signal.labeled import condition
from lidarops.retrieve.signal.labeled_averaging import ClockAverage, IntervalSums, Screening
from lidarops.retrieve.signal.thresholds import THRESHOLDS

WINDOW = RamanReference(lowest=3000.0, highest=6500.0)
NAMES = ("photon_355", "photon_387")


def night(profiles: int, bins: int) -> xr.Dataset:
    """Return counts of both channels over clean air, a profile a minute."""
    rng = np.random.default_rng(1)
    distance = 7.5 * (np.arange(bins) + 0.5)
    shape = MolecularProfile.us_standard().number_density(distance) / distance**2
    mean = 300.0 * shape / np.interp(1000.0, distance, shape) + 0.02
    minute = np.timedelta64(60, "s")
    starts = np.datetime64("2026-03-01T18:00", "ns") + np.arange(profiles) * minute
    unit = {"detection_mode": DetectionMode.PHOTON, "bin_width": 7.5}
    counts = {
        name: (("time", "range"), rng.poisson(mean, (profiles, bins)).astype(np.int32), unit)
        for name in NAMES
    }
    shots = {f"{name}_shots": ("time", np.full(profiles, 1200, np.int32)) for name in NAMES}
    return xr.Dataset(
        counts | shots,
        coords={
            "time": starts + minute // 2,
            "time_bnds": (("time", "nv"), np.stack([starts, starts + minute], axis=1)),
            "range": ("range", distance, {"units": "m"}),
        },
    )


def screened_average(counts: xr.Dataset) -> ClockAverage:
    """Return the means over half an hour of both channels, still without profiles."""
    distance, geometry = counts["range"].to_numpy(), counts[["time", "time_bnds"]]
    records = [
        IntervalSums(
            geometry,
            distance,
            seconds=1800.0,
            shots=counts[f"{name}_shots"],
            parts=THRESHOLDS.most_parts,
        )
        for name in NAMES
    ]
    return ClockAverage(records, Screening(cloud_contrast(355e-9), 12_000.0))


def peak(means: int, bins: int, cell: float) -> tuple[float, int]:
    """Return the peak of bytes beyond the profiles, and the number of cells."""
    counts = night(30 * means, bins)
    profiles = [
        condition(counts, name, dead_time=4e-9, full_overlap_range=300.0).load() for name in NAMES
    ]
    tracemalloc.start()
    average = screened_average(counts)
    average.add(profiles)
    ((elastic, raman),) = average.completed()
    product = labeled.retrieve(
        elastic.assign_coords(zenith_angle=0.0),
        raman,
        molecules=MolecularProfile.us_standard(),
        station_altitude=100.0,
        wavelengths=(355e-9, 387e-9),
        settings=RamanSettings(cell=cell, highest=float(counts["range"][-1]), reference=WINDOW),
    )
    highest = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return float(highest), product.sizes["range"]


@pytest.mark.parametrize(("means", "bins", "cell"), [(8, 1000, 15.0), (8, 4000, 300.0)])
def test_the_stated_memory_is_that_of_means_and_retrieval(means, bins, cell):
    peak(1, bins, cell)  # Compiles, and fills caches.
    highest, cells = peak(means, bins, cell)
    assert 0.6 < highest / bytes_held(len(NAMES), means, bins, cells) < 1.1
