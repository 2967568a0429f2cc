"""The memory that a plan states for a Raman product is what means and retrieval take."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import xarray as xr

from lidarops.products.raman.steps import bytes_held
from lidarops.records import DetectionMode
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.raman import labeled
from lidarops.retrieve.raman.retrieval import RamanSettings
from lidarops.retrieve.signal.labeled import condition
from lidarops.retrieve.signal.labeled_averaging import ClockAverage
from lidarops.retrieve.signal.labeled_screening import Record, ScreenedAverage, Screening
from lidarops.retrieve.signal.thresholds import THRESHOLDS

STEP = 7.5
SETTINGS = RamanSettings(355e-9, 387e-9, 1.0, 0.5, 3000.0, 6500.0, 2000.0, 1.0, 0.02, 0.01)
NAMES = ("photon_355o", "photon_387o")


def counted(means: int, bins: int) -> xr.Dataset:
    """Return counts of two channels over clean air, 10 profiles a mean."""
    rng = np.random.default_rng(1)
    distance = STEP * (np.arange(bins) + 0.5)
    shape = MolecularProfile.us_standard().number_density(distance) / distance**2
    mean = 3000.0 * shape / np.interp(1000.0, distance, shape)
    length = np.timedelta64(180, "s")
    starts = np.datetime64("2026-03-01T18:00", "ns") + np.arange(10 * means) * length
    unit = {"detection_mode": DetectionMode.PHOTON, "bin_width": STEP}
    variables = {}
    for name in NAMES:
        counts = rng.poisson(mean, (starts.size, bins)).astype(np.int32)
        variables[name] = (("time", "range"), counts, unit)
        variables[f"{name}_shots"] = ("time", np.full(starts.size, 1200, np.int32), {})
    bounds = (("time", "nv"), np.stack([starts, starts + length], axis=1))
    coords = {
        "time": starts + length // 2,
        "time_bnds": bounds,
        "range": ("range", distance, {"units": "m"}),
    }
    return xr.Dataset(variables, coords=coords)


def peak(means: int, bins: int, cell: float) -> tuple[float, int]:
    """Return the peak of bytes beyond the profiles, and the number of cells."""
    counts = counted(means, bins)
    distance = counts["range"].to_numpy()
    profiles = [
        condition(counts, name, dead_time=4e-9, full_overlap_range=300.0).load() for name in NAMES
    ]
    geometry = counts[["time", "time_bnds"]]
    tracemalloc.start()
    records = [
        Record(
            ClockAverage(
                geometry,
                distance,
                seconds=1800.0,
                shots=counts[f"{name}_shots"],
                parts=THRESHOLDS.most_parts,
            ),
            distance,
        )
        for name in NAMES
    ]
    average = ScreenedAverage(records, Screening(3.0, 6500.0))
    average.add(profiles)
    ((elastic, raman),) = average.completed()
    product = labeled.retrieve(
        elastic.assign_coords(zenith_angle=0.0),
        raman,
        molecules=MolecularProfile.us_standard(),
        station_altitude=100.0,
        assumptions=labeled.Assumptions(SETTINGS, cell, float(distance[-1]), known_shape=True),
    )
    highest = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return float(highest), product.sizes["range"]


@pytest.mark.parametrize(("means", "bins", "cell"), [(8, 1000, 15.0), (8, 4000, 300.0)])
def test_the_stated_memory_is_that_of_means_and_retrieval(means, bins, cell):
    peak(1, bins, cell)  # Compiles, and fills caches.
    highest, cells = peak(means, bins, cell)
    assert 0.6 < highest / bytes_held(len(NAMES), means, bins, cells) < 1.1
