"""Means of several channels without the parts that are outlying in any of them."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import xarray as xr

from lidarops.records import DetectionMode
from lidarops.retrieve.signal import labeled
from lidarops.retrieve.signal.labeled_averaging import Screening
from lidarops.scene.profiles import Averages, Chunk, FileProfiles, bin_ranges

STEP, BINS, PROFILES = 7.5, 400, 12
DISTANCE = STEP * (np.arange(BINS) + 0.5)
OFFSETS = {"photon_355": 0.0, "photon_387": 15.0}
"""m, by which the ranges of each channel are shifted."""


def counts(*, spike: str | None) -> xr.Dataset:
    """Return raw counts of a quarter of an hour, of which one profile may have a spike."""
    rng = np.random.default_rng(1)
    starts = np.datetime64("2026-03-01T20:00", "ns") + np.arange(PROFILES) * np.timedelta64(60, "s")
    bounds = np.stack([starts, starts + np.timedelta64(60, "s")], axis=1)
    variables = {}
    for name, offset in OFFSETS.items():
        light = 3e7 / (DISTANCE + offset + 300.0) ** 2
        drawn = rng.poisson(light + 0.1, (PROFILES, BINS)).astype(np.int32)
        if name == spike:
            drawn[5, 200:210] *= 9
        attributes = {"detection_mode": DetectionMode.PHOTON, "bin_width": STEP}
        variables[name] = (("time", "range"), drawn, attributes)
        variables[f"{name}_shots"] = ("time", np.full(PROFILES, 1200, np.int32))
    return xr.Dataset(
        variables,
        coords={
            "time": starts + np.timedelta64(30, "s"),
            "time_bnds": (("time", "nv"), bounds),
            "range": ("range", DISTANCE, {"units": "m"}),
        },
    )


def means(archive: xr.Dataset) -> tuple[xr.Dataset, ...]:
    """Return the mean of both channels."""
    channels = [
        FileProfiles(
            name,
            bin_ranges(archive, name, offset),
            None,
            partial(
                labeled.condition,
                dead_time=None, dead_time_uncertainty=0.0, noise_variance=None,
                dark=None, range_offset=offset, full_overlap_range=0.0,
            ),
        )
        for name, offset in OFFSETS.items()
    ]  # fmt: skip
    averages = Averages(
        channels, archive, archive["photon_355_shots"], 900.0, Screening(2.0, 2500.0)
    )
    averages.add(Chunk(archive, slice(0, archive.sizes["time"])))
    (completed,) = averages.completed()
    return completed


@pytest.mark.parametrize("spike", OFFSETS)
def test_a_profile_with_a_spike_in_one_channel_is_left_out_of_all(spike):
    clean = means(counts(spike=None))
    spiked = means(counts(spike=spike))
    for channel, of_all in zip(spiked, clean, strict=True):
        assert of_all["profiles_left_out"] == 0
        assert channel["profiles_left_out"] == 1
        assert channel["profiles"] == PROFILES - 1
        assert channel["shots"] == 1200 * (PROFILES - 1)
        away = (channel["power"] - of_all["power"]).to_numpy()[0, 200:210]
        error = np.sqrt(of_all["variance"].to_numpy()[0, 200:210])
        # One profile less; with it, the mean would be larger by 10 errors.
        assert np.abs(away).max() < 1.5 * error.max()
    distances = [channel["range"].to_numpy()[0] for channel in spiked]
    assert distances == [0.5 * STEP + offset for offset in OFFSETS.values()]


def test_cells_of_all_channels_are_of_the_same_ranges():
    first, second = means(counts(spike=None))
    # Of equal light; the first channel begins two bins nearer than the last one.
    ratio = (first["part_power"] / second["part_power"]).to_numpy()[0, :PROFILES, :20]
    assert np.nanmean(ratio) == pytest.approx(1.0, abs=0.01)
