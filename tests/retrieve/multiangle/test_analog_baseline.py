"""The analog baseline that beams behind a tree or building show."""

from __future__ import annotations

import numpy as np
import pytest

from lidarops.retrieve.multiangle.analog_baseline import BlockedBeams

DISTANCE = 3.75 * (np.arange(8000) + 0.5)
TAIL = (22e3, 26e3)
"""m; the record is longer."""
IN_TAIL = (TAIL[0] <= DISTANCE) & (TAIL[1] >= DISTANCE)
NOISE = 5e-3
TRUE = 4e-3 * np.exp(-DISTANCE / 6000.0) + 4e-7 * DISTANCE
"""mV."""


def scan(rng, targets, *, true=TRUE, echo=30.0, scatter=0.0, light=60.0):
    """Return power and variance of analog profiles, each blocked at its target, in mV."""
    power = np.empty((len(targets), DISTANCE.size))
    for row, target in enumerate(targets):
        falling = light * (300.0 / DISTANCE) ** 2 * np.exp(-2e-4 * DISTANCE)
        falling = np.where(target > DISTANCE, falling, 0.0)
        falling[(target <= DISTANCE) & (target + 40.0 > DISTANCE)] = echo
        own = scatter * rng.normal() * np.exp(-DISTANCE / 15000.0)
        power[row] = 4.8 + true + own + falling + rng.normal(0.0, NOISE, DISTANCE.size)
    return power, np.full(power.shape, NOISE**2)


def baseline(power, variance, together=1000):
    beams = BlockedBeams(DISTANCE, TAIL)
    for first in range(0, len(power), together):
        rows = np.arange(first, min(first + together, len(power)))
        beams.add(power[rows], variance[rows], rows)
    return beams.baseline()


# Fewer beams do not show how much they differ.
@pytest.mark.parametrize(("blocked", "scatter"), [(1, 0.0), (2, 0.0), (6, 0.0), (6, 3e-3)])
def test_the_baseline_lies_within_its_error(blocked, scatter):
    rng = np.random.default_rng(blocked)
    deviations = []
    for _ in range(30):
        targets = [*rng.uniform(100.0, 900.0, blocked), np.inf, np.inf, np.inf]
        found = baseline(*scan(rng, targets, scatter=scatter))
        assert found.profile.tolist() == list(range(blocked))
        assert (found.obstruction <= targets[:blocked]).all()
        expected = np.interp(found.range, DISTANCE, TRUE) - TRUE[IN_TAIL].mean()
        deviation = (found.power - expected) / found.standard_error
        deviations.append(deviation[found.range < TAIL[0]])
    spread = np.sqrt(np.mean(np.square(np.concatenate(deviations))))
    # The error is that of the baseline of a free beam, which differs from the mean as others do.
    assert (0.3 if scatter else 0.8) < spread < 1.2


def test_a_record_without_light_becomes_zero():
    rng = np.random.default_rng(4)
    found = baseline(*scan(rng, [*rng.uniform(100.0, 400.0, 30), np.inf]))
    net = TRUE - found.at(DISTANCE)
    net -= net[IN_TAIL].mean()
    assert found.at(DISTANCE[IN_TAIL]).mean() == pytest.approx(0.0, abs=1e-9)
    beyond = (found.range[0] < DISTANCE) & (TAIL[1] > DISTANCE)
    assert (np.abs(net) < 4.0 * found.error_at(DISTANCE))[beyond].all()


# The faster the recovery, the less of it the first two blocks show.
@pytest.mark.parametrize(("recovery", "most"), [(300.0, 2.2), (1000.0, 1.5), (6000.0, 1.0)])
def test_the_error_covers_a_recovery_before_the_first_block(recovery, most):
    """Beams are blocked at 200 to 300 m, so that the first block begins at 600 m."""
    true = 8e-3 * np.exp(-DISTANCE / recovery)
    near = (DISTANCE > 200.0) & (DISTANCE < 900.0)
    rng = np.random.default_rng(6)
    ratios = []
    for _ in range(30):
        targets = [*rng.uniform(200.0, 300.0, 6), np.inf, np.inf]
        found = baseline(*scan(rng, targets, true=true))
        assert found.range[0] == 750.0
        net = true - true[IN_TAIL].mean() - found.at(DISTANCE)
        ratios.append((net / found.error_at(DISTANCE))[near])
    assert 0.5 < np.sqrt(np.square(ratios).mean()) < most


def test_profiles_taken_together_change_no_bit():
    power, variance = scan(np.random.default_rng(1), [300.0, np.inf, 500.0, np.inf, 200.0])
    one, other = (baseline(power, variance, together) for together in (1, 5))
    for name in ("range", "power", "standard_error", "profile", "obstruction"):
        assert np.array_equal(getattr(one, name), getattr(other, name))


def test_free_beams_show_no_baseline():
    assert baseline(*scan(np.random.default_rng(2), [np.inf] * 5)) is None


def test_an_echo_before_the_overlap_is_no_obstruction():
    """A bright window, darkness up to 500 m, and light beyond, in one of the profiles."""
    power, variance = scan(np.random.default_rng(3), [np.inf] * 4)
    power[0, (DISTANCE > 130.0) & (DISTANCE < 500.0)] = 4.8
    power[0, DISTANCE < 130.0] += 3000.0
    assert baseline(power, variance) is None


def test_the_echo_of_a_target_leaves_the_baseline_as_it_is():
    """25 uV behind the target, which fall by half in 30 m, as in a real scan."""
    target = 299.0
    power, variance = scan(np.random.default_rng(5), [target, np.inf, np.inf])
    echo = 25e-3 * 0.5 ** ((DISTANCE - target - 40.0) / 30.0)
    with_echo = power.copy()
    with_echo[0] += np.where(target + 40.0 < DISTANCE, echo, 0.0)
    before, found = (baseline(values, variance) for values in (power, with_echo))
    assert np.array_equal(found.range, before.range)
    assert (np.abs(found.power - before.power) < 0.1 * found.standard_error).all()


def test_far_blocks_are_longer_and_have_less_noise():
    found = baseline(*scan(np.random.default_rng(7), [200.0, np.inf, np.inf]))
    of_300_m = NOISE / np.sqrt(300.0 / 3.75)
    assert (found.standard_error[found.range > 6000.0] < 0.6 * of_300_m).all()


def test_a_beam_that_is_dark_behind_afterpulses_is_blocked():
    """As a photon counter sees it, where free beams are saturated up to 1 km."""
    power, variance = scan(np.random.default_rng(6), [60.0, np.inf, np.inf])
    power[1:, DISTANCE < 1000.0] = np.nan
    near = DISTANCE < 300.0
    power[0, near] = 4.8 + 2.0 * (60.0 / DISTANCE[near]) ** 2 * np.exp(-DISTANCE[near] / 60.0)
    beams = BlockedBeams(DISTANCE, TAIL)
    beams.add(power, variance, np.arange(3))
    assert beams.obstructions() == {0: 300.0}


def test_weak_beams_are_not_taken_for_blocked_ones():
    power, variance = scan(np.random.default_rng(7), [np.inf] * 300, true=0.0, light=3e-3)
    beams = BlockedBeams(DISTANCE, TAIL)
    beams.add(power, variance, np.arange(300))
    assert beams.obstructions() == {}
