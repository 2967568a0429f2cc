"""Methods that fit no horizontal gradient flag that they cannot detect one."""

from __future__ import annotations

import numpy as np
import pytest

from lidarops.retrieve.multiangle import optical_depth

ZENITH = np.array([-75.0, -60.0, -45.0, -30.0, 0.0, 30.0, 45.0, 60.0, 75.0])
ALTITUDE = np.arange(100.0, 3000.0, 50.0)


def level_sky(gradient: float) -> tuple[np.ndarray, np.ndarray]:
    """Return signals of level layers whose backscatter grows to one side by `gradient` (m-1)."""
    path = 1.0 / np.cos(np.deg2rad(ZENITH))[:, np.newaxis]
    aside = ALTITUDE * np.tan(np.deg2rad(ZENITH))[:, np.newaxis]
    signal = np.exp(gradient * aside - 2.0 * path * 1e-4 * ALTITUDE)
    return np.broadcast_to(signal, (10, *signal.shape)), (0.003 * signal) ** 2


@pytest.mark.parametrize("method", ["two_angle", "mld", "kano_hamilton", "joint"])
def test_methods_blind_to_a_gradient_flag_it(method):
    signal, variance = level_sky(2e-4)
    result = optical_depth.retrieve_optical_depth(
        signal, ZENITH, ALTITUDE, variance=variance, method=method
    )
    known = np.isfinite(result.optical_depth)
    assert known.any()
    if method in ("two_angle", "mld"):
        assert result.flags.one_sided[known].all()
        return
    assert not result.flags.one_sided[known].any()
    true = np.broadcast_to(1e-4 * ALTITUDE, known.shape)
    assert np.abs(result.optical_depth - true)[known].max() < 0.01
