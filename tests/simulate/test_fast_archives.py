"""Fast archives, drifting instruments, and truth of layered air."""

from __future__ import annotations

import numpy as np
import pytest

from lidarops.raw import licel
from lidarops.simulate.campaign import simulate_campaign


def _simulated(tree):
    return tree["simulation"]["instruments"]


def _values(result, row):
    path = result.archive / str(result.truth["path"].values[row])
    header = licel.read_header(path)
    content = path.read_bytes()
    return {
        d.name: np.frombuffer(content, "<i4", d.bins, d.offset) * d.scale for d in header.channels
    }


def test_fast_files_agree_with_the_truth_within_their_noise(small):
    def fast(tree):
        tree["simulation"]["fast"] = True
        tree["simulation"]["duration"] = 2400
        del _simulated(tree)["hill-lidar"]

    result = simulate_campaign(small(fast))
    truth = result.truth
    distance = (np.arange(600) + 0.5) * 7.5
    beyond = distance >= 300
    scores = {"photon_532o": [], "analog_532o": []}
    for row in range(8):  # before the dead time changes
        values = _values(result, row)
        sigma = float(truth["total_extinction"][row])
        shape = np.exp(-2 * sigma * distance) / distance**2
        rate = float(truth["background_photon_532o"][row])
        rate = rate + float(truth["amplitude_photon_532o"][row]) * shape
        load = rate * 6e-3
        error = np.sqrt(rate / 30 / (1 + load) ** 3)
        scores["photon_532o"].append((values["photon_532o"] - rate / (1 + load)) / error)
        variance = 1.2 * 0.05**2 * rate / 30 + (0.2**2 + (100 / 4096) ** 2 / 12) / 600
        scores["analog_532o"].append((values["analog_532o"] - 0.05 * rate - 3) / np.sqrt(variance))
    for name, score in scores.items():
        z = np.array(score)[:, beyond]
        assert abs(z.mean()) < 4 / np.sqrt(z.size), name
        assert z.std() == pytest.approx(1, abs=0.03), name


def test_the_truth_of_a_fast_simulation_fits_its_signals(small):
    def fast(tree):
        tree["simulation"]["fast"] = True
        tree["simulation"]["duration"] = 3600
        tree["simulation"]["truth"] = {"cells": 800}
        del _simulated(tree)["coast-lidar"]
        hill = _simulated(tree)["hill-lidar"]
        hill["detectors"] = hill["detectors"][:1]
        hill["acquisition"]["interval"] = 60
        height = {"minimum": 100, "maximum": 3000, "hour_of_maximum": 6}
        hill["atmosphere"] = {"boundary_layer": {"height": height}}

    result = simulate_campaign(small(fast))
    truth = result.truth
    profiles = truth["profile_total_extinction_hill_lidar"].values[:, 0]
    # The air changes every ten minutes, and the truth with it.
    changes = np.flatnonzero(np.any(profiles[1:] != profiles[:-1], axis=1)) + 1
    np.testing.assert_array_equal(changes, [10, 20, 30, 40, 50])
    for row in (5, 55):
        signal = _values(result, row)["analog_1064o"] - 3.0
        distance = truth["range_hill_lidar"].values
        depth = truth["profile_path_optical_depth_hill_lidar"].values[row, 0]
        middle = depth - 0.5 * np.diff(depth, prepend=0)
        backscatter = truth["profile_total_backscatter_hill_lidar"].values[row, 0]
        shape = backscatter * np.exp(-2 * middle) / distance**2 * 30e12 * 0.05
        sky = float(truth["background_analog_1064o"][row])
        noise = np.sqrt(0.2**2 / 600 + 1.2 * 0.05 * (shape + sky) / 30)
        score = ((signal - shape - sky) / noise)[distance > 300]
        assert abs(score.mean()) < 4 / np.sqrt(score.size)
        assert score.std() == pytest.approx(1, abs=0.1)


def test_a_thin_layer_is_not_missed_by_coarse_truth(small):
    def cloud(tree):
        del _simulated(tree)["coast-lidar"]
        hill = _simulated(tree)["hill-lidar"]
        period = {"start": "2024-12-31", "stop": "2025-01-02"}
        hill["atmosphere"] = {"clouds": [{"extinction": 0.01, "base": 3000, "top": 3030, **period}]}

    coarse = simulate_campaign(small(cloud, lambda t: t["simulation"].update(truth={"cells": 8})))
    fine = simulate_campaign(
        small(cloud, lambda t: t["simulation"].update(truth={"cells": 800}), archive="fine")
    )
    depths = {}
    for name, result in (("coarse", coarse), ("fine", fine)):
        truth = result.truth.isel(wavelength_hill_lidar=0, profile_hill_lidar=0)
        end = truth["range_end_hill_lidar"].values
        depth = truth["profile_path_optical_depth_hill_lidar"].values
        assert depth[-1] == pytest.approx(0.3, abs=0.15)
        # Extinction is the mean over a cell, so that it adds up to the optical depth.
        width = np.diff(end, prepend=0)
        total = np.cumsum(truth["profile_total_extinction_hill_lidar"].values * width)
        np.testing.assert_allclose(total, depth, rtol=1e-5)
        depths[name] = dict(zip(end, depth, strict=True))
    for end, depth in depths["coarse"].items():
        assert depths["fine"][end] == pytest.approx(depth, rel=1e-6)


def test_long_campaigns_store_some_true_profiles(small):
    result = simulate_campaign(small(lambda t: t["simulation"].update(truth={"profiles": 2})))
    assert result.truth.sizes["profile_hill_lidar"] == 2
    assert list(result.truth["profile_granule_hill_lidar"].values) == [20, 22]
    none = simulate_campaign(
        small(lambda t: t["simulation"].update(truth={"cells": 0}), archive="none")
    )
    assert "profile_hill_lidar" not in none.truth.sizes


def test_the_truth_holds_the_drift_of_laser_and_dark_offset(small):
    def drifting(tree):
        tree["simulation"]["duration"] = 7200
        del _simulated(tree)["hill-lidar"]
        coast = _simulated(tree)["coast-lidar"]
        coast["laser"] = {"per_hour": -0.1, "jitter": 0.02}
        coast["detectors"][0]["analog"]["dark_drift"] = 0.5

    truth = simulate_campaign(small(drifting)).truth
    energy = truth["energy"].values
    hours = (np.arange(120) + 0.5) / 60
    assert energy == pytest.approx(1 - 0.1 * hours, abs=0.1)
    spread = energy / (1 - 0.1 * hours) - 1
    assert spread.std() == pytest.approx(0.02, rel=0.3)
    for channel in ("photon_532o", "analog_532o"):
        amplitude = truth[f"amplitude_{channel}"].values
        np.testing.assert_allclose(amplitude / energy, amplitude[0] / energy[0], rtol=1e-12)
    np.testing.assert_allclose(truth["dark_offset_analog_532o"], 3 + 0.5 * hours)
