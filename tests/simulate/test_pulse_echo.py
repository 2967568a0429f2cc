"""Signals of finite pulses against integrals of the lidar equation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import expon, norm, uniform

from lidarops.campaign.simulated_instrument import Pulse
from lidarops.constants import SPEED_OF_LIGHT
from lidarops.simulate.atmosphere import BeamPath
from lidarops.simulate.campaign import simulate_campaign
from lidarops.simulate.pulse import pulse_echo
from lidarops.simulate.signal import backscatter_signal

STEP = 7.5
DISTANCE = (np.arange(400) + 0.5) * STEP


def _path(sigma, distance=DISTANCE):
    return BeamPath(np.full_like(distance, sigma), np.full_like(distance, 1e-6))


def _echo(sigma, shape, width, full=10.0):
    return pulse_echo(
        DISTANCE,
        _path(sigma),
        Pulse(shape=shape, width=width),
        system_constant=1e12,
        full_overlap_range=full,
    )


def _shape(shape, width):
    length = 0.5 * SPEED_OF_LIGHT * width
    if shape == "rectangle":
        return uniform(-0.5 * length, length), (-0.5 * length, 0.5 * length)
    if shape == "gaussian":
        return norm(scale=length / (2 * np.sqrt(2 * np.log(2)))), (-2 * length, 2 * length)
    return expon(-length, length), (-length, 19 * length)


@pytest.mark.parametrize("sigma", [0.0, 2e-4, 2e-3])
@pytest.mark.parametrize(
    ("shape", "width"),
    [("rectangle", 100e-9), ("rectangle", 20e-9), ("gaussian", 60e-9), ("exponential", 15e-9)],
)
def test_a_pulse_is_smeared_as_the_integral_says(sigma, shape, width):
    signal = _echo(sigma, shape, width)
    pulse, (first, last) = _shape(shape, width)

    def rate(at):
        s = first + (last - first) * (np.arange(100_000) + 0.5) / 100_000
        values = pulse.pdf(s) * np.exp(-2 * sigma * (at - s)) / (at - s) ** 2
        return values.mean() * (last - first)

    for number in (60, 350):
        start = number * STEP
        inside, weights = np.polynomial.legendre.leggauss(4)
        points = start + 0.5 * STEP * (inside + 1)
        expected = 1e6 * sum(w * rate(p) for w, p in zip(weights, points, strict=True)) / 2
        assert signal[number] == pytest.approx(expected, rel=2e-5)


def test_a_rectangular_pulse_without_extinction_has_a_closed_form():
    # The mean over s of (R - s)^-2 is 1 / ((R - l/2) (R + l/2)); over a bin, a logarithm.
    width = 2 * 15.0 / SPEED_OF_LIGHT
    signal = _echo(0.0, "rectangle", width)
    near, far = DISTANCE - 0.5 * STEP, DISTANCE + 0.5 * STEP
    beyond = DISTANCE > 60

    def antiderivative(r):
        return np.log((r - 7.5) / (r + 7.5)) / 15.0

    expected = 1e6 * (antiderivative(far[beyond]) - antiderivative(near[beyond])) / STEP
    # Cells of a quarter of a bin: an error of the second order in their size.
    np.testing.assert_allclose(signal[beyond], expected, rtol=3e-4)
    np.testing.assert_allclose(signal[40:], expected[32:], rtol=1.5e-5)


def test_a_short_pulse_gives_the_short_pulse_signal():
    signal = _echo(2e-4, "gaussian", 5e-9, full=300.0)
    path = _path(2e-4)
    point = backscatter_signal(
        DISTANCE,
        extinction=path.extinction,
        backscatter=path.backscatter,
        system_constant=1e12,
        full_overlap_range=300.0,
    )
    far = DISTANCE > 400
    np.testing.assert_allclose(signal[far], point[far], rtol=2e-4)


def test_nothing_diverges_at_the_lidar():
    signal = _echo(1e-4, "rectangle", 1e-6, full=500.0)
    assert np.isfinite(signal).all()
    assert (signal >= 0).all()
    assert signal[:20].max() < 100 * signal[200]


def test_the_base_of_a_cloud_is_blurred_by_the_pulse(small):
    def pulsed(tree):
        del tree["simulation"]["instruments"]["coast-lidar"]
        hill = tree["simulation"]["instruments"]["hill-lidar"]
        hill["pulse"] = {"shape": "gaussian", "width": 400e-9}
        hill["atmosphere"] = {
            "clouds": [
                {
                    "extinction": 0.001, "base": 3000, "top": 3600,
                    "start": "2024-12-31", "stop": "2025-01-02",
                }
            ]
        }  # fmt: skip

    def rise(campaign):
        result = simulate_campaign(campaign)
        raw = (result.archive / str(result.truth["path"].values[0])).read_bytes()
        body = raw.partition(b"\r\n\r\n")[2]
        counts = np.frombuffer(body, "<i4", 800, 800 * 4 + 2)  # the photon counter
        signal = counts * DISTANCE.size / 400 * ((np.arange(800) + 0.5) * STEP) ** 2
        low, top = signal[300:380].mean(), signal[420:440].mean()
        inside = (signal - low) / (top - low)
        return np.count_nonzero((inside > 0.1) & (inside < 0.85) & (np.arange(800) < 430))

    blurred = rise(small(pulsed, archive="pulsed"))

    def sharp(tree):
        pulsed(tree)
        del tree["simulation"]["instruments"]["hill-lidar"]["pulse"]

    # 60 m of pulse at half maximum are 8 bins.
    assert rise(small(sharp, archive="sharp")) <= 2
    assert 4 <= blurred <= 14
