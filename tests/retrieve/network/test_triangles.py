"""The closed forms of the paper against linear algebra, each other and the retrieval."""

from __future__ import annotations

import numpy as np
import pytest
from support.oracles.network import (
    at_crossings,
    cycle_start,
    fan,
    gradient,
    grid,
    homogeneous,
    noisy,
    plume,
    relative_errors,
    root_mean_square,
    signals,
    triangle,
    with_noise,
    without_noise,
)

from lidarops.errors import RetrievalInputError
from lidarops.flags import Quality
from lidarops.retrieve.network.extinction_field import retrieve_network
from lidarops.retrieve.network.triangles import systematic_error

MULTIPLIERS = [0.0, 0.5, 0.8, 0.95, 1.0]


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


@pytest.mark.parametrize("multiplier", MULTIPLIERS)
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
    for multiplier in MULTIPLIERS:
        result = without_noise(net, gradient, step=1.0, multiplier=multiplier)
        closed = 1.0 / cycle_start(start, end, integral, multiplier)
        assert result.extinction[first] == pytest.approx(closed, rel=1e-3)


# The retrieval with a multiplier ------------------------------------------------------------


def solved(air, relative, multiplier, profiles=300):
    return with_noise(triangle(), air, relative, profiles, multiplier=multiplier)


@pytest.mark.parametrize("exponent", [0.7, 1.0, 1.5])
@pytest.mark.parametrize("multiplier", MULTIPLIERS)
def test_in_homogeneous_air_the_error_is_that_of_formula_17(multiplier, exponent):
    """Without noise, the stated error is the whole error, at both near crossings."""
    net, truth = triangle(), 2e-3
    result = without_noise(net, homogeneous(truth), exponent=exponent, multiplier=multiplier)
    stated = result.multiplier_error
    np.testing.assert_allclose((result.extinction - stated)[:2], truth, rtol=1e-8)
    assert np.isnan(result.extinction[2])
    if exponent == 1.0 and multiplier == 0.8:
        # Fixed figure: a quarter too small a visibility at crossing 1.
        assert stated[0] / result.extinction[0] == pytest.approx(0.2527, abs=1e-4)


@pytest.mark.parametrize("air", [gradient, plume])
def test_a_multiplier_of_one_is_exact_in_any_field(air):
    net = triangle()
    result = without_noise(net, air, step=1.0, multiplier=1.0)
    np.testing.assert_allclose(result.extinction[:2], at_crossings(net, air)[:2], rtol=2e-3)
    np.testing.assert_array_equal(result.multiplier_error[:2], 0.0)


@pytest.mark.parametrize("multiplier", [0.0, 0.8, 0.95, 1.0])
def test_the_stated_noise_of_a_triangle_is_that_of_many_profiles(multiplier):
    net, air = triangle(), homogeneous()
    distance = grid(net)
    clean = signals(net, distance, air)
    power, variance = noisy(net, distance, clean, 0.005, 1000, additive=0.001)
    result = retrieve_network(
        power, distance, net, variance=variance, full_overlap_range=100.0, multiplier=multiplier
    )
    scatter = np.std(np.log(result.extinction[:, :2]), axis=0)
    stated = np.median(result.extinction_standard_error / result.extinction, axis=0)[:2]
    np.testing.assert_allclose(scatter, stated, rtol=0.08)


@pytest.mark.parametrize("relative", [0.003, 0.05, 0.1])
def test_the_chosen_multiplier_is_no_worse_than_any_fixed_one(relative):
    """In homogeneous air; with 10 percent of noise, linear errors of the noise fall short."""
    errors = {
        multiplier: root_mean_square(
            relative_errors(solved(homogeneous(), relative, multiplier), 2e-3)
        )[0]
        for multiplier in ("chosen", 1.0, 0.98, 0.95, 0.9, 0.8, 0.0)
    }
    chosen = errors.pop("chosen")
    assert chosen <= 1.06 * min(errors.values())
    # The figures of the paper's triangle: a multiplier of 0.8 costs a quarter of the visibility.
    assert errors[0.8] > 0.25
    assert errors[0.8] > 1.2 * chosen


@pytest.mark.parametrize(
    ("air", "share"), [(homogeneous(), 0.967), (gradient, 0.907), (plume, 0.976)]
)
def test_all_beams_together_are_better_than_a_triangle(air, share):
    """The stated bias is that of homogeneous air, so that it falls short in a gradient."""
    truth = at_crossings(triangle(), air)
    chosen, joint = (solved(air, 0.05, multiplier) for multiplier in ("chosen", None))
    errors = [root_mean_square(relative_errors(result, truth))[:2] for result in (joint, chosen)]
    assert (errors[0] < errors[1]).all()
    stated = np.hypot(chosen.extinction_standard_error, chosen.multiplier_error)
    inside = abs(chosen.extinction - truth) < 1.96 * stated
    covered = inside[:, :2][~chosen.flagged[:, :2]].mean()
    assert covered == pytest.approx(share, abs=6e-3)


def test_the_chosen_multiplier_falls_with_the_noise():
    chosen = [np.median(solved(homogeneous(), e, "chosen").multiplier[:, 0]) for e in (0.003, 0.1)]
    assert 0.98 < chosen[0] < 1.0
    assert 0.85 < chosen[1] < 0.95


def test_a_block_has_one_multiplier():
    net = triangle()
    distance = grid(net)
    power, variance = noisy(net, distance, signals(net, distance, plume), 0.05, 60)
    given = {"variance": variance, "full_overlap_range": 100.0, "blocks": np.arange(60) // 20}
    chosen = retrieve_network(power, distance, net, multiplier="chosen", **given)
    assert np.unique(chosen.multiplier[:20, 0]).size == 1
    assert np.unique(chosen.multiplier[:, 0]).size > 1


def test_a_crossing_without_a_triangle_is_not_measured():
    """Two beams of one lidar meet two of another one: four crossings in a quadrilateral."""
    net = fan([0.0, 400.0], [[50.0, 70.0], [110.0, 130.0]])
    result = without_noise(net, homogeneous(), multiplier=1.0)
    assert result.raised(Quality.INPUT_MISSING).all()
    assert np.isnan(result.extinction).all()


@pytest.mark.parametrize("multiplier", [-0.1, 1.1, [0.5, 0.5], "best"])
def test_other_multipliers_are_refused(multiplier):
    with pytest.raises(RetrievalInputError, match="multiplier"):
        without_noise(triangle(), homogeneous(), multiplier=multiplier)
