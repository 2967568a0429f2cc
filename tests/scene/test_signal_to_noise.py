"""Values below their noise carry LOW_SIGNAL_TO_NOISE; means that keep them are unbiased."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from lidarops.flags import Quality
from lidarops.scene.retrieval import with_low_signal_to_noise

CARE = int(Quality.LOW_SIGNAL_TO_NOISE)


def rows(**values: list[float]) -> xr.Dataset:
    """Return variables over time with errors of 2, and an earlier bit on the first value."""
    count = len(next(iter(values.values())))
    flags = np.zeros(count, np.int32)
    flags[0] = int(Quality.PILE_UP)
    arrays = {name: ("time", np.array(array)) for name, array in values.items()}
    errors = {f"{name}_standard_error": ("time", np.full(count, 2.0)) for name in values}
    return xr.Dataset({**arrays, **errors, "quality_flag": ("time", flags)})


def test_values_below_their_error_are_used_with_care():
    flags = with_low_signal_to_noise(rows(a=[1.0, -1.9, 2.0, -2.1, np.nan]), ["a"], 1.0)
    care = int(Quality.LOW_SIGNAL_TO_NOISE)
    expected = [int(Quality.PILE_UP) | care, care, 0, 0, 0]
    assert flags["quality_flag"].values.tolist() == expected
    assert flags["quality_flag"].dtype == np.int32


@pytest.mark.parametrize(("least", "raised"), [(0.0, 0), (1.0, 1), (3.0, 2)])
def test_the_limit_is_a_multiple_of_the_error(least: float, raised: int):
    flags = with_low_signal_to_noise(rows(a=[9.0, 0.0, 5.0]), ["a"], least)["quality_flag"]
    assert int((flags & CARE != 0).sum()) == raised


def test_one_variable_is_enough():
    flags = with_low_signal_to_noise(rows(a=[9.0, 9.0], b=[9.0, 1.0]), ["a", "b"], 1.0)
    assert (flags["quality_flag"].values & CARE != 0).tolist() == [False, True]


def test_a_mean_is_unbiased_only_with_such_values():
    noise = np.random.default_rng(3).normal(0.5, 2.0, 40_000)
    marked = with_low_signal_to_noise(rows(a=[9.0, *noise]), ["a"], 1.0).isel(time=slice(1, None))
    good = marked["a"].where(marked["quality_flag"] & CARE == 0).mean()
    # The mean of all is 0.5.
    assert float(good) > 0.7
