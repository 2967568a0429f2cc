"""Simulated analog records with a baseline, and beams that end at a building."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lidarops.records import DetectionMode
from lidarops.simulate import files

Baseline = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Ranges in m and voltages of the light in mV to the baseline in mV."""
WALL = 200.0
"""m, range of the building in beams lower than `LOWEST_FREE`."""
LOWEST_FREE = 3.5
"""degree of elevation."""


def decaying(amplitude: float, length: float) -> Baseline:
    """Return a baseline of an amplitude in mV at the lidar that falls to 1/e in `length` m."""
    return lambda distance, _: amplitude * np.exp(-distance / length)


def undershoot(share: float, length: float) -> Baseline:
    """Return a baseline of a share of the largest voltage behind it, that falls to 1/e."""

    def baseline(distance: np.ndarray, voltage: np.ndarray) -> np.ndarray:
        peak = int(np.argmax(voltage))
        behind = distance - distance[peak]
        shape = np.exp(-np.maximum(behind, 0.0) / length) * (behind >= 0.0)
        return -share * voltage[peak] * shape

    return baseline


def record_with(monkeypatch: pytest.MonkeyPatch, baseline: Baseline | None) -> None:
    """Add a baseline to all analog records that are simulated, of dark files too."""
    plain = files.Simulator._read_out

    def read_out(simulator: Any, conditions: Any, detector: Any, *about: Any) -> Any:
        mode, light, random = about
        acquisition, rate = conditions.acquisition, light.electrons.rate
        distance = (np.arange(rate.size) + 0.5) * acquisition.bin_width
        if mode is not DetectionMode.ANALOG:
            return plain(simulator, conditions, detector, *about)
        if 90.0 - conditions.zenith_angle < LOWEST_FREE:
            rate = np.where(distance > WALL, light.sky, rate)
            light = replace(light, electrons=replace(light.electrons, rate=rate))
        counts, truth = plain(simulator, conditions, detector, mode, light, random)
        if baseline is None:
            return counts, truth
        recorder = detector.analog
        voltage = baseline(distance, (rate - light.sky) * recorder.gain)
        added = np.rint(voltage * acquisition.shots / recorder.step).astype(counts.dtype)
        top = acquisition.shots * (2**recorder.adc_bits - 1)
        return np.clip(counts + added, 0, top), truth

    monkeypatch.setattr(files.Simulator, "_read_out", read_out)
