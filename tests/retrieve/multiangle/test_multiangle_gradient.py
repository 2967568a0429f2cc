"""Errors by a horizontal gradient, where beams point to both sides."""

from __future__ import annotations

import numpy as np
import pytest
from support.scan_arguments import retrieve_optical_depth

ZENITH = np.array([-75.0, -60.0, -45.0, -30.0, 0.0, 30.0, 45.0, 60.0, 75.0])
ALTITUDE = np.arange(100.0, 3000.0, 50.0)


def level_sky(gradient: float) -> tuple[np.ndarray, np.ndarray]:
    """Return signals of level layers whose backscatter grows to one side by `gradient` (m-1)."""
    path = 1.0 / np.cos(np.deg2rad(ZENITH))[:, np.newaxis]
    aside = ALTITUDE * np.tan(np.deg2rad(ZENITH))[:, np.newaxis]
    signal = np.exp(gradient * aside - 2.0 * path * 1e-4 * ALTITUDE)
    return np.broadcast_to(signal, (10, *signal.shape)), (0.003 * signal) ** 2


@pytest.mark.parametrize(
    ("method", "cancels"),
    [("two_angle", False), ("mld", True), ("kano_hamilton", True), ("joint", True)],
)
def test_a_gradient_cancels_or_is_within_the_stated_error(method, cancels):
    signal, variance = level_sky(5e-5)
    result = retrieve_optical_depth(
        signal, ZENITH, ALTITUDE, variance=variance, method=method, largest_gradient=5e-5
    )
    known = np.isfinite(result.optical_depth)
    assert known.any()
    error = np.abs(result.optical_depth - 1e-4 * ALTITUDE)[known]
    stated = result.optical_depth_gradient_error[known]
    assert np.all(error < stated + 0.01)
    assert (stated.max() < 1e-9) == cancels
    assert (error.max() < 0.01) == cancels
