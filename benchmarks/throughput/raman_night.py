"""CPU time of the Raman products of a night, beyond reading its files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import xarray as xr

from benchmarks.harness.figure import Figure, cpu_time
from benchmarks.harness.results import Effort, Results, Study
from benchmarks.harness.timing import CPU_TIME, READ, time_methods
from benchmarks.harness.verdicts import Scores
from lidarops.records import DetectionMode
from lidarops.retrieve.air.molecular import MolecularProfile
from lidarops.retrieve.raman import labeled
from lidarops.retrieve.raman.settings import RamanSettings
from lidarops.retrieve.signal.averaging import cloud_contrast
from lidarops.retrieve.signal.labeled import condition
from lidarops.retrieve.signal.labeled_averaging import (
    ClockAverage,
    IntervalSums,
    Screening,
    joined,
)
from lidarops.retrieve.signal.thresholds import THRESHOLDS

PROFILES: Final = 720
BINS: Final = 4000
CHANNELS: Final = {"355": 355e-9, "387": 386.7e-9, "408": 407.5e-9, "532": 532e-9, "607": 607.4e-9}
"""m, by name."""
PRODUCTS: Final = (("355", "387", "408"), ("532", "607"))
"""Channels of each product: laser, nitrogen and, of one, water vapour."""
_STEP: Final = 7.5
_SECONDS: Final = 60
_COUNTS: Final = 300.0
"""Mean counts of a bin of a profile at 1 km."""
_BACKGROUND: Final = 0.02
_HIGHEST: Final = 12_000.0
"""m, of the reference window."""
AVERAGES: Final = "signals and means"
RETRIEVALS: Final = "two pairs and water vapour"
WHOLE: Final = "both, of the whole night"


def measure_raman(effort: Effort, *, profiles: int = PROFILES) -> Study:
    """Time signals, means and retrievals of a night of five channels, from counts in memory."""
    counts = night(profiles)
    means = means_of(counts)
    calls = {
        READ: (lambda: [np.max(counts[f"photon_{name}"]) for name in CHANNELS], profiles),
        AVERAGES: (lambda: means_of(counts), profiles),
        RETRIEVALS: (lambda: retrieved(means), profiles),
    }
    case = f"{profiles} profiles to {means['355'].sizes['time']} means, five channels"
    scores: Scores = time_methods(case, calls, effort.repeats or 3)
    parts = [scores[case, name][CPU_TIME] for name in (AVERAGES, RETRIEVALS)]
    whole = profiles * sum(part.value for part in parts if isinstance(part, Figure))
    scores[case, WHOLE] = {"lidarops": True, "profiles": 1, CPU_TIME: cpu_time(whole)}
    effort.progress(1)
    note = (
        f"{len(CHANNELS)} channels of photon counting, {BINS} bins: signals with noise and quality,"
        " means over half an hour without outlying parts; then extinction, backscatter and lidar"
        " ratio of two pairs, and water vapour. Reading and writing of files are left out. One"
        f" thread. Reads: multiples of {READ}."
    )
    results = Results("CPU time of a profile", scores, note, case="night")
    return Study("Raman: time of a night", effort.date, [results])


def night(profiles: int, bins: int = BINS) -> xr.Dataset:
    """Return the counts of the channels over clean air, as of an open archive."""
    rng = np.random.default_rng(1)
    distance = _STEP * (np.arange(bins) + 0.5)
    shape = MolecularProfile.us_standard().number_density(distance) / distance**2
    mean = _COUNTS * shape / np.interp(1000.0, distance, shape) + _BACKGROUND
    length = np.timedelta64(_SECONDS, "s")
    starts = np.datetime64("2026-03-01T18:00", "ns") + np.arange(profiles) * length
    both = ("time", "range")
    unit = {"detection_mode": DetectionMode.PHOTON, "bin_width": _STEP}
    variables: dict[str, Any] = {}
    for name in CHANNELS:
        counts = rng.poisson(mean, (profiles, bins)).astype(np.int32)
        variables[f"photon_{name}"] = (both, counts, unit)
        variables[f"photon_{name}_shots"] = ("time", np.full(profiles, 1200, np.int32), {})
    return xr.Dataset(
        variables,
        coords={
            "time": starts + length // 2,
            "time_bnds": (("time", "nv"), np.stack([starts, starts + length], axis=1)),
            "range": ("range", distance, {"units": "m"}),
        },
    )


def means_of(counts: xr.Dataset) -> dict[str, xr.Dataset]:
    """Return the means of each channel, by name, without the parts outlying in its product."""
    means: dict[str, xr.Dataset] = {}
    for names in PRODUCTS:
        average = screened_average(counts, names)
        for first in range(0, counts.sizes["time"], 90):
            average.add(night_signals(counts.isel(time=slice(first, first + 90)), names))
        batches = zip(*average.completed(), strict=True)
        means |= {name: joined(iter(of)) for name, of in zip(names, batches, strict=True)}
    return means


def night_signals(counts: xr.Dataset, names: Sequence[str]) -> list[xr.Dataset]:
    """Return the signals of channels, with noise and quality."""
    return [
        condition(counts, f"photon_{name}", dead_time=4e-9, full_overlap_range=300.0)
        for name in names
    ]


def screened_average(counts: xr.Dataset, names: Sequence[str]) -> ClockAverage:
    """Return the means over half an hour of the channels of a product, still without profiles."""
    distance, geometry = counts["range"].to_numpy(), counts[["time", "time_bnds"]]
    records = [
        IntervalSums(geometry, distance, seconds=1800.0, shots=counts[f"photon_{name}_shots"],
                     parts=THRESHOLDS.most_parts)
        for name in names
    ]  # fmt: skip
    return ClockAverage(records, Screening(cloud_contrast(CHANNELS[names[0]]), _HIGHEST))


def retrieved(means: dict[str, xr.Dataset]) -> list[xr.Dataset]:
    """Return the products of both pairs."""
    water = labeled.WaterVapour(means["408"], CHANNELS["408"], 0.2, 0.01)
    pairs = (("355", "387", water), ("532", "607", None))
    return [
        labeled.retrieve(
            means[laser].assign_coords(zenith_angle=0.0), means[raman],
            molecules=MolecularProfile.us_standard(), station_altitude=100.0,
            wavelengths=(CHANNELS[laser], CHANNELS[raman]), settings=RamanSettings(), water=of_pair,
        )
        for laser, raman, of_pair in pairs
    ]  # fmt: skip
