"""Finite pulses against closed forms and adaptive quadrature of the integral itself."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from lidarops.constants import SPEED_OF_LIGHT
from lidarops.errors import LidarOpsError
from lidarops.simulate.pulse import (
    ExponentialPulse,
    GaussianPulse,
    RectangularPulse,
    pulsed_signal,
    response,
)
from lidarops.simulate.signal import SimulationInputError, backscatter_signal, bin_centres

HALF_C = SPEED_OF_LIGHT / 2

SHAPES = {
    "rectangle": RectangularPulse(20e-9),
    "gauss": GaussianPulse(8e-9),
    "exponential": ExponentialPulse(4e-9),
}


def _homogeneous(distance, sigma, pulse, **more):
    return pulsed_signal(
        distance,
        extinction=np.full(distance.size, sigma),
        backscatter=np.full(distance.size, 2e-6),
        system_constant=1e9,
        pulse=pulse,
        **more,
    ) / (1e9 * 2e-6)


@settings(deadline=None)
@given(
    st.floats(1e-9, 2e-6),
    st.floats(1.0001, 3.0),
    st.floats(0.1, 30.0),
    st.sampled_from([None, 0.3, 2.0]),
)
def test_a_rectangular_pulse_has_the_exact_near_range_factor(duration, first, step, resolution):
    length = HALF_C * duration
    distance = length * first + step * np.arange(500)
    ours = _homogeneous(distance, 0.0, RectangularPulse(duration), resolution=resolution)
    exact = 1 / (distance * (distance - length))
    # Next to the lidar, rounding of R - c tau / 2 costs more digits.
    digits = 1e-15 * distance / (distance - length)
    assert np.all(np.abs(ours / exact - 1) <= 2e-14 + digits)
    assert np.all(np.abs(ours / exact - 1)[distance > 1.01 * length] <= 1e-12)


@pytest.mark.parametrize("sigma", [1e-5, 1e-4, 1e-3])
@pytest.mark.parametrize("duration", [20e-9, 100e-9, 600e-9])
def test_extinction_along_the_pulse_is_an_exponential_integral(sigma, duration):
    length = HALF_C * duration
    distance = np.linspace(length + 100, 6000, 60)
    ours = _homogeneous(distance, sigma, RectangularPulse(duration), resolution=0.3)

    def upward(r):
        return mpmath.expint(2, 2 * mpmath.mpf(sigma) * r) / r

    exact = [float((upward(mpmath.mpf(r) - length) - upward(mpmath.mpf(r))) / length)
             for r in distance]  # fmt: skip
    np.testing.assert_allclose(ours, exact, rtol=1e-6)


@pytest.mark.parametrize("sigma", [0.0, 1e-4, 2e-3])
def test_the_bin_centre_stands_for_the_bin(sigma):
    distance = bin_centres(800, 7.5)[1:]
    mean = _homogeneous(distance, sigma, None, bin_width=7.5, resolution=0.25)
    at_centre = backscatter_signal(
        distance,
        extinction=np.full(799, sigma),
        backscatter=np.ones(799),
        system_constant=1.0,
    )
    far = distance >= 300
    error = at_centre / mean - 1
    assert np.abs(error[far]).max() <= 4e-4
    assert np.abs(error[far]).max() > 1e-4
    # At the start of the bin it would be wrong by 2.5 per cent there.
    start = distance[far] - 3.75
    assert abs(np.exp(-2 * sigma * start[0]) / start[0] ** 2 / mean[far][0] - 1) > 0.02
    for j in (10, 40, 400):
        edges = [mpmath.mpf(7.5) * j, mpmath.mpf(7.5) * (j + 1)]
        exact = mpmath.quad(lambda r: mpmath.exp(-2 * sigma * r) / r**2, edges) / 7.5
        assert mean[j - 1] == pytest.approx(float(exact), rel=3e-7)


@pytest.mark.parametrize("shape", SHAPES)
def test_energy_leaves_between_start_and_stop(shape):
    pulse = SHAPES[shape]
    time = np.linspace(pulse.start, pulse.stop, 41)
    passed = pulse.passed(time)
    assert passed[0] == pytest.approx(0, abs=1e-12)
    assert passed[-1] == pytest.approx(1, abs=1e-12)
    assert np.all(np.diff(passed) > 0)
    assert pulse.passed(np.array([pulse.start - 1e-8, pulse.stop + 1e-8])) == pytest.approx([0, 1])
    ends = np.array([0.3 * pulse.start + 0.7 * pulse.stop, pulse.stop + 7e-9])
    for end, ours in zip(ends, pulse.passed_integral(ends), strict=True):
        nodes = np.linspace(pulse.start, end, 200_001)
        assert ours == pytest.approx(np.trapezoid(pulse.passed(nodes), nodes), rel=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("width", [None, 7.5])
def test_cells_hold_the_whole_pulse(shape, width):
    edges, density = response(SHAPES[shape], bin_width=width)
    assert np.sum(density * np.diff(edges)) == pytest.approx(1, rel=1e-12)
    assert np.all(density >= 0)
    span = (SHAPES[shape].stop - SHAPES[shape].start) * HALF_C + (width or 0.0)
    assert edges[-1] - edges[0] == pytest.approx(span, rel=1e-12)


def test_the_origin_of_time_is_as_stated():
    gauss = SHAPES["gauss"]
    assert gauss.passed(np.array([0.0]))[0] == pytest.approx(0.5)
    assert gauss.start == -gauss.stop == pytest.approx(-3 * 8e-9 / math.sqrt(8 * math.log(2)))
    assert SHAPES["rectangle"].start == SHAPES["exponential"].start == 0
    assert SHAPES["rectangle"].stop == 20e-9


def _power(name, time):
    """Return the power of a pulse shape by its definition, 1/s."""
    if name == "rectangle":
        return 1 / 20e-9 if 0 <= time <= 20e-9 else 0.0
    if name == "gauss":
        s = 8e-9 / math.sqrt(8 * math.log(2))
        z = time / s
        if abs(z) > 3:
            return 0.0
        return math.exp(-z * z / 2) / (s * math.sqrt(2 * math.pi) * math.erf(3 / 2**0.5))
    return math.exp(-time / 4e-9) / 4e-9 if time >= 0 else 0.0


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("far", [12.0, 150.0, 2000.0])
def test_every_shape_is_its_integral(name, far):
    # Equation 20 by adaptive quadrature: a layer, overlap, two wavelengths.
    path = np.linspace(0.25, 4000.0, 16_000)
    out, back = 2e-4 * np.exp(-path / 900), 1.5e-4 * np.exp(-path / 700)
    beta = 3e-6 * (1 + 0.5 * np.sin(path / 90))
    ours = pulsed_signal(
        np.array([far, far + 100]),
        extinction=out,
        backscatter=beta,
        returning_extinction=back,
        system_constant=1.0,
        pulse=SHAPES[name],
        full_overlap_range=400.0,
        path=path,
        resolution=0.02,
    )[0]

    def integrand(r):
        tau = 2e-4 * 900 * -math.expm1(-r / 900) + 1.5e-4 * 700 * -math.expm1(-r / 700)
        overlap = math.sin(math.pi * min(r, 400.0) / 800) ** 2
        scattered = 3e-6 * (1 + 0.5 * math.sin(r / 90)) * math.exp(-tau)
        return scattered * overlap / r**2 * _power(name, (far - r) / HALF_C) / HALF_C

    pulse = SHAPES[name]
    low, high = max(far - HALF_C * pulse.stop, 1e-9), far - HALF_C * pulse.start
    kinks = sorted({min(max(far - HALF_C * t, low), high) for t in (2e-9, 5e-9, 8e-9, 10e-9)})
    exact = quad(integrand, low, high, points=kinks, limit=400, epsrel=1e-11, epsabs=0)[0]
    assert ours == pytest.approx(exact, rel=3e-5)


def test_optical_properties_are_linear_between_their_points():
    # Two points only: extinction and backscatter rise linearly, the optical depth as R^2.
    distance = np.array([500.0, 1500.0, 2900.0, 3500.0])
    ours = pulsed_signal(
        distance,
        extinction=np.array([0.0, 2e-3]),
        backscatter=np.array([1e-6, 4e-6]),
        system_constant=1.0,
        pulse=RectangularPulse(1e-9),
        path=np.array([1e-9, 3000.0]),
    )
    middle = distance - HALF_C * 0.5e-9
    inside = np.minimum(middle, 3000.0)
    tau = 2e-3 * inside**2 / 6000.0 + 2e-3 * (middle - inside)
    expected = (1e-6 + 1e-9 * inside) / middle**2 * np.exp(-2 * tau)
    np.testing.assert_allclose(ours, expected, rtol=1e-6)


def test_a_detector_takes_the_mean_over_its_bin():
    distance = np.array([200.0, 600.0, 3000.0])
    pulse = GaussianPulse(20e-9)
    ours = _homogeneous(distance, 1e-3, pulse, bin_width=15.0, resolution=0.05)
    nodes, weights = np.polynomial.legendre.leggauss(20)
    for r, value in zip(distance, ours, strict=True):
        within = _homogeneous(r + 7.5 * nodes, 1e-3, pulse, resolution=0.01)
        assert value == pytest.approx(within @ weights / 2, rel=2e-6)


@pytest.mark.parametrize(
    ("pulse", "measured", "width"),
    [
        (GaussianPulse(8e-9), 1.65, 1.2),
        (GaussianPulse(20e-9), 4.05, 3.3),
        (RectangularPulse(100e-9), 7.35, 12.0),
    ],
)
def test_a_cloud_base_rises_late_by_the_pulse(pulse, measured, width):
    path = np.arange(900.0, 1100.0, 0.01)
    cloud = np.where(path >= 1000.0, 1e-4, 0.0)
    distance = np.arange(995.0, 1030.0, 0.02)
    signal = pulsed_signal(
        distance,
        extinction=np.zeros(path.size),
        backscatter=cloud,
        system_constant=1.0,
        pulse=pulse,
        path=path,
        resolution=0.02,
    )
    rise = signal * distance**2 / 1e-4
    at = {level: np.interp(level, rise, distance) - 1000 for level in (0.1, 0.5, 0.9)}
    # The peak of a Gaussian, the middle of a rectangle; grids of 0.3 m differ by less than that.
    middle = HALF_C * 0.5 * (pulse.start + pulse.stop)
    assert at[0.5] == pytest.approx(middle, abs=0.1)
    assert at[0.5] - HALF_C * pulse.start == pytest.approx(measured, abs=0.3)
    assert at[0.9] - at[0.1] == pytest.approx(width, abs=0.2)


def test_a_long_pulse_over_the_telescope_stays_finite():
    # 1 microsecond (150 m): near ranges see the pulse while it leaves.
    distance = bin_centres(200, 7.5)
    signal = _homogeneous(
        distance, 1e-3, RectangularPulse(1e-6), full_overlap_range=300.0, bin_width=7.5
    )
    assert np.all(np.isfinite(signal))
    assert np.all(signal > 0)

    def integrand(r):
        return math.exp(-2e-3 * r) * math.sin(math.pi * min(r, 300) / 600) ** 2 / r**2

    length = HALF_C * 1e-6
    for j in (8, 30, 100):
        nodes, weights = np.polynomial.legendre.leggauss(12)
        exact = 0.0
        for node, weight in zip(nodes, weights / 2, strict=True):
            r = distance[j] + 3.75 * node
            low = max(r - length, 1e-9)
            exact += weight * quad(integrand, low, r, points=[min(max(300, low), r)])[0] / length
        assert signal[j] == pytest.approx(exact, rel=1e-4)
    # Before the lidar a symmetric pulse has left in part already.
    early = _homogeneous(
        np.array([-2.0, 0.0, 500.0]), 0.0, GaussianPulse(20e-9), full_overlap_range=300.0
    )  # fmt: skip
    assert early[1] > early[0] > 0


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"extinction": np.full(50, -1e-4)}, "extinction"),
        ({"backscatter": np.full(50, np.nan)}, "backscatter"),
        ({"extinction": np.zeros(49)}, "extinction"),
        ({"pulse": RectangularPulse(1e-4)}, "pulse"),
        ({"pulse": None}, "pulse"),
        ({"full_overlap_range": 0.0}, "full_overlap_range"),
        ({"full_overlap_range": -3.0}, "full_overlap_range"),
        ({"bin_width": 0.0}, "bin_width"),
        ({"resolution": 1e-9}, "resolution"),
        ({"path": np.zeros(50)}, "path"),
        ({"path": np.linspace(-9, 0, 50)}, "path"),
        ({"returning_extinction": np.full(50, -1.0)}, "returning_extinction"),
    ],
)
def test_impossible_input_is_refused(change, name):
    good = {
        "extinction": np.full(50, 1e-4),
        "backscatter": np.full(50, 1e-6),
        "pulse": RectangularPulse(200e-9),
        "full_overlap_range": 200.0,
    }
    distance = bin_centres(50, 7.5)
    assert np.all(pulsed_signal(distance, system_constant=1.0, **good) > 0)
    with pytest.raises(SimulationInputError, match=name) as caught:
        pulsed_signal(distance, system_constant=1.0, **(good | change))
    assert isinstance(caught.value, LidarOpsError)


@pytest.mark.parametrize(
    "make",
    [
        lambda: RectangularPulse(0.0),
        lambda: RectangularPulse(8.0),
        lambda: GaussianPulse(-1e-9),
        lambda: GaussianPulse(math.nan),
        lambda: ExponentialPulse(0.0),
    ],
)
def test_impossible_pulses_are_refused(make):
    with pytest.raises(SimulationInputError):
        make()
