"""The closed forms of the paper against linear algebra, each other and the retrieval."""

from __future__ import annotations

import numpy as np
import pytest
from support.oracles.network import at_crossings, cycle_start, gradient, triangle, without_noise

from lidarops.bench.accuracy.network_cases import systematic_error


@pytest.mark.parametrize("beams", [3, 5, 12, 40])
def test_the_closed_form_solves_the_rows_of_a_cycle(beams):
    rng = np.random.default_rng(beams)
    start = rng.uniform(1.0, 2.0, (100, beams))
    end, integral = start * rng.uniform(0.6, 0.9, start.shape), rng.uniform(0.1, 0.3, start.shape)
    rows = np.arange(beams)
    matrix = np.zeros((100, beams, beams))
    matrix[:, rows, rows] = start
    matrix[:, rows, (rows + 1) % beams] -= end
    exact = np.linalg.solve(matrix, integral[..., np.newaxis])[:, 0, 0]
    np.testing.assert_allclose(cycle_start(start, end, integral), exact, rtol=1e-12)


@pytest.mark.parametrize("multiplier", [0.0, 0.5, 0.8, 0.95, 1.0])
def test_the_systematic_error_is_that_of_the_closed_form_in_any_field(multiplier):
    rng = np.random.default_rng(3)
    extinction = rng.uniform(0.5, 4.0, 3)
    depth = np.array([0.3, 0.2, -0.1])
    start = extinction.copy()
    end = np.roll(extinction, -1) * np.exp(-2.0 * depth)
    integral = start / extinction - end / np.roll(extinction, -1)
    estimate = cycle_start(start, end, integral, multiplier)
    expected = systematic_error(depth, multiplier)
    assert 1.0 - estimate * extinction[0] == pytest.approx(expected, abs=1e-12)


def test_there_is_no_error_beyond_the_pole():
    assert np.isnan(systematic_error(np.array([-0.5, -0.5, -0.5]), 0.95))


def test_the_retrieval_of_a_triangle_agrees_with_the_closed_form():
    """Without noise and prior, both are exact up to the step of the bins."""
    net = triangle()
    truth = at_crossings(net, gradient)
    first = int(net.on_beam(0)[0][0])
    crossings = [net.on_beam(beam)[0] for beam in range(3)]
    order, beams, signs = [first], [], []
    while len(beams) < 3:
        beam = next(b for b in range(3) if b not in beams and order[-1] in crossings[b])
        near, far = crossings[beam]
        order.append(int(far if order[-1] == near else near))
        signs.append(1.0 if order[-2] == near else -1.0)
        beams.append(beam)
    distance = [np.linspace(*np.sort(net.on_beam(b)[1]), 20001) for b in beams]
    start, end, integral = np.empty((3, 3))
    for row, (beam, r) in enumerate(zip(beams, distance, strict=True)):
        x, y, z = net.origin[beam][:, np.newaxis] + net.direction[beam][:, np.newaxis] * r
        sigma = gradient(x, y, z)
        steps = 0.5 * (sigma[1:] + sigma[:-1]) * np.diff(r)
        signal = sigma * np.exp(-2.0 * np.append(0.0, np.cumsum(steps)))
        area = 2.0 * np.sum(0.5 * (signal[1:] + signal[:-1]) * np.diff(r))
        start[row], end[row] = signal[[0, -1]] if signs[row] > 0 else signal[[-1, 0]]
        integral[row] = signs[row] * area
    closed = 1.0 / cycle_start(start, end, integral)
    assert closed == pytest.approx(truth[first], rel=1e-5)
    assert without_noise(net, gradient, step=1.0).extinction[first] == pytest.approx(
        closed, rel=1e-3
    )
