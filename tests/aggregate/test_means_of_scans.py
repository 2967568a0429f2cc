"""Means over many scans of the same air, which share the smoothing error."""

from __future__ import annotations

import numpy as np
import pytest
from support.oracles.angle_scenes import clear, estimates

from lidarops.aggregate._sums import Sample, Sums
from lidarops.aggregate.means_variables import budget_of
from lidarops.netcdf.variables import layout_of
from lidarops.retrieve.multiangle import smooth_profile

CYCLES = 48


@pytest.mark.parametrize("name", ["vertical_optical_depth", "total_extinction"])
def test_means_stay_within_their_errors(name: str):
    rng = np.random.default_rng(5)
    scene = clear(3000.0, aerosol=2.0)
    step = np.diff(scene.altitude, prepend=0.0)
    truth = (
        scene.truth
        if name == "vertical_optical_depth"
        else np.diff(scene.truth, prepend=0.0) / step
    )
    sums, shares = Sums(), []
    for days in range(1, 6):
        depths = estimates(scene, CYCLES, rng, 0.6)
        smooth = smooth_profile.smooth_optical_depth(
            depths.optical_depth,
            depths.information,
            scene.altitude,
            noise=depths.noise,
        )
        short = name.removeprefix("vertical_").removeprefix("total_")
        errors = getattr(smooth, f"{short}_standard_error")
        budget = budget_of(layout_of("multiangle").rows[name])
        random, shared = (errors, ()) if budget is None else (np.zeros_like(errors), (errors,))
        usable = np.isfinite(smooth.optical_depth)
        day = Sample(getattr(smooth, short), errors, random, shared, {}, usable)
        sums.add(day, np.ones(day.values.shape))
        if days in (1, 5):
            mean = sums.mean(name)
            frequent = mean[f"{name}_observations"] > 0.9 * CYCLES * days
            assert frequent.sum() > 50
            error = mean[f"{name}_standard_error"]
            shares.append(np.abs(mean[name] - truth)[frequent] / error[frequent])
    assert all(np.mean(share > 2.0) < 0.05 for share in shares)
    assert all(share.max() < 4.0 for share in shares)
