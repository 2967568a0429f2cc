"""Errors by a horizontal gradient, where beams point to both sides."""

from __future__ import annotations

import numpy as np
import pytest
from support.scan_arguments import retrieve_optical_depth

from lidarops.retrieve.multiangle.flags import MultiAngleQuality
from lidarops.retrieve.multiangle.optical_depth import MultiAngleResult
from lidarops.retrieve.multiangle.slant_paths import slant_path

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


@pytest.mark.parametrize("method", ["kano_hamilton", "joint"])
def test_a_cycle_cut_short_fits_no_gradient_that_its_beams_cannot_tell(method):
    """The beams to one side would determine the optical depth seven times worse with a gradient."""
    signal, variance = level_sky(0.0)
    drawn = np.random.default_rng(5).normal(size=(2, *variance.shape))
    cycles = signal[:2] + np.sqrt(variance) * drawn
    cycles[1, ZENITH < 0.0] = np.nan
    result = retrieve_optical_depth(cycles, ZENITH, ALTITUDE, variance=variance, method=method)
    whole, cut = result.optical_depth_standard_error
    assert np.nanmedian(cut / whole) < 2.0
    assert np.nanmax(np.abs(result.optical_depth[1] - 1e-4 * ALTITUDE) / cut) < 4.0
    assert np.all(result.optical_depth_gradient_error[0] < 1e-9)
    assert np.all(result.optical_depth_gradient_error[1] > 0.0)


SIDES = np.array([0.0, *4 * [30.0, 45.0, 60.0, 70.0]])
AZIMUTH = np.array([0.0, *np.repeat([0.0, 180.0, 90.0, 270.0], 4)])


@pytest.mark.parametrize("method", ["kano_hamilton", "joint"])
@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_altitudes_with_beams_to_one_side_alone_have_values_with_errors(method, correlation):
    """Every other altitude holds beams to the north alone, which fit no gradient."""
    rng, path = np.random.default_rng(7), slant_path(SIDES, ALTITUDE)
    air = rng.normal(size=(40, *path.shape))
    for k in range(1, ALTITUDE.size):
        air[..., k] *= np.sqrt(1.0 - correlation**2)
        air[..., k] += correlation * air[..., k - 1]
    signal = np.exp(0.02 * air - 2.0 * path * 1e-4 * ALTITUDE)
    signal[:, AZIMUTH > 0.0, ::2] = np.nan
    result = retrieve_optical_depth(
        signal, SIDES, ALTITUDE, variance=1e-8 * signal**2, azimuth=AZIMUTH, method=method
    )
    away = (result.extinction - 1e-4) / result.extinction_standard_error
    assert np.isfinite(away).all()
    assert 0.5 < np.sqrt(np.mean(away**2)) < 1.5


LOW = np.arange(65.0, 85.1, 0.4)
CELLS = np.arange(60.0, 3001.0, 60.0)


def one_sided(
    seed: int, *, gradient: float = 0.0, dead_time: float = 0.0, change: float = 0.0
) -> MultiAngleResult:
    """Retrieve ten cycles to one side, with an error by the dead time as of the real scans.

    `dead_time` is the error of the signal at 1000 m; `change` that which is stated.
    """
    path = slant_path(LOW, CELLS)
    depth = np.cumsum(np.where(CELLS < 1000.0, 2.2e-4, 6e-5) * 60.0)
    aside = np.sqrt(path**2 - 1.0) * CELLS
    near = (1000.0 / (path * CELLS)) ** 2
    signal = np.where(CELLS < 1000.0, 1.0, 0.3) * np.exp(gradient * aside - 2.0 * path * depth)
    noise = np.full(path.shape, 0.01) * (path * CELLS / 1500.0) ** 2
    drawn = np.random.default_rng(seed).normal(size=(10, *signal.shape))
    measured = signal * (1.0 + dead_time * near) + noise * drawn
    measured[:, path * CELLS < 700.0] = np.nan
    return retrieve_optical_depth(
        measured,
        LOW,
        CELLS,
        variance=np.where(np.isnan(measured), np.nan, noise**2),
        azimuth=np.full(LOW.size, 90.0),
        method="kano_hamilton",
        dead_time_change=np.broadcast_to(signal * near * change, measured.shape),
    )


def rejected(result: MultiAngleResult) -> float:
    """Return the share of optical depths that `poor_stratification` rejects."""
    poor = result.raised(MultiAngleQuality.POOR_STRATIFICATION)
    return float(poor[np.isfinite(result.optical_depth)].mean())


def test_level_air_shows_no_gradient():
    """Noisy samples are biased: with them, all altitudes of these scenes would be rejected."""
    assert [rejected(one_sided(seed)) for seed in (56, 64, 74)] == [0.0, 0.0, 0.0]


def test_what_the_dead_time_explains_is_no_gradient():
    """The stated error of the dead time decides whether bent signals near the lidar reject."""
    assert rejected(one_sided(1, dead_time=0.1)) == 1.0
    assert rejected(one_sided(1, dead_time=0.1, change=0.1)) == 0.0
    assert rejected(one_sided(1, gradient=1e-3, change=0.05)) == 1.0
    # Several errors of the dead time would explain this one.
    assert rejected(one_sided(1, gradient=5e-4, change=0.05)) == 1.0
